"""Reflection point on the mirror between a world point and the lens, also through a glass tube; spread of the bundle.

**Perfect sphere: Alhazen's problem.** In the plane of the two points and the sphere centre one angle gamma is unknown.
With c and p the distances of the points from the centre, beta the angle between them, and l_c and l_p the two path
lengths, the total length is stationary where

    f(gamma) = c sin(gamma) / l_c - p sin(beta - gamma) / l_p = 0.

Both points see the mirror point for gamma between beta - acos(R / p) and acos(R / c). There f rises from a value <= 0
to a value >= 0: the root is single, and Newton's method inside the shrinking bracket cannot fail. An empty interval
means that there is no reflection.

**Form error: Fermat's path.** Let u and v be the unit vectors from the points a, b to a surface point P, l and m the
distances, N the outward normal and K the curvature matrix of the surface (positive where convex). On the surface the
path |a P| + |P b| has the gradient (u + v), taken tangentially, and the second derivatives

    M = (I - u u^T) / l + (I - v v^T) / m - ((u + v) . N) K,    tangentially.

Newton's method takes P to where the gradient vanishes. It starts from Alhazen's point of the largest sphere about the
centre that is certainly inside: where that sphere is in the way, so is the mirror. The mirror is convex (`SphereMirror`
checks it). The tangent plane at a point that both ends see has the straight line between them on one side and the
mirror on the other, so that there is at most one such point. With a the source, l^2 m^2 det(M) / cos^2 i is the spread
of the reflected bundle from steradians to square metres at b: Coddington's (1 + m / s_t) (1 + m / s_s) l^2 for any
curvature matrix.

**Mirror of revolution.** `revolved_reflection` finds the point; M is the same.

**Glass tube around the mirror.** A point outside appears at another place to rays from inside, which depends on the
ray (`scenes.glass_tube`): the reflection point of that place gives the ray, and the ray the place. Rounds of the two
settle, because a few millimetres of glass move little. The bundle that spreads from the place to the eye is that of
the point but for the growth of areas across it (`GlassTube.stretch`), with the ray's derivatives by the place from M:
where it moves by dW, the reflection point moves by M^-1 (I - u u^T) dW / l, tangentially.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from phibench.render.optics.revolved_reflection import revolved_determinant, revolved_points, rising_root
from phibench.scenes.form_error import Form, Level, deviation, level
from phibench.scenes.frames import Array, BoolArray, cross
from phibench.scenes.glass_tube import GlassTube, parts_across
from phibench.scenes.mirror import Mirror, SphereMirror
from phibench.scenes.revolved_mirror import RevolvedMirror
from phibench.scenes.rig import View


@dataclass(frozen=True)
class MirrorPoints:
    """Reflection points, world frame; NaN where there is none.

    Attributes
    ----------
    points_m, normals : arrays, shape (N, 3)
    lit : bool array, shape (N,)
        Whether both ends see the point.
    apparent_m : array, shape (N, 3)
        Where the world points appear from inside a tube; the points themselves where no glass is between.
    bent : bool array, shape (N,), or None
        Whether a tube's wall is on the way; None without a tube.
    """

    points_m: Array
    normals: Array
    lit: BoolArray
    apparent_m: Array
    bent: BoolArray | None = None


def mirror_points(view: View, points_m: Array, eyes_m: Array, rest: float = 4e-16) -> MirrorPoints:
    """Reflection points for pairs of world points, shape (N, 3) each.

    Where glass is around the mirror and no ray through it leads to a point, the straight one is given, and not lit.
    A perfect sphere's search ends with a step below `rest` of the angle between the points. The default asks for the
    last bit; Newton's method squares the error, so that 1e-9 leaves 1e-16, in an eighth of the steps.
    """
    tube, solver = view.tube, _solver_of(view.rig.mirror, rest)
    if tube is None:
        return solver.points(view, points_m, eyes_m)
    apparent, bent = points_m, tube.outside(points_m)
    step = np.full(len(points_m), np.inf)
    for _ in range(_GLASS_ROUNDS):
        found = solver.points(view, apparent, eyes_m)
        with np.errstate(divide="ignore", invalid="ignore"):
            ray = _split(apparent - found.points_m)[1]
            new = np.where(bent[:, None], tube.appearing(points_m, *tube.invariants(found.points_m, ray)), points_m)
            step = np.linalg.norm(new - apparent, axis=1)
        if not np.any(step > _SETTLED_M):
            break
        apparent = np.where((found.lit & np.isfinite(step))[:, None], new, apparent)
    lost = found.lit & ~(step <= _ENOUGH_M)
    if lost.any():
        apparent, bent = np.where(lost[:, None], points_m, apparent), bent & ~lost
        found = solver.points(view, apparent, eyes_m)
    return MirrorPoints(found.points_m, found.normals, found.lit & ~lost, apparent, bent)


@dataclass(frozen=True)
class OnwardWays:
    """Ways from reflection points to world points.

    Attributes
    ----------
    directions : array, shape (N, 3)
        Unit directions in which the points are reached.
    legs : tuple of pairs of arrays, shape (N, 3)
        Starts and ends of the straight parts, in order.
    transmittance : array, shape (N,)
        Of the glass.
    """

    directions: Array
    legs: tuple[tuple[Array, Array], ...]
    transmittance: Array | float


def onward_ways(view: View, found: MirrorPoints, points_m: Array) -> OnwardWays:
    """Ways from reflection points to the points (N, 3) that they were found for."""
    mirror, tube = found.points_m, view.tube
    directions = -_split(mirror - found.apparent_m)[1]
    if tube is None or found.bent is None:
        return OnwardWays(directions, ((mirror, points_m),), 1.0)
    crossing, bent = tube.leave(mirror, directions), found.bent[:, None]
    whole = points_m - mirror  # a straight way is cut anywhere
    inner, outer = (
        np.where(bent, crossing.inner_m, mirror + whole / 3.0),
        np.where(bent, crossing.outer_m, mirror + whole * (2.0 / 3.0)),
    )
    legs = ((mirror, inner), (inner, outer), (outer, points_m))
    return OnwardWays(
        np.where(bent, crossing.directions, directions), legs, np.where(found.bent, crossing.transmittance, 1.0)
    )


def bundle_spread(view: View, found: MirrorPoints, eyes_m: Array, cos_i: Array) -> Array:
    """Square metres at the eye per steradian at the point, shape (N,), of the bundle that is reflected there."""
    spread = _solver_of(view.rig.mirror).spread(view, found.points_m, found.apparent_m, eyes_m, cos_i)
    if view.tube is None or found.bent is None:
        return spread
    return spread * np.where(found.bent, _stretch(view, view.tube, found, eyes_m), 1.0)


# Kinds of mirror.


class _Solver(Protocol):
    """World-side optics of one kind of mirror."""

    def points(self, view: View, points_m: Array, eyes_m: Array) -> MirrorPoints:
        """Reflection points without glass."""

    def spread(self, view: View, mirror_m: Array, points_m: Array, eyes_m: Array, cos_i: Array) -> Array:
        """Square metres at the eye per steradian at the point, shape (N,), without glass."""


def _solver_of(mirror: Mirror, rest: float = 4e-16) -> _Solver:
    """Optics of a mirror: the one test of its type on the world's side."""
    if isinstance(mirror, RevolvedMirror):
        return _Revolved(mirror)
    if isinstance(mirror, SphereMirror):
        return _Round(mirror, rest) if mirror.form is None else _Formed(mirror, mirror.form)
    raise TypeError(f"no reflection points of {type(mirror).__name__}: add it to render/optics/reflection_point.py")


