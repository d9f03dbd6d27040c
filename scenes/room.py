"""Room with sun and robot; target boards and whether a rig hits them; the lab; named rooms and rigs of recipes.

The robot is the ESCALADE360 as simple solids. The paper gives its overall dimensions, which the solids have, and tracks
with flippers after the PackBot; the split into body, tracks and flippers is ours. So are the mast that lifts the sensor
and the camera's housing, which make the middle of the mirror show a camera on a robot. The holder of the mirror is the
rig's (`scenes/holder.py`), and is part of every room that the rig looks into.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np

from phibench.scenes.camera import Camera
from phibench.scenes.frames import Pose, Vector, as_matrix, as_vector, rotation_xyz
from phibench.scenes.rig import Rig, RobotPose, View
from phibench.scenes.shapes import Checker, Cuboid, Mesh, Prism, Rectangle, Shape, Uniform, cuboid, rectangle, shines
from phibench.scenes.validation import SceneError, finite, finite_vector, positive, unit_vector, within

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


# Catalogue of rooms and rigs by the names that recipes use, and the target boards.


# Inner faces of the lab, metres: about 10 x 9 x 3 with the stroke axis at the origin.
X_LOW, X_HIGH, Y_LOW, Y_HIGH, HEIGHT = -4.8, 5.2, -4.6, 4.4, 3.0
BOARD_THICKNESS_M = 0.02
BOARD_SIZE_M = (0.40, 0.30)  # width, height
BOARD_ALBEDO = 0.70
_LAMP_RADIANCE = (3.6, 3.2, 2.4)  # W/m^2/sr per band: on the floor about 300 lx directly, warm white


@dataclass(frozen=True)
class TargetBoard:
    """A target board that faces the stroke axis, and the spot at its centre.

    Parameters
    ----------
    depth_m : float
        Horizontal distance of the board's face from the world's z axis.
    azimuth_rad : float
        From world x towards world y.
    height_m : float
        Height of the board's centre above the floor.
    """

    name: str
    depth_m: float
    azimuth_rad: float
    height_m: float

    def __post_init__(self) -> None:
        positive("Target", "depth_m", self.depth_m)
        finite("Target", "azimuth_rad", self.azimuth_rad)
        finite("Target", "height_m", self.height_m)

    @property
    def position_world_m(self) -> Vector:
        """Centre of the board's face."""
        return (self.depth_m * math.cos(self.azimuth_rad), self.depth_m * math.sin(self.azimuth_rad), self.height_m)

    @property
    def normal_world(self) -> Vector:
        """Normal of the board's face: horizontal, towards the axis."""
        return (-math.cos(self.azimuth_rad), -math.sin(self.azimuth_rad), 0.0)


def board(target: TargetBoard) -> Cuboid:
    """Thin cuboid whose front face carries the target's spot."""
    behind = target.depth_m + BOARD_THICKNESS_M / 2.0
    centre = (behind * math.cos(target.azimuth_rad), behind * math.sin(target.azimuth_rad), target.height_m)
    size = (BOARD_THICKNESS_M, *BOARD_SIZE_M)
    return cuboid(f"board_{target.name}", centre, size, (BOARD_ALBEDO,) * 3, rotation_xyz(z_rad=target.azimuth_rad))


def lab(targets: Sequence[TargetBoard] = ()) -> Room:
    """Room of 10 x 9 x 3 m: tiled floor, striped and plain walls, six lamps, a door, furniture, boards."""
    surfaces, furniture = _empty_lab()
    return Room("lab", surfaces, (*furniture, *(board(target) for target in targets)))


@cache
def _empty_lab() -> tuple[tuple[Rectangle, ...], tuple[Cuboid, ...]]:
    """Surfaces and furniture: a recipe is checked with its boards in this room one by one."""
    furniture = (
        cuboid("table", (3.6, -1.9, 0.72), (1.6, 0.8, 0.05), (0.45, 0.33, 0.20)),
        cuboid("table_base", (3.6, -1.9, 0.35), (1.2, 0.5, 0.69), (0.30, 0.30, 0.32)),
        cuboid("cabinet", (-4.45, 1.6, 0.95), (0.60, 1.8, 1.90), (0.55, 0.57, 0.60)),
        cuboid("shelf", (-1.0, 4.15, 1.00), (1.4, 0.40, 2.00), (0.42, 0.26, 0.14)),
        cuboid("crate_red", (-2.6, -2.9, 0.30), (0.60, 0.60, 0.60), (0.55, 0.10, 0.08)),
        cuboid("crate_blue", (4.6, 3.2, 0.45), (0.80, 0.80, 0.90), (0.10, 0.18, 0.50)),
        cuboid("column", (-3.4, -4.3, 1.5), (0.40, 0.40, 2.98), (0.62, 0.60, 0.56)),
    )
    return (*_shell(), *_lamps()), furniture


def dark(targets: Sequence[TargetBoard] = ()) -> Room:
    """The lab with every lamp off, for tests."""
    return lab(targets).dark()


