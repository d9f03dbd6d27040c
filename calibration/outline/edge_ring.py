"""Edge and limb strength around a circle in a picture (`EdgeRing`, `LimbRing`), and the contrast of curves there.

The light is taken as logarithm and colour differences, so that a step counts the same in the dark and in the bright.
What is sought is a curve r(t) = r0 + dr + du cos t + dv sin t + e1 cos 2t + e2 sin 2t: a circle that may move, and the
ellipse that a sphere beside the camera's axis has for an outline. A mirror ball shows the room: edges are everywhere,
and of either sign. The outline differs by being an edge nearly all around, which the room's edges are not.

At the limb a ray grazes the ball and goes on undeviated. Just outside, the room's light hardly changes within a few
pixels. Just inside, the mirror turns rays by T(d) = 2 arccos(1 + d / r), which grows as the root of the depth -d: 15
degrees at 3 px. So the light across the limb is nearly a + b T + c T^2, blurred, with T = 0 outside; reflectance near
grazing is of that form, too. A window of light that this describes better than a parabola has its limb there. The
room's edges, reflected a few pixels inside, are as sharp, but they are no such root.

Symbols: d distance from the limb, pixels, outwards positive; r radius of the outline, pixels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from phibench.calibration.outline.limb_image import convolution
from phibench.scenes.frames import Array, BoolArray

Circle = tuple[float, float, float]
TURNS = 360  # places around the ring: a degree is some 5 px of a usual outline
REACH_PX = 14.0
_ALONG_PX = 5.0  # the room's own edges are rarely along the outline: averaged away
_SHARE = 0.7  # an edge of 0.7 times the rms of its turn has half of the full strength
_NOISE = 0.003  # of the logarithm: below it is no edge
_DARK = 0.02  # of the median: logarithms end there
# curves that a contrast is taken against: beyond the edge's blur
_BESIDE_PX = (-9.0, -7.5, -6.0, -4.5, 4.5, 6.0, 7.5, 9.0)
_CORRELATED_PX = 10.0  # along the curve: nearer strengths are one and the same
_FEWEST_TURNS = TURNS // 12  # a twelfth of a circle is not told from a line
PEAKS = 4  # edges of a turn that are kept: the limb is not always the strongest
_LEAST_PEAK = 0.25  # of the full strength


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
_EVERY_TURN = np.arange(TURNS)
for _table in (TURN_RAD, CURVES, _EVERY_TURN):
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

    alike: ClassVar[float] = 0.5
    """Part of the strongest edge from which the outermost counts: the room is squeezed to edges inside the limb."""
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
    def uv(self) -> tuple[Array, Array]:
        """Pixels (u, v) of all turns and distances, each of shape (TURNS, distances)."""
        u, v, radius = self.circle
        r = radius + self.distances_px
        return u + np.outer(CURVES[:, 1], r), v + np.outer(CURVES[:, 2], r)

    @cached_property
    def inside(self) -> BoolArray:
        """True inside the picture, shape (TURNS, distances)."""
        u, v = self.uv
        rows, columns = self.channels.shape[1:]
        return np.asarray((u > 2.0) & (u < columns - 3.0) & (v > 2.0) & (v < rows - 3.0))

    @cached_property
    def light(self) -> Array:
        """Channels at all turns and distances, shape (n, TURNS, distances)."""
        u, v = self.uv
        return np.stack([ndimage.map_coordinates(plane, [v, u], order=1, mode="nearest") for plane in self.channels])

    @cached_property
    def strength(self) -> Array:
        """Slope of the light across the circle over that of its turn, 0 to 1, shape (TURNS, distances)."""
        light = self.light
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
        count = len(self.distances_px)
        x = (distance_px - self.distances_px[0]) / self.step_px
        i = np.minimum(np.maximum(x.astype(np.intp), 0), count - 2)
        fraction, values, place = x - i, table.reshape(-1), i + count * _EVERY_TURN
        value = values[place] * (1.0 - fraction) + values[place + 1] * fraction
        return np.asarray(np.where((x < 0.0) | (x > count - 1), 0.0, value))

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
        # a drawn circle has no scatter at all
        return float(means.mean() / (means.std(ddof=1) / np.sqrt(places) + 1e-9))

    def moved(self, curve: Array, **options: float) -> tuple[Self, Array]:
        """A ring around a curve's circle, and the curve from there: its e1 and e2."""
        u, v, radius = self.circle
        circle = (u + float(curve[1]), v + float(curve[2]), radius + float(curve[0]))
        return type(self)(self.channels, circle, **options), np.array([0.0, 0.0, 0.0, curve[3], curve[4]])


