"""A view unrolled: columns are azimuths and rows elevations of the rays that leave the mirror.

A sphere has no single viewpoint: rays of one azimuth and elevation leave it from a place that only they have. A grid
point therefore stands for a direction (a scene far away, exactly one pixel), or for a point at a stated distance from
the sphere centre. Elevation is spaced evenly, in steps of the columns' angle: squares at the horizon.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from phibench.datasets.errors import DatasetError
from phibench.estimator.mirror_image import image_of
from phibench.scenes.frames import Array
from phibench.scenes.rig import View

FAR_M = 1e9  # a far scene: 60 mm of mirror at this distance are 6e-11 rad
_AT_ONCE = 32768
_WIDTHS = (16, 16384)


@dataclass(frozen=True)
class Grid:
    """Directions of a panorama's pixels, seen from inside: left edge behind the robot, middle its front (world x).

    Column j has the azimuth pi - (j + 1/2) step from world x towards y, row i the elevation high - (i + 1/2) step, with
    step = 2 pi / width.

    Parameters
    ----------
    width_px : int
    low_rad, high_rad : float
        Elevations above the horizon of the lower and the upper edge; the lower moves to a whole number of rows.

    Raises
    ------
    DatasetError
        If a number is out of range.
    """

    width_px: int
    low_rad: float
    high_rad: float

    def __post_init__(self) -> None:
        if not _WIDTHS[0] <= self.width_px <= _WIDTHS[1]:
            raise DatasetError(
                f"width of the panorama = {self.width_px} px: allowed range is {_WIDTHS[0]} to {_WIDTHS[1]}"
            )
        low, high = math.degrees(self.low_rad), math.degrees(self.high_rad)
        if not -90.0 <= low < high <= 90.0 or self.height_px < 1:
            raise DatasetError(
                f"elevations {low:g} to {high:g} degrees: give two numbers from -90 to 90, the lower one first and "
                f"at least {math.degrees(self.step_rad):.2g} degrees apart"
            )

    @property
    def step_rad(self) -> float:
        """Angle of a pixel."""
        return 2.0 * math.pi / self.width_px

    @property
    def height_px(self) -> int:
        """Rows."""
        return round((self.high_rad - self.low_rad) / self.step_rad)

    @property
    def azimuths_rad(self) -> Array:
        """Of the columns, shape (W,), falling from pi to -pi."""
        return np.asarray(math.pi - (np.arange(self.width_px) + 0.5) * self.step_rad, float)

    @property
    def elevations_rad(self) -> Array:
        """Of the rows, shape (H,), falling."""
        return np.asarray(self.high_rad - (np.arange(self.height_px) + 0.5) * self.step_rad, float)

    def directions(self) -> Array:
        """Unit vectors, shape (H, W, 3), world."""
        turn, up = self.azimuths_rad[None, :], self.elevations_rad[:, None]
        flat = np.cos(up)
        return np.stack(np.broadcast_arrays(flat * np.cos(turn), flat * np.sin(turn), np.sin(up)), axis=-1)

    def place(self, directions: Array) -> Array:
        """Column and row, shape (..., 2), of directions (..., 3) of any length; columns in [-1/2, W - 1/2)."""
        d = np.asarray(directions, float)
        column = (math.pi - np.arctan2(d[..., 1], d[..., 0])) / self.step_rad - 0.5
        elevation = np.arctan2(d[..., 2], np.hypot(d[..., 0], d[..., 1]))
        return np.stack([column, (self.high_rad - elevation) / self.step_rad - 0.5], axis=-1)


def pixels_by_model(view: View, grid: Grid, distance_m: float = FAR_M) -> Array:
    """Image pixel (u, v) of every grid point, shape (H, W, 2), by the closed form; NaN where the image shows it not.

    Parameters
    ----------
    view : View
        Of the rig that is believed.
    grid : Grid
    distance_m : float
        Of the scene from the sphere centre.
    """
    if not distance_m > view.rig.mirror.radius_m:
        raise DatasetError(f"distance of the scene = {distance_m:g} m: must be above the mirror's radius")
    points = (view.sphere_centre_m + distance_m * grid.directions()).reshape(-1, 3)
    parts = [image_of(view, points[i : i + _AT_ONCE]).uv_px for i in range(0, len(points), _AT_ONCE)]
    uv = np.concatenate(parts)
    uv[~view.rig.camera.contains(uv)] = np.nan
    return uv.reshape(grid.height_px, grid.width_px, 2)


def unrolled(image: NDArray[np.generic], uv_px: Array) -> Array:
    """Image values at pixels, bilinear between the four around each; NaN where the pixel is.

    Parameters
    ----------
    image : shape (h, w) or (h, w, c)
    uv_px : shape (H, W, 2)

    Returns
    -------
    array, shape (H, W) or (H, W, c)
    """
    seen = np.asarray(np.isfinite(uv_px).all(axis=-1))
    where = np.where(seen[..., None], uv_px, 0.0)
    planes = np.asarray(image, float)
    stacked = planes[..., None] if planes.ndim == 2 else planes
    each = [
        map_coordinates(stacked[..., k], (where[..., 1], where[..., 0]), order=1, mode="nearest")
        for k in range(stacked.shape[-1])
    ]
    result = np.where(seen[..., None], np.stack(each, axis=-1), np.nan)
    return result[..., 0] if planes.ndim == 2 else result
