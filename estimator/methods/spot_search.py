"""Parts shared by built-in methods: kept results, boxes, search regions, peaks, spot distance, test of a fit's place.

A fit begins at a detection and may walk off along noise, to a lamp's edge or to another light. Its covariance is that
of the place where it ended, and says nothing of this: `at_detection` and `joint_or_separate` test how far it
lies from there.

Integer (u, v) are pixel centres, u along the columns, v along the rows.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, fields, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import gaussian_filter

from phibench.estimator.geometry.status import Status, describe
from phibench.estimator.geometry.triangulate import depth_exact
from phibench.estimator.interface import Answer, Box, Image, Method, Pair, Spot
from phibench.estimator.methods.pair_light import SIGMA_OF_MAD
from phibench.estimator.spots.camera_codes import rgb_codes
from phibench.estimator.spots.detect import Detection, PairDetection, detect
from phibench.estimator.spots.gaussian_spot import SpotBlur
from phibench.estimator.spots.image_planes import (
    demosaiced_planes,
    full_scale_e,
    kind_of,
    linear_planes,
    redness,
    variance_e2,
)
from phibench.estimator.spots.simple_spots import SpotPositions
from phibench.estimator.spots.spot_prediction import spot_blur
from phibench.scenes.frames import Array, BoolArray
from phibench.scenes.rig import POSITIONS

SIDE_PX = 15  # of a window: holds 99.9 % of a spot with a blur of up to 2 px, and a border to take the background from
_DETECTED_SIDE_PX = 21  # of a box around a detection: room for a fit's surroundings
LEAST_PX = 5  # side of a box below which there is nothing to measure
CORE_PX, AROUND_PX = 0.9, 3.0  # of the two Gaussians of a spot's likeness
_BEAM_RANGE_M = (0.3, 20.0)  # distances at which a beam's size is taken into account


# -- work that methods share -----------------------------------------------------------------------------------------

T = TypeVar("T")


@dataclass(frozen=True)
class _Made:
    value: Any
    seconds: float


class SharedWork:
    """Results for one pair that several built-in methods begin with: each is made once and kept.

    Results are immutable, so that no method can change what another one gets.

    Attributes
    ----------
    stages : dict of str to float
        CPU-seconds of each result, without those of results that it began with.
    reused_seconds : float
        Wall clock that results took which were there already: what a method would have taken besides, alone.
    """

    def __init__(self) -> None:
        self._made: dict[str, _Made] = {}
        self.stages: dict[str, float] = {}
        self.reused_seconds = 0.0

    def once(self, stage: str, make: Callable[[], T]) -> T:
        """Result of a stage, made now or kept; what raises is not kept."""
        if stage in self._made:
            self.reused_seconds += self._made[stage].seconds
            kept: T = self._made[stage].value
            return kept
        start, cpu, reused, inner = time.perf_counter(), time.process_time(), self.reused_seconds, self.total
        value = make()
        self.stages[stage] = time.process_time() - cpu - (self.total - inner)
        self._made[stage] = _Made(value, time.perf_counter() - start + self.reused_seconds - reused)
        return value

    @property
    def total(self) -> float:
        """CPU-seconds of all stages."""
        return sum(self.stages.values())


@dataclass(frozen=True)
class SharedPair(Pair):
    """A pair that built-in methods look at one after the other, with the work that they share.

    `dataclasses.replace` gives one without results: they belong to these very images.
    """

    work: SharedWork = field(default_factory=SharedWork, init=False, repr=False, compare=False)

    @classmethod
    def of(cls, pair: Pair) -> SharedPair:
        """The same pair, nothing done."""
        return cls(**{field.name: getattr(pair, field.name) for field in fields(Pair)})


def once(pair: Pair, stage: str, make: Callable[[Pair], T]) -> T:
    """Result of a stage; kept where methods share the work on this pair."""
    return pair.work.once(stage, lambda: make(pair)) if isinstance(pair, SharedPair) else make(pair)


def pair_detection(pair: Pair) -> PairDetection:
    """Spots that `detect` sees.

    Raises
    ------
    ValueError
        If an image does not fit the card's output.
    """
    return once(pair, "detect", detect)


# -- boxes -----------------------------------------------------------------------------------------------------------


def spot_boxes(pair: Pair, hints: bool = False) -> tuple[Box | None, Box | None]:
    """Boxes around the spots that `detect` sees; where it sees none, those of `trusted_hints`, or all if `hints`.

    Raises
    ------
    ValueError
        If an image does not fit the card's output.
    """
    return _boxes(pair, pair_detection(pair), hints)


def _boxes(pair: Pair, found: PairDetection, hints: bool) -> tuple[Box | None, Box | None]:
    own = (pair.box_down, pair.box_up) if hints else trusted_hints(pair, found)
    return box_around(found.down, pair.down) or own[0], box_around(found.up, pair.up) or own[1]


def trusted_hints(pair: Pair, found: PairDetection) -> tuple[Box | None, Box | None]:
    """Hints in which a spot may be although `detect` sees none.

    Without a laser-off image its silence says little: the room hides the spot from it. Where it has left out a spot
    that does not go with the other image's, the rig may be off. Elsewhere fits gave 58 answers on a benchmark, none of
    them near the spot.
    """
    down = pair.box_down if found.apart or pair.down_off is None else None
    return down, pair.box_up if found.apart or pair.up_off is None else None


def box_around(found: Detection | None, image: Image) -> Box | None:
    """Square of 21 pixels around a detection, moved inside the image where it would leave it."""
    return None if found is None else square_around(found.uv_px, image.shape, _DETECTED_SIDE_PX)


def square_around(uv_px: Iterable[float], shape: tuple[int, ...], side_px: int) -> Box:
    """Square about the nearest pixel of a place, moved inside an image of the shape (H, W, ...); at most the image."""
    size = shape[1], shape[0]
    side = min(side_px, size[0]), min(side_px, size[1])
    u0, v0 = (min(max(round(x) - s // 2, 0), n - s) for x, s, n in zip(uv_px, side, size, strict=True))
    return Box(u0, v0, *side)


def box_at(uv_px: tuple[float, float], shape: tuple[int, ...], side_px: int = SIDE_PX) -> Box:
    """Square box with the nearest pixel of a position in its middle, cut at the image's border.

    Parameters
    ----------
    uv_px : (u, v), pixels
    shape : (H, W, ...) of the image
    side_px : int, odd
    """
    half = side_px // 2
    u, v = (round(x) for x in uv_px)
    return clipped_box(Box(u - half, v - half, 2 * half + 1, 2 * half + 1), shape)


def clipped_box(box: Box, shape: tuple[int, ...]) -> Box:
    """Part of a box that lies in an image of the shape (H, W, ...)."""
    u0, v0 = max(box.u0_px, 0), max(box.v0_px, 0)
    u1, v1 = min(box.u0_px + box.width_px, shape[1]), min(box.v0_px + box.height_px, shape[0])
    return Box(u0, v0, max(u1 - u0, 0), max(v1 - v0, 0))


# -- spot-like places ------------------------------------------------------------------------------------------------


def spot_likeness(red: Array) -> Array:
    """Narrow minus wide Gaussian of a redness image, shape (h, w): a matched filter without the room's level."""
    narrow, wide = (gaussian_filter(red, sigma, mode="nearest") for sigma in (CORE_PX, AROUND_PX))
    return np.asarray(narrow - wide)


