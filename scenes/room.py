"""Room and robot: everything that light can hit except the mirror.

The robot is the ESCALADE360 as simple solids. The paper gives its overall dimensions, which the solids have, and tracks
with flippers after the PackBot; the split into body, tracks and flippers is ours. So are the mast that lifts the sensor
and the camera's housing, which make the middle of the mirror show a camera on a robot. The holder of the mirror is the
rig's (`scenes/holder.py`), and is part of every room that the rig looks into.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from phibench.scenes.frames import Pose, Vector, as_matrix, as_vector, rotation_xyz
from phibench.scenes.rig import RobotPose, View
from phibench.scenes.shapes import Cuboid, Mesh, Prism, Rectangle, Shape, Uniform, cuboid, shines
from phibench.scenes.validation import SceneError, finite_vector, unit_vector, within

# The robot.

ROBOT_SIZE_M = (0.90, 0.53, 0.30)
"""Overall length, width and height without mast, of the paper; flippers at `FLIPPER_RAD`."""
BODY_TOP_M = ROBOT_SIZE_M[2]
_HOUSING_M = (0.072, 0.030, 0.032)  # the C310's bar, lying on its back
_LENS_CLEARANCE_M = 1e-3  # the housing's top stays below the lens centre so that it shades no aperture
_GREY, _BLACK, _OLIVE = (0.10, 0.10, 0.10), (0.03, 0.03, 0.03), (0.16, 0.17, 0.10)


FLIPPER_RAD = math.radians(25.0)
"""Angle at which the flippers are drawn unless a robot turns them; 0 is ahead, up counts."""
_AXLE_M = np.array([0.23, 0.0, 0.10])  # of the front rollers, about which the flippers turn
_TRACK_M, _FLIPPER_M = (0.78, 0.11, 0.20), (0.28, 0.05, 0.08)  # within the paper's size of the robot
_TRACK_Y_M = 0.5 * (ROBOT_SIZE_M[1] - _TRACK_M[1])  # of the middles, half of the gauge
# of the flippers' middles: the tips' upper corners end the length
_FLIPPER_X_M = 0.5 * (ROBOT_SIZE_M[0] - _FLIPPER_M[0] * math.cos(FLIPPER_RAD) - _FLIPPER_M[2] * math.sin(FLIPPER_RAD))


def chassis(robot: RobotPose | None = None) -> tuple[Cuboid, ...]:
    """Body, two tracks and two flippers, standing on the floor, front towards world +x unless the robot has driven."""
    flipper = rotation_xyz(y_rad=-FLIPPER_RAD)
    parts = (
        cuboid("robot_body", (-0.05, 0.0, 0.19), (0.66, 0.29, 0.22), _OLIVE),
        cuboid("robot_track_left", (-0.06, _TRACK_Y_M, 0.10), _TRACK_M, _BLACK),
        cuboid("robot_track_right", (-0.06, -_TRACK_Y_M, 0.10), _TRACK_M, _BLACK),
        cuboid("robot_flipper_left", (_FLIPPER_X_M, _TRACK_Y_M, 0.18), _FLIPPER_M, _GREY, flipper),
        cuboid("robot_flipper_right", (_FLIPPER_X_M, -_TRACK_Y_M, 0.18), _FLIPPER_M, _GREY, flipper),
    )
    if robot is None:
        return parts
    turn = np.array(rotation_xyz(y_rad=FLIPPER_RAD - robot.flipper_rad))
    about = Pose("rig", "rig", as_vector(_AXLE_M - turn @ _AXLE_M), as_matrix(turn))
    return tuple(_placed(part, robot.T_world_rig, about if "flipper" in part.name else None) for part in parts)


def _may_contain(solid: Cuboid | Prism, point_world_m: tuple[float, ...]) -> bool:
    """Tell whether a point lies in the sphere around a solid, which takes a hundredth of the time of `contains`."""
    reach = solid.size_m if isinstance(solid, Cuboid) else (2.0 * solid.radius_m, solid.height_m)
    # a micrometre more, far above the rounding of both
    return math.dist(point_world_m, solid.T_world_shape.translation_m) <= 0.5 * math.hypot(*reach) + 1e-6


def _placed(part: Cuboid, T_world_rig: Pose, moved: Pose | None = None) -> Cuboid:
    """Part that is written in the rig's frame, in the world."""
    own = replace(part.T_world_shape, target="rig")
    return replace(part, T_world_shape=T_world_rig @ (own if moved is None else moved @ own))