def _in_mirror(view: View, places_m: Array) -> Array:
    """World points (N, 3) in the mirror's frame."""
    return (places_m - view.sphere_centre_m) @ view.T_world_sphere.R


def _in_world(view: View, found: Array, normals: Array, lit: BoolArray, points_m: Array) -> MirrorPoints:
    axes = view.T_world_sphere.R
    return MirrorPoints(found @ axes.T + view.sphere_centre_m, normals @ axes.T, lit, points_m)


@dataclass(frozen=True)
class _Round:
    """Alhazen's point; with s the distance point to mirror and l mirror to eye, s^2 (1 + l/s_t) (1 + l/s_s)."""

    mirror: SphereMirror
    rest: float

    def points(self, view: View, points_m: Array, eyes_m: Array) -> MirrorPoints:
        centre, radius_m = view.sphere_centre_m, self.mirror.radius_m
        found, lit = reflection_points(points_m - centre, eyes_m - centre, radius_m, self.rest)
        found = found + centre
        return MirrorPoints(found, (found - centre) / radius_m, lit, points_m)

    def spread(self, view: View, mirror_m: Array, points_m: Array, eyes_m: Array, cos_i: Array) -> Array:
        s, far = (np.linalg.norm(end - mirror_m, axis=-1) for end in (points_m, eyes_m))
        spread = s**2 * (1.0 + far * (1.0 / s + 2.0 / (self.mirror.radius_m * cos_i)))
        return np.asarray(spread * (1.0 + far * (1.0 / s + 2.0 * cos_i / self.mirror.radius_m)))


