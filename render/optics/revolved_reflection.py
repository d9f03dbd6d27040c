"""Reflection points on a mirror of revolution by Fermat's principle: starts, Newton's method, and bracketed roots.

With a and b two points outside the mirror, F(P) = |a P| + |P b| is a convex function of P. The mirror with all that is
behind it, K = {z >= sag(x^2 + y^2)}, is a convex body. Where the straight line from a to b misses K, the least F on K
is on the surface, and it is a place where the gradient of F points into K: there light is reflected from a to b. A
convex problem has one such place. Where the line meets K the mirror stands between a and b, and no light is reflected.
So a stationary point that both ends see is the only one, wherever the search began.

The search begins in the half-plane of the axis and the point (its *meridian*), the eye moved into it. There f(r), the
slope of the path along the profile at the radius r, is at most 0 where the eye's line of sight touches the profile on
the side away from the point, and at least 0 where it touches on the point's side; between the two f has one root with
both ends outside. Newton's method inside the shrinking bracket finds it. For an eye on the axis this is the answer.
Otherwise Newton's method in the two coordinates across the axis starts there. Where many pairs lie close together, as
those of a spot and the lens, all start at the place of their middle; those that get nowhere take the long way.

A form error leaves K convex (`FormedProfile.check`), and all this remains true. The search in the half-plane is that of
the ideal profile. Where it ends beyond the rim or the limb, the other one starts there: the form may shift the answer
inside.

At the tip of a cone the path has a kink, where the search in the half-plane may end, and no second derivatives. What is
lost there begins again, one Newton step from the tip along the side on which the path falls most (`_beside_tip`).

That the place is the only one does not say that Newton's steps reach it. For points within millimetres of the mirror
they may not; what is lost there begins again where a careful descent ends (`_descended`).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from phibench.scenes.frames import Array
from phibench.scenes.revolved_profile import FormedProfile, Profile

_PLANE_STEPS = 80  # bisection alone would need 55; Newton takes 3 to 5
_STEPS = 30  # 2 to 5 do
_BEYOND = 1.05  # rim radii: where the search ends, unless the equator comes first
_EQUATOR = 0.999999
_LONGEST = 0.3  # step, in rim radii
_CLOSE = 1e-9  # of the rim's radius: the step after that would be its square
_FOUND = 1e-6
_BESIDE = 4.0  # rim radii from the vertex: points that are lost nearer than this are looked for by `_descended`
_DESCENTS, _HALVINGS = 60, 40
_MANY, _NEAR = 32, 0.05  # pairs, and their extent over their distance, that start together
Surface = Profile | FormedProfile
_START = 1e-6  # of the rim's radius: where the search in the half-plane ends; the one in two coordinates goes on


def revolved_points(points_m: Array, eyes_m: Array, surface: Surface) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Reflection points in the mirror's frame.

    Parameters
    ----------
    points_m, eyes_m : arrays, shape (N, 3)
        The two points, metres, relative to the vertex.

    Returns
    -------
    reflection_m : array, shape (N, 3); NaN where there is none inside the rim
    normals : array, shape (N, 3), unit, away from the mirror; NaN where there is none
    valid : bool array, shape (N,)
        The point lies inside the rim, and both ends on the outer side of the tangent plane there.
    """
    P, N = np.full((2, *points_m.shape), np.nan)
    valid = np.zeros(len(points_m), dtype=bool)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        if _are_close(points_m) and _are_close(eyes_m):
            middle = points_m.mean(axis=0)[None], eyes_m.mean(axis=0)[None]
            xy = np.repeat(_start(*middle, surface), len(points_m), axis=0)
            P, N, valid = _search(xy, points_m, eyes_m, surface)
        rest = np.flatnonzero(~valid)
        if len(rest):
            ends = points_m[rest], eyes_m[rest]
            P[rest], N[rest], valid[rest] = _search(_start(*ends, surface), *ends, surface)
        rest = np.flatnonzero(~valid)
        if len(rest) and surface.ideal.shape == "cone":  # which bears no form error
            ends = points_m[rest], eyes_m[rest]
            P[rest], N[rest], valid[rest] = _search(_beside_tip(*ends, surface.ideal), *ends, surface)
        rest = np.flatnonzero(~valid & (np.linalg.norm(points_m, axis=1) < _BESIDE * surface.rim_radius_m))
        if len(rest):
            ends = points_m[rest], eyes_m[rest]
            P[rest], N[rest], valid[rest] = _search(_descended(*ends, surface), *ends, surface)
    return P, N, valid


