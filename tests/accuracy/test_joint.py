"""Joint fit of both images against the depth bound, with draws of the real chain.

`pytest -s -k accuracy_of_the_joint` prints the table. 4000 draws per cell: 40 points at all azimuths by 100 cameras, so
that PRNU and DSNU are drawn anew, as the bound counts them.
"""

from __future__ import annotations

import numpy as np
import pytest
import scipy
from helpers.joint_pairs import BAYER, MONO, RIG, drawn_pairs

from phibench.estimator.geometry.least_squares_depth import joint_bound
from phibench.estimator.geometry.status import Status
from phibench.estimator.geometry.triangulate import depth_exact
from phibench.render.sensor.settings import Sensor

POSITIONS, CAMERAS = 40, 100
LEAST = 4.5  # standard deviations: a chance of 7e-6


CELLS = [
    (MONO, 3.18, 0.425, 5000.0),
    (BAYER, 3.18, 0.425, 5000.0),
    (BAYER, 3.18, 0.425, 2000.0),
    (BAYER, 1.0, 0.425, 5000.0),
    (MONO, 4.18, 1.0, 2000.0),
    (BAYER, 2.18, 1.2, 2000.0),
]
NAMES = [f"{s.name}-{d:g}-{h:g}-{e:g}" for s, d, h, e in CELLS]


@pytest.mark.parametrize("cell", [pytest.param(CELLS[0], marks=pytest.mark.slow), CELLS[1]], ids=NAMES[:2])
def test_accuracy_of_the_joint_fit_in_short(cell: tuple[Sensor, float, float, float]) -> None:
    """480 draws: a standard deviation of 3 %."""
    checked(*cell, 12)


@pytest.mark.slow
@pytest.mark.study
@pytest.mark.parametrize("cell", CELLS, ids=NAMES)
def test_accuracy_of_the_joint_fit(cell: tuple[Sensor, float, float, float]) -> None:
    """4000 draws."""
    checked(*cell, CAMERAS)


def checked(s: Sensor, depth_m: float, stroke_m: float, collected_e: float, cameras: int) -> None:
    """Errors of D over the joint bound: their rms is known to 1 / sqrt(2 n), 1.1 % for 4000 draws; intervals of 95 %.

    The rms may be 5 % above the bound plus `LEAST` standard deviations (0.05), not below it by more than those; the
    joint fit is not worse than the midpoint of separate fits of the same draws; pulls have the standard deviation 1.
    """
    pairs = drawn_pairs(s, depth_m, stroke_m, collected_e, 100.0, POSITIONS, cameras)
    joint, one, two = pairs.joint(), pairs.separate(pairs.down), pairs.separate(pairs.up)
    apart = depth_exact(RIG, stroke_m, one.uv_px, two.uv_px)
    bounds = pairs.down.bound_px2, pairs.up.bound_px2
    bound = np.sqrt(joint_bound(RIG, stroke_m, pairs.down.uv_px, pairs.depth_m, *bounds).variance_depth_m2)
    free = depth_exact(RIG, stroke_m, pairs.down.uv_px, pairs.up.uv_px, *bounds).sigma_m
    good = (joint.status == Status.OK) & (apart.status == Status.OK)
    n = int(good.sum())
    error, separate = ((x.depth_m - pairs.depth_m)[good] / bound[good] for x in (joint, apart))
    ratio, ratio_apart = (float(np.sqrt(np.mean(x * x))) for x in (error, separate))
    pull = float(np.std(((joint.depth_m - pairs.depth_m) / joint.sigma_m)[good]))
    half = scipy.stats.norm.ppf(0.975) / np.sqrt(2.0 * n)
    print(
        f"{s.name}, D {depth_m} m, h {stroke_m} m, {collected_e:.0f} e-: bound {1e3 * np.sqrt(np.mean(bound**2)):.2f} "
        f"mm (without the constraint {np.sqrt(np.mean(free**2) / np.mean(bound**2)):.3f} times); rms / bound: joint "
        f"{ratio:.3f} +- {ratio * half:.3f}, separate {ratio_apart:.3f} +- {ratio_apart * half:.3f}; pull {pull:.3f} "
        f"+- {pull * half:.3f}; chi2 {np.mean(joint.chi2[good]):.3f}; n = {n}"
    )
    assert n >= 0.995 * POSITIONS * cameras
    assert (bound <= free * (1.0 + 1e-9)).all()
    spread = LEAST / np.sqrt(2.0 * n)
    assert 1.0 - spread <= ratio <= 1.05 + spread
    # of the same draws: their ratio scatters far less than each
    assert ratio <= 1.005 * ratio_apart
    assert 0.95 - spread <= pull <= 1.05 + spread
    # chi^2 of one degree of freedom: mean 1, standard deviation sqrt(2 / n); faint spots add some per cent
    assert np.mean(joint.chi2[good]) == pytest.approx(1.0, abs=0.08 + LEAST * np.sqrt(2.0 / n))
    # a bias of 0.8 standard deviations in the same draws is rejected
    assert not float(np.sqrt(np.mean((error + 0.8) ** 2))) <= 1.05 + spread
