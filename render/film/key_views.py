"""Key views of a film: its motion in parts (`PoseParts`), the room's image interpolated between views, and its error.

Views are smooth in the pose: where the image moves by less than its blur between two keys, a pixel's light is a smooth
function of the pose. It is interpolated by the cubic through the four keys around (`key_weights`). Weights are linear
in the views, so that rolling shutter and motion blur of the room are means of weights over each row's exposure.

The poses of a film are parts of a way, one after the other (`PoseParts`). A move of the carriage is a part, its place
the offset; a film in which the robot stands has this part alone. Each leg of the drive is a part as well, its place the
way of the faster track or the angle of the flippers. Each part has keys of its own: where one ends, the way may bend.
Flippers that come to the floor bend it, too, and end a part.

The proof compares a rendered view half-way between two keys with the interpolated one, around the spot (`compare`).
The cubic's error is largest half-way, 9/384 of the fourth derivative times the spacing^4.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.polynomial.legendre import leggauss
from numpy.typing import NDArray

from phibench.render.film.moving_rows import RowsImage
from phibench.render.sensor.electrons import mosaic
from phibench.render.sensor.light import Region
from phibench.scenes.frames import Array
from phibench.scenes.motion.film_scene import FilmScene
from phibench.scenes.rig import View

ALLOWED = 0.25  # of the sensor's noise
_READ_NOISE_E = 4.0  # of the presets
_NODES = 5
_BOX_PX = 8  # around the spot's window, that pixels beside it count as well


def key_offsets_m(low_m: float, high_m: float, count: int) -> Array:
    """Evenly spaced offsets of key views, shape (count,); one for a carriage that stays."""
    if high_m - low_m < 1e-9:
        return np.array([0.5 * (low_m + high_m)])
    return np.linspace(low_m, high_m, max(count, 4))


def key_weights(keys_m: Array, offsets_m: Array) -> Array:
    """Weights of the key views, shape (..., keys), of the cubic through the four keys around each offset.

    Beyond the ends the outer cubic goes on.
    """
    offsets = np.asarray(offsets_m, float)
    if len(keys_m) == 1:
        return np.ones((*offsets.shape, 1))
    step = (keys_m[-1] - keys_m[0]) / (len(keys_m) - 1)
    place = (offsets - keys_m[0]) / step
    first = np.clip(np.floor(place).astype(int) - 1, 0, len(keys_m) - 4)
    x = place - first
    weights = np.zeros((*offsets.shape, len(keys_m)))
    for number, w in enumerate(_lagrange(x)):
        np.put_along_axis(weights, (first + number)[..., None], w[..., None], axis=-1)
    return weights


def _lagrange(x: Array) -> tuple[Array, ...]:
    """Cubic Lagrange weights of nodes 0, 1, 2, 3."""
    a, b, c, d = x, x - 1.0, x - 2.0, x - 3.0
    return -b * c * d / 6.0, a * c * d / 2.0, -a * b * d / 2.0, a * b * c / 6.0


@dataclass(frozen=True)
class PosePart:
    """One part of a film's poses.

    Attributes
    ----------
    start_s : float
        Time from which the part holds, up to the next one's.
    low, high : float
        Smallest and largest place at which a row is exposed.
    leg : int or None
        Leg of the drive; None is a move of the carriage.
    """

    start_s: float
    low: float
    high: float
    leg: int | None


@dataclass(frozen=True)
class PoseParts:
    """Parts of a film's poses, in order of time."""

    scene: FilmScene
    parts: tuple[PosePart, ...]

    @classmethod
    def of(cls, scene: FilmScene) -> PoseParts:
        """Parts during which rows of a film are exposed."""
        times, half = scene.times, 0.5 * (scene.times.exposure_s + scene.times.readout_s)
        begin, end = float(times.frame_s[0]) - half, float(times.frame_s[-1]) + half
        starts = _starts(scene)
        spans = [(starts[n][0] if n else -math.inf, one[0]) for n, one in enumerate([*starts[1:], (math.inf, None)])]
        parts = [
            PosePart(start, *_range(scene, leg, max(low, begin), min(high, end)), leg)
            for (start, leg), (low, high) in zip(starts, spans, strict=True)
            if max(low, begin) < min(high, end)
        ]
        return cls(scene, tuple(parts))

    def places(self, times_s: Array) -> tuple[NDArray[np.int64], Array]:
        """Part and place within it at any times; before the first part, that of its beginning."""
        times = np.asarray(times_s, float)
        number = np.clip(np.searchsorted([p.start_s for p in self.parts], times, side="right") - 1, 0, None)
        place = np.zeros(times.shape)
        for n, part in enumerate(self.parts):
            here = number == n
            if np.any(here):
                place[here] = _place(self.scene, part.leg, times[here])
                if part.leg is not None:
                    place[here] = np.clip(place[here], part.low, part.high)
        return number, place

    def view(self, part: int, place: float) -> View:
        """View at a place of a part, without vibration across it."""
        one, scene = self.parts[part], self.scene
        if one.leg is None:
            return scene.view_of(place, np.zeros(3), scene.robot_state(one.start_s))
        assert scene.drive is not None
        state = scene.drive.state_on_leg(one.leg, np.array(place))
        return scene.view_of(float(scene.carriage.position_m(one.start_s)), np.zeros(3), state)

    def weights(self, keys: Sequence[Array], times_s: Array) -> Array:
        """Weights of all key views, part by part, at any times, shape (..., keys)."""
        number, place = self.places(times_s)
        weights = [key_weights(at, place) * (number == n)[..., None] for n, at in enumerate(keys)]
        return np.concatenate(weights, axis=-1)

    def row_weights(self, keys: Sequence[Array], frame: int, rows: Array) -> Array:
        """Weights of the key views in each row of a frame, shape (rows, keys): means over the row's exposure."""
        times = self.scene.times
        x, weight = leggauss(_NODES)
        nodes = times.row_s(frame, rows)[:, None] + 0.5 * times.exposure_s * x
        return np.einsum("rjk,j->rk", self.weights(keys, nodes), 0.5 * weight)