def _descended(points_m: Array, eyes_m: Array, surface: Surface) -> Array:
    """Places (x, y) near the least path, shape (N, 2), for points beside the mirror.

    There the path bends within millimetres, and Newton's steps may leave its basin. Here a step is taken only if the
    path becomes shorter, and goes down the slope where the path has no upward bend.
    """
    rim = surface.rim_radius_m
    xy = _start(points_m, eyes_m, surface)
    foot = points_m[:, :2] * np.minimum(1.0, rim / np.maximum(np.hypot(*points_m[:, :2].T), rim))[:, None]
    xy = np.where(np.isfinite(xy), xy, foot)

    def length(xy: Array) -> Array:
        P = np.concatenate([xy, surface.heights(*xy.T).z_m[:, None]], axis=-1)
        total = sum(np.linalg.norm(P - end, axis=-1) for end in (points_m, eyes_m))
        return np.where(np.hypot(*xy.T) <= _BEYOND * rim, np.nan_to_num(total, nan=np.inf), np.inf)

    now = length(xy)
    for _ in range(_DESCENTS):
        (g_x, g_y), (h_xx, h_xy, h_yy), _ = _path(xy, points_m, eyes_m, surface)
        g = np.stack([g_x, g_y], axis=-1)
        bends_up = (h_xx > 0.0) & (h_xx * h_yy > h_xy * h_xy)
        down = -g * (_LONGEST * rim / np.maximum(np.linalg.norm(g, axis=-1), 1e-300))[:, None]
        move = np.where(bends_up[:, None], _newton(xy, points_m, eyes_m, surface), down)
        for _ in range(_HALVINGS):
            new = length(xy + move)
            if not (longer := new > now).any():
                break
            move = np.where(longer[:, None], 0.5 * move, move)
        better = new < now
        xy, now = np.where(better[:, None], xy + move, xy), np.where(better, new, now)
        if not better.any():
            break
    return xy


def _beside_tip(points_m: Array, eyes_m: Array, profile: Profile) -> Array:
    """Places (x, y) one step from a cone's tip down the path, shape (N, 2); NaN where the path is least at the tip.

    Along a side (u, c), with u a unit vector across the axis and c the cone's slope, the path's derivative at the tip
    is -w.(u, c), where w is the sum of the unit vectors to the two ends. It is least for u along w.
    """
    ways = [end / np.linalg.norm(end, axis=-1, keepdims=True) for end in (points_m, eyes_m)]
    slope = (-1.0 - profile.conic) ** -0.5
    w = ways[0] + ways[1]
    across = np.hypot(w[:, 0], w[:, 1])
    side = np.column_stack([w[:, :2] / across[:, None], np.full(len(w), slope)])
    falls = across + slope * w[:, 2]
    bend = np.zeros(len(w))
    for end, way in zip((points_m, eyes_m), ways, strict=True):
        along = np.einsum("ni,ni->n", way, side)
        bend += (1.0 + slope * slope - along * along) / np.linalg.norm(end, axis=-1)
    return np.where(falls > 0.0, falls / bend, np.nan)[:, None] * side[:, :2]


def _are_close(ends_m: Array) -> bool:
    """Return True for many points, shape (N, 3), within a small part of their distance."""
    return len(ends_m) >= _MANY and bool(np.ptp(ends_m, axis=0).max() <= _NEAR * np.linalg.norm(ends_m[0]))


