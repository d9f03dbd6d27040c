"""Weights of key views, and the bound on what any weights can do for an edge in the image."""

from __future__ import annotations

import numpy as np
import pytest

from phibench.render.film.key_views import key_weights
from phibench.scenes.frames import Array

BLUR_PX = 0.7  # optical blur of the default rig, besides the pixel
FREQUENCY = np.linspace(1e-4, 1.2, 6000)  # cycles per pixel: beyond it the blur leaves 1e-6
STEP = FREQUENCY[1] - FREQUENCY[0]
# Energy spectrum, both sides, of an edge of height 1 behind the blur and a pixel of width 1.
EDGE = 2.0 * (np.exp(-2.0 * (np.pi * BLUR_PX * FREQUENCY) ** 2) * np.sinc(FREQUENCY) / (2.0 * np.pi * FREQUENCY)) ** 2


def edge_error(weights: Array, offsets_px: Array) -> float:
    """Root of the integral of the squared error of an interpolated edge along its normal, px^0.5 (Parseval).

    The views are the edge, moved by `offsets_px` from the place that is wanted.
    """
    transfer = (weights[:, None] * np.exp(2j * np.pi * FREQUENCY * offsets_px[:, None])).sum(axis=0)
    return float(np.sqrt(np.sum(EDGE * np.abs(1.0 - transfer) ** 2) * STEP))


def best_weights(offsets_px: Array) -> Array:
    """Weights of smallest error among those with sum 1: least squares with a Lagrange multiplier (kriging)."""

    def half_variogram(d: Array) -> Array:
        return np.array([np.sum(EDGE * (1.0 - np.cos(2.0 * np.pi * FREQUENCY * x))) * STEP for x in d.ravel()])

    n = len(offsets_px)
    system = np.ones((n + 1, n + 1))
    system[:n, :n] = -half_variogram(offsets_px[:, None] - offsets_px).reshape(n, n)
    system[n, n] = 0.0
    return np.linalg.solve(system, np.append(-half_variogram(offsets_px), 1.0))[:n]


def halfway(spacing_px: float, count: int) -> Array:
    return spacing_px * (np.arange(count) - 0.5 * (count - 1))


def cubic(spacing_px: float) -> float:
    keys = np.arange(8.0)
    return edge_error(key_weights(keys, np.array(3.5)), halfway(spacing_px, 8))


def test_the_weights_are_exact_for_cubics() -> None:
    keys, at = np.linspace(-1.0, 2.0, 9), np.linspace(-1.0, 2.0, 50)
    for power in range(4):
        assert np.allclose(key_weights(keys, at) @ keys**power, at**power, rtol=0.0, atol=1e-13)  # some eps of 2^3
    assert np.abs(key_weights(keys, at) @ keys**4 - at**4).max() > 1e-3


@pytest.mark.parametrize("spacing_px", [1.8, 2.4, 3.0])
def test_no_weights_make_up_for_views_that_are_missing(spacing_px: float) -> None:
    """At the spacing of a drive the cubic is within 15 % of the best weights of eight views, and nearer beyond."""
    ours, best = cubic(spacing_px), edge_error(best_weights(halfway(spacing_px, 8)), halfway(spacing_px, 8))
    print(f"edge half-way, views {spacing_px} px apart: cubic {ours:.3f}, best of eight views {best:.3f} px^0.5")
    assert best < ours < 1.15 * best
    assert best_weights(halfway(spacing_px, 8)).sum() == pytest.approx(1.0)
    if spacing_px > 1.8:
        assert best > 1.7 * cubic(1.8)
    # the error is not the blur's: where views are dense, it goes
    assert cubic(0.5) < 0.05 * cubic(1.8)
