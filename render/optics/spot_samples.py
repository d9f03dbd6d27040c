"""Laser spot's light on the film by quadrature over spot and aperture: positions, powers; Gaussians that cover them.

Where an edge or a texture cuts the light, a fixed set of quasi-random rays is taken; else nodes of a quadrature.

Pairs of a point on the spot and a point on the aperture are joined by the reflection law (`mirror_points`). Product
quadrature on the two discs gives nodes and weights; their sums replace random samples. The power of a pair follows from
the geometry of the reflected bundle. With s the distance spot to mirror, l mirror to lens and i the angle of incidence,
Coddington's equations for a convex sphere give the distances of the virtual image behind the mirror

    1/s_t = 1/s + 2 / (R cos i)      1/s_s = 1/s + 2 cos(i) / R

and dPhi = L rho(i) cos(theta_spot) cos(theta_lens) / (s^2 (1 + l/s_t) (1 + l/s_s)) dA_spot dA_lens.
With a form error the two factors become a determinant, that of the reflected bundle's curvature (`reflection_point`). A
glass tube around the mirror moves the point that the mirror sees, and takes a part of the light.

`image_parts` says where the image lies, for a certificate to draw its film positions there.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.polynomial.hermite_e import hermegauss
from numpy.polynomial.laguerre import laggauss
from numpy.polynomial.legendre import leggauss
from scipy.special import ndtri

from phibench.render.optics.beam_deposit import Deposit, deposit, footprint, is_plain_spot
from phibench.render.optics.faces import IntArray
from phibench.render.optics.reflection_point import bundle_spread, mirror_points, onward_ways
from phibench.render.optics.room_tracer import GeometryLike, RoomGeometry, as_geometry, blocked_by
from phibench.scenes.frames import Array, BoolArray
from phibench.scenes.laser import LaserSpot
from phibench.scenes.random_streams import sobol
from phibench.scenes.rig import View

Profile = Literal["uniform", "gaussian"]

_SMALL = 1.0  # Gaussian spots up to this many blurs: few Gauss-Laguerre rings do
_REACH = 5.5  # sigmas; a Gaussian's flux beyond is 3e-7


def disc_nodes(profile: Profile, smoothness: float) -> tuple[Array, Array]:
    """Nodes on a disc of unit radius ("uniform") or of unit sigma ("gaussian"), weights summing to 1.

    The image's blur damps spatial frequencies k (in units of 1 / blur) as exp(-k^2 / 2): beyond 4 nothing is left, and
    rings and points per ring are as many as exp(i k x) with k = 4 needs (tested against closed forms).

    Parameters
    ----------
    profile
        Weight function: constant on the unit disc, or exp(-r^2 / 2) / (2 pi) on the plane.
    smoothness : float
        Extent of the disc's image (radius or sigma) in units of the blur that smooths it.

    Returns
    -------
    nodes : array, shape (n, 2)
    weights : array, shape (n,)
    """
    radius, weight = _rings(profile, smoothness)
    around = 8 + 2 * np.ceil(2.5 * smoothness * np.maximum(radius, 1.0)).astype(int)
    turns = [2.0 * np.pi * (np.arange(n) + 0.5) / n for n in around]
    nodes = [r * np.stack([np.cos(turn), np.sin(turn)], axis=-1) for r, turn in zip(radius, turns, strict=True)]
    weights = np.repeat(weight / around, around)
    return np.concatenate(nodes), weights / weights.sum()


def streak_nodes(profile: Profile, along: float, across: float) -> tuple[Array, Array]:
    """Nodes as of `disc_nodes` for discs whose image is a streak: x runs along it, y across.

    Ring upon ring would be as fine across the streak as along it. Over the uniform disc this is Gauss-Chebyshev
    quadrature of the second kind in x, whose weight is the length of the chord, times Gauss-Legendre on the chord. Over
    the Gaussian it is the trapezoidal rule where the image is long, exact for a Gaussian up to what aliases, and
    Gauss-Hermite where it is short.

    Parameters
    ----------
    along, across : float
        Extents of the image in units of the blur.
    """
    if profile == "uniform":
        count = 4 + math.ceil(2.2 * along)
        angle = np.pi * np.arange(1, count + 1) / (count + 1)
        x, weight_x = np.cos(angle), np.sin(angle) ** 2
        y, weight_y = leggauss(2 + math.ceil(2.2 * across - 0.5))
        nodes = np.stack(np.broadcast_arrays(x[:, None], np.sin(angle)[:, None] * y), axis=-1)
    else:
        (x, weight_x), (y, weight_y) = (_gaussian_line(extent) for extent in (along, across))
        nodes = np.stack(np.broadcast_arrays(x[:, None], y), axis=-1)
    weights = np.outer(weight_x, weight_y).ravel()
    return nodes.reshape(-1, 2), weights / weights.sum()


def _gaussian_line(extent: float) -> tuple[Array, Array]:
    """Nodes on a line and weights for exp(-x^2 / 2)."""
    if extent <= _SMALL:
        rule = np.array(hermegauss(2 + math.ceil(8.0 * extent + 3.0 * extent**2)))
        return rule[0], rule[1]
    # a Gaussian of variance 1 / (1 + extent^2), as the blur leaves it: exp(-2 pi^2 / (step^2 (1 + extent^2))) aliases
    step = 2.0 * np.pi / (4.6 * extent + 3.0)
    half = math.ceil(_REACH / step)
    x = np.linspace(-half * step, half * step, 2 * half + 1)
    return x, np.exp(-0.5 * x * x)


def disc_points(profile: Profile, uniform: Array) -> Array:
    """Points of the same discs, shape (n, 2), from uniform points on the unit square."""
    if profile == "gaussian":
        return np.asarray(ndtri(np.clip(uniform, 1e-12, 1.0 - 1e-12)))
    radius, turn = np.sqrt(uniform[:, 0]), 2.0 * np.pi * uniform[:, 1]
    return np.stack([radius * np.cos(turn), radius * np.sin(turn)], axis=-1)


def _rings(profile: Profile, smoothness: float) -> tuple[Array, Array]:
    """Radii and weights of the rings."""
    if profile == "uniform":
        t, weight = leggauss(3 + math.ceil(1.5 * smoothness))  # uniform in r^2
        return np.sqrt(0.5 * (t + 1.0)), weight
    if smoothness <= _SMALL:
        t, weight = laggauss(4 + math.ceil(1.5 * smoothness))  # t = r^2 / 2 has the density exp(-t)
        return np.sqrt(2.0 * t), weight
    t, weight = leggauss(6 + math.ceil(2.0 * _REACH * smoothness))  # k r / 2 with k = 4
    radius = 0.5 * _REACH * (t + 1.0)
    return radius, weight * radius * np.exp(-0.5 * radius**2)


def slices(total: int, size: int) -> Iterator[slice]:
    """Slices that cover range(total) in pieces of at most `size`."""
    return (slice(start, min(start + size, total)) for start in range(0, total, size))


_PAIRS_AT_ONCE = 65536
_LOG2_DENSE = 17  # where edges cut the light on its way
_LOG2_UNEVEN = 15  # where it is only uneven on the surfaces: steps in two of the four dimensions


@dataclass(frozen=True)
class FilmCloud:
    """Light that reaches the film before optical blur.

    Attributes
    ----------
    uv_px : array, shape (N, 2)
    watts : array, shape (N,)
    points_m : array, shape (N, 3), or None
        Places on the room's surfaces that the light comes from, world.
    """

    uv_px: Array
    watts: Array
    points_m: Array | None = None

    def centroid_px(self) -> Array:
        """Energy centroid (u, v), shape (2,); NaN when there is no light."""
        with np.errstate(invalid="ignore"):
            return self.watts @ self.uv_px / self.watts.sum()

    def place_m(self) -> Array:
        """Mean place on the surfaces, weighted by power, shape (3,); NaN when there is no light or no place."""
        if self.points_m is None or not len(self.watts):
            return np.full(3, np.nan)
        with np.errstate(invalid="ignore"):
            return self.watts @ self.points_m / self.watts.sum()


def specular_cloud(view: View, spot: LaserSpot, room: GeometryLike, log2_pairs: int | None = None) -> FilmCloud:
    """Quadrature over spot and aperture; occluded pairs keep their place with power 0.

    Where an edge cuts the light, or faces and textures change below it, nodes would sample a step: quasi-random pairs
    take over. `log2_pairs` takes that many of them in any case.
    """
    geometry = as_geometry(room)
    if log2_pairs is not None:
        return _dense_cloud(view, spot, geometry, log2_pairs)
    probes = deposit(spot, geometry, _probes(spot))
    if _is_cut(view, spot, geometry, probes):
        return _dense_cloud(view, spot, geometry, _LOG2_DENSE)
    if not is_plain_spot(spot, geometry, probes):
        return _dense_cloud(view, spot, geometry, _LOG2_UNEVEN)
    return _node_cloud(view, spot, geometry)


def _probes(spot: LaserSpot) -> Array:
    """Places across the spot, from its centre to its rim (4 sigma), shape (N, 2)."""
    reach = (4.0, 2.0, 1.0) if spot.profile == "gaussian" else (1.0, 0.8, 0.4)
    return np.concatenate([np.zeros((1, 2)), *(scale * _RIM for scale in reach)])


def _node_cloud(view: View, spot: LaserSpot, room: RoomGeometry) -> FilmCloud:
    disc, spot_weights, lens_nodes, lens_weights = _nodes(view, spot)
    light = deposit(spot, room, disc)
    lens_steps = max(1, _PAIRS_AT_ONCE // len(disc))
    parts = []
    for start in range(0, len(lens_nodes), lens_steps):
        pairs, eyes = _pairs(light, lens_nodes[start : start + lens_steps])
        weight = np.outer(lens_weights[start : start + lens_steps], spot_weights).ravel()
        parts.append(_connect(view, spot, room, pairs, eyes, weight))
    return _joined(parts)


def _dense_cloud(view: View, spot: LaserSpot, room: RoomGeometry, log2_pairs: int) -> FilmCloud:
    """Sobol pairs of spot and aperture: steps are found to about 1e-3 of the flux."""
    x = sobol(4, 2**log2_pairs)
    light = deposit(spot, room, disc_points(spot.profile, x[:, :2]))
    lit = light.lit
    light, eyes = light[lit], _lens_points(view, disc_points("uniform", x[lit, 2:]))
    area = math.pi * view.rig.camera.aperture_radius_m**2
    weight = np.full(len(lit), spot.power_w * area / len(x))
    parts = [_connect(view, spot, room, light[s], eyes[s], weight[s]) for s in slices(len(lit), _PAIRS_AT_ONCE)]
    return _joined(parts)


def _is_cut(view: View, spot: LaserSpot, room: RoomGeometry, probes: Deposit) -> bool:
    """True if a part of the scattered light is blocked and a part is not, of pairs of probes and lens points."""
    pairs, eyes = _pairs(probes[probes.lit], _lens_points(view, np.concatenate([np.zeros((1, 2)), _RIM])))
    if not len(eyes):
        return False
    cloud = _connect(view, spot, room, pairs, eyes, np.ones(len(eyes)))
    lit = cloud.watts > 0.0
    return bool(lit.any()) and not bool(lit.all() and len(lit) == len(eyes))


def _joined(parts: Sequence[FilmCloud]) -> FilmCloud:
    if not parts:
        return FilmCloud(np.empty((0, 2)), np.empty(0))
    places = [p.points_m for p in parts if p.points_m is not None]
    return FilmCloud(
        np.concatenate([p.uv_px for p in parts]),
        np.concatenate([p.watts for p in parts]),
        np.concatenate(places) if len(places) == len(parts) else None,
    )


def film_position(view: View, lens_m: Array, mirror_m: Array) -> Array:
    """Film position (u, v), shape (N, 2), of rays from mirror points to aperture points, both in the camera frame."""
    focus = view.rig.camera.focus_distance_m
    ray = mirror_m - lens_m
    at_focus = lens_m + ray * (focus / ray[:, 2:])
    return view.rig.camera.to_pixel(at_focus[:, :2] / focus)


def _rim_images(view: View, spot: LaserSpot) -> tuple[Array, Array]:
    """Images, before blur, of the spot's rim (or sigma) and of the aperture's rim, film positions (8, 2)."""
    spot_uv = _film(view, footprint(spot, _RIM), _lens_points(view, np.zeros_like(_RIM)))
    return spot_uv, _film(view, np.broadcast_to(spot.position_world_m, (len(_RIM), 3)), _lens_points(view, _RIM))


_LONG, _SLENDER = 1.0, 3.0  # blurs along a streak, and lengths over its width
_BENT = 0.1  # blurs that the map of the rim may deviate from a linear one
_TURN = 2.0 * np.pi * np.arange(8) / 8.0
_RIM = np.stack([np.cos(_TURN), np.sin(_TURN)], axis=-1)


def _reach(uv: Array) -> float:
    seen = uv[np.isfinite(uv).all(axis=-1)]  # rim points beyond the mirror's edge have no image
    return float(np.linalg.norm(seen - seen.mean(axis=0), axis=-1).max()) if len(seen) else 0.0


def _fitting_nodes(profile: Profile, rim_uv: Array, blur_px: float) -> tuple[Array, Array]:
    """Nodes of a disc whose rim has this image: those of a streak where it is one, and the map to it is linear."""
    nodes = disc_nodes(profile, _reach(rim_uv) / blur_px)
    if not np.isfinite(rim_uv).all():
        return nodes
    offset = rim_uv - rim_uv.mean(axis=0)
    to_film = offset.T @ _RIM / (0.5 * len(_RIM))
    _, (along, across), axes = np.linalg.svd(to_film)
    bend = np.abs(offset - _RIM @ to_film.T).max()
    if along < _LONG * blur_px or along < _SLENDER * across or bend > _BENT * blur_px:
        return nodes
    streak, weights = streak_nodes(profile, along / blur_px, across / blur_px)
    return streak @ axes, weights


def _film(view: View, points: Array, eyes: Array) -> Array:
    pose = view.T_world_camera.inverse()
    return film_position(view, pose.points(eyes), pose.points(mirror_points(view, points, eyes).points_m))


def _nodes(view: View, spot: LaserSpot) -> tuple[Array, Array, Array, Array]:
    """Places across the spot, their weights (W), world points on the aperture, weights (m^2)."""
    blur, (spot_uv, lens_uv) = view.rig.camera.blur_sigma_px, _rim_images(view, spot)
    disc, share = _fitting_nodes(spot.profile, spot_uv, blur)
    aperture, area = _fitting_nodes("uniform", lens_uv, blur)
    area = area * math.pi * view.rig.camera.aperture_radius_m**2
    return disc, share * spot.power_w, _lens_points(view, aperture), area


def _lens_points(view: View, disc: Array) -> Array:
    flat = np.concatenate([view.rig.camera.aperture_radius_m * disc, np.zeros((len(disc), 1))], axis=-1)
    return view.T_world_camera.points(flat)


def _pairs(light: Deposit, eyes: Array) -> tuple[Deposit, Array]:
    """Every eye with every place of a deposit."""
    count = len(light.points_m)
    return light[np.tile(np.arange(count), len(eyes))], np.repeat(eyes, count, axis=0)


def _connect(view: View, spot: LaserSpot, room: RoomGeometry, light: Deposit, eyes: Array, weight: Array) -> FilmCloud:
    """Film positions and powers of pairs (spot point, aperture point (N, 3)), with quadrature weights (N,)."""
    points = light.points_m
    found = mirror_points(view, points, eyes)
    mirror, lit = found.points_m, found.lit
    way, to_lens = onward_ways(view, found, points), _unit(eyes - mirror)
    cos_i = np.einsum("ni,ni->n", to_lens, found.normals)
    cos_lens = -to_lens @ view.T_world_camera.R[:, 2]
    spread = bundle_spread(view, found, eyes, cos_i)
    rho = view.rig.mirror.reflectance(cos_i, spot.wavelength_nm)
    watts = weight * light.scattered(-way.directions) * rho * np.maximum(cos_lens, 0.0) / spread * way.transmittance
    free = _unobstructed(room, (*way.legs, (eyes, mirror)), lit)
    pose = view.T_world_camera.inverse()
    uv = film_position(view, pose.points(eyes), pose.points(mirror))
    return FilmCloud(uv[lit], np.where(free, watts, 0.0)[lit], points[lit])


def _unobstructed(room: RoomGeometry, legs: tuple[tuple[Array, Array], ...], lit: BoolArray) -> BoolArray:
    """Mask of lit pairs, shape (N,), of whose legs nothing stands in the way."""
    free = np.zeros(len(lit), dtype=bool)
    free[lit] = np.all([blocked_by(room, start[lit], end[lit]) < 0 for start, end in legs], axis=0)
    return free


def _unit(vectors: Array) -> Array:
    return vectors / np.linalg.norm(vectors, axis=-1)[:, None]


# Where the image lies: a certificate draws its film positions there.


_PILOTS = 4096
_APART = 4.0  # standard deviations from the image's middle: 3e-4 of a Gaussian
_MOST_APART = 8  # faces
_APART_WIDTH = 2.0  # a few pilots tell the extent badly
_WIDTHS = (1.3, 3.0)  # of the two Gaussians, relative to the image: bounded weights, and tails where it is no Gaussian
_MANY = 16  # pilots that tell a face's part of the image
_SCATTERED = 0.15  # area of the parts over that of a Gaussian about all of them, below which each is drawn by itself
_STRAY = 0.2  # share of the rays that are drawn about all of them even so


@dataclass(frozen=True)
class ImagePart:
    """Gaussian by which film positions are drawn: share of the rays, mean (2,) and root (2, 2) of the covariance."""

    share: float
    mean: Array
    root: Array

    def density(self, offset: Array) -> Array:
        """Rays per square pixel at offsets (N, 2), as a part of all rays."""
        r2 = (np.linalg.solve(self.root, (offset - self.mean).T) ** 2).sum(axis=0)
        return np.asarray(self.share * np.exp(-0.5 * r2) / (2.0 * math.pi * abs(np.linalg.det(self.root))))


def image_parts(view: View, spot: LaserSpot, room: RoomGeometry, chief_px: Array) -> list[ImagePart]:
    """Gaussians that cover the spot's image, pixels from the chief ray's.

    Two cover the whole. A tail of the beam that passes an edge lands further on, and its image apart from the rest:
    each face with such a part gets a Gaussian of its own. Where an edge splits the beam, the image is parts with little
    between them, and each is covered by itself. Only how densely film positions are drawn follows from all this, which
    is why the world-side solution may be used.
    """
    places = ndtri(np.clip(sobol(2, _PILOTS), 1e-4, 1.0 - 1e-4))
    light = deposit(spot, room, places if spot.profile == "gaussian" else 0.5 * places)
    light = light[light.lit]
    mirror = mirror_points(view, light.points_m, np.broadcast_to(view.camera_centre_m, light.points_m.shape)).points_m
    uv = view.rig.camera.project(view.T_world_camera.inverse().points(mirror)) - chief_px
    found = np.isfinite(uv).all(axis=1)
    uv, patch = np.concatenate([uv[found], np.zeros((1, 2))]), np.append(light.patch[found], -1)
    mean, covariance = _moments_of(uv)
    root = np.asarray(np.linalg.cholesky(covariance), float)
    if shared := _split_faces(uv, patch, covariance):
        offset = _offsets(view, spot, light.points_m[found])
        return [*_split_parts(offset, patch[:-1], shared), ImagePart(_STRAY, mean, _WIDTHS[1] * root)]
    away = np.linalg.norm(np.linalg.solve(root, (uv - mean).T), axis=0) > _APART
    faces, counts = np.unique(patch[away], return_counts=True)
    apart = faces[np.argsort(-counts, kind="stable")][:_MOST_APART]
    whole = 1.0 if len(apart) == 0 else 0.75
    parts = [ImagePart(0.5 * whole, mean, width * root) for width in _WIDTHS]
    for face in apart:
        own_mean, own = _moments_of(uv[away & (patch == face)])
        own_root = _APART_WIDTH * np.asarray(np.linalg.cholesky(own + 0.01 * covariance), float)
        parts.append(ImagePart((1.0 - whole) / len(apart), own_mean, own_root))
    return parts


def _split_faces(uv: Array, patch: IntArray, covariance: Array) -> list[int]:
    """Faces that share an image with little between its parts; none for any other image."""
    faces, counts = np.unique(patch[patch >= 0], return_counts=True)
    most = np.argsort(-counts, kind="stable")[:_MOST_APART]
    most = most[counts[most] >= _MANY]
    if len(most) < 2:
        return []
    areas = [math.sqrt(np.linalg.det(_moments_of(uv[patch == face])[1])) for face in faces[most]]
    return [] if sum(areas) > _SCATTERED * math.sqrt(np.linalg.det(covariance)) else faces[most].tolist()


def _offsets(view: View, spot: LaserSpot, points_m: Array) -> Array:
    """Film positions (N, 2) of points through all of the aperture, from those of the spot's centre through the same.

    Points behind the spot are out of its focus: their image moves with the ray's place in the aperture.
    """
    eyes = _lens_points(view, disc_points("uniform", sobol(2, len(points_m))))
    centre = np.broadcast_to(spot.position_world_m, points_m.shape)
    return _film(view, points_m, eyes) - _film(view, centre, eyes)


def _split_parts(offset: Array, patch: IntArray, faces: list[int]) -> list[ImagePart]:
    """Gaussians of the faces that share an image."""
    whole = np.isfinite(offset).all(axis=1)
    chosen = [offset[whole & (patch == face)] for face in faces]
    counts = np.array([len(part) for part in chosen])
    # half by the beam's parts, half to each alike: a small part may scatter much light to the mirror
    shares = (1.0 - _STRAY) * 0.5 * (counts / counts.sum() + 1.0 / len(counts))
    moments = [_moments_of(part) for part in chosen]
    return [
        ImagePart(0.5 * float(share), mean, width * np.asarray(np.linalg.cholesky(own), float))
        for share, (mean, own) in zip(shares, moments, strict=True)
        for width in _WIDTHS
    ]


def _moments_of(uv: Array) -> tuple[Array, Array]:
    """Mean and covariance; a spot of a point has an extent, too."""
    return uv.mean(axis=0), np.atleast_2d(np.cov(uv.T, bias=True)) + 1e-6 * np.eye(2)
