"""Image of a room for a camera anywhere, by one ray per pixel into its baked light map; quick image of a spot; NumPy.

The ray of a pixel's centre goes to the mirror and on into the room. The face that it meets sends out what
`render.room.surfaces` says: albedo x irradiance / pi below its coat, what the coat mirrors, and what a lamp emits. The
optical blur and the pixel's own width are a Gaussian over the pixels afterwards.

The room is written in the world frame, rig and robot in the rig's. `placement` leads from the rig's frame to the world.
The robot is not in the light map: it takes no light from the room, and sends out its albedo times the mean irradiance
of level surfaces, weighted by (1 + n_z) / 2, n_z the upward part of a face's normal. The aperture is a point. Beside
the mirror every fourth pixel is traced and the others are interpolated.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from phibench.render.optics.beam_deposit import footprint, inside_reflectance, transmittance
from phibench.render.optics.faces import FaceTable, IntArray
from phibench.render.optics.ray_tracer import lens_rays, reflect
from phibench.render.optics.reflection_point import bundle_spread, mirror_points
from phibench.render.optics.room_tracer import RoomGeometry, RoomHits
from phibench.render.optics.spot_layer import SpotLayer, splat
from phibench.render.optics.spot_samples import FilmCloud, film_position
from phibench.render.sensor.light import Region
from phibench.scenes.camera import Camera
from phibench.scenes.frames import Array, BoolArray
from phibench.scenes.laser import LaserSpot
from phibench.scenes.rig import View
from phibench.scenes.room import escalade360
from phibench.scenes.shapes import Bitmap, Checker, Texture

Placement = tuple[Array, Array]
"""Rotation, shape (3, 3), and origin, shape (3,), of the rig's frame in the world."""

_ROWS_AT_ONCE = 48  # of a whole image: the work arrays stay small
_BESIDE_PX = 4  # step of the rays that miss the mirror
_TAIL_SIGMAS = 5.0
_ANGLES = 1024  # of the mirror's reflectance table: its curve errs by 1e-6
_LIFT_M = 5e-5  # mirrored rays start this far in front of a coat
_UNEVEN = 0.03  # part of a pixel's light by which what its neighbours' coats mirror may differ
_LEVEL = 0.9  # upward part of the normal of a level surface


class TexelPlaces(Protocol):
    """Grids of texels by patch, as `render.optics.faces.TexelGrid`; integer arrays of shape (P,)."""

    @property
    def columns(self) -> IntArray:
        """Texels along local x; 0 where there is no grid."""

    @property
    def rows(self) -> IntArray:
        """Texels along local y."""

    @property
    def start(self) -> IntArray:
        """First texel of a patch's front."""

    @property
    def back(self) -> IntArray:
        """First texel of its back; -1 where it has none."""


