"""Contours of mirrors of revolution: against projected rims and surfaces, and in frames of drawn rigs."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import scipy
from helpers.limb_frames import drawn_revolved, drawn_room, limb_light
from helpers.revolved_rigs import PROFILES, revolved
from scipy import optimize

from phibench.calibration.outline.contour import (
    Contour,
    contour_of,
    place_of_outline,
    place_of_rig,
    rig_at,
    tilts_of_ellipse,
)
from phibench.calibration.outline.limb_image import planes_of
from phibench.calibration.outline.outline import find_outline, fit_outline, outline_at
from phibench.calibration.outline.outline_least_squares import OutlinePixels
from phibench.calibration.outline.outline_result import Outline, mean_outline
from phibench.datasets.frames.sensor_card import sensor_card
from phibench.estimator.spots.image_planes import ImageError
from phibench.render.sensor.camera_chain import Chain
from phibench.render.sensor.electrons import NoiseStream
from phibench.render.sensor.light import Light
from phibench.render.sensor.settings import sensor
from phibench.scenes.misalignment import Misalignment
from phibench.scenes.random_streams import generator
from phibench.scenes.revolved_mirror import RevolvedMirror
from phibench.scenes.revolved_profile import Profile
from phibench.scenes.rig import Rig

GRAZED = Profile(0.06, 0.8, 0.0445)
"""Ellipsoid whose rim lies behind the place where lines of sight touch it."""


def at_pixels(contour: Contour, uv: np.ndarray) -> np.ndarray:
    """Distances of places from a contour, pixels."""
    n = len(uv)
    pixels = OutlinePixels(np.zeros(n, int), uv[:, 0], uv[:, 1], np.zeros((n, 3)), np.zeros((n, 3, 2)), np.zeros(n))
    return contour.place_of(pixels).d_px


@pytest.mark.parametrize("shape", PROFILES)
def test_a_rim_is_a_projected_circle(shape: str) -> None:
    """10 000 points of the circle in space; the spline errs by 1e-6 px at most. A rig 1 mm off is 5 px off."""
    rig = revolved(shape, aligned=False, k1=-0.026, k2=1.06)
    profile, turn = PROFILES[shape], np.linspace(0.0, 2.0 * np.pi, 10_000)
    circle = np.stack([np.cos(turn), np.sin(turn), 0.0 * turn], axis=-1) * profile.rim_radius_m
    circle[:, 2] = profile.depth_m
    uv = rig.camera.project(circle @ rig.T_camera_sphere.R.T + rig.sphere_in_camera_m)
    contour = contour_of(rig, place_of_rig(rig))
    assert contour.rim.all()
    assert np.abs(at_pixels(contour, uv)).max() < 1e-6
    other = contour_of(rig, place_of_rig(rig) + [1e-3, 0.0, 0.0, 0.0, 0.0])
    assert 4.0 < np.abs(at_pixels(other, uv)).max() < 9.0


def test_a_surface_that_is_seen_tangentially() -> None:
    """In half-planes about the axis, the greatest angle from the axis that a point of the surface is seen under.

    A maximum of other mathematics than the contour's root of n . d; bounded minimisation finds it to 1e-8 of its place,
    where it is flat, and 1e-7 px. Random points of the surface lie inside.
    """
    rig = replace(revolved("ellipsoid", aligned=False), mirror=RevolvedMirror(GRAZED))
    eye, contour = rig.T_camera_sphere.inverse().t, contour_of(rig, place_of_rig(rig))
    assert not contour.rim.any()

    def pixel(radius: float, turn: float) -> np.ndarray:
        P = np.array([radius * np.cos(turn), radius * np.sin(turn), GRAZED.sag(np.array(radius**2)).z_m])
        return rig.camera.project(rig.T_camera_sphere.points(P))

    for turn in np.linspace(0.0, 6.0, 7):
        way = np.array([-np.sin(turn), np.cos(turn), 0.0])  # the half-plane's normal; the eye is beside it

        def off(radius: float, turn: float = turn) -> float:
            return -float(at_pixels(contour, pixel(radius, turn)[None])[0])

        best = optimize.minimize_scalar(off, bounds=(0.03, 0.0445), method="bounded", options={"xatol": 1e-9})
        # the point of the half-plane that is farthest out touches the contour, as near as the eye is to the half-plane
        assert abs(eye @ way) < 0.02
        assert best.fun == pytest.approx(0.0, abs=2e-3)
    rng = np.random.default_rng(1)
    inside = np.array([pixel(r, t) for r, t in zip(rng.uniform(0, 0.0445, 4000), rng.uniform(0, 7, 4000), strict=True)])
    assert at_pixels(contour, inside).max() < 1e-6


@pytest.mark.parametrize("shape", ["paraboloid", "cone"])
def test_derivatives_and_the_way_back(shape: str) -> None:
    """Motion of the distances with the place, by central differences; and the place of a contour's own points."""
    rig = revolved(shape)
    place = place_of_rig(rig) + [1e-3, -2e-3, 3e-3, 0.03, -0.02]
    contour, rng = contour_of(rig, place), np.random.default_rng(2)
    uv = contour.points_px(50) + rng.uniform(-3.0, 3.0, (50, 2))
    n = len(uv)
    pixels = OutlinePixels(np.zeros(n, int), uv[:, 0], uv[:, 1], np.zeros((n, 3)), np.zeros((n, 3, 2)), np.zeros(n))
    ours = contour.place_of(pixels).by_s
    for i, step in enumerate((1e-5, 1e-5, 1e-5, 1e-3, 1e-3)):
        e = step * np.eye(5)[i]
        there = [at_pixels(contour_of(rig, place + s * e), uv) for s in (1.0, -1.0)]
        difference = (there[0] - there[1]) / (2.0 * step)
        # the cosine of the curve's slant changes, too, by 1e-3 of what it is
        assert ours[:, i] == pytest.approx(difference, abs=2e-3 * np.abs(difference).max())
    # the ellipse is about the contour's middle, and on the way back about the rig's own: 4 % of it aside
    off = np.abs(place_of_outline(rig, contour.points_px(300)) - place)
    assert (off < [1e-6, 1e-6, 1e-6, 5e-5, 5e-5]).all()


