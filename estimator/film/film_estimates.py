"""Depth of a film of a data set in three ways: joint bundle, bursts at both ends, recursive filter.

Each takes what a robot has: raw windows, their times, encoder readings, the nominal rig. The true scene is not asked.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.datasets.film.film_read import Film
from phibench.datasets.frames.sensor_card import SensorCard, card_of
from phibench.estimator.film.film_bundle import FilmDepth, expected_sigma_m, film_depth
from phibench.estimator.film.film_positions import FilmPositions, fit_positions, stepped_positions
from phibench.estimator.film.recursive_filter import FilterState, first_state, updated
from phibench.estimator.geometry.mirror_image import image_of
from phibench.estimator.spots.gaussian_spot import SpotBlur
from phibench.estimator.spots.spot_prediction import spot_blur
from phibench.scenes.frames import Array
from phibench.scenes.laser import Beam
from phibench.scenes.rig import Rig

_STEPS, _SETTLED = 6, 0.02  # of the bundle, and standard deviations that it stops at
_REST_M = 5e-3  # of the ends of the stroke: what counts as resting there


@dataclass(frozen=True)
class SeenFilm:
    """Measurements of a film.

    Attributes
    ----------
    rig : Rig
        Nominal, or calibrated.
    positions : FilmPositions
        Of each frame by itself.
    encoder_m : array, shape (N,)
        Readings, taken to the time at which the spot's row was exposed.
    encoder_sigma_m : float
    windows_dn, origins_px : arrays, shape (N, h, w) and (N, 2)
        Raw pixels, and the image pixel (u, v) of the first one.
    card : SensorCard
    blur : SpotBlur
    """

    rig: Rig
    positions: FilmPositions
    encoder_m: Array
    encoder_sigma_m: float
    windows_dn: NDArray[Any] = field(repr=False)
    origins_px: NDArray[np.int64] = field(repr=False)
    card: SensorCard
    blur: SpotBlur

    def some(self, index: NDArray[np.int64]) -> SeenFilm:
        """Some of the frames."""
        return replace(
            self,
            positions=self.positions.some(index),
            encoder_m=self.encoder_m[index],
            windows_dn=self.windows_dn[index],
            origins_px=self.origins_px[index],
        )


def seen_film(
    film: Film,
    draw: int = 0,
    camera_seed: int = 0,
    preset: str = "bayer-raw",
    depth_m: float | None = None,
    vibration_sigma_m: float = 0.0,
    frames: Array | None = None,
    rig: Rig | None = None,
) -> SeenFilm:
    """Draw frames of raw pixels and fit the spot in each.

    Parameters
    ----------
    film, draw, camera_seed, preset
    depth_m : float, optional
        Rough distance, for the blur; by default the one that a first fit gives.
    vibration_sigma_m : float
        Of the carriage beside its encoder.
    frames : array of int, optional
        Frames to take; all by default.
    rig : Rig, optional
        Calibrated; the nominal one by default.
    """
    numbers = np.arange(len(film)) if frames is None else np.asarray(frames)
    drawn = [film.frame(int(k), preset, draw, camera_seed) for k in numbers]
    card = card_of(drawn[0].sensor)
    windows = np.stack([one.image for one in drawn])
    origins = np.array([(one.region.u0_px, one.region.v0_px) for one in drawn], np.int64)
    rig, times = rig or film.plan.nominal.rig, film.plan.nominal.times
    readings = film.table["encoder_m"].to_numpy()
    sigma = float(np.hypot(film.plan.encoder.sigma_m, vibration_sigma_m))
    middle = origins.mean(axis=0) + 0.5 * (np.array(windows.shape[:0:-1]) - 1.0)
    for _ in range(1 if depth_m is not None else 2):
        blur = spot_blur(rig, middle, depth_m, Beam())
        positions = fit_positions(windows, origins, card, rig, blur)
        rows = np.where(positions.good, positions.uv_px[:, 1], middle[1])
        at_row = np.interp(times.row_s(numbers.astype(float), rows), times.frame_s, readings)
        if depth_m is None:
            depth_m = film_depth(rig, positions, at_row, sigma).depth_m
    return SeenFilm(rig, positions, at_row, sigma, windows, origins, card, blur)


def bundle_depth(seen: SeenFilm, covariance_rig: Array | None = None) -> FilmDepth:
    """Joint bundle over all frames: Gauss-Newton steps of the likelihood of all pixels, from the frames' own fits."""
    found, positions = film_depth(seen.rig, seen.positions, seen.encoder_m, seen.encoder_sigma_m), seen.positions
    for _ in range(_STEPS):
        positions = joint_positions(seen, found)
        before, found = found, film_depth(seen.rig, positions, seen.encoder_m, seen.encoder_sigma_m, covariance_rig)
        if abs(found.depth_m - before.depth_m) < _SETTLED * found.sigma_m:
            break
    return found


