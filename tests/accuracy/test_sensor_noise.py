"""Noise of the sensor against its laws: Poisson counts, clipping, rounding.

Every random test has a fixed seed, states the chance that it would fail for another one, and is shown to fail where the
model is off by 3 %.
"""

from __future__ import annotations

import numpy as np
import pytest
import scipy

from phibench.render.sensor.camera_chain import Chain
from phibench.render.sensor.electrons import NoiseStream, digitised_signal, poisson
from phibench.render.sensor.light import Light, Region
from phibench.render.sensor.settings import Sensor, sensor

FALSE_ALARM = 2e-6  # per assertion; 13 of them in this file: 3e-5 per run
STREAM = NoiseStream(("accuracy", 0))
QUIET = {"prnu": 0.0, "dsnu_e": 0.0, "dark_e_per_s": 0.0, "read_noise_e": 0.0}


def p_value(counts: np.ndarray, mean: float) -> float:
    """Chi-square of counts against the Poisson law, in cells of at least 50 expected counts."""
    n = counts.size
    edges = [-1]
    probability = scipy.stats.poisson(mean).cdf
    for value in range(int(scipy.stats.poisson(mean).ppf(1.0 - 1e-9)) + 1):
        if n * (probability(value) - probability(edges[-1])) >= 50.0:
            edges.append(value)
    edges = edges[:-1]  # the last cell is open
    expected = n * np.diff([0.0, *probability(np.array(edges[1:])), 1.0])
    observed = np.histogram(counts, [*(np.array(edges) + 0.5), np.inf])[0]
    assert observed.sum() == n
    assert len(expected) > 3
    return float(scipy.stats.chisquare(observed, expected).pvalue)


@pytest.mark.parametrize("mean", [0.5, 5.0, 50.0, 5000.0])
def test_counts_follow_poisson(mean: float) -> None:
    """A mean that is off by 3 % is seen; below 50 a Gaussian of the same mean and variance, too."""
    region = Region.whole((512, 512))
    counts = poisson(STREAM.stage(str(mean)), np.full(region.shape, mean), region)
    assert p_value(counts, mean) > FALSE_ALARM
    assert p_value(counts, 1.03 * mean) < FALSE_ALARM
    if mean <= 50.0:
        gaussian = np.random.default_rng(5).normal(mean, np.sqrt(mean), counts.size)
        assert p_value(np.maximum(np.rint(gaussian), 0.0), mean) < FALSE_ALARM


@pytest.mark.parametrize("mean", [0.5, 5.0, 50.0])
def test_counts_of_frames_that_the_chain_gives(mean: float) -> None:
    """Gain 1 DN/e-, no other noise: DN - black is the count."""
    one = sensor("mono-raw", gain_dn_per_e=1.0, exposure_s=0.1, **QUIET)
    rate = 10.0 * mean / 3.0
    counts = Chain(one).frame(Light.flat((rate, rate, rate), (512, 512)), STREAM) - 64.0
    assert p_value(counts, mean) > FALSE_ALARM
    assert p_value(counts, 1.03 * mean) < FALSE_ALARM


def test_dark_electrons_are_counted_with_the_light() -> None:
    """20 e- of light and 30 e- of dark current are one Poisson number of 50 e-."""
    one = sensor("mono-raw", gain_dn_per_e=1.0, exposure_s=0.1, **{**QUIET, "dark_e_per_s": 300.0})
    counts = Chain(one).frame(Light.flat((200.0, 0.0, 0.0), (512, 512)), STREAM.stage("dark")) - 64.0
    assert p_value(counts, 50.0) > FALSE_ALARM
    assert p_value(counts, 51.5) < FALSE_ALARM


def test_full_well_is_exact() -> None:
    """No pixel above the full well, and the share of pixels at it is the tail of the Poisson law."""
    well = sensor("mono-raw", full_well_e=900.0, gain_dn_per_e=1.0, exposure_s=0.1, **QUIET)
    signal = Chain(well).frame(Light.flat((9000.0, 0.0, 0.0), (512, 512)), STREAM.stage("well")) - 64
    assert signal.max() == 900
    full = int((signal == 900).sum())
    tail = scipy.stats.poisson(900.0).sf(899)
    assert scipy.stats.binomtest(full, signal.size, tail).pvalue > FALSE_ALARM
    # a mean of 3 % more: sf changes from 0.50 to 0.82
    assert scipy.stats.binomtest(full, signal.size, scipy.stats.poisson(927.0).sf(899)).pvalue < FALSE_ALARM