@dataclass(frozen=True, eq=False)
class LitRoom:
    """Faces of a room and the light that they send out.

    Parameters
    ----------
    geometry : RoomGeometry
        Without the robot.
    texels : TexelPlaces
        Of the geometry's table.
    irradiance_w_m2 : array, shape (texels, 3)
    """

    geometry: RoomGeometry
    texels: TexelPlaces
    irradiance_w_m2: NDArray[np.float32]

    def seen(self, origins_m: Array, directions: Array) -> Array:
        """Radiance, shape (N, 3), W/(m^2 sr), against rays, shape (N, 3), world; 0 where nothing is met."""
        hits = self.geometry.first_hit(origins_m, directions)
        return self.ground(hits, origins_m, directions) + self.mirrored(hits, origins_m, directions)

    def seen_on_grid(self, origins_m: Array, directions: Array, on: BoolArray) -> Array:
        """The same for the rays of pixels that are `on`, shape (rows, columns), row by row.

        Every second pixel along both axes is traced. Where the four around a pixel meet one face, it meets that face,
        and what its coat mirrors is the mean of theirs if they agree. The others are traced. So what is narrower than
        two pixels may be lost.
        """
        number = np.full(on.shape, -1)
        number[on] = np.arange(len(directions))
        coarse = number[::2, ::2]
        nodes, among = coarse[coarse >= 0], coarse >= 0
        hits = self.geometry.first_hit(origins_m[nodes], directions[nodes])
        patch, mirrored = np.full(coarse.shape, -1), np.zeros((*coarse.shape, 3))
        patch[among] = hits.patch
        mirrored[among] = self.mirrored(hits, origins_m[nodes], directions[nodes])
        row, column = np.nonzero(on)
        i, j = row // 2, column // 2
        k, m = (np.minimum(a + b % 2, n - 1) for a, b, n in zip((i, j), (row, column), coarse.shape, strict=True))
        corners = ((i, j), (k, j), (i, m), (k, m))
        guess = patch[i, j]
        same = np.all([patch[corner] == guess for corner in corners], axis=0) & (guess >= 0)
        hits = self.geometry.resolve(origins_m, directions, np.where(same, guess, -1))
        result = self.ground(hits, origins_m, directions)
        glints = np.stack([mirrored[corner] for corner in corners])
        even = np.ptp(glints, axis=0) <= _UNEVEN * (result + glints.mean(axis=0))
        same &= (hits.patch == guess) & even.all(axis=1)
        result[same] += glints.mean(axis=0)[same]
        rest = np.flatnonzero(~same & (hits.patch >= 0))
        other = RoomHits(hits.distance_m[rest], hits.object_id[rest], hits.patch[rest])
        result[rest] += self.mirrored(other, origins_m[rest], directions[rest])
        return result

    def ground(self, hits: RoomHits, origins_m: Array, directions: Array) -> Array:
        """Radiance of what rays hit, without what coats mirror, shape (N, 3)."""
        met, result = np.flatnonzero(hits.patch >= 0), np.zeros((len(directions), 3))
        d = directions[met]
        result[met] = self._ground(hits.patch[met], origins_m[met] + hits.distance_m[met, None] * d, d)
        return result

    def mirrored(self, hits: RoomHits, origins_m: Array, directions: Array) -> Array:
        """Radiance that coats mirror: one bounce; shape (N, 3)."""
        result, table = np.zeros((len(directions), 3)), self._table
        coated = np.flatnonzero((hits.patch >= 0) & (table.coat[hits.patch] > 0.0))
        if not len(coated):
            return result
        patch, d = hits.patch[coated], directions[coated]
        normal = table.normal[patch]
        cos = -np.einsum("ni,ni->n", normal, d)
        normal, cos = np.where(cos[:, None] < 0.0, -normal, normal), np.abs(cos)
        onward = d + 2.0 * cos[:, None] * normal
        starts = origins_m[coated] + hits.distance_m[coated, None] * d + _LIFT_M * normal
        found = self.ground(self.geometry.first_hit(starts, onward), starts, onward)
        result[coated] = (1.0 - transmittance(cos, table.coat[patch]))[:, None] * found
        return result

    def _ground(self, patch: IntArray, points: Array, d: Array) -> Array:
        """Radiance of faces without what their coats mirror."""
        table, texels = self._table, self.texels
        cos = np.einsum("ni,ni->n", table.normal[patch], d)
        front = cos < 0.0
        shines = self._shines[patch]
        start = np.where(front, np.where(shines, 0, texels.start[patch]), np.where(shines, -1, texels.back[patch]))
        albedo = self._albedo(patch, points)
        own = albedo * np.where(table.emits[patch, None], table.radiance_w_m2_sr[patch], 1.0)
        E = self._irradiance(patch, points, np.maximum(start, 0))
        lit = self._below_coat(patch, albedo, np.abs(cos)) * E / math.pi
        return np.where((start >= 0)[:, None], np.where(shines[:, None], own, lit), 0.0)

    def _irradiance(self, patch: IntArray, points: Array, start: IntArray) -> Array:
        """Irradiance, bilinear between texel centres and linear beyond the outermost ones; at least 0."""
        table = self._table
        columns, rows = (np.maximum(side[patch], 2) for side in (self.texels.columns, self.texels.rows))
        across, up = (table.local_m(patch, points) / table.size_m[patch] + 0.5).T
        x, y = across * columns - 0.5, up * rows - 0.5
        i = np.clip(np.floor(x), 0, columns - 2).astype(np.int64)
        j = np.clip(np.floor(y), 0, rows - 2).astype(np.int64)
        first = np.where(self._shines[patch], 0, start + j * columns + i)
        across_step = np.where(self._shines[patch], 0, columns)
        return np.maximum(_blended(self._light, first, 1, across_step, x - i, y - j), 0.0)

    def _albedo(self, patch: IntArray, points: Array) -> Array:
        """Value of the texture at points, shape (N, 3)."""
        texels, places = self._textures
        width, height, start, half = places[self._texture_of[patch]].T
        s, t = self._table.places(patch, points).T - half
        low_s, low_t = np.floor(s), np.floor(t)
        smooth = half > 0.0
        ts, tt = np.where(smooth, s - low_s, 0.0), np.where(smooth, t - low_t, 0.0)
        i, j = (np.mod(low, size).astype(np.int64) for low, size in ((low_s, width), (low_t, height)))
        w, first = width.astype(np.int64), start.astype(np.int64)
        right = np.where(i + 1 < w, 1, 1 - w)
        above = np.where(j + 1 < height, w, w - w * height.astype(np.int64))
        return _blended(texels, first + j * w + i, right, above, ts, tt)

    def _below_coat(self, patch: IntArray, albedo: Array, cos: Array) -> Array:
        """Albedo of the ground below a coat, seen at an angle; the albedo itself where there is none."""
        coat, result = self._table.coat[patch], albedo.copy()
        on = np.flatnonzero(coat > 0.0)
        inside = self._inside[patch[on], None]
        leaves = transmittance(cos[on], coat[on]) / coat[on] ** 2
        result[on] = albedo[on] / (1.0 - albedo[on] * inside) * leaves[:, None]
        return result

    @cached_property
    def ambient_w_m2(self) -> Array:
        """Mean irradiance of level surfaces that look up, shape (3,)."""
        table, texels = self._table, self.texels
        level = np.flatnonzero((table.normal[:, 2] > _LEVEL) & (texels.columns > 0))
        parts = [slice(texels.start[k], texels.start[k] + texels.columns[k] * texels.rows[k]) for k in level]
        if not parts:
            return np.asarray(self.irradiance_w_m2.mean(axis=0), float)
        return np.asarray(np.concatenate([self.irradiance_w_m2[part] for part in parts]).mean(axis=0), float)

    @property
    def _table(self) -> FaceTable:
        return self.geometry.table

    @cached_property
    def _shines(self) -> BoolArray:
        return np.asarray(self._table.emits | self._table.is_radiance)

    @cached_property
    def _light(self) -> Array:
        """Irradiance with four more texels, so that faces without a grid may look up something."""
        return np.concatenate([self.irradiance_w_m2, np.zeros((4, 3), np.float32)]).astype(float)

    @cached_property
    def _inside(self) -> Array:
        return np.array([inside_reflectance(float(coat)) if coat > 0.0 else 0.0 for coat in self._table.coat])

    @cached_property
    def _texture_of(self) -> IntArray:
        """Texture of each patch; the last one, white, of lamps."""
        return np.where(self._table.emits, len(self._table.textures), self._table.texture)

    @cached_property
    def _textures(self) -> tuple[Array, Array]:
        """Texels of all textures, shape (T, 3); width, height, first texel and half a texel if it is smooth."""
        images = [*(_image(texture) for texture in self._table.textures), (np.ones((1, 1, 3)), 0.0)]
        first = np.cumsum([0, *(image.shape[0] * image.shape[1] for image, _ in images[:-1])])
        places = [(im.shape[1], im.shape[0], k, half) for (im, half), k in zip(images, first, strict=True)]
        return np.concatenate([image.reshape(-1, 3) for image, _ in images]), np.array(places, float)


