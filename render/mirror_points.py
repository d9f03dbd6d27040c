"""Where a view's mirror reflects points of the world to points of the lens, and how far the bundle spreads.

A perfect sphere takes Alhazen's closed problem and Coddington's equations, a form error Fermat's path (`fermat`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from phibench.render.alhazen import reflection_points
from phibench.render.fermat import fermat_points, path_determinant
from phibench.scenes.frames import Array, BoolArray
from phibench.scenes.rig import View


@dataclass(frozen=True)
class MirrorPoints:
    """Reflection points, world frame; NaN where there is none.

    Attributes
    ----------
    points_m, normals : arrays, shape (N, 3)
    lit : bool array, shape (N,)
        Whether both ends see the point.
    """

    points_m: Array
    normals: Array
    lit: BoolArray


def mirror_points(view: View, points_m: Array, eyes_m: Array) -> MirrorPoints:
    """Reflection points for pairs of world points, shape (N, 3) each."""
    centre, mirror = view.sphere_centre_m, view.rig.mirror
    if mirror.form is None:
        found, lit = reflection_points(points_m - centre, eyes_m - centre, mirror.radius_m)
        found = found + centre
        return MirrorPoints(found, (found - centre) / mirror.radius_m, lit)
    axes = view.T_world_sphere.R
    ends = ((points_m - centre) @ axes, (eyes_m - centre) @ axes)
    found, normals, lit = fermat_points(*ends, mirror.radius_m, mirror.form)
    return MirrorPoints(found @ axes.T + centre, normals @ axes.T, lit)


def bundle_spread(view: View, mirror_m: Array, points_m: Array, eyes_m: Array, cos_i: Array) -> Array:
    """Square metres at the eye per steradian at the point, shape (N,), of the bundle that is reflected there.

    With s the distance point to mirror, l mirror to eye and i the angle of incidence, on a sphere
    s^2 (1 + l/s_t) (1 + l/s_s); otherwise s^2 l^2 det(M) / cos^2 i.
    """
    mirror = view.rig.mirror
    s, far = (np.linalg.norm(end - mirror_m, axis=-1) for end in (points_m, eyes_m))
    if mirror.form is None:
        spread = s**2 * (1.0 + far * (1.0 / s + 2.0 / (mirror.radius_m * cos_i)))
        return spread * (1.0 + far * (1.0 / s + 2.0 * cos_i / mirror.radius_m))
    axes, centre = view.T_world_sphere.R, view.sphere_centre_m
    P, a, b = ((place - centre) @ axes for place in (mirror_m, points_m, eyes_m))
    return (s * far / cos_i) ** 2 * path_determinant(P, a, b, mirror.radius_m, mirror.form)
