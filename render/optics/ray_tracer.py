"""Ray tracer from pixels in float64: lens, reflection at a sphere or mirror of revolution with form error, glass tube.

It shares no mathematics with the world-side solution (`reflection_point`), so that the two can certify each other. A
form error enters by the values of the mirror's radius or height alone: neither its tensors nor its derivatives are
used. The harmonics are written out as in `scenes/mirror.py`. The ray's place is found by the secant method on
q = |P|^2 - r(P / |P|)^2, which for a sphere is a parabola in the distance along the ray. The normal follows from
differences of surface points.

Rays are origins and unit directions, shape (N, 3), world frame, metres. `room_tracer` follows them into the room.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial

import numpy as np

from phibench.render.optics.faces import IntArray
from phibench.scenes.form_error import Form
from phibench.scenes.frames import Array
from phibench.scenes.glass_tube import GlassTube
from phibench.scenes.mirror import Mirror, SphereMirror
from phibench.scenes.revolved_mirror import RevolvedMirror
from phibench.scenes.revolved_profile import FormedProfile, Profile
from phibench.scenes.rig import View

Function = Callable[[Array], Array]
Added = Callable[[Array, Array, Array], Array]


# Rays from the camera, reflected once at the mirror.


@dataclass(frozen=True)
class MirrorRays:
    """Rays after the mirror, world frame; NaN where the mirror is missed.

    Attributes
    ----------
    points_m : array, shape (N, 3)
        Reflection points.
    normals : array, shape (N, 3)
        Outward unit normals there.
    directions : array, shape (N, 3)
        Unit directions of the reflected rays, away from the mirror.
    cos_incidence : array, shape (N,)
    path_camera_mirror_m : array, shape (N,)
    """

    points_m: Array
    normals: Array
    directions: Array
    cos_incidence: Array
    path_camera_mirror_m: Array


def lens_rays(view: View, uv_px: Array, lens_m: Array | None = None) -> tuple[Array, Array]:
    """Origins on the lens and unit directions, world frame, of the rays that belong to film positions.

    A film position (u, v) looks at one point of the plane of focus, through every point of the aperture.

    Parameters
    ----------
    uv_px : array, shape (N, 2)
    lens_m : array, shape (N, 2), or None
        Points on the aperture, metres from the lens centre, camera x and y; None is the lens centre.
    """
    camera, pose = view.rig.camera, view.T_world_camera
    x, y = camera.focus_distance_m * camera.normalised(uv_px).T
    if lens_m is None:
        origins = np.broadcast_to(pose.t, (len(x), 3))
    else:
        x, y = x - lens_m[:, 0], y - lens_m[:, 1]
        origins = lens_m @ pose.R[:, :2].T + pose.t
    z = camera.focus_distance_m
    directions = pose.R @ (np.stack([x, y, np.full_like(x, z)]) / np.sqrt(x * x + y * y + z * z))
    return origins, directions.T  # rows of x, y, z lie together: whole images take half the time


def reflect(view: View, origins_m: Array, directions: Array) -> MirrorRays:
    """Intersect world rays, shape (N, 3), with the mirror and reflect them."""
    return _tracer_of(view.rig.mirror)(view, origins_m, directions)


def _tracer_of(mirror: Mirror) -> Callable[[View, Array, Array], MirrorRays]:
    """Tracer of a mirror: the one test of its type on the camera's side."""
    if isinstance(mirror, RevolvedMirror):
        return partial(_reflect_at_profile, mirror.surface)
    if isinstance(mirror, SphereMirror):
        radius_m, form = mirror.radius_m, mirror.form
        return partial(_reflect_at_ball, radius_m) if form is None else partial(_reflect_at_form, radius_m, form)
    raise TypeError(f"no tracer of {type(mirror).__name__}: add it to render/optics/ray_tracer.py")


