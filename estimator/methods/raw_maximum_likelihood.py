"""The likelihood fit of `estimator.fit_raw` as a method, on raw pixels with or without colour filters.

What it takes as known: the card's noise (PRNU and DSNU count as noise), the rig's detector for the filters' response
at the laser line, and the blur that the rig predicts at the pixel (`spot_blur`). A rough mirror's blur is not
predicted: there the width is fitted as well. Where the room behind the spot is not flat, chi2 widens the covariance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from phibench.estimator.fit_raw import SpotFit, fit_raw
from phibench.estimator.methods.sight import Sight
from phibench.estimator.raw_pixels import PixelNoise, bayer_filters, noise_of, raw_electrons
from phibench.estimator.seat.pair import Spot
from phibench.estimator.spot_blur import spot_blur
from phibench.estimator.status import Status, describe
from phibench.scenes.frames import Array

_STRUCTURE_SIGMAS = 4.0  # by which the off frame's chi2 must exceed that of a flat room
_MISFIT_SIGMAS = 3.0  # by which the fit's chi2 must exceed 1 before its covariance is widened


@dataclass(frozen=True)
class _Background:
    """Known background, shape (h, w), electrons, and what its own noise adds; or none, and levels are fitted."""

    electrons: Array | None
    noise: PixelNoise


def raw_maximum_likelihood(sight: Sight) -> Spot:
    """Position and covariance by maximum likelihood on 15 x 15 raw pixels around the red peak."""
    card, rig = sight.pair.card, sight.pair.rig
    try:
        noise = noise_of(card)
    except ValueError:
        return Spot.missing("the fit needs shot noise and no row noise")
    near = sight.narrowed()
    if near is None:
        return Spot.missing("no spot")
    middle = (near.box.u0_px + near.box.width_px // 2, near.box.v0_px + near.box.height_px // 2)
    sigma = spot_blur(rig, middle).round_px
    response = rig.camera.detector.laser_filter_response if card.mosaic == "bayer" else None
    background = _background(near, noise)
    fit = fit_raw(
        raw_electrons(near.pixels, card)[None],
        near.origin_px,
        background.noise,
        sigma,
        None if response is None else (response[0], response[1], response[2]),
        background.electrons,
        rig.mirror.roughness_alpha > 0.0,
        card.saturation_e,
    )
    return _spot(fit, near.pixels.size)


def _background(near: Sight, noise: PixelNoise) -> _Background:
    """Off frame as known background where the room behind the spot has structure; otherwise levels per filter.

    One off frame brings its own noise, which costs more than fitting three levels to a flat room. Its chi2 about those
    levels tells which it is.
    """
    off = near.off_pixels
    if off is None:
        return _Background(None, noise)
    electrons = raw_electrons(off, near.pair.card)
    levels = _levels(near, electrons)
    count = electrons.size
    chi2 = float(np.mean((electrons - levels) ** 2 / noise.variance_e2(levels)))
    if chi2 < 1.0 + _STRUCTURE_SIGMAS * np.sqrt(2.0 / count):
        return _Background(None, noise)
    added = float(np.max(noise.variance_e2(levels)))  # that of the red pixels, which tell where the spot is
    return _Background(electrons, replace(noise, gaussian_e2=noise.gaussian_e2 + added))


def _levels(near: Sight, electrons: Array) -> Array:
    """Mean of the off frame per filter, at each pixel."""
    if near.pair.card.mosaic == "mono":
        return np.full(electrons.shape, electrons.mean())
    filters = bayer_filters(np.array([near.origin_px]), (electrons.shape[0], electrons.shape[1]))[0]
    means = np.array([electrons[filters == colour].mean() for colour in range(3)])
    return means[filters]


def _spot(fit: SpotFit, count: int) -> Spot:
    status = Status(int(fit.status[0]))
    if status is not Status.OK:
        return Spot.missing(describe(status))
    # a room that the model does not follow shows in chi2; the claim is widened by it, as for any fit of least squares
    chi2 = float(fit.chi2[0])
    widened = chi2 if chi2 > 1.0 + _MISFIT_SIGMAS * math.sqrt(2.0 / count) else 1.0
    (a, b), (c, d) = (widened * fit.covariance_px2[0]).tolist()
    return Spot((float(fit.uv_px[0, 0]), float(fit.uv_px[0, 1])), ((a, b), (c, d)))
