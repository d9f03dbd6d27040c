"""Expected light of one view (`Light`), pixel rectangles (`Region`), and a moving spot under a rolling shutter.

Layers have the shape (3, H, W), planes R, G, B; a region is a rectangle of whole pixels.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from phibench.render.optics.truth import spot_truth
from phibench.render.sensor.settings import SensorError
from phibench.scenes.frames import Array
from phibench.scenes.laser import LaserSpot
from phibench.scenes.rig import View


class SpotImage(Protocol):
    """A spot layer, rendered or read: see `phibench.render.optics.spot_layer.SpotLayer`."""

    @property
    def u0_px(self) -> int:
        """Image column of the window's first column."""

    @property
    def v0_px(self) -> int:
        """Image row of the window's first row."""

    @property
    def electrons_per_s(self) -> Array:
        """Expected electrons per second, shape (3, h, w)."""

    @property
    def du_electrons_per_s_px(self) -> Array:
        """Derivative by a shift of the spot's image by +u, shape (3, h, w)."""

    @property
    def dv_electrons_per_s_px(self) -> Array:
        """Derivative by a shift of the spot's image by +v, shape (3, h, w)."""


@dataclass(frozen=True)
class OtherSpot:
    """Another small light in the view, for which a method may take the spot; it stands still.

    Parameters
    ----------
    image : spot layer
    follows_laser : bool
        Whether the laser's level is its factor, so that it goes out with the laser; otherwise it is as the layer says.
    """

    image: SpotImage = field(repr=False)
    follows_laser: bool = True


