"""Panorama of a room: the radiance that arrives at a point from every direction, as an equirectangular picture.

Row i of H has the elevation 90 - (i + 1/2) 180 / H degrees, column j of 2 H the azimuth heading + 180 - (j + 1/2)
180 / H degrees, from world x to y: the form that `datasets/rooms/panorama_room` reads.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from phibench.render.optics.faces import TexelGrid, face_table
from phibench.render.room.camera_plugin import MM_PER_M
from phibench.render.room.light_map import BakeSettings, LightMap, fixed_shapes
from phibench.render.room.surfaces import Surfaces, aligned
from phibench.render.setup.variant import activate
from phibench.scenes.frames import Vector
from phibench.scenes.rig import View
from phibench.scenes.room import Room

_SIDE = 4  # directions along a pixel's side: edges are as smooth as a sixteenth of a pixel
_AT_ONCE = 1 << 22  # rays


def rendered_panorama(
    view: View, room: Room, light: LightMap, settings: BakeSettings, point_m: Vector, heading_deg: float, rows: int
) -> tuple[NDArray[np.float32], float]:
    """Radiance, shape (rows, 2 rows, 3), W/(m^2 sr), and the part of all directions in which there is a surface.

    Parameters
    ----------
    view : View
        The origin of the scene's coordinates is taken from it, as for `bake`.
    light, settings
        Of `bake` for this room.
    point_m : 3 floats
        World frame; not inside a solid.
    heading_deg : float
        Azimuth of the picture's middle column.
    """
    surfaces = Surfaces(activate(), view, face_table(fixed_shapes(room)))
    surfaces.set_light(TexelGrid.of(surfaces.table, settings.texel_m), light.irradiance_w_m2)
    at_once = max(1, _AT_ONCE // (2 * rows * _SIDE**2))
    bands = [
        _band(surfaces, point_m, heading_deg, rows, first, min(first + at_once, rows))
        for first in range(0, rows, at_once)
    ]
    return np.concatenate([radiance for radiance, _ in bands]), sum(met for _, met in bands) / (2 * rows * rows)


def _band(
    surfaces: Surfaces, point_m: Vector, heading_deg: float, rows: int, first: int, end: int
) -> tuple[NDArray[np.float32], float]:
    """Rows from `first` to before `end`, and how many pixels of them see a surface."""
    import drjit as dr

    mi = activate()
    step = math.pi / rows / _SIDE
    elevation = 0.5 * math.pi - (np.arange(first * _SIDE, end * _SIDE) + 0.5) * step
    azimuth = math.radians(heading_deg) + math.pi - (np.arange(2 * rows * _SIDE) + 0.5) * step
    z, flat = np.sin(elevation)[:, None], np.cos(elevation)[:, None]
    parts = np.broadcast_arrays(flat * np.cos(azimuth), flat * np.sin(azimuth), z)
    place = MM_PER_M * (np.array(point_m) - surfaces.view.sphere_centre_m)
    direction = mi.Vector3f(*(mi.Float(aligned(part)) for part in parts))
    ray = mi.Ray3f(mi.Point3f(*map(float, place)), direction)
    t, patch, valid = surfaces.hit(ray)
    value = dr.select(valid, surfaces.radiance(patch, ray(t), direction, valid, lamps=True), 0.0)
    dr.eval(value, valid)  # together: each would trace the rays anew
    planes = np.stack([np.array(value[k]) for k in range(3)], axis=-1)
    picture = planes.reshape(end - first, _SIDE, 2 * rows, _SIDE, 3).mean(axis=(1, 3))
    return picture.astype(np.float32), float(np.count_nonzero(np.array(valid))) / _SIDE**2
