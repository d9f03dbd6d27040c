"""Generated rooms: all valid, equal for equal names, different for others; subjects do not disturb each other."""

from __future__ import annotations

import math
import re
from collections import Counter
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from phibench.datasets.recipe.recipe_scene import ceiling_m
from phibench.render.optics.faces import FaceTable, face_table
from phibench.scenes.room import Room, chassis
from phibench.scenes.shapes import Bitmap, Cuboid, Mesh, Prism, Rectangle, cuboid
from phibench.scenes.worlds.floor_plan import FREE_DISC_HEIGHT_M, FREE_DISC_M, FREE_RADIUS_M, floor_plan
from phibench.scenes.worlds.generated_room import MOST_LIGHTS, MOST_PATCHES, generate_room
from phibench.scenes.worlds.room_properties import PROPERTIES, RoomProperties, drawn_properties

SEED = "rooms-of-a-test"
FLAT_LAMP_M = 0.11  # the flattest lamps may be above the robot
SMALLEST = {name: entry.low for name, entry in PROPERTIES.items() if not entry.choices} | {"use": "home", "l_shape": 1}
FULLEST = {name: entry.high for name, entry in PROPERTIES.items() if not entry.choices} | {"use": "workshop"}
DRAWN = list[tuple[RoomProperties, Room]]


def drawn(number: int, **fixed: float | str) -> tuple[RoomProperties, Room]:
    properties = drawn_properties(SEED, number, **fixed)
    return properties, generate_room(properties, SEED, number)


@pytest.fixture(scope="module")
def rooms() -> DRAWN:
    return [drawn(number) for number in range(12)]


def piece_of(name: str) -> str:
    """Name of the piece that a part belongs to: `chair_2` of `chair_2_leg_1`."""
    found = re.match(r"[a-z_]+?_\d+", name)
    return found.group() if found else name


def solids_of(room: Room) -> dict[str, Cuboid]:
    """Solids by name, a prism as the box around it."""
    solids = [shape for shape in room.furniture if isinstance(shape, Cuboid | Prism)]
    return {shape.name: Cuboid(shape.name, shape.T_world_shape, shape.size_m) for shape in solids}


def overlaps(solids: dict[str, Cuboid]) -> list[tuple[str, str]]:
    """Pairs of solids of different pieces that share points."""
    names, boxes = list(solids), list(solids.values())
    half = np.array([0.5 * np.abs(box.T_world_shape.R) @ np.array(box.size_m) for box in boxes])
    centre = np.array([box.T_world_shape.t for box in boxes])
    near = np.all(np.abs(centre[:, None] - centre[None]) < half[:, None] + half[None], axis=-1)
    pieces = np.unique([piece_of(name) for name in names], return_inverse=True)[1]
    near &= pieces[:, None] != pieces[None]
    pairs = zip(*np.nonzero(np.triu(near, 1)), strict=True)
    return [(names[i], names[j]) for i, j in pairs if boxes[i].meets(boxes[j])]


def hit_before(table: FaceTable, start: np.ndarray, direction: np.ndarray, reach_m: float) -> bool:
    """A triangle lies on a ray (Moeller and Trumbore), which the generator does not use."""
    a, b, c = np.moveaxis(table.corners_m, 1, 0)
    e1, e2, s = b - a, c - a, start - a
    p, q = np.cross(direction, e2), np.cross(s, e1)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        det = np.einsum("ni,ni->n", e1, p)
        u, v, t = np.einsum("ni,ni->n", s, p) / det, q @ direction / det, np.einsum("ni,ni->n", e2, q) / det
    hit = np.isfinite(det) & (np.abs(det) > 1e-15) & (u >= 0.0) & (v >= 0.0) & (t > 1e-6) & (t < reach_m)
    return bool(np.any(u[hit] + v[hit] <= 1.0))


def axis_distance_m(corners: np.ndarray) -> np.ndarray:
    """Least distance of triangles (N, 3, 3) from the z axis by 200 points on each, metres."""
    low, high = corners[..., :2].min(axis=1), corners[..., :2].max(axis=1)
    far = np.maximum(np.maximum(low, -high), 0.0).max(axis=1)  # of the rectangle around: never too large
    near = far < FREE_DISC_M
    if not near.all():
        far[near] = axis_distance_m(corners[near]) if near.any() else far[near]
        return far
    u, v = np.random.default_rng(0).random((2, 200))
    u, v = np.where(u + v > 1.0, 1.0 - u, u), np.where(u + v > 1.0, 1.0 - v, v)
    a, b, c = np.moveaxis(corners[..., :2], 1, 0)
    points = a[:, None] + u[:, None] * (b - a)[:, None] + v[:, None] * (c - a)[:, None]
    return np.linalg.norm(np.concatenate([points, corners[..., :2]], axis=1), axis=-1).min(axis=1)


