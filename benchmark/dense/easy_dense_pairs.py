"""Easy dense pairs and their truth, made in NumPy, not rendered: a box room, patterned walls, a cabinet, an exact rig.

They serve to try a dense method, not to rank it. Nothing is dark, glossy or without pattern, and there are no shadows.
The estimator's geometry makes both images and their truth: the ray of a pixel, and its first meeting with the box.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from phibench.benchmark.isolation.easy_pairs import EasyCamera, require_easy
from phibench.datasets.frames.sensor_card import SensorCard, sensor_card
from phibench.estimator.dense.dense_interface import DensePair
from phibench.estimator.geometry.reflection import image_of, room_rays
from phibench.estimator.spots.raw_pixels import bayer_filters
from phibench.scenes.frames import Array
from phibench.scenes.random_streams import generator
from phibench.scenes.rig import Rig, View

_LEVEL_E = np.array([3600.0, 4000.0, 2600.0])  # behind R, G, B on a white wall
_WAVES, _LONG_M, _SHORT_M = 48, 0.9, 0.12  # of the pattern: a pixel sees some 20 mm at 2.5 m
_AT_ONCE = 1 << 15
_SAME_M = 1e-6
STEP_PX = 4
"""Every so many pixels along each side the answers are looked at."""


@dataclass(frozen=True)
class EasyRoom:
    """A room of flat walls about the rig's axis, and a cabinet in it; metres.

    Parameters
    ----------
    low_m, high_m : shape (3,)
        Opposite corners of the room.
    cabinet_low_m, cabinet_high_m : shape (3,)
        Of the cabinet.
    number : int
        Names the pattern.
    """

    low_m: Array
    high_m: Array
    cabinet_low_m: Array
    cabinet_high_m: Array
    number: int

    @classmethod
    def of(cls, number: int) -> EasyRoom:
        """Room of a pair, from the stream named after its number."""
        rng = generator("easy dense", "room", number)
        low = np.array([*rng.uniform(-3.2, -2.0, 2), 0.0])
        high = np.array([*rng.uniform(2.0, 3.2, 2), 2.7])
        corner = np.array([rng.uniform(0.9, 1.2), rng.uniform(-0.6, 0.0), 0.0])
        return cls(low, high, corner, corner + np.array([0.5, 0.8, rng.uniform(0.8, 1.3)]), number)

    def hits(self, origins_m: Array, directions: Array) -> Array:
        """First points of the room along rays from inside, shape (N, 3)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            walls = np.maximum(*((corner - origins_m) / directions for corner in (self.low_m, self.high_m)))
            t = walls.min(axis=1)
            one, two = ((corner - origins_m) / directions for corner in (self.cabinet_low_m, self.cabinet_high_m))
        near, far = np.minimum(one, two).max(axis=1), np.maximum(one, two).min(axis=1)
        t = np.where((near < far) & (near > 0.0), np.minimum(near, t), t)
        return np.asarray(origins_m + t[:, None] * directions)

    def brightness(self, points_m: Array) -> Array:
        """Pattern of the surfaces, shape (N,), 0.1 to 1."""
        rng = generator("easy dense", "pattern", self.number)
        lengths = np.exp(rng.uniform(np.log(_SHORT_M), np.log(_LONG_M), _WAVES))
        towards = rng.normal(size=(_WAVES, 3))
        waves = 2.0 * np.pi * towards / np.linalg.norm(towards, axis=1, keepdims=True) / lengths[:, None]
        phases = rng.uniform(0.0, 2.0 * np.pi, _WAVES)
        total = np.sin(points_m @ waves.T + phases).sum(axis=1) / np.sqrt(_WAVES)
        return np.asarray(0.55 + 0.45 * np.tanh(total))


@dataclass(frozen=True)
class EasyTruth:
    """Exact answer for some pixels of a pair: every fourth one along each side whose point both images show.

    Attributes
    ----------
    uv_px : shape (n, 2)
        The pixels.
    point_world_m : shape (n, 3)
    depth_m : shape (n,)
    up_px : shape (n, 2)
        Place of the point in the up image.
    """

    rig: Rig
    stroke_m: float
    room: EasyRoom
    uv_px: Array
    point_world_m: Array
    depth_m: Array
    up_px: Array

    def at(self, plane: Array) -> Array:
        """Values of a plane, shape (H, W, ...), at the pixels."""
        u, v = self.uv_px.astype(int).T
        return np.asarray(plane[v, u], float)


