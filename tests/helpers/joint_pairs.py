"""Stroke pairs of drawn raw regions with exact positions, for the tests of the joint fit. Not a test file."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from helpers.sensor_light import FILTERS, spot_at

from phibench.datasets.exposures.expected_electrons import expected_of_light
from phibench.datasets.frames.sensor_card import card_of
from phibench.estimator.geometry.reflection import image_of
from phibench.estimator.limits.position_bound import spot_limit
from phibench.estimator.spots.fit_joint import JointFit, fit_joint
from phibench.estimator.spots.fit_raw import SpotData, SpotFit, fit_raw, spot_data
from phibench.estimator.spots.gaussian_spot import LASER_RESPONSE, SpotBlur, SpotModel
from phibench.estimator.spots.raw_pixels import GaussLaw, noise_of, raw_electrons, spot_regions
from phibench.render.sensor.camera_chain import Chain
from phibench.render.sensor.electrons import NoiseStream
from phibench.render.sensor.light import Light, Region
from phibench.render.sensor.settings import Sensor, sensor
from phibench.scenes.random_streams import generator
from phibench.scenes.rig import Rig

RIG = Rig()
SIZE, BOX = (48, 48), Region.around(24.0, 24.0, (48, 48), 15)
SIGMA_PX = 0.7
BLUR = SpotBlur(SIGMA_PX)
MONO = sensor("mono-raw", mono_weights=(1.0, 0.0, 0.0))
BAYER = sensor("bayer-raw")
COLLECTED = float(FILTERS @ (0.25, 0.5, 0.25))


@dataclass(frozen=True)
class Side:
    """One image of many pairs: true positions and bounds of the covariance per draw, regions and their corners."""

    uv_px: np.ndarray
    bound_px2: np.ndarray
    electrons: np.ndarray
    origin_px: np.ndarray


@dataclass(frozen=True)
class Pairs:
    """Draws of stroke pairs: (n,) depths and strokes, and both sides."""

    sensor: Sensor
    depth_m: np.ndarray
    stroke_m: float
    down: Side
    up: Side

    def regions(self, side: Side) -> SpotData:
        card, x = card_of(self.sensor), side.electrons
        regions = spot_regions(x, side.origin_px, x < card.saturation_e)
        return spot_data(regions, GaussLaw(noise_of(card)), BLUR, SpotModel(response_of(self.sensor)))

    def separate(self, side: Side) -> SpotFit:
        card = card_of(self.sensor)
        return fit_raw(
            side.electrons,
            side.origin_px,
            noise_of(card),
            BLUR,
            SpotModel(response_of(self.sensor)),
            saturation_e=card.saturation_e,
        )

    def joint(self) -> JointFit:
        # a detection is good to about a fifth of a pixel
        start = generator("joint", "start").normal(0.0, 0.2, (2, len(self.depth_m), 2))
        return fit_joint(
            RIG,
            self.stroke_m,
            self.regions(self.down),
            self.regions(self.up),
            self.down.uv_px + start[0],
            self.up.uv_px + start[1],
        )


def response_of(s: Sensor) -> tuple[float, float, float] | None:
    return LASER_RESPONSE if s.mosaic == "bayer" else None


def drawn_pairs(
    s: Sensor, depth_m: float, stroke_m: float, collected_e: float, room_e: float, positions: int, cameras: int
) -> Pairs:
    """Pairs of `positions` points at all azimuths, of depths within 2 % (so that every phase of a pixel occurs), each
    drawn by `cameras` cameras.
    """
    rng = generator("joint", s.name, str(depth_m), str(stroke_m), str(collected_e))
    D = depth_m * rng.uniform(0.98, 1.02, positions)
    azimuth = rng.uniform(0.0, 2.0 * np.pi, positions)
    centre = RIG.at(0.0).sphere_centre_m
    X = np.column_stack([centre[0] + D * np.cos(azimuth), centre[1] + D * np.sin(azimuth), np.full(positions, 0.5)])
    flux_e = collected_e / (COLLECTED if s.mosaic == "bayer" else 1.0)
    down, up = (
        side(s, image_of(RIG.at(offset), X).uv_px, name, flux_e, room_e, cameras)
        for name, offset in (("down", 0.0), ("up", stroke_m))
    )
    return Pairs(s, np.repeat(D, cameras), stroke_m, down, up)


def side(s: Sensor, uv: np.ndarray, name: str, flux_e: float, room_e: float, cameras: int) -> Side:
    card, electrons, bounds, origins = card_of(s), [], [], []
    for i, place in enumerate(uv):
        corner = np.floor(place).astype(int) // 2 * 2 - 24  # even, so that red stays red
        light = scene(*(place - corner), flux_e, room_e, s)
        bounds.append(spot_limit(expected_of_light(light, s), card).covariance_px2)
        for j in range(cameras):
            dn = Chain(s, cameras * i + j).frame(light, NoiseStream(("joint", name, i, j)), BOX)
            electrons.append(raw_electrons(dn, card))
        origins.append(corner + [BOX.u0_px, BOX.v0_px])
    repeated = (np.repeat(np.array(x), cameras, axis=0) for x in (uv, bounds, origins))
    uv_px, bound_px2, origin_px = repeated
    return Side(uv_px, bound_px2, np.array(electrons), origin_px)


def scene(u: float, v: float, flux_e: float, room_e: float, s: Sensor) -> Light:
    room = np.array([1.0, 0.9, 0.6])[:, None, None] * np.full((3, *SIZE), room_e / s.exposure_s)
    return Light(room, spot_at(u, v, SIGMA_PX, flux_e / s.exposure_s))
