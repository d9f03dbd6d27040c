"""Belief over a target with a rig not known exactly, both fitted to all frames (`SmoothedBelief`); beliefs of a film.

A filter that takes frame after frame commits itself to the straight line on which it took each: directions in a rig as
built by hand bend by a tenth of their shift, many times the noise, and all frames share that bend. `SmoothedBelief`
keeps the frames and solves for target and rig anew with each, every ray being that of the rig as it is then believed.

Unknowns are the state of `Belief`: target, slip and skid, velocity, and theta of `RigBias`. With p_i the target's place
in the robot at frame i, by the arcs of the tracks back from now, and o_i, d_i the ray of its pixel in the deviated rig,

    r_i = (azimuth, rise)(p_i - h_i e - o_i) - (azimuth, rise)(d_i)

should be 0. Residuals are e_i = J_i^-1 r_i in pixels, J_i = dr_i / d(pixel). In angles, whose scale J_i depends on the
rig, a fit would prefer rigs that make the same noise a smaller angle: by half a standard deviation in 40 frames.
The covariance of e_i has the pixel's noise in each frame, and what frames share (`frame_history`).
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np
from scipy.linalg import solve_triangular

from phibench.estimator.geometry.reflection import reflect
from phibench.estimator.geometry.rig_parameters import changed_rig, stroke_of
from phibench.robot.film.film_positions import FilmPositions
from phibench.robot.loop.belief import ANY_TARGET, LEAST_Q, SKID, SLIP, VELOCITY, Belief, TargetBelief, TargetPrior
from phibench.robot.loop.frame_history import Course, FrameHistory, TrackSteps, shared_by_motion, shared_px2
from phibench.robot.loop.rig_bias import RigBias
from phibench.robot.loop.sensing import (
    Direction,
    angle_slopes,
    angles,
    direction_with,
    wrapped_angle,
    wrapped_differences,
)
from phibench.scenes.frames import Array
from phibench.scenes.motion.vehicle import Stance, Vehicle
from phibench.scenes.rig import Rig, View
from phibench.scenes.validation import SceneError

_STEP = 0.1  # of a standard deviation: differences by theta err by 1 % of the slope
_STALE = 0.2  # of one: slopes by theta are taken anew beyond
_ROUNDS, _HALVINGS, _AT_REST = 6, 8, 0.1  # of standard deviations
_PIXEL_STEP_PX = 1e-3  # of differences by pixels: smooth over it, and far above rounding
_MOST_FRAMES = 160  # kept: older ones are thinned, which loses what they say and adds nothing


class _DeviatedView(NamedTuple):
    """A rig with a deviation, mirror down; its stroke axis, and the values it deviates by."""

    view: View
    axis: Array
    values: Array

    def rays(self, uv_px: Array, stroke_m: Array) -> tuple[Array, Array, Array]:
        """Origins and directions of rays, shapes (..., N, 3), and how far the mirror was raised, shape (N, 3)."""
        ray = reflect(self.view, uv_px)
        raised = stroke_of(stroke_m, self.values)[:, None] * self.axis
        return ray.origin_world_m, ray.direction_world, raised

    def rays_beside(self, uv_px: Array, stroke_m: Array) -> Array:
        """Origin, direction and rise for each pixel as it is and a step aside in u and v, shape (3, 3, N, 3)."""
        origin, direction, raised = self.rays(uv_px + _PIXEL_STEP_PX * np.eye(3, 2, k=-1)[:, None], stroke_m)
        return np.stack([origin, direction, np.broadcast_to(raised, origin.shape)])


@dataclass(frozen=True)
class _Rows:
    """Residuals, shape (r,), their slopes by the state (r, n) and covariance (r, r).

    `F` has their slopes by the target's place, shape (N, 2, 3), `per_px` those of the angles by the pixel, (N, 2, 2).
    """

    r: Array
    J: Array
    C: Array
    F: Array
    per_px: Array


class SmoothedBelief(Belief):
    """Belief over one target of a rig that is known to a covariance.

    Parameters
    ----------
    rig, vehicle, first, stroke_m, prior
        As for `belief.TargetBelief`.
    bias : RigBias
        Of the rig's deviations.
    """

    def __init__(
        self,
        rig: Rig,
        vehicle: Vehicle,
        first: Direction,
        stroke_m: float,
        bias: RigBias,
        prior: TargetPrior = ANY_TARGET,
    ) -> None:
        super().__init__(rig, vehicle, prior)
        self._bias, of_target = bias, 8 if prior.moves else 5
        n = of_target + bias.count
        self._deviations = slice(of_target, n)
        self._way = TrackSteps(vehicle)
        x, q = np.zeros(n), prior.q
        x[:5] = first.azimuth_rad, first.rise + stroke_m * q, q, vehicle.slip, vehicle.skid
        self._prior, self._precision = x.copy(), np.zeros(n)
        # a vehicle may be exact: 1e-12 keeps its weight finite
        self._precision[[SLIP, SKID]] = 1.0 / (np.array([vehicle.slip_sigma, vehicle.skid_sigma]) ** 2 + 1e-12)
        self._precision[self._deviations] = 1.0  # the rig's deviations are counted in their standard deviations
        self._P = np.zeros((n, n))
        self._latest: tuple[tuple[Direction, float, Stance | None, float, int], FrameHistory] | None = None
        self._x, self._middle = x, x[self._deviations]
        self._views = self._around()
        self._frames = self._frame(first, stroke_m, None)
        self._solve()

    @property
    def mean(self) -> Array:
        """State."""
        return self._x

    @property
    def covariance(self) -> Array:
        """Of the state, by the slopes at the mean."""
        return self._P

    def pixel(self, stroke_m: float, held: Stance | None = None) -> tuple[float, float] | None:
        """Pixel at which the mean is seen; None where the mirror does not show it."""
        place = self._bias.pixel(self._standing(self._x, held), stroke_m, self._x[self._deviations])
        return None if math.isnan(place[0]) else place

    def predict(self, left_m: float, right_m: float, step_s: float) -> None:
        """Take in a step of the tracks, and the time that it took."""
        x, about = self._x, float(self._x[0])
        F = np.eye(len(x))
        for k in range(self._deviations.start):
            e = np.zeros(len(x))
            e[k] = 1e-6
            ends = (self._moved(x + s * e, left_m, right_m, step_s, about) for s in (1.0, -1.0))
            F[:, k] = np.subtract(*ends) / 2e-6
        Q = self._process_noise(x, left_m, right_m, step_s)
        self._x, self._P = self._moved(x, left_m, right_m, step_s, about), F @ self._P @ F.T + Q
        self._way = self._way.after(left_m, right_m, step_s)

    def update(self, seen: Direction, stroke_m: float, held: Stance | None = None) -> None:
        """Take in a direction, after `predict`; one that the rig as believed cannot see says nothing."""
        frame = self._frame(seen, stroke_m, held)
        if not np.isfinite(self._residuals(self._x, frame)).all():
            return
        self._frames = self._frames.joined(frame)
        if len(self._frames.time_s) > _MOST_FRAMES:
            self._frames = self._frames.thinned()
        self._solve()

    def imagine(self, stroke_m: float, covariance: Array) -> None:
        """Take in a direction where it is expected."""
        place = self.pixel(stroke_m)
        if place is None:
            return
        nothing = Direction(0.0, 0.0, covariance, np.array(place), np.zeros((2, 2)))
        rows = self._rows(self._x, self._frame(nothing, stroke_m, None))
        J = rows.per_px[0] @ rows.J
        K = self._P @ J.T @ np.linalg.inv(J @ self._P @ J.T + covariance)
        self._P = self._P - K @ J @ self._P
        self._P = 0.5 * (self._P + self._P.T)

    def copied(self) -> Self:
        """Copy that changes on its own: no array is changed in place."""
        return copy.copy(self)

    def distance2(self, seen: Direction, stroke_m: float, held: Stance | None = None) -> float:
        """Squared Mahalanobis distance of a direction from what is expected, to first order."""
        rows = self._rows(self._x, self._frame(seen, stroke_m, held))
        return float(rows.r @ np.linalg.solve(rows.J @ self._P @ rows.J.T + rows.C, rows.r))

    # -- solution --------------------------------------------------------------------------------------------------

    def _solve(self) -> None:
        """Most probable state by Gauss-Newton, and the covariance by its slopes (Laplace's approximation)."""
        for _ in range(_ROUNDS):
            if np.any(np.abs(self._x[self._deviations] - self._middle) > _STALE):
                self._middle = self._x[self._deviations].copy()
                self._views, self._latest = self._around(), None
                rays = self._view_rays(self._frames.uv_px, self._frames.stroke_m)
                self._frames = replace(self._frames, rays=rays)
            rows = self._with_priors(self._x, self._rows(self._x, self._frames))
            factor = np.asarray(np.linalg.cholesky(rows.C), float)
            r, J = (solve_triangular(factor, matrix, lower=True) for matrix in (rows.r, rows.J))
            hessian = J.T @ J + np.diag(self._precision)
            step = -np.linalg.solve(hessian, J.T @ r + self._precision * (self._x - self._prior))
            P = np.linalg.inv(hessian)
            self._P = 0.5 * (P + P.T)
            size = float(np.max(np.abs(step) / np.sqrt(np.diag(P))))
            if not self._stepped(step, factor, r) or size < _AT_REST:
                break
        self._x = np.concatenate([[wrapped_angle(float(self._x[0]))], self._x[1:]])

    def _stepped(self, step: Array, factor: Array, r: Array) -> bool:
        """Take a step, or the part of it that makes chi squared smaller with the covariance as it is."""
        before = self._chi2(r, self._x)
        for k in range(_HALVINGS):
            x = self._x + 0.5**k * step
            try:
                residuals = self._first_rows(x, self._residuals(x, self._frames).reshape(-1))
            except SceneError:  # a rig that cannot exist
                continue
            if np.isfinite(residuals).all() and x[2] > LEAST_Q:
                after = self._chi2(solve_triangular(factor, residuals, lower=True), x)
                if after <= before + 1e-6:  # rounding of chi^2 is no rise
                    self._x = x
                    return True
        return False

    def _chi2(self, whitened: Array, x: Array) -> float:
        return float(whitened @ whitened + self._precision @ (x - self._prior) ** 2)

    def _first_rows(self, x: Array, r: Array) -> Array:
        """Residuals of frames, and those of what was believed at the first frame: q, and the velocity."""
        return np.concatenate([r, self._first(x)])

    def _first(self, x: Array) -> Array:
        p, V = self._places(x, self._frames)
        return np.concatenate([[1.0 / math.hypot(*p[0, :2]) - self.prior.q], V if self.prior.moves else []])

    def _with_priors(self, x: Array, rows: _Rows) -> _Rows:
        """Rows, and those of what was believed at the first frame."""
        n, more = len(rows.r), 4 if self.prior.moves else 1
        J, C = np.zeros((n + more, len(x))), np.zeros((n + more, n + more))
        J[:n], C[:n, :n] = rows.J, rows.C
        J[n:, : self._deviations.start] = self._slopes(x, self._first)
        C[n, n] = self.prior.q_sigma**2
        if self.prior.moves:
            lag, a = self._way.time_s - self._frames.time_s, self.prior.acceleration_m2_per_s3
            C[n + 1 :, n + 1 :] = (self.prior.speed_m_per_s**2 + a * lag[0]) * np.eye(3)
            C[:n, n + 1 :] = (-0.5 * a * lag[:, None, None] ** 2 * rows.F).reshape(n, 3)
            C[n + 1 :, :n] = C[:n, n + 1 :].T
        return _Rows(self._first_rows(x, rows.r), J, C, rows.F, rows.per_px)

    def _slopes(self, x: Array, function: Callable[[Array], Array]) -> Array:
        """Derivatives of a function by the target's part of the state, shape (..., 5 or 8)."""
        columns = []
        for k in range(self._deviations.start):
            e = np.zeros(len(x))
            e[k] = 1e-6
            columns.append((function(x + e) - function(x - e)) / 2e-6)
        return np.stack(columns, axis=-1)

    # -- model -----------------------------------------------------------------------------------------------------

    def _frame(self, seen: Direction, stroke_m: float, held: Stance | None) -> FrameHistory:
        """One frame, now; that of the latest direction again, as `update` follows `distance2`."""
        when = seen, stroke_m, held, self._way.time_s, self._way.steps
        if self._latest is not None and self._latest[0][0] is seen and self._latest[0][1:] == when[1:]:
            return self._latest[1]
        R, t = self._tilt(held)
        frame = FrameHistory(
            seen.uv_px[None],
            seen.covariance_px2[None],
            np.array([stroke_m]),
            R[None],
            t[None],
            np.array([self._way.steps]),
            np.array([self._way.time_s]),
            self._view_rays(seen.uv_px[None], np.array([stroke_m])),
            np.array([seen.shared_px]),
            np.array([seen.stroke_sigma_m]),
        )
        self._latest = when, frame
        return frame

    def _view_rays(self, uv_px: Array, stroke_m: Array) -> Array:
        """Rays of pixels by the middle rig and those beside it, shape (N, m + 1, 3, 3, 3)."""
        return np.stack([np.moveaxis(view.rays_beside(uv_px, stroke_m), 2, 0) for view in self._views], axis=1)

    def _around(self) -> list[_DeviatedView]:
        """Rig of the middle deviation, and those a step away from it along each of its numbers."""
        return [self._rig(self._middle + _STEP * e) for e in np.eye(len(self._middle) + 1, len(self._middle), k=-1)]

    def _rig(self, theta: Array) -> _DeviatedView:
        values = self._bias.deviations @ theta
        rig = changed_rig(self.rig, values)
        return _DeviatedView(rig.at(0.0), np.array(rig.stroke_axis_world), values)

    def _residuals(self, x: Array, frames: FrameHistory) -> Array:
        """Pixels by those of the target, shape (N, 2)."""
        rays = self._rig(x[self._deviations]).rays_beside(frames.uv_px, frames.stroke_m)
        return _pixel_residual(self._places(x, frames)[0], rays)[0]

    def _rows(self, x: Array, frames: FrameHistory) -> _Rows:
        """Residuals of frames, their slopes and covariance."""
        n, m = len(frames.time_s), self._deviations.start
        rays = self._rig(x[self._deviations]).rays_beside(frames.uv_px, frames.stroke_m)
        p = self._places(x, frames)[0]
        e, per_px = _pixel_residual(p, rays)
        to_px = np.linalg.inv(per_px)
        origin, direction, raised = rays[:, 0]
        slopes = self._slopes(x, lambda y: _residual(self._places(y, frames)[0], origin, direction, raised))
        J = np.zeros((2 * n, len(x)))
        J[:, :m] = (to_px @ slopes).reshape(2 * n, m)
        base, *moved = (_pixel_residual(p, np.moveaxis(one, 0, 2))[0] for one in np.moveaxis(frames.rays, 1, 0))
        for k, one in enumerate(moved):
            # a pixel at the mirror's rim may be none in the next rig: it then says nothing of this deviation
            J[:, m + k] = np.nan_to_num(one - base).reshape(-1) / _STEP
        C, F = self._covariance(x, frames, to_px @ angle_slopes(p - origin - raised))
        C += np.kron(shared_px2(frames, self._way.driven_m[frames.steps]), np.eye(2))
        return _Rows(e.reshape(-1), J, C, F, per_px)

    def _course(self, y: Array) -> Course:
        """Course of the robot by the state's slip and skid."""
        return self._way.course(y[SLIP], y[SKID])

    def _places(self, y: Array, frames: FrameHistory) -> tuple[Array, Array]:
        """Places of the target in the rig's frame as the robot stood at each frame, shape (N, 3), and its velocity."""
        course, velocity = self._course(y), np.zeros(3)
        if self.prior.moves:
            velocity = course.last_yaw @ y[VELOCITY] / max(float(y[2]), LEAST_Q)
        return course.seen_from(frames, course.fixed(self.point_m(y)), velocity, self._way.time_s), velocity

    def _covariance(self, x: Array, frames: FrameHistory, E: Array) -> tuple[Array, Array]:
        """Covariance of residuals, shape (2 N, 2 N): pixels, readings of the stroke, steps and motion; and F."""
        n, course = len(frames.time_s), self._course(x)
        C = np.zeros((n, 2, n, 2))
        by_reading = E @ np.array(self.rig.stroke_axis_world) * frames.stroke_sigma_m[:, None]  # px
        own = frames.covariance_px2 + by_reading[:, :, None] * by_reading[:, None, :]
        C[np.arange(n), :, np.arange(n), :] = own
        F = course.slopes(frames, E)
        if self._way.steps:
            C += self._way.shared_by_steps(course, course.fixed(self.point_m(x)), frames, F)
        if self.prior.moves:
            C += shared_by_motion(self.prior.acceleration_m2_per_s3, self._way.time_s - frames.time_s, F)
        return C.reshape(2 * n, 2 * n), F


def _residual(p: Array, origin: Array, direction: Array, raised: Array) -> Array:
    """Azimuth and rise of points by those of rays, shape (N, 2)."""
    return wrapped_differences(angles(p - origin - raised) - angles(direction))


def _pixel_residual(p: Array, rays: Array) -> tuple[Array, Array]:
    """Residuals of pixels, shape (N, 2), and slopes of the angles by the pixel, (N, 2, 2), for `rays_beside`."""
    r, *aside = (_residual(p, *rays[:, k]) for k in range(3))
    per_px = np.stack([wrapped_differences(one - r) for one in aside], axis=-1) / _PIXEL_STEP_PX
    return np.asarray(np.linalg.solve(per_px, r[..., None])[..., 0], float), per_px


# -- choice -----------------------------------------------------------------------------------------------------------


def belief_of(
    rig: Rig, vehicle: Vehicle, first: Direction, stroke_m: float, bias: RigBias, prior: TargetPrior = ANY_TARGET
) -> Belief:
    """Belief for what is known: smoothed where the rig has deviations or frames share errors, filtered elsewhere."""
    if bias.count or any(first.shared_px):
        return SmoothedBelief(rig, vehicle, first, stroke_m, bias, prior)
    return TargetBelief(rig, vehicle, first, stroke_m, prior)


def film_beliefs(
    rig: Rig,
    vehicle: Vehicle,
    positions: FilmPositions,
    times_s: Array,
    strokes_m: Array,
    prior: TargetPrior = ANY_TARGET,
    encoder_sigma_m: float = 0.0,
    rig_covariance: Array | None = None,
) -> Iterator[tuple[int, Belief]]:
    """Belief after each frame of a film of a robot that stands: its number, and the belief, which goes on changing.

    Parameters
    ----------
    positions : FilmPositions
        In N frames, those of `film.film_estimates.seen_film`, which takes the room off by frames with the laser off,
        or of `film.spot_tracks.fitted_positions`; frames without one are left out.
    times_s, strokes_m : shape (N,)
        Time at which the spot's row was exposed, and the encoder's reading then.
    encoder_sigma_m : float
        Standard deviation of a reading: the rise is k - h q, and errs by as much as q times that.
    rig_covariance : shape (p, p), or None
        Of the true rig's deviations from `rig`, that of a calibration (`Calibration.covariance`); None is an exact rig.
    """
    belief: Belief | None = None
    before, bias = 0.0, RigBias(rig, rig_covariance)
    # what frames share, as if new in every frame: the sum over all frames is no less than it, by Gershgorin's theorem
    shared = np.abs(positions.shared_px2[:, :, positions.good]).sum(axis=(2, 3))
    for k in np.flatnonzero(positions.good):
        noise = positions.noise_px2[k] + np.diag(shared[k])
        seen = direction_with(rig, float(positions.uv_px[k, 0]), float(positions.uv_px[k, 1]), noise)
        if seen is None:
            continue
        q = prior.q if belief is None else float(belief.mean[2])
        noisy = seen.covariance + np.diag([0.0, (q * encoder_sigma_m) ** 2])
        seen = replace(seen, covariance=noisy, stroke_sigma_m=encoder_sigma_m)
        if belief is None:
            belief = belief_of(rig, vehicle, seen, float(strokes_m[k]), bias, prior)
        else:
            belief.predict(0.0, 0.0, float(times_s[k]) - before)
            belief.update(seen, float(strokes_m[k]))
        before = float(times_s[k])
        yield int(k), belief
