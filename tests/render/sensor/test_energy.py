"""Energy bookkeeping: watts of laser and lamps against the electrons of layers and of `ideal` frames.

The oracles share no code with the renderer: Fresnel's equations from n and k, reflection at the sphere as a map from
directions at the spot to points of the lens plane, whose finite differences give the power that enters the aperture.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from scipy import optimize

from phibench.render.optics.faces import TexelGrid, face_table
from phibench.render.optics.spot_layer import spot_layer
from phibench.render.room.ambient_layer import render_ambient
from phibench.render.room.light_map import BakeSettings, LightMap, bake
from phibench.render.sensor.camera_chain import Chain
from phibench.render.sensor.electrons import NoiseStream
from phibench.render.sensor.light import Light
from phibench.render.sensor.settings import sensor
from phibench.scenes.frames import Pose
from phibench.scenes.laser import LaserSpot, beam_diameter_m
from phibench.scenes.room import Room, default_rig
from phibench.scenes.shapes import cuboid, rectangle

STREAM = NoiseStream(("energy", 0))
SEED_OF_PHOTONS = 650e-9 / (6.62607015e-34 * 299792458.0)  # photons in a joule at 650 nm
# J. Appl. Phys. 53, 6340 (1982), at 640 and 660 nm
STEEL_650 = complex(0.5 * (2.3962 + 2.4839), 0.5 * (4.1378 + 4.2261))
STEEL_610_540_460 = (
    complex(0.5 * (2.2325 + 2.3122), 0.5 * (3.9594 + 4.0504)),
    complex(2.0072, 3.6166),
    complex(1.7169, 3.1785),
)
RADIUS_M, LENS_Z_M, SPHERE_Z_M = 0.060, 0.45, 0.71


def fresnel(index: complex, incidence_rad: float) -> float:
    """Unpolarised reflectance from Fresnel's equations with Snell's law, angles complex."""
    cos_i, refracted = math.cos(incidence_rad), np.arcsin(complex(math.sin(incidence_rad)) / index)
    cos_t = np.cos(refracted)
    s = (cos_i - index * cos_t) / (cos_i + index * cos_t)
    p = (index * cos_i - cos_t) / (index * cos_i + cos_t)
    return 0.5 * (abs(s) ** 2 + abs(p) ** 2)


def reflected(start: np.ndarray, way: np.ndarray) -> tuple[np.ndarray, float]:
    """Where a ray from `start` meets the lens plane after the sphere, (x, y), and its angle of incidence."""
    centre = np.array([0.0, 0.0, SPHERE_Z_M])
    d = way / np.linalg.norm(way)
    b = d @ (start - centre)
    hit = start + d * (-b - math.sqrt(b * b - (start - centre) @ (start - centre) + RADIUS_M**2))
    n = (hit - centre) / RADIUS_M
    out = d - 2.0 * (d @ n) * n
    if out[2] >= 0.0:
        raise ValueError("goes up and never meets the lens plane")
    at_lens = hit + out * (LENS_Z_M - hit[2]) / out[2]
    return at_lens[:2], math.acos(-(d @ n))


def budget_electrons_per_s(spot: LaserSpot, aperture_radius_m: float) -> float:
    """Electrons per second behind the red filter: laser -> Lambertian wall -> steel sphere -> aperture -> electrons.

    P_lens = (albedo P / pi) cos(wall) R(i) |d Omega / d A| A, with d Omega the solid angle at the spot whose rays meet
    the area d A of the lens plane: the inverse of the map's area ratio, by central differences of 1e-6 rad.
    """
    start, normal = np.array(spot.position_world_m), np.array(spot.normal_world)
    to_sphere = np.array([0.0, 0.0, SPHERE_Z_M]) - start
    e1 = to_sphere / np.linalg.norm(to_sphere)
    e2 = np.cross(e1, [0.0, 0.0, 1.0]) / np.linalg.norm(np.cross(e1, [0.0, 0.0, 1.0]))
    e3 = np.cross(e1, e2)

    def lands(ab: np.ndarray) -> np.ndarray:
        return reflected(start, e1 + ab[0] * e2 + ab[1] * e3)[0]

    # the chief ray: a scan for the start, since most directions that meet the sphere miss the lens
    reach = RADIUS_M / np.linalg.norm(to_sphere)
    tries = reach * np.linspace(-0.95, 0.95, 191)
    guess = min((np.array([0.0, b]) for b in tries), key=lambda ab: _miss(lands, ab))
    chief = optimize.root(lands, guess, options={"xtol": 1e-14}).x
    assert np.linalg.norm(lands(chief)) < 1e-9
    step = 1e-6 * np.eye(2)
    jacobian = np.array([(lands(chief + h) - lands(chief - h)) / 2e-6 for h in step])
    way = e1 + chief[0] * e2 + chief[1] * e3
    per_area = 1.0 / abs(np.linalg.det(jacobian)) / np.linalg.norm(way) ** 3  # tangent plane to solid angle
    _, incidence = reflected(start, way)
    wall = normal @ way / np.linalg.norm(way)
    watts_per_sr = spot.albedo * spot.power_w / math.pi * wall
    watts = watts_per_sr * per_area * math.pi * aperture_radius_m**2 * fresnel(STEEL_650, incidence)
    return watts * SEED_OF_PHOTONS * 0.35


def _miss(lands, ab: np.ndarray) -> float:
    """Distance from the lens centre; infinite for rays that miss the sphere or the lens plane."""
    try:
        return float(np.linalg.norm(lands(ab)))
    except ValueError:
        return math.inf


@pytest.mark.parametrize("depth_m", [1.0, 2.0, 4.2])
@pytest.mark.parametrize("azimuth", [0.0, 0.7])
def test_accuracy_energy_of_the_spot(depth_m: float, azimuth: float) -> None:
    """Within 1 %, of the layer and of the `ideal` frame; a forgotten factor is far off.

    The budget takes the chief ray for all of aperture and spot: the difference is of second order in 0.8 mm / 60 mm and
    in spot size / distance, below 1e-3.
    """
    rig = default_rig()
    place = (depth_m * math.cos(azimuth), depth_m * math.sin(azimuth), 0.50)
    spot = LaserSpot(place, (-math.cos(azimuth), -math.sin(azimuth), 0.0), beam_diameter_m(depth_m))
    aperture_m = 1430.0 * 2.8e-6 / (2.0 * 2.4)
    expected = budget_electrons_per_s(spot, aperture_m)
    layer = spot_layer(rig.at(0.0), spot, ())
    light = Light(np.zeros((3, 720, 1280), np.float32), layer)
    frame = Chain(sensor("ideal")).frame(light, STREAM) * 60.0
    print(f"D {depth_m} m: budget {expected / 60:.1f} e- in 1/60 s, layer {layer.total_electrons_per_s[0] / 60:.1f}")
    for image in (layer.electrons_per_s, frame):
        flux = image.sum(axis=(1, 2))
        assert flux == pytest.approx(expected * np.array([1.0, 0.10, 0.03]), rel=0.01)
        assert flux[0] == pytest.approx(expected, rel=2e-3)  # what it reaches
    assert frame.sum() != pytest.approx(expected * 1.13 / fresnel(STEEL_650, 0.7), rel=0.01)


def test_accuracy_energy_fresnel_at_normal_incidence() -> None:
    """((n - 1)^2 + k^2) / ((n + 1)^2 + k^2), and the 66.7 % and 66.0 % of docs/model.md."""
    n, k = STEEL_650.real, STEEL_650.imag
    assert fresnel(STEEL_650, 0.0) == pytest.approx(((n - 1) ** 2 + k * k) / ((n + 1) ** 2 + k * k), rel=1e-12)
    assert fresnel(STEEL_650, 0.0) == pytest.approx(0.667, abs=5e-4)
    assert fresnel(STEEL_650, math.pi / 4) == pytest.approx(0.660, abs=5e-4)


# -- a box of uniform radiance -------------------------------------------------------------------------------------

# Walls of radiance 1 that reflect nothing (lamps do not), and in the line of sight a cube of albedo a: it is convex, so
# each of its texels has the irradiance pi and the radiance a. What is seen of the cube comes out of the light map.
ALBEDO = 0.6
SETTINGS = BakeSettings(texel_m=0.2, lamp_rays=1024, bounces=1, bounce_rays=4, final_rays=4)
WINDOWS = {"direct": (8, 8, 8, 8), "mirror": (700, 300, 8, 8)}
VIEW = default_rig().at(0.0)
LENS = np.array([0.0, 0.0, LENS_Z_M])


def sight(window: str) -> tuple[np.ndarray, np.ndarray, float]:
    """Line of sight of a window's middle: a point, the direction from there, and the angle of incidence (0: none)."""
    u0, v0, width, height = WINDOWS[window]
    way = pixel_ray(u0 + 0.5 * (width - 1), v0 + 0.5 * (height - 1))
    if window == "direct":
        return LENS, way, 0.0
    centre = np.array([0.0, 0.0, SPHERE_Z_M])
    b = way @ (LENS - centre)
    hit = LENS + way * (-b - math.sqrt(b * b - (SPHERE_Z_M - LENS_Z_M) ** 2 + RADIUS_M**2))
    n = (hit - centre) / RADIUS_M
    return hit, way - 2.0 * (way @ n) * n, math.acos(-(way @ n))