def misplaced(properties: RoomProperties, room: Room, table: FaceTable) -> list[str]:
    """Names of what stands in the robot's free space, in a wall or outside."""
    names = np.array([shape.name for shape in (*room.surfaces, *room.furniture)])
    owner = names[table.shape[table.patch]]
    inner = np.array([not re.fullmatch(r"(floor|ceiling|wall)(_\d+)?", name) for name in owner])
    corners, height = table.corners_m[inner], properties.height_m
    low, high = corners[..., 2].min(axis=1), corners[..., 2].max(axis=1)
    distance = axis_distance_m(corners)
    wrong = (distance < FREE_RADIUS_M) & (high < height - FLAT_LAMP_M)
    wrong |= (distance < FREE_DISC_M) & (low < FREE_DISC_HEIGHT_M)
    wrong |= (low < 5e-4) | (high > height - 5e-4)
    plan = floor_plan(properties)
    place = plan.T_world_plan.inverse().points(corners.reshape(-1, 3)).reshape(-1, 3, 3)[..., :2]
    sides = np.array([plan.length_m, plan.width_m])
    outside = np.any((place < 5e-4) | (place > sides - 5e-4), axis=-1)
    if plan.cut_m[0]:
        outside |= np.all(place > sides - plan.cut_m - 5e-4, axis=-1)
    return sorted(set(owner[inner][wrong | outside.any(axis=1)]))


def is_hidden(room: Room, table: FaceTable, lamp: Rectangle) -> bool:
    """Something lies within 0.3 m before a lamp, or it is in a solid; a window has bars and curtains before it."""
    if lamp.window:
        return False
    reach = 0.3 if lamp.name.startswith("lamp_") else 0.1
    pose, size = lamp.T_world_shape, lamp.size_m
    if room.solid_around(tuple(pose.t)) is not None:
        return True
    places = [(u, v) for u in (-0.45, 0.0, 0.45) for v in (-0.45, 0.0, 0.45)]
    starts = [pose.points(np.array([u * size[0], v * size[1], 1e-4])) for u, v in places]
    return any(hit_before(table, start, pose.R[:, 2], reach) for start in starts)


def faults_of(properties: RoomProperties, room: Room) -> list[str]:
    """Everything that is wrong with a room, in words."""
    robot = {box.name: box for box in chassis()}
    pairs = [pair for pair in overlaps(solids_of(room) | robot) if not set(pair) <= set(robot)]
    table = face_table((*room.surfaces, *room.furniture))
    found = [f"{a} and {b} overlap" for a, b in pairs]
    found += [f"{name} is where it must not be" for name in misplaced(properties, room, table)]
    lights = [surface for surface in room.surfaces if surface.emits]
    found += [f"{lamp.name} is hidden" for lamp in lights if is_hidden(room, table, lamp)]
    if ceiling_m(room) < properties.height_m - FLAT_LAMP_M:
        found.append(f"the stroke ends at {ceiling_m(room):.2f} m")
    bitmaps = [texture.values for texture in table.textures if isinstance(texture, Bitmap)]
    if not 1 <= len(lights) <= MOST_LIGHTS or len(table.size_m) > MOST_PATCHES or len(room.furniture) > 600:
        found.append(f"{len(lights)} lights, {len(table.size_m)} patches, {len(room.furniture)} shapes")
    if sum(values.size for values in bitmaps) > 4_000_000 or max(max(values.shape) for values in bitmaps) > 256:
        found.append("too many texels")
    return found


@pytest.mark.slow
def test_rooms_are_valid(rooms):
    """Nothing overlaps, hides a lamp, stands in the robot's way or leaves the room."""
    assert {k: found for k, pair in enumerate(rooms) if (found := faults_of(*pair))} == {}


