"""Rows of a moving spot against brute force, truth against stills, velocities against differences of stills."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from phibench.render.film.film_truth import RATES, instant_truth
from phibench.render.film.moving_rows import chief_uv_px, exposure_nodes, parted_image, rows_image, spot_time_s
from phibench.render.optics.room_tracer import room_geometry
from phibench.render.optics.spot_layer import spot_layer
from phibench.render.optics.truth import spot_truth
from phibench.scenes.frames import Array, Pose, as_matrix, as_vector
from phibench.scenes.holder import fitted_holder
from phibench.scenes.laser import LaserSpot
from phibench.scenes.misalignment import Misalignment
from phibench.scenes.motion.carriage import Carriage, Vibration
from phibench.scenes.motion.drive import Drive, DriveLeg
from phibench.scenes.motion.film_scene import FilmScene, SpotPath, Waypoint
from phibench.scenes.motion.film_times import BlinkCode, FilmTimes
from phibench.scenes.motion.vehicle import PlanarPose, Vehicle, rig_placement, stance
from phibench.scenes.rig import Rig, View
from phibench.scenes.room import Room, TargetBoard, lab

TARGET = TargetBoard("t", 1.5, 0.6, 0.5)
ROOM = lab((TARGET,))
SPOT = LaserSpot(TARGET.position_world_m, TARGET.normal_world, 4.5e-3)
TIMES = FilmTimes(20, 30.0, 1 / 60, 0.03, 720)
SHAKE = tuple(Vibration.band(axis, 20.0, 60.0, 1e-4, "t", axis) for axis in ("stroke", "x", "y"))
MOVING = FilmScene(Rig(), SPOT, TIMES, Carriage((0.0, 0.5), (0.0, 0.0), 0.5, 2.0), SHAKE)
LEGS = (DriveLeg(0.0, 0.08, -0.15, None, 0.5, 3.0), DriveLeg(0.46, flipper_rad=-1.2))
DRIVING = replace(MOVING, carriage=Carriage((0.1,), (1.0,)), drive=Drive(Vehicle(), LEGS, 0.05, 1.4))
ERRANT = Rig().perturbed(Misalignment(roll_rad=0.02, pitch_rad=-0.01, yaw_rad=0.03, shift_x_m=5e-3))
CASES = {
    "carriage": MOVING,
    "driving": DRIVING,
    "misaligned": replace(MOVING, rig=ERRANT, stroke_m=0.5),
    "still": replace(MOVING, carriage=Carriage((0.1,), (1.0,)), vibrations=()),
    "blinking": replace(MOVING, code=BlinkCode("10110", 0.011, 0.002)),
    "target": replace(
        MOVING,
        carriage=Carriage((0.1,), (1.0,)),
        path=SpotPath((Waypoint(0.0, -0.1, 0.0), Waypoint(0.5, 0.1, 0.1))),
    ),
}


def brute_force(
    scene: FilmScene, frame: int, rows: Array, columns: Array, room: Room | None = None, count: int = 10
) -> Array:
    """Mean over each row's exposure of stills rendered at `count` times of it."""
    image, (nodes, weights) = np.zeros((3, len(rows), len(columns))), np.polynomial.legendre.leggauss(count)
    for number, row in enumerate(rows):
        middle = float(scene.times.row_s(frame, float(row)))
        for time, weight in zip(middle + 0.5 * scene.times.exposure_s * nodes, 0.5 * weights, strict=True):
            view = scene.view_at(time)
            layer = spot_layer(view, scene.spot_at(time), () if room is None else room_geometry(room, view))
            v = int(row) - layer.v0_px
            if 0 <= v < layer.electrons_per_s.shape[1]:
                u = columns - layer.u0_px
                inside = (u >= 0) & (u < layer.electrons_per_s.shape[2])
                image[:, number, inside] += layer.electrons_per_s[:, v, u[inside]] * weight
    return image


