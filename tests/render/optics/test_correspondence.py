"""Counterparts of pixels against shortest paths in long double, and their causes against a loop over all triangles.

The path lens - mirror - point is minimised by differences of its own length: no reflection law, no derivative of a
surface, no reflection solver. With 1e-19 of rounding and steps of 1e-6 m a minimum is known to 1e-12 m, 1e-8 px.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from helpers.oracles import project_cv2, random_rig
from helpers.revolved_rigs import PROFILES, revolved
from helpers.triangles import by_determinants

from phibench.render.optics.correspondence import (
    BACK_SIDE,
    CAUSES,
    HOLDER,
    MIRROR_RIM,
    NOTHING,
    OCCLUDED,
    OUTSIDE,
    ROBOT,
    SEEN,
    Correspondence,
    correspondence,
)
from phibench.render.optics.truth import truth_layer
from phibench.scenes.frames import Pose
from phibench.scenes.holder import fitted_holder
from phibench.scenes.rig import Rig, View
from phibench.scenes.room import Room, default_rig, lab

STROKE_M = 0.42
TOLERANCE_PX = 1e-6
EDGE_PX = 1e-4
Surface = Callable[[np.ndarray], np.ndarray]


def misaligned_sphere() -> Rig:
    return random_rig(np.random.default_rng(41))


def hyperboloid() -> Rig:
    return revolved("hyperboloid", aligned=False)


RIGS = {"sphere misaligned": misaligned_sphere, "hyperboloid": hyperboloid}


@dataclass(frozen=True)
class Mirror:
    """Mirror as a smooth map of two lengths (N, 2) to places (N, 3), in long double, in axes of its own."""

    axes: np.ndarray
    origin_m: np.ndarray
    place: Surface
    rim_m: float


def mirror_of(view: View) -> Mirror:
    """Sphere by arc lengths from its pole below, or hyperboloid by x and y; z runs away from the lens."""
    pose = view.T_world_sphere
    if view.rig.mirror.radius_m is not None:
        radius = np.longdouble(view.rig.mirror.radius_m)
        axis = pose.t - view.T_world_camera.t
        axis = axis / np.linalg.norm(axis)
        side = np.linalg.svd(axis[None])[2][1]

        def on_sphere(ab: np.ndarray) -> np.ndarray:
            arc = np.maximum(np.sqrt((ab**2).sum(axis=1)), np.longdouble(1e-300))[:, None]
            return radius * np.concatenate([np.sin(arc / radius) * ab / arc, -np.cos(arc / radius)], axis=1)

        return Mirror(np.column_stack([side, np.cross(axis, side), axis]), pose.t, on_sphere, float(radius))
    profile = PROFILES["hyperboloid"]
    R, K = np.longdouble(profile.vertex_radius_m), np.longdouble(profile.conic)

    def on_profile(xy: np.ndarray) -> np.ndarray:
        s = (xy**2).sum(axis=1)[:, None]
        return np.concatenate([xy, s / (R * (1 + np.sqrt(1 - (1 + K) * s / R**2)))], axis=1)

    return Mirror(pose.R, pose.t, on_profile, profile.rim_radius_m)


def shortest(view: View, points_world_m: np.ndarray) -> np.ndarray:
    """Mirror points, world, shape (N, 3), of the shortest paths between the lens and points; NaN where none is found.

    Newton's method on the mirror's surface, on differences of lengths; a step that makes the path longer is
    halved.
    """
    mirror = mirror_of(view)

    def inside(world: np.ndarray) -> np.ndarray:
        return (np.asarray(world - mirror.origin_m) @ mirror.axes).astype(np.longdouble)

    ends = inside(points_world_m), inside(view.T_world_camera.t[None])

    def length(xy: np.ndarray) -> np.ndarray:
        P = mirror.place(xy)
        return sum(np.sqrt(((end - P) ** 2).sum(axis=1)) for end in ends)

    flat = ends[0][:, :2]
    xy = 0.5 * mirror.rim_m * flat / np.sqrt((flat**2).sum(axis=1))[:, None]
    for delta in [1e-4] * 25 + [1e-5] * 4 + [1e-6] * 4:
        xy = _nearer(length, xy, np.longdouble(delta))
    return mirror.place(xy).astype(float) @ mirror.axes.T + mirror.origin_m


def _nearer(length: Callable[[np.ndarray], np.ndarray], xy: np.ndarray, delta: np.longdouble) -> np.ndarray:
    """One step towards the least length, by central differences over `delta`."""
    f = {(i, j): length(xy + delta * np.array([i, j])) for i in (-1, 0, 1) for j in (-1, 0, 1)}
    with np.errstate(divide="ignore"):
        g = np.stack([f[1, 0] - f[-1, 0], f[0, 1] - f[0, -1]], axis=1) / (2 * delta)
        xx, yy = f[1, 0] - 2 * f[0, 0] + f[-1, 0], f[0, 1] - 2 * f[0, 0] + f[0, -1]
        mixed = 0.25 * (f[1, 1] - f[1, -1] - f[-1, 1] + f[-1, -1])
        det = (xx * yy - mixed**2) / delta**2
        step = -np.stack([yy * g[:, 0] - mixed * g[:, 1], xx * g[:, 1] - mixed * g[:, 0]], axis=1) / det[:, None]
    slope = np.sqrt((g**2).sum(axis=1))[:, None]
    downhill = -np.longdouble(2e-3) * g / np.maximum(slope, np.longdouble(1e-30))
    convex = ((det > 0) & (xx > 0) & np.isfinite(step).all(axis=1))[:, None]
    step = np.where(convex, step, downhill)
    size = np.sqrt((step**2).sum(axis=1))[:, None]
    step = step * np.minimum(1, 2e-2 / np.maximum(size, np.longdouble(1e-30)))
    for _ in range(12):
        worse = length(xy + step) > f[0, 0]
        step = np.where(worse[:, None], step / 2, step)
    return xy + np.where(worse[:, None], 0, step)


def places_by_minimisation(view: View, points_world_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (N, 2) and mirror points."""
    P = shortest(view, points_world_m)
    return project_cv2(view.rig.camera, (P - view.T_world_camera.t) @ view.T_world_camera.R), P


