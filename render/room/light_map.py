"""Light map of a room: irradiance of every texel, from lamps, the sun and all bounces. Baked once for a room.

First what comes from lamps and the sun (`lamp_light`), then the bounces over a coarse grid (`bounced_light`). Last a
gather over the fine grid from the full map, in two independent halves; what both agree on is smoothed
(`irradiance_filter`).
The mirror ball itself (12 cm), its holder and the carriage are left out of the room's light. Carriage and holder are
lit by the map when a view is rendered.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from phibench.render.room.ball_light import ball_light
from phibench.render.room.bounced_light import bounced_light, finer, gathered
from phibench.render.room.camera_plugin import MM_PER_M
from phibench.render.room.irradiance_filter import smoothed
from phibench.render.room.lamp_light import direct_light
from phibench.render.room.surfaces import Surfaces
from phibench.render.room.texel_grid import TexelGrid
from phibench.render.room.texel_points import Texels, covered_texels, filled
from phibench.render.setup.variant import activate
from phibench.scenes.faces import face_table
from phibench.scenes.frames import Array, BoolArray
from phibench.scenes.rig import View
from phibench.scenes.room import Room, Sun, chassis
from phibench.scenes.shapes import Shape

# texels along a side over which smoothing keeps the mean: light of surfaces changes slowly
_KEPT_OF_LAMPS, _KEPT_OF_SURFACES = 5, 9
_SEED = 0  # the shifts are part of the quadrature rule; the two halves use different streams


@dataclass(frozen=True)
class BakeSettings:
    """Size of texels and numbers of rays per texel (defaults: 0.3 % noise in the furnished lab).

    What comes from other surfaces than lamps changes slowly: it has texels of its own, `indirect_texel_m`.
    """

    texel_m: float = 0.05
    indirect_texel_m: float = 0.1
    lamp_rays: int = 64
    bounces: int = 12
    bounce_rays: int = 64
    final_rays: int = 384


@dataclass(frozen=True)
class LightMap:
    """Irradiance of all texels of a room.

    Attributes
    ----------
    irradiance_w_m2 : array, shape (texels, 3), float32
        Per ambient band; texels that are covered by another shape hold their nearest neighbour's.
    sigma_w_m2 : array, shape (texels, 3), float32
        Standard error, from two independent halves.
    covered : bool array, shape (texels,)
    """

    irradiance_w_m2: NDArray[np.float32]
    sigma_w_m2: NDArray[np.float32]
    covered: BoolArray


def fixed_shapes(room: Room) -> tuple[Shape, ...]:
    """Shapes of a room that stand still: everything but the carriage, the mirror and its holder."""
    return (*room.surfaces, *room.furniture, *(chassis() if room.robot else ()))


def texel_count(room: Room, texel_m: float) -> int:
    """Number of texels of a room's light map."""
    return TexelGrid.of(face_table(fixed_shapes(room)), texel_m).count


def bake(view: View, room: Room, settings: BakeSettings) -> LightMap:
    """Light map of a room; `view` only gives the origin of the scene's coordinates."""
    mi = activate()
    import drjit as dr

    surfaces = Surfaces(mi, view, face_table(fixed_shapes(room)))
    grid = TexelGrid.of(surfaces.table, settings.texel_m)
    if not grid.count:  # all surfaces shine by themselves
        none = np.zeros((0, 3), dtype=np.float32)
        return LightMap(none, none, np.zeros(0, dtype=bool))
    fine = Texels.of(mi, surfaces, grid)
    covered = covered_texels(mi, surfaces, fine, settings.texel_m)
    surfaces.set_light(fine.grid, np.zeros((len(fine), 3)))
    direct = direct_light(mi, surfaces, fine, room.sun, settings.lamp_rays, _SEED)
    one, other = (filled(half, covered, fine.grid) for half in direct)
    lamps, noise = smoothed(fine.grid, one, other, _KEPT_OF_LAMPS)
    lit = lamps + bounced_light(
        mi, surfaces, fine.grid, lamps, settings.texel_m, settings.bounces, settings.bounce_rays, _SEED + 10
    )
    surfaces.set_light(fine.grid, lit)
    mean, sigma = _indirect(mi, surfaces, fine, covered, settings)
    dr.flush_malloc_cache()  # arrays that Dr.Jit keeps for the next time, of other sizes than a view's
    total = np.maximum(mean, 0.0) + np.maximum(lamps, 0.0)  # a straight line through noise may end below 0
    return LightMap(total.astype(np.float32), np.hypot(noise, sigma).astype(np.float32), covered)


def _indirect(
    mi: ModuleType, surfaces: Surfaces, fine: Texels, covered: BoolArray, settings: BakeSettings
) -> tuple[Array, Array]:
    """Irradiance by all surfaces, from the present map, and its standard error, shape (texels, 3) each."""
    texels, hidden = fine, covered
    if settings.indirect_texel_m > settings.texel_m:
        texels = Texels.of(mi, surfaces, TexelGrid.of(surfaces.table, settings.indirect_texel_m))
        hidden = covered_texels(mi, surfaces, texels, settings.texel_m)
    # two independent halves: half their difference is the standard error of their mean
    halves = [
        filled(gathered(mi, surfaces, texels, settings.final_rays, 2 + 2 * i), hidden, texels.grid) for i in (0, 1)
    ]
    mean, sigma = smoothed(texels.grid, halves[0], halves[1], _KEPT_OF_SURFACES)
    if texels is fine:
        return mean, sigma
    return finer(texels.grid, fine.grid, mean), finer(texels.grid, fine.grid, sigma)


def light_carriage(
    surfaces: Surfaces,
    grid: TexelGrid,
    fixed: int,
    irradiance: NDArray[np.float32],
    settings: BakeSettings,
    sun: Sun | None = None,
) -> NDArray[np.float32]:
    """Irradiance of all texels of a view: the map for the `fixed` first patches, gathered now for the others.

    With a holder, which stands close to it, the mirror ball takes and gives light as well (`ball_light`).
    """
    mi = activate()
    first = grid.texels_of(fixed)
    full = np.zeros((grid.count, 3), dtype=np.float32)
    full[:first] = irradiance
    surfaces.set_light(grid, full)
    if first < grid.count:
        texels = Texels.of(mi, surfaces, grid, first)
        rig = surfaces.view.rig
        ball_mm = 0.0 if rig.holder is None else MM_PER_M * rig.mirror.radius_m
        rays = _HOLDER_RAYS if ball_mm else _CARRIAGE_RAYS
        direct = direct_light(mi, surfaces, texels, sun, settings.lamp_rays, _SEED, ball_mm)
        light = 0.5 * (direct[0] + direct[1]) + gathered(mi, surfaces, texels, rays, _SEED + 2)
        if ball_mm:
            light = np.maximum(light + ball_light(mi, surfaces, texels, rays, _SEED + 3), 0.0)
        full[first:] = light
        surfaces.set_light(grid, full)
    return full


_CARRIAGE_RAYS = 1024
_HOLDER_RAYS = 256  # its texels are many and small; 1024 rays would take 3 CPU-s for each view


# Light maps as files.

ARRAYS = {"irradiance_w_m2": ("<f4", 2), "sigma_w_m2": ("<f4", 2), "covered": ("|b1", 1)}
"""Type and number of axes of each array of a file."""


def encoded(light: LightMap) -> bytes:
    """Bytes of an `.npz` file."""
    buffer = io.BytesIO()
    np.savez(buffer, **{name: getattr(light, name) for name in ARRAYS})
    return buffer.getvalue()
