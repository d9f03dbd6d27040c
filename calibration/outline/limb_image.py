"""Images as planes of linear light, and the model of the light across a polished sphere's limb in them.

Planes: a pixel of a demosaiced image is a weighted sum of mosaic pixels around it. The sum is kept as taps. So a model
of the light goes through the same sum, and nothing has to be inverted. Integer (u, v) are pixel centres; RGGB mosaic,
red at even row and even column. Filters are numbered 0, 1, 2 for R, G, B.

Limb: there a ray grazes the sphere and goes on undeviated. Radiance is continuous over the limb except for the steel's
reflectance, which rises to 1 at grazing incidence. The light across the limb is the room's, a smooth function of the
angle by which the mirror turns the ray, x the Fresnel reflectance (1 outside), blurred by lens, defocus and pixel.

Symbols: s sphere centre in the camera frame, R radius, a angle of a ray from s, a0 = asin(R / |s|) that of the limb, d
distance from the limb across it, pixels, outwards positive.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from phibench.datasets.frames.sensor_card import SensorCard
from phibench.estimator.spots.camera_codes import light_of, rgb_picture
from phibench.estimator.spots.image_planes import ImageError
from phibench.estimator.spots.simple_spots import LUMA
from phibench.scenes.camera import Camera
from phibench.scenes.frames import Array, BoolArray
from phibench.scenes.rig import Rig

_CLIPPED = 250  # of 255: JPEG moves clipped pixels by some codes
_NEAR_FULL = 0.97  # of saturation: with noise a pixel above it may be cut


@dataclass(frozen=True)
class Tap:
    """One term of a pixel's sum: `weight` x light behind `filter_index` at the pixel (u + du_px, v + dv_px)."""

    weight: float
    filter_index: int
    du_px: int = 0
    dv_px: int = 0


Taps = tuple[Tap, ...]


@dataclass(frozen=True)
class Plane:
    """Linear light of one kind.

    Attributes
    ----------
    values : shape (H, W), in any unit
    usable : shape (H, W), False where there is no such pixel or it is saturated
    taps : 4 sums, for the pixels with 2 (v mod 2) + (u mod 2) = 0, 1, 2, 3; weights sum to 1
    """

    values: Array = field(repr=False)
    usable: BoolArray = field(repr=False)
    taps: tuple[Taps, Taps, Taps, Taps]


def planes_of(image: NDArray[Any], card: SensorCard | None = None) -> tuple[Plane, ...]:
    """Planes of an image.

    Parameters
    ----------
    image : array
        Without a card, or for a card whose output is "electrons": a layer or an ideal frame, shape (3, H, W). Else by
        `card.output`: "raw" (H, W) DN; "srgb8" and "mjpeg" (H, W, 3) of 8 bits; "yuyv" (H, W, 2).
    card : SensorCard, optional

    Raises
    ------
    ImageError
        If the shape is not the output's.
    """
    output = "electrons" if card is None else card.output
    shape_is_right = {
        "electrons": image.ndim == 3 and image.shape[0] == 3,
        "raw": image.ndim == 2,
        "yuyv": image.ndim == 3 and image.shape[-1] == 2,
    }.get(output, image.ndim == 3 and image.shape[-1] == 3)
    if not shape_is_right or image.size == 0:
        raise ImageError(
            f"an image of shape {image.shape} is no '{output}' image: name the preset that it was drawn with"
        )
    if card is None or output == "electrons":
        return tuple(_whole(image[i], (Tap(1.0, i),)) for i in range(3))
    if output == "raw":
        return _raw(image, card)
    return (_luma(rgb_picture(image, card), card),)


def full_pixels(planes: tuple[Plane, ...]) -> BoolArray:
    """Pixels that no plane can use, shape (H, W): saturated ones."""
    return ~np.logical_or.reduce([plane.usable for plane in planes])


