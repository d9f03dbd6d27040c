"""Truth of a film at any instant: exact spot, phi, D, pose of the rig, and how fast each of them changes.

`instant_truth` is `spot_truth` of the view and the spot of that instant, with derivatives by the time. The derivatives
are central differences along the motion at that instant, over 0.1 mm of the way or 0.1 mrad: they err by about 1e-8 of
themselves.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from phibench.render.optics.room_tracer import GeometryLike, room_geometry
from phibench.render.optics.truth import SpotTruth, depth_m, spot_truth
from phibench.scenes.frames import Array, as_vector
from phibench.scenes.laser import LaserSpot
from phibench.scenes.motion.drive import placement
from phibench.scenes.motion.film_scene import FilmScene
from phibench.scenes.room import FLIPPER_RAD, Room

_STEP_M = 1e-4
RATES = ("u_px", "v_px", "phi_ray_rad", "phi_normal_rad", "phi_incidence_rad", "azimuth_rad", "path_spot_mirror_m")
"""Numbers of `SpotTruth` whose derivative is given, per second."""


@dataclass(frozen=True)
class InstantTruth:
    """One instant of a film.

    Attributes
    ----------
    time_s, offset_m, offset_m_per_s : float
        Time; offset along the stroke axis, vibration included, and its derivative.
    sway_m, sway_m_per_s, spot_world_m, spot_m_per_s : 3 floats
        Shift of the rig across, the spot's centre in the world, and their derivatives.
    rig_world_m, rig_m_per_s : 3 floats
        Origin of the frame in which the rig is written, and its derivative: it moves where the robot drives.
    rig_angles_rad, rig_rad_per_s : 3 floats
        Roll, pitch and yaw of that frame, R = Rz(yaw) Ry(pitch) Rx(roll), a nose up being a pitch below 0; and its
        angular velocity about the world's axes.
    flipper_rad : float
        Angle of the flippers; 0 is ahead, up counts.
    depth_m : float
        D: horizontal distance of the spot from the vertical through the sphere centre with the carriage down, where
        the robot stands now.
    laser_level : float
        Part of the exposure about this instant during which the laser is on.
    rates : dict
        Derivative by the time of each of `RATES`, per second; NaN where there is no reflection point.
    """

    time_s: float
    offset_m: float
    offset_m_per_s: float
    sway_m: tuple[float, ...]
    sway_m_per_s: tuple[float, ...]
    spot_world_m: tuple[float, ...]
    spot_m_per_s: tuple[float, ...]
    rig_world_m: tuple[float, ...]
    rig_m_per_s: tuple[float, ...]
    rig_angles_rad: tuple[float, ...]
    rig_rad_per_s: tuple[float, ...]
    flipper_rad: float
    depth_m: float
    laser_level: float
    spot: SpotTruth
    rates: dict[str, float]


def instant_truth(scene: FilmScene, room: Room, time_s: float, visible: bool = True) -> InstantTruth:
    """Truth at a time.

    Parameters
    ----------
    visible : bool
        False leaves out what stands in the way: `spot.visible` and `spot.cause` then know nothing of the room.
    """
    view, spot = scene.view_at(time_s), scene.spot_at(time_s)
    geometry: GeometryLike = room_geometry(room, view) if visible else ()
    state = scene.robot_state(time_s)
    down = scene.view_of(0.0, np.zeros(3), state).sphere_centre_m
    return InstantTruth(
        time_s=time_s,
        offset_m=float(scene.offset_m(time_s)),
        offset_m_per_s=float(scene.offset_velocity_m_per_s(time_s)),
        sway_m=as_vector(scene.sway_m(time_s)),
        sway_m_per_s=as_vector(scene.sway_velocity_m_per_s(time_s)),
        spot_world_m=spot.position_world_m,
        spot_m_per_s=as_vector(scene.spot_velocity_m_per_s(time_s)),
        **_robot(scene, time_s, state),
        depth_m=float(depth_m(np.array(spot.position_world_m), down)),
        laser_level=float(scene.code.mean_level(np.array(time_s), scene.times.exposure_s)),
        spot=spot_truth(view, spot, geometry),
        rates=_rates(scene, time_s, spot),
    )


def _robot(scene: FilmScene, time_s: float, state: Array) -> dict[str, Any]:
    """Pose of the rig's frame and its derivative."""
    nil = (0.0, 0.0, 0.0)
    if scene.drive is None:
        still = {"rig_world_m": nil, "rig_m_per_s": nil, "rig_angles_rad": nil, "rig_rad_per_s": nil}
        return {**still, "flipper_rad": FLIPPER_RAD}
    vehicle, rate = scene.drive.vehicle, scene.robot_rate(time_s)
    R, t = placement(vehicle, state)
    velocity, turning = np.zeros(3), np.zeros(3)
    if fastest := float(np.abs(rate).max()):
        step_s = _STEP_M / fastest
        turns, origins = placement(vehicle, state + np.array([[-step_s], [step_s]]) * rate)
        velocity = (origins[1] - origins[0]) / (2.0 * step_s)
        spin = (turns[1] - turns[0]) @ R.T / (2.0 * step_s)  # [w]x
        turning = 0.5 * np.array([spin[2, 1] - spin[1, 2], spin[0, 2] - spin[2, 0], spin[1, 0] - spin[0, 1]])
    angles = (np.arctan2(R[2, 1], R[2, 2]), np.arctan2(-R[2, 0], np.hypot(R[2, 1], R[2, 2])), state[2])
    return {
        "rig_world_m": as_vector(t),
        "rig_m_per_s": as_vector(velocity),
        "rig_angles_rad": as_vector(np.array(angles)),
        "rig_rad_per_s": as_vector(turning),
        "flipper_rad": float(state[3]),
    }


def _rates(scene: FilmScene, time_s: float, spot: LaserSpot) -> dict[str, float]:
    """Central differences between the states in which everything would be a little earlier and later at its speed."""
    now = np.hstack([scene.offset_m(time_s), scene.sway_m(time_s), scene.robot_state(time_s), scene.spot_m(time_s)])
    rate = np.hstack(
        [
            scene.offset_velocity_m_per_s(time_s),
            scene.sway_velocity_m_per_s(time_s),
            scene.robot_rate(time_s),
            scene.spot_velocity_m_per_s(time_s),
        ]
    )
    fastest = float(np.abs(rate).max())
    if fastest == 0.0:
        return dict.fromkeys(RATES, 0.0)
    step_s = _STEP_M / fastest
    before, after = (_state_truth(scene, spot, now + sign * step_s * rate) for sign in (-1.0, 1.0))
    return {name: _difference(name, before, after) / (2.0 * step_s) for name in RATES}


def _state_truth(scene: FilmScene, spot: LaserSpot, state: Array) -> SpotTruth:
    """Still of a state: offset, sway (3), robot (4), spot (3)."""
    view = scene.view_of(float(state[0]), state[1:4], state[4:8])
    return spot_truth(view, replace(spot, position_world_m=as_vector(state[8:])), ())


def _difference(name: str, before: SpotTruth, after: SpotTruth) -> float:
    difference = float(getattr(after, name)) - float(getattr(before, name))
    if name != "azimuth_rad":
        return difference
    return float(np.arctan2(np.sin(difference), np.cos(difference)))  # across the cut at pi