def causes_by_triangles(room: Room, view: View, mirror_m: np.ndarray, points_m: np.ndarray) -> np.ndarray:
    """0 where the way mirror - point is free, else the id of its first shape and `OCCLUDED`."""
    way = points_m - mirror_m
    far = np.linalg.norm(way, axis=1)
    distance, shape, _ = by_determinants(room.shapes(view), mirror_m, way / far[:, None])
    return np.where(distance < far - 2e-7, OCCLUDED + shape, SEEN)


def check(kind: str, count: int, room: Room) -> None:
    """Places and causes of random pixels, both ways; see the module's docstring."""
    rig, rng, causes = RIGS[kind](), np.random.default_rng(7), set[int]()
    views = rig.at(0.0), rig.at(STROKE_M)
    for view, other in (views, views[::-1]):
        found = correspondence(room, view, other)
        pixels = np.argwhere((found.cause == SEEN) | (found.cause >= OCCLUDED))
        hidden = np.argwhere(found.cause >= OCCLUDED)
        pixels = np.concatenate([pixels[rng.choice(len(pixels), count)], hidden[rng.choice(len(hidden), count // 4)]])
        v, u = pixels.T
        points, cause = found.point_world_m[v, u], found.cause[v, u]
        place, mirror = places_by_minimisation(other, points)
        expected = causes_by_triangles(room, other, mirror, points)
        seen = cause == SEEN
        error = np.abs(found.uv_px[v, u] - place)[seen]
        print(f"{kind}: {seen.sum()} places, {error.max():.1e} px; {np.count_nonzero(cause != expected)} other causes")
        assert error.max() < TOLERANCE_PX
        assert seen.sum() > 0.7 * count
        for i in np.flatnonzero(cause != expected):
            assert cause[i] in near_by(room, view, other, pixels[i]), (u[i], v[i])
        causes |= set(cause.tolist())
    assert len(causes) > 5


def near_by(room: Room, view: View, other: View, pixel: np.ndarray) -> set[int]:
    """Causes by brute force of places 1e-4 px around a pixel: what the pixel's may be at an edge."""
    from phibench.render.optics.ray_tracer import trace_pixels

    around = [(i, j) for i in (-1.0, 0.0, 1.0) for j in (-1.0, 0.0, 1.0)]
    rays = trace_pixels(view, pixel[::-1] + EDGE_PX * np.array(around))
    distance, _, _ = by_determinants(room.shapes(view), rays.points_m, rays.directions)
    points = rays.points_m + distance[:, None] * rays.directions
    return set(causes_by_triangles(room, other, shortest(other, points), points).tolist())


@pytest.mark.parametrize("kind", RIGS)
def test_places_and_causes_by_shortest_paths(kind: str) -> None:
    check(kind, 400, lab(()))


@pytest.mark.slow
@pytest.mark.parametrize("kind", RIGS)
def test_accuracy_of_ten_thousand_places_by_shortest_paths(kind: str) -> None:
    check(kind, 10_000, lab(()))


def test_points_are_those_of_the_truth_layer_and_the_way_back_leads_home() -> None:
    """Points to rounding; a seen pixel's place, looked up from the other image, is within the pixel's own distance."""
    room, rig = lab(()), small(misaligned_sphere())
    down, up = rig.at(0.0), rig.at(STROKE_M)
    there, truth = correspondence(room, down, up), truth_layer(down, room.shapes(down))
    shown = truth["object_id"] >= 0
    assert np.array_equal(there.cause == NOTHING, ~shown)
    own = np.array([name.startswith(("robot", "camera")) for name in there.object_names])
    assert np.array_equal(there.cause == ROBOT, shown & own[truth["object_id"].astype(int)])
    for axis, name in enumerate(("x_m", "y_m", "z_m")):
        np.testing.assert_allclose(there.point_world_m[..., axis], truth[name], rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(there.depth_m, truth["depth_m"], rtol=0.0, atol=1e-9)
    v, u = np.argwhere(there.seen)[::7].T
    place, _ = places_by_minimisation(down, there.point_world_m[v, u])
    np.testing.assert_allclose(place, np.stack([u, v], axis=1), rtol=0.0, atol=TOLERANCE_PX)


def small(rig: Rig) -> Rig:
    """An eighth of the pixels' number along each side."""
    camera = rig.camera
    sides = {name: getattr(camera, name) / 8.0 for name in ("fx_px", "fy_px")}
    middle = {name: (getattr(camera, name) + 0.5) / 8.0 - 0.5 for name in ("cx_px", "cy_px")}
    return replace(rig, camera=replace(camera, width_px=160, height_px=90, **sides, **middle))


def at_both(rig: Rig) -> tuple[View, View]:
    return rig.at(0.0), rig.at(STROKE_M)


def test_every_cause_occurs_and_says_what_is_in_the_way() -> None:
    """A holder of rods, a mirror with a rim, and a mirror so near that its image is cut."""
    rig = small(default_rig())
    held = replace(rig, holder=fitted_holder("rods", 0.060))
    found = correspondence(lab(()), held.at(STROKE_M), held.at(0.0))
    counts = found.counts()
    assert {"none", "nothing", "robot", "holder", "back_side"} <= set(counts)
    assert {f"occluded:{name}" for name in held.holder.part_names} & set(counts)
    assert any(name.startswith("occluded:table") for name in counts)
    assert np.isnan(found.uv_px[~found.seen]).all()
    assert np.isfinite(found.uv_px[found.seen]).all()
    assert np.array_equal(found.of_room, ~np.isin(found.cause, (NOTHING, ROBOT, HOLDER)))
    assert np.isin(found.cause, (MIRROR_RIM, BACK_SIDE)).any()
    assert CAUSES[MIRROR_RIM] in correspondence(lab(()), *at_both(small(hyperboloid()))[::-1]).counts()
    near = replace(rig, T_camera_sphere=Pose("camera", "sphere", (0.0, 0.0, 0.15)))
    assert CAUSES[OUTSIDE] in correspondence(lab(()), *at_both(near)[::-1]).counts()


def test_a_mirror_in_glass_sees_the_same_points() -> None:
    """Through 3 mm of glass a seen pixel's place, traced back through the glass, meets the same room point."""
    from phibench.render.optics.ray_tracer import trace_pixels
    from phibench.render.optics.room_tracer import first_hit, rays_into_room, room_geometry

    rig = replace(small(default_rig()), holder=fitted_holder("tube", 0.060, wall_m=0.003, rise_m=0.063))
    down, up = rig.at(0.0), rig.at(STROKE_M)
    found: Correspondence = correspondence(lab(()), down, up)
    v, u = np.argwhere(found.seen)[::11].T
    rays, geometry = trace_pixels(up, found.uv_px[v, u]), room_geometry(lab(()), up)
    way = rays_into_room(up, geometry, rays.points_m, rays.directions)
    back = way.starts_m + first_hit(geometry, way.starts_m, way.directions).distance_m[:, None] * way.directions
    assert len(v) > 200
    # 1e-12 px of rounding in a place is 1e-11 m at 4 m; flat incidence magnifies it by some hundred
    np.testing.assert_allclose(back, found.point_world_m[v, u], rtol=0.0, atol=1e-8)


def test_a_shifted_mirror_is_noticed() -> None:
    """The oracle sees a mirror that is 1e-9 m off: 7e-6 px."""
    rig = misaligned_sphere()
    up = rig.at(STROKE_M)
    moved = replace(
        rig, T_camera_sphere=replace(rig.T_camera_sphere, translation_m=tuple(rig.T_camera_sphere.t + 1e-9))
    )
    points = np.array([[2.0, 1.0, 0.6], [-1.0, 2.0, 1.5]])
    right, wrong = (places_by_minimisation(view, points)[0] for view in (up, moved.at(STROKE_M)))
    assert np.abs(right - wrong).max() > TOLERANCE_PX


def test_glossy_surfaces_are_told() -> None:
    """The floor alone gets a coat."""
    room, rig = lab(()), small(default_rig())
    floor = replace(room.surfaces[0], coat=1.5)
    assert floor.name == "floor"
    found = correspondence(replace(room, surfaces=(floor, *room.surfaces[1:])), *at_both(rig))
    on_floor = np.abs(found.point_world_m[..., 2]) < 1e-9
    # where solids stand on the floor, a point of theirs may be at its height
    assert (found.glossy & ~on_floor).sum() == 0
    assert (on_floor & ~found.glossy).sum() < 0.01 * on_floor.sum()
    assert not correspondence(room, *at_both(rig)).glossy.any()
