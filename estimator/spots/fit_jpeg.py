"""Fit of a spot to a window of quantised outputs, by a quasi-score through the processing.

Outputs are codes of R, G, B (srgb8), of Y', Cb, Cr (yuyv), or a JPEG's coefficients (mjpeg).

With m the mean and C the covariance of the quantiser's output, the estimating equation J^T C^-1 (z - m) = 0 is unbiased
whatever the law of the output (R. W. M. Wedderburn, Biometrika 61, 439, 1974). Its covariance (J^T C^-1 J)^-1 is the
smallest of estimates that know m and C only (`limits.processed_bound`). The quantiser of a Gaussian
input gives m, and C_ij = g_i g_j C'_ij off the diagonal, g its mean slope and C' the input's covariance (J. J.
Bussgang, 1952). A coefficient that is 0 whatever the noise has no slope and is left out.

A window is 2 x 2 JPEG units of a decoded region, or 12 x 12 pixels of another, with the spot nearest to its middle.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from phibench.datasets.frames.sensor_card import SensorCard
from phibench.estimator.spots.camera_codes import ycbcr_codes
from phibench.estimator.spots.chain_model import (
    ChainModel,
    code_slopes,
    codes,
    noise_factor,
    raw_variance_e2,
    window_px,
)
from phibench.estimator.spots.fisher import limited, scoring_step
from phibench.estimator.spots.gaussian_spot import SpotBlur, SpotModel, SpotPixels
from phibench.estimator.spots.jpeg_coefficients import (
    hidden_share,
    mcu_px,
    qtables_of,
    quantised,
    recovered,
    room_variance,
    step_correlation,
)
from phibench.estimator.spots.pixel_statistics import CutPixels, cut_pixels
from phibench.scenes.frames import Array

_LIVE = 2e-3  # variance of the output, in steps squared, from which a coefficient counts as one that changes
_LEAST = 1e-3  # and that is taken for one whose variance falls below it
_FRESH = 5  # times that the covariance is computed
_STEPS = 24  # of the fit in all; the covariance stays after `_FRESH` of them, so that the misfit can only fall
_SCREENING_STEPS = 3
_STEP_PX = 0.4  # shorter than on raw pixels: a coarse quantiser has plateaus
_HALVINGS = 3
_SMALL = 1e-4  # squared step in standard deviations at which the fit ends
_REST = 1e-2  # and at which it has come to rest, if it ends for its number of steps


@dataclass(frozen=True)
class Rows:
    """Some of a model's coefficients, with what belongs to them; `index` into all, shape (l,)."""

    index: NDArray[np.int64]
    transform: Array
    squares: Array
    step: Array
    shift: Array
    rounding: Array

    @classmethod
    def all(cls, model: ChainModel) -> Rows:
        """All coefficients of a model."""
        names = ("transform", "squares", "step", "shift", "rounding")
        return cls(np.arange(len(model.step)), *(getattr(model, name) for name in names))

    def part(self, index: NDArray[np.int64]) -> Rows:
        """Take some of them."""
        return Rows(*(np.take(getattr(self, f.name), index, axis=-1) for f in fields(self)))


