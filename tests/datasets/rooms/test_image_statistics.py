"""Statistics of images, on images whose statistics are known."""

from __future__ import annotations

import numpy as np
import pytest

from docs.image_statistics import image_statistics, spectrum_slope


def noise_rows(exponent: float, rows: int = 40, columns: int = 256) -> np.ndarray:
    """Periodic rows with the power 1/f^exponent exactly, and random phases."""
    frequency = np.arange(columns // 2 + 1)
    amplitude = np.where(frequency > 0, np.maximum(frequency, 1) ** (-0.5 * exponent), 0.0)
    phase = np.exp(2j * np.pi * np.random.default_rng(1).random((rows, len(frequency))))
    return np.fft.irfft(amplitude * phase, columns, axis=1)


@pytest.mark.parametrize("exponent", [0.0, 0.7, 1.2, 2.0])
def test_slope_of_a_power_law(exponent):
    """Powers are exact, so that the line fits to rounding."""
    assert spectrum_slope(noise_rows(exponent)) == pytest.approx(exponent, abs=1e-9)


def test_levels_and_contrast_of_two_tones():
    """Half of the columns 1, the others 1/4: white is 1, and ln luminance is +- ln(4) / 2 about its mean."""
    light = np.ones((8, 64, 3)) * np.array([1.0, 1.0, 1.0])
    light[:, 32:] = 0.25
    found = image_statistics(17.0 * light)
    assert (found.red, found.green, found.blue) == pytest.approx((0.625, 0.625, 0.625))
    assert found.contrast == pytest.approx(np.log(4.0) / 2.0)
    assert found.mean_step == pytest.approx(2.0 * np.log(4.0) / 64.0)  # two edges, the seam is one
    assert (found.flat, found.edges) == pytest.approx((62.0 / 64.0, 2.0 / 64.0))
    assert found.steps.mean() == pytest.approx(found.mean_step, rel=0.2)  # 256 quantiles of 62 zeros and two steps


def test_colours_are_told_apart():
    """Green makes 0.7152 of the luminance: a level of 1 in all bands, halved in blue, moves white by 0.0361."""
    light = np.ones((4, 64, 3)) * np.array([1.0, 1.0, 0.5])
    found = image_statistics(light)
    assert (found.red, found.green) == (1.0, 1.0)  # cut at white
    assert found.blue == pytest.approx(0.5 / (1.0 - 0.5 * 0.0722))


def test_lamps_are_cut_off_and_black_has_a_floor():
    light = np.full((4, 128, 3), 0.5)
    light[:, 0] = 1e6  # 0.8 % of the pixels: above the 97 % quantile
    light[:, 1] = 0.0
    found = image_statistics(light)
    assert found.green == pytest.approx(127.0 / 128.0)
    assert found.steps.max() == pytest.approx(np.log(255.0))


def test_unseen_rows_are_left_out():
    light = np.random.default_rng(0).uniform(0.2, 1.0, (6, 64, 3))
    hole = light.copy()
    hole[2, 5, 1] = np.nan
    assert image_statistics(hole).contrast == image_statistics(np.delete(light, 2, axis=0)).contrast


@pytest.mark.parametrize("light", [np.zeros((4, 64, 3)), np.full((4, 64, 3), np.nan), np.ones((4, 32, 3))])
def test_images_without_statistics_are_refused(light):
    with pytest.raises(ValueError, match=r"black|give 64"):
        image_statistics(light)
