"""Smoothing and resampling of light maps: shadows stay, noise goes, and the stated error is the true one."""

from __future__ import annotations

import numpy as np

from phibench.render.optics.faces import TexelGrid, face_table
from phibench.render.room.bounced_light import _between, _overlap, coarser_values, finer_values
from phibench.render.room.light_map import line_fit, smoothed_mean
from phibench.render.room.texel_points import nearest_free
from phibench.scenes.shapes import Rectangle, rectangle

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
    mean, sigma = smoothed_mean(GRID, *halves(SLOW, 0), kept=9)
    error = mean - SLOW.reshape(-1, 3)
    assert np.sqrt(np.mean(error**2)) < SIGMA / np.sqrt(2.0) / 3.0
    assert 1 / 1.5 < np.mean(sigma**2) / np.mean(error**2) < 1.5


def test_a_shadow_keeps_its_edge() -> None:
    """A step of 0.6, twenty times the noise: no texel beside it is off by more than 5 of the unsmoothed errors."""
    mean, _ = smoothed_mean(GRID, *halves(SHADOW, 1), kept=5)
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
        mean, _ = smoothed_mean(GRID, a, b, 5)
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


def test_grids_of_one_shape_are_treated_as_if_each_were_alone() -> None:
    """Three walls of two shapes, in the order that parts those alike: smoothing, resampling and nearest free texels."""
    walls = [rectangle(f"wall_{k}", (k, 0, 0), (0, 0, 1), size) for k, size in enumerate(((1.0, 0.6), (0.7, 2.0)) * 2)]
    rng = np.random.default_rng(4)

    def of(shapes: list[Rectangle], a: np.ndarray, b: np.ndarray, covered: np.ndarray) -> list[np.ndarray]:
        grid, coarse = (TexelGrid.of(face_table(shapes), np.full(len(shapes), size)) for size in (0.1, 0.2))
        free, means = nearest_free(covered, grid), coarser_values(grid, coarse, a)
        return [*smoothed_mean(grid, a, b, 5), a[free], finer_values(coarse, grid, means)]

    grid = TexelGrid.of(face_table(walls), np.full(len(walls), 0.1))
    a, b = (1.0 + 0.1 * rng.normal(size=(grid.count, 3)) for _ in range(2))
    covered = rng.random(grid.count) < 0.3
    together = of(walls, a, b, covered)
    for wall, (part, _, _) in zip(walls, grid.grids(), strict=True):
        for all_of, alone in zip(together, of([wall], a[part], b[part], covered[part]), strict=True):
            np.testing.assert_allclose(all_of[part], alone, rtol=1e-12, atol=1e-12)


def test_covered_texels_take_the_value_of_the_nearest_free_one() -> None:
    """Against all distances; a grid without a free texel keeps its own."""
    walls = [rectangle(f"wall_{k}", (k, 0, 0), (0, 0, 1), (1.0, 0.6)) for k in range(2)]
    grid = TexelGrid.of(face_table(walls), np.full(len(walls), 0.1))
    covered = np.random.default_rng(6).random(grid.count) < 0.7
    covered[60:] = True
    found = nearest_free(covered, grid)
    np.testing.assert_array_equal(found[60:], np.arange(60, 120))
    place = np.stack(np.divmod(np.arange(60), 10), axis=1)
    away = np.linalg.norm(place[:, None] - place[~covered[:60]], axis=2).min(axis=1)
    assert covered[:60].any()
    assert not covered[found[:60]].any()
    np.testing.assert_allclose(np.linalg.norm(place - place[found[:60]], axis=1), away)