def _reflect_at_ball(radius: float, view: View, origins_m: Array, directions: Array) -> MirrorRays:
    centre, d = view.sphere_centre_m[:, None], directions.T
    offset = origins_m.T - centre
    # along the ray to its nearest point to the centre
    approach = -_inner(offset, d)
    miss = offset + approach * d  # nearest point to the centre: no cancellation
    with np.errstate(invalid="ignore"):
        root = np.sqrt(radius**2 - _inner(miss, miss))
        # c / (b + root) in place of b - root: no cancellation where the lens is far
        t = (_inner(offset, offset) - radius**2) / (approach + root)
        t = np.where(t > 0.0, t, np.nan)
    normals = (offset + t * d) / radius
    normals /= np.sqrt(_inner(normals, normals))
    cos_i = -_inner(normals, d)
    out = d + 2.0 * cos_i * normals
    return MirrorRays((centre + radius * normals).T, normals.T, out.T, cos_i, t)


def _inner(a: Array, b: Array) -> Array:
    """Inner products, shape (N,), of vectors as rows of x, y, z, shape (3, N)."""
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


def _reflect_at_form(radius_m: float, form: Form, view: View, origins_m: Array, directions: Array) -> MirrorRays:
    axes, centre = view.T_world_sphere.R, view.sphere_centre_m
    points, normals, t = meet((origins_m - centre) @ axes, directions @ axes, radius_m, form)
    return _reflected(view, points, normals, t, directions)


def _reflected(view: View, points: Array, normals: Array, t: Array, directions: Array) -> MirrorRays:
    """Rays from points and normals in the mirror's frame; what lies behind their start is no hit."""
    axes, centre = view.T_world_sphere.R, view.sphere_centre_m
    # NaN, where the ray misses, is behind as well
    behind = ~(t > 0.0)
    # one mask for vectors and numbers alike
    points, normals, t = (np.where(behind.reshape(-1, *[1] * (v.ndim - 1)), np.nan, v) for v in (points, normals, t))
    normals = normals @ axes.T
    cos_i = -_dot(normals, directions)
    return MirrorRays(points @ axes.T + centre, normals, directions + 2.0 * cos_i[:, None] * normals, cos_i, t)


def trace_pixels(view: View, uv_px: Array, lens_m: Array | None = None) -> MirrorRays:
    """Trace film positions, shape (N, 2), through the lens (its centre by default) to the mirror and away."""
    return reflect(view, *lens_rays(view, uv_px, lens_m))


def _dot(a: Array, b: Array) -> Array:
    return np.einsum("ni,ni->n", a, b)


# Mirror with a form error.


_NARROWING = (0.3, 0.03, 3e-3, 3e-4)  # radii: half width of the parabola that looks for the nearest place
_SECANTS = 12  # 4 to 6 do
_SETTLED = 1e-17  # metres: below a rounding of the distance
_STENCIL_RAD = 1e-3  # a five-point stencil errs by 3^5 / 30 of its fourth power: 1e-11 of the form, 1e-13 rad for 1 mm

_HARMONICS: dict[str, Callable[[Array, Array, Array], Array]] = {
    "form_20_m": lambda x, y, z: 1.5 * z * z - 0.5,
    "form_21c_m": lambda x, y, z: 2.0 * x * z,
    "form_21s_m": lambda x, y, z: 2.0 * y * z,
    "form_22c_m": lambda x, y, z: x * x - y * y,
    "form_22s_m": lambda x, y, z: 2.0 * x * y,
    "form_30_m": lambda x, y, z: (2.5 * z * z - 1.5) * z,
    "form_31c_m": lambda x, y, z: 0.1875 * math.sqrt(15.0) * x * (5.0 * z * z - 1.0),
    "form_31s_m": lambda x, y, z: 0.1875 * math.sqrt(15.0) * y * (5.0 * z * z - 1.0),
    "form_32c_m": lambda x, y, z: 1.5 * math.sqrt(3.0) * z * (x * x - y * y),
    "form_32s_m": lambda x, y, z: 3.0 * math.sqrt(3.0) * x * y * z,
    "form_33c_m": lambda x, y, z: x * (x * x - 3.0 * y * y),
    "form_33s_m": lambda x, y, z: y * (3.0 * x * x - y * y),
}


