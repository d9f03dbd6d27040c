"""Holder of the mirror above the camera (rods, post or glass tube): sizes, checks against mirror and lens, and shapes.

It has a file of its own because three sides need the same thing: the rig checks its sizes, rooms take its shapes, and
recipes draw it. It belongs to the rig and moves with it. Its axis is the line from the lens centre to the sphere's
centre, or to the vertex of a mirror of revolution: the mirror sits centred in its holder, and the two are misaligned
together against camera and stroke axis. Along that axis z is 0 at the lens centre. A mirror of revolution may be tilted
in its holder.

* Rods: three upright rods on a circle around the mirror, between a plate below the camera and one above the mirror.
* Post: a post from above ends at the top of a ball, or on the back of a mirror of revolution, in the plane of its rim.
  Nothing that is wholly behind a convex mirror is ever seen in it. The post therefore hangs from an arm, and a column
  beside the mirror carries that from the plate below the camera.
* Tube: a glass tube around mirror and lens, between the same plates as the rods (`scenes.glass_tube`).

**Nothing of it stands between lens and mirror.** Mirror and lens lie in a cylinder around the axis, as wide as the
mirror reaches (`check`: or as the lens opening), and so does every line between their points, since a cylinder is
convex. All parts beside the mirror lie outside that cylinder. What hides a spot, it hides between mirror and wall.

Rods are prisms of `SIDES` sides. Their corners lie r (pi / n) / sin(pi / n) from the axis, so that the mean width of
the prism, seen from all sides, is that of the round rod (Cauchy: the perimeter over pi). Its outline then lies within
r ((pi / n) / sin(pi / n) - 1) = 0.29 % of r outside, and 0.57 % inside, the round one's.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Literal

import numpy as np

from phibench.scenes.frames import Array, Pose, as_matrix, as_vector
from phibench.scenes.glass_tube import GlassTube
from phibench.scenes.shapes import Cuboid, Prism, Uniform
from phibench.scenes.validation import SceneError, finite, within

HolderKind = Literal["rods", "post", "tube"]
Part = Prism | Cuboid

SIDES = 24  # of rods: their outline errs by 0.6 % of the radius
PLATE_SIDES = 48  # larger, so that the same error is as small in millimetres
_PLATE_M = 0.004  # thickness
_BELOW_LENS_M = 0.034  # top of the plate below the camera, whose housing ends 1 mm above
_BLACK_METAL = Uniform((0.10, 0.10, 0.10))  # albedo of a painted part
_RODS = 3  # the least that hold plates parallel
LARGEST_INDEX = 2.5  # of a tube: diamond has 2.42


@dataclass(frozen=True)
class Extent:
    """Reach of a mirror from the point that the holder's axis leads to: a sphere's centre, or a vertex.

    Attributes
    ----------
    wide_m, high_m : float
        Farthest from the axis, and up along it.
    back_m : float
        Height at which a post ends.
    """

    wide_m: float
    high_m: float
    back_m: float


@dataclass(frozen=True)
class Holder:
    """Kind and sizes of a holder; `check` holds them against a mirror.

    Parameters
    ----------
    kind : "rods", "post" or "tube"
    radius_m : float
        Of each rod; of post, arm and column; a tube has none.
    circle_m : float
        From the holder's axis to that of each rod, or of the column; to the inner face of a tube.
    plate_m : float
        Radius of the plates.
    rise_m : float
        From the sphere's centre, or the vertex, up to the upper plate, or to the top of the arm.
    azimuth_rad : float
        Direction of the first rod, or of the column, from the camera's x axis against the clock seen from above.
    wall_m : float
        Thickness of a tube's wall.
    glass_index : float
        Refractive index of a tube. Borosilicate glass 3.3: 1.473 at 587.6 nm (data sheet of Schott's Duran tubing),
        acrylic: 1.491 (Kasarova et al., Optical Materials 29, 1481, 2007). One for all wavelengths.
    """

    kind: HolderKind
    radius_m: float = 0.004
    circle_m: float = 0.080
    plate_m: float = 0.090
    rise_m: float = 0.090
    azimuth_rad: float = math.pi / 6.0
    wall_m: float = 0.003
    glass_index: float = 1.473

    def __post_init__(self) -> None:
        for name in LENGTHS:
            within("Holder", name, getattr(self, name), 1e-4, 1.0)
        finite("Holder", "azimuth_rad", self.azimuth_rad)
        within("Holder", "glass_index", self.glass_index, 1.0, LARGEST_INDEX)

    @property
    def part_names(self) -> tuple[str, ...]:
        """Names of the parts, in the order of `holder_shapes`."""
        if self.kind == "rods":
            return ("holder_plate_low", "holder_plate_high", *(f"holder_rod_{i + 1}" for i in range(_RODS)))
        if self.kind == "tube":
            return ("holder_plate_low", "holder_plate_high")
        return ("holder_plate_low", "holder_column", "holder_arm", "holder_post")

    @property
    def top_m(self) -> float:
        """Height of its highest part above the sphere's centre or the vertex, along its axis."""
        return self.rise_m + (0.0 if self.kind == "post" else _PLATE_M)

    def check(self, mirror: Extent, lens_m: float) -> None:
        """Raise `SceneError` if it does not fit a mirror and a lens opening of radius `lens_m`."""
        wide_m = mirror.wide_m
        if self.kind == "tube":
            self._check_tube(mirror, lens_m)
            return
        thick = prism_radius_m(self.radius_m)
        inside = max(wide_m, lens_m) + thick
        upright = "rods" if self.kind == "rods" else "column"
        if self.circle_m <= inside:
            raise SceneError(
                f"Holder.circle_m = {self.circle_m:g}: the {upright} would stand inside the mirror, which reaches "
                f"{wide_m:g} m from the axis; give more than {inside:.4f}"
            )
        if self.circle_m + thick > self.plate_m:
            raise SceneError(
                f"Holder.plate_m = {self.plate_m:g}: the {upright} would stand outside the plate; give at least "
                f"{self.circle_m + thick:.4f}, or a smaller circle_m"
            )
        if self.kind == "post" and thick >= wide_m:
            raise SceneError(
                f"Holder.radius_m = {self.radius_m:g}: the post is thicker than the mirror, which reaches "
                f"{wide_m:g} m from the axis; give less"
            )
        self._check_rise(mirror.high_m if self.kind == "rods" else mirror.high_m + 2.0 * self.radius_m)

    def _check_tube(self, mirror: Extent, lens_m: float) -> None:
        inside = max(mirror.wide_m, lens_m)
        if self.circle_m <= inside:
            raise SceneError(
                f"Holder.circle_m = {self.circle_m:g}: the tube would stand inside the mirror, which reaches "
                f"{mirror.wide_m:g} m from the axis; give more than {inside:.4f}"
            )
        outer = self.circle_m + self.wall_m
        if outer > self.plate_m * math.cos(math.pi / PLATE_SIDES):
            # rounded up, so that what is proposed is allowed
            least = math.ceil(1e4 * outer / math.cos(math.pi / PLATE_SIDES)) / 1e4
            raise SceneError(
                f"Holder.plate_m = {self.plate_m:g}: the tube's wall would stand outside the plate; give at least "
                f"{least:.4f}, or a smaller circle_m or wall_m"
            )
        self._check_rise(mirror.high_m)

    def _check_rise(self, low: float) -> None:
        if self.rise_m <= low:
            raise SceneError(
                f"Holder.rise_m = {self.rise_m:g}: the holder's top would lie inside the mirror; give more than "
                f"{low:.4f}"
            )


def fitted_holder(kind: HolderKind, wide_m: float, depth_m: float | None = None, **given: float) -> Holder:
    """Holder with the sizes that are given, and others that suit a ball of radius `wide_m`, or a rim of this radius.

    The gap between mirror and rods, or tube, is a quarter of the radius. The plates reach two radii of a rod beyond
    them, and the upper plate is half the radius above the mirror's top. A tube's wall does not follow the mirror.

    Parameters
    ----------
    depth_m : float or None
        Of the rim over the vertex; None is a ball.
    """
    sizes = {"radius_m": wide_m / 15.0, "wall_m": Holder.wall_m, **given}  # 4 mm for a ball of 60 mm
    tube = kind == "tube"
    sizes.setdefault("circle_m", 1.25 * wide_m + (0.0 if tube else sizes["radius_m"]))
    beyond = sizes["wall_m"] + 2.0 * sizes["radius_m"] if tube else 3.0 * sizes["radius_m"]
    sizes.setdefault("plate_m", sizes["circle_m"] + beyond)
    sizes.setdefault("rise_m", 1.5 * wide_m if depth_m is None else depth_m + 0.5 * wide_m)
    return Holder(kind, **sizes)


OF_TUBES = ("wall_m", "glass_index")
"""Fields that mean something for a tube alone; documents of other holders leave them out."""
LENGTHS = tuple(field.name for field in fields(Holder) if field.name.endswith("_m"))
"""Names of the sizes that `fitted_holder` may choose."""


def prism_radius_m(radius_m: float) -> float:
    """Radius of the corners of a prism that has the mean width of a round rod."""
    half = math.pi / SIDES
    return radius_m * half / math.sin(half)


def holder_shapes(holder: Holder, T_world_camera: Pose, sphere_centre_m: Array, back_m: float) -> tuple[Part, ...]:
    """Shapes of a holder in the world, in the order of `Holder.part_names`.

    Parameters
    ----------
    sphere_centre_m : array, shape (3,)
        Or the vertex, in the world.
    back_m : float
        Height above it at which the post ends.
    """
    axis = _Axis.of(T_world_camera, sphere_centre_m)
    foot, top = _ends_m(holder, axis)
    plates: list[Part] = [axis.upright(0.0, 0.0, foot - _PLATE_M, foot, holder.plate_m, PLATE_SIDES)]
    thick = prism_radius_m(holder.radius_m)
    if holder.kind != "post":
        plates.append(axis.upright(0.0, 0.0, top, top + _PLATE_M, holder.plate_m, PLATE_SIDES))
    if holder.kind == "tube":
        return _named(holder, plates)
    if holder.kind == "rods":
        turns = [holder.azimuth_rad + 2.0 * math.pi * i / _RODS for i in range(_RODS)]
        posts = [axis.upright(turn, holder.circle_m, foot, top, thick, SIDES) for turn in turns]
        return _named(holder, [*plates, *posts])
    width, turn = 2.0 * holder.radius_m, holder.azimuth_rad
    column = axis.upright(turn, holder.circle_m, foot, top - width, thick, SIDES)
    arm = Cuboid(
        "",
        axis.pose(turn, 0.5 * holder.circle_m, top - holder.radius_m),
        (holder.circle_m + width, width, width),
        _BLACK_METAL,
    )
    post = axis.upright(0.0, 0.0, axis.length_m + back_m, top - width, thick, SIDES)
    return _named(holder, [*plates, column, arm, post])


def holder_tube(holder: Holder, T_world_camera: Pose, sphere_centre_m: Array) -> GlassTube:
    """Wall of a holder that is a tube, in the world, from plate to plate; heights count from the lens centre."""
    axis = _Axis.of(T_world_camera, sphere_centre_m)
    radii = (holder.circle_m, holder.circle_m + holder.wall_m)
    return GlassTube(*radii, holder.glass_index, *_ends_m(holder, axis), axis.origin_m, axis.rotation[:, 2])


def _ends_m(holder: Holder, axis: _Axis) -> tuple[float, float]:
    """Heights above the lens between which upright parts stand."""
    return -_BELOW_LENS_M, axis.length_m + holder.rise_m


def _named(holder: Holder, parts: Sequence[Part]) -> tuple[Part, ...]:
    return tuple(replace(part, name=name) for part, name in zip(parts, holder.part_names, strict=True))


@dataclass(frozen=True)
class _Axis:
    """The holder's frame: z from the lens centre to the sphere's or the vertex, x near to the camera's."""

    origin_m: Array
    rotation: Array
    length_m: float

    @staticmethod
    def of(T_world_camera: Pose, sphere_centre_m: Array) -> _Axis:
        way = sphere_centre_m - T_world_camera.t
        length = float(np.linalg.norm(way))
        z = way / length
        y = np.cross(z, T_world_camera.R[:, 0])
        y /= np.linalg.norm(y)
        return _Axis(T_world_camera.t, np.stack([np.cross(y, z), y, z], axis=1), length)

    def pose(self, turn: float, away_m: float, height_m: float) -> Pose:
        """Pose at a distance from the axis, its x axis outwards."""
        c, s = math.cos(turn), math.sin(turn)
        place = self.origin_m + self.rotation @ np.array([away_m * c, away_m * s, height_m])
        turned = self.rotation @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        return Pose("world", "shape", as_vector(place), as_matrix(turned))

    def upright(self, turn: float, away_m: float, low_m: float, high_m: float, radius_m: float, sides: int) -> Prism:
        """Prism along the axis from one height to another."""
        pose = self.pose(turn, away_m, 0.5 * (low_m + high_m))
        return Prism("", pose, radius_m, high_m - low_m, sides, _BLACK_METAL)
