"""Edges across a circle in a picture, by turn and by distance from it; closed curves near it.

The light is taken as logarithm and colour differences, so that a step counts the same in the dark and in the bright.
What is sought is a curve r(t) = r0 + dr + du cos t + dv sin t + e1 cos 2t + e2 sin 2t: a circle that may move, and the
ellipse that a sphere beside the camera's axis has for an outline. A mirror ball shows the room: edges are everywhere,
and of either sign. The outline differs by being an edge nearly all around, which the room's edges are not.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from phibench.scenes.frames import Array, BoolArray

Circle = tuple[float, float, float]
TURNS = 360
REACH_PX = 14.0
_ALONG_PX = 5.0  # the room's own edges are rarely along the outline: averaged away
_SHARE = 0.7  # an edge of 0.7 times the rms of its turn has half of the full strength
_NOISE = 0.003  # of the logarithm: below it is no edge
_DARK = 0.02  # of the median: logarithms end there
_BESIDE_PX = (-9.0, -7.5, -6.0, -4.5, 4.5, 6.0, 7.5, 9.0)
_CORRELATED_PX = 10.0
_FEWEST_TURNS = TURNS // 12
PEAKS = 4
_LEAST_PEAK = 0.25


def log_colours(light: NDArray[Any]) -> Array:
    """Logarithm of linear light, shape (H, W) or (H, W, 3), as channels: shape (1, H, W) or (3, H, W)."""
    grey = light if light.ndim == 2 else light.mean(axis=-1)
    bright = grey[grey > 0.0]
    level = float(np.median(bright)) if bright.size else 1.0
    logs: Array = np.log(np.maximum(light, 0.0) / level + _DARK)
    if light.ndim == 2:
        return np.asarray(logs[None], dtype=np.float64)
    red, green, blue = np.moveaxis(logs, -1, 0)
    return np.stack([logs.mean(axis=-1), 0.5 * (red - green), 0.5 * (blue - green)])


TURN_RAD = np.linspace(0.0, 2.0 * np.pi, TURNS, endpoint=False)
CURVES = np.stack(
    [np.ones(TURNS), np.cos(TURN_RAD), np.sin(TURN_RAD), np.cos(2.0 * TURN_RAD), np.sin(2.0 * TURN_RAD)], axis=1
)
"""Derivatives of r(t) by (dr, du, dv, e1, e2), shape (TURNS, 5)."""
for _table in (TURN_RAD, CURVES):
    _table.setflags(write=False)


@dataclass(frozen=True)
class EdgeRing:
    """Edges across a circle.

    Parameters
    ----------
    channels : array, shape (n, H, W)
        Of `log_colours`.
    circle : centre (u, v) and radius, pixels
    reach_px, step_px : float
        Distances from the circle that are looked at, on both sides.
    blur_px : float
    """

    channels: Array = field(repr=False)
    circle: Circle
    reach_px: float = REACH_PX
    step_px: float = 0.5
    blur_px: float = 1.0

    @cached_property
    def distances_px(self) -> Array:
        """Distances from the circle, outwards positive."""
        count = round(self.reach_px / self.step_px)
        return np.asarray(np.arange(-count, count + 1) * self.step_px)

    @cached_property
    def _uv(self) -> tuple[Array, Array]:
        u, v, radius = self.circle
        r = radius + self.distances_px
        return u + np.outer(CURVES[:, 1], r), v + np.outer(CURVES[:, 2], r)

    @cached_property
    def inside(self) -> BoolArray:
        """True inside the picture, shape (TURNS, distances)."""
        u, v = self._uv
        rows, columns = self.channels.shape[1:]
        return np.asarray((u > 2.0) & (u < columns - 3.0) & (v > 2.0) & (v < rows - 3.0))

    @cached_property
    def strength(self) -> Array:
        """Slope of the light across the circle over that of its turn, 0 to 1, shape (TURNS, distances)."""
        u, v = self._uv
        light = np.stack([ndimage.map_coordinates(plane, [v, u], order=1, mode="nearest") for plane in self.channels])
        along = max(1.0, _ALONG_PX * TURNS / (2.0 * np.pi * max(self.circle[2], 1.0)))
        modes = ("nearest", "wrap", "nearest")
        smooth = ndimage.gaussian_filter(light, (0.0, along, self.blur_px / self.step_px), mode=modes)
        slope = np.sqrt(np.square(np.gradient(smooth, self.step_px, axis=2)).sum(axis=0))
        slope[~self.inside] = 0.0
        usual = np.sqrt(np.mean(slope**2, axis=1, keepdims=True)) + _NOISE
        return np.asarray(np.where(self.inside, slope / (slope + _SHARE * usual), 0.0))

    @cached_property
    def peaks(self) -> tuple[Array, Array]:
        """Distances of the strongest edges of every turn and their strengths, 0 for none, shapes (TURNS, PEAKS)."""
        N = self.strength
        best = np.zeros_like(N)
        middle = N[:, 1:-1]
        top = (middle >= N[:, :-2]) & (middle > N[:, 2:]) & (middle > _LEAST_PEAK)
        best[:, 1:-1][top] = middle[top]
        order = np.argsort(-best, axis=1, kind="stable")[:, :PEAKS]
        i, rows = np.clip(order, 1, N.shape[1] - 2), np.arange(TURNS)[:, None]
        low, mid, high = N[rows, i - 1], N[rows, i], N[rows, i + 1]
        with np.errstate(all="ignore"):
            shift = np.nan_to_num(0.5 * (low - high) / (low - 2.0 * mid + high))
        place = self.distances_px[i] + np.clip(shift, -0.5, 0.5) * self.step_px
        return place, np.take_along_axis(best, order, axis=1)

    def along(self, table: Array, distance_px: Array) -> Array:
        """Values of a table (TURNS, distances) on a curve, shape (TURNS,); 0 beyond the reach."""
        x = (distance_px - self.distances_px[0]) / self.step_px
        i = np.clip(x.astype(np.intp), 0, len(self.distances_px) - 2)
        part, rows = x - i, np.arange(TURNS)
        value = table[rows, i] * (1.0 - part) + table[rows, i + 1] * part
        return np.asarray(np.where((x < 0.0) | (x > len(self.distances_px) - 1), 0.0, value))

    def contrast(self, curve: Array) -> float:
        """By how many standard errors a curve's mean strength exceeds that of curves beside it.

        Places nearer than 10 px correlate and count as one.
        """
        distance = CURVES @ curve
        here = self.along(self.strength, distance)
        beside = np.mean([self.along(self.strength, distance + d) for d in _BESIDE_PX], axis=0)
        more = (here - beside)[self.along(self.inside.astype(float), distance) > 0.5]
        together = max(1, round(_CORRELATED_PX * TURNS / (2.0 * np.pi * max(self.circle[2], 1.0))))
        places = len(more) // together
        if len(more) < _FEWEST_TURNS or places < 3:
            return 0.0
        means = more[: places * together].reshape(places, together).mean(axis=1)
        return float(means.mean() / (means.std(ddof=1) / np.sqrt(places) + 1e-9))

    def moved(self, curve: Array, **options: float) -> tuple[EdgeRing, Array]:
        """A ring around a curve's circle, and the curve from there: its e1 and e2."""
        u, v, radius = self.circle
        circle = (u + float(curve[1]), v + float(curve[2]), radius + float(curve[0]))
        return EdgeRing(self.channels, circle, **options), np.array([0.0, 0.0, 0.0, curve[3], curve[4]])
