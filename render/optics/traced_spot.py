"""Image of a spot by rays from the film to the lit surface: centroid, power; film position of a ray to a given point.

The camera's side of a certificate. Newton's method finds the film position that meets a given wall point; power is
radiance times etendue. A rough mirror reflects each ray at a facet with a drawn slope.

A spot of a beam is found the same way round: each ray goes on to the first surface of the room, from where the beam is
looked for backwards, with a shadow test. Film positions are drawn from two Gaussians that cover the spot's image; the
faces that the spot lies on play no part in that, so that edges and textures need nothing of their own.

A glass tube around the mirror is crossed by Snell's law for vectors, at one face after the other; Fresnel's equations
and the sum over the reflections between the faces give what passes.

Film positions are pixels (u, v), shape (N, 2); points are world coordinates in metres, shape (N, 3).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.special import ndtri

from phibench.render.optics.beam_deposit import BEAM_REACH_M
from phibench.render.optics.faces import FaceTable, IntArray
from phibench.render.optics.ray_tracer import MirrorRays, lens_rays, reflect, through_glass
from phibench.render.optics.room_tracer import GeometryLike, RoomGeometry, as_geometry, blocked_by
from phibench.render.optics.spot_samples import ImagePart, image_parts
from phibench.render.optics.truth import SpotTruth
from phibench.scenes.frames import Array, BoolArray
from phibench.scenes.laser import LaserSpot
from phibench.scenes.random_streams import sobol
from phibench.scenes.rig import View

_RAYS_AT_ONCE = 2**16  # of a beam: more take a gigabyte
_STEP_PX = 1e-3
_REST_PX = 1e-11  # last step of a search for a place
_NEAR_PX = 1e-3  # of one for the middle of drawn places, whose density is known wherever it lies
_SMOOTH_PX = 1e-6  # of one whose slopes count: a thousandth of their own `_STEP_PX`
_NEWTON_STEPS = 8
_HALVINGS = 6


@dataclass(frozen=True)
class RayBundle:
    """Rays that differ in aperture point (metres, camera x and y) and facet slope, both of shape (N, 2)."""

    lens_m: Array
    slopes: Array

    @staticmethod
    def chief() -> RayBundle:
        """Chief ray of the nominal mirror."""
        return RayBundle(np.zeros((1, 2)), np.zeros((1, 2)))


def aim(view: View, spot: LaserSpot, bundle: RayBundle, wall_m: Array, start_px: Array) -> Array:
    """Film positions, shape (N, 2), whose rays meet wall points; NaN where none is found.

    Parameters
    ----------
    bundle
        Aperture points and facet slopes of the N rays.
    wall_m : array, shape (N, 2)
        Points in the spot's plane, metres from the spot's centre along its tangents.
    start_px : array, shape (N, 2)
    """
    return _aimed(view, spot, bundle, wall_m, start_px, _REST_PX)[0]


def _aimed(
    view: View, spot: LaserSpot, bundle: RayBundle, wall_m: Array, start_px: Array, rest_px: float
) -> tuple[Array, Array]:
    """As `aim`, to a last step of `rest_px`, and about d(wall) / d(u, v), shape (N, 2, 2): before that step.

    Rays are aimed across the line of sight: on a wall that is seen edge on there is no place for some of them.
    """
    targets = np.array(spot.position_world_m) + wall_m @ np.stack(spot.tangents())
    sight = targets - _reflect(view, spot, start_px, bundle).starts_m
    sight /= np.linalg.norm(sight, axis=-1, keepdims=True)
    across = _across(sight)

    def missed(uv: Array) -> Array:
        rays = _reflect(view, spot, uv, bundle)
        offset = rays.starts_m - targets
        distance = -np.einsum("ni,ni->n", offset, sight) / np.einsum("ni,ni->n", rays.directions, sight)
        return np.einsum("nki,ni->nk", across, offset + distance[:, None] * rays.directions)

    uv, miss = start_px, missed(start_px)
    for _ in range(_NEWTON_STEPS):
        slopes = _jacobian(missed, uv)
        step = _solve(slopes, miss)
        uv, miss = _step(missed, uv, step)
        if not np.any(np.abs(step) > rest_px):
            break
    seen = across @ np.stack(spot.tangents()).T  # of the wall's tangents across the sight
    return uv, np.stack([_solve(seen, slopes[:, :, k]) for k in (0, 1)], axis=-1)


def _across(directions: Array) -> Array:
    """Two unit vectors across each direction (N, 3), shape (N, 2, 3)."""
    first = np.cross(directions, np.eye(3)[np.abs(directions).argmin(axis=-1)])
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    return np.stack([first, np.cross(directions, first)], axis=1)


def _step(missed: Callable[[Array], Array], uv: Array, step: Array) -> tuple[Array, Array]:
    """Take a Newton step, halved where the ray would leave the mirror."""
    for _ in range(_HALVINGS):
        new = uv - step
        miss = missed(new)
        lost = np.any(~np.isfinite(miss), axis=-1)
        if not lost.any():
            break
        step = np.where(lost[:, None], 0.5 * step, step)
    return new, miss


def _solve(jacobian: Array, rhs: Array) -> Array:
    """Solve 2 x 2 systems; NaN where a matrix is singular or not finite."""
    (a, b), (c, d) = jacobian[:, 0].T, jacobian[:, 1].T
    with np.errstate(divide="ignore", invalid="ignore"):
        det = a * d - b * c
        return np.stack([(d * rhs[:, 0] - b * rhs[:, 1]) / det, (a * rhs[:, 1] - c * rhs[:, 0]) / det], axis=-1)


def through_chief_point(view: View, truth: SpotTruth, lens_m: Array) -> Array:
    """Film positions, shape (N, 2), of rays from aperture points to the chief ray's mirror point: a start for `aim`."""
    camera, mirror = view.rig.camera, np.array(truth.reflection_point_world_m)
    x, y, z = view.T_world_camera.inverse().points(mirror)
    # the ray through the lens place and the mirror point, at the plane of focus; z = 1 gives the pixel
    share = camera.focus_distance_m / z
    at_focus = np.array([x, y]) * share + lens_m * (1.0 - share)
    return camera.to_pixel(at_focus / camera.focus_distance_m)


