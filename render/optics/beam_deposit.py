"""Light of a laser beam on the surfaces that it meets (`deposit`): bare or coated, with Fresnel transmittance.

The beam is parallel over its width of a few millimetres. Each place across it runs from `BEAM_REACH_M` before the
spot's centre to the first surface, at most as far behind it. What lands elsewhere is not part of the spot; recipes
refuse such spots (`recipe.spot_placement`). The robot, which carries the laser, stops none of it.

A bare surface of albedo a is Lambertian: of the power P it sends P a cos(theta_o) / pi into each steradian. A coated
one is a smooth dielectric of index n over a diffuse ground (Mitsuba's `plastic`, nonlinear; Weidlich and Wilkie,
"Arbitrarily layered micro-facet surfaces", 2007). With T = 1 - F the Fresnel transmittance and f the diffuse
reflectance of the coat from inside,

P T(theta_i) T(theta_o) / n^2  a / (1 - a f)  cos(theta_o) / pi,        f = 1 - (1 - F_mean) / n^2,

F_mean = 2 integral of F(mu) mu dmu over [0, 1] (reciprocity gives f from it). What the coat mirrors leaves the spot
in one direction and is left out. Lamps and backs of one-sided faces scatter nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial.legendre import leggauss

from phibench.render.optics.faces import FaceTable, IntArray
from phibench.render.optics.room_tracer import RoomGeometry
from phibench.scenes.frames import Array
from phibench.scenes.laser import LaserSpot
from phibench.scenes.shapes import Bitmap, Checker

BEAM_REACH_M = 0.25  # before and behind the spot's centre, along the beam


@dataclass(frozen=True)
class Deposit:
    """Light that N places across a beam leave on surfaces.

    Attributes
    ----------
    points_m : array, shape (N, 3); NaN where nothing is met
    normals : array, shape (N, 3)
        On the side that the beam comes from.
    strength : array, shape (N,)
        Share of the power that is scattered: the albedo, or T(theta_i) / n^2 a / (1 - a f) below a coat; 0 for what
        scatters nothing.
    coat : array, shape (N,)
        Refractive index; 0 is none.
    patch : int array, shape (N,)
        Face; -1 where nothing is met, and for flat spots.
    """

    points_m: Array
    normals: Array
    strength: Array
    coat: Array
    patch: IntArray

    def __getitem__(self, n: IntArray | slice) -> Deposit:
        return Deposit(self.points_m[n], self.normals[n], self.strength[n], self.coat[n], self.patch[n])

    @property
    def lit(self) -> IntArray:
        """Numbers of the places that scatter any light."""
        return np.flatnonzero(self.strength > 0.0)

    def scattered(self, leaving: Array) -> Array:
        """Power per steradian and watt, 1/sr, shape (N,), in unit directions (N, 3)."""
        cos = np.maximum(np.einsum("ni,ni->n", leaving, self.normals), 0.0)
        return self.strength / np.pi * cos * np.where(self.coat > 0.0, transmittance(cos, self.coat), 1.0)


def deposit(spot: LaserSpot, room: RoomGeometry, disc: Array) -> Deposit:
    """Deposit of places (N, 2) across the beam, in units of `spot.scale_m`; of a flat spot, its disc."""
    count = len(disc)
    across = np.array(spot.position_world_m) + spot.scale_m * disc @ np.stack(spot.across_beam())
    if spot.beam_direction_world is None:
        assert spot.albedo is not None
        normals = np.broadcast_to(np.array(spot.normal_world), (count, 3))
        return Deposit(across, normals, np.full(count, spot.albedo), np.zeros(count), np.full(count, -1))
    beam = np.array(spot.beam_direction_world)
    starts, own = across - BEAM_REACH_M * beam, room.without_robot
    hits = own.first_hit(starts, np.broadcast_to(beam, (count, 3)), np.full(count, 2.0 * BEAM_REACH_M))
    way = np.where(hits.patch >= 0, hits.distance_m, np.nan) - BEAM_REACH_M
    points = across + way[:, None] * beam
    return _scattering(spot, own.table, hits.patch, points)


def footprint(spot: LaserSpot, disc: Array) -> Array:
    """Points (N, 3) where places (N, 2) across the beam would land if the spot's plane went on without end."""
    offset = spot.scale_m * disc @ np.stack(spot.across_beam())
    if spot.beam_direction_world is not None:
        beam, normal = np.array(spot.beam_direction_world), np.array(spot.normal_world)
        offset = offset - (offset @ normal / (beam @ normal))[:, None] * beam
    return np.array(spot.position_world_m) + offset


def is_plain_spot(spot: LaserSpot, room: RoomGeometry, light: Deposit) -> bool:
    """True for a flat spot, and where places of a beam all lie on one face and in one colour of it."""
    if spot.beam_direction_world is None:
        return True
    if light.patch[0] < 0 or np.any(light.patch != light.patch[0]):
        return False
    table = room.without_robot.table
    texture = table.textures[table.texture[light.patch[0]]]
    if spot.albedo is not None or not isinstance(texture, Bitmap | Checker):
        return True
    cells = np.floor(table.places(light.patch, light.points_m))
    return isinstance(texture, Checker) and bool(np.all(cells == cells[0]))


def transmittance(cos: Array, n: Array) -> Array:
    """1 - F of unpolarised light that enters a dielectric of index n, shape of `cos`, the cosine outside."""
    n = np.where(n > 0.0, n, 1.0)
    inside = np.sqrt(1.0 - (1.0 - cos * cos) / (n * n))
    with np.errstate(invalid="ignore"):  # 0 / 0: grazing incidence without a coat
        r_s, r_p = (cos - n * inside) / (cos + n * inside), (n * cos - inside) / (n * cos + inside)
    return 1.0 - 0.5 * (r_s * r_s + r_p * r_p)


def inside_reflectance(n: float) -> float:
    """Diffuse reflectance f of a coat from inside."""
    x, weight = leggauss(64)
    mu = 0.5 * (x + 1.0)
    mean_transmittance = float(weight @ (mu * transmittance(mu, np.full_like(mu, n))))
    return 1.0 - mean_transmittance / (n * n)


def _scattering(spot: LaserSpot, table: FaceTable, patch: IntArray, points: Array) -> Deposit:
    """Deposit at points (N, 3) on faces (N,)."""
    met = patch >= 0
    face = np.where(met, patch, 0)
    if not len(table.shape):
        return Deposit(points, np.zeros_like(points), np.zeros(len(patch)), np.zeros(len(patch)), patch)
    normals = table.normal[face]
    cos = -normals @ np.array(spot.beam_direction_world)
    scatters = met & ((cos > 0.0) | table.two_sided[face]) & ~table.emits[face]
    normals, cos = np.where(cos[:, None] < 0.0, -normals, normals), np.abs(cos)
    if spot.albedo is not None:
        return Deposit(points, normals, np.where(scatters, spot.albedo, 0.0), np.zeros(len(patch)), patch)
    albedo, coat = np.zeros(len(patch)), table.coat[face]
    albedo[scatters] = table.laser_albedo(patch[scatters], points[scatters])
    strength = albedo.copy()
    for n in np.unique(coat[coat > 0.0]):
        below = coat == n
        ground = albedo[below] / (1.0 - albedo[below] * inside_reflectance(float(n)))
        strength[below] = transmittance(cos[below], coat[below]) / n**2 * ground
    return Deposit(points, normals, strength, coat, patch)