def _starts(scene: FilmScene) -> list[tuple[float, int | None]]:
    """Times at which the parts begin, with their legs: moves of the carriage between two legs are one part."""
    if scene.drive is None or not scene.drive.legs:
        return [(-math.inf, None)]
    moves: list[tuple[float, int | None]] = [
        (leg.start_s, None) for leg in scene.carriage.legs if leg.end_m != leg.start_m
    ]
    legs: list[tuple[float, int | None]] = [
        (start_s, number)
        for number, leg in enumerate(scene.drive.legs)
        for start_s in (leg.start_s, *scene.drive.bends_s(number))
    ]
    found = sorted(moves + legs, key=lambda one: one[0])
    return [one for n, one in enumerate(found) if n == 0 or one[1] is not None or found[n - 1][1] is not None]


def _range(scene: FilmScene, leg: int | None, low_s: float, high_s: float) -> tuple[float, float]:
    dense = np.append(np.arange(low_s, high_s, min(1e-3, scene.times.exposure_s / 4.0)), high_s)
    places = _place(scene, leg, dense if leg is not None else dense[:-1])
    return float(places.min()), float(places.max())


def _place(scene: FilmScene, leg: int | None, times_s: Array) -> Array:
    if leg is None:
        return scene.offset_m(times_s)
    assert scene.drive is not None
    return scene.drive.profiles[leg].state(times_s)[0]


def blended(views: NDArray[np.float32], weights: Array) -> NDArray[np.float32]:
    """Room of a frame, shape (3, h, w), from key views (keys, 3, h, w) and weights (h, keys).

    A pixel below 0, which a cubic may leave beside a very bright edge, becomes 0.
    """
    used = np.flatnonzero(np.abs(weights).max(axis=0) > 0.0)
    part = weights[:, used].astype(np.float32)
    if np.ptp(part, axis=0).max(initial=0.0) == 0.0:  # the carriage stands still: one weight for all rows
        result = np.tensordot(part[0], views[used], axes=(0, 0))
    else:
        result = sum(views[key] * part[:, n][None, :, None] for n, key in enumerate(used))
    return np.maximum(result, np.float32(0.0))


