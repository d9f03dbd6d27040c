"""A Gaussian integrated over pixels, with its derivatives: one axis at a time, and oblique images of spots from them.

Point-sampled Gaussians are biased below a blur of 0.5 px (27 mpx at 0.3 px), integrated ones are not.

Mean electrons of raw pixels under a spot over a base: the model that goes through the processing.

Unknowns: u, v, flux, one background level per colour filter, and, if it is free, the blur's sigma.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from phibench.scenes.frames import Array

_ROOT_2PI = np.sqrt(2.0 * np.pi)


@dataclass(frozen=True)
class Profile:
    """One axis of `m` Gaussians of unit flux on `count` pixels, shape (m, count).

    Attributes
    ----------
    share : share of the flux in each pixel
    by_centre, by_sigma : its derivatives, per pixel
    """

    share: Array
    by_centre: Array
    by_sigma: Array


def profile(centre_px: Array, sigma_px: Array, count: int) -> Profile:
    """Integrate over the pixels 0 to `count` - 1, whose centres are integers.

    Parameters
    ----------
    centre_px, sigma_px : shape (m,)
    count : int
    """
    edges = (np.arange(count + 1) - 0.5 - centre_px[:, None]) / sigma_px[:, None]
    density = np.exp(-0.5 * edges * edges) / _ROOT_2PI
    sigma = sigma_px[:, None]
    return Profile(
        np.diff(ndtr(edges), axis=1), -np.diff(density, axis=1) / sigma, -np.diff(edges * density, axis=1) / sigma
    )


def outer(down: Array, across: Array) -> Array:
    """Images, shape (m, h, w), of profiles (m, h) and (m, w)."""
    return down[:, :, None] * across[:, None, :]


def spot_images(
    place_px: Array,
    flux: Array,
    sigma_px: Array,
    ratio: Array,
    mixed_px2: Array,
    shape: tuple[int, int],
    by_width: bool = False,
) -> Array:
    """Derivatives of spots' images by u, v, flux and, if asked for, sigma; shape (m, 3, h, w) or (m, 4, h, w).

    The image itself is the flux times its derivative by the flux.

    Parameters
    ----------
    place_px : shape (m, 2), (u, v) from the first pixel's centre
    flux : shape (m,)
    sigma_px : shape (m,), blur along u
    ratio : shape (m,), sigma along v over it
    mixed_px2 : shape (m,)
        Mixed second moment of u and v, to first order: kappa d^2/du dv of the upright Gaussian.
    shape : (h, w)
    by_width : bool
    """
    h, w = shape
    across, down = profile(place_px[:, 0], sigma_px, w), profile(place_px[:, 1], ratio * sigma_px, h)
    flux = flux[:, None]
    images = np.empty((len(place_px), 4 if by_width else 3, h, w))
    images[:, 0] = outer(flux * down.share, across.by_centre)
    images[:, 1] = outer(flux * down.by_centre, across.share)
    images[:, 2] = outer(down.share, across.share)
    if by_width:
        images[:, 3] = outer(flux * ratio[:, None] * down.by_sigma, across.share)
        images[:, 3] += outer(flux * down.share, across.by_sigma)
    if mixed_px2.any():
        # a second derivative by the centre is by_sigma / sigma (heat equation)
        kappa, sigma, tall = mixed_px2[:, None], sigma_px[:, None], (ratio * sigma_px)[:, None]
        images[:, 0] += outer(kappa * flux * down.by_centre, across.by_sigma / sigma)
        images[:, 1] += outer(kappa * flux * down.by_sigma / tall, across.by_centre)
        images[:, 2] += outer(kappa * down.by_centre, across.by_centre)
    return images


@dataclass(frozen=True)
class SpotMeans:
    """A window of raw pixels, (h, w), r = h w.

    Attributes
    ----------
    filters : shape (h, w), 0, 1, 2 for R, G, B
    response : 3 floats, of the filters at the laser's wavelength
    base_e : shape (r,), what the levels add to
    ratio : float
        Sigma along v over sigma along u.
    mixed_px2 : float
        Mixed second moment of u and v, to first order: kappa d^2/du dv of the upright Gaussian.
    sigma_px : float
        Blur along u; where it is not free.
    free_width : bool
    """

    filters: NDArray[np.int64]
    response: tuple[float, float, float]
    base_e: Array
    sigma_px: float
    ratio: float = 1.0
    mixed_px2: float = 0.0
    free_width: bool = False

    @property
    def unknowns(self) -> int:
        """How many."""
        return 7 if self.free_width else 6

    def at(self, theta: Array) -> tuple[Array, Array]:
        """Mean, shape (m, r), and derivatives, shape (m, k, r), for hypotheses, shape (m, k)."""
        shape = (self.filters.shape[0], self.filters.shape[1])
        sigma = theta[:, 6] if self.free_width else np.full(len(theta), self.sigma_px)
        ratio, mixed = (np.full(len(theta), value) for value in (self.ratio, self.mixed_px2))
        spots = spot_images(theta[:, :2], theta[:, 2], sigma, ratio, mixed, shape, self.free_width)
        spots *= np.asarray(self.response)[self.filters]
        derivatives = np.empty((len(theta), self.unknowns, *shape))
        derivatives[:, :3] = spots[:, :3]
        derivatives[:, 3:6] = self.filters == np.arange(3)[:, None, None]
        if self.free_width:
            derivatives[:, 6] = spots[:, 3]
        flat = derivatives.reshape(len(theta), self.unknowns, -1)
        levels = np.einsum("mc,mcr->mr", theta[:, 3:6], flat[:, 3:6])
        return self.base_e + levels + theta[:, 2, None] * flat[:, 2], flat
