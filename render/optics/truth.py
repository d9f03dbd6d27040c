"""Exact truth in float64: the chief ray of one spot, and of every pixel centre, through the mirror.

`spot_truth` solves for the chief ray of a spot in closed form, or by Fermat's path. `truth_layer` traces the chief ray
of every pixel centre: exact and unfiltered. Both give the three angles that the paper calls phi, and the azimuth
(docs/paper.md). All angles are measured against the world's vertical, in radians; points are world coordinates in
metres. NaN marks what does not exist.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from phibench.render.optics.ray_tracer import blocked_by, first_hit, trace_pixels
from phibench.render.optics.reflection_point import mirror_points
from phibench.scenes.frames import Array
from phibench.scenes.laser import LaserSpot
from phibench.scenes.rig import View, limb_points
from phibench.scenes.shapes import Shape


@dataclass(frozen=True)
class MirrorAngles:
    """Angles in radians, arrays of shape (N,).

    Attributes
    ----------
    phi_ray_rad
        theta / 2, theta the angle between the ray that leaves the mirror and the downward vertical.
    phi_normal_rad
        Polar angle of the outward mirror normal from the downward vertical.
    phi_incidence_rad
        Angle of incidence.
    azimuth_rad
        Of the mirror normal's horizontal part, from world x towards world y.
    """

    phi_ray_rad: Array
    phi_normal_rad: Array
    phi_incidence_rad: Array
    azimuth_rad: Array


def mirror_angles(normals: Array, directions: Array) -> MirrorAngles:
    """Angles of unit outward normals and unit leaving directions, both of shape (N, 3), world frame."""
    return MirrorAngles(
        phi_ray_rad=0.5 * _from_downward(directions),
        phi_normal_rad=_from_downward(normals),
        phi_incidence_rad=_between(normals, directions),
        azimuth_rad=np.arctan2(normals[..., 1], normals[..., 0]),
    )


def _from_downward(v: Array) -> Array:
    return np.arctan2(np.hypot(v[..., 0], v[..., 1]), -v[..., 2])


def _between(a: Array, b: Array) -> Array:
    """Angle between unit vectors, accurate for small and large angles (Kahan)."""
    return 2.0 * np.arctan2(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1))


VISIBLE, NO_REFLECTION, EDGE, FACES_AWAY, OUTSIDE = (
    "none",
    "no_reflection",
    "mirror_edge",
    "faces_away",
    "outside_image",
)
OCCLUDED = "occluded:"  # followed by the name of the object in the way
EDGE_PX = 1.0  # nearer to the outline part of the aperture sees no reflection, and the blur goes past the mirror


@dataclass(frozen=True)
class SpotTruth:
    """Chief ray of a spot. All numbers are NaN where no reflection point exists.

    Attributes
    ----------
    u_px, v_px : float
        Image of the spot centre through the lens centre.
    phi_ray_rad, phi_normal_rad, phi_incidence_rad, azimuth_rad : float
        See `angles`.
    reflection_point_world_m, camera_centre_world_m, sphere_centre_world_m : 3 floats
    path_spot_mirror_m, path_mirror_camera_m : float
    visible : bool
    cause : str
        "none", "no_reflection", "mirror_edge", "faces_away", "outside_image" or "occluded:<object>".
    """

    u_px: float
    v_px: float
    phi_ray_rad: float
    phi_normal_rad: float
    phi_incidence_rad: float
    azimuth_rad: float
    reflection_point_world_m: tuple[float, ...]
    camera_centre_world_m: tuple[float, ...]
    sphere_centre_world_m: tuple[float, ...]
    path_spot_mirror_m: float
    path_mirror_camera_m: float
    visible: bool
    cause: str


def spot_truth(view: View, spot: LaserSpot, shapes: Sequence[Shape]) -> SpotTruth:
    """Trace the chief ray of a spot: position, angles, lengths, and why it is not seen where it is not."""
    point, eye, centre = np.array([spot.position_world_m]), view.camera_centre_m[None], view.sphere_centre_m
    found = mirror_points(view, point, eye)
    mirror = found.points_m
    normals, leaving = found.normals, point - mirror
    path = np.linalg.norm(leaving, axis=-1)
    uv = view.rig.camera.project(view.T_world_camera.inverse().points(mirror))[0]
    angles = mirror_angles(normals, leaving / path[:, None])
    cause = _cause(view, spot, shapes, mirror, uv)
    return SpotTruth(
        u_px=float(uv[0]),
        v_px=float(uv[1]),
        phi_ray_rad=float(angles.phi_ray_rad[0]),
        phi_normal_rad=float(angles.phi_normal_rad[0]),
        phi_incidence_rad=float(angles.phi_incidence_rad[0]),
        azimuth_rad=float(angles.azimuth_rad[0]),
        reflection_point_world_m=_floats(mirror[0]),
        camera_centre_world_m=_floats(eye[0]),
        sphere_centre_world_m=_floats(centre),
        path_spot_mirror_m=float(path[0]),
        path_mirror_camera_m=float(np.linalg.norm(mirror - eye)),
        visible=cause == VISIBLE,
        cause=cause,
    )


def depth_m(point_world_m: Array, sphere_centre_down_m: Array) -> Array:
    """D: horizontal distance of points, shape (..., 3), from the vertical line through the sphere centre when down."""
    offset = np.asarray(point_world_m, float)[..., :2] - sphere_centre_down_m[:2]
    return np.hypot(offset[..., 0], offset[..., 1])


def _cause(view: View, spot: LaserSpot, shapes: Sequence[Shape], mirror: Array, uv: Array) -> str:
    point, eye = np.array([spot.position_world_m]), view.camera_centre_m[None]
    if not np.isfinite(mirror).all():
        return NO_REFLECTION
    if _outline_distance_px(view, mirror[0]) < EDGE_PX:
        return EDGE
    if np.dot(mirror[0] - point[0], spot.normal_world) <= 0.0:
        return FACES_AWAY
    if not view.rig.camera.contains(uv):
        return OUTSIDE
    for start, end in ((mirror, point), (eye, mirror)):
        blocker = int(blocked_by(shapes, start, end)[0])
        if blocker >= 0:
            return OCCLUDED + shapes[blocker].name
    return VISIBLE


def _outline_distance_px(view: View, mirror: Array) -> float:
    """Distance of a mirror point's image from the mirror's outline, across it, pixels (angle times focal length)."""
    to_mirror, to_centre = mirror - view.camera_centre_m, view.sphere_centre_m - view.camera_centre_m
    across, along = np.linalg.norm(np.cross(to_mirror, to_centre)), np.dot(to_mirror, to_centre)
    outline = _outline_angle(view, to_mirror, to_centre)
    return float((outline - np.arctan2(across, along)) * view.rig.camera.fx_px)


def _outline_angle(view: View, to_mirror: Array, to_centre: Array) -> float:
    """Angle, seen from the lens, between the sphere centre and the outline on the mirror point's side."""
    distance, mirror = np.linalg.norm(to_centre), view.rig.mirror
    if mirror.form is None:
        return float(np.arcsin(mirror.radius_m / distance))
    axes, axis = view.T_world_sphere.R, to_centre / distance
    across = to_mirror - np.dot(to_mirror, axis) * axis
    if np.linalg.norm(across) < 1e-12:  # on the axis: any side will do
        across = np.cross(axis, axes[:, np.argmin(np.abs(axis @ axes))])
    across = across / np.linalg.norm(across)
    limb = limb_points(-to_centre @ axes, (across @ axes)[None], mirror.radius_m, mirror.form)[0] @ axes.T + to_centre
    return float(np.arctan2(np.linalg.norm(np.cross(axis, limb)), np.dot(axis, limb)))


def _floats(values: Array) -> tuple[float, ...]:
    return tuple(float(x) for x in values)


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
