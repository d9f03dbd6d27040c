"""Least squares with free coefficients in every sector of an outline, robust weights, and an honest covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from phibench.scenes.frames import Array

MIN_PIXELS = 12
"""Pixels that a sector needs to count: four times its coefficients."""
_HUBER, _CUT, _TUKEY = 2.0, 6.0, 4.685
_ROUNDS = 3
NEIGHBOURS = 2
"""Sectors on each side whose errors may be correlated."""


@dataclass(frozen=True)
class SectorFit:
    """Fit of a model that is linear in its coefficients, sector by sector.

    Attributes
    ----------
    coefficients : shape (groups, m)
    model, residual, weight : shape (N,)
    relative_residual : float
        Median over the sectors of the robust standard deviation over the mean light.
    """

    coefficients: Array
    model: Array
    residual: Array
    weight: Array
    relative_residual: float
    basis: Array
    group: NDArray[np.int64]

    def without_nuisance(self, columns: Array) -> Array:
        """Columns, shape (N, p), less what the coefficients of the own sector can imitate."""
        normal, right = _normal(self.group, len(self.coefficients), self.basis, columns, self.weight)
        return np.asarray(columns - np.einsum("nm,nmp->np", self.basis, _solve(normal, right)[self.group]))


@dataclass(frozen=True)
class Sectors:
    """Which sector each pixel is in: `group` for one plane's, `sector` for all planes' together."""

    group: NDArray[np.int64]
    sector: NDArray[np.int64]
    offset: Array
    count: int
    groups: int

    @classmethod
    def of(cls, plane: NDArray[np.int64], turn_rad: Array, count: int) -> Sectors:
        """Cut the turn into `count` sectors; `offset` is the place within the own one, -0.5 to 0.5."""
        turn = (turn_rad + np.pi) / (2.0 * np.pi) * count
        sector = np.floor(turn).astype(np.int64) % count
        planes = int(plane.max()) + 1 if plane.size else 1
        return cls(plane * count + sector, sector, turn - np.floor(turn) - 0.5, count, planes * count)

    def fit(self, y: Array, basis: Array) -> SectorFit:
        """Iteratively reweighted least squares; a sector's weight is one over its own variance."""
        pixels = np.bincount(self.group, minlength=self.groups)
        enough = (pixels >= MIN_PIXELS)[self.group]
        weight = enough.astype(float)
        mean = np.bincount(self.group, y, self.groups) / np.maximum(pixels, 1)
        for _ in range(_ROUNDS):
            coefficients = _solve(*_normal(self.group, self.groups, basis, y[:, None], weight))[..., 0]
            model = np.einsum("nm,nm->n", basis, coefficients[self.group])
            residual = y - model
            spread = self._spread(residual, mean, pixels)
            with np.errstate(all="ignore"):
                size = np.abs(residual) / spread[self.group]
                weight = np.where(size > _CUT, 0.0, np.minimum(1.0, _HUBER / size)) / spread[self.group] ** 2
            weight = np.where(enough & np.isfinite(weight), weight, 0.0)
        seen = pixels >= MIN_PIXELS
        with np.errstate(all="ignore"):
            relative = float(np.nanmedian(spread[seen] / np.abs(mean[seen]))) if seen.any() else float("nan")
        return SectorFit(coefficients, model, residual, weight, relative, basis, self.group)

    def summed(self, rows: Array) -> Array:
        """Sums over the sectors, shape (count, p), of rows (N, p)."""
        columns = [np.bincount(self.sector, column, self.count) for column in rows.T]
        return np.stack(columns, axis=-1)

    def _spread(self, residual: Array, mean: Array, pixels: NDArray[np.int64]) -> Array:
        """Robust standard deviation of each group; half of the usual relative one at least, so that no sector rules."""
        order = np.argsort(self.group, kind="stable")
        parts = np.split(np.abs(residual[order]), np.cumsum(np.bincount(self.group, minlength=self.groups))[:-1])
        spread = np.array([1.4826 * np.median(part) if part.size else 0.0 for part in parts])
        seen = (pixels >= MIN_PIXELS) & (mean > 0.0)
        if not seen.any():
            return np.ones(self.groups)
        usual = float(np.median(spread[seen] / mean[seen]))
        return np.hypot(spread, np.maximum(0.5 * usual * np.abs(mean), 1e-12 * np.abs(mean).max() + 1e-300))


def sector_weights(where: Sectors, weight: Array, shift: Array, residual: Array) -> Array:
    """Tukey weights of the sectors, shape (count,), from the limb's own shift in each over its usual scatter.

    An edge of the room along the limb moves a whole sector, which no weight of single pixels can see.
    """
    information = where.summed((weight * shift * shift)[:, None])[:, 0]
    score = where.summed((weight * shift * residual)[:, None])[:, 0]
    seen = information > 0.0
    if not seen.any():
        return np.ones(where.count)
    z = np.zeros(where.count)
    z[seen] = score[seen] / np.sqrt(information[seen])
    scale = 1.4826 * float(np.median(np.abs(z[seen])))
    return np.clip(1.0 - (z / max(_TUKEY * scale, 1e-300)) ** 2, 0.0, None) ** 2


def sandwich(A: Array, scores: Array) -> Array:
    """Covariance A^-1 M A^-1 of estimates with normal matrix A and the sums of scores of the sectors, shape (K, p).

    M has the products of neighbours with Bartlett weights, around the full turn (Newey and West, Econometrica 55, 703,
    1987), and K / (K - p) for the degrees of freedom.
    """
    used = int(np.any(scores != 0.0, axis=-1).sum())
    M = scores.T @ scores
    for lag in range(1, NEIGHBOURS + 1):
        cross = scores.T @ np.roll(scores, lag, axis=0)
        M = M + (1.0 - lag / (NEIGHBOURS + 1)) * (cross + cross.T)
    inverse = np.linalg.inv(A)
    return np.asarray(inverse @ M @ inverse * used / max(used - A.shape[0], 1))


def _normal(group: NDArray[np.int64], groups: int, basis: Array, columns: Array, weight: Array) -> tuple[Array, Array]:
    """Normal matrices (groups, m, m) and right sides (groups, m, p)."""
    m, p = basis.shape[1], columns.shape[1]
    normal, right = np.empty((groups, m, m)), np.empty((groups, m, p))
    for i in range(m):
        weighted = weight * basis[:, i]
        for j in range(i, m):
            normal[:, i, j] = normal[:, j, i] = np.bincount(group, weighted * basis[:, j], groups)
        for j in range(p):
            right[:, i, j] = np.bincount(group, weighted * columns[:, j], groups)
    return normal, right


def _solve(normal: Array, right: Array) -> Array:
    """Solve all; a sector without pixels gets zeros, and one that cannot tell its coefficients apart small ones."""
    size = np.trace(normal, axis1=-2, axis2=-1)[:, None, None]
    ridge = np.where(size > 0.0, 1e-10 * size, 1.0) * np.eye(normal.shape[-1])
    return np.asarray(np.linalg.solve(normal + ridge, right))
