"""Causes (`CAUSES`) of images without a right position, one each; their counts; and what false positions lie on.

An image that is not found is of one kind: *unseen* (no spot visible, and rightly no position), *missed* (a spot, no
position: "no answer" in tables) or *false* (a position where there is no spot, or too far from it). Its cause is one
of `CAUSES`, in this order; the numbers of the rules:

edge          the spot's image is nearer than 3 blurs to the mirror's outline or to the sensor's edge
confused      the answer is within `match_px` of another light, or its 4 x 4 pixels (two Bayer cells) are brighter than
              the spot's: in the image as it is, or less the laser-off image. A lamp that the laser-off image would have
              ruled out is still what the method was confused by
below_noise   signal to noise (`limits.position_bound`) below 5. The largest of 1280 x 720 Gaussian numbers is 4.9
              deviations on average: a fainter spot cannot be told from noise (A. Rose, J. Opt. Soc. Am. 38, 196,
              1948, has 5 for the eye)
compression   the raw pixels are good enough (bound below 1 px along each axis), but the spot is lost in the 8-bit
              image: in every colour the mean of its 3 x 3 pixels is less than one code, or less than 3 standard
              errors, above the median of the ring 4 to 8 px around. The error is that of 9 pixels with the ring's
              deviation (1.4826 MAD)

The image itself is the cause only where a fit that knows where to look does no better: where such a fit reaches its
bound (`fit_at_truth`), `mirror_edge`, `image_edge`, `saturated`, `below_noise` and `compression` do not hold, and the
method's own fault shows.

A crash on an image without a spot counts as `occluded`; failures of the method are counted apart, `count_failures`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import polars as pl
from scipy.ndimage import uniform_filter

from phibench.benchmark.scores.answer_errors import Rules
from phibench.benchmark.scores.fit_at_truth import FitAtTruth, fit_at_truth, reaches_bound
from phibench.estimator.interface import FAILURES, Answer, Pair
from phibench.estimator.pair_set import ImageTruth, PairSet, PairTruth
from phibench.estimator.spots.camera_codes import rgb_codes
from phibench.estimator.spots.image_planes import PROCESSED
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig

# Thresholds of the rules, derived in the text above.
LEAST_SNR = 5.0
EDGE_BLURS = 3.0
GOOD_RAW_PX = 1.0
LEAST_CODES = 1.0
LEAST_CONTRAST = 3.0
_RING = (4, 8)  # px from the spot: 4 px are 5 blurs of the default rig, so that no light of the spot is in it
_CLIPPED = 0.95  # of the largest code: the mean of 4 x 4 pixels in a lamp's reflection
_LAMP_TO_SPOT = 3.0
_AROUND_PX = 12  # from a false position, to what on - off has there otherwise
_PEAK_SIGMAS = 2.2
KINDS: dict[str, str] = {"missed": "no answer", "false": "false", "unseen": "rightly none"}
"""Kinds with their names in tables. The records' column `missed` holds for "false" at a visible spot, too."""
_PIXEL_SIGMA2 = 1.0 / 12.0  # px^2: the integration over a pixel widens the optical blur by the variance of a unit box
_OF_THE_MIRROR = ("no_reflection", "mirror_edge")


@dataclass(frozen=True)
class Case:
    """One image without a right position; its images are simulated when a rule needs them."""

    position: str
    truth: PairTruth
    answer_px: Array | None
    failure: str
    draw: Callable[[int], Pair]
    rules: Rules
    fit: Callable[[Pair, PairTruth], Answer | None] = fit_at_truth

    @property
    def spot(self) -> ImageTruth:
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

    @cached_property
    def allows_a_fit(self) -> bool:
        """True if a fit that knows where to look reaches its bound in this image."""
        answer = self.fit(self.pair, self.truth)
        return reaches_bound(answer, self.position, self.spot, self.rules.match_px)

    def region(self, uv_px: Array, before: int, after: int, less_off: bool = False) -> Array:
        """Codes of the pixels from `before` to `after` around one, inclusive, shape (h, w, planes).

        Empty outside the image; less the laser-off image if that is asked for and there is one.
        """
        u, v = (int(x) for x in np.floor(uv_px))
        rows, columns = (slice(max(x - before, 0), max(x + after + 1, 0)) for x in (v, u))
        planes = self._planes(getattr(self.pair, self.position), rows, columns)
        off = getattr(self.pair, f"{self.position}_off")
        return planes - self._planes(off, rows, columns) if less_off and off is not None else planes

    def _planes(self, image: Any, rows: slice, columns: slice) -> Array:
        planes = np.asarray(rgb_codes(image[rows, columns], self.pair.card, (columns.start, 0)), float)
        return planes[..., None] if planes.ndim == 2 else planes