def test_what_a_tilt_does_to_the_rim() -> None:
    """First order a shift, as of a decentre; second order an ellipse, the same for both signs; by an ellipse's axes.

    The axes of the projected circle, by moments of its points, are a mean apart by 4 e.
    """
    rig, a = revolved("paraboloid"), np.radians(3.0)
    found = {}
    for sign in (1.0, -1.0):
        true = rig.perturbed(Misalignment(mirror_tilt_y_rad=sign * a))
        uv = true.outline_px(4000)
        found[sign] = place_of_outline(rig, uv)
        size = np.ptp(uv, axis=0)
        e1 = 0.25 * (size[0] - size[1])
        assert found[sign][3] == pytest.approx(e1, rel=0.02)
        assert abs(found[sign][4]) < 1e-4
    assert found[1.0][3] == pytest.approx(found[-1.0][3], rel=1e-6)
    assert found[1.0][3] < -0.1  # 0.17 px at 3 degrees
    assert found[1.0][0] == pytest.approx(-found[-1.0][0], rel=1e-3)
    depth = PROFILES["paraboloid"].depth_m
    q, Z = 0.06, 0.2 + depth
    # the rim's centre moves by a x depth, and the near side looks larger: a q^2 / Z more
    assert found[1.0][0] == pytest.approx(a * (depth + q * q / Z), rel=0.02)
    of = tilts_of_ellipse(rig, np.radians(2.0))
    assert of(np.array([0.0, a])) == pytest.approx(found[1.0][3:], rel=0.02, abs=1e-3)


