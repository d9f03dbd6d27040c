"""Depth from a film of a robot that drives: motion stereo with the readings of its tracks.

Unknowns are the point X in the world's frame of the start, slip and skid of the tracks, with the priors of `Vehicle`,
the random part n of every track's way from frame to frame, in its standard deviations, and the rig's deviations q, in
independent parts. The pose of frame k follows from the readings r by

    pose_k = pose_{k-1} after the arc of (r_k - r_{k-1} - sigma_k n_k) with slip and skid.

Data are the positions of the spot with the covariance of all frames, and the priors. All is one least-squares problem,
solved by Gauss-Newton steps. Its covariance holds the robot's own way, so that D is known from where the robot stands
now, as from where it started. Heading errors and the bearing of X are not told apart at rest: X and the way are.

Positions come from the frames as for a film of a robot that stands (`film_positions`). Frames in which the spot's image
is farther than 1.5 px from all with the laser off are left out: there the room behind the spot is not known.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.film.film_read import Film
from phibench.estimator.geometry.reflection import image_of, room_rays
from phibench.estimator.geometry.rig_parameters import PARAMETERS, STROKE_PARAMETERS
from phibench.estimator.spots.spot_prediction import spot_blur
from phibench.robot.film.film_frames import FilmFrames, Index, film_frames
from phibench.robot.film.film_positions import FilmPositions, fit_positions, stepped_positions
from phibench.robot.film.room_interpolation import LENGTH_PX, RoomWeights
from phibench.scenes.frames import Array
from phibench.scenes.laser import Beam
from phibench.scenes.misalignment import PARAMETERS as MISALIGNMENT
from phibench.scenes.motion.drive import placement
from phibench.scenes.motion.vehicle import PlanarPose, Vehicle
from phibench.scenes.rig import Rig

_STARTS_M = tuple(np.geomspace(0.6, 12.0, 9))  # of D: each within a factor of 1.2 of a possible one
_STEPS, _SETTLED = 30, 1e-3  # of the least squares, and standard deviations of X that it stops at
_ROUNDS, _SAME = 6, 0.02  # of positions, and standard deviations of D that they stop at
_LEAST_WAY_M = 1e-2  # below it odometry's own noise is the way
_POINT, _SLIP, _SKID, _OWN = slice(0, 3), 3, 4, 5  # entries of the unknowns; then n, left and right, and q
_SMALL = 1e-4  # of slip and skid, for differences


@dataclass(frozen=True)
class RobotWay:
    """Way of a robot as it is told, at N times.

    Attributes
    ----------
    tracks_m : array, shape (N, 2)
        Readings of both tracks since the start.
    flippers_rad : array, shape (N,)
        As the flippers were told to turn.
    """

    vehicle: Vehicle
    tracks_m: Array
    flippers_rad: Array

    @property
    def sigma_m(self) -> Array:
        """Standard deviations of the random parts of the steps, shape (N, 2)."""
        steps = np.abs(np.diff(self.tracks_m, axis=0, prepend=np.zeros((1, 2))))
        return np.asarray(self.vehicle.track_noise * np.sqrt(steps))

    def poses(self, slip: float, skid: float, noise: Array) -> tuple[Array, Array]:
        """Poses (x, y, heading), shape (N, 3), and their derivatives by slip, skid and noise (N, 2): (N, 3, 2 + 2 N).

        The way of a track is its reading less `sigma_m` times the noise.
        """
        sigma = self.sigma_m
        steps = np.diff(self.tracks_m, axis=0, prepend=np.zeros((1, 2))) - sigma * noise
        poses, slopes = self._reckoned(steps, slip, skid), np.zeros((len(steps), 3, 2 + steps.size))
        for column, (a, b) in enumerate(((_SMALL, 0.0), (0.0, _SMALL))):
            after, before = (self._reckoned(steps, slip + sign * a, skid + sign * b) for sign in (1.0, -1.0))
            slopes[:, :, column] = (after - before) / (2.0 * _SMALL)
        kept, turning = 1.0 - slip, skid * self.vehicle.gauge_m
        H = kept * np.array([[0.5, 0.5], [-1.0 / turning, 1.0 / turning]])
        before = np.array([-self.vehicle.sensor_x_m, 0.0, 0.0])
        for k, (left, right) in enumerate(steps):
            c, s = np.cos(before[2]), np.sin(before[2])
            turned = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
            F = np.eye(3)
            F[:2, 2] = before[1] - poses[k, 1], poses[k, 0] - before[0]
            own = slice(2 + 2 * k, 4 + 2 * k)
            if k:
                slopes[k, :, 2:] = F @ slopes[k - 1, :, 2:]
            slopes[k, :, own] = -turned @ self.vehicle.arc(left, right, slip, skid).jacobian() @ H * sigma[k]
            before = poses[k]
        return poses, slopes

    def _reckoned(self, steps: Array, slip: float, skid: float) -> Array:
        pose, poses = PlanarPose(-self.vehicle.sensor_x_m), []
        for left, right in steps:
            pose = pose.after(self.vehicle.arc(float(left), float(right), slip, skid))
            poses.append((pose.x_m, pose.y_m, pose.heading_rad))
        return np.array(poses)


@dataclass(frozen=True)
class DrivingDepth:
    """Point and depths from a film of a robot that drives.

    Attributes
    ----------
    point_world_m : array, shape (3,)
        In the frame in which the robot started.
    covariance_m2 : array, shape (3, 3)
    depth_m, sigma_m : arrays, shape (N,)
        D from where the robot stands in each frame, and its standard deviation.
    chi2 : float
        Of positions and priors together, with 2 n - 3 degrees of freedom of n frames with a position.
    uv_px : array, shape (N, 2)
        Fitted places.
    """

    point_world_m: Array
    covariance_m2: Array
    depth_m: Array
    sigma_m: Array
    slip: float
    skid: float
    chi2: float
    uv_px: Array


def driving_depth(
    rig: Rig, way: RobotWay, positions: FilmPositions, covariance_rig: Array | None = None
) -> DrivingDepth:
    """Fit the point of a film of a robot that drives with the carriage down.

    Parameters
    ----------
    rig : Rig
        Nominal, or calibrated.
    way : RobotWay
        At the times at which the spot's rows were exposed, N in all.
    positions : FilmPositions
        In these N frames; those without one count for the way alone.
    covariance_rig : array, shape (p, p), optional
        Of `rig_parameters.PARAMETERS`.

    Raises
    ------
    DatasetError
        If fewer than two frames have a position, or the robot does not move by a centimetre between them.
    """
    keep = np.flatnonzero(positions.good)
    moved = float(np.abs(np.ptp(way.tracks_m[keep], axis=0)).max()) if len(keep) else 0.0
    if len(keep) < 2 or moved < _LEAST_WAY_M:
        raise DatasetError(
            f"film of {len(keep)} positions over {moved:.4f} m of the tracks: two positions that are {_LEAST_WAY_M:g} "
            "m apart are the least that give a depth; drive farther, or make a stroke"
        )
    problem = _Problem(rig, way, keep, positions.some(keep), _independent(covariance_rig))
    starts = [problem.solved(x, 6) for x in problem.starts()]  # six steps tell which start leads on
    finite = [one for one in starts if np.isfinite(one[1])]
    if not finite:
        raise DatasetError("no point before the robot explains the film's positions: they are no spot's")
    x, _ = problem.solved(min(finite, key=lambda one: one[1])[0], _STEPS)
    return problem.result(x)


def _independent(covariance: Array | None) -> Array:
    """Matrix L of a covariance L L^T, columns that are not 0, shape (p, r)."""
    if covariance is None:
        return np.zeros((len(PARAMETERS), 0))
    values, vectors = np.linalg.eigh(covariance)
    # parameters that are held have no variance
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0)))[:, values > 1e-12 * values.max()])


@dataclass(frozen=True)
class _Problem:
    rig: Rig
    way: RobotWay
    keep: Index
    positions: FilmPositions
    parts: Array

    @property
    def size(self) -> int:
        return _OWN + self.way.tracks_m.size + self.parts.shape[1]

    def starts(self) -> list[Array]:
        """Unknowns with the point at some distances along the first position's ray."""
        ray = room_rays(self.rig.at(0.0), self.positions.uv_px[:1])
        poses, _ = self.way.poses(*self._nominal, np.zeros(self.way.tracks_m.shape))
        R, t = placement(self.way.vehicle, self._states(poses[self.keep[:1]], self.keep[:1]))
        result = []
        for far in _STARTS_M:
            x = np.zeros(self.size)
            x[_POINT] = R[0] @ (ray.origin_world_m[0] + far * ray.direction_world[0]) + t[0]
            x[[_SLIP, _SKID]] = self._nominal
            result.append(x)
        return result

    def solved(self, x: Array, steps: int) -> tuple[Array, float]:
        """Unknowns after some steps, and chi2 there; NaN where no pixel shows the point."""
        for _ in range(steps):
            r, J = self.residuals(x)
            if not np.isfinite(r).all() or not np.isfinite(J).all():
                return x, float("nan")
            step = -np.linalg.lstsq(J, r, rcond=None)[0]
            far = float(np.linalg.norm(x[_POINT]))
            # half of the distance at most
            x = x + step * min(1.0, 0.5 * far / max(float(np.linalg.norm(step[_POINT])), 1e-12))
            covariance = np.linalg.inv(J.T @ J)[_POINT, _POINT]
            if step[_POINT] @ np.linalg.solve(covariance, step[_POINT]) < _SETTLED**2:
                break
        r, _ = self.residuals(x)
        return x, float(r @ r)

    def residuals(self, x: Array) -> tuple[Array, Array]:
        """Whitened residuals of positions and priors, shape (2 n + m,), and derivatives by the m unknowns."""
        uv, slopes, _, _ = self.model(x, self.keep)
        L = np.linalg.cholesky(self.positions.covariance_px2())
        both = np.column_stack([(uv - self.positions.uv_px).ravel(), slopes])
        white = solve_triangular(L, both, lower=True, check_finite=False)
        vehicle = self.way.vehicle
        prior, scale = np.zeros(self.size), np.ones(self.size)
        prior[[_SLIP, _SKID]] = self._nominal
        scale[[_SLIP, _SKID]] = vehicle.slip_sigma, vehicle.skid_sigma
        own = np.diag(1.0 / scale)[_SLIP:]
        return np.concatenate([white[:, 0], ((x - prior) / scale)[_SLIP:]]), np.vstack([white[:, 1:], own])

    def model(self, x: Array, frames: Index) -> tuple[Array, Array, Array, Array]:
        """Places (n, 2) in some frames, derivatives (2 n, m), poses (n, 3) and their derivatives (n, 3, m)."""
        count = self.way.tracks_m.size
        noise = x[_OWN : _OWN + count].reshape(-1, 2)
        poses, by_way = self.way.poses(float(x[_SLIP]), float(x[_SKID]), noise)
        by_unknown = np.zeros((len(poses), 3, self.size))
        by_unknown[:, :, _SLIP : _OWN + count] = by_way
        poses, by_unknown = poses[frames], by_unknown[frames]
        uv, by_point, by_pose = self._images(self.rig, x[_POINT], poses, frames)
        slopes = np.einsum("nij,njm->nim", by_pose, by_unknown)
        slopes[:, :, _POINT] = by_point
        by_rig = self._by_rig(x[_POINT], poses, frames) @ self.parts
        slopes[:, :, _OWN + count :] = by_rig
        # deviations of the rig count to first order
        return uv + by_rig @ x[_OWN + count :], slopes.reshape(-1, self.size), poses, by_unknown

    def _images(self, rig: Rig, X: Array, poses: Array, frames: Index) -> tuple[Array, Array, Array]:
        """Places, derivatives by the point (n, 2, 3), and by the pose (n, 2, 3)."""
        R, t = placement(self.way.vehicle, self._states(poses, frames))
        apart = X - t
        at = image_of(rig.at(0.0), np.einsum("nji,nj->ni", R, apart))
        by_point = np.einsum("nij,nkj->nik", at.px_per_m, R)
        from_base = X - np.column_stack([poses[:, :2], np.zeros(len(poses))])
        # by the heading the point turns backwards about the base: -(e_z x p)
        turn = np.column_stack([from_base[:, 1], -from_base[:, 0], np.zeros(len(poses))])
        by_pose = np.concatenate([-by_point[:, :, :2], (by_point @ turn[:, :, None])], axis=2)
        return at.uv_px, by_point, by_pose

    def _by_rig(self, X: Array, poses: Array, frames: Index) -> Array:
        """Derivatives of the places by `PARAMETERS`, shape (n, 2, p); without a stroke two of them move nothing."""
        columns = np.zeros((len(poses), 2, len(PARAMETERS)))
        for number, name in enumerate(PARAMETERS if self.parts.size else ()):
            if name not in STROKE_PARAMETERS:
                parameter = MISALIGNMENT[name]
                rigs = [parameter.apply(self.rig, sign * parameter.step) for sign in (1.0, -1.0)]
                after, before = (self._images(rig, X, poses, frames)[0] for rig in rigs)
                columns[:, :, number] = (after - before) / (2.0 * parameter.step)
        return columns

    def result(self, x: Array) -> DrivingDepth:
        r, J = self.residuals(x)
        frames = np.arange(len(self.way.tracks_m))
        uv, _, poses, by_unknown = self.model(x, frames)
        covariance = np.asarray(np.linalg.inv(J.T @ J), float)
        centre = np.array(self.rig.at(0.0).sphere_centre_m)
        R, t = placement(self.way.vehicle, self._states(poses, frames))
        apart = x[_POINT] - (R @ centre + t)
        D = np.hypot(apart[:, 0], apart[:, 1])
        g = apart[:, :2] / D[:, None]
        arm = R @ centre + t - np.column_stack([poses[:, :2], np.zeros(len(poses))])
        slopes = -g[:, :1] * by_unknown[:, 0] - g[:, 1:] * by_unknown[:, 1]
        # the heading turns the sphere's centre about the base
        slopes += (g[:, 0] * arm[:, 1] - g[:, 1] * arm[:, 0])[:, None] * by_unknown[:, 2]
        slopes[:, 0:2] += g
        sigma = np.sqrt(np.einsum("nm,ml,nl->n", slopes, covariance, slopes))
        slip, skid = float(x[_SLIP]), float(x[_SKID])
        return DrivingDepth(x[_POINT], covariance[_POINT, _POINT], D, sigma, slip, skid, float(r @ r), uv)

    def _states(self, poses: Array, index: Index) -> Array:
        return np.column_stack([poses, self.way.flippers_rad[index]])

    @property
    def _nominal(self) -> tuple[float, float]:
        return self.way.vehicle.slip, self.way.vehicle.skid


