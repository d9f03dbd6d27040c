"""Light map of a room, baked once: irradiance of every texel from lamps, sun and all bounces, and its smoothing.

First what comes from lamps and the sun (`lamp_light`), then the bounces over a coarse grid (`bounced_light`). Last a
gather over the fine grid from the full map, in two independent halves; `smoothed_mean` keeps what both agree on.
Rays start all over a texel: it holds the mean of the light on what is free of it, and a shadow's edge moves by nothing.
The mirror ball itself (12 cm), its holder and the carriage are left out of the room's light. Carriage and holder are
lit by the map when a view is rendered (`ambient_layer`).

Smoothing: a texel's value may be replaced by a straight-line fit through its neighbours, along rows and columns. Let
S_r be the fit over r texels to each side, and a, b the halves. The expectation of (S_r a - b)^2 is bias^2 + var(S_r a)
+ var(b). The r with the least of it, averaged around a texel, is taken there. So shadows and edges stay as they are.

Bright texels are noisier: they are smoothed, and dark ones beside them, which are left as they are, do not get what
these lose. Fits at borders lose some as well. A floor lost 0.33 % of its light, a bright part of it 1.4 %. What the
smoothed texels around have lost on average is given back to them.

The standard error is half the difference of the smoothed halves. What smoothing blurs is not in it: at a single texel
it cannot be told from noise. docs/measurements/light.md has the true errors of the lab.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from functools import lru_cache
from types import ModuleType

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from phibench.render.optics.faces import IntArray, TexelGrid, face_table
from phibench.render.room.bounced_light import (
    BrightTexels,
    bounced_light,
    finer_values,
    gathered_light,
    needed_rays,
    rays_by_area,
    rays_by_noise,
)
from phibench.render.room.lamp_light import direct_light, lamps_in_coats
from phibench.render.room.surfaces import Surfaces
from phibench.render.room.texel_points import Texels, covered_texels, nearest_free, spread_texels
from phibench.render.setup.variant import activate
from phibench.scenes.frames import Array, BoolArray
from phibench.scenes.rig import RobotPose, View
from phibench.scenes.room import Room, chassis
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
    final_rays: int = 128


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


def fixed_shapes(room: Room, robot: RobotPose | None = None) -> tuple[Shape, ...]:
    """Shapes of a room that stand still: everything but the carriage, the mirror and its holder."""
    return (*room.surfaces, *room.furniture, *(chassis(robot) if room.robot else ()))


def texel_count(room: Room, texel_m: float) -> int:
    """Number of texels of a room's light map."""
    return TexelGrid.of(face_table(fixed_shapes(room)), texel_m).count


def bake(view: View, room: Room, settings: BakeSettings) -> LightMap:
    """Light map of a room; `view` only gives the origin of the scene's coordinates, and where the robot stands."""
    mi = activate()
    import drjit as dr

    surfaces = Surfaces(mi, view, face_table(fixed_shapes(room, view.robot)))
    grid = TexelGrid.of(surfaces.table, settings.texel_m)
    if not grid.count:  # all surfaces shine by themselves
        none = np.zeros((0, 3), dtype=np.float32)
        return LightMap(none, none, np.zeros(0, dtype=bool))
    fine, covered = _spread_texels(mi, surfaces, grid, settings.texel_m)
    surfaces.set_light(fine.grid, np.zeros((len(fine), 3)))
    free = nearest_free(covered, fine.grid)
    needed = needed_rays(np.ones(len(fine), dtype=np.int64), covered, free) > 0
    direct = direct_light(mi, surfaces, fine, room.sun, settings.lamp_rays, _SEED, needed=needed)
    one, other = ((half + lamps_in_coats(mi, surfaces, fine, _SEED + 20 + k))[free] for k, half in enumerate(direct))
    lamps, noise = smoothed_mean(fine.grid, one, other, _KEPT_OF_LAMPS)
    bounced, coarse, pilot = bounced_light(
        mi, surfaces, fine.grid, lamps, settings.texel_m, settings.bounces, settings.bounce_rays, _SEED + 10
    )
    lit = lamps + bounced
    surfaces.set_light(fine.grid, lit)
    bright = BrightTexels.of(mi, surfaces, fine.grid, lit)
    mean, sigma = _indirect(mi, surfaces, fine, covered, free, settings, bright, (coarse, pilot))
    dr.flush_malloc_cache()  # arrays that Dr.Jit keeps for the next time, of other sizes than a view's
    total = np.maximum(mean, 0.0) + np.maximum(lamps, 0.0)  # a straight line through noise may end below 0
    return LightMap(total.astype(np.float32), np.hypot(noise, sigma).astype(np.float32), covered)


def _spread_texels(mi: ModuleType, surfaces: Surfaces, grid: TexelGrid, near_m: float) -> tuple[Texels, BoolArray]:
    """Texels whose values are means over what is free of them, and which of them are covered."""
    texels = Texels.of(mi, surfaces, grid)
    spread = spread_texels(mi, surfaces, texels)
    assert spread.spread is not None
    return spread, covered_texels(mi, surfaces, texels, near_m) & spread.spread.hidden


