"""Detection of the laser spot in both whole frames, without a hint; epipolar curve, mirror's box and mask, lamps.

Per image: the strongest places of a matched filter inside the mirror's outline and away from lamps, each tested for
shape and colour (`candidates`). Then both images together: the ray of a pixel of the down image passes points at
distances D, whose images sweep a curve in the up image. The spot's images belong to one point, so that the candidate of
the up image lies near the curve.

False alarms. The mirror's disc has 3.6e5 pixels and each is asked at 4 half-pixel places, so that a frame has at most
N = 1.44e6 trials. On raw pixels whose background is known the significance is never larger than a unit normal's,
because chi^2 only lowers it. A candidate alone: N Q(6.2) = 4e-4 a frame. A pair: the partner lies within 4 px of a
curve at most 340 px long, n = 4 x 2700 trials, and both pass 4.8: N n Q(4.8)^2 = 0.01 with all places taken for
independent. Those within a blur's area (7 px, 4 places each) share their noise, in both images, which leaves about
1e-5 a pair. Processed pixels have longer tails than a normal law, and a room seen without filters and without a
laser-off frame has corners that look like spots: both have thresholds of their own, set by measurement.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from PIL import Image as Picture
from PIL import ImageDraw
from scipy.ndimage import label, maximum_filter

from phibench.datasets.frames.sensor_card import SensorCard
from phibench.estimator.geometry.epipolar_line import up_image
from phibench.estimator.interface import Box, Pair
from phibench.estimator.spots.candidates import Candidates, candidate_noise, candidates_at, peaks
from phibench.estimator.spots.image_planes import ColourPlanes, blur_of, colour_planes
from phibench.scenes.frames import Array, BoolArray
from phibench.scenes.rig import Rig

# -- lamps -----------------------------------------------------------------------------------------------------------

_BRIGHT = 3.0  # times the median inside the mirror
_LEAST_AREA_PX = 80  # of a lamp: a full spot has fewer pixels
_HALO_PX, _JPEG_HALO_PX = 5, 12  # a JPEG's block and its neighbour's interpolation
_IN_HALO = 3.0  # times the threshold of a candidate alone, where a laser-off frame shows the lamp


def lamp_halo(planes: ColourPlanes, inside: BoolArray, card: SensorCard, laser_off: bool) -> BoolArray:
    """Lamps and what is near to them, shape (h, w): large bright areas.

    Around them an edge, clipping or JPEG's ringing look like anything. Bright is a multiple of the usual level; a spot,
    however strong, is small. Of a laser-off frame (`laser_off`) only full pixels count: what is merely bright, such as
    a sunlit wall, is subtracted, and its noise is known. There a spot of several times the threshold counts.
    """
    # red pixels alone: every second one of a mosaic
    step = 2 if planes.mosaic else 1
    red = planes.values_e[0][::step, ::step]
    bright = planes.full[0][::step, ::step]
    if not laser_off:
        bright = bright | (red > _BRIGHT * np.median(red[inside[::step, ::step]]))
    areas, count = label(bright)
    large = np.bincount(areas.ravel(), minlength=count + 1) * step**2 >= _LEAST_AREA_PX
    # area 0 is what is not bright
    large[0] = False
    lamps = np.repeat(np.repeat(large[areas], step, axis=0), step, axis=1)[: planes.shape[0], : planes.shape[1]]
    return np.asarray(maximum_filter(lamps, 2 * (_JPEG_HALO_PX if card.output == "mjpeg" else _HALO_PX) + 1))


# -- both images together --------------------------------------------------------------------------------------------

NEAREST_M, FARTHEST_M = 0.3, 12.0  # of D
NEAR_CURVE_PX = 4.0  # shift of the curve for a rig that differs a little from the nominal one
_POINTS = 48  # of the curve, evenly in 1 / D: there it hardly bends between two
_FLUX_RATIO = 6.0  # of one spot in both images, for 98 % of all surfaces
_FLUX_RATIO_ALONE = 30.0  # where each is sure by itself: 17 at most in 900 pairs, times 2 for a sharp one on a mosaic
_STRONGER = 1.5  # a single candidate over a pair's: others have half the spot's light at most
_MOST = 24  # candidates of an image that are compared


@dataclass(frozen=True)
class Thresholds:
    """Least significance of a candidate alone, of each of a pair, and of their root mean square."""

    alone: float
    each: float
    together: float


@dataclass(frozen=True)
class Choice:
    """Rows of the chosen candidates; None where there is none."""

    down: int | None = None
    up: int | None = None
    apart: bool = False


def choose(rig: Rig, stroke_m: float, down: Candidates, up: Candidates, least: Thresholds, sure: bool) -> Choice:
    """Choose the strongest consistent pair, or one candidate alone.

    Parameters
    ----------
    down, up : Candidates
        Candidates, pixels of the whole image, strongest first.
    sure : bool
        The candidates are known to be red or the laser's; otherwise a pair is always preferred.
    """
    fits = consistent_pairs(rig, stroke_m, down.uv_px[:_MOST], up.uv_px[:_MOST])
    ratio = up.electrons[None, :_MOST] / np.maximum(down.electrons[:_MOST, None], 1e-9)  # no light: far beyond `most`
    z_down, z_up = down.z[:_MOST, None], up.z[None, :_MOST]
    most = np.where(np.minimum(z_down, z_up) >= least.alone, _FLUX_RATIO_ALONE, _FLUX_RATIO)
    fits &= (ratio < most) & (ratio > 1.0 / most)
    fits &= (np.minimum(z_down, z_up) >= least.each) & (z_down**2 + z_up**2 >= 2.0 * least.together**2)
    alone = (_strongest(down, least.alone), _strongest(up, least.alone))
    if not fits.any():
        return _single(down, up, alone)
    # by the light of both: a saturated spot may seem fainter in one image than another light
    light = np.sqrt(np.maximum(down.electrons[:_MOST, None], 0.0) * np.maximum(up.electrons[None, :_MOST], 0.0))
    row, column = (int(k) for k in np.unravel_index(np.argmax(np.where(fits, light, -1.0)), fits.shape))
    if not sure:
        return Choice(row, column)
    outshone = [
        one is not None and side.electrons[one] > _STRONGER * side.electrons[other]
        for side, one, other in ((down, alone[0], row), (up, alone[1], column))
    ]
    if not any(outshone):
        return Choice(row, column)
    return _single(down, up, (alone[0] if outshone[0] else None, alone[1] if outshone[1] else None))


def consistent_pairs(rig: Rig, stroke_m: float, uv_down_px: Array, uv_up_px: Array) -> BoolArray:
    """Pairs of pixels, (n, 2) and (m, 2), that can show one point, shape (n, m), bool."""
    if len(uv_down_px) == 0 or len(uv_up_px) == 0:
        return np.zeros((len(uv_down_px), len(uv_up_px)), bool)
    curve = epipolar_curve(rig, stroke_m, uv_down_px)
    return np.asarray(_distance(curve, uv_up_px) < NEAR_CURVE_PX)


def epipolar_curve(rig: Rig, stroke_m: float, uv_down_px: Array) -> Array:
    """Images in the up frame of the points seen by pixels of the down frame, shape (n, k, 2), near ones first.

    The points lie at k values of D from `NEAREST_M` to `FARTHEST_M`, even in 1 / D, which is nearly even in pixels.
    """
    q = np.linspace(1.0 / NEAREST_M, 1.0 / FARTHEST_M, _POINTS)
    return up_image(rig, stroke_m, uv_down_px[:, None, :], q).uv_px


def _distance(curve: Array, points: Array) -> Array:
    """Distance of points (m, 2) from polylines (n, k, 2), shape (n, m); infinite where there is no line."""
    start, along = curve[:, None, :-1], np.diff(curve, axis=1)[:, None]
    to = points[None, :, None] - start
    with np.errstate(all="ignore"):
        share = np.clip(np.sum(to * along, axis=-1) / np.sum(along * along, axis=-1), 0.0, 1.0)
        distance = np.linalg.norm(to - share[..., None] * along, axis=-1)
    return np.min(np.where(np.isfinite(distance), distance, np.inf), axis=-1)


def _strongest(side: Candidates, alone: float) -> int | None:
    """Strongest candidate that passes alone."""
    passing = np.flatnonzero(side.z >= alone)
    return int(passing[0]) if passing.size else None


def _single(down: Candidates, up: Candidates, rows: tuple[int | None, int | None]) -> Choice:
    """One candidate, the more significant of two: both could not be one point."""
    if rows[0] is None or rows[1] is None:
        return Choice(rows[0], rows[1])
    # two that are not one point: the more significant one is the spot, the other image has none
    in_down = down.z[rows[0]] >= up.z[rows[1]]
    return Choice(rows[0] if in_down else None, None if in_down else rows[1], apart=True)


# -- detection -------------------------------------------------------------------------------------------------------

RAW = Thresholds(alone=6.2, each=4.8, together=4.8)
PROCESSED = Thresholds(alone=6.8, each=4.6, together=5.5)  # without JPEG 5.6 was the largest of 204 frames' false ones
JPEG = Thresholds(alone=7.5, each=4.6, together=5.5)
PROCESSED_ONE_FRAME = Thresholds(alone=8.5, each=5.0, together=6.5)  # without a laser-off frame
UNSURE = Thresholds(alone=16.0, each=5.0, together=10.0)  # neither filters nor a laser-off frame
_IN_A_BOX = 0.7  # less than in the whole mirror, see above
_SMALL_BOX_PX2 = 10_000  # in larger ones chance finds as much as in the whole mirror
_LEAST_PEAK = 3.8  # of the map: below every threshold, because the fit's own test decides
_MOST_PEAKS = 3000
_MOST_TESTED = 200  # at the second scale
_WIDER = 1.8  # than the blur: a rough mirror's or a saturated spot
_MARGIN_PX = 8  # around the outline: spots at the rim keep their surroundings


@dataclass(frozen=True)
class Detection:
    """A spot that was found in an image.

    Attributes
    ----------
    uv_px : (u, v), at the peak of the matched filter, to about a tenth of a pixel
    electrons : float
        Amplitude behind the red filter (or without filters); too low where pixels are full.
    significance : float
        In standard deviations of the noise.
    """

    uv_px: tuple[float, float]
    electrons: float
    significance: float


@dataclass(frozen=True)
class PairDetection:
    """Both images of a pair; None where there is no spot.

    `apart` tells that each image has one that is sure by itself, but not both of one point: other lights, or a rig that
    differs from the nominal one. The more significant one is taken.
    """

    down: Detection | None
    up: Detection | None
    apart: bool = False


@dataclass(frozen=True)
class _Searched:
    """One image: planes, blur in them, and what passed the tests."""

    on: ColourPlanes
    off: ColourPlanes | None
    sigma_px: float
    found: Candidates


def detect(pair: Pair) -> PairDetection:
    """Find the strongest red laser light that both images agree on.

    A spot in one image only must be more significant than one in both. Boxes of the pair, if there are any, restrict
    the search.

    Raises
    ------
    ValueError
        If an image does not fit the card's output.

    Examples
    --------
    >>> from phibench.estimator.interface import Answer, Pair, Spot
    >>> from phibench.estimator.spots.detect import detect
    >>> def extract(pair: Pair) -> Answer:
    ...     found = detect(pair)
    ...     down, up = (Spot.missing("not seen") if d is None else Spot(d.uv_px) for d in (found.down, found.up))
    ...     return Answer(down, up)  # about a tenth of a pixel; measure finer in a box around d.uv_px
    """
    off = pair.down_off is not None and pair.up_off is not None
    sure = off or pair.card.mosaic == "bayer"
    least = _thresholds(pair.card, sure, off)
    least = _lowered(least) if _is_small(pair.box_down) and _is_small(pair.box_up) else least
    down = _searched(pair, "down", pair.box_down, least)
    up = _searched(pair, "up", pair.box_up, least)
    choice = choose(pair.rig, pair.stroke_m, down.found, up.found, least, sure)
    return _refined(choice, down, up, pair.card)


def _thresholds(card: SensorCard, sure: bool, off: bool) -> Thresholds:
    if not sure:
        return UNSURE
    if card.output == "raw":
        return RAW
    if off:
        return JPEG if card.output == "mjpeg" else PROCESSED
    return PROCESSED_ONE_FRAME


def _is_small(hint: Box | None) -> bool:
    return hint is not None and hint.width_px * hint.height_px <= _SMALL_BOX_PX2


def _lowered(least: Thresholds) -> Thresholds:
    return Thresholds(least.alone - _IN_A_BOX, least.each - _IN_A_BOX, least.together - _IN_A_BOX)


def outline_mask(rig: Rig, box: Box) -> BoolArray:
    """Pixels of a box inside the mirror's outline, shape (h, w)."""
    # a hundred times faster than skimage.draw.polygon for as many corners
    picture = Picture.new("1", (box.width_px, box.height_px))
    outline = rig.outline_px() - [box.u0_px, box.v0_px]
    ImageDraw.Draw(picture).polygon([(float(u), float(v)) for u, v in outline], fill=1)
    return np.asarray(picture, bool)


