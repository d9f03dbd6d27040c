"""Benchmark: CPU time of a view at equal noise, light map against path tracing, both in one run (`make benchmark`)."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from helpers.oracles import TARGETS
from helpers.path_ambient import traced_scene

from phibench.render.room.ambient_layer import render_ambient
from phibench.render.room.light_map import BakeSettings, LightMap, bake
from phibench.render.setup.variant import activate
from phibench.scenes.room import c310_rig, lab

ROOM, RIG, SETTINGS = lab(TARGETS), c310_rig(), BakeSettings()
VIEW = RIG.at(0.425)  # lens, blur, distortion, 1280 x 720
POSES = 18  # of `paper`, which share a light map
WANTED = 0.003  # noise in the mirror disc
PATH_SAMPLES = 32


def cpu(function: Callable[[], Any]) -> tuple[float, Any]:
    """CPU seconds of this process, and what came out."""
    began = time.process_time()
    result = function()
    return time.process_time() - began, result


def noise(a: np.ndarray, b: np.ndarray) -> float:
    """Relative noise of one of two independent images in the mirror disc, robust: median of |a - b| for a Gaussian."""
    v, u = np.mgrid[:720, :1280]
    disc = np.hypot(u - 639.5, v - 359.5) < 330.0
    difference = np.abs(a[:, disc] - b[:, disc]) / (0.5 * (a[:, disc] + b[:, disc]))
    return float(np.median(difference)) / 0.6745 / np.sqrt(2.0)


def trace(seed: int) -> np.ndarray:
    """`path` with the multijitter sampler and Mitsuba's own Russian roulette."""
    mi = activate()
    scene = traced_scene(mi, VIEW, ROOM)
    integrator = mi.load_dict({"type": "path", "max_depth": 16})
    image = np.array(mi.render(scene, integrator=integrator, spp=PATH_SAMPLES, seed=seed), dtype=float)
    return image.transpose(2, 0, 1)


def with_map_noise(light: LightMap, seed: int) -> LightMap:
    """The light map as it might have come out, by its own standard errors."""
    drawn = np.random.default_rng(seed).normal(size=light.irradiance_w_m2.shape) * light.sigma_w_m2
    return LightMap((light.irradiance_w_m2 + drawn).astype(np.float32), light.sigma_w_m2, light.covered)


def test_benchmark_equal_noise(benchmark) -> None:
    if benchmark.disabled:
        pytest.skip("a benchmark")
    bake_s, light = cpu(lambda: bake(RIG.at(0.0), ROOM, SETTINGS))
    render_ambient(VIEW, ROOM, light, SETTINGS, 2, 0)  # warm
    looks = [cpu(lambda s=s: render_ambient(VIEW, ROOM, light, SETTINGS, 2, s, rounds=0)) for s in (1, 2)]
    full = [cpu(lambda s=s: render_ambient(VIEW, ROOM, light, SETTINGS, 2, s)) for s in (1, 2)]
    benchmark.pedantic(lambda: render_ambient(VIEW, ROOM, light, SETTINGS, 2, 3), rounds=3)
    other = render_ambient(VIEW, ROOM, with_map_noise(light, 2), SETTINGS, 2, 2, rounds=0)
    first = render_ambient(VIEW, ROOM, with_map_noise(light, 1), SETTINGS, 2, 1, rounds=0)
    look_s, full_s = (min(seconds for seconds, _ in runs) for runs in (looks, full))
    look, kept = (noise(*(layer.electrons_per_s.astype(float) for _, layer in runs)) for runs in (looks, full))
    total = noise(first.electrons_per_s.astype(float), other.electrons_per_s.astype(float))
    traced = [cpu(lambda s=s: trace(s)) for s in (1, 2)]
    path_noise, path_s = noise(traced[0][1], traced[1][1]), min(seconds for seconds, _ in traced)
    equal_s = path_s * (path_noise / WANTED) ** 2
    figures = {
        "bake_cpu_s": bake_s,
        "view_without_refinement_cpu_s": look_s,
        "view_cpu_s": full_s,
        "noise_without_refinement": look,
        "noise": kept,
        "noise_with_light_map": total,
        "path_cpu_s": path_s,
        "path_noise": path_noise,
        "path_cpu_s_for_0.3_percent": equal_s,
        "ratio_at_equal_noise": equal_s / look_s,
        "ratio_of_the_view_with_budget": equal_s / full_s,
        "ratio_with_bake_shared_by_18": equal_s / (look_s + bake_s / POSES),
        "ratio_of_the_view_with_budget_and_bake": equal_s / (full_s + bake_s / POSES),
    }
    print("\n" + "\n".join(f"{name} {value:.4g}" for name, value in figures.items()))
    benchmark.extra_info.update(figures)
    assert total <= WANTED
    assert figures["ratio_at_equal_noise"] >= 1000.0
    assert figures["ratio_with_bake_shared_by_18"] >= 100.0
