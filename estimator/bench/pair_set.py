"""A set of pairs to score on, wherever it comes from."""

from __future__ import annotations

from typing import Any, Protocol

from phibench.estimator.bench.truth import PairTruth
from phibench.estimator.seat.pair import Pair


class PairSet(Protocol):
    """Pairs by number, 0 to len - 1; each is drawn or read when it is asked for."""

    def __len__(self) -> int:
        """How many."""

    def pair(self, number: int) -> Pair:
        """What a method sees."""

    def truth(self, number: int) -> PairTruth:
        """The exact answer.

        Raises
        ------
        DatasetError
            If the set is sealed.
        """

    def document(self) -> dict[str, Any]:
        """Provenance: name, task version, hashes, seeds, as JSON can hold it."""
