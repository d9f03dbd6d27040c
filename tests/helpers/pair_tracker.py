"""Tracker that takes target and robot to rest: what others are compared with."""

from __future__ import annotations

import math

import numpy as np

from phibench.estimator.geometry.triangulate import depth_exact
from phibench.robot.loop.sensing import SpotReading
from phibench.scenes.rig import Rig


class PairTracker:
    """Depth from the last two frames whose strokes differ enough, as of a target and a robot at rest: a baseline.

    Parameters
    ----------
    rig : Rig
    least_stroke_m : float
        Between the two frames.
    """

    def __init__(self, rig: Rig, least_stroke_m: float = 0.2) -> None:
        self.rig, self.least_stroke_m = rig, least_stroke_m
        self.distance_m, self.distance_sigma_m = math.nan, math.nan
        self._frames: list[tuple[float, SpotReading]] = []

    def update(self, reading: SpotReading, stroke_m: float) -> None:
        """Take in a frame."""
        apart = [frame for frame in self._frames if abs(frame[0] - stroke_m) >= self.least_stroke_m]
        self._frames.append((stroke_m, reading))
        if not apart:
            return
        (low_m, low), (high_m, high) = sorted([apart[-1], (stroke_m, reading)], key=lambda frame: frame[0])
        pixels = [np.array([one.u_px, one.v_px]) for one in (low, high)]
        noise = [one.sigma_px**2 * np.eye(2) for one in (low, high)]
        depth = depth_exact(self.rig, high_m - low_m, *pixels, *noise)
        self.distance_m, self.distance_sigma_m = float(depth.depth_m), float(depth.sigma_m)
