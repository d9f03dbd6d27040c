"""Seat method `joint_fit`: detection, then both images together under the epipolar constraint.

Raw outputs: `fit_joint`. With laser-off frames the fit sees on - off + the usual level of off, and the off frame's
noise is added to the on frame's; without them a level per filter is fitted. Processed outputs: the positions of the
matched filter, combined by least squares with the errors that their significance stands for; better positions, with
their covariances, go through `combine` in the same way.
"""

from __future__ import annotations

import numpy as np

from phibench.datasets.sensor_card import SensorCard
from phibench.estimator.combine import combine
from phibench.estimator.detect import Detection, detect
from phibench.estimator.fit_joint import fit_joint
from phibench.estimator.fit_raw import LASER_RESPONSE
from phibench.estimator.raw_pixels import PixelNoise, noise_of, raw_electrons
from phibench.estimator.seat.pair import Answer, Image, Matrix2, Pair, Spot
from phibench.estimator.spot_likelihood import SpotRegions, spot_regions
from phibench.estimator.status import Status, describe
from phibench.scenes.frames import Array

_SIDE_PX = {True: 15, False: 9}  # with a laser-off frame, and without: a level is flat over a few pixels only
_FLOOR_PX = 0.2  # of a matched filter's position after interpolation between colours


def joint_fit(pair: Pair) -> Answer:
    """Positions and depth of a pair; positions alone where one image has no spot or the two are not one point."""
    found = detect(pair)
    if found.down is None or found.up is None:
        return Answer(_alone(found.down), _alone(found.up))
    if pair.card.output == "raw":
        return _raw(pair, found.down, found.up)
    return _processed(pair, found.down, found.up)


def _raw(pair: Pair, down: Detection, up: Detection) -> Answer:
    first = _region(pair.down, pair.down_off, pair, down)
    second = _region(pair.up, pair.up_off, pair, up)
    start = (np.array([down.uv_px]), np.array([up.uv_px]))
    fit = fit_joint(pair.rig, pair.stroke_m, first, second, *start)
    status = int(fit.status[0])
    if status != Status.OK:
        return Answer(Spot.missing(describe(status)), Spot.missing(describe(status)))
    return Answer(
        _spot(fit.uv_down_px[0], fit.covariance_down_px2[0]),
        _spot(fit.uv_up_px[0], fit.covariance_up_px2[0]),
        float(fit.depth_m[0]),
        float(fit.sigma_m[0]),
    )


def _processed(pair: Pair, down: Detection, up: Detection) -> Answer:
    blur = pair.rig.camera.blur_sigma_px
    C = [np.eye(2)[None] * (_FLOOR_PX**2 + (blur / found.significance) ** 2) for found in (down, up)]
    uv = (np.array([down.uv_px]), np.array([up.uv_px]))
    best = combine(pair.rig, pair.stroke_m, uv[0], C[0], uv[1], C[1])
    if int(best.status[0]) != Status.OK:
        return Answer(_alone(down), _alone(up))
    return Answer(
        _spot(best.uv_down_px[0], best.covariance_down_px2[0]),
        _spot(best.uv_up_px[0], best.covariance_up_px2[0]),
        float(best.depth_m[0]),
        float(best.sigma_m[0]),
    )


def _region(image: Image, dark: Image | None, pair: Pair, found: Detection) -> SpotRegions:
    """Square around a detection, moved inside the image."""
    height, width = image.shape
    side = _SIDE_PX[dark is not None]
    u0 = min(max(round(found.uv_px[0]) - side // 2, 0), max(width - side, 0))
    v0 = min(max(round(found.uv_px[1]) - side // 2, 0), max(height - side, 0))
    window = (slice(v0, v0 + side), slice(u0, u0 + side))
    x, extra = raw_electrons(image[window], pair.card), np.zeros((1, 1, 1))
    x = np.where(x < pair.card.saturation_e, x, np.nan)
    if dark is not None:
        off = raw_electrons(dark[window], pair.card)
        level = float(np.median(off))
        x, extra = x - off + level, _variance(off, pair.card)[None]
    response = LASER_RESPONSE if pair.card.mosaic == "bayer" else None
    sigma = pair.rig.camera.blur_sigma_px
    return spot_regions(x[None], (u0, v0), noise_of(pair.card), sigma, response, extra_e2=extra)


def _variance(off_e: Array, card: SensorCard) -> Array:
    """Noise of the off frame's pixels; of the fixed pattern, which cancels, nothing."""
    noise: PixelNoise = noise_of(card, pattern_known=True)
    return noise.variance_e2(off_e)


def _spot(uv_px: Array, covariance_px2: Array) -> Spot:
    (a, b), (c, d) = covariance_px2.tolist()
    matrix: Matrix2 = ((a, b), (c, d))
    return Spot((float(uv_px[0]), float(uv_px[1])), matrix)


def _alone(found: Detection | None) -> Spot:
    return Spot.missing("no spot found") if found is None else Spot(found.uv_px)