def _blended(table: Array, first: IntArray, right: IntArray | int, above: IntArray, tx: Array, ty: Array) -> Array:
    """Rows of a table, shape (N, 3), bilinear between four."""
    tx, ty = tx[:, None], ty[:, None]
    low = (1.0 - tx) * table[first] + tx * table[first + right]
    return np.asarray((1.0 - ty) * low + ty * ((1.0 - tx) * table[first + above] + tx * table[first + above + right]))


def _image(texture: Texture) -> tuple[Array, float]:
    """Texels, shape (rows, columns, 3), and half a texel if the texture is smooth."""
    if isinstance(texture, Bitmap):
        return texture.values[..., :3].astype(float), 0.5
    if isinstance(texture, Checker):
        even, odd = np.array(texture.albedo_even), np.array(texture.albedo_odd)
        return np.array([[even, odd], [odd, even]]), 0.0
    return np.array([[texture.albedo]], float), 0.0


# -- camera ----------------------------------------------------------------------------------------------------------


def room_image(view: View, placement: Placement, lit: LitRoom, region: Region) -> NDArray[np.float32]:
    """Expected electrons per second behind R, G, B on a region, shape (3, h, w)."""
    sigma = math.hypot(view.rig.camera.blur_sigma_px, math.sqrt(1.0 / 12.0))
    margin = math.ceil(_TAIL_SIGMAS * sigma)
    u = np.arange(region.u0_px - margin, region.u1_px + margin)
    v = np.arange(region.v0_px - margin, region.v1_px + margin)
    robot = RoomGeometry(escalade360(view))
    bands = [_sharp(view, placement, lit, robot, u, v[k : k + _ROWS_AT_ONCE]) for k in range(0, len(v), _ROWS_AT_ONCE)]
    sharp = np.concatenate(bands, axis=1)
    blurred = gaussian_filter(sharp, (0.0, sigma, sigma), truncate=_TAIL_SIGMAS)
    return np.asarray(blurred[:, margin:-margin, margin:-margin], np.float32)


