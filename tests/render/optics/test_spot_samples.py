"""Disc quadrature against closed forms, from points to images many blurs wide."""

from __future__ import annotations

import numpy as np
import pytest
import scipy
from scipy.special import i0e

from phibench.render.optics.spot_samples import disc_nodes, disc_points, slices, streak_nodes

SMOOTHNESS = [0.0, 0.2, 0.7, 0.999, 1.001, 2.0, 4.0, 8.0, 16.0]


def _blurred(profile: str, smoothness: float, at: np.ndarray) -> np.ndarray:
    """Image of the disc's nodes, scaled by `smoothness`, blurred by a unit Gaussian, at points (n, 2)."""
    nodes, weights = disc_nodes(profile, smoothness)  # type: ignore[arg-type]
    distance2 = ((at[:, None] - smoothness * nodes[None]) ** 2).sum(axis=-1)
    return np.exp(-0.5 * distance2) @ weights / (2.0 * np.pi)


def _points(extent: float) -> np.ndarray:
    """Points along three directions, so that gaps between the nodes cannot hide."""
    along = np.linspace(0.0, extent, 41)
    turns = np.array([0.0, 0.3, 1.1])[:, None]
    return np.stack([along * np.cos(turns), along * np.sin(turns)], axis=-1).reshape(-1, 2)


@pytest.mark.parametrize("smoothness", SMOOTHNESS)
def test_gaussian_blurred_is_a_wider_gaussian(smoothness: float) -> None:
    """Sigma^2 = 1 + smoothness^2 exactly; to 1e-4 of the peak everywhere."""
    variance = 1.0 + smoothness**2
    at = _points(4.0 * np.sqrt(variance))
    exact = np.exp(-0.5 * (at**2).sum(axis=-1) / variance) / (2.0 * np.pi * variance)
    assert np.abs(_blurred("gaussian", smoothness, at) - exact).max() <= 1e-4 * exact.max()


@pytest.mark.parametrize("smoothness", SMOOTHNESS)
def test_disc_blurred_is_the_integral_over_its_radius(smoothness: float) -> None:
    """Over the angle the blurred ring is exp(-(r - q)^2 / 2) I0e(r q); over the radius scipy integrates; to 1e-4."""
    at = _points(smoothness + 4.0)
    radius = np.linalg.norm(at, axis=-1)

    def ring(q: float) -> np.ndarray:
        return np.exp(-0.5 * (radius - smoothness * q) ** 2) * i0e(radius * smoothness * q) * 2.0 * q / (2.0 * np.pi)

    exact = scipy.integrate.quad_vec(ring, 0.0, 1.0, epsabs=1e-10)[0]
    assert np.abs(_blurred("uniform", smoothness, at) - exact).max() <= 1e-4 * exact.max()


@pytest.mark.parametrize("along", [1.0, 2.0, 4.0, 8.0, 16.0])
@pytest.mark.parametrize("slender", [0.0, 0.1, 1.0 / 3.0])
def test_streaks_blurred(along: float, slender: float) -> None:
    """As above, with extents that differ: the Gaussian in closed form, the disc by rings enough for its length."""
    extents = np.array([along, slender * along])
    at = np.stack(np.meshgrid(np.linspace(0.0, along + 4.0, 41), np.linspace(0.0, extents[1] + 4.0, 11)), axis=-1)
    at, variance = at.reshape(-1, 2), 1.0 + extents**2

    def blurred(nodes: np.ndarray, weights: np.ndarray) -> np.ndarray:
        distance2 = ((at[:, None] - extents * nodes[None]) ** 2).sum(axis=-1)
        return np.exp(-0.5 * distance2) @ weights / (2.0 * np.pi)

    exact = np.exp(-0.5 * (at**2 / variance).sum(axis=-1)) / (2.0 * np.pi * np.sqrt(variance.prod()))
    assert np.abs(blurred(*streak_nodes("gaussian", *extents)) - exact).max() <= 1e-4 * exact.max()
    exact = blurred(*disc_nodes("uniform", 1.5 * along + 1.0))
    assert np.abs(blurred(*streak_nodes("uniform", *extents)) - exact).max() <= 1e-4 * exact.max()


def test_too_few_nodes_would_be_noticed() -> None:
    """The nodes for a small spot, used for a large one, miss by far more than the tolerance."""
    nodes, weights = disc_nodes("gaussian", 0.5)
    at = _points(16.0)
    distance2 = ((at[:, None] - 4.0 * nodes[None]) ** 2).sum(axis=-1)
    exact = np.exp(-0.5 * (at**2).sum(axis=-1) / 17.0) / (2.0 * np.pi * 17.0)
    assert np.abs(np.exp(-0.5 * distance2) @ weights / (2.0 * np.pi) - exact).max() > 0.05 * exact.max()


@pytest.mark.parametrize("profile", ["gaussian", "uniform"])
def test_points_have_the_moments_of_the_disc(profile: str) -> None:
    """Second moment per axis: 1 (Gaussian), 1/4 (disc); 20 000 points, 6 sigma of about 1 %."""
    points = disc_points(profile, np.random.default_rng(0).uniform(size=(20000, 2)))  # type: ignore[arg-type]
    assert points.mean(axis=0) == pytest.approx(np.zeros(2), abs=0.05)
    assert (points**2).mean(axis=0) == pytest.approx(np.full(2, 1.0 if profile == "gaussian" else 0.25), rel=0.06)


def test_slices_cover_everything_once() -> None:
    assert [list(range(10))[part] for part in slices(10, 4)] == [[0, 1, 2, 3], [4, 5, 6, 7], [8, 9]]
