"""Noise budget of rendering: a pixel's allowed variance beside the sensor's noise, and the errors of phi by both.

A spot at (u, v) is located from raw Bayer pixels with the Fisher weights of a known shape (Huang 2013). Let mu be the
expected electrons of a pixel, r the read noise, w = 1/(mu + r^2), d = dmu/d(u, v) and F = sum d d^T w. The estimate is
F^-1 sum d w (x - mu), and the sensor's noise gives it the covariance F^-1. Rendering noise of mu with the covariance C
gives F^-1 [sum d_p w_p C_pq w_q d_q^T] F^-1. Pixels within the blur share samples: C_pq = sqrt(V_p V_q) rho(p - q),
with rho the autocorrelation of a pixel's weights (`subpixel_grid`). The gradient of phi_ray turns both into errors
of phi_ray.
NumPy only.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import toeplitz

from phibench.render.optics.ray_tracer import trace_pixels
from phibench.render.optics.truth import mirror_angles
from phibench.render.room.subpixel_grid import FilmGrid
from phibench.render.sensor.light import SpotImage
from phibench.render.sensor.settings import Sensor, sensor
from phibench.scenes.frames import Array
from phibench.scenes.rig import View

# Largest allowed render error by the quality that a recipe asks for, in units of the sensor's.
BUDGETS = {"reference": 0.25, "training": 0.5}
BUDGET = BUDGETS["reference"]
_STEP_PX = 0.01


@cache
def webcam() -> Sensor:
    """The sensor whose noise is the measure: raw Bayer frames at the presets' nominal exposure."""
    return sensor("bayer-raw")


@dataclass(frozen=True)
class NoiseBudget:
    """Standard deviations of phi_ray, radians; NaN where the image says nothing about the spot.

    Attributes
    ----------
    phi_sensor_rad : float
        From photons and read noise, one raw Bayer frame at nominal exposure.
    phi_render_rad : float
        From the rendering noise of the ambient layer.
    """

    phi_sensor_rad: float
    phi_render_rad: float

    def kept(self, budget: float = BUDGET) -> bool:
        """True if the rendering noise stays below this part of the sensor's, and where there is nothing to keep."""
        return not self.phi_render_rad > budget * self.phi_sensor_rad


def variance_excess(
    electrons_per_s: NDArray[np.float32],
    variance_per_s2: NDArray[np.float32],
    blur_sigma_px: float,
    budget: float = BUDGET,
) -> NDArray[np.float32]:
    """By what factor a pixel's rendering variance is above its budget, largest of three colours, shape (H, W).

    The budget of a pixel is b^2 (a + r^2) / kappa: the sensor's variance without any spot, times b = `budget` squared.
    If all pixels keep it and their noise were independent (kappa = 1), every spot would: V <= b^2 (a + r^2) and
    w = 1/(s + a + r^2) give sum d d^T V w^2 <= b^2 sum d d^T w, hence F^-1 [..] F^-1 <= b^2 F^-1, whatever the spot's
    shape, brightness and place. Noise that shares the spot's own blur, of variance S, counts for more: its spectrum is
    4 pi S |G|^2 that of independent noise, and the integral of k^2 |G|^4 over that of k^2 |G|^2 is 1/4 for a Gaussian
    G, hence kappa = pi S (1 where that is less). The number of each spot (`noise_budget`) has no such approximation.
    A colour in which the pixel is full counts 0: a raw pixel has one filter.

    Parameters
    ----------
    electrons_per_s, variance_per_s2 : arrays, shape (3, H, W)
        Ambient layer and its variance.
    blur_sigma_px : float
        The camera's, without the pixel's own square (1/12 px^2).
    budget : float
        One of `BUDGETS`.
    """
    over = variance_per_s2 / allowed_per_s2(electrons_per_s, blur_sigma_px, budget)
    return np.asarray(np.where(is_full(electrons_per_s), np.float32(0.0), over).max(axis=0))


def is_full(electrons_per_s: NDArray[np.float32]) -> NDArray[np.bool_]:
    """True where a pixel behind a filter is full at the nominal exposure; of the shape of the layer."""
    return np.asarray(electrons_per_s * np.float32(webcam().exposure_s) > webcam().full_well_e)


