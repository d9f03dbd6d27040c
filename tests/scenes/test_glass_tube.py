"""A holder of glass: its closed forms against Snell's law, and truth, spots, views and certificates with it."""

from __future__ import annotations

import dataclasses
import math
from importlib.util import find_spec

import numpy as np
import pytest
from helpers.snell import through

from phibench.datasets.store.json_forms import from_json, to_json
from phibench.estimator.geometry.least_squares_depth import depth_general
from phibench.estimator.geometry.reflection import image_of
from phibench.estimator.geometry.triangulate import depth_exact, exact_gradient
from phibench.render.optics import certificate
from phibench.render.optics.certificate import certify
from phibench.render.optics.ray_tracer import trace_pixels
from phibench.render.optics.reflection_point import mirror_points
from phibench.render.optics.room_tracer import RoomGeometry, rays_into_room, room_geometry
from phibench.render.optics.spot_layer import spot_layer
from phibench.render.optics.truth import spot_truth, truth_layer
from phibench.render.setup.variant import activate
from phibench.scenes.glass_tube import GlassTube
from phibench.scenes.holder import OF_TUBES, Holder, fitted_holder
from phibench.scenes.laser import LaserSpot
from phibench.scenes.misalignment import Misalignment
from phibench.scenes.rig import Rig, View
from phibench.scenes.room import default_rig, lab

BALL_M = 0.060
ALIGNED = Misalignment()
CROOKED = Misalignment(tilt_x_rad=0.02, tilt_y_rad=-0.03, decentre_x_m=0.004, stroke_tilt_x_rad=0.02)
FORMED = dataclasses.replace(CROOKED, form_22c_m=1e-4, form_30_m=-5e-5)
RIGS = {"aligned": ALIGNED, "crooked": CROOKED, "formed": FORMED}


def rig(misalignment: Misalignment = ALIGNED, **sizes: float) -> Rig:
    return dataclasses.replace(default_rig(), holder=fitted_holder("tube", BALL_M, **sizes)).perturbed(misalignment)


def tube(rng: np.random.Generator, inner_m: float = 0.075, wall_m: float = 0.003) -> GlassTube:
    """Tube of any index, somewhere, in any direction."""
    axis = rng.normal(size=3)
    index = rng.uniform(1.2, 2.5)
    return GlassTube(inner_m, inner_m + wall_m, index, -9.0, 9.0, rng.normal(size=3), axis / np.linalg.norm(axis))


