"""Drive in films: states against the vehicle's arcs, rates against differences, readings against their variance."""

import math
from dataclasses import replace

import numpy as np
import pytest

from phibench.scenes.misalignment import Misalignment, Motion
from phibench.scenes.motion.drive import Drive, DriveLeg, placement, reckoned_poses, robot_pose
from phibench.scenes.motion.vehicle import PlanarPose, Vehicle, rig_placement, stance
from phibench.scenes.rig import Rig
from phibench.scenes.room import FLIPPER_RAD, chassis, escalade360

LEGS = (
    DriveLeg(0.5, 0.4, 0.7),
    DriveLeg(5.0, flipper_rad=-1.2),
    DriveLeg(8.0, -0.2),
    DriveLeg(10.0, 0.0, -math.pi / 2),
)
DRIVE = Drive(Vehicle(), LEGS, 0.06, 1.7)


def test_states_are_the_vehicles_arcs_at_the_tracks_distances() -> None:
    """Oracle: `Vehicle.arc` of the distances that the tracks ran, leg by leg."""
    pose, before, checked = PlanarPose(-0.06), np.zeros(2), 0
    for leg, profile in zip(LEGS, DRIVE.profiles, strict=True):
        for share in (0.3, 1.0):
            time = profile.start_s + share * profile.duration_s
            ways = DRIVE.tracks_m(time)[0] - before
            at = pose.after(Vehicle().arc(*map(float, ways), slip=0.06, skid=1.7))
            found = DRIVE.state(time)
            assert found[:3] == pytest.approx([at.x_m, at.y_m, at.heading_rad], abs=1e-12)
            checked += 1
        pose, before = at, DRIVE.tracks_m(time)[0]
        if leg.flipper_rad is not None:
            assert found[3] == leg.flipper_rad
    assert checked == 8
    assert DRIVE.state(0.2) == pytest.approx([-0.06, 0.0, 0.0, FLIPPER_RAD], abs=0)
    # 0.7 rad to the left and a quarter of a turn to the right
    assert DRIVE.state(99.0)[2] == pytest.approx(0.7 - math.pi / 2, abs=1e-12)


def test_rates_are_differences_of_states() -> None:
    times, step = np.array([0.2, 0.7, 1.9, 5.3, 8.6, 10.7, 30.0]), 1e-5
    slope = (DRIVE.state(times + step) - DRIVE.state(times - step)) / (2 * step)
    np.testing.assert_allclose(DRIVE.rate(times), slope, atol=1e-8)
    assert (np.abs(DRIVE.rate(times)).max(axis=1) > 0.0).tolist() == [False, True, True, True, True, True, False]


def test_placement_of_many_states_is_the_vehicles_of_each() -> None:
    states = DRIVE.state(np.linspace(0.0, 18.0, 40))
    turns, origins = placement(Vehicle(), states)
    for state, R, t in zip(states, turns, origins, strict=True):
        pose = PlanarPose(*map(float, state[:3]))
        wanted = rig_placement(Vehicle(), pose, stance(Vehicle(), pose, float(state[3])))
        np.testing.assert_allclose(R, wanted[0], atol=1e-15)
        np.testing.assert_allclose(t, wanted[1], atol=1e-15)
    assert np.ptp(origins[:, 2]) > 0.01  # the flippers lift it


def test_where_the_flippers_touch_the_floor_the_way_bends() -> None:
    (time,) = DRIVE.bends_s(1)
    before, after = placement(Vehicle(), DRIVE.state(np.array([time - 1e-6, time + 1e-3])))[0]
    assert before[2, 0] == 0.0
    assert after[2, 0] > 0.0
    assert DRIVE.bends_s(0) == ()


def test_readings_have_the_variance_of_the_tracks_ways() -> None:
    """2000 drives: a variance of N(0, s) is known to 3.2 %, so that 13 % is four standard deviations (6e-5)."""
    times = np.array([0.4, 4.9, 9.9, 20.0])
    net, gross = DRIVE.tracks_m(times)
    errors = np.stack([DRIVE.readings_m(times, "t", n) - net for n in range(2000)])
    np.testing.assert_allclose(errors[:, 1:].var(axis=0), 1e-4 * gross[1:], rtol=0.13)
    assert np.all(errors[:, 0] == 0.0)
    # a later reading leaves the earlier ones as they are
    np.testing.assert_array_equal(DRIVE.readings_m(times[:2], "t", 3), DRIVE.readings_m(times, "t", 3)[:2])


def test_a_robot_that_knows_slip_and_skid_finds_its_way_and_another_errs() -> None:
    times = np.linspace(0.0, 18.0, 200)
    exact = Vehicle(slip=0.06, skid=1.7, track_noise=0.0)
    read = Drive(exact, LEGS, 0.06, 1.7).readings_m(times)
    found = np.array([(p.x_m, p.y_m, p.heading_rad) for p in reckoned_poses(exact, read)])
    # arcs between readings: the chords of a leg's parts meet on its circle
    np.testing.assert_allclose(found, DRIVE.state(times)[:, :3], atol=1e-12)
    wrong = reckoned_poses(Vehicle(), read)[-1]
    assert abs(wrong.heading_rad - found[-1, 2]) > 0.05


def test_robot_and_rig_go_together() -> None:
    rig, room_parts = Rig(), escalade360(Rig().at(0.3))
    state = DRIVE.state(99.0)
    view = replace(rig.at(0.3), robot=robot_pose(Vehicle(), state))
    T = view.robot.T_world_rig if view.robot else None
    assert T is not None
    for here, there in zip(room_parts, escalade360(view), strict=True):
        if "flipper" in here.name:
            continue
        np.testing.assert_allclose(there.T_world_shape.t, T.points(here.T_world_shape.t), atol=1e-12)
        np.testing.assert_allclose(there.T_world_shape.R, T.R @ here.T_world_shape.R, atol=1e-12)
    # the flipper's tip is 0.24 m from the axle and, at its angle, on the floor: drawn and computed to 1 cm
    flipper = chassis(view.robot)[3]
    tip = flipper.T_world_shape.points(np.array([0.14, 0.0, 0.0]))
    assert abs(tip[2]) < 0.05
    assert flipper.T_world_shape.points(np.zeros(3))[2] > tip[2]
    np.testing.assert_allclose(view.sphere_centre_m, T.points(rig.at(0.3).sphere_centre_m), atol=1e-12)


def test_a_share_of_a_motion_is_its_turn_and_shift_in_proportion() -> None:
    motion = Rig().perturbed(Misalignment(roll_rad=0.02, yaw_rad=-0.3, shift_y_m=0.01)).motion
    assert motion is not None
    assert motion.part(0.0) is None
    assert motion.part(1.0) is motion
    third = motion.part(1 / 3)
    assert third is not None
    thrice = third.then(third).then(third)
    np.testing.assert_allclose(thrice.rotation, motion.rotation, atol=1e-14)
    np.testing.assert_allclose(thrice.translation_m, motion.translation_m, atol=1e-15)
    np.testing.assert_array_equal(Motion((1.0, 0.0, 0.0)).turns(np.array([0.3]))[0], np.eye(3))