@dataclass(frozen=True)
class _Formed:
    """Fermat's path from Alhazen's point; s^2 l^2 det(M) / cos^2 i."""

    mirror: SphereMirror
    form: Form

    def points(self, view: View, points_m: Array, eyes_m: Array) -> MirrorPoints:
        ends = _in_mirror(view, points_m), _in_mirror(view, eyes_m)
        return _in_world(view, *fermat_points(*ends, self.mirror.radius_m, self.form), points_m)

    def spread(self, view: View, mirror_m: Array, points_m: Array, eyes_m: Array, cos_i: Array) -> Array:
        ends = _in_mirror(view, points_m), _in_mirror(view, eyes_m)
        det = path_determinant(_in_mirror(view, mirror_m), *ends, self.mirror)
        return _from_determinant(det, mirror_m, points_m, eyes_m, cos_i)


@dataclass(frozen=True)
class _Revolved:
    """Fermat's path in the coordinates across the axis; the same spread."""

    mirror: RevolvedMirror

    def points(self, view: View, points_m: Array, eyes_m: Array) -> MirrorPoints:
        ends = _in_mirror(view, points_m), _in_mirror(view, eyes_m)
        return _in_world(view, *revolved_points(*ends, self.mirror.surface), points_m)

    def spread(self, view: View, mirror_m: Array, points_m: Array, eyes_m: Array, cos_i: Array) -> Array:
        ends = _in_mirror(view, points_m), _in_mirror(view, eyes_m)
        det = revolved_determinant(_in_mirror(view, mirror_m), *ends, self.mirror.surface)
        return _from_determinant(det, mirror_m, points_m, eyes_m, cos_i)


def _from_determinant(det: Array, mirror_m: Array, points_m: Array, eyes_m: Array, cos_i: Array) -> Array:
    s, far = (np.linalg.norm(end - mirror_m, axis=-1) for end in (points_m, eyes_m))
    return np.asarray((s * far / cos_i) ** 2 * det)


# Glass around the mirror.


_GLASS_ROUNDS = 40  # three to six do, unless the wall is thick and the point near
_SETTLED_M = 1e-13
_ENOUGH_M = 1e-12  # rounding of a room 100 m wide


def _stretch(view: View, tube: GlassTube, found: MirrorPoints, eyes_m: Array) -> Array:
    """Growth of areas across the bundle from an eye, shape (N,)."""
    axes, centre, mirror = view.T_world_sphere.R, view.sphere_centre_m, view.rig.mirror
    P, a, b = ((place - centre) @ axes for place in (found.points_m, found.apparent_m, eyes_m))
    with np.errstate(divide="ignore", invalid="ignore"):
        tangents, _, M = _path(P, a, b, mirror.level(P))
        tangents = tangents @ axes.T
        length, ray = _split(found.apparent_m - found.points_m)
        inverse = np.stack([M[:, 1, 1], -M[:, 0, 1], -M[:, 0, 1], M[:, 0, 0]], axis=-1).reshape(-1, 2, 2)
        inverse = inverse / (M[:, 0, 0] * M[:, 1, 1] - M[:, 0, 1] ** 2)[:, None, None]

        def moved(vectors: Array) -> Array:
            """Transposed derivative of the reflection point by the place, times vectors."""
            flat = np.einsum("nkl,nli,ni->nk", inverse, tangents, vectors)
            return parts_across(np.einsum("nk,nki->ni", flat, tangents), ray, length)

        axis = np.broadcast_to(tube.axis, ray.shape)
        by_moment = parts_across(cross(tube.axis, found.points_m - tube.origin_m), ray, length)
        by_cosine = parts_across(axis, ray, length)
        moment_slope = by_moment + moved(cross(ray, axis) - by_moment)
        cosine_slope = by_cosine - moved(by_cosine)
        return tube.stretch(found.apparent_m, found.points_m, moment_slope, cosine_slope)


