"""Pulls and intervals of D where sigma is small, of 1 / D where it is not."""

import numpy as np
import pytest

from phibench.estimator.geometry.status import LINEAR, depth_interval, depth_pull


def test_pulls_of_a_gaussian_disparity_are_normal_on_both_sides() -> None:
    """q = 1 / D is drawn with 10 % of its value, and sigma of D stated as D^2 sigma_q, as a propagation does.

    20 000 draws: the share beyond 1.96 on each side is 2.5 % +- 0.11 %; five standard errors, false alarm below 1e-6.
    In D alone the near side has 5.7 %, by the normal law of (1 - D / D0) D0 / (0.1 D) at 1.96: q above 1.244 / D0
    """
    true, share, count = 2.0, 0.1, 20_000
    q = np.random.default_rng(5).normal(1.0 / true, share / true, count)
    D, sigma_q = 1.0 / q, share / true
    sigma = sigma_q * D**2
    assert (sigma > LINEAR * D).all() or (sigma > LINEAR * D).mean() > 0.99
    pulls = depth_pull(D, sigma, true)
    tolerance = 5.0 * np.sqrt(0.025 * 0.975 / count)
    for beyond in ((pulls > 1.96).mean(), (pulls < -1.96).mean()):
        assert beyond == pytest.approx(0.025, abs=tolerance)
    plain = (D - true) / sigma
    assert (plain < -1.96).mean() - (plain > 1.96).mean() > 0.01  # the near side claims too little
    inside = np.mean([low <= true <= high for low, high in map(depth_interval, D[:2000], sigma[:2000])])
    assert inside == pytest.approx(0.95, abs=5.0 * np.sqrt(0.05 * 0.95 / 2000))


def test_of_a_small_sigma_they_are_those_of_the_depth() -> None:
    assert depth_pull(3.0, 0.03, 3.06) == pytest.approx(-2.0)
    assert depth_interval(3.0, 0.03) == pytest.approx((3.0 - 0.0588, 3.0 + 0.0588), abs=1e-4)
    low, high = depth_interval(4.0, 1.0)  # 1 / D = 0.25 +- 0.0625 per metre
    assert (1.0 / low, 1.0 / high) == pytest.approx((0.25 + 1.96 * 0.0625, 0.25 - 1.96 * 0.0625), abs=1e-5)
    assert depth_interval(2.0, 1.1) == (pytest.approx(2.0 / (1.0 + 1.959964 * 0.55)), np.inf)
