"""Maximum-likelihood fit of spots' positions on raw pixels (`fit_raw`), or on pixels of any law (`fit_law`).

The mean of a pixel is that of `SpotPixels`; its noise is Poisson plus Gauss with the variance V(mu) of `PixelNoise`.
The score sum (x - mu) / V(mu) dmu is unbiased. Without PRNU it is the exact one of the shifted Poisson law x + r^2 ~
Poisson(mu + r^2) (F. Huang et al., Nature Methods 10, 653, 2013). With PRNU it is the quasi-score of R. W. M.
Wedderburn (Biometrika 61, 439, 1974). Fisher scoring goes from 3 x 3 starts, because the likelihood on a Bayer grid has
several minima.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import convolve1d

from phibench.estimator.geometry.status import Status, StatusArray, flag, keep
from phibench.estimator.spots.gaussian_spot import (
    SpotBlur,
    SpotModel,
    SpotPixels,
    covariance_bound,
    limited_step,
    profile,
    scoring_step,
)
from phibench.estimator.spots.raw_pixels import GaussLaw, PixelLaw, PixelNoise, SpotRegions, spot_regions
from phibench.scenes.frames import Array, BoolArray

NEAR_PX = 1.5  # of a detection on interpolated pixels, which are up to a pixel off; lamps and noise lie farther off
START_PX = 0.6  # half width of the 3 x 3 grid of starts: the minima of a Bayer grid lie about a pixel apart
LEAST_SNR = 3.0  # flux over its standard deviation below which there is no spot
DAMPING = (1.0,) * 12 + (0.5,) * 16 + (0.25,) * 24  # of the steps after screening: full ones may go round in circles
DECREMENT = 1e-8  # squared distance from the minimum in standard deviations: 1e-4 of one
AT_ONCE = 64  # spots that are fitted together: their arrays stay in the cache
MISFIT_SIGMAS = 3.0  # by which a fit's chi2 must exceed 1 before its covariance is widened
_SCREENING_STEPS = 4
_LEAST_FREEDOM = 0.1  # of a pixel, 1 - leverage: one that a fit follows wholly says nothing of its misfit
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
    misfit_px2 : shape (n, 2, 2), covariance of (u, v) from the pixels' own misfits (`_sandwich`); NaN where a fit of
        another kind has none
    """

    uv_px: Array
    covariance_px2: Array
    flux_e: Array
    background_e: Array
    sigma_px: Array
    chi2: Array
    status: StatusArray
    misfit_px2: Array


@dataclass(frozen=True)
class SpotData:
    """Regions with the law of their readings and the model of their means: what a likelihood is made of."""

    regions: SpotRegions
    law: PixelLaw
    pixels: SpotPixels

    def __len__(self) -> int:
        return len(self.regions)

    def rows(self, index: NDArray[np.int64]) -> SpotData:
        """Data of some of the spots."""
        return SpotData(self.regions.rows(index), self.law.rows(index), self.pixels.rows(index))

    @property
    def unknowns(self) -> int:
        """Number of unknowns of a spot."""
        return self.pixels.unknowns

    def misfit(self, theta: Array) -> Array:
        """-2 log likelihood of unknowns, shape (n,), for which of the minima is the deepest; infinite for no number."""
        mean, _ = self.pixels.at(theta)
        value = np.sum(self.regions.used * self.law.misfit(self.regions.x_e, mean), axis=(1, 2))
        return np.where(np.isfinite(value), value, np.inf)


def spot_data(regions: SpotRegions, law: PixelLaw, blur: SpotBlur, model: SpotModel | None = None) -> SpotData:
    """Data of regions; parameters as for `fit_law`."""
    return SpotData(regions, law, SpotPixels.of(regions.filters, blur, model or SpotModel()))


