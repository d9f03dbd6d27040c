"""Named random streams: a seed is a function of names, never of the order of draws; and nodes of a Sobol sequence.

The names (data set, pose, stage, ...) and the recipe's seed are hashed with SHA-256 into the entropy of a
`numpy.random.SeedSequence`, so that adding a view or a spot changes no other one. Seed 0 is legal.
"""

from __future__ import annotations

import hashlib
from functools import reduce
from operator import xor

import numpy as np
from numpy.typing import NDArray

from phibench.scenes.frames import Array

Name = str | int
LEAST_SECRET_SEED = 2**128  # no whole number that somebody types is as large
LARGEST_SEED = 2 * LEAST_SECRET_SEED - 1
"""Root seeds go from 0; those from `LEAST_SECRET_SEED` on hold 128 bits that the system drew."""


def seed_sequence(*names: Name) -> np.random.SeedSequence:
    """Seed sequence of a stream; ("a", "bc") differs from ("ab", "c"), and 1 differs from "1"."""
    digest = _digest(names)
    # all 256 bits of the hash, as words of 32
    return np.random.SeedSequence([int.from_bytes(digest[i : i + 4], "little") for i in range(0, 32, 4)])


def philox_key(*names: Name) -> np.ndarray[tuple[int], np.dtype[np.uint64]]:
    """Key of a `numpy.random.Philox` stream, shape (2,): 128 bits of the same hash, for many counters under one key."""
    return np.frombuffer(_digest(names)[:16], dtype="<u8").astype(np.uint64)


def generator(*names: Name) -> np.random.Generator:
    """Random generator of a stream."""
    return np.random.default_rng(seed_sequence(*names))


def seed_32(*names: Name) -> int:
    """Seed of a stream for a renderer that takes 32 bits."""
    return int(seed_sequence(*names).generate_state(1, np.uint32)[0])


# Sobol's sequence: the points of `scipy.stats.qmc.Sobol`, whose import takes longer than most of what asks for them.

_BITS = 30
_JOE_KUO = (
    *((1, (1,)), (3, (1,)), (7, (1, 3)), (11, (1, 3, 1)), (13, (1, 1, 1))),
    *((19, (1, 1, 3, 3)), (25, (1, 3, 5, 13))),
)
"""Primitive polynomial of each dimension, its coefficients as bits, and first odd numbers (S. Joe, F. Y. Kuo, SIAM J.
Sci. Comput. 30, 2635, 2008)."""


def sobol(dimensions: int, count: int) -> Array:
    """Nodes of a quadrature rule: a Sobol sequence of one scramble for all, shape (count, dimensions), in [0, 1).

    There are seven dimensions at most.
    """
    rng = np.random.default_rng(0).spawn(1)[0]  # part of the rule, not a noise draw
    shift = rng.integers(2, size=(dimensions, _BITS), dtype=np.uint32) @ (1 << np.arange(_BITS, dtype=np.int64))
    matrices = np.tril(rng.integers(2, size=(dimensions, _BITS, _BITS), dtype=np.uint32), -1)
    scrambled = np.array(
        [_scrambled(_directions(*one), m) for one, m in zip(_JOE_KUO[:dimensions], matrices, strict=True)]
    )
    words = np.array(shift[None])
    for k in range(max(count - 1, 0).bit_length()):  # by Gray's code, which runs backwards with the next bit set
        words = np.concatenate([words, words[::-1] ^ scrambled[:, k]])
    return words[:count] * 0.5**_BITS


def _directions(polynomial: int, first: tuple[int, ...]) -> list[int]:
    """Direction numbers of a dimension, `_BITS` bits each, by the recurrence of its polynomial."""
    degree, odd = polynomial.bit_length() - 1, list(first)
    for _ in range(len(first), _BITS):
        steps = (odd[-k] << k for k in range(1, degree + 1) if polynomial >> (degree - k) & 1)
        odd.append(reduce(xor, steps, odd[-degree] if degree else 1))
    return [value << (_BITS - 1 - place) for place, value in enumerate(odd)]


def _scrambled(directions: list[int], matrix: NDArray[np.uint32]) -> NDArray[np.int64]:
    """Direction numbers times a lower triangular matrix of bits with ones on its diagonal (Matousek)."""
    places = np.arange(_BITS)[::-1]
    bits = np.array(directions)[:, None] >> places & 1
    return np.asarray((bits + bits @ matrix.T.astype(np.int64)) % 2 @ (1 << places))


def _digest(names: tuple[Name, ...]) -> bytes:
    text = "\0".join(f"{type(name).__name__}:{len(str(name))}:{name}" for name in names)
    return hashlib.sha256(text.encode()).digest()
