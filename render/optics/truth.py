"""Exact truth of one spot and every pixel: chief ray over the mirror, the three phi, distance D; the spot's visibility.

`spot_truth` solves for the chief ray of a spot in closed form, or by Fermat's path. `truth_layer` traces the chief ray
of every pixel centre: exact and unfiltered. Both give the three angles that the paper calls phi, and the azimuth
(docs/paper.md). All angles are measured against the world's vertical, in radians; points are world coordinates in
metres. NaN marks what does not exist. All is float64.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from phibench.render.optics.faces import IntArray
from phibench.render.optics.ray_tracer import trace_pixels
from phibench.render.optics.reflection_point import MirrorPoints, OnwardWays, mirror_points, onward_ways
from phibench.render.optics.room_tracer import (
    Finder,
    GeometryLike,
    RaysIntoRoom,
    RoomGeometry,
    as_geometry,
    blocked_by,
    rays_into_room,
)
from phibench.scenes.form_error import limb_points
from phibench.scenes.frames import Array, BoolArray, cross
from phibench.scenes.laser import LaserSpot
from phibench.scenes.rig import View


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
    x, y, z = np.moveaxis(v, -1, 0)
    return np.arctan2(np.sqrt(x * x + y * y), -z)


def _between(a: Array, b: Array) -> Array:
    """Angle between unit vectors, accurate for small and large angles (Kahan)."""
    apart, together = (np.moveaxis(v, -1, 0) for v in (a - b, a + b))
    return 2.0 * np.arctan2(*(np.sqrt(x * x + y * y + z * z) for x, y, z in (apart, together)))


VISIBLE, NO_REFLECTION, EDGE, FACES_AWAY, OUTSIDE = (
    "none",
    "no_reflection",
    "mirror_edge",
    "faces_away",
    "outside_image",
)
OCCLUDED = "occluded:"  # followed by the name of the object in the way
_CORNERS = 720
EDGE_PX = 1.0  # nearer to the outline part of the aperture sees no reflection, and the blur goes past the mirror


@dataclass(frozen=True)
class SpotTruth:
    """Chief ray of a spot. All numbers are NaN where no reflection point exists.

    Attributes
    ----------
    u_px, v_px : float
        Image of the spot centre through the lens centre.
    phi_ray_rad, phi_normal_rad, phi_incidence_rad, azimuth_rad : float
        See `MirrorAngles`.
    reflection_point_world_m, camera_centre_world_m, sphere_centre_world_m : 3 floats
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


def spot_truth(view: View, spot: LaserSpot, room: GeometryLike) -> SpotTruth:
    """Trace the chief ray of a spot: position, angles, lengths, and why it is not seen where it is not."""
    point, eye, centre = np.array([spot.position_world_m]), view.camera_centre_m[None], view.sphere_centre_m
    found = mirror_points(view, point, eye)
    mirror = found.points_m
    leaving = found.apparent_m - mirror
    way = onward_ways(view, found, point)
    uv = view.rig.camera.project(view.T_world_camera.inverse().points(mirror))[0]
    angles = mirror_angles(found.normals, leaving / np.linalg.norm(leaving, axis=-1)[:, None])
    cause = _cause(view, spot, room, found, way, uv)
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
        path_spot_mirror_m=math.fsum(np.linalg.norm(end - start, axis=-1)[0] for start, end in way.legs),
        path_mirror_camera_m=float(np.linalg.norm(mirror - eye)),
        visible=cause == VISIBLE,
        cause=cause,
    )


def depth_m(point_world_m: Array, sphere_centre_down_m: Array) -> Array:
    """D: horizontal distance of points, shape (..., 3), from the vertical line through the sphere centre when down."""
    offset = np.asarray(point_world_m, float)[..., :2] - sphere_centre_down_m[:2]
    x, y = offset[..., 0], offset[..., 1]
    return np.sqrt(x * x + y * y)