def fit_raw(
    regions_e: Array,
    origin_px: ArrayLike,
    noise: PixelNoise,
    blur: SpotBlur,
    model: SpotModel | None = None,
    saturation_e: float = np.inf,
) -> SpotFit:
    """Fit one spot in each region of raw pixels.

    Parameters
    ----------
    regions_e, origin_px
        As for `spot_regions`.
    blur, model
        As for `fit_law`.
    saturation_e : float
        Pixels from here on are left out.

    Returns and raises what `fit_law` does, and a ValueError where the shapes do not go together.
    """
    x = np.asarray(regions_e, float)
    return fit_law(spot_regions(x, origin_px, x < saturation_e), GaussLaw(noise), blur, model)


def fit_law(
    regions: SpotRegions,
    law: PixelLaw,
    blur: SpotBlur,
    model: SpotModel | None = None,
    near_px: ArrayLike | None = None,
) -> SpotFit:
    """Fit one spot in each region, for pixels of any law.

    Parameters
    ----------
    law : PixelLaw
        Of all regions.
    blur : SpotBlur
        Of all spots or of each; its sigma is the start of a free width.
    model : SpotModel, optional
        By default the laser behind the filters of a mosaic, an unknown level per filter and a known width.
    near_px : shape (2,) or (n, 2), optional
        Place (u, v) in the image, within `NEAR_PX` of which a fit begins: of a detection. By default it begins where
        light stands out most, wherever in the region.

    Returns
    -------
    SpotFit
        Status NOT_FINITE, SATURATED (fewer pixels than unknowns), NO_SPOT (flux below `LEAST_SNR` standard deviations),
        SPOT_CUT (the minimum lies outside the region), NOT_CONVERGED.
    """
    data = spot_data(regions, law, blur, model)
    # whole rows of a table of spots: a fit does not depend on its neighbours
    parts = [np.arange(i, min(i + AT_ONCE, len(data))) for i in range(0, len(data), AT_ONCE)]
    near = None if near_px is None else np.broadcast_to(np.asarray(near_px, float), (len(data), 2))
    fits = [_fit(data.rows(rows), None if near is None else near[rows]) for rows in parts]
    if not fits:
        return _nothing(data.pixels.levels.shape[1])
    return SpotFit(*(np.concatenate([getattr(fit, f.name) for fit in fits]) for f in fields(SpotFit)))


def _fit(data: SpotData, near_px: Array | None) -> SpotFit:
    with np.errstate(all="ignore"):
        theta = _screened(data, _first_guess(data, near_px))
        theta, converged = scored_unknowns(data, theta)
        return _result(data, theta, converged)


# -- start -----------------------------------------------------------------------------------------------------------


def _first_guess(data: SpotData, near_px: Array | None) -> Array:
    """Background: median of the border per level. Position and flux: peak of the matched filter on whole pixels."""
    regions, pixels = data.regions, data.pixels
    border = regions.used.copy()
    # two pixels around the region hold next to no light of the spot
    border[:, 2:-2, 2:-2] = False
    levels = [_median(regions.x_e, border & (pixels.levels[:, i] > 0.0)) for i in range(pixels.levels.shape[1])]
    b = np.stack(levels, axis=1) if levels else np.zeros((len(data), 0))
    above = regions.x_e - pixels.background_e - np.einsum("nc,nchw->nhw", b, pixels.levels)
    kernel = profile(np.array([4.0]), np.array([np.median(pixels.blur.sigma_px)]), 9).share[0]
    match = _blurred(np.where(regions.used, above * pixels.response, 0.0), kernel)
    norm = _blurred(np.where(regions.used, pixels.response**2, 0.0), kernel**2) + 1e-12  # no used pixel near: 0 / 0
    # fall of chi^2 by a spot of the best flux at each pixel; a negative flux is none
    gain = np.maximum(match, 0.0) ** 2 / norm
    if near_px is not None:
        gain = near_alone(gain, near_px - regions.origin_px)
    v, u = np.unravel_index(np.argmax(gain.reshape(len(gain), -1), axis=1), gain.shape[1:])
    each = np.arange(len(gain))
    flux = np.maximum(match[each, v, u] / norm[each, v, u], 1.0)
    width = [np.asarray(pixels.blur.sigma_px)] if pixels.free_width else []
    return np.column_stack([u, v, flux, b, *width]).astype(float)


