"""Named random streams: a seed is a function of names, never of the order of draws.

The names (data set, pose, stage, ...) and the recipe's seed are hashed with SHA-256 into the entropy of a
`numpy.random.SeedSequence`, so that adding a view or a spot changes no other one. Seed 0 is legal.
"""

from __future__ import annotations

import hashlib

import numpy as np

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


def sobol(dimensions: int, count: int) -> Array:
    """Nodes of a quadrature rule: a Sobol sequence of one scramble for all, shape (count, dimensions), in [0, 1)."""
    from scipy.stats import qmc  # takes two seconds, and most of what imports this file needs none

    engine = qmc.Sobol(dimensions, scramble=True, rng=0)  # part of the rule, not a noise draw
    power = max(count - 1, 0).bit_length()  # scipy warns about numbers that are no power of two
    return np.asarray(engine.random_base2(power)[:count])


def _digest(names: tuple[Name, ...]) -> bytes:
    text = "\0".join(f"{type(name).__name__}:{len(str(name))}:{name}" for name in names)
    return hashlib.sha256(text.encode()).digest()
