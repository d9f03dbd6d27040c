"""Numbers of docs/implement.md: each computed here by plain formulas, and by the library, from the page's own words.

The formulas share no code with the library. A printed number must be the formula's, rounded as printed, and the
library's must agree with the formula to 1e-9 of its size: both are double precision, and no formula cancels more than
four digits.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from phibench.estimator.geometry.paper_depth import depth_paper
from phibench.estimator.geometry.phi import phi_incidence, phi_normal, phi_ray
from phibench.estimator.geometry.reflection import reflect
from phibench.render.sensor.electrons import digitised_signal, mosaic
from phibench.render.sensor.light import row_times_s
from phibench.render.sensor.processing import tone_encoded, yuyv
from phibench.render.sensor.settings import sensor
from phibench.scenes.camera import Camera, photons_per_joule
from phibench.scenes.frames import Pose, rotation_xyz
from phibench.scenes.laser import beam_diameter_m
from phibench.scenes.misalignment import Misalignment
from phibench.scenes.motion.drive import Drive, DriveLeg, placement
from phibench.scenes.motion.vehicle import Vehicle
from phibench.scenes.revolved_mirror import RevolvedMirror
from phibench.scenes.revolved_profile import FormedProfile, paraboloid
from phibench.scenes.rig import Rig
from phibench.scenes.room import default_rig

PAGE = Path(__file__).resolve().parent.parent / "docs/implement.md"
NUMBER = re.compile(r"[+-]?\d+(?:\.\d+)?")
FX, CX, CY = 1430.0, 639.5, 359.5
R, Z_C, LENS_M = 0.06, 0.26, 0.45


def turn(axis: int, rad: float) -> np.ndarray:
    """Right-handed turn about x, y or z, column by column from where it takes the axes."""
    a, b = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[a, a], matrix[b, a] = math.cos(rad), math.sin(rad)
    matrix[a, b], matrix[b, b] = -math.sin(rad), math.cos(rad)
    return matrix


# What the page says, by plain formulas.


def distorted_pixel() -> list[float]:
    x, y = 0.03 / 0.30, -0.02 / 0.30
    k1, k2, k3, p1, p2 = -0.026, 1.06, -3.40, 1e-3, -2e-3
    s = x * x + y * y
    radial = 1.0 + k1 * s + k2 * s**2 + k3 * s**3
    u = x * radial + 2.0 * p1 * x * y + p2 * (s + 2.0 * x * x)
    v = y * radial + p1 * (s + 2.0 * y * y) + 2.0 * p2 * x * y
    return [FX * u + CX, FX * v + CY]


def mirrored() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Reflection point, normal and direction of pixel (900, 300), from the lens: world axes are the camera's."""
    d = np.array([(900.0 - CX) / FX, (300.0 - CY) / FX, 1.0])
    d /= math.sqrt(d @ d)
    centre = np.array([0.0, 0.0, Z_C])
    along = d @ centre
    point = (along - math.sqrt(along**2 - Z_C**2 + R**2)) * d
    normal = (point - centre) / R
    return point, normal, d - 2.0 * (d @ normal) * normal


def angles_of_a_pixel() -> list[float]:
    _, normal, onward = mirrored()
    from_down = math.acos(-onward[2])
    return [0.5 * from_down, math.acos(-normal[2]), math.acos(onward @ normal)]


def reflection_point() -> list[float]:
    point, _, _ = mirrored()
    return [*(point + [0.0, 0.0, LENS_M])]


def azimuth() -> list[float]:
    _, normal, _ = mirrored()
    return [math.atan2(normal[1], normal[0])]


def depth_of_two_angles() -> list[float]:
    """Rays of a meridian plane: from R (sin phi, -cos phi) below the centre, at 2 phi from straight down, cut."""
    starts = [np.array([R * math.sin(p), z - R * math.cos(p)]) for p, z in ((0.70, 0.0), (0.64, 0.4))]
    ways = [np.array([math.sin(2.0 * p), -math.cos(2.0 * p)]) for p in (0.70, 0.64)]
    steps = np.linalg.solve(np.stack([ways[0], -ways[1]], axis=1), starts[1] - starts[0])
    return [float((starts[0] + steps[0] * ways[0])[0])]


def moved_sphere() -> list[float]:
    lens = np.array([0.0, 0.0, LENS_M + 0.5])
    return [*(lens + turn(2, 0.03) @ turn(1, 0.01) @ turn(0, 0.02) @ [0.0, 0.0, Z_C])]


def form_of_a_sphere() -> list[float]:
    x, z = 0.6, -0.8
    return [1e3 * (R + 5e-4 * 3.0 * math.sqrt(15.0) / 16.0 * x * (5.0 * z * z - 1.0))]


def form_of_a_paraboloid() -> list[float]:
    r, rho = 0.045, 0.75
    height = 2e-4 * (6.0 * rho**4 - 6.0 * rho**2 + 1.0)
    return [1e3 * (r * r / (2.0 * R) - height * math.sqrt(1.0 + (r / R) ** 2))]


