"""Scenes for the tests of the fit through the chain: a spot over a flat room, drawn by the simulator's chain."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from helpers.sensor_light import FILTERS, spot_at

from phibench.datasets.frames.sensor_card import SensorCard, card_of
from phibench.estimator.geometry.status import Status
from phibench.estimator.limits.processed_bound import chain_limit, limit_window
from phibench.estimator.processed.fit_processed_images import fit_jpeg, fit_srgb, fit_yuyv
from phibench.estimator.spots.gaussian_spot import SpotBlur, covariance_bound
from phibench.render.sensor.camera_chain import Chain
from phibench.render.sensor.electrons import NoiseStream
from phibench.render.sensor.light import Light, Region
from phibench.render.sensor.settings import Sensor
from phibench.scenes.random_streams import generator

SIZE, MIDDLE = (64, 96), np.array([48.0, 32.0])
SQUARE, UNITS = Region.around(*MIDDLE, SIZE, 17), Region(16, 16, 80, 48)  # 17 x 17 pixels; 4 x 4 units of 16 x 8
ROOM = np.array([1.0, 0.9, 0.6])
# electrons in all pixels of the mosaic, per electron of an unfiltered red pixel: a quarter R, a half G, a quarter B
COLLECTED = float(FILTERS @ (0.25, 0.5, 0.25))
FITS = {"srgb8": fit_srgb, "yuyv": fit_yuyv, "mjpeg": fit_jpeg}


def scene(uv: np.ndarray, sigma_px: float, flux_e: float, background_e: float, s: Sensor) -> Light:
    """Spot of `flux_e` electrons per exposure in pixels of response 1, over a room of `background_e` behind R."""
    room = ROOM[:, None, None] * np.full((3, *SIZE), background_e / s.exposure_s)
    return Light(room, spot_at(*uv, sigma_px, flux_e / s.exposure_s))


@dataclass(frozen=True)
class Draws:
    """Errors, bounds of their variances and pulls of (u, v), shape (n, 2), and how many fits came to nothing."""

    error_px: np.ndarray
    bound_px2: np.ndarray
    pull: np.ndarray
    failed: int

    @property
    def over_bound(self) -> float:
        return float(np.sqrt(np.mean(self.error_px**2 / self.bound_px2)))


def drawn(
    s: Sensor,
    sigma_px: float,
    collected_e: float,
    background_e: float,
    positions: int,
    cameras: int,
    frames: int = 1,
) -> Draws:
    """Fits of `positions` places in a cell of 2 x 2 pixels by `cameras` cameras, each with its own fixed pattern.

    Each fit is of `frames` frames of one camera.
    """
    card, rng, flux_e = card_of(s), generator("chain", s.name, f"{collected_e} {background_e}"), collected_e / COLLECTED
    box = UNITS if s.output == "mjpeg" else SQUARE
    errors, bounds, pulls, failed = [], [], [], 0
    for k in range(positions):
        uv = MIDDLE + rng.uniform(-1.0, 1.0, 2)
        light = scene(uv, sigma_px, flux_e, background_e, s)
        chains = [Chain(s, cameras * k + j) for j in range(cameras)]
        streams = [[NoiseStream(("chain", k, j, *((f,) if f else ()))) for f in range(frames)] for j in range(cameras)]
        seen = [[c.frame(light, x, box) for x in some] for c, some in zip(chains, streams, strict=True)]
        images = np.stack([np.stack(some) for some in seen])
        fit = FITS[s.output](images, (box.u0_px, box.v0_px), card, SpotBlur(sigma_px))
        good = fit.status == Status.OK
        failed += int((~good).sum())
        dark = s.dark_e_per_s * s.exposure_s
        bound = _bound(card, uv, SpotBlur(sigma_px), np.array([flux_e, *(background_e * ROOM + dark)]), frames)
        errors.append(fit.uv_px[good] - uv)
        bounds.append(np.tile(np.diag(bound), (int(good.sum()), 1)))
        pulls.append(errors[-1] / np.sqrt(np.diagonal(fit.covariance_px2[good], axis1=1, axis2=2)))
    return Draws(*(np.concatenate(x) for x in (errors, bounds, pulls)), failed)


def _bound(card: SensorCard, uv: np.ndarray, blur: SpotBlur, rest: np.ndarray, frames: int) -> np.ndarray:
    """Covariance of (u, v) at the bound, shape (2, 2): flux and three levels are unknown."""
    if frames == 1:
        return chain_limit(card, uv, blur, rest[0], rest[1:]).covariance_px2
    window, corner = limit_window(card, uv, blur)
    return covariance_bound(replace(window, frames=frames).fisher(np.array([*(uv - corner), *rest])))
