"""Smoothing and resampling of light maps: shadows stay, noise goes, and the stated error is the true one."""

from __future__ import annotations

import numpy as np

from phibench.render.room.bounced_light import _between, _overlap
from phibench.render.room.light_map import line_fit, smoothed
from phibench.render.room.texel_grid import TexelGrid
from phibench.scenes.faces import face_table
from phibench.scenes.shapes import rectangle

GRID = TexelGrid.of(face_table([rectangle("wall", (0, 0, 0), (0, 0, 1), (6.0, 4.0))]), 0.1)
X, Y = np.meshgrid((np.arange(60) + 0.5) / 60, (np.arange(40) + 0.5) / 40)
SLOW = (1.0 + 0.5 * X + 0.3 * Y + 0.2 * np.sin(3.0 * X))[..., None] * np.array([1.0, 0.8, 0.6])
SHADOW = np.where(X[..., None] < 0.5, 0.4, 1.0) * SLOW
SIGMA = 0.03


def halves(truth: np.ndarray, seed: int) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [(truth + SIGMA * rng.normal(size=truth.shape)).reshape(-1, 3) for _ in range(2)]


def test_smooth_light_loses_two_thirds_of_its_noise_and_states_the_rest() -> None:
    """The mean of both halves has 0.03 / sqrt(2); a line fit over 9 x 9 texels leaves a ninth of it inside.

    2400 x 3 texels: the stated variance is that of the errors within a factor of 1.5, neighbours being correlated.
    """
    mean, sigma = smoothed(GRID, *halves(SLOW, 0), kept=9)
    error = mean - SLOW.reshape(-1, 3)
    assert np.sqrt(np.mean(error**2)) < SIGMA / np.sqrt(2.0) / 3.0
    assert 1 / 1.5 < np.mean(sigma**2) / np.mean(error**2) < 1.5


def test_a_shadow_keeps_its_edge() -> None:
    """A step of 0.6, twenty times the noise: no texel beside it is off by more than 5 of the unsmoothed errors."""
    mean, _ = smoothed(GRID, *halves(SHADOW, 1), kept=5)
    error = (mean - SHADOW.reshape(-1, 3)).reshape(40, 60, 3)
    assert np.abs(error[:, 26:34]).max() < 5.0 * SIGMA / np.sqrt(2.0)


def test_bright_texels_lose_no_light_to_dark_ones() -> None:
    """Noise of 10 % of the light, a spot of light: the mean of the wall and that of its bright part are kept.

    7200 values and 16 draws leave 0.04 % and 0.1 % of noise, which the unsmoothed mean has as well.
    """
    lit = 0.02 + np.exp(-((X - 0.5) ** 2 + (Y - 0.5) ** 2) / 0.02)[..., None] * np.ones(3)
    bright = (lit > 0.5).ravel().reshape(-1, 3)[:, 0]
    rng = np.random.default_rng(5)
    kept = []
    for _ in range(16):
        a, b = ((lit * (1.0 + 0.1 * rng.normal(size=lit.shape))).reshape(-1, 3) for _ in range(2))
        mean, _ = smoothed(GRID, a, b, 5)
        kept.append([mean[part].sum() / (0.5 * (a + b))[part].sum() - 1.0 for part in (slice(None), bright)])
    print(np.mean(kept, axis=0), np.std(kept, axis=0) / 4.0)
    assert np.all(np.abs(np.mean(kept, axis=0)) < (1e-3, 3e-3))


def test_line_fits_keep_lines() -> None:
    line = 2.0 + 0.3 * np.arange(17)
    for reach in (1, 2, 4):
        np.testing.assert_allclose(line_fit(17, reach) @ line, line, atol=1e-12)


def test_coarser_grids_keep_the_light_and_finer_ones_lines() -> None:
    values = np.random.default_rng(2).random(21)
    np.testing.assert_allclose((_overlap(21, 8) @ values).mean(), values.mean(), atol=1e-12)
    coarse, fine = (np.arange(8) + 0.5) / 8, (np.arange(21) + 0.5) / 21
    inner = (fine > coarse[0]) & (fine < coarse[-1])
    np.testing.assert_allclose((_between(8, 21) @ (3.0 * coarse))[inner], 3.0 * fine[inner], atol=1e-12)
