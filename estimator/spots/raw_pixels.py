"""Raw pixels as an estimator sees them: electrons, filters, noise, the law of a reading, and the background of a spot.

Conventions: integer (u, v) are pixel centres; RGGB, red at even row and even column of the image; values in electrons;
arrays of regions have the shape (n, h, w): spot, row, column.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import gaussian_filter

from phibench.datasets.frames.sensor_card import SensorCard
from phibench.scenes.frames import Array, BoolArray


@dataclass(frozen=True)
class PixelNoise:
    """Variance of a pixel with the mean mu: mu + gaussian_e2 + (prnu mu)^2, electrons squared.

    Parameters
    ----------
    gaussian_e2 : float
        What does not depend on the light: read noise, DSNU, rounding.
    prnu : float
        Relative spread of the responsivity that nobody has calibrated.
    """

    gaussian_e2: float
    prnu: float = 0.0

    def __post_init__(self) -> None:
        if not self.gaussian_e2 >= 0.0 or not 0.0 <= self.prnu < 1.0:
            raise ValueError(
                f"PixelNoise: gaussian_e2 = {self.gaussian_e2:g} must be 0 or above and prnu = {self.prnu:g} in [0, 1)"
            )

    def variance_e2(self, mean_e: Array) -> Array:
        """Variance for means of any shape; a mean below 0, which a fit may try, counts as 0."""
        mean = np.maximum(mean_e, 0.0)
        return mean + self.gaussian_e2 + (self.prnu * mean) ** 2


def noise_of(card: SensorCard, pattern_known: bool = False) -> PixelNoise:
    """Noise of a sensor's pixels.

    Parameters
    ----------
    pattern_known : bool
        PRNU and DSNU of the camera were calibrated and taken out; otherwise they count as noise.

    Raises
    ------
    ValueError
        If the sensor has row noise, which is common to the pixels of a row, or no shot noise.
    """
    if card.row_noise_e > 0.0 or not card.shot_noise:
        raise ValueError(
            f"sensor '{card.name}': row_noise_e = {card.row_noise_e:g}, shot_noise = {card.shot_noise}; independent "
            "pixels need row_noise_e = 0 and shot noise; bounds and likelihoods of others are not known"
        )
    rounding_e2 = 1.0 / (12.0 * card.dn_per_e**2)  # uniform over one code of the converter
    fixed_e2 = 0.0 if pattern_known else card.dsnu_e**2
    return PixelNoise(card.read_noise_e**2 + fixed_e2 + rounding_e2, 0.0 if pattern_known else card.prnu)


def noise_before_rounding(card: SensorCard, pattern_known: bool = False) -> PixelNoise:
    """Noise of a sensor's pixels before the converter rounds; errors as `noise_of`."""
    noise = noise_of(card, pattern_known)
    # rounding is in `noise_of`
    return PixelNoise(max(noise.gaussian_e2 - 1.0 / (12.0 * card.dn_per_e**2), 0.0), noise.prnu)


@dataclass(frozen=True)
class PatternNoise:
    """Fixed pattern of a camera, the same in all its frames: dsnu_e2 + (prnu mu)^2, electrons squared."""

    dsnu_e2: float
    prnu: float

    @classmethod
    def of(cls, card: SensorCard) -> PatternNoise:
        """Pattern of a sensor."""
        return cls(card.dsnu_e**2, card.prnu)

    def variance_e2(self, mean_e: Array) -> Array:
        """Variance for means of any shape."""
        return np.asarray(self.dsnu_e2 + (self.prnu * np.maximum(mean_e, 0.0)) ** 2)


def raw_electrons(dn: NDArray[Any], card: SensorCard) -> Array:
    """Electrons of DN: black level taken off, divided by the system gain."""
    return (np.asarray(dn, float) - card.black_level_dn) / card.dn_per_e


def bayer_filters(origin_px: ArrayLike, shape: tuple[int, int]) -> NDArray[np.int64]:
    """Filter of each pixel, 0, 1, 2 for R, G, B, shape (n, h, w).

    Parameters
    ----------
    origin_px : shape (n, 2)
        Image pixel (u, v) of each region's first column and row.
    shape : (h, w)
    """
    origin = np.asarray(origin_px, np.int64)
    v = (origin[:, 1, None] + np.arange(shape[0])) % 2
    u = (origin[:, 0, None] + np.arange(shape[1])) % 2
    return v[:, :, None] + u[:, None, :]


