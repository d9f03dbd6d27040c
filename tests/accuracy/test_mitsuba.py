"""The Mitsuba side against the float64 side: pixel convention, geometry, and brute-force path tracing of the spot."""

from __future__ import annotations

import dataclasses
import math
import subprocess
from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from helpers.oracles import TARGETS, project_cv2
from helpers.path_ambient import path_trace, traced_scene
from helpers.path_spots import compare

from phibench.render.optics.spot_layer import spot_layer
from phibench.render.optics.truth import spot_truth, truth_layer
from phibench.render.plugins.room_plugins import to_scene_mm
from phibench.render.room.ambient_layer import render_ambient
from phibench.render.room.camera_plugin import camera_plugin_dict
from phibench.render.room.light_map import BakeSettings, bake
from phibench.render.setup.variant import activate
from phibench.scenes.camera import Camera, Detector
from phibench.scenes.frames import Pose, rotation_xyz
from phibench.scenes.laser import LaserSpot
from phibench.scenes.rig import Rig, View
from phibench.scenes.room import Room, c310_camera, default_rig, lab
from phibench.scenes.shapes import Checker, Uniform, cuboid, rectangle

SHARP = 0.05  # px; the least blur that Camera allows
TILTED = Rig(
    camera=dataclasses.replace(c310_camera(), cx_px=650.0, cy_px=352.0, p1=1e-3, p2=-5e-4),
    T_world_camera=Pose("world", "camera", (0.02, -0.01, 0.45), rotation_xyz(0.02, -0.03, 0.1)),
    T_camera_sphere=Pose("camera", "sphere", (0.004, -0.003, 0.28)),
)


@pytest.fixture(scope="module")
def mi() -> ModuleType:
    return activate()