def binned_planes(planes: tuple[Plane, ...], block: int) -> tuple[Plane, ...]:
    """Planes of squares of `block` pixels: means of what is usable there; a pixel's sum has no neighbours then."""
    return tuple(_binned(plane, block) for plane in planes)


def _binned(plane: Plane, block: int) -> Plane:
    count = square_sums(plane.usable.astype(np.uint16), block)
    sums = square_sums(np.where(plane.usable, plane.values, 0.0), block)
    shares = [sum(t.weight for t in taps if t.filter_index == i) for taps in plane.taps for i in range(3)]
    share = np.array(shares, float).reshape(4, 3).mean(axis=0)
    taps = tuple(Tap(float(one), i) for i, one in enumerate(share) if one)
    return Plane(sums / np.maximum(count, 1), count > 0, (taps, taps, taps, taps))


def square_sums(values: NDArray[Any], block: int) -> NDArray[Any]:
    """Sums over squares of `block` pixels, shape (H // block, W // block, ...); what is left over is cut off.

    Slices are added up: five times as fast as `skimage.measure.block_reduce`, which sums along short axes.
    """
    height, width = (size // block for size in values.shape[:2])
    cut = values[: height * block, : width * block]
    rows = cut[::block].copy()
    for k in range(1, block):
        rows += cut[k::block]
    sums = rows[:, ::block].copy()
    for k in range(1, block):
        sums += rows[:, k::block]
    return sums


def _whole(values: NDArray[Any], taps: Taps) -> Plane:
    values = np.asarray(values, float)
    return Plane(values, np.isfinite(values), (taps, taps, taps, taps))


def _raw(image: NDArray[Any], card: SensorCard) -> tuple[Plane, ...]:
    electrons = (image.astype(float) - card.black_level_dn) / card.dn_per_e
    open_wells = electrons < _NEAR_FULL * card.saturation_e
    if card.mosaic == "mono":
        taps = tuple(Tap(1.0 / 3.0, i) for i in range(3))
        return (Plane(electrons, open_wells, (taps, taps, taps, taps)),)
    rows, columns = np.indices(image.shape) % 2
    planes = []
    for i in range(3):
        taps = (Tap(1.0, i),)
        planes.append(Plane(electrons, open_wells & (rows + columns == i), (taps, taps, taps, taps)))
    return tuple(planes)


def _luma(image: NDArray[Any], card: SensorCard) -> Plane:
    """Luma of the linear, white-balanced planes. It is a filter's own light only where the colour matrix is one."""
    weights = np.array(LUMA)  # JPEG's: errors of its coarse chroma cancel in this sum
    clipped: BoolArray = np.maximum(np.maximum(image[..., 0], image[..., 1]), image[..., 2]) >= _CLIPPED
    clipped = ndimage.binary_dilation(clipped, iterations=2) if clipped.any() else clipped
    if image.dtype == np.uint8:  # 256 codes have 256 values: the tone curve of twelve megapixels would take seconds
        light = light_of(np.arange(256) / 255.0, card)  # of every code
        values = (light * weights[0])[image[..., 0]]
        for i in (1, 2):
            values += (light * weights[i])[image[..., i]]
        level = np.array([_median_light(light, image[..., i]) for i in range(3)]) * weights
    else:
        linear = light_of(np.asarray(image, float) / 255.0, card)
        values, level = linear @ weights, np.median(linear.reshape(-1, 3), axis=0) * weights
    # shares of the filters in the luma of this picture; three equal ones would be as good, the room is nearly grey
    share = level / level.sum() if level.sum() > 0.0 else weights
    du, dv = card.mosaic_phase
    taps = [_merged(_luma_taps(2 * ((k // 2 + dv) % 2) + (k + du) % 2, share, card)) for k in range(4)]
    return Plane(values, ~clipped, (taps[0], taps[1], taps[2], taps[3]))


def _median_light(light: Array, codes: NDArray[np.uint8]) -> float:
    """Median of the light of codes, shape (256,), which rises with the code."""
    below = np.cumsum(np.bincount(codes.ravel(), minlength=256))
    middle = np.searchsorted(below, [(codes.size - 1) // 2, codes.size // 2], side="right")
    return float(light[middle].mean())


_CROSS = tuple((0.25, du, dv) for du, dv in ((-1, 0), (1, 0), (0, -1), (0, 1)))
_CORNERS = tuple((0.25, du, dv) for du in (-1, 1) for dv in (-1, 1))
_BESIDE, _ABOVE, _OWN = ((0.5, -1, 0), (0.5, 1, 0)), ((0.5, 0, -1), (0.5, 0, 1)), ((1.0, 0, 0),)
_BILINEAR = (  # by parity, then filter R, G, B: what bilinear interpolation of an RGGB mosaic takes
    (_OWN, _CROSS, _CORNERS),
    (_BESIDE, _OWN, _ABOVE),
    (_ABOVE, _OWN, _BESIDE),
    (_CORNERS, _CROSS, _OWN),
)


def _luma_taps(parity: int, share: Array, card: SensorCard) -> Iterable[Tap]:
    for weight, du, dv in _sharpening(card.sharpen_amount):
        there = (parity // 2 + dv) % 2 * 2 + (parity + du) % 2
        for i in range(3):
            sums = _BILINEAR[there][i] if card.mosaic == "bayer" else _OWN
            yield from (Tap(weight * of_sum * float(share[i]), i, du + a, dv + b) for of_sum, a, b in sums)


def _sharpening(amount: float) -> Iterable[tuple[float, int, int]]:
    """Unsharp mask as a sum. After the sRGB curve, in the camera; on a faint limb that is the same."""
    if amount == 0.0:
        yield 1.0, 0, 0
        return
    binomial = (0.25, 0.5, 0.25)
    for du in (-1, 0, 1):
        for dv in (-1, 0, 1):
            yield (1.0 + amount if du == dv == 0 else 0.0) - amount * binomial[du + 1] * binomial[dv + 1], du, dv


def _merged(taps: Iterable[Tap]) -> Taps:
    """One tap for each filter and place."""
    sums: dict[tuple[int, int, int], float] = {}
    for tap in taps:
        key = (tap.filter_index, tap.du_px, tap.dv_px)
        sums[key] = sums.get(key, 0.0) + tap.weight
    return tuple(Tap(weight, *key) for key, weight in sums.items())


# -- light across the limb ---------------------------------------------------------------------------------------------

STEP_PX = 0.01
"""Of tables of the light across an outline."""
_REACH_PX = 30.0  # of the tables, to both sides of the limb
_PIXEL_VARIANCE_PX2 = 1.0 / 12.0  # of a square pixel, in every direction


@dataclass(frozen=True)
class Limb:
    """Light across the limb for a level of 1 outside, per filter R, G, B.

    Attributes
    ----------
    d_px : shape (n,)
    light, slope_per_px, curvature_per_px2 : shape (3, n)
        The light, its first and its second derivative by d.
    turned, turned_squared : shape (3, n)
        The light times the angle by which the mirror turns the ray, 0 outside, and times its square: what the room's
        light adds that changes with direction. That angle grows as the root of -d: 15 degrees at 3 px.
    """

    d_px: Array
    light: Array
    slope_per_px: Array
    curvature_per_px2: Array
    turned: Array
    turned_squared: Array

    @cached_property
    def rows(self) -> Array:
        """All five, shape (3, n, 5): what one distance needs lies together."""
        tables = (self.light, self.slope_per_px, self.curvature_per_px2, self.turned, self.turned_squared)
        return np.ascontiguousarray(np.stack(tables, axis=-1))

    def all_at(self, filter_index: int, d_px: Array) -> Array:
        """Values of the five at distances, shape (..., 5), linear between the table's evenly spaced rows."""
        # the last row has a next one no more
        at = np.clip((d_px - self.d_px[0]) / STEP_PX, 0.0, len(self.d_px) - 1.001)
        row = at.astype(np.intp)
        rows, fraction = self.rows[filter_index], (at - row)[..., None]
        return np.asarray(rows[row] * (1.0 - fraction) + rows[row + 1] * fraction)


def limb_angle_rad(s: Array, radius_m: float) -> float:
    """a0 = asin(R / |s|), radians."""
    return float(np.arcsin(radius_m / np.linalg.norm(s)))


def limb_of(rig: Rig, s: Array, blur_px2: float) -> Limb:
    """Light across the limb of a sphere at `s`.

    Parameters
    ----------
    rig : Rig
        For radius, steel, focal length, focus and filters.
    s : shape (3,), metres
    blur_px2 : float
        Variance of the lens's blur, besides defocus and pixel.
    """
    camera, distance = rig.camera, float(np.linalg.norm(s))
    a0 = limb_angle_rad(s, rig.sphere.radius_m)
    scale = np.sqrt(camera.fx_px * camera.fy_px) / np.cos(a0) ** 2  # pixels per radian across the limb
    d = distances_px()
    miss = distance / rig.sphere.radius_m * np.sin(a0 + d / scale)  # sine of the angle of incidence
    cos_i = np.sqrt(np.clip(1.0 - miss * miss, 0.0, None))
    kernel = line_spread(camera, distance * np.cos(a0) ** 2, blur_px2)
    light, turned, squared = [], [], []
    turn = 2.0 * np.arcsin(cos_i)
    for wavelength_nm in camera.detector.band_wavelength_nm:
        sharp = np.where(d < 0.0, rig.mirror.reflectance(cos_i, wavelength_nm), 1.0)
        light.append(blurred_light(sharp, kernel))
        turned.append(blurred_light(sharp * turn, kernel))
        squared.append(blurred_light(sharp * turn**2, kernel))
    table = np.array(light)
    slope = np.gradient(table, STEP_PX, axis=-1)
    return Limb(d, table, slope, np.gradient(slope, STEP_PX, axis=-1), np.array(turned), np.array(squared))


def distances_px() -> Array:
    """Distances from an outline of a table of its light, evenly spaced, shape (n,)."""
    return np.asarray(np.arange(-_REACH_PX, _REACH_PX + STEP_PX / 2.0, STEP_PX))


def line_spread(camera: Camera, depth_m: float, blur_px2: float) -> Array:
    """Line spread at the table's steps: Gaussian for lens and pixel, and the projection of the disc of defocus."""
    x = np.arange(-8.0, 8.0 + STEP_PX / 2.0, STEP_PX)
    kernel = np.exp(-0.5 * x * x / (blur_px2 + _PIXEL_VARIANCE_PX2))
    disc_px = camera.aperture_radius_m * camera.fx_px * abs(1.0 / camera.focus_distance_m - 1.0 / depth_m)
    if disc_px > 2.0 * STEP_PX:
        half = len(x) // 2
        kernel = convolution(np.pad(kernel, half), np.sqrt(np.clip(disc_px**2 - x * x, 0.0, None)))
    return np.asarray(kernel / kernel.sum())


def blurred_light(sharp: Array, kernel: Array) -> Array:
    """Light of a table, shape (n,), through a line spread."""
    half = len(kernel) // 2
    padded = np.concatenate([np.full(half, sharp[0]), sharp, np.full(half, sharp[-1])])
    return convolution(padded, kernel)


def convolution(values: Array, kernel: Array) -> Array:
    """Convolution where the kernel lies within the values, by FFT: what `scipy.signal`, slow to import, gives."""
    length = fft.next_fast_len(len(values), real=True)
    product = fft.rfft(values, length) * fft.rfft(kernel, length)
    return np.asarray(fft.irfft(product, length)[len(kernel) - 1 : len(values)])
