"""Settings by which a panorama becomes a room: file, place of the camera, geometry, and their checks."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from phibench.datasets.rooms.mesh_placement import EXTENT_M, MIRROR_TOP_M, MeshSettings, robot_box
from phibench.datasets.rooms.room_files import RoomError
from phibench.scenes.frames import Vector
from phibench.scenes.validation import finite_vector, within

CLEAR_M = 0.05
"""Least distance of the camera from every wall."""


@dataclass(frozen=True)
class PanoramaSettings:
    """Settings by which a panorama becomes a room.

    Parameters
    ----------
    path : Path
        Absolute; JPEG, PNG, OpenEXR or Radiance HDR, equirectangular.
    point_m : 3 floats
        Place of the camera, world frame: metres from the robot, x its front, z up from the floor.
    heading_deg : float
        Azimuth of the picture's middle column, from world x towards world y.
    box_m : 5 floats, or None
        Walls around the robot: x_low, x_high, y_low, y_high, height. The floor is at 0.
    mesh : MeshSettings, or None
        Geometry of a mesh file, whose colours, emission and lamps are not used; this or a box must be stated.
    texel_m : float
        Least size of a texel.
    radiance_scale : float, or None
        W/(m^2 sr) per unit of the picture; by default the mean irradiance from all directions becomes 1 W/m^2.
    laser_albedo : float
        Of all surfaces.
    stroke_m : float
        Largest stroke that the box must leave room for; a mesh has its own.
    name : str
    """

    path: Path
    point_m: Vector
    heading_deg: float = 0.0
    box_m: Vector | None = None
    mesh: MeshSettings | None = None
    texel_m: float = 0.008
    radiance_scale: float | None = None
    laser_albedo: float = 0.5
    stroke_m: float = 1.4
    name: str = "panorama"

    def __post_init__(self) -> None:
        object.__setattr__(self, "path", Path(self.path))
        object.__setattr__(self, "point_m", finite_vector("PanoramaSettings", "point_m", self.point_m, 3))
        within("PanoramaSettings", "heading_deg", self.heading_deg, -360.0, 360.0)
        within("PanoramaSettings", "texel_m", self.texel_m, 5e-4, 1.0)
        within("PanoramaSettings", "laser_albedo", self.laser_albedo, 0.0, 1.0)
        within("PanoramaSettings", "stroke_m", self.stroke_m, 0.0, 10.0)
        if self.radiance_scale is not None:
            within("PanoramaSettings", "radiance_scale", self.radiance_scale, 1e-9, 1e9)
        if (self.box_m is None) == (self.mesh is None):
            raise RoomError("PanoramaSettings: state the geometry by box_m or by mesh, one of them and not both")
        if self.mesh is not None and self.mesh.lamps:
            raise RoomError(
                "PanoramaSettings.mesh has lamps: the walls of a panorama shine by themselves; leave them out"
            )
        if self.box_m is not None:
            self._check_box(finite_vector("PanoramaSettings", "box_m", self.box_m, 5))

    def _check_box(self, box: Vector) -> None:
        object.__setattr__(self, "box_m", box)
        low, high = np.array([box[0], box[2], 0.0]), np.array([box[1], box[3], box[4]])
        extent, text = high - low, f"PanoramaSettings.box_m = {box}"
        for axis in range(2):
            if extent[axis] <= 0.0:
                names = f"{'xy'[axis]}_low = {low[axis]:g} is not below {'xy'[axis]}_high = {high[axis]:g}"
                raise RoomError(f"{text}: {names}; give x_low, x_high, y_low, y_high, height in this order")
        if extent.min() < EXTENT_M[0] or extent.max() > EXTENT_M[1]:
            raise RoomError(
                f"{text} (x_low, x_high, y_low, y_high, height) measures {extent[0]:.3g} x {extent[1]:.3g} x "
                f"{extent[2]:.3g} m: a room measures {EXTENT_M[0]:g} to {EXTENT_M[1]:g} m each way; move the walls"
            )
        robot_low, robot_high = robot_box()
        if np.any(low[:2] > robot_low[:2]) or np.any(high[:2] < robot_high[:2]):
            (x_low, y_low), (x_high, y_high) = robot_low[:2], robot_high[:2]
            raise RoomError(
                f"{text}: the robot, x {x_low:.2f} to {x_high:.2f} m and y {y_low:.2f} to {y_high:.2f} m, must stand "
                "between the walls; the box counts from the robot, so x_low and y_low are below 0"
            )
        if box[4] < MIRROR_TOP_M + self.stroke_m:
            raise RoomError(
                f"{text}: the ceiling is lower than the mirror, which rises to {MIRROR_TOP_M + self.stroke_m:.2f} m "
                f"with a stroke of {self.stroke_m:g} m; take a shorter stroke or check the height"
            )
        point = np.array(self.point_m)
        if np.any(point < low + CLEAR_M) or np.any(point > high - CLEAR_M):
            inside = zip("xyz", low + CLEAR_M, high - CLEAR_M, strict=True)
            clear = ", ".join(f"{axis} {least:g} to {most:g} m" for axis, least, most in inside)
            raise RoomError(
                f"PanoramaSettings.point_m = {self.point_m}: the camera must be inside the box, {CLEAR_M:g} m or "
                f"more from its walls: {clear}; move it or the walls"
            )
