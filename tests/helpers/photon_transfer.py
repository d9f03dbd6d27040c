"""Photon transfer: a sensor's numbers from its flat fields, as EMVA 1288 (release 4.0) defines them.

Mean and temporal variance of pairs or stacks of frames at several exposures; the ratio of their slopes is the gain K,
the dark frames give the noise, stacks of many frames the fixed pattern.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.scenes.frames import Array

_QUANTISATION_DN2 = 1.0 / 12.0


@dataclass(frozen=True)
class Stack:
    """Frames of one light level and one exposure, reduced to what photon transfer needs.

    Attributes
    ----------
    exposure_s : float
    mean_dn : float
    temporal_dn2 : float
        Mean over the pixels of the variance from frame to frame.
    spatial_dn2 : float
        Variance over the pixels of the mean frame, less what of it is temporal noise.
    """

    exposure_s: float
    mean_dn: float
    temporal_dn2: float
    spatial_dn2: float

    @classmethod
    def of(cls, exposure_s: float, frames: NDArray[Any]) -> Stack:
        """Reduce frames, shape (n, h, w), n >= 2."""
        values = frames.astype(float)
        temporal = float(values.var(axis=0, ddof=1).mean())
        spatial = float(values.mean(axis=0).var(ddof=1)) - temporal / len(values)
        return cls(exposure_s, float(values.mean()), temporal, spatial)


def system_gain_dn_per_e(bright: Sequence[Stack], dark: Sequence[Stack]) -> float:
    """K: slope through the origin of temporal variance against mean, both less those of the dark frames.

    Weighted by 1 / variance^2, the weights of a variance that is estimated from equally many pixels everywhere.
    """
    mean = np.array([b.mean_dn - d.mean_dn for b, d in zip(bright, dark, strict=True)])
    variance = np.array([b.temporal_dn2 - d.temporal_dn2 for b, d in zip(bright, dark, strict=True)])
    weights = np.array([b.temporal_dn2 for b in bright]) ** -2.0
    return float(np.sum(weights * mean * variance) / np.sum(weights * mean * mean))


def dark_current_e_per_s(dark: Sequence[Stack], dn_per_e: float) -> float:
    """Slope of the dark mean against the exposure time."""
    slope, _ = _line(dark, [stack.mean_dn for stack in dark])
    return slope / dn_per_e


def read_noise_e(dark: Sequence[Stack], dn_per_e: float) -> float:
    """Temporal noise of dark frames at exposure 0, the rounding's 1/12 DN^2 taken off."""
    _, variance_dn2 = _line(dark, [stack.temporal_dn2 for stack in dark])
    return float(np.sqrt(variance_dn2 - _QUANTISATION_DN2)) / dn_per_e


def dsnu_e(dark: Stack, dn_per_e: float) -> float:
    """Spread of the dark frames' fixed pattern; the rounding of a stack is dithered by its noise and drops out."""
    return float(np.sqrt(dark.spatial_dn2)) / dn_per_e


def prnu(bright: Stack, dark: Stack) -> float:
    """Relative spread of the response: EMVA 1288 eq. for PRNU_1288, at half of saturation."""
    return float(np.sqrt(bright.spatial_dn2 - dark.spatial_dn2)) / (bright.mean_dn - dark.mean_dn)


def full_well_e(saturated: Stack, dark: Stack, dn_per_e: float) -> float:
    """Signal that more light does not raise; the converter must not be at its end."""
    return (saturated.mean_dn - dark.mean_dn) / dn_per_e


def _line(stacks: Sequence[Stack], values: Sequence[float]) -> tuple[float, float]:
    """Slope and intercept of a straight line against the exposure time."""
    times: Array = np.array([stack.exposure_s for stack in stacks])
    intercept, slope = np.polynomial.Polynomial.fit(times, values, 1).convert().coef
    return float(slope), float(intercept)