# Alhazen's problem.


_ALHAZEN_STEPS = 60  # bisection alone would need 53; Newton takes 4 to 7


def reflection_points(
    points_m: Array, eyes_m: Array, radius_m: float, rest: float = 4e-16
) -> tuple[Array, NDArray[np.bool_]]:
    """Reflection points on the convex side of a sphere at the origin.

    Parameters
    ----------
    points_m, eyes_m : arrays, shape (N, 3)
        The two points, metres, relative to the sphere centre.
    rest : float
        Of the angle between the points: the step that ends the search.

    Returns
    -------
    reflection_m : array, shape (N, 3); NaN where there is none
    valid : bool array, shape (N,)
        Both points lie on the outer side of the tangent plane at the reflection point.
    """
    p, c = (np.linalg.norm(v, axis=-1) for v in (points_m, eyes_m))
    e1 = eyes_m / c[:, None]
    across = points_m - np.einsum("ni,ni->n", points_m, e1)[:, None] * e1
    width = np.linalg.norm(across, axis=-1)
    beta = np.arctan2(width, np.einsum("ni,ni->n", points_m, e1))
    with np.errstate(invalid="ignore", divide="ignore"):
        e2 = np.where(width[:, None] > 0.0, across / width[:, None], 0.0)
        low = np.maximum(0.0, beta - np.arccos(radius_m / p))
        high = np.minimum(beta, np.arccos(radius_m / c))
        lit = low <= high
        low, high = np.where(lit, low, np.nan), np.where(lit, high, np.nan)
        f = partial(_stationarity, p, c, beta, radius_m)
        gamma = rising_root(f, 0.5 * (low + high), (low, high), rest * beta, _ALHAZEN_STEPS)
    found = radius_m * (np.cos(gamma)[:, None] * e1 + np.sin(gamma)[:, None] * e2)
    return np.where(lit[:, None], found, np.nan), lit


def _stationarity(p: Array, c: Array, beta: Array, radius: float, gamma: Array) -> tuple[Array, Array]:
    """f(gamma) and its derivative."""
    f_c, slope_c = _tangential(c, gamma, radius)
    f_p, slope_p = _tangential(p, beta - gamma, radius)
    return f_c - f_p, slope_c + slope_p


def _tangential(distance: Array, angle: Array, radius: float) -> tuple[Array, Array]:
    """d sin(a) / l and its derivative by a, with l the distance from the mirror point."""
    # l^2 = (d - R)^2 + 4 d R sin^2(a/2): no cancellation near the surface
    length = np.sqrt((distance - radius) ** 2 + 4.0 * distance * radius * np.sin(0.5 * angle) ** 2)
    value = distance * np.sin(angle) / length
    return value, (distance * np.cos(angle) - radius * value**2) / length


# Fermat's path.


_FERMAT_STEPS = 30  # 4 to 6 do, but at grazing incidence
_LONGEST = 0.2  # step, in radii: the next point stays on the same side of the mirror
_CLOSE = 1e-9  # of the radius: the step after that would be its square
_FOUND = 1e-6  # of the radius: the last step of a search that went well


