"""Named random streams: a seed is a function of names, never of the order of draws.

The names (data set, pose, stage, ...) and the recipe's seed are hashed with SHA-256 into the entropy of a
`numpy.random.SeedSequence`, so that adding a view or a spot changes no other one. Seed 0 is legal.
"""

from __future__ import annotations

import hashlib

import numpy as np

Name = str | int


def seed_sequence(*names: Name) -> np.random.SeedSequence:
    """Seed sequence of a stream; ("a", "bc") differs from ("ab", "c"), and 1 differs from "1"."""
    text = "\0".join(f"{type(name).__name__}:{len(str(name))}:{name}" for name in names)
    digest = hashlib.sha256(text.encode()).digest()
    return np.random.SeedSequence([int.from_bytes(digest[i : i + 4], "little") for i in range(0, 32, 4)])


def generator(*names: Name) -> np.random.Generator:
    """Random generator of a stream."""
    return np.random.default_rng(seed_sequence(*names))


def seed_32(*names: Name) -> int:
    """Seed of a stream for a renderer that takes 32 bits."""
    return int(seed_sequence(*names).generate_state(1, np.uint32)[0])
