"""Light that the mirror takes from what stands beside it, and the light that it throws there.

Light maps leave the mirror out: it is small for a room. It is not small for its holder, whose rods stand a quarter of
its radius away. Seen from a texel a ball around the mirror fills a cone. In that cone rays compare what is behind the
mirror with what the mirror shows, and the difference is added. Lamps and the sun behind the mirror are tested ray by
ray (`lamp_light`). A spherical mirror is perfect and smooth here: a form error moves what a black rod mirrors by less
than it matters. A mirror of revolution is closed by a black disc in the plane of its rim, its back.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np

from phibench.render.room.camera_plugin import MM_PER_M
from phibench.render.room.mirror_intersection import mirror_intersection
from phibench.render.room.shading import mirror_bands
from phibench.render.room.subpixel_grid import points, shifts
from phibench.render.room.surfaces import Surfaces
from phibench.render.room.texel_points import Texels, transmitted
from phibench.scenes.frames import Array
from phibench.scenes.revolved_mirror import RevolvedMirror
from phibench.scenes.rig import View

_PLACES = 401  # of a profile
_MARGIN = 1.001  # of the ball around it


@dataclass(frozen=True)
class MirrorBody:
    """The mirror as rays from beside it meet it; in the scene, mm.

    Attributes
    ----------
    centre, radius : Dr.Jit
        Of a ball that holds it.
    meets : callable
        From points and unit directions to masks of rays that meet it, their distances from it, outward unit normals
        there, and masks of what mirrors.
    """

    centre: Any
    radius: Any
    meets: Callable[[Any, Any], tuple[Any, Any, Any, Any]]


def mirror_body(mi: ModuleType, view: View) -> MirrorBody | None:
    """Mirror of a view; None without a holder: it then has nothing beside it that is lit."""
    if view.rig.holder is None:
        return None
    mirror = view.rig.mirror
    return _ball(mi, mirror.radius_m) if mirror.radius_m is not None else _revolved(mi, view, mirror)


def _ball(mi: ModuleType, radius_m: float) -> MirrorBody:
    import drjit as dr

    radius = dr.opaque(mi.Float, MM_PER_M * radius_m)

    def meets(point: Any, way: Any) -> tuple[Any, Any, Any, Any]:
        approach = -dr.dot(point, way)
        foot = point + approach * way
        square = dr.square(radius) - dr.squared_norm(foot)
        near, met = approach - dr.sqrt(dr.maximum(square, 0.0)), (square > 0.0) & (approach > 0.0)
        return met, near, (point + near * way) / radius, met

    return MirrorBody(mi.Vector3f(0.0), radius, meets)


def _revolved(mi: ModuleType, view: View, mirror: RevolvedMirror) -> MirrorBody:
    import drjit as dr

    meeting, axes, profile = mirror_intersection(mi, view), view.T_world_sphere.R, mirror.profile
    r = np.linspace(0.0, profile.rim_radius_m, _PLACES)
    z, depth_m = profile.sag(r * r).z_m, profile.depth_m
    middle_m = min(depth_m, 0.5 * (profile.rim_radius_m**2 + depth_m**2) / depth_m)
    radius_m = _MARGIN * float(np.hypot(r, z - middle_m).max()) + mirror.reach_m
    axis = mi.Vector3d(*(dr.opaque(mi.Float64, float(a)) for a in axes[:, 2]))
    depth, rim2 = (
        dr.opaque(mi.Float64, value) for value in (MM_PER_M * depth_m, (MM_PER_M * profile.rim_radius_m) ** 2)
    )

    def meets(point: Any, way: Any) -> tuple[Any, Any, Any, Any]:
        o, d = mi.Vector3d(point), mi.Vector3d(way)
        place, normal, found = meeting(o, d)
        front = found & (dr.dot(normal, d) < 0.0)
        near = dr.select(front, dr.norm(place - o), dr.inf)
        fall = dr.dot(axis, d)
        down = (depth - dr.dot(axis, o)) / fall
        across = o + down * d - depth * axis
        back = (fall < 0.0) & (down > 0.0) & (dr.squared_norm(across) <= rim2) & (down < near)
        met = front | back
        distance = dr.select(back, down, dr.select(front, near, 0.0))
        return met, mi.Float(distance), mi.Vector3f(dr.select(back, axis, normal)), front & ~back

    centre = MM_PER_M * middle_m * axes[:, 2]
    return MirrorBody(
        mi.Vector3f(*(dr.opaque(mi.Float, float(c)) for c in centre)), dr.opaque(mi.Float, MM_PER_M * radius_m), meets
    )


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
