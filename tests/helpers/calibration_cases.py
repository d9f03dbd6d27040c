"""Calibrations of known rigs, shared by tests."""

from __future__ import annotations

import numpy as np
from scipy import optimize

from phibench.calibration.outline.outline_result import PoseMeasurement
from phibench.scenes.rig import Rig

RIG, STROKE = Rig(), 0.5


OUTLINE2 = np.diag([5e-6, 5e-6, 2e-5]) ** 2


def apparent(true: Rig, rng: np.random.Generator | None = None) -> PoseMeasurement:
    """Outline's centre as the nominal camera sees it: the cone over the true outline's pixels, fitted in angles."""
    rays = RIG.camera.rays(true.outline_px(360))

    def off(s: np.ndarray) -> np.ndarray:
        distance = np.linalg.norm(s)
        return np.arccos(rays @ s / distance) - np.arcsin(RIG.mirror.radius_m / distance)

    value = optimize.least_squares(off, RIG.sphere_in_camera_m, x_scale=1e-3, xtol=1e-15, ftol=1e-15, gtol=1e-15).x
    return PoseMeasurement(value if rng is None else rng.multivariate_normal(value, OUTLINE2), OUTLINE2)