def carriage(view: View) -> tuple[Cuboid, ...]:
    """Camera housing and the mast below it, for a rig at one stroke offset."""
    T_world_camera = view.T_world_camera
    height = _HOUSING_M[2]
    centre = Pose("camera", "shape", (0.0, 0.0, -_LENS_CLEARANCE_M - height / 2.0))
    housing = Cuboid("camera_housing", T_world_camera @ centre, _HOUSING_M, Uniform(_GREY))
    foot = T_world_camera.points(np.array([0.0, 0.0, -_LENS_CLEARANCE_M - height]))
    if view.robot is not None:
        foot = view.robot.T_world_rig.inverse().points(foot)
    rise = max(float(foot[2]) - BODY_TOP_M, 1e-3)  # a camera at the body's top has a mast of 1 mm
    mast = cuboid(
        "robot_mast", as_vector(np.array([foot[0], foot[1], BODY_TOP_M + rise / 2.0])), (0.03, 0.02, rise), _GREY
    )
    return (housing, mast if view.robot is None else _placed(mast, view.robot.T_world_rig))


def escalade360(view: View) -> tuple[Cuboid, ...]:
    """All solids of robot and sensor housing for one view; the same number and order at every offset."""
    return (*chassis(view.robot), *carriage(view))


# The room.

MIRROR_NAME = "mirror"


@dataclass(frozen=True)
class Sun:
    """The sun, which shines through the windows (`Rectangle.window`) of a room.

    Parameters
    ----------
    direction_world : 3 floats
        Towards the sun; made a unit vector.
    irradiance_w_m2 : 3 floats
        Of a surface that faces the sun, per ambient band, behind the pane.
    radius_rad : float
        Angular radius of the disc.
    """

    direction_world: Vector
    irradiance_w_m2: Vector
    radius_rad: float = 0.00465

    def __post_init__(self) -> None:
        object.__setattr__(self, "direction_world", unit_vector("Sun", "direction_world", self.direction_world))
        values = finite_vector("Sun", "irradiance_w_m2", self.irradiance_w_m2, 3)
        for value in values:
            within("Sun", "irradiance_w_m2", value, 0.0, 1e6)
        object.__setattr__(self, "irradiance_w_m2", values)
        within("Sun", "radius_rad", self.radius_rad, 0.0, 0.1)


@dataclass(frozen=True)
class Room:
    """Surfaces, lamps and furniture, in the world frame, and whether the robot stands in it.

    Parameters
    ----------
    name : str
    surfaces : rectangles; those that emit are the lamps
    furniture : shapes of any kind
    robot : bool
        Robot, mast and camera housing are part of the scene.
    sun : Sun or None
    """

    name: str
    surfaces: tuple[Rectangle, ...]
    furniture: tuple[Shape, ...] = ()
    robot: bool = True
    sun: Sun | None = None

    def __post_init__(self) -> None:
        shapes: tuple[Shape, ...] = (*self.surfaces, *self.furniture)
        names = [shape.name for shape in shapes]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise SceneError(f"Room '{self.name}': two shapes are called {twice[0]}; names must differ")

    @property
    def lit(self) -> bool:
        """True if any lamp or screen is on."""
        return any(shines(shape) for shape in (*self.surfaces, *self.furniture))

    @cached_property
    def digest(self) -> str:
        """SHA-256 of all that the room is."""
        return hashlib.sha256(repr(self).encode()).hexdigest()

    def shapes(self, view: View) -> tuple[Shape, ...]:
        """All shapes for one view; the index of a shape in this tuple is its object id, the same at every offset."""
        return (*self.surfaces, *self.furniture, *self.brought(view))

    def brought(self, view: View) -> tuple[Shape, ...]:
        """Shapes that come with the rig: robot and carriage where the room has them, and the mirror's holder."""
        return (*(escalade360(view) if self.robot else ()), *view.holder_shapes)

    def object_names(self, view: View) -> tuple[str, ...]:
        """Names of the shapes in the order of their object ids, but for the holder's, whose ids follow."""
        return tuple(shape.name for shape in self.shapes(view)[: -len(view.holder_shapes) or None])

    def dark(self) -> Room:
        """Return the same room with every lamp switched off."""
        off = tuple(replace(surface, radiance_w_m2_sr=(0.0, 0.0, 0.0)) for surface in self.surfaces)
        return replace(self, name="dark", surfaces=off)

    def solid_around(self, point_world_m: tuple[float, ...]) -> str | None:
        """Name of the solid (furniture, robot) that a world point lies inside, or None."""
        solids = (*self.furniture, *(chassis() if self.robot else ()))
        named = (solid for solid in solids if not isinstance(solid, Rectangle | Mesh))
        near = (solid for solid in named if _may_contain(solid, point_world_m))
        return next((solid.name for solid in near if solid.contains(point_world_m)), None)