def meet(origins_m: Array, directions: Array, radius_m: float, form: Form) -> tuple[Array, Array, Array]:
    """First points of the mirror on rays from outside, in the sphere's frame.

    Parameters
    ----------
    origins_m, directions : arrays, shape (N, 3); directions of unit length

    Returns
    -------
    points_m, normals : arrays, shape (N, 3); NaN where the mirror is missed
    distance_m : array, shape (N,); NaN likewise
    """
    added = _added(form)
    approach = -np.einsum("ni,ni->n", origins_m, directions)
    foot = origins_m + approach[:, None] * directions  # nearest point to the centre
    foot2 = np.einsum("ni,ni->n", foot, foot)
    foot_xyz, way_xyz = np.ascontiguousarray(foot.T), np.ascontiguousarray(directions.T)

    def q(x: Array) -> Array:
        """Excess of the ray over the surface at a distance x from the foot, in squares of metres."""
        rho2 = foot2 + x * x
        with np.errstate(invalid="ignore"):
            return rho2 - (radius_m + added(*((foot_xyz + x * way_xyz) / np.sqrt(rho2)))) ** 2

    # certainly hits, and q is no parabola near the sphere's centre
    central = foot2 < 0.25 * radius_m**2
    lowest = np.where(central, 0.0, _lowest(q, radius_m, len(foot2)))
    with np.errstate(invalid="ignore"):
        x = _first_zero(q, lowest, np.sqrt(-np.where(central, foot2 - radius_m**2, q(lowest))))
    points = foot + x[:, None] * directions
    return points, _normals(points, radius_m, added), approach + x


def _added(form: Form) -> Added:
    """Deviation of the radius in unit directions x, y, z, each of shape (N,): rows that lie together are faster."""
    terms = [(peak, _HARMONICS[name]) for name, peak in asdict(form).items() if peak]

    def added(x: Array, y: Array, z: Array) -> Array:
        return np.asarray(sum(peak * harmonic(x, y, z) for peak, harmonic in terms))

    return added


def _lowest(q: Function, radius_m: float, count: int) -> Array:
    """Minimiser of a function that is nearly a parabola x^2 + c, shape (N,)."""
    lowest = np.zeros(count)
    with np.errstate(invalid="ignore", divide="ignore"):
        for width in _NARROWING:
            h = width * radius_m
            left, middle, right = (q(lowest + shift) for shift in (-h, 0.0, h))
            # vertex of the parabola through three places
            lowest = lowest - 0.5 * h * (right - left) / (right - 2.0 * middle + left)
    return lowest


