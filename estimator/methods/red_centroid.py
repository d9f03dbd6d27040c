"""Centroid of the redness R - max(G, B) in linear light, above 30 % of its peak."""

from __future__ import annotations

from phibench.estimator.methods.linear import redness
from phibench.estimator.methods.sight import Sight, spot_of
from phibench.estimator.seat.pair import Spot
from phibench.estimator.simple_spots import thresholded_centroid


def red_centroid(sight: Sight) -> Spot:
    """Thresholded centroid of the redness on 15 x 15 pixels around its peak; of the signal without colour filters."""
    near = sight.narrowed()
    if near is None:
        return Spot.missing("no spot")
    return spot_of(thresholded_centroid(redness(near.planes)[None], near.origin_px))
