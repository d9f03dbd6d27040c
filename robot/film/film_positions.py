"""Positions of the spot, fitted in each frame of a film, raw or processed; their noise, and errors that frames share.

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

**Processed frames** go through the camera's chain, one frame at a time. The room behind a frame's spot comes from
frames with the laser off, undone to electrons each, put together with the weights of `room_interpolation`, and
smoothed as `background_of` does it for stills. Where all frames together predict the spot, the interval fit of a JPEG's
coefficients (`processed.interval_fit`) or the quasi-score of other outputs gives the place. Motion blur is part of the
spot's model. Frames at rest are better fitted as a burst.

The likelihood of one faint JPEG has several summits: a fit of its own may settle a pixel away and claim a seventh of
one. The interval fit therefore keeps to the prediction, by a narrow prior. Many frames would each count that, so it is
taken out: the place is one scoring step of the likelihood alone (`IntervalPosterior.likelihood`) from the posterior's
mean. Near the truth the score has mean zero and the Fisher matrix as its covariance, however the likelihood is shaped.
What frames share by the same frames with the laser off, and by the pattern of the spot's own light, is left out: the
rounding of a single JPEG is several times as large.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from phibench.datasets.frames.sensor_card import SensorCard
from phibench.estimator.geometry.status import Status
from phibench.estimator.processed.fit_processed_images import spot_window
from phibench.estimator.processed.interval_fit import interval_posterior
from phibench.estimator.processed.inverse_processing import electrons_before_chroma_loss, unprocessed_electrons
from phibench.estimator.processed.quasi_score import CoefficientWindow, fit_window
from phibench.estimator.spots.camera_codes import mcu_px
from phibench.estimator.spots.fit_raw import LEAST_SNR, fit_law
from phibench.estimator.spots.gaussian_spot import (
    SpotBlur,
    SpotModel,
    SpotPixels,
    covariance_bound,
    fisher_matrix,
    scoring_step,
)
from phibench.estimator.spots.raw_pixels import (
    Background,
    GaussLaw,
    PatternNoise,
    SpotRegions,
    background_of,
    bayer_filters,
    noise_before_rounding,
    noise_of,
    spot_regions,
)
from phibench.robot.film.film_frames import FilmFrames, Index
from phibench.robot.film.room_interpolation import RoomWeights, has_near_off_frame, room_weights
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


def joined_positions(first: FilmPositions, second: FilmPositions) -> FilmPositions:
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
    blur : SpotBlur
        Of one spot, or of each.
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
    known = has_near_off_frame(here, at_px[count:])
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


# -- processed frames --------------------------------------------------------------------------------------------------

_AROUND_PX = 12  # of the spot, and whole units of the JPEG beyond
_LEAST_WEIGHT = 1e-3  # of a frame with the laser off
_PREDICTED_PX = 0.1  # between two bursts a place is known to some hundredths


def processed_positions(frames: FilmFrames, point_world_m: Array, which: Index) -> tuple[FilmPositions, Array]:
    """Positions in some of the frames with the laser on, by their index, and the carriage's offsets, shape (n,).

    Parameters
    ----------
    frames : FilmFrames
        Of processed images.
    point_world_m : array, shape (3,)
        From which the places are predicted, to a tenth of a pixel.
    which : array of int, shape (n,)
    """
    count = len(frames.on)
    places, offsets = frames.positions_px(point_world_m, np.concatenate([frames.on, frames.off]))
    weights, known = (
        room_weights(places[:count], places[count:]).weights,
        has_near_off_frame(places[:count], places[count:]),
    )
    blur = frames.blur(point_world_m, places[:count])
    r, g, b = frames.rig.camera.detector.laser_filter_response
    size = frames.rig.camera.width_px, frames.rig.camera.height_px
    uv, noise = np.full((len(which), 2), np.nan), np.tile(np.eye(2), (len(which), 1, 1))
    for row, k in enumerate(which):
        if not known[k]:
            continue
        corner, part = _units(frames, places[k])
        room = _room(frames, weights[k], corner, part)
        image = frames.on_e[k][None, None, *part]
        window, start, origin = spot_window(
            image, corner[None], places[k], frames.card, blur.rows(np.array([k])), SpotModel((r, g, b)), room, size
        )
        theta, fisher = _of_intervals(window, start) if window.of_intervals else _of_score(window, start)
        covariance = covariance_bound(fisher, keep=3)
        if theta[2] > LEAST_SNR * np.sqrt(covariance[2, 2]):
            uv[row] = theta[:2] + origin
            noise[row] = covariance[:2, :2]
    nothing = np.zeros((len(which), 2, len(which), 2))
    return FilmPositions(uv, noise, nothing), offsets[which]


def _of_intervals(window: CoefficientWindow, start: Array) -> tuple[Array, Array]:
    """Unknowns and Fisher matrix by the likelihood alone; NaN where the posterior is none."""
    posterior = interval_posterior(window, start, _PREDICTED_PX)
    if posterior is None or not posterior.settled:
        return np.full(len(start), np.nan), np.eye(len(start))
    (r,), (J,) = posterior.likelihood()(posterior.theta[None], 0)
    fisher = J @ J.T
    return posterior.theta + scoring_step(fisher[None], (J @ r)[None])[0], fisher


def _of_score(window: CoefficientWindow, start: Array) -> tuple[Array, Array]:
    fit = fit_window(window, start[None])
    return (fit.theta if fit.converged else np.full(len(start), np.nan)), fit.fisher


def _units(frames: FilmFrames, uv_px: Array) -> tuple[NDArray[np.int64], tuple[slice, slice]]:
    """Whole units of the JPEG around a place, and one more on each side: first pixel (u, v), and where they are."""
    down, across = mcu_px(frames.card.jpeg_subsampling)
    unit, sides = np.array([across, down]), np.array(frames.on_e.shape[2:0:-1])
    low = (np.floor((uv_px - _AROUND_PX) / unit).astype(np.int64) - 1) * unit - frames.origin_px
    high = (np.ceil((uv_px + _AROUND_PX) / unit).astype(np.int64) + 1) * unit - frames.origin_px
    low, high = np.clip(low, 0, sides), np.clip(high, 0, sides)
    return low + frames.origin_px, (slice(low[1], high[1]), slice(low[0], high[0]))


def _room(frames: FilmFrames, weights: Array, corner: NDArray[np.int64], part: tuple[slice, slice]) -> Background:
    """Room of one frame, and one frame with the laser off that shows how a JPEG rounds it."""
    used = np.flatnonzero(np.abs(weights) > _LEAST_WEIGHT)
    images, w = frames.off_e[used][:, *part], weights[used] / weights[used].sum()
    x, rounding = unprocessed_electrons(images, np.tile(corner, (len(used), 1)), frames.card)
    mean = electrons_before_chroma_loss(np.tensordot(w, x, 1)[None], corner[None], frames.card)[0]
    noise = noise_before_rounding(frames.card, True).variance_e2(mean)
    variance = w @ w * noise + np.tensordot(w**2, rounding, 1)
    background = background_of(mean[None], variance[None], np.ones((1, *mean.shape)), PatternNoise.of(frames.card))
    return Background(background.mean_e, background.variance_e2, images[np.argmax(w)][None], holds_pattern=True)
