"""Fisher matrices from derivative images, and the covariance bound of the first unknowns with the others free.

Maximum likelihood of a spot's position on raw pixels, mono or Bayer, for many spots at once.

Model of a pixel with filter c: mu = flux x response_c x (Gaussian blur integrated over the pixel) + background_c.
Noise: Poisson plus Gauss with the variance V(mu) of `PixelNoise`. The score sum (x - mu) / V(mu) dmu is unbiased, and
without PRNU it is the exact one of the shifted Poisson law x + r^2 ~ Poisson(mu + r^2) (F. Huang et al., Nature Methods
10, 653, 2013); with PRNU it is the quasi-score of R. W. M. Wedderburn (Biometrika 61, 439, 1974). Fisher scoring from
3 x 3 starts, because the likelihood on a Bayer grid has several minima.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import convolve1d

from phibench.estimator.geometry.status import Status, StatusArray, flag, keep
from phibench.estimator.spots.gaussian_spot import profile, spot_images
from phibench.estimator.spots.raw_pixels import GaussLaw, PixelLaw, PixelNoise, bayer_filters
from phibench.scenes.frames import Array, BoolArray

_CONDITION = 1e12  # of the scaled matrix; beyond it the unknowns cannot be told apart
_DEPENDENT = 1e-11  # of the largest eigenvalue of a covariance: below this an output repeats others


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


def processed_fisher(slopes: ArrayLike, covariance: Array, draws: int = 0) -> Array:
    """Lower bound of the Fisher matrix of any output from its mean and covariance, shape (k, k).

    J >= (dm/dt)^T C^-1 (dm/dt): M. Stein, A. Mezghani, J. A. Nossek, IEEE Signal Process. Lett. 21, 796 (2014).
    What is left out is in the output's higher moments, so that the inverse is no bound for every method: it is that of
    methods that know the output by its mean and covariance. The truth lies between it and the raw pixels' bound.

    Parameters
    ----------
    slopes : shape (k, n), or (s, k, n)
        Derivatives of the mean output by k unknowns. With s >= 2 independent noisy estimates only products of different
        ones are averaged, so that their noise adds no information.
    covariance : shape (n, n)
        Outputs that never vary (a clipped or empty pixel) must not depend on the unknowns; they are left out.
    draws : int
        Number of draws behind `covariance`; 0 for a closed form. C^-1 of a sample is too large by
        (draws - 1) / (draws - n - 2) for Gaussian data, which is divided out: J. Hartlap, P. Simon, P. Schneider,
        A&A 464, 399 (2007).

    Raises
    ------
    ValueError
        If there are too few draws for n outputs.
    """
    D = np.asarray(slopes, float)
    D = D[None] if D.ndim == 2 else D
    varies = np.diagonal(covariance) > 0.0
    n = int(varies.sum())
    factor = hartlap_factor(n, draws) if draws else 1.0
    D = D[:, :, varies]
    # outputs that are sums of others (interpolated pixels before they are rounded) add nothing: pseudo-inverse
    inverse = np.linalg.pinv(covariance[np.ix_(varies, varies)], rcond=_DEPENDENT, hermitian=True)
    products = np.einsum("akn,nm,blm->abkl", D, inverse, D, optimize=True)
    apart = ~np.eye(len(D), dtype=bool) if len(D) > 1 else np.ones((1, 1), bool)
    mean = products[apart].mean(axis=0)
    return factor * 0.5 * (mean + mean.T)


def hartlap_factor(outputs: int, draws: int) -> float:
    """(draws - n - 2) / (draws - 1), by which the inverse of a sample covariance of n outputs is unbiased."""
    if draws < outputs + 3:
        raise ValueError(
            f"covariance of {outputs} outputs from {draws} draws: it has no inverse; {outputs + 3} draws are the least "
            f"that will do, {10 * outputs} are sound"
        )
    return (draws - outputs - 2.0) / (draws - 1.0)


LASER_RESPONSE = (1.0, 0.10, 0.03)  # of R, G, B at 650 nm, assumed: `scenes/detector.py`
START_PX = 0.6  # half width of the 3 x 3 grid of starts
LEAST_SNR = 3.0  # flux over its standard deviation below which there is no spot
_SCREENING_STEPS = 4
_DAMPING = (1.0,) * 12 + (0.5,) * 16 + (0.25,) * 24  # of the steps after screening: full ones may go round in circles
_DECREMENT = 1e-8  # squared distance from the minimum in standard deviations: 1e-4 of one
_STEP_PX = 0.5
_SIGMA_RANGE_PX = (0.15, 10.0)
_AT_ONCE = 64
_LEAST_INFORMATION = 1e-12  # per electron squared: of a pixel that is full


@dataclass(frozen=True)
class SpotFit:
    """Fits of n spots; NaN where the status is not OK.

    Attributes
    ----------
    uv_px : shape (n, 2), in the image
    covariance_px2 : shape (n, 2, 2), from the Fisher matrix at the fit
    flux_e : shape (n,), electrons that a pixel of response 1 would see in all
    background_e : shape (n, c), per filter R, G, B, or one; NaN where it was given
    sigma_px : shape (n,)
    chi2 : shape (n,), sum over the pixels that were used of score^2 / information, which is (x - mu)^2 / V for raw
        pixels, per degree of freedom
    status : shape (n,), values of `Status`
    """

    uv_px: Array
    covariance_px2: Array
    flux_e: Array
    background_e: Array
    sigma_px: Array
    chi2: Array
    status: StatusArray


@dataclass(frozen=True)
class _Data:
    """Regions as the fit needs them; axes are spot, row, column; theta = u, v, flux, backgrounds, width."""

    x: Array
    finite: BoolArray  # (n,): whether the region is
    used: BoolArray
    response: Array
    base: Array
    levels: Array  # (n, c, h, w): 1 where the pixel has that background level
    law: PixelLaw
    sigma: Array  # (n,)
    ratio: Array  # (n,)
    mixed: Array  # (n,)
    free_width: bool

    def rows(self, index: NDArray[np.int64]) -> _Data:
        arrays = ("x", "finite", "used", "response", "base", "levels", "sigma", "ratio", "mixed")
        return replace(self, law=self.law.rows(index), **{name: getattr(self, name)[index] for name in arrays})


def fit_raw(
    regions_e: Array,
    origin_px: ArrayLike,
    noise: PixelNoise,
    sigma_px: ArrayLike,
    response: tuple[float, float, float] | None = LASER_RESPONSE,
    background_e: Array | None = None,
    free_width: bool = False,
    saturation_e: float = np.inf,
) -> SpotFit:
    """Fit one spot in each region.

    Parameters
    ----------
    regions_e : shape (n, h, w), electrons, black level off (`raw_pixels.raw_electrons`)
    origin_px : shape (2,) or (n, 2)
        Image pixel (u, v) of the first column and row: where the mosaic's red pixels are.
    noise : PixelNoise
    sigma_px : float or shape (n,)
        Blur of the spot; the start of it with `free_width`.
    response : 3 floats or None
        Of the filters R, G, B at the laser's wavelength; None for pixels without filters.
    background_e : shape (n, h, w) or (h, w), optional
        Known background, dark current included; levels per filter are fitted if it is not given.
    free_width : bool
        Fit the blur as well.
    saturation_e : float
        Pixels from here on are left out.

    Returns
    -------
    SpotFit
        Status NOT_FINITE, SATURATED (fewer pixels than unknowns), NO_SPOT (flux below `LEAST_SNR` standard deviations),
        SPOT_CUT (the minimum lies outside the region), NOT_CONVERGED.

    Raises
    ------
    ValueError
        If the shapes do not go together.
    """
    x = np.asarray(regions_e, float)
    return fit_law(x, origin_px, GaussLaw(noise), sigma_px, response, background_e, free_width, x < saturation_e)


def fit_law(
    regions_e: Array,
    origin_px: ArrayLike,
    law: PixelLaw,
    sigma_px: ArrayLike,
    response: tuple[float, float, float] | None = LASER_RESPONSE,
    background_e: Array | None = None,
    free_width: bool = False,
    used: ArrayLike = True,
    ratio: ArrayLike = 1.0,
    mixed_px2: ArrayLike = 0.0,
) -> SpotFit:
    """As `fit_raw`, for pixels of any law.

    Parameters
    ----------
    law : PixelLaw
        Of all regions.
    used : boolean, shape (n, h, w) or one that broadcasts to it
        Pixels that are not left out.
    ratio : float or shape (n,)
        Blur along v over blur along u.
    mixed_px2 : float or shape (n,)
        Mixed second moment of u and v of an oblique spot, to first order.

    Other parameters, errors and the result are those of `fit_raw`.
    """
    x = np.asarray(regions_e, float)
    if x.ndim != 3 or min(x.shape[1:], default=0) < 3:
        raise ValueError(f"regions have the shape {x.shape}: (n, h, w) of 3 x 3 pixels or more is needed")
    origin = np.broadcast_to(np.asarray(origin_px, np.int64), (len(x), 2))
    data = _data(x, origin, law, np.broadcast_to(np.asarray(sigma_px, float), len(x)), response, background_e)
    ratios, mixed = (np.broadcast_to(np.asarray(value, float), len(x)) for value in (ratio, mixed_px2))
    both = data.used & np.asarray(used, bool)
    data = replace(data, used=both, free_width=free_width, ratio=ratios, mixed=mixed)
    parts = [np.arange(i, min(i + _AT_ONCE, len(x))) for i in range(0, len(x), _AT_ONCE)]
    fits = [_fit(data.rows(part), origin[part]) for part in parts]
    if not fits:
        return _nothing(data.levels.shape[1])
    return SpotFit(*(np.concatenate([getattr(fit, f.name) for fit in fits]) for f in fields(SpotFit)))


def _data(
    x: Array,
    origin: NDArray[np.int64],
    law: PixelLaw,
    sigma: Array,
    response: tuple[float, float, float] | None,
    background_e: Array | None,
) -> _Data:
    filters = np.zeros(x.shape, np.int64) if response is None else bayer_filters(origin, x.shape[1:])
    weights = np.ones(1) if response is None else np.array(response)
    used = np.isfinite(x)
    if background_e is not None:
        base, levels = np.broadcast_to(np.asarray(background_e, float), x.shape), np.zeros((len(x), 0, *x.shape[1:]))
    else:
        base = np.zeros(x.shape)
        levels = (filters[:, None] == np.arange(len(weights))[:, None, None]).astype(float)
    finite = used.all(axis=(1, 2)) & np.isfinite(base).all(axis=(1, 2))
    return _Data(
        np.where(used, x, 0.0),
        finite,
        used,
        weights[filters],
        base,
        levels,
        law,
        sigma,
        np.ones(len(x)),
        np.zeros(len(x)),
        False,
    )


def _fit(data: _Data, origin: NDArray[np.int64]) -> SpotFit:
    with np.errstate(all="ignore"):
        theta = _screened(data, _first_guess(data))
        theta, converged = _polished(data, theta)
        return _result(data, theta, converged, origin)


def _screened(data: _Data, guess: Array) -> Array:
    """Guess with the position and flux of the deepest minimum of nine starts; background and width stay as guessed."""
    n, c = len(guess), data.levels.shape[1]
    grid = START_PX * np.stack(np.meshgrid((-1, 0, 1), (-1, 0, 1)), -1).reshape(-1, 2)
    base = data.base + np.einsum("nc,nchw->nhw", guess[:, 3 : 3 + c], data.levels)
    fixed = replace(data, base=base, levels=data.levels[:, :0], free_width=False)
    many = fixed.rows(np.repeat(np.arange(n), len(grid)))
    theta = np.repeat(guess[:, :3], len(grid), axis=0)
    theta[:, :2] += np.tile(grid, (n, 1))
    for _ in range(_SCREENING_STEPS):
        theta, _ = _step(many, theta)
    best = np.argmin(_misfit(many, theta).reshape(n, -1), axis=1)
    return np.column_stack([theta.reshape(n, len(grid), 3)[np.arange(n), best], guess[:, 3:]])


def _first_guess(data: _Data) -> Array:
    """Background: median of the border per level. Position and flux: peak of the matched filter on whole pixels."""
    border = data.used.copy()
    border[:, 2:-2, 2:-2] = False
    levels = [_median(data.x, border & (data.levels[:, i] > 0.0)) for i in range(data.levels.shape[1])]
    b = np.stack(levels, axis=1) if levels else np.zeros((len(data.x), 0))
    above = data.x - data.base - np.einsum("nc,nchw->nhw", b, data.levels)
    kernel = profile(np.array([4.0]), np.array([np.median(data.sigma)]), 9).share[0]
    match = _blurred(np.where(data.used, above * data.response, 0.0), kernel)
    norm = _blurred(np.where(data.used, data.response**2, 0.0), kernel**2) + 1e-12
    gain = np.maximum(match, 0.0) ** 2 / norm
    v, u = np.unravel_index(np.argmax(gain.reshape(len(gain), -1), axis=1), gain.shape[1:])
    each = np.arange(len(gain))
    flux = np.maximum(match[each, v, u] / norm[each, v, u], 1.0)
    width = [data.sigma] if data.free_width else []
    return np.column_stack([u, v, flux, b, *width]).astype(float)


def _median(x: Array, mask: BoolArray) -> Array:
    """Lower median of the masked pixels, shape (n,), 0 where there are none; nanmedian takes ten times longer."""
    rising = np.sort(np.where(mask, x, np.inf).reshape(len(x), -1), axis=1)
    middle = np.maximum(mask.sum(axis=(1, 2)) - 1, 0) // 2
    median = np.take_along_axis(rising, middle[:, None], axis=1)[:, 0]
    return np.where(np.isfinite(median), median, 0.0)


def _blurred(images: Array, kernel: Array) -> Array:
    return np.asarray(convolve1d(convolve1d(images, kernel, axis=1, mode="constant"), kernel, axis=2, mode="constant"))


def _model(data: _Data, theta: Array) -> tuple[Array, Array]:
    """Mean, shape (n, h, w), and its derivatives, shape (n, k, h, w)."""
    shape, c = data.x.shape[1:], data.levels.shape[1]
    sigma = theta[:, -1] if data.free_width else data.sigma
    spots = spot_images(theta[:, :2], theta[:, 2], sigma, data.ratio, data.mixed, shape, data.free_width)
    spots *= data.response[:, None]
    derivatives = np.empty((len(theta), theta.shape[1], *shape))
    derivatives[:, :3] = spots[:, :3]
    derivatives[:, 3 : 3 + c] = data.levels
    if data.free_width:
        derivatives[:, -1] = spots[:, 3]
    mean = theta[:, 2, None, None] * spots[:, 2] + data.base
    for i in range(c):
        mean += theta[:, 3 + i, None, None] * data.levels[:, i]
    return mean, derivatives


def _scores(data: _Data, theta: Array) -> tuple[Array, Array]:
    """Score, shape (n, k), and Fisher matrix, shape (n, k, k)."""
    mean, derivatives = _model(data, theta)
    n, k = theta.shape
    weight = data.used * data.law.information(mean)
    flat = derivatives.reshape(n, k, -1)
    weighted = flat * weight.reshape(n, 1, -1)
    score = (flat @ (data.used * data.law.score(data.x, mean)).reshape(n, -1, 1))[..., 0]
    return score, weighted @ np.swapaxes(flat, 1, 2)


def _step(data: _Data, theta: Array, damping: float = 1.0) -> tuple[Array, Array]:
    """One step of Fisher scoring, limited; and the squared distance in standard deviations that the whole step had."""
    score, fisher = _scores(data, theta)
    diagonal = np.einsum("nkk->nk", fisher)
    diagonal *= 1.0 + 1e-9  # a view: keeps a matrix of unknowns that nothing tells apart from stopping all
    diagonal += 1e-12
    step = np.linalg.solve(fisher, score[..., None])[..., 0]
    limit = np.minimum(damping, _STEP_PX / np.maximum(np.abs(step[:, :2]).max(axis=1), 1e-300))
    new = theta + limit[:, None] * step
    new[:, 2] = np.maximum(new[:, 2], 0.1 * np.maximum(theta[:, 2], 1.0))
    if data.free_width:
        new[:, -1] = np.clip(new[:, -1], 0.7 * theta[:, -1], 1.4 * theta[:, -1]).clip(*_SIGMA_RANGE_PX)
    return np.where(np.isfinite(new), new, theta), np.sum(step * score, axis=1)


def _polished(data: _Data, theta: Array) -> tuple[Array, BoolArray]:
    """Go on until the step is small against the standard deviation; only what still moves is computed."""
    theta, moving = theta.copy(), np.arange(len(theta))
    for damping in _DAMPING:
        theta[moving], decrement = _step(data.rows(moving), theta[moving], damping)
        moving = moving[~(decrement < _DECREMENT)]
        if moving.size == 0:
            break
    return theta, ~np.isin(np.arange(len(theta)), moving)


def _misfit(data: _Data, theta: Array) -> Array:
    """-2 log likelihood, shape (n,): which of the minima is the deepest."""
    mean, _ = _model(data, theta)
    value = np.sum(data.used * data.law.misfit(data.x, mean), axis=(1, 2))
    return np.where(np.isfinite(value), value, np.inf)


def _result(data: _Data, theta: Array, converged: BoolArray, origin: NDArray[np.int64]) -> SpotFit:
    n, k = theta.shape
    h, w = data.x.shape[1:]
    _, fisher = _scores(data, theta)
    covariance = covariance_bound(fisher, keep=3)
    inside = (np.abs(theta[:, 0] - (w - 1) / 2) <= w / 2) & (np.abs(theta[:, 1] - (h - 1) / 2) <= h / 2)
    used = data.used.sum(axis=(1, 2))
    status = flag(
        (~data.finite, Status.NOT_FINITE),
        (used <= k, Status.SATURATED),
        (~(theta[:, 2] > LEAST_SNR * np.sqrt(covariance[:, 2, 2])), Status.NO_SPOT),
        (~inside, Status.SPOT_CUT),
        (~converged, Status.NOT_CONVERGED),
    )
    mean, _ = _model(data, theta)
    square = data.used * data.law.score(data.x, mean) ** 2 / np.maximum(data.law.information(mean), _LEAST_INFORMATION)
    chi2 = np.sum(square, axis=(1, 2)) / np.maximum(used - k, 1)
    c = data.levels.shape[1]
    background = theta[:, 3 : 3 + c] if c else np.full((n, 1), np.nan)
    sigma = theta[:, -1] if data.free_width else data.sigma
    values = (theta[:, :2] + origin, covariance[:, :2, :2], theta[:, 2], background, sigma, chi2)
    uv, uv_covariance, flux, levels, width, misfit = (keep(value, status) for value in values)
    return SpotFit(uv, uv_covariance, flux, levels, width, misfit, status)


def _nothing(levels: int) -> SpotFit:
    none = np.zeros(0)
    shape = (0, max(levels, 1))
    return SpotFit(np.zeros((0, 2)), np.zeros((0, 2, 2)), none, np.zeros(shape), none, none, np.zeros(0, np.int64))