def fermat_points(
    points_m: Array, eyes_m: Array, radius_m: float, form: Form
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Reflection points in the sphere's frame.

    Parameters
    ----------
    points_m, eyes_m : arrays, shape (N, 3)
        The two points, metres, relative to the sphere centre.

    Returns
    -------
    reflection_m : array, shape (N, 3); NaN where there is none
    normals : array, shape (N, 3), unit, outward; NaN where there is none
    valid : bool array, shape (N,)
        Both points lie on the outer side of the tangent plane at the reflection point.
    """
    inner = radius_m - form.bound_m
    start, possible = reflection_points(points_m, eyes_m, inner)
    index = np.flatnonzero(possible)
    a, b = points_m[index], eyes_m[index]
    P = _onto(start[index], radius_m, form)
    step = np.full(len(P), np.inf)
    for _ in range(_FERMAT_STEPS):
        going = np.flatnonzero(~(step <= _CLOSE * radius_m))
        if not len(going):
            break
        move = _newton(P[going], a[going], b[going], radius_m, form)
        P[going] = _onto(P[going] + move, radius_m, form)
        step[going] = np.linalg.norm(move, axis=-1)
    N = _normals(P, radius_m, form)
    seen = [np.einsum("ni,ni->n", end - P, N) >= 0.0 for end in (a, b)]
    lit = np.all(seen, axis=0) & (step <= _FOUND * radius_m)
    reflection, normals = np.full((2, *points_m.shape), np.nan)
    valid = np.zeros(len(points_m), dtype=bool)
    reflection[index[lit]], normals[index[lit]], valid[index[lit]] = P[lit], N[lit], True
    return reflection, normals, valid


def path_determinant(mirror_m: Array, points_m: Array, eyes_m: Array, mirror: Mirror) -> Array:
    """det(M), shape (N,), 1/m^2, at reflection points, all in the mirror's frame."""
    _, _, M = _path(mirror_m, points_m, eyes_m, mirror.level(mirror_m))
    return M[:, 0, 0] * M[:, 1, 1] - M[:, 0, 1] ** 2


def _newton(P: Array, a: Array, b: Array, radius_m: float, form: Form) -> Array:
    """Step in the tangent plane, shape (N, 3), no longer than `_LONGEST` radii."""
    tangents, slope, M = _path(P, a, b, level(P, radius_m, form))
    det = M[:, 0, 0] * M[:, 1, 1] - M[:, 0, 1] ** 2
    x = (M[:, 1, 1] * slope[:, 0] - M[:, 0, 1] * slope[:, 1]) / det
    y = (M[:, 0, 0] * slope[:, 1] - M[:, 0, 1] * slope[:, 0]) / det
    move = -(x[:, None] * tangents[:, 0] + y[:, None] * tangents[:, 1])
    length = np.linalg.norm(move, axis=-1, keepdims=True)
    return move * np.minimum(1.0, _LONGEST * radius_m / np.maximum(length, 1e-300))


def _path(P: Array, a: Array, b: Array, surface: Level) -> tuple[Array, Array, Array]:
    """Two tangents (N, 2, 3), the path's slopes along them (N, 2) and second derivatives M (N, 2, 2)."""
    length = np.linalg.norm(surface.gradient, axis=-1)
    N = surface.gradient / length[:, None]
    tangents = _tangents(N)
    (near, u), (far, v) = _split(P - a), _split(P - b)
    flat_u, flat_v, slope = (np.einsum("nki,ni->nk", tangents, w) for w in (u, v, u + v))
    M = tangents @ surface.hessian_per_m @ tangents.transpose(0, 2, 1)
    M *= (-np.einsum("ni,ni->n", u + v, N) / length)[:, None, None]
    for flat, distance in ((flat_u, near), (flat_v, far)):
        M += (np.eye(2) - flat[:, :, None] * flat[:, None, :]) / distance[:, None, None]
    return tangents, slope, M


def _tangents(N: Array) -> Array:
    """Two unit vectors across each unit normal, shape (N, 2, 3)."""
    helper = np.eye(3)[np.argmin(np.abs(N), axis=-1)]
    first = cross(N, helper)
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    return np.stack([first, cross(N, first)], axis=1)


def _onto(P: Array, radius_m: float, form: Form) -> Array:
    """Surface points in the directions of P."""
    n = P / np.linalg.norm(P, axis=-1, keepdims=True)
    return (radius_m + deviation(n, form).value_m)[:, None] * n


def _normals(P: Array, radius_m: float, form: Form) -> Array:
    gradient = level(P, radius_m, form).gradient
    return gradient / np.linalg.norm(gradient, axis=-1, keepdims=True)


def _split(vectors: Array) -> tuple[Array, Array]:
    """Lengths (N,) and unit vectors (N, 3)."""
    length = np.linalg.norm(vectors, axis=-1)
    return length, vectors / length[:, None]
