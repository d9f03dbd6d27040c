"""Candidates for a spot in one image: a matched-filter map of every half pixel, and a test of its peaks.

Map. Amplitude of a spot of the profile k (pixel-integrated Gaussian) at a place: A = sum(k d) / sum(k^2), its variance
V / sum(k^2), over the sites of the red plane; d is the light above the background. The background is the laser-off
frame where there is one. Otherwise it is green, scaled to the local ratio of red and green, because the room's light is
not as red as the laser; without filters it is the mean of the surroundings.

Test. At each place and for each plane: least squares of a spot's profile on a tilted background, over a patch. The
significance is amplitude over standard deviation, divided by sqrt(chi^2) where the model does not fit. Edges, lines and
corners of the room match a spot a little and its surroundings not at all: with p pixels and a correlation c between
structure and profile, the significance cannot pass c sqrt(p / (1 - c^2)) by what lies beside the profile. In chi^2 a
pixel of the spot has its shot noise and a tenth of its light as further noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate1d, uniform_filter
from skimage.feature import peak_local_max

from phibench.datasets.frames.sensor_card import SensorCard
from phibench.estimator.spots.gaussian_spot import outer, profile
from phibench.estimator.spots.image_planes import ColourPlanes, green_at_red, variance_e2
from phibench.scenes.frames import Array, BoolArray

# -- map of a matched filter -----------------------------------------------------------------------------------------

_KERNEL_REACH_PX = 4
_PHASES = (0.0, 0.5)  # of a pixel: the matched filter loses little at a quarter of one
_AROUND_PX, _CORE_PX = 13, 5  # of the surroundings that a background is taken from, and what is left out of them
# coarse chroma spreads red into green: what is taken off would move the peak
_GREEN_TAKEN = {"raw": 1.0, "srgb8": 1.0, "yuyv": 0.0, "mjpeg": 0.0}
_NOISE = 0.70  # standard deviation of the highest of the four phases for pure noise, measured


@dataclass(frozen=True)
class Peaks:
    """Local maxima of the map, highest first; (u, v) relative to the part, shape (n, 2), and z, shape (n,)."""

    uv_px: Array
    z: Array


def peaks(
    on: ColourPlanes,
    off: ColourPlanes | None,
    card: SensorCard,
    sigma_px: float,
    inside: BoolArray,
    least_z: float,
    most: int,
) -> Peaks:
    """Strongest local maxima of the map.

    Parameters
    ----------
    on, off : ColourPlanes
        Laser on and, if there is one, off.
    sigma_px : float
        Blur in the planes.
    inside : shape (h, w)
        Where to look.
    least_z : float
        In standard deviations of the noise; of processed images, of the map's.
    """
    light, variance = _above_background(on, off, card)
    z, phase = _highest_phase(light, variance, on, sigma_px)
    z = np.where(inside, z / (1.0 if card.output == "raw" else _map_spread(z, inside)), np.float32(0.0))
    vu = peak_local_max(  # type: ignore[no-untyped-call]
        z, min_distance=2, threshold_abs=least_z, exclude_border=False, num_peaks=most
    )
    at = (vu[:, 0], vu[:, 1])
    shift = np.stack([phase[at] % 2, phase[at] // 2], axis=-1) * _PHASES[1]
    return Peaks(vu[:, ::-1] + shift, z[at])


def _above_background(on: ColourPlanes, off: ColourPlanes | None, card: SensorCard) -> tuple[Array, Array]:
    """Red light above the background, shape (h, w), zero where there is no site, and the variance of a pixel."""
    if off is not None:
        level = np.maximum(on.values_e[0], off.values_e[0])
        return _flat(on.values_e[0] - off.values_e[0], on), 2.0 * _variance(level, on, card, True)
    if len(on.values_e) == 1:
        return _flat(on.values_e[0], on), _variance(on.values_e[0], on, card, False)
    red, green = on.values_e[0], green_at_red(on)
    ratio = _mean(red, on, _AROUND_PX) / np.maximum(_mean(green, on, _AROUND_PX), 1.0)
    ratio *= _GREEN_TAKEN[card.output]
    light = _flat(np.where(on.sites[0], red - ratio * green, np.float32(0.0)), on)
    share = 0.25 if on.mosaic else 1.0  # four green neighbours are averaged
    return light, _variance(red, on, card, False) + share * ratio**2 * _variance(green, on, card, False)


def _flat(plane: Array, on: ColourPlanes) -> Array:
    """Plane less the mean of its surroundings, the core left out."""
    outer, core = _mean(plane, on, _AROUND_PX), _mean(plane, on, _CORE_PX)
    # mean of the ring: the mean of the outer square less that of the core, by their areas
    share = (_CORE_PX / _AROUND_PX) ** 2
    return np.where(on.sites[0], plane - (outer - share * core) / (1.0 - share), 0.0)


def _mean(plane: Array, on: ColourPlanes, side: int) -> Array:
    """Mean over the red sites of a square, known at every pixel; of a mosaic as near to the side as whole sites go."""
    if not on.mosaic:
        return uniform_filter(plane, side)
    # red sites are a plane of half the size; an odd window keeps its middle
    result = np.repeat(np.repeat(uniform_filter(plane[::2, ::2], side // 2 + 1 - side // 2 % 2), 2, 0), 2, 1)
    return result[: plane.shape[0], : plane.shape[1]]


def _variance(plane: Array, on: ColourPlanes, card: SensorCard, alike: bool) -> Array:
    return np.asarray(variance_e2(_mean(plane, on, _CORE_PX), card, alike), np.float32)


def _highest_phase(
    light: Array, variance: Array, on: ColourPlanes, sigma_px: float
) -> tuple[NDArray[np.float32], NDArray[np.int8]]:
    """Largest z over the places (u, v) + (0 or 1/2, 0 or 1/2), and which it was: 2 x (row's half) + column's half."""
    count = 2 * _KERNEL_REACH_PX + 1
    centres = _KERNEL_REACH_PX + np.array(_PHASES)
    kernels = profile(centres, np.full(2, sigma_px), count).share.astype(np.float32)
    best: NDArray[np.float32] = np.full(light.shape, -np.inf, np.float32)
    which: NDArray[np.int8] = np.zeros(light.shape, np.int8)
    scale = np.sqrt(variance)
    for i, down in enumerate(kernels):
        rows = _correlated(light, down, 0)
        for j, across in enumerate(kernels):
            # sqrt(sum of kernel^2) over the sites that hold a value: standard deviation of pure noise becomes 1
            norm = np.sqrt(np.outer(_squares(down, on, 0), _squares(across, on, 1)))
            z = _correlated(rows, across, 1) / (scale * norm.astype(np.float32))
            higher = z > best
            np.copyto(best, z, where=higher)
            np.copyto(which, np.int8(2 * i + j), where=higher)
    return best, which


def _correlated(plane: Array, kernel: Array, axis: int) -> Array:
    return np.asarray(correlate1d(plane, kernel, axis=axis, mode="constant"))


def _squares(kernel: Array, on: ColourPlanes, axis: int) -> Array:
    """Sum of k^2 over the red sites around each row (axis 0) or column, shape (h,) or (w,); (1,) if all are alike."""
    site = (np.arange(on.shape[axis]) % 2 == 0) if on.mosaic else np.ones(on.shape[axis], bool)
    # the border counts as if the sites went on: a spot cut by the image's edge is then only underrated
    return np.asarray(correlate1d(site.astype(float), kernel**2, mode="wrap"))[: None if on.mosaic else 1]


def _map_spread(z: NDArray[Any], inside: BoolArray) -> float:
    """Scale of the map, 1 for independent noise of the variance that was taken."""
    values = z[::3, ::3][inside[::3, ::3]]
    # 1.4826 times the median deviation is the standard deviation of a normal law; spots and edges leave it alone
    spread = 1.4826 * np.median(np.abs(values - np.median(values))) if values.size else 1.0
    return float(max(spread / _NOISE, 0.5))


# -- test of places --------------------------------------------------------------------------------------------------

# of a patch: of a mosaic, where a quarter of the pixels are red, and of whole planes
_PATCH_REACH_PX = {True: 6, False: 4}
# of white light's green: where red ends; the laser's is 0.1, but for coarse chroma
_GREEN_SHARE = {"raw": 0.5, "srgb8": 0.5, "yuyv": 0.75, "mjpeg": 0.75}
_FULLER = 0.5  # of the red's share of full pixels: green that is as full says white
_OUTSHINES = 0.7  # peak of a spot over the level around it, more than the contrast of walls and furniture
_LATTICE_PX = 17  # odd: all phases of the mosaic and of JPEG's blocks occur
_CHI2_SHARE = 0.75  # of places without a spot that count as fitted well: JPEG leaves many all but empty
_SHAPE = 0.1  # of a spot's light in a pixel: what blur, defocus and demosaicing leave unknown of it
_FULL_PX = 3  # a saturated spot is not wider


@dataclass(frozen=True)
class Candidates:
    """Tested places, n of them.

    Attributes
    ----------
    uv_px : shape (n, 2), relative to the part
    z : shape (n,), significance in the red plane
    electrons : shape (n,), amplitude there; too low where pixels are full
    sigma_e : shape (n,), standard deviation of `electrons`
    chi2 : shape (n,), per degree of freedom
    red : shape (n,), bool; True without filters, and where there is a laser-off frame
    """

    uv_px: Array
    z: Array
    electrons: Array
    sigma_e: Array
    chi2: Array
    red: BoolArray


@dataclass(frozen=True)
class CandidateNoise:
    """Result of tests at places without a spot: not 1 for pixels that processing correlates.

    Attributes
    ----------
    spread : float
        Standard deviation of the significance.
    chi2 : float
        Usual chi^2 per degree of freedom.
    """

    spread: float = 1.0
    chi2: float = 1.0


@dataclass(frozen=True)
class _Fit:
    """Amplitude, variance and chi^2 per degree of freedom, shape (n,) each."""

    amplitude: Array
    variance: Array
    chi2: Array


def candidates_at(
    on: ColourPlanes,
    off: ColourPlanes | None,
    card: SensorCard,
    uv_px: Array,
    sigma_px: float,
    noise: CandidateNoise = CandidateNoise(),
) -> Candidates:
    """Test places.

    Parameters
    ----------
    on, off : ColourPlanes
    uv_px : shape (n, 2), relative to the part
    sigma_px : float
        Blur in the planes.
    """
    reach = _PATCH_REACH_PX[on.mosaic]
    corner = np.rint(uv_px).astype(int) - reach
    template = _template(uv_px - corner, sigma_px, reach)
    # what the laser-off frame does not hold is the laser's, whatever its colour looks like
    count = 2 if off is None and len(on.values_e) > 1 else 1
    fits = [_fitted(on, off, card, c, corner, template) for c in range(count)]
    red = fits[0]
    if off is None and count == 2 and card.output != "raw":
        red = _bright_or(red, on, card, corner, template)
    z = red.amplitude / np.sqrt(red.variance * np.maximum(red.chi2 / noise.chi2, 1.0)) / noise.spread
    colour = _red([red, *fits[1:]], card) | _fuller(on, uv_px) if len(fits) > 1 else np.ones(len(z), bool)
    return Candidates(uv_px, z, red.amplitude, np.sqrt(red.variance) * noise.spread, red.chi2, colour)


def candidate_noise(
    on: ColourPlanes,
    off: ColourPlanes | None,
    card: SensorCard,
    sigma_px: float,
    inside: BoolArray,
    frames: tuple[int, int] = (1, 1),
) -> CandidateNoise:
    """Result of tests all over the part, where there is no spot; of raw pixels the noise is known.

    `frames` are those with the laser on, and off, of which the planes are means.
    """
    places = lattice(inside, _LATTICE_PX)
    if card.output == "raw" or not len(places):
        if off is None:
            return CandidateNoise(frames[0] ** -0.5, 1.0 / frames[0])
        # no structure is left that the misfit of a mean, small against that of one frame, would have to tell
        return CandidateNoise(float(np.sqrt(0.5 / frames[0] + 0.5 / frames[1])))
    tests = candidates_at(on, off, card, places, sigma_px)
    chi2 = float(max(np.quantile(tests.chi2, _CHI2_SHARE), 0.1))  # noise-free and empty JPEG places have none
    # significances as they will be with this usual misfit in place of 1
    z = tests.z * np.sqrt(np.maximum(tests.chi2, 1.0) / np.maximum(tests.chi2 / chi2, 1.0))
    return CandidateNoise(max(_tail_spread(z), 0.5), chi2)


def _tail_spread(z: Array) -> float:
    """Standard deviation of a normal law with the middle, or with the tails of `z`, whichever is wider."""
    tail = np.max(np.abs(np.quantile(z, (0.01, 0.99)))) / 2.326  # quantile 0.99 of the normal law
    return float(max(1.4826 * np.median(np.abs(z - np.median(z))), tail))


def lattice(inside: BoolArray, step_px: int) -> Array:
    """Places all over the part, shape (n, 2): where the noise of a test is measured. Odd steps see every phase."""
    half = step_px // 2
    v, u = np.nonzero(inside[half::step_px, half::step_px])
    return np.asarray(np.stack([u, v], axis=-1) * float(step_px) + half, float)


def _template(centre_px: Array, sigma_px: float, reach: int) -> Array:
    n, count = len(centre_px), 2 * reach + 1
    across, down = (profile(centre_px[:, i], np.full(n, sigma_px), count).share for i in (0, 1))
    return outer(down, across)


def _bright_or(guided: _Fit, on: ColourPlanes, card: SensorCard, corner: Array, template: Array) -> _Fit:
    """Fits without green where the spot outshines the room: processing spreads a bright spot into green."""
    plain = _fitted(on, None, card, 0, corner, template, guided=False)
    size = template.shape[1]
    level = _middle(_patches(on.values_e[0], corner, size), _patches(on.sites[0], corner, size))
    bright = plain.amplitude * template.max(axis=(1, 2)) > _OUTSHINES * np.maximum(level, 1.0)
    pairs = ((plain.amplitude, guided.amplitude), (plain.variance, guided.variance), (plain.chi2, guided.chi2))
    return _Fit(*(np.where(bright, a, b) for a, b in pairs))


def _fitted(
    on: ColourPlanes,
    off: ColourPlanes | None,
    card: SensorCard,
    c: int,
    corner: Array,
    template: Array,
    guided: bool = True,
) -> _Fit:
    """Fit of one plane on patches; without a laser-off frame red's background may look like green (`guided`)."""
    size = template.shape[1]
    y, used = _patches(on.values_e[c], corner, size), _patches(on.sites[c], corner, size)
    level = _level(y, used)
    columns = [template]
    if off is not None:
        dark = _patches(off.values_e[c], corner, size)
        # noise of a difference: twice that of the darker frame
        y, level = y - dark, np.maximum(dark, _middle(dark, used)[:, None, None])
    elif guided and c == 0 and len(on.values_e) > 1:
        guide = _patches(green_at_red(on), corner, size)
        middle = _middle(guide, used)[:, None, None]
        level = np.maximum(level, guide * _middle(y, used)[:, None, None] / np.maximum(middle, 1.0))
        # structure of the room as green shows it, about 0, so that the level stays in the constant
        columns.append(guide / np.maximum(middle, 1.0) - 1.0)
    variance = (1.0 if off is None else 2.0) * variance_e2(level, card, off is not None)
    return _least_squares(y, used / variance, np.stack(columns, axis=1))


def _level(y: Array, used: Array) -> Array:
    """Level that a pixel's noise belongs to, without a spot: its own outside the core, the median or more inside."""
    far = np.abs(np.arange(y.shape[1]) - y.shape[1] // 2) > _FULL_PX
    middle = _middle(y, used)[:, None, None]
    return np.asarray(np.where(far[:, None] | far, np.maximum(y, middle), middle))


def _least_squares(y: Array, weight: Array, columns: Array) -> _Fit:
    """First of the columns, shape (n, k, p, p), beside the others and a tilted background."""
    n, k, size = columns.shape[:3]
    slope = np.linspace(-1.0, 1.0, size)
    ones = np.ones((size, size))
    # background of a patch: a constant and a slope along both axes
    plane = np.stack([ones, ones * slope, ones * slope[:, None]]).reshape(3, size * size)
    flat_columns = columns.reshape(n, k, size * size)
    X = np.concatenate([flat_columns, np.broadcast_to(plane, (n, *plane.shape))], axis=1)
    w, flat = weight.reshape(n, 1, size * size), y.reshape(n, size * size)
    normal = (X * w) @ np.swapaxes(X, 1, 2)
    normal = normal + 1e-12 * np.eye(k + 3)  # a patch of no weight is singular
    solution = np.linalg.solve(normal, (X * w) @ flat[..., None])[..., 0]
    rest = flat - (solution[:, None] @ X)[:, 0]
    freedom = np.maximum((w[:, 0] > 0.0).sum(axis=1) - k - 3, 1)
    # a bright spot's own shot noise, and its shape, which is known to a part only, are no reason to doubt it
    own = np.maximum(solution[:, :1], 0.0) * flat_columns[:, 0]
    trust = w[:, 0] / (1.0 + w[:, 0] * (own + (_SHAPE * own) ** 2))
    chi2 = np.sum(trust * rest * rest, axis=1) / freedom
    return _Fit(solution[:, 0], np.linalg.inv(normal)[:, 0, 0], chi2)


def _patches(plane: Array, corner: Array, size: int) -> Array:
    """Squares of a plane, shape (n, size, size); zero, and so no site, beyond its border."""
    reach = np.arange(size)
    v, u = corner[:, 1, None] + reach, corner[:, 0, None] + reach
    inside_v, inside_u = (v >= 0) & (v < plane.shape[0]), (u >= 0) & (u < plane.shape[1])
    rows, columns = np.clip(v, 0, plane.shape[0] - 1), np.clip(u, 0, plane.shape[1] - 1)
    values = plane[rows[:, :, None], columns[:, None, :]]
    return np.where(inside_v[:, :, None] & inside_u[:, None, :], values, 0).astype(float)


def _middle(y: Array, used: Array) -> Array:
    """Median of the used pixels, shape (n,); that of whole frames' patches, which use a fixed share of them."""
    rising = np.sort(np.where(used > 0.0, y, np.inf).reshape(len(y), y.shape[1] * y.shape[2]), axis=1)
    middle = np.maximum((used > 0.0).sum(axis=(1, 2)) - 1, 0) // 2
    value = np.take_along_axis(rising, middle[:, None], axis=1)[:, 0]
    return np.where(np.isfinite(value), value, 0.0)


def _red(fits: list[_Fit], card: SensorCard) -> BoolArray:
    """Places whose green is below half of what white light of this red would have, within one standard deviation."""
    # on processed planes white has equal codes; here in electrons, before white balance
    share = _GREEN_SHARE[card.output] * card.white_balance[0] / card.white_balance[1]
    red, green = fits[0], fits[1]
    sigma = np.sqrt(green.variance * np.maximum(green.chi2, 1.0) + share**2 * red.variance * np.maximum(red.chi2, 1.0))
    return np.asarray(green.amplitude < share * red.amplitude + sigma)


def _fuller(on: ColourPlanes, uv_px: Array) -> BoolArray:
    """Places where far more red than green pixels are full: too bright for the amplitude to tell the colour."""
    corner, size = np.rint(uv_px).astype(int) - _FULL_PX, 2 * _FULL_PX + 1
    shares = []
    for c in (0, 1):
        full, sites = (_patches(planes[c], corner, size).sum(axis=(1, 2)) for planes in (on.full, on.sites))
        shares.append(full / np.maximum(sites, 1.0))
    return np.asarray((shares[0] > 0.0) & (shares[1] < _FULLER * shares[0]))
