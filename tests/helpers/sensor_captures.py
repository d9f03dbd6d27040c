"""Folders of frames of a simulated camera, as `phibench sensor fit` reads them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from phibench.render.sensor.camera_chain import Chain
from phibench.render.sensor.light import Light
from phibench.render.sensor.noise_tiles import NoiseStream
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
        Image.fromarray(image).save(folder / f"{k:03d}.png")


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
        write_frames(folder / "dark-exposure" / f"{seconds:g}", images)
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
