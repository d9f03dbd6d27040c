"""The vertical from edges, and the point through which they pass: exact vertical lines by another way."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.oracles import true_pixel

from phibench.calibration.outline.first_circle import rig_circle
from phibench.calibration.rig.bundle import apparent_outline
from phibench.calibration.rig.edge_meeting import EdgeMeeting, edge_meeting, stated_tilt, with_vertical
from phibench.calibration.rig.vertical_edges import edges_of, find_vertical, measured_vertical, vertical_of
from phibench.estimator.spots.image_planes import ImageError
from phibench.scenes.frames import Pose, as_matrix, as_vector, rotation_xyz
from phibench.scenes.rig import Rig

HEIGHTS_M = np.linspace(0.2, 1.9, 20)
FEET_M = [(3.0, 0.4), (0.5, 3.5), (-2.4, 1.0), (-1.0, -4.0), (2.0, -2.2)]


def tilted(x_deg: float, y_deg: float) -> Rig:
    """Camera tilted about its lens, sphere off its axis."""
    pose = Pose("world", "camera", (0.0, 0.0, 0.45), rotation_xyz(*np.radians([x_deg, y_deg, 30.0])))
    return replace(Rig(), T_world_camera=pose, T_camera_sphere=Pose("camera", "sphere", (1e-3, -5e-4, 0.261)))


def upright(rig: Rig) -> Rig:
    """The nominal rig: the same, not tilted."""
    level = replace(rig.T_world_camera, rotation=as_matrix(np.eye(3)))
    return replace(rig, T_world_camera=level)


def lines(rig: Rig, noise_px: float = 0.0) -> list[np.ndarray]:
    """Pixels of vertical lines, by Alhazen's quartic."""
    rng = np.random.default_rng(21)
    found = []
    for x, y in FEET_M:
        pixels = np.array([true_pixel(rig, 0.0, np.array([x, y, z])) for z in HEIGHTS_M])
        found.append(pixels + noise_px * rng.standard_normal(pixels.shape))
    return found


@pytest.mark.parametrize("tilt", [(0.0, 0.0), (0.5, -0.8), (-1.5, 1.0)])
def test_exact_lines_give_the_vertical(tilt: tuple[float, float]) -> None:
    """Distances are not known: with a sphere 1 mm off the axis that costs up to 1e-4 rad (0.006 degrees)."""
    rig = tilted(*tilt)
    found = vertical_of(lines(rig), upright(rig))
    assert found.edges == len(FEET_M)
    assert np.abs(found.up[:2] - rig.T_world_camera.R.T[:2, 2]).max() < 1e-4


def test_a_sloping_line_is_left_out() -> None:
    """A line that leans by 5 degrees among five upright ones; with it the vertical would be off by about a degree."""
    rig = tilted(0.3, 0.2)
    lean = np.array([true_pixel(rig, 0.0, np.array([2.5 + 0.09 * z, 1.5 - 0.2 * z, z])) for z in HEIGHTS_M])
    found = vertical_of([*lines(rig, 0.05), lean], upright(rig))
    assert found.edges == len(FEET_M)
    assert np.abs(found.up[:2] - rig.T_world_camera.R.T[:2, 2]).max() < 2e-3


@pytest.mark.slow
def test_sigma_of_points_with_noise() -> None:
    """Pull over 60 draws; it scatters by 1 / sqrt(120) = 9 %, with few edges by twice that: false alarm 1e-3."""
    rig = tilted(0.4, -0.3)
    exact, rng = lines(rig), np.random.default_rng(22)
    z = []
    for _ in range(60):
        found = vertical_of([edge + 0.05 * rng.standard_normal(edge.shape) for edge in exact], upright(rig))
        off = found.up[:2] - rig.T_world_camera.R.T[:2, 2]
        z.append(off / np.sqrt(np.diag(found.covariance)))
    pull = np.sqrt(np.mean(np.square(z)))
    assert 0.3 < pull < 1.6  # white noise: the sixfold allowance for points that are wrong together is too much here


def test_too_few_edges_are_refused() -> None:
    rig = tilted(0.0, 0.0)
    with pytest.raises(ImageError, match="3 are needed"):
        vertical_of(lines(rig)[:2], upright(rig))
    flat = np.full((3, 720, 1280), 100.0)
    with pytest.raises(ImageError, match="0 vertical edges"):
        find_vertical(flat, rig)


def test_edges_are_found_where_they_are() -> None:
    """A picture with three bright sectors between known azimuths: six edges, to 0.05 px across."""
    rig = Rig()
    centre = rig.outline_px().mean(axis=0)
    v, u = np.mgrid[:720, :1280]
    radius, azimuth = np.hypot(u - centre[0], v - centre[1]), np.arctan2(v - centre[1], u - centre[0])
    picture, borders = np.ones((720, 1280)), []
    for start in (-2.5, 0.4, 1.7):
        borders += [start, start + 0.3]
        for border, sign in ((start, 1.0), (start + 0.3, -1.0)):
            picture += 0.5 * sign / (1.0 + np.exp(-np.clip((azimuth - border) * radius / 0.5, -50.0, 50.0)))
    found = edges_of(picture, rig)
    assert len(found) == len(borders)
    for edge in found:
        at = np.arctan2(edge[:, 1] - centre[1], edge[:, 0] - centre[0])
        off = np.abs(at[:, None] - borders).min(axis=1) * np.hypot(*(edge - centre).T)
        assert off.max() < 0.05


