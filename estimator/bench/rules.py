"""The rules of a score: what counts as found, how a missed spot counts, how intervals are made.

* An image's spot is **detected** when a position is given within `match_px` of the chief ray's (u, v) and the spot is
  visible. Visible and not detected: **missed**. A position given where the spot is not visible, or further than
  `match_px` from it: **false detection**; an image can be missed and falsely detected at once.
* Errors are over detected spots. Beside each rms stands a second one, "missed counted", over all visible spots, in
  which a missed spot counts as an error of `match_px`, and a pair without a usable depth, or with one that is off by
  more than `missed_relative` of D, as `missed_relative`: an answer is never worth less than none.
* A pair's depth is **found** when both spots are visible and a finite depth above 0 follows from the answer: the
  method's own, unless a position that it gave is a false detection, else the exact one of two detected spots.
"""

from __future__ import annotations

from dataclasses import dataclass

from phibench.datasets.errors import DatasetError

MATCH_PX = 3.0
"""A spot at 5 sigma, the faintest that counts as there, is placed to 0.3 to 0.5 px (blur 0.7 px; mono to Bayer), so
that 3 px is six standard deviations or more and an answer beyond it belongs to something else. A blind guess in the
mirror's disc (radius 339 px) is within 3 px of the spot with a chance of 8e-5."""


@dataclass(frozen=True)
class Rules:
    """Numbers of a score.

    Parameters
    ----------
    match_px : float
        Largest distance of a position from the truth that counts as found.
    missed_relative : float
        Relative depth error for which a missed pair counts.
    confidence : float
        Of every interval.
    resamples : int
        Bootstrap resamples of the samples.
    least_samples : int
        With fewer samples a metric has no interval.
    """

    match_px: float = MATCH_PX
    missed_relative: float = 1.0
    confidence: float = 0.95
    resamples: int = 1999
    least_samples: int = 5

    def __post_init__(self) -> None:
        _above("match_px", self.match_px, 0.0)
        _above("missed_relative", self.missed_relative, 0.0)
        _above("resamples", self.resamples, 98)
        _above("least_samples", self.least_samples, 1)
        if not 0.5 <= self.confidence < 1.0:
            raise DatasetError(f"Rules.confidence = {self.confidence:g}: allowed are 0.5 up to below 1")


def _above(name: str, value: float, low: float) -> None:
    if not value > low:
        raise DatasetError(f"Rules.{name} = {value:g}: must be above {low:g}")
