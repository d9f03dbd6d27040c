"""Depth from the drive of a robot: errors against drawn slip and skid, exact readings against the exact point."""

from dataclasses import replace

import numpy as np
import pytest
import scipy
from helpers.stroke_film import NOISE_PX, POINT, SCENE

from phibench.datasets.common.errors import DatasetError
from phibench.estimator.geometry.rig_parameters import PARAMETERS
from phibench.render.film.moving_rows import chief_uv_px
from phibench.robot.film.driving_depth import RobotWay, driving_depth
from phibench.robot.film.film_positions import FilmPositions
from phibench.scenes.frames import Array
from phibench.scenes.motion.carriage import Carriage
from phibench.scenes.motion.drive import Drive, DriveLeg, placement
from phibench.scenes.motion.vehicle import Vehicle
from phibench.scenes.random_streams import generator

DRIVES, AT_S = 8, np.arange(24) * 0.12
NOMINAL = Vehicle()


def driven(number: int) -> tuple[Drive, Array, Array]:
    """Drive with drawn slip and skid, exact places by the simulator, and D from where the robot stands."""
    drive = Drive.drawn(NOMINAL, (DriveLeg(0.1, 0.4, 0.35),), "driven", number)
    scene = replace(SCENE, carriage=Carriage((0.0,), (0.1,)), drive=drive)
    turns, origins = placement(NOMINAL, drive.state(AT_S))
    apart = POINT - (turns @ np.array(SCENE.rig.at(0.0).sphere_centre_m) + origins)
    return drive, chief_uv_px(scene, AT_S), np.hypot(apart[:, 0], apart[:, 1])


@pytest.mark.slow
@pytest.mark.parametrize("understated", [False, True])
def test_motion_stereo_is_consistent(understated: bool) -> None:
    """8 drives: squared pulls of X, of D at the end, and chi2 in bands of 1e-5; slip and skid taken as exact fail."""
    vehicle = replace(NOMINAL, slip_sigma=1e-4, skid_sigma=1e-4, track_noise=1e-4) if understated else NOMINAL
    each, count = NOISE_PX**2 * np.eye(2), len(AT_S)
    pulls, ends, misfits, covariance = [], [], [], np.zeros((len(PARAMETERS),) * 2)
    for number in range(DRIVES):
        drive, uv, depth_m = driven(number)
        noisy = uv + NOISE_PX * generator("drives", number).standard_normal(uv.shape)
        noisy[5] = np.nan
        positions = FilmPositions(noisy, np.broadcast_to(each, (count, 2, 2)), np.zeros((count, 2, count, 2)))
        way = RobotWay(vehicle, drive.readings_m(AT_S, "drives", number), drive.state(AT_S)[:, 3])
        found = driving_depth(SCENE.rig, way, positions)
        error = found.point_world_m - POINT
        pulls.append(error @ np.linalg.solve(found.covariance_m2, error))
        ends.append(((found.depth_m[-1] - depth_m[-1]) / found.sigma_m[-1]) ** 2)
        misfits.append(found.chi2)
    high, end, most = (scipy.stats.chi2.ppf(1 - 1e-5, k * DRIVES) for k in (3, 1, 2 * (count - 1) - 3))
    assert (np.sum(pulls) < high) == (not understated)
    assert (np.sum(misfits) < most) == (not understated)
    if understated:
        return
    assert np.sum(ends) < end
    assert np.sum(ends) > scipy.stats.chi2.ppf(1e-5, DRIVES)
    # a focal length that is 1 % unknown widens the claim, and moves no place of a fit without error
    covariance[PARAMETERS.index("focal_relative")][PARAMETERS.index("focal_relative")] = 0.01**2
    wide = driving_depth(SCENE.rig, way, positions, covariance)
    assert (wide.sigma_m > found.sigma_m).all()


def test_motion_stereo_from_exact_readings_is_exact() -> None:
    drive, uv, depth_m = driven(3)
    exact_one = replace(NOMINAL, slip=drive.slip, skid=drive.skid, slip_sigma=1e-6, skid_sigma=1e-6, track_noise=1e-6)
    each = np.broadcast_to(NOISE_PX**2 * np.eye(2), (len(AT_S), 2, 2))
    positions = FilmPositions(uv, each, np.zeros((len(AT_S), 2, len(AT_S), 2)))
    found = driving_depth(SCENE.rig, RobotWay(exact_one, drive.tracks_m(AT_S)[0], drive.state(AT_S)[:, 3]), positions)
    # an arc is reckoned exactly, and priors of 1e-6 hold the rest
    np.testing.assert_allclose(found.point_world_m, POINT, atol=1e-6)
    np.testing.assert_allclose(found.depth_m, depth_m, atol=1e-6)
    still = replace(positions, uv_px=uv[:1].repeat(len(AT_S), 0))
    with pytest.raises(DatasetError, match="drive farther, or make a stroke"):
        driving_depth(SCENE.rig, RobotWay(NOMINAL, np.zeros((len(AT_S), 2)), drive.state(AT_S)[:, 3]), still)
