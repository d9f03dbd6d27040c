"""Statistics of generated rooms beside those of photographed ones: `compare_rooms.py PANORAMA [PANORAMA ...]`.

Run `draw_rooms.py --sheet` before, both from the repository root. Panoramas are equirectangular pictures that
`phibench` reads, or the packed pictures (`*.exr.js`) of the npm package `@pmndrs/assets`. Both kinds of image become
bands of 256 azimuths, 40 degrees up and down from the horizon: the views in the mirror by the exact reflection, the
panoramas by means over areas. Prints the table of docs/measurements/rooms.md; intervals are of a bootstrap over images.
"""

from __future__ import annotations

import base64
import math
import re
import sys
import tempfile
from pathlib import Path

import numpy as np
from draw_rooms import STROKE_M, VIEWS, coarse_rig
from image_statistics import ImageStatistics, image_statistics
from scipy.stats import ks_2samp, wasserstein_distance

from phibench.datasets.rooms.panorama_files import read_panorama
from phibench.estimator.geometry.panorama import PanoramaGrid, pixels_by_model, unrolled_values

WIDTH, HALF_DEG = 256, 40.0
NAMES = ("red", "green", "blue", "contrast", "slope", "mean_step", "flat", "edges")
_RESAMPLED = 2000
_SCENE_M = 2.5  # distance of what the mirror shows


def rendered() -> list[ImageStatistics]:
    """Statistics of the views of the contact sheet."""
    rig = coarse_rig()
    high = math.radians(HALF_DEG)
    places = pixels_by_model(rig.at(STROKE_M), PanoramaGrid(WIDTH, -high, high), _SCENE_M)
    gain = np.array(rig.camera.detector.band_electrons_per_joule())
    layers = np.load(VIEWS)["electrons_per_s"]
    return [image_statistics(unrolled_values(np.moveaxis(layer, 0, -1) / gain, places)) for layer in layers]


def photographed(path: Path) -> ImageStatistics:
    """Statistics of one panorama."""
    light = _packed(path) if path.name.endswith(".exr.js") else read_panorama(path)
    rows, columns = light.shape[:2]
    times = columns // WIDTH
    if columns % WIDTH or rows * 2 != columns:
        raise SystemExit(f"{path}: {columns} x {rows} pixels; give a multiple of {WIDTH} x {WIDTH // 2}")
    small = light.reshape(WIDTH // 2, times, WIDTH, times, 3).mean(axis=(1, 3))
    cut = round((90.0 - HALF_DEG) / 360.0 * WIDTH)
    return image_statistics(small[cut:-cut])


def _packed(path: Path) -> np.ndarray:
    """Picture of the npm package; its lossy code overshoots below 0 beside lamps."""
    import OpenEXR

    coded = re.search(r"base64,([A-Za-z0-9+/=]+)", path.read_text())
    if coded is None:
        raise SystemExit(f"{path}: holds no picture in base64")
    with tempfile.NamedTemporaryFile(suffix=".exr") as file:
        file.write(base64.b64decode(coded[1]))
        file.flush()
        with OpenEXR.File(file.name) as opened:
            return np.maximum(opened.channels()["RGB"].pixels[..., :3].astype(float), 0.0)


def distances(one: np.ndarray, other: np.ndarray) -> tuple[float, float]:
    """Kolmogorov-Smirnov distance, and Wasserstein distance over the standard deviation of the second sample."""
    spread = float(other.std(ddof=1))
    return float(ks_2samp(one, other).statistic), float(wasserstein_distance(one, other)) / spread


def interval(one: np.ndarray, other: np.ndarray, rng: np.random.Generator) -> tuple[float, float, float]:
    """95 % of the bootstrap of the Wasserstein distance over the second sample's standard deviation, and chance.

    Chance: 95 % of the distances between samples of these sizes, both drawn from the second, are below.
    """
    spread = float(other.std(ddof=1))
    drawn, same = [], []
    for _ in range(_RESAMPLED):
        again = rng.choice(other, len(other))
        drawn.append(wasserstein_distance(rng.choice(one, len(one)), again) / spread)
        same.append(wasserstein_distance(rng.choice(other, len(one)), again) / spread)
    low, high = np.quantile(drawn, (0.025, 0.975))
    return float(low), float(high), float(np.quantile(same, 0.95))


def main() -> None:
    """Print the table."""
    paths = [Path(name) for name in sys.argv[1:]]
    if len(paths) < 3:
        raise SystemExit("give three panoramas or more")
    rooms, photographs, rng = rendered(), [photographed(path) for path in paths], np.random.default_rng(0)
    for path, found in zip(paths, photographs, strict=True):
        print(path.name, *(f"{name} {getattr(found, name):.3f}" for name in NAMES))
    print(f"\n{len(rooms)} generated, {len(photographs)} photographed")
    print(
        "| statistic | photographs | generated | KS | Wasserstein / sd | by chance below |\n|---|---|---|---|---|---|"
    )
    for name in NAMES:
        one, other = (np.array([getattr(found, name) for found in group]) for group in (rooms, photographs))
        ks, moved = distances(one, other)
        low, high, same = interval(one, other, rng)
        cells = [f"{values.mean():.3f} ({values.std(ddof=1):.3f})" for values in (other, one)]
        print(f"| {name} | {cells[0]} | {cells[1]} | {ks:.2f} | {moved:.2f} [{low:.2f}, {high:.2f}] | {same:.2f} |")
    steps = [np.array([found.steps for found in group]) for group in (rooms, photographs)]
    pooled = [np.sort(group.ravel()) for group in steps]
    drawn = [
        wasserstein_distance(*(group[rng.integers(len(group), size=len(group))].ravel() for group in steps))
        for _ in range(200)
    ]
    low, high = np.quantile(drawn, (0.025, 0.975))
    cells = [f"{group.mean():.3f}" for group in (pooled[1], pooled[0])]
    ks = ks_2samp(*pooled).statistic
    print(
        f"| histogram of steps, pooled | {cells[0]} | {cells[1]} | {ks:.2f} | "
        f"{wasserstein_distance(*pooled):.3f} [{low:.3f}, {high:.3f}], not over sd | - |"
    )


if __name__ == "__main__":
    main()
