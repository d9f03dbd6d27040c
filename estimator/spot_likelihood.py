"""Score, Fisher matrix and misfit of one spot per region on raw pixels: the model and the noise law of `fit_raw`.

mu = flux x response x (Gaussian blur integrated over the pixel) + background of the pixel's filter; unknowns
theta = u, v (of the image), flux, backgrounds. Axes of regions are spot, row, column.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phibench.estimator.gaussian_spot import spot_images
from phibench.estimator.raw_pixels import PixelNoise, bayer_filters
from phibench.scenes.frames import Array, BoolArray


@dataclass(frozen=True)
class SpotRegions:
    """Regions of one image position.

    Attributes
    ----------
    x : shape (n, h, w), electrons
    used : shape (n, h, w), bool
    response : shape (n, h, w), of each pixel's filter at the laser's wavelength
    levels : shape (n, c, h, w), 1 where a pixel has that background level
    origin_px : shape (n, 2), image pixel (u, v) of the first column and row
    noise : PixelNoise
    extra_e2 : shape (n, h, w)
        Variance besides that of `noise`, such as a subtracted frame's.
    sigma_px, ratio, mixed_px2 : shape (n,)
        Blur along u, that along v over it, and its mixed second moment.
    """

    x: Array
    used: BoolArray
    response: Array
    levels: Array
    origin_px: NDArray[np.int64]
    noise: PixelNoise
    extra_e2: Array
    sigma_px: Array
    ratio: Array
    mixed_px2: Array

    def __len__(self) -> int:
        return len(self.x)

    def rows(self, index: NDArray[np.int64]) -> SpotRegions:
        """Regions of some of the spots."""
        names = ("x", "used", "response", "levels", "origin_px", "extra_e2", "sigma_px", "ratio", "mixed_px2")
        return replace(self, **{name: getattr(self, name)[index] for name in names})

    @property
    def unknowns(self) -> int:
        """How many unknowns a region has: 3 + c."""
        return 3 + self.levels.shape[1]


def spot_regions(
    x: Array,
    origin_px: ArrayLike,
    noise: PixelNoise,
    sigma_px: ArrayLike,
    response: tuple[float, float, float] | None,
    saturation_e: float = np.inf,
    extra_e2: ArrayLike = 0.0,
    ratio: ArrayLike = 1.0,
    mixed_px2: ArrayLike = 0.0,
) -> SpotRegions:
    """Regions as `fit_raw` takes them; pixels that are not finite or from `saturation_e` on are left out.

    Raises
    ------
    ValueError
        If the regions have no shape (n, h, w) of 3 x 3 pixels or more.
    """
    data = np.asarray(x, float)
    if data.ndim != 3 or min(data.shape[1:]) < 3:
        raise ValueError(f"regions have the shape {data.shape}: (n, h, w) of 3 x 3 pixels or more is needed")
    n = len(data)
    origin = np.broadcast_to(np.asarray(origin_px, np.int64), (n, 2))
    filters = np.zeros(data.shape, np.int64) if response is None else bayer_filters(origin, data.shape[1:])
    weights = np.ones(1) if response is None else np.array(response)
    levels = (filters[:, None] == np.arange(len(weights))[:, None, None]).astype(float)
    used = np.isfinite(data) & (np.nan_to_num(data, nan=np.inf) < saturation_e)
    extra = np.broadcast_to(np.asarray(extra_e2, float), data.shape)
    blur = (np.broadcast_to(np.asarray(value, float), n) for value in (sigma_px, ratio, mixed_px2))
    return SpotRegions(np.where(used, data, 0.0), used, weights[filters], levels, origin, noise, extra, *blur)


def scores(data: SpotRegions, theta: Array) -> tuple[Array, Array]:
    """Score, shape (n, k), and Fisher matrix, shape (n, k, k), at unknowns of shape (n, k)."""
    mean, derivatives = _model(data, theta)
    n, k = theta.shape
    weight = data.used / _variance(data, mean)
    flat = derivatives.reshape(n, k, -1)
    weighted = flat * weight.reshape(n, 1, -1)
    score = (weighted @ (data.x - mean).reshape(n, -1, 1))[..., 0]
    return score, weighted @ np.swapaxes(flat, 1, 2)


def misfit(data: SpotRegions, theta: Array) -> Array:
    """-2 log likelihood with a Gaussian of variance V(mu), shape (n,); infinite where it is not finite."""
    mean, _ = _model(data, theta)
    variance = _variance(data, mean)
    value = np.sum(data.used * ((data.x - mean) ** 2 / variance + np.log(variance)), axis=(1, 2))
    return np.where(np.isfinite(value), value, np.inf)


def _model(data: SpotRegions, theta: Array) -> tuple[Array, Array]:
    """Mean, shape (n, h, w), and its derivatives, shape (n, k, h, w)."""
    shape, place = data.x.shape[1:], theta[:, :2] - data.origin_px
    derivatives = np.empty((*theta.shape, *shape))
    derivatives[:, :3] = spot_images(place, theta[:, 2], data.sigma_px, data.ratio, data.mixed_px2, shape)
    derivatives[:, :3] *= data.response[:, None]
    derivatives[:, 3:] = data.levels
    mean = theta[:, 2, None, None] * derivatives[:, 2] + np.einsum("nc,nchw->nhw", theta[:, 3:], data.levels)
    return mean, derivatives


def _variance(data: SpotRegions, mean: Array) -> Array:
    return data.noise.variance_e2(mean) + data.extra_e2
