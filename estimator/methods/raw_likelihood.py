"""Built-in method `raw_maximum_likelihood`: each spot fitted by itself on raw pixels; pixels with noise for other fits.

`raw_maximum_likelihood` takes as known the card's noise (PRNU and DSNU count as noise), the rig's detector for the
filters' response at the laser line, and the oblique blur that the rig predicts at the pixel (`spot_blur`), with the
beam's size once the pair's distance is known. A rough mirror's blur is not predicted: there the width is fitted as
well. The room behind is the laser-off frame, smoothed as far as it is flat (`background_of`). Without one it is a level
per filter, or, where that does not describe it, what surrounds the spot. A misfit that is left widens the covariance.

Several frames: means are fitted. Photons, read noise and rounding fall with their number; what frames share does not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from phibench.datasets.frames.sensor_card import SensorCard
from phibench.estimator.geometry.status import Status, describe
from phibench.estimator.interface import Answer, Image, Pair, Spot
from phibench.estimator.methods.likelihood_maps import claimed_px2, pixels_likelihood
from phibench.estimator.methods.spot_search import SearchRegion, at_detection, each_spot_twice, once, pair_blur
from phibench.estimator.spots.fit_raw import MISFIT_SIGMAS, SpotData, SpotFit, fit_law, spot_data
from phibench.estimator.spots.gaussian_spot import SpotModel
from phibench.estimator.spots.raw_pixels import (
    Background,
    GaussLaw,
    PatternNoise,
    PixelNoise,
    background_of,
    noise_of,
    outside_spot,
    raw_electrons,
    spot_regions,
)
from phibench.scenes.frames import Array

_FLAT_SIGMAS = 4.0  # by which the chi2 of a fit with flat levels must exceed 1 for the room to have structure
_SHOT_SIGMAS = 4.0  # of a full pixel in one frame, by which the mean of several must be below it
_SIDE_PX = {True: 15, False: 9}  # with a laser-off frame, and without: a level is flat over a few pixels only


def raw_maximum_likelihood(region: SearchRegion) -> Spot:
    """Position and covariance by maximum likelihood on 15 x 15 raw pixels about the place of the spot.

    The covariance of a faint spot is that of its posterior about the fit's place: the mosaic has other places for it.
    Of a spot that was seen but gives no fit there, it is the place of the matched filter, without covariance; of one
    with too few pixels that are not full it is nothing.
    """
    try:
        noise = noise_of(region.pair.card, pattern_known=True)
    except ValueError:
        return Spot.missing("the fit needs shot noise and no row noise")
    place = region.place
    near = region.window_at(place)
    if near is None or place is None:
        return Spot.missing("no spot")
    x, start = raw_electrons(near.pixels, region.pair.card)[None], np.add(place, region.origin_px)
    flat, data = _fit(near, x, noise, None, start)
    fit, good = flat, flat.status[0] == Status.OK
    if near.off_pixels is not None or not good or flat.chi2[0] >= 1.0 + _FLAT_SIGMAS * math.sqrt(2.0 / x.size):
        structured, over_room = _fit(near, x, noise, _background(near, x, noise, flat), start)
        if structured.status[0] == Status.OK:
            fit, data = structured, over_room
    spot = _fitted_spot(fit, data)
    return spot if fit.status[0] == Status.SATURATED else at_detection(region.found, spot)


def _fit(
    near: SearchRegion, x: Array, noise: PixelNoise, background: Background | None, start: Array
) -> tuple[SpotFit, SpotData]:
    """Fit from a place (u, v) of the image, with a known background or with a level per filter; and its pixels."""
    card, rig = near.pair.card, near.pair.rig
    u0, v0 = near.origin_px
    blur = pair_blur(near.pair, (u0 + near.box.width_px // 2, v0 + near.box.height_px // 2), near.depth_m)
    rough = rig.mirror.roughness_alpha > 0.0
    model = SpotModel(_response(near.pair), None if background is None else background.mean_e, rough)
    pattern, frames = PatternNoise.of(card), near.frames[0]
    law = (
        GaussLaw(noise, pattern.dsnu_e2, frames, pattern.prnu)
        if background is None
        else GaussLaw(noise, background.variance_e2, frames, pattern.prnu, background.mean_e)
    )
    regions = spot_regions(x, near.origin_px, x < _full_from_e(card, frames))
    return fit_law(regions, law, blur, model, start), spot_data(regions, law, blur, model)


def _full_from_e(card: SensorCard, frames: int) -> float:
    """Mean of frames from which on one of them may be full; of one frame it is seen."""
    return card.full_from_e - (_SHOT_SIGMAS * math.sqrt(max(card.full_from_e, 0.0)) if frames > 1 else 0.0)


def _response(pair: Pair) -> tuple[float, float, float] | None:
    """Response of the filters at the laser line; None without filters."""
    r, g, b = pair.rig.camera.detector.laser_filter_response
    return (r, g, b) if pair.card.mosaic == "bayer" else None


def _background(near: SearchRegion, x: Array, noise: PixelNoise, flat: SpotFit) -> Background:
    """Room of the laser-off frame; without one, of the pixels around the spot."""
    off, pattern, frames = near.off_pixels, PatternNoise.of(near.pair.card), near.frames
    if off is not None:
        electrons = raw_electrons(off, near.pair.card)[None]
        return background_of(electrons, noise.variance_e2(electrons) / frames[1], np.ones(x.shape), pattern)
    origin = np.array([near.origin_px], float)
    middle = origin + (np.array([x.shape[2], x.shape[1]]) - 1.0) / 2.0
    uv = np.where(np.isfinite(flat.uv_px), flat.uv_px, middle)
    return background_of(
        x, noise.variance_e2(x) / frames[0], outside_spot(uv, origin, (x.shape[1], x.shape[2])), pattern
    )


def _fitted_spot(fit: SpotFit, data: SpotData) -> Spot:
    status = Status(int(fit.status[0]))
    if status is not Status.OK:
        return Spot.missing(describe(status))
    chi2, covariance = float(fit.chi2[0]), fit.covariance_px2[0]
    if not data.pixels.free_width:
        covariance = claimed_px2(fit.uv_px[0], covariance, lambda: pixels_likelihood(data, fit.uv_px[0]))
    if covariance is None:
        return Spot((float(fit.uv_px[0, 0]), float(fit.uv_px[0, 1])))
    if chi2 > 1.0 + MISFIT_SIGMAS * math.sqrt(2.0 / data.regions.x_e.size):
        # a room that the model does not follow misfits everywhere: the claim is widened by chi2, as for any fit of
        # least squares; a light of another shape, such as a spot on an edge, misfits on the few pixels that place it
        covariance = max(chi2 * covariance, fit.misfit_px2[0], key=np.trace)
    (a, b), (c, d) = covariance.tolist()
    return Spot((float(fit.uv_px[0, 0]), float(fit.uv_px[0, 1])), ((a, b), (c, d)))


_each = each_spot_twice(raw_maximum_likelihood)


def raw_likelihood(pair: Pair) -> Answer:
    """Both spots by `raw_maximum_likelihood`, each by itself."""
    return once(pair, "raw_maximum_likelihood", _each)


def raw_spot_data(pair: Pair, position: str, start: Array, depth_m: float | None) -> SpotData:
    """Square of raw pixels around a start, moved inside the image, with the model of a spot there.

    Pixels are the mean of the frames, less that of frames with the laser off: the spot is left. The room, as each
    pixel of this camera sees it, has the noise of both means; PRNU counts for the spot alone.
    """
    card, near = pair.card, _around(pair, position, start)
    noise, pattern, frames = noise_of(card, pattern_known=True), PatternNoise.of(card), pair.count(position)
    x = raw_electrons(near.on, card)[None]
    used = x < _full_from_e(card, frames)
    law = GaussLaw(noise, pattern.dsnu_e2, frames, pattern.prnu)
    if near.off is not None:
        off, count = raw_electrons(near.off, card)[None], pair.count(f"{position}_off")
        room = np.maximum(background_of(off, noise.variance_e2(off) / count, np.ones(off.shape), pattern).mean_e, 0.0)
        x, law = x - off, replace(law, extra_e2=room / frames + noise.variance_e2(room) / count)
    blur = pair_blur(pair, start, depth_m)
    return spot_data(spot_regions(np.where(used, x, 0.0), near.corner_px, used), law, blur, SpotModel(_response(pair)))


def over_known_room(pair: Pair, position: str, start: Array, depth_m: float | None) -> SpotData:
    """Square of raw pixels around a start, over the room that the laser-off frame shows, smoothed where it is flat.

    On - off, as the joint fit takes it, has the noise of both frames: errors are then 1.2 times as large.
    """
    card, near = pair.card, _around(pair, position, start)
    if near.off is None:
        return raw_spot_data(pair, position, start, depth_m)
    noise, pattern, frames = noise_of(card, pattern_known=True), PatternNoise.of(card), pair.count(position)
    x, off = raw_electrons(near.on, card)[None], raw_electrons(near.off, card)[None]
    variance = noise.variance_e2(off) / pair.count(f"{position}_off")
    room = background_of(off, variance, np.ones(off.shape), pattern)
    law = GaussLaw(noise, room.variance_e2, frames, pattern.prnu, room.mean_e)
    regions = spot_regions(x, near.corner_px, x < _full_from_e(card, frames))
    return spot_data(regions, law, pair_blur(pair, start, depth_m), SpotModel(_response(pair), room.mean_e))


@dataclass(frozen=True)
class _Square:
    """Pixels around a place, shape (n, n), with the laser on and off, and the image pixel (u, v) of their corner."""

    on: Image
    off: Image | None
    corner_px: tuple[int, int]


def _around(pair: Pair, position: str, start: Array) -> _Square:
    """Square of pixels around a place, moved inside the image; wider where there is a laser-off frame."""
    image, dark = pair.images[position], pair.images.get(f"{position}_off")
    height, width = image.shape
    side = _SIDE_PX[dark is not None]
    u0 = min(max(round(start[0]) - side // 2, 0), max(width - side, 0))
    v0 = min(max(round(start[1]) - side // 2, 0), max(height - side, 0))
    window = (slice(v0, v0 + side), slice(u0, u0 + side))
    return _Square(image[window], None if dark is None else dark[window], (u0, v0))
