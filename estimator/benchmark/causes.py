"""Why an image has no right position: exactly one cause for each, the first that holds along the path of the light.

An image that is not detected is **unseen** (not visible, and no position was given: rightly), **missed** (visible, no
position) or **false** (a position where there is no spot, or too far from it). Whatever it is, it has one cause:

1. ``occluded``: not visible, and the scene is why: an object in the way, or the wall that carries the spot.
2. ``mirror_edge``: not visible because no point of the mirror reflects it, or its image touches the mirror's outline;
   or visible and nearer to the outline than 3 blurs, where part of its light is cut off.
3. ``image_edge``: the same with the edge of the sensor.
4. ``saturated``: a pixel of the spot is expected above saturation: its shape is lost.
5. ``confused``: the position is within `match_px` of another light of the scene, or of a region that is brighter than
   the spot, in the image as it is or less the laser-off image if there is one: mean of 4 x 4 pixels (two Bayer cells).
   A lamp that the laser-off image would have ruled out is still what the method was confused by.
6. ``below_noise``: flux below 5 standard deviations. In 1280 x 720 pixels of Gaussian noise the largest is at 4.9
   standard deviations on average, so that a fainter spot cannot be told from noise in the whole image (A. Rose, J.
   Opt. Soc. Am. 38, 196, 1948, found the same 5 for the eye).
7. ``compression``: the raw pixels would have been good enough (bound below 1 px along each axis), but nothing is left
   at the spot's place in the 8-bit image: in every colour the mean of its 3 x 3 pixels is less than one code, or less
   than 3 standard errors, above the median of the ring 4 to 8 px around. The standard error is that of 9 pixels with
   the ring's robust deviation (1.4826 MAD).
8. the harness's word, if the method did not come back: ``error``, ``timeout``, ``crash``, ``memory``, ``invalid``,
   ``mutated``.
9. ``method``: none of these. The light was there.

So a crash on an image without a spot counts as ``occluded``; how often the method failed is counted apart (`failures`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import polars as pl

from phibench.estimator.benchmark.answer_errors import Rules
from phibench.estimator.interface import FAILURES, Pair
from phibench.estimator.pair_set import PairSet, PairTruth, SpotTruth
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig

LEAST_SNR = 5.0
EDGE_BLURS = 3.0
GOOD_RAW_PX = 1.0
LEAST_CODES = 1.0
LEAST_CONTRAST = 3.0
_RING = (4, 8)
KINDS = ("unseen", "missed", "false")
_PIXEL_SIGMA2 = 1.0 / 12.0
_OF_THE_MIRROR = ("no_reflection", "mirror_edge")


@dataclass(frozen=True)
class Case:
    """One image without a right position, with what the rules ask; the images are drawn when a rule needs them."""

    position: str
    truth: PairTruth
    answer_px: Array | None
    failure: str
    draw: Callable[[int], Pair]
    rules: Rules

    @property
    def spot(self) -> SpotTruth:
        """Truth of the image."""
        return getattr(self.truth, self.position)

    @property
    def rig(self) -> Rig:
        """The rig that was rendered."""
        return self.truth.true_rig

    @cached_property
    def pair(self) -> Pair:
        """Images."""
        return self.draw(self.truth.number)

    def region(self, uv_px: Array, before: int, after: int, less_off: bool = False) -> Array:
        """Codes of the pixels from `before` to `after` around one, inclusive, shape (h, w, planes).

        Empty outside the image; less the laser-off image if that is asked for and there is one.
        """
        u, v = (int(x) for x in np.floor(uv_px))
        rows, columns = (slice(max(x - before, 0), max(x + after + 1, 0)) for x in (v, u))
        part = _planes(getattr(self.pair, self.position)[rows, columns])
        off = getattr(self.pair, f"{self.position}_off")
        return part - _planes(off[rows, columns]) if less_off and off is not None else part


def cause_of(case: Case) -> str:
    """The cause: the name of the first rule that holds."""
    return next((name for name, holds in _RULES.items() if holds(case)), case.failure or "method")


def with_causes(records: pl.DataFrame, pairs: PairSet, rules: Rules) -> pl.DataFrame:
    """Records with `kind` and `cause`, both null where the spot was detected.

    Parameters
    ----------
    records : as of `records.records`
    pairs : PairSet
        Images are asked for only where a rule looks at them, those of a pair twice at most: give `CachedPairs`.
    rules : Rules
    """
    causes, kinds = [], []
    for row in records.iter_rows(named=True):
        found = row["detected"]
        causes.append(None if found else cause_of(_case(row, pairs, rules)))
        kinds.append(None if found else _kind(row))
    return records.with_columns(pl.Series("kind", kinds, pl.String), pl.Series("cause", causes, pl.String))


def count(records: pl.DataFrame) -> dict[str, dict[str, int]]:
    """Images per cause and kind; every cause is there, in the order of the rules."""
    rows = records.filter(~pl.col("detected")).select("cause", "kind").rows()
    numbers = Counter(rows)
    return {cause: {kind: numbers[cause, kind] for kind in KINDS} for cause in CAUSES}


def count_failures(records: pl.DataFrame) -> dict[str, int]:
    """Pairs per failure of the harness, whatever their spots' causes."""
    numbers = Counter(records.filter(pl.col("image") == "down")["failure"].to_list())
    return {name: numbers[name] for name in FAILURES}


