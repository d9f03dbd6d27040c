"""Pixels of the loop: windows around spots, or whole frames, of a room that was baked; and the spots that they show.

`RobotCamera` draws what the sensor delivers: room, robot, spots and noise, from `datasets.film.moving_camera`. Windows
lie about every light that is not hidden, on even pixels, at a random offset, so that their place tells no more than a
few pixels. `SpotReader` finds and fits spots in raw pixels, as a policy would: peaks of a matched filter, then
maximum likelihood of a red spot with the covariance of the fit, times chi^2 where it fits badly: what is white or wide
fits badly. It knows the nominal rig only.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from phibench.datasets.film.moving_camera import BakedRoom, MovingCamera, window_around
from phibench.datasets.frames.sensor_card import SensorCard, presets_of, sensor_card
from phibench.estimator.geometry.status import Status
from phibench.estimator.interface import Box
from phibench.estimator.spots.candidates import peaks
from phibench.estimator.spots.detect import RAW, lamp_halo
from phibench.estimator.spots.fit_raw import fit_raw
from phibench.estimator.spots.gaussian_spot import SpotBlur
from phibench.estimator.spots.image_planes import colour_planes
from phibench.estimator.spots.raw_pixels import noise_of, raw_electrons
from phibench.estimator.spots.spot_prediction import Laser, spot_blur
from phibench.robot.loop.sensing import EXPOSURES_S, SEEN, SpotOnSurface, SpotReading
from phibench.scenes.frames import Array, BoolArray, as_vector
from phibench.scenes.laser import LaserSpot, beam_diameter_m
from phibench.scenes.random_streams import Name
from phibench.scenes.rig import Rig
from phibench.scenes.validation import SceneError

Fidelity = Literal["exact", "windows", "frames"]
FIDELITIES: tuple[Fidelity, ...] = get_args(Fidelity)
WINDOW_PX = 32  # a spot anywhere within its offset, and its surroundings
_OFFSET_PX = 6  # of a window's middle from the spot, at most
_FIT_REACH_PX = 6  # pixels around a peak that are fitted
_MOST_FITTED = 64  # places of a whole frame
_LEAST_Z = {"windows": 5.0, "frames": RAW.alone}  # a window has 4000 places: 1e-3 false spots
_PATTERN_PX = 0.006  # of a spot's place by the sensor's fixed pattern, measured: docs/measurements/loop.md
_APART_PX, _MOST_SPOTS = 4.0, 24  # of spots in a frame: nearer ones are one and the same


@dataclass(frozen=True)
class Window:
    """Part of a frame: image pixel of its first column and row, and its pixels, shape (h, w) or (h, w, 3)."""

    u0_px: int
    v0_px: int
    pixels: NDArray[Any]


def pixel_form(preset: str) -> tuple[tuple[int, ...], type[np.generic], int]:
    """Channels, type and largest value of a preset's pixels.

    Raises
    ------
    SceneError
        If its frames are no whole numbers.
    """
    card = sensor_card(preset)
    if card.output == "electrons":
        raise SceneError(f"preset '{preset}': pixels of a robot are codes; take one of {', '.join(presets_of())}")
    if card.output == "raw":
        return (), np.uint16, card.top_dn
    return ((2,) if card.output == "yuyv" else (3,)), np.uint8, 255


@dataclass(frozen=True)
class RobotCamera:
    """Camera of the robot.

    Parameters
    ----------
    rig : Rig
        The true one.
    fidelity : "windows" or "frames"
    """

    rig: Rig
    preset: str
    laser: Laser
    fidelity: Fidelity

    def take(
        self,
        room: BakedRoom,
        lights: Sequence[tuple[SpotOnSurface, float, float]],
        placement: tuple[Array, Array],
        stroke_m: float,
        exposure: int,
        rng: np.random.Generator,
        *stream: Name,
    ) -> tuple[Window, ...]:
        """Windows by rising column, or the whole frame as the only one.

        Parameters
        ----------
        lights : sequence of (light, u_px, v_px)
            Those that nothing hides, world frame, and the pixels of their images.
        exposure : int
            Index of `EXPOSURES_S`.
        rng : Generator
            For the places of windows.
        *stream : names of the noise
        """
        camera, size = MovingCamera(self.rig, self.preset), self.rig.camera
        if self.fidelity == "frames":
            regions = [window_around(size, 0.0, 0.0, 2)]
            regions = [replace(regions[0], u0_px=0, v0_px=0, u1_px=size.width_px, v1_px=size.height_px)]
        else:
            places = sorted((u, v) for _, u, v in lights)
            shifts = rng.integers(-_OFFSET_PX, _OFFSET_PX + 1, (len(places), 2))
            regions = [
                _even(window_around(size, u + a, v + b, WINDOW_PX))
                for (u, v), (a, b) in zip(places, shifts, strict=True)
            ]
        spots = [self._spot(light, placement) for light, _, _ in lights]
        light = camera.light(room, placement, stroke_m, spots, regions)
        drawn = camera.frames(light, EXPOSURES_S[exposure], regions, *stream)
        return tuple(Window(r.u0_px, r.v0_px, pixels) for r, pixels in zip(regions, drawn, strict=True))

    def _spot(self, light: SpotOnSurface, placement: tuple[Array, Array]) -> LaserSpot:
        R, origin = placement
        own = (light.point_m - origin) @ R
        return LaserSpot(
            as_vector(own),
            as_vector(light.normal @ R),
            beam_diameter_m(float(np.linalg.norm(own))),
            self.laser.albedo,
            self.laser.power_w * light.power,
            self.laser.wavelength_nm,
        )


def _even(region: Any) -> Any:
    """Region that begins at an even row and column, so that its mosaic begins with red."""
    u0, v0 = region.u0_px // 2 * 2, region.v0_px // 2 * 2
    return replace(region, u0_px=u0, v0_px=v0, u1_px=u0 + WINDOW_PX, v1_px=v0 + WINDOW_PX)


class SpotReader:
    """Finder and fit of spots in raw pixels.

    Parameters
    ----------
    rig : Rig
        The nominal one.
    fidelity : "windows" or "frames"

    Raises
    ------
    SceneError
        If the preset's pixels are not raw.
    """

    def __init__(self, rig: Rig, preset: str, fidelity: Fidelity) -> None:
        self._cards = [replace(sensor_card(preset), exposure_s=exposure) for exposure in EXPOSURES_S]
        if self._cards[0].output != "raw":
            raise SceneError(
                f"preset '{preset}': the policies here read raw pixels; take {' or '.join(presets_of('raw'))}, or read "
                "the pixels of the environment yourself"
            )
        self.rig, self._least_z = rig, _LEAST_Z[fidelity]
        self._sigma_px = rig.camera.blur_sigma_px
        self._disc = _inside_outline(rig) if fidelity == "frames" else None

    def read(self, windows: Sequence[Window], exposure: int) -> tuple[SpotReading, ...]:
        """Spots by rising u; of a whole frame the strongest ones."""
        card = self._cards[exposure]
        readings = [reading for window in windows for reading in self._in_window(window, card)]
        readings.sort(key=lambda reading: -reading.electrons)
        apart: list[SpotReading] = []
        for brightest in readings:
            if all(math.hypot(brightest.u_px - other.u_px, brightest.v_px - other.v_px) > _APART_PX for other in apart):
                apart.append(brightest)
        return tuple(sorted(apart[:_MOST_SPOTS]))

    def _in_window(self, window: Window, card: SensorCard) -> list[SpotReading]:
        height, width = window.pixels.shape
        planes = colour_planes(window.pixels, card, Box(0, 0, width, height))
        inside = np.ones((height, width), bool)
        if self._disc is not None:
            inside = self._disc & ~lamp_halo(planes, self._disc, card, laser_off=True)
        seen = peaks(planes, None, card, self._sigma_px, inside, self._least_z, _MOST_FITTED)
        places = seen.uv_px[: _MOST_FITTED if self._disc is not None else 1]
        corner = np.rint(places).astype(int) - _FIT_REACH_PX
        size = 2 * _FIT_REACH_PX + 1
        corner = corner[np.all((corner >= 0) & (corner + size <= (width, height)), axis=1)]
        return self._fitted(window, corner, size, card)

    def _fitted(self, window: Window, corner: NDArray[np.int64], size: int, card: SensorCard) -> list[SpotReading]:
        if not len(corner):
            return []
        regions = np.stack([window.pixels[v : v + size, u : u + size] for u, v in corner])
        origin = corner + (window.u0_px, window.v0_px)
        blurs = [spot_blur(self.rig, place + 0.5 * (size - 1.0)) for place in origin]
        sigma_px, ratio, mixed = (np.array([getattr(b, n) for b in blurs]) for n in ("sigma_px", "ratio", "mixed_px2"))
        blur = SpotBlur(sigma_px, ratio, mixed)
        fit = fit_raw(raw_electrons(regions, card), origin, noise_of(card), blur, saturation_e=card.saturation_e)
        bound = np.sqrt(0.5 * np.trace(fit.covariance_px2, axis1=1, axis2=2))
        sigma = bound * np.sqrt(np.maximum(fit.chi2, 1.0))
        # a spot of n standard deviations has its place to a blur over n, to twice that between red pixels; what fits
        # badly counts for less
        good = (fit.status == Status.OK) & (sigma <= 2.0 * self._sigma_px / self._least_z)
        texture = bound * np.sqrt(np.maximum(fit.chi2 - 1.0, 0.0))
        rows = np.column_stack([fit.uv_px, sigma, fit.flux_e, texture])[good]
        return [SpotReading(u, v, s, e, SEEN, _PATTERN_PX, t) for u, v, s, e, t in rows.tolist()]


def _inside_outline(rig: Rig) -> BoolArray:
    """Pixels of the mirror's image, two pixels inside of its outline."""
    camera = rig.camera
    centre, outline = camera.project(rig.sphere_in_camera_m), rig.outline_px(360)
    v, u = np.mgrid[: camera.height_px, : camera.width_px]
    angle = np.arctan2(v - centre[1], u - centre[0])
    around: Array = np.arctan2(*(outline - centre).T[::-1])
    order = np.argsort(around)
    radius = np.linalg.norm(outline - centre, axis=1)[order]
    return np.asarray(
        np.hypot(u - centre[0], v - centre[1]) < np.interp(angle, around[order], radius, period=2 * np.pi) - 2
    )