def mirror_box(rig: Rig) -> Box:
    """Smallest part of the image around the mirror that begins at an even row and column."""
    outline, size = rig.outline_px(), np.array([rig.camera.width_px, rig.camera.height_px])
    # an even corner: the phase of the mosaic stays that of the frame
    low = np.clip(np.floor(outline.min(axis=0)).astype(int) - _MARGIN_PX, 0, size - 2) // 2 * 2
    high = np.clip(np.ceil(outline.max(axis=0)).astype(int) + _MARGIN_PX, low + 2, size)
    return Box(int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1]))


def _searched(pair: Pair, position: str, hint: Box | None, least: Thresholds) -> _Searched:
    card, box, dark = pair.card, mirror_box(pair.rig), pair.images.get(f"{position}_off")
    on = colour_planes(pair.images[position], card, box)
    off = None if dark is None else colour_planes(dark, card, box)
    outline = outline_mask(pair.rig, box)
    halo = lamp_halo(off or on, outline, card, off is not None)
    inside = outline & ~halo
    sigma = blur_of(card, pair.rig.camera.blur_sigma_px)
    counts = pair.count(position), max(pair.count(f"{position}_off"), 1)
    noise = candidate_noise(on, off, card, sigma, inside, counts)
    seen = inside if off is None else outline  # a strong spot beside a lamp is still one
    where = seen if hint is None else seen & _hinted(hint, box)
    places = peaks(on, off, card, sigma, where, _LEAST_PEAK, _MOST_PEAKS).uv_px
    first = candidates_at(on, off, card, places, sigma, noise)
    # a sum, so that no candidates at all give 0
    first = _rows(first, first.z >= np.sort(first.z)[-_MOST_TESTED:][:1].sum())
    best = _better(first, candidates_at(on, off, card, first.uv_px, _WIDER * sigma, noise))
    near = halo[tuple(np.rint(best.uv_px).astype(int).T[::-1])]
    keep = best.red & (best.z >= np.where(near, _IN_HALO * least.alone, least.each))
    return _Searched(on, off, sigma, _moved(_rows(best, keep), box))


