"""Derivatives of the estimated depth D, the true D and the spot's pixel by each misalignment of the true rig.

An estimate depends on the true rig through the pixels alone: dD/dp = dD/d(u1, v1, u2, v2) . d(u1, v1, u2, v2)/dp. The
first factor is the estimator's own gradient at the nominal rig. The second follows from the reflected ray through the
spot by implicit differentiation, at the true rig. p are the parameters of `Misalignment`, of a further misalignment of
the true rig: `true_rig.perturbed(...)`. The plane of focus, roughness and rim move no chief ray and are left out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial

import numpy as np

from phibench.estimator.geometry.mirror_geometry import geometry_of
from phibench.estimator.geometry.paper_depth import paper_gradient
from phibench.estimator.geometry.phi import CONVENTIONS, GRADIENTS
from phibench.estimator.geometry.reflection import image_of, ray_basis, ray_slope, reflect
from phibench.estimator.geometry.triangulate import ESTIMATORS, exact_gradient
from phibench.scenes.camera import Camera
from phibench.scenes.form_error import Level
from phibench.scenes.frames import Array
from phibench.scenes.misalignment import PARAMETERS as MISALIGNMENT
from phibench.scenes.rig import POSITIONS, Rig, Stroke, View

_MOVES_NO_RAY = ("focus_distance_m", "roughness_alpha", "rim_radius_m")
PARAMETERS = tuple(name for name in MISALIGNMENT if name not in _MOVES_NO_RAY)
"""Order of all gradients by p."""
_CAMERA = ("focal_relative", "cx_px", "cy_px", "k1", "k2", "k3", "p1", "p2")
_AXES = np.eye(3)

PixelGradient = Callable[[Rig, float, Array, Array], Array]


@dataclass(frozen=True)
class Sensitivity:
    """One estimator on one pair.

    Attributes
    ----------
    estimate_m : float
        D as estimated with the nominal rig; NaN where there is no estimate.
    estimate_gradient : array, shape (p,)
        Its derivatives by `PARAMETERS`, metres per unit.
    truth_gradient : array, shape (p,)
        Derivatives of the true D, which counts from the true sphere.
    """

    estimate_m: float
    estimate_gradient: Array
    truth_gradient: Array

    @property
    def error_gradient(self) -> Array:
        """Derivatives of estimate minus truth."""
        return self.estimate_gradient - self.truth_gradient


def sensitivity(
    estimator: str, nominal_rig: Rig, nominal_stroke_m: float, true_rig: Rig, true_stroke_m: float, point_world_m: Array
) -> Sensitivity:
    """Sensitivities of one of `triangulate.ESTIMATORS` to every parameter, for a spot at a world point, shape (3,).

    Everything is NaN where the spot is not seen or the estimator has no answer.
    """
    given = nominal_rig, nominal_stroke_m, true_rig, true_stroke_m, point_world_m
    return sensitivities((estimator,), *given)[estimator]


def sensitivities(
    estimators: Iterable[str],
    nominal_rig: Rig,
    nominal_stroke_m: float,
    true_rig: Rig,
    true_stroke_m: float,
    point_world_m: Array,
) -> dict[str, Sensitivity]:
    """The same of several estimators by name: how the pixels move is the same for all."""
    views = [true_rig.at(Stroke(true_stroke_m).offset_m(position)) for position in POSITIONS]
    pixels = [image_of(view, point_world_m).uv_px for view in views]
    moved = [pixel_gradient(view, uv, point_world_m) for view, uv in zip(views, pixels, strict=True)]
    truth = truth_gradient(true_rig, point_world_m)
    found = {}
    for name in estimators:
        # chain rule: dD/d(pixels) of the nominal rig times d(pixels)/dp of the true one
        by_pixel = PIXEL_GRADIENTS[name](nominal_rig, nominal_stroke_m, *pixels)
        gradient = by_pixel[:2] @ moved[0] + by_pixel[2:] @ moved[1]
        estimate = ESTIMATORS[name](nominal_rig, nominal_stroke_m, *pixels)
        found[name] = Sensitivity(float(estimate.depth_m), gradient, truth)
    return found


def truth_gradient(true_rig: Rig, point_world_m: Array) -> Array:
    """Derivatives of the true D by `PARAMETERS`, shape (p,): a decentre moves the line from which D counts."""
    away = np.asarray(point_world_m, float)[:2] - true_rig.at(0.0).sphere_centre_m[:2]
    with np.errstate(invalid="ignore"):  # D = 0 has no direction: NaN
        away /= np.hypot(*away)
    result = np.zeros(len(PARAMETERS))
    # the line from which D counts moves with the mirror: D falls by the part along its direction
    result[[PARAMETERS.index("decentre_x_m"), PARAMETERS.index("decentre_y_m")]] = -away
    return result


def pixel_gradient(view: View, uv_px: Array, point_world_m: Array) -> Array:
    """d(u, v)/dp, shape (2, p), pixels per unit, of a world point, shape (3,), that is seen at a pixel, shape (2,).

    The reflected ray P + t r goes through the point whatever p is: across the ray, dP + t dr = 0. How a glass tube
    around the mirror changes dP and dr is left out.
    """
    with np.errstate(all="ignore"):
        dP, dr = _ray_changes(view, uv_px)
        ray = reflect(view, uv_px)
        along = np.sum((point_world_m - ray.origin_world_m) * ray.direction_world)
        # the ray passes beside the point: its miss across, at the distance of the point
        across = ray_basis(ray.direction_world) @ (dP + along * dr).T
        slope = ray_slope(view, uv_px, point_world_m)
    if not (np.isfinite(slope).all() and np.isfinite(across).all()):
        return np.full((2, len(PARAMETERS)), np.nan)
    # the pixel moves so that the miss is 0 again (implicit function)
    return np.asarray(-np.linalg.solve(slope, across), float)


def _ray_changes(view: View, uv_px: Array) -> tuple[Array, Array]:
    """d(mirror point)/dp and d(ray that leaves)/dp at a fixed pixel, shape (p, 3), world.

    d camera ray, q sphere centre from the lens, t distance lens to mirror point, P = t d - q: the mirror's level
    function g(P) = 0 gives dt; then its gradient gives the normal n, and r = d + 2 cos(i) n, cos(i) = -d . n.
    """
    lens, sphere, turn, mirror_turn = _rigid_changes(view)
    ray = reflect(view, uv_px)
    P, n = ray.origin_world_m - view.sphere_centre_m, ray.normal_world
    d = view.T_world_camera.directions(view.rig.camera.rays(uv_px))
    t, cos_i = np.linalg.norm(ray.origin_world_m - view.camera_centre_m), -d @ n
    d1 = np.cross(turn, d) + _camera_ray_changes(view, uv_px)
    q1 = sphere - lens
    surface, g1, gradient1 = _surface_changes(view, P)
    length = np.linalg.norm(surface.gradient)
    carried = np.cross(mirror_turn, P)  # with the mirror
    t1 = -(g1 / length + (t * d1 - q1 - carried) @ n) / (d @ n)
    P1 = t1[:, None] * d + t * d1 - q1  # relative to the sphere centre
    across = np.eye(3) - np.outer(n, n)
    # the normal turns with the mirror, and by its change along the surface
    n1 = np.cross(mirror_turn, n) + ((P1 - carried) @ surface.hessian_per_m + gradient1) @ across / length
    cos1 = -(d1 @ n + n1 @ d)
    return sphere + P1, d1 + 2.0 * (cos1[:, None] * n + cos_i * n1)


def _surface_changes(view: View, P: Array) -> tuple[Level, Array, Array]:
    """Level function g of the mirror, world axes about its centre, at P, shape (3,), and dg/dp, d(grad g)/dp at P."""
    axes, geometry = view.form_axes, geometry_of(view.rig.mirror)
    at, changes = geometry.changing_level(P @ axes, axes)
    g1, gradient1 = np.zeros(len(PARAMETERS)), np.zeros((len(PARAMETERS), 3))
    for name, (value, gradient) in changes.items():
        g1[PARAMETERS.index(name)], gradient1[PARAMETERS.index(name)] = value, gradient
    return Level(at.value_m, axes @ at.gradient, axes @ at.hessian_per_m @ axes.T), g1, gradient1


def _rigid_changes(view: View) -> tuple[Array, Array, Array, Array]:
    """d(lens centre), d(sphere centre), d(camera's turn), d(mirror's turn), shape (p, 3), world, by p."""
    lens, sphere, turn = (dict.fromkeys(PARAMETERS, np.zeros(3)) for _ in range(3))
    # misalignments are fixed to the rig: a motion between the images turns their axes
    moved = np.eye(3) if view.motion is None else np.array(view.motion.rotation)
    for name, axis in zip(("decentre_x_m", "decentre_y_m", "axial_m"), moved.T, strict=True):
        sphere[name] = axis
    for name, axis in zip(("tilt_x_rad", "tilt_y_rad"), moved.T[:2], strict=True):
        turn[name] = axis
    if view.offset_m != 0.0:
        for name, shift in _stroke_changes(view).items():
            lens[name] = sphere[name] = shift
        to_sphere = view.sphere_centre_m - view.camera_centre_m
        for name, axis in zip(("roll_rad", "pitch_rad", "yaw_rad"), _AXES, strict=True):
            turn[name], sphere[name] = axis, np.cross(axis, to_sphere)
    # a tilt of the camera leaves the mirror as it is, and the mirror's own leaves the camera
    mirror_turn = {name: np.zeros(3) if name.startswith("tilt") else axis for name, axis in turn.items()}
    for name, axis in zip(("mirror_tilt_x_rad", "mirror_tilt_y_rad"), moved.T[:2], strict=True):
        mirror_turn[name] = axis
    a, b, c, d = (np.array([*changes.values()]) for changes in (lens, sphere, turn, mirror_turn))
    return a, b, c, d


def _stroke_changes(view: View) -> dict[str, Array]:
    """d(lens centre) by what moves the whole rig when it is up."""
    axis, h = np.array(view.rig.stroke_axis_world), view.offset_m
    return {
        "stroke_relative": h * axis,
        "stroke_offset_m": axis,
        # small turn of the axis: the lens moves by h (turn x axis)
        "stroke_tilt_x_rad": h * np.cross(_AXES[0], axis),
        "stroke_tilt_y_rad": h * np.cross(_AXES[1], axis),
        **{f"shift_{name}_m": direction for name, direction in zip("xyz", _AXES, strict=True)},
    }


def _camera_ray_changes(view: View, uv_px: Array) -> Array:
    """d(camera ray), shape (p, 3), world, by the camera's numbers."""
    result = np.zeros((len(PARAMETERS), 3))
    xy = view.rig.camera.normalised(uv_px)
    length = np.sqrt(1.0 + xy @ xy)
    d = np.array([*xy, 1.0]) / length
    q1 = np.concatenate([_normalised_changes(view.rig.camera, uv_px, xy), np.zeros((1, len(_CAMERA)))]).T
    rows = [PARAMETERS.index(name) for name in _CAMERA]
    result[rows] = view.T_world_camera.directions((q1 - (q1 @ d)[:, None] * d) / length)
    return result


