"""Arenas: lines of sight against points along them, and targets that can be driven to."""

from __future__ import annotations

import math

import numpy as np
import pytest

from phibench.estimator.geometry.line_of_sight import blocked_segments
from phibench.robot.loop.arena import Boxes, arena_of, boxes_of, generated_arena, plain_arena
from phibench.scenes.frames import Array, rotation_xyz
from phibench.scenes.random_streams import generator
from phibench.scenes.room import lab
from phibench.scenes.shapes import cuboid
from phibench.scenes.validation import SceneError

RNG = generator("test", "arena")


def drawn_boxes(count: int) -> tuple[Boxes, list]:
    solids = [
        cuboid(
            f"box_{k}",
            tuple(RNG.uniform(-2, 2, 3)),
            tuple(RNG.uniform(0.2, 1.5, 3)),
            (0.5, 0.5, 0.5),
            rotation_xyz(*RNG.uniform(-1, 1, 3)),
        )
        for k in range(count)
    ]
    return boxes_of(solids), solids


def inside(boxes: Boxes, points: Array) -> Array:
    local = np.einsum("nji,pnj->pni", boxes.axes, points[:, None] - boxes.centre_m)
    return (np.abs(local) < boxes.half_m).all(axis=-1).any(axis=-1)


def test_lines_of_sight_agree_with_points_along_them_and_with_the_scalar_test() -> None:
    boxes, solids = drawn_boxes(12)
    starts, ends = RNG.uniform(-3, 3, (300, 3)), RNG.uniform(-3, 3, (300, 3))
    found = boxes.block(starts, ends)
    steps = np.linspace(0.0, 0.999, 400)[:, None]
    sampled = np.array([inside(boxes, a + steps * (b - a)).any() for a, b in zip(starts, ends, strict=True)])
    scalar = np.array(
        [any(blocked_segments(solid, a, b) for solid in solids) for a, b in zip(starts, ends, strict=True)]
    )
    assert 60 < scalar.sum() < 240
    assert not np.any(sampled & ~found)
    # points 15 mm apart miss corners that are cut by less; the last 3 mm of a line are left out
    assert np.mean(found != sampled) < 0.03
    assert np.mean(found != scalar) < 0.005


def test_the_first_face_is_hit_where_points_enter_a_box() -> None:
    boxes, _ = drawn_boxes(12)
    hits = 0
    for _ in range(100):
        start, d = RNG.uniform(-3, 3, 3), RNG.normal(size=3)
        d /= np.linalg.norm(d)
        if inside(boxes, start[None])[0] or (hit := boxes.first_hit(start, d, 6.0)) is None:
            continue
        hits += 1
        distance, normal = hit
        assert not inside(boxes, start + np.linspace(0, distance - 1e-6, 500)[:, None] * d).any()
        assert inside(boxes, (start + (distance + 1e-6) * d)[None])[0]
        assert normal @ d < 0.0
    assert hits > 10


def test_targets_can_be_driven_to() -> None:
    checked = 0
    for k in range(20):
        arena, rng = plain_arena("test", k), generator("test", "targets", k)
        try:
            target = arena.draw_target(rng, (1.5, 4.5), 1.0)
        except SceneError:
            continue
        D = math.hypot(*target.point_m[:2])
        assert 1.5 <= D <= 4.5
        assert target.normal[:2] @ target.point_m[:2] < 0.0
        for share in np.linspace(0, 1, 20):
            way = share * (D - 1.0) / D * target.point_m[:2]
            assert not arena.collides(*way)
        checked += 1
    assert checked >= 15


def test_walls_stop_the_robot_and_floors_do_not() -> None:
    arena = arena_of(lab())
    assert not arena.collides(0.0, 0.0)
    assert any(arena.collides(x, 0.0) for x in np.arange(0.0, 8.0, 0.2))
    assert len(arena.floor) < len(arena.sight)


def test_generated_rooms_become_arenas_and_the_same_names_the_same_one() -> None:
    arena, again = generated_arena("test", 1), generated_arena("test", 1)
    assert np.array_equal(arena.sight.centre_m, again.sight.centre_m)
    assert len(arena.sight) > 50
    with pytest.raises(SceneError, match="allow other distances"):
        arena.draw_target(generator("test"), (40.0, 50.0), 1.0)