def _sensor_rays(mi: ModuleType, view: View, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Chief rays of the plugin, blur switched off, as arrays (N, 3)."""
    sensor = mi.load_dict(camera_plugin_dict(mi, view) | {"blur_sigma_px": 0.0})
    camera = view.rig.camera
    position = mi.Point2f(*((uv[:, i] + 0.5) / size for i, size in enumerate((camera.width_px, camera.height_px))))
    centre = mi.Point2f(0.5, 0.5)  # of the aperture
    ray, _ = sensor.sample_ray_differential(0.0, 0.0, position, centre)
    return np.array(ray.o).T, np.array(ray.d).T


@pytest.mark.parametrize("rig", [default_rig(), TILTED], ids=["default", "tilted, distorted, decentred"])
def test_accuracy_pixel_convention_of_the_sensor(mi: ModuleType, rig: Rig) -> None:
    """<= 1e-4 px at the corners, edges and centre, against `scenes` and against OpenCV.

    Mitsuba's sample positions and directions are float32: 1280 x 6e-8 / 2 = 4e-5 px each.
    """
    u, v = np.meshgrid([-0.5, 0.0, 639.5, 640.0, 1279.0, 1279.5], [-0.5, 0.0, 359.5, 719.0, 719.5])
    uv = np.stack([u.ravel(), v.ravel()], axis=-1)
    view = rig.at(0.3)
    origins, directions = _sensor_rays(mi, view, uv)
    camera_directions = view.T_world_camera.inverse().directions(directions.astype(float))
    for project in (rig.camera.project, lambda points: project_cv2(rig.camera, points)):
        assert np.abs(project(camera_directions) - uv).max() <= 1e-4
    assert np.abs(origins - to_scene_mm(view, view.camera_centre_m)).max() < 1e-4  # float32 at 300 mm: 3e-5 mm


@pytest.mark.parametrize("rig", [default_rig(), TILTED], ids=["default", "tilted, distorted, decentred"])
def test_accuracy_truth_layer_against_mitsuba_geometry(mi: ModuleType, rig: Rig) -> None:
    """Object and point hit through the mirror at 4000 pixels: two programs, one scene.

    Float32 rays: 4e-5 px, that is 3e-7 rad x 6 m, and more near the rim, where the mirror magnifies: 0.05 mm for 99 %.
    """
    room, view = lab(TARGETS), rig.at(0.425)
    planes = truth_layer(view, room.shapes(view))
    rng = np.random.default_rng(0)
    v, u = np.nonzero(np.isfinite(planes["x_m"]))
    pick = rng.choice(len(u), 4000, replace=False)
    u, v = u[pick], v[pick]
    scene = traced_scene(mi, view, room)
    origins, directions = _sensor_rays(mi, view, np.stack([u, v], axis=-1).astype(float))
    first = scene.ray_intersect(mi.Ray3f(mi.Point3f(origins.T), mi.Vector3f(directions.T)))
    reflected = first.spawn_ray(first.to_world(mi.reflect(first.wi)))
    second = scene.ray_intersect(reflected)
    names = [shape.id() for shape in scene.shapes()]
    ids = {name: int(name.split("_")[1]) if name.startswith("shape_") else -2 for name in names}
    hit_ids = np.array([ids[shape.id()] if shape is not None else -1 for shape in second.shape])
    ours = planes["object_id"][v, u].astype(int)
    assert np.mean(hit_ids == ours) > 0.998  # a pixel centre within 4e-5 px of an edge may fall on either side
    points = to_scene_mm(view, np.stack([planes[k][v, u] for k in ("x_m", "y_m", "z_m")], axis=-1))
    distance = np.linalg.norm(points - np.array(second.p).T, axis=-1)[hit_ids == ours]
    assert np.quantile(distance, 0.99) < 0.05
    assert len(np.unique(ours)) > 20  # most of the lab was looked at


def test_accuracy_truth_layer_against_closed_form() -> None:
    """The world point of a pixel, sent back by Alhazen's closed form, lands on that pixel: <= 1e-6 px."""
    room, view = lab(TARGETS), TILTED.at(0.2)
    planes = truth_layer(view, room.shapes(view))
    v, u = np.nonzero(np.isfinite(planes["x_m"]))
    rng, checked = np.random.default_rng(1), 0
    for i in rng.choice(len(u), 500, replace=False):
        point = tuple(planes[k][v[i], u[i]] for k in ("x_m", "y_m", "z_m"))
        normal = tuple(view.sphere_centre_m - np.array(point))
        truth = spot_truth(view, LaserSpot(point, normal, 1e-3), ())
        assert math.hypot(truth.u_px - u[i], truth.v_px - v[i]) <= 1e-6
        for name in ("phi_ray_rad", "phi_normal_rad", "phi_incidence_rad", "azimuth_rad"):
            assert planes[name][v[i], u[i]] == pytest.approx(getattr(truth, name), abs=1e-9)
        path = truth.path_spot_mirror_m + truth.path_mirror_camera_m
        assert planes["path_m"][v[i], u[i]] == pytest.approx(path, rel=1e-9)
        checked += 1
    assert checked == 500


# -- the spot by brute force ---------------------------------------------------------------------------------------


def _red_laser_rig(blur_px: float, focus_m: float = 0.23, alpha: float = 0.0, **changes: Any) -> Rig:
    """Default rig whose ambient bands lie at the laser line, so that both renderers count the same electrons."""
    rig = default_rig()
    detector = Detector(band_wavelength_nm=(650.0,) * 3, band_efficiency=(0.35,) * 3)
    camera = dataclasses.replace(rig.camera, detector=detector, blur_sigma_px=blur_px, focus_distance_m=focus_m)
    mirror = dataclasses.replace(rig.mirror, roughness_alpha=alpha)
    return dataclasses.replace(rig, camera=camera, mirror=mirror, **changes)


@pytest.mark.slow
def test_accuracy_spot_layer_against_brute_force_path_tracing(mi: ModuleType) -> None:
    """Flux within 0.3 % and shares of the columns within 0.002, at >= 1e8 paths.

    A 12 mm spot at 2 m with little blur fills 1 to 2 pixels: about 2e6 of 1e8 paths reach it, flux error 7e-4, share
    error 4e-4 (one sigma), so that the tolerances stand at 4 and 5 sigma: false alarm below 1e-4.
    """
    spot = LaserSpot((1.9, 0.7, 0.5), (-1.9, -0.7, 0.0), 12e-3, profile="uniform")
    figures = compare(mi, _red_laser_rig(0.25), spot, 2, 1.05e8)
    assert figures["paths"] >= 1e8
    assert figures["flux_error"] < 1e-3
    assert abs(figures["flux"]) <= 3e-3
    assert figures["share"] <= 2e-3
    assert 0.3 < figures["largest_share"] < 0.9  # the split is a real one


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("defocused", {"focus_m": 0.46, "blur_px": 0.3}),
        ("rough", {"alpha": 0.004, "blur_px": 0.3}),
        pytest.param(
            *("off axis", {"T_camera_sphere": Pose("camera", "sphere", (0.01, -0.008, 0.30)), "blur_px": 0.3}),
            marks=pytest.mark.slow,
        ),
    ],
)
def test_accuracy_spot_layer_against_path_tracing_short(mi: ModuleType, name: str, changes: dict[str, Any]) -> None:
    """The same with fewer paths for the other optics: flux and shares within 5 sigma + 0.3 % (false alarm 6e-7).

    1.7e7 paths on 9 x 9 pixels, which hold all of the light but 1e-4: sigma is at most 0.55 %, so that 3 % are always
    seen; 0.3 % are for the slow test above.
    """
    spot = LaserSpot((1.9, 0.7, 0.5), (-1.9, -0.7, 0.0), 20e-3, profile="uniform")
    figures = compare(mi, _red_laser_rig(**changes), spot, 4, 1.67e7)
    assert figures["inside"] > 0.9998
    assert figures["flux_error"] < 5.5e-3
    assert abs(figures["flux"]) <= 5.0 * figures["flux_error"] + 3e-3
    assert figures["share"] <= 2.5 * figures["flux_error"] + 2e-3


