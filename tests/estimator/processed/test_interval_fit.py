"""Fit of intervals: moments of a cut Gaussian, a posterior against draws, and errors where steps are coarse."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.chain_scenes import drawn
from numpy.polynomial.legendre import leggauss

from phibench.estimator.processed.interval_fit import QuantiserSteps, Sites, _Belief, _propagated, truncated_moments
from phibench.render.sensor.settings import sensor
from phibench.scenes.frames import Array
from phibench.scenes.random_streams import generator

NODES = leggauss(400)


def _by_quadrature(a: float, b: float) -> tuple[float, float]:
    """Mean and variance of a standard Gaussian in [a, b]; 400 nodes where its density is."""
    top = min(max(0.0, a), b)
    reach = 45.0 / (1.0 + abs(top))
    low, high = max(a, top - reach), min(b, top + reach)
    x, w = NODES
    x = 0.5 * (high - low) * x + 0.5 * (high + low)
    density = w * np.exp(-0.5 * (x - top) * (x + top))
    off = float((density * (x - top)).sum() / density.sum())
    return top + off, float((density * (x - top - off) ** 2).sum() / density.sum())


def test_truncated_moments_against_quadrature() -> None:
    """The stated 5e-5, for widths of 1e-4 to 100 standard deviations, up to 3000 from the mean, on both sides."""
    rng = generator("interval", "moments")
    width = 10.0 ** rng.uniform(-4.0, 2.0, 400)
    a = rng.choice([-1.0, 1.0], 400) * 10.0 ** rng.uniform(-3.0, 3.5, 400)
    mean, variance = truncated_moments(np.full(400, 0.0), np.ones(400), a, a + width)
    wanted = np.array([_by_quadrature(*ends) for ends in zip(a, a + width, strict=True)])
    assert np.abs((mean - wanted[:, 0]) / np.sqrt(wanted[:, 1])).max() < 1e-4
    assert np.abs(variance / wanted[:, 1] - 1.0).max() < 1e-4


def test_truncated_moments_scale_and_shift() -> None:
    mean, variance = truncated_moments(np.array(3.0), np.array(2.0), np.array(1.0), np.array(7.0))
    unit, spread = _by_quadrature(-1.0, 2.0)
    np.testing.assert_allclose([mean, variance], [3.0 + 2.0 * unit, 4.0 * spread], rtol=1e-12)


def _coarse() -> tuple[_Belief, Array, Array]:
    """Two unknowns seen through six outputs with correlated noise, in steps of some ten times it."""
    rng = generator("interval", "posterior")
    slopes = rng.normal(size=(2, 6))
    F = 0.1 * rng.normal(size=(4, 6))
    prior = np.diag([0.5, 1.0])
    outputs = F.T @ F + 0.005 * np.eye(6) + slopes.T @ prior @ slopes
    low = 1.5 * np.floor((np.array([0.3, -0.6]) @ slopes) / 1.5)
    return _Belief(np.zeros(2), prior, np.zeros(6), prior @ slopes, outputs), low, low + 1.5


def test_posterior_against_drawn_outputs() -> None:
    """Joint draws of unknowns and outputs, of which those inside all intervals are kept: no approximation.

    Of 1 000 000 draws 70 000 are left, so that a mean is known to 0.004 deviations, a deviation to 0.3 %. Expectation
    propagation is an approximation; 0.05 deviations and 5 % are allowed. Gaussians of variance step^2 / 12 in place of
    the intervals are off by 14 and 26 %, and fail.
    """
    belief, low, high = _coarse()
    steps = QuantiserSteps(high - low, low, np.ones((1, 6)), 1)
    mean, covariance = belief.posterior(_propagated(belief, Sites(*np.zeros((2, 6))), steps, np.zeros(6), 20))
    joint = np.block([[belief.covariance, belief.cross], [belief.cross.T, belief.outputs]])
    rng, L, kept = generator("interval", "drawn"), np.linalg.cholesky(joint + 1e-12 * np.eye(8)), []
    for _ in range(5):
        x = rng.normal(size=(200_000, 8)) @ L.T
        kept.append(x[((x[:, 2:] >= low) & (x[:, 2:] < high)).all(axis=1), :2])
    found = np.concatenate(kept)
    assert len(found) > 30_000
    sigma = found.std(axis=0)
    assert (np.abs(mean - found.mean(axis=0)) < 0.05 * sigma).all()
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), sigma, rtol=0.05)

    weight = 12.0 / (high - low) ** 2
    _, wrong = belief.posterior(Sites(weight, weight * 0.5 * (low + high)))
    assert (np.abs(np.sqrt(np.diag(wrong)) / sigma - 1.0) > 0.1).all()


@pytest.mark.slow
def test_coarse_steps_give_honest_errors() -> None:
    """Quality 60, 20 000 electrons over 500 of a room: 40 fits, of which the quasi-score erred by 3 times its claim.

    The mean square of 80 pulls is chi^2_80 / 80: above 1.8 in 1e-5 of all runs; the quasi-score gives 8.
    """
    found = drawn(sensor("mjpeg", jpeg_quality=60), 0.7, 20_000.0, 500.0, 10, 4)
    assert found.failed <= 2
    assert np.mean(found.pull**2) < 1.8
    assert found.over_bound < 1.4


@pytest.mark.parametrize(
    ("spread", "shared", "frames"), [(0.02, 0.5, 3), (0.1, 0.7, 6), (0.3, 0.7, 6), (0.5, 0.2, 4), (0.8, 1.0, 6)]
)
def test_site_of_several_frames_against_draws(spread: float, shared: float, frames: int) -> None:
    """Mean of frames before the quantiser, and what they share, of all draws that give the same steps in any order.

    2000 draws and more are left: a mean is known to 0.03 deviations, a deviation to 2 %; three times that is allowed.
    """
    rng = generator("interval", f"several {spread}")
    x = 0.37 + shared * rng.normal(size=(400_000, 1))
    y = x + spread * rng.normal(size=(len(x), frames))
    z = np.sort(np.rint(y), axis=1)
    steps, kept = QuantiserSteps.of(z[7][:, None], np.ones(1)), (z == z[7]).all(axis=1)
    found, places = y.mean(axis=1)[kept], x[kept, 0]
    assert len(found) > 2000
    variance = shared**2 + spread**2 / frames
    site = steps.sites(np.array([0.37]), np.array([variance]), np.array([spread**2]))
    precision = 1.0 / variance + site.precision[0]
    assert (0.37 / variance + site.shift[0]) / precision == pytest.approx(found.mean(), abs=0.1 * found.std())
    assert precision**-0.5 == pytest.approx(found.std(), rel=0.06)
    mean, left = steps.shared(np.array([0.37]), np.array([shared**2]), np.array([spread**2]))
    assert mean[0] == pytest.approx(places.mean(), abs=0.1 * places.std())
    assert left[0] ** 0.5 == pytest.approx(places.std(), rel=0.06)


def test_several_frames_in_coarse_steps_give_honest_errors() -> None:
    """Quality 60, six frames of 20 000 electrons over 500 of a room: 16 fits; the quasi-score's pulls are 4.

    The mean square of 32 pulls is chi^2_32 / 32: above 2.3 in 1e-4 of all runs.
    """
    found = drawn(sensor("mjpeg", jpeg_quality=60), 0.7, 20_000.0, 500.0, 4, 4, 6)
    assert found.failed <= 1
    assert np.mean(found.pull**2) < 2.3
    assert found.over_bound < 1.5
