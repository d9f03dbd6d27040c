"""Room tracer against a loop over all triangles by Moeller and Trumbore's determinants; edges, planes, insides."""

from __future__ import annotations

import pickle
import time
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from helpers.triangles import by_determinants

from phibench.render.optics.face_tree import Rays
from phibench.render.optics.faces import face_table
from phibench.render.optics.room_tracer import RoomGeometry, blocked_by, first_hit, room_geometry
from phibench.render.optics.truth import truth_layer
from phibench.scenes.frames import Pose, rotation_xyz
from phibench.scenes.room import Room, default_rig, lab
from phibench.scenes.shapes import Cuboid, Mesh, Prism, Shape, Uniform, rectangle

VIEW = default_rig().at(0.3)


def clutter(seed: int, count: int = 60) -> tuple[Shape, ...]:
    """Walls of the lab, and turned boxes, prisms and bumpy meshes in it, which may cut each other."""
    rng = np.random.default_rng(seed)
    shapes: list[Shape] = list(lab(()).surfaces)
    for i in range(count):
        pose = Pose("world", "shape", tuple(rng.uniform([-4, -4, 0.1], [4, 4, 2.5])), rotation_xyz(*rng.normal(size=3)))
        size = rng.uniform(0.05, 0.6, 3)
        if i % 3 == 0:
            shapes.append(Cuboid(f"box{i}", pose, tuple(size)))
        elif i % 3 == 1:
            shapes.append(Prism(f"prism{i}", pose, size[0], size[1], int(rng.integers(3, 25))))
        else:
            shapes.append(bumpy(f"mesh{i}", pose, rng, size[0]))
    return tuple(shapes)


def bumpy(name: str, pose: Pose, rng: np.random.Generator, size_m: float, side: int = 5) -> Mesh:
    """Sheet of 2 (side - 1)^2 triangles with bumps."""
    x, y = np.meshgrid(np.linspace(-size_m, size_m, side), np.linspace(-size_m, size_m, side))
    vertices = pose.points(np.stack([x, y, 0.2 * size_m * rng.normal(size=x.shape)], axis=-1).reshape(-1, 3))
    corner = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    halves = [[corner, corner + 1, corner + side + 1], [corner, corner + side + 1, corner + side]]
    return Mesh(name, vertices, np.concatenate([np.stack(half, axis=-1) for half in halves]), Uniform((0.5, 0.5, 0.5)))


