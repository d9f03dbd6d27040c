"""Readers of files, by walking the modules, and the fuzz target of each: what it reads and a valid file of it.

Not a test file. `valid_files.kinds` has the targets of data sets, scores, sealed sets and studies; here are those of
films, releases, sensors, folders of pairs and rigs.
"""

from __future__ import annotations

import ast
import io
import json
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
from helpers.districts import DISTRICTS, statements, tree
from helpers.strange_releases import TITLE, tiny_release
from helpers.valid_files import ROOT, TEXT, Kind, compact, digest, png
from PIL import Image

from phibench.benchmark.dense.dense_records import COLUMN_TYPES
from phibench.benchmark.dense.dense_score import records_so_far
from phibench.benchmark.export.dense_export import read_dense_index
from phibench.benchmark.isolation.method_references import resolve
from phibench.benchmark.isolation.run_limits import MethodError
from phibench.benchmark.release import fetch
from phibench.benchmark.release.release_parts import read_manifest_file
from phibench.benchmark.sealed.sealed_set import secret_seed
from phibench.calibration.captures.pair_list import read_pair_list
from phibench.calibration.captures.picture_files import read_photo
from phibench.calibration.captures.rig_file import read_rig_file
from phibench.calibration.sensor_fit.capture_folder import CaptureNotes, read_frame, read_notes
from phibench.calibration.sensor_fit.emva_descriptor import open_descriptor
from phibench.datasets.build.bake_task import cache_limit_mb
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.film.film_store import FilmInfo, read_document, read_spots, read_table, write_spots
from phibench.datasets.film.film_video import read_frames, write_frames
from phibench.datasets.frames.frame_request import jpeg_tables
from phibench.datasets.frames.sensor_file import SensorFile, read_sensor_file
from phibench.datasets.rooms.panorama_files import is_linear
from phibench.datasets.rooms.room_files import RoomFiles
from phibench.datasets.store.checksums import read_checksums
from phibench.datasets.store.parquet_tables import parquet_bytes
from phibench.estimator.learned.network_graphs import CROP
from phibench.estimator.learned.networks import Network
from phibench.render.film.moving_rows import RowsImage
from phibench.scenes.rig import Rig

FOLDERS = (*DISTRICTS, "phibench")
_DECODERS = {("OpenEXR", "File"), ("av", "open"), ("Image", "open"), ("polars", "read_parquet"), ("pl", "read_parquet")}


def readers(root: Path) -> Iterator[str]:
    """Functions that make an `InputFile` or call a decoder themselves, as "folder/module.py function"."""
    for folder in FOLDERS:
        for path in sorted((root / folder).rglob("*.py")):
            words = set(re.findall(r"\w+", path.read_text(encoding="utf-8")))
            if not any(words.issuperset(called) for called in ({"InputFile"}, *_DECODERS)):
                continue  # no call below can be in it: most files are neither parsed nor walked
            for node in statements(tree(path)):
                if isinstance(node, ast.FunctionDef) and any(map(_reads, ast.walk(node))):
                    yield f"{path.relative_to(root).as_posix()} {node.name}"


def _reads(node: ast.AST) -> bool:
    if not isinstance(node, ast.Call):
        return False
    called = node.func
    if isinstance(called, ast.Name):
        return called.id == "InputFile"
    return (
        isinstance(called, ast.Attribute)
        and isinstance(called.value, ast.Name)
        and (called.value.id, called.attr) in _DECODERS
    )


def jpeg() -> bytes:
    buffer = io.BytesIO()
    Image.new("RGB", (64, 48)).save(buffer, "JPEG")
    return buffer.getvalue()


def _made(folder: Path, name: str, write: Callable[[Path], object]) -> bytes:
    write(folder / name)
    return (folder / name).read_bytes()


def _film_info() -> bytes:
    document = {"film": "a", "key": TEXT, "frames": 2, "u0_px": 0, "v0_px": 0, "width_px": 4, "height_px": 4}
    document |= {"window_px": None, "keys_m": [0.0], "key_counts": [1], "pixel_ratio": 0.1, "position_ratio": None}
    return compact({**document, "sha256": {"film.parquet": TEXT}})


def _spots(path: Path) -> Path:
    stack = np.ones((3, 2, 4))
    write_spots(path, [RowsImage(1, 2, stack, stack, stack)] * 2)
    return path


def _table() -> bytes:
    buffer = io.BytesIO()
    pl.DataFrame({"row_light_u_px": [0.0, 1.0]}).write_parquet(buffer)
    return buffer.getvalue()


def _small_rig() -> Rig:
    rig = Rig()
    return replace(rig, camera=replace(rig.camera, width_px=64, height_px=48, cx_px=31.5, cy_px=23.5))


