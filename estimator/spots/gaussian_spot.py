"""Pixel model of a spot: Gaussians integrated over pixels, their derivatives, Fisher matrix, bound and scoring step.

A spot is an upright Gaussian, sigma along u and another along v, with a mixed second moment to first order; or several
such parts side by side, where a mirror draws the lens's aperture to something else. Pixels are integrated:
point-sampled Gaussians are biased below a blur of 0.5 px (27 mpx at 0.3 px). Positions (u, v) count from the centre of
a window's first pixel. Fluxes and levels are in electrons.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from phibench.scenes.frames import Array

LASER_RESPONSE = (1.0, 0.10, 0.03)  # of R, G, B at 650 nm, assumed: `scenes.camera.Detector`
_ROOT_2PI = np.sqrt(2.0 * np.pi)


@dataclass(frozen=True)
class SpotParts:
    """Equal Gaussians that a spot's image is made of, seen through k points of the lens.

    Attributes
    ----------
    offset_px : shape (k, 2) or (n, k, 2), from the chief ray's place
    weight : shape (k,) or (n, k), with the sum 1
    blur : SpotBlur, of each part
    """

    offset_px: Array
    weight: Array
    blur: SpotBlur


@dataclass(frozen=True)
class SpotBlur:
    """Second moments of a spot's image, or of n spots' images.

    Attributes
    ----------
    sigma_px : float or shape (n,), along u
    ratio : float or shape (n,), sigma along v over it
    mixed_px2 : float or shape (n,), mixed moment of u and v
    parts : SpotParts, optional
        What the image is made of, where it is no Gaussian; the moments are then those of all parts.
    """

    sigma_px: float | Array
    ratio: float | Array = 1.0
    mixed_px2: float | Array = 0.0
    parts: SpotParts | None = None

    @classmethod
    def of(cls, moments_px2: Array) -> SpotBlur:
        """From a covariance matrix, shape (2, 2)."""
        sigma = np.sqrt(np.diag(moments_px2))
        return cls(float(sigma[0]), float(sigma[1] / sigma[0]), float(moments_px2[0, 1]))

    @property
    def round_px(self) -> float:
        """Sigma of a round spot with the same variance: root mean square of both axes; of one spot."""
        return float(self.sigma_px * np.sqrt(0.5 * (1.0 + self.ratio**2)))

    def each(self, n: int) -> SpotBlur:
        """Blur of n spots, all attributes of shape (n,)."""
        sigma, ratio, mixed = (
            np.broadcast_to(np.asarray(value, float), n) for value in (self.sigma_px, self.ratio, self.mixed_px2)
        )
        if self.parts is None:
            return SpotBlur(sigma, ratio, mixed)
        k = self.parts.offset_px.shape[-2]
        offset, weight = np.broadcast_to(self.parts.offset_px, (n, k, 2)), np.broadcast_to(self.parts.weight, (n, k))
        return SpotBlur(sigma, ratio, mixed, SpotParts(offset, weight, self.parts.blur.each(n)))

    def rows(self, index: NDArray[np.int64]) -> SpotBlur:
        """Blur of some of n spots."""
        sigma, ratio, mixed = (np.asarray(value)[index] for value in (self.sigma_px, self.ratio, self.mixed_px2))
        if self.parts is None:
            return SpotBlur(sigma, ratio, mixed)
        offset, weight = self.parts.offset_px[index], self.parts.weight[index]
        return SpotBlur(sigma, ratio, mixed, SpotParts(offset, weight, self.parts.blur.rows(index)))


@dataclass(frozen=True)
class SpotModel:
    """Knowledge that a fit has of a spot besides its blur.

    Attributes
    ----------
    response : 3 floats or None
        Of the filters R, G, B at the laser's wavelength; None for pixels without filters.
    background_e : shape (n, h, w) or (h, w), optional
        Known background, dark current included; without it one level per filter is fitted.
    free_width : bool
        Fit the blur's sigma as well, from that of the `SpotBlur`.
    """

    response: tuple[float, float, float] | None = LASER_RESPONSE
    background_e: Array | None = None
    free_width: bool = False


@dataclass(frozen=True)
class GaussianProfile:
    """One axis of `m` Gaussians of unit flux on `count` pixels, shape (m, count).

    Attributes
    ----------
    share : share of the flux in each pixel
    by_centre, by_sigma : its derivatives, per pixel
    """

    share: Array
    by_centre: Array
    by_sigma: Array


def profile(centre_px: Array, sigma_px: Array, count: int) -> GaussianProfile:
    """Integrate over the pixels 0 to `count` - 1, whose centres are integers.

    Parameters
    ----------
    centre_px, sigma_px : shape (m,)
    """
    edges = (np.arange(count + 1) - 0.5 - centre_px[:, None]) / sigma_px[:, None]
    density = np.exp(-0.5 * edges * edges) / _ROOT_2PI
    sigma = sigma_px[:, None]
    return GaussianProfile(
        np.diff(ndtr(edges), axis=1), -np.diff(density, axis=1) / sigma, -np.diff(edges * density, axis=1) / sigma
    )


def outer(down: Array, across: Array) -> Array:
    """Images, shape (m, h, w), of profiles (m, h) and (m, w)."""
    return down[:, :, None] * across[:, None, :]


def spot_images(place_px: Array, flux: Array, blur: SpotBlur, shape: tuple[int, int], by_width: bool = False) -> Array:
    """Derivatives of spots' images by u, v, flux and, if asked for, sigma; shape (m, 3, h, w) or (m, 4, h, w).

    The image itself is the flux times its derivative by the flux.

    Parameters
    ----------
    place_px : shape (m, 2), (u, v) from the first pixel's centre
    flux : shape (m,)
    blur : SpotBlur
        Of m spots; the mixed moment kappa enters as kappa d^2/du dv of the upright Gaussian. A free width knows no
        parts.
    shape : (h, w)
    """
    if blur.parts is not None and not by_width:
        return _images_of_parts(place_px, flux, blur.parts, shape)
    h, w = shape
    sigma, ratio, mixed = (np.asarray(value) for value in (blur.sigma_px, blur.ratio, blur.mixed_px2))
    across, down = profile(place_px[:, 0], sigma, w), profile(place_px[:, 1], ratio * sigma, h)
    flux = flux[:, None]
    images = np.empty((len(place_px), 4 if by_width else 3, h, w))
    images[:, 0] = outer(flux * down.share, across.by_centre)
    images[:, 1] = outer(flux * down.by_centre, across.share)
    images[:, 2] = outer(down.share, across.share)
    if by_width:
        images[:, 3] = outer(flux * ratio[:, None] * down.by_sigma, across.share)
        images[:, 3] += outer(flux * down.share, across.by_sigma)
    if mixed.any():
        # a second derivative by the centre is by_sigma / sigma (heat equation)
        kappa, wide, tall = mixed[:, None], sigma[:, None], (ratio * sigma)[:, None]
        images[:, 0] += outer(kappa * flux * down.by_centre, across.by_sigma / wide)
        images[:, 1] += outer(kappa * flux * down.by_sigma / tall, across.by_centre)
        images[:, 2] += outer(kappa * down.by_centre, across.by_centre)
    return images


def _images_of_parts(place_px: Array, flux: Array, parts: SpotParts, shape: tuple[int, int]) -> Array:
    """Derivatives by u, v and flux, shape (m, 3, h, w), of spots of k parts: products of (h, k) and (k, w) matrices."""
    (h, w), (m, k) = shape, parts.weight.shape
    where = (place_px[:, None] + parts.offset_px).reshape(-1, 2)
    sigma, ratio, mixed = (
        np.repeat(np.asarray(value, float), k)
        for value in (parts.blur.sigma_px, parts.blur.ratio, parts.blur.mixed_px2)
    )
    across, down = profile(where[:, 0], sigma, w), profile(where[:, 1], ratio * sigma, h)
    kappa, wide, tall = mixed[:, None], sigma[:, None], (ratio * sigma)[:, None]
    sums = (  # the second of each pair is the mixed moment's, as in `spot_images`
        ((down.share, across.by_centre), (kappa * down.by_centre, across.by_sigma / wide)),
        ((down.by_centre, across.share), (kappa * down.by_sigma / tall, across.by_centre)),
        ((down.share, across.share), (kappa * down.by_centre, across.by_centre)),
    )
    images = np.empty((m, 3, h, w))
    for image, pairs in zip(np.moveaxis(images, 1, 0), sums, strict=True):
        tall_parts, wide_parts = ([pair[i].reshape(m, k, -1) for pair in pairs] for i in (0, 1))
        tall_parts = [part * parts.weight[..., None] for part in tall_parts]
        np.matmul(np.concatenate(tall_parts, 1).swapaxes(1, 2), np.concatenate(wide_parts, 1), out=image)
    images[:, :2] *= flux[:, None, None, None]
    return images


@dataclass(frozen=True)
class SpotPixels:
    """Mean electrons of the raw pixels of n windows with one spot each: flux x response x spot + background + level.

    Unknowns theta, shape (m, k): u, v, flux, c levels and, if it is free, sigma. There is a row for each of the n
    windows; of one window (n = 1) there may be any number m of hypotheses.

    Attributes
    ----------
    response : shape (n, h, w), of each pixel's filter
    background_e : shape (n, h, w), known
    levels : shape (n, c, h, w), 1 where a pixel has that level
    blur : SpotBlur, of n spots
    """

    response: Array
    background_e: Array
    levels: Array
    blur: SpotBlur
    free_width: bool = False

    @classmethod
    def of(cls, filters: NDArray[np.int64], blur: SpotBlur, model: SpotModel) -> SpotPixels:
        """Model of windows whose pixels have these filters, shape (n, h, w), 0, 1, 2 for R, G, B.

        Without filters (`model.response` None) there is one level. A known background leaves no level to fit.
        """
        n, *shape = filters.shape
        weights = np.ones(1) if model.response is None else np.array(model.response)
        kinds = filters if model.response is not None else np.zeros(filters.shape, np.int64)
        known = np.zeros(filters.shape) if model.background_e is None else np.asarray(model.background_e, float)
        levels = (kinds[:, None] == np.arange(len(weights))[:, None, None]).astype(float)
        if model.background_e is not None:
            levels = np.zeros((n, 0, *shape))
        background = np.broadcast_to(known, filters.shape)
        return cls(weights[kinds], background, levels, blur.each(n), model.free_width)

    @property
    def unknowns(self) -> int:
        """Number of unknowns, 3 + c or 4 + c."""
        return 3 + self.levels.shape[1] + int(self.free_width)

    def rows(self, index: NDArray[np.int64]) -> SpotPixels:
        """Model of some of the windows."""
        return replace(
            self,
            response=self.response[index],
            background_e=self.background_e[index],
            levels=self.levels[index],
            blur=self.blur.rows(index),
        )

    def at(self, theta: Array) -> tuple[Array, Array]:
        """Mean, shape (m, h, w), and its derivatives, shape (m, k, h, w)."""
        h, w = self.response.shape[1:]
        c = self.levels.shape[1]
        blur = replace(self.blur, sigma_px=theta[:, -1]) if self.free_width else self.blur
        spots = spot_images(theta[:, :2], theta[:, 2], blur, (h, w), self.free_width)
        spots *= self.response[:, None]
        derivatives = np.empty((*theta.shape, h, w))
        derivatives[:, :3] = spots[:, :3]
        derivatives[:, 3 : 3 + c] = self.levels
        if self.free_width:
            derivatives[:, -1] = spots[:, 3]
        below = self.background_e
        for i in range(c):
            below = below + theta[:, 3 + i, None, None] * self.levels[:, i]
        return below + theta[:, 2, None, None] * spots[:, 2], derivatives


# Fisher matrices of spots, their covariance bound, and the limited step of Fisher scoring.
#
# A Fisher matrix is over the unknowns of a spot, u and v first. Leading axes of all arrays are spots or hypotheses.


_CONDITION = 1e12  # of the scaled matrix; beyond it the unknowns cannot be told apart
_RELATIVE_RIDGE, _RIDGE = 1e-9, 1e-12  # added to the diagonal: unknowns that nothing tells apart stop no step
STEP_PX = 0.5  # the longest step of a position: beyond it a spot of 0.7 px is no parabola
_FLUX_FALL = 0.1  # a flux falls to no less in one step
_WIDTH_CHANGE = (0.7, 1.4)  # of a free width in one step
_WIDTH_RANGE_PX = (0.15, 10.0)  # of a free width: narrower ones are a point on any pixel, wider ones a part of the room
_TINY = 1e-300  # instead of 0 as a divisor


def fisher_matrix(derivatives: Array, information: Array) -> Array:
    """Fisher matrix, shape (..., k, k): sum over pixels of (dmu/da)(dmu/db) J(mu).

    Parameters
    ----------
    derivatives : shape (..., k, h, w), derivatives of the mean by k unknowns
    information : shape (..., h, w), information of each pixel about its mean
    """
    flat = derivatives.reshape(*derivatives.shape[:-2], -1)
    return np.asarray((flat * information.reshape(*information.shape[:-2], 1, -1)) @ np.swapaxes(flat, -1, -2))


def covariance_bound(fisher: Array, keep: int = 2) -> Array:
    """Cramer-Rao bound of the first `keep` unknowns while the others are unknown too, shape (..., keep, keep).

    NaN where the matrix is singular or holds what is not finite.
    """
    with np.errstate(all="ignore"):
        scale = 1.0 / np.sqrt(np.diagonal(fisher, axis1=-2, axis2=-1))
        scaled = fisher * scale[..., :, None] * scale[..., None, :]
        finite = np.asarray(np.isfinite(scaled).all(axis=(-2, -1)))
        # the unit matrix keeps what cannot be inverted from stopping the others
        safe = np.where(finite[..., None, None], scaled, np.eye(fisher.shape[-1]))
        good = finite & (np.linalg.cond(safe) < _CONDITION)
        inverse = np.linalg.inv(np.where(good[..., None, None], safe, np.eye(fisher.shape[-1])))
        bound = (inverse * scale[..., :, None] * scale[..., None, :])[..., :keep, :keep]
    return np.where(good[..., None, None], bound, np.nan)


def scoring_step(fisher: Array, score: Array) -> Array:
    """Step of Fisher scoring, F^-1 s, shape (m, k); 0 for what is not finite.

    Parameters
    ----------
    fisher : shape (m, k, k)
    score : shape (m, k)
    """
    matrix = np.where(np.isfinite(fisher), fisher, 0.0)
    diagonal = np.einsum("mkk->mk", matrix)  # a view
    diagonal *= 1.0 + _RELATIVE_RIDGE
    diagonal += _RIDGE
    return np.asarray(np.linalg.solve(matrix, np.nan_to_num(score)[..., None])[..., 0])


def limited_step(
    theta: Array,
    step: Array,
    damping: float = 1.0,
    *,
    moved_px: Array | None = None,
    most_px: float = STEP_PX,
    fluxes: Sequence[int] = (2,),
    free_width: bool = False,
) -> Array:
    """Unknowns after a limited step, shape (m, k); what would not be finite stays.

    Parameters
    ----------
    theta, step : shape (m, k)
    damping : float
        Of the whole step, at most 1.
    moved_px : shape (m,), optional
        How far the step moves a spot; by default the larger of its first two elements.
    most_px : float
        The step is shortened so that no spot moves further.
    fluxes : columns of fluxes, which may fall to a tenth
    free_width : bool
        The last column is a width; it changes by at most 40 % and stays within 0.15 to 10 px.
    """
    moved = np.abs(step[:, :2]).max(axis=1) if moved_px is None else moved_px
    new = theta + np.minimum(damping, most_px / np.maximum(moved, _TINY))[:, None] * step
    for flux in fluxes:
        new[:, flux] = np.maximum(new[:, flux], _FLUX_FALL * np.maximum(theta[:, flux], 1.0))
    if free_width:
        low, high = (change * theta[:, -1] for change in _WIDTH_CHANGE)
        new[:, -1] = np.clip(new[:, -1], low, high).clip(*_WIDTH_RANGE_PX)
    return np.where(np.isfinite(new), new, theta)
