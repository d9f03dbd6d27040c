"""Positions of the spot in the frames of a film, with their noise, and with what frames share.

What is left of a frame when the room is taken off (`film_frames`) is fitted around the spot: place and flux. A fit
errs by A (x - mu), with A = F^-1 d / V the influence of every pixel. Of frames k and l, whose spots share pixels p, the
errors have these covariances, w the weights of frames with the laser off:

    noise     new in every frame: A_kp^2 V_kp
    room      sum_p A_kp A_lp V_p (sum_j w_kj w_lj): the same frames with the laser off were taken off both
    motion    (sum_p A_kp g_p)^2 m_k^2, new in every frame: g the slope of the room, and m_k how far its image may have
              moved beyond what is interpolated; the pixels of an edge err together
    pattern   sum_p A_kp A_lp prnu^2 s_kp s_lp, s the spot's light alone

DSNU and the pattern of the room's light are taken off with the room. A spot that rests gains nothing against the rest
of the pattern from more frames; one that moves over pixels does.

A faint spot behind a mosaic has several minima in one frame. `stepped_positions` takes one scoring step from places
that all frames together predict: repeated with the bundle, these are Gauss-Newton steps of the joint likelihood.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from phibench.datasets.frames.sensor_card import SensorCard
from phibench.estimator.geometry.status import Status
from phibench.estimator.spots.fisher import fisher_matrix
from phibench.estimator.spots.fit_raw import fit_law
from phibench.estimator.spots.gaussian_spot import SpotBlur, SpotModel, SpotPixels
from phibench.estimator.spots.raw_pixels import (
    GaussLaw,
    PatternNoise,
    SpotRegions,
    bayer_filters,
    noise_of,
    spot_regions,
)
from phibench.robot.film.film_frames import FilmFrames, RoomWeights, room_known, room_weights
from phibench.scenes.frames import Array, BoolArray

SIDE_PX = 11  # a spot of 0.9 px that moves by 2 px, and its tails


@dataclass(frozen=True)
class FilmPositions:
    """Positions in N frames, of which `good` have one.

    Attributes
    ----------
    uv_px : array, shape (N, 2)
        NaN where there is none.
    noise_px2 : array, shape (N, 2, 2)
        Covariance of what is new in every frame.
    shared_px2 : array, shape (N, 2, N, 2)
        Covariance of what frames share: pattern, and room.
    snr : array, shape (N,)
        Flux over its standard deviation; infinite where nothing was measured in pixels.
    """

    uv_px: Array
    noise_px2: Array = field(repr=False)
    shared_px2: Array = field(repr=False)
    snr: Array = field(default_factory=lambda: np.array(np.inf), repr=False)

    @property
    def good(self) -> BoolArray:
        """Frames with a position, shape (N,)."""
        return np.asarray(np.isfinite(self.uv_px).all(axis=1))

    def some(self, index: NDArray[np.int64]) -> FilmPositions:
        """Positions of some frames."""
        shared, snr = self.shared_px2[index][:, :, index], np.broadcast_to(self.snr, len(self.uv_px))
        return FilmPositions(self.uv_px[index], self.noise_px2[index], shared, snr[index])

    def covariance_px2(self) -> Array:
        """Covariance of all positions, shape (2 N, 2 N), frame by frame (u, v)."""
        count = len(self.uv_px)
        total = self.shared_px2.copy()
        each = np.arange(count)
        total[each, :, each, :] += self.noise_px2
        return total.reshape(2 * count, 2 * count)


def joined(first: FilmPositions, second: FilmPositions) -> FilmPositions:
    """Positions of both, which share nothing."""
    a, b = len(first.uv_px), len(second.uv_px)
    shared = np.zeros((a + b, 2, a + b, 2))
    shared[:a, :, :a], shared[a:, :, a:] = first.shared_px2, second.shared_px2
    uv, noise = np.concatenate([first.uv_px, second.uv_px]), np.concatenate([first.noise_px2, second.noise_px2])
    return FilmPositions(uv, noise, shared)


@dataclass(frozen=True)
class _Windows:
    """Squares of N frames, room taken off, with the law of their pixels.

    weights (N, M) are those of the room; moved_e (N, 2, h, w) is the room's change as its image moves along u and v by
    the standard deviation of what the interpolation misses.
    """

    regions: SpotRegions
    law: GaussLaw
    room_e: Array
    moved_e: Array
    weights: Array
    prnu: float


def fit_positions(frames: FilmFrames, blur: SpotBlur, room: RoomWeights) -> FilmPositions:
    """Fit each frame by itself, where the light that blinks stands out most within reach of `frames.near_px`.

    Parameters
    ----------
    frames : FilmFrames
    blur : SpotBlur
        Of one spot, or of each.
    room : RoomWeights
    """
    windows = _windows(frames, _most_outstanding(frames, room) + frames.origin_px, room)
    model = _model(frames, windows)
    fit = fit_law(windows.regions, windows.law, blur, model)
    # a fit that wanders off has found something else
    astray = np.abs(fit.uv_px - frames.near_px).max(axis=1) > frames.reach_px + 1.0
    good = (fit.status == Status.OK) & ~astray
    pixels = SpotPixels.of(windows.regions.filters, blur, model)
    theta = np.column_stack([fit.uv_px - windows.regions.origin_px, fit.flux_e])
    uv = np.where(good[:, None], fit.uv_px, np.nan)
    return _covariances(uv, np.where(good[:, None], theta, 1.0), pixels, windows)


def stepped_positions(frames: FilmFrames, blur: SpotBlur, at_px: Array, from_px: Array | None = None) -> FilmPositions:
    """Positions after one scoring step from predicted ones, flux fitted there; frames without light have none.

    Parameters
    ----------
    at_px : array, shape (N + M, 2)
        Predicted positions in the frames with the laser on, then in those with it off. Others as for `fit_positions`.
    from_px : array, shape (N, 2), optional
        Places to step from, where they are finite: a rig that is not exact predicts none that are near enough.
    """
    count = len(frames.on)
    here, room = at_px[:count], room_weights(at_px[:count], at_px[count:])
    known = room_known(here, at_px[count:])
    here = here if from_px is None else np.where(np.isfinite(from_px), from_px, here)
    windows = _windows(frames, np.rint(here).astype(np.int64), room)
    pixels = SpotPixels.of(windows.regions.filters, blur, _model(frames, windows))
    x, used = windows.regions.x_e, windows.regions.used
    theta = np.column_stack([here - windows.regions.origin_px, _fluxes(pixels, windows, here)])
    mean, derivatives = pixels.at(theta)
    weight = used * windows.law.information(mean)
    score = np.einsum("nkhw,nhw->nk", derivatives, weight * (x - mean))
    step = np.einsum("nkl,nl->nk", np.linalg.pinv(fisher_matrix(derivatives, weight), hermitian=True), score)
    good = np.isfinite(step).all(axis=1) & (theta[:, 2] > 0.0) & known
    uv = np.where(good[:, None], here + step[:, :2], np.nan)
    return _covariances(uv, theta, pixels, windows)


def _fluxes(pixels: SpotPixels, windows: _Windows, here: Array) -> Array:
    """Fluxes that fit best at given places, shape (N,): two rounds of weighted least squares."""
    x, used, origin = windows.regions.x_e, windows.regions.used, windows.regions.origin_px
    shape = pixels.at(np.column_stack([here - origin, np.ones(len(x))]))[0]
    flux = np.maximum(np.sum(used * x * shape, axis=(1, 2)) / np.sum(used * shape**2, axis=(1, 2)), 1.0)
    for _ in range(2):
        weight = used * windows.law.information(flux[:, None, None] * shape)
        flux = np.sum(weight * x * shape, axis=(1, 2)) / np.sum(weight * shape**2, axis=(1, 2))
    return np.asarray(flux)


def _model(frames: FilmFrames, windows: _Windows) -> SpotModel:
    red, green, blue = frames.rig.camera.detector.laser_filter_response
    nothing = np.zeros(windows.regions.x_e.shape)
    return SpotModel((red, green, blue) if frames.card.mosaic == "bayer" else None, nothing)


def _windows(frames: FilmFrames, middle_px: NDArray[np.int64], interpolation: RoomWeights) -> _Windows:
    """Squares around these pixels, moved inside the region."""
    card: SensorCard = frames.card
    limit = np.array(frames.on_e.shape[:0:-1]) - SIDE_PX
    corners = np.clip(middle_px - frames.origin_px - SIDE_PX // 2, 0, limit)
    on, room, moved = [], [], []
    for image, w, px, (u, v) in zip(frames.on_e, interpolation.weights, interpolation.moved_px, corners, strict=True):
        on.append(image[v : v + SIDE_PX, u : u + SIDE_PX])
        around = np.tensordot(w, frames.off_e[:, max(v - 2, 0) : v + SIDE_PX + 2, max(u - 2, 0) : u + SIDE_PX + 2], 1)
        inner = slice(min(v, 2), min(v, 2) + SIDE_PX), slice(min(u, 2), min(u, 2) + SIDE_PX)
        room.append(around[inner])
        moved.append(px * np.stack([_slope(around, axis)[inner] for axis in (1, 0)]))
    noise, pattern = noise_of(card, pattern_known=True), PatternNoise.of(card)
    seen, moved_e = np.maximum(room, 0.0), np.stack(moved)
    interpolated = np.sum(interpolation.weights**2, axis=1)[:, None, None]
    extra = seen + noise.variance_e2(seen) * interpolated + np.sum(moved_e**2, axis=1)
    regions = spot_regions(np.stack(on) - np.stack(room), corners + frames.origin_px, np.stack(on) < card.full_from_e)
    law = GaussLaw(noise, extra, 1, pattern.prnu)
    return _Windows(regions, law, seen, moved_e, interpolation.weights, pattern.prnu)


def _slope(image: Array, axis: int) -> Array:
    """Change per pixel, between the pixels of one filter on both sides; beyond the edge the image stays as it is."""
    padded = np.pad(image, [(2, 2) if k == axis else (0, 0) for k in (0, 1)], mode="edge")
    count = image.shape[axis]
    high, low = (padded.take(np.arange(count) + start, axis=axis) for start in (4, 0))
    return np.asarray(0.25 * (high - low))  # central difference over four pixels of the mosaic: the same filter


def _most_outstanding(frames: FilmFrames, interpolation: RoomWeights) -> NDArray[np.int64]:
    """Place (u, v) near a given one in each image, shape (N, 2), where light of the laser's colour is surest.

    Score of a spot of 1 pixel rms: sum k r x / V over the root of sum (k r)^2 / V, with its shape k, the answer r of
    each filter, and the variance V of what is left when the room is taken off.
    """
    near_px, (count, h, w) = frames.near_px - frames.origin_px, frames.on_e.shape
    answer = np.ones((h, w))
    if frames.card.mosaic == "bayer":
        filters = bayer_filters([frames.origin_px], (h, w))[0]
        answer = np.array(frames.rig.camera.detector.laser_filter_response)[filters]
    noise, best = noise_of(frames.card, pattern_known=True), np.zeros((count, 2), np.int64)
    v, u = np.mgrid[:h, :w]
    for k, (image, weights, px) in enumerate(
        zip(frames.on_e, interpolation.weights, interpolation.moved_px, strict=True)
    ):
        room = np.tensordot(weights, frames.off_e, 1)
        seen, moved = np.maximum(room, 0.0), [px * _slope(room, axis) for axis in (0, 1)]
        variance = noise.variance_e2(seen) * (1.0 + weights @ weights) + moved[0] ** 2 + moved[1] ** 2
        clear = image < frames.card.full_from_e
        above = gaussian_filter(clear * answer * (image - room) / variance, 1.0)
        # the square of a Gaussian is one of half the variance
        score = above / np.sqrt(gaussian_filter(clear * answer**2 / variance, np.sqrt(0.5)) + 1e-12)
        far = np.maximum(np.abs(u - near_px[k, 0]), np.abs(v - near_px[k, 1])) > frames.reach_px
        best[k] = np.unravel_index(np.argmax(np.where(far, -np.inf, score)), (h, w))[::-1]
    return best


def _covariances(uv_px: Array, theta: Array, pixels: SpotPixels, windows: _Windows) -> FilmPositions:
    mean, derivatives = pixels.at(theta)
    law, origins = windows.law, windows.regions.origin_px
    weight = windows.regions.used * law.information(mean)
    inverse = np.linalg.pinv(fisher_matrix(derivatives, weight), hermitian=True)
    influence = np.einsum("nik,nkhw->nihw", inverse[:, :2], derivatives * weight[:, None])
    room = np.sqrt(law.noise.variance_e2(windows.room_e))[:, None]
    new = np.einsum("nihw,nhw,njhw->nij", influence, law.noise.variance_e2(mean) + windows.room_e, influence)
    by_motion = np.einsum("nihw,njhw->nij", influence, windows.moved_e)
    new += by_motion @ by_motion.transpose(0, 2, 1)
    common = _common(influence * room, origins) * (windows.weights @ windows.weights.T)[:, None, :, None]
    shared = common + windows.prnu**2 * _common(influence * mean[:, None], origins)
    # signal to noise
    return FilmPositions(uv_px, new, shared, theta[:, 2] / np.sqrt(np.maximum(inverse[:, 2, 2], 1e-12)))


def _common(values: Array, origins: NDArray[np.int64]) -> Array:
    """Sum over common pixels of the products of values (N, 2, h, w) of every two frames, shape (N, 2, N, 2)."""
    count, _, h, w = values.shape
    low = origins.min(axis=0)
    width, height = origins.max(axis=0) - low + (w, h)
    images = np.zeros((count, 2, int(height), int(width)))
    for image, part, (u, v) in zip(images, values, origins - low, strict=True):
        image[:, v : v + h, u : u + w] = part
    flat = images.reshape(2 * count, -1)
    return np.asarray((flat @ flat.T).reshape(count, 2, count, 2))