_DENSE = b'{"name": "a", "pair_set": "b", "files": {"a-up.png": "c"}}\n'
DESCRIPTOR = """n 8 64 48
d 1000000
i a.png
i a.png
b 1000000 100.0
i a.png
i a.png
"""


def _fetched(path: Path) -> object:
    """A fetch that goes on with the state at the path."""
    release = tiny_release(path.parent.parent / "release")
    part = read_manifest_file(release / "MANIFEST.json", "ask").parts[TITLE]
    fetch._claim(path.parent, TITLE, part)
    done = fetch.Source.of(str(release), 1)
    from phibench.datasets.common.progress import progress_console

    return fetch._archives(done, path.parent, TITLE, part, progress_console())


def _seed(path: Path) -> object:
    path.chmod(0o600)
    return secret_seed(path)


def _method(path: Path) -> object:
    try:
        return resolve(f"{path}:extract")
    except MethodError as error:  # a sentence of its own kind
        raise DatasetError(str(error)) from error


def _network() -> bytes:
    return (ROOT / "estimator" / "learned" / "learned_crop.onnx").read_bytes()


def _dense_records() -> bytes:
    row = pl.DataFrame({name: [None] for name in COLUMN_TYPES}, schema=COLUMN_TYPES)
    return parquet_bytes(row.with_columns(run=pl.lit("a")))


def further_kinds(folder: Path) -> dict[str, Kind]:
    """Targets by the name of their file; `folder` is empty and for the first writing."""
    release = tiny_release(folder / "release")
    manifest = json.loads((release / "MANIFEST.json").read_text())
    sums = manifest["parts"][TITLE]["sums_sha256"]
    state = compact({"title": TITLE, "sums_sha256": sums, "unpacked": []})
    sensor = 'preset = "mjpeg"\nread_noise_e = 4.0\n\n[sigma]\nread_noise_e = 0.1\n'
    pairs = "name,down,up,stroke_m,depth_m,depth_sigma_m\na,x.png,y.png,0.3,2.0,0.01\nb,x.png;z.png,y.png,0.3,,\n"
    every = [
        Kind("done.json", _film_info(), lambda path: read_document(path, FilmInfo), compact),
        Kind("spots.npz", _made(folder, "spots.npz", _spots), lambda path: read_spots(path, 2)),
        Kind("film.parquet", _table(), lambda path: read_table(path, 2)),
        Kind(
            "film.avi",
            _made(folder, "film.avi", lambda path: write_frames(path, [jpeg()] * 2, "mjpeg", (64, 48), 10.0)),
            lambda path: list(read_frames(path)),
        ),
        Kind("MANIFEST.json", compact(manifest), lambda path: read_manifest_file(path, "ask who gave it"), compact),
        Kind("set.part/fetch.json", state, _fetched, compact),
        Kind("seed.txt", f"{2**128 + 7}\n".encode(), _seed),
        Kind("SHA256SUMS", f"{TEXT}  a.png\n{TEXT}  b/c.exr\n".encode(), lambda path: read_checksums(path.parent)),
        Kind("sensor.toml", sensor.encode(), read_sensor_file),
        Kind("tables.jpg", jpeg(), jpeg_tables),
        Kind("limit.txt", b"1000.0\n", lambda path: cache_limit_mb(path.parent)),
        Kind("pairs.csv", pairs.encode(), lambda path: read_pair_list(path.parent)),
        Kind("rig.toml", b"[rig]\nfx_px = 1430.0\nz_c_m = 0.26\n", read_rig_file),
        Kind("photo.raw", bytes(2 * 64 * 48), lambda path: read_photo(path, _small_rig(), SensorFile("mjpeg", {}))),
        Kind("capture.toml", b'camera = "mine"\nbits = 10\n\n[controls]\ngain = 1\n', read_notes),
        Kind("frame.png", png(), lambda path: read_frame(path, CaptureNotes())),
        Kind("descriptor.txt", DESCRIPTOR.encode(), open_descriptor),
        Kind("method.py", b"def extract(pair):\n    return None\n", _method),
        Kind("dense.jsonl", _DENSE, lambda path: read_dense_index(path.parent)),
        Kind("dense.so-far.parquet", _dense_records(), lambda path: records_so_far(path, "a")),
        Kind("network.onnx", _network(), lambda path: Network(path, CROP)),
        Kind("linear.hdr", b"#?RADIANCE\n", is_linear),
        Kind("room.glb", b"glTF", lambda path: RoomFiles(path.parent).sha256(path.name)),
    ]
    return {kind.name: kind for kind in every}


ALWAYS_READ = ("linear.hdr", "room.glb", "limit.txt", "dense.jsonl", "dense.so-far.parquet")
"""Of any content there is an answer: bytes are hashed or looked at, no limit is the usual one, no records are none."""

SIGNED = {"network.onnx": lambda data: data[:-64] + digest(data[:-64]).encode()}