def test_the_spheres_own_error_is_in_the_covariance() -> None:
    """4 um across the axis turn the normals by 4e-6 / 0.06 rad and the reflected rays by twice that."""
    rig = tilted(0.2, 0.1)
    edges = lines(rig)
    moved = replace(
        rig,
        T_camera_sphere=replace(rig.T_camera_sphere, translation_m=as_vector(rig.T_camera_sphere.t + [4e-6, 0.0, 0.0])),
    )
    change = np.linalg.norm((vertical_of(edges, upright(moved)).up - vertical_of(edges, upright(rig)).up)[:2])
    assert 0.3 * 1.3e-4 < change < 3.0 * 1.3e-4


# -- the point through which edges pass --------------------------------------------------------------------------------


def above_lens(beside_m: tuple[float, float], tilt_deg: tuple[float, float], principal_point_px: float = 0.0) -> Rig:
    """A mirror beside the vertical through the lens, in world axes, under a tilted camera."""
    pose = Pose("world", "camera", (0.0, 0.0, 0.45), rotation_xyz(*np.radians(tilt_deg), 0.0))
    centre = as_vector(pose.R.T @ np.array([*beside_m, 0.26]))
    camera = replace(Rig().camera, cx_px=639.5 + principal_point_px, cy_px=359.5 - principal_point_px)
    return replace(Rig(), camera=camera, T_world_camera=pose, T_camera_sphere=Pose("camera", "sphere", centre))


def met(rig: Rig, further: list[np.ndarray] | None = None) -> EdgeMeeting:
    return edge_meeting([*lines(rig), *(further or [])], rig_circle(rig))


@pytest.mark.parametrize("tilt_deg", [(0.0, 0.0), (1.0, -0.6)])
def test_edges_meet_in_the_middle_of_the_outline_where_the_mirror_is_above_the_lens(tilt_deg) -> None:
    """A tilt of the camera leaves it so: 0.7 px/deg remain, as the middle of an ellipse is not its cone's axis."""
    found = met(above_lens((0.0, 0.0), tilt_deg))
    assert len(found.edges) == len(FEET_M)
    assert found.off_px < 0.8 * float(np.hypot(*tilt_deg)) + 1e-6


def test_edges_miss_the_middle_by_the_mirrors_offset() -> None:
    """1 mm moves the outline by 5.5 px and the point by 2.3 px more: the same share for twice as much, and along it."""
    one, two = met(above_lens((1e-3, 0.0), (0.0, 0.0))), met(above_lens((0.0, 2e-3), (0.0, 0.0)))
    off = [found.uv_px - found.centre_px for found in (one, two)]
    assert 2.0 < off[0][0] < 2.6
    assert off[1][1] == pytest.approx(2.0 * off[0][0], rel=0.1)
    # the edges stand unevenly around, and lines of an offset rig are bent
    assert abs(off[0][1]) + abs(off[1][0]) < 0.4


def test_lines_that_do_not_meet_there_are_left_out_or_refused() -> None:
    rig = above_lens((0.0, 0.0), (0.0, 0.0))
    u, v, radius = rig_circle(rig)
    aside = np.stack([np.linspace(u - 200.0, u - 120.0, 30), np.full(30, v + 0.25 * radius)], axis=-1)
    assert len(met(rig, [aside]).edges) == len(FEET_M)
    with pytest.raises(ImageError, match="3 are needed"):
        edge_meeting(lines(rig)[:2], rig_circle(rig))
    # both sides of a post, and one more of it: they say nothing along themselves
    post = [np.stack([u + np.linspace(190.0, 290.0, 30), np.full(30, v + k)], axis=-1) for k in (-1.0, 0.0, 1.0)]
    with pytest.raises(ImageError, match="3 are needed"):
        edge_meeting(post, rig_circle(rig))


def test_edges_make_an_unknown_principal_point_harmless() -> None:
    """A camera tilted by 0.3 deg whose principal point is 6 px off: nobody knows of either.

    Without edges the tilt moves the mirror by 0.36 deg x 0.26 m = 1.6 mm, the principal point by 8.5 px x 0.26 m / f
    = 1.5 mm. With them 1 - 0.83 of what the principal point does is left, and less, as tilt and point share it out.
    """
    true, beside_m = above_lens((1.2e-3, -0.7e-3), (0.3, -0.2), 6.0), np.array([1.2e-3, -0.7e-3])
    nominal = above_lens((0.0, 0.0), (0.0, 0.0))
    sphere = apparent_outline(nominal, true)
    pose = replace(nominal.T_camera_sphere, translation_m=as_vector(sphere))
    stated = stated_tilt(nominal, np.radians(0.5), 10.0)
    vertical = measured_vertical(lines(true), replace(nominal, T_camera_sphere=pose))
    focal = np.array([nominal.camera.fx_px, nominal.camera.fy_px])
    off, sigma = {}, {}
    for name, camera in (("stated", stated), ("edges", with_vertical(stated, nominal, vertical))):
        found, covariance = camera.beside_m(sphere, focal)
        off[name] = float(np.linalg.norm(found[:2] - beside_m))
        sigma[name] = float(np.sqrt(0.5 * np.trace(covariance)))
    assert off["stated"] > 1e-3
    assert off["edges"] < 0.2 * off["stated"]
    assert off["edges"] < 3.0 * sigma["edges"]
    assert sigma["edges"] < 0.2 * sigma["stated"]


def test_edges_that_contradict_what_was_stated_widen_sigma() -> None:
    """A camera that is said to be vertical to 0.01 deg and leans by 1.5 deg."""
    rig = tilted(-1.5, 0.0)
    stated = stated_tilt(upright(rig), np.radians(0.01), 0.1)
    found = with_vertical(stated, upright(rig), measured_vertical(lines(rig, 0.05), upright(rig)))
    assert found.chi2 is not None
    assert found.chi2 > 100.0
    assert np.sqrt(found.covariance[0, 0]) > np.radians(0.05)
