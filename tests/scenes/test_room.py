"""Robot, rooms, solids and textures: they stand where they should, and impossible ones are refused."""

from __future__ import annotations

import math
from itertools import pairwise, product

import numpy as np
import pytest
from helpers.oracles import TARGETS, paper_cases, true_reflection

from phibench.scenes.frames import Pose, rotation_xyz
from phibench.scenes.rig import Rig
from phibench.scenes.room import RIGS, ROOMS, Room, TargetBoard, chassis, dark, escalade360, lab
from phibench.scenes.shapes import Bitmap, Checker, Cuboid, Rectangle, Uniform, cuboid, rectangle
from phibench.scenes.validation import SceneError

NAN, INF = math.nan, math.inf


def corners(box: Cuboid) -> np.ndarray:
    return box.T_world_shape.points(np.array(list(product((-0.5, 0.5), repeat=3))) * np.array(box.size_m))


def test_robot_has_the_papers_dimensions():
    """0.90 x 0.53 x 0.30 m overall, to rounding, about the stroke axis and on the floor."""
    points = np.concatenate([corners(box) for box in chassis()])
    np.testing.assert_allclose(points.min(axis=0), [-0.45, -0.265, 0.0], atol=1e-12)
    np.testing.assert_allclose(points.max(axis=0), [0.45, 0.265, 0.30], atol=1e-12)


def test_no_two_solids_of_the_robot_touch_along_its_sides():
    """Faces in one plane would make light maps and rays choose between two materials."""
    solids = {box.name: box for box in chassis()}
    for side in ("left", "right"):
        inner = np.abs(corners(solids[f"robot_track_{side}"])[:, 1]).min()
        assert inner - corners(solids["robot_body"])[:, 1].max() == pytest.approx(0.01)


@pytest.mark.parametrize("offset_m", [0.0, 0.5, 1.4])
def test_carriage_follows_the_camera_and_does_not_cover_the_lens(offset_m):
    view = Rig().at(offset_m)
    parts = {shape.name: shape for shape in escalade360(view)}
    assert len(parts) == len(chassis()) + 2
    assert corners(parts["camera_housing"])[:, 2].max() == pytest.approx(view.camera_centre_m[2] - 1e-3, abs=1e-12)
    assert corners(parts["robot_mast"])[:, 2].min() == pytest.approx(0.30, abs=1e-12)
    assert corners(parts["robot_mast"])[:, 2].max() == pytest.approx(view.camera_centre_m[2] - 0.033, abs=1e-12)


@pytest.mark.parametrize("name", ROOMS)
def test_object_ids_do_not_depend_on_the_pose(name):
    room = ROOMS[name](TARGETS)
    assert room.object_names(Rig().at(0.0)) == room.object_names(Rig().at(1.4))
    assert len(set(room.object_names(Rig().at(0.0)))) == len(room.shapes(Rig().at(0.0)))


def test_dark_room_is_the_lab_without_light():
    assert any(surface.emits for surface in lab().surfaces)
    assert not any(surface.emits for surface in dark().surfaces)
    assert [s.name for s in dark().surfaces] == [s.name for s in lab().surfaces]


def test_a_room_is_lit_by_lamps_and_by_textures_that_shine():
    glow = Bitmap(np.ones((1, 1, 4)), (1.0, 1.0), is_radiance=True)
    plain = cuboid("box", (2.0, 0.0, 0.5), (0.4, 0.4, 0.4), (0.5, 0.5, 0.5))
    assert lab().lit
    assert not Room("r", (), (plain,)).lit
    assert Room("r", (), (plain, cuboid("sign", (0.0, 2.0, 0.5), (0.4, 0.4, 0.4), glow))).lit


