"""Limbs of real mirror balls beside simulated ones, through the same measures: a table of `reality.md`.

    git clone https://github.com/FrostKiwi/Mirrorball
    phibench dataset make paper-misaligned --out out/limbs
    python docs/draw_limbs.py Mirrorball/assets/media out/limbs --samples 29

Give a folder of photographs and a data set. No photograph is copied. All pictures are made smaller by whole squares of
pixels, so that the outline's radius is near that of the C310, and looked for by `find_circle` alone.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.calibration.outline.ball_circle import BallCircle, find_circle, shrunk_picture
from phibench.calibration.outline.edge_ring import TURNS, EdgeRing
from phibench.calibration.rig.from_dataset import photograph
from phibench.datasets.read import open_dataset
from phibench.datasets.rooms.panorama_files import read_light
from phibench.estimator.spots.camera_codes import light_of, rgb_picture
from phibench.estimator.spots.image_planes import ImageError

Array = NDArray[Any]
RADIUS_PX = 339.0
SECTORS = 120
LEAST_STEP = 0.15  # of the light: of an edge whose spread is measured


def photographs(folder: Path) -> Iterator[tuple[str, Array]]:
    """Name and linear light of each photograph."""
    for path in sorted(folder.glob("*.jpg")):
        yield path.stem, read_light(path)


def frames(folder: Path, most: int) -> Iterator[tuple[str, Array]]:
    """Name and linear light of an MJPEG frame of each sample, down and up in turn."""
    dataset = open_dataset(folder)
    for number, sample in enumerate(islice(dataset, most)):
        image = photograph(dataset, sample, ("down", "up")[number % 2], "mjpeg")
        table = light_of(np.arange(256) / 255.0, image.card).astype(np.float32)
        yield sample.row.sample_id, table[rgb_picture(image.pixels, image.card)]


def at_one_size(light: Array) -> tuple[Array, BallCircle]:
    """The picture in squares that make the outline's radius about `RADIUS_PX`, and its outline."""
    block = max(1, round(find_circle(light).circle_px[2] / RADIUS_PX))
    small = shrunk_picture(light, block)
    return small, find_circle(small)


def measures(light: Array, circle: BallCircle) -> dict[str, float]:
    """Measures of one limb; NaN for what it does not tell."""
    off = circle.off_px
    some = off[np.isfinite(off)]
    return {
        "turns with an edge": circle.edges,
        "edge spread, 10 to 90 %, px": spread(light, circle),
        "residual along the limb, px rms": 1.4826 * float(np.median(np.abs(some - np.median(some)))),
        "correlation of the residual at 3 deg": correlation(off, 3),
        "correlation of the residual at 10 deg": correlation(off, 10),
        "second harmonic over radius, 1e-3": 1e3 * float(np.hypot(*circle.ellipse_px)) / circle.circle_px[2],
        "claimed sigma of the radius, px": float(circle.sigma_px[2]),
    }


def correlation(off: Array, turns: int) -> float:
    """Correlation of residuals that many of the 360 turns apart."""
    here, there = off - np.nanmean(off), np.roll(off - np.nanmean(off), turns)
    both = np.isfinite(here) & np.isfinite(there)
    if np.count_nonzero(both) < TURNS // 4:
        return np.nan
    return float(np.mean(here[both] * there[both]) / np.nanmean((off - np.nanmean(off)) ** 2))


def spread(light: Array, circle: BallCircle) -> float:
    """Median distance from 10 to 90 % of the step across the limb, of sectors with a clear one."""
    u, v, radius = circle.circle_px
    ring = EdgeRing(light.mean(axis=-1)[None], (u, v, radius), 10.0, 0.25)
    profile = ring.light[0].reshape(SECTORS, -1, len(ring.distances_px)).mean(axis=1)
    d, found = ring.distances_px, []
    far, near = (d > 4.0) & (d < 8.0), (d < -4.0) & (d > -8.0)
    for one in profile:
        low, high = float(one[near].mean()), float(one[far].mean())
        flat = max(float(one[near].std()), float(one[far].std()))
        if abs(high - low) < LEAST_STEP * max(high, low) or flat > 0.15 * abs(high - low):
            continue
        share = np.maximum.accumulate((one - low) / (high - low))
        found.append(float(np.interp(0.9, share, d) - np.interp(0.1, share, d)))
    return float(np.median(found)) if len(found) >= 5 else np.nan


def column(pictures: Iterator[tuple[str, Array]]) -> tuple[list[dict[str, float]], int]:
    """Measures of the pictures whose outline is found, and how many are refused."""
    found, refused = [], 0
    for name, light in pictures:
        try:
            found.append(measures(*at_one_size(light)))
            print(name, {key: round(value, 3) for key, value in found[-1].items()}, flush=True)
        except ImageError:
            refused += 1
    return found, refused


def cell(values: Sequence[float]) -> str:
    """Mean and 95 % interval of what is known."""
    known = np.array([value for value in values if np.isfinite(value)])
    if len(known) < 3:
        return "-"
    return f"{known.mean():.2f} +- {1.96 * known.std(ddof=1) / np.sqrt(len(known)):.2f} ({len(known)})"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photographs", type=Path)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--samples", type=int, default=20)
    options = parser.parse_args()
    real, refused = column(photographs(options.photographs))
    simulated, lost = column(frames(options.dataset, options.samples))
    print(f"\n| measure | real, {len(real)} ({refused} refused) | simulated, {len(simulated)} ({lost} refused) |")
    print("|---|---|---|")
    for name in real[0]:
        print(f"| {name} | {cell([one[name] for one in real])} | {cell([one[name] for one in simulated])} |")


if __name__ == "__main__":
    main()