def near_alone(values: Array, uv_px: Array) -> Array:
    """Values of images, shape (n, h, w), within `NEAR_PX` of places, shape (n, 2), of them; elsewhere -inf."""
    v, u = np.indices(values.shape[1:])
    # a square, so that whole pixels about a detection count alike
    off = np.maximum(np.abs(u - uv_px[:, 0, None, None]), np.abs(v - uv_px[:, 1, None, None]))
    return np.where(off <= NEAR_PX, values, -np.inf)


def _median(x: Array, mask: BoolArray) -> Array:
    """Lower median of the masked pixels, shape (n,), 0 where there are none; nanmedian takes ten times longer."""
    rising = np.sort(np.where(mask, x, np.inf).reshape(len(x), -1), axis=1)
    middle = np.maximum(mask.sum(axis=(1, 2)) - 1, 0) // 2
    median = np.take_along_axis(rising, middle[:, None], axis=1)[:, 0]
    return np.where(np.isfinite(median), median, 0.0)


def _blurred(images: Array, kernel: Array) -> Array:
    return np.asarray(convolve1d(convolve1d(images, kernel, axis=1, mode="constant"), kernel, axis=2, mode="constant"))


def _screened(data: SpotData, guess: Array) -> Array:
    """Guess with the position and flux of the deepest minimum of nine starts; background and width stay as guessed."""
    n, c = len(guess), data.pixels.levels.shape[1]
    grid = START_PX * np.stack(np.meshgrid((-1, 0, 1), (-1, 0, 1)), -1).reshape(-1, 2)
    background = data.pixels.background_e + np.einsum("nc,nchw->nhw", guess[:, 3 : 3 + c], data.pixels.levels)
    # starts differ in place and flux alone: levels and width stay those of the guess
    fixed = replace(data.pixels, background_e=background, levels=data.pixels.levels[:, :0], free_width=False)
    many = replace(data, pixels=fixed).rows(np.repeat(np.arange(n), len(grid)))
    theta = np.repeat(guess[:, :3], len(grid), axis=0)
    theta[:, :2] += np.tile(grid, (n, 1))
    for _ in range(_SCREENING_STEPS):
        theta, _ = _step(many, theta)
    best = np.argmin(many.misfit(theta).reshape(n, -1), axis=1)
    return np.column_stack([theta.reshape(n, len(grid), 3)[np.arange(n), best], guess[:, 3:]])


# -- Fisher scoring --------------------------------------------------------------------------------------------------


def _scores(data: SpotData, theta: Array) -> tuple[Array, Array]:
    """Score, shape (n, k), and Fisher matrix, shape (n, k, k)."""
    mean, derivatives = data.pixels.at(theta)
    n, k = theta.shape
    used = data.regions.used
    weight = used * data.law.information(mean)
    flat = derivatives.reshape(n, k, -1)
    weighted = flat * weight.reshape(n, 1, -1)
    score = (flat @ (used * data.law.score(data.regions.x_e, mean)).reshape(n, -1, 1))[..., 0]
    return score, weighted @ np.swapaxes(flat, 1, 2)


def _step(data: SpotData, theta: Array, damping: float = 1.0) -> tuple[Array, Array]:
    """One limited step, and the squared distance in standard deviations that the whole step had."""
    score, fisher = _scores(data, theta)
    step = scoring_step(fisher, score)
    return limited_step(theta, step, damping, free_width=data.pixels.free_width), np.sum(step * score, axis=1)


def scored_unknowns(data: SpotData, theta: Array) -> tuple[Array, BoolArray]:
    """Unknowns, shape (n, k), after scoring from a start until steps are small, and whether they became so.

    Full steps may go round in circles, beside full codes above all: later ones are damped. Only what moves is computed.
    """
    theta, moving = theta.copy(), np.arange(len(theta))
    for damping in DAMPING:
        theta[moving], decrement = _step(data.rows(moving), theta[moving], damping)
        moving = moving[~(decrement < DECREMENT)]
        if moving.size == 0:
            break
    return theta, ~np.isin(np.arange(len(theta)), moving)


