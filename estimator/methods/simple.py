"""The simple extractors of `estimator.simple_spots` as methods: on the picture as a viewer shows it."""

from __future__ import annotations

from collections.abc import Callable

from phibench.estimator.methods.sight import Sight, spot_of
from phibench.estimator.seat.pair import Spot
from phibench.estimator.simple_spots import SIMPLE_METHODS

Finder = Callable[[Sight], Spot]


def in_the_box(name: str) -> Finder:
    """Simple extractor on the whole box, whatever is brightest there.

    Parameters
    ----------
    name : key of `simple_spots.SIMPLE_METHODS`
    """

    def find(sight: Sight) -> Spot:
        return spot_of(SIMPLE_METHODS[name](sight.picture[None], sight.origin_px))

    return find


def at_the_red_peak(name: str) -> Finder:
    """Simple extractor on 15 x 15 pixels around the reddest spot-like place in the box.

    Parameters
    ----------
    name : key of `simple_spots.SIMPLE_METHODS`
    """

    def find(sight: Sight) -> Spot:
        near = sight.narrowed()
        return Spot.missing("no spot") if near is None else in_the_box(name)(near)

    return find
