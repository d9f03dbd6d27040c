"""The likelihood fit of `estimator.fit_raw` as a method, on raw pixels with or without colour filters.

What it takes as known: the card's noise (PRNU and DSNU count as noise), the rig's detector for the filters' response
at the laser line, and the oblique blur that the rig predicts at the pixel (`spot_blur`), with the beam's size once the
pair's distance is known. A rough mirror's blur is not predicted: there the width is fitted as well. The room behind is
the laser-off frame, smoothed as far as it is flat (`base_image`); without one it is a level per filter, or, where that
does not describe it, what surrounds the spot. A misfit that is left widens the covariance.
"""

from __future__ import annotations

import math

import numpy as np

from phibench.estimator.base_image import BaseImage, around, base_of
from phibench.estimator.fit_raw import SpotFit, fit_law
from phibench.estimator.methods.beam_size import pair_blur
from phibench.estimator.methods.sight import Sight
from phibench.estimator.pixel_law import GaussLaw
from phibench.estimator.raw_pixels import PixelNoise, noise_of, raw_electrons
from phibench.estimator.seat.pair import Spot
from phibench.estimator.status import Status, describe
from phibench.scenes.frames import Array

_FLAT_SIGMAS = 4.0  # by which the chi2 of a fit with flat levels must exceed 1 for the room to have structure
_MISFIT_SIGMAS = 3.0  # by which the fit's chi2 must exceed 1 before its covariance is widened


def raw_maximum_likelihood(sight: Sight) -> Spot:
    """Position and covariance by maximum likelihood on 15 x 15 raw pixels around the red peak."""
    try:
        noise = noise_of(sight.pair.card)
    except ValueError:
        return Spot.missing("the fit needs shot noise and no row noise")
    near = sight.narrowed()
    if near is None:
        return Spot.missing("no spot")
    x = raw_electrons(near.pixels, sight.pair.card)[None]
    flat = _fit(near, x, noise, None)
    if (
        near.off_pixels is None
        and flat.status[0] == Status.OK
        and flat.chi2[0] < 1.0 + _FLAT_SIGMAS * math.sqrt(2.0 / x.size)
    ):
        return _spot(flat, x.size)
    based = _fit(near, x, noise, _base(near, x, noise, flat))
    return _spot(based if based.status[0] == Status.OK else flat, x.size)


def _fit(near: Sight, x: Array, noise: PixelNoise, base: BaseImage | None) -> SpotFit:
    """Fit with a known background, or with a level per filter."""
    card, rig = near.pair.card, near.pair.rig
    u0, v0 = near.origin_px
    blur = pair_blur(near.pair, (u0 + near.box.width_px // 2, v0 + near.box.height_px // 2), near.depth_m)
    r, g, b = rig.camera.detector.laser_filter_response
    return fit_law(
        x,
        near.origin_px,
        GaussLaw(noise, 0.0 if base is None else base.variance_e2),
        blur.sigma_px,
        (r, g, b) if card.mosaic == "bayer" else None,
        None if base is None else base.mean_e,
        rig.mirror.roughness_alpha > 0.0,
        x < card.full_from_e,
        blur.ratio,
        blur.mixed_px2,
    )


def _base(near: Sight, x: Array, noise: PixelNoise, flat: SpotFit) -> BaseImage:
    """Room of the laser-off frame; without one, of the pixels around the spot."""
    off = near.off_pixels
    if off is not None:
        electrons = raw_electrons(off, near.pair.card)[None]
        return base_of(electrons, noise.variance_e2(electrons), np.ones(x.shape))
    origin = np.array([near.origin_px], float)
    middle = origin + (np.array([x.shape[2], x.shape[1]]) - 1.0) / 2.0
    uv = np.where(np.isfinite(flat.uv_px), flat.uv_px, middle)
    return base_of(x, noise.variance_e2(x), around(uv, origin, (x.shape[1], x.shape[2])))


def _spot(fit: SpotFit, count: int) -> Spot:
    status = Status(int(fit.status[0]))
    if status is not Status.OK:
        return Spot.missing(describe(status))
    # a room that the model does not follow shows in chi2; the claim is widened by it, as for any fit of least squares
    chi2 = float(fit.chi2[0])
    widened = chi2 if chi2 > 1.0 + _MISFIT_SIGMAS * math.sqrt(2.0 / count) else 1.0
    (a, b), (c, d) = (widened * fit.covariance_px2[0]).tolist()
    return Spot((float(fit.uv_px[0, 0]), float(fit.uv_px[0, 1])), ((a, b), (c, d)))