# -- regions and the law of their pixels -----------------------------------------------------------------------------


@dataclass(frozen=True)
class SpotRegions:
    """Raw pixels around n spots.

    Attributes
    ----------
    x_e : shape (n, h, w), electrons; 0 where a reading is not finite
    origin_px : shape (n, 2), image pixel (u, v) of the first column and row
    used : shape (n, h, w), bool
    finite : shape (n,), bool; whether all readings are
    phase : (du, dv)
        Red lies where u + du and v + dv are even.
    """

    x_e: Array
    origin_px: NDArray[np.int64]
    used: BoolArray
    finite: BoolArray
    phase: tuple[int, int] = (0, 0)

    def __len__(self) -> int:
        return len(self.x_e)

    def rows(self, index: NDArray[np.int64]) -> SpotRegions:
        """Some of the regions."""
        return SpotRegions(self.x_e[index], self.origin_px[index], self.used[index], self.finite[index], self.phase)

    @property
    def filters(self) -> NDArray[np.int64]:
        """Filter of each pixel of a mosaic, shape (n, h, w)."""
        return bayer_filters(self.origin_px + self.phase, (self.x_e.shape[1], self.x_e.shape[2]))


def spot_regions(
    x_e: ArrayLike, origin_px: ArrayLike, used: ArrayLike = True, phase: tuple[int, int] = (0, 0)
) -> SpotRegions:
    """Regions of some readings; what is not finite is left out.

    Parameters
    ----------
    x_e : shape (n, h, w), electrons, black level off (`raw_electrons`)
    origin_px : shape (2,) or (n, 2)
        Image pixel (u, v) of the first column and row: where the mosaic's red pixels are.
    used : bool, shape (n, h, w) or one that broadcasts to it
        Pixels that are not left out, such as those below saturation.
    phase : (du, dv)
        Of the mosaic: red lies where u + du and v + dv are even.

    Raises
    ------
    ValueError
        If the readings have no shape (n, h, w) of 3 x 3 pixels or more.
    """
    x = np.asarray(x_e, float)
    if x.ndim != 3 or min(x.shape[1:]) < 3:
        raise ValueError(f"regions have the shape {x.shape}: (n, h, w) of 3 x 3 pixels or more is needed")
    finite = np.isfinite(x)
    origin = np.broadcast_to(np.asarray(origin_px, np.int64), (len(x), 2))
    whole = np.asarray(finite.all(axis=(1, 2)))
    return SpotRegions(np.where(finite, x, 0.0), origin, finite & np.asarray(used, bool), whole, phase)


class PixelLaw(Protocol):
    """Law of one pixel's reading x, given its mean: score, information and misfit."""

    def rows(self, index: NDArray[np.int64]) -> PixelLaw:
        """Law of some of the spots."""

    def score(self, x: Array, mean: Array) -> Array:
        """Derivative of the log likelihood by the mean."""

    def information(self, mean: Array) -> Array:
        """Mean square of the score."""

    def misfit(self, x: Array, mean: Array) -> Array:
        """-2 log likelihood, up to a constant of the pixel."""


@dataclass(frozen=True)
class GaussLaw:
    """Gaussian quasi-likelihood of a mean of frames, with the variance V(mu) / frames + (prnu (mu - room))^2 + extra.

    Parameters
    ----------
    noise : PixelNoise
        V, of one frame.
    extra_e2 : float or shape (n, h, w)
        Variance that does not depend on the mean, such as that of a background; all frames share it.
    frames : int
        That the readings are means of.
    prnu : float
        Relative spread of the responsivity, of the light above `room_e` and the same in all frames; besides that in V.
    room_e : float or shape (n, h, w)
        Light whose pattern is not to be counted, because the background holds it.
    """

    noise: PixelNoise
    extra_e2: float | Array = 0.0
    frames: int = 1
    prnu: float = 0.0
    room_e: float | Array = 0.0

    def rows(self, index: NDArray[np.int64]) -> GaussLaw:
        """Law of some of the spots."""
        extra, room = (x[index] if isinstance(x, np.ndarray) else x for x in (self.extra_e2, self.room_e))
        return replace(self, extra_e2=extra, room_e=room)

    def score(self, x: Array, mean: Array) -> Array:
        """(x - mu) / V."""
        return (x - mean) * self.information(mean)

    def information(self, mean: Array) -> Array:
        """1 / V."""
        variance = self.noise.variance_e2(mean) / self.frames + self.extra_e2
        return np.asarray(1.0 / (variance + (self.prnu * (mean - self.room_e)) ** 2))

    def misfit(self, x: Array, mean: Array) -> Array:
        """(x - mu)^2 / V + log V."""
        information = self.information(mean)
        return np.asarray((x - mean) ** 2 * information - np.log(information))


