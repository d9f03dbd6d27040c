"""Photographs of a pair, laser on and off, and the pairs to be measured that are made of them.

Frames of DN are added up, which is one frame of a sensor with as much more of everything (`_summed`), so that nothing
is lost. Of processed pictures each is a pair of its own.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from phibench.datasets.errors import DatasetError
from phibench.datasets.frames.sensor_card import SensorCard
from phibench.estimator.captures.picture_files import Photo, require_one_camera
from phibench.estimator.captures.rig_file import MeasuredRig
from phibench.estimator.interface import Image, Pair
from phibench.scenes.rig import POSITIONS

_MOST_SUMMED = 64  # frames of 10 bits whose sum is below 2^16


@dataclass(frozen=True)
class PositionPhotos:
    """Pictures of one stroke position: laser on, and laser off where there are any."""

    on: tuple[Photo, ...]
    off: tuple[Photo, ...] = ()


@dataclass(frozen=True)
class PairPhotos:
    """Pictures of both positions.

    Raises
    ------
    DatasetError
        If the counts do not go together, or the pictures are of different cameras.
    """

    down: PositionPhotos
    up: PositionPhotos

    def __post_init__(self) -> None:
        counts = {p: (len(getattr(self, p).on), len(getattr(self, p).off)) for p in POSITIONS}
        if counts["down"] != counts["up"] or not counts["down"][0]:
            (a, b), (c, d) = counts["down"], counts["up"]
            raise DatasetError(
                f"{a} pictures down ({b} with the laser off) and {c} up ({d} off): give as many of both positions"
            )
        if counts["down"][1] > counts["down"][0]:
            raise DatasetError("more pictures with the laser off than on: give at most as many")
        require_one_camera(self.all)

    @property
    def all(self) -> tuple[Photo, ...]:
        """All pictures, those with the laser on first."""
        return (*self.down.on, *self.up.on, *self.down.off, *self.up.off)


def pairs_of_photos(photos: PairPhotos, stroke_m: float, known: MeasuredRig, card: SensorCard) -> list[Pair]:
    """Pairs to be measured one by one: one of sums of frames of DN, else one for each frame."""
    count, offs = len(photos.down.on), len(photos.down.off)
    if card.output == "raw" and count > 1 and offs in (0, count):
        groups = [(*photos.down.on,), (*photos.up.on,), (*photos.down.off,), (*photos.up.off,)]
        sums = [_summed([photo.pixels for photo in group]) if group else None for group in groups]
        return [_pair(0, sums, stroke_m, known, _of_sum(card, count))]
    found = []
    for k in range(count):
        on = [photos.down.on[k].pixels, photos.up.on[k].pixels]
        off = [photos.down.off[k % offs].pixels, photos.up.off[k % offs].pixels] if offs else [None, None]
        found.append(_pair(k, [*on, *off], stroke_m, known, card))
    return found


def _pair(number: int, images: Sequence[Image | None], stroke_m: float, known: MeasuredRig, card: SensorCard) -> Pair:
    down, up, down_off, up_off = images
    if down is None or up is None:
        raise ValueError("a pair needs both positions")
    return Pair(number, down, up, known.rig, stroke_m, card, down_off, up_off, beam=known.beam)


def _summed(images: Sequence[Image]) -> Image:
    if len(images) > _MOST_SUMMED:
        raise DatasetError(f"{len(images)} frames of a position: at most {_MOST_SUMMED} are added up")
    total = np.sum([image.astype(np.uint32) for image in images], axis=0)
    if total.max() > 65535:
        raise DatasetError("the sum of the frames is beyond 16 bits: give fewer frames of a position")
    summed = total.astype(np.uint16)
    summed.flags.writeable = False
    return summed


def _of_sum(card: SensorCard, count: int) -> SensorCard:
    """Card of the sum of frames: Poisson laws add up, and so do wells, codes and the variances of the noise.

    The responsivity's pattern stays the same part of the light. The n roundings are n / 12 DN^2 instead of 1 / 12.
    """
    rounding_e2 = (count - 1) / (12.0 * card.dn_per_e**2)
    return replace(
        card,
        exposure_s=card.exposure_s * count,
        full_well_e=card.full_well_e * count,
        read_noise_e=math.sqrt(count * card.read_noise_e**2 + rounding_e2),
        row_noise_e=math.sqrt(count) * card.row_noise_e,
        dsnu_e=count * card.dsnu_e,
        black_level_dn=count * card.black_level_dn,
        top_dn=count * card.top_dn,
    )


def frames_note(photos: PairPhotos, card: SensorCard) -> str:
    """Sentence on how several frames are used; empty for one."""
    count, offs = len(photos.down.on), len(photos.down.off)
    if count == 1:
        return ""
    if card.output == "raw" and offs in (0, count):
        return f"frames: {count} of each position, added up"
    shared = f", {offs} with the laser off" if offs else ""
    return f"frames: {count} of each position{shared}, each measured alone, positions combined"
