"""Closed moments against drawn ones, and the draws against other draws."""

from __future__ import annotations

import numpy as np
import pytest
import scipy
from helpers.sensor_light import spot_at
from helpers.sensor_moments import QUANTISATION_DN2, drawn_moments, linear_moments, linear_operator, raw_moments

from phibench.render.sensor import processing
from phibench.render.sensor.camera_chain import Chain
from phibench.render.sensor.electrons import NoiseStream
from phibench.render.sensor.light import Light, Region
from phibench.render.sensor.settings import sensor

STREAM = NoiseStream(("moments", 0))
LIGHT = Light(np.full((3, 40, 48), 6e4) * np.linspace(0.5, 1.5, 48), spot_at(21.3, 18.8, electrons_per_s=3e5))
REGION = Region.around(21.3, 18.8, LIGHT.size, 10)
DRAWS = 3000
FALSE_ALARM = 1e-6  # per assertion
MATRIX = ((1.5, -0.4, -0.1), (-0.25, 1.45, -0.2), (-0.05, -0.45, 1.5))


def p_of_mean(drawn: np.ndarray, mean: np.ndarray, covariance: np.ndarray) -> float:
    """Chi-square of the drawn mean against the closed one, pixels and planes taken together."""
    values, vectors = np.linalg.eigh(covariance)
    good = values > 1e-9 * values.max()
    z = vectors[:, good].T @ (drawn - mean).ravel() / np.sqrt(values[good] / DRAWS)
    return float(scipy.stats.chi2(good.sum()).sf(z @ z))


def p_of_covariance(drawn: np.ndarray, covariance: np.ndarray) -> float:
    """Two-sided chance of the mean ratio of variances along the covariance's own axes, each chi-square of DRAWS - 1."""
    values, vectors = np.linalg.eigh(covariance)
    good = values > 1e-9 * values.max()
    ratio = np.diag(vectors[:, good].T @ drawn @ vectors[:, good]) / values[good]
    z = (ratio.mean() - 1.0) * np.sqrt(good.sum() * (DRAWS - 1) / 2.0)
    return float(2.0 * scipy.stats.norm.sf(abs(z)))


@pytest.mark.parametrize("changes", [{}, {"row_noise_e": 4.0}, {"speckle_m": 3.0}, {"prnu": 0.05, "dsnu_e": 20.0}])
def test_raw_moments(changes: dict) -> None:
    """Gain 4: a dark pixel has 1.3 DN of noise, so that rounding is white."""
    chain = Chain(sensor("bayer-raw", analogue_gain=4.0, **changes), 2)
    closed, drawn = raw_moments(chain, LIGHT, REGION), drawn_moments(chain, LIGHT, REGION, STREAM, DRAWS)
    covariance = closed.covariance_dn2()
    assert drawn.draws == DRAWS
    assert p_of_mean(drawn.mean, closed.mean_dn, covariance) > FALSE_ALARM
    assert p_of_mean(drawn.mean, 64.0 + 1.03 * (closed.mean_dn - 64.0), covariance) < FALSE_ALARM
    assert p_of_covariance(drawn.covariance, covariance) > FALSE_ALARM
    assert p_of_covariance(drawn.covariance, 1.03 * covariance) < FALSE_ALARM


def test_what_is_common_to_a_row_and_to_the_spot_is_off_the_diagonal() -> None:
    """Leaving row noise or flicker out of the closed form is noticed along its own direction."""
    for changes in ({"row_noise_e": 12.0}, {"speckle_m": 3.0}):
        chain = Chain(sensor("bayer-raw", analogue_gain=4.0, **changes), 2)
        closed, drawn = raw_moments(chain, LIGHT, REGION), drawn_moments(chain, LIGHT, REGION, STREAM, DRAWS)
        direction = closed.flicker_dn.ravel() if "speckle_m" in changes else np.repeat([1.0] + [0.0] * 9, 10)
        direction = direction / np.linalg.norm(direction)
        measured = direction @ drawn.covariance @ direction
        # relative standard error of a variance: sqrt(2 / 3000), for the gamma law's kurtosis of 6 / 3 sqrt(4 / 3000):
        # 3.7 %, of which 20 % are five
        assert measured == pytest.approx(direction @ closed.covariance_dn2() @ direction, rel=0.2)
        assert measured > 1.5 * direction @ np.diag(closed.variance_dn2.ravel()) @ direction