def _search(xy: Array, points_m: Array, eyes_m: Array, surface: Surface) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Newton's method from places (x, y), shape (N, 2); returns as `revolved_points`."""
    index = np.flatnonzero(np.isfinite(xy).all(axis=1))
    step = np.full(len(xy), np.inf)
    for _ in range(_STEPS):
        if not len(index):
            break
        whole = len(index) == len(xy)
        part = (xy, points_m, eyes_m) if whole else (xy[index], points_m[index], eyes_m[index])
        move = _newton(*part, surface)
        length = np.hypot(move[:, 0], move[:, 1])
        if whole:
            xy, step = xy + move, length
        else:
            xy[index] += move
            step[index] = length
        index = index[length > _CLOSE * surface.rim_radius_m]  # NaN leaves as well
    s, at = np.einsum("ni,ni->n", xy, xy), surface.heights(*xy.T)
    P = np.concatenate([xy, at.z_m[:, None]], axis=-1)
    N = np.stack([at.x, at.y, np.full(len(xy), -1.0)], axis=-1)
    N /= np.sqrt(1.0 + at.x**2 + at.y**2)[:, None]
    seen = [np.einsum("ni,ni->n", end - P, N) >= 0.0 for end in (points_m, eyes_m)]
    valid = seen[0] & seen[1] & (s <= surface.rim_radius_m**2) & (step <= _FOUND * surface.rim_radius_m)
    lost = ~valid
    P[lost], N[lost] = np.nan, np.nan
    return P, N, np.asarray(valid)


def _start(points_m: Array, eyes_m: Array, surface: Surface) -> Array:
    """Places (x, y) to begin at, shape (N, 2); NaN where no place inside the rim can be the answer."""
    away = np.hypot(points_m[:, 0], points_m[:, 1])
    across = np.where(away[:, None] > 0.0, points_m[:, :2] / away[:, None], [1.0, 0.0])
    end = (away, points_m[:, 2])
    eye = (np.einsum("ni,ni->n", eyes_m[:, :2], across), eyes_m[:, 2])
    r = _in_meridian(end, eye, surface.ideal, to_end=surface is not surface.ideal)
    return r[:, None] * across


Plane = tuple[Array, Array]  # radius and height of points in a half-plane, each of shape (N,)


def _in_meridian(point: Plane, eye: Plane, profile: Profile, *, to_end: bool) -> Array:
    """Root of f, shape (N,). Where it lies beyond the rim or the limb, NaN, or the end of what is seen."""
    reach = min(_BEYOND * profile.rim_radius_m, _EQUATOR * profile.equator_m)
    low, high = _seen_part(eye, profile, reach)
    inside, outside = _slope(low, point, eye, profile)[0] > 0.0, _slope(high, point, eye, profile)[0] < 0.0
    ends = np.where(inside, low, high), inside | outside
    start, rest = np.where(ends[1], np.nan, 0.5 * (low + high)), _START * profile.rim_radius_m
    r = rising_root(lambda r: _slope(r, point, eye, profile), start, (low, high), rest, _PLANE_STEPS)
    return np.where(ends[1], ends[0], r) if to_end else r


Rising = Callable[[Array], tuple[Array, Array]]
"""Function that is below 0 before its root and above 0 behind it: values and slopes at places, shape (N,)."""


def rising_root(f: Rising, start: Array, ends: Plane, rest: Array | float, most: int) -> Array:
    """Roots by Newton's method in the bracket between two ends, which is halved where a step would leave it.

    The search ends when no step is above `rest`, after `most` of them at most.
    """
    (low, high), x = ends, start
    for _ in range(most):
        value, slope = f(x)
        low, high = np.where(value < 0.0, x, low), np.where(value > 0.0, x, high)
        step = x - value / slope
        new = np.where((step >= low) & (step <= high), step, 0.5 * (low + high))
        moving = np.abs(new - x) > rest
        x = new
        if not moving.any():
            break
    return x


def _seen_part(eye: Plane, profile: Profile, reach: float) -> Plane:
    """Least and largest radius on the profile that the eye sees, up to `reach`."""
    ends = []
    for side in (-1.0, 1.0):
        high = np.full(len(eye[0]), side * reach)
        hidden = np.flatnonzero(~_faces(high, eye, profile))
        if len(hidden):
            part = (eye[0][hidden], eye[1][hidden])
            low, far = np.clip(part[0], -reach, reach), high[hidden]
            for _ in range(_PLANE_STEPS):
                middle = 0.5 * (low + far)
                facing = _faces(middle, part, profile)
                low, far = np.where(facing, middle, low), np.where(facing, far, middle)
            high[hidden] = low
        ends.append(high)
    return ends[0], ends[1]


