"""Product quadrature on discs: nodes and weights whose sums replace random samples of spot and aperture."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Literal

import numpy as np
from numpy.polynomial.laguerre import laggauss
from numpy.polynomial.legendre import leggauss
from scipy.special import ndtri

from phibench.scenes.frames import Array

Profile = Literal["uniform", "gaussian"]

_SMALL = 1.0  # Gaussian spots up to this many blurs: few Gauss-Laguerre rings do
_REACH = 5.5  # sigmas; a Gaussian's flux beyond is 3e-7


def disc_nodes(profile: Profile, smoothness: float) -> tuple[Array, Array]:
    """Nodes on a disc of unit radius ("uniform") or of unit sigma ("gaussian"), weights summing to 1.

    The image's blur damps spatial frequencies k (in units of 1 / blur) as exp(-k^2 / 2): beyond 4 nothing is left, and
    rings and points per ring are as many as exp(i k x) with k = 4 needs (tested against closed forms).

    Parameters
    ----------
    profile
        Weight function: constant on the unit disc, or exp(-r^2 / 2) / (2 pi) on the plane.
    smoothness : float
        Extent of the disc's image (radius or sigma) in units of the blur that smooths it.

    Returns
    -------
    nodes : array, shape (n, 2)
    weights : array, shape (n,)
    """
    radius, weight = _rings(profile, smoothness)
    around = 8 + 2 * np.ceil(2.5 * smoothness * np.maximum(radius, 1.0)).astype(int)
    turns = [2.0 * np.pi * (np.arange(n) + 0.5) / n for n in around]
    nodes = [r * np.stack([np.cos(turn), np.sin(turn)], axis=-1) for r, turn in zip(radius, turns, strict=True)]
    weights = np.repeat(weight / around, around)
    return np.concatenate(nodes), weights / weights.sum()


def disc_points(profile: Profile, uniform: Array) -> Array:
    """Points of the same discs, shape (n, 2), from uniform points on the unit square."""
    if profile == "gaussian":
        return np.asarray(ndtri(np.clip(uniform, 1e-12, 1.0 - 1e-12)))
    radius, turn = np.sqrt(uniform[:, 0]), 2.0 * np.pi * uniform[:, 1]
    return np.stack([radius * np.cos(turn), radius * np.sin(turn)], axis=-1)


def _rings(profile: Profile, smoothness: float) -> tuple[Array, Array]:
    """Radii and weights of the rings."""
    if profile == "uniform":
        t, weight = leggauss(3 + math.ceil(1.5 * smoothness))  # uniform in r^2
        return np.sqrt(0.5 * (t + 1.0)), weight
    if smoothness <= _SMALL:
        t, weight = laggauss(4 + math.ceil(1.5 * smoothness))  # t = r^2 / 2 has the density exp(-t)
        return np.sqrt(2.0 * t), weight
    t, weight = leggauss(6 + math.ceil(2.0 * _REACH * smoothness))  # k r / 2 with k = 4
    radius = 0.5 * _REACH * (t + 1.0)
    return radius, weight * radius * np.exp(-0.5 * radius**2)


def slices(total: int, size: int) -> Iterator[slice]:
    """Slices that cover range(total) in pieces of at most `size`."""
    return (slice(start, min(start + size, total)) for start in range(0, total, size))
