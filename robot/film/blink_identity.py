"""Evidence that a track's light follows a target's blink code: log likelihood ratio against chance.

A track's light in frame k is y_k = C + A x_k for a light with the code. x_k is the part of the exposure of the spot's
own row during which the code is on, and C what is steady there, such as an edge of the room. The alternative is a light
whose bits, on the same clock, are on or off by chance. Its likelihood is the mean over all sequences of bits, by the
forward algorithm (L. R. Rabiner, Proc. IEEE 77, 257, 1989). One frame in 50 may be wrong in both.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from phibench.scenes.frames import Array

_WRONG = 0.02  # of frames
_RELATIVE = 0.1  # of a light, that changes from frame to frame: its place in the mosaic
_LEAST_SPREAD = 0.3  # of the levels: without an on and an off frame nothing is known
_STEADY = -1.0  # log odds of such a light
_FOLLOWS = 6.0  # least A over its standard deviation: noise at a million places does not reach it


@dataclass(frozen=True)
class Evidence:
    """Comparison of a track with a code.

    Attributes
    ----------
    log_odds : float
        Log likelihood ratio against a light that blinks by chance, less ln(phases).
    electrons, sigma_e : float
        Amplitude A of what follows the code, and its standard deviation.
    phase : int
        Number of the phase that fits best.
    """

    log_odds: float = 0.0
    electrons: float = 0.0
    sigma_e: float = math.inf
    phase: int = 0


@dataclass(frozen=True)
class Exposures:
    """Exposures of N rows, one a frame, by the bits of a code's clock.

    Attributes
    ----------
    first : shape (N,)
        Number of the first bit of each.
    shares : shape (N, m)
        Part of the exposure that falls on this bit and the m - 1 after it.
    """

    first: NDArray[np.int64]
    shares: Array

    @classmethod
    def of(cls, middle_s: Array, exposure_s: float, bit_s: float, start_s: float) -> Exposures:
        """Exposures about `middle_s`, of a clock that starts at `start_s`."""
        low = (middle_s - 0.5 * exposure_s - start_s) / bit_s
        first, length = np.floor(low), max(exposure_s / bit_s, 1e-9)  # an instant has a bit, too
        ends = first[:, None] + np.arange(math.ceil(length) + 2)
        passed = np.clip(ends - low[:, None], 0.0, length)
        return cls(first.astype(np.int64), np.diff(passed, axis=1) / length)

    def levels(self, bits: str) -> Array:
        """Light of a code, shape (N,), between 0 and 1."""
        values = np.array([float(bit) for bit in bits])
        return np.sum(self.shares * values[(self.first[:, None] + np.arange(self.shares.shape[1])) % len(bits)], axis=1)


def evidence(electrons: Array, sigma_e: Array, exposures: Sequence[Exposures], bits: str) -> Evidence:
    """Compare the light of N frames with a code.

    Parameters
    ----------
    electrons, sigma_e : shape (N,)
    exposures : sequence of Exposures
        For each phase that the code may have.
    """
    best = Evidence(-math.inf)
    for phase, exposure in enumerate(exposures):
        of_phase = _of_phase(electrons, sigma_e, exposure, bits)
        if of_phase.log_odds > best.log_odds:
            best = replace(of_phase, phase=phase)
    return replace(best, log_odds=best.log_odds - math.log(len(exposures)))


def _of_phase(y: Array, sigma: Array, exposures: Exposures, bits: str) -> Evidence:
    x = exposures.levels(bits)
    if np.ptp(x) < _LEAST_SPREAD:
        return Evidence()
    C, A, sigma_A = _fitted(y, sigma, x)
    if sigma_A * _FOLLOWS > A:
        return Evidence(_STEADY, A, sigma_A)
    flat = _WRONG / (A + 6.0 * float(np.median(sigma)))  # evenly over all levels that a light can have
    own = np.log(_likelihood(y, C, A, sigma, x[:, None], flat)).sum()
    return Evidence(float(own) - _by_chance(y, C, A, sigma, exposures, flat), A, sigma_A)


def _fitted(y: Array, sigma: Array, x: Array) -> tuple[float, float, float]:
    """C, A and the standard deviation of A; the second time frames that cannot be right count less."""
    weight = 1.0 / sigma**2
    X = np.stack([np.ones_like(x), x])
    for _ in range(2):
        F = (X * weight) @ X.T
        C, A = np.linalg.solve(F, (X * weight) @ y)
        spread = np.hypot(sigma, _RELATIVE * (abs(C) + A * x))
        rest = np.abs(y - C - A * x)
        # a wrong frame counts less, however far off it is
        weight = np.where(rest < 4.0 * spread, 1.0, (4.0 * spread / np.maximum(rest, 1e-12)) ** 2) / spread**2
    return float(C), float(A), float(math.sqrt(np.linalg.inv(F)[1, 1]))


def _likelihood(y: Array, C: float, A: float, sigma: Array, levels: Array, flat: float) -> Array:
    """Likelihood of N frames at levels (N, m)."""
    spread = np.hypot(sigma[:, None], _RELATIVE * (abs(C) + A * levels))
    normal = np.exp(-0.5 * ((y[:, None] - C - A * levels) / spread) ** 2) / (math.sqrt(2.0 * math.pi) * spread)
    return np.asarray(flat + (1.0 - _WRONG) * normal)


def _by_chance(y: Array, C: float, A: float, sigma: Array, exposures: Exposures, flat: float) -> float:
    """Log likelihood of a light whose bits are on or off by chance: forward over the bits that a frame sees."""
    width = exposures.shares.shape[1]
    patterns = np.arange(2**width)[:, None] >> np.arange(width - 1, -1, -1) & 1  # the first bit leads
    each = _likelihood(y, C, A, sigma, exposures.shares @ patterns.T, flat)
    total, weight = 0.0, np.full(len(patterns), 1.0 / len(patterns))
    for k, likelihood in enumerate(each):
        for _ in range(min(int(exposures.first[k] - exposures.first[k - 1]), width) if k else 0):
            # the first bit is dropped, and a new one comes behind
            kept = weight.reshape(2, -1).sum(axis=0)
            weight = 0.5 * np.repeat(kept, 2)
        weight = weight * likelihood
        total += math.log(weight.sum())
        weight = weight / weight.sum()
    return total