def _shell() -> tuple[Rectangle, ...]:
    x, y, z = (X_LOW + X_HIGH) / 2.0, (Y_LOW + Y_HIGH) / 2.0, HEIGHT / 2.0
    size_x, size_y = X_HIGH - X_LOW, Y_HIGH - Y_LOW
    tiles = Checker((0.46, 0.44, 0.40), (0.30, 0.29, 0.28), (0.5, 0.5), (-size_x / 2.0, -size_y / 2.0))
    stripes = Checker((0.66, 0.62, 0.52), (0.58, 0.54, 0.45), (0.6, 10.0), (-size_y / 2.0, -HEIGHT / 2.0))
    plain, blueish, white = Uniform((0.68, 0.67, 0.63)), Uniform((0.52, 0.60, 0.66)), Uniform((0.82, 0.82, 0.80))
    return (
        rectangle("floor", (x, y, 0.0), (0.0, 0.0, 1.0), (size_x, size_y), texture=tiles),
        rectangle("ceiling", (x, y, HEIGHT), (0.0, 0.0, -1.0), (size_x, size_y), texture=white),
        rectangle("wall_west", (X_LOW, y, z), (1.0, 0.0, 0.0), (size_y, HEIGHT), texture=stripes),
        rectangle("wall_east", (X_HIGH, y, z), (-1.0, 0.0, 0.0), (size_y, HEIGHT), texture=plain),
        rectangle("wall_south", (x, Y_LOW, z), (0.0, 1.0, 0.0), (size_x, HEIGHT), texture=plain),
        rectangle("wall_north", (x, Y_HIGH, z), (0.0, -1.0, 0.0), (size_x, HEIGHT), texture=blueish),
        rectangle(
            "door", (X_HIGH - 0.005, 1.2, 1.025), (-1.0, 0.0, 0.0), (0.9, 2.05), texture=Uniform((0.40, 0.22, 0.10))
        ),
        rectangle("poster", (1.6, Y_LOW + 0.005, 1.5), (0.0, 1.0, 0.0), (1.2, 0.9), texture=_poster()),
    )


def _poster() -> Checker:
    return Checker((0.80, 0.78, 0.70), (0.15, 0.30, 0.20), (0.15, 0.15), (-0.6, -0.45))


def _lamps() -> tuple[Rectangle, ...]:
    places = [(x, y) for x in (-2.8, 0.2, 3.2) for y in (-2.3, 2.1)]  # six panels, evenly over the ceiling
    return tuple(
        rectangle(
            f"lamp_{i}",
            (x, y, HEIGHT - 0.02),
            (0.0, 0.0, -1.0),
            (1.2, 0.6),
            texture=Uniform((0.0, 0.0, 0.0)),
            radiance_w_m2_sr=_LAMP_RADIANCE,
        )
        for i, (x, y) in enumerate(places)
    )


def cut_part(view: View, plate: Cuboid) -> str | None:
    """Name the part of the carriage (mirror, housing, mast, holder) that a board cuts; None if none.

    Round parts of the holder count as the boxes around them, its glass included.
    """
    if plate.distance_m(view.sphere_centre_m) <= view.rig.mirror.bound_m:
        return "mirror"
    boxes = [
        Cuboid(part_of_holder.name, part_of_holder.T_world_shape, part_of_holder.size_m)
        for part_of_holder in view.holder_shapes
    ]
    if (tube := view.tube) is not None:
        middle = tube.origin_m + 0.5 * (tube.low_m + tube.high_m) * tube.axis
        upright = replace(boxes[0].T_world_shape, translation_m=as_vector(middle))
        boxes.append(Cuboid("holder_tube", upright, (2.0 * tube.outer_m, 2.0 * tube.outer_m, tube.high_m - tube.low_m)))
    return next((part.name.replace("_", " ") for part in (*carriage(view), *boxes) if plate.meets(part)), None)


_HOUSING_REACH_M = 0.1  # housing and mast stay within this of the lens


class Boards:
    """Boards of a room, for many rigs: nearly all are too far from the carriage to be asked."""

    def __init__(self, targets: Sequence[TargetBoard]) -> None:
        self._plates = [board(target) for target in targets]
        self._centres_m = np.array([plate.T_world_shape.translation_m for plate in self._plates]).reshape(-1, 3)

    def cut_by(self, rig: Rig, stroke_m: float) -> str | None:
        """Say which board a rig cuts at an end of its stroke; None if none."""
        lens_m = rig.T_world_camera.t
        wide_m = rig.mirror.bound_m if rig.holder is None else rig.holder.plate_m
        reach_m = float(np.linalg.norm(rig.sphere_in_camera_m[:2])) + wide_m + _HOUSING_REACH_M
        reach_m += abs(stroke_m) * math.hypot(*rig.stroke_axis_world[:2]) + rig.sphere_in_camera_m[2] * _tilt(rig)
        if rig.motion is not None:  # at most: the sphere swings about the lens as far as it is from it, twice
            reach_m += math.hypot(*rig.motion.translation_m) + 2.0 * float(np.linalg.norm(rig.sphere_in_camera_m))
        near = np.hypot(*(self._centres_m - lens_m)[:, :2].T) < reach_m + math.hypot(*BOARD_SIZE_M)
        for k in np.flatnonzero(near):
            for offset_m in (0.0, stroke_m):
                if hit := cut_part(rig.at(offset_m), self._plates[k]):
                    return f"the {self._plates[k].name} cuts the {hit} at stroke {offset_m:g} m"
        return None


def _tilt(rig: Rig) -> float:
    """Sine of the angle between the optical axis and the vertical."""
    return math.hypot(*rig.T_world_camera.R[:2, 2])


def default_rig() -> Rig:
    """Aligned rig without distortion, focused on the virtual image at z_c - R/2; numbers in docs/model.md."""
    return Rig()


def c310_camera() -> Camera:
    """The C310 with the published distortion coefficients (at most 0.65 px inside the mirror disc)."""
    return Camera(k1=-0.026, k2=1.06, k3=-3.40)


def c310_rig() -> Rig:
    """Default rig with the C310's distortion."""
    return Rig(camera=c310_camera())


ROOMS: dict[str, Callable[[Sequence[TargetBoard]], Room]] = {"lab": lab, "dark": dark}
RIGS: dict[str, Callable[[], Rig]] = {"default": Rig, "c310": c310_rig}