@dataclass(frozen=True)
class Noise:
    """Covariance of the live coefficients at one hypothesis.

    Attributes
    ----------
    rows : Rows
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
class JpegFit:
    """Fit of one window; positions in the raw window's own pixels.

    Attributes
    ----------
    theta : shape (k,), as `SpotPixels`
    fisher : shape (k, k), J^T C^-1 J
    chi2 : float, r^T C^-1 r per degree of freedom
    converged : bool
    """

    theta: Array
    fisher: Array
    chi2: float
    converged: bool


@dataclass(frozen=True)
class Window:
    """Coefficients of one window with the model that is fitted to them.

    Attributes
    ----------
    z : shape (n,), quantised coefficients in the order of `jpeg_coefficients.coefficients`, mean of the frames
    model : ChainModel
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
    """

    z: Array
    model: ChainModel
    pixels: SpotPixels
    extra_e2: Array | float = 0.0
    room: Array | float = 0.0
    frames: int = 1
    prnu: float = 0.0

    def noise(self, theta: Array, live: Rows | None = None, least: float = _LIVE) -> Noise:
        """Covariance of the quantised coefficients for one hypothesis, shape (k,); which are live, if it is known.

        Otherwise those are whose variance exceeds `least`, in steps squared.
        """
        model = self.model
        rows = live or Rows.all(model)
        raw, _ = self._raw(theta[None])
        at = codes(model, raw.mean_e).one(0)
        extra = raw.slope[0] ** 2 * (self.extra_e2 + self._pattern_e2(theta))
        F = noise_factor(model, at, raw.variance_e2[0] + extra, rows.transform)
        room = np.broadcast_to(self.room, len(model.step))[rows.index]
        sigma = np.sqrt(np.einsum("rn,rn->n", F, F) + at.excess @ rows.squares + rows.rounding + room)
        output = quantised(at.mean @ rows.transform + rows.shift, sigma, rows.step)
        variance = np.maximum(output.variance, _LEAST * rows.step**2)
        slope = output.slope
        if live is None:
            index = np.flatnonzero(output.variance > least * rows.step**2)
            F, slope, variance, sigma, rows = F[:, index], slope[index], variance[index], sigma[index], rows.part(index)
            room = room[index]
        F *= slope
        C = F.T @ F
        np.fill_diagonal(C, variance)
        if self.frames > 1:
            if model.noise.prnu > 0.0:
                extra = extra + raw.slope[0] ** 2 * (model.noise.prnu * np.maximum(raw.mean_e[0], 0.0)) ** 2
            E = noise_factor(model, at, extra, rows.transform)
            alike = shared_covariance(E, room, sigma, slope, rows.step)
            C = C / self.frames + (1.0 - 1.0 / self.frames) * alike
        return Noise(rows, sigma, np.asarray(np.linalg.cholesky(C), float))

    def _pattern_e2(self, theta: Array) -> Array | float:
        """Variance of the spot's light by PRNU, shape (r,)."""
        if self.prnu == 0.0:
            return 0.0
        _, derivatives = self.pixels.at(theta[None])
        return np.asarray((self.prnu * theta[2] * derivatives[0, 2].ravel()) ** 2)

    def residual(self, noise: Noise, theta: Array) -> tuple[Array, Array]:
        """Whitened residuals, shape (m, l), and derivatives of the mean, shape (m, k, l), of hypotheses (m, k)."""
        rows = noise.rows
        raw, derivatives = self._raw(theta)
        at = codes(self.model, raw.mean_e)
        output = quantised(at.mean @ rows.transform + rows.shift, noise.sigma, rows.step)
        changes = code_slopes(self.model, at, derivatives)
        slopes = (changes @ rows.transform) * output.slope[:, None, :]
        m, k, count = slopes.shape
        both = np.concatenate([(self.z[rows.index] - output.mean)[:, None], slopes], axis=1)
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
    own = np.sqrt(np.maximum(sigma**2 - shared, 0.0))
    alike = step_correlation(own / step) - step_correlation(sigma / step)
    E = factor * slope
    C = E.T @ E
    C[np.diag_indices_from(C)] += slope**2 * room + step**2 / 12.0 * alike
    return np.asarray(C)


def fit_window(window: Window, starts: Array) -> JpegFit:
    """Fit one window from hypotheses, shape (s, k); the one with the smallest misfit after some steps goes on."""
    noise = window.noise(starts[0])
    if noise.dead:
        return JpegFit(starts[0], np.zeros((starts.shape[1],) * 2), np.nan, False)
    theta = _best(window, noise, starts)
    r, J = window.residual(noise, theta[None])
    length = np.inf
    for k in range(_STEPS):
        if 0 < k < _FRESH:
            noise = window.noise(theta, noise.rows)
            r, J = window.residual(noise, theta[None])
        theta, r, J, length = _descended(window, noise, theta, r, J)
        if k and length < _SMALL:
            break
    chi2 = float(r[0] @ r[0]) / max(len(noise.sigma) - len(theta), 1)
    return JpegFit(theta, J[0] @ J[0].T, chi2, length < _REST)