def _cause(view: View, spot: LaserSpot, room: GeometryLike, found: MirrorPoints, way: OnwardWays, uv: Array) -> str:
    mirror, eye = found.points_m, view.camera_centre_m[None]
    if not np.isfinite(mirror).all():
        return NO_REFLECTION
    if _outline_distance_px(view, mirror[0]) < EDGE_PX:
        return EDGE
    if np.dot(-way.directions[0], spot.normal_world) <= 0.0:
        return FACES_AWAY
    if not view.rig.camera.contains(uv):
        return OUTSIDE
    geometry = as_geometry(room)
    for start, end in (*way.legs, (eye, mirror)):
        blocker = int(blocked_by(geometry, start, end)[0])
        if blocker >= 0:
            return OCCLUDED + geometry.shapes[blocker].name
    if not found.lit[0]:  # so steep that no ray through the glass leads there: an end of the tube is in the way
        assert view.rig.holder is not None
        return OCCLUDED + view.rig.holder.part_names[int(way.directions[0] @ view.T_world_camera.R[:, 2] > 0.0)]
    return VISIBLE


def _outline_distance_px(view: View, mirror: Array) -> float:
    """Distance of a mirror point's image from the mirror's outline, across it, pixels (angle times focal length)."""
    if view.rig.mirror.radius_m is None:
        return _polygon_distance_px(view, mirror)
    to_mirror, to_centre = mirror - view.camera_centre_m, view.sphere_centre_m - view.camera_centre_m
    across, along = np.linalg.norm(cross(to_mirror, to_centre)), np.dot(to_mirror, to_centre)
    outline = _outline_angle(view, to_mirror, to_centre)
    return float((outline - np.arctan2(across, along)) * view.rig.camera.fx_px)


def _polygon_distance_px(view: View, mirror: Array) -> float:
    """Distance of a mirror point's image from the polygon of the outline, whose sides sag by 0.003 px."""
    uv = view.rig.camera.project(view.T_world_camera.inverse().points(mirror[None]))[0]
    corners = view.rig.outline_px(_CORNERS)
    side = np.roll(corners, -1, axis=0) - corners
    share = np.clip(np.sum((uv - corners) * side, axis=1) / np.sum(side * side, axis=1), 0.0, 1.0)
    return float(np.linalg.norm(uv - corners - share[:, None] * side, axis=1).min())


def _outline_angle(view: View, to_mirror: Array, to_centre: Array) -> float:
    """Angle, seen from the lens, between the sphere centre and the outline on the mirror point's side."""
    distance, mirror = np.linalg.norm(to_centre), view.rig.sphere
    if mirror.form is None:
        return float(np.arcsin(mirror.radius_m / distance))
    axes, axis = view.T_world_sphere.R, to_centre / distance
    across = to_mirror - np.dot(to_mirror, axis) * axis
    if np.linalg.norm(across) < 1e-12:  # on the axis: any side will do
        across = cross(axis, axes[:, np.argmin(np.abs(axis @ axes))])
    across = across / np.linalg.norm(across)
    limb = limb_points(-to_centre @ axes, (across @ axes)[None], mirror.radius_m, mirror.form)[0] @ axes.T + to_centre
    return float(np.arctan2(np.linalg.norm(cross(axis, limb)), np.dot(axis, limb)))


def _floats(values: Array) -> tuple[float, ...]:
    return tuple(float(x) for x in values)


ANGLES = ("phi_ray_rad", "phi_normal_rad", "phi_incidence_rad", "azimuth_rad")
TRUTH_PLANES = ("x_m", "y_m", "z_m", "depth_m", "path_m", *ANGLES, "object_id")


def truth_layer(
    view: View, room: GeometryLike, finder: Finder | None = None, names: Sequence[str] = TRUTH_PLANES
) -> dict[str, Array]:
    """Trace every pixel centre through the mirror.

    Parameters
    ----------
    room : RoomGeometry or sequence of shapes
    finder : callable (origins, directions) -> faces, or None
        Guesses the face of each ray: index in the geometry's `table`, -1 for none. `RoomGeometry.resolve` checks the
        guesses; without a finder all rays are traced.
    names : those of `TRUTH_PLANES` that are wanted

    Returns
    -------
    planes : dict of arrays, shape (height, width), float64
        By `names`: world point hit, D, path lens centre -> mirror -> point, the three phi, azimuth and
        object id. NaN (object id -1) where the ray misses the mirror or hits nothing.
    """
    camera, geometry = view.rig.camera, as_geometry(room)
    size = camera.height_px, camera.width_px
    planes = {name: np.full(size, -1.0 if name == "object_id" else np.nan) for name in names}
    blocks = [_traced_rows(view, geometry, rows, columns) for rows, columns in _disc_blocks(view)]
    guesses: list[IntArray | None] = [None] * len(blocks)
    if finder is not None:
        ends = np.cumsum([len(block.pixel) for block in blocks])[:-1]
        points, directions = (np.concatenate([getattr(b.way, name) for b in blocks]) for name in _RAY)
        guesses = list(np.split(finder(points, directions), ends))
    for block, guess in zip(blocks, guesses, strict=True):
        _fill(planes, view, geometry, block, guess)
    return planes


