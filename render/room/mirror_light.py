"""Light that the mirror takes from what stands beside it, and the light that it throws there.

Light maps leave the mirror out: it is small for a room. It is not small for its holder, whose rods stand a quarter of
its radius away. Seen from a texel a ball around the mirror fills a cone. In that cone rays compare what is behind the
mirror with what the mirror shows, and the difference is added. Lamps and the sun behind the mirror are tested ray by
ray (`lamp_light`). A spherical mirror is perfect and smooth here: a form error moves what a black rod mirrors by less
than it matters. A mirror of revolution is closed by a black disc in the plane of its rim, its back.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np

from phibench.render.room.mirror_intersection import MirrorBody
from phibench.render.room.shading import mirror_bands
from phibench.render.room.subpixel_grid import points, shifts
from phibench.render.room.surfaces import Surfaces
from phibench.render.room.texel_points import Texels, transmitted
from phibench.scenes.frames import Array


def mirror_light(mi: ModuleType, surfaces: Surfaces, texels: Texels, mirror: MirrorBody, rays: int, seed: int) -> Array:
    """Change of the irradiance by the mirror, shape (texels, 3): what it shows, less what surfaces behind it send."""
    import drjit as dr

    bands = mirror_bands(mi, surfaces.view.rig)
    point, normal, lanes = texels.points, texels.normals, dr.arange(mi.UInt32, len(texels))
    way_there = mirror.centre - mi.Vector3f(point)
    distance = dr.norm(way_there)
    rim = dr.safe_sqrt(1.0 - dr.square(dr.minimum(mirror.radius / distance, 1.0)))  # cosine of the cone's half angle
    rim = dr.select(distance > mirror.radius, rim, -1.0)
    frame = mi.Frame3f(way_there / distance)
    key, count = (dr.opaque(mi.UInt32, value) for value in (seed, rays))
    shift = shifts(mi, lanes, 2, key)
    dr.eval(shift, rim, frame)

    def body(i: Any, total: Any) -> tuple[Any, Any]:
        x, y = points(mi, shift, i)
        c = 1.0 - x * (1.0 - rim)
        sine, turn = dr.safe_sqrt(1.0 - c * c), 2.0 * dr.pi * y
        way = frame.to_world(mi.Vector3f(sine * dr.cos(turn), sine * dr.sin(turn), c))
        cos = dr.dot(way, normal)
        met, near, facet, shows = mirror.meets(point, way)
        met &= cos > 0.0
        ray = mi.Ray3f(point, way)
        t, patch, valid = surfaces.hit(ray, met, coherent=False)
        met &= ~valid | (t > near)
        behind = surfaces.radiance(patch, ray(t), way, met & valid, lamps=False)
        at = point + near * way
        cos_mirror = dr.maximum(-dr.dot(way, facet), 0.0)
        onward = mi.Ray3f(at, way + 2.0 * cos_mirror * facet)
        t, patch, valid = surfaces.hit(onward, met & shows, coherent=False)
        mirrored = surfaces.radiance(patch, onward(t), onward.d, valid, lamps=True)
        mirrored *= mi.Color3f(*(band(cos_mirror) for band in bands))
        weight = dr.select(met, cos, 0.0)
        if texels.coat is not None:
            weight *= transmitted(surfaces, texels.coat, cos)
        return i + 1, total + weight * (mirrored - behind)

    start = (mi.UInt32(0), dr.zeros(mi.Color3f, len(texels)))
    _, total = dr.while_loop(start, lambda i, _: i < count, body)
    dr.eval(total)  # its bands together: each would run the loop anew
    cone = 2.0 * np.pi * (1.0 - np.array(rim, dtype=float)) / rays
    return cone[:, None] * np.stack([np.array(total[k], dtype=float) for k in range(3)], axis=-1)