@dataclass(frozen=True)
class ViewError:
    """Interpolated against rendered, around one spot, in units of the noise of one raw Bayer frame.

    Attributes
    ----------
    pixel_ratio : float
        Root mean square over the spot's window and 8 pixels around.
    position_ratio : float
        Error of the spot's best position, over its bound: the larger of two axes of the bound's ellipse.
    """

    pixel_ratio: float
    position_ratio: float

    @property
    def largest(self) -> float:
        """Larger of the two, of the pixels alone where the spot sends no light."""
        return self.pixel_ratio if math.isnan(self.position_ratio) else max(self.pixel_ratio, self.position_ratio)


def compare(
    rendered: NDArray[Any],
    interpolated: NDArray[Any],
    region: Region,
    spot: RowsImage,
    exposure_s: float,
    uv_px: Array | None = None,
) -> ViewError:
    """Compare two images of the room, shape (3, h, w) on `region`, electrons per second, around a spot.

    A spot that sends no light has pixels around `uv_px`, but no position.
    """
    box = _box(spot, region) if spot.electrons_per_s.size or uv_px is None else _dark_box(uv_px, region)
    if box is None:
        return ViewError(math.nan, math.nan)
    rows, columns = box.slices(region)
    phase = (box.v0_px, box.u0_px)
    room, error = (
        exposure_s * mosaic(planes[:, rows, columns].astype(float), phase)
        for planes in (rendered, interpolated.astype(float) - rendered)
    )
    stacks = (spot.electrons_per_s, spot.du_electrons_per_s_px, spot.dv_electrons_per_s_px)
    image, du, dv = (exposure_s * mosaic(_placed(stack, spot, box), phase) for stack in stacks)
    variance = room + np.maximum(image, 0.0) + _READ_NOISE_E**2
    slopes = np.stack([du, dv])
    information = np.einsum("ihw,jhw->ij", slopes, slopes / variance)
    pixels = float(np.sqrt(np.mean(error**2 / (room + _READ_NOISE_E**2))))
    if np.linalg.matrix_rank(information) != 2:
        return ViewError(math.nan if uv_px is None else pixels, math.nan)
    pull = (slopes * error / variance).sum(axis=(1, 2))
    # the error F^-1 g of the estimate, measured by F: its square is g F^-1 g, one for one sigma in any direction
    position = math.sqrt(float(pull @ np.linalg.solve(information, pull)))
    return ViewError(pixels, position)


def _box(spot: RowsImage, region: Region) -> Region | None:
    height, width = spot.electrons_per_s.shape[1:]
    box = Region(
        max(spot.u0_px - _BOX_PX, region.u0_px),
        max(spot.v0_px - _BOX_PX, region.v0_px),
        min(spot.u0_px + width + _BOX_PX, region.u1_px),
        min(spot.v0_px + height + _BOX_PX, region.v1_px),
    )
    return box if height and min(box.shape) > 0 else None


def _dark_box(uv_px: Array, region: Region) -> Region | None:
    u, v = (round(float(x)) for x in uv_px)
    box = Region(
        max(u - _BOX_PX, region.u0_px),
        max(v - _BOX_PX, region.v0_px),
        min(u + _BOX_PX + 1, region.u1_px),
        min(v + _BOX_PX + 1, region.v1_px),
    )
    return box if min(box.shape) > 0 else None


def _placed(stack: Array, spot: RowsImage, box: Region) -> Array:
    """Planes of the spot's window on a box; zero elsewhere."""
    planes = np.zeros((3, *box.shape))
    height, width = stack.shape[1:]
    v0, u0 = max(spot.v0_px, box.v0_px), max(spot.u0_px, box.u0_px)
    v1, u1 = min(spot.v0_px + height, box.v1_px), min(spot.u0_px + width, box.u1_px)
    if v0 < v1 and u0 < u1:
        planes[:, v0 - box.v0_px : v1 - box.v0_px, u0 - box.u0_px : u1 - box.u0_px] = stack[
            :, v0 - spot.v0_px : v1 - spot.v0_px, u0 - spot.u0_px : u1 - spot.u0_px
        ]
    return planes
