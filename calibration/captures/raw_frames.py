"""Tests of a pair's raw frames: Bayer phase from the laser spots, and correlation of noise between neighbouring pixels.

A phase (du, dv) puts red where u + du and v + dv are even: 1 for 0 in a sensor that is read out mirrored.

Laser on less laser off is noise, but for the spot. Raw noise is not alike in neighbours. In frames that were smoothed,
sharpened, shrunk or compressed it is, and the spot's light lies on pixels of other filters, too.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.ndimage import gaussian_filter

from phibench.estimator.interface import Image
from phibench.scenes.frames import Array
from phibench.scenes.rig import POSITIONS

Phase = tuple[int, int]
PATTERNS: Mapping[Phase, str] = {(0, 0): "RGGB", (1, 0): "GRBG", (0, 1): "GBRG", (1, 1): "BGGR"}
"""Colours of the first two rows of two pixels, by the phase."""

_RED_RATIO = 2.5  # of a spot's light on the brightest of four places over the next, from which on that is red
_NO_FILTERS = 2.0  # of the brightest over the faintest, below which there are no filters
_SPOT_SIGMAS = 12.0  # a spot that tells its filter is far beyond what a map of a million places has by chance


def raw_phase(images: Mapping[str, Image]) -> Phase | str | None:
    """Phase of a mosaic by the colour of its spots; "mono" where there are no filters; None where it cannot be told.

    Parameters
    ----------
    images : mapping of "down", "up" and, where they are there, "down_off", "up_off" to DN, shape (H, W)
    """
    told = set()
    for position in POSITIONS:
        off = images.get(f"{position}_off")
        if off is None:
            return None
        told.add(_spot_phase(np.asarray(images[position], float), np.asarray(off, float)))
    return told.pop() if len(told) == 1 else None


def _spot_phase(on: Array, off: Array) -> Phase | str | None:
    light = on - off
    h, w = (size // 2 * 2 for size in light.shape)
    sums = light[:h, :w].reshape(h // 2, 2, w // 2, 2).sum(axis=(1, 3))
    match = gaussian_filter(sums, 1.0) - gaussian_filter(sums, 4.0)
    scatter = 1.4826 * float(np.median(np.abs(match)))
    v, u = np.unravel_index(int(np.argmax(match)), match.shape)
    if match[v, u] < _SPOT_SIGMAS * max(scatter, 1e-9):  # noise-free pictures scatter by nothing
        return None
    v0, u0 = (max(2 * int(x) - 4, 0) for x in (v, u))
    window = light[v0 : v0 + 10, u0 : u0 + 10]
    wide = light[max(v0 - 10, 0) : v0 + 20, max(u0 - 10, 0) : u0 + 20]
    places = {}
    for du, dv in PATTERNS:  # red at (u + du, v + dv) even; v0 and u0 are even
        places[du, dv] = float((window[dv::2, du::2] - np.median(wide[dv::2, du::2])).sum())
    first, second, *_, last = sorted(places, key=lambda place: -places[place])
    if places[first] > _RED_RATIO * places[second]:
        return first
    # pixels at the converter's end are as bright behind any filter
    cut = np.count_nonzero(on[v0 : v0 + 10, u0 : u0 + 10] == on.max()) > 2
    return "mono" if places[first] < _NO_FILTERS * places[last] and not cut else None


# -- noise -------------------------------------------------------------------------------------------------------------

MOST_LIKENESS = 0.05
"""Correlation of neighbours from which on DN are not raw: a million pixels tell 0.001."""
_NEAR, _FAR = ((0, 1), (1, 0), (1, 1), (0, 2), (2, 0)), (7, 7)
_CUT = 3.0  # standard deviations: the spot, and edges of a room that moved by a hair, count no more


def neighbour_likeness(images: Mapping[str, Image]) -> float:
    """Largest correlation of the noise of neighbours, laser on less laser off, less that of pixels far away.

    Parameters
    ----------
    images : as `raw_phase` has them; 0 without laser-off pictures
    """
    most = 0.0
    for position in POSITIONS:
        if (off := images.get(f"{position}_off")) is None:
            continue
        z = np.asarray(images[position], float) - np.asarray(off, float)
        for du, dv in PATTERNS:  # filters differ in noise
            site = z[dv::2, du::2]
            site -= np.median(site)
            site /= max(1.4826 * float(np.median(np.abs(site))), 0.5)
        z = np.clip(z, -_CUT, _CUT)
        white = max(float(np.square(z).mean()), 1e-9)
        far = _product(z, *_FAR)
        most = max([most, *(abs(_product(z, *lag) - far) / white for lag in _NEAR)])
    return most


def _product(z: Array, rows: int, columns: int) -> float:
    """Mean product of pixels so many rows and columns apart."""
    return float(np.mean(z[: z.shape[0] - rows, : z.shape[1] - columns] * z[rows:, columns:]))
