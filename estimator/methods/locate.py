"""Where the spot is, without a hint: a box for each image of a pair."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.estimator.methods.linear import linear_planes, redness
from phibench.estimator.methods.red_peak import red_peak
from phibench.estimator.methods.window import around, clipped, cut
from phibench.estimator.phi import outline_circle
from phibench.estimator.seat.pair import Box, Pair
from phibench.scenes.frames import Array, BoolArray

BOX_PX = 33
_INSIDE = 0.985  # of the outline's radius: the rim itself is an edge
_LEAST_SIGMAS = 6.0  # of half a million pixels one exceeds 5 by chance


def locate(pair: Pair) -> tuple[Box | None, Box | None]:
    """Box of 33 x 33 pixels around the most spot-like red place inside the mirror's outline.

    Where the pair has frames with the laser off, in on minus off. Without them a lamp's edge is often redder.

    Parameters
    ----------
    pair : Pair

    Returns
    -------
    (down, up)
        None where nothing stands out by 6 standard deviations.
    """
    return _locate(pair, pair.down, pair.down_off), _locate(pair, pair.up, pair.up_off)


def _locate(pair: Pair, image: NDArray[Any], off: NDArray[Any] | None) -> Box | None:
    centre, radius = outline_circle(pair.rig)
    side = 2 * int(np.ceil(radius)) + 1
    disc = around((float(centre[0]), float(centre[1])), image.shape, side)
    if disc.width_px == 0 or disc.height_px == 0:
        return None
    red = _redness(pair, image, disc) if off is None else _redness(pair, image, disc) - _redness(pair, off, disc)
    peak = red_peak(red, _in_mirror(disc, (float(centre[0]), float(centre[1])), _INSIDE * radius), _LEAST_SIGMAS)
    if peak is None:
        return None
    return clipped(around((peak[0] + disc.u0_px, peak[1] + disc.v0_px), image.shape, BOX_PX), image.shape)


def _redness(pair: Pair, image: NDArray[Any], box: Box) -> Array:
    return redness(linear_planes(cut(image, box), pair.card, (box.u0_px, box.v0_px)))


def _in_mirror(disc: Box, centre: tuple[float, float], radius: float) -> BoolArray:
    u = np.arange(disc.width_px) + disc.u0_px - centre[0]
    v = np.arange(disc.height_px) + disc.v0_px - centre[1]
    return u[None, :] ** 2 + v[:, None] ** 2 < radius**2