# -- the ambient layer ---------------------------------------------------------------------------------------------


def _furnace(albedo: float) -> Room:
    """A closed box whose walls all emit 1 W/(m^2 sr) and reflect nothing: radiance 1 everywhere in it."""
    sides = [
        ((x, y, z), (-x, -y, -z)) for x, y, z in [(3, 0, 0), (-3, 0, 0), (0, 3, 0), (0, -3, 0), (0, 0, 3), (0, 0, -3)]
    ]
    walls = [
        rectangle(f"wall_{i}", place, normal, (6.0, 6.0), radiance_w_m2_sr=(1.0, 1.0, 1.0))
        for i, (place, normal) in enumerate(sides)
    ]
    return Room("furnace", tuple(walls), (), robot=False)


def test_ambient_electrons_in_a_furnace(mi: ModuleType) -> None:
    """Uniform radiance 1: beside the mirror a pixel gets etendue x electrons per joule; in it, times the reflectance.

    cos^4 and the pixel's solid angle from `scenes`; the aperture's finite size changes cos^4 by about 1e-5.
    """
    view = dataclasses.replace(default_rig(), T_world_camera=Pose("world", "camera", (0, 0, 0.45))).at(0.0)
    camera = view.rig.camera
    for u0, v0, seen_through_mirror in ((10, 10, False), (700, 300, True), (1200, 600, False)):
        image = path_trace(view, _furnace(0.0), 64, 4, 0, (u0, v0, 4, 4)).mean(axis=(1, 2))
        ray = camera.rays(np.array([[u0 + 1.5, v0 + 1.5]]))[0]
        etendue = math.pi * camera.aperture_radius_m**2 * ray[2] ** 4 / (camera.fx_px * camera.fy_px)
        expected = etendue * np.array(camera.detector.band_electrons_per_joule())
        if seen_through_mirror:
            from phibench.render.optics.ray_tracer import trace_pixels

            cos_i = trace_pixels(view, np.array([[u0 + 1.5, v0 + 1.5]])).cos_incidence
            waves = camera.detector.band_wavelength_nm
            expected = expected * [view.rig.mirror.reflectance(cos_i, nm)[0] for nm in waves]
        assert image == pytest.approx(expected, rel=2e-4)


def test_ambient_shows_checkers_where_the_scene_has_them(mi: ModuleType) -> None:
    """A lit checkerboard: traced contrast has the sign and size of `Checker.evaluate` at the truth layer's points."""
    tiles = Checker((0.8, 0.8, 0.8), (0.2, 0.2, 0.2), (0.5, 0.7), (-2.75, -2.9))
    floor = rectangle("floor", (0.1, 0.2, 0.0), (0, 0, 1), (5.5, 5.8), texture=tiles)
    lamp = rectangle("lamp", (0, 0, 3.0), (0, 0, -1), (6, 6), texture=Uniform((0, 0, 0)), radiance_w_m2_sr=(1, 1, 1))
    room = Room("tiles", (floor, lamp), (), robot=False)
    view = default_rig().at(0.0)
    crop = (560, 280, 160, 160)
    image = path_trace(view, room, 16, 3, 3, crop)[0]
    planes = truth_layer(view, room.shapes(view))
    window = np.s_[280:440, 560:720]
    points = np.stack([planes[k][window] for k in ("x_m", "y_m")], axis=-1) - [0.1, 0.2]
    albedo = tiles.evaluate(points)[..., 0]
    # away from cell edges, where blur mixes
    inside = np.all(np.abs((points + [2.75, 2.9]) / [0.5, 0.7] % 1.0 - 0.5) < 0.3, axis=-1) & np.isfinite(albedo)
    light, dark = image[inside & (albedo > 0.5)], image[inside & (albedo < 0.5)]
    assert min(len(light), len(dark)) > 500
    assert np.median(light) / np.median(dark) == pytest.approx(4.0, rel=0.15)
    assert np.mean(image[inside & (albedo < 0.5)] > np.median(light) / 2.0) < 0.01