# -- background ------------------------------------------------------------------------------------------------------

_SIGMA_PX = 2.5  # of the local mean, pixels of one phase: 5 pixels of the image
_HIDDEN_PX = 5.0  # radius around the spot that the laser-on frame says nothing about
_LEAST_WEIGHT = 1e-6  # keeps quotients finite where nothing around is known


@dataclass(frozen=True)
class Background:
    """Background of n regions: the room behind a spot, and what is not known of it.

    Attributes
    ----------
    mean_e : shape (n, h, w)
    variance_e2 : shape (n, h, w)
        Of its error, taken as independent from pixel to pixel.
    image : shape (n, h, w, 3) or, of f frames, (n, f, h, w, 3), uint8, optional
        The decoded JPEG frames that it was taken from.
    holds_pattern : bool
        The error is that of the room as this camera's pixels see it: PRNU and DSNU of the room are counted here.
    """

    mean_e: Array
    variance_e2: Array
    image: NDArray[Any] | None = None
    holds_pattern: bool = False


def background_of(x_e: Array, variance_e2: Array, known: Array, pattern: PatternNoise | None = None) -> Background:
    """Smooth images without the spot, or around it.

    Each of the mosaic's four phases is smoothed as strongly as its local variance allows (adaptive Wiener filter: J. S.
    Lim, "Two-Dimensional Signal and Image Processing", 1990, section 9.2). Where the room is flat, the background has
    next to no noise.

    Parameters
    ----------
    x_e : shape (n, h, w), electrons of each pixel's own colour
    variance_e2 : shape (n, h, w), of its noise
    known : shape (n, h, w), 0 or 1
        0 where the image says nothing about the background. What surrounds it is carried on, and its structure counts
        as variance.
    pattern : PatternNoise, optional
        Of the camera, where `variance_e2` leaves it out: a structure that every room has at least.
    """
    least = np.zeros(x_e.shape) if pattern is None else pattern.variance_e2(x_e)
    mean, variance = np.empty(x_e.shape), np.empty(x_e.shape)
    for row in (0, 1):
        for column in (0, 1):
            at = (slice(None), slice(row, None, 2), slice(column, None, 2))
            mean[at], variance[at] = _of_phase(x_e[at], variance_e2[at], np.asarray(known, float)[at], least[at])
    return Background(mean, variance, holds_pattern=pattern is not None)


def outside_spot(uv_px: Array, origin_px: Array, shape: tuple[int, int]) -> Array:
    """Pixels farther than 5 px from (u, v), shape (n, h, w), 0 or 1; positions and origins of shape (n, 2)."""
    v = np.arange(shape[0]) + origin_px[:, 1, None] - uv_px[:, 1, None]
    u = np.arange(shape[1]) + origin_px[:, 0, None] - uv_px[:, 0, None]
    return (v[:, :, None] ** 2 + u[:, None, :] ** 2 > _HIDDEN_PX**2).astype(float)


def _of_phase(x: Array, noise: Array, known: Array, least: Array) -> tuple[Array, Array]:
    weight = np.maximum(_smooth(known), _LEAST_WEIGHT)
    local = _smooth(known * x) / weight
    spread = _smooth(known * (x - local) ** 2) / weight
    typical = _smooth(known * noise) / weight
    structure = np.maximum(spread - typical, _smooth(known * least) / weight)
    gain = known * structure / np.maximum(structure + typical, _LEAST_WEIGHT)
    # local + gain (x - local) errs by the pixel's own noise times the gain; the rest is a Gaussian mean, whose variance
    # falls by 4 pi sigma^2. A pixel that is not known has the structure itself as its error.
    left = np.where(known > 0.0, (gain + (1.0 - gain) / (4.0 * np.pi * _SIGMA_PX**2)) * typical, structure)
    return local + gain * (x - local), left


def _smooth(x: Array) -> Array:
    return np.asarray(gaussian_filter(x, (0.0, _SIGMA_PX, _SIGMA_PX), mode="nearest"))
