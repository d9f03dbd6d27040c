"""Files of strangers that took minutes, gigabytes or a traceback: pictures, meshes, folders of pairs, exports."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import resource
import shutil
import struct
import subprocess
import sys
import time
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers.valid_files import png

from phibench.benchmark.export.export_make import verify_export
from phibench.calibration.captures.imported_set import import_pairs
from phibench.calibration.captures.pair_list import read_pair_list
from phibench.calibration.sensor_fit.capture_folder import read_header
from phibench.datasets.common.camera_pictures import read_camera_picture
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import InputFile
from phibench.datasets.rooms import mesh_polygons
from phibench.datasets.rooms.mesh_placement import read_mesh
from phibench.datasets.rooms.panorama_files import read_light
from phibench.datasets.rooms.room_files import RoomFiles, checked_data

SOON_S = 10.0  # of a processor: the machine may have other work


def refusal(read: Callable[[], object]) -> str:
    """The sentence that refuses a file, soon."""
    start = time.process_time()
    with pytest.raises(DatasetError) as caught:
        read()
    assert time.process_time() - start < SOON_S
    assert str(caught.value).isprintable()
    return str(caught.value)


# -- pictures --------------------------------------------------------------------------------------------------------


def hdr(head: str) -> bytes:
    return f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n{head}\n\n-Y 2 +X 2\n".encode() + bytes((10, 20, 30, 137)) * 4


@pytest.mark.parametrize("text", [".", "", "0", "-1", "1e", "1e999", "1 2", "nan", "\x1b[31m", "1e-200"])
def test_an_exposure_that_is_no_number_above_zero(text: str, tmp_path: Path) -> None:
    (tmp_path / "a.hdr").write_bytes(hdr(f"EXPOSURE={text}"))
    assert "EXPOSURE=" in refusal(lambda: read_light(tmp_path / "a.hdr"))


@pytest.mark.parametrize(
    ("head", "exposure"), [("A=B", 1.0), ("EXPOSURE=2", 2.0), ("EXPOSURE= .5e1 \nEXPOSURE=1.", 5.0)]
)
def test_exposures_are_multiplied(head: str, exposure: float, tmp_path: Path) -> None:
    """A pixel is mantissa x 2^(exponent - 136), over the product of all exposures."""
    (tmp_path / "a.hdr").write_bytes(hdr(head))
    assert read_light(tmp_path / "a.hdr")[1, 1].tolist() == pytest.approx([20 / exposure, 40 / exposure, 60 / exposure])


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


EXIF = {
    "no hexadecimal": chunk(b"tEXt", b"Raw profile type exif\0\nexif\n      20\nxyz not hex\n"),
    "no lines": chunk(b"tEXt", b"Raw profile type exif\0"),
    "no TIFF": chunk(b"eXIf", b"\xff" * 40),
    "cut": chunk(b"eXIf", b"MM\0*\0\0\0\x08\xff\xff"),
    "circle": chunk(b"eXIf", b"MM\0*\0\0\0\x08\0\x01\x87\x69\0\x04\0\0\0\x01\0\0\0\x08\0\0\0\x08"),
    "type": chunk(b"eXIf", b"MM\0*\0\0\0\x08\0\x01\x01\x12\xff\xff\xff\xff\xff\xff\0\0\0\0"),
}


@pytest.mark.parametrize("name", EXIF)
def test_a_png_with_broken_exif_is_read_or_refused(name: str, tmp_path: Path) -> None:
    data = png()
    file = InputFile(tmp_path / "a.png", "give a picture")
    file.path.write_bytes(data[:33] + EXIF[name] + data[33:])
    if name == "no hexadecimal":
        message = refusal(lambda: read_camera_picture(file))
        assert "has damaged EXIF data; `exiftool -all= FILE` removes them" in message
        return
    with contextlib.suppress(DatasetError):
        assert read_camera_picture(file).pixels.ndim == 3


def test_a_jpeg_whose_planes_have_no_size_or_table() -> None:
    """Its header says sampling factors 0, and a quantisation table that is not there."""
    import io

    from PIL import Image

    buffer = io.BytesIO()
    Image.new("RGB", (16, 16)).save(buffer, "JPEG")
    data = buffer.getvalue()
    frame = data.index(b"\xff\xc0")
    for place, value in ((frame + 14, 0x00), (frame + 15, 0x03), (frame + 11, 0x00)):
        changed = bytearray(data)
        changed[place] = value
        assert "a.jpg" in refusal(lambda changed=changed: read_header(bytes(changed), "a.jpg"))


# -- meshes ----------------------------------------------------------------------------------------------------------

SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"


def test_an_obj_of_a_hundred_thousand_materials(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text(SQUARE + "".join(f"usemtl m{k}\nf 1 2 3\n" for k in range(100_000)))
    assert "more than 5000 parts" in refusal(lambda: read_mesh(tmp_path / "a.obj"))


def test_many_parts_do_not_carry_all_vertices_each(tmp_path: Path) -> None:
    """2000 parts of a file with 20 000 vertices: 40 million vertices, were all of them carried."""
    lines = [f"v {k} 0 0\nv {k} 1 0\nv {k} 0 1\n" for k in range(7000)]
    lines += [f"usemtl m{k}\nf {3 * k + 1} {3 * k + 2} {3 * k + 3}\n" for k in range(2000)]
    (tmp_path / "a.obj").write_text("".join(lines))
    parts = read_mesh(tmp_path / "a.obj")
    assert len(parts) == 2000
    assert sum(len(part.vertices) for part in parts) == 6000
    part = next(part for part in parts if part.name == "m1999")
    assert part.vertices[part.triangles[0]].tolist() == [[1999, 0, 0], [1999, 1, 0], [1999, 0, 1]]


@pytest.mark.parametrize("part", [20, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.parametrize("form", ["obj", "ply"])
def test_polygons_of_ten_thousand_corners(
    form: str, part: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A comb: each tooth is looked at against all others. Time goes with the corners that may be looked at."""
    monkeypatch.setattr(mesh_polygons, "MOST_CUTTING", mesh_polygons.MOST_CUTTING // part)
    count = 10_000
    points = [(k, 0.0 if k % 2 else 1.0 + k % 7, 0.0) for k in range(count - 1)] + [(0.5 * count, -5.0, 0.0)]
    if form == "obj":
        face = "f " + " ".join(str(k + 1) for k in range(count)) + "\n"
        text = "".join(f"v {x} {y} {z}\n" for x, y, z in points) + face * 60
    else:
        face = f"{count} " + " ".join(map(str, range(count))) + "\n"
        text = f"ply\nformat ascii 1.0\nelement vertex {count}\nproperty float x\nproperty float y\nproperty float z\n"
        text += "element face 60\nproperty list int int vertex_indices\nend_header\n"
        text += "".join(f"{x} {y} {z}\n" for x, y, z in points) + face * 60
    (tmp_path / f"a.{form}").write_text(text)
    assert "too many corners" in refusal(lambda: read_mesh(tmp_path / f"a.{form}"))


def test_an_obj_of_lines_without_end(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_bytes(b"\n" * 30_000_000)
    assert "lines" in refusal(lambda: read_mesh(tmp_path / "a.obj"))


def test_a_gltf_of_entries_without_bytes(tmp_path: Path) -> None:
    """50 primitives of 3 million places that no buffer holds."""
    count = 3_000_000
    document = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}] * 50}],
        "accessors": [
            {"count": count, "type": "VEC3", "componentType": 5126},
            {"count": 3, "type": "SCALAR", "componentType": 5125},
        ],
    }
    (tmp_path / "a.gltf").write_text(json.dumps(document))
    assert "entries together" in refusal(lambda: read_mesh(tmp_path / "a.gltf"))


