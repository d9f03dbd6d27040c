"""Rays that meet mirrors of revolution: Dr.Jit against NumPy's ray tracer, and the mesh of the cap."""

from __future__ import annotations

from types import ModuleType

import numpy as np
import pytest
from helpers.revolved_rigs import PROFILES, revolved

from phibench.render.optics.ray_tracer import lens_rays, reflect
from phibench.render.room.mirror_intersection import mirror_intersection
from phibench.render.setup.variant import activate
from phibench.scenes.revolved_mirror import RevolvedMirror


@pytest.fixture(scope="module")
def mi() -> ModuleType:
    return activate()


@pytest.mark.parametrize("aligned", [True, False])
@pytest.mark.parametrize("shape", PROFILES)
def test_accuracy_rays_that_meet_the_mirror(mi: ModuleType, shape: str, *, aligned: bool) -> None:
    """20 000 rays from all over the lens: the same are hits; places to 1e-14 m, normals to 1e-12.

    Float64 over 0.2 m leaves 3e-17 m, grazing incidence makes 100 times as much of it at most. At 0.1 mm from a cone's
    tip that is 3e-13 of the normal.
    """
    view, rng = revolved(shape, aligned=aligned).at(0.3), np.random.default_rng(0)
    uv = view.rig.outline_px().mean(axis=0) + rng.uniform(-420.0, 420.0, (20_000, 2))
    origins, directions = lens_rays(view, uv, rng.uniform(-6e-4, 6e-4, uv.shape))
    rays, start = reflect(view, origins, directions), 1e3 * (origins - view.sphere_centre_m)
    point, normal, found = (
        np.array(x).T for x in mirror_intersection(mi, view)(mi.Vector3d(start.T), mi.Vector3d(directions.T))
    )
    assert np.isfinite(point).all()  # misses as well: what is computed from them must not spoil a sum
    assert np.isfinite(normal).all()
    hit = np.isfinite(rays.cos_incidence)
    assert 5_000 < hit.sum() < 15_000
    assert np.array_equal(found, hit)
    assert np.abs(1e-3 * point + view.sphere_centre_m - rays.points_m)[hit].max() < 1e-14
    assert np.abs(normal - rays.normals)[hit].max() < 1e-12


@pytest.mark.parametrize("shape", PROFILES)
def test_mesh_of_the_cap(shape: str) -> None:
    """Corners on the surface with its normals, facets' middles within what `scene` says of its chords."""
    profile = PROFILES[shape]
    points, normals = RevolvedMirror(profile).grid(450, 900)
    assert points.shape == normals.shape == (450, 900, 3)
    rings = points[:-1]  # a cone's tip has no gradient
    gradient = profile.level(rings).gradient
    assert np.abs(profile.level(rings).value_m).max() < 1e-16
    across = np.cross(gradient / np.linalg.norm(gradient, axis=-1, keepdims=True), normals[:-1])
    assert np.abs(across).max() < 1e-13
    assert (normals[..., 2] < 0.0).all()
    middles = 0.5 * (points[:-1, :-1] + points[1:, 1:])  # the diagonals
    assert np.abs(profile.level(middles).value_m).max() < 1e-6