def _sharp(
    view: View, placement: Placement, lit: LitRoom, robot: RoomGeometry, u: IntArray, v: IntArray
) -> NDArray[np.float32]:
    """Electrons per second at pixel centres before the blur, shape (3, rows, columns)."""
    uv = np.stack([np.tile(u, len(v)), np.repeat(v, len(u))]).T.astype(float)
    rays = reflect(view, *lens_rays(view, uv))
    on = np.isfinite(rays.cos_incidence)
    light = np.zeros((len(uv), 3))
    if not on.all():
        light[~on] = _beside(view, placement, lit, uv[~on])
    mine = np.flatnonzero(on)
    grid = on.reshape(len(v), len(u))
    radiance = _arriving(placement, lit, robot, rays.points_m[mine], rays.directions[mine], grid)
    light[mine] = radiance * _mirror_reflectance(view, rays.cos_incidence[mine])
    light *= _electrons_per_radiance(view.rig.camera, uv)
    return np.asarray(light.T.reshape(3, len(v), len(u)), np.float32)


def _arriving(
    placement: Placement, lit: LitRoom, robot: RoomGeometry, points: Array, directions: Array, on: BoolArray
) -> Array:
    """Radiance against rays in the rig's frame, shape (N, 3), of the pixels that are `on`."""
    R, origin = placement
    result = lit.seen_on_grid(points @ R.T + origin, directions @ R.T, on)
    down = np.flatnonzero(directions[:, 2] < 0.0)  # the robot lies below the mirror
    corners = robot.table.corners_m.reshape(-1, 3)
    near = down[_meets_box(points[down], directions[down], corners.min(axis=0), corners.max(axis=0))]
    hits = robot.first_hit(points[near], directions[near])
    met = np.flatnonzero(hits.patch >= 0)
    if len(met):
        at, patch, d = near[met], hits.patch[met], directions[near[met]]
        normal = robot.table.normal[patch] @ R.T
        normal *= -np.sign(np.einsum("ni,ni->n", normal, d @ R.T))[:, None]
        # its shapes are of one albedo each
        albedo = np.array([texture.albedo for texture in robot.table.textures])[robot.table.texture[patch]]  # type: ignore[union-attr]
        result[at] = albedo * lit.ambient_w_m2 / math.pi * 0.5 * (1.0 + normal[:, 2:])
    return result


def _meets_box(points: Array, directions: Array, low: Array, high: Array) -> BoolArray:
    with np.errstate(divide="ignore", invalid="ignore"):
        one, two = (low - points) / directions, (high - points) / directions
    enter, leave = np.fmin(one, two).max(axis=1), np.fmax(one, two).min(axis=1)
    return np.asarray((enter <= leave) & (leave > 0.0))