@dataclass(frozen=True)
class TracedSpot:
    """Image of a spot by rays from the film.

    Attributes
    ----------
    centroid_px : array, shape (2,)
        Of the pixel-sampled image.
    place_m : array, shape (3,)
        Of its light on the surfaces, weighted by power, world.
    extent_m : float
        Root mean square distance of that light from its place.
    watts : float
        Power on the film.
    """

    centroid_px: Array
    place_m: Array
    extent_m: float
    watts: float


def trace_spot(view: View, spot: LaserSpot, room: GeometryLike, truth: SpotTruth, log2_rays: int) -> TracedSpot:
    """Trace the image of a spot from the film.

    Film positions are drawn by a linear map about the image of the spot's centre. In a mirror that is no sphere each is
    aimed at its own point of the wall: near a cone's tip no linear map covers the image.
    """
    if spot.beam_direction_world is not None:
        return _trace_beam(view, spot, as_geometry(room), truth, log2_rays)
    room = as_geometry(room)
    x = np.clip(sobol(6, 2**log2_rays), 1e-12, 1.0 - 1e-12)
    # dimensions 0, 1: the lens; 2, 3: the wall; 4, 5: the slopes of facets
    bundle = RayBundle(view.rig.camera.aperture_radius_m * _disc(x[:, :2]), _facets(view, x[:, 4:]))
    wall, density = _wall_samples(spot, x[:, 2:4])
    if view.rig.mirror.radius_m is None:
        start = through_chief_point(view, truth, bundle.lens_m)
        uv = _aimed(view, spot, bundle, wall, start, _SMOOTH_PX)[0]
        jacobian = _jacobian(lambda place: _on_wall(view, spot, place, bundle), uv)
    else:
        uv, jacobian = _linear_aim(view, spot, bundle, wall, truth)
    with np.errstate(invalid="ignore"):
        # density of samples per pixel: that on the wall times d(wall) / d(pixel)
        area = density * np.abs(jacobian[:, 0, 0] * jacobian[:, 1, 1] - jacobian[:, 0, 1] * jacobian[:, 1, 0])
        watts, points = _watts(view, spot, room, uv, bundle)
        return _moments(view, uv, points, watts / area / len(x))


