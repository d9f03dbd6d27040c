"""Positions of the spot in processed frames of a moving film: through the camera's chain, one frame at a time.

The room behind a frame's spot comes from frames with the laser off, undone to electrons each, put together with the
weights of `film_frames.room_weights`, and smoothed as `background_of` does it for stills. Where all frames together
predict the spot, the interval fit of a JPEG's coefficients (`processed.interval_fit`) or the quasi-score of other
outputs gives the place. Motion blur is part of the spot's model. Frames at rest are better fitted as a burst.

The likelihood of one faint JPEG has several summits: a fit of its own may settle a pixel away and claim a seventh of
one. The interval fit therefore keeps to the prediction, by a narrow prior. Many frames would each count that, so it is
taken out: the place is one scoring step of the likelihood alone (`IntervalPosterior.likelihood`) from the posterior's
mean. Near the truth the score has mean zero and the Fisher matrix as its covariance, however the likelihood is shaped.

What frames share by the same frames with the laser off, and by the pattern of the spot's own light, is left out: the
rounding of a single JPEG is several times as large.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from phibench.estimator.processed.chroma_loss import regained
from phibench.estimator.processed.fit_chain import spot_window, undone, unrounded
from phibench.estimator.processed.interval_fit import interval_posterior
from phibench.estimator.processed.quasi_score import CoefficientWindow, fit_window
from phibench.estimator.spots.fisher import covariance_bound, scoring_step
from phibench.estimator.spots.fit_raw import LEAST_SNR
from phibench.estimator.spots.gaussian_spot import SpotModel
from phibench.estimator.spots.jpeg_coefficients import mcu_px
from phibench.estimator.spots.raw_pixels import Background, PatternNoise, background_of
from phibench.robot.film.film_frames import FilmFrames, Index, room_known, room_weights
from phibench.robot.film.film_positions import FilmPositions
from phibench.scenes.frames import Array

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
    weights, known = room_weights(places[:count], places[count:]).weights, room_known(places[:count], places[count:])
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
    x, rounding = undone(images, np.tile(corner, (len(used), 1)), frames.card)
    mean = regained(np.tensordot(w, x, 1)[None], corner[None], frames.card)[0]
    noise = unrounded(frames.card, True).variance_e2(mean)
    variance = w @ w * noise + np.tensordot(w**2, rounding, 1)
    background = background_of(mean[None], variance[None], np.ones((1, *mean.shape)), PatternNoise.of(frames.card))
    return Background(background.mean_e, background.variance_e2, images[np.argmax(w)][None], holds_pattern=True)