def _faces(r: Array, eye: Plane, profile: Profile) -> NDArray[np.bool_]:
    """Mask of places r whose tangent has the eye below it."""
    z, slope, _ = _profile(r, profile)
    return np.asarray(z + slope * (eye[0] - r) - eye[1] > 0.0)


def _profile(r: Array, profile: Profile) -> tuple[Array, Array, Array]:
    """Height of the profile and its derivatives by the radius, which may be negative."""
    sag = profile.sag(r * r)
    slope, bend = 2.0 * r * sag.slope_per_m, 2.0 * sag.slope_per_m + 4.0 * r * r * sag.bend_per_m3
    if profile.shape != "cone":
        return sag.z_m, slope, bend
    tangent = (-1.0 - profile.conic) ** -0.5
    return sag.z_m, tangent * np.where(r < 0.0, -1.0, 1.0), np.zeros_like(r)


def _slope(r: Array, point: Plane, eye: Plane, profile: Profile) -> tuple[Array, Array]:
    """f and its derivative: of the path by the radius."""
    z, z1, z2 = _profile(r, profile)
    f, bend = np.zeros_like(r), np.zeros_like(r)
    for away, height in (point, eye):
        dr, dz = r - away, z - height
        length = np.hypot(dr, dz)
        along = (dr + dz * z1) / length
        f += along
        bend += (1.0 + z1 * z1 + dz * z2 - along * along) / length
    return f, bend


def _newton(xy: Array, points_m: Array, eyes_m: Array, surface: Surface) -> Array:
    """Step in (x, y), shape (N, 2), no longer than `_LONGEST` rim radii."""
    (g_x, g_y), (h_xx, h_xy, h_yy), _ = _path(xy, points_m, eyes_m, surface)
    det = h_xx * h_yy - h_xy * h_xy
    move = np.stack([h_xy * g_y - h_yy * g_x, h_xy * g_x - h_xx * g_y], axis=-1) / det[:, None]
    length = np.hypot(move[:, 0], move[:, 1])[:, None]
    return move * np.minimum(1.0, _LONGEST * surface.rim_radius_m / np.maximum(length, 1e-300))


def _path(
    xy: Array, points_m: Array, eyes_m: Array, surface: Surface
) -> tuple[tuple[Array, Array], tuple[Array, Array, Array], Array]:
    """Derivatives of the path as a function of x and y: slopes, second derivatives xx, xy, yy; and squared slope of z.

    All of shape (N,). Components are written out: matrices of each pair would take three times as long.
    """
    x, y = xy.T
    at = surface.heights(x, y)
    z_x, z_y, z_xx, z_xy, z_yy = at.x, at.y, at.xx_per_m, at.xy_per_m, at.yy_per_m
    g_x, g_y, h_xx, h_xy, h_yy = np.zeros((5, len(x)))
    for end in (points_m, eyes_m):
        dx, dy, dz = x - end[:, 0], y - end[:, 1], at.z_m - end[:, 2]
        near = 1.0 / np.sqrt(dx * dx + dy * dy + dz * dz)
        u_x, u_y = (dx + dz * z_x) * near, (dy + dz * z_y) * near
        g_x, g_y = g_x + u_x, g_y + u_y
        h_xx = h_xx + near * (1.0 + z_x * z_x + dz * z_xx - u_x * u_x)
        h_xy = h_xy + near * (z_x * z_y + dz * z_xy - u_x * u_y)
        h_yy = h_yy + near * (1.0 + z_y * z_y + dz * z_yy - u_y * u_y)
    return (g_x, g_y), (h_xx, h_xy, h_yy), z_x * z_x + z_y * z_y


def revolved_determinant(mirror_m: Array, points_m: Array, eyes_m: Array, surface: Surface) -> Array:
    """Determinant of the path's second derivatives along the surface, shape (N,), 1/m^2, at reflection points.

    Those by x and y are T^T M T, with T the derivatives of the surface point: det(T)^2 = 1 + |grad z|^2.
    """
    _, (h_xx, h_xy, h_yy), steep = _path(mirror_m[:, :2], points_m, eyes_m, surface)
    return np.asarray((h_xx * h_yy - h_xy * h_xy) / (1.0 + steep))