@pytest.mark.slow
def test_a_gltf_of_thousands_of_parts(tmp_path: Path) -> None:
    document = {
        "asset": {"version": "2.0"},
        "nodes": [{"mesh": 0}] * 100_000,
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{"count": 3, "type": "VEC3", "componentType": 5126}],
    }
    (tmp_path / "a.gltf").write_text(json.dumps(document))
    assert "more than 5000 parts" in refusal(lambda: read_mesh(tmp_path / "a.gltf"))


PLY = {
    "elements": "".join(f"element e{k} 3000000\n" for k in range(1000)),
    "property twice": "element vertex 1\nproperty float x\nproperty float x\n",
    "element twice": "element vertex 1\nproperty float x\nelement vertex 1\nproperty float x\n",
}


@pytest.mark.parametrize("name", PLY)
def test_a_ply_whose_header_promises_too_much(name: str, tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_text(f"ply\nformat binary_little_endian 1.0\n{PLY[name]}end_header\n" + "0" * 100)
    words = {"elements": "more than 6000000 entries"}.get(name, f"{name.split()[0]} twice")
    assert words in refusal(lambda: read_mesh(tmp_path / "a.ply"))


# -- folders ---------------------------------------------------------------------------------------------------------


def test_a_column_twice(tmp_path: Path) -> None:
    """Readers that take the first and the last would see two strokes."""
    (tmp_path / "pairs.csv").write_text("name,down,up,stroke_m,stroke_m\na,x.png,y.png,0.1,0.9\n")
    assert "has the column 'stroke_m' twice" in refusal(lambda: read_pair_list(tmp_path))


@pytest.mark.slow
def test_a_list_of_a_hundred_thousand_names_one_twice(tmp_path: Path) -> None:
    rows = "".join(f"n{k},x.png,y.png,0.1\n" for k in range(99_998))
    (tmp_path / "pairs.csv").write_text(f"name,down,up,stroke_m\n{rows}n99997,x.png,y.png,0.1\n")
    assert "has the name n99997 twice" in refusal(lambda: read_pair_list(tmp_path))


@pytest.mark.parametrize("link", ["file", "folder"])
def test_links_out_of_a_folder_that_becomes_a_data_set(link: str, tmp_path: Path) -> None:
    """What they lead to would become part of a data set that is given away."""
    folder, outside = tmp_path / "pairs", tmp_path / "private"
    for path in (folder, outside):
        path.mkdir()
        (path / "up.png").write_bytes(png())
    (outside / "down.png").write_bytes(png())
    (folder / "rig.toml").write_text("[rig]\nfx_px = 1430.0\n")
    name = "down.png" if link == "file" else "inside/down.png"
    (folder / name.split("/")[0]).symlink_to(outside / "down.png" if link == "file" else outside)
    (folder / "pairs.csv").write_text(f"name,down,up,stroke_m\na,{name},up.png,0.3\n")
    assert "leads out of" in refusal(lambda: import_pairs(folder, tmp_path / "out"))
    assert not (tmp_path / "out").exists()
    with pytest.raises(DatasetError, match="leads out of"):
        checked_data(folder, name, "0" * 64)
    with pytest.raises(DatasetError, match="leads out of"):
        RoomFiles(folder).sha256(name)


def test_links_within_a_folder_are_followed(tmp_path: Path) -> None:
    (tmp_path / "room.glb").write_bytes(b"a room")
    (tmp_path / "latest.glb").symlink_to("room.glb")
    assert RoomFiles(tmp_path).sha256("latest.glb") == RoomFiles(tmp_path).sha256("room.glb")


def test_pipes_in_an_export_are_faults(tmp_path: Path) -> None:
    (tmp_path / "export.json").write_text("{}")
    listed = {"export.json": hashlib.sha256(b"{}").hexdigest(), "pairs.parquet": "0" * 64}
    (tmp_path / "SHA256SUMS").write_text("".join(f"{digest}  {name}\n" for name, digest in listed.items()))
    os.mkfifo(tmp_path / "pairs.parquet")
    os.mkfifo(tmp_path / "more")
    (tmp_path / "nowhere").symlink_to("gone")
    faults = verify_export(tmp_path)
    assert len(faults) == 3
    assert "pairs.parquet is not readable: it is a FIFO" in faults[0]
    assert faults[1:] == ["more is not of the export", "nowhere is not of the export"]


# -- little memory ---------------------------------------------------------------------------------------------------

LITTLE = 400 << 20


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="the address space is bounded on Linux")
@pytest.mark.parametrize(
    "tokens",
    [
        ("dataset", "verify", "{}"),
        ("dataset", "show", "{}", "--out", "a.png"),
        ("align", "a.png"),
        ("score", "{}", "--method", "red_centroid", "--out", "a.json"),
    ],
    ids=lambda tokens: tokens[0] + tokens[1][:5],
)
def test_an_address_space_of_400_mb_ends_in_a_sentence(
    tokens: tuple[str, ...], smallest_dataset: Path, tmp_path: Path
) -> None:
    """Libraries that are loaded late fail in words of their own, or end the process: neither is an answer."""
    shutil.copy(Path(__file__).parents[1] / "smallest.toml", tmp_path)
    from PIL import Image

    Image.fromarray(np.zeros((720, 1280, 3), np.uint8)).save(tmp_path / "a.png")
    words = [str(smallest_dataset) if word == "{}" else word for word in tokens]
    done = subprocess.run(
        [sys.executable, "-m", "phibench", *words],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=300,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (LITTLE, LITTLE)),
    )
    assert done.returncode in (0, 1, 2), done.stderr[-2000:]
    assert "Traceback" not in done.stderr
    if done.returncode == 2:
        assert "memory" in done.stderr
