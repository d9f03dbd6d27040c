"""Sources of rooms of files: as documents, by names below a folder, and with the files that they were made from."""

from dataclasses import replace
from pathlib import Path

import pytest
from helpers.room_files import BOX, write_files

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.rooms.mesh_placement import MeshLamp, MeshSettings, read_mesh
from phibench.datasets.rooms.panorama_room import PanoramaSettings
from phibench.datasets.rooms.room_files import RoomError, RoomFiles
from phibench.datasets.rooms.room_sources import SOURCES, MeshRoom, PanoramaRoom, room_of
from phibench.datasets.store.json_forms import from_json, to_json

LAMP = MeshLamp((0.0, 0.6, 2.55), (0.0, 0.0, -1.0), (1.2, 0.6))
HALL = MeshSettings(Path("meshes/hall.glb"), 1.0, "y", (0.0, 0.0, 0.0), lamps=(LAMP,))
OFFICE = PanoramaSettings(Path("office.png"), (0.3, -0.2, 1.4), box_m=BOX, texel_m=0.2)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> RoomFiles:
    """Files of both rooms. Read only."""
    return RoomFiles(write_files(tmp_path_factory.mktemp("files")))


@pytest.fixture(scope="module")
def sources(files: RoomFiles) -> tuple[PanoramaRoom, PanoramaRoom, MeshRoom]:
    photo, mesh = files.sha256("office.png"), files.sha256("meshes/hall.glb")
    on_mesh = replace(OFFICE, box_m=None, mesh=replace(HALL, lamps=()))
    return PanoramaRoom(OFFICE, photo), PanoramaRoom(on_mesh, photo, mesh), MeshRoom(HALL, mesh)


def test_a_source_comes_back_from_its_line(sources: tuple[PanoramaRoom | MeshRoom, ...]) -> None:
    for source in sources:
        assert from_json(SOURCES[source.kind], to_json(source)) == source


def test_the_room_is_the_same_wherever_its_files_lie(
    files: RoomFiles, sources: tuple[PanoramaRoom | MeshRoom, ...], tmp_path: Path
) -> None:
    other = write_files(tmp_path / "elsewhere")
    for source in sources:
        assert source.build(other).digest == room_of(source, files.folder).digest
        assert str(files.folder) not in repr(source.build(files.folder))


def test_a_missing_or_changed_file_is_one_sentence(
    sources: tuple[PanoramaRoom | MeshRoom, ...], tmp_path: Path
) -> None:
    photo, on_mesh, mesh = sources
    with pytest.raises(RoomError, match=r"office\.png is missing; put a file of at most 64 MiB there"):
        photo.build(tmp_path)
    folder = write_files(tmp_path)
    (folder / "meshes" / "hall.glb").write_bytes(b"glTF")
    for source in (on_mesh, mesh):
        with pytest.raises(RoomError, match=r"hall\.glb is another file than the room was made from: its SHA-256 begi"):
            source.build(folder)
    with pytest.raises(RoomError, match="nobody says in which folder"):
        photo.build()


@pytest.mark.parametrize("name", ["/etc/passwd", "../office.png", ".hidden", "a b.png", ""])
def test_names_lead_nowhere_else(name: str, sources: tuple[PanoramaRoom | MeshRoom, ...]) -> None:
    for source in sources:
        document = to_json(source)
        document["settings"]["path"] = name
        with pytest.raises(DatasetError, match=r"is no name of a file below the folder|not allowed"):
            from_json(SOURCES[source.kind], document)


def test_a_mesh_that_names_other_files_is_refused(tmp_path: Path) -> None:
    import trimesh

    for name, data in trimesh.exchange.gltf.export_gltf(trimesh.Scene(trimesh.creation.box((4, 4, 4)))).items():
        (tmp_path / name).write_bytes(data)
    assert read_mesh(tmp_path / "model.gltf")
    with pytest.raises(RoomError, match=r"names the file '\w+\.bin', and here a mesh must be one file; export it"):
        read_mesh(tmp_path / "model.gltf", one_file=True)
