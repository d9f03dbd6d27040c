"""Mean electrons of raw pixels under a spot over a base: the model that goes through the processing.

Unknowns: u, v, flux, one background level per colour filter, and, if it is free, the blur's sigma.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from phibench.estimator.gaussian_spot import outer, profile
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
        h, w = self.filters.shape
        sigma = theta[:, 6] if self.free_width else np.full(len(theta), self.sigma_px)
        across, down = profile(theta[:, 0], sigma, w), profile(theta[:, 1], self.ratio * sigma, h)
        flux = theta[:, 2, None]
        weights = np.asarray(self.response)[self.filters]
        # kappa times the mixed derivative; a second one by the centre is by_sigma / sigma (heat equation)
        kappa, tall = self.mixed_px2, self.ratio * sigma[:, None]
        images = [
            outer(flux * down.share, across.by_centre)
            + kappa * outer(flux * down.by_centre, across.by_sigma / sigma[:, None]),
            outer(flux * down.by_centre, across.share) + kappa * outer(flux * down.by_sigma / tall, across.by_centre),
            outer(down.share, across.share) + kappa * outer(down.by_centre, across.by_centre),
        ]
        images = [weights * image for image in images]
        images += [np.broadcast_to(self.filters == c, (len(theta), h, w)) for c in range(3)]
        if self.free_width:
            along_v = outer(self.ratio * flux * down.by_sigma, across.share)
            images.append((along_v + outer(flux * down.share, across.by_sigma)) * weights)
        derivatives = np.stack(images, axis=1).reshape(len(theta), self.unknowns, h * w).astype(float)
        levels = np.einsum("mc,mcr->mr", theta[:, 3:6], derivatives[:, 3:6])
        return self.base_e + levels + flux * derivatives[:, 2], derivatives
