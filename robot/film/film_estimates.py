"""Depth from a film by all frames or both ends, its bound; targets tracked: depth, time to lock, losses, true error.

Each takes what a robot has: raw frames with the laser on and off, their times, encoder readings, the rig that it knows,
and how the carriage was told to go. Only `found_rows` compares with the truth.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import polars

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.film.film_read import Film
from phibench.datasets.frames.sensor_card import card_of
from phibench.datasets.recipe.film_tables import TARGET
from phibench.estimator.spots.raw_pixels import raw_electrons
from phibench.estimator.spots.spot_prediction import spot_blur
from phibench.robot.film.film_bundle import FilmDepth, consensus_frames, deviations2, expected_sigma_m, film_depth
from phibench.robot.film.film_frames import LIT, FilmFrames, Index
from phibench.robot.film.film_positions import FilmPositions, fit_positions, stepped_positions
from phibench.robot.film.room_interpolation import has_near_off_frame, room_weights
from phibench.robot.film.target_tracker import TargetCode, TargetTracker
from phibench.scenes.frames import Array, BoolArray
from phibench.scenes.laser import Beam
from phibench.scenes.motion.carriage import Carriage
from phibench.scenes.validation import SceneError

_ROUNDS = 2  # of the frames' own fits: the second one knows distance and motion
_STEPS, _SETTLED = 8, 0.02  # of the bundle, and standard deviations that it stops at
_REST_M = 1e-9  # rounding of the carriage's place
_AROUND_PX = 24  # of a tracked spot
_BEYOND_CHANCE = 20.0  # chi squared of 2: one fit in 2e4
_LEAST_SNR = 10.0  # of all frames: noise within reach, searched for the place that all agree on, has 6
_AMONG_WORST = 0.5  # of the largest squared deviation: what is farther is left out with it
_LEFT_OUT = 0.5  # of the frames with the code on, at most
_TRACKED_WITHIN_PX = 2  # of the place that a track says
_ONE_PLACE_M = 3e-3  # of the carriage: an image moves by less than half a pixel
_MOST_CHI2 = 2.0  # per degree of freedom: 20 frames of a target at rest exceed it with a chance of 2e-4
_NO_ONE_PLACE_CHI2 = 4.0  # per degree of freedom: vibrations that nobody told of give 2
_CAUSES = "the target moves, or is hidden, or another light is beside it, or the rig is not the one that was told"
_MOVES_M = 1.5e-3  # of the encoder from frame to frame: five of its standard deviations


@dataclass(frozen=True)
class SeenFilm:
    """Measurements of a film.

    Attributes
    ----------
    frames : FilmFrames
        Frames that a user of the camera has.
    positions : FilmPositions
        Of each frame with the laser on, by itself.
    offsets_m : array, shape (N,)
        Carriage when the spot's row was exposed.
    depth : FilmDepth
        From these alone.
    """

    frames: FilmFrames
    positions: FilmPositions
    offsets_m: Array
    depth: FilmDepth


def seen_film(frames: FilmFrames) -> SeenFilm:
    """Fit the spot in each frame by itself; fits that settled elsewhere, or before an unknown room, are none.

    Raises
    ------
    DatasetError
        If the positions give no depth.
    """
    count, places = len(frames.on), _near_px(frames)
    blur = spot_blur(frames.rig, places[:count].mean(axis=0), None, Beam())
    for number in range(_ROUNDS):
        here, off = places[:count], places[count:]
        positions = fit_positions(frames, blur, room_weights(here, off))
        positions.uv_px[~has_near_off_frame(here, off)] = np.nan
        offsets = frames.offsets_m(frames.on, np.where(positions.good, positions.uv_px[:, 1], here[:, 1]))
        positions.uv_px[~consensus_frames(frames.rig, positions, offsets)] = np.nan
        depth = film_depth(frames.rig, positions, offsets, frames.encoder_sigma_m)
        if number + 1 < _ROUNDS:
            places = predicted_px(frames, depth.point_world_m)[0]
            blur = frames.blur(depth.point_world_m, places[:count])
    return SeenFilm(frames, positions, offsets, depth)


def _near_px(frames: FilmFrames) -> Array:
    """Rough places in all frames, laser on first, shape (N + M, 2): those of a point at rest follow the carriage."""
    order = np.argsort(frames.encoder_m[frames.on])
    at = frames.encoder_m[frames.on][order], frames.encoder_m[frames.off]
    return np.vstack([frames.near_px, np.stack([np.interp(at[1], at[0], x) for x in frames.near_px[order].T], axis=1)])


def predicted_px(frames: FilmFrames, point_world_m: Array) -> tuple[Array, Array]:
    """Positions of a point in all frames, laser on first, shape (N + M, 2), and offsets of those with it on, (N,)."""
    uv, offsets = frames.positions_px(point_world_m, np.concatenate([frames.on, frames.off]))
    return uv, offsets[: len(frames.on)]


def bundle_depth(seen: SeenFilm, covariance_rig: Array | None = None) -> FilmDepth:
    """Joint bundle over all frames: Gauss-Newton steps of the likelihood of all pixels, from the frames' own fits.

    Frames that disagree with the others beyond chance are left out: the room behind their spot was not known.

    Raises
    ------
    DatasetError
        If the spot is too faint, more than half of the frames disagree, or what is left is no one place at rest.
    """
    frames, depth, places = seen.frames, seen.depth, None
    for _ in range(_STEPS):
        positions, offsets = joint_positions(frames, depth.point_world_m, places)
        before, depth = depth, _agreed(frames, positions, offsets, covariance_rig)
        if abs(depth.depth_m - before.depth_m) < _SETTLED * depth.sigma_m:
            break
        places = depth.places_px
    _check_light(positions)
    return _of_one_place(depth, _NO_ONE_PLACE_CHI2)


def _agreed(
    frames: FilmFrames, positions: FilmPositions, offsets_m: Array, covariance_rig: Array | None = None
) -> FilmDepth:
    """Depth of the frames that agree: the worst are left out and the others fitted again while any is beyond chance."""
    known, told = positions.good, (frames.encoder_sigma_m, covariance_rig)
    while positions.good.sum() >= (1.0 - _LEFT_OUT) * known.sum():
        depth = film_depth(frames.rig, positions, offsets_m, *told)
        apart2 = np.nan_to_num(deviations2(frames.rig, depth.point_world_m, positions, offsets_m, *told))
        if apart2.max() < _BEYOND_CHANCE:
            return depth
        positions.uv_px[apart2 >= max(_BEYOND_CHANCE, _AMONG_WORST * apart2.max())] = np.nan
    raise _disagreement(int((known & ~positions.good).sum()), int(known.sum()))


def _disagreement(count: int, of: int) -> DatasetError:
    return DatasetError(f"positions in {count} of {of} frames do not agree with those in the others: {_CAUSES}")


def _check_light(positions: FilmPositions) -> None:
    # frames in which the flux came out below 0 have no position, and count
    snr = np.broadcast_to(positions.snr, len(positions.uv_px))
    snr = snr[positions.good | (snr <= 0.0)]
    if not (together := float(snr.sum() / np.sqrt(len(snr)))) > _LEAST_SNR:
        raise DatasetError(
            f"the spot is too faint: its light is {together:.1f} standard deviations in {len(snr)} frames together, "
            f"and {_LEAST_SNR:g} are the least; expose longer, take more frames, or a darker place"
        )


def _of_one_place(found: FilmDepth, most_chi2: float) -> FilmDepth:
    degrees = 2 * found.frames - 3
    if not found.chi2 < most_chi2 * degrees:
        raise DatasetError(
            f"{found.frames} positions do not agree with one place at rest, chi^2 {found.chi2:.0f} with {degrees} "
            f"degrees of freedom: {_CAUSES}"
        )
    return found


def joint_positions(
    frames: FilmFrames, point_world_m: Array, from_px: Array | None = None
) -> tuple[FilmPositions, Array]:
    """Positions one step from where a point predicts them, or from `from_px` (N, 2), and offsets, shape (N,)."""
    uv, offsets = predicted_px(frames, point_world_m)
    return stepped_positions(frames, frames.blur(point_world_m, uv[: len(frames.on)]), uv, from_px), offsets


def burst_depth(seen: SeenFilm, covariance_rig: Array | None = None) -> FilmDepth:
    """Frames at rest at both ends of the stroke alone, all of them, as two bursts."""
    frames = seen.frames
    on, off = (np.flatnonzero(_rests(frames, numbers)) for numbers in (frames.on, frames.off))
    return bundle_depth(
        SeenFilm(frames.some(on, off), seen.positions.some(on), seen.offsets_m[on], seen.depth), covariance_rig
    )


def _rests(frames: FilmFrames, numbers: Index) -> BoolArray:
    """Frames during whose exposure the carriage was told to rest at an end of the stroke."""
    half = 0.5 * (frames.times.exposure_s + frames.times.readout_s)
    # instants of a frame, rows included
    inner = frames.times.frame_s[numbers][:, None] + half * np.linspace(-1.0, 1.0, 9)
    at, stops = frames.carriage.position_m(inner), frames.carriage.stops_m
    return np.any([np.all(np.abs(at - stop) < _REST_M, axis=1) for stop in (min(stops), max(stops))], axis=0)


@dataclass(frozen=True)
class EqualLight:
    """Standard deviations of D at equal light, metres: N frames of the film, and N / 2 at each end."""

    film_m: float
    two_ends_m: float

    @property
    def gain(self) -> float:
        """Variance of two ends over that of the film; below 1 where resting at the ends is better."""
        return (self.two_ends_m / self.film_m) ** 2


def equal_light(seen: SeenFilm, point_world_m: Array, covariance_rig: Array | None = None) -> EqualLight:
    """Bound of a film against two bursts of as many frames, on and off, at the ends of its stroke."""
    frames = seen.frames

    def sigma_m(some: FilmFrames) -> float:
        positions, offsets = joint_positions(some, point_world_m)
        good = np.flatnonzero(positions.good)
        some_good = positions.some(good)
        return expected_sigma_m(some.rig, point_world_m, offsets[good], some_good, some.encoder_sigma_m, covariance_rig)

    ends = frames.some(_two_ends(frames, frames.on), _two_ends(frames, frames.off))
    return EqualLight(sigma_m(frames), sigma_m(ends))


def _two_ends(frames: FilmFrames, numbers: Index) -> Index:
    """As many frames, half of them that of the lowest and half that of the highest offset: their index."""
    told = frames.carriage.position_m(frames.times.frame_s[numbers])
    return np.where(np.arange(len(numbers)) < len(numbers) // 2, np.argmin(told), np.argmax(told))


# Targets.


def track_film(
    film: Film, preset: str = "bayer-raw", draw: int = 0, camera_seed: int = 0, phase_known: bool = True
) -> TargetTracker:
    """Tracker after all frames of a film of a data set; it looks for the target and for lights that are targets, too.

    Raises
    ------
    SceneError
        If the film holds windows only, or a code has no 0.
    """
    scene, info = film.plan.scene, film.info
    if info.window_px is not None:
        raise SceneError(
            f"film {info.film} holds windows around the spot, and a target is looked for in whole images: make it with "
            'view = "full" in [film]'
        )
    codes = [TargetCode(TARGET, scene.code, phase_known)]
    codes += [TargetCode(light.name, light.code, phase_known) for light in scene.lights if light.is_target]
    tracker = TargetTracker(film.plan.nominal.rig, card_of(film.sensor(preset)), scene.times, codes)
    told = film.table["encoder_m"].to_numpy()
    driven = np.abs(np.diff(scene.robot_state(scene.times.frame_s), axis=0, prepend=0.0)).max(axis=1)
    for k in range(len(film)):
        moves = k > 0 and (abs(told[k] - told[k - 1]) > _MOVES_M or driven[k] > 0.0)
        tracker.add(film.frame(k, preset, draw, camera_seed).image, bool(moves))
    return tracker


@dataclass(frozen=True)
class TrackedPositions:
    """Positions of a tracked target that rests, the room taken off by the frames in which its code is off.

    Attributes
    ----------
    positions : FilmPositions
        In N frames with its code on.
    times_s, offsets_m : shape (N,)
        Of the spot's row, and the encoder then: the arguments of `loop.smoothing.film_beliefs`.
    depth : FilmDepth
        From all of them.
    """

    positions: FilmPositions
    times_s: Array
    offsets_m: Array
    depth: FilmDepth


def tracked_positions(
    tracker: TargetTracker, name: str, carriage: Carriage, encoder_m: Array, encoder_sigma_m: float
) -> TrackedPositions:
    """Positions of a target that a tracker has found, while the robot stands and moves its carriage.

    Parameters
    ----------
    tracker : TargetTracker
        After the film's frames.
    name : str
        Of the target.
    carriage : Carriage
        As it was told to go.
    encoder_m : shape (frames,)
        Readings at the frames' times.
    encoder_sigma_m : float
        Standard deviation of the stroke's encoder.

    Raises
    ------
    SceneError
        If the target was never seen, or the pixels are not raw.
    DatasetError
        If its code is on in fewer than two frames or off in none, or the positions give no depth, or do not agree.
    """
    frames = frames_of_one_place(tracked_frames(tracker, name, carriage, encoder_m, encoder_sigma_m))
    depth = _of_one_place(bundle_depth(seen_film(frames)), _MOST_CHI2)
    positions, offsets = joint_positions(frames, depth.point_world_m)
    positions.uv_px[np.isnan(depth.places_px)] = np.nan  # frames that the bundle left out
    rows = predicted_px(frames, depth.point_world_m)[0][: len(frames.on), 1]
    return TrackedPositions(positions, frames.times.row_s(frames.on.astype(float), rows), offsets, depth)


def tracked_frames(
    tracker: TargetTracker, name: str, carriage: Carriage, encoder_m: Array, encoder_sigma_m: float
) -> FilmFrames:
    """Frames of a target that a tracker has found, with its code on and off: arguments as of `tracked_positions`."""
    if tracker.card.output != "raw":
        raise SceneError(f"positions of '{tracker.card.output}' frames have no fit for films; take raw ones")
    used, places = _places(tracker, name, np.asarray(encoder_m, float))
    level = tracker.levels(name, used, places[:, 1])
    lit, dark = np.flatnonzero(level > LIT), np.flatnonzero(level < 1.0 - LIT)
    if len(lit) < 2 or not len(dark):
        raise DatasetError(
            f"target '{name}': its code is on in {len(lit)} frames since it was seen, and off in {len(dark)}; two on "
            "and one off are the least: take more frames, or a code whose bits are longer than an exposure"
        )
    box = tracker.tracker.search.box
    origin, limit = np.array([box.u0_px, box.v0_px]), np.array([box.width_px, box.height_px])
    middle = np.rint(places).astype(np.int64) - origin
    # pairs of rows and columns: the mosaic begins with a whole cell
    low = np.clip((middle.min(axis=0) - _AROUND_PX) // 2 * 2, 0, limit)
    high = np.clip(middle.max(axis=0) + _AROUND_PX, 0, limit)
    x = raw_electrons(tracker.tracker.pixels(used)[:, low[1] : high[1], low[0] : high[0]], tracker.card)
    parts = (used[lit], used[dark], x[lit], x[dark], low + origin, places[lit])
    told = tracker.rig, tracker.card, tracker.times, carriage, encoder_m, encoder_sigma_m
    return FilmFrames(*told, *parts, reach_px=_TRACKED_WITHIN_PX)


def frames_of_one_place(frames: FilmFrames) -> FilmFrames:
    """Frames whose fits, each by itself, agree with one place: the worst is left out while it is beyond chance.

    On edges of the room, or behind something, a fit in one frame may find anything.
    """
    seen = seen_film(frames)
    depth = _agreed(frames, seen.positions, seen.offsets_m)
    if depth.frames < (1.0 - _LEFT_OUT) * len(frames.on):
        raise _disagreement(len(frames.on) - depth.frames, len(frames.on))
    return frames.some(np.flatnonzero(seen.positions.good), np.arange(len(frames.off)))


def _places(tracker: TargetTracker, name: str, encoder_m: Array) -> tuple[Index, Array]:
    """Frames that are kept, from the first in which a target was seen, and its places there, shape (n, 2).

    The place of a target that rests depends on the carriage alone: where it was not seen it is interpolated in that.
    """
    seen, uv = tracker.seen_places(name)
    frames = np.arange(max(int(seen[0]), tracker.tracker.oldest), tracker.frame + 1)
    _, same = np.unique(np.round(encoder_m[seen] / _ONE_PLACE_M), return_inverse=True)
    count = np.bincount(same)
    at, u, v = (np.bincount(same, values) / count for values in (encoder_m[seen], uv[:, 0], uv[:, 1]))
    reached = (encoder_m[frames] > at[0] - _ONE_PLACE_M) & (encoder_m[frames] < at[-1] + _ONE_PLACE_M)
    frames = frames[reached]
    return frames, np.stack([np.interp(encoder_m[frames], at, values) for values in (u, v)], axis=1)


@dataclass(frozen=True)
class FoundRow:
    """Outcome for one target of a film.

    Attributes
    ----------
    target, fault : str
        Name, and the sentence that says why it was not found; empty where it was.
    lock_s : float
        Time from the film's first frame to the end of the frame of the lock.
    uv_px : (u, v)
        Place at the lock.
    error_px : float
        Distance from the true place.
    losses, lights : int
        Times that it was lost; lights that are followed at the end.
    depth_m, sigma_m : float
        D, as of a target that rests before a robot that stands; NaN where the frames do not give it.
    """

    target: str
    fault: str = ""
    lock_s: float = math.nan
    uv_px: tuple[float, float] = (math.nan, math.nan)
    error_px: float = math.nan
    losses: int = 0
    lights: int = 0
    depth_m: float = math.nan
    sigma_m: float = math.nan


def found_rows(film: Film, tracker: TargetTracker) -> list[FoundRow]:
    """Outcome of a film for each of its targets, against the truth."""
    return [_found(film, tracker, name) for name in tracker.names]


def _found(film: Film, tracker: TargetTracker, name: str) -> FoundRow:
    try:
        first = tracker.first_lock(name)
    except SceneError as error:
        return FoundRow(name, str(error))
    table = film.table if name == TARGET else film.lights_table.filter(polars.col("light") == name)
    truth = np.array([table[f"row_light_{x}_px"][first.locked] for x in "uv"])
    place = first.track.uv_px[first.locked - first.track.first]
    losses = sum(hold.lost >= 0 for hold in tracker.holds if hold.target == name)
    lock_s = (first.locked + 1) / tracker.times.rate_hz
    off_px = float(np.linalg.norm(truth - place))
    return FoundRow(name, "", lock_s, place, off_px, losses, tracker.lights, *_depth(film, tracker, name))


def _depth(film: Film, tracker: TargetTracker, name: str) -> tuple[float, float]:
    """D and its standard deviation; NaN where the robot drives, or what was seen is not one place."""
    if film.plan.scene.drive is not None:
        return math.nan, math.nan
    encoder_m, nominal = film.table["encoder_m"].to_numpy(), film.plan.nominal
    try:
        depth = tracked_positions(tracker, name, nominal.carriage, encoder_m, film.plan.encoder.sigma_m).depth
    except (DatasetError, SceneError):
        return math.nan, math.nan
    return depth.depth_m, depth.sigma_m
