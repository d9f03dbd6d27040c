"""Kernels that trace rays in a bake, a view's own light and a panorama: every ray is traced once.

Dr.Jit is lazy: of a loop's outputs, or of a hit's, each that is converted alone runs the loop, or traces the rays,
anew. What follows counts the kernels that call Embree.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from helpers.oracles import TARGETS

from phibench.render.room.ambient_layer import render_ambient, view_film, view_surfaces
from phibench.render.room.bounced_light import BrightTexels
from phibench.render.room.light_map import BakeSettings, LightMap, bake
from phibench.render.room.rendered_panorama import rendered_panorama
from phibench.render.room.subpixel_grid import CellSampler, Samples
from phibench.render.room.texel_points import Net
from phibench.render.setup.variant import activate
from phibench.scenes.holder import fitted_holder
from phibench.scenes.room import Room, default_rig, lab
from phibench.scenes.shapes import Rectangle, rectangle

ROOM, RIG = lab(TARGETS), default_rig()
SETTINGS = BakeSettings(texel_m=0.5, indirect_texel_m=1.0, lamp_rays=16, bounces=2, bounce_rays=8, final_rays=16)
LAMPS = sum(isinstance(one, Rectangle) and one.emits for one in ROOM.surfaces)
OF_LAMPS = 3  # their first rays, then those of both halves
GRIDS = 3 + 2  # of lamps, bounces and surfaces: which of their texels are covered; and where two of them are free
NEEDED_SAMPLES, NEEDED_KERNELS = 16.7, 20
NEEDED_RAYS = 95.0
GATHERS = 3  # of the bounces, and of two halves


@pytest.fixture(scope="module")
def baked() -> tuple[LightMap, list[dict[str, Any]]]:
    return kernels(lambda: bake(RIG.at(0.0), ROOM, SETTINGS))


def kernels(work: Callable[[], Any]) -> tuple[Any, list[dict[str, Any]]]:
    """What some work returns, and its kernels."""
    activate()
    import drjit as dr

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        result = work()
        found = dr.kernel_history([dr.KernelType.JIT])
        dr.kernel_history_clear()
    return result, found


def tracing(found: list[dict[str, Any]]) -> int:
    """How many kernels trace rays: Embree's function is the one thing that they call by its address."""
    return sum("call void %" in kernel["ir"].getvalue() for kernel in found)


def test_a_bake_traces_every_ray_once(baked: tuple[LightMap, list[dict[str, Any]]]) -> None:
    """Four times for each lamp and three times for each grid, before outputs were evaluated together."""
    _, found = baked
    assert tracing(found) == GRIDS + OF_LAMPS + GATHERS


def test_a_bake_looks_up_its_light_once(baked: tuple[LightMap, list[dict[str, Any]]]) -> None:
    """Kernels at all: those that trace, three that prepare rays, a lamp's closed form, a bounce's look-up."""
    _, found = baked
    assert len(found) <= tracing(found) + 3 * (OF_LAMPS + GATHERS) + LAMPS + SETTINGS.bounces + 1


def test_a_bake_takes_few_rays() -> None:
    """At most 1.3 times the rays of a free texel that `lab` needs here: 77 to lamps, 9 of the bounces, 9 of the gather.

    Eight go to every lamp that a texel faces; where it is partly hidden, 16 in the mean follow, twice.
    """
    counts: list[int] = []
    plain = Net.of

    def counted(mi: Any, lanes: Any, rays: np.ndarray, *rest: Any) -> Net:
        counts.append(int(rays.sum()))
        return plain(mi, lanes, rays, *rest)

    with patch.object(Net, "of", counted):
        light = bake(RIG.at(0.0), ROOM, SETTINGS)
    found = sum(counts) / np.count_nonzero(~light.covered)
    print(counts, found)
    assert found < 1.3 * NEEDED_RAYS


def test_a_bake_with_coats_and_a_bright_ceiling_traces_every_ray_once() -> None:
    """Photons of both halves meet a coat three times. A gather follows what a coat mirrors, and aims at the ceiling.

    Nothing hides the lamp: it gets its first rays alone.
    """
    floor = rectangle("floor", (0, 0, 0), (0, 0, 1), (4, 4), coat=1.5)
    ceiling = rectangle("ceiling", (0, 0, 2.5), (0, 0, -1), (4, 4), coat=1.5)
    lamp = rectangle("lamp", (0, 0, 2.4), (0, 0, 1), (0.2, 0.2), radiance_w_m2_sr=(9.0, 9.0, 9.0))
    room = Room("uplight", (floor, ceiling, lamp), (), robot=False)
    with patch.object(BrightTexels, "weight", autospec=True, side_effect=BrightTexels.weight) as weight:
        light, found = kernels(lambda: bake(RIG.at(0.0), room, SETTINGS))
    assert light.irradiance_w_m2.min() > 0.0
    assert weight.call_count >= 2 * GATHERS  # of those that aim, and of the others
    assert tracing(found) == GRIDS + 1 + 2 * (1 + 3) + GATHERS + 1  # rays of the bounces that aim are stored apart


def test_a_view_takes_few_samples_and_few_kernels(baked: tuple[LightMap, list[dict[str, Any]]]) -> None:
    """A part of the mirror with tiles, edges and a lamp: at most 1.3 times the samples and kernels that it needs.

    Every pixel has a scout and a sample. Edges and textures add cells, and strata where these leave too much noise:
    16.7 samples a pixel in all. It took 32.8 when cells were refined blindly.
    """
    window, counts = (560, 100, 240, 200), []
    view = RIG.at(0.425)
    surfaces = view_surfaces(view, ROOM)

    def once(self: CellSampler, numbers: np.ndarray, stream: int, parts: int = 0) -> Samples:
        counts.append(len(numbers))
        return plain(self, numbers, stream, parts)

    def again(self: CellSampler, numbers: np.ndarray, side: np.ndarray, *rest: Any) -> Samples:
        counts.append(int(np.sum(side.astype(int) ** 2)))
        return strata(self, numbers, side, *rest)

    plain, strata = CellSampler.sample_once, CellSampler.sample
    with patch.object(CellSampler, "sample_once", once), patch.object(CellSampler, "sample", again):
        _, found = kernels(lambda: render_ambient(view, ROOM, baked[0], SETTINGS, 2, 0, window, surfaces=surfaces))
    samples = sum(counts) / (window[2] * window[3])
    print(samples, tracing(found), len(found))
    assert samples < 1.3 * NEEDED_SAMPLES
    assert tracing(found) < 1.3 * NEEDED_KERNELS


def test_a_view_lights_its_holder_once(baked: tuple[LightMap, list[dict[str, Any]]]) -> None:
    """Lamps as above, what the mirror takes and gives, and the gather."""
    view = dataclasses.replace(RIG, holder=fitted_holder("rods", RIG.mirror.radius_m)).at(0.3)
    surfaces = view_surfaces(view, ROOM)
    _, found = kernels(lambda: view_film(view, ROOM, baked[0], SETTINGS, 2, 0, surfaces))
    assert tracing(found) == OF_LAMPS + 1 + 1


def test_a_panorama_traces_every_ray_once(baked: tuple[LightMap, list[dict[str, Any]]]) -> None:
    place = (0.5, 0.2, 1.5)
    _, found = kernels(lambda: rendered_panorama(RIG.at(0.0), ROOM, baked[0], SETTINGS, place, 0.0, 16))
    assert tracing(found) == 1
