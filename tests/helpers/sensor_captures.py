"""Folders of frames of a simulated camera, as `phibench sensor fit` reads them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from phibench.render.sensor.camera_chain import Chain
from phibench.render.sensor.electrons import NoiseStream
from phibench.render.sensor.light import Light
from phibench.render.sensor.settings import Sensor

SIDE = 128


def flat_frames(
    s: Sensor, electrons: Sequence[float], count: int, label: str, seed: int, size: tuple[int, int] = (SIDE, SIDE)
) -> list[NDArray[Any]]:
    """Frames of an even field; electrons behind R, G, B per exposure."""
    light = Light.flat(tuple(e / s.exposure_s for e in electrons), size)
    return [Chain(s, seed).frame(light, NoiseStream(("capture", seed, label, k))) for k in range(count)]


def write_frames(folder: Path, images: Sequence[NDArray[Any]]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for k, image in enumerate(images):
        Image.fromarray(image).save(folder / f"{k:03d}.png", compress_level=0)  # noise: packing takes seconds


def write_raw_capture(
    folder: Path,
    s: Sensor,
    seed: int = 0,
    levels: Sequence[float] = (0.1, 0.3, 0.5, 0.7, 0.85),
    frames: int = 8,
    dark_frames: int = 24,
    dark_seconds: Mapping[float, int] | None = None,
) -> Path:
    """Dark and flat frames; levels are shares of what saturates."""
    top_e = min(s.full_well_e, (s.top_dn - s.black_level_dn) / s.dn_per_e)
    write_frames(folder / "dark", flat_frames(s, (0.0, 0.0, 0.0), dark_frames, "dark", seed))
    for i, level in enumerate(levels):
        e = level * top_e
        images = flat_frames(s, (0.8 * e, e, 0.6 * e), frames, f"flat{i}", seed)
        write_frames(folder / "flat" / f"{i:02d}", images)
    for seconds, count in (dark_seconds or {}).items():
        images = flat_frames(s.replace(exposure_s=seconds), (0.0, 0.0, 0.0), count, f"slow{seconds}", seed)
        write_frames(folder / "dark-exposure" / f"{seconds:.3f}", images)
    notes = f"exposure_s = {s.exposure_s}\nanalogue_gain = {s.analogue_gain}\nbits = {s.adc_bits}\n"
    (folder / "capture.toml").write_text(f'{notes}format = "{s.mosaic}-raw"\n')
    return folder


def drawn_sensor(k: int) -> Sensor:
    """A raw sensor drawn within the ranges of `settings_presets.toml`; every fourth one is read at a higher gain."""
    from phibench.render.sensor.settings import sensor

    rng = np.random.default_rng(k)
    gain = 4.0 if k % 4 == 3 else 1.0
    full_well = rng.uniform(9000.0, 17000.0)
    return sensor(
        "bayer-raw" if k % 2 else "mono-raw",
        analogue_gain=gain,
        full_well_e=full_well,
        # every third converter ends above the full well
        gain_dn_per_e=(0.85 if k % 3 == 0 else 1.1) * 959.0 / full_well,
        black_level_dn=rng.uniform(40.0, 80.0),
        read_noise_e=rng.uniform(3.5, 8.0),
        prnu=rng.uniform(0.005, 0.02),
        dsnu_e=rng.uniform(1.5, 5.0),
        dark_e_per_s=rng.uniform(3.0, 30.0),
        exposure_s=0.01,
        mono_weights=(0.0, 1.0, 0.0),
    )


def drawn_processed(k: int) -> Sensor:
    """A processed sensor drawn within the ranges of `settings_presets.toml`: srgb8 or yuyv.

    Two of four are sharpened or denoised by 3 x 3 pixels; the others are sharpened, and denoised by 5 x 5 with edges
    spared.
    """
    from phibench.render.sensor.settings import sensor

    rng = np.random.default_rng(1000 + k)
    full_well = rng.uniform(6000.0, 12000.0)
    amount = rng.uniform(0.2, 1.0)
    left, right = rng.uniform(0.0, 0.3, 2)
    own: dict[str, Any] = {
        "sharpen_amount": 0.0 if k % 3 == 2 else amount,
        "denoise_luma": 0.5 * amount if k % 3 == 2 else 0.0,
    }
    if k % 4 > 1:
        own = {
            "sharpen_amount": amount,
            "denoise_luma": rng.uniform(0.4, 0.9),
            "denoise_reach_px": 2,
            "denoise_vertical": rng.uniform(0.5, 0.95),
            "denoise_threshold_codes": rng.uniform(15.0, 40.0),
        }
    if k % 2:
        own["chroma_taps"] = (left, 1.0 - left - right, right)
    return sensor(
        "yuyv" if k % 2 else "srgb8",
        full_well_e=1.2 * full_well,
        gain_dn_per_e=959.0 / full_well,
        read_noise_e=rng.uniform(6.0, 15.0),
        prnu=rng.uniform(0.008, 0.02),
        transfer_function="rec709" if k % 8 > 3 else "srgb",
        white_balance=(rng.uniform(0.9, 1.3), 1.0, rng.uniform(1.1, 1.6)),
        denoise_chroma=rng.uniform(0.2, 0.9),
        exposure_s=0.01,
        **own,
    )


def write_processed_capture(folder: Path, s: Sensor, seed: int = 0, frames: int = 8, side: int = SIDE) -> Path:
    """Flat frames and an exposure series of a grey surface under the camera's own white balance."""
    white_e = (s.top_dn - s.black_level_dn) / s.dn_per_e
    grey = 1.0 / np.array(s.white_balance)
    for i, level in enumerate((0.01, 0.03, 0.08, 0.2, 0.4, 0.65)):
        images = flat_frames(s, tuple(level * white_e * grey), frames, f"flat{i}", seed, (side, side))
        write_frames(folder / "flat" / f"{i:02d}", images)
    for share in (0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.7, 0.9):
        images = flat_frames(s, tuple(share * white_e * grey), 1, f"t{share}", seed, (64, 64))
        tiles = [np.tile(image, (side // 64, side // 64, 1)) for image in images]
        write_frames(folder / "exposure" / f"{share * 0.02:.4f}", tiles)
    if s.denoise_threshold_codes is not None:
        write_frames(folder / "edge", edge_frames(s, 0.6, (5.0, 8.0, 12.0, 15.0), side))
    return folder


def edge_frames(s: Sensor, sigma_px: float, angles_deg: Sequence[float], side: int) -> list[NDArray[Any]]:
    """Frames of a blurred grey chessboard, turned by each angle."""
    from scipy.special import ndtr

    def stripes(t: NDArray[Any]) -> NDArray[Any]:
        t = np.mod(t, 60.0)
        return np.asarray(ndtr((t - 15.0) / sigma_px) - ndtr((t - 45.0) / sigma_px))

    white_e = (s.top_dn - s.black_level_dn) / s.dn_per_e
    y, x = np.mgrid[0.0:side, 0.0:side]
    frames = []
    for k, angle in enumerate(np.radians(angles_deg)):
        u = stripes(x * np.cos(angle) + y * np.sin(angle))
        v = stripes(-x * np.sin(angle) + y * np.cos(angle))
        grey = 0.03 + 0.55 * (u * (1.0 - v) + v * (1.0 - u))
        rates = grey * white_e / s.exposure_s / np.array(s.white_balance)[:, None, None]
        frames.append(Chain(s, 0).frame(Light(rates), NoiseStream(("edges", k))))
    return frames


def board_views(lens: tuple[float, float, float, float], k1: float, count: int) -> list[NDArray[np.uint8]]:
    """Views of a chessboard of 8 x 6 inner corners, 30 mm apart, 320 x 240, by exact projection of every pixel."""
    fx, fy, cx, cy = lens
    rng = np.random.default_rng(11)
    y, x = np.mgrid[0:960, 0:1280] / 4.0 - 0.375  # 4 x 4 samples of a pixel
    xd, yd = (x - cx) / fx, (y - cy) / fy
    xn, yn = xd.copy(), yd.copy()
    for _ in range(20):
        r2 = xn * xn + yn * yn
        xn, yn = xd / (1.0 + k1 * r2), yd / (1.0 + k1 * r2)
    images = []
    for _ in range(count):
        a, b, c = rng.uniform(-0.45, 0.45, 3) * np.array([1.0, 1.0, 0.5])
        rotation = (
            np.array([[np.cos(c), -np.sin(c), 0.0], [np.sin(c), np.cos(c), 0.0], [0.0, 0.0, 1.0]])
            @ np.array([[np.cos(b), 0.0, np.sin(b)], [0.0, 1.0, 0.0], [-np.sin(b), 0.0, np.cos(b)]])
            @ np.array([[1.0, 0.0, 0.0], [0.0, np.cos(a), -np.sin(a)], [0.0, np.sin(a), np.cos(a)]])
        )
        centre = np.array([rng.uniform(-0.04, 0.04), rng.uniform(-0.03, 0.03), rng.uniform(0.42, 0.55)])
        rays = np.stack([xn, yn, np.ones_like(xn)], axis=-1)
        normal = rotation[:, 2]
        points = rays * (centre @ normal / (rays @ normal))[..., None] - centre
        u, v = points @ rotation[:, 0] / 0.03, points @ rotation[:, 1] / 0.03
        dark = (np.floor(u) + np.floor(v)) % 2 == 0
        inside = (np.abs(u + 0.5) < 4.5) & (np.abs(v - 0.5) < 3.5)
        fine = np.where(inside & dark, 30.0, 215.0)
        grey = fine.reshape(240, 4, 320, 4).mean(axis=(1, 3)) + rng.normal(0.0, 1.0, (240, 320))
        images.append(np.repeat(np.rint(grey).astype(np.uint8)[..., None], 3, axis=2))
    return images
