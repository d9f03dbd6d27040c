"""Window of quantised outputs with its model (`CoefficientWindow`), and the fit of a spot to it by a quasi-score.

Outputs are codes of R, G, B (srgb8), of Y', Cb, Cr (yuyv), or a JPEG's coefficients (mjpeg).

With m the mean and C the covariance of the quantiser's output, the estimating equation J^T C^-1 (z - m) = 0 is unbiased
whatever the law of the output (R. W. M. Wedderburn, Biometrika 61, 439, 1974). Its covariance (J^T C^-1 J)^-1 is the
smallest of estimates that know m and C only (`limits.processed_bound`). The quantiser of a Gaussian
input gives m, and C_ij = g_i g_j C'_ij off the diagonal, g its mean slope and C' the input's covariance (J. J.
Bussgang, 1952). A coefficient that is 0 whatever the noise has no slope and is left out.

Where steps exceed the noise the equation has several roots; `interval_fit` is for JPEG.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from phibench.estimator.processed.chain_model import (
    ChainModel,
    code_slopes,
    codes,
    excess_variance,
    noise_factor,
    parts_of,
    raw_variance_e2,
)
from phibench.estimator.processed.output_blocks import Part
from phibench.estimator.spots.camera_codes import quantised_output, step_correlation
from phibench.estimator.spots.gaussian_spot import SpotPixels, limited_step, scoring_step
from phibench.estimator.spots.pixel_statistics import CutPixels, cut_pixels
from phibench.scenes.frames import Array

_LIVE = 2e-3  # variance of the output, in steps squared, from which a coefficient counts as one that changes
_LEAST = 1e-3  # and that is taken for one whose variance falls below it
_FRESH = 5  # times that the covariance is computed
_STEPS = 24  # of the fit in all; the covariance stays after `_FRESH` of them, so that the misfit can only fall
_SCREENING_STEPS = 3  # of each start; the best one goes on
_STEP_PX = 0.4  # shorter than on raw pixels: a coarse quantiser has plateaus
_HALVINGS = 3  # of a step that makes the misfit larger
_SMALL = 1e-4  # squared step in standard deviations at which the fit ends
_REST = 1e-2  # and at which it has come to rest, if it ends for its number of steps


@dataclass(frozen=True)
class Rows:
    """Some of a model's coefficients, with what belongs to them; `index` into all, shape (l,)."""

    model: ChainModel
    index: NDArray[np.int64]
    transform: Array
    block: NDArray[np.int64]
    step: Array
    shift: Array
    rounding: Array

    @classmethod
    def all(cls, model: ChainModel) -> Rows:
        """All coefficients of a model."""
        names = ("transform", "block", "step", "shift", "rounding")
        return cls(model, np.arange(len(model.step)), *(getattr(model, name) for name in names))

    def part(self, index: NDArray[np.int64]) -> Rows:
        """Take some of them."""
        return Rows(self.model, *(np.take(getattr(self, f.name), index, axis=-1) for f in fields(self)[1:]))

    @cached_property
    def parts(self) -> list[Part]:
        """The same block by block."""
        whole = self.transform is self.model.transform
        return self.model.parts if whole else parts_of(self.model, self.transform, self.block)

    def of_codes(self, values: Array) -> Array:
        """Outputs, shape (..., l), of codes, shape (..., 3 p + q): `values @ transform`, block by block."""
        result = np.empty((*values.shape[:-1], len(self.block)))
        for part in self.parts:
            result[..., part.columns] = values[..., part.codes] @ part.matrix
        return result


@dataclass(frozen=True)
class Noise:
    """Covariance of the live coefficients at one hypothesis.

    Attributes
    ----------
    sigma : shape (l,), of the quantiser's input
    factor : shape (l, l), Cholesky factor of the output's covariance
    """

    rows: Rows
    sigma: Array
    factor: Array

    @property
    def dead(self) -> bool:
        """No coefficient changes with the noise: the quantiser's output says nothing."""
        return len(self.sigma) == 0

    def whitened(self, values: Array) -> Array:
        """Values, shape (l, ...), in units in which their covariance is the unit matrix."""
        return np.asarray(solve_triangular(self.factor, values, lower=True, check_finite=False))