@pytest.mark.slow
@pytest.mark.parametrize("fixed", [SMALLEST, FULLEST], ids=["smallest", "fullest"])
@pytest.mark.parametrize("kind", PROPERTIES["lamp_kind"].choices)
def test_rooms_at_the_ends_of_the_ranges_are_valid(fixed, kind):
    assert faults_of(*drawn(0, **(fixed | {"lamp_kind": kind}))) == []


@pytest.mark.slow
def test_500_rooms_are_valid_and_differ():
    faults, digests = {}, set()
    for k in range(500):
        properties, room = drawn(k)
        digests.add(room.digest)
        if found := faults_of(properties, room):
            faults[k] = found
    assert faults == {}
    assert len(digests) == 500


@pytest.mark.slow
def test_each_fault_is_found(rooms):
    """The checks above see a fault of each kind."""
    properties, room = rooms[0]
    lamp = next(s for s in room.surfaces if s.name.startswith("lamp_") and s.emits)
    under = lamp.T_world_shape.t + 0.1 * lamp.T_world_shape.R[:, 2]

    def with_box(centre: np.ndarray | tuple[float, ...], size: float) -> str:
        box = cuboid("box_1", tuple(map(float, centre)), (size, size, size), (0.5, 0.5, 0.5))
        return "; ".join(faults_of(properties, replace(room, furniture=(*room.furniture, box))))

    solid = next(iter(solids_of(room).values()))
    assert "hidden" in with_box(under, 0.1)
    assert "overlap" in with_box(solid.T_world_shape.t, 0.1)
    assert "robot_body" in with_box((0.0, 0.0, 0.2), 0.1)
    assert "where it must not" in with_box((0.5, 0.0, 0.1), 0.04)
    assert "where it must not" in with_box((40.0, 0.0, 1.6), 0.1)
    assert "stroke ends at 1.55 m" in with_box((0.15, 0.0, 1.6), 0.1)


def in_one_plane(table: FaceTable) -> list[tuple[int, int]]:
    """Pairs of rectangles within 0.3 mm of one plane that overlap by more than a millimetre: they would flicker."""
    corners = np.bincount(table.patch)
    keep = np.flatnonzero(corners == 2)
    normal, centre, size = table.normal[keep], table.centre_m[keep], table.size_m[keep]
    normal = normal * np.where(normal @ np.array([0.577, 0.211, 0.789]) < 0.0, -1.0, 1.0)[:, None]
    off = np.einsum("ni,ni->n", normal, centre)
    same = (np.abs(off[:, None] - off[None]) < 3e-4) & (normal @ normal.T > 1.0 - 1e-8)
    found = []
    for i, j in zip(*np.nonzero(np.triu(same, 1)), strict=True):
        a, b = (
            np.stack([table.x_axis[keep[i]], table.y_axis[keep[i]]]),
            np.stack([table.x_axis[keep[j]], table.y_axis[keep[j]]]),
        )
        shift = centre[j] - centre[i]
        apart = [
            np.abs(axes @ shift) - 0.5 * (np.abs(axes @ a.T) @ size[i] + np.abs(axes @ b.T) @ size[j])
            for axes in (a, b)
        ]
        if np.max(apart) < -1e-3:
            found.append((int(keep[i]), int(keep[j])))
    return found


def test_no_two_faces_share_a_plane(rooms):
    pairs = set()
    for _, room in rooms[:5]:
        names = [shape.name for shape in (*room.surfaces, *room.furniture)]
        table = face_table((*room.surfaces, *room.furniture))
        pairs |= {(names[table.shape[a]], names[table.shape[b]]) for a, b in in_one_plane(table)}
    assert pairs == set()


def test_equal_names_give_equal_rooms(rooms):
    properties, room = rooms[3]
    assert generate_room(properties, SEED, 3).digest == room.digest
    assert generate_room(properties, SEED, 4).digest != room.digest


def split(room: Room) -> tuple[dict[str, object], dict[str, object]]:
    """Lamps, and all other shapes, by name."""
    lamps, others = {}, {}
    for shape in (*room.surfaces, *room.furniture):
        (lamps if shape.name.startswith(("lamp_", "indicator_")) else others)[shape.name] = shape
    return lamps, others


@pytest.mark.slow
def test_other_lamps_leave_furniture_and_textures():
    for number in range(3):
        lamps, others = split(drawn(number, lamp_kind="tubes", illuminance_lx=200.0)[1])
        other_lamps, same = split(drawn(number, lamp_kind="pendants", illuminance_lx=900.0, indicator_lamps=2)[1])
        assert others == same
        assert lamps != other_lamps