def _normalised_changes(camera: Camera, uv_px: Array, xy: Array) -> Array:
    """d(x, y), undistorted, at a fixed pixel by `_CAMERA`, shape (2, 8): distort(x, y) = ((u - cx)/fx, (v - cy)/fy)."""
    x, y = xy
    r2 = x * x + y * y
    f = np.array([camera.fx_px, camera.fy_px])
    distorted = (uv_px - np.array([camera.cx_px, camera.cy_px])) / f
    # derivatives of the distorted point by k1, k2, k3, p1, p2 at fixed (x, y)
    brown = [xy * r2, xy * r2**2, xy * r2**3, (2.0 * x * y, r2 + 2.0 * y * y), (r2 + 2.0 * x * x, 2.0 * x * y)]
    right = np.stack([-distorted, (-1.0 / f[0], 0.0), (0.0, -1.0 / f[1]), *(-np.asarray(b) for b in brown)], axis=-1)
    return np.linalg.solve(camera.distort_jacobian(xy), right)


def _paper_pixel_gradient(convention: str, of_radius: bool, rig: Rig, h: float, down_px: Array, up_px: Array) -> Array:
    """dD/d(u1, v1, u2, v2), shape (4,), of eq. (4), or of eq. (5), which leaves out the radius."""
    views, pixels = (rig.at(0.0), rig.at(h)), (down_px, up_px)
    phi1, phi2 = (CONVENTIONS[convention](view, uv) for view, uv in zip(views, pixels, strict=True))
    with np.errstate(all="ignore"):
        slopes = [GRADIENTS[convention](view, uv) for view, uv in zip(views, pixels, strict=True)]
    by_phi = geometry_of(rig.mirror).paper_gradient(phi1, phi2, h) if of_radius else paper_gradient(phi1, phi2, h, 0.0)
    return np.concatenate([by_phi[i] * slopes[i] for i in range(2)])


PIXEL_GRADIENTS: dict[str, PixelGradient] = {
    **{f"paper_{name}": partial(_paper_pixel_gradient, name, True) for name in CONVENTIONS},
    "approx_ray": partial(_paper_pixel_gradient, "ray", False),
    "exact": exact_gradient,
}
"""dD/d(u1, v1, u2, v2), shape (4,), metres per pixel, of every estimator of `triangulate.ESTIMATORS`."""