def test_path_tracing_is_bit_identical_and_seeds_matter(mi: ModuleType) -> None:
    view, room, crop = default_rig().at(0.0), lab(TARGETS), (600, 400, 16, 16)
    first, again, other = (path_trace(view, room, 4, 4, seed, crop) for seed in (0, 0, 1))
    assert first.tobytes() == again.tobytes()
    assert first.tobytes() != other.tobytes()


BAKE_AND_RENDER = """
import hashlib, sys
from phibench.render.room.ambient_layer import render_ambient
from phibench.render.room.light_map import BakeSettings, bake
from phibench.scenes.room import default_rig, lab
room, rig = lab(), default_rig()
settings = BakeSettings(texel_m=0.5, lamp_rays=4, bounces=2, bounce_rays=8, final_rays=8)
light = bake(rig.at(0.0), room, settings)
layer = render_ambient(rig.at(0.3), room, light, settings, 4, int(sys.argv[1]), (600, 400, 32, 32))
for array in (light.irradiance_w_m2, light.sigma_w_m2, layer.electrons_per_s, layer.variance_per_s2):
    print(hashlib.sha256(array.tobytes()).hexdigest())
"""


def test_ambient_is_bit_identical_in_two_processes_and_seeds_matter(
    python: Callable[..., subprocess.CompletedProcess[str]],
) -> None:
    """Light map, layer and variance: all bytes; the seed is the view's and does not enter the light map."""
    first, again, other = (python(BAKE_AND_RENDER, seed).stdout.split() for seed in ("0", "0", "1"))
    assert len(first) == 4
    assert first == again
    assert [a == b for a, b in zip(first, other, strict=True)] == [True, True, False, False]


def test_dark_room_has_no_ambient_light() -> None:
    view, room = default_rig().at(0.0), lab(TARGETS).dark()
    assert not path_trace(view, room, 4, 4, 0).any()
    settings, crop = BakeSettings(texel_m=0.5, lamp_rays=1, bounces=1, bounce_rays=2, final_rays=2), (600, 300, 32, 32)
    light = bake(view, room, settings)
    assert not light.irradiance_w_m2.any()
    assert not render_ambient(view, room, light, settings, 2, 0, crop).electrons_per_s.any()


def test_solid_in_the_way_is_seen_by_both(mi: ModuleType) -> None:
    """A box between mirror and spot: truth names it, and the layer is dark."""
    box = cuboid("screen", (1.0, 0.0, 0.55), (0.1, 0.6, 0.6), (0.5, 0.5, 0.5))
    room, view = Room("screened", (), (box,), robot=False), default_rig().at(0.0)
    spot = LaserSpot((2.0, 0.0, 0.5), (-1, 0, 0), 5e-3)
    assert spot_truth(view, spot, room.shapes(view)).cause == "occluded:screen"
    assert not spot_layer(view, spot, room.shapes(view)).electrons_per_s.any()
    assert spot_truth(view, spot, ()).visible


def test_aperture_of_the_default_camera() -> None:
    camera = Camera()
    assert camera.aperture_radius_m == pytest.approx(0.833e-3, rel=2e-3)


@pytest.mark.benchmark(group="layers")
def test_benchmark_truth_layer(benchmark) -> None:
    """Target: <= 2 s per view on one core."""
    view = default_rig().at(0.425)
    planes = benchmark.pedantic(truth_layer, (view, lab(TARGETS).shapes(view)), rounds=3)
    assert np.isfinite(planes["x_m"]).sum() > 3e5
