"""Truth of pixels in rooms of all kinds, against a loop-free search of all triangles and a camera by OpenCV.

No code is shared but the table of faces: pixels are undistorted by OpenCV, meet the sphere by the quadratic formula,
and every reflected ray is tried with every triangle by determinants.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from helpers.oracles import undistort_cv2
from helpers.proof_rooms import MESHES, generated, of_mesh, of_panorama
from helpers.snell import through

from phibench.render.optics.faces import FaceTable
from phibench.render.optics.room_tracer import room_geometry
from phibench.render.optics.truth import truth_layer
from phibench.render.room.ambient_layer import view_surfaces
from phibench.scenes.frames import Pose, rotation_xyz
from phibench.scenes.glass_tube import GlassTube
from phibench.scenes.holder import Holder, fitted_holder
from phibench.scenes.rig import Rig, View
from phibench.scenes.room import Room, default_rig

PIXELS = 400
GUESS_M = 1e-5
"""Truth takes the face that the renderer guesses in float32, if the exact ray meets it so far inside its border."""
TOLERANCE_M = 1e-9
"""Rounding of 1e-16 x 30 m in coordinates, times 1e4 where the sphere's rim and flat incidence magnify it."""
ANGLE_RAD = 1e-7
"""Angles by arccos: the square root of rounding near 0 and pi."""


def rig(number: int, holder: Holder | None = None) -> Rig:
    """An eighth of the size, distorted, tilted and off axis, another one for each room."""
    rng, nominal = np.random.default_rng(number), default_rig()
    camera = replace(
        nominal.camera,
        width_px=160,
        height_px=90,
        fx_px=178.75,
        fy_px=178.75,
        cx_px=79.5 + rng.uniform(-2.0, 2.0),
        cy_px=44.5,
        k1=-0.02 * rng.random(),
        p1=1e-3 * rng.random(),
    )
    tilt = rotation_xyz(*rng.uniform(-0.02, 0.02, 3))
    pose = Pose("world", "camera", (*rng.uniform(-5e-3, 5e-3, 2), nominal.T_world_camera.t[2]), tilt)
    return replace(nominal, camera=camera, T_world_camera=pose, holder=holder)


@dataclass(frozen=True)
class Found:
    """What brute force finds for N pixels; NaN and -1 where the mirror or the room is not met."""

    point_m: np.ndarray
    shape: np.ndarray
    depth_m: np.ndarray
    path_m: np.ndarray
    phi_ray_rad: np.ndarray
    phi_normal_rad: np.ndarray
    near: list[set[int]]
    """Shapes that the ray meets, or passes within `GUESS_M`, of each pixel."""


def by_brute_force(view: View, table: FaceTable, uv: np.ndarray) -> Found:
    """Chief rays of pixels (N, 2) by other mathematics than `truth_layer`'s."""
    pose, centre, radius = view.T_world_camera, view.sphere_centre_m, view.rig.sphere.radius_m
    xy = undistort_cv2(view.rig.camera, uv)
    d = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
    d = (d / np.linalg.norm(d, axis=1, keepdims=True)) @ pose.R.T
    to_eye = pose.t - centre
    b, c = d @ to_eye, to_eye @ to_eye - radius**2
    root = b * b - c
    with np.errstate(invalid="ignore"):
        t = -b - np.sqrt(root)
    mirror = pose.t + t[:, None] * d
    normal = (mirror - centre) / radius
    out = d - 2.0 * np.sum(d * normal, axis=1, keepdims=True) * normal
    start, way, before = mirror, out, t
    if view.tube is not None:
        start, way, before = _behind_glass(view.tube, table, mirror, out, t)
    distance, shape, near = _first(table, start, way)
    point = start + distance[:, None] * way
    down = view.rig.at(0.0).sphere_centre_m
    phi = [np.arccos(np.clip(-a[:, 2], -1.0, 1.0)) for a in (out, normal)]
    met = shape >= 0
    phi_ray, phi_normal = (np.where(met, p, np.nan) for p in (0.5 * phi[0], phi[1]))
    return Found(point, shape, np.hypot(*(point - down)[:, :2].T), before + distance, phi_ray, phi_normal, near)


