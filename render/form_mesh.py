"""A mirror with a form error as a triangle mesh, for the reference by path tracing alone.

Facets 0.4 degrees wide lie within R (0.4 degrees)^2 / 8 = 0.4 micrometres of the surface; the normals, which steer the
reflection, are those of the surface at the corners and interpolated between.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.render.c310_plugin import MM_PER_M
from phibench.scenes.form import deviation, level
from phibench.scenes.frames import Array
from phibench.scenes.rig import View

_RINGS, _SPOKES = 450, 900


def form_mesh(mi: ModuleType, view: View, name: str, bsdf: Any) -> Any:
    """Mesh in the scene's coordinates: millimetres, world axes, the sphere centre at the origin."""
    mirror, axes = view.rig.mirror, view.T_world_sphere.R
    assert mirror.form is not None
    n = _directions()
    points = (mirror.radius_m + deviation(n, mirror.form).value_m)[:, None] * n
    normals = level(points, mirror.radius_m, mirror.form).gradient
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    props = mi.Properties()
    props["bsdf"] = bsdf
    triangles = _triangles()
    mesh = mi.Mesh(name, len(n), len(triangles), has_vertex_normals=True, props=props)
    buffers = mi.traverse(mesh)
    buffers["vertex_positions"] = (MM_PER_M * points @ axes.T).ravel().astype(np.float32)
    buffers["vertex_normals"] = (normals @ axes.T).ravel().astype(np.float32)
    buffers["faces"] = triangles.ravel()
    buffers.update()
    return mesh


def _directions() -> Array:
    """Unit vectors on rings from pole to pole, shape (rings * spokes, 3)."""
    polar = np.linspace(0.0, np.pi, _RINGS)[:, None]
    turn = np.linspace(0.0, 2.0 * np.pi, _SPOKES, endpoint=False)
    grid = np.broadcast_arrays(np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar))
    return np.stack(grid, axis=-1).reshape(-1, 3)


def _triangles() -> NDArray[np.uint32]:
    """Corners of the triangles between the rings, outside first, shape (n, 3)."""
    ring, spoke = np.mgrid[0 : _RINGS - 1, 0:_SPOKES]
    a, b = _SPOKES * ring + spoke, _SPOKES * ring + (spoke + 1) % _SPOKES
    c, d = a + _SPOKES, b + _SPOKES
    return np.concatenate([np.stack([a, c, b], -1), np.stack([b, c, d], -1)]).reshape(-1, 3).astype(np.uint32)