def _first_zero(q: Function, lowest: Array, reach: Array) -> Array:
    """Zero of q about `reach` before its lowest place, shape (N,); NaN where `reach` is."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return _secants(q, lowest - reach, lowest - 0.999 * reach, _SECANTS, _SETTLED)


def _secants(f: Function, old: Array, new: Array, most: int, rest: float) -> Array:
    """Zeros by secants from two places each, shape (N,), until no step is above `rest`, `most` of them at most."""
    f_old, f_new = f(old), f(new)
    for _ in range(most):
        step = f_new * (new - old) / (f_new - f_old)
        step = np.where(np.isfinite(step) | np.isnan(new), step, 0.0)  # two equal values: nothing more to find
        old, f_old, new = new, f_new, new - step
        f_new = f(new)
        if not np.any(np.abs(step) > rest):
            break
    return new


def _normals(points_m: Array, radius_m: float, added: Added) -> Array:
    """Outward unit normals, shape (N, 3), at surface points: the cross product of two tangents."""
    n = points_m / np.linalg.norm(points_m, axis=-1, keepdims=True)
    # the axis that lies farthest from the normal: no small cross product
    helper = np.eye(3)[np.argmin(np.nan_to_num(np.abs(n)), axis=-1)]
    first = np.cross(n, helper)
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    second = np.cross(n, first)
    n_xyz = np.ascontiguousarray(n.T)
    radius = (radius_m + added(*n_xyz))[:, None]
    slopes = [_slope(added, n_xyz, np.ascontiguousarray(e.T)) for e in (first, second)]
    tangents = [radius * e + slope[:, None] * n for e, slope in zip((first, second), slopes, strict=True)]
    normals = np.cross(*tangents)
    return np.asarray(normals / np.linalg.norm(normals, axis=-1, keepdims=True))


def _slope(added: Added, n: Array, e: Array) -> Array:
    """Derivative of the radius, metres per radian, from n (3, N) towards e at right angles to it."""
    # five points: (8 (f1 - f-1) - (f2 - f-2)) / 12 h
    near, far = (_difference(added, n, e, angle) for angle in (_STENCIL_RAD, 2.0 * _STENCIL_RAD))
    return (8.0 * near - far) / (12.0 * _STENCIL_RAD)


def _difference(added: Added, n: Array, e: Array, angle: float) -> Array:
    c, s = math.cos(angle), math.sin(angle)
    return added(*(c * n + s * e)) - added(*(c * n - s * e))


# Mirror of revolution.


_REGULA_STEPS = 60  # 6 to 10 do
_REST_M = 1e-16  # less than a rounding of a lens's distance


def _reflect_at_profile(surface: Surface, view: View, origins_m: Array, directions: Array) -> MirrorRays:
    axes, centre = view.T_world_sphere.R, view.sphere_centre_m
    points, normals, t = meet_profile((origins_m - centre) @ axes, directions @ axes, surface)
    return _reflected(view, points, normals, t, directions)


def meet_profile(origins_m: Array, directions: Array, surface: Surface) -> tuple[Array, Array, Array]:
    """First points of a mirror of revolution on rays from outside, in its frame; as `meet`.

    A quadric gives a quadratic in the distance, counted from the ray's place that is nearest to the vertex. A
    polynomial is added to the quadric by the secant method, which needs the sag alone; the normal is that of the sag's
    slope. Only the sheet before the rim counts: it is met first, because the body behind it is convex. With a form
    error the secants begin at a quadric that certainly lies before the surface: along the ray the depth is a convex
    function, whose secants from there do not pass its first zero.
    """
    profile, height, before_m = surface.ideal, None, 0.0
    if surface.form is not None:
        height, before_m = _form_height(surface), _before_m(surface)
    approach = -_dot(origins_m, directions)
    foot, A, R = origins_m + approach[:, None] * directions, 1.0 + profile.conic, profile.vertex_radius_m
    start = foot + [0.0, 0.0, before_m]
    flat_f, flat_d = start[:, :2], directions[:, :2]
    # conic in the ray's parameter, a x^2 + 2 b x + c = 0: x^2 + y^2 - 2 R z + (1 + k) z^2 = 0
    a = _dot(flat_d, flat_d) + A * directions[:, 2] ** 2
    b = _dot(flat_f, flat_d) + (A * start[:, 2] - R) * directions[:, 2]
    c = _dot(flat_f, flat_f) + (A * start[:, 2] - 2.0 * R) * start[:, 2]
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        # both roots q / a and c / q without cancellation; a sign of 0 would lose them
        q = -(b + np.where(b < 0.0, -1.0, 1.0) * np.sqrt(b * b - a * c))
        x = _nearest_on_sheet(start, directions, np.stack([q / a, c / q]), -approach, profile)
        if height is not None:
            x = _secants_to_form(foot, directions, x, profile, height)
        elif not profile.is_quadric:
            x = _secant_to_sag(foot, directions, x, profile)
        points = foot + x[:, None] * directions
        s = points[:, 0] ** 2 + points[:, 1] ** 2
        slope = 2.0 * profile.sag(s).slope_per_m
        # outwards is down, towards the camera: z of the normal is -1
        normals = np.stack([slope * points[:, 0], slope * points[:, 1], np.full(len(points), -1.0)], axis=-1)
        if height is not None:
            normals[:, :2] -= _height_slopes(height, points, _STENCIL * profile.rim_radius_m)
            normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        else:
            normals /= np.sqrt(1.0 + slope**2 * s)[:, None]
        hit = (s <= profile.rim_radius_m**2) & (_dot(normals, directions) < 0.0)
    return (
        np.where(hit[:, None], points, np.nan),
        np.where(hit[:, None], normals, np.nan),
        np.where(hit, approach + x, np.nan),
    )


def _nearest_on_sheet(foot: Array, d: Array, roots: Array, start: Array, profile: Profile) -> Array:
    """First of two roots, shape (2, N), that lies after the start and on the sheet of the vertex; NaN without one."""
    z = foot[:, 2] + roots * d[:, 2]
    A, R = 1.0 + profile.conic, profile.vertex_radius_m
    on_sheet = (R - A * z >= 0.0) & (z >= -1e-12) & (roots > start)  # the half before the equator, or one sheet of two
    best = np.min(np.where(on_sheet, roots, np.inf), axis=0)
    return np.where(np.isfinite(best), best, np.nan)


def _secant_to_sag(foot: Array, d: Array, x: Array, profile: Profile) -> Array:
    """Places x where rays meet the sag, from those where they meet its quadric part."""

    def excess(x: Array) -> Array:
        P = foot + x[:, None] * d
        return np.asarray(profile.sag(P[:, 0] ** 2 + P[:, 1] ** 2).z_m - P[:, 2])

    return _secants(excess, x, x - 1e-4 * profile.rim_radius_m, _REGULA_STEPS, _REST_M)


# Form error of a mirror of revolution.

Surface = Profile | FormedProfile
Height = Callable[[Array, Array], Array]
_MET_M = 1e-12  # depth that is left where a ray meets the surface
_FORM_STEPS = 40  # 5 to 8 do; of a ray that grazes each leaves 0.6 of the way
_STENCIL = 1e-4  # of the rim's radius: five points err by 1e-16 of the form's fifth derivative
_ASIDE = 1.2  # of the rim's radius: where a ray is given up
_ON_DISC: dict[str, Callable[[Array, Array, Array], Array]] = {  # of x, y and their squares' sum, in radii
    "form_20_m": lambda x, y, t: (6.0 * t - 6.0) * t + 1.0,
    "form_21c_m": lambda x, y, t: (3.0 * t - 2.0) * x,
    "form_21s_m": lambda x, y, t: (3.0 * t - 2.0) * y,
    "form_22c_m": lambda x, y, t: x * x - y * y,
    "form_22s_m": lambda x, y, t: 2.0 * x * y,
    "form_30_m": lambda x, y, t: ((20.0 * t - 30.0) * t + 12.0) * t - 1.0,
    "form_31c_m": lambda x, y, t: ((10.0 * t - 12.0) * t + 3.0) * x,
    "form_31s_m": lambda x, y, t: ((10.0 * t - 12.0) * t + 3.0) * y,
    "form_32c_m": lambda x, y, t: (4.0 * t - 3.0) * (x * x - y * y),
    "form_32s_m": lambda x, y, t: (4.0 * t - 3.0) * 2.0 * x * y,
    "form_33c_m": lambda x, y, t: x * (x * x - 3.0 * y * y),
    "form_33s_m": lambda x, y, t: y * (3.0 * x * x - y * y),
}


def _form_height(surface: FormedProfile) -> Height:
    """Height of the surface over the ideal one, along the axis towards the camera, at places (x, y)."""
    terms = [(peak, _ON_DISC[name]) for name, peak in asdict(surface.form).items() if peak]

    def height(x: Array, y: Array) -> Array:
        s = x * x + y * y
        half_slope = surface.ideal.sag(s).slope_per_m
        place = x / surface.disc_m, y / surface.disc_m, s / surface.disc_m**2
        # a form error counts along the normal; along the axis it is longer by 1 / cos of the slope
        along_normal = sum(peak * wave(*place) for peak, wave in terms)
        return np.asarray(along_normal * np.sqrt(1.0 + 4.0 * s * half_slope * half_slope))

    return height


def _secants_to_form(foot: Array, d: Array, x: Array, profile: Profile, height: Height) -> Array:
    """Places x where rays meet a surface with a form error, from places before it; NaN where there is none.

    The depth along a ray is convex, and two places before its first zero have their secant's zero before it as well.
    """

    def depth(x: Array, rays: IntArray) -> Array:
        P = foot[rays] + x[:, None] * d[rays]
        s = P[:, 0] ** 2 + P[:, 1] ** 2
        z = np.asarray(profile.sag(s).z_m - height(P[:, 0], P[:, 1]) - P[:, 2])
        return np.where(s < (_ASIDE * profile.rim_radius_m) ** 2, z, np.nan)

    met = np.full(len(x), np.nan)
    rays = np.flatnonzero(np.isfinite(x))
    new, old = x[rays], x[rays] - 1e-4 * profile.rim_radius_m
    f_new, f_old = depth(new, rays), depth(old, rays)
    for _ in range(_FORM_STEPS):
        step = f_new * (new - old) / (f_new - f_old)
        step = np.where((f_new == f_old) & np.isfinite(f_new), 0.0, step)
        old, f_old, new = new, f_new, new - step
        f_new = depth(new, rays)
        done = (np.abs(step) <= _REST_M) & (np.abs(f_new) < _MET_M)
        met[rays[done]] = new[done]
        going = ~done & np.isfinite(f_new)
        rays = rays[going]
        old, f_old, new, f_new = (values[going] for values in (old, f_old, new, f_new))
        if not len(rays):
            break
    close = np.abs(f_new) < _MET_M
    met[rays[close]] = new[close]
    return met


def _before_m(surface: FormedProfile) -> float:
    """Shift of the quadric that brings it before the surface."""
    rim, terms = surface.rim_radius_m, surface.ideal.even_terms
    return surface.reach_m + sum(max(-a, 0.0) * rim ** (2 * i) for i, a in enumerate(terms, start=2))


def _height_slopes(height: Height, points: Array, step: float) -> Array:
    """Derivatives of a height by x and y, shape (N, 2)."""
    x, y = points[:, 0], points[:, 1]

    def slope(a: float, b: float) -> Array:
        near, far = (height(x + k * a, y + k * b) - height(x - k * a, y - k * b) for k in (1.0, 2.0))
        return np.asarray((8.0 * near - far) / (12.0 * step))

    return np.stack([slope(step, 0.0), slope(0.0, step)], axis=-1)


# Glass around the mirror.


_ECHOES = 60  # between the faces of a plate: R^120 is left, 1e-6 for R = 0.89


def through_glass(tube: GlassTube, points: Array, directions: Array) -> tuple[tuple[Array, ...], Array, Array]:
    """Rays from inside a tube through its wall, by Snell's law at one face after the other.

    Returns
    -------
    corners : three arrays, shape (N, 3)
        Where the rays began, and where they meet the two faces.
    directions : array, shape (N, 3)
        Behind the wall.
    passing : array, shape (N,)
        Part of unpolarised light that a bare wall passes.
    """
    corners, passing = [points], np.zeros(len(points))
    for radius, ratio in ((tube.inner_m, 1.0 / tube.index), (tube.outer_m, tube.index)):
        with np.errstate(divide="ignore", invalid="ignore"):
            points, outward = _to_cylinder(tube, points, directions, radius)
            cos = np.einsum("ni,ni->n", directions, outward)
            # Snell: the part along the face is scaled by n / n', the rest follows from length 1
            along = ratio * (directions - cos[:, None] * outward)
            directions = along + np.sqrt(1.0 - np.einsum("ni,ni->n", along, along))[:, None] * outward
            if radius == tube.inner_m:
                passing = _through_plate(cos, tube.index)
        corners.append(points)
    return tuple(corners), directions, passing


def _to_cylinder(tube: GlassTube, points: Array, directions: Array, radius: float) -> tuple[Array, Array]:
    """Points of a cylinder about the tube's axis that rays from inside meet, and its outward normals there."""
    flat = np.eye(3) - np.outer(tube.axis, tube.axis)
    offset, way = (points - tube.origin_m) @ flat, directions @ flat
    a, b = np.einsum("ni,ni->n", way, way), np.einsum("ni,ni->n", way, offset)
    c = np.einsum("ni,ni->n", offset, offset) - radius**2
    # the larger root: the ray comes from within the cylinder
    distance = ((np.sqrt(b * b - a * c) - b) / a)[:, None]
    return points + distance * directions, (offset + distance * way) / radius


def _through_plate(cos: Array, n: float) -> Array:
    """Part of unpolarised light that a plate passes: (1 - R)^2 (1 + R^2 + R^4 + ...) for each polarisation."""
    outside = np.clip(np.arccos(cos), 1e-9, None)
    inside = np.arcsin(np.sin(outside) / n)
    apart, together = outside - inside, outside + inside
    faces = (np.sin(apart) / np.sin(together)) ** 2, (np.tan(apart) / np.tan(together)) ** 2
    return np.asarray(0.5 * sum((1.0 - R) ** 2 * sum(R ** (2 * k) for k in range(_ECHOES)) for R in faces))