def _moments(view: View, uv: Array, points: Array, watts: Array) -> TracedSpot:
    """Moments of rays; what is not finite got lost on its way."""
    kept = np.isfinite(watts) & np.isfinite(uv).all(axis=-1) & np.isfinite(points).all(axis=-1)
    watts, uv, points = watts[kept], uv[kept], points[kept]
    with np.errstate(invalid="ignore", divide="ignore"):
        share = watts / watts.sum()
        place = share @ points
        extent = np.sqrt(share @ ((points - place) ** 2).sum(axis=1))
        centroid = share @ _expected_pixel(uv, view.rig.camera.blur_sigma_px)
    return TracedSpot(centroid, place, float(extent), float(watts.sum()))


def _linear_aim(view: View, spot: LaserSpot, bundle: RayBundle, wall: Array, truth: SpotTruth) -> tuple[Array, Array]:
    """Film samples: the image of the spot's centre for each ray, plus a linear map of the wall sample.

    Sampling only: where on the wall such a ray really lands, and with what weight, is traced afterwards. So centre and
    map need not be exact: what counts is that the density is that of this map.
    """
    start = through_chief_point(view, truth, bundle.lens_m)
    centres, jacobian = _aimed(view, spot, bundle, np.zeros_like(wall), start, _NEAR_PX)
    return centres + _solve(jacobian, wall), jacobian


def _facets(view: View, x: Array) -> Array:
    """Beckmann slopes, shape (N, 2): variance alpha^2 / 2 each way; 0 for an ideal mirror."""
    return view.rig.mirror.roughness_alpha / math.sqrt(2.0) * ndtri(x)


def _wall_samples(spot: LaserSpot, x: Array) -> tuple[Array, Array]:
    """Points in the spot's plane (N, 2) that cover the spot generously, and their density, 1/m^2."""
    if spot.profile == "gaussian":
        # wider than the spot, so that weights of its tail stay bounded
        z, sigma = ndtri(x), 1.2 * spot.sigma_m
        return sigma * z, np.exp(-0.5 * (z**2).sum(axis=1)) / (2.0 * math.pi * sigma**2)
    radius = 1.05 * spot.diameter_m / 2.0
    return radius * _disc(x), np.full(len(x), 1.0 / (math.pi * radius**2))


def _disc(x: Array) -> Array:
    # square root: as many samples on every part of the area
    radius, turn = np.sqrt(x[:, 0]), 2.0 * np.pi * x[:, 1]
    return np.stack([radius * np.cos(turn), radius * np.sin(turn)], axis=-1)


@dataclass(frozen=True)
class _Reflected:
    """Rays of film positions after the mirror, and after the glass around it where there is a tube.

    `corners_m` are the mirror point and, in order, where a ray meets the faces of the glass; the ray goes on from the
    last in `directions`.
    """

    lens_points_m: Array
    corners_m: tuple[Array, ...]
    directions: Array
    cos_facet: Array
    cos_lens: Array
    facet_weight: Array
    transmittance: Array | float

    @property
    def starts_m(self) -> Array:
        """Places from which the rays go on into the room."""
        return self.corners_m[-1]

    def legs(self, chosen: IntArray | BoolArray) -> list[tuple[Array, Array]]:
        """Starts and ends of straight parts of some rays, from the lens on."""
        places = [place[chosen] for place in (self.lens_points_m, *self.corners_m)]
        return list(pairwise(places))