def joint_positions(seen: SeenFilm, found: FilmDepth) -> FilmPositions:
    """Positions one step from where a depth predicts them."""
    axis = np.array(seen.rig.stroke_axis_world)
    at = image_of(seen.rig.at(0.0), found.point_world_m - seen.encoder_m[:, None] * axis)
    return stepped_positions(seen.windows_dn, seen.origins_px, seen.card, seen.rig, seen.blur, at.uv_px)


def burst_depth(seen: SeenFilm, covariance_rig: Array | None = None) -> FilmDepth:
    """Frames at rest at both ends of the stroke alone, all of them, as two bursts."""
    low, high = seen.encoder_m.min(), seen.encoder_m.max()
    ends = np.flatnonzero((seen.encoder_m < low + _REST_M) | (seen.encoder_m > high - _REST_M))
    return bundle_depth(seen.some(ends), covariance_rig)


def filtered(seen: SeenFilm) -> list[FilterState]:
    """Belief after every frame that has a position."""
    states: list[FilterState] = []
    for k in np.flatnonzero(seen.positions.good):
        uv, noise = seen.positions.uv_px[k], seen.positions.noise_px2[k]
        pattern, offset = seen.positions.pattern_px2[k, :, k], float(seen.encoder_m[k])
        if not states:
            states.append(first_state(seen.rig, uv, noise, pattern, offset))
            continue
        states.append(updated(seen.rig, states[-1], uv, noise, pattern, offset, seen.encoder_sigma_m))
    return states


@dataclass(frozen=True)
class EqualLight:
    """Standard deviations of D at equal light, metres: N frames of the film, and N / 2 at each end."""

    film_m: float
    two_ends_m: float

    @property
    def gain(self) -> float:
        """Variance of two ends over that of the film; below 1 where resting at the ends is better."""
        return (self.two_ends_m / self.film_m) ** 2


def equal_light(seen: SeenFilm, point_world_m: Array, covariance_rig: Array | None = None) -> EqualLight:
    """Bound of a film against two bursts of as many frames at the ends of its stroke, from the frames' covariances."""
    axis = np.array(seen.rig.stroke_axis_world)
    at = image_of(seen.rig.at(0.0), point_world_m - seen.encoder_m[:, None] * axis)
    stepped = stepped_positions(seen.windows_dn, seen.origins_px, seen.card, seen.rig, seen.blur, at.uv_px)
    good = np.flatnonzero(stepped.good)
    positions, offsets = stepped.some(good), seen.encoder_m[good]
    ends = np.where(np.arange(len(good)) < len(good) // 2, np.argmin(offsets), np.argmax(offsets))
    return EqualLight(
        expected_sigma_m(seen.rig, point_world_m, offsets, positions, seen.encoder_sigma_m, covariance_rig),
        expected_sigma_m(
            seen.rig, point_world_m, offsets[ends], positions.some(ends), seen.encoder_sigma_m, covariance_rig
        ),
    )
