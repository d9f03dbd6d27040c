"""Doubts of a measurement's spots: light that is no spot, laser-off pictures that moved, rays that do not meet.

A sentence begins with "doubtful: " and says what to look at; "" says that there is nothing.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from phibench.calibration.captures.pair_photos import (
    PairPhotos,
    light_ratio,
    moved_between,
    moved_note,
    relit_note,
)
from phibench.calibration.captures.spot_shape import UNLIKE
from phibench.estimator.geometry.least_squares_depth import GeneralDepth
from phibench.estimator.interface import Pair
from phibench.estimator.spots.detect import FARTHEST_M
from phibench.scenes.frames import Array

DOUBTFUL_P = 1e-3
"""Probability of the two rays' gap below which the two spots are not taken for one point."""
_RELIT = 0.03  # relative change of the room's median code from which on it may be what has not the shape of a spot


@dataclass(frozen=True)
class SeenSpot:
    """Position of a spot in one image; pixels, covariance of (u, v), and how unlike a spot its light is (0 to 1)."""

    uv_px: Array
    covariance_px2: Array = field(repr=False)
    unlike: float = 0.0

    @property
    def sigma_px(self) -> float:
        """Root mean square of both coordinates' standard deviations."""
        return math.sqrt(0.5 * float(np.trace(self.covariance_px2)))


def moved_offs(pair: Pair, photos: PairPhotos) -> Iterator[str]:
    """Sentences on laser-off pictures that are shifted: edges of the room then count as light of the spot."""
    for position, shift in moved_between(pair):
        yield f"doubtful: the spot {position} lies on edges: {moved_note(photos, position, shift)}"


def unlike_spots(pair: Pair, photos: PairPhotos, spots: Mapping[str, SeenSpot]) -> Iterator[str]:
    """Sentences on lights that have not the shape of a spot, by position."""
    for position, spot in spots.items():
        if spot.unlike < UNLIKE:
            continue
        (u, v), percent = spot.uv_px, 100.0 * min(spot.unlike, 1.0)
        remedy = "the beam may meet an edge or graze a surface, turn the laser a little"
        ratio = light_ratio(pair, position)
        if ratio is not None and abs(ratio - 1.0) > _RELIT:
            remedy = relit_note(photos, position, ratio)
        yield (
            f"doubtful: the spot {position} at ({u:.0f}, {v:.0f}) px has not the shape of one, {percent:.0f} % "
            f"of its light do not fit; {remedy}"
        )


def too_far(depth: GeneralDepth) -> str:
    """Sentence on a D beyond the points that spots are looked for at."""
    if float(depth.depth_m) <= FARTHEST_M:
        return ""
    return (
        f"doubtful: D is beyond {FARTHEST_M:g} m, up to which spots are looked for: one of the two lights may be "
        "another one, or the stroke is not in metres"
    )


def rays_gap(depth: GeneralDepth) -> str:
    """Sentence on the test of both rays."""
    p, chi2 = float(depth.p_value), float(depth.chi2)
    if p >= DOUBTFUL_P:
        return f"one point: chi^2 {chi2:.2f} for one degree of freedom (p = {p:.2g})"
    return (
        f"doubtful: the spots are not images of one point, chi^2 {chi2:.1f} for one degree of freedom (p = {p:.1e}); "
        "one may be a reflection, the rig may have turned between the pictures, or the calibration is another rig's"
    )
