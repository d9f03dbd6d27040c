"""Vehicle: arcs against integration, odometry against drawn ways, stance against a ground that is searched."""

from __future__ import annotations

import ast
import math
from pathlib import Path

import numpy as np
import pytest
import scipy
from scipy.optimize import brentq

from phibench.scenes.frames import rotation_xyz
from phibench.scenes.motion.vehicle import (
    PARAMETERS,
    Arc,
    Obstacle,
    PlanarPose,
    Stance,
    Vehicle,
    arc_covariance,
    flipper_pitch_rad,
    rig_placement,
    rig_pose,
    stance,
)
from phibench.scenes.random_streams import generator
from phibench.scenes.room import chassis
from phibench.scenes.validation import SceneError

ESCALADE = Vehicle()


def odometry_covariance(vehicle: Vehicle, tracks_m: list[tuple[float, float]], start: PlanarPose) -> np.ndarray:
    """Covariance of (x, y, heading), world, shape (3, 3), after steps of the tracks, to first order.

    Random part of the tracks' ways only; slip and skid are nominal. Many short steps and few long ones differ by what
    the heading does within a step, of second order in its turn.

    Parameters
    ----------
    vehicle : Vehicle
    tracks_m : sequence of (left, right), metres
    start : PlanarPose, known exactly
    """
    P, pose = np.zeros((3, 3)), start
    for left, right in tracks_m:
        arc, c, s = vehicle.arc(left, right), math.cos(pose.heading_rad), math.sin(pose.heading_rad)
        turned = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        pose_after = pose.after(arc)
        F = np.eye(3)
        F[:2, 2] = pose.y_m - pose_after.y_m, pose_after.x_m - pose.x_m
        G = turned @ arc.jacobian()
        P = F @ P @ F.T + G @ arc_covariance(vehicle, left, right) @ G.T
        pose = pose_after
    return P


def test_arcs_agree_with_integration_of_the_tracks_speeds() -> None:
    """Oracle: the differential equation of the base, whose step control is set to 1e-12."""
    checked = 0
    for left, right in ((0.3, 0.3), (0.3, 0.31), (-0.2, 0.4), (0.5, 0.5 + 1e-6), (0.0, 2.0), (-0.7, -0.1)):
        for heading in (0.0, 2.0):
            f, k, b = ESCALADE.slip, ESCALADE.skid, ESCALADE.gauge_m
            speed, rate = (1 - f) * (left + right) / 2, (1 - f) * (right - left) / (k * b)

            def slope(_: float, y: np.ndarray, speed: float = speed, rate: float = rate) -> list[float]:
                return [speed * math.cos(y[2]), speed * math.sin(y[2]), rate]

            end = scipy.integrate.solve_ivp(slope, (0, 1), [0.4, -0.3, heading], rtol=1e-12, atol=1e-13).y[:, -1]
            found = PlanarPose(0.4, -0.3, heading).after(ESCALADE.arc(left, right))
            assert [found.x_m, found.y_m, found.heading_rad] == pytest.approx(end, abs=1e-10)
            checked += 1
    assert checked == 12


def test_an_arc_has_no_seam_at_small_turns() -> None:
    """The series and the closed form meet: both within 1e-15 of each other's value at the seam, 1e-4 rad."""
    for s in (0.5, -2.0):
        below, above = Arc(s, 0.99999e-4), Arc(s, 1.00001e-4)
        assert below.chord_m == pytest.approx(above.chord_m, abs=3e-9)
        assert below.jacobian() == pytest.approx(above.jacobian(), abs=3e-9)


@pytest.mark.parametrize("arc", [Arc(0.6, 0.8), Arc(-0.3, -2.0), Arc(1.0, 3e-5), Arc(0.0, 1.0), Arc(0.4, 0.0)])
def test_the_jacobian_of_an_arc_is_its_differences(arc: Arc) -> None:
    step = 1e-6  # central differences: step^2 / 6 of the third derivative, below 1e-11, and rounding of 1e-10
    columns = []
    for ds, da in ((step, 0.0), (0.0, step)):
        high, low = (Arc(arc.length_m + g * ds, arc.turn_rad + g * da) for g in (1, -1))
        columns.append([*((np.array(high.chord_m) - low.chord_m) / (2 * step)), (1.0 if da else 0.0)])
    assert arc.jacobian() == pytest.approx(np.array(columns).T, abs=1e-9)