def _best(window: Window, noise: Noise, starts: Array) -> Array:
    """Start with the smallest misfit after some steps."""
    theta = starts
    if len(starts) > 1:
        for _ in range(_SCREENING_STEPS):
            theta = _moved(window, theta, _newton(*window.residual(noise, theta)))
    r, _ = window.residual(noise, theta)
    return np.asarray(theta[np.argmin(np.einsum("ml,ml->m", r, r))])


def _descended(window: Window, noise: Noise, theta: Array, r: Array, J: Array) -> tuple[Array, Array, Array, float]:
    """One step that does not raise the misfit, what belongs to it, and its squared length in standard deviations."""
    step = _newton(r, J)
    length = float(np.sum((step[0] @ J[0]) ** 2))
    for halving in range(_HALVINGS + 1):
        tried = _moved(window, theta[None], 0.5**halving * step)
        new_r, new_J = window.residual(noise, tried)
        if new_r[0] @ new_r[0] <= r[0] @ r[0] * (1.0 + 1e-12):
            return tried[0], new_r, new_J, length
    return theta, r, J, 0.0  # at the bottom of a misfit with corners


def _newton(r: Array, J: Array) -> Array:
    """Gauss-Newton steps, shape (m, k)."""
    return scoring_step(J @ np.swapaxes(J, 1, 2), np.einsum("mkl,ml->mk", J, r))


def _moved(window: Window, theta: Array, step: Array) -> Array:
    """Hypotheses after limited steps."""
    return limited(theta, step, most_px=_STEP_PX, free_width=window.pixels.free_width)


# -- windows of decoded images ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Region:
    """One region on the grid of JPEG units, or one that begins at an even row and column.

    Attributes
    ----------
    image : shape (f, h, w, 3), uint8, of f frames; (f, h, w, 2) of "yuyv"
    ends : 4 booleans
        Top, bottom, left and right side are the image's own.
    background_e, extra_e2 : shape (h, w)
        Background of the raw pixels, and the variance of its error.
    room : shape (f, h, w, 3), uint8, optional
        Decoded frames without the laser that the background was taken from.
    prnu : float
        Of the spot's light, where the background's variance holds the pattern of the room.
    """

    image: NDArray[Any]
    ends: tuple[bool, bool, bool, bool]
    background_e: Array
    extra_e2: Array
    room: NDArray[Any] | None = None
    prnu: float = 0.0


