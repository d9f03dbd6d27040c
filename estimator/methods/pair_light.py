"""Helpers of a user's own method: light of the laser in a pair's images, masks of mirror and lamps, and the noise.

>>> import numpy as np
>>> from phibench.estimator.interface import Answer, Pair, Spot
>>> from phibench.estimator.methods.pair_light import laser_light, lamp_mask, mirror_mask
>>> def find(pair: Pair, position: str) -> Spot:
...     inside = mirror_mask(pair, position) & ~lamp_mask(pair, position)
...     light = np.where(inside, laser_light(pair, position), -np.inf)
...     v, u = np.unravel_index(np.argmax(light), light.shape)
...     return Spot((float(u), float(v)))
>>> def extract(pair: Pair) -> Answer:
...     return Answer(find(pair, "down"), find(pair, "up"))

`position` is "down" or "up". Arrays have the shape (H, W) of the images: integer (u, v) are pixel centres, u along the
columns, v along the rows, and `light[v, u]` is the light of a pixel. Every output of a camera is taken.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter, maximum_filter

from phibench.estimator.interface import Box, Pair
from phibench.estimator.spots.detect import outline_mask
from phibench.estimator.spots.image_planes import linear_planes, redness
from phibench.scenes.frames import Array, BoolArray

LAMP_LEVEL = 3.0  # times the median light in the mirror
LEAST_LAMP = 0.06  # of full scale: what a spot of full scale and 1 px blur keeps when it is smoothed, 1 / (1 + 4^2)
LAMP_BLUR_PX = 4.0  # more than a spot's blur: it is spread, a lamp is not
LAMP_MARGIN_PX = 12  # a JPEG's block of 8 px and half of its neighbour
SIGMA_OF_MAD = 1.4826  # standard deviation of a normal law over its median absolute deviation


def mirror_mask(pair: Pair, position: str | None = None) -> BoolArray:
    """Pixels in which the spot may be, shape (H, W): those inside the mirror's outline.

    Outside of it there is the room itself, in which a lamp may be redder than the spot.

    Parameters
    ----------
    position : "down" or "up", optional
        Image whose box narrows the mask, where the pair has boxes. Without it the mask is that of both images: camera
        and mirror move together.
    """
    height, width = pair.down.shape[:2]
    inside = outline_mask(pair.rig, Box(0, 0, width, height))
    box = None if position is None else getattr(pair, f"box_{position}")
    if box is None:
        return inside
    hinted = np.zeros_like(inside)
    hinted[box.slices] = inside[box.slices]
    return hinted


def laser_light(pair: Pair, position: str) -> Array:
    """Red light that the laser adds to an image, shape (H, W), in linear units of full scale 1.

    With a laser-off frame it is on - off of the red plane. Without one it is the redness R - max(G, B), or, of pixels
    without colour filters, the image itself.
    """
    off = pair.images.get(f"{position}_off")
    on = linear_planes(pair.images[position], pair.card)
    return redness(on) if off is None else np.asarray(on[0] - linear_planes(off, pair.card)[0])


def lamp_mask(pair: Pair, position: str) -> BoolArray:
    """Lamps, sunlit walls and what is near to them, shape (H, W), bool.

    Their noise and the errors of JPEG at their edges look like spots in on - off. They are the areas of more than 3
    times the median light in the mirror, and of 6 % of full scale at least: in a dark room nothing is a lamp. 12 px
    around them are masked, too. The light is the red one of the laser-off frame, or of the image where there is none,
    smoothed over 4 px.
    """
    image = pair.images.get(f"{position}_off", pair.images[position])
    red = linear_planes(image, pair.card)[0]
    usual = float(np.median(red[mirror_mask(pair)]))
    bright = gaussian_filter(red, LAMP_BLUR_PX) > max(LAMP_LEVEL * usual, LEAST_LAMP)
    return np.asarray(maximum_filter(bright, 2 * LAMP_MARGIN_PX + 1))


def noise_of(light: Array, inside: BoolArray) -> float:
    """Standard deviation of the light of some pixels, from the median absolute deviation: a spot does not change it.

    Parameters
    ----------
    light : shape (H, W)
        Such as `laser_light`, or a filtered one.
    inside : shape (H, W), bool

    Returns
    -------
    float
        In the unit of `light`; NaN where `inside` holds no pixel.
    """
    there = light[inside]
    return SIGMA_OF_MAD * float(np.median(np.abs(there - np.median(there)))) if there.size else float("nan")
