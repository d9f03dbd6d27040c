"""Faint spots on raw Bayer pixels, in places drawn evenly over the mosaic's cell, and what their fits claim."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from phibench.estimator.geometry.joint_posterior import single_posterior
from phibench.estimator.geometry.status import Status
from phibench.estimator.methods.likelihood_maps import claimed_px2, likelihood_map, pixels_likelihood
from phibench.estimator.spots.fit_raw import fit_law, spot_data
from phibench.estimator.spots.gaussian_spot import SpotBlur, SpotModel, SpotPixels
from phibench.estimator.spots.raw_pixels import GaussLaw, PixelNoise, bayer_filters, spot_regions
from phibench.scenes.random_streams import generator

SIDE, READ_E, ORIGIN = 15, 4.0, np.array([[100, 200]])
SEEN_PX = 0.35  # of `detect`, one coordinate
RESPONSE = (1.0, 0.1, 0.03)


@dataclass(frozen=True)
class FaintSpots:
    """Squared errors over claims, shape (n,): by the fit's curvature, by `claimed_px2`, of the posterior's mean.

    Attributes
    ----------
    answers : int
    apart_px : shape (n,), distance of the fit from the truth
    unclaimed : int
        Fits whose posterior has no end.
    """

    curvature: np.ndarray
    claimed: np.ndarray
    posterior: np.ndarray
    apart_px: np.ndarray
    unclaimed: int


def faint_spots(snr: float, sigma_px: float, room_e: float, count: int) -> FaintSpots:
    """Fits of `count` spots of one signal to noise over a known flat room."""
    rng, law = generator("faint", round(10 * snr), f"{sigma_px} {room_e}"), GaussLaw(PixelNoise(READ_E**2))
    room = np.full((1, SIDE, SIDE), room_e)
    blur, model = SpotBlur(sigma_px), SpotModel(RESPONSE, room)
    pixels = SpotPixels.of(bayer_filters(ORIGIN, (SIDE, SIDE)), blur, model)
    rows, apart, unclaimed = [], [], 0
    for _ in range(count):
        place = SIDE // 2 + rng.uniform(-1.0, 1.0, 2)
        share = pixels.at(np.array([[*place, 1.0]]))[0] - room
        mean = room + _flux_e(share, room_e, snr) * share
        x = rng.poisson(mean) + rng.normal(0.0, READ_E, mean.shape)
        truth = place + ORIGIN[0]
        regions = spot_regions(x, ORIGIN)
        fit = fit_law(regions, law, blur, model, truth + rng.normal(0.0, SEEN_PX, 2))
        if fit.status[0] != Status.OK:
            continue
        uv, C = fit.uv_px[0], fit.covariance_px2[0]
        one = pixels_likelihood(spot_data(regions, law, blur, model), uv)
        claim, places = claimed_px2(uv, C, lambda one=one: one), likelihood_map(one)
        found = None if places is None else single_posterior(places)
        apart.append(np.hypot(*(uv - truth)))
        if claim is None or found is None:
            unclaimed += 1
            continue
        rows.append(
            [e @ np.linalg.solve(M, e) for e, M in ((uv - truth, C), (uv - truth, claim), (found[0] - truth, found[1]))]
        )
    return FaintSpots(*np.array(rows).reshape(-1, 3).T, np.array(apart), unclaimed)


def _flux_e(share: np.ndarray, room_e: float, snr: float) -> float:
    """Flux with which 2 (sqrt(b + s) - sqrt(b)), read noise in b, has this length over the pixels."""
    flux, dark = snr * np.sqrt(room_e + READ_E**2) / float(np.linalg.norm(share)), room_e + READ_E**2
    for _ in range(30):
        flux *= snr / float(np.linalg.norm(2.0 * (np.sqrt(dark + flux * share) - np.sqrt(dark))))
    return float(flux)