def rays(seed: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    d = rng.normal(size=(count, 3))
    return rng.uniform([-4, -4, 0.2], [4, 4, 2.8], (count, 3)), d / np.linalg.norm(d, axis=1, keepdims=True)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_random_rooms_against_a_loop_over_all_triangles(seed: int) -> None:
    """Distances to 1e-12 of rounding over 10 m (at 1e-4 rad from the plane it grows to 1e-9); same shape and face."""
    shapes, (o, d) = clutter(seed), rays(seed, 1500)
    found, (distance, object_id, face) = first_hit(shapes, o, d), by_determinants(shapes, o, d)
    np.testing.assert_allclose(found.distance_m, distance, rtol=0.0, atol=1e-11)
    assert np.array_equal(found.object_id, object_id)
    assert np.array_equal(found.patch, face)
    assert np.count_nonzero(object_id >= 14) > 200  # the clutter is met, not the walls alone
    assert {0, 1, 2} == {shapes[k].name[0] == "b" or 2 * (shapes[k].name[0] == "m") for k in object_id if k >= 14}


@pytest.mark.slow
def test_bundles_of_rays_against_a_loop_over_all_triangles() -> None:
    """Bundles as wide as a few pixels of the mirror and up to 20 degrees; each has to try few faces alone, or all.

    Borders as above. Half of the rays end at the middle of their way: faces behind that are not met.
    """
    shapes, rng = clutter(5, 30), np.random.default_rng(5)
    geometry, tried = RoomGeometry(shapes), Counter[bool]()
    for k in range(30):
        width = (0.003, 0.03, 0.2)[k % 3]
        centre, way = rays(100 + k, 1)
        o = centre + rng.uniform(-width, width, (300, 3)) * rng.integers(0, 2, 3)
        d = way + rng.uniform(-width, width, (300, 3))
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        distance, object_id, face = by_determinants(shapes, o, d)
        limit = np.where(np.arange(300) % 2, np.inf, 0.5 * distance)
        found = geometry.first_hit(o, d, limit)
        met = np.isinf(limit) & np.isfinite(distance)
        assert np.array_equal(found.patch, np.where(met, face, -1))
        assert np.array_equal(found.object_id, np.where(met, object_id, -1))
        np.testing.assert_allclose(found.distance_m, np.where(met, distance, np.inf), rtol=0.0, atol=1e-11)
        tree = geometry._parts[0].tree
        tried[len(tree._ahead(Rays.of(o, d), np.where(np.isinf(limit), 100.0, limit))) <= 16] += 1
    assert min(tried[True], tried[False]) > 5


def test_segments_stop_at_the_first_shape_between_their_ends() -> None:
    shapes, (o, d) = clutter(7), rays(7, 1000)
    ends = o + np.random.default_rng(1).uniform(0.1, 4.0, (1000, 1)) * d
    length = np.linalg.norm(ends - o, axis=1)
    distance, object_id, _ = by_determinants(shapes, o, d)
    free = distance > length
    assert np.array_equal(blocked_by(shapes, o, ends), np.where(free, -1, object_id))
    assert 200 < np.count_nonzero(free) < 900
    on_surface = o + distance[:, None] * d  # a segment that ends on a surface is not blocked by it
    assert np.all(blocked_by(shapes, o, on_surface) == -1)


def test_no_ray_slips_through_the_edges_of_a_solid() -> None:
    """Rays from inside through points on edges and corners, and along diagonals of faces: each meets the solid.

    Points are rounded to float64, so that about half of the rays pass outside of either face: without the reach
    beyond the borders some hundred of them are lost.
    """
    rng, lost = np.random.default_rng(0), 0
    for number in range(20):
        pose = Pose("world", "shape", tuple(rng.uniform(-5, 5, 3)), rotation_xyz(*rng.normal(size=3)))
        solid: Shape = Prism("p", pose, 0.3, 0.5, 24) if number % 2 else Cuboid("c", pose, (0.3, 0.5, 0.2))
        table = face_table([solid])
        edges = np.concatenate([table.corners_m, np.roll(table.corners_m, -1, axis=1)], axis=2).reshape(-1, 2, 3)
        share = rng.random((len(edges), 1))
        aims = np.concatenate([share * edges[:, 0] + (1.0 - share) * edges[:, 1], edges[:, 0]])
        starts = pose.points(0.05 * rng.uniform(-1.0, 1.0, aims.shape))
        d = aims - starts
        length = np.linalg.norm(d, axis=1)
        found = first_hit((solid,), starts, d / length[:, None])
        lost += np.count_nonzero(np.abs(found.distance_m - length) > 1e-9)
    assert lost == 0


def test_rays_in_planes_and_along_edges() -> None:
    """In the plane of a face the ray meets the sides of the box; along an edge, its end or one of the two faces."""
    box = Cuboid("box", Pose("world", "shape", (2.0, 0.0, 0.5)), (1.0, 1.0, 1.0))
    start, along = np.array([[0.0, 0.0, 1.0], [0.0, 0.5, 1.0], [0.0, 0.2, 1.0 + 1e-6]]), np.array([[1.0, 0.0, 0.0]] * 3)
    found = first_hit((box,), start, along)
    np.testing.assert_allclose(found.distance_m[:2], 1.5, atol=1e-12)
    assert found.object_id.tolist() == [0, 0, -1]
    card = rectangle("card", (2.0, 0.0, 1.0), (0.0, 0.0, 1.0), (1.0, 1.0))
    assert first_hit((card,), start, along).object_id.tolist() == [-1, -1, -1]  # seen edge on, it has no width


def test_from_inside_a_solid_the_way_out_is_met() -> None:
    solids: tuple[Shape, ...] = (
        Cuboid("box", Pose("world", "shape"), (1.0, 2.0, 3.0)),
        Prism("prism", Pose("world", "shape", (5.0, 0.0, 0.0)), 0.5, 2.0, 4),
    )
    starts = np.array([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0]])
    up, across = np.array([[0.0, 0.0, 1.0]] * 2), np.array([[1.0, 0.0, 0.0]] * 2)
    assert first_hit(solids, starts, up).distance_m == pytest.approx([1.5, 1.0])
    assert first_hit(solids, starts, across).distance_m == pytest.approx([0.5, 0.5])  # the prism's corner 0


