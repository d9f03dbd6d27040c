"""Lower bound of the error of each pixel's depth D in dense matching; motion of the image's texture with 1 / D.

A window's pixels share one 1 / D, q. Where q changes, the down image is as if its texture moved by e = M^-1 t: t is the
motion of the up image's place with q, M its derivative by the down pixel, both of the exact projection. The texture
is unknown, and both images tell of it: the noise of the up image counts by its pixels per pixel of the down image,
|det M|. So the information of a window on q is the sum of

    (grad a . e)^2 / (var_a + var_b / |det M|)

over its pixels, saturated ones left out, and sigma of D is D^2 / sqrt(information). The mean a is in electrons and the
noise that of the pixels before any processing. No method that takes the window for one q, and knows no more of the
room, is better; one that takes larger windows or planes may be.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import correlate1d, uniform_filter

from phibench.datasets.frames.sensor_card import SensorCard
from phibench.estimator.geometry.epipolar_line import up_image
from phibench.estimator.spots.image_planes import variance_e2
from phibench.estimator.spots.raw_pixels import bayer_filters
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig

BOUND_WINDOW_PX = 15
_AT_ONCE = 1 << 15
_SLOPE = np.array([1.0, -8.0, 0.0, 8.0, -1.0]) / 12.0  # central difference, exact for polynomials up to the order 4
_FLAT_PER_M2 = 1e-12  # information on 1 / D, m^2: less is none


@dataclass(frozen=True)
class EpipolarMotion:
    """Motion of the down image's texture with 1 / D, planes of the image; NaN where there is no depth.

    Attributes
    ----------
    px_m : array, shape (H, W, 2)
        e, pixels of the down image per 1 / m.
    density : array, shape (H, W)
        |det M|, pixels of the up image per pixel of the down image.
    """

    px_m: Array
    density: Array


def epipolar_motion(rig: Rig, stroke_m: float, depth_m: Array) -> EpipolarMotion:
    """Motion at known depths (H, W), by the exact projection."""
    px_m, density = np.full((*depth_m.shape, 2), np.nan), np.full(depth_m.shape, np.nan)
    known = np.flatnonzero(np.isfinite(depth_m))
    for index in np.array_split(known, len(known) // _AT_ONCE + 1):
        v, u = np.divmod(index, depth_m.shape[1])
        at = up_image(rig, stroke_m, np.stack([u, v], axis=-1).astype(float), 1.0 / depth_m.reshape(-1)[index])
        moved, density.reshape(-1)[index] = motion_of(at.jacobian)
        px_m.reshape(-1, 2)[index] = moved
    return EpipolarMotion(px_m, density)


def motion_of(jacobian: Array) -> tuple[Array, Array]:
    """e, shape (..., 2), and |det M|, shape (...), of Jacobians of `up_image`, shape (..., 2, 3)."""
    (a, b, s), (c, d, t) = (np.moveaxis(jacobian[..., k, :], -1, 0) for k in (0, 1))
    det = a * d - b * c
    with np.errstate(divide="ignore", invalid="ignore"):
        e = np.stack([d * s - b * t, a * t - c * s], axis=-1) / det[..., None]
    return e, np.abs(det)


def matching_information(planes_e: Array, card: SensorCard, motion: EpipolarMotion, window_px: int) -> Array:
    """Information on 1 / D, m^2, of the window around each pixel, shape (H, W).

    Parameters
    ----------
    planes_e : shape (3, H, W), or (1, H, W) of a sensor without filters
        Expected electrons of the down image behind each filter.
    window_px : int
        Side, odd.
    """
    along = [
        motion.px_m[..., 0] * correlate1d(plane, _SLOPE, axis=1)
        + motion.px_m[..., 1] * correlate1d(plane, _SLOPE, axis=0)
        for plane in planes_e
    ]
    shape = planes_e.shape[1], planes_e.shape[2]
    filters = np.zeros(shape, int) if len(planes_e) == 1 else bayer_filters(np.zeros((1, 2), int), shape)[0]
    level, slope = (np.choose(filters, list(each)) for each in (planes_e, along))
    with np.errstate(divide="ignore", invalid="ignore"):
        told = np.where(level < card.saturation_e, slope**2, 0.0) / (
            variance_e2(level, card, alike=False) * (1.0 + 1.0 / motion.density)
        )
    return np.asarray(uniform_filter(np.nan_to_num(told), window_px, mode="constant") * window_px**2)


def dense_bound(
    rig: Rig, stroke_m: float, card: SensorCard, planes_e: Array, depth_m: Array, window_px: int = BOUND_WINDOW_PX
) -> Array:
    """Least sigma of D, metres, shape (H, W); NaN without depth, infinite without texture.

    Parameters
    ----------
    rig, stroke_m : the true ones
    planes_e : as in `matching_information`
    depth_m : shape (H, W)
        True D.
    """
    return sigma_of(matching_information(planes_e, card, epipolar_motion(rig, stroke_m, depth_m), window_px), depth_m)


def sigma_of(told: Array, depth_m: Array) -> Array:
    """Least sigma of D, metres, from the information on 1 / D: infinite where that is none, NaN without depth."""
    with np.errstate(divide="ignore"):
        return np.asarray(depth_m**2 / np.sqrt(np.where(told > _FLAT_PER_M2, told, 0.0)))
