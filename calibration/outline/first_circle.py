"""Grey picture of a rig's image, and circles of its mirror, predicted and seen; plain sphere fits to begin with.

The plain fits are biased: the steepest place of the light is not the limb, because light falls inside it and not
outside. They are the start of the fit of the light across the limb, and a comparison for it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from scipy import ndimage

from phibench.calibration.outline.ball_circle import BallCircle, possible_circles
from phibench.calibration.outline.edge_ring import Circle
from phibench.calibration.outline.limb_image import Plane
from phibench.estimator.spots.image_planes import ImageError
from phibench.scenes.camera import Camera
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig

_FEW, _CANDIDATES = 6, 12  # circles about the nominal size, and of all sizes
_NEAR = (0.95, 1.05)  # of the nominal rig's outline: looked at first
SIZES_LOOKED_FOR = (0.7, 1.4)  # of the nominal outline's: sizes that are looked at
_LEAST_RADIUS_PX = 30.0  # a smaller outline has too few pixels for its sectors
_LEVEL_PX = 1000  # rows and columns that are enough for a level
PICTURE_BLUR_PX2 = 0.5 + 1.0 / 6.0 + 1.0 / 12.0
"""Variance of the blur of `grey` besides the lens: the mosaic's mean, linear interpolation, the pixel."""


def grey(planes: tuple[Plane, ...]) -> Array:
    """One picture, shape (H, W), for edges: mosaic averaged away, level 1."""
    picture = planes[0].values
    if len(planes) == 3 and planes[0].values is not planes[1].values:
        picture = np.mean([plane.values for plane in planes], axis=0)
    elif len(planes) == 3:
        # each place has the same share of all three filters
        picture = ndimage.convolve(picture, np.outer([1, 2, 1], [1, 2, 1]) / 16.0, mode="mirror")
    every = max(1, max(picture.shape) // _LEVEL_PX)
    some = picture[::every, ::every]
    level = np.median(some[np.isfinite(some)]) if np.isfinite(some).any() else 0.0
    if not level > 0.0:
        raise ImageError("an image without a mirror: it is dark")
    return np.nan_to_num(picture / level)


def circles_by_size(picture: Array, rig: Rig) -> Iterator[Iterator[BallCircle]]:
    """Circles of a picture, the clearest first: those of about the size that the rig says, then those of all sizes.

    A holder's plates are clear circles, too, and circles of tiles and lamps in the mirror may be clearer than the
    mirror's own; the fit of the light across them tells which is which.
    """
    low, high = radii_px(rig)
    near = (low * _NEAR[0] / SIZES_LOOKED_FOR[0], high * _NEAR[1] / SIZES_LOOKED_FOR[1])
    return (possible_circles(picture, radii, count) for radii, count in ((near, _FEW), ((low, high), _CANDIDATES)))


def radii_px(rig: Rig) -> tuple[float, float]:
    """Least and largest radius of the outline that is looked for, pixels.

    Raises
    ------
    ImageError
        If no such outline can be seen in the rig's image.
    """
    camera, radius = rig.camera, rig_circle(rig)[2]
    largest = math.hypot(camera.width_px, camera.height_px)
    if not _LEAST_RADIUS_PX <= radius <= largest:
        raise ImageError(
            f"focal length, mirror radius and distance of the rig give an outline with a radius of {radius:.0f} px, in "
            f"an image of {camera.width_px} x {camera.height_px}: check these numbers, {_LEAST_RADIUS_PX:.0f} to "
            f"{largest:.0f} px can be measured"
        )
    return SIZES_LOOKED_FOR[0] * radius, SIZES_LOOKED_FOR[1] * radius


def rig_circle(rig: Rig) -> Circle:
    """Middle (u, v) and mean radius, pixels, of the outline that a rig gives."""
    outline = rig.outline_px()
    u, v = outline.mean(axis=0)
    return float(u), float(v), 0.5 * float(np.ptp(outline, axis=0).mean())


def sphere_from_circle(circle: Circle, camera: Camera, radius_m: float) -> Array:
    """Sphere centre as the plain circle has it: its centre's ray, and |s| = R / sin(radius / f)."""
    u, v, radius = circle
    f = np.sqrt(camera.fx_px * camera.fy_px)
    return np.asarray(camera.rays(np.array([u, v])) * radius_m / np.sin(np.arctan(radius / f)))


def sphere_from_rays(rays: Array, radius_m: float) -> Array:
    """Sphere centre, shape (3,), whose limb rays, shape (n, 3), are nearest: ray . s = |s| cos a0 for all of them."""
    x = np.linalg.lstsq(rays, np.ones(len(rays)), rcond=None)[0]  # x = n / cos a0
    cosine = 1.0 / np.linalg.norm(x)
    if not cosine < 1.0:
        raise ImageError("an image without a mirror: the edges found are no sphere's outline")
    return np.asarray(x * cosine * radius_m / np.sqrt((1.0 - cosine) * (1.0 + cosine)))
