"""The theoretical limit: how well u, v, phi and D of one spot can be known.

Unknowns besides u, v: the spot's flux (laser, albedo and speckle are not known to a per cent), and the background, one
level per colour filter, because the colour of the room's light behind the spot is not known; with the laser-off frame
in hand it may count as known. Speckle flicker scales the whole spot and is covered by the unknown flux.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from phibench.datasets.expected import ExpectedRegion
from phibench.datasets.sensor_card import SensorCard
from phibench.estimator.fisher import covariance_bound, fisher_matrix
from phibench.estimator.phi import PhiEstimate, estimate_phi
from phibench.estimator.pixel_information import approximate_information, exact_information, quantised_information
from phibench.estimator.raw_pixels import noise_of
from phibench.estimator.rig_errors import rig_gradient
from phibench.estimator.status import StatusArray
from phibench.estimator.triangulate import depth_exact
from phibench.scenes.frames import Array
from phibench.scenes.names import nearest
from phibench.scenes.rig import Rig, View

Unknown = Literal["position", "flux", "flux+background"]
NoiseModel = Literal["approximate", "exact", "quantised"]
UNKNOWNS: tuple[Unknown, ...] = ("position", "flux", "flux+background")
NOISE_MODELS: tuple[NoiseModel, ...] = ("approximate", "exact", "quantised")


@dataclass(frozen=True)
class SpotLimit:
    """Bound of one spot.

    Attributes
    ----------
    covariance_px2 : shape (2, 2), of (u, v); NaN where the pixels cannot tell
    fisher : shape (k, k), by u, v, relative flux, background levels in electrons, as far as they are unknown
    """

    covariance_px2: Array
    fisher: Array

    @property
    def rms_px(self) -> float:
        """Root of the mean variance of u and v."""
        return float(np.sqrt(np.trace(self.covariance_px2) / 2.0))


@dataclass(frozen=True)
class DepthLimit:
    """Bound of D, shape (...), in its two parts, which add in squares.

    Attributes
    ----------
    depth_m : shape (...)
    sigma_spot_m : shape (...)
        From the pixels' noise: sqrt(g^T F^-1 g).
    sigma_calibration_m : shape (...)
        From what is not known of the rig: sqrt(g_c^T Sigma_c g_c).
    gradient : shape (..., p)
        g_c, dD by each of `rig_errors.RIG_PARAMETERS`, metres per its unit.
    status : shape (...), values of `Status`
    """

    depth_m: Array
    sigma_spot_m: Array
    sigma_calibration_m: Array
    gradient: Array
    status: StatusArray

    @property
    def sigma_m(self) -> Array:
        """Both parts together."""
        return np.hypot(self.sigma_spot_m, self.sigma_calibration_m)


def spot_limit(
    region: ExpectedRegion,
    card: SensorCard,
    unknown: Unknown = "flux+background",
    model: NoiseModel = "approximate",
    pattern_known: bool = False,
) -> SpotLimit:
    """Cramer-Rao bound of a spot's position on raw pixels.

    Parameters
    ----------
    region : ExpectedRegion
    card : SensorCard
    unknown : "position", "flux" or "flux+background"
        What is unknown: the position alone, the flux too, or the background levels too.
    model : "approximate", "exact" or "quantised"
        Noise: 1 / variance with all terms; Poisson and Gauss exactly, the rounding as Gaussian; the converter's codes.
        The last two leave PRNU out.
    pattern_known : bool
        Whether the camera's PRNU and DSNU are calibrated.
    """
    information = _information(region.mean_e, card, model, pattern_known)
    return limit_of(derivative_images(region, unknown), information)


def limit_of(derivatives: Array, information: Array) -> SpotLimit:
    """Bound from derivative images, shape (k, h, w), u and v first, and the pixels' information, shape (h, w)."""
    fisher = fisher_matrix(derivatives, information)
    return SpotLimit(covariance_bound(fisher), fisher)


def derivative_images(region: ExpectedRegion, unknown: Unknown = "flux+background") -> Array:
    """Derivatives of the mean by u, v, relative flux and the background of each filter, shape (k, h, w)."""
    if unknown not in UNKNOWNS:
        raise ValueError(f"unknown '{unknown}': {nearest(unknown, UNKNOWNS)}")
    images = [region.du_e_per_px, region.dv_e_per_px]
    if unknown != "position":
        images.append(region.spot_e)
    if unknown == "flux+background":
        images += [(region.filters == colour).astype(float) for colour in np.unique(region.filters)]
    return np.stack(images)


def phi_limit(view: View, uv_px: ArrayLike, limit: SpotLimit, convention: str = "ray") -> PhiEstimate:
    """Phi at a pixel with the bound of its variance, g C g^T."""
    return estimate_phi(convention, view, np.asarray(uv_px, float), limit.covariance_px2)


def depth_limit(
    rig: Rig,
    stroke_m: ArrayLike,
    uv_down_px: Array,
    uv_up_px: Array,
    covariance_down_px2: Array,
    covariance_up_px2: Array,
    covariance_rig: Array,
) -> DepthLimit:
    """Bound of D in its two parts, to first order.

    Parameters
    ----------
    rig, stroke_m, uv_down_px, uv_up_px, covariance_down_px2, covariance_up_px2
        As for `triangulate.depth_exact`; the covariances are bounds of (u, v).
    covariance_rig : shape (p, p)
        Of the calibration's parameters, see `rig_errors.rig_covariance`.
    """
    spot = depth_exact(rig, stroke_m, uv_down_px, uv_up_px, covariance_down_px2, covariance_up_px2)
    g = rig_gradient(rig, stroke_m, uv_down_px, uv_up_px)
    calibration = np.sqrt(np.einsum("...i,ij,...j->...", g, covariance_rig, g))
    return DepthLimit(spot.depth_m, spot.sigma_m, calibration, g, spot.status)


def _information(mean_e: Array, card: SensorCard, model: NoiseModel, pattern_known: bool) -> Array:
    if model not in NOISE_MODELS:
        raise ValueError(f"noise model '{model}': {nearest(model, NOISE_MODELS)}")
    noise = noise_of(card, pattern_known)
    if model == "approximate":
        return approximate_information(mean_e, noise)
    if model == "exact":
        return exact_information(mean_e, noise.gaussian_e2)
    return quantised_information(mean_e, card, pattern_known)