@dataclass(frozen=True)
class Inputs:
    """Gaussian outputs before the quantiser, mean of the frames: covariance F^T F, and `own` on the diagonal.

    Attributes
    ----------
    mean : shape (n,)
    slopes : shape (k, n), derivatives of the mean by the unknowns
    factor : shape (r, n), F
    own : shape (n,)
    spread : shape (n,)
        Variance of one frame about what the frames share.
    """

    mean: Array
    slopes: Array
    factor: Array
    own: Array
    spread: Array


@dataclass(frozen=True)
class WindowFit:
    """Fit of one window; positions in the raw window's own pixels.

    Attributes
    ----------
    theta : shape (k,), as `SpotPixels`
    fisher : shape (k, k), J^T C^-1 J, or the inverse covariance of a posterior
    chi2 : float, r^T C^-1 r per degree of freedom
    """

    theta: Array
    fisher: Array
    chi2: float
    converged: bool


@dataclass(frozen=True)
class CoefficientWindow:
    """Coefficients of one window with the model that is fitted to them.

    Attributes
    ----------
    z : shape (n,), quantised coefficients in the order of `camera_codes.coefficients`, mean of the frames
    pixels : SpotPixels
        Of the one window and the raw pixels around it, r in all.
    extra_e2 : shape (r,) or float
        Variance of the background, electrons squared, which counts as noise of the raw pixels.
    room : shape (n,) or float
        Variance of the background's coefficients by quantisation (`room_variance`).
    frames : int
        That `z` is the mean of. They share the background's errors and the pattern.
    prnu : float
        Relative spread of the responsivity, of the spot's light alone.
    readings : shape (f, n), optional
        Outputs of each frame, where they are several.
    offset : shape (n,) or float
        By which the background's outputs differ from those that the model gives it.
    """

    z: Array
    model: ChainModel
    pixels: SpotPixels
    extra_e2: Array | float = 0.0
    room: Array | float = 0.0
    frames: int = 1
    prnu: float = 0.0
    readings: Array | None = None
    offset: Array | float = 0.0

    @property
    def of_intervals(self) -> bool:
        """Coefficients of JPEG, to be fitted by `interval_fit`."""
        return self.model.card.output == "mjpeg" and (self.frames == 1 or self.readings is not None)

    @property
    def each(self) -> Array:
        """Outputs of each frame, shape (f, n)."""
        return self.z[None] if self.readings is None else self.readings

    def noise(self, theta: Array, live: Rows | None = None, least: float = _LIVE) -> Noise:
        """Covariance of the quantised coefficients for one hypothesis, shape (k,); which are live, if it is known.

        Otherwise those are whose variance exceeds `least`, in steps squared.
        """
        model = self.model
        rows = live or Rows.all(model)
        raw, _ = self._raw(theta[None])
        at = codes(model, raw.mean_e).one(0)
        extra = raw.slope[0] ** 2 * (self.extra_e2 + self._pattern_e2(theta))
        F = noise_factor(model, at, raw.variance_e2[0] + extra, rows.transform, rows.parts)
        room, offset = (np.broadcast_to(x, len(model.step))[rows.index] for x in (self.room, self.offset))
        rest = excess_variance(model, at, rows.transform, rows.parts) + rows.rounding + room
        # diagonal of F^T F, and what is white beside it
        sigma = np.sqrt(np.einsum("rn,rn->n", F, F) + rest)
        output = quantised_output(at.mean @ rows.transform + rows.shift + offset, sigma, rows.step)
        variance = np.maximum(output.variance, _LEAST * rows.step**2)
        slope = output.slope
        if live is None:
            index = np.flatnonzero(output.variance > least * rows.step**2)
            F, slope, variance, sigma, rows = F[:, index], slope[index], variance[index], sigma[index], rows.part(index)
            room = room[index]
        # slope of the quantiser: the part of a change that its output shows
        F *= slope
        C = F.T @ F
        # the diagonal holds the rounding as well, which neighbours do not share
        np.fill_diagonal(C, variance)
        if self.frames > 1:
            if model.noise.prnu > 0.0:
                extra = extra + raw.slope[0] ** 2 * (model.noise.prnu * np.maximum(raw.mean_e[0], 0.0)) ** 2
            E = noise_factor(model, at, extra, rows.transform, rows.parts)
            alike = shared_covariance(E, room, sigma, slope, rows.step)
            # mean of n frames: own errors fall by n, shared ones stay
            C = C / self.frames + (1.0 - 1.0 / self.frames) * alike
        return Noise(rows, sigma, np.asarray(np.linalg.cholesky(C), float))

    def means(self, theta: Array, rows: Rows, first: int = 0) -> tuple[Array, Array]:
        """Means before the quantiser, shape (m, l), and derivatives, shape (m, k - first, l), of hypotheses (m, k).

        Derivatives are those by the unknowns from `first` on.
        """
        raw, derivatives = self._raw(theta)
        at, offset = codes(self.model, raw.mean_e), np.broadcast_to(self.offset, len(self.model.step))[rows.index]
        slopes = code_slopes(self.model, at, derivatives[:, first:])
        return rows.of_codes(at.mean) + rows.shift + offset, rows.of_codes(slopes)

    def inputs(self, theta: Array) -> Inputs:
        """Outputs before the quantiser for one hypothesis, shape (k,)."""
        model = self.model
        raw, derivatives = self._raw(theta[None])
        at = codes(model, raw.mean_e)
        shared = raw.slope[0] ** 2 * (self.extra_e2 + self._pattern_e2(theta))
        # the fixed pattern is the same in every frame; the rest is drawn anew
        pattern = raw.slope[0] ** 2 * (model.noise.prnu * np.maximum(raw.mean_e[0], 0.0)) ** 2
        changing = np.maximum(raw.variance_e2[0] - pattern, 0.0)
        white = excess_variance(model, at.one(0), model.transform, model.parts) + model.rounding
        variance_e2 = shared + pattern + changing / self.frames
        F = noise_factor(model, at.one(0), variance_e2, model.transform, model.parts)
        mean = at.one(0).mean @ model.transform + model.shift + self.offset
        spread = white
        if self.frames > 1:
            changes = noise_factor(model, at.one(0), changing, model.transform, model.parts)
            spread = np.einsum("rn,rn->n", changes, changes) + white
        slopes = (code_slopes(model, at, derivatives) @ model.transform)[0]
        return Inputs(mean, slopes, F, white / self.frames + self.room, spread)

    def _pattern_e2(self, theta: Array) -> Array | float:
        """Variance of the spot's light by PRNU, shape (r,)."""
        if self.prnu == 0.0:
            return 0.0
        _, derivatives = self.pixels.at(theta[None])
        return np.asarray((self.prnu * theta[2] * derivatives[0, 2].ravel()) ** 2)

    def residual(self, noise: Noise, theta: Array, first: int = 0) -> tuple[Array, Array]:
        """Whitened residuals, shape (m, l), and derivatives of the mean, shape (m, k - first, l), as `means`."""
        rows = noise.rows
        mean, slopes = self.means(theta, rows, first)
        output = quantised_output(mean, noise.sigma, rows.step)
        slopes *= output.slope[:, None, :]
        m, k, count = slopes.shape
        both = np.concatenate([(self.z[rows.index] - output.mean)[:, None], slopes], axis=1)
        # residual and slopes by one solution of the triangle
        white = noise.whitened(both.reshape(-1, count).T).T.reshape(m, k + 1, count)
        return white[:, 0], white[:, 1:]

    def _raw(self, theta: Array) -> tuple[CutPixels, Array]:
        """Raw pixels, shape (m, r), with full ones cut, and derivatives of their means, shape (m, k, r)."""
        mean, derivatives = self.pixels.at(theta)
        mean, derivatives = mean.reshape(len(theta), -1), derivatives.reshape(*theta.shape, -1)
        cut = cut_pixels(mean, raw_variance_e2(self.model, mean), self.model.card.saturation_e)
        return cut, derivatives * cut.slope[:, None, :]

    def fisher(self, theta: Array) -> Array:
        """J^T C^-1 J of the model's output, shape (k, k)."""
        noise = self.noise(theta)
        if noise.dead:
            return np.zeros((len(theta), len(theta)))
        _, J = self.residual(noise, theta[None])
        return np.asarray(J[0] @ J[0].T)


