"""Spots that are easy to see: where they are in the world and in both images. No rendering, no file."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from phibench.estimator.mirror_image import image_of
from phibench.estimator.phi import phi_incidence, phi_normal, phi_ray
from phibench.estimator.spot_blur import spot_blur
from phibench.scenes.rig import Rig
from phibench.scenes.streams import generator

DEPTH_M, STROKE_M, HEIGHT_M = (1.2, 3.2), (0.35, 0.6), (0.35, 0.65)
FLUX_E = (25_000.0, 35_000.0)  # behind the red filter: an eighth of it in the brightest pixel


@dataclass(frozen=True)
class EasySpot:
    """One image's spot: position, blur, the three angles and the azimuth of the world point."""

    uv_px: tuple[float, float]
    sigma_px: float
    phi_rad: dict[str, float]
    azimuth_rad: float


@dataclass(frozen=True)
class EasyScene:
    """One stroke pair.

    Attributes
    ----------
    depth_m, stroke_m, flux_e : float
    down, up : EasySpot
    """

    depth_m: float
    stroke_m: float
    flux_e: float
    down: EasySpot
    up: EasySpot


def easy_rig() -> Rig:
    """The default rig, stopped down to f/16: without astigmatism from defocus a spot is round, as it is drawn here."""
    rig = Rig()
    return replace(rig, camera=replace(rig.camera, f_number=16.0))


def easy_scene(rig: Rig, number: int) -> EasyScene:
    """Scene of a pair: depth, stroke, height, azimuth and flux come from the stream named after its number."""
    rng = generator("easy pairs", "place", number)
    depth, stroke, height, flux = (float(rng.uniform(*span)) for span in (DEPTH_M, STROKE_M, HEIGHT_M, FLUX_E))
    azimuth = float(rng.uniform(-math.pi, math.pi))
    axis = rig.at(0.0).sphere_centre_m
    point = np.array([axis[0] + depth * math.cos(azimuth), axis[1] + depth * math.sin(azimuth), height])
    down, up = (_spot(rig, offset, point, azimuth) for offset in (0.0, stroke))
    return EasyScene(depth, stroke, flux, down, up)


def _spot(rig: Rig, offset_m: float, point: np.ndarray[tuple[int], np.dtype[np.float64]], azimuth: float) -> EasySpot:
    view = rig.at(offset_m)
    u, v = image_of(view, point).uv_px
    uv = (float(u), float(v))
    at = np.array(uv)
    angles = {"ray": phi_ray(view, at), "normal": phi_normal(view, at), "incidence": phi_incidence(view, at)}
    return EasySpot(uv, spot_blur(rig, uv).round_px, {name: float(phi) for name, phi in angles.items()}, azimuth)
