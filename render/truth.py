"""The truth layer: what every pixel centre's chief ray sees through the mirror, exact and unfiltered."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from phibench.render.angles import mirror_angles
from phibench.render.raycast import first_hit
from phibench.render.spot_truth import depth_m
from phibench.render.trace import trace_pixels
from phibench.scenes.frames import Array
from phibench.scenes.rig import View
from phibench.scenes.solids import Shape

TRUTH_PLANES = (
    "x_m",
    "y_m",
    "z_m",
    "depth_m",
    "path_m",
    "phi_ray_rad",
    "phi_normal_rad",
    "phi_incidence_rad",
    "azimuth_rad",
    "object_id",
)


def truth_layer(view: View, shapes: Sequence[Shape]) -> dict[str, Array]:
    """Trace every pixel centre through the mirror.

    Returns
    -------
    planes : dict of arrays, shape (height, width), float64
        Keys are `TRUTH_PLANES`: world point hit, D, path lens centre -> mirror -> point, the three phi, azimuth and
        object id. NaN (object id -1) where the ray misses the mirror or hits nothing.
    """
    camera = view.rig.camera
    planes = {name: np.full((camera.height_px, camera.width_px), np.nan) for name in TRUTH_PLANES}
    planes["object_id"][:] = -1.0
    rows, columns = _disc_window(view)
    v, u = np.mgrid[rows, columns]
    uv = np.stack([u.ravel(), v.ravel()], axis=-1).astype(float)
    rays = trace_pixels(view, uv)
    hit = np.flatnonzero(np.isfinite(rays.cos_incidence))
    points, normals, directions = rays.points_m[hit], rays.normals[hit], rays.directions[hit]
    distance, object_id = first_hit(shapes, points, directions)
    seen = object_id >= 0
    hit, world = hit[seen], (points + distance[:, None] * directions)[seen]
    angles = mirror_angles(normals[seen], directions[seen])
    values = (
        *world.T,
        depth_m(world, view.rig.at(0.0).sphere_centre_m),
        rays.path_camera_mirror_m[hit] + distance[seen],
        angles.phi_ray_rad,
        angles.phi_normal_rad,
        angles.phi_incidence_rad,
        angles.azimuth_rad,
        object_id[seen],
    )
    for name, value in zip(TRUTH_PLANES, values, strict=True):
        planes[name][v.ravel()[hit], u.ravel()[hit]] = value
    return planes


def _disc_window(view: View) -> tuple[slice, slice]:
    """Rows and columns of the image that can see the mirror: the bounding box of its outline, one pixel wider."""
    outline = view.rig.outline_px()
    if not np.isfinite(outline).all():  # part of the outline is outside the lens model: look everywhere
        return slice(0, view.rig.camera.height_px), slice(0, view.rig.camera.width_px)
    low = np.maximum(np.floor(outline.min(axis=0)).astype(int) - 1, 0)
    high = np.ceil(outline.max(axis=0)).astype(int) + 2
    return slice(low[1], min(high[1], view.rig.camera.height_px)), slice(low[0], min(high[0], view.rig.camera.width_px))