def _beside(view: View, placement: Placement, lit: LitRoom, uv: Array) -> Array:
    """Radiance at pixels that miss the mirror: bilinear between rays on a grid that all regions share."""
    R, origin = placement
    place = uv / _BESIDE_PX
    low = np.floor(place).astype(np.int64)
    corner, width = low.min(axis=0), int(np.ptp(low[:, 0])) + 2
    nodes = np.stack(np.meshgrid(np.arange(width), np.arange(int(np.ptp(low[:, 1])) + 2)), axis=-1).reshape(-1, 2)
    i, j = (low - corner).T
    first = j * width + i
    needed = np.zeros(len(nodes), bool)
    for step in (0, 1, width, width + 1):
        needed[first + step] = True
    starts, directions = lens_rays(view, (nodes[needed] + corner) * float(_BESIDE_PX))
    found = np.zeros((len(nodes), 3))
    found[needed] = lit.seen(starts @ R.T + origin, directions @ R.T)
    return _blended(found, first, 1, np.full(len(first), width), *(place - low).T)


def _mirror_reflectance(view: View, cos: Array) -> Array:
    """Reflectance in the three bands, shape (N, 3)."""
    rig, grid = view.rig, np.linspace(0.0, 1.0, _ANGLES)
    return np.stack(
        [np.interp(cos, grid, rig.mirror.band(nm).at(grid)) for nm in rig.camera.detector.band_wavelength_nm], axis=-1
    )


def _electrons_per_radiance(camera: Camera, uv: Array) -> Array:
    """Electrons per second and pixel for a radiance of 1 W/(m^2 sr), shape (N, 3)."""
    xy = camera.normalised(uv)
    cos2 = 1.0 / (1.0 + np.sum(xy * xy, axis=-1))
    etendue = math.pi * camera.aperture_radius_m**2 * cos2**2 * camera.solid_angle_density(xy)
    return np.asarray(etendue[:, None] * np.array(camera.detector.band_electrons_per_joule()))


# -- spots -----------------------------------------------------------------------------------------------------------

# rules of seven nodes, exact to the fifth moment: Radon's of the unit disc, and of a Gaussian of variance 1 per axis
_RING = np.array([(math.cos(k * math.pi / 3.0), math.sin(k * math.pi / 3.0)) for k in range(6)])
_UNIFORM_NODES = np.concatenate([np.zeros((1, 2)), math.sqrt(2.0 / 3.0) * _RING])
_UNIFORM_WEIGHTS = np.array([0.25, *[0.125] * 6])
_GAUSSIAN_NODES = np.concatenate([np.zeros((1, 2)), 2.0 * _RING])
_GAUSSIAN_WEIGHTS = np.array([0.5, *[1.0 / 12.0] * 6])


def quick_spot(view: View, spot: LaserSpot) -> SpotLayer:
    """Image of a flat spot that nothing hides, in a smooth mirror: `spot_layer` with 49 pairs of spot and aperture.

    While both discs are images smaller than the blur, the rules' error is of the sixth order in their ratio to it.
    """
    places = footprint(spot, _GAUSSIAN_NODES if spot.profile == "gaussian" else _UNIFORM_NODES)
    share = _GAUSSIAN_WEIGHTS if spot.profile == "gaussian" else _UNIFORM_WEIGHTS
    camera = view.rig.camera
    lens = np.pad(camera.aperture_radius_m * _UNIFORM_NODES, ((0, 0), (0, 1)))
    points, eyes = np.tile(places, (7, 1)), np.repeat(view.T_world_camera.points(lens), 7, axis=0)
    weight = np.outer(_UNIFORM_WEIGHTS, share).ravel() * math.pi * camera.aperture_radius_m**2 * spot.power_w
    found = mirror_points(view, points, eyes)
    to_lens, out = (_unit(ends - found.points_m) for ends in (eyes, points))
    cos_i = np.einsum("ni,ni->n", to_lens, found.normals)
    facing = np.maximum(-out @ np.array(spot.normal_world), 0.0)
    rho = view.rig.mirror.reflectance(cos_i, spot.wavelength_nm)
    watts = weight * (spot.albedo or 0.0) / math.pi * facing * rho
    watts *= np.maximum(-to_lens @ view.T_world_camera.R[:, 2], 0.0) / bundle_spread(view, found, eyes, cos_i)
    pose = view.T_world_camera.inverse()
    uv = film_position(view, pose.points(eyes), pose.points(found.points_m))
    lit = found.lit & np.isfinite(watts)
    gain = np.array(camera.detector.laser_electrons_per_joule(spot.wavelength_nm))
    return splat(FilmCloud(uv[lit], watts[lit]), camera.blur_sigma_px, gain)


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1)[:, None])
