"""Panorama of a view, azimuth by elevation: grid, its image pixels by model or by truth layer, and the view's picture.

A sphere has no single viewpoint: every ray leaves it from another place. So a grid point stands for a direction (a
scene far away, exactly one pixel), or for a point at a stated distance from the sphere centre. Elevation is spaced
evenly, in steps of the columns' angle: squares at the horizon.

Two ways lead to the pixels of a grid. `pixels_by_model` uses the closed form. `pixels_by_truth` uses no model of the
mirror: it searches the directions of a data set's truth layer.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.read import Sample
from phibench.datasets.store.pictures import display_exposure_s, to_srgb
from phibench.estimator.geometry.mirror_geometry import geometry_of
from phibench.estimator.geometry.reflection import image_of
from phibench.scenes.frames import Array
from phibench.scenes.rig import POSITIONS, View
from phibench.scenes.validation import nearest

FAR_M = 1e9  # a far scene: 60 mm of mirror at this distance are 6e-11 rad
_AT_ONCE = 32768  # directions: arrays of a MB or so stay in the cache
_WIDTHS = (16, 16384)  # columns that are allowed: 16384 are a degree in 46 parts


@dataclass(frozen=True)
class PanoramaGrid:
    """Directions of a panorama's pixels, seen from inside: left edge behind the robot, middle its front (world x).

    Column j has the azimuth pi - (j + 1/2) step from world x towards y, row i the elevation high - (i + 1/2) step, with
    step = 2 pi / width.

    Parameters
    ----------
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

    def directions(self, rows: slice = slice(None)) -> Array:
        """Unit vectors of all rows or some, shape (H, W, 3), world."""
        turn, up = self.azimuths_rad[None, :], self.elevations_rad[rows, None]
        flat = np.cos(up)
        return np.stack(np.broadcast_arrays(flat * np.cos(turn), flat * np.sin(turn), np.sin(up)), axis=-1)

    def place(self, directions: Array) -> Array:
        """Column and row, shape (..., 2), of directions (..., 3) of any length; columns in [-1/2, W - 1/2)."""
        d = np.asarray(directions, float)
        column = (math.pi - np.arctan2(d[..., 1], d[..., 0])) / self.step_rad - 0.5
        elevation = np.arctan2(d[..., 2], np.hypot(d[..., 0], d[..., 1]))
        return np.stack([column, (self.high_rad - elevation) / self.step_rad - 0.5], axis=-1)


def pixels_by_model(view: View, grid: PanoramaGrid, distance_m: float = FAR_M) -> Array:
    """Image pixel (u, v) of every grid point, shape (H, W, 2), by the closed form; NaN where the image shows it not.

    Parameters
    ----------
    view : View
        Of the nominal rig.
    grid : PanoramaGrid
    distance_m : float
        Of the scene from the sphere centre.
    """
    if not distance_m > view.rig.mirror.bound_m:
        raise DatasetError(f"distance of the scene = {distance_m:g} m: must be above the mirror's radius")
    points = (view.sphere_centre_m + distance_m * grid.directions()).reshape(-1, 3)
    parts = [image_of(view, points[i : i + _AT_ONCE]).uv_px for i in range(0, len(points), _AT_ONCE)]
    uv = np.concatenate(parts)
    uv[~view.rig.camera.contains(uv)] = np.nan
    return uv.reshape(grid.height_px, grid.width_px, 2)


def unrolled_values(image: NDArray[np.generic], uv_px: Array) -> Array:
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
    planes = np.asarray(image) if image.dtype.kind == "f" else np.asarray(image, float)  # a large float32 stays one
    stacked = planes[..., None] if planes.ndim == 2 else planes
    each = [
        map_coordinates(stacked[..., k], (where[..., 1], where[..., 0]), order=1, mode="nearest")
        for k in range(stacked.shape[-1])
    ]
    result = np.where(seen[..., None], np.stack(each, axis=-1), np.nan)
    return result[..., 0] if planes.ndim == 2 else result


# -- pixels by the truth layer -----------------------------------------------------------------------------------------
#
# The truth has, for every pixel, the outward normal and the world point X that it sees. The normal tells the place P at
# which the ray leaves the mirror: S + R n on a sphere, and the radius with that slope on a mirror of revolution. The
# direction is (X - P) / |X - P|. For every grid point the pixel with the nearest direction is looked up.
# Differences over its 3 x 3 neighbours give the step to the place between pixels. A mirror with an error of form counts
# as its sphere here: at a peak of 50 um P is off by as much, and the place by 0.014 px.

_ROUNDS = 4
_REACH_PX = 1.5  # the place must be within reach of the nearest pixel's neighbours


def ray_directions(truth: Mapping[str, NDArray[Any]], view: View) -> Array:
    """Unit vectors of the rays that leave the mirror, shape (H, W, 3), from a truth layer; NaN beside the mirror.

    Raises
    ------
    DatasetError
        If the mirror is a cone.
    """
    angle, turn = truth["phi_normal_rad"], truth["azimuth_rad"]
    n = np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), -np.cos(angle)], axis=-1)
    places = geometry_of(view.rig.mirror).place_of_normal(n, view.T_world_sphere)
    away = np.stack([truth[name] for name in ("x_m", "y_m", "z_m")], axis=-1) - places
    return np.asarray(away / np.linalg.norm(away, axis=-1, keepdims=True))


