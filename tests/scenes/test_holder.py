"""The mirror's holder against round cylinders in closed form, and what it hides."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from helpers.revolved_rigs import PROFILES, revolved

from phibench.datasets.store.json_forms import from_json, to_json
from phibench.render.optics.certificate import certify
from phibench.render.optics.ray_tracer import trace_pixels
from phibench.render.optics.room_tracer import first_hit, room_geometry
from phibench.render.optics.spot_layer import spot_layer
from phibench.render.optics.truth import spot_truth, truth_layer
from phibench.scenes.holder import SIDES, Holder, fitted_holder, prism_radius_m
from phibench.scenes.laser import LaserSpot
from phibench.scenes.misalignment import Misalignment
from phibench.scenes.rig import Rig, View
from phibench.scenes.room import default_rig, lab
from phibench.scenes.validation import SceneError

BALL_M = 0.060
KINDS = ("rods", "post")
ALIGNED = Misalignment()
# A tilted camera, a decentred ball and a tilted stroke: nothing is upright any more.
CROOKED = Misalignment(tilt_x_rad=0.02, tilt_y_rad=-0.03, decentre_x_m=0.004, stroke_tilt_x_rad=0.02)


def rig(kind: str, misalignment: Misalignment = ALIGNED) -> Rig:
    return dataclasses.replace(default_rig(), holder=fitted_holder(kind, BALL_M)).perturbed(misalignment)


# -- oracle: rays against round cylinders, in the holder's own frame -----------------------------------------------


def own_frame(view: View, points: np.ndarray) -> np.ndarray:
    """Points with z along the line from the lens to the ball's centre, x in the plane of it and the camera's x."""
    z = view.sphere_centre_m - view.camera_centre_m
    z = z / np.linalg.norm(z)
    x = view.T_world_camera.R[:, 0]
    x = x - (x @ z) * z
    x = x / np.linalg.norm(x)
    return (points - view.camera_centre_m) @ np.stack([x, np.cross(z, x), z], axis=1)


def crossings(o: np.ndarray, d: np.ndarray, foot: tuple[float, float], low: float, high: float, r: float) -> np.ndarray:
    """Distance at which rays enter an upright round cylinder; inf where they do not. By clipping the ray."""
    x, y = o[:, 0] - foot[0], o[:, 1] - foot[1]
    a, b, c = d[:, 0] ** 2 + d[:, 1] ** 2, x * d[:, 0] + y * d[:, 1], x * x + y * y - r * r
    root = np.sqrt(np.maximum(b * b - a * c, 0.0))
    ends = np.sort([(low - o[:, 2]) / d[:, 2], (high - o[:, 2]) / d[:, 2]], axis=0)
    enter, leave = np.maximum((-b - root) / a, ends[0]), np.minimum((-b + root) / a, ends[1])
    return np.where((b * b > a * c) & (enter < leave) & (enter > 0.0), enter, np.inf)


def uprights(view: View, scale: float) -> list[np.ndarray]:
    """(x, y, low, high, radius) of all round upright parts, radii of rods times `scale`, in the order of the ids."""
    holder, distance = view.rig.holder, float(np.linalg.norm(view.sphere_centre_m - view.camera_centre_m))
    low, high, t = -0.034, distance + holder.rise_m, holder.azimuth_rad
    plate = (0.0, 0.0, low - 0.004, low, holder.plate_m)
    r, c = scale * holder.radius_m, holder.circle_m
    if holder.kind == "post":
        arm = high - 2.0 * holder.radius_m
        return [plate, (c * math.cos(t), c * math.sin(t), low, arm, r)]
    rods = [(c * math.cos(t + k * 2.0 * math.pi / 3.0), c * math.sin(t + k * 2.0 * math.pi / 3.0)) for k in range(3)]
    return [plate, (0.0, 0.0, high, high + 0.004, holder.plate_m), *((*at, low, high, r) for at in rods)]


@pytest.mark.slow
@pytest.mark.parametrize("misalignment", [ALIGNED, CROOKED], ids=["aligned", "crooked"])
@pytest.mark.parametrize("kind", KINDS)
def test_rods_are_round_ones_within_the_error_of_their_prisms(kind: str, misalignment: Misalignment) -> None:
    """A ray that meets the cylinder in the prism meets the prism, one that misses the cylinder around it does not."""
    view = rig(kind, misalignment).at(0.4)
    rng = np.random.default_rng(7)
    camera = view.rig.camera
    rays = trace_pixels(view, rng.uniform([300, 20], [980, 700], (200_000, 2)))
    kept = np.flatnonzero(np.isfinite(rays.cos_incidence))
    points, directions = rays.points_m[kept], rays.directions[kept]
    found = first_hit(view.holder_shapes, points, directions)
    o, d = own_frame(view, points), own_frame(view, points + directions) - own_frame(view, points)
    outer = prism_radius_m(1.0)  # of the corners; the sides are cos(pi / n) of that from the axis
    inner = outer * math.cos(math.pi / SIDES)
    assert (outer - 1.0, 1.0 - inner) == pytest.approx((0.00286, 0.00572), abs=2e-5)  # what the module says
    names = view.rig.holder.part_names
    upright = [k for k, name in enumerate(names) if "rod" in name or "column" in name]
    met = {}
    for scale in (inner, 1.0, outer):
        t = np.stack([crossings(o, d, part[:2], *part[2:]) for part in uprights(view, scale)])
        met[scale] = np.where(np.isfinite(t.min(axis=0)), t.argmin(axis=0), -1)
    ids = [k if kind == "rods" else {0: 0, 1: 1}[k] for k in range(len(uprights(view, 1.0)))]
    seen = np.array([-1, *ids])[met[1.0] + 1]
    on_rod = np.isin(found.object_id, upright)
    assert on_rod.sum() > 2000
    sure = np.isin(np.array([-1, *ids])[met[inner] + 1], upright)
    possible = np.isin(np.array([-1, *ids])[met[outer] + 1], upright)
    edge = np.array([part[3] for part in uprights(view, 1.0) if len(part)]).max() - 0.01  # plates and arm lie there
    low = (o + np.where(np.isfinite(found.distance_m), found.distance_m, 0.0)[:, None] * d)[:, 2] < edge
    away = low & (o[:, 2] < edge)
    assert np.all(on_rod[sure & away]), "a ray slips through a rod"
    assert np.all(possible[on_rod & away]), "a rod reaches beyond its prism"
    assert np.array_equal(found.object_id[sure & on_rod], seen[sure & on_rod])
    wrong = np.mean(np.isin(seen, upright)[away] != on_rod[away])
    assert wrong < 0.006 * on_rod.mean()  # 0.6 % of a rod's radius at most, both sides have some
    assert camera.width_px == 1280


@pytest.mark.parametrize("kind", [*KINDS, "tube"])
def test_nothing_of_it_stands_between_lens_and_mirror(kind: str) -> None:
    """Segments from all over the lens to all that it sees of the mirror, with sizes at their limits."""
    rng = np.random.default_rng(3)
    tight = prism_radius_m(0.004) + BALL_M + 1e-6
    holder = Holder(kind, circle_m=tight)
    view = dataclasses.replace(default_rig(), holder=holder).perturbed(CROOKED).at(0.2)
    n = rng.normal(size=(50_000, 3))
    ends = view.sphere_centre_m + BALL_M * n / np.linalg.norm(n, axis=1, keepdims=True)
    turn, r = rng.uniform(0, 2 * np.pi, len(n)), view.rig.camera.aperture_radius_m * np.sqrt(rng.random(len(n)))
    lens = view.T_world_camera.points(np.stack([r * np.cos(turn), r * np.sin(turn), 0.0 * r], axis=1))
    facing = np.einsum("ni,ni->n", lens - ends, ends - view.sphere_centre_m) > 0.0
    way = ends[facing] - lens[facing]
    length = np.linalg.norm(way, axis=1)
    hits = first_hit(view.holder_shapes, lens[facing], way / length[:, None])
    assert facing.sum() > 5000
    assert np.all(hits.distance_m > length)


@pytest.mark.slow
def test_truth_of_pixels_and_of_spots_agree() -> None:
    """Pixels that see a rod instead of the wall, and spots on what those pixels would see without it."""
    with_, without = rig("rods").at(0.3), default_rig().at(0.3)
    room = lab()
    seen = truth_layer(with_, room_geometry(room, with_))
    free = truth_layer(without, room_geometry(room, without))
    names = (*room.object_names(with_), *with_.rig.holder.part_names)
    assert len(names) == len(room.shapes(with_))
    parts = np.arange(len(names) - 5, len(names))
    changed = seen["object_id"] != free["object_id"]
    assert np.array_equal(np.isin(seen["object_id"], parts), changed)
    same = ~changed
    for name, plane in seen.items():
        # the sums over the largest faces are matrix products: with more faces they round in another order
        assert np.allclose(plane[same], free[name][same], rtol=0.0, atol=1e-12, equal_nan=True), name
    assert set(np.unique(seen["object_id"][changed]).astype(int)) == set(parts)
    rng = np.random.default_rng(0)
    v, u = np.nonzero(changed & (free["object_id"] == room.object_names(with_).index("wall_east")))
    for k in rng.choice(len(v), 12, replace=False):
        point = np.array([free[axis][v[k], u[k]] for axis in ("x_m", "y_m", "z_m")])
        spot = LaserSpot(tuple(point), (-1.0, 0.0, 0.0), 0.004, 0.7)
        truth = spot_truth(with_, spot, room_geometry(room, with_))
        assert truth.cause == f"occluded:{names[int(seen['object_id'][v[k], u[k]])]}"
        assert (truth.u_px, truth.v_px) == pytest.approx((u[k], v[k]), abs=1e-6)
        assert spot_truth(without, spot, room_geometry(room, without)).visible


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_rod_cuts_a_part_of_the_light_and_the_certificate_agrees(kind: str) -> None:
    """At the rod's edge a part of the lens sees the spot: by the mirror's two independent solutions alike."""
    view, bare, room = rig(kind).at(0.3), default_rig().at(0.3), lab()
    geometry, free = room_geometry(room, view), room_geometry(room, bare)

    def spot(y: float) -> LaserSpot:
        return LaserSpot((5.2, y, 1.3), (-1.0, 0.0, 0.0), 0.008, 0.7)

    # the first rod, or the column, stands at 30 degrees: between y = 2 and y = 4 on the wall at x = 5.2
    middle = spot_truth(view, spot(5.2 * math.tan(math.pi / 6.0)), geometry)
    assert middle.cause == f"occluded:{'holder_rod_1' if kind == 'rods' else 'holder_column'}"
    hidden, seen = 5.2 * math.tan(math.pi / 6.0), 4.3
    for _ in range(30):
        y = 0.5 * (hidden + seen)
        hidden, seen = (hidden, y) if spot_truth(view, spot(y), geometry).visible else (y, seen)
    parts = []
    for shift in (0.0, 0.004, 0.2):
        there = spot(seen + shift)
        truth = spot_truth(view, there, geometry)
        layer, whole = spot_layer(view, there, geometry), spot_layer(bare, there, free)
        assert truth.visible
        assert certify(view, there, geometry, truth, layer).passed
        parts.append(layer.total_electrons_per_s[0] / whole.total_electrons_per_s[0])
    assert parts[0] == pytest.approx(0.5, abs=0.1)  # the edge goes through the middle of lens and spot
    assert parts[0] + 0.05 < parts[1] < 1.0
    assert parts[2] == 1.0
    dark = spot_layer(view, spot(5.2 * math.tan(math.pi / 6.0)), geometry)
    assert dark.total_electrons_per_s[0] == 0.0


# -- mirrors of revolution -------------------------------------------------------------------------------------------


def held(shape: str, kind: str, *, aligned: bool) -> Rig:
    rig = revolved(shape, aligned=aligned)
    return dataclasses.replace(
        rig, holder=fitted_holder(kind, rig.mirror.profile.rim_radius_m, rig.mirror.profile.depth_m)
    )


@pytest.mark.slow
@pytest.mark.parametrize("shape", PROFILES)
@pytest.mark.parametrize("kind", [*KINDS, "tube"])
def test_nothing_of_it_stands_between_lens_and_a_mirror_of_revolution(kind: str, shape: str) -> None:
    """Segments from all over the lens to the mirror, with rods as near as they may be; and all of the mirror is seen.

    The mirror keeps within what the rig says of its extent; the holder hides none of it.
    """
    rng, bare = np.random.default_rng(3), revolved(shape, aligned=False)
    extent, profile = bare.extent, bare.mirror.profile
    tight = extent.wide_m + (1e-6 if kind == "tube" else prism_radius_m(0.004) + 1e-6)
    view = dataclasses.replace(bare, holder=Holder(kind, circle_m=tight, rise_m=extent.high_m + 0.009)).at(0.2)
    # a tenth of them on the rim itself
    r = profile.rim_radius_m * np.sqrt(np.minimum(1.1 * rng.random(20_000), 1.0))
    turn = rng.uniform(0.0, 2.0 * np.pi, 20_000)
    ends = np.stack([r * np.cos(turn), r * np.sin(turn), profile.sag(r * r).z_m], axis=1)
    ends = view.T_world_sphere.points(ends)
    own = own_frame(view, ends)
    length = float(np.linalg.norm(view.sphere_centre_m - view.camera_centre_m))
    assert np.hypot(own[:, 0], own[:, 1]).max() == pytest.approx(extent.wide_m, abs=1e-4)
    assert own[:, 2].max() - length == pytest.approx(extent.high_m, abs=1e-4)
    lens = view.T_world_camera.points(
        view.rig.camera.aperture_radius_m * np.stack([np.cos(turn), np.sin(turn), 0.0 * turn], axis=1)
    )
    way = ends - lens
    distance = np.linalg.norm(way, axis=1)
    assert np.all(first_hit(view.holder_shapes, lens, way / distance[:, None]).distance_m > distance)


@pytest.mark.parametrize(("shape", "kind"), [("hyperboloid", "rods"), ("ellipsoid", "post"), ("paraboloid", "tube")])
def test_accuracy_spots_in_a_held_mirror_of_revolution(shape: str, kind: str) -> None:
    """Spots around the rig: hidden where rays from the camera meet a part, else certified, the cut ones as well."""
    view, room = held(shape, kind, aligned=False).at(0.3), lab()
    geometry, names, causes = room_geometry(room, view), view.rig.holder.part_names, []
    for turn in np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False):
        c, s = math.cos(turn), math.sin(turn)
        spot = LaserSpot((1.5 * c, 1.5 * s, 0.5), (-c, -s, 0.0), 0.006)
        truth = spot_truth(view, spot, geometry)
        rays = trace_pixels(view, np.array([[truth.u_px, truth.v_px]]))
        met = first_hit(view.holder_shapes, rays.points_m, rays.directions).object_id[0]
        causes.append(truth.cause)
        if kind != "tube":  # which bends the ray
            assert truth.cause == ("none" if met < 0 else f"occluded:{names[met]}")
        if len(causes) % 8 == 1 and truth.visible:
            assert certify(view, spot, geometry, truth, spot_layer(view, spot, geometry)).passed
    hidden = {cause for cause in causes if cause != "none"}
    assert (
        hidden
        == {
            "rods": {f"occluded:holder_rod_{k}" for k in (1, 2, 3)},
            "post": {"occluded:holder_column"},
            "tube": set(),
        }[kind]
    )


def test_a_post_ends_on_the_back_of_a_mirror_of_revolution() -> None:
    view = held("hyperboloid", "post", aligned=True).at(0.0)
    *_, post = view.holder_shapes
    low = post.T_world_shape.t[2] - 0.5 * post.size_m[2]
    assert low == pytest.approx(view.sphere_centre_m[2] + view.rig.mirror.profile.depth_m, abs=1e-12)


# -- sizes -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "sizes", "words"),
    [
        ("rods", {"circle_m": 0.064}, "inside the mirror"),
        ("rods", {"plate_m": 0.08}, "outside the plate"),
        ("rods", {"rise_m": 0.06}, "top would lie inside the mirror"),
        ("post", {"circle_m": 0.05}, "column would stand inside the mirror"),
        ("post", {"radius_m": 0.06, "circle_m": 0.2, "plate_m": 0.3, "rise_m": 0.2}, "thicker than the mirror"),
        ("post", {"rise_m": 0.067}, "give more than 0.0680"),
        ("rods", {"radius_m": -1.0}, "allowed range"),
        ("tube", {"circle_m": 0.06}, "tube would stand inside the mirror"),
        ("tube", {"wall_m": 0.0}, "wall_m = 0.0: allowed range is 0.0001"),
        ("tube", {"wall_m": -0.003}, "allowed range"),
        ("tube", {"plate_m": 0.083}, "wall would stand outside the plate; give at least 0.0832"),
        ("tube", {"rise_m": 0.06}, "top would lie inside the mirror"),
        ("tube", {"glass_index": 0.99}, "allowed range is 1.0 to 2.5"),
        ("tube", {"glass_index": 2.6}, "allowed range is 1.0 to 2.5"),
        ("tube", {"glass_index": math.nan}, "finite"),
        ("rods", {"azimuth_rad": math.nan}, "finite"),
    ],
)
def test_impossible_sizes_are_one_sentence(kind: str, sizes: dict[str, float], words: str) -> None:
    with pytest.raises(SceneError, match=words) as error:
        dataclasses.replace(default_rig(), holder=Holder(kind, **sizes))
    assert "\n" not in str(error.value)


def test_limits_of_sizes_themselves_are_possible() -> None:
    thick = prism_radius_m(0.004)
    for kind, sizes in (
        ("rods", {"circle_m": BALL_M + thick + 1e-9, "plate_m": BALL_M + 2.0 * thick + 2e-9, "rise_m": BALL_M + 1e-9}),
        ("tube", {"circle_m": BALL_M + 1e-9, "wall_m": 1e-4, "plate_m": 0.0603, "rise_m": BALL_M + 1e-9}),
        ("post", {"radius_m": 0.059, "circle_m": 0.12, "plate_m": 0.2, "rise_m": BALL_M + 0.119}),
    ):
        view = dataclasses.replace(default_rig(), holder=Holder(kind, **sizes)).at(0.0)
        assert len(view.holder_shapes) == len(view.rig.holder.part_names)


def test_it_moves_with_the_rig_and_survives_misalignment_and_storage() -> None:
    crooked = rig("rods", CROOKED)
    assert crooked.holder == rig("rods").holder
    down, up = crooked.at(0.0), crooked.at(0.7)
    shift = np.array(crooked.stroke_axis_world) * 0.7
    for a, b in zip(down.holder_shapes, up.holder_shapes, strict=True):
        assert b.T_world_shape.t - a.T_world_shape.t == pytest.approx(shift, abs=1e-12)
    assert from_json(Rig, to_json(crooked)) == crooked
    assert "holder" not in to_json(default_rig())
    assert from_json(Rig, to_json(default_rig())) == default_rig()