def test_odometry_spreads_as_drawn_ways_do() -> None:
    """2000 ways with random parts; a variance of n draws has the relative sigma sqrt(2 / n): 0.032, five of them."""
    tracks = [(0.05, 0.05)] * 20 + [(0.02, 0.06)] * 15 + [(0.05, 0.04)] * 10
    start = PlanarPose(0.2, 0.1, 0.7)
    predicted = odometry_covariance(ESCALADE, tracks, start)
    rng, ends = generator("test", "odometry"), []
    for _ in range(2000):
        pose = start
        for way in tracks:
            drawn = [x + math.sqrt(ESCALADE.track_variance_m2(x)) * rng.standard_normal() for x in way]
            pose = pose.after(ESCALADE.arc(*drawn))
        ends.append([pose.x_m, pose.y_m, pose.heading_rad])
    measured = np.cov(np.array(ends).T)
    scale = np.sqrt(np.diag(predicted))
    limit = 5 * math.sqrt(2 / 2000)
    assert np.abs((measured - predicted) / np.outer(scale, scale)).max() < limit
    # tracks that are noisier by 15 % would be noticed
    assert np.abs((1.15**2 * measured - predicted) / np.outer(scale, scale)).max() > limit


def test_a_straight_way_spreads_sideways_with_the_cube_of_its_length() -> None:
    """Closed form of a heading that walks randomly: var(y) = q s^3 / 3, q the heading's variance per metre."""
    n, s, kept = 2000, 3.0, 1 - ESCALADE.slip
    q = 2 * kept**2 * ESCALADE.track_noise**2 / (kept * (ESCALADE.skid * ESCALADE.gauge_m) ** 2)
    P = odometry_covariance(ESCALADE, [(s / n / kept,) * 2] * n, PlanarPose())
    assert P[2, 2] == pytest.approx(q * s, rel=1e-9)
    assert P[1, 1] == pytest.approx(q * s**3 / 3, rel=2 / n)  # a sum of n terms instead of the integral
    assert P[0, 1] == pytest.approx(0.0, abs=1e-15)


def lowest(pitch: float, angle: float, vehicle: Vehicle) -> float:
    """Height of the tip roller's lowest point above that of the rear roller, with the base turned nose up."""
    x, z = vehicle.contact_m + vehicle.flipper_m * math.cos(angle), vehicle.flipper_m * math.sin(angle)
    return (x * math.sin(pitch) + z * math.cos(pitch) - vehicle.tip_m) + vehicle.roller_m


@pytest.mark.parametrize("angle", [-1.4, -0.9, -0.5, -0.35])
def test_flippers_lift_the_front_until_their_tips_touch(angle: float) -> None:
    """Oracle: the pitch at which both rollers are equally low, by bisection."""
    searched = brentq(lowest, 0.0, 1.0, args=(angle, ESCALADE), xtol=1e-14)
    assert flipper_pitch_rad(ESCALADE, angle) == pytest.approx(searched, abs=1e-12)
    assert searched > 0.01


def test_flippers_ahead_or_up_do_nothing() -> None:
    assert [flipper_pitch_rad(ESCALADE, angle) for angle in (-0.2, 0.0, 1.0)] == [0.0, 0.0, 0.0]
    assert lowest(0.0, -0.2, ESCALADE) > 0.0


def test_a_lifted_front_raises_and_tilts_the_sensor() -> None:
    """The rear axle stays; the stroke axis leans back by the pitch."""
    pose = PlanarPose(1.0, 2.0, 0.5)
    R, t = rig_placement(ESCALADE, pose, stance(ESCALADE, pose, -1.0))
    pitch = flipper_pitch_rad(ESCALADE, -1.0)
    assert np.degrees(np.arccos(R[2, 2])) == pytest.approx(math.degrees(pitch), abs=1e-9)
    ahead = np.array([math.cos(0.5), math.sin(0.5), 0.0])
    assert R[:, 2] @ ahead == pytest.approx(-math.sin(pitch), abs=1e-12)
    axle = np.array([-0.29 - 0.06, 0.0, 0.10])  # in the rig's frame
    assert R @ axle + t == pytest.approx(np.array([1.0, 2.0, 0.10]) - 0.29 * ahead, abs=1e-12)
    assert rig_pose(ESCALADE, pose, stance(ESCALADE, pose, -1.0)).t == pytest.approx(t, abs=0)


def test_ground_gives_pitch_and_roll() -> None:
    ramp = Obstacle(3.0, 0.0, 1.0, 2.0, 0.2, run_m=2.0)  # slope of one in ten between x = 0.5 and 2.5
    held = stance(ESCALADE, PlanarPose(1.5, 0.0, 0.0), 0.0, [ramp])
    assert held.pitch_rad == pytest.approx(math.atan(0.1), abs=1e-12)
    assert (held.lift_m, held.roll_rad) == pytest.approx((0.1, 0.0), abs=1e-12)
    across = stance(ESCALADE, PlanarPose(1.5, 0.0, math.pi / 2), 0.0, [ramp])  # its right side is uphill
    assert across.roll_rad == pytest.approx(-math.atan(0.1), abs=1e-12)
    R, _ = rig_placement(ESCALADE, PlanarPose(1.5, 0.0, math.pi / 2), across)
    assert R[:, 2] == pytest.approx(np.array([-0.1, 0.0, 1.0]) / math.hypot(1, 0.1), abs=1e-12)


