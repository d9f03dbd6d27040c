"""Extractors of other packages, as rows to compare with; each package is imported when its method runs."""

from __future__ import annotations

import numpy as np

from phibench.estimator.methods.linear import redness
from phibench.estimator.methods.sight import Sight
from phibench.estimator.seat.pair import Spot
from phibench.scenes.frames import Array

TRACKPY_DIAMETER_PX = 7


def photutils_centroid_2dg(sight: Sight) -> Spot:
    """`photutils.centroids.centroid_2dg` on the redness of 15 x 15 pixels: an elliptical Gaussian by least squares."""
    from photutils.centroids import centroid_2dg

    near = sight.narrowed()
    if near is None:
        return Spot.missing("no spot")
    u, v = (float(x) for x in centroid_2dg(_above(near)))
    return _spot(near, u, v)


def trackpy_refine(sight: Sight) -> Spot:
    """`trackpy.refine_com` on the redness of 15 x 15 pixels: centroid in a disc of 7 pixels, moved until it is central.

    Trackpy's own search wants whole numbers; the start is the red peak.
    """
    from trackpy import refine_com

    near = sight.narrowed()
    if near is None:
        return Spot.missing("no spot")
    image = np.maximum(_above(near), 0.0)
    middle = np.array([[image.shape[0] // 2, image.shape[1] // 2]])
    table = refine_com(image, image, TRACKPY_DIAMETER_PX // 2, middle, pos_columns=["v", "u"], engine="python")
    return _spot(near, float(table["u"].iloc[0]), float(table["v"].iloc[0]))


def _above(near: Sight) -> Array:
    """Redness over the median of the window's border; scaled, because a fit's tolerances are absolute."""
    red = redness(near.planes)
    edge = np.concatenate([red[0], red[-1], red[1:-1, 0], red[1:-1, -1]])
    above = red - np.median(edge)
    return np.asarray(above / max(float(above.max()), 1e-12))


def _spot(near: Sight, u: float, v: float) -> Spot:
    """Answer for a position in the window."""
    if not (0.0 <= u <= near.box.width_px - 1.0 and 0.0 <= v <= near.box.height_px - 1.0):
        return Spot.missing("spot cut")
    return Spot((u + near.box.u0_px, v + near.box.v0_px))
