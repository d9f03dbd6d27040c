"""Every function that reads a file has a fuzz target: the modules are walked, and the targets are watched."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from types import CodeType, FrameType

import pytest
from attack.test_fuzz_readers import FEW, MANY, fuzz_a_file, outcome, read_dataset
from attack.test_fuzz_rooms import as_room, written
from helpers.fuzz_folders import ALWAYS_READ as ALWAYS_READ_IN_FOLDERS
from helpers.fuzz_folders import DENSE_ANSWERS, folder_kinds
from helpers.fuzz_targets import ALWAYS_READ, ROOT, further_kinds, readers
from helpers.valid_files import Kind, kinds, read_sealed, write_sealed

from phibench.datasets.rooms.panorama_files import read_light

NAMES = (
    *("done.json", "spots.npz", "film.parquet", "film.avi", "MANIFEST.json", "set.part/fetch.json", "seed.txt"),
    *("SHA256SUMS", "sensor.toml", "tables.jpg", "limit.txt", "pairs.csv", "rig.toml", "photo.raw", "capture.toml"),
    *("frame.png", "descriptor.txt", "method.py", "network.onnx", "linear.hdr", "room.glb", "dense.jsonl"),
    "dense.so-far.parquet",
)
OF_FOLDERS = (
    *("dataset.json", "recipe.toml", "seal.json", ".phibench-draws", "export.json", "request.json", "rooms.json"),
    *("room000.npz", "imported.json", "pairs.jsonl", "imported.png", "header.jpg", "encoded.txt", "drawing.svg"),
    *("manifest-of-a-release.json", "frames_set.json", "lines-of-frames.jsonl"),
    *("dense_set.json", "lines-of-dense.jsonl"),
    *DENSE_ANSWERS,
)
BUILDS_A_ROOM = ("rooms.json", "room000.npz")  # 1 s of a processor for each case
OF_WRITERS = {
    "datasets/film/film_video.py write": "encodes a film; it reads nothing",
    "datasets/film/film_video.py write_frames": "the same",
    "datasets/film/film_video.py write_mp4": "the same",
    "datasets/store/layers.py _write": "writes a layer",
    "render/sensor/processing.py jpeg_image": "decodes what the chain has encoded in the line before",
    "calibration/sensor_fit/capture_folder.py _tables_of": "the same, for its tables",
    "calibration/captures/imported_set.py _stored": "copies the bytes of a picture that `read_photo` has read",
    "benchmark/export/export_make.py _finish": "copies files of a data set that is open, byte by byte",
}


@contextmanager
def watched(seen: set[str]) -> Iterator[None]:
    """Names of our functions that are entered meanwhile, as `readers` has them."""
    entered: set[CodeType] = set()

    def enter(frame: FrameType, event: str, _: object) -> None:
        entered.add(frame.f_code)

    before = sys.gettrace()
    sys.settrace(enter)  # a profile function would be called for each function in C as well
    try:
        yield
    finally:
        sys.settrace(before)
    for code in entered:
        path = _resolved(code.co_filename)
        if path.is_relative_to(ROOT):
            seen.add(f"{path.relative_to(ROOT).as_posix()} {code.co_name}")


@cache
def _resolved(name: str) -> Path:
    return Path(name).resolve()


@pytest.fixture(scope="module")
def further(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Kind]:
    return further_kinds(tmp_path_factory.mktemp("further"))


@pytest.fixture(scope="module")
def of_folders(tmp_path_factory: pytest.TempPathFactory, smallest_dataset: Path) -> dict[str, Kind]:
    return folder_kinds(tmp_path_factory.mktemp("folders"), smallest_dataset)


def test_every_reader_has_a_target(
    further: dict[str, Kind],
    of_folders: dict[str, Kind],
    tmp_path: Path,
    smallest_dataset: Path,
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    """Each target reads its valid file; the functions that it enters are those that it fuzzes."""
    seen: set[str] = set()
    reads: list[tuple[Callable[[Path], object], Path]] = []
    every_kind = (*kinds(tmp_path_factory.mktemp("valid")).values(), *further.values(), *of_folders.values())
    for number, kind in enumerate(every_kind):
        path = tmp_path / f"{number}" / "set" / kind.name
        path.parent.mkdir(parents=True)
        path.write_bytes(kind.data)
        reads.append((kind.read, path))
    for name in ("glb", "ply", "obj", "hdr", "exr"):
        (tmp_path / f"of-{name}").mkdir()
        reads.append((as_room if name in ("glb", "ply", "obj") else read_light, written(tmp_path / f"of-{name}", name)))
    reads += [(read_sealed, write_sealed(tmp_path / "sealed")), (read_dataset, smallest_dataset)]
    for read, path in reads:
        with watched(seen):
            assert outcome(read, path) == "read" or path.name == "room.glb", path
    every = set(readers(ROOT))
    assert len(every) > 60
    assert sorted(every - seen - set(OF_WRITERS)) == []
    assert set(OF_WRITERS) <= every


def test_a_new_reader_without_a_target_is_seen(tmp_path: Path) -> None:
    for folder in ("render", "datasets"):
        (tmp_path / folder).mkdir()
    (tmp_path / "datasets" / "a.py").write_text("def read_it(path):\n    return InputFile(path, '').json()\n")
    (tmp_path / "render" / "b.py").write_text(
        "def f(p):\n    return Image.open(p)\n\ndef g(p):\n    return open_it(p)\n"
    )
    assert list(readers(tmp_path)) == ["render/b.py f", "datasets/a.py read_it"]


@pytest.mark.parametrize("name", NAMES)
def test_a_damaged_file_is_read_or_refused(name: str, further: dict[str, Kind], tmp_path: Path) -> None:
    assert set(further) == set(NAMES)
    fuzz_a_file(further[name], tmp_path, FEW, always_read=name in ALWAYS_READ)


@pytest.mark.slow
@pytest.mark.parametrize("name", OF_FOLDERS)
def test_a_folder_with_a_damaged_file_is_taken_or_refused(
    name: str, of_folders: dict[str, Kind], tmp_path: Path
) -> None:
    assert set(of_folders) == set(OF_FOLDERS)
    fuzz_a_file(of_folders[name], tmp_path, FEW, always_read=name in ALWAYS_READ_IN_FOLDERS)


@pytest.mark.study
@pytest.mark.parametrize("name", [*NAMES, *OF_FOLDERS])
def test_hundreds_of_damaged_files_are_read_or_refused(
    name: str, further: dict[str, Kind], of_folders: dict[str, Kind], tmp_path: Path
) -> None:
    always = name in (*ALWAYS_READ, *ALWAYS_READ_IN_FOLDERS)
    cases = MANY // 10 if name in BUILDS_A_ROOM else MANY
    fuzz_a_file({**further, **of_folders}[name], tmp_path, cases, always_read=always)