def _case(row: dict[str, Any], pairs: PairSet, rules: Rules) -> Case:
    answer = None if row["u_px"] is None else np.array([row["u_px"], row["v_px"]])
    return Case(row["image"], pairs.truth(row["number"]), answer, row["failure"], pairs.pair, rules)


def _kind(row: dict[str, Any]) -> str:
    if row["false_detection"]:
        return "false"
    return "missed" if row["visible"] else "unseen"


# -- the rules -----------------------------------------------------------------------------------------------------


def _occluded(case: Case) -> bool:
    return not case.spot.visible and case.spot.cause not in (*_OF_THE_MIRROR, "outside_image")


def _mirror_edge(case: Case) -> bool:
    if not case.spot.visible:
        return case.spot.cause in _OF_THE_MIRROR
    outline = case.rig.outline_px()
    return bool(np.min(np.linalg.norm(outline - np.array(case.spot.uv_px), axis=-1)) < _margin_px(case.rig))


def _image_edge(case: Case) -> bool:
    if not case.spot.visible:
        return case.spot.cause == "outside_image"
    u, v = case.spot.uv_px
    camera = case.rig.camera
    inside = min(u + 0.5, v + 0.5, camera.width_px - 0.5 - u, camera.height_px - 0.5 - v)
    return inside < _margin_px(case.rig)


def _saturated(case: Case) -> bool:
    return case.spot.saturated


def _confused(case: Case) -> bool:
    if case.answer_px is None:
        return False
    others = (np.array(other.uv_px) for other in case.spot.distractions)
    if any(np.linalg.norm(case.answer_px - other) <= case.rules.match_px for other in others):
        return True
    true_px = np.array(case.spot.uv_px)
    return any(_level(case, case.answer_px, off) > _level(case, true_px, off) for off in (False, True))


def _below_noise(case: Case) -> bool:
    return case.spot.snr < LEAST_SNR


def _compression(case: Case) -> bool:
    raw = case.spot.raw_bound_px2
    if raw is None or not np.sqrt(np.trace(raw) / 2.0) < GOOD_RAW_PX or case.pair.card.output not in ("srgb8", "mjpeg"):
        return False
    return not _stands_out(case)


_RULES: dict[str, Callable[[Case], bool]] = {
    "occluded": _occluded,
    "mirror_edge": _mirror_edge,
    "image_edge": _image_edge,
    "saturated": _saturated,
    "confused": _confused,
    "below_noise": _below_noise,
    "compression": _compression,
}
CAUSES = (*_RULES, *FAILURES, "method")


def _margin_px(rig: Rig) -> float:
    return EDGE_BLURS * float(np.sqrt(rig.camera.blur_sigma_px**2 + _PIXEL_SIGMA2))


def _planes(image: Any) -> Array:
    planes = np.asarray(image, float)
    return planes[..., None] if planes.ndim == 2 else planes


def _level(case: Case, uv_px: Array, less_off: bool) -> float:
    """Mean of the 4 x 4 pixels around a position, all planes added; -inf outside the image."""
    part = case.region(uv_px, 1, 2, less_off)
    return float(part.sum(axis=-1).mean()) if part.size else -np.inf


def _stands_out(case: Case) -> bool:
    """Whether the 3 x 3 pixels of the spot rise above the ring around them in any colour; see rule 7."""
    middle = np.floor(np.array(case.spot.uv_px) + 0.5)
    around = case.region(middle, _RING[1], _RING[1])
    inside = np.minimum(middle, _RING[1]).astype(int)  # of the pixel in the region: less where the image begins
    rows, columns = np.ogrid[: around.shape[0], : around.shape[1]]
    distance = np.maximum(abs(rows - inside[1]), abs(columns - inside[0]))
    spot, ring = around[distance <= 1], around[distance >= _RING[0]]
    level = np.median(ring, axis=0)
    error = 1.4826 * np.median(abs(ring - level), axis=0) / 3.0
    contrast = spot.mean(axis=0) - level
    return bool(np.any((contrast >= LEAST_CODES) & (contrast >= LEAST_CONTRAST * error)))
