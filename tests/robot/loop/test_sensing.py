"""Exact measurement model: places by the general projection, noise by the bound, causes of what is not seen."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from helpers.target_approach import RIG, VEHICLE, sensing

from phibench.datasets.frames.sensor_card import sensor_card
from phibench.estimator.geometry.reflection import image_of
from phibench.estimator.limits.best_stroke import spot_bound
from phibench.estimator.spots.spot_prediction import Laser, spot_electrons_per_s
from phibench.robot.loop.arena import Arena, Boxes
from phibench.robot.loop.sensing import (
    BRIGHT,
    EXPOSURES_S,
    FAINT,
    HIDDEN,
    OUTSIDE,
    SEEN,
    SpotOnSurface,
    SpotReading,
)
from phibench.scenes.frames import Pose, as_matrix, as_vector
from phibench.scenes.motion.vehicle import Obstacle, PlanarPose, Stance, rig_placement, stance
from phibench.scenes.random_streams import generator
from phibench.scenes.rig import View

LEVEL = rig_placement(VEHICLE, PlanarPose(), Stance())
FACING = np.array([-1.0, 0.0, 0.0])


def read(point, exposure=4, arena=None, rng=None, placement=LEVEL, stroke=0.0, power=1.0, normal=FACING) -> SpotReading:
    (found,) = sensing().read([SpotOnSurface(np.array(point), normal, power)], placement, stroke, exposure, arena, rng)
    return found


def test_the_place_is_that_of_a_rig_carried_by_the_robot() -> None:
    """Oracle: the rig itself, moved in the world with flippers, ramp and stroke, and the general projection."""
    pose, point = PlanarPose(0.4, -0.2, 0.9), np.array([1.5, 1.4, 0.7])
    held = stance(VEHICLE, pose, -0.9, [Obstacle(0.3, 0.0, 0.2, 0.4, 0.05)])
    R, t = rig_placement(VEHICLE, pose, held)
    carrier = Pose("world", "world", as_vector(t), as_matrix(R))
    moved = dataclasses.replace(
        RIG, T_world_camera=carrier @ RIG.T_world_camera, stroke_axis_world=as_vector(R @ np.array([0.0, 0.0, 1.0]))
    )
    view = View(moved, 0.3)
    expected = image_of(view, point)
    normal = -(point - t) / np.linalg.norm(point - t)
    found = read(point, placement=(R, t), stroke=0.3, normal=normal)
    assert found.cause == SEEN
    assert np.allclose(found[:2], expected.uv_px, rtol=0, atol=1e-8)
    lowered = image_of(RIG.at(0.0), (point - t) @ R - [0, 0, 0.3])
    light = spot_electrons_per_s(RIG, Laser(), lowered, normal @ R) * EXPOSURES_S[4]
    assert math.isclose(found.electrons, float(light), rel_tol=1e-4)


def test_the_noise_is_the_bound_at_the_spots_light() -> None:
    point, rng = [2.5, 0.0, 0.5], generator("test", "sensing")
    exact = read(point)
    bound = float(
        spot_bound(RIG, dataclasses.replace(sensor_card("bayer-raw"), exposure_s=EXPOSURES_S[4])).at(exact.electrons)
    )
    assert math.isclose(exact.sigma_px, bound, rel_tol=1e-9)
    drawn = np.array([read(point, rng=rng)[:2] for _ in range(1000)]) - exact[:2]
    # a standard deviation of 2000 numbers is known to 1 / sqrt(4000): five of them
    assert abs(drawn.std() / bound - 1) < 5 / math.sqrt(4000)
    assert abs(drawn.std() / (1.2 * bound) - 1) > 5 / math.sqrt(4000)


def test_every_cause_of_an_unseen_spot() -> None:
    wall = Arena("wall", *[Boxes(np.array([[1.2, 0.0, 0.7]]), np.eye(3)[None], np.array([[0.05, 2.0, 2.0]]))] * 2)
    assert read([2.5, 0.0, 0.5]).cause == SEEN
    assert read([2.5, 0.0, 0.5], arena=wall).cause == HIDDEN
    assert read([2.5, 0.0, 0.5], normal=-FACING).cause == HIDDEN
    assert read([0.1, 0.0, 5.0]).cause == OUTSIDE
    assert read([2.5, 0.0, 0.5], power=1e-4).cause == FAINT
    assert read([2.5, 0.0, 0.5], power=1e4).cause == BRIGHT
    low_and_near = read(
        [0.5, 0.0, 0.05], arena=Arena("nothing", *[Boxes(np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 3)))] * 2)
    )
    assert low_and_near.cause == HIDDEN  # behind the robot's own front


def test_shorter_exposures_see_less() -> None:
    sigmas = [read([2.5, 0.0, 0.5], exposure=k).sigma_px for k in range(1, len(EXPOSURES_S))]
    assert sigmas == sorted(sigmas, reverse=True)
    assert sigmas[0] / sigmas[-1] > 3
