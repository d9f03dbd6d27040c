"""Angles phi of pixels with derivative and variance, in four senses: ray, normal, incidence, radius over the outline.

* ``ray``: theta / 2, theta between the ray that leaves the mirror and the downward vertical (eqs. 1 and 2 are exact);
* ``normal``: between the outward normal at the reflection point and the downward vertical;
* ``incidence``: angle of incidence at the mirror;
* ``outline``: asin(r / r_outline), r the distance in the image from the image of the sphere centre.

All agree for a camera at infinity. Angles in radians, shape (...) for pixels (..., 2); NaN where there is no angle.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from phibench.estimator.geometry.mirror_geometry import geometry_of
from phibench.estimator.geometry.reflection import ON_AXIS_SINE, reflect, reflect_jacobian
from phibench.estimator.geometry.status import Status, StatusArray, flag, keep
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig, View
from phibench.scenes.validation import SceneError, nearest

Convention = Callable[[View, Array], Array]


@dataclass(frozen=True)
class PhiEstimate:
    """Angles phi, shape (...), their variances and why a value is missing.

    Parameters
    ----------
    phi_rad : shape (...)
    variance_rad2 : shape (...), NaN if no pixel covariance was given
    status : shape (...), values of `Status`
    """

    phi_rad: Array
    variance_rad2: Array
    status: StatusArray


def phi(rig: Rig | View, uv_px: ArrayLike, convention: str = "ray") -> Array:
    """Angle phi of pixels, radians: `phibench.phi`.

    Parameters
    ----------
    rig : Rig or View
        A rig stands for its down position; `rig.at(stroke_m)` and `sample.view("up")` are views.
    uv_px : shape (..., 2), pixels
    convention : "ray", "normal", "incidence" or "outline"

    Returns
    -------
    array, shape (...)
        NaN where the pixel's ray misses the mirror.

    Raises
    ------
    SceneError
        If the pixels are no pairs of numbers, or there is no such convention.
    """
    if convention not in CONVENTIONS:
        raise SceneError(f"no convention '{convention}' of phi; {nearest(convention, CONVENTIONS)}")
    try:
        uv = np.asarray(uv_px, float)
    except (TypeError, ValueError):
        uv = np.empty(0)
    if uv.ndim == 0 or uv.shape[-1] != 2:
        raise SceneError("uv_px: must be numbers of shape (..., 2), the pixel's u and v; give (640.0, 120.0)")
    return np.asarray(CONVENTIONS[convention](rig.at(0.0) if isinstance(rig, Rig) else rig, uv))


def phi_ray(view: View, uv_px: Array) -> Array:
    """Half the angle between the ray that leaves the mirror and the downward vertical."""
    # a ray that came straight up leaves at twice the angle of the normal: half of it is the phi of the paper
    return _from_downward(reflect(view, uv_px).direction_world) / 2.0


def phi_normal(view: View, uv_px: Array) -> Array:
    """Angle between the outward normal and the downward vertical."""
    return _from_downward(reflect(view, uv_px).normal_world)


def phi_incidence(view: View, uv_px: Array) -> Array:
    """Angle of incidence."""
    return reflect(view, uv_px).incidence_rad


def phi_outline(view: View, uv_px: Array) -> Array:
    """asin(r / r_outline): an image distance taken for an orthographic one.

    On a mirror of revolution the angle of the normal at so large a part of the rim's radius.
    """
    uv = np.asarray(uv_px, float)
    centre, radius_px = outline_circle(view.rig)
    # rounding puts pixels of the outline beyond it: arcsin takes 1 at most
    ratio = np.minimum(np.linalg.norm(uv - centre, axis=-1) / radius_px, 1.0)
    return keep(geometry_of(view.rig.mirror).normal_angle(ratio), _outline_status(view, uv))


def outline_circle(rig: Rig) -> tuple[Array, float]:
    """Image of the sphere centre, shape (2,), and mean distance of the outline from it, pixels."""
    centre = rig.camera.project(rig.sphere_in_camera_m)
    return centre, float(np.mean(np.linalg.norm(rig.outline_px() - centre, axis=-1)))


def _ray_gradient(view: View, uv_px: Array) -> Array:
    jacobian = reflect_jacobian(view, uv_px)
    return _downward_gradient(reflect(view, uv_px).direction_world, jacobian.direction_per_px) / 2.0


def _normal_gradient(view: View, uv_px: Array) -> Array:
    return _downward_gradient(reflect(view, uv_px).normal_world, reflect_jacobian(view, uv_px).normal_per_px)


def _incidence_gradient(view: View, uv_px: Array) -> Array:
    return reflect_jacobian(view, uv_px).incidence_rad_per_px


def _outline_gradient(view: View, uv_px: Array) -> Array:
    centre, radius_px = outline_circle(view.rig)
    return geometry_of(view.rig.mirror).normal_angle_gradient(np.asarray(uv_px, float) - centre, radius_px)


CONVENTIONS: dict[str, Convention] = {
    "ray": phi_ray,
    "normal": phi_normal,
    "incidence": phi_incidence,
    "outline": phi_outline,
}
GRADIENTS: dict[str, Convention] = {
    "ray": _ray_gradient,
    "normal": _normal_gradient,
    "incidence": _incidence_gradient,
    "outline": _outline_gradient,
}


def estimate_phi(convention: str, view: View, uv_px: Array, covariance_px2: Array | None = None) -> PhiEstimate:
    """Return phi in one convention with its variance and status.

    Parameters
    ----------
    convention : key of `CONVENTIONS`
    uv_px : shape (..., 2), pixels
    covariance_px2 : shape (..., 2, 2), covariance of (u, v), optional

    Returns
    -------
    PhiEstimate
        variance = g C g^T with g = dphi/d(u, v), differentiated analytically.
    """
    angle = CONVENTIONS[convention](view, uv_px)
    status = _outline_status(view, uv_px) if convention == "outline" else reflect(view, uv_px).status
    if covariance_px2 is None:
        return PhiEstimate(angle, np.full(angle.shape, np.nan), status)
    with np.errstate(all="ignore"):
        g = GRADIENTS[convention](view, uv_px)
        variance = np.einsum("...i,...ij,...j->...", g, covariance_px2, g)
    return PhiEstimate(angle, keep(variance, status), status)


def _outline_status(view: View, uv_px: Array) -> StatusArray:
    centre, radius_px = outline_circle(view.rig)
    ratio = np.linalg.norm(np.asarray(uv_px, float) - centre, axis=-1) / radius_px
    return flag(
        (~np.isfinite(ratio), Status.NOT_FINITE),
        (ratio > 1.0, Status.MISSES_MIRROR),
        # the outline itself: the ray grazes, and phi has no derivative
        (ratio == 1.0, Status.GRAZING),
        (ratio < ON_AXIS_SINE, Status.ON_AXIS),
    )


def _from_downward(directions: Array) -> Array:
    """Angle of directions (..., 3) from (0, 0, -1); arctan2 because arccos loses digits near the axis."""
    return np.arctan2(np.hypot(directions[..., 0], directions[..., 1]), -directions[..., 2])


def _downward_gradient(unit: Array, jacobian: Array) -> Array:
    """Gradient (..., 2) of the angle from (0, 0, -1), from a unit vector (..., 3) and its Jacobian (..., 3, 2)."""
    return jacobian[..., 2, :] / np.hypot(unit[..., 0], unit[..., 1])[..., None]  # cos theta = -z
