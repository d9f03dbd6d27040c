"""Pairs that are drawn once and held while everything that looks at them does so."""

from __future__ import annotations

from typing import Any

from phibench.estimator.bench.pair_set import PairSet
from phibench.estimator.bench.truth import PairTruth
from phibench.estimator.seat.pair import Pair


class HeldPairs:
    """A part of a pair set in memory; make another for the next part.

    Parameters
    ----------
    pairs : PairSet
    """

    def __init__(self, pairs: PairSet) -> None:
        self._pairs = pairs
        self._images: dict[int, Pair] = {}
        self._truths: dict[int, PairTruth] = {}

    def __len__(self) -> int:
        return len(self._pairs)

    def pair(self, number: int) -> Pair:
        """What a method sees."""
        if number not in self._images:
            self._images[number] = self._pairs.pair(number)
        return self._images[number]

    def truth(self, number: int) -> PairTruth:
        """The exact answer."""
        if number not in self._truths:
            self._truths[number] = self._pairs.truth(number)
        return self._truths[number]

    def document(self) -> dict[str, Any]:
        """Provenance of the set."""
        return self._pairs.document()
