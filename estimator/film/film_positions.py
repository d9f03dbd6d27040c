"""Positions of the spot in the frames of a film, with noise, and with the pattern that frames share.

Raw pixels around the spot are fitted frame by frame (`spots.fit_raw`). A fit errs by A (x - mu), with A = F^-1 d / V
the influence of every pixel. Noise is new in every frame. PRNU and DSNU are the same in all, so that the errors of
frames k and l, whose spots share pixels p, have the covariance

    sum_p A_kp A_lp (prnu^2 mu_kp mu_lp + dsnu^2).

A spot that rests gains nothing against the pattern from more frames; one that moves over pixels does.

A faint spot behind a mosaic has several minima in one frame. `stepped_positions` takes one scoring step from places
that all frames together predict: repeated with the bundle, these are Gauss-Newton steps of the joint likelihood.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phibench.datasets.frames.sensor_card import SensorCard
from phibench.estimator.geometry.status import Status
from phibench.estimator.spots.fisher import fisher_matrix
from phibench.estimator.spots.fit_raw import SpotFit, fit_law
from phibench.estimator.spots.gaussian_spot import SpotBlur, SpotModel, SpotPixels
from phibench.estimator.spots.raw_pixels import GaussLaw, PatternNoise, noise_of, raw_electrons, spot_regions
from phibench.scenes.frames import Array, BoolArray
from phibench.scenes.rig import Rig

SIDE_PX = 9  # a level per filter describes the room over so few pixels only
_SEARCH_PX = 12  # around the middle of a window


@dataclass(frozen=True)
class FilmPositions:
    """Positions in N frames, of which `good` have one.

    Attributes
    ----------
    uv_px : array, shape (N, 2)
        NaN where there is none.
    noise_px2 : array, shape (N, 2, 2)
        Covariance of what is new in every frame.
    pattern_px2 : array, shape (N, 2, N, 2)
        Covariance of what the fixed pattern does, between all frames.
    """

    uv_px: Array
    noise_px2: Array
    pattern_px2: Array

    @property
    def good(self) -> BoolArray:
        """Frames with a position, shape (N,)."""
        return np.asarray(np.isfinite(self.uv_px).all(axis=1))

    def some(self, index: NDArray[np.int64]) -> FilmPositions:
        """Positions of some frames."""
        return FilmPositions(self.uv_px[index], self.noise_px2[index], self.pattern_px2[index][:, :, index])

    def covariance_px2(self) -> Array:
        """Covariance of all positions, shape (2 N, 2 N), frame by frame (u, v)."""
        count = len(self.uv_px)
        total = self.pattern_px2.copy()
        each = np.arange(count)
        total[each, :, each, :] += self.noise_px2
        return total.reshape(2 * count, 2 * count)


def fit_positions(
    windows_dn: NDArray[Any], origins_px: ArrayLike, card: SensorCard, rig: Rig, blur: SpotBlur, frames: int = 1
) -> FilmPositions:
    """Fit the spot in windows of raw pixels.

    Parameters
    ----------
    windows_dn : array, shape (N, h, w)
        The spot lies within 12 px of their middle.
    origins_px : shape (N, 2)
        Image pixel (u, v) of each window's first column and row.
    card, rig
        Of the sensor; nominal rig, for the filters' response.
    blur : SpotBlur
    frames : int
        That each window is the mean of.
    """
    x, origins = raw_electrons(windows_dn, card), np.asarray(origins_px, np.int64)
    x, origins = _narrowed(x, origins)
    noise, pattern = noise_of(card, pattern_known=True), PatternNoise.of(card)
    law = GaussLaw(noise, pattern.dsnu_e2, frames, pattern.prnu)
    red, green, blue = rig.camera.detector.laser_filter_response
    model = SpotModel((red, green, blue) if card.mosaic == "bayer" else None)
    regions = spot_regions(x, origins, x < card.full_from_e)
    fit = fit_law(regions, law, blur, model)
    pixels = SpotPixels.of(regions.filters, blur, model)
    return _with_pattern(fit, pixels, regions.used, origins, law, pattern)


def stepped_positions(
    windows_dn: NDArray[Any], origins_px: ArrayLike, card: SensorCard, rig: Rig, blur: SpotBlur, at_px: Array
) -> FilmPositions:
    """Positions after one scoring step from predicted ones, flux and levels fitted there; all frames have one.

    Parameters
    ----------
    at_px : array, shape (N, 2)
        Predicted positions. Others as for `fit_positions`.
    """
    x, origins = raw_electrons(windows_dn, card), np.asarray(origins_px, np.int64)
    shape = np.array(x.shape[:0:-1])
    corner = np.clip(np.rint(at_px).astype(np.int64) - origins - SIDE_PX // 2, 0, shape - SIDE_PX)
    x = np.stack([part[v : v + SIDE_PX, u : u + SIDE_PX] for part, (u, v) in zip(x, corner, strict=True)])
    origins = origins + corner
    noise, pattern = noise_of(card, pattern_known=True), PatternNoise.of(card)
    law = GaussLaw(noise, pattern.dsnu_e2, 1, pattern.prnu)
    red, green, blue = rig.camera.detector.laser_filter_response
    model = SpotModel((red, green, blue) if card.mosaic == "bayer" else None)
    regions = spot_regions(x, origins, x < card.full_from_e)
    pixels = SpotPixels.of(regions.filters, blur, model)
    theta = _linear_unknowns(pixels, regions.x_e, regions.used, law, at_px - origins)
    mean, derivatives = pixels.at(theta)
    weight = regions.used * law.information(mean)
    score = np.einsum("nkhw,nhw->nk", derivatives, weight * (regions.x_e - mean))
    step = np.einsum("nkl,nl->nk", np.linalg.pinv(fisher_matrix(derivatives, weight), hermitian=True), score)
    good = np.isfinite(step).all(axis=1) & (theta[:, 2] > 0.0)
    uv = np.where(good[:, None], at_px + step[:, :2], np.nan)
    return _covariances(uv, theta, pixels, regions.used, origins, law, pattern)


def _linear_unknowns(pixels: SpotPixels, x: Array, used: BoolArray, law: GaussLaw, place_px: Array) -> Array:
    """Flux and levels that fit best at given places, shape (N, unknowns): two rounds of weighted least squares."""
    theta = np.column_stack([place_px, np.ones((len(x), pixels.unknowns - 2))])
    basis = pixels.at(theta)[1][:, 2:]  # linear in flux and levels
    mean = np.broadcast_to(np.maximum(x.mean(axis=(1, 2), keepdims=True), 1.0), x.shape)
    for _ in range(2):
        weight = used * law.information(mean)
        right = np.einsum("nkhw,nhw->nk", basis, weight * x)
        theta[:, 2:] = np.einsum("nkl,nl->nk", np.linalg.pinv(fisher_matrix(basis, weight), hermitian=True), right)
        mean = np.maximum(np.einsum("nk,nkhw->nhw", theta[:, 2:], basis), 1.0)
    return theta


def _narrowed(x: Array, origins: NDArray[np.int64]) -> tuple[Array, NDArray[np.int64]]:
    """Small regions around the brightest place that is as wide as a spot, near the middle of each window."""
    count, h, w = x.shape
    level = np.median(x[:, ::2, ::2].reshape(count, -1), axis=1)[:, None, None]
    rows, columns = (_middle(n) for n in (h, w))
    # a mosaic shows the spot in one pixel of four: what counts is the sum over 3 x 3
    padded = np.pad(x - level, ((0, 0), (1, 1), (1, 1)), mode="edge")
    total = sum(padded[:, a : a + h, b : b + w] for a in range(3) for b in range(3))
    near = np.asarray(total)[:, rows, columns].reshape(count, -1)
    v, u = np.unravel_index(near.argmax(axis=1), (rows.stop - rows.start, columns.stop - columns.start))
    best = np.stack([u, v], axis=1)
    corner = best + (columns.start, rows.start) - SIDE_PX // 2
    corner = np.clip(corner, 0, (w - SIDE_PX, h - SIDE_PX))
    cut = [part[v : v + SIDE_PX, u : u + SIDE_PX] for part, (u, v) in zip(x, corner, strict=True)]
    return np.stack(cut), origins + corner


def _middle(length: int) -> slice:
    half = min(_SEARCH_PX, length // 2)
    return slice(length // 2 - half, length // 2 + half)


def _with_pattern(
    fit: SpotFit,
    pixels: SpotPixels,
    used: BoolArray,
    origins: NDArray[np.int64],
    law: GaussLaw,
    pattern: PatternNoise,
) -> FilmPositions:
    good = fit.status == Status.OK
    theta = np.column_stack([fit.uv_px - origins, fit.flux_e, fit.background_e])
    theta = np.where(good[:, None], theta, 1.0)
    uv = np.where(good[:, None], fit.uv_px, np.nan)
    return _covariances(uv, theta, pixels, used, origins, law, pattern)


def _covariances(
    uv_px: Array,
    theta: Array,
    pixels: SpotPixels,
    used: BoolArray,
    origins: NDArray[np.int64],
    law: GaussLaw,
    pattern: PatternNoise,
) -> FilmPositions:
    mean, derivatives = pixels.at(theta)
    weight = used * law.information(mean)
    inverse = np.linalg.pinv(fisher_matrix(derivatives, weight), hermitian=True)[:, :2]
    influence = np.einsum("nik,nkhw->nihw", inverse, derivatives * weight[:, None])
    own = law.noise.variance_e2(mean) / law.frames
    new = np.einsum("nihw,nhw,njhw->nij", influence, own, influence)
    shared = _shared(influence * mean[:, None], origins, pattern.prnu**2) + _shared(influence, origins, pattern.dsnu_e2)
    return FilmPositions(uv_px, new, shared)


def _shared(weights: Array, origins: NDArray[np.int64], variance: float) -> Array:
    """Sum over common pixels of the weights (N, 2, h, w) of every two frames, shape (N, 2, N, 2), times a variance."""
    count, _, h, w = weights.shape
    low = origins.min(axis=0)
    width, height = origins.max(axis=0) - low + (w, h)
    images = np.zeros((count, 2, int(height), int(width)))
    for image, part, (u, v) in zip(images, weights, origins - low, strict=True):
        image[:, v : v + h, u : u + w] = part
    flat = images.reshape(2 * count, -1)
    return variance * (flat @ flat.T).reshape(count, 2, count, 2)
