"""Rolling shutter: the image of a spot that moves while the rows are read one after the other.

Row r of H is exposed for T seconds about t_r = (r - (H - 1) / 2) x readout / H. The reference instant, 0, at which the
layer shows the spot, is the middle of the exposure of the image's centre. Row r sees the spot displaced by
velocity x t_r and smeared over velocity x T; shape and flux are those of the layer.

The displaced image is computed from the layer's values and its derivatives by the sampling theorem with derivatives
(A. Papoulis, "Generalized sampling expansion", IEEE Trans. Circuits Syst. 24, 652, 1977): both together fix frequencies
up to one cycle per pixel along each axis, twice what the values alone fix. What is beyond half a cycle in u and in v at
once they do not fix. It is taken from a Gaussian with the spot's moments. For round spots and for streaks up to 4 px,
in the worst phase, the image errs by 1e-4 of its peak at a blur of 0.7 px, by 5e-4 at 0.6, by 2e-3 at 0.5 and by 2e-2
at 0.4. Frequencies beyond one cycle make more than half of the last two.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from phibench.render.optics.truth import spot_truth
from phibench.render.sensor.light import SpotImage
from phibench.render.sensor.settings import SensorError
from phibench.scenes.frames import Array
from phibench.scenes.laser import LaserSpot
from phibench.scenes.rig import View

Spectrum = NDArray[np.complex128]
_STEP_M = 1e-4  # carriage step of the derivative: error about step^2, 1e-8 relative
_MAX_MOTION_PX = 200


def spot_velocity_px_per_s(view: View, spot: LaserSpot, carriage_m_per_s: float) -> tuple[float, float]:
    """Velocity (u, v) of the spot's image while the carriage moves along the stroke axis, pixels per second."""
    # the rig's motion between the images is none of the carriage's: the view keeps what it has of it
    nearby = (replace(view, offset_m=view.offset_m + step) for step in (-_STEP_M, _STEP_M))
    before, after = (spot_truth(each, spot, ()) for each in nearby)
    scale = carriage_m_per_s / (2.0 * _STEP_M)
    return (after.u_px - before.u_px) * scale, (after.v_px - before.v_px) * scale


def row_times_s(rows: Array, height: int, readout_s: float) -> Array:
    """Middle of the exposure of image rows, seconds from that of the image's centre."""
    return (np.asarray(rows) - 0.5 * (height - 1)) * (readout_s / height)


def moved_spot(
    spot: SpotImage, velocity_px_per_s: tuple[float, float], exposure_s: float, readout_s: float, height: int
) -> tuple[int, int, Array]:
    """Mean electrons per second of a moving spot over each row's exposure.

    Parameters
    ----------
    spot : spot layer
    velocity_px_per_s : 2 floats, (u, v)
    exposure_s, readout_s : float
    height : int
        Rows of the image.

    Returns
    -------
    u0_px, v0_px : int
        First column and row of the window.
    planes : array, shape (3, h, w)
        May be below zero by such an error; cutting it here would add flux.
    """
    if velocity_px_per_s == (0.0, 0.0) or spot.electrons_per_s.size == 0:
        return spot.u0_px, spot.v0_px, spot.electrons_per_s
    margin = _margin_px(velocity_px_per_s, exposure_s, readout_s)
    shape = tuple(n + 2 * margin for n in spot.electrons_per_s.shape[1:])
    shift = row_times_s(spot.v0_px - margin + np.arange(shape[0]), height, readout_s)[:, None] * velocity_px_per_s
    image = np.zeros((3, *shape))
    for spectrum, kv, ku in layer_spectra(spot, margin):
        smear = np.sinc((ku * velocity_px_per_s[0] + kv[:, None] * velocity_px_per_s[1]) * exposure_s)
        image += _at_rows(spectrum * smear, kv, ku, shift)
    return spot.u0_px - margin, spot.v0_px - margin, image


