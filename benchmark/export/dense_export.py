"""Export of dense pairs for other tools: pictures, truth as 32-bit OpenEXR planes, and an index by which a run resumes.

Each pair has three files, NAME-down, NAME-up and NAME-truth.exr, and a line in `dense.jsonl`. Planes have the shape
(H, W), float32, NaN where there is nothing. A pair that is there and whole is kept. phibench reads `dense_set`.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from phibench.benchmark.dense.dense_pairs import DensePairs, DenseTruth
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import InputFile
from phibench.datasets.exposures.draw_frames import require_outside
from phibench.datasets.frames.frame_files import suffix, write_frame
from phibench.datasets.store.checksums import filling, with_checksums, write_documents
from phibench.datasets.store.files import sha256
from phibench.datasets.store.layers import write_exr
from phibench.datasets.store.schema import TruthFolder
from phibench.scenes.frames import Array

INDEX = TruthFolder.DENSE_EXPORT.value
PLANES = ("depth_m", "up_u_px", "up_v_px", "cause", "x_m", "y_m", "z_m")
"""D; place of the same room point in the up image; code of the cause, as `cause_names` of the index says; the point."""
_KIND = "dense truth"


def export_dense(pairs: DensePairs, out: str | Path, told: Callable[[int], None] = lambda done: None) -> Path:
    """Write dense pairs with their truth.

    Parameters
    ----------
    pairs : DensePairs
        Each of one frame of an image.
    out : folder, outside the data set
    told : callable
        Given the number of pairs that are written.

    Raises
    ------
    DatasetError
        If the folder holds something else or a pair cannot be read; in one sentence.
    """
    target = Path(out)
    require_outside(target, pairs.dataset.folder)
    with filling(target, lambda: _check_folder(target)):
        names = [f"{draw.sample_id}-{draw.preset}-{draw.draw:04d}" for draw in pairs.pair_draws]
        whole = {
            name: line
            for name, line in read_dense_index(target).items()
            if name in names and _is_of(pairs, target, line)
        }
        for number, name in enumerate(names):
            if name not in whole:
                whole[name] = _written(pairs, number, target, name)
                _write_index(target, [whole[each] for each in names if each in whole])
            told(number + 1)
        _write_index(target, [whole[name] for name in names])
    return target


def _written(pairs: DensePairs, number: int, out: Path, name: str) -> dict[str, Any]:
    truth = pairs.truth(number)
    frames = pairs.frames(number)
    files = []
    for position, frame in frames.items():
        path = out / f"{name}-{position}{suffix(frame.sensor, True)}"
        files.append(write_frame(path, frame, pairs.dataset[truth.sample_id].stream_names))
    header = {"kind": _KIND, "sample_id": truth.sample_id, "preset": truth.preset, "draw": truth.draw}
    files.append(write_exr(out / f"{name}-truth.exr", truth_planes(truth), header))
    codes = np.unique(truth.found.cause).tolist()
    sensor = next(iter(frames.values())).sensor
    return {
        "name": name,
        "sample_id": truth.sample_id,
        "preset": truth.preset,
        "draw": truth.draw,
        "pair_set": pairs.document()["dataset_sha256"],
        "room": truth.room,
        "stroke_m": truth.stroke_m,
        "given_stroke_m": truth.given_stroke_m,
        "rig": pairs.dataset[truth.sample_id].row.rig,
        "given_rig": pairs.dataset[truth.sample_id].row.nominal_rig,
        "sensor": sensor.model_dump(mode="json"),
        "cause_names": {code: truth.found.cause_name(code) for code in codes},
        "files": {path.name: sha256(path) for path in files},
    }


def truth_planes(truth: DenseTruth) -> dict[str, Array]:
    """Planes of a truth by `PLANES`, shape (H, W)."""
    found = truth.found
    parts = (found.depth_m, *np.moveaxis(found.uv_px, -1, 0), found.cause, *np.moveaxis(found.point_world_m, -1, 0))
    return {name: np.asarray(part, float) for name, part in zip(PLANES, parts, strict=True)}


def _text(lines: list[dict[str, Any]]) -> bytes:
    return "".join(json.dumps(line, allow_nan=False) + "\n" for line in lines).encode()


def read_dense_index(out: Path) -> dict[str, dict[str, Any]]:
    """Lines of an index that is there, by name; none of a line that cannot be read."""
    path, lines = out / INDEX, {}
    if path.is_file():
        for text in InputFile(path, "export again").read().decode(errors="replace").splitlines():
            try:
                line = json.loads(text)
                lines[str(line["name"])] = {**line, "files": dict(line["files"]), "pair_set": line["pair_set"]}
            except (ValueError, KeyError, TypeError):  # cut off by a kill: written again
                continue
    return lines


def _write_index(out: Path, lines: list[dict[str, Any]]) -> None:
    hashes = {file: hashed for line in lines for file, hashed in line["files"].items()}
    write_documents(out, with_checksums({INDEX: _text(lines)}, hashes))


def _is_of(pairs: DensePairs, out: Path, line: dict[str, Any]) -> bool:
    """Tell whether a line's files are there as it says, and of this state of the data set."""
    files = line["files"].items()
    same = line["pair_set"] == pairs.document()["dataset_sha256"]
    return same and bool(files) and all(Path(name).name == name and _hash(out / name) == h for name, h in files)


def _hash(path: Path) -> str:
    return sha256(path) if path.is_file() else ""


def _check_folder(out: Path) -> None:
    held = [path for path in out.iterdir() if not path.name.startswith(".")] if out.is_dir() else []
    if held and not (out / INDEX).is_file():
        raise DatasetError(f"{out} holds something else: give a new folder, or one of `phibench dense export`")
