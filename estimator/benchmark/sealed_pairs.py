"""A sealed set as a set of pairs: frames are read from its folder, and there is no truth."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Sequence
from copy import copy
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image as Picture

from phibench.datasets.errors import DatasetError
from phibench.datasets.frames.sensor_card import SensorCard
from phibench.datasets.store.checksums import read_checksums
from phibench.datasets.store.documents import from_json
from phibench.estimator.benchmark.sealed_set import (
    CHECKSUMS,
    FRAMES,
    PAIRS,
    SEAL,
    PublicBox,
    PublicPair,
    Seal,
    read_pairs,
    read_seal,
)
from phibench.estimator.interface import Box, Image, Pair
from phibench.estimator.pair_set import PairTruth
from phibench.scenes.laser import Beam
from phibench.scenes.rig import Rig


class SealedPairs:
    """Pairs of a sealed set by number; every file is checked against its hash when it is read.

    Parameters
    ----------
    folder : Path

    Raises
    ------
    DatasetError
        If it is no sealed set, incomplete, or changed; in one sentence.
    """

    def __init__(self, folder: Path) -> None:
        self._folder, self._seal, self._listed = folder, read_seal(folder), read_checksums(folder)
        self._truths: tuple[PairTruth, ...] | None = None
        for name in (SEAL, PAIRS):
            self._read(name)
        self._rows = read_pairs(folder)
        if [row.number for row in self._rows] != list(range(self._seal.pairs)):
            raise DatasetError(
                f"{folder / PAIRS} does not hold the pairs 0 to {self._seal.pairs - 1}; download it again"
            )

    def __len__(self) -> int:
        return len(self._rows)

    @property
    def seal(self) -> Seal:
        """What was sealed."""
        return self._seal

    def pair(self, number: int) -> Pair:
        """What a method sees."""
        row = self._row(number)
        images = {name: self._image(file) for name, file in row.files.items()}
        return Pair(
            number,
            images["down"],
            images["up"],
            rig=from_json(Rig, row.rig),
            stroke_m=row.stroke_m,
            card=from_json(SensorCard, row.card),
            down_off=images.get("down_off"),
            up_off=images.get("up_off"),
            box_down=_private_box(row.box_down),
            box_up=_private_box(row.box_up),
            beam=None if row.beam is None else from_json(Beam, row.beam),
        )

    def with_truths(self, truths: Sequence[PairTruth]) -> SealedPairs:
        """The same set with the truths of all its pairs, by number."""
        opened = copy(self)
        opened._truths = tuple(truths)
        return opened

    def truth(self, number: int) -> PairTruth:
        """Exact answer for a pair, once the set is unsealed.

        Raises
        ------
        DatasetError
            If it is sealed: nobody who has only this folder has the truth.
        """
        self._row(number)
        if self._truths is not None:
            return self._truths[number]
        raise DatasetError(
            f"{self._folder} is sealed, the truth of pair {number} is not in it; send a submission to who sealed it"
        )

    def document(self) -> dict[str, Any]:
        """Provenance of the set."""
        return {"sealed": True, **self._seal.model_dump(mode="json")}

    def check(self) -> None:
        """Read every file once.

        Raises
        ------
        DatasetError
            If a file is missing, changed, or not of the set.
        """
        for name in self._listed:
            self._read(name)
        found = (path.relative_to(self._folder).as_posix() for path in (self._folder / FRAMES).rglob("*"))
        if strays := sorted(set(found) - set(self._listed)):
            raise DatasetError(f"{self._folder / strays[0]} is not of the sealed set; remove it")

    def _row(self, number: int) -> PublicPair:
        if not 0 <= number < len(self._rows):
            raise DatasetError(f"pair {number}: there are {len(self._rows)}, numbered from 0; ask for one of them")
        return self._rows[number]

    def _read(self, name: str) -> bytes:
        """Bytes of a file of the set."""
        if name not in self._listed:
            raise DatasetError(f"{self._folder / name} is not listed in {CHECKSUMS}; download the set again")
        try:
            data = (self._folder / name).read_bytes()
        except OSError as error:
            text = f"{self._folder / name} is not readable: {error.strerror or error}"
            raise DatasetError(f"{text}; download the set again") from error
        if hashlib.sha256(data).hexdigest() != self._listed[name]:
            raise DatasetError(
                f"{self._folder / name} was changed, its SHA-256 is not the listed one; download it again"
            )
        return data

    def _image(self, name: str) -> Image:
        """Image of a file, read-only: 16 bits with one channel, or 8 bits R, G, B."""
        data = self._read(name)
        with Picture.open(io.BytesIO(data), formats=("PNG", "JPEG")) as picture:
            image = np.array(picture)
        result = image.astype(np.uint16) if image.ndim == 2 else image
        result.flags.writeable = False
        return result


def _private_box(box: PublicBox | None) -> Box | None:
    return None if box is None else Box(box.u0_px, box.v0_px, box.width_px, box.height_px)