# -- result ----------------------------------------------------------------------------------------------------------


def _result(data: SpotData, theta: Array, converged: BoolArray) -> SpotFit:
    n, k = theta.shape
    regions, pixels = data.regions, data.pixels
    h, w = regions.x_e.shape[1:]
    _, fisher = _scores(data, theta)
    covariance = covariance_bound(fisher, keep=3)
    sandwich = _sandwich(data, theta, fisher)
    inside = (np.abs(theta[:, 0] - (w - 1) / 2) <= w / 2) & (np.abs(theta[:, 1] - (h - 1) / 2) <= h / 2)
    used = regions.used.sum(axis=(1, 2))
    status = flag(
        (~(regions.finite & np.isfinite(pixels.background_e).all(axis=(1, 2))), Status.NOT_FINITE),
        (used <= k, Status.SATURATED),
        (~(theta[:, 2] > LEAST_SNR * np.sqrt(covariance[:, 2, 2])), Status.NO_SPOT),
        (~inside, Status.SPOT_CUT),
        (~converged, Status.NOT_CONVERGED),
    )
    mean, _ = pixels.at(theta)
    information = np.maximum(data.law.information(mean), _LEAST_INFORMATION)
    # score^2 / information is a chi^2 of one pixel, whatever its law
    square = regions.used * data.law.score(regions.x_e, mean) ** 2 / information
    chi2 = np.sum(square, axis=(1, 2)) / np.maximum(used - k, 1)
    c = pixels.levels.shape[1]
    background = theta[:, 3 : 3 + c] if c else np.full((n, 1), np.nan)
    sigma = theta[:, -1] if pixels.free_width else np.asarray(pixels.blur.sigma_px)
    values = (theta[:, :2] + regions.origin_px, covariance[:, :2, :2], theta[:, 2], background, sigma, chi2, sandwich)
    uv, uv_covariance, flux, levels, width, misfit, own = (keep(value, status) for value in values)
    return SpotFit(uv, uv_covariance, flux, levels, width, misfit, status, own)


def _sandwich(data: SpotData, theta: Array, fisher: Array) -> Array:
    """Covariance of (u, v) that the misfit of each pixel says by itself, shape (n, 2, 2).

    F^-1 (sum of J_i J_i^T s_i^2 / (1 - h_i)^2) F^-1 with the scores s_i and the leverages h_i = w_i J_i^T F^-1 J_i: H.
    White, Econometrica 48, 817 (1980), in the form HC3 of J. G. MacKinnon and H. White (1985). It holds whatever the
    pixels' variances are. A light that has not the model's shape misfits on the few pixels that place it, and chi^2
    over all pixels would dilute that.
    """
    mean, derivatives = data.pixels.at(theta)
    n, k = theta.shape
    J = derivatives.reshape(n, k, -1)
    used = data.regions.used
    w = (used * data.law.information(mean)).reshape(n, -1)
    s = (used * data.law.score(data.regions.x_e, mean)).reshape(n, -1)
    inverse = covariance_bound(fisher, keep=k)
    own = inverse @ J
    leverage = w * np.einsum("nkp,nkp->np", J, own)
    # residuals that the fit has not pulled to itself (jackknife): over 1 - leverage
    scaled = own[:, :2] * (s / np.maximum(1.0 - leverage, _LEAST_FREEDOM))[:, None]
    return np.asarray(scaled @ np.swapaxes(scaled, 1, 2))


def _nothing(levels: int) -> SpotFit:
    none = np.zeros(0)
    shape = (0, max(levels, 1))
    status, matrices = np.zeros(0, np.int64), np.zeros((0, 2, 2))
    return SpotFit(np.zeros((0, 2)), matrices, none, np.zeros(shape), none, none, status, matrices)
