"""Fits of rendered spots in mirrors of each shape against their bounds: `pytest -s --study -k fits_in_mirrors`.

n draws give 2 n values of u and v: a standard deviation is known to 1 / sqrt(4 n); streams are fixed, by name.
"""

from __future__ import annotations

import numpy as np
import pytest
import scipy
from helpers.mirror_fits import MIRRORS, drawn, places

from phibench.render.sensor.settings import Sensor, sensor

RAW, SRGB, MJPEG = sensor("bayer-raw"), sensor("srgb8"), sensor("mjpeg", jpeg_quality=85)
LIMITS = {"raw": 1.05, "srgb8": 1.10, "mjpeg": 1.20}
PULLS = {"raw": (0.95, 1.05), "srgb8": (0.9, 1.1), "mjpeg": (0.85, 1.15)}
CELLS = [(RAW, 2000.0, 20), (RAW, 5000.0, 20), (SRGB, 2000.0, 20), (SRGB, 5000.0, 20), (MJPEG, 5000.0, 10)]


def checked(shape: str, s: Sensor, collected_e: float, count: int, cameras: int, sigmas: float) -> None:
    """rms / bound and the pull's standard deviation within the targets, widened by `sigmas` standard errors."""
    draws = drawn(s, places(shape, count), collected_e, 100.0, cameras)
    n = draws.error_px.size
    error, ratio, pull = 1.0 / np.sqrt(2.0 * n), draws.over_bound, float(draws.pull.std())
    half = scipy.stats.norm.ppf(0.975) * error
    print(
        f"{shape}, {s.output}, {collected_e:.0f} e- over 100 e-: rms {1e3 * np.sqrt(np.mean(draws.error_px**2)):.1f} "
        f"mpx, rms / bound {ratio:.3f} +- {ratio * half:.3f}, pull {pull:.3f} +- {pull * half:.3f}, mean pull "
        f"{draws.pull.mean():+.3f}, n = {n // 2}, failed {draws.failed}",
        flush=True,
    )
    low, high = PULLS[s.output]
    assert n // 2 + draws.failed == count * cameras
    assert draws.failed <= 0.01 * count * cameras
    assert ratio * (1.0 - sigmas * error) <= LIMITS[s.output]
    assert ratio >= 1.0 - 5.0 * error  # nothing is better than the bound
    assert low - sigmas * error <= pull <= high + sigmas * error
    # what is 40 % worse is rejected
    assert 1.4 * ratio * (1.0 - sigmas * error) > LIMITS[s.output]


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["hyperboloid", "cone"])
def test_accuracy_of_fits_in_mirrors_in_short(shape: str) -> None:
    """60 raw draws of 6 places: a standard error of 6 %; at a true ratio of 1.03 three of them fail in 1e-3.

    One Gaussian at the chief ray's place, as it is of a sphere's image, is at 1.6 times the bound in a cone.
    """
    checked(shape, RAW, 2000.0, 6, 10, 3.0)


@pytest.mark.slow
@pytest.mark.study
@pytest.mark.parametrize("cell", CELLS, ids=[f"{s.output}-{e:g}" for s, e, _ in CELLS])
@pytest.mark.parametrize("shape", MIRRORS)
def test_accuracy_of_fits_in_mirrors(shape: str, cell: tuple[Sensor, float, int]) -> None:
    """400 draws, 200 of MJPEG: standard errors of 2.5 and 3.5 %; with one of them true ratios of 1.03 pass."""
    s, collected_e, cameras = cell
    checked(shape, s, collected_e, 20, cameras, 1.0)
