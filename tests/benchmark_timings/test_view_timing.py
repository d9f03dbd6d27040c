"""Benchmark: CPU time of a view's parts, and of its rays in a bare loop, in one run (`make benchmark`)."""

from __future__ import annotations

import statistics
import time
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from helpers.oracles import TARGETS

from phibench.datasets.store.layers import STORED_TRUTH_PLANES, write_ambient, write_truth
from phibench.datasets.store.pictures import display_exposure_s, save_png, to_srgb
from phibench.render.optics.room_tracer import room_geometry
from phibench.render.optics.truth import truth_layer
from phibench.render.room.ambient_layer import render_ambient, view_film, view_surfaces
from phibench.render.room.light_map import BakeSettings, LightMap, bake
from phibench.render.room.subpixel_grid import CellSampler
from phibench.scenes.room import default_rig, lab

ROOM, RIG = lab(TARGETS), default_rig()
SETTINGS = BakeSettings(lamp_rays=16, bounces=4, bounce_rays=16, final_rays=64)
VIEW = RIG.at(0.425)
RUNS = 5


def parts(light: LightMap, seed: int, folder: Path) -> dict[str, float]:
    """CPU seconds of the parts of a view, all files included."""
    times = [time.process_time()]
    surfaces = view_surfaces(VIEW, ROOM)
    layer = render_ambient(VIEW, ROOM, light, SETTINGS, 2, seed, surfaces=surfaces)
    times.append(time.process_time())
    truth = truth_layer(VIEW, room_geometry(ROOM, VIEW), surfaces.first_patch, STORED_TRUTH_PLANES)
    times.append(time.process_time())
    write_ambient(folder / "ambient.exr", layer.electrons_per_s, layer.variance_per_s2, {})
    write_truth(folder / "truth.exr", truth, {})
    times.append(time.process_time())
    detector = RIG.camera.detector
    exposure = display_exposure_s(layer.electrons_per_s, detector)
    save_png(folder / "preview.png", to_srgb(layer.electrons_per_s, detector, exposure))
    times.append(time.process_time())
    names = ("room's light", "truth", "files of layers", "preview")
    return {**dict(zip(names, np.diff(times).tolist(), strict=True)), "all": times[-1] - times[0]}


def rays(light: LightMap) -> int:
    """Rays of the room's light of a view."""
    counts: list[int] = []
    once, again = CellSampler.sample_once, CellSampler.sample

    def first(self, numbers, *rest):
        counts.append(len(numbers))
        return once(self, numbers, *rest)

    def strata(self, numbers, side, *rest):
        counts.append(int(np.sum(side.astype(int) ** 2)))
        return again(self, numbers, side, *rest)

    with patch.object(CellSampler, "sample_once", first), patch.object(CellSampler, "sample", strata):
        render_ambient(VIEW, ROOM, light, SETTINGS, 2, 0)
    return sum(counts)


def test_benchmark_view_parts(benchmark, tmp_path: Path) -> None:
    if benchmark.disabled:
        pytest.skip("a benchmark")
    light = bake(RIG.at(0.0), ROOM, SETTINGS)
    parts(light, 0, tmp_path)  # warm
    runs = [parts(light, seed, tmp_path) for seed in range(RUNS)]
    figures = {f"{name}_cpu_s": statistics.median(run[name] for run in runs) for name in runs[0]}
    count = rays(light)
    film = view_film(VIEW, ROOM, light, SETTINGS, 2, 0, view_surfaces(VIEW, ROOM))
    numbers = np.resize(film.grid.squares((0, 0, 1280, 720)).ravel(), count)
    bare = []
    for stream in range(RUNS):
        began = time.process_time()
        film.sample_once(numbers, stream, 1)
        bare.append(time.process_time() - began)
    figures["rays"] = count
    figures["bare_loop_cpu_s"] = statistics.median(bare)
    figures["ratio_to_the_bare_loop"] = figures["room's light_cpu_s"] / figures["bare_loop_cpu_s"]
    size = sum((tmp_path / name).stat().st_size for name in ("ambient.exr", "truth.exr"))
    figures["layers_mb"] = size / 1e6
    benchmark.pedantic(lambda: render_ambient(VIEW, ROOM, light, SETTINGS, 2, 3), rounds=1)
    print("\n" + "\n".join(f"{name} {value:.4g}" for name, value in figures.items()))
    benchmark.extra_info.update(figures)
    assert figures["layers_mb"] < 12.5
