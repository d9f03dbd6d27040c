"""The spot layer: the laser spot's expected electrons per second on a small window, and its derivative images."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from phibench.render.quadrature import slices
from phibench.render.rough_cloud import rough_cloud
from phibench.render.spot_cloud import FilmCloud, specular_cloud
from phibench.scenes.frames import Array
from phibench.scenes.laser import LaserSpot
from phibench.scenes.rig import View
from phibench.scenes.solids import Shape

_TAIL_SIGMAS = 6.5  # a Gaussian's flux beyond it is 8e-11
_POINTS_AT_ONCE = 16384


@dataclass(frozen=True)
class SpotLayer:
    """Image of one spot in one view, after optics and blur, before exposure.

    The window may reach beyond the image; what lies outside is not on the sensor.

    Attributes
    ----------
    u0_px, v0_px : int
        Image pixel of the window's first column and row.
    electrons_per_s : array, shape (3, h, w)
        Expected photo-electrons per second per pixel behind the filters R, G, B.
    du_electrons_per_s_px, dv_electrons_per_s_px : arrays, shape (3, h, w)
        Derivatives with respect to a shift of the whole image of the spot by +u, +v.
    centroid_uv_px : array, shape (2,)
        Energy centroid over spot and aperture before pixel sampling; NaN when dark.
    total_electrons_per_s : array, shape (3,)
        Electrons per second of the whole spot, window or not.
    """

    u0_px: int
    v0_px: int
    electrons_per_s: Array
    du_electrons_per_s_px: Array
    dv_electrons_per_s_px: Array
    centroid_uv_px: Array
    total_electrons_per_s: Array


def spot_layer(view: View, spot: LaserSpot, shapes: Sequence[Shape]) -> SpotLayer:
    """Render the spot by specular connection (ideal mirror) or microfacet sampling (rough mirror)."""
    cloud = (rough_cloud if view.rig.mirror.roughness_alpha > 0.0 else specular_cloud)(view, spot, shapes)
    gain = np.array(view.rig.camera.detector.laser_electrons_per_joule(spot.wavelength_nm))
    return splat(cloud, view.rig.camera.blur_sigma_px, gain)


def splat(cloud: FilmCloud, sigma_px: float, electrons_per_joule: Array) -> SpotLayer:
    """Blur the film points by a Gaussian and integrate over each pixel, exactly (erf).

    Parameters
    ----------
    cloud : FilmCloud
    sigma_px : float
    electrons_per_joule : array, shape (3,)
    """
    bright = cloud.watts > 0.0
    if not bright.any():
        return _dark_layer()
    uv, watts = cloud.uv_px[bright], cloud.watts[bright]
    low = np.floor(uv.min(axis=0) - _TAIL_SIGMAS * sigma_px).astype(int)
    high = np.ceil(uv.max(axis=0) + _TAIL_SIGMAS * sigma_px).astype(int)
    images = np.zeros((3, high[1] - low[1] + 1, high[0] - low[0] + 1))
    for part in slices(len(uv), _POINTS_AT_ONCE):
        across, d_across = _pixel_integrals(uv[part, 0], low[0], high[0], sigma_px)
        down, d_down = _pixel_integrals(uv[part, 1], low[1], high[1], sigma_px)
        down *= watts[part, None]
        d_down *= watts[part, None]
        images += np.stack([down.T @ across, down.T @ d_across, d_down.T @ across])
    layer, du, dv = images[:, None] * electrons_per_joule[:, None, None]
    total = watts.sum() * electrons_per_joule
    return SpotLayer(int(low[0]), int(low[1]), layer, du, dv, cloud.centroid_px(), total)


def _pixel_integrals(centre: Array, low: int, high: int, sigma: float) -> tuple[Array, Array]:
    """Integral of a unit Gaussian over pixels low..high, shape (N, pixels), and its derivative by the centre."""
    edges = (np.arange(low, high + 2) - 0.5 - centre[:, None]) / sigma
    density = np.exp(-0.5 * edges**2) / (sigma * math.sqrt(2.0 * math.pi))
    return np.diff(ndtr(edges), axis=1), -np.diff(density, axis=1)


def _dark_layer() -> SpotLayer:
    zeros = np.zeros((3, 1, 1))
    return SpotLayer(0, 0, zeros, zeros, zeros, np.full(2, np.nan), np.zeros(3))
