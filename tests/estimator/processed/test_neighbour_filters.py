"""Sharpening and denoising of the estimator's model against draws through the simulator's own functions."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse

from phibench.datasets.frames.sensor_card import card_of
from phibench.estimator.processed.neighbour_filters import denoise_margin_px, edge_sparing, neighbours
from phibench.render.sensor.processing import denoised, sharpened
from phibench.render.sensor.settings import sensor

SIDE = 14
S = sensor(
    "srgb8",
    sharpen_amount=0.6,
    denoise_luma=0.9,
    denoise_reach_px=2,
    denoise_vertical=0.7,
    denoise_chroma=0.5,
    denoise_threshold_codes=15.0,
)


def step() -> np.ndarray:
    """Codes of three planes: a step of 40 codes, one of 12, and a ramp; shape (3, side, side)."""
    y, x = np.mgrid[0.0:SIDE, 0.0:SIDE]
    grey = 90.0 + 40.0 * (x > 6) + 12.0 * (y > 8) + 0.7 * x + 0.4 * y
    return np.stack([grey, grey + 5.0, grey - 10.0])


def through(planes: np.ndarray) -> np.ndarray:
    """Codes after the simulator's unsharp mask and denoising, less the margin."""
    m = 1 + denoise_margin_px(card_of(S))
    return 255.0 * denoised(sharpened(planes / 255.0, S.sharpen_amount), S)[..., m:-m, m:-m]


def model(sigma: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean, covariance, and the mean without noise, for white noise of `sigma` codes."""
    card, codes = card_of(S), step().ravel()
    sharp, smooth = neighbours((SIDE, SIDE), card)
    sparing = edge_sparing(sharp, (SIDE, SIDE), card)
    assert sparing is not None
    noise = sparse.csr_array(sigma * sparse.eye_array(len(codes)))
    linear, same = (smooth @ sharp).toarray(), np.tile(np.eye(len(sparing.centre)), (1, 3))
    change, slopes = sparing.means(codes, noise)
    still, _ = sparing.means(codes, 1e-6 * noise)
    T = linear.T + sparing.of_codes(slopes, card.denoise_luma * same)
    np.testing.assert_allclose(
        T.T @ codes - linear @ codes, card.denoise_luma * np.tile(sparing.changes(slopes, codes), 3), atol=1e-8
    )
    return (
        linear @ codes + card.denoise_luma * np.tile(change, 3),
        sigma**2 * T.T @ T,
        linear @ codes + (card.denoise_luma * np.tile(still, 3)),
    )


@pytest.mark.parametrize(("sigma", "most"), [(3.0, 0.04), (6.0, 0.05)])
def test_mean_and_covariance_against_draws(sigma: float, most: float) -> None:
    """2500 draws: a variance is known to 2.8 %, the mean over 64 pixels to 0.5 %, as they share some noise.

    sigma 3 and 6 are v / T^2 of 0.08 and 0.33 behind the unsharp mask.
    """
    rng = np.random.default_rng(int(sigma))
    drawn = through(step() + sigma * rng.normal(size=(2500, 3, SIDE, SIDE))).reshape(2500, -1)
    mean, C, still = model(sigma)
    assert drawn.shape[1] == len(mean) == 192
    error = drawn.std(axis=0, ddof=1) / np.sqrt(len(drawn))
    z = (drawn.mean(axis=0) - mean) / error
    assert np.sqrt(np.mean(z**2)) < 1.6  # 1 and a half of it: 64 values of Y', which the planes share
    assert np.sqrt(np.mean(((drawn.mean(axis=0) - still) / error) ** 2)) > 2.0  # noise moves the mean
    variance = drawn.var(axis=0, ddof=1)
    ratio = float(np.mean(np.diag(C) / variance))
    below = np.corrcoef(drawn.T)[np.arange(184), np.arange(184) + 8]  # next row of the 8 x 8 pixels of a plane
    wanted = (C / np.sqrt(np.outer(np.diag(C), np.diag(C))))[np.arange(184), np.arange(184) + 8]
    print(f"sigma {sigma}: variance, model / drawn {ratio:.3f}, correlation below {np.mean(below - wanted):+.3f}")
    assert abs(ratio - 1.0) < most
    assert abs(float(np.mean(below - wanted))) < most
    sharp, smooth = neighbours((SIDE, SIDE), card_of(S))
    undenoised = sigma**2 * np.square((smooth @ sharp).toarray()).sum(axis=1)
    assert float(np.mean(undenoised / variance)) > 1.0 + most