@dataclass(frozen=True)
class EasyDensePairs:
    """Easy dense pairs by number.

    Parameters
    ----------
    preset : str
        Name of a sensor's preset that ends in pixels, such as "mjpeg".

    Raises
    ------
    MethodError
        If there is no such preset.
    """

    preset: str = "mjpeg"
    count: int = 3
    rig: Rig = field(default_factory=Rig)
    folders: tuple[Path, ...] = ()

    def __post_init__(self) -> None:
        require_easy(self.preset)

    def __len__(self) -> int:
        return self.count

    def pair(self, number: int) -> DensePair:
        """Images of a pair, with its exact rig."""
        camera, stroke = EasyCamera(self.rig.camera, self._card), self.stroke_m(number)
        frames = {
            name: [_sealed(camera.developed(self._mean_e(number, offset), (self.preset, number, name)))]
            for name, offset in (("down", 0.0), ("up", stroke))
        }
        return DensePair.of_frames(number, frames, rig=self.rig, stroke_m=stroke, card=self._card)

    def stroke_m(self, number: int) -> float:
        """h of a pair."""
        return float(generator("easy dense", "stroke", number).uniform(0.35, 0.6))

    def truth(self, number: int) -> EasyTruth:
        """Exact answer for some pixels."""
        room, stroke = EasyRoom.of(number), self.stroke_m(number)
        down, up = self.rig.at(0.0), self.rig.at(stroke)
        uv = self._pixels[:, ::STEP_PX, ::STEP_PX].reshape(2, -1).T
        X = points_of(down, room, uv)
        shown = np.isfinite(X).all(axis=1)
        uv, X = uv[shown], X[shown]
        place = image_of(up, X).uv_px
        seen = self.rig.camera.contains(place)
        seen[seen] = np.linalg.norm(points_of(up, room, place[seen]) - X[seen], axis=1) < _SAME_M
        uv, X, place = uv[seen], X[seen], place[seen]
        depth = np.hypot(*(X - down.sphere_centre_m)[:, :2].T)
        return EasyTruth(self.rig, stroke, room, uv, X, depth, place)

    def document(self) -> dict[str, Any]:
        """Provenance."""
        return {"name": "easy dense pairs", "preset": self.preset, "pairs": self.count}

    @property
    def _card(self) -> SensorCard:
        return sensor_card(self.preset)

    @cached_property
    def _pixels(self) -> Array:
        """(u, v) of all pixels, shape (2, H, W)."""
        camera = self.rig.camera
        return np.stack(np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px))).astype(float)

    def _mean_e(self, number: int, offset_m: float) -> Array:
        """Expected electrons of an image, shape (H, W); a twentieth of the light beside the mirror."""
        room, view = EasyRoom.of(number), self.rig.at(offset_m)
        shape = self._pixels.shape[1:]
        light = np.full(shape[0] * shape[1], 0.05)
        uv = self._pixels.reshape(2, -1).T
        for part in np.array_split(np.arange(len(uv)), len(uv) // _AT_ONCE + 1):
            X = points_of(view, room, uv[part])
            shown = np.flatnonzero(np.isfinite(X).all(axis=1))
            light[part[shown]] = room.brightness(X[shown])
        mosaic = self._card.mosaic == "bayer"
        level = _LEVEL_E[bayer_filters(np.array([(0, 0)]), shape)[0]] if mosaic else _LEVEL_E.sum()
        return np.asarray(light.reshape(shape) * level + self._card.dark_e_per_s * self._card.exposure_s)


def points_of(view: View, room: EasyRoom, uv_px: Array) -> Array:
    """Points of the room that pixels show, shape (N, 3); NaN beside the mirror."""
    ray = room_rays(view, uv_px)
    points, on = np.full((*uv_px.shape[:-1], 3), np.nan), np.isfinite(ray.direction_world).all(axis=-1)
    points[on] = room.hits(ray.origin_world_m[on], ray.direction_world[on])
    return points


def _sealed(image: Any) -> Any:
    image.flags.writeable = False
    return image
