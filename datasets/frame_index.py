"""`frames.jsonl`: one line per file of drawn frames, with every number that it depends on and its SHA-256."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal

from phibench.datasets.errors import DatasetError
from phibench.datasets.files import write_text
from phibench.datasets.lines import read_rows
from phibench.datasets.schema import Document, Position

INDEX = "frames.jsonl"
REQUEST = "request.json"
_IMAGES = (".exr", ".jpg", ".png")


class FrameRow(Document):
    """One file.

    `values` says what a number in the file means; `sensor` has the exposure and gain that were used, `request` what was
    asked for. The image's pixel (0, 0) is pixel (u0_px, v0_px) of the sensor. `key` is a hash of all that the file
    depends on, layers and code included.
    """

    file: str
    sha256: str
    kind: Literal["frame", "preview"]
    values: str
    dataset: str
    dataset_seed: int
    sample_id: str
    position: Position
    laser: Literal["on", "off"]
    draw: int
    preset: str
    exposure_s: float
    analogue_gain: float
    u0_px: int
    v0_px: int
    width_px: int
    height_px: int
    sensor: dict[str, Any]
    request: dict[str, Any]
    key: str


def read_index(folder: Path) -> dict[str, FrameRow]:
    """Rows by file name; none where there is no index.

    Raises
    ------
    DatasetError
        With the number of the first line that is not a row.
    """
    path = folder / INDEX
    if not path.exists():
        return {}
    try:
        return {row.file: row for row in read_rows(path, FrameRow)}
    except DatasetError as error:
        raise DatasetError(f"{error}; delete the file and run the command again") from error


def write_index(folder: Path, rows: Iterable[FrameRow]) -> Path:
    """Write all rows, sorted by file name, atomically."""
    ordered = sorted(rows, key=lambda row: row.file)
    lines = (json.dumps(row.model_dump(mode="json"), allow_nan=False) + "\n" for row in ordered)
    return write_text(folder / INDEX, "".join(lines))


def claim(folder: Path, dataset: tuple[str, int], wanted: dict[str, Any]) -> None:
    """Write down what the folder is for, before its first frame; refuse one that has frames of something else.

    Raises
    ------
    DatasetError
        With the names and values that differ, or if the note is damaged.
    """
    path = folder / REQUEST
    meant = {"dataset": dataset[0], "dataset_seed": dataset[1], **wanted}
    if not path.exists() or not _has_frames(folder):
        write_text(path, json.dumps(meant, indent=1, allow_nan=False) + "\n")
        return
    try:
        held = dict(json.loads(path.read_text(encoding="utf-8")))
    except (ValueError, TypeError) as error:
        raise DatasetError(f"{path} is damaged: give another folder, `--out FOLDER`") from error
    if other := [name for name in meant if held.get(name) != meant[name]]:
        texts = ", ".join(f"{name} {held.get(name)}, not {meant[name]}" for name in other)
        raise DatasetError(f"{folder} holds frames with {texts}: give another folder, `--out FOLDER`")


def _has_frames(folder: Path) -> bool:
    """Whether a frame is there, in the index or not."""
    return any(path.suffix in _IMAGES for path in folder.iterdir())