# -- in frames ---------------------------------------------------------------------------------------------------------


@cache
def scene(shape: str) -> tuple[Rig, np.ndarray]:
    rng = generator("test", "rim", shape)
    rig = drawn_revolved(rng, "ellipsoid", conic=0.8, rim_radius_m=0.0445) if shape == "grazed" else None
    rig = rig or drawn_revolved(rng, shape)
    return rig, limb_light(rig, rng, 1.5e5, drawn_room(rng))


def frame_of(shape: str, preset: str) -> np.ndarray:
    rig, light = scene(shape)
    return Chain(sensor(preset), 0, rig.camera).frame(Light(light), NoiseStream(("rim", shape)))


def nominal(rig: Rig) -> Rig:
    """The rig with its mirror straight above, 6 mm too near."""
    return rig_at(rig, np.array([0.0, 0.0, 0.214, 0.0, 0.0]))


def check(found: Outline, rig: Rig) -> None:
    """chi2 of place and ellipse, five numbers: false alarm 1e-5; an outline off by 0.2 px would be noticed."""
    assert found.ellipse_px is not None
    assert found.covariance is not None
    error = np.append(found.sphere_in_camera_m - rig.sphere_in_camera_m, found.ellipse_px)
    limit = scipy.stats.chi2.isf(1e-5, 5)
    assert error @ np.linalg.solve(found.covariance, error) < limit
    wrong = error + [2e-4, 0.0, 0.0, 0.0, 0.0]
    assert wrong @ np.linalg.solve(found.covariance, wrong) > 2.0 * limit


@cache
def nearby(shape: str) -> Outline:
    """Fit of a raw frame from a place nearby."""
    rig, card = scene(shape)[0], sensor_card("bayer-raw")
    start = place_of_rig(rig) + [2e-5, -2e-5, 3e-4, 0.0, 0.0]
    return fit_outline(outline_at(planes_of(frame_of(shape, "bayer-raw"), card), rig, start))


@pytest.mark.slow
def test_from_the_picture_alone() -> None:
    rig = scene("paraboloid")[0]
    found = find_outline(frame_of("paraboloid", "mjpeg"), nominal(rig), sensor_card("mjpeg"))
    check(found, rig)
    assert not found.by_edge
    assert found.blur_px == pytest.approx(rig.camera.blur_sigma_px, abs=0.15)


@pytest.mark.parametrize("shape", ["cone", pytest.param("grazed", marks=pytest.mark.slow)])
def test_from_nearby(shape: str) -> None:
    check(nearby(shape), scene(shape)[0])


def test_measured_numbers_of_several_outlines() -> None:
    found = nearby("cone")
    together = mean_outline([found, found])
    assert together.value == pytest.approx(found.measured.value)
    assert together.covariance == pytest.approx(found.covariance / 2.0)
    assert found.widened(2.0).measured.covariance == pytest.approx(4.0 * found.covariance)


@pytest.mark.slow
def test_pictures_without_a_rim_are_refused_in_one_sentence() -> None:
    rig, rng = revolved("paraboloid"), np.random.default_rng(3)
    blank = planes_of(1000.0 + rng.standard_normal((3, 720, 1280)))
    with pytest.raises(ImageError, match="no circle of the rim's size has edges all around"):
        find_outline(np.ones((3, 720, 1280)), rig)
    with pytest.raises(ImageError, match="no edge along the mirror's rim"):
        fit_outline(outline_at(blank, rig, place_of_rig(rig)))
    with pytest.raises(ImageError, match="cut by the frame"):
        fit_outline(outline_at(blank, rig, place_of_rig(rig) + [0.14, 0.0, 0.0, 0.0, 0.0]), near=True)


def test_a_part_of_a_picture_is_refused_in_one_sentence() -> None:
    with pytest.raises(ImageError, match="give a whole frame"):
        find_outline(np.ones((3, 100, 1280)), revolved("paraboloid"))
