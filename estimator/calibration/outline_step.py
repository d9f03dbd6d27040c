"""One Gauss-Newton step of the outline's fit: sphere centre and blur."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from phibench.estimator.calibration.limb import limb_of
from phibench.estimator.calibration.limb_image import ImageError, Plane
from phibench.estimator.calibration.outline_pixels import OutlinePixels, place_of, through_taps
from phibench.estimator.calibration.sectors import SectorFit, Sectors, scatter, sector_weights
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig

_MIN_SLACK = 0.5


@dataclass(frozen=True)
class Step:
    """A step of (x, y, z of s, blur variance), and what is known where it starts.

    Attributes
    ----------
    move : shape (4,), metres and square pixels
    covariance : shape (4, 4)
    contrast, residual : float
        See `outline.Outline`.
    sectors_used : int
    model : shape (N,)
        Light of the pixels, as fitted.
    by_parameters : shape (N, 4)
        Its derivatives.
    solution : Solution
    """

    move: Array
    covariance: Array
    contrast: float
    residual: float
    sectors_used: int
    model: Array
    by_parameters: Array
    solution: Solution


@dataclass(frozen=True)
class Solution:
    """The step as a linear function of the light, weights held.

    Attributes
    ----------
    where : Sectors
    J : shape (N, 4)
        Derivatives, less what the sectors' coefficients can imitate.
    shift : shape (N,)
        The same of a limb that is displaced by 1 px.
    own : shape (N,)
        Weights of the pixels, one over variance.
    trust : shape (count,)
        Of the sectors, 0 to 1.
    slack : float
        Part of the information that is left when the weights' own change with the errors is counted (M-estimators:
        psi' in place of psi / x).
    """

    where: Sectors
    J: Array
    shift: Array
    own: Array
    trust: Array
    slack: float = 1.0

    @property
    def weight(self) -> Array:
        """Weights of pixels and sectors, shape (N,)."""
        return np.asarray(self.own * self.trust[self.where.sector])

    def move(self, residual: Array) -> Array:
        """Step of the parameters, shape (4,), for residuals (N,)."""
        return np.asarray(np.linalg.lstsq(self.normal(), self.J.T @ (self.weight * residual), rcond=1e-14)[0])

    def covariance(self, residual: Array) -> Array:
        """Covariance of the step, shape (4, 4), from the scatter of the residuals (N,) that it leaves."""
        where, own, trust = self.where, self.own, self.trust
        information = where.summed((own * self.shift**2)[:, None])[:, 0]
        root = np.sqrt(np.maximum(information, 1e-300))
        left = (own * self.shift * (residual - self.J @ self.move(residual)))[:, None]
        z = np.sqrt(trust) * np.where(information > 0.0, where.summed(left)[:, 0] / root, 0.0)
        by_s = where.summed((own * self.shift)[:, None] * self.J[:, :3])
        directions = np.where(information > 0.0, np.sqrt(trust) / root, 0.0)[:, None] * by_s
        size = scatter(z, trust * (information > 0.0), directions / np.abs(directions).max())
        inverse = np.linalg.inv(self.normal())
        meat = self.J.T @ ((self.weight * trust[where.sector])[:, None] * self.J)
        return np.asarray(inverse @ meat @ inverse * size / self.slack**2)

    def normal(self) -> Array:
        """Normal matrix, shape (4, 4)."""
        return np.asarray(self.J.T @ (self.weight[:, None] * self.J))


def step_from(
    pixels: OutlinePixels,
    planes: tuple[Plane, ...],
    rig: Rig,
    s: Array,
    blur_px2: float,
    sectors: int,
    half_px: float,
    jpeg: bool = False,
    near: bool = False,
) -> Step:
    """Linearise the light around (s, blur) and solve, robustly within sectors and over them.

    `near` leaves out the sectors whose light is not described; far from the limb that is all of them.

    Raises
    ------
    ImageError
        If there is no light across the outline.
    """
    place, limb = place_of(pixels, s, rig.mirror.radius_m), limb_of(rig, s, blur_px2)
    light, slope, curvature, turned, squared = through_taps(pixels, planes, limb, place)
    where = Sectors.of(pixels.plane, place.turn_rad, sectors)
    d = place.d_px / half_px
    # JPEG's lack of fine waves looks like a slope on both sides of the limb more than like the room's curvature
    room = np.stack([light, light * where.offset, turned, squared], axis=-1)
    fit = where.fit(pixels.y, room)
    level = fit.model / light
    by_parameters = np.concatenate([place.by_s * slope[:, None], 0.5 * curvature[:, None]], axis=-1) * level[:, None]
    columns = fit.without_nuisance(np.concatenate([by_parameters, (slope * level)[:, None]], axis=-1))
    trust = where.described(pixels.y, fit.residual) if near else np.ones(sectors)
    solution = _solution(where, fit, columns, trust)
    move = solution.move(fit.residual)
    used = int(np.unique(where.sector[solution.weight > 0.0]).size)
    contrast = _contrast(where, pixels.y, light, d)
    covariance = solution.covariance(fit.residual)
    return Step(move, covariance, contrast, fit.relative_residual, used, fit.model, by_parameters, solution)


def _solution(where: Sectors, fit: SectorFit, columns: Array, described: Array) -> Solution:
    """Weights of the sectors by their shifts, and with them the whole step."""
    J, shift = columns[:, :4], columns[:, 4]
    own = fit.weight * (described > 0.0)[where.sector]
    trust = bread = described
    for _ in range(4):
        solution = Solution(where, J, shift, own, trust)
        A = solution.normal()
        if not np.isfinite(A).all() or np.linalg.matrix_rank(A, tol=1e-12 * np.abs(A).max()) < 1:
            raise ImageError("an image without a mirror: there is no light across the outline")
        weights = sector_weights(where, own, shift, fit.residual - J @ solution.move(fit.residual))
        trust, bread = described * weights.trust, described * weights.bread
    core = np.sum(own * fit.core * bread[where.sector] * shift * shift)
    whole = np.sum(own * trust[where.sector] * shift * shift)
    slack = float(np.clip(core / max(float(whole), 1e-300), _MIN_SLACK, 1.0))
    return Solution(where, J, shift, own, trust, slack)


def _contrast(where: Sectors, y: Array, light: Array, d: Array) -> float:
    """Median over sectors of the steel's fall of light, in units of itself, with level and slope free."""
    fit = where.fit(y, np.stack([np.ones_like(y), d, light - 1.0], axis=-1))
    with np.errstate(all="ignore"):
        ratio = fit.coefficients[:, 2] / fit.coefficients[:, 0]
    good = ratio[np.isfinite(ratio)]
    return float(np.median(good)) if good.size else 0.0
