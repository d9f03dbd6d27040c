"""What became of one pair in the hands of a method."""

from __future__ import annotations

from dataclasses import dataclass

from phibench.estimator.seat.pair import Answer

FAILURES = ("error", "timeout", "crash", "memory", "invalid", "mutated")
"""Exception; time limit; the process died; memory limit; an answer that is none; the method wrote into its input."""


@dataclass(frozen=True)
class Outcome:
    """One pair.

    Attributes
    ----------
    number : int
        `Pair.number`.
    answer : Answer or None
        None where `failure` says why.
    seconds : float
        Wall-clock time inside the method; NaN where it did not come back.
    failure : "" or one of `FAILURES`
    message : str
        One sentence about the failure, with the method's own line where there is one.
    """

    number: int
    answer: Answer | None
    seconds: float
    failure: str = ""
    message: str = ""
