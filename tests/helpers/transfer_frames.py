"""Frames of an even field by a camera that is NumPy alone: Poisson, Gauss, a bent response, rounding."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image


@dataclass(frozen=True)
class BentCamera:
    """y = black + K (electrons + read noise) + jitter of the frame; a code is rint(y (1 - bend (y / top)^power))."""

    gain: float
    read_noise_e: float
    black: float
    bits: int = 12
    bend: float = 0.0
    power: float = 3.0
    prnu: float = 0.005
    jitter_dn: float = 0.0
    hot: int = 0  # pixels that have 3000 electrons more, on the mean
    size: tuple[int, int] = (128, 128)

    @property
    def top(self) -> int:
        return int((1 << self.bits) - 1)

    @property
    def gain_at_black(self) -> float:
        """Derivative of the code by electrons at black."""
        return self.gain * (1.0 - (1.0 + self.power) * self.bend * (self.black / self.top) ** self.power)

    @property
    def _hot_e(self) -> NDArray[Any]:
        draw, result = np.random.default_rng(98), np.zeros(self.size)
        result.flat[draw.choice(result.size, self.hot, replace=False)] = draw.exponential(3000.0, self.hot)
        return result

    def frames(self, electrons: float, count: int, rng: np.random.Generator) -> list[NDArray[Any]]:
        pattern = 1.0 + self.prnu * np.random.default_rng(99).standard_normal(self.size)
        result = []
        for _ in range(count):
            e = rng.poisson(electrons * pattern + self._hot_e) + self.read_noise_e * rng.standard_normal(self.size)
            y = self.black + self.gain * e + self.jitter_dn * rng.standard_normal()
            codes = y * (1.0 - self.bend * (np.maximum(y, 0.0) / self.top) ** self.power)
            kind = np.uint16 if self.bits > 8 else np.uint8
            result.append(np.clip(np.rint(codes), 0, self.top).astype(kind))
        return result

    def electrons(self, share: float) -> float:
        """Of a share of the code range."""
        return share * (self.top - self.black) / self.gain


def write_stack(folder: Path, images: list[NDArray[Any]]) -> list[str]:
    folder.mkdir(parents=True)
    names = [f"{k:03d}.png" for k in range(len(images))]
    for name, image in zip(names, images, strict=True):
        Image.fromarray(image).save(folder / name, compress_level=0)  # noise, read once: packing takes seconds
    return names


def write_transfer(
    folder: Path, camera: BentCamera, seed: int, shares: tuple[float, ...], frames: int = 8, kind: str = "mono-raw"
) -> Path:
    """Folder of 16 dark frames and flat levels at shares of the range."""
    rng = np.random.default_rng(seed)
    write_stack(folder / "dark", camera.frames(0.0, 16, rng))
    for k, share in enumerate(shares):
        write_stack(folder / f"flat/{k:02d}", camera.frames(camera.electrons(share), frames, rng))
    (folder / "capture.toml").write_text(f'format = "{kind}"\nbits = {camera.bits}\nexposure_s = 0.01\n')
    return folder