def test_linear_moments() -> None:
    """Demosaicing, white balance and matrix: drawn by sending raw frames through the same stages."""
    s = sensor("bayer-raw", analogue_gain=4.0, colour_matrix=MATRIX)
    chain = Chain(s, 2)
    region = Region.around(21.0, 19.0, LIGHT.size, 6)
    closed = linear_moments(chain, LIGHT, region)
    box = chain.raw_region(region, LIGHT.size)
    raw = np.stack([chain.raw(LIGHT, STREAM.stage(k), box) for k in range(DRAWS)])
    planes = processing.linear_rgb(processing.linear_signal(raw, s), s)[(..., *region.slices(box))].reshape(DRAWS, -1)
    covariance = np.cov(planes, rowvar=False)
    assert p_of_mean(planes.mean(axis=0), closed.mean.ravel(), closed.covariance) > FALSE_ALARM
    assert p_of_mean(planes.mean(axis=0), 1.03 * closed.mean.ravel(), closed.covariance) < FALSE_ALARM
    assert p_of_covariance(covariance, closed.covariance) > FALSE_ALARM
    assert p_of_covariance(covariance, 1.03 * closed.covariance) < FALSE_ALARM


@pytest.mark.parametrize("shape", [(8, 12), (9, 7)])
@pytest.mark.parametrize("preset", ["mjpeg", "mono-raw"])
def test_the_operator_is_the_code(shape: tuple[int, int], preset: str) -> None:
    s = sensor(preset, colour_matrix=MATRIX)
    image = np.random.default_rng(4).uniform(0.0, 1.0, shape)
    result = (linear_operator(s, shape) @ image.ravel()).reshape(3, *shape)
    # sums of at most 15 products below 2
    np.testing.assert_allclose(result, processing.linear_rgb(image, s), rtol=0, atol=1e-14)


def test_drawn_moments_of_the_whole_chain_agree_with_themselves() -> None:
    """Two halves with different names: their means differ by no more than their covariance says."""
    chain = Chain(sensor("mjpeg", sharpen_amount=0.5), 2)
    a, b = (drawn_moments(chain, LIGHT, REGION, STREAM.stage(name), 600) for name in ("a", "b"))
    error = np.sqrt((np.diag(a.covariance) + np.diag(b.covariance)) / 600.0).reshape(a.mean.shape)
    z = (a.mean - b.mean) / error
    # 300 values, at most 5.5 standard errors: 300 x 4e-8 = 1e-5
    assert np.abs(z).max() < 5.5
    assert z.std() == pytest.approx(1.0, abs=0.5)
    assert a.mean.shape == (10, 10, 3)


def test_srgb_moments_are_the_linear_ones_times_the_slope() -> None:
    """Where noise is small and nothing is cut, the 8-bit variance is slope^2 x linear variance + 1/12."""
    s = sensor("srgb8", prnu=0.0, dsnu_e=0.0)
    light = Light.flat((2.4e5, 2.4e5, 1.8e5), (24, 24))
    region = Region(4, 4, 20, 20)
    drawn = drawn_moments(Chain(s), light, region, STREAM, 1000)
    linear = linear_moments(Chain(s.replace(output="raw")), light, region)
    step = 1e-6
    slope = (
        (processing.srgb_encoded(linear.mean + step) - processing.srgb_encoded(linear.mean - step)) / (2 * step) * 255.0
    )
    expected = slope.ravel() ** 2 * np.diag(linear.covariance)
    rounding = QUANTISATION_DN2
    measured = np.diag(drawn.covariance).reshape(16, 16, 3).transpose(2, 0, 1).ravel()
    # 256 pixels x 1000 draws per plane, neighbours correlated over 9 pixels: sqrt(2 / 28000) = 0.8 %; the curve's bend
    # changes the slope over the noise of 1.5 % of the signal by 1e-4
    for plane in np.split(np.arange(768), 3):
        assert measured[plane].mean() == pytest.approx((expected[plane] + rounding).mean(), rel=0.04)
        assert measured[plane].mean() != pytest.approx(expected[plane].mean(), rel=0.04)