def red_peak(
    red: Array, inside: BoolArray | None = None, least_sigmas: float = 0.0, variance: Array | None = None
) -> tuple[float, float] | None:
    """Pixel (u, v) of the largest likeness, in the coordinates of `red`; None if nothing stands out.

    Parameters
    ----------
    red : shape (h, w)
        Redness, or any image in which the spot is brighter than its surroundings.
    inside : bool, shape (h, w), optional
        Where the spot may be.
    least_sigmas : float
        The peak must exceed the scatter of the likeness so many times (median absolute deviation).
    variance : shape (h, w), optional
        Of the redness, pixel by pixel, in any unit: the likeness is then over its standard deviation. Otherwise the
        noise of a lamp outshines a spot in a dark place.
    """
    if min(red.shape) < 3 or not np.isfinite(red).all():
        return None
    likeness = spot_likeness(red)
    if variance is not None:
        # the square of a Gaussian is one of half the variance
        likeness = likeness / np.sqrt(gaussian_filter(variance, CORE_PX / math.sqrt(2.0), mode="nearest"))
    allowed = np.ones(red.shape, bool) if inside is None else inside
    if not allowed.any():
        return None
    masked = np.where(allowed, likeness, -np.inf)
    v, u = np.unravel_index(int(np.argmax(masked)), masked.shape)
    scatter = SIGMA_OF_MAD * float(np.median(np.abs(likeness[allowed])))
    if not masked[v, u] > max(least_sigmas * scatter, 0.0):
        return None
    return float(u), float(v)


