"""Upright edges of a room in a panorama: where they must be, and their place, lean and scatter as they are seen."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from phibench.estimator.geometry.panorama import PanoramaGrid
from phibench.estimator.geometry.reflection import image_of, reflect
from phibench.scenes.frames import Array
from phibench.scenes.rig import View
from phibench.scenes.room import Room
from phibench.scenes.shapes import Cuboid, Rectangle, Shape, faces

_HALF_WIDTH_PX = 6  # of a row's window: its outer columns are beside the blurred edge
_LEVEL_PX = 2  # columns at each end of a row's window that give the levels beside the edge
_LEAST_CONTRAST = 0.15  # difference of the levels over their mean
_LEAST_ROWS = 8
_TRIMMED = 0.3  # of the height, at both ends: what stands before its foot, and what is above it
_TRACK = 65  # points of an edge: its image hardly bends between two


@dataclass(frozen=True)
class RoomEdge:
    """A vertical edge of the room: a line from `low_m` to `high_m`, shape (3,) each, world."""

    name: str
    low_m: Array
    high_m: Array


@dataclass(frozen=True)
class SeenEdge:
    """An edge in a panorama.

    Attributes
    ----------
    lean_px, lean_sigma_px : float
        Columns by which the line through the measured places moves from its lowest to its highest row, to the left
        positive (towards larger azimuths), and the standard error from the scatter about the line.
    expected_lean_px : float
        The same of the places where the edge must be.
    offset_px : float
        Mean column less that.
    scatter_px : float
        Rms distance of the places from the line, in columns.
    """

    name: str
    azimuth_deg: float
    rows: int
    lean_px: float
    lean_sigma_px: float
    expected_lean_px: float
    offset_px: float
    scatter_px: float


def vertical_edges(room: Room, names: tuple[str, ...]) -> Iterator[RoomEdge]:
    """Both upright edges of the faces of shapes, by name; of a solid, of the face that looks at the world's z axis."""
    shapes: tuple[Shape, ...] = (*room.surfaces, *room.furniture)
    for shape in shapes:
        if shape.name not in names or not isinstance(shape, Rectangle | Cuboid):
            continue
        face = min(faces(shape), key=lambda each: float(np.dot(each.T_world_shape.R[:, 2], each.T_world_shape.t)))
        width, height = face.size_m
        for side in (-0.5, 0.5):
            ends = [face.T_world_shape.points(np.array([side * width, end * height, 0.0])) for end in (-0.5, 0.5)]
            low, high = sorted(ends, key=lambda point: float(point[2]))
            yield RoomEdge(f"{shape.name} {'left' if side < 0.0 else 'right'}", low, high)


def track(true_view: View, nominal_view: View, grid: PanoramaGrid, edge: RoomEdge) -> Array:
    """Columns and rows, shape (n, 2), bottom to top, of an edge that one rig sees and another one unrolls."""
    share = np.linspace(0.0, 1.0, _TRACK)[:, None]
    uv = image_of(true_view, (1.0 - share) * edge.low_m + share * edge.high_m).uv_px
    places = grid.place(reflect(nominal_view, uv).direction_world)
    places[:, 0] = np.unwrap(places[:, 0], period=grid.width_px)
    return places


def seen_edge(panorama: Array, grid: PanoramaGrid, name: str, expected_px: Array) -> SeenEdge | None:
    """Measure an edge; None where it has too little contrast or too few rows.

    In each row the levels beside the edge are the means of the outer columns of a window; between them the edge is
    where a sharp step of the same sum would be (moments are kept: A. J. Tabatabai and O. R. Mitchell, IEEE Trans. PAMI
    6, 188, 1984), which no symmetric blur moves.

    Parameters
    ----------
    panorama : shape (H, W), linear in the light
    grid : PanoramaGrid
    expected_px : shape (n, 2), see `track`
    """
    (bottom, top), trim = expected_px[[0, -1], 1], _TRIMMED * float(expected_px[0, 1] - expected_px[-1, 1])
    rows = np.arange(max(int(np.ceil(top + trim)), 0), min(int(np.floor(bottom - trim)) + 1, grid.height_px))
    if len(rows) < _LEAST_ROWS:
        return None
    predicted = np.interp(rows, expected_px[::-1, 1], expected_px[::-1, 0])
    start = np.rint(predicted).astype(int) - _HALF_WIDTH_PX
    window = (start[:, None] + np.arange(2 * _HALF_WIDTH_PX + 1)) % grid.width_px
    places = start - 0.5 + _step_place(panorama[rows[:, None], window])
    good = np.isfinite(places)
    if np.count_nonzero(good) < _LEAST_ROWS:
        return None
    heights = rows[good].astype(float)
    lean, sigma, scatter = _line(heights, places[good])
    middle = float(predicted.mean())
    return SeenEdge(
        name,
        float(np.degrees(grid.azimuths_rad[0] - middle * grid.step_rad)),
        int(good.sum()),
        lean,
        sigma,
        _line(heights, predicted[good])[0],
        float((places - predicted)[good].mean()),
        scatter,
    )


def _step_place(values: Array) -> Array:
    """Place of a step in each row (n, w), columns from the window's left side; NaN where there is none."""
    left, right = values[:, :_LEVEL_PX].mean(axis=1), values[:, -_LEVEL_PX:].mean(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        place = np.sum((right[:, None] - values) / (right - left)[:, None], axis=1)
    clear = np.abs(right - left) > _LEAST_CONTRAST * 0.5 * (np.abs(left) + np.abs(right))
    inside = (place > _LEVEL_PX) & (place < values.shape[1] - _LEVEL_PX)
    return np.where(clear & inside, place, np.nan)


def _line(rows: Array, places: Array) -> tuple[float, float, float]:
    """Lean over all rows, its standard error, and the scatter about the line."""
    x = rows - rows.mean()
    slope = float(np.sum(x * places) / np.sum(x * x))
    rest = places - places.mean() - slope * x
    scatter = float(np.sqrt(np.sum(rest**2) / max(len(rows) - 2, 1)))
    height = float(np.ptp(rows))
    # rows run downwards: a line that leans to the left with height has a column that grows with the row
    return slope * height, scatter / float(np.sqrt(np.sum(x * x))) * height, scatter