def _hinted(hint: Box, box: Box) -> BoolArray:
    mask = np.zeros((box.height_px, box.width_px), bool)
    rows, columns = hint.slices
    v0, u0 = max(rows.start - box.v0_px, 0), max(columns.start - box.u0_px, 0)
    mask[v0 : max(rows.stop - box.v0_px, 0), u0 : max(columns.stop - box.u0_px, 0)] = True
    return mask


def _better(a: Candidates, b: Candidates) -> Candidates:
    """At each place the test of the scale that fits better."""
    first = a.z >= b.z
    return Candidates(
        a.uv_px,
        np.where(first, a.z, b.z),
        a.electrons,  # of one scale everywhere, so that spots can be compared
        a.sigma_e,
        np.where(first, a.chi2, b.chi2),
        a.red,  # the wider one takes more of green's surroundings in
    )


def _rows(tests: Candidates, keep: BoolArray) -> Candidates:
    order = np.flatnonzero(keep)[np.argsort(-tests.electrons[keep], kind="stable")]
    return Candidates(*(getattr(tests, name)[order] for name in tests.__dataclass_fields__))


def _moved(tests: Candidates, box: Box) -> Candidates:
    origin = np.array([box.u0_px, box.v0_px], float)
    values = {name: getattr(tests, name) for name in tests.__dataclass_fields__}
    return Candidates(**{**values, "uv_px": tests.uv_px + origin})


