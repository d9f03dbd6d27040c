"""Light that the mirror ball takes from what stands beside it, and the light that it throws there.

Light maps leave the ball out: it is small for a room. It is not small for its holder, whose rods stand a quarter of its
radius away. Seen from a texel the ball fills a cone. In that cone rays compare what is behind the ball with what the
ball mirrors, and the difference is added. Lamps and the sun behind the ball are tested ray by ray (`lamp_light`).
The ball is a perfect and smooth sphere here: a form error moves what a black rod mirrors by less than it matters.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np

from phibench.render.room.camera_plugin import MM_PER_M
from phibench.render.room.shading import mirror_bands
from phibench.render.room.subpixel_grid import points, shifts
from phibench.render.room.surfaces import Surfaces
from phibench.render.room.texel_points import Texels, transmitted
from phibench.scenes.frames import Array


def meets_ball(radius_mm: Any, point: Any, way: Any) -> tuple[Any, Any]:
    """Mask of rays (scene, mm) that meet the ball, whose centre is the origin, and their distances from it."""
    import drjit as dr

    approach = -dr.dot(point, way)
    foot = point + approach * way
    square = dr.square(radius_mm) - dr.squared_norm(foot)
    return (square > 0.0) & (approach > 0.0), approach - dr.sqrt(dr.maximum(square, 0.0))


def ball_light(mi: ModuleType, surfaces: Surfaces, texels: Texels, rays: int, seed: int) -> Array:
    """Change of the irradiance by the ball, shape (texels, 3): what it mirrors, less what surfaces behind it send."""
    import drjit as dr

    rig = surfaces.view.rig
    radius = dr.opaque(mi.Float, MM_PER_M * rig.sphere.radius_m)
    bands = mirror_bands(mi, rig)
    point, normal, lanes = texels.points, texels.normals, dr.arange(mi.UInt32, len(texels))
    distance = dr.norm(point)
    rim = dr.safe_sqrt(1.0 - dr.square(dr.minimum(radius / distance, 1.0)))  # cosine of the cone's half angle
    frame = mi.Frame3f(-point / distance)
    key, count = (dr.opaque(mi.UInt32, value) for value in (seed, rays))
    shift = shifts(mi, lanes, 2, key)
    dr.eval(shift, rim, frame)

    def body(i: Any, total: Any) -> tuple[Any, Any]:
        x, y = points(mi, shift, i)
        c = 1.0 - x * (1.0 - rim)
        sine, turn = dr.safe_sqrt(1.0 - c * c), 2.0 * dr.pi * y
        way = frame.to_world(mi.Vector3f(sine * dr.cos(turn), sine * dr.sin(turn), c))
        cos = dr.dot(way, normal)
        met, near = meets_ball(radius, point, way)
        met &= cos > 0.0
        ray = mi.Ray3f(point, way)
        t, patch, valid = surfaces.hit(ray, met, coherent=False)
        met &= ~valid | (t > near)
        behind = surfaces.radiance(patch, ray(t), way, met & valid, lamps=False)
        at = point + near * way
        facet = at / radius
        cos_ball = dr.maximum(-dr.dot(way, facet), 0.0)
        onward = mi.Ray3f(at, way + 2.0 * cos_ball * facet)
        t, patch, valid = surfaces.hit(onward, met, coherent=False)
        mirrored = surfaces.radiance(patch, onward(t), onward.d, valid, lamps=True)
        mirrored *= mi.Color3f(*(band(cos_ball) for band in bands))
        weight = dr.select(met, cos, 0.0)
        if texels.coat is not None:
            weight *= transmitted(surfaces, texels.coat, cos)
        return i + 1, total + weight * (mirrored - behind)

    start = (mi.UInt32(0), dr.zeros(mi.Color3f, len(texels)))
    _, total = dr.while_loop(start, lambda i, _: i < count, body)
    cone = 2.0 * np.pi * (1.0 - np.array(rim, dtype=float)) / rays
    return cone[:, None] * np.stack([np.array(total[k], dtype=float) for k in range(3)], axis=-1)
