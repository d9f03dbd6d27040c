"""Circles of balls whose limb has little contrast: pulls and refusals, of drawn pictures or of photographs.

    python docs/measure_limb_contrast.py drawn 40
    python docs/measure_limb_contrast.py FOLDER      # one ball that stands still, under several lights

Drawn balls stand before a wall that is lit in a pool on one side and goes on in the mirror; numbers are random.
Pulls of photographs are about the median circle of all answers.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from PIL import Image
from scipy import ndimage

from phibench.calibration.outline.ball_circle import BallCircle, find_circle
from phibench.estimator.spots.image_planes import ImageError
from phibench.render.sensor.srgb import srgb_decoded
from phibench.scenes.frames import Array
from phibench.scenes.random_streams import generator

_SIDE = 600


def drawn(number: int) -> tuple[Array, Array]:
    """Linear picture, shape (600, 600), and its circle (u, v, radius)."""
    draw = generator("limb contrast", number)
    u, v = 300.0 + draw.uniform(-20.0, 20.0, 2)
    radius, angle, reach = draw.uniform(180.0, 260.0), draw.uniform(0.0, 2.0 * np.pi), draw.uniform(1.2, 2.2)
    width, level, blur = draw.uniform(0.5, 1.2), draw.uniform(0.15, 0.5), draw.uniform(0.8, 2.5)
    pool = reach * np.cos(angle), reach * np.sin(angle)
    y, x = (np.mgrid[: 3 * _SIDE, : 3 * _SIDE] + 0.5) / 3.0 - 0.5
    X, Y = (x - u) / radius, (y - v) / radius
    z = np.sqrt(np.clip(1.0 - X**2 - Y**2, 0.0, None))
    down = 2.0 * z * z - 1.0
    t = np.where(down < -1e-3, (z + 3.0) / np.maximum(-down, 1e-3), 0.0)

    def wall(px: Array, py: Array) -> Array:
        return np.asarray(0.01 + level * np.exp(-((px - pool[0]) ** 2 + (py - pool[1]) ** 2) / (2.0 * width**2)))

    shown = np.where(down < -1e-3, wall(X + 2.0 * t * z * X, Y + 2.0 * t * z * Y), 0.01)
    light = np.where(X**2 + Y**2 < 1.0, (0.6 + 0.4 * (1.0 - z) ** 5) * shown, wall(X, Y))
    light = ndimage.gaussian_filter(light.reshape(_SIDE, 3, _SIDE, 3).mean(axis=(1, 3)), blur)
    return np.maximum(light + 0.003 * draw.standard_normal(light.shape), 0.0), np.array([u, v, radius])


def main(what: str, count: str = "40") -> None:
    """Print every answer, and the rms of all pulls."""
    answers: list[tuple[BallCircle, Array]] = []
    refused = 0
    photographs = sorted(Path(what).iterdir()) if what != "drawn" else []
    for k in range(int(count) if what == "drawn" else len(photographs)):
        if what == "drawn":
            light, true = drawn(k)
        else:
            with Image.open(photographs[k]) as picture:
                light, true = srgb_decoded(np.asarray(picture.convert("RGB")) / 255.0), np.full(3, np.nan)
        try:
            found = find_circle(light)
        except ImageError as error:
            refused += 1
            print(k, "refused:", str(error)[:90])
            continue
        answers.append((found, true))
        print(k, np.round(found.circle_px, 1), "+-", np.round(found.sigma_px, 1), "true", np.round(true, 1), flush=True)
    circles = np.array([found.circle_px for found, _ in answers])
    middle = np.median(circles, axis=0) if photographs else np.array([true for _, true in answers])
    pulls = (circles - middle) / np.array([found.sigma_px for found, _ in answers])
    print(f"{len(answers)} answers, {refused} refused; rms pull {np.sqrt(np.mean(pulls**2)):.2f}, "
          f"largest {np.abs(pulls).max():.1f}")  # fmt: skip


if __name__ == "__main__":
    main(*sys.argv[1:])