def rays(rng: np.random.Generator, one: GlassTube, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Rays from anywhere inside in any direction that leads to the wall within 10 radii."""
    d = rng.normal(size=(20 * count, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    d = d[np.abs(d @ one.axis) < 0.995][:count]
    p = rng.normal(size=(count, 3))
    p -= np.outer(p @ one.axis, one.axis)
    p *= (one.inner_m * 0.999 * np.sqrt(rng.random(count)) / np.linalg.norm(p, axis=1))[:, None]
    return one.origin_m + p + np.outer(rng.uniform(-0.2, 0.2, count), one.axis), d


# -- closed forms ----------------------------------------------------------------------------------------------------


def test_accuracy_of_the_closed_form_against_snells_law() -> None:
    """Rounding of 1e-16 in places of some metres, times the 10 that a ray of cosine 0.995 runs per radius."""
    worst = 0.0
    for seed in range(10):
        rng = np.random.default_rng(seed)
        one = tube(rng, wall_m=rng.uniform(0.001, 0.03))
        points, directions = rays(rng, one, 1000)
        found, expected = one.leave(points, directions), through(one, points, directions)
        for a, b in zip((found.inner_m, found.outer_m, found.directions), expected, strict=True):
            worst = max(worst, float(np.abs(a - b).max()))
        bent = np.linalg.norm(found.directions - directions, axis=1)
        assert bent.max() > 0.01  # skew rays are turned
    print(f"glass tube, 10 000 rays: {worst:.1e}")
    assert worst < 1e-12


def test_a_wide_tube_is_a_plane_plate() -> None:
    """Shift of a ray across itself, t sin(i) (1 - cos(i) / (n cos(i'))), up to the curvature: 30 mm / 1 km."""
    rng = np.random.default_rng(1)
    one = GlassTube(1000.0, 1000.003, 1.473, -9.0, 9.0, np.zeros(3), np.array([0.0, 0.0, 1.0]))
    d = rng.normal(size=(200, 3))
    d[:, 0] = np.abs(d[:, 0]) + 0.1
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    points = np.broadcast_to([999.9999, 0.0, 0.0], d.shape)
    found = one.leave(points, d)
    offset = found.outer_m - points
    shift = np.linalg.norm(offset - np.sum(offset * d, axis=1, keepdims=True) * d, axis=1)
    sine = np.sqrt(1.0 - d[:, 0] ** 2)
    plate = 0.003 * sine * (1.0 - d[:, 0] / np.sqrt(1.473**2 - sine**2))
    assert shift == pytest.approx(plate, rel=1e-4, abs=1e-9)
    assert plate.max() > 1e-3
    assert found.directions == pytest.approx(d, abs=1e-4)


def test_what_bare_glass_passes() -> None:
    """2 n / (n^2 + 1) straight on; all of one polarisation at Brewster's angle; nothing at grazing incidence."""
    one = tube(np.random.default_rng(0))
    n = one.index
    assert one.transmittance(np.array([1.0, 0.0])) == pytest.approx([2.0 * n / (n * n + 1.0), 0.0])
    cos = 1.0 / math.hypot(1.0, n)
    r_s = ((1.0 - n * n) / (1.0 + n * n)) ** 2
    assert one.transmittance(np.array([cos]))[0] == pytest.approx(0.5 + 0.5 * (1.0 - r_s) / (1.0 + r_s))


def test_points_outside_as_they_appear_from_inside() -> None:
    """From a place and a ray's end back to the ray, and areas by differences."""
    for seed in range(5):
        rng = np.random.default_rng(seed)
        one = tube(rng)
        places, directions = rays(rng, one, 300)
        flat = np.abs(directions @ one.axis) < 0.9
        places, directions = places[flat], directions[flat]
        crossing = one.leave(places, directions)
        ends = crossing.outer_m + rng.uniform(0.1, 5.0, (len(places), 1)) * crossing.directions
        seen, growth = one.seen_from(places, ends)
        way = seen - places
        assert way / np.linalg.norm(way, axis=1, keepdims=True) == pytest.approx(directions, abs=1e-12)

        def outside(apparent: np.ndarray, places: np.ndarray = places, one: GlassTube = one) -> np.ndarray:
            """Points at which light from apparent ones is: as far along the ray behind the glass."""
            way = apparent - places
            length = np.linalg.norm(way, axis=1, keepdims=True)
            L, q = one.invariants(places, way / length)
            bend = one.bend(L, q)
            return one.origin_m + one.turned(apparent - one.origin_m, bend.turn) + bend.lift[:, None] * one.axis

        assert outside(seen) == pytest.approx(ends, abs=1e-12)
        h = 1e-5 * np.eye(3)
        slopes = np.stack([(outside(seen + step) - outside(seen - step)) / 2e-5 for step in h], axis=-1)
        assert growth == pytest.approx(np.linalg.det(slopes), abs=1e-8)  # h^2 / wall^2 and rounding / h
        assert np.abs(growth - 1.0).max() > 1e-3


# -- truth and spots -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", RIGS)
def test_accuracy_of_the_way_there_and_back(name: str) -> None:
    """Pixels through mirror and glass to the wall, and the wall's points back to the pixels."""
    view, room, rng = rig(RIGS[name]).at(0.3), lab(), np.random.default_rng(2)
    geometry = room_geometry(room, view)
    uv = rng.uniform([310, 30], [970, 690], (2000, 2))
    hit = trace_pixels(view, uv)
    seen = np.flatnonzero(hit.cos_incidence > 0.05)
    uv = uv[seen]
    way = rays_into_room(view, geometry, hit.points_m[seen], hit.directions[seen])
    found = geometry.first_hit(way.starts_m, way.directions)
    wall = found.object_id < len(room.surfaces) + len(room.furniture)
    points = (way.starts_m + found.distance_m[:, None] * way.directions)[wall]
    eyes = np.broadcast_to(view.camera_centre_m, points.shape)
    back = mirror_points(view, points, eyes)
    assert back.lit.all()
    assert np.all(back.bent)
    again = view.rig.camera.project(view.T_world_camera.inverse().points(back.points_m))
    worst = np.abs(again - uv[wall]).max()
    print(f"{name}: {wall.sum()} pixels, {worst:.1e} px")
    assert worst < 1e-9
    straight = mirror_points(dataclasses.replace(view, rig=dataclasses.replace(view.rig, holder=None)), points, eyes)
    bare = view.rig.camera.project(view.T_world_camera.inverse().points(straight.points_m))
    assert np.abs(bare - uv[wall]).max() > 1e-3


SPOTS = {
    "flat": LaserSpot((5.2, 0.7, 2.0), (-1.0, 0.0, 0.0), 0.008, 0.7),
    "beam": LaserSpot((5.2, 0.7, 2.0), (-1.0, 0.0, 0.0), 0.008, None, beam_direction_world=(0.98, 0.1, 0.15)),
}
ROUGH = {"smooth": 0.0, "rough": 0.002}


@pytest.mark.parametrize(
    ("spot", "roughness", "name"),
    [("flat", "smooth", "aligned"), ("flat", "smooth", "formed"), ("beam", "smooth", "crooked")]
    + [("flat", "rough", "crooked")],
)
def test_certificates_with_glass(spot: str, roughness: str, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two sides that know of the glass agree; where one of them does not, chief ray and flux tell."""
    monkeypatch.setattr(certificate, "_LOG2_RAYS", (13,))  # no more for those that fail
    plain = rig(RIGS[name], wall_m=0.006)
    held = dataclasses.replace(plain, mirror=dataclasses.replace(plain.mirror, roughness_alpha=ROUGH[roughness]))
    view, bare = held.at(0.3), dataclasses.replace(held, holder=None).at(0.3)
    geometry, light = room_geometry(lab(), view), SPOTS[spot]
    truth, layer = spot_truth(view, light, geometry), spot_layer(view, light, geometry)
    right = certify(view, light, geometry, truth, layer)
    print(spot, roughness, name, right)
    assert right.passed
    without = certify(bare, light, geometry, truth, layer)
    assert not without.passed
    assert without.chief_difference_px > certificate.CHIEF_TOLERANCE_PX
    wrong = certify(view, light, geometry, truth, spot_layer(bare, light, geometry))
    assert not wrong.passed
    assert wrong.flux_difference > 0.07  # 7 % is what the glass keeps back
    assert wrong.centroid_difference_px < 10.0 * certificate.CENTROID_TOLERANCE_PX


def test_power_follows_the_map_and_not_only_the_glass() -> None:
    """Thick glass of a high index close to the mirror: areas change by more than the certificate allows."""
    held = rig(CROOKED, wall_m=0.03, glass_index=2.0, circle_m=0.062)
    light = LaserSpot((0.45, 0.1, 0.9), (-1.0, 0.0, 0.0), 0.004, 0.7)
    view = held.at(0.3)
    truth, layer = spot_truth(view, light, ()), spot_layer(view, light, ())
    assert certify(view, light, (), truth, layer).passed
    bare = dataclasses.replace(held, holder=None).at(0.3)
    point, eye = np.array([light.position_world_m]), view.camera_centre_m[None]
    found = mirror_points(view, point, eye)
    way = found.apparent_m - found.points_m
    passing = view.tube.leave(found.points_m, way / np.linalg.norm(way, axis=1)[:, None]).transmittance[0]
    part = layer.total_electrons_per_s[0] / spot_layer(bare, light, ()).total_electrons_per_s[0]
    assert abs(part / passing - 1.0) > 0.01  # 1 % more or less than the glass passes: by the map's areas


def test_glass_of_air_changes_nothing() -> None:
    """A refractive index of 1: the plates alone are left."""
    view, bare = rig(CROOKED, glass_index=1.0).at(0.3), default_rig().perturbed(CROOKED).at(0.3)
    for light in SPOTS.values():
        a, b = (spot_truth(one, light, room_geometry(lab(), one)) for one in (view, bare))
        assert (a.u_px, a.v_px, a.path_spot_mirror_m) == pytest.approx(
            (b.u_px, b.v_px, b.path_spot_mirror_m), abs=1e-12
        )
        one, other = (spot_layer(v, light, room_geometry(lab(), v)) for v in (view, bare))
        assert one.electrons_per_s == pytest.approx(other.electrons_per_s, rel=1e-9, abs=1e-6)


def test_what_the_glass_costs_an_estimator_that_neglects_it() -> None:
    """D is too short by a plate's t (1 - 1/n), about 1 mm; steep rays, in height or by the mirror, add to that."""
    view, rows = rig(), []
    for depth in (1.0, 2.5, 4.2):
        points = np.array([[depth, 0.0, z] for z in (0.05, 0.5, 1.0, 1.5, 2.0)])
        shifts, errors = [], []
        for stroke in (0.2, 0.5, 1.0):
            images = [[chief_px(one.at(h), points) for h in (0.0, stroke)] for one in (view, default_rig())]
            shifts.append(np.linalg.norm(np.subtract(*images), axis=-1).max())
            errors.append(depth_exact(default_rig(), stroke, *images[0]).depth_m / depth - 1.0)
        low, high = 1e2 * np.min(errors), 1e2 * np.max(errors)
        print(f"{depth} m: {max(shifts):.4f} px, {low:.3f} to {high:.3f} %")
        rows.append((max(shifts), low * depth / 0.1, high * depth / 0.1))
    plate_mm = 3.0 * (1.0 - 1.0 / 1.473)
    assert np.array(rows)[:, 2] == pytest.approx(-plate_mm, rel=0.1)
    assert np.array(rows)[:, 1].min() > -2.5 * plate_mm
    assert rows[0][0] == pytest.approx(0.135, abs=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["aligned", "crooked"])
def test_estimators_that_know_of_the_glass_are_exact(name: str) -> None:
    """D, point and image by the estimator's Snell's law, from pixels of the simulator's closed form; derivatives."""
    one, rng = rig(RIGS[name], wall_m=0.006), np.random.default_rng(4)
    turn, depth = rng.uniform(0.0, 2.0 * np.pi, 200), rng.uniform(0.8, 5.0, 200)
    points = np.stack([depth * np.cos(turn), depth * np.sin(turn), rng.uniform(0.05, 2.2, 200)], axis=1)
    down, up = (chief_px(one.at(h), points) for h in (0.0, 0.5))
    image = image_of(one.at(0.5), points)
    assert image.uv_px == pytest.approx(up, abs=1e-9)
    true = np.hypot(*(points - one.at(0.0).sphere_centre_m)[:, :2].T)
    covariance = np.broadcast_to(np.eye(2), (200, 2, 2))
    exact, general = depth_exact(one, 0.5, down, up), depth_general(one, 0.5, down, up, covariance, covariance)
    for found in (exact, general):
        assert found.depth_m == pytest.approx(true, rel=1e-9)  # 1e-12 px, times the 500 of D by pixels
        assert found.point_world_m == pytest.approx(points, abs=1e-8)
    without = depth_exact(dataclasses.replace(one, holder=None), 0.5, down, up)
    assert np.abs(without.depth_m - true).min() > 1e-3
    by_pixel = np.moveaxis(np.array([(numeric(one, down, up, k)) for k in range(4)]), 0, -1)
    assert exact_gradient(one, 0.5, down, up) == pytest.approx(by_pixel, rel=1e-5, abs=1e-6)
    steps = 1e-5 * np.eye(3)
    slopes = [(image_of(one.at(0.5), points + h).uv_px - image_of(one.at(0.5), points - h).uv_px) / 2e-5 for h in steps]
    assert image.px_per_m == pytest.approx(np.stack(slopes, axis=-1), rel=1e-4, abs=1e-3)


def numeric(one: Rig, down: np.ndarray, up: np.ndarray, k: int) -> np.ndarray:
    """Derivative of D by the k-th of four pixel coordinates."""
    h = 1e-4 * np.eye(4)[k]
    plus, minus = (depth_exact(one, 0.5, down + s * h[:2], up + s * h[2:]).depth_m for s in (1.0, -1.0))
    return (plus - minus) / 2e-4


def chief_px(view: View, points: np.ndarray) -> np.ndarray:
    found = mirror_points(view, points, np.broadcast_to(view.camera_centre_m, points.shape))
    return view.rig.camera.project(view.T_world_camera.inverse().points(found.points_m))


def pixels_of(planes: dict[str, np.ndarray], k: int, count: int) -> np.ndarray:
    """Some (v, u) that show an object."""
    places = np.argwhere(planes["object_id"] == k)
    return places[np.random.default_rng(0).choice(len(places), count, replace=False)]


def small(one: Rig, cells: int = 8) -> Rig:
    """The same rig with larger pixels."""
    camera = one.camera
    size = {"width_px": camera.width_px // cells, "height_px": camera.height_px // cells}
    focal = {"fx_px": camera.fx_px / cells, "fy_px": camera.fy_px / cells}
    middle = {"cx_px": (size["width_px"] - 1) / 2.0, "cy_px": (size["height_px"] - 1) / 2.0}
    pitch = camera.pixel_pitch_um * cells
    return dataclasses.replace(one, camera=dataclasses.replace(camera, **size, **focal, **middle, pixel_pitch_um=pitch))


def test_plates_hide_spots_and_glass_hides_none() -> None:
    """What a pixel sees on a plate hides the spot that it would see else; no cause speaks of glass."""
    view, room = small(rig(rise_m=0.062, plate_m=0.2)).at(0.3), lab()  # else few pixels see the upper plate
    free = small(default_rig()).at(0.3)
    geometry = room_geometry(room, view)
    seen, else_ = truth_layer(view, geometry), truth_layer(free, room_geometry(room, free))
    names = (*room.object_names(view), *view.rig.holder.part_names)
    assert view.rig.holder.part_names == ("holder_plate_low", "holder_plate_high")
    for part in view.rig.holder.part_names:
        causes = set()
        for v, u in pixels_of(seen, names.index(part), 8):
            point = np.array([else_[axis][v, u] for axis in ("x_m", "y_m", "z_m")])
            away = free.sphere_centre_m - point
            light = LaserSpot(tuple(point), tuple(away), 0.004, 0.7)
            causes.add(spot_truth(view, light, geometry).cause)
        assert f"occluded:{part}" in causes
        assert causes <= {f"occluded:{part}", "mirror_edge", "occluded:camera_housing"}
    on_wall = pixels_of(seen, names.index("wall_east"), 20)
    for v, u in on_wall:
        point = tuple(seen[axis][v, u] for axis in ("x_m", "y_m", "z_m"))
        truth = spot_truth(view, LaserSpot(point, (-1.0, 0.0, 0.0), 0.004, 0.7), geometry)
        assert truth.cause in ("none", "mirror_edge")
        assert (truth.u_px, truth.v_px) == pytest.approx((u, v), abs=1e-9)
        assert truth.phi_ray_rad == pytest.approx(seen["phi_ray_rad"][v, u], abs=1e-12)
        whole = truth.path_spot_mirror_m + truth.path_mirror_camera_m
        assert whole == pytest.approx(seen["path_m"][v, u], abs=1e-12)


def test_a_ray_that_meets_a_plate_within_the_wall() -> None:
    """Such pixels show the plate where the glass ends, at the height of its inner face."""
    view = rig(wall_m=0.02, rise_m=0.062).at(0.3)
    geometry = RoomGeometry(view.holder_shapes)
    hit = trace_pixels(view, np.random.default_rng(0).uniform([300, 20], [980, 700], (200_000, 2)))
    seen = np.flatnonzero(np.isfinite(hit.cos_incidence))
    points, directions = hit.points_m[seen], hit.directions[seen]
    crossing = view.tube.leave(points, directions)
    ends = np.flatnonzero(crossing.crosses & ~crossing.passes)
    assert len(ends) > 100
    way = rays_into_room(view, geometry, points[ends], directions[ends])
    found = geometry.first_hit(way.starts_m, way.directions)
    place = way.starts_m + found.distance_m[:, None] * way.directions
    height = view.tube.height_m(place)
    assert np.minimum(np.abs(height - view.tube.low_m), np.abs(height - view.tube.high_m)).max() < 1e-12
    assert set(found.object_id) == {0, 1}
    assert np.all(way.path_m > 0.0)


# -- views -----------------------------------------------------------------------------------------------------------


@pytest.mark.skipif(find_spec("mitsuba") is None, reason="needs Mitsuba")
def test_accuracy_of_the_look_through_glass() -> None:
    """The kernel's closed form against the other one: 1e-16 of 0.1 m, times 10 for rays along the axis."""
    from phibench.render.room.glass_refraction import Tube

    mi = activate()
    view, rng = rig(CROOKED).at(0.3), np.random.default_rng(0)
    n = rng.normal(size=(5000, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    points, d = view.sphere_centre_m + BALL_M * n, n + 0.9 * np.cross(n, rng.normal(size=n.shape))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    d = np.where(np.abs(d @ view.tube.axis)[:, None] < 0.99, d, n)
    places, ways = (
        mi.Vector3d(*(mi.Float64(np.ascontiguousarray(a[:, i])) for i in range(3)))
        for a in (1000.0 * (points - view.sphere_centre_m), d)
    )
    inner, outer, onward, passing = (np.array(value).T for value in Tube(mi, view).cross(places, ways))
    exact = view.tube.leave(points, d)
    flat = np.abs(d @ view.tube.axis) < 0.99
    for found, expected in ((inner, exact.inner_m), (outer, exact.outer_m)):
        assert (1e-3 * found + view.sphere_centre_m)[flat] == pytest.approx(expected[flat], abs=1e-12)
    assert onward[flat] == pytest.approx(exact.directions[flat], abs=1e-12)
    assert passing[flat] == pytest.approx(exact.transmittance[flat], abs=1e-9)


def test_it_survives_misalignment_and_storage() -> None:
    crooked = rig(CROOKED)
    assert from_json(Rig, to_json(crooked)) == crooked
    assert set(OF_TUBES) <= set(to_json(crooked)["holder"])
    rods = dataclasses.replace(default_rig(), holder=Holder("rods"))
    assert not set(OF_TUBES) & set(to_json(rods)["holder"])
    assert from_json(Rig, to_json(rods)) == rods
    low, high = crooked.at(0.0), crooked.at(0.7)
    assert high.tube.origin_m - low.tube.origin_m == pytest.approx(0.7 * np.array(crooked.stroke_axis_world), abs=1e-12)
    ends = [shape.T_world_shape.t for shape in low.holder_shapes]
    for place, z in zip(ends, (low.tube.low_m - 0.002, low.tube.high_m + 0.002), strict=True):
        assert low.tube.height_m(place[None])[0] == pytest.approx(z, abs=1e-12)