def shared_covariance(factor: Array, room: Array, sigma: Array, slope: Array, step: Array) -> Array:
    """Covariance between the quantised coefficients of two frames that share some errors, shape (n, n).

    An error that both share comes through the quantiser with its slope. Besides that, both are rounded alike as far as
    the noise of each alone does not move them in their step, and as the shared error leaves open where they are.

    Parameters
    ----------
    factor : shape (r, n), F of which F^T F is the shared covariance by the raw pixels, before the quantiser
    room : shape (n,), shared variance of other origin
    sigma : shape (n,), standard deviation before the quantiser, all in all
    slope, step : shape (n,), of the quantiser
    """
    shared = np.einsum("rn,rn->n", factor, factor) + room
    # what differs from frame to frame: it alone decorrelates the rounding
    own = np.sqrt(np.maximum(sigma**2 - shared, 0.0))
    alike = step_correlation(own / step) - step_correlation(sigma / step)
    E = factor * slope
    C = E.T @ E
    C[np.diag_indices_from(C)] += slope**2 * room + step**2 / 12.0 * alike
    return np.asarray(C)


def fit_window(window: CoefficientWindow, starts: Array, steps: int = _STEPS) -> WindowFit:
    """Fit one window from hypotheses, shape (s, k); the one with the smallest misfit after some steps goes on."""
    noise = window.noise(starts[0])
    if noise.dead:
        return WindowFit(starts[0], np.zeros((starts.shape[1],) * 2), np.nan, False)
    theta = _best(window, noise, starts)
    r, J = window.residual(noise, theta[None])
    length = np.inf
    for k in range(steps):
        if 0 < k < _FRESH:
            noise = window.noise(theta, noise.rows)
            r, J = window.residual(noise, theta[None])
        theta, r, J, length = _descended(window, noise, theta, r, J)
        if k and length < _SMALL:
            break
    chi2 = float(r[0] @ r[0]) / max(len(noise.sigma) - len(theta), 1)
    return WindowFit(theta, J[0] @ J[0].T, chi2, length < _REST)


