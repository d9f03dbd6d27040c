"""Draw the pictures of docs/dense.md: epipolar curves, matches, sweep, a dense answer, and the bound.

Usage: python docs/draw_dense.py DATASET [SAMPLE]
"""

from __future__ import annotations

import io
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from phibench.benchmark.dense.dense_pairs import DenseTruth, dense_pairs
from phibench.benchmark.dense.dense_pictures import DensePicture
from phibench.benchmark.reports.figures import encoded_figure, styled_figure
from phibench.datasets.read import open_dataset
from phibench.estimator.dense.dense_bound import dense_bound
from phibench.estimator.dense.dense_interface import DensePair
from phibench.estimator.dense.dense_methods import DENSE_METHODS
from phibench.estimator.dense.panorama_matchers import codes_8bit
from phibench.estimator.dense.sweep import costs, inverse_levels
from phibench.estimator.dense.unrolled_pair import UnrolledPair, at_places
from phibench.estimator.geometry.reflection import room_rays

OUT = Path(__file__).resolve().parent
SAMPLE = "table2-d3.180-h0.425"
_FEW_COLOURS = {"dense_curves": 128, "dense_sweep": 64}  # are enough, and make a file smaller
_COLUMNS_DEG = (100.0, 20.0, -60.0, -140.0)  # azimuths of the curves
_AT_M = {1.0: ("v", "#d55e00"), 2.0: ("s", "#e69f00"), 4.0: ("D", "#56b4e9"), 10.0: ("o", "#cc79a7")}
_SHOWN_DEG = (-36.0, 20.0)  # elevations
_SWEPT_M = (1.0, 2.0, 4.5)
_PIXEL_DEG = (-75.0, 7.0)  # azimuth and elevation: the chequered board


def curves(unrolled: UnrolledPair) -> bytes:
    """Both panoramas, with columns of the down one and where the up one shows their points at all D."""
    grid = unrolled.maps.grid
    low, high = np.degrees(grid.high_rad - grid.height_px * grid.step_rad), np.degrees(grid.high_rad)
    extent = (180.0, -180.0, float(low), float(high))
    outlined: dict[str, Any] = {"markeredgecolor": "white", "markeredgewidth": 0.8, "linestyle": "none"}
    with styled_figure({"axes.grid": False}, (7.5, 6.6), layout="constrained") as figure:
        axes = figure.subplots(2, 1)
        for one, image, name in zip(axes, (unrolled.down, unrolled.up), ("down", "up"), strict=True):
            one.imshow(codes_8bit(image), cmap="gray", interpolation="nearest", extent=extent, aspect="auto")
            one.set(title=f"{name} image, unrolled", xlabel="azimuth, degrees", ylabel="elevation, degrees")
            one.set(ylim=_SHOWN_DEG, xticks=range(-180, 181, 60))
        for azimuth in _COLUMNS_DEG:
            column = int(np.argmin(np.abs(grid.azimuths_rad - np.radians(azimuth))))
            row = int(np.argmin(np.abs(grid.elevations_rad - np.radians(5.0))))
            axes[0].plot(azimuth, 5.0, "o", color="black", markersize=8, **outlined)
            axes[1].axvline(azimuth, color="white", linewidth=1.0)
            for depth, (marker, colour) in _AT_M.items():
                x, y, z = _seen(unrolled, row, column, depth)
                place = np.degrees([np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))])
                label = f"D = {depth:g} m" if azimuth == _COLUMNS_DEG[0] else None
                axes[1].plot(*place, marker=marker, color=colour, markersize=7, label=label, **outlined)
        axes[1].legend(loc="lower center", ncols=len(_AT_M), fontsize=9)
        return encoded_figure(figure, "png")


def _seen(unrolled: UnrolledPair, row: int, column: int, depth_m: float) -> Any:
    """Direction in which the up image shows a grid point at a D."""
    maps = unrolled.maps
    uv = maps.up_px(1.0 / depth_m)[row, column]
    return room_rays(maps.rig.at(maps.stroke_m), uv).direction_world


