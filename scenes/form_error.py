"""Form errors of a mirror (`Form`): harmonics added to a radius, derivatives of the surface, its occluding contour.

The form error adds low-order harmonics to the sphere's radius. The surface is r(n) = R + sum of c_k h_k(n), with
n = (x, y, z) a unit direction in the sphere's own frame (`T_camera_sphere`). `Rig.perturbed` lays its axes along the
world's at the down position: z up, so that -z faces the camera. The real harmonics h_k of degree 2 and 3 are scaled to
a largest magnitude of 1: a coefficient is the peak of what it adds, in metres, and not its rms. Degree 0 is the radius
and degree 1, to first order, a decentre: both are parameters already.

    20    (3 z^2 - 1) / 2        +1 at the poles (top and bottom), -1/2 around the equator
    21c   2 x z                  21s  2 y z
    22c   x^2 - y^2              22s  2 x y
    30    (5 z^3 - 3 z) / 2      +1 at the top, -1 at the bottom
    31c   a x (5 z^2 - 1)        31s  a y (5 z^2 - 1)     a = 3 sqrt(15) / 16
    32c   b z (x^2 - y^2)        32s  2 b x y z           b = 3 sqrt(3) / 2
    33c   x^3 - 3 x y^2          33s  3 x^2 y - y^3

On the unit sphere a harmonic of degree l is a homogeneous polynomial H of degree l (x^2 + y^2 + z^2 = 1 makes the terms
equal in degree). Off the surface it is continued as H(P) / |P|^l, and the surface is the zero of the level function
g(P) = |P| - R - H2(P) / |P|^2 - H3(P) / |P|^3.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, fields
from functools import cache, cached_property

import numpy as np

from phibench.scenes.frames import Array
from phibench.scenes.validation import finite

_A, _B = 3.0 * math.sqrt(15.0) / 16.0, 3.0 * math.sqrt(3.0) / 2.0


# Homogeneous polynomials: monomial -> coefficient. _A and _B scale the largest magnitude on the sphere to 1.
_POLYNOMIALS: dict[str, dict[str, float]] = {
    "form_20_m": {"zz": 1.0, "xx": -0.5, "yy": -0.5},
    "form_21c_m": {"xz": 2.0},
    "form_21s_m": {"yz": 2.0},
    "form_22c_m": {"xx": 1.0, "yy": -1.0},
    "form_22s_m": {"xy": 2.0},
    "form_30_m": {"zzz": 1.0, "xxz": -1.5, "yyz": -1.5},
    "form_31c_m": {"xzz": 4.0 * _A, "xxx": -_A, "xyy": -_A},
    "form_31s_m": {"yzz": 4.0 * _A, "xxy": -_A, "yyy": -_A},
    "form_32c_m": {"xxz": _B, "yyz": -_B},
    "form_32s_m": {"xyz": 2.0 * _B},
    "form_33c_m": {"xxx": 1.0, "xyy": -3.0},
    "form_33s_m": {"xxy": 3.0, "yyy": -1.0},
}


@dataclass(frozen=True)
class Form:
    """Peak deviations from the sphere, metres, signed: positive is outward where the harmonic is positive."""

    form_20_m: float = 0.0
    form_21c_m: float = 0.0
    form_21s_m: float = 0.0
    form_22c_m: float = 0.0
    form_22s_m: float = 0.0
    form_30_m: float = 0.0
    form_31c_m: float = 0.0
    form_31s_m: float = 0.0
    form_32c_m: float = 0.0
    form_32s_m: float = 0.0
    form_33c_m: float = 0.0
    form_33s_m: float = 0.0

    def __post_init__(self) -> None:
        for name in HARMONICS:
            object.__setattr__(self, name, finite("Form", name, float(getattr(self, name))))

    @property
    def coefficients_m(self) -> tuple[float, ...]:
        """Peaks in the order of `HARMONICS`."""
        return tuple(getattr(self, name) for name in HARMONICS)

    @property
    def bound_m(self) -> float:
        """No point of the surface is farther from the sphere than this: the sum of the peaks."""
        return math.fsum(map(abs, self.coefficients_m))

    @cached_property
    def tensors(self) -> tuple[Array, Array]:
        """Symmetric tensors of H2 and H3, metres, shapes (3, 3) and (3, 3, 3)."""
        degree_2, degree_3 = _basis()
        c = np.array(self.coefficients_m)
        return np.tensordot(c[: len(degree_2)], degree_2, 1), np.tensordot(c[len(degree_2) :], degree_3, 1)


HARMONICS = tuple(entry.name for entry in fields(Form))
"""Names of the parameters, in order: first degree 2, then degree 3."""


@dataclass(frozen=True)
class Level:
    """A function of space and its derivatives at some points.

    Attributes
    ----------
    value_m : array, shape (...)
        Value of the level function; 0 on the surface.
    gradient : array, shape (..., 3)
        Its derivatives by the point.
    hessian_per_m : array, shape (..., 3, 3)
        Its second derivatives.
    """

    value_m: Array
    gradient: Array
    hessian_per_m: Array


def level(points_m: Array, radius_m: float, form: Form) -> Level:
    """g of the module's docstring at points (..., 3) in the sphere's frame: 0 on the surface, above 0 outside."""
    rho = np.linalg.norm(points_m, axis=-1)
    n, I3 = points_m / rho[..., None], np.eye(3)
    added = deviation(points_m, form)
    value = rho - radius_m - added.value_m
    return Level(
        value, n - added.gradient, (I3 - n[..., :, None] * n[..., None, :]) / rho[..., None, None] - added.hessian_per_m
    )


def deviation(points_m: Array, form: Form) -> Level:
    """H2(P) / |P|^2 + H3(P) / |P|^3 at points (..., 3): the same along a ray from the centre."""
    Q, T = form.tensors
    rho = np.linalg.norm(points_m, axis=-1)
    n, I3 = points_m / rho[..., None], np.eye(3)
    # H2 = n Q n and H3 = T n n n; their derivatives are twice and three times one contraction less
    q, t2 = n @ Q, (n @ T.reshape(3, 9)).reshape(*n.shape, 3)  # the cubic form contracted with n once
    t1 = np.einsum("...ij,...j->...i", t2, n)
    parts = (
        (2, np.einsum("...i,...i", q, n), 2.0 * q, 2.0 * Q),
        (3, np.einsum("...i,...i", t1, n), 3.0 * t1, 6.0 * t2),
    )
    value, gradient, hessian = np.zeros_like(rho), np.zeros_like(n), np.zeros((*n.shape, 3))
    nn = n[..., :, None] * n[..., None, :]
    for degree, H, dH, ddH in parts:  # of |P|^-l H(P) at |P| = 1; rho comes in at the end
        mixed = dH[..., :, None] * n[..., None, :]
        scaled = degree * H[..., None, None]
        value += H
        gradient += dH - degree * H[..., None] * n
        hessian += ddH - degree * (mixed + np.swapaxes(mixed, -1, -2)) + scaled * ((degree + 2) * nn - I3)
    return Level(value, gradient / rho[..., None], hessian / (rho**2)[..., None, None])


def gradients_by_parameter(points_m: Array) -> tuple[Array, Array]:
    """h_k at points (..., 3) and their gradients, 1/m: shapes (12, ...) and (12, ..., 3)."""
    units = (deviation(points_m, Form(**{name: 1.0})) for name in HARMONICS)
    values, gradients = zip(*((unit.value_m, unit.gradient) for unit in units), strict=True)
    return np.array(values), np.array(gradients)


def curvatures(surface: Level) -> tuple[Array, Array]:
    """Principal curvatures, 1/m, smaller and larger, shape (...), positive where the surface is convex."""
    length = np.linalg.norm(surface.gradient, axis=-1)
    N = surface.gradient / length[..., None]
    across = np.eye(3) - N[..., :, None] * N[..., None, :]
    K = across @ surface.hessian_per_m @ across / length[..., None, None]
    # eigenvalues of a symmetric tensor of rank two: mean -+ sqrt(tr(K^2) / 2 - mean^2)
    mean = 0.5 * np.trace(K, axis1=-2, axis2=-1)
    spread = np.sqrt(np.maximum(0.5 * np.einsum("...ij,...ji", K, K) - mean**2, 0.0))
    return mean - spread, mean + spread


def directions(count: int) -> Array:
    """Unit vectors that cover the sphere evenly (a Fibonacci lattice), shape (count, 3)."""
    i = np.arange(count) + 0.5
    z, turn = 1.0 - 2.0 * i / count, np.pi * (1.0 + math.sqrt(5.0)) * i  # turns by the golden ratio
    s = np.sqrt(1.0 - z * z)
    return np.stack([s * np.cos(turn), s * np.sin(turn), z], axis=-1)


@cache
def _basis() -> tuple[Array, Array]:
    """Tensors of the harmonics of degree 2, shape (5, 3, 3), and 3, shape (7, 3, 3, 3)."""
    matrices: dict[int, list[Array]] = {2: [], 3: []}
    for name in HARMONICS:
        degree = len(next(iter(_POLYNOMIALS[name])))
        matrices[degree].append(sum((_symmetric(m, c) for m, c in _POLYNOMIALS[name].items()), np.zeros((3,) * degree)))
    return np.array(matrices[2]), np.array(matrices[3])


def _symmetric(monomial: str, coefficient: float) -> Array:
    """Symmetric tensor of one monomial."""
    # a monomial's coefficient is shared by all orders of its factors
    places = set(itertools.permutations("xyz".index(letter) for letter in monomial))
    result = np.zeros((3,) * len(monomial))
    for place in places:
        result[place] = coefficient / len(places)
    return result


def form_sum(old: Form | None, new: Form) -> Form:
    """Sum of two forms in the same frame."""
    return new if old is None else Form(*(a + b for a, b in zip(old.coefficients_m, new.coefficients_m, strict=True)))


# Outline of a sphere with a form.
#
# g(P) = 0 on the surface, and a point P of the outline as seen from the eye E has grad g . (P - E) = 0. In the
# half-plane of the eye, the centre and a direction across there is one such point: the mirror is convex and holds the
# centre.

_LIMB_STEPS = 8  # Newton's method starts within the form's slopes, some 1e-3 rad


_CLOSE_RAD = 1e-9  # the step after that would be its square


def limb_points(eye_m: Array, across: Array, radius_m: float, form: Form) -> Array:
    """Points of the contour, shape (N, 3), metres, sphere's frame.

    Parameters
    ----------
    eye_m : array, shape (3,)
        Camera centre, metres, sphere's frame.
    across : array, shape (N, 3)
        Unit vectors at right angles to the eye's direction.
    radius_m : float
        Radius of the perfect sphere.
    form : Form
        Deviation from it.
    """
    distance = float(np.linalg.norm(eye_m))
    axis = eye_m / distance
    angle = np.full(len(across), np.arccos(radius_m / distance))
    for _ in range(_LIMB_STEPS):
        n, n1 = _directions(axis, across, angle)
        P = _surface(n, radius_m, form)
        at = level(P, radius_m, form)
        rho = np.linalg.norm(P, axis=-1, keepdims=True)
        # d rho / d angle: n is radial, grad g = n - grad f
        rho1 = -rho * np.sum(at.gradient * n1, axis=-1, keepdims=True)
        # derivative of the surface point by the angle, for Newton's slope
        P1 = rho * n1 + rho1 * n
        facing = np.sum(at.gradient * (P - eye_m), axis=-1)
        slope = np.einsum("ni,nij,nj->n", P1, at.hessian_per_m, P - eye_m)
        step = facing / slope
        angle = angle - step
        if not np.any(np.abs(step) > _CLOSE_RAD):
            break
    return _surface(_directions(axis, across, angle)[0], radius_m, form)


def _directions(axis: Array, across: Array, angle: Array) -> tuple[Array, Array]:
    """Unit vectors at angles from the axis, and their derivatives by the angle."""
    c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
    return c * axis + s * across, c * across - s * axis


def _surface(n: Array, radius_m: float, form: Form) -> Array:
    """Surface points in directions n."""
    return (radius_m + deviation(n, form).value_m)[:, None] * n