def _indirect(
    mi: ModuleType,
    surfaces: Surfaces,
    fine: Texels,
    covered: BoolArray,
    free: IntArray,
    settings: BakeSettings,
    bright: BrightTexels | None,
    pilot: tuple[TexelGrid, Array],
) -> tuple[Array, Array]:
    """Irradiance by all surfaces, from the present map, and its standard error, shape (texels, 3) each.

    The pilot, a grid and two halves, shares no ray with what it places: rays that decide for themselves err.
    """
    texels, largest_m = fine, max(settings.indirect_texel_m, settings.texel_m)
    if settings.indirect_texel_m > settings.texel_m:
        grid = TexelGrid.of(surfaces.table, settings.indirect_texel_m)
        texels, covered = _spread_texels(mi, surfaces, grid, settings.texel_m)
        free = nearest_free(covered, grid)
    # two independent halves: half their difference is the standard error of their mean
    rays = needed_rays(rays_by_area(texels.grid, settings.final_rays, largest_m), covered, free)
    coarse, values = pilot
    rays = rays_by_noise(rays, texels.grid, np.stack([finer_values(coarse, texels.grid, half) for half in values]))
    halves = [gathered_light(mi, surfaces, texels, rays, 2 + 3 * i, bright, lamps=False)[free] for i in (0, 1)]
    mean, sigma = smoothed_mean(texels.grid, halves[0], halves[1], _KEPT_OF_SURFACES)
    if texels is fine:
        return mean, sigma
    return finer_values(texels.grid, fine.grid, mean), finer_values(texels.grid, fine.grid, sigma)


def interpolated_light_map(one: LightMap, other: LightMap, share: float) -> LightMap:
    """Light map of a room between two places of its robot: irradiances in proportion."""
    if share in (0.0, 1.0):
        return other if share else one
    keep, take = np.float32(1.0 - share), np.float32(share)
    light = keep * one.irradiance_w_m2 + take * other.irradiance_w_m2
    sigma = np.hypot(keep * one.sigma_w_m2, take * other.sigma_w_m2)
    return LightMap(light, sigma, one.covered & other.covered)


# Light maps as files.

ARRAYS = {"irradiance_w_m2": ("<f4", 2), "sigma_w_m2": ("<f4", 2), "covered": ("|b1", 1)}
"""Type and number of axes of each array of a file."""


def light_map_bytes(light: LightMap) -> bytes:
    """Bytes of an `.npz` file."""
    buffer = io.BytesIO()
    np.savez(buffer, **{name: getattr(light, name) for name in ARRAYS})
    return buffer.getvalue()


# -- smoothing, decided by two independent halves ---------------------------------------------------------------------

_REACHES = (1, 2, 4)  # texels to each side
_AROUND = 5  # texels over which the choice is averaged
_FEWEST = 12  # texels of a grid that is smoothed


def smoothed_mean(grid: TexelGrid, a: Array, b: Array, kept: int) -> tuple[Array, Array]:
    """Mean of two halves, shape (texels, 3), smoothed, and its standard error.

    Parameters
    ----------
    kept : int, odd
        Means of smoothed texels over squares of so many along a side are kept. Small ones leave more of the noise.
    """
    mean, variance = 0.5 * (a + b), (0.5 * (a - b)) ** 2
    for texels in grid.alike:
        if texels[0].size >= _FEWEST:
            mean[texels], variance[texels] = _best(a[texels], b[texels], kept)
    return mean, np.sqrt(variance)


def _best(a: Array, b: Array, kept: int) -> tuple[Array, Array]:
    """Mean and variance of grids, each texel with the reach that serves it best; shape (grids, rows, columns, 3)."""
    # the reach 0, in which a itself is compared with b
    best, least = [a, b], _around(2.0 * ((a - b) ** 2).sum(axis=-1, keepdims=True))[..., 0]
    changed = np.zeros((*least.shape, 1), dtype=bool)
    for reach in _REACHES:
        one, other = (_fit(half, reach) for half in (a, b))
        error = _around(((one - b) ** 2 + (other - a) ** 2).sum(axis=-1, keepdims=True))[..., 0]
        better = (error < least)[..., None]
        best = [np.where(better, new, old) for new, old in zip((one, other), best, strict=True)]
        least = np.minimum(least, error)
        changed |= better
    # given back to none but smoothed texels, and not to rounding: what is dark beside them stays dark
    changed &= (best[0] != 0.0).any(axis=-1, keepdims=True)
    share = np.divide(changed, _around(changed.astype(float), kept), where=changed, out=np.zeros(changed.shape))
    one, other = (fit + share * _around(half - fit, kept) for fit, half in zip(best, (a, b), strict=True))
    return 0.5 * (one + other), (0.5 * (one - other)) ** 2


def _around(image: Array, side: int = _AROUND) -> Array:
    return np.asarray(ndimage.uniform_filter(image, size=(1, side, side, 1), mode="nearest"))


def _fit(image: Array, reach: int) -> Array:
    """Straight-line fits along both axes."""
    rows, columns = (line_fit(length, reach) for length in image.shape[1:3])
    down = np.matmul(rows, image.reshape(*image.shape[:2], -1)).reshape(image.shape)  # einsum takes 20 times as long
    return np.matmul(columns, down)


@lru_cache(maxsize=512)
def line_fit(length: int, reach: int) -> Array:
    """Matrix (length, length) of straight-line fits over `reach` places to each side; the identity below 4 places."""
    if length < 4:
        return np.eye(length)
    matrix = np.zeros((length, length))
    for i in range(length):
        low, high = max(i - reach, 0), min(i + reach + 1, length)
        x = np.arange(low, high) - float(i)
        centred = x - x.mean()
        # value at x = 0 of the line through the window's points
        matrix[i, low:high] = 1.0 / len(x) - x.mean() * centred / (centred @ centred)
    return matrix