def pixel_ray(u: float, v: float) -> np.ndarray:
    way = np.array([(u - 639.5) / 1430.0, (v - 359.5) / 1430.0, 1.0])
    return way / np.linalg.norm(way)


def furnace(window: str) -> Room:
    """A closed box, 6 m wide, with a cube of 0.8 m in the line of sight of one window."""
    start, way, _ = sight(window)
    cube = cuboid("cube", tuple(start + 1.5 * way), (0.8, 0.8, 0.8), (ALBEDO,) * 3)
    places = [(3, 0, 1), (-3, 0, 1), (0, 3, 1), (0, -3, 1), (0, 0, 4), (0, 0, -2)]
    walls = [
        rectangle(f"wall_{i}", at, tuple(np.subtract((0, 0, 1), at)), (6.0, 6.0), radiance_w_m2_sr=(1.0,) * 3)
        for i, at in enumerate(places)
    ]
    return Room("furnace", tuple(walls), (cube,), robot=False)


@pytest.fixture(scope="module", params=list(WINDOWS))
def baked(request: pytest.FixtureRequest) -> tuple[str, LightMap]:
    """Where the cube is, and the light map."""
    return request.param, bake(VIEW, furnace(request.param), SETTINGS)


def expected_rates(window: str, radiance: float) -> np.ndarray:
    """Radiance x etendue x electrons per joule, shape (3,), times the steel's reflectance where the mirror is seen.

    Etendue of a pixel: aperture area x solid angle x cosine = A cos^4 / f^2 in pixels; the mirror does not change it.
    """
    u0, v0, width, height = WINDOWS[window]
    cosine = pixel_ray(u0 + 0.5 * (width - 1), v0 + 0.5 * (height - 1))[2]
    etendue = math.pi * (1430.0 * 2.8e-6 / 4.8) ** 2 * cosine**4 / 1430.0**2
    waves_m, efficiency = np.array([610e-9, 540e-9, 460e-9]), np.array([0.35, 0.40, 0.35])
    rates = radiance * etendue * efficiency * waves_m / (6.62607015e-34 * 299792458.0)
    incidence = sight(window)[2]
    return rates if window == "direct" else rates * [fresnel(index, incidence) for index in STEEL_610_540_460]


