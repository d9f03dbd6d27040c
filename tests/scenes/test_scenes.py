"""Descriptions of rig, room, robot and laser: what they refuse and what they compute."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from helpers.oracles import TARGETS

from phibench.scenes.camera import Camera
from phibench.scenes.frames import Pose, cross, rotation_facing, rotation_xyz
from phibench.scenes.laser import LaserSpot, beam_diameter_m
from phibench.scenes.metals import METALS, STEEL
from phibench.scenes.mirror import SphereMirror
from phibench.scenes.rig import POSITIONS, Rig, Stroke
from phibench.scenes.room import c310_rig, lab
from phibench.scenes.shapes import Uniform
from phibench.scenes.validation import SceneError

NAN, INF = math.nan, math.inf


# -- frames ------------------------------------------------------------------------------------------------------


def test_composition_takes_points_through_both_poses():
    T_ab = Pose("a", "b", (1.0, 2.0, 3.0), rotation_xyz(0.3, -0.2, 1.1))
    T_bc = Pose("b", "c", (-0.5, 0.1, 0.7), rotation_xyz(-1.0, 0.4, 0.2))
    points = np.random.default_rng(71).normal(size=(5, 7, 3))
    np.testing.assert_allclose((T_ab @ T_bc).points(points), T_ab.points(T_bc.points(points)), rtol=0, atol=1e-14)
    assert ((T_ab @ T_bc).target, (T_ab @ T_bc).source) == ("a", "c")


def test_inverse_brings_points_back():
    T = Pose("a", "b", (1.0, 2.0, 3.0), rotation_xyz(0.3, -0.2, 1.1))
    points = np.random.default_rng(72).normal(size=(10, 3))
    np.testing.assert_allclose(T.inverse().points(T.points(points)), points, rtol=0, atol=1e-14)
    assert (T.inverse().target, T.inverse().source) == ("b", "a")


def test_composition_of_unrelated_frames_is_refused():
    with pytest.raises(SceneError, match="frame 'b' meets frame 'a'"):
        Pose("a", "b") @ Pose("a", "b")


@pytest.mark.parametrize(
    "rotation",
    [
        ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, -1.0)),  # mirrors
        ((2.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
        ((1.0, 1e-8, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
        ((NAN, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
        ((1.0, 0.0), (0.0, 1.0)),
    ],
)
def test_matrices_that_do_not_rotate_are_refused(rotation):
    with pytest.raises(SceneError):
        Pose("a", "b", rotation=rotation)


def test_rotation_about_each_axis_turns_the_right_way():
    x, y, z = np.eye(3)
    np.testing.assert_allclose(np.array(rotation_xyz(x_rad=math.pi / 2)) @ y, z, atol=1e-15)
    np.testing.assert_allclose(np.array(rotation_xyz(y_rad=math.pi / 2)) @ z, x, atol=1e-15)
    np.testing.assert_allclose(np.array(rotation_xyz(z_rad=math.pi / 2)) @ x, y, atol=1e-15)
    # first x, then y, then z
    composed = np.array(rotation_xyz(z_rad=0.3)) @ np.array(rotation_xyz(y_rad=0.2)) @ np.array(rotation_xyz(x_rad=0.1))
    np.testing.assert_allclose(rotation_xyz(0.1, 0.2, 0.3), composed, atol=1e-15)


@pytest.mark.parametrize("normal", [(0, 0, 1), (0, 0, -1), (1, 0, 0), (-0.3, 0.8, 0.1), (0, 1e-12, 1)])
def test_rotation_facing_is_a_rotation_onto_the_normal(normal):
    M = np.array(rotation_facing(normal))
    np.testing.assert_allclose(M @ M.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(M) == pytest.approx(1.0)
    np.testing.assert_allclose(M[:, 2], np.array(normal) / np.linalg.norm(normal), atol=1e-14)


# -- rig ---------------------------------------------------------------------------------------------------------


def test_cross_products_are_those_of_numpy_to_the_bit():
    rng = np.random.default_rng(7)
    for shapes in (((3,), (3,)), ((5, 3), (3,)), ((4, 1, 3), (5, 3))):
        a, b = (rng.normal(size=shape) for shape in shapes)
        assert np.array_equal(cross(a, b), np.cross(a, b))
        assert not np.array_equal(cross(a, b), cross(b, a))


def test_rig_moves_as_one_along_the_stroke_axis():
    rig = dataclasses.replace(Rig(), stroke_axis_world=(0.3, 0.0, 0.4))  # made a unit vector
    down, up = rig.at(Stroke(0.5).offset_m("down")), rig.at(Stroke(0.5).offset_m("up"))
    np.testing.assert_allclose(up.camera_centre_m - down.camera_centre_m, [0.3, 0.0, 0.4], atol=1e-15)
    np.testing.assert_allclose(up.sphere_centre_m - down.sphere_centre_m, [0.3, 0.0, 0.4], atol=1e-15)
    assert POSITIONS == ("down", "up")


def test_default_rig_has_the_mirror_above_the_camera():
    view = Rig().at(0.0)
    np.testing.assert_allclose(view.camera_centre_m, [0, 0, 0.45], atol=1e-15)
    np.testing.assert_allclose(view.sphere_centre_m, [0, 0, 0.71], atol=1e-15)


@pytest.mark.parametrize("sphere", [(0.0, 0.0, 0.26), (0.02, -0.015, 0.3)])
@pytest.mark.parametrize("make_camera", [Camera, lambda: c310_rig().camera])
def test_outline_separates_hits_from_misses(sphere, make_camera):
    """Brute force: rays 0.01 px inside the outline hit the sphere, those outside miss it."""
    rig = Rig(camera=make_camera(), T_camera_sphere=Pose("camera", "sphere", sphere))
    outline = rig.outline_px(90)
    assert outline.shape == (90, 2)
    middle = outline.mean(axis=0)
    outward = (outline - middle) / np.linalg.norm(outline - middle, axis=1, keepdims=True)
    for shift, hits in ((-0.01, True), (0.01, False)):
        distance = np.linalg.norm(np.cross(rig.camera.rays(outline + shift * outward), rig.sphere_in_camera_m), axis=1)
        assert np.all((distance < 0.06) == hits)


def test_outline_radius_of_the_default_rig():
    radius = np.linalg.norm(Rig().outline_px() - [639.5, 359.5], axis=1)
    np.testing.assert_allclose(radius, 1430 * 0.06 / math.sqrt(0.26**2 - 0.06**2), rtol=0, atol=1e-10)


@pytest.mark.parametrize(("z_c", "fits"), [(0.244, False), (0.248, True), (0.26, True)])
def test_mirror_fits_the_image_from_246_mm(z_c, fits):
    assert Rig(T_camera_sphere=Pose("camera", "sphere", (0, 0, z_c))).fits_image() is fits


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"stroke_axis_world": (0.0, 0.0, 0.0)}, "zero vector"),
        ({"stroke_axis_world": (0.0, 0.0, NAN)}, "finite"),
        ({"T_camera_sphere": Pose("camera", "sphere", (0, 0, 0.05))}, "more than the mirror radius"),
        ({"T_camera_sphere": Pose("camera", "sphere", (0, 0, -0.3))}, "in front of"),
        ({"T_camera_sphere": Pose("world", "sphere", (0, 0, 0.3))}, "must be"),
        ({"T_world_camera": Pose("camera", "world")}, "must be"),
    ],
)
def test_impossible_rigs_are_refused(change, message):
    with pytest.raises(SceneError, match=message):
        dataclasses.replace(Rig(), **change)


@pytest.mark.parametrize("stroke_m", [0.0, -0.1, NAN, INF])
def test_impossible_strokes_are_refused(stroke_m):
    with pytest.raises(SceneError, match="stroke_m"):
        Stroke(stroke_m)


def test_offset_of_a_rig_is_finite():
    with pytest.raises(SceneError, match="offset_m"):
        Rig().at(NAN)


@pytest.mark.parametrize(
    "thing",
    [
        Camera(),
        SphereMirror(),
        Rig(),
        Rig().at(0.1),
        Stroke(0.5),
        Pose("a", "b"),
        lab(),
        TARGETS[0],
        LaserSpot((1, 0, 0.5), (-1, 0, 0), 4e-3),
        Uniform((0.5, 0.5, 0.5)),
    ],
    ids=lambda thing: type(thing).__name__,
)
def test_descriptions_are_frozen_and_hashable(thing):
    name = dataclasses.fields(thing)[0].name
    with pytest.raises(dataclasses.FrozenInstanceError):
        setattr(thing, name, getattr(thing, name))
    assert hash(thing) == hash(dataclasses.replace(thing))


# -- mirror ------------------------------------------------------------------------------------------------------


def fresnel_real(n: float, k: float, angle: float) -> float:
    """Unpolarised reflectance in real arithmetic (Born and Wolf, section 14.2, with u + iv = sqrt(m^2 - sin^2))."""
    s2, difference = math.sin(angle) ** 2, n * n - k * k - math.sin(angle) ** 2
    root = math.sqrt(difference**2 + 4 * n * n * k * k)
    u2, v2, c = (root + difference) / 2, (root - difference) / 2, math.cos(angle)
    u = math.sqrt(u2)
    Rs = ((c - u) ** 2 + v2) / ((c + u) ** 2 + v2)
    st = s2 / c
    return 0.5 * Rs * (1 + ((u - st) ** 2 + v2) / ((u + st) ** 2 + v2))


@pytest.mark.parametrize("wavelength_nm", [400.0, 460.0, 555.0, 650.0, 700.0])
def test_reflectance_against_real_arithmetic(wavelength_nm):
    mirror, angles = SphereMirror(), np.linspace(0.0, 1.55, 50)
    m = mirror.refractive_index(wavelength_nm)
    expected = [fresnel_real(m.real, m.imag, angle) for angle in angles]
    np.testing.assert_allclose(mirror.reflectance(np.cos(angles), wavelength_nm), expected, rtol=1e-12)


@pytest.mark.parametrize(("degrees", "percent"), [(0, 66.7), (45, 66.0)])
def test_reflectance_of_the_steel(degrees, percent):
    reflectance = SphereMirror().reflectance(np.cos(np.radians(degrees)), 650.0)
    assert 100 * reflectance == pytest.approx(percent, abs=0.05)  # docs/model.md has one decimal


@pytest.mark.parametrize(
    ("metal", "wavelength_nm", "percent"),
    [("aluminium", 450.0, 92.2), ("aluminium", 650.0, 90.5), ("gold", 450.0, 40.0), ("gold", 650.0, 96.6)],
)
def test_reflectance_of_evaporated_films(metal, wavelength_nm, percent):
    """Handbook values at normal incidence of evaporated films; tables of different authors differ by 1 %."""
    reflectance = SphereMirror(metal=metal).reflectance(np.ones(1), wavelength_nm)[0]
    assert 100 * reflectance == pytest.approx(percent, abs=1.0)
    assert METALS[metal][0, 0] <= 400.0
    assert METALS[metal][-1, 0] >= 700.0


def test_an_unknown_metal_is_refused_in_a_sentence():
    with pytest.raises(SceneError, match="known are steel, aluminium, gold"):
        SphereMirror(metal="brass")


def test_index_is_the_table_and_linear_between():
    mirror = SphereMirror()
    assert mirror.refractive_index(640.0) == complex(2.3962, 4.1378)
    assert mirror.refractive_index(650.0) == pytest.approx(2.440 + 4.182j, abs=5e-4)
    assert len(STEEL) == 16
    with pytest.raises(ValueError, match="read-only"):
        STEEL[0, 0] = 1.0


@pytest.mark.parametrize("wavelength_nm", [399.0, 701.0, NAN])
def test_wavelength_beyond_the_table_is_refused(wavelength_nm):
    with pytest.raises(SceneError, match="400 to 700"):
        SphereMirror().refractive_index(wavelength_nm)


@pytest.mark.parametrize(
    "change", [{"radius_m": 0.0}, {"radius_m": NAN}, {"roughness_alpha": -0.1}, {"roughness_alpha": 0.1}]
)
def test_impossible_mirrors_are_refused(change):
    with pytest.raises(SceneError, match=next(iter(change))):
        SphereMirror(**change)


# -- laser -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("profile", ["gaussian", "uniform"])
def test_spot_radiates_albedo_times_power(profile):
    """Radiance integrated over the spot and the half space (pi for a Lambertian wall)."""
    spot = LaserSpot((1, 0, 0.5), (-1, 0, 0), 5e-3, albedo=0.7, power_w=1e-3, profile=profile)
    edges = np.linspace(0.0, 15e-3, 300_001)  # 6 diameters of the Gaussian's sigma and more
    middles = (edges[1:] + edges[:-1]) / 2
    power = np.pi * np.sum(spot.radiance_w_m2_sr(middles) * 2 * np.pi * middles) * (edges[1] - edges[0])
    # a midpoint sum with 2e5 steps: 1e-9 where smooth, half a ring of 5e-8 m at the rim of the disc: 4e-5
    assert power == pytest.approx(0.7e-3, rel=5e-5)


def test_gaussian_diameter_is_the_e2_diameter():
    spot = LaserSpot((1, 0, 0.5), (-1, 0, 0), 4e-3)
    assert spot.radiance_w_m2_sr(2e-3) == pytest.approx(float(spot.radiance_w_m2_sr(0.0)) * math.exp(-2), rel=1e-12)


@pytest.mark.parametrize("normal", [(-1, 0, 0), (0, 0, 1), (0, 0, -1), (0.3, -0.5, 0.8)])
def test_tangents_span_the_wall(normal):
    spot = LaserSpot((1, 0, 0.5), normal, 4e-3)
    a, b = spot.tangents()
    frame = np.stack([a, b, spot.normal_world])
    np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-14)


def test_default_beam_grows_one_millimetre_per_metre():
    assert beam_diameter_m(2.0) == pytest.approx(5e-3)


@pytest.mark.parametrize(
    "change",
    [
        {"position_world_m": (1.0, NAN, 0.0)},
        {"position_world_m": (1.0, 0.0)},
        {"normal_world": (0.0, 0.0, 0.0)},
        {"diameter_m": 0.0},
        {"power_w": -1e-3},
        {"albedo": 1.1},
        {"wavelength_nm": 800.0},
        {"profile": "square"},
    ],
)
def test_impossible_spots_are_refused(change):
    with pytest.raises(SceneError, match=next(iter(change))):
        LaserSpot(**({"position_world_m": (1, 0, 0.5), "normal_world": (-1, 0, 0), "diameter_m": 4e-3} | change))