def _best(window: CoefficientWindow, noise: Noise, starts: Array) -> Array:
    """Start with the smallest misfit after some steps."""
    theta = starts
    if len(starts) > 1:
        for _ in range(_SCREENING_STEPS):
            theta = _moved(window, theta, _newton(*window.residual(noise, theta)))
    r, _ = window.residual(noise, theta)
    return np.asarray(theta[np.argmin(np.einsum("ml,ml->m", r, r))])


def _descended(
    window: CoefficientWindow, noise: Noise, theta: Array, r: Array, J: Array
) -> tuple[Array, Array, Array, float]:
    """One step that does not raise the misfit, what belongs to it, and its squared length in standard deviations."""
    step = _newton(r, J)
    length = float(np.sum((step[0] @ J[0]) ** 2))
    for halving in range(_HALVINGS + 1):
        tried = _moved(window, theta[None], 0.5**halving * step)
        new_r, new_J = window.residual(noise, tried)
        if new_r[0] @ new_r[0] <= r[0] @ r[0] * (1.0 + 1e-12):  # 1e-12: rounding is no rise
            return tried[0], new_r, new_J, length
    return theta, r, J, 0.0  # at the bottom of a misfit with corners


def _newton(r: Array, J: Array) -> Array:
    """Gauss-Newton steps, shape (m, k)."""
    return scoring_step(J @ np.swapaxes(J, 1, 2), np.einsum("mkl,ml->mk", J, r))


def _moved(window: CoefficientWindow, theta: Array, step: Array) -> Array:
    """Hypotheses after limited steps."""
    return limited_step(theta, step, most_px=_STEP_PX, free_width=window.pixels.free_width)
