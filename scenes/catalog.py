"""Catalogue of rooms and rigs by the names that recipes use, and the target boards."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from phibench.scenes.camera import Camera
from phibench.scenes.frames import Vector, rotation_xyz
from phibench.scenes.rig import Rig
from phibench.scenes.room import Room
from phibench.scenes.shapes import Checker, Cuboid, Rectangle, Uniform, cuboid, rectangle
from phibench.scenes.validation import finite, positive

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
    name : str
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
    furniture = (
        cuboid("table", (3.6, -1.9, 0.72), (1.6, 0.8, 0.05), (0.45, 0.33, 0.20)),
        cuboid("table_base", (3.6, -1.9, 0.35), (1.2, 0.5, 0.69), (0.30, 0.30, 0.32)),
        cuboid("cabinet", (-4.45, 1.6, 0.95), (0.60, 1.8, 1.90), (0.55, 0.57, 0.60)),
        cuboid("shelf", (-1.0, 4.15, 1.00), (1.4, 0.40, 2.00), (0.42, 0.26, 0.14)),
        cuboid("crate_red", (-2.6, -2.9, 0.30), (0.60, 0.60, 0.60), (0.55, 0.10, 0.08)),
        cuboid("crate_blue", (4.6, 3.2, 0.45), (0.80, 0.80, 0.90), (0.10, 0.18, 0.50)),
        cuboid("column", (-3.4, -4.3, 1.5), (0.40, 0.40, 2.98), (0.62, 0.60, 0.56)),
    )
    return Room("lab", (*_shell(), *_lamps()), (*furniture, *(board(target) for target in targets)))


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
RIGS: dict[str, Callable[[], Rig]] = {"default": default_rig, "c310": c310_rig}
