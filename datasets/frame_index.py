"""`frames.jsonl`: one line per file of drawn frames, with every number that it depends on and its SHA-256."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal

from pydantic import ValidationError

from phibench.datasets.errors import DatasetError
from phibench.datasets.files import write_text
from phibench.datasets.schema import Document, Position

INDEX = "frames.jsonl"
REQUEST = "request.json"


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
    rows = {}
    for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), 1):
        try:
            row = FrameRow.model_validate_json(line)
        except ValidationError as error:
            raise DatasetError(f"{path} line {number} is damaged: delete the file and run the command again") from error
        rows[row.file] = row
    return rows


def write_index(folder: Path, rows: Iterable[FrameRow]) -> Path:
    """Write all rows, sorted by file name, atomically."""
    ordered = sorted(rows, key=lambda row: row.file)
    lines = (json.dumps(row.model_dump(mode="json"), allow_nan=False) + "\n" for row in ordered)
    return write_text(folder / INDEX, "".join(lines))


def claim(folder: Path, dataset: tuple[str, int], wanted: dict[str, Any]) -> None:
    """Write down what the folder is for, before its first frame; refuse one that is for something else.

    Raises
    ------
    DatasetError
        With the names and values that differ, or if the note is damaged.
    """
    path = folder / REQUEST
    meant = {"dataset": dataset[0], "dataset_seed": dataset[1], **wanted}
    if not path.exists():
        write_text(path, json.dumps(meant, indent=1, allow_nan=False) + "\n")
        return
    try:
        held = dict(json.loads(path.read_text(encoding="utf-8")))
    except (ValueError, TypeError) as error:
        raise DatasetError(f"{path} is damaged: give another folder, `--out FOLDER`") from error
    if other := [name for name in meant if held.get(name) != meant[name]]:
        texts = ", ".join(f"{name} {held.get(name)}, not {meant[name]}" for name in other)
        raise DatasetError(f"{folder} holds frames with {texts}: give another folder, `--out FOLDER`")
