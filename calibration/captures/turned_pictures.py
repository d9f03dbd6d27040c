"""Pictures of a pair that are mirrored or turned against each other, told by the room around the mirror.

The stroke is upright: a wall or lamp keeps its bearing from down to up, and its place in the mirror moves inwards or
outwards only. So the light of both pictures over the bearing, the mean over the radii, is alike. Of a picture that was
mirrored or turned it is alike after it is turned back.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter, gaussian_filter1d, map_coordinates

from phibench.calibration.captures.picture_files import Photo
from phibench.calibration.outline.first_circle import rig_circle
from phibench.datasets.common.errors import DatasetError
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig

_SIDE_PX = 360  # short side of a picture that is small enough
_SMOOTH_PX, _BEARINGS, _RADII = 1.5, 360, np.linspace(0.35, 0.93, 24)  # radii over that of the outline
_WIDE, _REACH = 30, 4  # degrees: what is wider is no feature; by what a rig may turn
_ALIKE, _LEAD = 0.5, 0.3  # correlation of a picture turned back, and what it has over that of the picture as it is
_DARKEST = 1e-3  # of the brightest, of which the logarithm is taken
_LEAST_RADIUS_PX = 15.0


@dataclass(frozen=True)
class _Turn:
    """A way in which a picture may be stored, in words, and what turns it back."""

    words: str
    back: Callable[[Array], Array]


_TURNS = (
    _Turn("mirrored left to right", lambda x: x[:, ::-1]),
    _Turn("mirrored top to bottom", lambda x: x[::-1]),
    _Turn("turned by 180 degrees", lambda x: x[::-1, ::-1]),
)
_OF_SQUARES = (
    _Turn("turned by 90 degrees", lambda x: np.rot90(x, 1)),
    _Turn("turned by 90 degrees", lambda x: np.rot90(x, -1)),
    _Turn("mirrored at a diagonal", lambda x: np.swapaxes(x, 0, 1)),
    _Turn("mirrored at a diagonal", lambda x: np.rot90(x, 2).swapaxes(0, 1)),
)


def require_alike(pictures: Sequence[tuple[Photo, Photo]], rig: Rig) -> None:
    """Refuse pictures that are mirrored or turned against each other.

    Parameters
    ----------
    pictures : pairs of pictures of one room from one axis
    rig : Rig
        Where the mirror is in them.

    Raises
    ------
    DatasetError
        In one sentence: which, how, and how alike they are turned back.
    """
    circle = rig_circle(rig)
    if not _LEAST_RADIUS_PX < circle[2] < math.hypot(rig.camera.width_px, rig.camera.height_px):
        return
    for first, second in pictures:
        as_it_is, turned, words = _likeness(_small(first), _small(second), circle, first.size_px)
        if turned >= _ALIKE and turned - as_it_is >= _LEAD:
            raise DatasetError(
                f"{second.path} is {words} against {first.path}: the room around the mirror is alike when it is turned "
                f"back (correlation {turned:.2f}), and as it is not ({as_it_is:.2f}); give all pictures of a pair as "
                "the camera delivers them"
            )


def _likeness(
    one: Array, other: Array, circle: tuple[float, float, float], size_px: tuple[int, int]
) -> tuple[float, float, str]:
    """Correlation of both pictures, the largest of a turned one, and its words."""
    u, v, radius = (x * one.shape[0] / size_px[1] for x in circle)
    turns = (*_TURNS, *(_OF_SQUARES if one.shape[0] == one.shape[1] else ()))
    by_bearing = _by_bearing(one, (u, v, radius))
    likeness = [(_correlation(by_bearing, _by_bearing(turn.back(other), (u, v, radius))), turn) for turn in turns]
    best, turn = max(likeness, key=lambda each: each[0])
    return _correlation(by_bearing, _by_bearing(other, (u, v, radius))), best, turn.words


def _small(photo: Photo) -> Array:
    """Logarithm of a picture's codes in squares, shape (H, W, C); of a mosaic's, whose phase is not known, the mean."""
    x = np.asarray(photo.pixels, np.float32)
    x = x[..., :1] if photo.kind == "yuyv" else x if x.ndim == 3 else x[..., None]
    block = max(1 if photo.kind != "raw" else 2, min(x.shape[:2]) // _SIDE_PX)
    height, width = (size // block for size in x.shape[:2])
    squares = x[: height * block, : width * block].reshape(height, block, width, block, -1).mean(axis=(1, 3))
    smooth = gaussian_filter(squares, (_SMOOTH_PX, _SMOOTH_PX, 0.0))
    return np.asarray(np.log(np.maximum(smooth, _DARKEST * max(float(smooth.max()), 1e-9))))


def _by_bearing(picture: Array, circle: tuple[float, float, float]) -> Array:
    """Mean over the radii, without what is wide; shape (C, bearings)."""
    (u, v, radius), bearing = circle, 2.0 * math.pi * np.arange(_BEARINGS) / _BEARINGS
    r = radius * _RADII[:, None]
    places = [v + r * np.sin(bearing), u + r * np.cos(bearing)]
    rings = [map_coordinates(picture[..., c], places, order=1, mode="nearest") for c in range(picture.shape[2])]
    means = np.mean(rings, axis=1)
    return np.asarray(means - gaussian_filter1d(means, _WIDE, axis=1, mode="wrap"))


def _correlation(a: Array, b: Array) -> float:
    """Largest correlation over the turns of a rig."""
    norm = math.sqrt(float(np.sum(a**2) * np.sum(b**2)))
    return max(float(np.sum(a * np.roll(b, k, axis=1))) for k in range(-_REACH, _REACH + 1)) / max(norm, 1e-30)
