"""Rays that meet a mirror with a form error, inside a Dr.Jit kernel, in float64.

Newton's method on q(t) = |P|^2 - r(P / |P|)^2 along the ray, first to its least value, which tells hit from miss, then
from the parabola's zero to that of q. `form_trace` answers the same question from values alone, `fermat` from the other
side; tests hold the three against each other.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any

from phibench.render.c310_plugin import MM_PER_M
from phibench.scenes.frames import Array
from phibench.scenes.rig import View

_LEAST_STEPS = 3
_STEPS = 5


def meet(mi: ModuleType, view: View, ray: Any) -> tuple[Any, Any, Any]:
    """First point of the mirror, its outward normal, and whether there is one, in scene coordinates (mm, float32).

    `ray` comes from outside, in the scene's coordinates: world axes, the sphere centre at the origin.
    """
    import drjit as dr

    V, axes = mi.Vector3d, view.T_world_sphere.R
    form = view.rig.mirror.form
    assert form is not None
    tensors = [MM_PER_M * tensor for tensor in form.tensors]
    radius = MM_PER_M * view.rig.mirror.radius_m
    o, d = (_turned(V, axes.T, V(vector)) for vector in (ray.o, ray.d))
    d = dr.normalize(d)
    foot = o - dr.dot(o, d) * d
    foot2 = dr.dot(foot, foot)
    central = foot2 < 0.25 * radius * radius  # certainly hits, and q is no parabola near the sphere's centre
    x = mi.Float64(0.0)
    for _ in range(_LEAST_STEPS):  # q'' is 2 but for the form
        _, slope = _q(V, foot, foot2, d, x, radius, tensors)
        x = dr.select(central, 0.0, x - 0.5 * slope)
    q, _ = _q(V, foot, foot2, d, x, radius, tensors)
    q = dr.select(central, foot2 - radius * radius, q)
    found = q < 0.0
    x = x - dr.sqrt(dr.maximum(-q, 0.0))
    for _ in range(_STEPS):
        q, slope = _q(V, foot, foot2, d, x, radius, tensors)
        x = dr.select(found, x - q / slope, x)
    P = foot + x * d
    rho = dr.norm(P)
    n = P / rho
    _, gradient = _added(V, n, tensors)
    normal = dr.normalize(n - gradient / rho)
    return mi.Point3f(_turned(V, axes, P)), mi.Vector3f(_turned(V, axes, normal)), found


def _q(V: Any, foot: Any, foot2: Any, d: Any, x: Any, radius: float, tensors: list[Array]) -> tuple[Any, Any]:
    """q and its derivative by the distance x from the foot."""
    import drjit as dr

    rho2 = foot2 + x * x
    rho = dr.sqrt(rho2)
    added, gradient = _added(V, (foot + x * d) / rho, tensors)
    r = radius + added
    return rho2 - r * r, 2.0 * x - 2.0 * r * dr.dot(gradient, d) / rho


def _added(V: Any, n: Any, tensors: list[Array]) -> tuple[Any, Any]:
    """Deviation of the radius in a unit direction, and its derivative along the unit sphere."""
    import drjit as dr

    Q, T = tensors
    q = _turned(V, Q, n)
    t = V(*(dr.dot(n, _turned(V, T[i], n)) for i in range(3)))
    along_q, along_t = dr.dot(q, n), dr.dot(t, n)
    return along_q + along_t, 2.0 * q + 3.0 * t - (2.0 * along_q + 3.0 * along_t) * n


def _turned(V: Any, matrix: Array, vector: Any) -> Any:
    """Matrix times vector."""
    rows = [[float(value) for value in row] for row in matrix]
    return V(*(row[0] * vector.x + row[1] * vector.y + row[2] * vector.z for row in rows))
