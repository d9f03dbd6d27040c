"""Mean electrons of raw pixels under a spot over a base: the model that goes through the processing.

Unknowns: u, v, flux, one background level per colour filter, and, if it is free, the blur's sigma.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from phibench.estimator.gaussian_spot import spot_images
from phibench.scenes.frames import Array


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