def end_of_a_drive() -> list[float]:
    length, a, lever = 0.4, math.radians(30.0), 0.06
    radius = length / a
    base = (-lever + radius * math.sin(a), radius * (1.0 - math.cos(a)))
    return [base[0] + lever * math.cos(a), base[1] + lever * math.sin(a)]


def grey_codes() -> list[float]:
    r, g, b = 200.0, 100.0, 50.0
    y = 0.299 * r + 0.587 * g + 0.114 * b
    return [float(round(x)) for x in (y, 128.0 + (b - y) / 1.772, 128.0 + (r - y) / 1.402)]


def steel() -> list[float]:
    n = complex((2.3962 + 2.4839) / 2.0, (4.1378 + 4.2261) / 2.0)  # steel at 640 and 660 nm
    found = []
    for angle in (0.0, math.radians(45.0)):
        cos, inner = math.cos(angle), (1.0 - (math.sin(angle) / n) ** 2) ** 0.5
        s, p = (cos - n * inner) / (cos + n * inner), (n * cos - inner) / (n * cos + inner)
        found.append(50.0 * (abs(s) ** 2 + abs(p) ** 2))
    return found


# The same by the library.


def rig() -> Rig:
    return default_rig()


def library_pixel() -> list[float]:
    camera = Camera(k1=-0.026, k2=1.06, k3=-3.40, p1=1e-3, p2=-2e-3)
    return [*camera.project(np.array([0.03, -0.02, 0.30]))]


def library_angles() -> list[float]:
    view, uv = rig().at(0.0), np.array([900.0, 300.0])
    return [float(phi(view, uv)) for phi in (phi_ray, phi_normal, phi_incidence)]


def library_direct() -> list[float]:
    view = rig().at(0.0)
    return [*view.rig.camera.project(view.T_world_camera.inverse().points(np.array([0.3, -0.2, 2.0])))]


def library_axis() -> list[float]:
    """Axis of the true mirror in the world, of a nominal tilt and a misalignment."""
    base = rig()
    nominal = Pose("camera", "sphere", (0.0, 0.0, 0.2), rotation_xyz(0.1, 0.0))
    mirror = RevolvedMirror(paraboloid(0.06, 0.06))
    tilted = Rig(base.camera, mirror, base.T_world_camera, nominal)
    true = tilted.perturbed(Misalignment(mirror_tilt_y_rad=0.2))
    return [*true.at(0.0).T_world_sphere.R[:, 2]]


def library_sphere_form() -> list[float]:
    ball = rig().perturbed(Misalignment(form_31c_m=5e-4)).mirror
    n = np.array([0.6, 0.0, -0.8])
    low, high = 0.05, 0.07
    for _ in range(60):  # where the level is 0
        middle = 0.5 * (low + high)
        outside = float(ball.level(middle * n).value_m) > 0.0
        low, high = (low, middle) if outside else (middle, high)
    return [1e3 * low]


def library_form() -> list[float]:
    form = Misalignment(form_20_m=2e-4).mirror(RevolvedMirror(paraboloid(0.06, 0.06)))
    assert isinstance(form.surface, FormedProfile)
    return [1e3 * float(form.surface.heights(np.array(0.045), np.array(0.0)).z_m)]


def library_drive() -> list[float]:
    vehicle = Vehicle()
    leg = DriveLeg(0.0, length_m=0.4, turn_rad=math.radians(30.0))
    end = Drive(vehicle, (leg,), vehicle.slip, vehicle.skid).starts[-1]
    return [*placement(vehicle, end)[1][:2]]


def library_codes() -> list[float]:
    planes = np.broadcast_to(np.array([200.0, 100.0, 50.0])[:, None, None] / 255.0, (3, 2, 4))
    codes = yuyv(planes, sensor("yuyv"))
    return [float(codes[0, 0, 0]), float(codes[0, 0, 1]), float(codes[0, 1, 1])]


def library_mosaic() -> list[float]:
    planes = np.broadcast_to(np.array([1.0, 2.0, 3.0])[:, None, None], (3, 2, 2))
    return [*mosaic(planes).ravel()]


def encoded(**changes: str) -> list[float]:
    return [255.0 * float(tone_encoded(np.array(0.2), sensor("yuyv", **changes)))]