def test_board_faces_carry_the_spots():
    """The centre of every board's face is the target's position, and the face looks at the axis."""
    boards = {box.name: box for box in lab(TARGETS).furniture}
    for target in TARGETS:
        box, position = boards[f"board_{target.name}"], np.array(target.position_world_m)
        local = box.T_world_shape.inverse().points(position)
        np.testing.assert_allclose(local, [-box.size_m[0] / 2, 0.0, 0.0], atol=1e-12)
        outward = box.T_world_shape.directions(np.array([-1.0, 0.0, 0.0]))
        np.testing.assert_allclose(outward, target.normal_world, atol=1e-12)
        assert math.hypot(*position[:2]) == pytest.approx(target.depth_m, abs=1e-12)


def test_spots_lie_on_their_boards_not_inside_a_solid():
    room = lab(TARGETS)
    for target in TARGETS:
        position = np.array(target.position_world_m)
        assert room.solid_around(tuple(position)) is None
        # a millimetre further the spot would be inside its board: the test can fail
        assert room.solid_around(tuple(position - 1e-3 * np.array(target.normal_world))) == f"board_{target.name}"
    assert room.solid_around((0.0, 0.0, 0.2)) == "robot_body"


def test_no_solid_stands_between_spot_and_mirror():
    """Dense samples (1 mm) of all 50 lines of sight and of the lines on to the camera; boards stand apart."""
    room, checked = lab(TARGETS), 0
    for row, spot in paper_cases():
        for offset in (0.0, row.baseline_m):
            P = true_reflection(Rig(), offset, spot)
            solids = [shape for shape in room.shapes(Rig().at(offset)) if isinstance(shape, Cuboid)]
            for start, end in pairwise((spot, P, Rig().at(offset).camera_centre_m)):
                steps = np.arange(1e-4, np.linalg.norm(end - start), 1e-3)
                points = start + steps[:, None] * (end - start) / np.linalg.norm(end - start)
                for box in solids:
                    local = np.abs(box.T_world_shape.inverse().points(points))
                    assert not np.any(np.all(local < np.array(box.size_m) / 2, axis=1)), (row, offset, box.name)
                checked += 1
    assert checked == 100


def test_solids_of_the_lab_do_not_intersect_the_boards():
    """Every board is sampled on a 2 cm grid against all other solids."""
    furniture = lab(TARGETS).furniture
    grid = np.array(list(product((-0.5, 0.0, 0.5), np.linspace(-0.5, 0.5, 21), np.linspace(-0.5, 0.5, 16))))
    for board, other in product(furniture, repeat=2):
        if board.name.startswith("board") and other.name != board.name:
            points = board.T_world_shape.points(grid * np.array(board.size_m))
            inside = np.all(np.abs(other.T_world_shape.inverse().points(points)) < np.array(other.size_m) / 2, axis=1)
            assert not inside.any(), (board.name, other.name)


def test_everything_stands_inside_the_lab():
    surfaces = {s.name: s for s in lab().surfaces}
    low = np.array([surfaces["wall_west"].T_world_shape.t[0], surfaces["wall_south"].T_world_shape.t[1], 0.0])
    high = np.array([surfaces["wall_east"].T_world_shape.t[0], surfaces["wall_north"].T_world_shape.t[1], 3.0])
    np.testing.assert_allclose(high - low, [10.0, 9.0, 3.0])
    for box in lab(TARGETS).furniture:
        points = corners(box)
        assert np.all(points >= low - 1e-9), box.name
        assert np.all(points <= high + 1e-9), box.name


def test_shell_faces_inwards():
    for surface in lab().surfaces:
        inward = np.array([0.2, -0.1, 1.5]) - surface.T_world_shape.t
        assert surface.T_world_shape.R[:, 2] @ inward > 0, surface.name


def test_two_shapes_of_one_name_are_refused():
    box = cuboid("box", (0, 0, 0), (1, 1, 1), (0.5, 0.5, 0.5))
    with pytest.raises(SceneError, match="box"):
        Room("room", (), (box, box))