def pixels_by_truth(directions: Array, grid: PanoramaGrid) -> Array:
    """Image pixel (u, v) of every grid point, shape (H, W, 2), from `ray_directions`; NaN where no pixel shows it."""
    inner = np.zeros(directions.shape[:2], bool)
    inner[1:-1, 1:-1] = _with_neighbours(directions)
    v, u = np.nonzero(inner)
    if v.size == 0:
        return np.full((grid.height_px, grid.width_px, 2), np.nan)
    wanted = grid.directions().reshape(-1, 3)
    _, nearest = cKDTree(directions[v, u]).query(wanted)
    step = _steps(directions, v[nearest], u[nearest], wanted)
    uv = np.stack([u[nearest], v[nearest]], axis=-1) + step
    uv[~(np.abs(step) < _REACH_PX).all(axis=-1)] = np.nan
    return uv.reshape(grid.height_px, grid.width_px, 2)


def _with_neighbours(directions: Array) -> NDArray[np.bool_]:
    seen = np.asarray(np.isfinite(directions).all(axis=-1))
    shifts = [slice(0, -2), slice(1, -1), slice(2, None)]
    return np.logical_and.reduce([seen[rows, columns] for rows in shifts for columns in shifts])


def _steps(r: Array, v: NDArray[np.intp], u: NDArray[np.intp], wanted: Array) -> Array:
    """Steps (du, dv), shape (n, 2), at which the quadratic through the neighbours has the wanted direction."""
    here, left, right, above, below = r[v, u], r[v, u - 1], r[v, u + 1], r[v - 1, u], r[v + 1, u]
    by_u, by_v = 0.5 * (right - left), 0.5 * (below - above)
    uu, vv = right - 2.0 * here + left, below - 2.0 * here + above
    # mixed derivative by central differences
    uv = 0.25 * (r[v + 1, u + 1] - r[v + 1, u - 1] - r[v - 1, u + 1] + r[v - 1, u - 1])
    step = np.zeros((len(v), 2))
    for _ in range(_ROUNDS):
        a, b = step[:, :1], step[:, 1:]
        model = here + a * by_u + b * by_v + 0.5 * (a * a * uu + b * b * vv) + a * b * uv
        slope = np.stack([by_u + a * uu + b * uv, by_v + b * vv + a * uv], axis=-1)
        normal = np.swapaxes(slope, -1, -2)
        step = step + np.linalg.solve(normal @ slope, normal @ (wanted - model)[..., None])[..., 0]
        step = np.clip(step, -2.0 * _REACH_PX, 2.0 * _REACH_PX)
    return step


# -- panorama of a sample ----------------------------------------------------------------------------------------------

LAYERS = "layers"
COLOUR_PRESETS = (LAYERS, "srgb8", "mjpeg")
By = Literal["model", "truth"]


@dataclass(frozen=True)
class Panorama:
    """A panorama.

    Attributes
    ----------
    pixels : uint8 array, shape (H, W, 3), sRGB; black where the image shows nothing of it
    seen : float
        Part of it that the image shows.
    """

    pixels: NDArray[np.uint8] = field(repr=False)
    seen: float


def panorama(
    sample: Sample,
    position: str,
    grid: PanoramaGrid,
    by: By = "model",
    distance_m: float = FAR_M,
    image: Array | None = None,
) -> Panorama:
    """Unroll a picture, shape (h, w, 3), uint8, or the noise-free view with the laser on."""
    picture = view_picture(sample, position) if image is None else image
    height, width = sample.nominal_rig.camera.height_px, sample.nominal_rig.camera.width_px
    if picture.shape[:2] != (height, width):
        raise DatasetError(
            f"the picture has {picture.shape[1]} x {picture.shape[0]} pixels, the rig's camera {width} x {height}: "
            "give a whole frame of this camera"
        )
    values = unrolled_values(picture, grid_pixels(sample, position, grid, by, distance_m))
    seen = np.isfinite(values[..., 0])
    return Panorama(np.rint(np.where(seen[..., None], values, 0.0)).astype(np.uint8), float(seen.mean()))


def grid_pixels(
    sample: Sample, position: str, grid: PanoramaGrid, by: By = "model", distance_m: float = FAR_M
) -> Array:
    """Image pixel of every grid point, shape (H, W, 2), by the nominal rig or by the truth layer of the true one."""
    if by == "model":
        return pixels_by_model(nominal_view(sample, position), grid, distance_m)
    if distance_m != FAR_M:
        raise DatasetError("a distance of the scene needs the model (--by model): the truth layer gives directions")
    return pixels_by_truth(ray_directions(sample.truth(position), sample.view(position)), grid)


def nominal_view(sample: Sample, position: str) -> View:
    """View of the nominal rig."""
    return sample.nominal_rig.at(0.0 if position == "down" else sample.row.nominal_stroke_m)


def view_picture(sample: Sample, position: str, preset: str = LAYERS) -> NDArray[Any]:
    """Colour picture of the view, laser on, shape (h, w, 3), uint8.

    Parameters
    ----------
    position : "down" or "up"
    preset : "layers" (noise-free), "srgb8" or "mjpeg"

    Raises
    ------
    DatasetError
        If there is no such position or colour picture.
    """
    if position not in POSITIONS:
        raise DatasetError(f"position '{position}': must be 'down' or 'up'")
    if preset not in COLOUR_PRESETS:
        raise DatasetError(f"no colour picture of preset '{preset}'; {nearest(preset, COLOUR_PRESETS)}")
    if preset == LAYERS:
        planes, detector = sample.expected_image(position), sample.rig.camera.detector
        return to_srgb(planes, detector, display_exposure_s(sample.ambient(position), detector))
    return np.asarray(sample.frame_source(preset).frame(position, 0, True).image)
