"""Sectors of the limb: a model with free coefficients in each, robust weights, and the scatter of the sectors' shifts.

A sector is a part of the full turn around the sphere's direction. Sectors whose light the model does not describe are
not trusted, nor their neighbours. Errors of neighbours are correlated: the room and JPEG's blocks reach over several.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter1d

from phibench.scenes.frames import Array, BoolArray

MIN_PIXELS = 12
"""Pixels that a sector needs to count: four times its coefficients."""
# in standard deviations: pixels beyond two count less and beyond six not at all; 4.685 keeps 95 % of the efficiency on
# normal errors
_HUBER, _CUT, _TUKEY = 2.0, 6.0, 4.685
_ROUNDS = 3
NEIGHBOURS = 12
"""Sectors on each side, each of 18 px, whose errors may be correlated: JPEG's blocks reach over two, pools of light
on a ceiling over thirty. More than this leave too few independent parts of the outline to take a scatter from."""
_MISFIT = (1.4, 2.0)
"""Rms of what the model leaves in a sector, over the usual one: trusted up to the first, not from the second on."""
_HARMLESS = 0.003
"""What the model may leave of the light where there is no noise: it moves sectors by thousandths of a pixel."""
_SPOILT = 2
"""Sectors on each side of a spoilt one that are not trusted either."""


@dataclass(frozen=True)
class SectorFit:
    """Fit of a model that is linear in its coefficients, sector by sector.

    Attributes
    ----------
    coefficients : shape (groups, m)
    model, residual, weight : shape (N,)
    core : shape (N,), bool
        Pixels whose residual is within Huber's bound: the others pull, but do not pull harder when they are off more.
    relative_residual : float
        Median over the sectors of the robust standard deviation over the mean light.
    """

    coefficients: Array
    model: Array
    residual: Array
    weight: Array
    core: BoolArray
    relative_residual: float
    basis: Array
    group: NDArray[np.int64]

    def without_nuisance(self, columns: Array) -> Array:
        """Columns, shape (N, p), less what the coefficients of the own sector can imitate."""
        normal, right = _normal(self.group, len(self.coefficients), self.basis, columns, self.weight)
        return np.asarray(columns - np.einsum("nm,nmp->np", self.basis, _solve(normal, right)[self.group]))


@dataclass(frozen=True)
class Sectors:
    """Sector of each pixel: `group` counts each plane's apart, `sector` all planes' together."""

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
            core = (size <= _HUBER) & (weight > 0.0)
        seen = pixels >= MIN_PIXELS
        with np.errstate(all="ignore"):
            relative = float(np.nanmedian(spread[seen] / np.abs(mean[seen]))) if seen.any() else float("nan")
        return SectorFit(coefficients, model, residual, weight, core, relative, basis, self.group)

    def described(self, y: Array, residual: Array, usual_quantile: float = 0.5) -> Array:
        """Trust in the sectors, shape (count,), 0 to 1, by how well the model describes the light in them.

        A lamp's edge, reflected 1 px inside the limb, looks like a limb that is somewhere else; what gives it away is
        what the model leaves. Noise grows as the root of the light. The sectors beside a spoilt one have the same edge.
        `usual_quantile` of the sectors, with the least misfit, stands for all that are not spoilt.
        """
        pixels = np.bincount(self.group, minlength=self.groups)
        with np.errstate(all="ignore"):
            light = np.bincount(self.group, y, self.groups) / pixels
            square = np.bincount(self.group, residual * residual, self.groups) / pixels / light
        size = np.sqrt(np.where((pixels >= MIN_PIXELS) & (light > 0.0), square, np.nan)).reshape(-1, self.count)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # a group without a single sector
            median = np.nanquantile(size, usual_quantile, axis=1, keepdims=True)
        usual = np.hypot(median, _HARMLESS * np.sqrt(np.abs(light)).reshape(size.shape))
        worst = np.nan_to_num((size / usual).max(axis=0), nan=np.inf)
        trust = np.clip((_MISFIT[1] - worst) / (_MISFIT[1] - _MISFIT[0]), 0.0, 1.0)
        return np.asarray(minimum_filter1d(trust, 2 * _SPOILT + 1, mode="wrap"))

    def summed(self, rows: Array) -> Array:
        """Sums over the sectors, shape (count, p), of rows (N, p)."""
        columns = [np.bincount(self.sector, column, self.count) for column in rows.T]
        return np.stack(columns, axis=-1)

    def _spread(self, residual: Array, mean: Array, pixels: NDArray[np.int64]) -> Array:
        """Robust standard deviation of each group; half of the usual relative one at least, so that no sector rules."""
        spread = 1.4826 * _medians(np.abs(residual), self.group, pixels)  # that of a normal law
        seen = (pixels >= MIN_PIXELS) & (mean > 0.0)
        if not seen.any():
            return np.ones(self.groups)
        usual = float(np.median(spread[seen] / mean[seen]))
        return np.hypot(spread, np.maximum(0.5 * usual * np.abs(mean), 1e-12 * np.abs(mean).max() + 1e-300))


def _medians(values: Array, group: NDArray[np.int64], counts: NDArray[np.int64]) -> Array:
    """Median of each group, 0 for one without values; one sort of all is ten times faster than a median of each."""
    rising = values[np.lexsort((values, group))]
    first = np.cumsum(counts) - counts
    low, high = (np.clip(first + middle, 0, max(len(rising) - 1, 0)) for middle in ((counts - 1) // 2, counts // 2))
    return np.where(counts > 0, 0.5 * (rising[low] + rising[high]), 0.0) if len(rising) else np.zeros(len(counts))


@dataclass(frozen=True)
class SectorWeights:
    """Tukey weights of the sectors, shape (count,), and the derivatives of their scores, in units of the unweighted."""

    trust: Array
    bread: Array


def sector_weights(where: Sectors, weight: Array, shift: Array, residual: Array) -> SectorWeights:
    """Weights of the sectors from the limb's own shift in each over its usual scatter.

    An edge of the room along the limb moves a whole sector, which no weight of single pixels can see.
    """
    information = where.summed((weight * shift * shift)[:, None])[:, 0]
    score = where.summed((weight * shift * residual)[:, None])[:, 0]
    seen = information > 0.0
    if not seen.any():
        return SectorWeights(np.ones(where.count), np.ones(where.count))
    z = np.zeros(where.count)
    z[seen] = score[seen] / np.sqrt(information[seen])
    scale = 1.4826 * float(np.median(np.abs(z[seen])))  # that of a normal law
    u2 = np.minimum((z / max(_TUKEY * scale, 1e-300)) ** 2, 1.0)
    return SectorWeights((1.0 - u2) ** 2, (1.0 - u2) * (1.0 - 5.0 * u2))


def scatter(z: Array, trust: Array, directions: Array) -> Array:
    """Variance of the sectors' shifts over what their pixels promise, with the correlation of neighbours, shape ().

    One number for all of the limb: a sandwich of the parameters' own scores has a relative error of a quarter in sigma
    from 120 sectors, this has a fifth. Bartlett weights around the full turn (Newey and West, Econometrica 55, 703,
    1987). The scatter left by a fit is too small; what white errors would leave is computed and divided out (the idea
    of Bell and McCaffrey, Survey Methodology 28, 169, 2002).

    Parameters
    ----------
    z : shape (K,)
        Shifts that the fit leaves, over their standard deviations as pixels promise them, times the root of `trust`.
    trust : shape (K,), 0 to 1
    directions : shape (K, p)
        Change of z with the parameters.
    """
    lag = np.abs(np.arange(z.size)[:, None] - np.arange(z.size))
    W = np.clip(1.0 - np.minimum(lag, z.size - lag) / (NEIGHBOURS + 1), 0.0, None)
    left = np.eye(z.size) - directions @ np.linalg.pinv(directions)
    alone = left @ (trust[:, None] * left)
    white, single = float(np.sum(W * alone)), float(np.trace(alone))
    return np.asarray(max(float(z @ W @ z) / max(white, 1.0), float(z @ z) / max(single, 1.0)))


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
    ridge = np.where(size > 0.0, 1e-10 * size, 1.0) * np.eye(normal.shape[-1])  # far below what a pixel tells
    return np.asarray(np.linalg.solve(normal + ridge, right))
