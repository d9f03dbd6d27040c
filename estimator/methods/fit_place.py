"""Test of a fit's place: how far it may lie from where its spot was detected.

A fit begins at a detection and may walk off along noise, to a lamp's edge or to another light. Its covariance is that
of the place where it ended, and says nothing of this.
"""

from __future__ import annotations

import math

import numpy as np

from phibench.estimator.interface import Answer, Pair, Spot
from phibench.estimator.methods.locate import detected
from phibench.estimator.spots.detect import Detection
from phibench.scenes.rig import POSITIONS

_OFF_PX = 1.0  # of a detection on interpolated pixels; 0.9 was seen
_SIGMAS = 4.0  # of detection and fit together
_MOST_PX = 2.0  # whatever a fit claims: with `_OFF_PX` a fit stays within 3 px of the light
_BLUR_PX = 1.0  # of a spot, whose detection has this over its significance for a standard deviation


def left_px(found: Detection, spot: Spot) -> float | None:
    """Distance of a fit from the detection, pixels, where it is more than both sigmas allow; otherwise None."""
    if spot.uv_px is None:
        return None
    apart = math.dist(spot.uv_px, found.uv_px)
    claimed2 = 0.0 if spot.covariance_px2 is None else 0.5 * float(np.trace(spot.covariance_px2))
    sigma = math.sqrt(claimed2 + (_BLUR_PX / max(found.significance, 1.0)) ** 2)
    return apart if not apart <= min(_OFF_PX + _SIGMAS * sigma, _MOST_PX) else None


def at_detection(found: Detection | None, spot: Spot) -> Spot:
    """The spot of a fit; of one that left its detection, or ended nowhere, the detection's place without covariance.

    A place without covariance says that no fit stands behind it.
    """
    if found is None or (spot.uv_px is not None and left_px(found, spot) is None):
        return spot
    return Spot(found.uv_px)


def kept(pair: Pair, separate: Answer, together: Answer) -> Answer:
    """The answer for both images together; the separate one where a spot of it left its detection."""
    detections = detected(pair)
    for position in POSITIONS:
        detection, spot = getattr(detections, position), getattr(together, position)
        if detection is not None and left_px(detection, spot) is not None:
            return separate
    return together