BY = Callable[[], list[float]]
CHECKS: dict[str, tuple[BY, BY]] = {
    "pixel": (distorted_pixel, library_pixel),
    "direct": (lambda: [CX + FX * 0.3 / 1.55, CY - FX * 0.2 / 1.55], library_direct),
    "reflection": (reflection_point, lambda: [*reflect(rig().at(0.0), np.array([900.0, 300.0])).origin_world_m]),
    "phi": (angles_of_a_pixel, library_angles),
    "azimuth": (
        azimuth,
        lambda: [float(np.arctan2(*reflect(rig().at(0.0), np.array([900.0, 300.0])).normal_world[1::-1]))],
    ),
    "depth": (depth_of_two_angles, lambda: [float(depth_paper(0.70, 0.64, 0.4, R).depth_m)]),
    "rotation": (
        lambda: [*(turn(2, 0.3) @ turn(1, 0.2) @ turn(0, 0.1))[:, 2]],
        lambda: [*np.array(rotation_xyz(0.1, 0.2, 0.3))[:, 2]],
    ),
    "stroke": (
        lambda: [*([0.0, 0.0, LENS_M] + 0.5 * turn(1, 0.02) @ turn(0, 0.01) @ [0.0, 0.0, 1.0])],
        lambda: [
            *rig().perturbed(Misalignment(stroke_tilt_x_rad=0.01, stroke_tilt_y_rad=0.02)).at(0.5).camera_centre_m
        ],
    ),
    "between": (
        moved_sphere,
        lambda: [*rig().perturbed(Misalignment(roll_rad=0.02, pitch_rad=0.01, yaw_rad=0.03)).at(0.5).sphere_centre_m],
    ),
    "tilt": (lambda: [*(turn(1, 0.2) @ turn(0, 0.1))[:, 2]], library_axis),
    "form, sphere": (form_of_a_sphere, library_sphere_form),
    "form, revolution": (form_of_a_paraboloid, library_form),
    "metal": (
        steel,
        lambda: [100.0 * float(rig().mirror.reflectance(np.cos(a), 650.0)) for a in (0.0, math.pi / 4.0)],
    ),
    "lens": (lambda: [FX * 2.8e-3 / 2.4 / 2.0], lambda: [1e3 * rig().camera.aperture_radius_m]),
    "laser": (lambda: [3.0 + 2.0, 5.0 / 4.0], lambda: [1e3 * beam_diameter_m(2.0), 250.0 * beam_diameter_m(2.0)]),
    "photons": (
        lambda: [650e-9 / (6.62607015e-34 * 299792458.0) / 1e18],
        lambda: [photons_per_joule(650.0) / 1e18],
    ),
    "mosaic": (lambda: [1.0, 2.0, 2.0, 3.0], library_mosaic),
    "converter": (
        lambda: [float(round(64.0 + 959.0 / 12000.0 * 1000.0))],
        lambda: [float(digitised_signal(np.array(1000.0), sensor("bayer-raw")))],
    ),
    "rec709": (
        lambda: [255.0 * (1.09929682680944 * 0.2**0.45 - 0.09929682680944)],
        lambda: encoded(transfer_function="rec709"),
    ),
    "srgb": (lambda: [255.0 * (1.055 * 0.2 ** (1.0 / 2.4) - 0.055)], encoded),
    "ycbcr": (grey_codes, library_codes),
    "shutter": (lambda: [-359.5 * 30.0 / 720.0], lambda: [1e3 * float(row_times_s(np.array(0), 720, 0.030))]),
    "drive": (end_of_a_drive, library_drive),
}


def printed() -> dict[str, list[str]]:
    """Numbers of the last cell of every row of the page's tables, by the name in the first."""
    rows = [line.strip().strip("|").split("|") for line in PAGE.read_text(encoding="utf-8").split("\n") if "|" in line]
    cells = [[cell.strip() for cell in row] for row in rows]
    return {row[0]: NUMBER.findall(row[-1]) for row in cells if row[0] not in ("name", "---")}


def test_the_page_has_every_convention() -> None:
    assert sorted(printed()) == sorted(CHECKS)


@pytest.mark.parametrize("name", CHECKS)
def test_the_printed_numbers_are_those_of_plain_formulas(name: str) -> None:
    expected = CHECKS[name][0]()
    shown = printed()[name]
    assert len(shown) == len(expected)
    for text, value in zip(shown, expected, strict=True):
        digits = len(text.partition(".")[2])
        assert float(text) == pytest.approx(value, rel=0.0, abs=0.5001 * 10.0**-digits)


@pytest.mark.parametrize("name", CHECKS)
def test_the_library_agrees_with_the_plain_formulas(name: str) -> None:
    expected, found = (np.array(by(), dtype=float) for by in CHECKS[name])
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


def test_the_orders_and_axes_that_the_page_refuses_are_told_apart() -> None:
    """By more than ten of the last printed digits: a wrong order, and a form laid along the normal."""
    other = (turn(0, 0.1) @ turn(1, 0.2))[:, 2]
    assert np.abs(other - CHECKS["tilt"][0]()).max() > 1e-3
    r, rho, h = 0.045, 0.75, 2e-4
    height = h * (6.0 * rho**4 - 6.0 * rho**2 + 1.0)
    # a place whose foot on the paraboloid is r, moved along the normal by the height there
    slope = r / R
    n = math.sqrt(1.0 + slope**2)
    moved = (r + height * slope / n, r * r / (2.0 * R) - height / n)
    axial = moved[0] ** 2 / (2.0 * R) - moved[1]
    assert abs(axial - height * n) > 1e-9
    published = 255.0 * (1.099 * 0.2**0.45 - 0.099)
    assert abs(published - CHECKS["rec709"][0]()[0]) > 0.01
    assert replace(default_rig()).mirror.radius_m == R
