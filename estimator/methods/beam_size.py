"""The beam's size in a spot's image: it needs the distance, which both images of a pair tell once they are measured."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from phibench.estimator.seat.pair import Answer, Pair
from phibench.estimator.spot_blur import SpotBlur, spot_blur
from phibench.estimator.status import Status
from phibench.estimator.triangulate import depth_exact

_REACH_M = (0.3, 20.0)  # distances to which a beam is believed


def measured_twice(measure: Callable[[float | None], Answer], pair: Pair) -> Answer:
    """Answer of `measure`, which takes the spot's distance: once without it, once with the one found.

    A spot that the second look does not find keeps the first one's answer.
    """
    first = measure(None)
    depth_m = seen_depth_m(pair, first)
    if depth_m is None:
        return first
    second = measure(depth_m)
    down, up = (
        one if two.uv_px is None or two.covariance_px2 is None else two
        for one, two in ((first.down, second.down), (first.up, second.up))
    )
    return Answer(down, up)


def seen_depth_m(pair: Pair, answer: Answer) -> float | None:
    """Distance at which the rays through two positions meet; None if they do not, or the beam is not known."""
    if pair.beam is None or answer.down.uv_px is None or answer.up.uv_px is None:
        return None
    found = depth_exact(pair.rig, pair.stroke_m, np.array(answer.down.uv_px), np.array(answer.up.uv_px))
    depth_m = float(found.depth_m)
    return depth_m if found.status == Status.OK and _REACH_M[0] <= depth_m <= _REACH_M[1] else None


def pair_blur(pair: Pair, uv_px: ArrayLike, depth_m: float | None) -> SpotBlur:
    """Blur of a spot of the pair's laser at a distance; None leaves the beam's size out."""
    return spot_blur(pair.rig, uv_px, depth_m, pair.beam)