@pytest.mark.slow
@pytest.mark.parametrize("name", ["carriage", "target", "driving"])
def test_moving_rows_are_those_of_brute_force(name: str) -> None:
    scene, frame = CASES[name], 8
    time = spot_time_s(scene, frame)
    layer = spot_layer(scene.view_at(time), scene.spot_at(time), ())
    image = rows_image(scene, frame, layer, time)
    height, width = image.electrons_per_s.shape[1:]
    rows = image.v0_px + np.array([height // 2 - 2, height // 2, height // 2 + 1])
    columns = image.u0_px + np.arange(width)
    wanted = brute_force(scene, frame, rows, columns)
    found = image.electrons_per_s[:, rows - image.v0_px]
    peak = layer.electrons_per_s.max()
    error = np.abs(found - wanted).max() / peak
    print(f"{name}: moving rows against brute force, {error:.1e} of the peak")
    # required; ten nodes integrate a blur of 0.8 px that moves by 6 px in the exposure to 1e-6
    assert error < 1e-3
    # and the motion is seen: the still is far away
    still = np.zeros_like(wanted)
    v, u = rows - layer.v0_px, columns - layer.u0_px
    ok_v, ok_u = (v >= 0) & (v < layer.electrons_per_s.shape[1]), (u >= 0) & (u < layer.electrons_per_s.shape[2])
    still[:, ok_v[:, None] & ok_u] = layer.electrons_per_s[:, v[ok_v][:, None], u[ok_u]].reshape(3, -1)
    assert np.abs(still - wanted).max() > 1e-2 * peak


@pytest.mark.slow
def test_a_waypoint_within_an_exposure_parts_it() -> None:
    """The spot turns back: its speed jumps in the midst of the exposure, at another part of each row's."""
    path = SpotPath((Waypoint(0.0, -0.1, 0.0), Waypoint(0.268, 0.1, 0.1), Waypoint(0.5, -0.1, 0.2)))
    scene, frame = replace(CASES["target"], path=path, times=replace(TIMES, exposure_s=1 / 30)), 8
    time = spot_time_s(scene, frame)
    layer = spot_layer(scene.view_at(time), scene.spot_at(time), ())
    image = rows_image(scene, frame, layer, time)
    rows = image.v0_px + np.array([image.electrons_per_s.shape[1] // 2])
    columns = image.u0_px + np.arange(image.electrons_per_s.shape[2])
    wanted = brute_force(scene, frame, rows, columns, count=100)
    error = np.abs(image.electrons_per_s[:, rows - image.v0_px] - wanted).max() / layer.electrons_per_s.max()
    print(f"waypoint: moving rows against brute force, {error:.1e} of the peak")
    # 100 stills err by a piece of the exposure with the wrong speed: below 1e-4. One rule over the turn errs by 6e-3.
    assert error < 3e-4


RODS = replace(
    DRIVING,
    rig=replace(Rig(), holder=fitted_holder("rods", 0.06)),
    vibrations=(),
    drive=Drive(Vehicle(), (DriveLeg(0.0, 0.1, 0.6, None, 0.5, 3.0),), 0.05, 1.4),
)
EMPTY = Room("empty", ())


def test_what_the_robot_carries_hides_the_spot_as_for_a_robot_that_stands() -> None:
    """Rig, holder and robot are one body: a spot that goes about it the other way round is hidden as well."""
    causes = set()
    for frame in (0, 2, 4, 9):
        time = spot_time_s(RODS, frame)
        view, spot = RODS.view_at(time), RODS.spot_at(time)
        assert view.robot is not None
        back = view.robot.T_world_rig.inverse()
        here = replace(
            spot,
            position_world_m=as_vector(back.points(np.array(spot.position_world_m))),
            normal_world=as_vector(back.directions(np.array(spot.normal_world))),
        )
        still = RODS.rig.at(view.offset_m)
        found, wanted = (spot_truth(v, s, room_geometry(EMPTY, v)) for v, s in ((view, spot), (still, here)))
        assert (found.u_px, found.v_px) == pytest.approx((wanted.u_px, wanted.v_px), abs=1e-9)
        assert found.cause == wanted.cause
        lights = [
            spot_layer(v, s, room_geometry(EMPTY, v)).total_electrons_per_s[0] for v, s in ((view, spot), (still, here))
        ]
        assert lights[0] == pytest.approx(lights[1], rel=1e-9, abs=1e-6 * 2e6)
        causes.add(found.cause)
    assert causes == {"none", "occluded:holder_rod_1"}


@pytest.mark.slow
def test_accuracy_of_a_spot_that_comes_out_from_behind_a_rod() -> None:
    """Flux and shape change within the exposure: parts of it agree with stills, one layer does not."""
    frame = 6
    image = parted_image(RODS, EMPTY, frame)
    row = image.v0_px + int(np.argmax(image.electrons_per_s[0].sum(axis=1)))
    columns = image.u0_px + np.arange(image.electrons_per_s.shape[2])
    wanted = brute_force(RODS, frame, np.array([row]), columns, EMPTY, 40)
    time = spot_time_s(RODS, 9)
    peak = spot_layer(RODS.view_at(time), RODS.spot_at(time), ()).electrons_per_s.max()
    error = np.abs(image.electrons_per_s[:, [row - image.v0_px]] - wanted).max() / peak
    print(f"behind a rod: moving rows against brute force, {error:.1e} of the peak")
    # required; with 10 stills in place of 40 it is brute force that errs, by 5e-4
    assert error < 1e-3
    assert wanted.max() > 0.1 * peak
    time = spot_time_s(RODS, frame)
    view = RODS.view_at(time)
    dark = spot_layer(view, RODS.spot_at(time), room_geometry(EMPTY, view))
    assert dark.total_electrons_per_s[0] < 1e-3 * peak  # one layer alone would leave the frame dark


def test_laser_code_lights_each_row_for_its_part_of_the_exposure() -> None:
    scene, seen = CASES["blinking"], set()
    for frame in range(6):
        time = spot_time_s(scene, frame)
        layer = spot_layer(scene.view_at(time), scene.spot_at(time), ())
        image = rows_image(scene, frame, layer, time)
        rows = image.v0_px + np.arange(image.electrons_per_s.shape[1])
        middle = scene.times.row_s(frame, rows)
        _, weights = exposure_nodes(scene, middle, 4)
        np.testing.assert_allclose(weights.sum(axis=1), scene.code.mean_level(middle, 1 / 60), atol=1e-12)
        row = round(float(chief_uv_px(scene, np.array([time]))[0, 1]))
        level = float(scene.code.mean_level(np.array(scene.times.row_s(frame, row)), 1 / 60))
        # levels change by readout / 720 / exposure = 0.25 % a row, over the spot's 3 or 4 rows
        total = float(image.electrons_per_s[0].sum() / layer.total_electrons_per_s[0])
        assert total == pytest.approx(level, abs=0.02)
        seen.add(round(level, 1))
    assert len(seen) > 2


def test_a_still_carriage_gives_the_still() -> None:
    scene = CASES["still"]
    time = spot_time_s(scene, 3)
    layer = spot_layer(scene.view_at(time), scene.spot_at(time), ())
    image = rows_image(scene, 3, layer, time)
    # the weights of an exposure add up to 1 but for rounding
    np.testing.assert_allclose(image.electrons_per_s, layer.electrons_per_s, rtol=1e-14)


def test_derivatives_of_the_moving_image_are_those_of_a_shift() -> None:
    scene = CASES["carriage"]
    time = spot_time_s(scene, 8)
    layer = spot_layer(scene.view_at(time), scene.spot_at(time), ())
    image = rows_image(scene, 8, layer, time)
    k = np.arange(image.electrons_per_s.shape[1])
    for axis, stack in ((1, image.dv_electrons_per_s_px), (2, image.du_electrons_per_s_px)):
        grid = np.arange(image.electrons_per_s.shape[axis])
        shape = [1, 1, 1]
        shape[axis] = -1
        moment = (image.electrons_per_s * grid.reshape(shape)).sum() / image.electrons_per_s.sum()
        slope = (stack * grid.reshape(shape)).sum() / image.electrons_per_s.sum()
        # a shift by 1 px moves the first moment by 1 px; what ringing leaves outside the window is below 1e-3
        assert slope == pytest.approx(1.0, abs=5e-3)
        assert 0 < moment < len(k) + len(grid)


def by_hand(scene: FilmScene, time: float) -> View:
    """View put together by hand: the down pose, the stroke axis up, the way of the robot, the turn between images."""
    rig, offset = scene.rig, float(scene.offset_m(time))
    lens = rig.T_world_camera.t + [0.0, 0.0, offset]
    turn, where = np.eye(3), np.zeros(3)
    if scene.drive is not None:
        x, y, heading, flipper = scene.drive.state(time)
        held = stance(Vehicle(), PlanarPose(x, y, heading), float(flipper))
        turn, where = rig_placement(Vehicle(), PlanarPose(x, y, heading), held)
    lens = turn @ lens + where
    if rig.motion is not None:
        share = offset / scene.stroke_m
        whole = Rotation.from_matrix(rig.motion.rotation)
        turn = Rotation.from_rotvec(share * whole.as_rotvec()).as_matrix() @ turn
        lens = lens + share * np.array(rig.motion.translation_m)
    lens = lens + scene.sway_m(time)
    pose = Pose("world", "camera", as_vector(lens), as_matrix(turn @ rig.T_world_camera.R))
    return replace(rig, T_world_camera=pose, motion=None).at(0.0)


@pytest.mark.parametrize("name", list(CASES))
def test_truth_of_a_frame_is_that_of_the_still_in_its_pose(name: str) -> None:
    scene, checked = CASES[name], 0
    for frame in range(0, 20, 3):
        time = spot_time_s(scene, frame)
        found = instant_truth(scene, ROOM, time)
        still = spot_truth(by_hand(scene, time), scene.spot_at(time), ())
        for key in RATES:
            assert getattr(found.spot, key) == pytest.approx(getattr(still, key), abs=1e-9)
        assert found.spot.visible
        uv = chief_uv_px(scene, np.array([scene.times.frame_s[frame], time]))
        np.testing.assert_allclose(uv[1], [still.u_px, still.v_px], atol=1e-9)
        # the spot's own row is read at that time
        assert float(scene.times.row_s(frame, still.v_px)) == pytest.approx(time, abs=1e-9)
        checked += 1
    assert checked == 7


@pytest.mark.parametrize("name", ["carriage", "target", "driving", "misaligned"])
def test_velocities_are_differences_of_stills(name: str) -> None:
    scene, step = CASES[name], 1e-4
    for time in (0.123, 0.301, 0.45):
        found = instant_truth(scene, ROOM, time)
        before, after = (instant_truth(scene, ROOM, time + sign * step, visible=False).spot for sign in (-1, 1))
        for key in RATES:
            slope = (getattr(after, key) - getattr(before, key)) / (2 * step)
            # vibration of 60 Hz: (2 pi 60 step)^2 / 6 = 2.4e-4 of its own part of the speed
            assert found.rates[key] == pytest.approx(slope, rel=1e-3, abs=3e-4 * abs(slope) + 1e-5)
        assert abs(found.rates["u_px"]) + abs(found.rates["v_px"]) > 1.0