def cause_of(case: Case) -> str:
    """The cause: the name of the first rule that holds."""
    return next((name for name in _RULES if _is_cause(case, name)), case.failure or "method")


def _is_cause(case: Case, name: str) -> bool:
    return _RULES[name](case) and not (name in _OF_THE_IMAGE and case.spot.visible and case.allows_a_fit)


def with_causes(records: pl.DataFrame, pairs: PairSet, rules: Rules, fit: FitAtTruth = fit_at_truth) -> pl.DataFrame:
    """Records with `kind`, `cause` and, of false detections, `taken_for`; null where the spot was detected.

    Parameters
    ----------
    records : as of `records.record_table`
    pairs : PairSet
        Images are asked for only where a rule looks at them, those of a pair twice at most: give `CachedPairs`.
    fit : FitAtTruth
        Fit that knows where to look.
    """
    columns: dict[str, list[str | None]] = {"kind": [], "cause": [], "taken_for": []}
    for row in records.iter_rows(named=True):
        if row["detected"]:
            values: tuple[str | None, ...] = (None, None, None)
        else:
            case, kind = _case(row, pairs, rules, fit), _kind(row)
            values = kind, cause_of(case), taken_for(case) if kind == "false" else None
        for name, value in zip(columns, values, strict=True):
            columns[name].append(value)
    return records.with_columns(*(pl.Series(name, values, pl.String) for name, values in columns.items()))


def count(records: pl.DataFrame) -> dict[str, dict[str, int]]:
    """Images per cause and kind; every cause is there, in the order of the rules."""
    rows = records.filter(~pl.col("detected")).select("cause", "kind").rows()
    numbers = Counter(rows)
    return {cause: {kind: numbers[cause, kind] for kind in KINDS} for cause in CAUSES}


def count_failures(records: pl.DataFrame) -> dict[str, int]:
    """Pairs per failure of the harness, whatever their spots' causes."""
    numbers = Counter(records.filter(pl.col("image") == "down")["failure"].to_list())
    return {name: numbers[name] for name in FAILURES}


def _case(row: dict[str, Any], pairs: PairSet, rules: Rules, fit: FitAtTruth) -> Case:
    answer = None if row["u_px"] is None else np.array([row["u_px"], row["v_px"]])
    return Case(row["image"], pairs.truth(row["number"]), answer, row["failure"], pairs.pair, rules, fit)


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
        return False  # silence takes no other light for the spot
    if _on_other_light(case, case.answer_px):
        return True
    true_px = np.array(case.spot.uv_px)
    return any(_level(case, case.answer_px, off) > _level(case, true_px, off) for off in (False, True))


def _on_other_light(case: Case, uv_px: Array) -> bool:
    others = (np.array(other.uv_px) for other in case.spot.distractions)
    return any(bool(np.linalg.norm(uv_px - other) <= case.rules.match_px) for other in others)


def _below_noise(case: Case) -> bool:
    return case.spot.snr < LEAST_SNR


def _compression(case: Case) -> bool:
    raw = case.spot.raw_bound_px2
    if raw is None or not np.sqrt(np.trace(raw) / 2.0) < GOOD_RAW_PX or case.pair.card.output not in PROCESSED:
        return False  # lost before the 8 bits, or never through them
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
_OF_THE_IMAGE = ("mirror_edge", "image_edge", "saturated", "below_noise", "compression")
CAUSES: dict[str, str] = {
    "occluded": "spot not visible: an object in the way, or the wall that carries it faces away",
    "mirror_edge": "spot not reflected, or cut off at the mirror's outline",
    "image_edge": "spot outside the image, or cut off at its edge",
    "saturated": "a pixel of the spot is expected above saturation, and no fit at its place reaches the bound",
    "confused": "the answer is another light, or a region brighter than the spot",
    "below_noise": "signal to noise of the spot below 5",
    "compression": "spot good enough in the raw pixels, lost in the 8-bit image",
    "error": "the method raised an exception",
    "timeout": "the method took longer than --seconds",
    "crash": "the method's process died",
    "memory": "the method needed more than --memory-mb",
    "invalid": "the method's answer breaks the rules of the interface",
    "mutated": "the method wrote into its input",
    "method": "none of these: the light was there, or a fit at its place reaches the bound",
}
"""Causes in the order in which they are tried, with their definitions."""