def allowed_per_s2(
    electrons_per_s: NDArray[np.float32], blur_sigma_px: float, budget: float = BUDGET
) -> NDArray[np.float32]:
    """Largest rendering variance of a pixel within its budget, (electrons/s)^2, of the shape of the layer."""
    kappa = max(1.0, math.pi * (blur_sigma_px**2 + 1.0 / 12.0))
    seconds = webcam().exposure_s
    mean_e = electrons_per_s * np.float32(seconds)
    return np.float32((budget / seconds) ** 2 / kappa) * (mean_e + np.float32(webcam().read_noise_e ** 2))


def noise_budget(view: View, uv_px: Array, layer: SpotImage, ambient: Array, variance: Array) -> NoiseBudget:
    """Compare the two for one spot in one view.

    Parameters
    ----------
    uv_px : array, shape (2,)
        Image of the spot.
    layer : SpotImage, rendered or read from a file
    ambient, variance : arrays, shape (3, H, W)
        Ambient layer, electrons/s, and its variance, (electrons/s)^2, of the whole image.
    """
    seen = _on_image(layer, ambient.shape[1:])
    if seen is None:
        return NoiseBudget(float("nan"), float("nan"))
    window, image = seen
    mosaic = _bayer(image)
    spot, du, dv, room, noise = (
        np.where(mosaic, stack, 0.0).sum(axis=0) * webcam().exposure_s
        for stack in (
            *(getattr(layer, name)[:, *window] for name in _STACKS),
            ambient[:, *image].astype(float),
            np.sqrt(variance[:, *image].astype(float)),
        )
    )
    # a full pixel tells nothing
    mean = spot + room
    weight = np.where(mean > webcam().full_well_e, 0.0, 1.0 / (mean + webcam().read_noise_e ** 2))
    slopes = np.stack([du, dv])
    information = np.einsum("ihw,jhw,hw->ij", slopes, slopes, weight)
    if np.linalg.matrix_rank(information) < 2:
        return NoiseBudget(float("nan"), float("nan"))
    # the estimate is linear in the pixels: rendering noise goes through the same weights
    part = slopes * weight * noise
    rows, columns = (_correlation(view, length) for length in room.shape)
    spread = np.einsum("ihw,jhw->ij", part, rows @ part @ columns)
    covariance = np.linalg.inv(information)
    gradient = phi_gradient(view, uv_px)
    sensor, render = (float(gradient @ c @ gradient) for c in (covariance, covariance @ spread @ covariance))
    return NoiseBudget(sensor**0.5, render**0.5)


def _correlation(view: View, pixels: int) -> Array:
    """Correlation of the rendering noise of pixels along an axis, shape (pixels, pixels)."""
    grid = FilmGrid.of(view.rig.camera, 2)
    full = np.correlate(grid.taps, grid.taps, mode="full")[len(grid.taps) - 1 :: grid.cells].astype(float)
    steps = np.zeros(pixels)
    steps[: len(full)] = full[:pixels] / full[0]
    return np.asarray(toeplitz(steps))


_STACKS = ("electrons_per_s", "du_electrons_per_s_px", "dv_electrons_per_s_px")


def phi_gradient(view: View, uv_px: Array) -> Array:
    """d phi_ray / d(u, v) at a pixel, radians per pixel, shape (2,), by central differences."""
    steps = _STEP_PX * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    rays = trace_pixels(view, uv_px + steps)
    phi = mirror_angles(rays.normals, rays.directions).phi_ray_rad
    return np.array([phi[0] - phi[1], phi[2] - phi[3]]) / (2.0 * _STEP_PX)


def _on_image(layer: SpotImage, size: tuple[int, ...]) -> tuple[tuple[slice, slice], tuple[slice, slice]] | None:
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
    """Filter of each pixel of a part of the image, axis 0 (R, G, B): RGGB, red at even row and column."""
    v, u = np.mgrid[image]
    red, blue = (v % 2 == 0) & (u % 2 == 0), (v % 2 == 1) & (u % 2 == 1)
    return np.stack([red, ~(red | blue), blue])
