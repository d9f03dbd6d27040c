"""Unsealing: proof that truth and submission belong to the seal, then truths and outcomes for the score."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from phibench.datasets.errors import DatasetError
from phibench.estimator.bench.seal_layout import Seal
from phibench.estimator.bench.sealed_pairs import SealedPairs
from phibench.estimator.bench.submission import Submission, check_complete, outcomes_of, read_submission
from phibench.estimator.bench.truth import PairTruth
from phibench.estimator.bench.truth_file import read_truth_file
from phibench.estimator.seat.outcome import Outcome
from phibench.estimator.seat.pair import Pair


@dataclass(frozen=True)
class Unsealed:
    """Pairs with their truth, outcomes by number, and what they were proved to belong to."""

    seal: Seal
    submission: Submission
    pairs: UnsealedPairs
    outcomes: tuple[Outcome, ...]


class UnsealedPairs:
    """A sealed set with its truth.

    Parameters
    ----------
    pairs : SealedPairs
    truths : tuple of PairTruth, by number
    """

    def __init__(self, pairs: SealedPairs, truths: tuple[PairTruth, ...]) -> None:
        self._pairs, self._truths = pairs, truths

    def __len__(self) -> int:
        return len(self._pairs)

    def pair(self, number: int) -> Pair:
        """What a method saw."""
        return self._pairs.pair(number)

    def truth(self, number: int) -> PairTruth:
        """The exact answer."""
        return self._truths[number]

    def document(self) -> dict[str, Any]:
        """Provenance of the set."""
        return self._pairs.document()


def unseal(public: str | Path, truth: str | Path, submission: str | Path) -> Unsealed:
    """Join a submission with the truth that was sealed.

    Parameters
    ----------
    public : folder of the sealed set
    truth : file that `seal` wrote beside the data set
    submission : file that `submit` wrote

    Raises
    ------
    DatasetError
        If a file of the set was changed, the truth is not the sealed one, or the submission answers another seal or
        not each pair once; in one sentence.
    """
    pairs = SealedPairs(Path(public))
    pairs.check()
    truths = read_truth_file(Path(truth), pairs.seal.truth_sha256)
    if [one.number for one in truths] != list(range(len(pairs))):
        raise DatasetError(f"{truth} does not hold the truth of each pair once; seal the data set again")
    document = read_submission(Path(submission))
    check_complete(document, pairs.seal, str(submission))
    return Unsealed(pairs.seal, document, UnsealedPairs(pairs, tuple(truths)), tuple(outcomes_of(document)))
