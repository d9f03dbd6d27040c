"""Product quadrature on discs: nodes and weights whose sums replace random samples of spot and aperture."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Literal

import numpy as np
from numpy.polynomial.laguerre import laggauss
from numpy.polynomial.legendre import leggauss

from phibench.scenes.frames import Array


def disc_nodes(profile: Literal["uniform", "gaussian"], smoothness: float) -> tuple[Array, Array]:
    """Nodes on a disc of unit radius ("uniform") or of unit sigma ("gaussian"), weights summing to 1.

    Parameters
    ----------
    profile
        Weight function: constant on the unit disc, or exp(-r^2 / 2) / (2 pi) on the plane.
    smoothness : float
        Extent of the disc's image (radius or sigma) in units of the blur that smooths it. The integrand then behaves as
        exp(i k x) with k up to about 4 times this number, which the node counts resolve (tested by doubling them).

    Returns
    -------
    nodes : array, shape (n, 2)
    weights : array, shape (n,)
    """
    radial = 3 + math.ceil(1.5 * smoothness)
    around = 8 + 2 * math.ceil(2.5 * smoothness)
    if profile == "uniform":
        t, w = leggauss(radial)  # uniform in r^2
        radius, weight = np.sqrt(0.5 * (t + 1.0)), 0.5 * w
    else:
        t, weight = laggauss(radial + 1)  # t = r^2 / 2 has the density exp(-t)
        radius = np.sqrt(2.0 * t)
    turn = 2.0 * np.pi * (np.arange(around) + 0.5) / around
    nodes = radius[:, None, None] * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    weights = np.repeat(weight, around) / around
    return nodes.reshape(-1, 2), weights / weights.sum()


def slices(total: int, size: int) -> Iterator[slice]:
    """Slices that cover range(total) in pieces of at most `size`."""
    return (slice(start, min(start + size, total)) for start in range(0, total, size))