def _behind_glass(
    tube: GlassTube, table: FaceTable, mirror: np.ndarray, out: np.ndarray, path: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rays on their way into the room, and paths up to there: Snell's law, unless a shape comes before the glass."""
    inner, outer, onward = through(tube, mirror, out)
    low, high = (tube.origin_m + z * tube.axis for z in (tube.low_m, tube.high_m))
    to_glass, in_glass = (np.linalg.norm(b - a, axis=1) for a, b in ((mirror, inner), (inner, outer)))
    first, _, _ = _first(table, mirror, out)
    between = [((place - low) @ tube.axis > 0.0) & ((place - high) @ tube.axis < 0.0) for place in (inner, outer)]
    enters = between[0] & ~(first < to_glass)
    leaves = enters & between[1]
    start = np.where(leaves[:, None], outer, np.where(enters[:, None], inner, mirror))
    way = np.where(leaves[:, None], onward, np.where(enters[:, None], (outer - inner) / in_glass[:, None], out))
    return start, way, path + np.where(enters, to_glass, 0.0) + np.where(leaves, in_glass, 0.0)


def _first(table: FaceTable, o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray, list[set[int]]]:
    """Distance and shape of the first triangle along each ray, and shapes whose triangles it meets or nearly meets."""
    a, b, c = np.moveaxis(table.corners_m, 1, 0)
    e1, e2 = b - a, c - a
    n = np.cross(e1, e2)
    area = np.linalg.norm(n, axis=1)
    # heights of the triangle over its three edges: what a barycentric coordinate of 1 is in metres
    sides = np.stack([np.linalg.norm(c - b, axis=1), np.linalg.norm(e2, axis=1), np.linalg.norm(e1, axis=1)])
    shapes = table.shape[table.patch]
    distance, shape, near = np.full(len(d), np.nan), np.full(len(d), -1), []
    for i in range(len(d)):
        with np.errstate(divide="ignore", invalid="ignore"):
            s, along = o[i] - a, -(n @ d[i])
            across = np.cross(s, d[i])
            t = np.einsum("ti,ti->t", s, n) / along
            v, w = np.einsum("ti,ti->t", e2, across) / along, -np.einsum("ti,ti->t", e1, across) / along
            inside_m = np.min(np.stack([1.0 - v - w, v, w]) * area / sides, axis=0)
            ahead = (t > 0.0) & np.isfinite(t)
            hit = np.flatnonzero(ahead & (inside_m >= 0.0))
            close = np.flatnonzero(ahead & (inside_m >= -GUESS_M))
        near.append(set(shapes[close].tolist()))
        if len(hit):
            k = hit[np.argmin(t[hit])]
            distance[i], shape[i] = t[k], shapes[k]
    return distance, shape, near


def check(room: Room, number: int, holder: Holder | None = None) -> None:
    """Point, surface, D and phi of random pixels of both views.

    Where a ray passes within 1e-5 m of another shape's border, that shape may be named: there are about 30 m of
    outlines in a square metre's view at most, 6e-4 of the pixels. Three of 800 by chance: 2e-2; six: 1e-5.
    """
    rng, other, checked = np.random.default_rng(number), 0, 0
    errors, angles, names = list[float](), list[float](), set[str]()
    for offset_m in (0.0, 0.37):
        view = rig(number, holder).at(offset_m)
        geometry = room_geometry(room, view)
        planes = truth_layer(view, geometry, view_surfaces(view, room).first_patch)
        on_mirror = np.argwhere(np.isfinite(planes["depth_m"]))
        v, u = on_mirror[rng.choice(len(on_mirror), PIXELS, replace=False)].T
        found = by_brute_force(view, geometry.table, np.stack([u, v], axis=-1).astype(float))
        truth = {name: plane[v, u] for name, plane in planes.items()}
        same = truth["object_id"] == found.shape
        for i in np.flatnonzero(~same):
            assert int(truth["object_id"][i]) in found.near[i], (room.name, u[i], v[i])
        other += np.count_nonzero(~same)
        point = np.stack([truth[name] for name in ("x_m", "y_m", "z_m")], axis=-1)
        errors.append(np.abs(point - found.point_m)[same].max())
        errors += [np.abs(truth[name] - getattr(found, name))[same].max() for name in ("depth_m", "path_m")]
        for name in ("phi_ray_rad", "phi_normal_rad"):
            angles.append(np.abs(truth[name] - getattr(found, name))[same].max())
        names |= {geometry.shapes[k].name for k in found.shape[same]}
        checked += np.count_nonzero(same)
    print(
        f"{room.name}: {checked} pixels, {len(names)} shapes, {max(errors):.1e} m, {max(angles):.1e} rad, {other} other"
    )
    assert max(errors) < TOLERANCE_M
    assert max(angles) < ANGLE_RAD
    assert other <= 6
    assert checked >= 2 * PIXELS - 6
    assert len(names) >= 6


def of_each(quick: int, slow: int, count: int) -> list[object]:
    """Numbers of a parametrised test: some quick, some slow, the rest for `make test-all`."""
    marks = [()] * quick + [pytest.mark.slow] * (slow - quick) + [pytest.mark.study] * (count - slow)
    return [pytest.param(number, marks=mark) for number, mark in enumerate(marks)]


@pytest.mark.parametrize("number", of_each(2, 7, 15))
def test_accuracy_of_truth_in_generated_rooms(number: int) -> None:
    check(generated(number), number)


@pytest.mark.parametrize("number", of_each(1, 3, 5))
def test_accuracy_of_truth_through_a_glass_tube(number: int) -> None:
    """Walls of 3 to 15 mm around the mirror; plates, camera and robot inside and outside of it."""
    holder = fitted_holder("tube", 0.060, wall_m=0.003 * (number + 1), glass_index=1.4 + 0.1 * number, rise_m=0.063)
    check(generated(number), number, holder)


@pytest.mark.parametrize("kind", MESHES)
def test_accuracy_of_truth_in_mesh_rooms(kind: str, tmp_path: Path) -> None:
    check(of_mesh(kind, tmp_path), 20 + MESHES.index(kind))


@pytest.mark.parametrize("kind", ["box", "flat box"])
def test_accuracy_of_truth_in_panorama_rooms(kind: str, tmp_path: Path) -> None:
    check(of_panorama(kind, tmp_path), 30 + len(kind))


def test_the_search_sees_a_shifted_wall(tmp_path: Path) -> None:
    """One wall of a box 0.1 micrometres further out, and truth is no longer what brute force finds."""
    room = of_panorama("box", tmp_path)
    wall = room.surfaces[3]
    moved = replace(wall, T_world_shape=replace(wall.T_world_shape, translation_m=(2.5 + 1e-7, 0.2, 1.35)))
    view = rig(1).at(0.0)
    right, wrong = (
        room_geometry(replace(room, surfaces=(*room.surfaces[:3], one, *room.surfaces[4:])), view)
        for one in (wall, moved)
    )
    planes = truth_layer(view, right)
    v, u = np.argwhere(planes["object_id"] == 3.0)[::50].T
    found = by_brute_force(view, wrong.table, np.stack([u, v], axis=-1).astype(float))
    assert np.abs(planes["depth_m"][v, u] - found.depth_m).max() > 10.0 * TOLERANCE_M
