"""Fits of MJPEG spots against their bound, over qualities, electrons and rooms. Not a test file.

`PYTHONPATH=tests python tests/helpers/mjpeg_grid.py QUALITIES ELECTRONS ROOMS POSITIONS CAMERAS [FRAMES]`, lists joined
by commas, prints a line for each cell: rms / bound, pull, fits that failed. POSITIONS x CAMERAS are the draws, of
FRAMES frames each, 1 by default.
"""

from __future__ import annotations

import sys
from itertools import product

import numpy as np
from helpers.chain_scenes import Draws, drawn

from phibench.render.sensor.settings import sensor

BLUR_PX = 0.7


def cell(quality: int, collected_e: float, background_e: float, positions: int, cameras: int, frames: int = 1) -> Draws:
    """Draws of one cell."""
    return drawn(sensor("mjpeg", jpeg_quality=quality), BLUR_PX, collected_e, background_e, positions, cameras, frames)


def line(name: str, found: Draws) -> str:
    """Figures of a cell, each with one standard error."""
    n = found.error_px.size
    error = 1.0 / np.sqrt(2.0 * n)
    ratio, pull, rms = found.over_bound, float(np.sqrt(np.mean(found.pull**2))), np.sqrt(np.mean(found.error_px**2))
    beyond = float(np.mean(np.abs(found.pull) > 1.959964))
    return (
        f"{name}: rms {1e3 * rms:.1f} mpx, rms / bound {ratio:.3f} +- {ratio * error:.3f}, "
        f"pull {pull:.3f} +- {pull * error:.3f}, beyond 95 % {100.0 * beyond:.1f} %, n {n // 2}, failed {found.failed}"
    )


if __name__ == "__main__":
    lists, counts = [[float(x) for x in text.split(",")] for text in sys.argv[1:4]], [int(x) for x in sys.argv[4:]]
    for q, e, b in product(*lists):
        print(line(f"quality {q:g}, {e:g} e- over {b:g} e-", cell(int(q), e, b, *counts)), flush=True)
