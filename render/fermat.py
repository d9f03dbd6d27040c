"""The point of a mirror with a form error that reflects one given point to another: Fermat's path.

With u and v the unit vectors from the two points a, b to a surface point P, l and m the distances, N the outward
normal and K the curvature matrix of the surface (positive where convex), the path |a P| + |P b| has on the surface the
gradient (u + v), taken tangentially, and the second derivatives

    M = (I - u u^T) / l + (I - v v^T) / m - ((u + v) . N) K,    tangentially.

Newton's method takes P to where the gradient vanishes. It starts from Alhazen's point of the largest sphere about the
centre that is certainly inside: where that sphere is in the way, so is the mirror. The mirror is convex (`SphereMirror`
sees to that), and the tangent plane at a point that both ends see has the straight line between them on one side and
the mirror on the other, so that there is one such point at most. M is the optics of the reflected bundle as well: with
a the source, l^2 m^2 det(M) / cos^2 i is its spread from steradians to square metres at b, which is Coddington's
(1 + m / s_t) (1 + m / s_s) l^2 for any curvature matrix.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from phibench.render.alhazen import reflection_points
from phibench.scenes.form import Form, deviation, level
from phibench.scenes.frames import Array

_STEPS = 30  # 4 to 6 do, but at grazing incidence
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
    radius_m, form

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
    for _ in range(_STEPS):
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


def path_determinant(mirror_m: Array, points_m: Array, eyes_m: Array, radius_m: float, form: Form) -> Array:
    """det(M), shape (N,), 1/m^2, at reflection points, all in the sphere's frame."""
    _, _, M = _path(mirror_m, points_m, eyes_m, radius_m, form)
    return M[:, 0, 0] * M[:, 1, 1] - M[:, 0, 1] ** 2


def _newton(P: Array, a: Array, b: Array, radius_m: float, form: Form) -> Array:
    """Step in the tangent plane, shape (N, 3), no longer than `_LONGEST` radii."""
    tangents, slope, M = _path(P, a, b, radius_m, form)
    det = M[:, 0, 0] * M[:, 1, 1] - M[:, 0, 1] ** 2
    x = (M[:, 1, 1] * slope[:, 0] - M[:, 0, 1] * slope[:, 1]) / det
    y = (M[:, 0, 0] * slope[:, 1] - M[:, 0, 1] * slope[:, 0]) / det
    move = -(x[:, None] * tangents[:, 0] + y[:, None] * tangents[:, 1])
    length = np.linalg.norm(move, axis=-1, keepdims=True)
    return move * np.minimum(1.0, _LONGEST * radius_m / np.maximum(length, 1e-300))


def _path(P: Array, a: Array, b: Array, radius_m: float, form: Form) -> tuple[Array, Array, Array]:
    """Two tangents (N, 2, 3), the path's slopes along them (N, 2) and second derivatives M (N, 2, 2)."""
    surface = level(P, radius_m, form)
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
    first = np.cross(N, helper)
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    return np.stack([first, np.cross(N, first)], axis=1)


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