def _reflect(view: View, spot: LaserSpot, uv: Array, bundle: RayBundle) -> _Reflected:
    """Reflect each ray at its facet; the weight (o.m) / (o.n n.m) turns drawn facets into f_r cos_i, shadowing 1."""
    origins, directions = lens_rays(view, uv, bundle.lens_m)
    rays = reflect(view, origins, directions)
    facet = rays.normals
    if view.rig.mirror.roughness_alpha > 0.0:
        facet = facet + np.einsum("nk,nki->ni", bundle.slopes, _tangents(view, spot, rays))
        facet /= np.linalg.norm(facet, axis=-1, keepdims=True)
    cos_facet = -np.einsum("ni,ni->n", facet, directions)
    out = directions + 2.0 * cos_facet[:, None] * facet
    # projected area of the facet over that of the smooth mirror, seen along the ray
    weight = cos_facet / (rays.cos_incidence * np.einsum("ni,ni->n", facet, rays.normals))
    cos_lens = directions @ view.T_world_camera.R[:, 2]
    if view.tube is None:
        return _Reflected(origins, (rays.points_m,), out, cos_facet, cos_lens, weight, 1.0)
    corners, out, passing = through_glass(view.tube, rays.points_m, out)
    return _Reflected(origins, corners, out, cos_facet, cos_lens, weight, passing)


def _tangents(view: View, spot: LaserSpot, rays: MirrorRays) -> Array:
    """Two tangents per ray, shape (N, 2, 3), smooth over the film: the first along the plane of incidence's normal."""
    to_spot = np.array(spot.position_world_m) - view.sphere_centre_m
    across = np.cross(to_spot, view.camera_centre_m - view.sphere_centre_m)
    if np.linalg.norm(across) < 1e-12:  # spot, sphere and camera in one line: any direction across will do
        across = view.T_world_camera.R[:, 0]
    first = across - np.einsum("ni,i->n", rays.normals, across)[:, None] * rays.normals
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    return np.stack([first, np.cross(rays.normals, first)], axis=1)


def _on_wall(view: View, spot: LaserSpot, uv: Array, bundle: RayBundle) -> Array:
    """Landing points in the spot's plane of rays from film positions, metres along its tangents, shape (N, 2)."""
    rays = _reflect(view, spot, uv, bundle)
    return _meet(spot, rays.starts_m, rays.directions)[0]


def _meet(spot: LaserSpot, origins: Array, directions: Array) -> tuple[Array, Array]:
    normal, centre = np.array(spot.normal_world), np.array(spot.position_world_m)
    # distance to the plane of the wall; negative where the ray leads away
    distance = (centre - origins) @ normal / (directions @ normal)
    points = origins + distance[:, None] * directions
    return (points - centre) @ np.stack(spot.tangents()).T, points


def _jacobian(function: Callable[[Array], Array], uv: Array) -> Array:
    """Derivatives of places (N, 2) by (u, v), shape (N, 2, 2), by central differences."""
    sides = [[function(uv + sign * step) for sign in (1, -1)] for step in _STEP_PX * np.eye(2)]
    return np.stack([(plus - minus) / (2.0 * _STEP_PX) for plus, minus in sides], axis=-1)


def _watts(view: View, spot: LaserSpot, room: RoomGeometry, uv: Array, bundle: RayBundle) -> tuple[Array, Array]:
    """Radiance x etendue, watts per square pixel for the whole aperture, shape (N,); points on the wall (N, 3)."""
    rays = _reflect(view, spot, uv, bundle)
    wall, points = _meet(spot, rays.starts_m, rays.directions)
    facing = rays.directions @ np.array(spot.normal_world) < 0.0
    watts = _through_lens(view, spot, uv, rays, spot.radiance_w_m2_sr(np.linalg.norm(wall, axis=-1)) * facing)
    hit = np.isfinite(watts)
    legs = (*rays.legs(hit), (rays.starts_m[hit], points[hit]))
    watts[hit] *= np.all([blocked_by(room, start, end) < 0 for start, end in legs], axis=0)
    return watts, points