def test_nothing_and_degenerate_triangles_are_met_by_nothing() -> None:
    o, d = rays(0, 5)
    assert first_hit((), o, d).object_id.tolist() == [-1] * 5
    assert np.isinf(first_hit((), o, d).distance_m).all()
    line = Mesh("line", np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]), np.array([[0, 1, 2]]))
    assert first_hit((line,), o, d).patch.tolist() == [-1] * 5


def test_a_rooms_own_part_is_made_once_and_never_pickled() -> None:
    """Ids are those of `Room.shapes` at every offset; the kept part goes neither into pickles nor into equality."""
    room, rig = Room("r", (), clutter(3)), default_rig()
    fresh, size = Room("r", (), room.furniture), len(pickle.dumps(room))
    first, second = (room_geometry(room, rig.at(h)) for h in (0.0, 0.5))
    o, d = rays(3, 400)
    for geometry, h in ((first, 0.0), (second, 0.5)):
        expected = first_hit(room.shapes(rig.at(h)), o, d)
        found = geometry.first_hit(o, d)
        assert np.array_equal(found.object_id, expected.object_id)
        assert np.array_equal(found.patch, expected.patch)
        table = face_table(room.shapes(rig.at(h)))
        assert np.array_equal(geometry.table.shape, table.shape)
        assert np.array_equal(geometry.table.normal, table.normal)
    assert first._parts[0] is second._parts[0]
    assert room == fresh
    assert len(pickle.dumps(room)) < size + 1000
    assert np.all(first.without_robot.first_hit(o, d).object_id < len(room.furniture))


def test_a_layer_with_guesses_is_that_without() -> None:
    """Guesses of faces that the ray does not meet, and none at all, are put right; all planes to 1e-12."""
    rig = default_rig()
    small = replace(rig.camera, width_px=160, height_px=90, fx_px=178.0, fy_px=178.0, cx_px=79.5, cy_px=44.5)
    view = replace(rig, camera=small).at(0.3)
    geometry = room_geometry(Room("r", (), clutter(5)), view)
    wrong = 0

    def finder(origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        nonlocal wrong
        right = geometry.first_hit(origins, directions).patch
        guess = right.copy()
        guess[::50] = -1
        guess[(np.arange(len(guess)) % 7 == 0) & (directions[:, 2] > 0.0)] = 0  # the floor
        wrong = np.count_nonzero(guess != right)
        return guess

    exact, guessed = truth_layer(view, geometry), truth_layer(view, geometry, finder)
    assert wrong > 200
    for name, plane in exact.items():
        np.testing.assert_allclose(guessed[name], plane, rtol=0.0, atol=1e-12)


def test_a_thousand_rays_in_a_room_of_thousands_of_faces() -> None:
    """Required: 60 ms of CPU for 1000 rays in 3000 faces; measured 5 ms (2026-11, 2 cores). A loop takes 300 ms."""
    geometry = RoomGeometry(clutter(11, 150))
    assert len(geometry.table.shape) > 2500
    o, d = rays(11, 1000)
    times_s = []
    for _ in range(4):  # the first one also prepares; whoever else uses the machine may slow down some
        began = time.process_time()
        geometry.first_hit(o, d)
        times_s.append(time.process_time() - began)
    assert min(times_s) < 0.06
