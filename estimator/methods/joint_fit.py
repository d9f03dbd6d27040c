"""Built-in method: both spots as images of one point of the room.

Each image is first fitted by itself: raw pixels by `raw_maximum_likelihood`, processed ones by `chain_fit`. Raw pixels
are then fitted together (`fit_joint`): with laser-off frames the fit sees on - off + the usual level of off, and the
off frame's noise is added to the on frame's; without them a level per filter is fitted. Of processed pixels the two
positions are combined by their covariances (`combine`), which is the same where both are Gaussian. Where the two are
not one point, the separate answer stands, without a depth of its own.
"""

from __future__ import annotations

import numpy as np

from phibench.datasets.sensor_card import SensorCard
from phibench.estimator.combine import CombinedEstimate, combine
from phibench.estimator.fit_joint import JointFit, fit_joint
from phibench.estimator.methods.beam_size import pair_blur, seen_depth_m
from phibench.estimator.methods.chain_fit import chain_fit
from phibench.estimator.methods.raw_maximum_likelihood import raw_maximum_likelihood
from phibench.estimator.methods.sight import each_spot_twice
from phibench.estimator.raw_pixels import PixelNoise, noise_of, raw_electrons
from phibench.estimator.seat.pair import Answer, Image, Matrix2, Pair, Spot
from phibench.estimator.spot_likelihood import SpotRegions, spot_regions
from phibench.estimator.status import Status
from phibench.scenes.frames import Array

_SIDE_PX = {True: 15, False: 9}  # with a laser-off frame, and without: a level is flat over a few pixels only
_MOST_CHI2 = 24.0  # of one degree of freedom: 1e-6 by chance

_each = each_spot_twice(raw_maximum_likelihood)


def joint_fit(pair: Pair) -> Answer:
    """Positions and depth of a pair; the separate answers where one image has no spot or the two are not one point."""
    return joint_of(pair, _each(pair) if pair.card.output == "raw" else chain_fit(pair))


def joint_of(pair: Pair, separate: Answer) -> Answer:
    """Answer for both images together, from that for each by itself: `raw_maximum_likelihood`'s or `chain_fit`'s."""
    if separate.down.uv_px is None or separate.up.uv_px is None:
        return separate
    return (_raw if pair.card.output == "raw" else _processed)(pair, separate)


def _raw(pair: Pair, separate: Answer) -> Answer:
    starts = [np.array([spot.uv_px], float) for spot in (separate.down, separate.up)]
    images = ((pair.down, pair.down_off), (pair.up, pair.up_off))
    depth_m = seen_depth_m(pair, separate)
    down, up = (_region(*image, pair, start[0], depth_m) for image, start in zip(images, starts, strict=True))
    return _answer(fit_joint(pair.rig, pair.stroke_m, down, up, *starts), separate)


def _processed(pair: Pair, separate: Answer) -> Answer:
    if separate.down.covariance_px2 is None or separate.up.covariance_px2 is None:
        return separate
    (uv1, C1), (uv2, C2) = (
        (np.array([spot.uv_px], float), np.array([spot.covariance_px2], float)) for spot in (separate.down, separate.up)
    )
    return _answer(combine(pair.rig, pair.stroke_m, uv1, C1, uv2, C2), separate)


def _answer(found: JointFit | CombinedEstimate, separate: Answer) -> Answer:
    if int(found.status[0]) != Status.OK or not found.chi2[0] < _MOST_CHI2:
        return separate
    return Answer(
        _spot(found.uv_down_px[0], found.covariance_down_px2[0]),
        _spot(found.uv_up_px[0], found.covariance_up_px2[0]),
        float(found.depth_m[0]),
        float(found.sigma_m[0]),
    )


def _region(image: Image, dark: Image | None, pair: Pair, start: Array, depth_m: float | None) -> SpotRegions:
    """Square around a start, moved inside the image."""
    height, width = image.shape
    side = _SIDE_PX[dark is not None]
    u0 = min(max(round(start[0]) - side // 2, 0), max(width - side, 0))
    v0 = min(max(round(start[1]) - side // 2, 0), max(height - side, 0))
    window = (slice(v0, v0 + side), slice(u0, u0 + side))
    x, extra = raw_electrons(image[window], pair.card), np.zeros((1, 1, 1))
    x = np.where(x < pair.card.full_from_e, x, np.nan)
    if dark is not None:
        off = raw_electrons(dark[window], pair.card)
        x, extra = x - off + float(np.median(off)), _variance(off, pair.card)[None]
    r, g, b = pair.rig.camera.detector.laser_filter_response
    response = (r, g, b) if pair.card.mosaic == "bayer" else None
    blur, noise = pair_blur(pair, start, depth_m), noise_of(pair.card)
    shape = {"ratio": blur.ratio, "mixed_px2": blur.mixed_px2}
    return spot_regions(x[None], (u0, v0), noise, blur.sigma_px, response, extra_e2=extra, **shape)


def _variance(off_e: Array, card: SensorCard) -> Array:
    """Noise of the off frame's pixels; of the fixed pattern, which cancels, nothing."""
    noise: PixelNoise = noise_of(card, pattern_known=True)
    return noise.variance_e2(off_e)


def _spot(uv_px: Array, covariance_px2: Array) -> Spot:
    (a, b), (c, d) = covariance_px2.tolist()
    matrix: Matrix2 = ((a, b), (c, d))
    return Spot((float(uv_px[0]), float(uv_px[1])), matrix)