def window_at(region: Region, chain: ChainModel, uv: Array) -> tuple[int, int]:
    """First row and column, in the region, of the window on the grid that has (u, v) nearest to its middle."""
    steps = grid_px(chain.card)
    places = []
    for centre, unit, side, size in zip((uv[1], uv[0]), steps, chain.shape, region.image.shape[1:3], strict=True):
        first = int(np.clip(np.rint((centre + 0.5 - side / 2) / unit), 0, (size - side) // unit))
        places.append(first * unit)
    return places[0], places[1]


def grid_px(card: SensorCard) -> tuple[int, int]:
    """Rows and columns at whose multiples a window may begin: JPEG's units, or the mosaic's cell."""
    return mcu_px(card.jpeg_subsampling) if card.output == "mjpeg" else (2, 2)


def fit_region(
    region: Region, chain: ChainModel, starts: Array, blur: SpotBlur, model: SpotModel
) -> tuple[JpegFit, Array]:
    """Fit the spot of one region.

    Parameters
    ----------
    region : Region
    chain : ChainModel
    starts : shape (s, 6) or (s, 7)
        u, v in the region, flux, levels on top of the background, width if it is free.
    blur : SpotBlur
    model : SpotModel
        Its background is not looked at; the region's is.

    Returns
    -------
    JpegFit
        Positions in the region.
    shape (2,)
        Distance of (u, v) from the window's middle, in half windows: above 1 it lies outside.
    """
    window, corner = region_window(region, chain, starts[0, :2], blur, model)
    shifted = starts.copy()
    shifted[:, :2] -= corner
    fit = fit_window(window, shifted)
    (h, w), m = chain.shape, chain.margin
    middle = np.array([(w - 1) / 2.0 + m, (h - 1) / 2.0 + m])
    off = np.abs(fit.theta[:2] - middle) / np.array([w / 2.0, h / 2.0])
    theta = fit.theta.copy()
    theta[:2] += corner
    return JpegFit(theta, fit.fisher, fit.chi2, fit.converged), off


def region_window(
    region: Region, chain: ChainModel, uv: Array, blur: SpotBlur, model: SpotModel
) -> tuple[Window, Array]:
    """Window of a region for a spot near (u, v), and the window's first raw pixel (u, v) in the region."""
    row, column = window_at(region, chain, uv)
    (h, w), m = chain.shape, chain.margin
    raw = (slice(row, row + h + 2 * m), slice(column, column + w + 2 * m))
    background, extra = (np.pad(x, m, mode="reflect")[raw] for x in (region.background_e, region.extra_e2))
    # the levels are fitted on top of the background
    pixels = replace(
        SpotPixels.of(chain.filters[None], blur, replace(model, background_e=None)), background_e=background[None]
    )
    corner = np.array([column - m, row - m], float)
    room: Array | float = 0.0
    if region.room is not None and chain.card.output == "mjpeg":
        room = _room(replace(region, image=region.room), chain, row, column, background)
    z = outputs_at(region, chain, row, column)
    return Window(z, chain, pixels, extra.ravel(), room, len(region.image), region.prnu), corner


def _room(region: Region, chain: ChainModel, row: int, column: int, background_e: Array) -> Array:
    """Variance of the room's coefficients by the quantiser, shape (n,), known from the region's frames."""
    found, count = coefficients_at(region, chain, row, column), len(region.image)
    if count == 1:
        return room_variance(found, chain.step)
    mean_e = np.maximum(background_e.ravel(), 0.0)
    at = codes(chain, mean_e)
    F = noise_factor(chain, at, raw_variance_e2(chain, mean_e), chain.transform)
    sigma = np.sqrt(np.einsum("rn,rn->n", F, F) + at.excess @ chain.squares + chain.rounding)
    return room_variance(found, chain.step, hidden_share(sigma / chain.step, count))


def outputs_at(region: Region, chain: ChainModel, row: int, column: int) -> Array:
    """Quantised outputs, shape (n,), of the window that begins at (row, column) of the region."""
    if chain.card.output == "mjpeg":
        return coefficients_at(region, chain, row, column)
    h, w = window_px(chain.card)
    image = region.image[:, row : row + h, column : column + w].mean(axis=0)
    return ycbcr_codes(image) if chain.card.output == "yuyv" else np.moveaxis(image, -1, 0).ravel()


def coefficients_at(region: Region, chain: ChainModel, row: int, column: int) -> Array:
    """Quantised coefficients, mean of the frames, shape (n,), of the window that begins at (row, column)."""
    card, (h, w) = chain.card, chain.shape
    down, across = mcu_px(card.jpeg_subsampling)
    height, width = region.image.shape[1:3]
    top, left = max(row - down, 0), max(column - across, 0)
    bottom, right = min(row + h + down, height), min(column + w + across, width)
    ends = (
        region.ends[0] and top == 0,
        region.ends[1] and bottom == height,
        region.ends[2] and left == 0,
        region.ends[3] and right == width,
    )
    found = recovered(region.image[:, top:bottom, left:right], qtables_of(card), card.jpeg_subsampling, ends)
    v, u = row - top, column - left
    luma = found.luma[:, v // 8 : (v + h) // 8, u // 8 : (u + w) // 8]
    chroma = found.chroma[:, :, v // down : (v + h) // down, u // across : (u + w) // across]
    return np.concatenate([luma.mean(axis=0).ravel(), chroma.mean(axis=0).ravel()])
