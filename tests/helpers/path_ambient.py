"""The ambient layer by plain path tracing: slow and noisy, the reference that `ambient` is held against."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.render.plugins.plugin_tree import mitsuba_dict
from phibench.render.plugins.standard_scene import standard_scene
from phibench.render.room.camera_plugin import camera_plugin_dict
from phibench.render.room.surfaces import load_scene
from phibench.render.setup.variant import activate
from phibench.scenes.rig import View
from phibench.scenes.room import Room

Crop = tuple[int, int, int, int]
_PASS = 16  # samples per pixel and pass: bounds the memory


def traced_scene(mi: ModuleType, view: View, room: Room, crop: Crop | None = None) -> Any:
    """Scene of a view, with our sensor instead of the standard one."""
    scene = mitsuba_dict(mi, standard_scene(view, room, light="ambient"))
    return load_scene(mi, scene | {"sensor": camera_plugin_dict(mi, view, crop)})


def path_trace(
    view: View,
    room: Room,
    samples_per_pixel: int,
    max_depth: int,
    seed: int,
    crop: Crop | None = None,
) -> NDArray[np.float32]:
    """Expected photo-electrons per second per pixel, planes R, G, B.

    Parameters
    ----------
    samples_per_pixel : int
        Taken in passes of at most 16, each stratified by the multijitter sampler.
    max_depth : int
        Longest light path; 1 is directly visible lamps, the mirror counts as a bounce.
    seed : int
        Of the named stream for this view; 0 is legal.
    crop : (u0, v0, width, height), or None

    Returns
    -------
    layer : array, shape (3, height, width), float32
    """
    camera = view.rig.camera
    _, _, width, height = crop or (0, 0, camera.width_px, camera.height_px)
    if not any(surface.emits for surface in room.surfaces):
        return np.zeros((3, height, width), dtype=np.float32)
    mi = activate()
    scene = traced_scene(mi, view, room, crop)
    integrator = mi.load_dict({"type": "path", "max_depth": max_depth, "rr_depth": 1000})
    passes = [_PASS] * (samples_per_pixel // _PASS) + [samples_per_pixel % _PASS] * (samples_per_pixel % _PASS > 0)
    seeds = np.random.SeedSequence(seed).generate_state(len(passes), dtype=np.uint32)
    total = np.zeros((height, width, 3))
    for count, pass_seed in zip(passes, seeds, strict=True):
        total += count * np.array(mi.render(scene, integrator=integrator, spp=count, seed=int(pass_seed)))
    return np.ascontiguousarray((total / samples_per_pixel).transpose(2, 0, 1), dtype=np.float32)


def path_runs(
    view: View,
    room: Room,
    samples_per_pixel: int,
    max_depth: int,
    runs: int,
    crop: Crop,
    first_seed: int = 0,
) -> NDArray[np.float32]:
    """Independent runs over a small window, one pass each, shape (runs, 3, height, width); else as `path_trace`."""
    mi = activate()
    scene = traced_scene(mi, view, room, crop)
    integrator = mi.load_dict({"type": "path", "max_depth": max_depth, "rr_depth": 1000})
    # the multijitter sampler lays out the samples of a pass anew for each seed
    seeds = range(first_seed, first_seed + runs)
    images = [np.array(mi.render(scene, integrator=integrator, spp=samples_per_pixel, seed=k)) for k in seeds]
    return np.stack(images).transpose(0, 3, 1, 2)