@dataclass(frozen=True)
class FineRing(EdgeRing):
    """Edges across a curve in a picture that was searched at a smaller size: all pixels between two turns are used.

    Parameters
    ----------
    channels : array, shape (n, H, W)
        Linear light of the whole picture.
    circle, reach_px, step_px, blur_px
        As of `EdgeRing`, in squares of `block` pixels.
    block : int
    ellipse : e1, e2
        Of the curve that the light is taken along, in squares, too: distances are from the circle.
    """

    block: int = 1
    ellipse: tuple[float, float] = (0.0, 0.0)

    @cached_property
    def light(self) -> Array:
        """Logarithms of the mean light between turns, as channels, shape (n, TURNS, distances)."""
        parts = max(1, math.ceil(2.0 * np.pi * self.circle[2] * self.block / TURNS))
        turn = (np.arange(TURNS * parts) - 0.5 * (parts - 1)) * (2.0 * np.pi / (TURNS * parts))
        # between two turns the ellipse goes on: the light is averaged along the curve, not across it
        here = self.ellipse[0] * np.cos(2.0 * turn) + self.ellipse[1] * np.sin(2.0 * turn)
        bend = here - np.repeat(CURVES[:, 3:] @ np.array(self.ellipse), parts)
        u, v, radius = self.circle
        r = radius + self.distances_px[None, :] + bend[:, None]
        uv = [(c + r * f(turn)[:, None] + 0.5) * self.block - 0.5 for c, f in ((v, np.sin), (u, np.cos))]
        planes = [ndimage.map_coordinates(plane, uv, order=1, mode="nearest") for plane in self.channels]
        mean = np.stack([plane.reshape(TURNS, parts, -1).mean(axis=1) for plane in planes], axis=-1)
        return log_colours(mean if mean.shape[-1] == 3 else mean[..., 0])

    @cached_property
    def inside(self) -> BoolArray:
        """True inside the picture, shape (TURNS, distances)."""
        u, v = self.uv
        rows, columns = (length / self.block for length in self.channels.shape[1:])
        return np.asarray((u > 2.0) & (u < columns - 3.0) & (v > 2.0) & (v < rows - 3.0))


# Limbs.

_HALF_PX = 5.0  # of a window
_ALONG_PX = 4.0
_NOISE = 0.002  # of the window's light: better descriptions do not count
_FULL, _AGAINST = 5.0, 2.0  # logarithms of the ratio of squares: of a limb without doubt; of none
_FINE = 10  # samples of the blur per step


@dataclass(frozen=True)
class LimbRing(EdgeRing):
    """A ring whose `strength` tells limbs from the room's edges.

    Parameters
    ----------
    channels : array, shape (n, H, W)
        Linear light; NaN where pixels are full.
    circle, reach_px, step_px
        As of `EdgeRing`.
    blur_px : float
        Standard deviation of all blur in the picture: lens, pixel, and what made it smaller.
    """

    alike: ClassVar[float] = 1.0

    @cached_property
    def inside(self) -> BoolArray:
        """True inside the picture, where the light is known, shape (TURNS, distances)."""
        u, v = self.uv
        known = np.isfinite(ndimage.map_coordinates(self.channels[0], [v, u], order=1, mode="nearest"))
        return np.asarray(super().inside & known)

    @cached_property
    def strength(self) -> Array:
        """By how much better a limb describes the light than a parabola, 0 to 1, shape (TURNS, distances)."""
        half = round(_HALF_PX / self.step_px)
        wide = EdgeRing(self.channels, self.circle, self.reach_px + half * self.step_px, self.step_px)
        u, v = wide.uv
        along = max(1.0, _ALONG_PX * TURNS / (2.0 * np.pi * max(self.circle[2], 1.0)))
        x: Array = self.step_px * np.arange(-half, half + 1, dtype=np.float64)
        limb, parabola = (np.linalg.qr(basis)[0] for basis in (self._limb(x), np.vander(x, 3)))
        square, left, right = 0.0, 0.0, 0.0
        for plane in self.channels:
            light = ndimage.map_coordinates(plane, [v, u], order=1, mode="nearest")
            light = ndimage.gaussian_filter1d(light, along, axis=0, mode="wrap")
            windows = np.lib.stride_tricks.sliding_window_view(light, len(x), axis=1)
            own = np.square(windows).sum(axis=-1)
            square = square + own
            left = left + own - np.square(windows @ limb).sum(axis=-1)
            right = right + own - np.square(windows @ parabola).sum(axis=-1)
        inside = np.lib.stride_tricks.sliding_window_view(wide.inside, len(x), axis=1).all(axis=-1)
        floor = _NOISE**2 * square + 1e-300  # a black window has no light
        ratio = np.log((np.maximum(right, 0.0) + floor) / (np.maximum(left, 0.0) + floor))
        return np.asarray(np.where(inside & np.isfinite(ratio), np.clip(ratio, -_AGAINST, _FULL) / _FULL, 0.0))

    def _limb(self, x: Array) -> Array:
        """Blurred 1, T and T^2 at distances from the limb, shape (n, 3)."""
        fine = self.step_px / _FINE
        reach = np.ceil(6.0 * self.blur_px / self.step_px) * self.step_px  # six sigma of the blur beyond the window
        d = np.arange(x[0] - reach, x[-1] + reach + 0.5 * fine, fine)
        k = np.arange(-reach, reach + 0.5 * fine, fine)
        kernel = np.exp(-0.5 * np.square(k / self.blur_px))
        T = 2.0 * np.arccos(np.clip(1.0 + d / self.circle[2], 0.0, 1.0))
        turned, squared = (convolution(f, kernel / kernel.sum())[::_FINE] for f in (T, T * T))
        return np.stack([np.ones(len(x)), turned, squared], axis=-1)
