"""Signal to noise beside what drawn images show: `measure_snr.py [--scenes 170] [--presets mjpeg]`.

Run from the repository root. Scenes are spots over flat rooms of 20 to 3000 electrons a pixel, in random places, for
each of three presets; a spot's pixels together collect 3 to 200 times the noise of one pixel, 20 to 400 for
mjpeg. Each scene is drawn 200
times with the laser on and 200 times with it off, every time by another camera. Half of the draws give the mean image
of the spot and the variance of every feature, the other half the likelihood ratio of a spot at the true place, for
Gaussian features of equal noise: the features weighted by mean over variance. Its d' is the distance of both means over
the mean deviation. Features are raw pixels, each pixel's own code, or the coefficients of a JPEG's blocks, those whose
mean stands out by 3 standard errors. No model of the estimator's enters.

Prints per preset the ratio of the signal to noise of `limits.position_bound` to d' (median, 5 and 95 % of scenes with a
d' of 2 to 15), the rank correlation, and how many scenes one of the two puts below 5 and the other above 7.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from scipy.fft import dctn
from scipy.stats import spearmanr

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from helpers.chain_scenes import COLLECTED, MIDDLE, ROOM, UNITS, scene

from phibench.datasets.exposures.expected_electrons import expected_of_light
from phibench.datasets.frames.sensor_card import card_of
from phibench.estimator.limits.position_bound import processed_snr, raw_snr
from phibench.estimator.limits.processed_bound import chain_limit
from phibench.estimator.spots.gaussian_spot import SpotBlur
from phibench.render.sensor.camera_chain import Chain
from phibench.render.sensor.electrons import NoiseStream
from phibench.render.sensor.light import Light
from phibench.render.sensor.settings import Sensor, sensor
from phibench.scenes.frames import Array

PRESETS = ("bayer-raw", "srgb8", "mjpeg")
DRAWS = 100
ROOMS_E = (20.0, 3000.0)
SIZES = {"bayer-raw": (3.0, 200.0), "srgb8": (3.0, 200.0), "mjpeg": (20.0, 400.0)}
SIGMA_PX = 0.8
_HALF_PX = 6  # of the square of pixels
_YCC = np.array([[0.299, 0.587, 0.114], [-0.168736, -0.331264, 0.5], [0.5, -0.418688, -0.081312]])


def features(image: Array, s: Sensor, uv: Array) -> Array:
    """Numbers of an image with nearly independent noise, shape (n,)."""
    codes = image.astype(float)
    if s.output == "mjpeg":
        y, *chroma = np.moveaxis(codes @ _YCC.T, -1, 0)
        planes = [y, *(0.5 * (c[:, ::2] + c[:, 1::2]) for c in chroma)]
        return np.concatenate([_blocks(plane).ravel() for plane in planes])
    u, v = (round(x) for x in uv - (UNITS.u0_px, UNITS.v0_px))
    rows, columns = (np.arange(x - _HALF_PX, x + _HALF_PX + 1) for x in (v, u))
    if codes.ndim == 3:
        own = rows[:, None] % 2 + columns % 2  # the corner of the units is on a red pixel
        return np.asarray(codes[rows[:, None], columns, own]).ravel()
    return np.asarray(codes[rows[:, None], columns]).ravel()


def _blocks(plane: Array) -> Array:
    h, w = plane.shape
    return np.asarray(dctn(plane.reshape(h // 8, 8, w // 8, 8).swapaxes(1, 2), axes=(2, 3), norm="ortho"))


def shown(light: Light, s: Sensor, uv: Array, name: tuple[object, ...]) -> float:
    """Distance of images with and without the spot in standard deviations, d'."""
    lights = {"on": light, "off": light.without_spot()}
    drawn = {
        key: np.stack(
            [
                features(Chain(s, k).frame(one, NoiseStream((*name, key, k)), UNITS), s, uv)  # type: ignore[arg-type]
                for k in range(2 * DRAWS)
            ]
        )
        for key, one in lights.items()
    }
    on, off = (drawn[key][:DRAWS] for key in ("on", "off"))
    mean, variance = on.mean(axis=0) - off.mean(axis=0), 0.5 * (on.var(axis=0) + off.var(axis=0)) + 1e-3
    weight = np.where(np.abs(mean) > 3.0 * np.sqrt(2.0 * variance / DRAWS), mean / variance, 0.0)
    on, off = (drawn[key][DRAWS:] @ weight for key in ("on", "off"))
    spread = np.sqrt(0.5 * (on.var() + off.var()))
    return float((on.mean() - off.mean()) / spread) if spread > 0.0 else 0.0


def told(light: Light, s: Sensor, uv: Array, flux_e: float, room_e: float) -> float:
    """Signal to noise as scores have it."""
    if s.output == "raw":
        return raw_snr(expected_of_light(light, s), card_of(s))
    levels = room_e * ROOM + s.dark_e_per_s * s.exposure_s

    def information(part: float) -> float:
        limit = chain_limit(card_of(s), uv, SpotBlur(SIGMA_PX), part * flux_e, levels)
        return float(limit.fisher[2, 2] * flux_e**2)

    return processed_snr(information, information(1.0))


def main() -> None:
    """Print a line per preset."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=170)
    parser.add_argument("--presets", nargs="+", default=list(PRESETS))
    given = parser.parse_args()
    count = given.scenes
    print("| preset | scenes | snr / d': median, 5 to 95 % | rank correlation | on other sides of 5 and 7 |")
    print("|---|---|---|---|---|")
    for preset in given.presets:
        s, rng = sensor(preset), np.random.default_rng(5)
        pairs = []
        for k in range(count):
            uv = MIDDLE + rng.uniform(-4.0, 4.0, 2)
            room_e, size = (float(np.exp(rng.uniform(*np.log(x)))) for x in (ROOMS_E, SIZES[preset]))
            flux_e = size * np.sqrt(room_e + 30.0) / COLLECTED
            light = scene(uv, SIGMA_PX, flux_e, room_e, s)
            pairs.append((told(light, s, uv, flux_e, room_e), shown(light, s, uv, ("snr", k))))
        snr, seen = np.array(pairs).T
        inside = (seen >= 2.0) & (seen <= 15.0)
        ratio = snr[inside] / seen[inside]
        apart = int(np.count_nonzero(((snr < 5.0) & (seen > 7.0)) | ((seen < 5.0) & (snr > 7.0))))
        low, middle, high = np.quantile(ratio, (0.05, 0.5, 0.95))
        rank = float(spearmanr(snr, seen).statistic)
        print(
            f"| {preset} | {count} ({len(ratio)}) | {middle:.2f}, {low:.2f} to {high:.2f} | {rank:.3f} | {apart} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