def sweep(unrolled: UnrolledPair) -> bytes:
    """Up image fetched at three D, its difference from the down one, and the cost of a pixel by 1 / D."""
    grid = unrolled.maps.grid
    levels = inverse_levels(unrolled.maps)
    row = int(np.argmin(np.abs(grid.elevations_rad - np.radians(_PIXEL_DEG[1]))))
    column = int(np.argmin(np.abs(grid.azimuths_rad - np.radians(_PIXEL_DEG[0]))))
    with styled_figure({"axes.grid": False}, (6.0, 7.4), layout="constrained") as figure:
        axes = figure.subplots(4, 1, height_ratios=(1, 1, 1, 0.7))
        for one, depth in zip(axes, _SWEPT_M, strict=False):
            there = at_places(unrolled.up_spline, unrolled.maps.up_px(1.0 / depth))
            one.imshow(np.abs(unrolled.down - there), cmap="gray_r", vmin=0.0, vmax=25.0, interpolation="nearest")
            one.plot(column, row, "o", color="#d55e00", markersize=5, markerfacecolor="none")
            one.set_title(f"|down - up|, up fetched as if all were at D = {depth:g} m: white agrees", fontsize=9)
            one.set_axis_off()
        axes[3].plot(levels, costs(unrolled, levels)[row, :, column], color="#0072b2")
        for depth in _SWEPT_M:
            axes[3].axvline(1.0 / depth, color="#7f7f7f", linewidth=0.8, linestyle="--")
        axes[3].set(xlabel="1 / D, 1/m", ylabel="cost of the pixel", yticks=[])
        return encoded_figure(figure, "png")


def bound(pair: DensePair, truth: DenseTruth, planes_e: Any, depth_m: Any) -> bytes:
    """Map of the bound, and the error of the sweep against it."""
    from matplotlib.colors import LogNorm

    sigma = dense_bound(truth.true_rig, truth.stroke_m, pair.card, planes_e, truth.depth_m)
    relative = np.where(truth.scored, 100.0 * sigma / truth.depth_m, np.nan)
    picture = DensePicture(pair, truth, depth_m, "dense_sweep")
    error = np.abs(depth_m / truth.depth_m - 1.0) * 100.0
    known = truth.scored & np.isfinite(error) & np.isfinite(relative)
    with styled_figure({"axes.grid": False}, (7.5, 5.4), layout="constrained") as figure:
        above, below = figure.subplots(2, 1, height_ratios=(1.0, 1.1))
        shown = above.imshow(
            picture.unrolled(np.minimum(relative, 1e3)),
            norm=LogNorm(0.03, 30.0),
            cmap="viridis",
            interpolation="nearest",
        )
        figure.colorbar(shown, ax=above, label="least sigma of D, %", extend="both", ticks=[0.1, 1, 10], format="{x:g}")
        above.set_axis_off()
        edges = np.logspace(-1.5, 1.5, 13)
        middles = np.sqrt(edges[1:] * edges[:-1])
        bins = [error[known & (relative >= a) & (relative < b)] for a, b in pairwise(edges)]
        few = [len(inside) < 300 for inside in bins]
        medians = [np.nan if lone else float(np.median(inside)) for inside, lone in zip(bins, few, strict=True)]
        below.loglog(middles, medians, marker="o", color="#0072b2", label="dense_sweep, median |error|")
        below.loglog(middles, 0.6745 * middles, "--", color="black", label="median at the bound")
        below.set(xlabel="least sigma of D in a window of 15 px, %", ylabel="median |error| of D, %")
        below.grid(True, alpha=0.35)
        below.legend()
        return encoded_figure(figure, "png")


def main() -> None:
    """Write the pictures beside this file."""
    dataset = open_dataset(sys.argv[1])
    pairs = dense_pairs(dataset, "mjpeg", 1)
    wanted = sys.argv[2] if len(sys.argv) > 2 else SAMPLE
    number = [draw.sample_id for draw in pairs.pair_draws].index(wanted)
    pair, truth = pairs.pair(number), pairs.truth(number)
    unrolled = UnrolledPair.of(pair)
    answer = DENSE_METHODS["dense_sweep"](pair)
    assert answer.depth_m is not None
    picture = DensePicture(pair, truth, answer.depth_m, "dense_sweep")
    planes = dataset[wanted].ambient("down").astype(float) * pair.card.exposure_s
    pictures = {
        "dense_curves": curves(unrolled),
        "dense_sweep": sweep(unrolled),
        "dense_panoramas": picture.panoramas_png(),
        "dense_above": picture.from_above_png(),
        "dense_bound": bound(pair, truth, planes, answer.depth_m),
    }
    for name, data in pictures.items():
        file = OUT / f"{name}.png"
        picture_file = Image.open(io.BytesIO(data)).convert("RGB")
        if name in _FEW_COLOURS:
            picture_file = picture_file.quantize(_FEW_COLOURS[name], dither=Image.Dither.NONE)
        picture_file.save(file, optimize=True)
        print(f"{file.name}: {file.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