# -- search regions --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SearchRegion:
    """Part of one image of a pair that holds its spot, as the built-in methods see it.

    Attributes
    ----------
    position : "down" or "up"
    box : Box
        In the image; from the hint, or from `spot_boxes`.
    depth_m : float or None
        Of the spot, where it is known already.
    found : Detection or None
        Where `detect` sees the spot; None in a hint in which it sees none.
    """

    pair: Pair
    position: str
    box: Box
    depth_m: float | None = None
    found: Detection | None = None

    @property
    def origin_px(self) -> tuple[int, int]:
        """Image pixel (u, v) of the box's first column and row."""
        return self.box.u0_px, self.box.v0_px

    @property
    def pixels(self) -> NDArray[Any]:
        """Pixels of the box, as the camera delivers them."""
        return self.pair.images[self.position][self.box.slices]

    @property
    def off_pixels(self) -> NDArray[Any] | None:
        """Pixels of the box with the laser off."""
        off = self.pair.images.get(f"{self.position}_off")
        return None if off is None else off[self.box.slices]

    @property
    def frames(self) -> tuple[int, int]:
        """Frames with the laser on, and with it off, that the pixels are means of."""
        return self.pair.count(self.position), self.pair.count(f"{self.position}_off")

    @property
    def planes(self) -> Array:
        """Linear light of the box: `image_planes.linear_planes`."""
        return linear_planes(self.pixels, self.pair.card, self.origin_px)

    @property
    def picture(self) -> Array:
        """Box as a viewer shows it: R, G, B, shape (h, w, 3), or one plane; raw ones interpolated, not encoded."""
        pixels = rgb_codes(self.pixels, self.pair.card, self.origin_px).astype(float)
        if kind_of(self.pair.card) != "bayer-raw":
            return pixels
        return np.moveaxis(demosaiced_planes(pixels, self.origin_px), 0, -1)

    @property
    def red(self) -> Array:
        """Redness of the box, shape (h, w), the room's taken off where there is a frame with the laser off."""
        red, off = redness(self.planes), self.off_pixels
        return red if off is None else red - redness(linear_planes(off, self.pair.card, self.origin_px))

    @property
    def variance(self) -> Array:
        """Variance of the redness, shape (h, w), but for a factor that is the same everywhere."""
        card, scale = self.pair.card, full_scale_e(self.pair.card)
        images = [self.pixels] if self.off_pixels is None else [self.pixels, self.off_pixels]
        levels = [linear_planes(image, card, self.origin_px).mean(axis=0) * scale for image in images]
        return np.sum([variance_e2(level, card, len(levels) > 1) for level in levels], axis=0)

    @property
    def place(self) -> tuple[float, float] | None:
        """Place (u, v) of the spot in the coordinates of the box; None if nothing stands out.

        It is that of `detect`. In a hint in which it sees none, it is the reddest spot-like place over its noise.
        """
        if self.found is None:
            return red_peak(self.red, variance=self.variance)
        return self.found.uv_px[0] - self.box.u0_px, self.found.uv_px[1] - self.box.v0_px

    def narrowed(self) -> SearchRegion | None:
        """Region of 15 x 15 pixels around `place`; None if there is none."""
        return self.window_at(self.place)

    def window_at(self, peak: tuple[float, float] | None) -> SearchRegion | None:
        """Region of 15 x 15 pixels around a place (u, v) in the coordinates of the box."""
        if peak is None:
            return None
        uv = (peak[0] + self.box.u0_px, peak[1] + self.box.v0_px)
        return replace(self, box=box_at(uv, self.pair.images[self.position].shape))


# -- methods on search regions ---------------------------------------------------------------------------------------


def each_spot(find: Callable[[SearchRegion], Spot], hints: bool = False) -> Method:
    """Method that looks at each image by itself, where `spot_boxes` sees a spot, or else at its hint if `hints`."""
    return lambda pair: _both(find, pair, pair_detection(pair), hints, None)


def each_spot_twice(find: Callable[[SearchRegion], Spot]) -> Method:
    """Method as of `each_spot`, then once more with the distance found, for methods that use the beam's size."""

    def method(pair: Pair) -> Answer:
        detections = pair_detection(pair)
        return measured_twice(lambda depth_m: _both(find, pair, detections, False, depth_m), pair)

    return method