def test_a_roller_rolls_over_a_step_on_a_circle_about_its_edge() -> None:
    """Oracle: the least height at which a circle of the roller's radius meets no point of the step, by search."""
    step, r = Obstacle(1.0, 0.0, 0.4, 1.0, 0.06), ESCALADE.roller_m
    edge = np.stack([np.linspace(0.8, 1.2, 4001), np.full(4001, 0.06)], axis=-1)
    for x in np.linspace(0.6, 1.4, 33):
        near = np.abs(edge[:, 0] - x) < r
        above = edge[near, 1] + np.sqrt(r**2 - (edge[near, 0] - x) ** 2) - r
        expected = max(above.max(initial=0.0), 0.0)
        assert step.lift_m(x, 0.0, r) == pytest.approx(expected, abs=1e-6)  # points of the edge are 1e-4 apart
    assert step.lift_m(1.0, 0.6, r) == 0.0


def test_roll_counts_with_the_left_side_up() -> None:
    one_track = Obstacle(0.0, 0.21, 2.0, 0.1, 0.05)
    held = stance(ESCALADE, PlanarPose(), 0.0, [one_track])
    assert held.roll_rad == pytest.approx(math.atan2(0.05, 0.42))
    R, _ = rig_placement(ESCALADE, PlanarPose(), held)
    assert R[:, 2] == pytest.approx(np.array(rotation_xyz(held.roll_rad))[:, 2])
    assert R[2, 1] > 0


def test_every_number_is_declared_with_a_range_and_is_used() -> None:
    assert all(entry.low < entry.high and entry.unit and entry.meaning for entry in PARAMETERS.values())
    root = Path(__file__).parents[3]
    files = [file for folder in ("scenes", "robot/loop", "robot/film") for file in (root / folder).rglob("*.py")]
    read = {node.attr for file in files for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
            if isinstance(node, ast.Attribute)}  # fmt: skip
    assert set(PARAMETERS) - read == set()


def test_the_vehicle_is_as_long_and_as_wide_as_the_robot_that_is_rendered() -> None:
    solids = {solid.name: solid for solid in chassis()}
    left, right = (solids[f"robot_track_{side}"] for side in ("left", "right"))
    assert left.T_world_shape.t[1] - right.T_world_shape.t[1] == pytest.approx(ESCALADE.gauge_m)
    assert left.size_m[2] == pytest.approx(2 * ESCALADE.roller_m)
    assert left.size_m[0] == pytest.approx(ESCALADE.contact_m + 2 * ESCALADE.roller_m)
    assert left.T_world_shape.t[0] == pytest.approx(-ESCALADE.sensor_x_m)  # the world of rooms is the rig's


def test_steps_that_add_up_to_the_end_of_the_flippers_range_are_at_that_end() -> None:
    assert sum([0.1] * 16) > ESCALADE.flipper_high_rad
    assert ESCALADE.check_flipper(sum([0.1] * 16)) == ESCALADE.flipper_high_rad
    with pytest.raises(SceneError, match="flipper_rad"):
        ESCALADE.check_flipper(ESCALADE.flipper_high_rad + 1e-6)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: ESCALADE.check_flipper(2.0), ("flipper_rad = 2", "1.6 rad")),
        (lambda: stance(ESCALADE, PlanarPose(), math.nan), ("flipper_rad = nan", "1.6 rad")),
        (lambda: Vehicle(skid=0.5), ("Vehicle.skid = 0.5", "1.0 to 2.5")),
        (lambda: Obstacle(0, 0, 1, 1, 0.2).lift_m(0, 0, 0.1), ("height_m = 0.2", "ramp")),
    ],
)
def test_what_cannot_be_is_refused_in_one_sentence(make, words) -> None:
    with pytest.raises(SceneError) as error:
        make()
    assert all(word in str(error.value) for word in words)
    assert str(error.value).count("\n") == 0


def test_a_level_stance_leaves_the_rig_upright() -> None:
    R, t = rig_placement(ESCALADE, PlanarPose(), Stance())
    assert R == pytest.approx(np.eye(3), abs=0)
    assert t == pytest.approx([ESCALADE.sensor_x_m, 0.0, 0.0], abs=1e-15)
