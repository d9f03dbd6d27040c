"""The mean of what several images say of the sphere's centre."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from phibench.estimator.calibration.bundle import Measured
from phibench.estimator.calibration.outline import Outline


def mean_outline(outlines: Sequence[Outline]) -> Measured:
    """Weighted mean of sphere centres; their scatter widens the covariance where it is larger than they claim."""
    weights = np.array([np.linalg.inv(outline.covariance_m2) for outline in outlines])
    covariance = np.linalg.inv(weights.sum(axis=0))
    centres = np.array([outline.sphere_in_camera_m for outline in outlines])
    mean = covariance @ np.einsum("kij,kj->i", weights, centres)
    off = centres - mean
    degrees = 3 * (len(outlines) - 1)
    chi2 = float(np.einsum("ki,kij,kj->", off, weights, off))
    return Measured(mean, covariance * max(1.0, chi2 / degrees if degrees else 1.0))
