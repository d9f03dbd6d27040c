"""Mirror as standard Mitsuba plugins: a sphere, or a fine mesh, of a conductor.

A mirror that is no perfect sphere is a triangle mesh. The normals, which steer the reflection, are those of the surface
at the corners and interpolated between. With e the side of a facet and k the curvature, facets lie within k e^2 / 8 of
the surface. With a form error e is R (0.4 degrees): 0.4 micrometres. The cap of a mirror of revolution has facets of
0.4 degrees around the axis and of pi / 900 rim radii along it: 0.4 micrometres for a rim radius of 60 mm. Interpolated
normals err by some (0.4 degrees)^2 / 8 = 6e-6 rad, which is 0.002 px.

The steel's n and k are taken at each band's wavelength: layers are per colour filter.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from phibench.render.plugins.plugin_tree import Plugin, Rgb, Triangles, Value
from phibench.render.room.camera_plugin import MM_PER_M
from phibench.scenes.frames import Array, Vector
from phibench.scenes.metals import MetalSurface
from phibench.scenes.rig import View
from phibench.scenes.room import MIRROR_NAME
from phibench.scenes.validation import SceneError

_RINGS, _SPOKES = 450, 900  # 0.4 degrees apart


def mirror_plugin(view: View) -> Plugin:
    """The mirror: a sphere at the origin, or a mesh.

    Raises
    ------
    SceneError
        If no standard plugin reflects as it does.
    """
    mirror = view.rig.mirror
    bsdf = mirror_bsdf(mirror, view.rig.camera.detector.band_wavelength_nm)
    if mirror.radius_m is not None and mirror.form is None:
        ball: dict[str, Value] = {"radius": MM_PER_M * mirror.radius_m, "bsdf": bsdf}
        return Plugin("shape", "sphere", ball, MIRROR_NAME, MIRROR_NAME)
    return grid_plugin(view, *mirror.grid(_RINGS, _SPOKES), bsdf, closed=True)


def mirror_bsdf(mirror: MetalSurface, wavelengths_nm: Vector) -> Plugin:
    """Smooth or rough conductor with the metal's n and k at the bands' wavelengths.

    A measured reflectance that is a factor of the metal's, or one for all angles, is a factor of the conductor.

    Raises
    ------
    SceneError
        Of a reflectance that depends on the angle otherwise.
    """
    bands = [mirror.band(nm) for nm in wavelengths_nm]
    values: dict[str, Value] = {"eta": Rgb(tuple(band.index.real for band in bands))}
    values["k"] = Rgb(tuple(band.index.imag for band in bands))
    table = mirror.reflectance_table
    if table is not None and (len(table.angle_deg) > 1 or any(band.loss < 1.0 for band in bands)):
        what = (
            f"a measured reflectance at {len(table.angle_deg)} angles"
            if table.angle_deg
            else "a measured reflectance above that of its metal"
        )
        raise SceneError(
            f"the mirror has {what}, which no standard plugin of Mitsuba reflects: allowed are the metal's own, one "
            "below it, and one for all angles; render a sample whose mirror has one of these"
        )
    if table is not None and table.angle_deg:
        values = {"material": "none", "specular_reflectance": Rgb(tuple(float(band.values[0]) for band in bands))}
    elif table is not None:
        values["specular_reflectance"] = Rgb(tuple(band.gain for band in bands))
    if mirror.roughness_alpha > 0.0:
        rough: dict[str, Value] = {"distribution": "beckmann", "alpha": mirror.roughness_alpha}
        return Plugin("bsdf", "roughconductor", rough | values)
    return Plugin("bsdf", "conductor", values)


def grid_plugin(view: View, points_m: Array, normals: Array, bsdf: Plugin, *, closed: bool) -> Plugin:
    """Mesh of a grid of points in the mirror's frame.

    Parameters
    ----------
    points_m, normals : arrays, shape (rings, spokes, 3)
        Outside is where spokes times rings point: the side that mirrors.
    bsdf
    closed : bool
        Whether the last spoke has the first beside it.
    """
    corners = MM_PER_M * points_m.reshape(-1, 3)
    mesh = Triangles(MIRROR_NAME, corners, grid_triangles(*points_m.shape[:2], closed=closed), normals.reshape(-1, 3))
    to_world = np.eye(4)
    to_world[:3, :3] = view.T_world_sphere.R
    return Plugin("shape", "ply", {"filename": mesh, "to_world": to_world, "bsdf": bsdf}, MIRROR_NAME, MIRROR_NAME)


def grid_triangles(rings: int, spokes: int, *, closed: bool) -> NDArray[np.int64]:
    """Corners of the triangles between the rings, outside first, shape (n, 3)."""
    ring, spoke = np.mgrid[0 : rings - 1, 0 : spokes - (not closed)]
    a, b = spokes * ring + spoke, spokes * ring + (spoke + 1) % spokes
    c, d = a + spokes, b + spokes
    return np.concatenate([np.stack([a, c, b], -1), np.stack([b, c, d], -1)]).reshape(-1, 3)