def test_screens_and_desk_lamps_change_nothing_but_light():
    _, dark = drawn(1, use="office", screens=0, desk_lamps=0)
    _, lit = drawn(1, use="office", screens=6, desk_lamps=2)
    differ = {
        a.name for a, b in zip(dark.surfaces, lit.surfaces, strict=True) if a != b and not a.name.startswith("lamp_")
    }
    assert differ
    assert all(name.endswith(("screen", "bulb")) for name in differ)


def test_more_furniture_keeps_shell_and_openings():
    few, many = (drawn(5, furniture_per_m2=part)[1] for part in (0.1, 0.5))
    kept = r"(floor|ceiling|wall_\d|(window|door)_\d_.*)"
    shells = [[s for s in (*r.surfaces, *r.furniture) if re.fullmatch(kept, s.name)] for r in (few, many)]
    assert len(shells[0]) > 10
    assert shells[0] == shells[1]
    assert len(many.furniture) > len(few.furniture)


def signature(properties: RoomProperties, room: Room) -> np.ndarray:
    """Light, mean colour, size and make-up of a room, each scaled to what the eye would tell apart."""
    table = face_table((*room.surfaces, *room.furniture))
    means = np.array([texture_mean(texture) for texture in table.textures])[table.texture]
    area = table.size_m.prod(axis=1)
    light = np.log((table.radiance_w_m2_sr * area[:, None]).sum(axis=0) + 1e-3)
    colour = (means * area[:, None]).sum(axis=0) / area.sum()
    kinds = Counter(piece_of(shape.name) for shape in room.furniture)
    return np.array([*light, *(5.0 * colour), math.log(properties.length_m * properties.width_m), len(kinds) / 10.0])


def texture_mean(texture: object) -> np.ndarray:
    return (
        texture.values[..., :3].mean(axis=(0, 1)).astype(float)
        if isinstance(texture, Bitmap)
        else np.array(texture.albedo)
    )


def test_rooms_differ_pair_by_pair(rooms):
    """The largest of eight scaled differences: two of one kind would be 0, drawn ones are far apart."""
    signatures = [signature(*pair) for pair in rooms]
    assert min(np.abs(a - b).max() for a, b in combinations(signatures, 2)) > 0.1
    assert len({properties.use for properties, _ in rooms}) >= 4


def test_rooms_have_many_shapes_with_readable_names(rooms):
    counts = [len(room.surfaces) + len(room.furniture) for _, room in rooms]
    assert 150 <= min(counts) <= max(counts) <= 600
    names = [shape.name for _, room in rooms for shape in (*room.surfaces, *room.furniture)]
    assert [name for name in names if not re.fullmatch(r"[a-z]+(_[a-z0-9]+)*", name)] == []


def test_flux_per_floor_area_is_the_stated_illuminance():
    """Of the lamps alone: pi L A over the floor's area, in lumens by the efficacies of test_lamps."""
    _, room = drawn(2, illuminance_lx=321.0, l_shape=1)
    lamps = [s for s in room.surfaces if s.name.startswith("lamp_") and s.emits]
    efficacy = np.array([192.9, 560.1, 55.9])
    lumens = sum(math.pi * math.prod(s.size_m) * float(efficacy @ np.array(s.radiance_w_m2_sr)) for s in lamps)
    floor = sum(math.prod(s.size_m) for s in room.surfaces if re.fullmatch(r"floor(_2)?", s.name))
    assert lumens / floor == pytest.approx(321.0, rel=1e-9)


@pytest.mark.slow
def test_sun_shines_in_through_a_window():
    seen = 0
    for number in range(4):
        _, room = drawn(number, windows=2, sun=1, length_m=9.0, width_m=7.0)
        windows = [s for s in room.surfaces if s.window]
        if windows:
            assert room.sun is not None
            assert min(float(w.T_world_shape.R[:, 2] @ room.sun.direction_world) for w in windows) < -0.05
            seen += 1
    assert seen >= 3
    assert drawn(0, windows=0, sun=1)[1].sun is None


def test_leaves_are_two_sided_meshes(rooms):
    meshes = [shape for _, room in rooms for shape in room.furniture if isinstance(shape, Mesh)]
    assert meshes
    assert all(mesh.two_sided for mesh in meshes)
