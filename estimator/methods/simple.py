"""Built-in methods without a noise model: simple extractors, centroids, other packages, `detect`.

The extractors of `simple_spots` work on the picture as a viewer shows it. Extractors of other packages are rows to
compare with; each package is imported when its method runs.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from phibench.estimator.interface import Answer, Pair, Spot
from phibench.estimator.methods.locate import SearchRegion, detected, red_peak, spot_of
from phibench.estimator.spots.detect import Detection
from phibench.estimator.spots.image_planes import linear_planes, redness
from phibench.estimator.spots.simple_spots import SIMPLE_METHODS, thresholded_centroid
from phibench.scenes.frames import Array

Finder = Callable[[SearchRegion], Spot]


def in_the_box(name: str) -> Finder:
    """Simple extractor on the whole box, whatever is brightest there.

    Parameters
    ----------
    name : key of `simple_spots.SIMPLE_METHODS`
    """

    def find(region: SearchRegion) -> Spot:
        return spot_of(SIMPLE_METHODS[name](region.picture[None], region.origin_px))

    return find


def at_the_red_peak(name: str) -> Finder:
    """Simple extractor on 15 x 15 pixels about the spot's place (`SearchRegion.place`).

    Parameters
    ----------
    name : key of `simple_spots.SIMPLE_METHODS`
    """

    def find(region: SearchRegion) -> Spot:
        near = region.narrowed()
        return Spot.missing("no spot") if near is None else in_the_box(name)(near)

    return find


def red_centroid(region: SearchRegion) -> Spot:
    """Thresholded centroid of the redness about the spot's place; of the signal without colour filters."""
    near = region.narrowed()
    if near is None:
        return Spot.missing("no spot")
    return spot_of(thresholded_centroid(redness(near.planes)[None], near.origin_px))


def off_difference(region: SearchRegion) -> Spot:
    """Thresholded centroid of the difference's red plane, on 15 x 15 pixels about the spot's place."""
    near = region.window_at(red_peak(_added(region)) if region.found is None else region.place)
    if near is None:
        return Spot.missing("no spot in the difference")
    return spot_of(thresholded_centroid(_added(near)[None], near.origin_px))


def _added(region: SearchRegion) -> Array:
    """Red plane of on - off, shape (h, w); differences of encoded values would depend on the room's level."""
    off = region.off_pixels
    if off is None:
        raise ValueError("off_difference: the pair has no laser-off frames")
    return region.planes[0] - linear_planes(off, region.pair.card, region.origin_px)[0]


TRACKPY_DIAMETER_PX = 7  # odd, as trackpy asks


def photutils_centroid_2dg(region: SearchRegion) -> Spot:
    """`photutils.centroids.centroid_2dg` on `_laser_in` of 15 x 15 pixels: an elliptical Gaussian by least squares."""
    from photutils.centroids import centroid_2dg

    near = region.narrowed()
    if near is None:
        return Spot.missing("no spot")
    u, v = (float(x) for x in centroid_2dg(_above(near)))
    return _spot_in_window(near, u, v)


def trackpy_refine(region: SearchRegion) -> Spot:
    """`trackpy.refine_com` on `_laser_in` of 15 x 15 pixels: centroid in a disc of 7 pixels, moved until it is central.

    Trackpy's own search wants whole numbers; the start is the red peak.
    """
    from trackpy import refine_com

    near = region.narrowed()
    if near is None:
        return Spot.missing("no spot")
    image = np.maximum(_above(near), 0.0)
    middle = np.array([[image.shape[0] // 2, image.shape[1] // 2]])
    table = refine_com(image, image, TRACKPY_DIAMETER_PX // 2, middle, pos_columns=["v", "u"], engine="python")
    return _spot_in_window(near, float(table["u"].iloc[0]), float(table["v"].iloc[0]))


def _above(near: SearchRegion) -> Array:
    """Laser's light over the median of the window's border; scaled, because a fit's tolerances are absolute."""
    red = _laser_in(near)
    edge = np.concatenate([red[0], red[-1], red[1:-1, 0], red[1:-1, -1]])
    above = red - np.median(edge)
    return np.asarray(above / max(float(above.max()), 1e-12))  # nothing above the border stays 0


def _laser_in(near: SearchRegion) -> Array:
    """Red plane of on - off; the redness where there is no laser-off frame."""
    return redness(near.planes) if near.off_pixels is None else _added(near)


def _spot_in_window(near: SearchRegion, u: float, v: float) -> Spot:
    """Answer for a position in the window."""
    if not (0.0 <= u <= near.box.width_px - 1.0 and 0.0 <= v <= near.box.height_px - 1.0):
        return Spot.missing("spot cut")
    return Spot((u + near.box.u0_px, v + near.box.v0_px))


def detected_spots(pair: Pair) -> Answer:
    """Position of the matched filter's peak, refined by a parabola, in both images."""
    detections = detected(pair)
    return Answer(_detected_spot(detections.down), _detected_spot(detections.up))


def _detected_spot(found: Detection | None) -> Spot:
    return Spot.missing("no spot found") if found is None else Spot(found.uv_px)
