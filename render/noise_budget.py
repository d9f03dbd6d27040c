"""The renderer's noise as an error of phi, beside the sensor's own.

A spot at (u, v) is located from raw Bayer pixels with the Fisher weights of a known shape: with mu the expected
electrons of a pixel, r the read noise and d = dmu/d(u, v), F = sum d d^T / (mu + r^2) (Huang 2013) and the estimate is
F^-1 sum d (x - mu) / (mu + r^2). The sensor's noise gives it the covariance F^-1; a variance V of mu itself, from
rendering, gives F^-1 [sum d d^T V / (mu + r^2)^2] F^-1. Both become errors of phi_ray by its gradient. NumPy only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from phibench.render.angles import mirror_angles
from phibench.render.spot import SpotLayer
from phibench.render.trace import trace_pixels
from phibench.scenes.frames import Array
from phibench.scenes.rig import View

EXPOSURE_S = 1.0 / 60.0  # nominal
READ_NOISE_E = 4.0  # of the sensor preset `webcam`
BUDGET = 0.25  # largest allowed render error, in units of the sensor's
_STEP_PX = 0.01


@dataclass(frozen=True)
class NoiseBudget:
    """Standard deviations of phi_ray, radians; NaN where the spot is not on the image.

    Attributes
    ----------
    phi_sensor_rad : float
        From photons and read noise, one raw Bayer frame at nominal exposure.
    phi_render_rad : float
        From the rendering noise of the ambient layer.
    """

    phi_sensor_rad: float
    phi_render_rad: float

    @property
    def kept(self) -> bool:
        """Whether the rendering noise stays below a quarter of the sensor's; true where there is nothing to keep."""
        return not self.phi_render_rad > BUDGET * self.phi_sensor_rad


def noise_budget(view: View, uv_px: Array, layer: SpotLayer, ambient: Array, variance: Array) -> NoiseBudget:
    """Compare the two for one spot in one view.

    Parameters
    ----------
    uv_px : array, shape (2,)
        Image of the spot.
    layer : SpotLayer
    ambient, variance : arrays, shape (3, H, W)
        Ambient layer, electrons/s, and its variance, (electrons/s)^2, of the whole image.
    """
    seen = _on_image(layer, ambient.shape[1:])
    if seen is None:
        return NoiseBudget(float("nan"), float("nan"))
    window, image = seen
    mosaic = _bayer(image)
    spot, du, dv, room, noise = (
        np.where(mosaic, stack, 0.0).sum(axis=0) * EXPOSURE_S
        for stack in (
            *(getattr(layer, name)[:, *window] for name in _STACKS),
            ambient[:, *image].astype(float),
            np.sqrt(variance[:, *image].astype(float)),
        )
    )
    weight = 1.0 / (spot + room + READ_NOISE_E**2)
    slopes = np.stack([du.ravel(), dv.ravel()])
    information = np.einsum("ip,jp,p->ij", slopes, slopes, weight.ravel())
    spread = np.einsum("ip,jp,p->ij", slopes, slopes, (noise * weight).ravel() ** 2)
    covariance = np.linalg.inv(information)
    gradient = phi_gradient(view, uv_px)
    sensor, render = (float(gradient @ c @ gradient) for c in (covariance, covariance @ spread @ covariance))
    return NoiseBudget(sensor**0.5, render**0.5)


_STACKS = ("electrons_per_s", "du_electrons_per_s_px", "dv_electrons_per_s_px")


def phi_gradient(view: View, uv_px: Array) -> Array:
    """d phi_ray / d(u, v) at a pixel, radians per pixel, shape (2,), by central differences."""
    steps = _STEP_PX * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    rays = trace_pixels(view, uv_px + steps)
    phi = mirror_angles(rays.normals, rays.directions).phi_ray_rad
    return np.array([phi[0] - phi[1], phi[2] - phi[3]]) / (2.0 * _STEP_PX)


def _on_image(layer: SpotLayer, size: tuple[int, ...]) -> tuple[tuple[slice, slice], tuple[slice, slice]] | None:
    """Slices (rows, columns) of the part of the layer that is on the image, in the layer and in the image."""
    starts = (layer.v0_px, layer.u0_px)
    low = [max(start, 0) for start in starts]
    shape = layer.electrons_per_s.shape[1:]
    high = [min(start + length, total) for start, length, total in zip(starts, shape, size, strict=True)]
    if any(a >= b for a, b in zip(low, high, strict=True)) or not layer.electrons_per_s.any():
        return None
    window = [slice(a - start, b - start) for a, b, start in zip(low, high, starts, strict=True)]
    image = [slice(a, b) for a, b in zip(low, high, strict=True)]
    return (window[0], window[1]), (image[0], image[1])


def _bayer(image: tuple[slice, slice]) -> Array:
    """Which filter, axis 0 (R, G, B), each pixel of a part of the image has: RGGB, red at even row and column."""
    v, u = np.mgrid[image]
    red, blue = (v % 2 == 0) & (u % 2 == 0), (v % 2 == 1) & (u % 2 == 1)
    return np.stack([red, ~(red | blue), blue])
