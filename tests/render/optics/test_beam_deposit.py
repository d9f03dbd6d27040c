"""Spots of beams: closed forms on walls, plain Monte Carlo on curved things and edges, coats by their energy."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from phibench.render.optics.beam_deposit import deposit, inside_reflectance, transmittance
from phibench.render.optics.certificate import CENTROID_TOLERANCE_PX, FLUX_TOLERANCE, _differences, certify
from phibench.render.optics.faces import face_table
from phibench.render.optics.ray_tracer import trace_pixels
from phibench.render.optics.room_tracer import RoomGeometry
from phibench.render.optics.spot_layer import spot_layer, spot_light
from phibench.render.optics.spot_samples import disc_nodes
from phibench.render.optics.truth import spot_truth
from phibench.scenes.frames import Pose, rotation_xyz
from phibench.scenes.laser import LaserSpot
from phibench.scenes.rig import View
from phibench.scenes.room import default_rig
from phibench.scenes.shapes import Bitmap, Checker, Cuboid, Mesh, Prism, Rectangle, Shape, Uniform, rectangle
from phibench.scenes.validation import SceneError

VIEW = default_rig().at(0.2)
START = np.array([0.0, 0.0, 0.7])


def beam_onto(shapes: tuple[Shape, ...], aim: tuple[float, float, float], **options: object) -> LaserSpot:
    """Spot of a beam from the axis through a point."""
    direction = np.array(aim) - START
    direction /= np.linalg.norm(direction)
    geometry = RoomGeometry(shapes)
    hits = geometry.first_hit(START[None], direction[None])
    normal = geometry.table.normal[hits.patch[0]]
    point = START + hits.distance_m[0] * direction
    return LaserSpot(tuple(point), tuple(normal), 5e-3, None, beam_direction_world=tuple(direction), **options)  # type: ignore[arg-type]


def wall(**options: object) -> Rectangle:
    """Wall 2 m ahead, turned by 45 degrees away from the beam."""
    return rectangle("wall", (2.0, 0.0, 0.7), (-1.0, -1.0, 0.0), (1.0, 1.0), **options)


BOX = Cuboid("box", Pose("world", "shape", (2.0, 0.0, 0.55), rotation_xyz(z_rad=0.5)), (0.3, 0.3, 0.3))
CORNER_M = BOX.T_world_shape.points(np.array([-0.15, 0.15, 0.15]))  # the edge below it looks at the axis
PRISM = Prism("post", Pose("world", "shape", (2.0, 0.3, 0.7)), 0.012, 0.4, 24)


def test_footprint_on_a_wall_at_45_degrees() -> None:
    """Second moments sigma^2 (1, 1 / cos^2), centre at the spot, power a P: sums over nodes, to their rounding."""
    spot = beam_onto((wall(),), (2.0, 0.0, 0.7))
    disc, weights = disc_nodes("gaussian", 1.0)
    light = deposit(spot, RoomGeometry((wall(),)), disc)
    offset = light.points_m - np.array(spot.position_world_m)
    along, up = np.array([1.0, -1.0, 0.0]) / math.sqrt(2.0), np.array([0.0, 0.0, 1.0])
    sigma2 = (5e-3 / 4.0) ** 2
    np.testing.assert_allclose(weights @ offset, 0.0, atol=1e-15)
    moments = [weights @ ((offset @ a) * (offset @ b)) for a, b in ((along, along), (up, up), (along, up))]
    np.testing.assert_allclose(moments, [2.0 * sigma2, sigma2, 0.0], rtol=1e-6, atol=1e-6 * sigma2)
    assert weights @ light.strength == pytest.approx(0.7, abs=1e-12)


def test_flux_and_centroid_on_a_wall_at_45_degrees() -> None:
    """A small beam's spot is a small disc's: flux and centroid do not know the shape below 0.05 px.

    The shape changes the centroid by the second derivative of the image, of the order (0.1 mm / 2 m)^2 of 300 px.
    """
    spot = dataclasses.replace(beam_onto((wall(),), (2.0, 0.0, 0.7)), diameter_m=1e-4)
    disc = dataclasses.replace(spot, beam_direction_world=None, albedo=0.7)
    beam_layer, disc_layer = (spot_layer(VIEW, one, (wall(),)) for one in (spot, disc))
    assert beam_layer.total_electrons_per_s[0] == pytest.approx(disc_layer.total_electrons_per_s[0], rel=1e-6)
    np.testing.assert_allclose(beam_layer.centroid_uv_px, disc_layer.centroid_uv_px, atol=1e-6)
    # and a wall that looks elsewhere scatters less towards the mirror: cos 45 against cos 0
    facing = rectangle("wall", (2.0, 0.0, 0.7), (-1.0, 0.0, 0.0), (1.0, 1.0))
    straight = spot_layer(VIEW, dataclasses.replace(spot, normal_world=(-1.0, 0.0, 0.0)), (facing,))
    ratio = beam_layer.total_electrons_per_s[0] / straight.total_electrons_per_s[0]
    to_mirror = np.array(spot_truth(VIEW, spot, ()).reflection_point_world_m) - np.array(spot.position_world_m)
    assert ratio == pytest.approx(to_mirror @ spot.normal_world / -to_mirror[0], rel=1e-6)


def test_step_of_albedo_through_the_middle_moves_the_centroid() -> None:
    """Half a Gaussian has its centroid at sigma sqrt(2 / pi); two halves of albedo a and b at (b - a) / (a + b) of it.

    The image moves by that times the derivative of the chief ray's pixel; curvature over 0.6 mm is below 1e-3 px, and
    2^15 quasi-random pairs leave less than 1e-3 px.
    """
    facing = rectangle(
        *("wall", (2.0, 0.0, 0.7), (-1.0, 0.0, 0.0), (1.0, 1.0)),
        texture=Checker((0.8, 0.8, 0.8), (0.1, 0.1, 0.1), (0.5, 9.0), (0.0, -4.5)),
    )
    spot = beam_onto((facing,), (2.0, 0.0, 0.7))
    rng, geometry = np.random.default_rng(0), RoomGeometry((facing,))
    light = deposit(spot, geometry, rng.normal(size=(200_000, 2)))
    shift_m = float(light.strength @ light.points_m[:, 1] / light.strength.sum())
    expected_m = 1.25e-3 * math.sqrt(2.0 / math.pi) * 0.7 / 0.9
    assert abs(shift_m) == pytest.approx(expected_m, rel=0.02)  # 200 000 draws: 0.3 %
    step = np.array([0.0, math.copysign(expected_m, shift_m), 0.0])
    moved, still = (
        spot_truth(VIEW, dataclasses.replace(spot, position_world_m=tuple(np.array(spot.position_world_m) + d)), ())
        for d in (step, 0.0 * step)
    )
    layer = spot_layer(VIEW, spot, geometry)
    found = layer.centroid_uv_px - [still.u_px, still.v_px]
    predicted = np.array([moved.u_px - still.u_px, moved.v_px - still.v_px])
    assert np.linalg.norm(predicted) > 0.04
    np.testing.assert_allclose(found, predicted, atol=2e-3)
    assert certify(VIEW, spot, geometry, still, layer).passed


@pytest.mark.slow
def test_place_of_a_torn_spot_on_the_wall_and_in_the_image() -> None:
    """Where the light of two halves of albedo a and b lies: sigma sqrt(2 / pi) (b - a) / (a + b) from the axis.

    2^15 quasi-random pairs leave 0.5 % of the spot's extent, 9 um. The place moves the image by 0.04 px, D by nothing
    here: it lies across. The angles are those of the chief ray to the place, to what 2e-3 px are: 1.5e-5 rad.
    """
    facing = rectangle(
        *("wall", (2.0, 0.0, 0.7), (-1.0, 0.0, 0.0), (1.0, 1.0)),
        texture=Checker((0.8, 0.8, 0.8), (0.1, 0.1, 0.1), (0.5, 9.0), (0.0, -4.5)),
    )
    spot, geometry = beam_onto((facing,), (2.0, 0.0, 0.7)), RoomGeometry((facing,))
    truth, layer = spot_truth(VIEW, spot, geometry), spot_layer(VIEW, spot, geometry)
    step_m = 1.25e-3 * math.sqrt(2.0 / math.pi) * 0.7 / 0.9
    offset = layer.place_m - spot.position_world_m
    assert abs(offset[1]) == pytest.approx(step_m, abs=9e-6)
    np.testing.assert_allclose(offset[[0, 2]], 0.0, atol=9e-6)
    certificate = certify(VIEW, spot, geometry, truth, layer)
    assert certificate.passed
    assert certificate.place_tolerance_m == pytest.approx(5e-3 * 1.25e-3 * math.sqrt(2.0), rel=0.2)
    on_the_axis = dataclasses.replace(layer, place_m=np.array(spot.position_world_m))
    assert not certify(VIEW, spot, geometry, truth, on_the_axis).passed
    light = spot_light(VIEW, layer)
    assert light is not None
    chief = spot_truth(VIEW, dataclasses.replace(spot, position_world_m=tuple(layer.place_m)), ())
    assert math.hypot(light.u_px - truth.u_px, light.v_px - truth.v_px) > 0.04
    for name in ("phi_ray_rad", "phi_normal_rad", "phi_incidence_rad", "azimuth_rad"):
        assert getattr(light, name) == pytest.approx(
            getattr(chief, name), abs=1.5e-5 if name != "azimuth_rad" else 1e-4
        )


HALF_PX = 1.1  # half of the window, in which the unblurred image lies


def monte_carlo(view: View, spot: LaserSpot, shapes: tuple[Shape, ...], count: int) -> np.ndarray:
    """Sums over rays from all over a window of the film: watts, watts u, watts v, each as (count,) samples.

    Rays go pixel -> lens -> sphere -> first triangle by Cramer's rule in a loop; a second one back along the beam.
    """
    rng, truth = np.random.default_rng(1), spot_truth(view, spot, ())
    uv = np.array([truth.u_px, truth.v_px]) + rng.uniform(-HALF_PX, HALF_PX, (count, 2))
    lens = rng.normal(size=(count, 2))
    lens *= (np.sqrt(rng.random(count)) / np.linalg.norm(lens, axis=1))[:, None]
    rays = trace_pixels(view, uv, view.rig.camera.aperture_radius_m * lens)
    t, face, table = first_triangle(shapes, rays.points_m, rays.directions)
    beam, centre = np.array(spot.beam_direction_world), np.array(spot.position_world_m)
    points = rays.points_m + np.where(np.isfinite(t), t, 0.0)[:, None] * rays.directions
    normal = table.normal[face]
    across = np.cross(points - centre, beam)
    irradiance = spot.irradiance_w_m2(np.linalg.norm(across, axis=1)) * np.maximum(-normal @ beam, 0.0)
    lit = np.flatnonzero(np.isfinite(t) & (irradiance > 1e-6 * irradiance.max()))
    back = points[lit] - 1e-6 * beam
    shadow = first_triangle(shapes, back, np.broadcast_to(-beam, back.shape))[0] < 0.3
    leaving = np.einsum("ni,ni->n", normal[lit], rays.directions[lit]) < 0.0
    radiance = np.zeros(count)
    radiance[lit] = 0.7 / math.pi * irradiance[lit] * (~shadow & leaving)
    camera = view.rig.camera
    cos4 = camera.rays(uv)[:, 2] ** 4
    etendue = camera.solid_angle_density(camera.normalised(uv)) * cos4 * math.pi * camera.aperture_radius_m**2
    watts = (
        (2.0 * HALF_PX) ** 2 * radiance * etendue * view.rig.mirror.reflectance(rays.cos_incidence, spot.wavelength_nm)
    )
    return np.stack([watts, watts * (uv[:, 0] - truth.u_px), watts * (uv[:, 1] - truth.v_px)])


def first_triangle(shapes: tuple[Shape, ...], origins: np.ndarray, directions: np.ndarray) -> tuple:
    table = face_table(shapes)
    distance, face = np.full(len(origins), np.inf), np.zeros(len(origins), dtype=int)
    for corners, patch in zip(table.corners_m, table.patch, strict=True):
        e1, e2, from_corner = corners[1] - corners[0], corners[2] - corners[0], origins - corners[0]
        across = np.cross(directions, e2)
        det, turned = across @ e1, np.cross(from_corner, e1)
        scale = np.divide(1.0, det, out=np.zeros_like(det), where=det != 0.0)
        a, b = np.einsum("ni,ni->n", from_corner, across) * scale, np.einsum("ni,ni->n", directions, turned) * scale
        t = turned @ e2 * scale
        nearer = (a >= 0) & (b >= 0) & (a + b <= 1) & (t > 1e-9) & (t < distance)
        distance[nearer], face[nearer] = t[nearer], patch
    return distance, face, table


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shapes", "aim"), [((BOX,), (*CORNER_M[:2], 0.6)), ((PRISM,), (2.0, 0.3114, 0.7))], ids=["edge", "prism"]
)
def test_edge_and_prism_against_plain_monte_carlo(shapes: tuple[Shape, ...], aim: tuple[float, float, float]) -> None:
    """Flux and centroid to 5 sigma of 150 000 rays (1 to 2 % and 6e-3 px each); a flat disc is off by more than 8."""
    spot = beam_onto(shapes, aim)
    sums = monte_carlo(VIEW, spot, shapes, 150_000)
    count = sums.shape[1]
    flux, sigma = sums[0].mean(), sums[0].std() / math.sqrt(count)
    assert sigma < 0.02 * flux
    near_rim = np.abs(sums[1:]) > 0.9 * HALF_PX * sums[0]
    assert sums[0][near_rim.any(axis=0)].sum() < 1e-4 * sums[0].sum()
    gain = VIEW.rig.camera.detector.laser_electrons_per_joule(spot.wavelength_nm)[0]
    truth, layer = spot_truth(VIEW, spot, shapes), spot_layer(VIEW, spot, shapes)
    flat = spot_layer(VIEW, dataclasses.replace(spot, albedo=0.7, beam_direction_world=None), ())
    assert abs(layer.total_electrons_per_s[0] / gain - flux) < 5.0 * sigma
    assert abs(flat.total_electrons_per_s[0] / gain - flux) > 8.0 * sigma
    for axis, place in enumerate(layer.centroid_uv_px - [truth.u_px, truth.v_px]):
        residual = sums[1 + axis] - place * sums[0]
        assert abs(residual.mean()) < 5.0 * residual.std() / math.sqrt(count)
    assert truth.visible
    assert certify(VIEW, spot, shapes, truth, layer).passed


BITMAP = Bitmap(np.random.default_rng(0).uniform(0.1, 0.9, (40, 40, 4)).astype(np.float32), (6e-3, 6e-3))
SHEET = Mesh(
    "sheet",
    np.array([[2.0, -0.5, 0.2], [2.1, 0.0, 0.2], [2.0, 0.0, 1.2], [2.0, 0.5, 0.2]]),
    np.array([[0, 2, 1], [1, 2, 3]]),
    BITMAP,
    np.array([[[0, 0], [40, 90], [90, 0]], [[90, 0], [40, 90], [0, 0]]], dtype=float),
)


@pytest.mark.parametrize("alpha", [0.0, 0.002])
@pytest.mark.parametrize(
    ("shapes", "aim"),
    [((SHEET,), (2.0, 0.001, 0.7)), ((wall(texture=BITMAP, coat=1.5),), (2.0, 0.0, 0.7)), ((BOX,), tuple(CORNER_M))],
    ids=["mesh", "coat", "corner"],
)
def test_certificate_of_a_beam(shapes: tuple[Shape, ...], aim: tuple[float, float, float], alpha: float) -> None:
    """Textures, coats, corners, smooth and rough mirrors pass; the layer of a flat disc does not."""
    rig = default_rig()
    view = dataclasses.replace(rig, mirror=dataclasses.replace(rig.mirror, roughness_alpha=alpha)).at(0.2)
    aim = (aim[0], aim[1], aim[2] - 1e-3) if shapes == (BOX,) else aim
    spot = beam_onto(shapes, aim)
    truth = spot_truth(view, spot, shapes)
    assert truth.visible
    assert certify(view, spot, shapes, truth, spot_layer(view, spot, shapes)).passed
    if alpha == 0.0:
        wrong = spot_layer(view, dataclasses.replace(spot, albedo=0.5, beam_direction_world=None), shapes)
        found = _differences(view, spot, RoomGeometry(shapes), truth, wrong, 13)
        assert max(found.centroid_px / CENTROID_TOLERANCE_PX, found.flux / FLUX_TOLERANCE) > 3.0


def test_certificate_of_a_beam_whose_tail_passes_an_edge() -> None:
    """0.5 % of the power lands behind, away from the rest, on a surface that faces the mirror: above 1 % of the light.

    The layer without it is more than three tolerances off, so the certificate's rays must find it.
    """
    lean = math.radians(82.0)
    panel = rectangle("panel", (2.0, 0.0, 0.7), (-math.cos(lean), math.sin(lean), 0.0), (0.2, 0.4))
    behind = rectangle("behind", (2.3, 0.0, 0.7), (-1.0, 0.0, 0.0), (0.6, 0.6))
    edge = np.array([0.1 * math.sin(lean), 0.1 * math.cos(lean)])
    inside = 2.6 * 5e-3 / 4.0
    aim = (2.0 + edge[0] - inside / math.tan(math.pi / 2.0 - lean), edge[1] - inside, 0.7)
    shapes = (panel, behind)
    spot = beam_onto(shapes, aim)
    truth, layer = spot_truth(VIEW, spot, shapes), spot_layer(VIEW, spot, shapes)
    certificate = certify(VIEW, spot, shapes, truth, layer)
    assert certificate.passed, certificate
    alone = spot_layer(VIEW, spot, (panel,))
    assert _differences(VIEW, spot, RoomGeometry(shapes), truth, alone, 15).flux > 3.0 * FLUX_TOLERANCE


def test_certificate_of_a_beam_that_an_edge_splits(monkeypatch: pytest.MonkeyPatch) -> None:
    """A part of the beam passes the edge of a board and lands 0.15 m behind it: two images, 7 px apart.

    2^15 rays about each are enough. About both together, as an image of one piece is covered, they are not.
    """
    board = rectangle("board", (0.6, 0.1, 0.7), (-1.0, 0.0, 0.0), (0.2, 0.4))
    behind = rectangle("behind", (0.75, 0.0, 0.7), (-0.9, -0.4, 0.0), (2.0, 2.0))
    shapes = (board, behind)
    spot = beam_onto(shapes, (0.6, 1e-3, 0.72))
    truth, layer = spot_truth(VIEW, spot, shapes), spot_layer(VIEW, spot, shapes)
    certificate = certify(VIEW, spot, shapes, truth, layer)
    assert certificate.passed, certificate
    apart = _differences(VIEW, spot, RoomGeometry(shapes), truth, layer, 15)
    assert apart.centroid_px < CENTROID_TOLERANCE_PX
    assert apart.flux < FLUX_TOLERANCE
    monkeypatch.setattr("phibench.render.optics.spot_samples._SCATTERED", 0.0)
    together = _differences(VIEW, spot, RoomGeometry(shapes), truth, layer, 15)
    assert together.centroid_px > CENTROID_TOLERANCE_PX, (apart, together)


def test_coats_keep_energy() -> None:
    """A white ground returns all that enters; f(1.5) = 0.596 (Egan and Hilgeman 1979), T(1.5) = 0.96 head on."""
    assert inside_reflectance(1.5) == pytest.approx(0.5963, abs=1e-4)
    assert transmittance(np.array([1.0, 0.0]), np.array([1.5, 1.5])) == pytest.approx([0.96, 0.0])
    white = wall(texture=Uniform((1.0, 1.0, 1.0)), coat=1.5)
    light = deposit(beam_onto((white,), (2.0, 0.0, 0.7)), RoomGeometry((white,)), np.zeros((1, 2)))
    u = (np.arange(400) + 0.5) / 400  # of the square of the sine: cosine-weighted directions
    sine, cosine = np.sqrt(u), np.sqrt(1.0 - u)
    side = np.array([0.0, 0.0, 1.0])
    leaving = cosine[:, None] * light.normals + sine[:, None] * side
    many = light[np.zeros(400, dtype=int)]
    sent = np.mean(many.scattered(leaving) * math.pi / cosine)
    entered = transmittance(np.array([math.sqrt(0.5)]), np.array([1.5]))[0]
    assert sent == pytest.approx(entered, rel=1e-3)  # the midpoints err by 400^-1.5 at grazing angles


def test_what_scatters_nothing() -> None:
    """Lamps, backs of one-sided faces, places that the beam misses, and what lies farther off than the spot's reach."""
    far = rectangle("far", (3.0, 0.0, 0.7), (-1.0, 0.0, 0.0), (1.0, 1.0))
    narrow = rectangle("card", (2.0, 0.0, 0.7), (-1.0, 0.0, 0.0), (2e-3, 1.0))
    spot = beam_onto((narrow, far), (2.0, 0.0, 0.7))
    disc = np.array([[0.0, 0.0], [2.0, 0.0], [0.0, 2.0]])
    light = deposit(spot, RoomGeometry((narrow, far)), disc)
    assert sorted(light.strength.tolist()) == [0.0, 0.7, 0.7]
    lamp = rectangle("lamp", (2.0, 0.0, 0.7), (-1, 0, 0), (1, 1), radiance_w_m2_sr=(1.0, 1.0, 1.0))
    back = rectangle("back", (2.0, 0.0, 0.7), (1.0, 0.0, 0.0), (1.0, 1.0))
    for shape in (lamp, back):
        assert not deposit(spot, RoomGeometry((shape,)), disc).lit.size
        assert spot_layer(VIEW, spot, (shape,)).total_electrons_per_s.sum() == 0.0


@pytest.mark.parametrize(
    ("change", "complaint"),
    [({"albedo": None}, "needs a beam"), ({"beam_direction_world": (-1.0, 0.0, 0.0)}, "against normal_world")],
)
def test_impossible_beams_are_refused(change: dict[str, object], complaint: str) -> None:
    with pytest.raises(SceneError, match=complaint):
        LaserSpot((2.0, 0.0, 0.7), (-1.0, 0.0, 0.0), 5e-3, **change)  # type: ignore[arg-type]
