"""Frames of a film, as depth estimators read them: laser on and off, carriage offsets, motion blur of the spot.

The laser is on in every other frame, switched as the spot's row is read, or blinks by the film's own code. Positions
belong to the time at which the spot's row is in the middle of its exposure. The encoder is read at the frame's time;
from there to the row's time the carriage goes as it was told to.

A spot that moves during an exposure is drawn out along its way. Its image is made of parts, as those of a wide lens
are: where the spot is at the nodes of a quadrature over the exposure. Rows within a spot differ in time by 0.2 ms, and
are taken as one.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.polynomial.legendre import leggauss
from numpy.typing import NDArray

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.film.film_read import Film
from phibench.datasets.frames.sensor_card import SensorCard, card_of
from phibench.estimator.geometry.reflection import image_of
from phibench.estimator.geometry.triangulate import depth_of
from phibench.estimator.spots.gaussian_spot import SpotBlur, SpotParts
from phibench.estimator.spots.raw_pixels import raw_electrons
from phibench.estimator.spots.spot_prediction import spot_blur
from phibench.scenes.frames import Array
from phibench.scenes.laser import Beam
from phibench.scenes.motion.carriage import Carriage
from phibench.scenes.motion.film_times import FilmTimes
from phibench.scenes.rig import Rig

_NODES = 4  # of an exposure: exact to the seventh power of a motion of 2 px over a blur of 0.7 px
_SIDE_PX, _UNIT_PX, _MARGIN_PX = 48, 16, 32  # of what is kept around all spots
LIT = 0.99  # of an exposure: a frame with less, and more than none, is no frame of either kind
Index = NDArray[np.int64]


@dataclass(frozen=True)
class FilmFrames:
    """Images of a film on one region, with the laser on in N frames and off in M.

    Attributes
    ----------
    rig : Rig
        Nominal, or calibrated.
    carriage : Carriage
        As it was told to go.
    encoder_m : array, shape (frames,)
        Readings at the frames' times.
    on, off : arrays of int, shape (N,) and (M,)
        Numbers of the frames.
    on_e, off_e : arrays, shape (N, h, w) and (M, h, w)
        Electrons; of processed images their codes, (N, h, w, c) and (M, h, w, c).
    origin_px : array, shape (2,)
        Image pixel (u, v) of the first one.
    near_px : array, shape (N, 2)
        Places within `reach_px` of the spots.
    stroke_scale : float
        Of a calibrated stroke, over the nominal one.
    """

    rig: Rig
    card: SensorCard
    times: FilmTimes
    carriage: Carriage
    encoder_m: Array
    encoder_sigma_m: float
    on: Index
    off: Index
    on_e: NDArray[Any] = field(repr=False)
    off_e: NDArray[Any] = field(repr=False)
    origin_px: Index
    near_px: Array
    stroke_scale: float = 1.0
    reach_px: int = 12

    def some(self, on: Index, off: Index) -> FilmFrames:
        """Some of the frames, by their index among those with the laser on, and off; twice is allowed."""
        return replace(
            self, on=self.on[on], off=self.off[off], on_e=self.on_e[on], off_e=self.off_e[off], near_px=self.near_px[on]
        )

    def until(self, frame: int) -> FilmFrames:
        """Frames that a robot has seen after one of them, by its number in the film."""
        return self.some(np.flatnonzero(self.on <= frame), np.flatnonzero(self.off <= frame))

    def offsets_m(self, numbers: Index, rows: Array) -> Array:
        """Carriage when these rows, shape (N,), of these frames were exposed."""
        told = self.carriage.position_m
        since = told(self.times.row_s(numbers.astype(float), rows)) - told(self.times.frame_s[numbers])
        return self.stroke_scale * (self.encoder_m[numbers] + since)

    def image_px(self, point_world_m: Array, offsets_m: Array) -> Array:
        """Image of a point with the carriage at offsets, shape (..., 2)."""
        axis = np.array(self.rig.stroke_axis_world)
        return image_of(self.rig.at(0.0), point_world_m - np.asarray(offsets_m)[..., None] * axis).uv_px

    def positions_px(self, point_world_m: Array, numbers: Index) -> tuple[Array, Array]:
        """Predicted positions, shape (N, 2), and the offsets at the times of their rows, shape (N,)."""
        rows = np.full(len(numbers), 0.5 * (self.times.height_px - 1))
        for _ in range(3):  # an image moves by a thousandth of a row in the time of a row
            offsets = self.offsets_m(numbers, rows)
            uv = self.image_px(point_world_m, offsets)
            rows = uv[:, 1]
        return uv, offsets

    def blur(self, point_world_m: Array, uv_px: Array) -> SpotBlur:
        """Blur of the N spots at (u, v), drawn out by the motion during the exposure."""
        D, _ = depth_of(self.rig, point_world_m)
        middle = self.times.row_s(self.on.astype(float), uv_px[:, 1])[:, None]
        when = np.hstack([middle, middle + 0.5 * self.times.exposure_s * leggauss(_NODES)[0]])
        places = self.image_px(point_world_m, self.stroke_scale * self.carriage.position_m(when))
        return self._drawn_out(np.full(len(uv_px), D), uv_px, places[:, 1:] - places[:, :1])

    def moving_blur(self, depth_m: Array, uv_px: Array, px_per_s: Array) -> SpotBlur:
        """Blur of the N spots at distances (N,), which move evenly during the exposure, shape (N, 2)."""
        apart = 0.5 * self.times.exposure_s * leggauss(_NODES)[0][:, None] * px_per_s[:, None]
        return self._drawn_out(depth_m, uv_px, apart)

    def _drawn_out(self, depth_m: Array, uv_px: Array, apart_px: Array) -> SpotBlur:
        each = [spot_blur(self.rig, uv, float(D), Beam()) for uv, D in zip(uv_px, depth_m, strict=True)]
        sigma, ratio, mixed = np.array([(b.sigma_px, b.ratio, b.mixed_px2) for b in each], float).T
        still, weights = SpotBlur(sigma, ratio, mixed), 0.5 * leggauss(_NODES)[1]
        return replace(still, parts=SpotParts(apart_px, np.broadcast_to(weights, apart_px.shape[:2]), still))


def film_frames(
    film: Film,
    draw: int = 0,
    camera_seed: int = 0,
    preset: str = "bayer-raw",
    *,
    frames: Array | None = None,
    rig: Rig | None = None,
    stroke_scale: float = 1.0,
    driving: bool = False,
    **changes: Any,
) -> FilmFrames:
    """Draw frames with the laser on and off.

    Parameters
    ----------
    frames : array of int, optional
        Frames to take; all by default.
    rig : Rig, optional
        Calibrated; the nominal one by default.
    stroke_scale : float
        Of the calibrated stroke.
    driving : bool
        The robot may drive, as `driving_depth` has it; places and blur by the carriage alone are then none.
    **changes
        Numbers of the preset.

    Raises
    ------
    DatasetError
        If fewer than two frames have the laser on, or none has it off, or the robot drives.
    """
    numbers = np.arange(len(film)) if frames is None else np.asarray(frames, np.int64)
    on, off, blinks = lit_frames(film, numbers)
    region = film.info.region
    if film.plan.scene.drive is not None and not driving:
        raise DatasetError(
            f"film {film.info.film}: the robot drives, and this estimator takes it to stand; give a film without "
            "[[film.drive]], or use driving_film_depth"
        )
    nominal, card = film.plan.nominal, card_of(film.sensor(preset, **changes))
    side = min(_SIDE_PX, film.info.window_px or _SIDE_PX)
    windows = np.array([(w.u0_px, w.v0_px, w.u1_px, w.v1_px) for w in (film.window(int(k), side) for k in on)])
    # whole units of a JPEG, and some more around them
    inside = [(region.u0_px, region.u1_px), (region.v0_px, region.v1_px)]
    low = np.clip(windows[:, :2].min(axis=0) // _UNIT_PX * _UNIT_PX - _MARGIN_PX, *np.transpose(inside))
    high = np.clip(-(-windows[:, 2:].max(axis=0) // _UNIT_PX) * _UNIT_PX + _MARGIN_PX, *np.transpose(inside))
    columns, rows = (slice(a - first, b - first) for a, b, (first, _) in zip(low, high, inside, strict=True))

    def drawn(frame: int, laser: bool) -> NDArray[Any]:
        image = film.cut_out(frame, preset, draw, camera_seed, laser=laser, **changes).image[rows, columns]
        return raw_electrons(image, card) if card.output == "raw" else image

    return FilmFrames(
        rig or nominal.rig,
        card,
        nominal.times,
        nominal.carriage,
        film.table["encoder_m"].to_numpy(),
        film.plan.encoder.sigma_m,
        on,
        off,
        np.stack([drawn(int(k), True) for k in on]),
        np.stack([drawn(int(k), blinks) for k in off]),
        low,
        0.5 * (windows[:, :2] + windows[:, 2:] - 1.0),
        stroke_scale,
    )


def lit_frames(film: Film, numbers: Index) -> tuple[Index, Index, bool]:
    """Frames with the laser on, frames with it off, and whether the film's own code switches it.

    Raises
    ------
    DatasetError
        If fewer than two are on, or none is off.
    """
    code, times = film.plan.nominal.code, film.plan.nominal.times
    blinks = code.duration_s > 0.0
    if blinks:
        rows = film.table["row_v_px"].to_numpy()[numbers]
        level = code.mean_level(times.row_s(numbers.astype(float), rows), times.exposure_s)
        on, off = numbers[level > LIT], numbers[level == 0.0]
    else:
        on, off = numbers[::2], numbers[1::2]
    if len(on) < 2 or not len(off):
        raise DatasetError(
            f"film {film.info.film}: the laser is on in {len(on)} of {len(numbers)} frames and off in {len(off)}; two "
            "on and one off are the least: take more frames, or a code whose bits are longer than two frames"
        )
    return on, off, blinks