def _through_lens(view: View, spot: LaserSpot, uv: Array, rays: _Reflected, radiance: Array) -> Array:
    """Watts per square pixel for the whole aperture of a radiance that rays come from, shape (N,)."""
    camera = view.rig.camera
    reflectance = rays.facet_weight * view.rig.mirror.reflectance(rays.cos_facet, spot.wavelength_nm)
    reflectance = reflectance * rays.transmittance
    density = camera.solid_angle_density(camera.normalised(uv))
    # thin lens: cos^4 law, aperture area over the square of the focal length in `density`
    return radiance * reflectance * density * rays.cos_lens**4 * math.pi * camera.aperture_radius_m**2


def _trace_beam(view: View, spot: LaserSpot, room: RoomGeometry, truth: SpotTruth, log2_rays: int) -> TracedSpot:
    """Trace the image of what a beam leaves on surfaces."""
    x = np.clip(sobol(7, 2**log2_rays), 1e-12, 1.0 - 1e-12)
    parts = image_parts(view, spot, room, np.array([truth.u_px, truth.v_px]))
    pieces = np.array_split(x, max(len(x) // _RAYS_AT_ONCE, 1))
    traced = zip(*(_beam_rays(view, spot, room, truth, parts, piece) for piece in pieces), strict=True)
    uv, points, watts = map(np.concatenate, traced)
    return _moments(view, uv, points, watts / len(x))


def _beam_rays(
    view: View, spot: LaserSpot, room: RoomGeometry, truth: SpotTruth, parts: Sequence[ImagePart], x: Array
) -> tuple[Array, Array, Array]:
    """Film positions (n, 2), points on surfaces (n, 3) and watts over density (n,) of numbers `x`, shape (n, 7)."""
    bundle = RayBundle(view.rig.camera.aperture_radius_m * _disc(x[:, :2]), _facets(view, x[:, 4:6]))
    start = through_chief_point(view, truth, bundle.lens_m)
    centres, _ = _aimed(view, spot, bundle, np.zeros((len(x), 2)), start, _NEAR_PX)
    # dimension 6 chooses the part of the image, by its share of the light
    chosen = np.searchsorted(np.cumsum([part.share for part in parts])[:-1], x[:, 6], side="right")
    z = ndtri(x[:, 2:4])
    offset = np.empty_like(z)
    for number, part in enumerate(parts):
        own = chosen == number
        offset[own] = part.mean + z[own] @ part.root.T
    # mixture: the density is that of all parts, whichever drew the sample
    uv, density = centres + offset, sum(part.density(offset) for part in parts)
    rays = _reflect(view, spot, uv, bundle)
    seen = np.flatnonzero(np.isfinite(rays.directions).all(axis=1) & np.isfinite(uv).all(axis=1))
    radiance, points = np.zeros(len(uv)), np.full((len(uv), 3), np.nan)
    radiance[seen], points[seen] = _beam_radiance(spot, room, rays.starts_m[seen], rays.directions[seen])
    lit = np.flatnonzero(radiance > 0.0)
    for start, end in rays.legs(lit):
        radiance[lit] *= blocked_by(room, start, end) < 0
    watts = np.zeros(len(uv))
    watts[seen] = _through_lens(view, spot, uv, rays, radiance)[seen]
    return uv, np.where(watts[:, None] > 0.0, points, 0.0), watts / density


def _beam_radiance(spot: LaserSpot, room: RoomGeometry, origins: Array, directions: Array) -> tuple[Array, Array]:
    """Radiance that rays from the mirror meet where the beam lights the room, shape (N,), and the points (N, 3).

    From the point that a ray meets, the place across the beam gives the irradiance; a ray against the beam finds what
    stands in between.
    """
    hits, table = room.first_hit(origins, directions), room.table
    met = np.flatnonzero(hits.patch >= 0)
    places = origins + hits.distance_m[:, None] * directions
    patch, points = hits.patch[met], places[met]
    beam, offset = np.array(spot.beam_direction_world), points - np.array(spot.position_world_m)
    along = offset @ beam
    irradiance = spot.irradiance_w_m2(np.linalg.norm(offset - along[:, None] * beam, axis=1))
    cos_in, cos_out = -table.normal[patch] @ beam, -np.einsum("ni,ni->n", table.normal[patch], directions[met])
    lit = (irradiance > 0.0) & (np.abs(along) < BEAM_REACH_M) & (cos_in * cos_out > 0.0)
    lit &= ((cos_in > 0.0) | table.two_sided[patch]) & ~table.emits[patch]
    number = np.flatnonzero(lit)
    back = points[number] - (along[number] + BEAM_REACH_M)[:, None] * beam
    number = number[blocked_by(room.without_robot, back, points[number]) < 0]
    # the robot stops none of the beam, but carries no spot either
    number = number[table.shape[patch[number]] < len(room.without_robot.shapes)]
    radiance = np.zeros(len(hits.patch))
    scattered = _reflected_share(
        spot, table, patch[number], points[number], np.abs(cos_in[number]), np.abs(cos_out[number])
    )
    radiance[met[number]] = irradiance[number] * np.abs(cos_in[number]) * scattered / math.pi
    return radiance, places


def _reflected_share(
    spot: LaserSpot, table: FaceTable, patch: IntArray, points: Array, cos_in: Array, cos_out: Array
) -> Array:
    """Pi times the BRDF at points (N, 3) on faces (N,)."""
    if spot.albedo is not None:
        return np.full(len(patch), spot.albedo)
    share, coat = table.laser_albedo(patch, points), table.coat[patch]
    for n in np.unique(coat[coat > 0.0]):
        below = coat == n
        through = _entering(cos_in[below], float(n)) * _entering(cos_out[below], float(n)) / n**2
        share[below] *= through / (1.0 - share[below] * _kept_inside(float(n)))
    return share


def _entering(cos: Array, n: float) -> Array:
    """Transmittance of a coat by Fresnel's equations in their form with angles."""
    outside = np.clip(np.arccos(cos), 1e-9, None)
    inside = np.arcsin(np.sin(outside) / n)
    # Fresnel, unpolarised: mean of sin^2 and tan^2 ratios of difference and sum of both angles
    apart, together = outside - inside, outside + inside
    return 1.0 - 0.5 * (np.sin(apart) ** 2 / np.sin(together) ** 2 + np.tan(apart) ** 2 / np.tan(together) ** 2)


def _kept_inside(n: float, steps: int = 4000) -> float:
    """Reflectance of a coat for diffuse light from inside: total beyond the critical angle, Fresnel's below it."""
    s2 = (np.arange(steps) + 0.5) / steps  # the square of the sine inside is uniform for diffuse light
    below = s2 < 1.0 / n**2
    passing = np.where(below, _entering(np.sqrt(np.clip(1.0 - s2 * n * n, 0.0, 1.0)), n), 0.0)
    return float(1.0 - passing.mean())


def _expected_pixel(uv: Array, sigma: float) -> Array:
    """Mean pixel index of a point blurred by a Gaussian: the centroid that pixels can show (Fourier series).

    round(x) = x - sum_m (-1)^(m+1) sin(2 pi m x) / (pi m); the Gaussian damps term m by exp(-2 pi^2 m^2 sigma^2).
    """
    m = np.arange(1, 2 + math.ceil(1.4 / sigma))  # the first left out is below 1e-16
    damping = (-1.0) ** (m + 1) / (np.pi * m) * np.exp(-2.0 * (np.pi * m * sigma) ** 2)
    return uv - np.sin(2.0 * np.pi * uv[..., None] * m) @ damping