def _refined(choice: Choice, down: _Searched, up: _Searched, card: SensorCard) -> PairDetection:
    return PairDetection(_detection(choice.down, down, card), _detection(choice.up, up, card), choice.apart)


def _detection(index: int | None, searched: _Searched, card: SensorCard) -> Detection | None:
    if index is None:
        return None
    origin = np.array([searched.on.box.u0_px, searched.on.box.v0_px], float)
    uv = parabola_peak(searched, card, searched.found.uv_px[index] - origin) + origin
    found = searched.found
    return Detection((float(uv[0]), float(uv[1])), float(found.electrons[index]), float(found.z[index]))


_PARABOLA_PX = 0.5  # between the places of the parabola


def parabola_peak(searched: _Searched, card: SensorCard, uv_px: Array) -> Array:
    """Vertex of a parabola along u and one along v through A^2 / variance at 3 x 3 places, shape (2,).

    A^2 / variance is twice the gain of the log likelihood, so that on raw pixels the vertex is near its maximum.
    """
    offsets = _PARABOLA_PX * np.stack(np.meshgrid((-1, 0, 1), (-1, 0, 1)), -1).reshape(-1, 2)
    for _ in range(3):
        test = candidates_at(searched.on, searched.off, card, uv_px + offsets, searched.sigma_px)
        # log likelihood of the best flux, but for a factor 2: near its peak a parabola
        gain = (np.maximum(test.electrons, 0.0) / test.sigma_e) ** 2
        best = int(np.argmax(gain))
        if best == len(offsets) // 2:
            break
        uv_px = uv_px + offsets[best]
    grid = gain.reshape(3, 3)
    return uv_px + _PARABOLA_PX * np.array([_vertex(grid[1]), _vertex(grid[:, 1])])


def _vertex(values: Array) -> float:
    """Place of the maximum of a parabola through values at -1, 0, 1; within half a step."""
    left, middle, right = values
    # vertex of the parabola through three places at -1, 0 and 1; a peak bends down
    bend = left - 2.0 * middle + right
    return float(np.clip(0.5 * (left - right) / bend, -0.5, 0.5)) if bend < 0.0 else 0.0