# From frames.


def driving_film_depth(
    film: Film, draw: int = 0, camera_seed: int = 0, *, rig: Rig | None = None, covariance_rig: Array | None = None
) -> DrivingDepth:
    """Depth from raw frames of a film of a robot that drives, every other one with the laser off.

    Parameters
    ----------
    rig : Rig, optional
        Calibrated; the nominal one by default.
    covariance_rig : array, shape (p, p), optional
        Of a calibrated one.

    Raises
    ------
    DatasetError
        If the robot stands, or makes a stroke as well, or the frames give no depth.
    """
    drive = film.plan.scene.drive
    if drive is None or len(set(film.plan.nominal.carriage.stops_m)) > 1:
        what = "the robot stands" if drive is None else "the carriage moves, too"
        raise DatasetError(
            f"film {film.info.film}: {what}, and motion stereo takes the way of the robot alone; give a film with "
            "[[film.drive]] and stops = [0.0], or take the estimators of a stroke"
        )
    frames = film_frames(film, draw, camera_seed, rig=rig, driving=True)
    numbers, read = np.sort(np.concatenate([frames.on, frames.off])), np.array(film.table["tracks_m"].to_list())
    on, off = (np.searchsorted(numbers, some) for some in (frames.on, frames.off))
    middle = frames.near_px.mean(axis=0)
    positions = fit_positions(frames, spot_blur(frames.rig, middle, None, Beam()), _in_time(frames))
    places, before_m = np.broadcast_to(middle, (len(numbers), 2)), np.inf
    for _ in range(_ROUNDS):
        times = frames.times.row_s(numbers.astype(float), places[:, 1])
        # tracks are read with every frame, and run evenly from one to the next
        tracks = np.stack([np.interp(times, frames.times.frame_s, column) for column in read.T], axis=1)
        way = RobotWay(drive.vehicle, tracks, drive.state(times)[:, 3])
        depth = driving_depth(frames.rig, way, _spread(positions, on, len(numbers)), covariance_rig)
        if abs(depth.depth_m[0] - before_m) < _SAME * depth.sigma_m[0]:
            break
        places, before_m = depth.uv_px, float(depth.depth_m[0])
        speeds = np.gradient(places, times, axis=0)
        blur = frames.moving_blur(depth.depth_m[on], places[on], speeds[on])
        positions = stepped_positions(frames, blur, np.vstack([places[on], places[off]]))
        # between frames with the laser off that are farther apart, edges of the room are interpolated wrongly
        nearest = np.linalg.norm(places[on][:, None] - places[off], axis=2).min(axis=1)
        positions.uv_px[nearest > LENGTH_PX] = np.nan
    return depth


def _in_time(frames: FilmFrames) -> RoomWeights:
    """Straight lines in time between frames with the laser off."""
    each = np.eye(len(frames.off))
    weights = np.stack([np.interp(frames.on, frames.off, row) for row in each], axis=1)
    return RoomWeights(weights, np.zeros(len(weights)))


def _spread(positions: FilmPositions, on: Index, count: int) -> FilmPositions:
    """Positions of the frames `on` among `count` frames; the others have none."""
    uv, noise, shared = np.full((count, 2), np.nan), np.zeros((count, 2, 2)), np.zeros((count, 2, count, 2))
    uv[on], noise[on] = positions.uv_px, positions.noise_px2
    both = np.arange(2)
    shared[np.ix_(on, both, on, both)] = positions.shared_px2
    return FilmPositions(uv, noise, shared)
