"""Where lamps are in an image: large bright areas, around which an edge, clipping or JPEG's ringing look like anything.

Bright is a multiple of the usual level; a spot, however strong, is small.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import label, maximum_filter

from phibench.datasets.sensor_card import SensorCard
from phibench.estimator.colour_planes import ColourPlanes
from phibench.scenes.frames import BoolArray

_BRIGHT = 3.0  # times the median inside the mirror
_LEAST_AREA_PX = 80
_HALO_PX = {True: 5, False: 12}  # of raw pixels; of processed ones, a JPEG's block and its neighbour's interpolation


def lamp_halo(planes: ColourPlanes, inside: BoolArray, card: SensorCard) -> BoolArray:
    """Lamps and what is near to them, shape (h, w)."""
    step = 2 if planes.mosaic else 1
    red = planes.values_e[0][::step, ::step]
    bright = (red > _BRIGHT * np.median(red[inside[::step, ::step]])) | planes.full[0][::step, ::step]
    areas, count = label(bright)
    large = np.bincount(areas.ravel(), minlength=count + 1) * step**2 >= _LEAST_AREA_PX
    large[0] = False
    lamps = np.repeat(np.repeat(large[areas], step, axis=0), step, axis=1)[: planes.shape[0], : planes.shape[1]]
    return np.asarray(maximum_filter(lamps, 2 * _HALO_PX[card.output == "raw"] + 1))
