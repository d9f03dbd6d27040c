"""Seat method `detect`: the peak of the matched filter, without covariance."""

from __future__ import annotations

from phibench.estimator.detect import Detection
from phibench.estimator.detect import detect as detect_spots
from phibench.estimator.seat.pair import Answer, Pair, Spot


def detect(pair: Pair) -> Answer:
    """Position of the matched filter's peak, refined by a parabola, in both images."""
    found = detect_spots(pair)
    return Answer(_spot(found.down), _spot(found.up))


def _spot(found: Detection | None) -> Spot:
    return Spot.missing("no spot found") if found is None else Spot(found.uv_px)