def angle_planes(view: View, seen: BoolArray) -> dict[str, Array]:
    """The planes of `truth_layer` that rig and pixel determine, whatever the room; NaN where nothing is seen.

    Parameters
    ----------
    seen : bool array, shape (height, width)
        Pixels whose ray meets the mirror and something beyond.
    """
    planes = {name: np.full(seen.shape, np.nan) for name in ANGLES}
    pixel = np.flatnonzero(seen)
    for part in np.array_split(pixel, len(pixel) // _PIXELS + 1):
        v, u = np.divmod(part, seen.shape[1])
        rays = trace_pixels(view, np.stack([u, v]).T.astype(float))
        angles = mirror_angles(rays.normals, rays.directions)
        for name, plane in planes.items():
            plane.reshape(-1)[part] = getattr(angles, name)
    return planes


_PIXELS = 1 << 14  # at a time: the work arrays stay in the cache
_RAY = ("starts_m", "directions")
_ROWS = 24  # of the image at a time: the work arrays stay in the cache


@dataclass(frozen=True)
class _Block:
    """Chief rays of N pixels after the mirror; `pixel` counts along the rows of the image.

    `directions` leave the mirror. `way` goes on into the room, and `path_m` is that from the lens to where it starts.
    """

    pixel: IntArray
    normals: Array
    directions: Array
    way: RaysIntoRoom
    path_m: Array


def _disc_blocks(view: View) -> Iterator[tuple[range, range]]:
    rows, columns = disc_window(view)
    for first in range(rows.start, rows.stop, _ROWS):
        yield range(first, min(first + _ROWS, rows.stop)), range(columns.start, columns.stop)


def _traced_rows(view: View, room: RoomGeometry, rows: range, columns: range) -> _Block:
    v, u = np.repeat(np.array(rows), len(columns)), np.tile(np.array(columns), len(rows))
    rays = trace_pixels(view, np.stack([u, v]).T.astype(float))
    hit = np.flatnonzero(np.isfinite(rays.cos_incidence))
    points, normals, directions = (np.take(a.T, hit, axis=1).T for a in (rays.points_m, rays.normals, rays.directions))
    pixel = (v * view.rig.camera.width_px + u)[hit]
    way = rays_into_room(view, room, points, directions)
    return _Block(pixel, normals, directions, way, rays.path_camera_mirror_m[hit] + way.path_m)


def _fill(planes: dict[str, Array], view: View, room: RoomGeometry, block: _Block, guess: IntArray | None) -> None:
    points, directions = block.way.starts_m, block.way.directions
    found = room.first_hit(points, directions) if guess is None else room.resolve(points, directions, guess)
    seen = found.object_id >= 0
    distance = np.where(seen, found.distance_m, np.nan)
    world = points.T + distance * directions.T
    values: dict[str, Array] = dict(zip(("x_m", "y_m", "z_m"), world, strict=True))
    values["depth_m"] = depth_m(world.T, view.rig.at(0.0).sphere_centre_m)
    values["path_m"], values["object_id"] = block.path_m + distance, found.object_id.astype(float)
    if not values.keys() >= planes.keys():
        angles = mirror_angles(block.normals, block.directions)
        values |= {name: np.where(seen, getattr(angles, name), np.nan) for name in ANGLES}
    for name, plane in planes.items():
        plane.reshape(-1)[block.pixel] = values[name]


def disc_window(view: View) -> tuple[slice, slice]:
    """Rows and columns of the image that can see the mirror: the bounding box of its outline, one pixel wider."""
    outline = view.rig.outline_px()
    if not np.isfinite(outline).all():  # part of the outline is outside the lens model: look everywhere
        return slice(0, view.rig.camera.height_px), slice(0, view.rig.camera.width_px)
    low = np.maximum(np.floor(outline.min(axis=0)).astype(int) - 1, 0)
    high = np.ceil(outline.max(axis=0)).astype(int) + 2
    return slice(low[1], min(high[1], view.rig.camera.height_px)), slice(low[0], min(high[0], view.rig.camera.width_px))
