"""What is where in a sealed set, and the documents in it.

seal.json       what was sealed, and the SHA-256 that the truth must have
pairs.jsonl     per pair what a user knows: rig, stroke, sensor, boxes, files
frames/         images: PNG of 8 or 16 bits, or the camera's JPEG
SHA256SUMS      of everything above
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from phibench.datasets.errors import DatasetError
from phibench.datasets.lines import read_rows
from phibench.datasets.schema import Document
from phibench.datasets.sums import read_sums, sums_text

SEAL, PAIRS, FRAMES, SUMS = "seal.json", "pairs.jsonl", "frames", "SHA256SUMS"
FORMAT = "phibench sealed set 1"


class Seal(Document):
    """`seal.json`.

    `public_sha256` is the hash of the list of hashes of `pairs.jsonl` and of the frames, `truth_sha256` that of the
    truth's file, which holds a random number of 256 bits, so that nobody can try out truths against it. The id follows
    from both.
    """

    format: str
    id: str
    task_version: int
    pairs: int
    public_sha256: str
    truth_sha256: str
    phibench: str | None


class PublicBox(Document):
    """A region hint, as `estimator.seat.pair.Box`."""

    u0_px: int
    v0_px: int
    width_px: int
    height_px: int


class PublicPair(Document):
    """One line of `pairs.jsonl`; `files` by image name: "down", "up", and "down_off", "up_off" where they are."""

    number: int
    files: dict[str, str]
    stroke_m: float
    rig: dict[str, Any]
    card: dict[str, Any]
    box_down: PublicBox | None
    box_up: PublicBox | None
    beam: dict[str, Any] | None = None


def seal_id(public_sha256: str, truth_sha256: str) -> str:
    """Id of a seal."""
    return hashlib.sha256(f"{public_sha256}\n{truth_sha256}\n".encode()).hexdigest()[:16]


def public_sha256(hashes: Mapping[str, str]) -> str:
    """Hash of what a method may see: pairs and frames, by relative name."""
    content = {name: digest for name, digest in hashes.items() if name == PAIRS or name.startswith(f"{FRAMES}/")}
    return hashlib.sha256(sums_text(content).encode()).hexdigest()


def read_seal(folder: Path) -> Seal:
    """Read `seal.json` and check that it fits the folder's list of hashes.

    Raises
    ------
    DatasetError
        In one sentence: no sealed set, damaged, or changed.
    """
    path = folder / SEAL
    if not path.is_file():
        raise DatasetError(f"{folder} is no sealed set: it has no {SEAL}; give what `phibench dataset seal` wrote")
    if not (folder / SUMS).is_file():
        raise DatasetError(f"{folder / SUMS} is missing; download the set again")
    try:
        seal = Seal.model_validate(json.loads(path.read_text(encoding="utf-8")))
    except (ValidationError, ValueError) as error:
        raise DatasetError(f"{path} is damaged: it is not a seal; download the set again") from error
    listed = public_sha256(read_sums(folder))
    if seal.format != FORMAT or listed != seal.public_sha256 or seal.id != seal_id(listed, seal.truth_sha256):
        raise DatasetError(
            f"{folder}: {SEAL} and {SUMS} do not belong together, one was changed; download the set again"
        )
    return seal


def read_pairs(folder: Path) -> list[PublicPair]:
    """Lines of `pairs.jsonl`, by number."""
    return read_rows(folder / PAIRS, PublicPair)
