"""The spot by brute force: Mitsuba's path tracer against the spot layer, on a crop around the spot's image."""

from __future__ import annotations

import math
from types import ModuleType
from typing import Any

import numpy as np

from phibench.render.optics.spot_layer import spot_layer
from phibench.render.optics.truth import spot_truth
from phibench.render.plugins.plugin_tree import Plugin, mitsuba_dict
from phibench.render.plugins.room_plugins import grid_plugin, mirror_bsdf, mirror_plugin, to_scene_mm
from phibench.render.room.camera_plugin import MM_PER_M, camera_plugin_dict
from phibench.render.room.surfaces import load_scene
from phibench.scenes.frames import rotation_facing
from phibench.scenes.laser import LaserSpot
from phibench.scenes.revolved_mirror import RevolvedMirror
from phibench.scenes.rig import Rig, View

_PATCH_M, _FACETS = 3e-3, 400  # half the side of a fine part of the mirror, and facets along it


def _spot_scene(mi: ModuleType, view: View, spot: LaserSpot, crop: tuple[int, int, int, int]) -> Any:
    """Mirror, sensor and the spot as a disk emitter of the spot's own radiance in every band."""
    radius = MM_PER_M * spot.diameter_m / 2.0
    matrix = np.eye(4)
    matrix[:3, :3] = np.array(rotation_facing(spot.normal_world))
    matrix[:3, 3] = to_scene_mm(view, np.array(spot.position_world_m))
    radiance = {"type": "rgb", "value": [float(spot.radiance_w_m2_sr(0.0))] * 3}
    disk = {
        "type": "disk",
        "to_world": mi.ScalarTransform4f(matrix) @ mi.ScalarTransform4f().scale([radius, radius, 1.0]),
        "emitter": {"type": "area", "radiance": radiance},
        "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.0, 0.0, 0.0]}},
    }
    sensor = camera_plugin_dict(mi, view, crop) | {"sampler": {"type": "independent"}}
    scene = mitsuba_dict(mi, Plugin("scene", "scene", {"mirror": _mirror(view, spot)}))
    return load_scene(mi, scene | {"sensor": sensor, "spot": disk})


def _brute_force(
    mi: ModuleType, view: View, spot: LaserSpot, crop: tuple[int, int, int, int], paths: float
) -> np.ndarray:
    """Electrons per second (height, width) of the crop by the `path` integrator, and their standard error."""
    scene = _spot_scene(mi, view, spot, crop)
    integrator = mi.load_dict({"type": "path", "max_depth": 3})
    per_pass = 2**16  # samples per pixel and pass; float32 sums stay exact enough, passes add up in float64
    count = math.ceil(paths / (per_pass * crop[2] * crop[3]))
    seeds = np.random.SeedSequence(7).generate_state(count, dtype=np.uint32)
    passes = [np.array(mi.render(scene, integrator=integrator, spp=per_pass, seed=int(s)))[..., 0] for s in seeds]
    return np.array(passes, dtype=float)


def _mirror(view: View, spot: LaserSpot) -> Plugin:
    """The mirror; of a mirror of revolution the part around the spot's image, with facets of 15 micrometres.

    Interpolated normals bend the map from the film to the wall in each facet, by as much as their error of 6e-6 rad
    over one facet of the whole cap's mesh, some 2 px: 0.1 % of the flux. It falls with the facet's side.
    """
    mirror = view.rig.mirror
    if not isinstance(mirror, RevolvedMirror):
        return mirror_plugin(view)
    place = np.array([spot_truth(view, spot, ()).reflection_point_world_m])
    x, y, _ = ((place - view.sphere_centre_m) @ view.T_world_sphere.R)[0]
    radius, turn, steps = math.hypot(x, y), math.atan2(y, x), np.linspace(-1.0, 1.0, _FACETS + 1)
    assert _PATCH_M < radius < mirror.profile.rim_radius_m - _PATCH_M
    grid = mirror.profile.grid(radius - _PATCH_M * steps, turn + _PATCH_M / radius * steps)
    bsdf = mirror_bsdf(mirror, view.rig.camera.detector.band_wavelength_nm)
    return grid_plugin(view, *grid, bsdf, closed=False)


def compare(mi: ModuleType, rig: Rig, spot: LaserSpot, half: int, paths: float) -> dict[str, float]:
    """Flux ratio and largest column-share difference of path tracing and spot layer on a crop, with standard errors."""
    view = rig.at(0.3)
    truth = spot_truth(view, spot, ())
    u0, v0, size = round(truth.u_px) - half, round(truth.v_px) - half, 2 * half + 1
    passes = _brute_force(mi, view, spot, (u0, v0, size, size), paths)
    layer = spot_layer(view, spot, ())
    ours = np.pad(layer.electrons_per_s[0], 60)[
        v0 - layer.v0_px + 60 : v0 - layer.v0_px + 60 + size, u0 - layer.u0_px + 60 : u0 - layer.u0_px + 60 + size
    ]
    image, sums = passes.mean(axis=0), passes.sum(axis=(1, 2))
    share, share_ours = image.sum(axis=0) / image.sum(), ours.sum(axis=0) / ours.sum()
    error = sums.std(ddof=1) / math.sqrt(len(sums)) / sums.mean()
    figures = {
        "flux": image.sum() / ours.sum() - 1.0,
        "flux_error": error,
        "share": float(np.abs(share - share_ours).max()),
        "inside": ours.sum() / layer.total_electrons_per_s[0],
        "largest_share": float(share_ours.max()),
        "paths": passes.shape[0] * 2**16 * size**2,
    }
    print(figures)
    return figures
