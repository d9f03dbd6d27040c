"""Quasi-random numbers inside Dr.Jit kernels: Kronecker sequences, one hashed shift per lane and dimension.

Point s of lane n in dimension d is frac(shift(n, d) + s alpha_d) with alpha_d the powers of the inverse of the root of
x^(D+1) = x + 1 (the D-dimensional golden ratio): a few points already fill the cube evenly. The shifts are hashed from
the lane, the dimension and a seed, so that lanes are independent.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any


def golden_steps(dimensions: int) -> tuple[float, ...]:
    """Steps alpha_1 .. alpha_D, the powers of 1 / phi_D."""
    root = 2.0
    for _ in range(60):  # fixed-point iteration of x = (1 + x)^(1 / (D + 1)), contraction below 1/2
        root = (1.0 + root) ** (1.0 / (dimensions + 1))
    return tuple(root ** -(d + 1) for d in range(dimensions))


_ROUNDS = 12  # of the Tiny Encryption Algorithm; with Mitsuba's usual 4, neighbouring lanes correlate by 0.48


def shifts(mi: ModuleType, lanes: Any, dimensions: int, seed: Any) -> list[Any]:
    """One uniform shift per lane for each dimension; `seed`, an integer or a Dr.Jit one, from a named stream."""
    keys = [mi.sample_tea_32(mi.UInt32(seed), mi.UInt32(d), _ROUNDS)[1] for d in range(dimensions)]
    return [_uniform(mi, mi.sample_tea_32(lanes, key, _ROUNDS)[1]) for key in keys]


def points(mi: ModuleType, shift: list[Any], index: Any) -> list[Any]:
    """Coordinates of point number `index` (an unsigned integer array) of every lane."""
    import drjit as dr

    steps = golden_steps(len(shift))
    moved = [offset + mi.Float(index) * step for offset, step in zip(shift, steps, strict=True)]
    return [value - dr.floor(value) for value in moved]


def _uniform(mi: ModuleType, word: Any) -> Any:
    return mi.Float(word >> 8) * (1.0 / 16777216.0)
