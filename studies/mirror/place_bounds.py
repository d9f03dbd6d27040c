"""Bound of D at a place, for mirrors that blur a spot unequally along and across the radius.

The blur of a spot differs between mirrors: a cone is flat along its side and focuses there much farther off than
across. D depends on the radius in the image alone, whose bound for a spot with the radial sigma s_r and the tangential
one s_t is taken from round spots of s = sqrt(s_r s_t):

    sigma_r = sigma_round(s) s_r / s.

Where the spot's own light is the noise, sigma_round grows as s, and where the background is, as s^2: sigma_r is then
s_r / sqrt(N) and proportional to s_r sqrt(s_r s_t), as for an elliptic Gaussian spot.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from phibench.datasets.frames.sensor_card import SensorCard
from phibench.estimator.geometry.reflection import reflect
from phibench.estimator.geometry.status import Status
from phibench.estimator.geometry.triangulate import depth_exact
from phibench.estimator.limits.best_stroke import ROOM_E_PER_S
from phibench.estimator.limits.processed_bound import SpotSigma, spot_sigma
from phibench.estimator.spots.gaussian_spot import SpotBlur
from phibench.estimator.spots.spot_prediction import Laser, spot_blur, spot_electrons_per_s
from phibench.scenes.laser import Beam
from phibench.scenes.rig import Rig
from phibench.studies.mirror.visible_places import raised_image

_WALL_NORMAL = np.array([-1.0, 0.0, 0.0])  # an upright wall along world x, facing the mirror


# -- bound -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class BlurBounds:
    """Bound of a coordinate by electrons and blur, for one sensor over a white wall.

    Attributes
    ----------
    blurs_px : tuple of float
        Sigma of round spots, rising.
    bounds : tuple of SpotSigma, one per blur
    """

    blurs_px: tuple[float, ...]
    bounds: tuple[SpotSigma, ...]
    exposure_s: float

    def round_at(self, flux_e: ArrayLike, blur_px: float) -> float:
        """Bound for a round spot, pixels, log-log between the blurs; infinite beyond them."""
        if not self.blurs_px[0] <= blur_px <= self.blurs_px[-1]:
            return float("inf")
        values = np.array([float(bound.at(flux_e)) for bound in self.bounds])
        return float(np.exp(np.interp(np.log(blur_px), np.log(self.blurs_px), np.log(values))))

    def at(self, flux_e: float, blur: SpotBlur) -> tuple[float, float]:
        """Bounds along and across the radius, pixels, for a spot on the image's u axis."""
        radial, tangential = float(blur.sigma_px), float(blur.sigma_px * blur.ratio)
        middle = float(np.sqrt(radial * tangential))
        at_middle = self.round_at(flux_e, middle)
        return at_middle * radial / middle, at_middle * tangential / middle


def blur_bounds(card: SensorCard, response: tuple[float, float, float], blurs_px: Sequence[float]) -> BlurBounds:
    """Table of bounds for a sensor, over a white wall of the lab."""
    room = [rate * card.exposure_s for rate in ROOM_E_PER_S]
    # a processed bound costs a covariance of the codes at every flux
    fluxes = tuple(np.geomspace(100.0, 1e6, 25 if card.output == "raw" else 9).tolist())
    bounds = tuple(spot_sigma(card, blur, room, response, flux_e=fluxes) for blur in blurs_px)
    return BlurBounds(tuple(blurs_px), bounds, card.exposure_s)


@dataclass(frozen=True)
class PlaceBound:
    """Bound of D at one place.

    Attributes
    ----------
    relative : float
        Standard deviation of D over D; NaN where a pair does not measure the place.
    theta_rad : (down, up)
        Of the rays, from straight down.
    radial_blur_px : float
        Larger sigma of both spots along the radius.
    """

    relative: float
    theta_rad: tuple[float, float]
    radial_blur_px: float


NOTHING = PlaceBound(float("nan"), (float("nan"), float("nan")), float("nan"))


def place_bound(rig: Rig, table: BlurBounds, depth_m: float, height_m: float, stroke_m: float) -> PlaceBound:
    """Bound of D for a spot of the default laser on an upright wall along world x, the rig known exactly."""
    point = np.array([depth_m, 0.0, height_m])
    pixels, covariances, thetas, blurs = [], [], [], []
    for offset in (0.0, stroke_m):
        image = raised_image(rig, point, offset)
        if image.status != Status.OK:
            return NOTHING
        blur = spot_blur(rig, image.uv_px, depth_m, Beam())
        light = float(spot_electrons_per_s(rig, Laser(), image, _WALL_NORMAL)) * table.exposure_s
        ray = reflect(rig.at(0.0), image.uv_px).direction_world
        pixels.append(image.uv_px)
        covariances.append(np.diag(np.square(table.at(light, blur))))
        thetas.append(float(np.arctan2(ray[0], -ray[2])))
        blurs.append(float(blur.sigma_px))
    depth = depth_exact(rig, stroke_m, *pixels, *covariances)
    return PlaceBound(float(depth.sigma_m) / depth_m, (thetas[0], thetas[1]), max(blurs))
