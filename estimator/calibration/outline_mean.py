"""The mean of what several images say of the sphere's centre, or of the vertical."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from phibench.estimator.calibration.measured import Measured
from phibench.estimator.calibration.outline import Outline


def mean_outline(outlines: Sequence[Outline]) -> Measured:
    """Weighted mean of sphere centres, see `mean_measured`."""
    return mean_measured([Measured(outline.sphere_in_camera_m, outline.covariance_m2) for outline in outlines])


def mean_measured(parts: Sequence[Measured]) -> Measured:
    """Weighted mean of vectors; their scatter widens the covariance where it is larger than they claim."""
    weights = np.array([np.linalg.inv(part.covariance) for part in parts])
    covariance = np.linalg.inv(weights.sum(axis=0))
    values = np.array([part.value for part in parts])
    mean = covariance @ np.einsum("kij,kj->i", weights, values)
    off = values - mean
    degrees = values.shape[1] * (len(parts) - 1)
    chi2 = float(np.einsum("ki,kij,kj->", off, weights, off))
    return Measured(mean, covariance * max(1.0, chi2 / degrees if degrees else 1.0))