def _margin_px(velocity_px_per_s: tuple[float, float], exposure_s: float, readout_s: float) -> int:
    """Pixels around the window that the spot may reach within the frame."""
    reach = math.hypot(*velocity_px_per_s) * 0.5 * (exposure_s + readout_s)
    if reach > _MAX_MOTION_PX:
        raise SensorError(
            f"Light.velocity_px_per_s = {velocity_px_per_s}: the spot moves by {reach:.0f} px in half a frame, "
            f"{_MAX_MOTION_PX} are allowed; move the carriage more slowly"
        )
    return math.ceil(reach) + 2


def layer_spectra(spot: SpotImage, margin: int) -> list[tuple[Spectrum, Array, Array]]:
    """Split the layer's spectrum into its base band and the neighbours along u, along v and along both.

    Returns tuples (spectrum, frequencies along v, frequencies along u), cycles per pixel.
    """
    pad = ((0, 0), (margin, margin), (margin, margin))
    values = np.pad(spot.electrons_per_s, pad)
    f, du, dv = (
        np.fft.fft2(part)
        for part in (values, *(np.pad(d, pad) for d in (spot.du_electrons_per_s_px, spot.dv_electrons_per_s_px)))
    )
    kv, ku = (np.fft.fftfreq(n).astype(float) for n in f.shape[1:])
    kv_next, ku_next = (k - np.where(k < 0.0, -1.0, 1.0) for k in (kv, ku))
    # values: f = F(k) + F(k'); derivative: -du = 2 pi i (k F(k) + k' F(k')), a shift by +u being minus the gradient
    along_u = (-du / (2j * np.pi) - ku * f) / (ku_next - ku)
    along_v = (-dv / (2j * np.pi) - kv[:, None] * f) / (kv_next - kv)[:, None]
    both = _gaussian_spectrum(values, kv_next, ku_next)  # is in along_u and in along_v
    return [
        (f - along_u - along_v + both, kv, ku),
        (along_u - both, kv, ku_next),
        (along_v - both, kv_next, ku),
        (both, kv_next, ku_next),
    ]


def _gaussian_spectrum(values: Array, kv: Array, ku: Array) -> Spectrum:
    """Spectrum of a Gaussian that is integrated over pixels and has the moments of `values`, shape (3, rows, columns).

    The planes have the same shape, that of the spot, and each its own light.
    """
    light = values.sum(axis=0)
    total = light.sum()
    if not total > 0.0:
        return np.zeros(values.shape, complex)
    v, u = np.arange(len(kv))[:, None], np.arange(len(ku))
    mean_u, mean_v = (light * u).sum() / total, (light * v).sum() / total
    du, dv = u - mean_u, v - mean_v
    uu, vv, uv = ((light * product).sum() / total for product in (du * du, dv * dv, du * dv))
    kv = kv[:, None]
    pixel = 1.0 / 12.0  # variance of the pixel's own square
    width = max(uu - pixel, 0.0) * ku * ku + max(vv - pixel, 0.0) * kv * kv + 2.0 * uv * ku * kv
    shape = np.exp(-2.0 * np.pi**2 * width - 2j * np.pi * (ku * mean_u + kv * mean_v))
    return values.sum(axis=(1, 2))[:, None, None] * np.sinc(ku) * np.sinc(kv) * shape


def _at_rows(spectrum: Spectrum, kv: Array, ku: Array, shift_uv_px: Array) -> Array:
    """Inverse transform, shape (3, rows, columns), every row with its own shift (u, v), shape (rows, 2)."""
    rows, columns = (np.arange(len(k)) for k in (kv, ku))
    down = np.exp(2j * np.pi * kv * (rows - shift_uv_px[:, 1])[:, None])
    per_row = (down @ spectrum) * np.exp(-2j * np.pi * ku * shift_uv_px[:, :1])
    across = np.exp(2j * np.pi * ku[:, None] * columns)
    return (per_row @ across).real / (len(kv) * len(ku))
