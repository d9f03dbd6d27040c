"""Centroid of the red light that the laser adds: on minus off, formed in linear light."""

from __future__ import annotations

from phibench.estimator.methods.linear import linear_planes
from phibench.estimator.methods.red_peak import red_peak
from phibench.estimator.methods.sight import Sight, spot_of
from phibench.estimator.seat.pair import Spot
from phibench.estimator.simple_spots import thresholded_centroid
from phibench.scenes.frames import Array


def off_difference(sight: Sight) -> Spot:
    """Thresholded centroid of the difference's red plane, on 15 x 15 pixels around its peak."""
    near = sight.window_at(red_peak(_added(sight)))
    if near is None:
        return Spot.missing("no spot in the difference")
    return spot_of(thresholded_centroid(_added(near)[None], near.origin_px))


def _added(sight: Sight) -> Array:
    """Red plane of on - off, shape (h, w); differences of encoded values would depend on the room's level."""
    off = sight.off_pixels
    if off is None:
        raise ValueError("off_difference: the pair has no laser-off frames")
    return sight.planes[0] - linear_planes(off, sight.pair.card, sight.origin_px)[0]