@dataclass(frozen=True)
class Light:
    """Expected photo-electrons per second behind the filters R, G, B, of one view.

    The layers are radiance times etendue: the natural cos^4 fall-off is in them and is applied nowhere else.

    Parameters
    ----------
    ambient_electrons_per_s : array, shape (3, H, W)
    spot : spot layer or None
        As this frame sees it: one that moves is given as `moved_spot` draws it out.
    lamp_level, laser_level : float
        Factors of the ambient and of the spot layer; `laser_level` 0 is laser off.
    f_number : float
        Lens stop at which the layers were rendered.
    others : tuple of OtherSpot
        Added to the spot. The spot's speckle flicker is not theirs.
    """

    ambient_electrons_per_s: NDArray[Any] = field(repr=False)
    spot: SpotImage | None = field(default=None, repr=False)
    lamp_level: float = 1.0
    laser_level: float = 1.0
    f_number: float = 2.4
    others: tuple[OtherSpot, ...] = ()

    def __post_init__(self) -> None:
        shape = self.ambient_electrons_per_s.shape
        if len(shape) != 3 or shape[0] != 3 or min(shape) < 2:
            raise SensorError(
                f"Light.ambient_electrons_per_s has the shape {shape}: (3, H, W) of 2 pixels or more is needed"
            )
        for name in ("lamp_level", "laser_level"):
            _not_negative(name, getattr(self, name))
        if not 0.5 <= self.f_number <= 256.0:
            raise SensorError(f"Light.f_number = {self.f_number:g}: allowed range is 0.5 to 256")

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) of the image, pixels."""
        return self.ambient_electrons_per_s.shape[1], self.ambient_electrons_per_s.shape[2]

    def laser_off(self) -> Light:
        """Return the same view without the laser: neither the spot nor what follows the laser."""
        return replace(self, laser_level=0.0)

    def without_spot(self) -> Light:
        """Return the same view without the spot, but with every other light: what lies under the spot."""
        return replace(self, spot=None)

    @classmethod
    def flat(cls, electrons_per_s: tuple[float, float, float], size: tuple[int, int]) -> Light:
        """Return a uniform field, for tests and photon transfer; `size` is (height, width)."""
        return cls(np.broadcast_to(np.array(electrons_per_s)[:, None, None], (3, *size)))


def _not_negative(name: str, value: float) -> None:
    if not (math.isfinite(value) and value >= 0.0):
        raise SensorError(f"Light.{name} = {value}: must be 0 or above")


@dataclass(frozen=True)
class Region:
    """Pixels u0 <= u < u1, v0 <= v < v1."""

    u0_px: int
    v0_px: int
    u1_px: int
    v1_px: int

    @classmethod
    def whole(cls, size: tuple[int, int]) -> Region:
        """Region of a whole image of size (height, width)."""
        return cls(0, 0, size[1], size[0])

    @classmethod
    def around(cls, u_px: float, v_px: float, size: tuple[int, int], side_px: int = 64) -> Region:
        """Square about a point, moved inwards where the image of size (height, width) ends.

        Raises
        ------
        SensorError
            If the point lies outside the image, or the square is larger than the image.
        """
        height, width = size
        if not (-0.5 <= u_px <= width - 0.5 and -0.5 <= v_px <= height - 0.5):
            raise SensorError(
                f"region around ({u_px:g}, {v_px:g}): outside the image, which spans [-0.5, {width - 0.5:g}] x "
                f"[-0.5, {height - 0.5:g}]; give a point inside"
            )
        if not 1 <= side_px <= min(size):
            raise SensorError(f"region of {side_px} px: allowed sides are 1 to {min(size)}, the image's shorter side")
        # pixel centres are integers: the middle pixel is the nearest one
        u0, v0 = (
            min(max(math.floor(centre + 0.5) - side_px // 2, 0), limit - side_px)
            for centre, limit in ((u_px, width), (v_px, height))
        )
        return cls(u0, v0, u0 + side_px, v0 + side_px)

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width)."""
        return self.v1_px - self.v0_px, self.u1_px - self.u0_px

    def slices(self, origin: Region | None = None) -> tuple[slice, slice]:
        """Rows and columns of this region in an image, or in an array that holds the region `origin`."""
        u0, v0 = (origin.u0_px, origin.v0_px) if origin else (0, 0)
        return slice(self.v0_px - v0, self.v1_px - v0), slice(self.u0_px - u0, self.u1_px - u0)

    def bands(self, rows: int) -> Iterator[Region]:
        """Parts of so many rows, from above; the last one may have less."""
        for v in range(self.v0_px, self.v1_px, rows):
            yield Region(self.u0_px, v, self.u1_px, min(v + rows, self.v1_px))

    def grown(self, size: tuple[int, int], step: tuple[int, int] = (1, 1), margin: tuple[int, int] = (0, 0)) -> Region:
        """Smallest region on a grid of `step` pixels (down, across) that holds this one and `margin` pixels around.

        It ends where the image of size (height, width) ends.
        """
        (down, across), (height, width) = step, size
        # -(-a // b) rounds up
        return Region(
            max((self.u0_px - margin[1]) // across * across, 0),
            max((self.v0_px - margin[0]) // down * down, 0),
            min(-(-(self.u1_px + margin[1]) // across) * across, width),
            min(-(-(self.v1_px + margin[0]) // down) * down, height),
        )

    def within(self, size: tuple[int, int]) -> Region:
        """Return the region itself if it is not empty and inside an image of size (height, width).

        Raises
        ------
        SensorError
            Otherwise.
        """
        height, width = size
        if not (0 <= self.u0_px < self.u1_px <= width and 0 <= self.v0_px < self.v1_px <= height):
            raise SensorError(
                f"region [{self.u0_px}, {self.u1_px}) x [{self.v0_px}, {self.v1_px}): must hold a pixel and lie inside "
                f"the image of {width} x {height} pixels; Region.around moves a square inside"
            )
        return self


# Rolling shutter: the image of a spot that moves while the rows are read one after the other.
#
# Row r of H is exposed for T seconds about t_r = (r - (H - 1) / 2) x readout / H. The reference instant, 0, at which
# the layer shows the spot, is the middle of the exposure of the image's centre. Row r sees the spot displaced by
# velocity x t_r and smeared over velocity x T; shape and flux are those of the layer.
#
# The displaced image is computed from the layer's values and its derivatives by the sampling theorem with derivatives
# (A. Papoulis, "Generalized sampling expansion", IEEE Trans. Circuits Syst. 24, 652, 1977): both together fix
# frequencies up to one cycle per pixel along each axis, twice what the values alone fix. What is beyond half a cycle in
# u and in v at once they do not fix. It is taken from a Gaussian with the spot's moments. For round spots and for
# streaks up to 4 px, in the worst phase, the image errs by 1e-4 of its peak at a blur of 0.7 px, by 5e-4 at 0.6, by
# 2e-3 at 0.5 and by 2e-2 at 0.4. Frequencies beyond one cycle make more than half of the last two.


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
            f"the spot's velocity is {velocity_px_per_s} px/s: it moves by {reach:.0f} px in half a frame, "
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