def test_accuracy_energy_of_the_light_map(baked: tuple[str, LightMap]) -> None:
    """The cube's irradiance is pi, mean to 0.3 %, every texel to 2 %: 1024 points per wall, 6 walls."""
    shapes = furnace(baked[0]).furniture
    count = TexelGrid.of(face_table(shapes), SETTINGS.texel_m).count
    assert count == 6 * 8 * 8  # small faces have texels of half the size
    ratio = baked[1].irradiance_w_m2[-count:] / math.pi
    print(f"mean {ratio.mean():.5f}, from {ratio.min():.4f} to {ratio.max():.4f}")
    assert ratio.mean() == pytest.approx(1.0, abs=3e-3)
    assert np.abs(ratio - 1.0).max() < 0.02


@pytest.mark.parametrize("window", WINDOWS)
def test_accuracy_energy_of_ambient_light(baked: tuple[str, LightMap], window: str) -> None:
    """`render_ambient` and an `ideal` frame of it within 1 % of the closed form, wall and cube, direct and mirrored.

    A forgotten albedo, reflectance or cos^4 changes the level by 40, 34 or 36 %.
    """
    place, light = baked
    layer = render_ambient(VIEW, furnace(place), light, SETTINGS, 4, 0, WINDOWS[window]).electrons_per_s
    frame = Chain(sensor("ideal", exposure_s=0.02)).frame(Light(layer), STREAM)
    expected = expected_rates(window, ALBEDO if place == window else 1.0)
    print(f"cube {place}, window {window}: {100.0 * (layer.mean(axis=(1, 2)) / expected - 1.0)} %")
    assert layer.mean(axis=(1, 2)) == pytest.approx(expected, rel=0.01)
    assert frame.mean(axis=(1, 2)) == pytest.approx(0.02 * expected, rel=0.01)


def test_accuracy_energy_of_the_aperture() -> None:
    """A stop of sqrt 2 halves the spot's electrons, in the layer and through the sensor's own stop."""
    rig = default_rig()
    spot = LaserSpot((2.0, 0.0, 0.5), (-1.0, 0.0, 0.0), beam_diameter_m(2.0))
    slow = dataclasses.replace(rig, camera=dataclasses.replace(rig.camera, f_number=2.4 * math.sqrt(2.0)))
    flux = [spot_layer(r.at(0.0), spot, ()).total_electrons_per_s[0] for r in (rig, slow)]
    assert flux[0] / flux[1] == pytest.approx(2.0, rel=1e-3)  # the aperture's size is of second order
    light = Light(np.zeros((3, 720, 1280), np.float32), spot_layer(rig.at(0.0), spot, ()))
    frames = [Chain(sensor("ideal", f_number=f)).frame(light, STREAM).sum() for f in (2.4, 2.4 * math.sqrt(2.0))]
    assert frames[0] / frames[1] == pytest.approx(2.0, rel=1e-12)


def test_accuracy_energy_does_not_depend_on_the_pose() -> None:
    """Camera and mirror moved and turned together with the spot: the same electrons, to rounding."""
    spot = LaserSpot((2.0, 0.3, 0.5), (-1.0, 0.0, 0.0), beam_diameter_m(2.0))
    rig = default_rig()
    moved = dataclasses.replace(rig, T_world_camera=Pose("world", "camera", (0.0, 0.0, 1.45)))
    higher = dataclasses.replace(spot, position_world_m=(2.0, 0.3, 1.5))
    a, b = (spot_layer(r.at(0.0), s, ()).total_electrons_per_s for r, s in ((rig, spot), (moved, higher)))
    assert a == pytest.approx(b, rel=1e-9)