def _both(
    find: Callable[[SearchRegion], Spot], pair: Pair, found: PairDetection, hints: bool, depth_m: float | None
) -> Answer:
    seen = zip(("down", "up"), _boxes(pair, found, hints), (found.down, found.up), strict=True)
    down, up = (_seen(find, pair, name, box, depth_m, one) for name, box, one in seen)
    return Answer(down, up)


def _seen(
    find: Callable[[SearchRegion], Spot],
    pair: Pair,
    position: str,
    box: Box | None,
    depth_m: float | None,
    found: Detection | None,
) -> Spot:
    if box is None:
        return Spot.missing("nothing spot-like in the mirror")
    inside = clipped_box(box, pair.images[position].shape)
    if min(inside.width_px, inside.height_px) < LEAST_PX:
        return Spot.missing("the box lies outside the image")
    return find(SearchRegion(pair, position, inside, depth_m, found))


def spot_of(found: SpotPositions) -> Spot:
    """Answer for the first of some positions, in the image."""
    status = Status(int(found.status[0]))
    if status is not Status.OK:
        return Spot.missing(describe(status))
    return Spot((float(found.uv_px[0, 0]), float(found.uv_px[0, 1])))


# -- the spot's distance and blur ------------------------------------------------------------------------------------


def measured_twice(measure: Callable[[float | None], Answer], pair: Pair) -> Answer:
    """Answer of `measure`, which takes the spot's distance: once without it, once with the one found.

    The beam's size in a spot's image needs the distance, which both images of a pair tell once they are measured. A
    spot that the second measurement does not find keeps the first one's answer.
    """
    first = measure(None)
    depth_m = seen_depth_m(pair, first)
    if depth_m is None:
        return first
    second = measure(depth_m)
    down, up = (
        one if two.uv_px is None or two.covariance_px2 is None else two
        for one, two in ((first.down, second.down), (first.up, second.up))
    )
    return Answer(down, up)


def seen_depth_m(pair: Pair, answer: Answer) -> float | None:
    """Distance at which the rays through two positions meet; None if they do not, or the beam is not known."""
    if pair.beam is None or answer.down.uv_px is None or answer.up.uv_px is None:
        return None
    estimate = depth_exact(pair.rig, pair.stroke_m, np.array(answer.down.uv_px), np.array(answer.up.uv_px))
    depth_m = float(estimate.depth_m)
    return depth_m if estimate.status == Status.OK and _BEAM_RANGE_M[0] <= depth_m <= _BEAM_RANGE_M[1] else None


def pair_blur(pair: Pair, uv_px: ArrayLike, depth_m: float | None) -> SpotBlur:
    """Blur of a spot of the pair's laser at a distance; None leaves the beam's size out."""
    return spot_blur(pair.rig, uv_px, depth_m, pair.beam)


# -- places of fits ----------------------------------------------------------------------------------------------------

_OFF_PX = 1.0  # of a detection on interpolated pixels; 0.9 was seen
_SIGMAS = 4.0  # of detection and fit together
_MOST_PX = 2.0  # whatever a fit claims: with `_OFF_PX` a fit stays within 3 px of the light
_BLUR_PX = 1.0  # of a spot, whose detection has this over its significance for a standard deviation


def left_px(found: Detection, spot: Spot) -> float | None:
    """Distance of a fit from the detection, pixels, where it is more than both sigmas allow; otherwise None."""
    if spot.uv_px is None:
        return None
    apart = math.dist(spot.uv_px, found.uv_px)
    claimed2 = 0.0 if spot.covariance_px2 is None else 0.5 * float(np.trace(spot.covariance_px2))
    sigma = math.sqrt(claimed2 + (_BLUR_PX / max(found.significance, 1.0)) ** 2)
    return apart if not apart <= min(_OFF_PX + _SIGMAS * sigma, _MOST_PX) else None


def at_detection(found: Detection | None, spot: Spot) -> Spot:
    """The spot of a fit; of one that left its detection, or ended nowhere, the detection's place without covariance.

    A place without covariance says that no fit stands behind it.
    """
    if found is None or (spot.uv_px is not None and left_px(found, spot) is None):
        return spot
    return Spot(found.uv_px)


def joint_or_separate(pair: Pair, separate: Answer, together: Answer) -> Answer:
    """The answer for both images together; the separate one where a spot of it left its detection."""
    detections = pair_detection(pair)
    for position in POSITIONS:
        detection, spot = getattr(detections, position), getattr(together, position)
        if detection is not None and left_px(detection, spot) is not None:
            return separate
    return together