@pytest.mark.parametrize("size", [(1.0, 0.0), (1.0, NAN), (1.0, -1.0), (1.0, 1.0, 1.0)])
def test_impossible_rectangles_are_refused(size):
    with pytest.raises(SceneError, match="size_m"):
        rectangle("wall", (0, 0, 0), (0, 0, 1), size)


def test_rectangle_and_lamp():
    lamp = rectangle("lamp", (0, 0, 3), (0, 0, -1), (1.2, 0.6), radiance_w_m2_sr=(1.0, 0.0, 0.0))
    assert lamp.emits
    assert not Rectangle("wall", Pose("world", "shape"), (1.0, 1.0)).emits


def test_checker_changes_at_its_lines():
    checker = Checker((0.8, 0.8, 0.8), (0.2, 0.2, 0.2), (0.5, 0.5), (-1.0, -1.0))
    xy = np.array([[-0.9, -0.9], [-0.4, -0.9], [-0.4, -0.4], [0.1, -0.9], [-0.501, -0.9], [-0.499, -0.9]])
    np.testing.assert_array_equal(checker.evaluate(xy)[:, 0], [0.8, 0.2, 0.8, 0.8, 0.8, 0.2])


@pytest.mark.parametrize("albedo", [(1.1, 0.5, 0.5), (-0.1, 0.5, 0.5), (0.5, 0.5), (NAN, 0.5, 0.5)])
def test_impossible_albedos_are_refused(albedo):
    with pytest.raises(SceneError, match="albedo"):
        Uniform(albedo)


@pytest.mark.parametrize("change", [{"depth_m": 0.0}, {"depth_m": NAN}, {"azimuth_rad": INF}, {"height_m": NAN}])
def test_impossible_targets_are_refused(change):
    with pytest.raises(SceneError, match=next(iter(change))):
        TargetBoard(**({"name": "t", "depth_m": 1.0, "azimuth_rad": 0.0, "height_m": 0.5} | change))


def test_catalogue_builds():
    assert set(RIGS) == {"default", "c310"}
    assert all(make().fits_image() for make in RIGS.values())


def test_boxes_meet_when_they_overlap_and_only_then():
    """Against 4000 points of one box: overlapping boxes share some, separated ones none."""
    rng, answers = np.random.default_rng(4), []

    def turns(rng):
        return rotation_xyz(*rng.uniform(-2, 2, 3))

    grid = np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, 16)] * 3), axis=-1).reshape(-1, 3)
    for _ in range(300):
        poses = [Pose("world", "shape", tuple(rng.uniform(-0.5, 0.5, 3)), turns(rng)) for _ in "ab"]
        a, b = (Cuboid(name, pose, tuple(rng.uniform(0.1, 0.7, 3))) for name, pose in zip("ab", poses, strict=True))
        points = b.T_world_shape.inverse().points(a.T_world_shape.points(grid * np.array(a.size_m)))
        shared = bool(np.any(np.all(np.abs(points) < 0.5 * np.array(b.size_m), axis=-1)))
        answers.append((shared, a.meets(b)))
        assert a.meets(b) == b.meets(a)
        assert a.meets(b) or not shared
    assert sum(shared for shared, _ in answers) > 50
    assert sum(not meets for _, meets in answers) > 50
    assert sum(meets and not shared for shared, meets in answers) < 30  # the grid misses thin overlaps only


def test_distance_from_a_box():
    box = cuboid("box", (1.0, 0.0, 0.0), (0.2, 0.4, 0.6), (0.5, 0.5, 0.5), rotation_xyz(z_rad=math.pi / 2))
    assert box.distance_m(np.array([1.0, 0.0, 0.0])) == 0.0
    assert box.distance_m(np.array([1.3, 0.0, 0.0])) == pytest.approx(0.1)  # turned: 0.4 along x
    assert box.distance_m(np.array([1.0, 0.4, 0.7])) == pytest.approx(0.5)