TAKEN_FOR: dict[str, tuple[str, str]] = {
    "lamp": (
        "a lamp or its reflection in the mirror",
        "subtract a laser-off image, or mask lamps (lamp_mask in docs/method.md)",
    ),
    "lamp_noise": (
        "noise of a lamp or its reflection in on - off",
        "divide by the noise, or mask lamps (lamp_mask in docs/method.md)",
    ),
    "light": ("another light of the scene", "tell it by the laser-off image and its size"),
    "region": ("a region that is brighter than the spot", "subtract a laser-off image"),
    "region_noise": (
        "noise of a bright region in on - off",
        "divide by the noise, or mask bright regions (lamp_mask in docs/method.md)",
    ),
    "nothing": (
        "false, where the image is no brighter than at the spot",
        "look at the worst images of `phibench report`; `phibench method check` finds mistakes of convention",
    ),
}
"""Kinds of places that false detections lie on, in words, with advice."""
NOISE = "_noise"
"""End of the kinds whose places are peaks of on - off: those of methods that subtract."""


def taken_for(case: Case) -> str:
    """Kind of the place that a false detection lies on: key of `TAKEN_FOR`."""
    if case.answer_px is None:
        raise ValueError("no position, nothing that it could be taken for")
    if _on_other_light(case, case.answer_px):
        return "light"
    spot = _level(case, np.array(case.spot.uv_px), False) if case.spot.visible else np.inf
    if _is_lamp(case, case.answer_px, spot):
        kind = "lamp"
    elif _level(case, case.answer_px, False) > spot:
        kind = "region"
    else:
        return "nothing"
    return f"{kind}{NOISE}" if _is_peak_of_difference(case, case.answer_px) else kind


def _is_peak_of_difference(case: Case, uv_px: Array) -> bool:
    """Tell whether on - off has a peak at a false position: the answer of a method that subtracts.

    The largest mean of 3 x 3 pixels within 2 px is compared with those of the ring 6 to 12 px around. Of methods that
    look at on alone it exceeds 2.2 deviations at less than half of the positions, of methods that subtract at most.
    """
    if getattr(case.pair, f"{case.position}_off") is None:
        return False  # nothing to subtract
    difference = case.region(uv_px, _AROUND_PX, _AROUND_PX, less_off=True).sum(axis=-1)
    if difference.shape != (2 * _AROUND_PX + 1,) * 2:
        return False  # at the image's edge
    means = uniform_filter(difference, 3)
    rows, columns = np.abs(np.indices(means.shape) - _AROUND_PX)
    distance = np.maximum(rows, columns)
    ring = means[distance >= _AROUND_PX // 2]
    level = np.median(ring)
    scatter = 1.4826 * np.median(np.abs(ring - level))  # deviation of a normal law
    # codes are whole numbers: the mean of nine has a tenth of a code where the noise is less
    return bool(means[distance <= 2].max() - level >= _PEAK_SIGMAS * max(scatter, 0.1))


def _is_lamp(case: Case, uv_px: Array, spot_level: float) -> bool:
    """Tell whether the light at a position is clipped, or in raw pixels thrice the spot's, black level included."""
    region, card = case.region(uv_px, 1, 2), case.pair.card
    if not region.size:
        return False  # outside of the image
    top = float(card.top_dn) if card.output == "raw" else 255.0
    if region.max(axis=-1).mean() >= _CLIPPED * top:
        return True
    return card.output == "raw" and float(region.sum(axis=-1).mean()) > _LAMP_TO_SPOT * spot_level > 0.0


def _margin_px(rig: Rig) -> float:
    return EDGE_BLURS * float(np.sqrt(rig.camera.blur_sigma_px**2 + _PIXEL_SIGMA2))


def _level(case: Case, uv_px: Array, less_off: bool) -> float:
    """Mean of the 4 x 4 pixels around a position, all planes added; -inf outside the image."""
    region = case.region(uv_px, 1, 2, less_off)
    return float(region.sum(axis=-1).mean()) if region.size else -np.inf


def _stands_out(case: Case) -> bool:
    """Tell whether the 3 x 3 pixels of the spot rise above the ring around them in any colour (`compression`)."""
    middle = np.floor(np.array(case.spot.uv_px) + 0.5)
    around = case.region(middle, _RING[1], _RING[1])
    inside = np.minimum(middle, _RING[1]).astype(int)  # of the pixel in the region: less where the image begins
    rows, columns = np.ogrid[: around.shape[0], : around.shape[1]]
    distance = np.maximum(abs(rows - inside[1]), abs(columns - inside[0]))
    spot, ring = around[distance <= 1], around[distance >= _RING[0]]
    level = np.median(ring, axis=0)
    # 1.4826 MAD is the deviation of a normal law; the mean of 3 x 3 pixels has a third of it
    error = 1.4826 * np.median(abs(ring - level), axis=0) / 3.0
    contrast = spot.mean(axis=0) - level
    return bool(np.any((contrast >= LEAST_CODES) & (contrast >= LEAST_CONTRAST * error)))
