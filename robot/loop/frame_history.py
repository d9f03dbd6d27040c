"""Frames that a smoothed belief keeps, the robot's way between them, and the errors that frames share.

Places are those in the robot's frame at the first frame. p_i is the target's place by the robot at frame i, and
F_i = de_i / dp_i the slope of the residuals e_i of `smoothing`. Random parts w_j of the steps since a frame move its
p_i, so that cov(e_i, e_k) has

    F_i (sum over j > max(i, k) of D_j Q_j D_j^T) F_k^T,        D_j = dp / dw_j.

A target whose velocity walks with the density a adds F_i F_k^T a s^2 (3 t - s) / 6, s <= t being the two frames' lags
before now (integrated Wiener process). Pixels share the camera's fixed pattern and the wall's texture.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from phibench.scenes.frames import Array
from phibench.scenes.motion.vehicle import Vehicle, arc_covariance

# lengths over which what frames share falls to 1 / e: apart in the image, and driven
_PATTERN_REACH_PX, _TEXTURE_REACH_M = 1.0, 0.5


@dataclass(frozen=True)
class FrameHistory:
    """N frames in order.

    Attributes
    ----------
    uv_px, covariance_px2 : shapes (N, 2), (N, 2, 2)
    stroke_m : shape (N,)
        Nominal.
    turned, origin_m : shapes (N, 3, 3), (N, 3)
        Attitude: rotation and origin of the rig's frame in that frame made level.
    steps, time_s : shape (N,)
        Steps of the tracks and time before the frame.
    rays : shape (N, m + 1, 3, 3, 3)
        Origin, direction and rise of the mirror, by the middle rig and those beside it, of the pixel and two beside it.
    shared_px : shape (N, 2)
        Standard deviations of what frames share: fixed pattern, texture.
    stroke_sigma_m : shape (N,)
        Of the readings of the stroke.
    """

    uv_px: Array
    covariance_px2: Array
    stroke_m: Array
    turned: Array
    origin_m: Array
    steps: Array
    time_s: Array
    rays: Array
    shared_px: Array
    stroke_sigma_m: Array

    def joined(self, other: FrameHistory) -> FrameHistory:
        """Both, this one's first."""
        return FrameHistory(*(np.concatenate([getattr(self, n), getattr(other, n)]) for n in self.__dataclass_fields__))

    def thinned(self) -> FrameHistory:
        """Every other frame of the older half, and all of the newer."""
        n = len(self.time_s)
        keep = np.concatenate([np.arange(0, n // 2, 2), np.arange(n // 2, n)])
        return FrameHistory(*(getattr(self, name)[keep] for name in self.__dataclass_fields__))


@dataclass(frozen=True)
class Course:
    """Places of the robot after each of S steps: shapes (S + 1,), (S + 1, 2); its sensor lies ahead of the base."""

    heading_rad: Array
    place_m: Array
    sensor_m: Array

    @property
    def last_yaw(self) -> Array:
        """Rotation of the robot now, shape (3, 3)."""
        return _yaw(self.heading_rad[-1])

    def fixed(self, point_m: Array) -> Array:
        """Place of a point that is given in the sensor's level frame of now, shape (3,)."""
        P = self.last_yaw @ (point_m + self.sensor_m)
        P[:2] += self.place_m[-1]
        return np.asarray(P)

    def seen_from(self, frames: FrameHistory, point_m: Array, velocity_m_per_s: Array, time_s: float) -> Array:
        """Places, in the rig's frame at each frame, of what is at a point at a time; shape (N, 3)."""
        points = point_m - (time_s - frames.time_s)[:, None] * velocity_m_per_s
        points[:, :2] -= self.place_m[frames.steps]
        level = np.einsum("nji,nj->ni", _yaw(self.heading_rad[frames.steps]), points) - self.sensor_m
        return np.einsum("nji,nj->ni", frames.turned, level - frames.origin_m)

    def slopes(self, frames: FrameHistory, E: Array) -> Array:
        """F of the frames, by the target's place, from slopes by the place in the rig's frame; shape (N, 2, 3)."""
        yaw = _yaw(self.heading_rad[frames.steps])
        return np.asarray(E @ np.swapaxes(frames.turned, 1, 2) @ np.swapaxes(yaw, 1, 2))


def _yaw(heading_rad: Array) -> Array:
    """Rotations about the vertical, shape (..., 3, 3)."""
    R = np.zeros((*np.shape(heading_rad), 3, 3))
    R[..., 0, 0] = R[..., 1, 1] = np.cos(heading_rad)
    R[..., 1, 0] = np.sin(heading_rad)
    R[..., 0, 1], R[..., 2, 2] = -R[..., 1, 0], 1.0
    return R


@dataclass(frozen=True)
class TrackSteps:
    """Steps of the tracks since the first frame.

    Attributes
    ----------
    tracks_m : shape (S, 2)
        As the encoders count them.
    noise : shape (S, 2, 2)
        Covariance of each step's length and turn.
    time_s : float
        Since the first frame.
    """

    vehicle: Vehicle
    tracks_m: Array = field(default_factory=lambda: np.zeros((0, 2)))
    noise: Array = field(default_factory=lambda: np.zeros((0, 2, 2)))
    time_s: float = 0.0

    @property
    def steps(self) -> int:
        """Number of steps that moved a track."""
        return len(self.tracks_m)

    @property
    def driven_m(self) -> Array:
        """Way before each step, shape (S + 1,)."""
        return np.concatenate([[0.0], np.cumsum(np.abs(self.tracks_m).mean(axis=1))])

    def after(self, left_m: float, right_m: float, step_s: float) -> TrackSteps:
        """Way with another step; one that moves no track takes time only."""
        later = replace(self, time_s=self.time_s + step_s)
        if not (left_m or right_m):
            return later
        noise = arc_covariance(self.vehicle, left_m, right_m)
        tracks = np.concatenate([self.tracks_m, [[left_m, right_m]]])
        return replace(later, tracks_m=tracks, noise=np.concatenate([self.noise, noise[None]]))

    def course(self, slip: float, skid: float) -> Course:
        """Places after each step, on arcs."""
        left, right = self.tracks_m.T
        kept, lever = 1.0 - slip, skid * self.vehicle.gauge_m
        length, turn = 0.5 * kept * (left + right), kept * (right - left) / lever
        heading = np.concatenate([[0.0], np.cumsum(turn)])
        chord, along = length * np.sinc(0.5 * turn / np.pi), heading[:-1] + 0.5 * turn
        steps = chord[:, None] * np.stack([np.cos(along), np.sin(along)], axis=-1)
        places = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
        return Course(heading, places, np.array([self.vehicle.sensor_x_m, 0.0, 0.0]))

    def shared_by_steps(self, course: Course, point_m: Array, frames: FrameHistory, F: Array) -> Array:
        """Covariance of residuals by random parts of the steps between frames and now, shape (N, 2, N, 2)."""
        n = len(frames.time_s)
        S = self._place_covariance(course, point_m)[frames.steps]
        later = ((F @ S).reshape(2 * n, 3) @ F.reshape(2 * n, 3).T).reshape(n, 2, n, 2)
        # the later of two frames decides, and frames are in order
        return np.where(np.tri(n, dtype=bool)[:, None, :, None], later, later.transpose(2, 3, 0, 1))

    def _place_covariance(self, course: Course, point_m: Array) -> Array:
        """Covariance of a point's place by the steps after each, shape (S + 1, 3, 3)."""
        dx, dy = (point_m[:2] - course.place_m[:-1]).T
        c, s = np.cos(course.heading_rad[:-1]), np.sin(course.heading_rad[:-1])
        zero = np.zeros_like(c)
        D = np.stack([np.stack(row, axis=-1) for row in ((c, -dy), (s, dx), (zero, zero))], axis=-2)
        each = D @ self.noise @ np.swapaxes(D, 1, 2)
        return np.concatenate([np.cumsum(each[::-1], axis=0)[::-1], np.zeros((1, 3, 3))])


def shared_by_motion(acceleration_m2_per_s3: float, lag_s: Array, F: Array) -> Array:
    """Covariance of residuals by the velocity of a target that walks, shape (N, 2, N, 2)."""
    n = len(lag_s)
    short, long = np.minimum.outer(lag_s, lag_s), np.maximum.outer(lag_s, lag_s)
    # covariance of a walk whose speed walks: integrated twice
    K = acceleration_m2_per_s3 * short**2 * (3.0 * long - short) / 6.0
    flat = F.reshape(2 * n, 3)
    return np.asarray(K[:, None, :, None] * (flat @ flat.T).reshape(n, 2, n, 2))


def shared_px2(frames: FrameHistory, driven_m: Array) -> Array:
    """Covariance of pixels that frames share, each coordinate, shape (N, N): fixed pattern, and the wall's texture.

    The pattern is that of the pixels under the spot. The texture stays where it is around the spot while only the
    carriage moves; a drive shows it from elsewhere.
    """
    pattern, texture = frames.shared_px.T
    uv = frames.uv_px
    apart = np.hypot(*np.moveaxis(uv[:, None] - uv, -1, 0))
    driven = np.abs(np.subtract.outer(driven_m, driven_m))
    result = np.outer(pattern, pattern) * np.exp(-apart / _PATTERN_REACH_PX)
    return np.asarray(result + np.outer(texture, texture) * np.exp(-driven / _TEXTURE_REACH_M))
