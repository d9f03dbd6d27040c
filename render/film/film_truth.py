"""Truth of a film: the still of any instant, and how fast everything in it changes.

`instant_truth` is `spot_truth` of the view and the spot of that instant, with derivatives by the time. The derivatives
are central differences along the motion at that instant, over 0.1 mm of the way: they err by about 1e-8 of themselves.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from phibench.render.optics.room_tracer import GeometryLike, room_geometry
from phibench.render.optics.truth import SpotTruth, depth_m, spot_truth
from phibench.scenes.frames import Array, as_vector
from phibench.scenes.laser import LaserSpot
from phibench.scenes.misalignment import Motion
from phibench.scenes.motion.film_scene import FilmScene
from phibench.scenes.rig import View
from phibench.scenes.room import Room

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
    depth_m : float
        D: horizontal distance of the spot from the vertical through the sphere centre at the down position.
    laser_level : float
        Part of the exposure about this instant during which the laser is on.
    spot : SpotTruth
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
    depth_m: float
    laser_level: float
    spot: SpotTruth
    rates: dict[str, float]


def instant_truth(scene: FilmScene, room: Room, time_s: float, visible: bool = True) -> InstantTruth:
    """Truth at a time.

    Parameters
    ----------
    scene, room, time_s
    visible : bool
        False leaves out what stands in the way: `spot.visible` and `spot.cause` then know nothing of the room.
    """
    view, spot = scene.view_at(time_s), scene.spot_at(time_s)
    geometry: GeometryLike = room_geometry(room, view) if visible else ()
    down = scene.rig.at(0.0).sphere_centre_m
    return InstantTruth(
        time_s=time_s,
        offset_m=float(scene.offset_m(time_s)),
        offset_m_per_s=float(scene.offset_velocity_m_per_s(time_s)),
        sway_m=as_vector(scene.sway_m(time_s)),
        sway_m_per_s=as_vector(scene.sway_velocity_m_per_s(time_s)),
        spot_world_m=spot.position_world_m,
        spot_m_per_s=as_vector(scene.spot_velocity_m_per_s(time_s)),
        depth_m=float(depth_m(np.array(spot.position_world_m), down)),
        laser_level=float(scene.code.mean_level(np.array(time_s), scene.times.exposure_s)),
        spot=spot_truth(view, spot, geometry),
        rates=_rates(scene, view, spot, time_s),
    )


def _rates(scene: FilmScene, view: View, spot: LaserSpot, time_s: float) -> dict[str, float]:
    along = float(scene.offset_velocity_m_per_s(time_s)) * np.array(scene.rig.stroke_axis_world)
    rig_m_per_s, spot_m_per_s = along + scene.sway_velocity_m_per_s(time_s), scene.spot_velocity_m_per_s(time_s)
    fastest = max(float(np.linalg.norm(rig_m_per_s)), float(np.linalg.norm(spot_m_per_s)))
    if fastest == 0.0:
        return dict.fromkeys(RATES, 0.0)
    step_s = _STEP_M / fastest
    before, after = (
        spot_truth(_moved(view, sign * step_s * rig_m_per_s), _placed(spot, sign * step_s * spot_m_per_s), ())
        for sign in (-1.0, 1.0)
    )
    return {name: _difference(name, before, after) / (2.0 * step_s) for name in RATES}


def _difference(name: str, before: SpotTruth, after: SpotTruth) -> float:
    difference = float(getattr(after, name)) - float(getattr(before, name))
    if name != "azimuth_rad":
        return difference
    return float(np.arctan2(np.sin(difference), np.cos(difference)))  # across the cut at pi


def _moved(view: View, shift_m: Array) -> View:
    motion = Motion(as_vector(shift_m))
    return replace(view, motion=motion if view.motion is None else view.motion.then(motion))


def _placed(spot: LaserSpot, shift_m: Array) -> LaserSpot:
    return replace(spot, position_world_m=as_vector(np.array(spot.position_world_m) + shift_m))
