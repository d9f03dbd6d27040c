"""Robots that look at a target, stroke and drive: what tests of beliefs share."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from phibench.estimator.geometry.rig_parameters import PARAMETERS, PRIOR_SIGMA, RIG_PARAMETERS
from phibench.estimator.geometry.sphere_image import SphereImager
from phibench.robot.loop.belief import Belief, TargetPrior
from phibench.robot.loop.rig_bias import RigBias
from phibench.robot.loop.sensing import SEEN, Direction, Sensing, SpotOnSurface, SpotReading, direction_of
from phibench.robot.loop.smoothing import belief_of
from phibench.scenes.motion.vehicle import PlanarPose, Stance, Vehicle, rig_placement, stance
from phibench.scenes.random_streams import generator
from phibench.scenes.rig import Rig

RIG, VEHICLE = Rig(), Vehicle()
OF_SPHERE = RIG_PARAMETERS[1:12]  # a perfect sphere has neither axis nor rim; the carriage is exact


def rig_covariance(size: float) -> np.ndarray:
    """Covariance of a rig whose errors are `size` times those of one that was built by hand."""
    return np.diag([(size * PRIOR_SIGMA[name]) ** 2 if name in OF_SPHERE else 0.0 for name in PARAMETERS])


@lru_cache(maxsize=1)
def sensing() -> Sensing:
    return Sensing(RIG)


@dataclass
class Approach:
    """One run: a target between 1.2 and 4.5 m, drawn by its number, and a robot whose slip is drawn as well."""

    number: int
    flipper_rad: float = 0.0
    pose: PlanarPose = field(default_factory=PlanarPose)
    stroke_m: float = 0.0

    def __post_init__(self) -> None:
        self.rng = generator("test", "approach", self.number)
        D, a, z = self.rng.uniform((1.2, -0.4, 0.2), (4.5, 0.4, 1.1))
        self.point = np.array([VEHICLE.sensor_x_m + D * math.cos(a), D * math.sin(a), z])
        self.normal = -np.array([math.cos(a), math.sin(a), 0.0])
        self.slip = VEHICLE.slip + VEHICLE.slip_sigma * self.rng.standard_normal()
        self.skid = VEHICLE.skid + VEHICLE.skid_sigma * self.rng.standard_normal()

    @property
    def held(self) -> Stance:
        return stance(VEHICLE, self.pose, self.flipper_rad)

    def place(self) -> np.ndarray:
        """True place in the rig's frame made level."""
        R, t = rig_placement(VEHICLE, self.pose, Stance())
        return (self.point - t) @ R

    def read(self) -> SpotReading | None:
        placement = rig_placement(VEHICLE, self.pose, self.held)
        for exposure in (4, 3, 2, 1, 0):
            light = SpotOnSurface(self.point, self.normal, 1.0)
            (read,) = sensing().read([light], placement, self.stroke_m, exposure, None, self.rng)
            if read.cause == SEEN:
                return read
        return None

    def look(self) -> Direction | None:
        read = self.read()
        return None if read is None else direction_of(RIG, read.u_px, read.v_px, read.sigma_px)

    def drive(self, left: float, right: float) -> None:
        noise = self.rng.standard_normal(2)
        true = [w + math.sqrt(VEHICLE.track_variance_m2(w)) * z for w, z in zip((left, right), noise, strict=True)]
        self.pose = self.pose.after(VEHICLE.arc(*true, self.slip, self.skid))


@dataclass
class MisalignedApproach(Approach):
    """Run of a rig that differs from the nominal one, with a noise of 0.05 px."""

    rig: Rig = RIG

    def read(self) -> SpotReading | None:
        R, t = rig_placement(VEHICLE, self.pose, self.held)
        lowered = (self.point - t) @ R - self.stroke_m * np.array(self.rig.stroke_axis_world)
        image = SphereImager(self.rig).image(*lowered.tolist())
        if image is None:
            return None
        du, dv = 0.05 * self.rng.standard_normal(2)
        return SpotReading(image.u_px + du, image.v_px + dv, 0.05, 1e4, SEEN)


def stroked(run: Approach, to_m: float, frames: int, moving: float = 0.0, bias: RigBias | None = None) -> Belief:
    """Belief after a stroke with frames on its way."""
    first = run.look()
    assert first is not None
    belief = belief_of(RIG, VEHICLE, first, 0.0, bias or RigBias(RIG, None), TargetPrior(acceleration_m2_per_s3=moving))
    for k in range(frames):
        run.stroke_m = to_m * (k + 1) / frames
        step(run, belief, 0.0, 0.0)
    return belief


def step(run: Approach, belief: Belief, left: float, right: float, seen: Callable[[], bool] = lambda: True) -> None:
    belief.predict(left, right, 0.1)
    if left or right:
        run.drive(left, right)
    direction = run.look() if seen() else None
    if direction is not None:
        belief.update(direction, run.stroke_m, run.held if run.flipper_rad else None)