def test_the_converter_clips_at_both_ends() -> None:
    s = sensor("bayer-raw")
    electrons = np.array([-1e9, -64 / s.dn_per_e - 1.0, -802.0, 0.0, 1.0, 12000.0, 12001.0, 1e12])
    # by hand: 64 + 0.0799167 e
    np.testing.assert_array_equal(digitised_signal(electrons, s), [0, 0, 0, 64, 64, 1023, 1023, 1023])
    step = 1.0 / s.dn_per_e
    np.testing.assert_array_equal(digitised_signal(np.array([0.49, 0.51, 1.49, 1.51]) * step, s), [64, 65, 65, 66])


def test_dark_frames_reach_neither_end() -> None:
    """The black level keeps the lower half of the noise: the mean of the darkness is the black level."""
    dark = Chain(sensor("mono-raw", analogue_gain=16.0, dsnu_e=0.0, dark_e_per_s=0.0))
    frame = dark.frame(Light.flat((0.0, 0.0, 0.0), (512, 512)), STREAM.stage("black")).astype(float)
    # read noise 4 e- x 1.279 DN/e- = 5.11 DN; 5 sigma of the mean: false alarm 6e-7
    assert frame.mean() == pytest.approx(64.0, abs=5.0 * 5.12 / 512.0)
    assert frame.min() > 0


def variance_z(s: Sensor, expected_dn2: float, size: int = 512) -> float:
    """(variance of a dark frame - expected) in standard errors, sqrt(2 / n) of a Gaussian."""
    frame = Chain(s).frame(Light.flat((0.0, 0.0, 0.0), (size, size)), STREAM.stage("rounding")).astype(float)
    return (frame.var(ddof=1) / expected_dn2 - 1.0) / np.sqrt(2.0 / frame.size)


def test_rounding_adds_one_twelfth_once() -> None:
    """Read noise 0.8 DN: variance 0.64 + 1/12. Sheppard's first harmonic is (4 x 0.64 + 0.1) exp(-12.6) = 9e-6 DN^2."""
    s = sensor("mono-raw", gain_dn_per_e=0.2, read_noise_e=4.0, prnu=0.0, dsnu_e=0.0, dark_e_per_s=0.0)
    assert abs(variance_z(s, 0.64 + 1 / 12)) < 5.0  # false alarm 6e-7
    for wrong in (0.64, 0.64 + 2 / 12, 1.03 * (0.64 + 1 / 12)):
        assert abs(variance_z(s, wrong)) > 5.0


def test_row_noise_is_common_to_a_row() -> None:
    s = sensor("mono-raw", analogue_gain=16.0, row_noise_e=3.0, prnu=0.0, dsnu_e=0.0, dark_e_per_s=0.0)
    frame = Chain(s).frame(Light.flat((0.0, 0.0, 0.0), (65536, 32)), STREAM.stage("row")).astype(float) / s.dn_per_e
    rows = frame.mean(axis=1)
    expected = 9.0 + (16.0 + 1 / 12 / s.dn_per_e**2) / 32.0
    # variance of 65536 row means: relative standard error 0.55 %, 5 of them; 3 % of the row noise are 6 % of it
    assert rows.var(ddof=1) == pytest.approx(expected, rel=5.0 * np.sqrt(2.0 / 65535))
    assert rows.var(ddof=1) != pytest.approx(expected + 0.0609 * 9.0, rel=5.0 * np.sqrt(2.0 / 65535))
    assert frame.mean(axis=0).var(ddof=1) < 0.1


def test_speckle_flicker_has_the_gamma_law() -> None:
    from phibench.render.sensor.electrons import speckle_gain

    s = sensor("mjpeg", speckle_m=2.5)
    gains = [speckle_gain(s, STREAM.stage("speckle test", k)) for k in range(60000)]
    assert scipy.stats.kstest(gains, scipy.stats.gamma(2.5, scale=0.4).cdf).pvalue > FALSE_ALARM
    assert scipy.stats.kstest(gains, scipy.stats.gamma(2.5, scale=0.4 * 1.03).cdf).pvalue < FALSE_ALARM
    assert speckle_gain(sensor("mjpeg"), STREAM) == 1.0
