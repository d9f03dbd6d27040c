"""Times of frames and rows, the blink code's integral, and the moving scene."""

import numpy as np
import pytest

from phibench.scenes.laser import LaserSpot
from phibench.scenes.motion.carriage import Carriage, Vibration
from phibench.scenes.motion.film_scene import FilmScene, SpotPath, Waypoint, across_and_up, frame_count
from phibench.scenes.motion.film_times import BlinkCode, FilmTimes
from phibench.scenes.rig import Rig
from phibench.scenes.validation import SceneError

TIMES = FilmTimes(90, 30.0, 1 / 60, 0.03, 720)
SPOT = LaserSpot((2.0, 0.0, 0.5), (-1.0, 0.0, 0.0), 5e-3)
UP = Carriage((0.0, 0.4), (0.4, 0.4))


def test_row_times_go_from_top_to_bottom_about_the_frames() -> None:
    assert TIMES.row_s(3, 359.5) == pytest.approx(0.1, abs=1e-15)
    rows = TIMES.row_s(0, np.arange(720))
    assert rows[-1] - rows[0] == pytest.approx(0.03 * 719 / 720)
    np.testing.assert_allclose(rows + rows[::-1], 0.0, atol=1e-15)


def test_part_of_an_exposure_that_the_laser_is_on_is_the_integral_of_its_level() -> None:
    code, seconds = BlinkCode("1101000", 0.021, 0.003), 1 / 60
    middle = np.linspace(-0.5, 0.7, 301)
    inner = (np.arange(4000) + 0.5) / 4000 - 0.5
    brute = code.level(middle[:, None] + seconds * inner).mean(axis=1)
    # a jump within a cell of the sum errs by half a cell; an exposure holds one or two
    np.testing.assert_allclose(code.mean_level(middle, seconds), brute, atol=1.01 / 4000)
    assert 0.3 < brute.mean() < 0.55  # 3 of 7 bits: the sweep saw both levels


def test_positions_have_their_velocities() -> None:
    shakes = tuple(Vibration.band(axis, 15.0, 25.0, 2e-4, "v", axis) for axis in ("stroke", "x", "y"))
    path = SpotPath((Waypoint(0.1, 0.0, 0.0), Waypoint(1.1, 0.2, -0.1), Waypoint(2.3, -0.1, 0.1)))
    scene = FilmScene(Rig(), SPOT, TIMES, UP, shakes, path)
    t, step = np.linspace(0.05, 2.9, 97), 1e-6
    for place, speed in (
        (scene.offset_m, scene.offset_velocity_m_per_s),
        (scene.sway_m, scene.sway_velocity_m_per_s),
        (scene.spot_m, scene.spot_velocity_m_per_s),
    ):
        slope = (place(t + step) - place(t - step)) / (2 * step)
        # rounding 1e-16 / step = 1e-10 per second; truncation (omega step)^2 / 6 = 4e-9 of 0.03 m/s; no corner is hit
        np.testing.assert_allclose(speed(t), slope, atol=2e-9)
        assert np.abs(slope).max() > 0.01


def test_view_and_spot_of_an_instant_are_where_the_motions_say() -> None:
    shakes = (Vibration.band("x", 15.0, 25.0, 2e-4, "v"),)
    scene = FilmScene(Rig(), SPOT, TIMES, UP, shakes, SpotPath((Waypoint(0.0, 0.0, 0.0), Waypoint(2.0, 0.2, 0.1))))
    view = scene.view_at(1.234)
    wanted = np.array([0.0, 0.0, 0.45]) + scene.sway_m(1.234) + [0.0, 0.0, float(scene.offset_m(1.234))]
    np.testing.assert_allclose(view.camera_centre_m, wanted, atol=1e-15)
    # seen from its front, at x = 0, looking along +x, the right is -y
    np.testing.assert_allclose(across_and_up(SPOT), [[0.0, -1.0, 0.0], [0.0, 0.0, 1.0]], atol=1e-15)
    np.testing.assert_allclose(scene.spot_at(1.0).position_world_m, [2.0, -0.1, 0.55], atol=1e-15)


def test_a_film_must_hold_the_whole_code() -> None:
    FilmScene(Rig(), SPOT, TIMES, UP, code=BlinkCode("110", 1.0))
    with pytest.raises(SceneError, match="must hold the whole code"):
        FilmScene(Rig(), SPOT, TIMES, UP, code=BlinkCode("1101", 1.0))


def test_rows_must_not_outlast_their_frame() -> None:
    with pytest.raises(SceneError, match=r"exposure_s = 0\.05.*0\.0333"):
        FilmTimes(9, 30.0, 0.05, 0.03, 720)
    assert frame_count(Carriage((0.0,), (1.0,)), 30.0) == 31
