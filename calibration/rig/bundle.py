"""Bundle adjustment of a rig to priors, outline, vertical and spots; and outline and vertical that a true rig shows.

The unknowns are the parameters of `rig_parameters.PARAMETERS`, as deviations from the nominal rig, and the world point
of every calibration spot. The data:

* the prior of every parameter: the accuracy of the nominal numbers;
* the sphere centre from an outline, 3 numbers. It was found with the nominal camera and radius. A camera or radius off
  by some per cent moves it, and the fit accounts for that (`apparent_outline`). Of a mirror of revolution the outline
  gives the vertex, found with the nominal profile and tilt, and the two numbers of the rim's ellipse (`contour`);
* the vertical from upright edges, 2 numbers, with the effect of the principal point (`apparent_vertical`);
* for every spot, 4 pixel coordinates, its distance D, and its azimuth and height where they were measured.

A spot has 4 pixel coordinates for 3 unknowns. With exact D, and without azimuth and height, it leaves two conditions on
the rig: D itself and the meeting of the rays.

The rim's ellipse is quadratic in the mirror's tilt. A fit without it is nearly linear, and its result is a normal
distribution; the ellipse turns that into one with two hills, or a ring. What is returned are mean and covariance of
this distribution (`_with_ellipse`): no hill is chosen where the data choose none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from phibench.calibration.outline.contour import place_of_outline, tilts_of_ellipse
from phibench.calibration.outline.first_circle import sphere_from_rays
from phibench.calibration.outline.outline_result import PoseMeasurement
from phibench.calibration.rig.vertical_edges import vertical_of
from phibench.datasets.common.errors import DatasetError
from phibench.estimator.geometry.reflection import image_of, reflect_both
from phibench.estimator.geometry.rig_parameters import PARAMETERS, changed_rig, has_effect, prior_sigmas, stroke_of
from phibench.estimator.geometry.triangulate import depth_exact
from phibench.scenes.frames import Array, as_vector, cross
from phibench.scenes.misalignment import Misalignment
from phibench.scenes.rig import Rig, View
from phibench.scenes.validation import SceneError

_FORWARD = np.finfo(float).eps ** 0.5  # of an unknown, or of 1 where it is less: the step of a difference
_NEWTON = 3  # steps from pixels nearby: each squares what is left
_TURNS = ("mirror_tilt_x_rad", "mirror_tilt_y_rad")
_TURN_RAD = 0.01  # for differences of a tilt
_PART = 0.1  # of a prior sigma, for differences
_REACH = 8.0  # sigmas on both sides of a fit without the ellipse
_NODES = (121, 801)  # of the sum over tilts: more where the misfit is steep
_HELD_RAD = 1e-9  # of a tilt that is exact: the covariance of both keeps its inverse
_WEAK = 0.9  # of the prior's variance: a direction that keeps so much was not measured


@dataclass(frozen=True)
class KnownSpot:
    """A laser spot at a known distance, seen in both images.

    Parameters
    ----------
    uv_down_px, uv_up_px : shape (2,)
    covariance_down_px2, covariance_up_px2 : shape (2, 2)
    stroke_m : float
    depth_m, depth_sigma_m : float
        D from the vertical through the sphere centre at the down position.
    height_m, height_sigma_m : float
        Above the floor of the world; an infinite sigma where it was not measured.
    azimuth_rad, azimuth_sigma_rad : float
        From the world's x axis, about the sphere centre; an infinite sigma where it was not measured.
    """

    uv_down_px: Array
    uv_up_px: Array
    covariance_down_px2: Array
    covariance_up_px2: Array
    stroke_m: float
    depth_m: float
    depth_sigma_m: float = 1e-3
    height_m: float = 0.0
    height_sigma_m: float = np.inf
    azimuth_rad: float = 0.0
    azimuth_sigma_rad: float = np.inf


@dataclass(frozen=True)
class WeakDirection:
    """A combination of parameters that the data do not tell apart.

    Attributes
    ----------
    parts : dict of str to float
        Share of each parameter, in units of its own prior sigma; those above 0.2.
    remaining : float
        Part of the prior's standard deviation that is left.
    """

    parts: dict[str, float]
    remaining: float


@dataclass(frozen=True)
class Bundle:
    """Result of the fit.

    Attributes
    ----------
    rig : Rig
        The nominal rig with its parameters corrected. Stroke scale and offset are in `values`.
    values, covariance : shape (p,), (p, p)
        Deviations from the nominal rig, in the order of `PARAMETERS`.
    chi2, degrees : float, int
    undetermined : directions with more than `_WEAK` of the prior's variance left, the weakest first
    """

    rig: Rig
    values: Array
    covariance: Array = field(repr=False)
    chi2: float
    degrees: int
    undetermined: tuple[WeakDirection, ...] = ()

    @property
    def sigmas(self) -> dict[str, float]:
        """Standard deviations by name."""
        return dict(zip(PARAMETERS, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    def stroke(self, nominal_m: Array) -> Array:
        """Strokes with scale and offset applied, metres."""
        return stroke_of(nominal_m, self.values)


def calibrate(
    nominal: Rig,
    outline: PoseMeasurement | None = None,
    spots: Sequence[KnownSpot] = (),
    vertical: PoseMeasurement | None = None,
    sigmas: Array | None = None,
) -> Bundle:
    """Fit a rig.

    Parameters
    ----------
    nominal : Rig
    outline : PoseMeasurement, optional
        Sphere centre in the camera frame, or vertex and ellipse, found with the nominal camera and mirror:
        `Outline.measured`.
    spots : sequence of KnownSpot
    vertical : PoseMeasurement, optional
        The world's vertical in the camera frame, x and y of the unit vector, shape (2,), found with the nominal camera
        and the sphere where the outline is (`find_vertical`): a wrong principal point turns it.
    sigmas : shape (p,), optional
        Standard deviations of the nominal numbers; 0 holds one. `prior_sigmas()` by default. Those of parameters that
        mean nothing for this mirror do not count.

    Raises
    ------
    DatasetError
        If a spot is not seen in the nominal rig, or the fit does not come to rest.
    """
    # what has no effect on this rig keeps its nominal value: a prior sigma of 0
    prior = np.where(has_effect(nominal), prior_sigmas() if sigmas is None else np.asarray(sigmas, float), 0.0)
    free = np.flatnonzero(prior > 0.0)
    turned = np.zeros((2, 2)) if vertical is None else vertical_by_principal_point(nominal)
    problem = _Problem(nominal, outline, tuple(spots), vertical, prior, free, turned)
    start = np.concatenate([np.zeros(free.size), *(_start(nominal, spot) for spot in spots)])
    try:
        solution = optimize.least_squares(
            problem.residuals, start, problem.jacobian, x_scale="jac", xtol=1e-12, ftol=1e-12
        )
    except SceneError as error:  # a step led to a rig that cannot be
        raise DatasetError(f"the calibration does not come to rest: {error}") from error
    if not solution.success or not np.isfinite(solution.cost):
        raise DatasetError(f"the calibration does not come to rest: {solution.message}")
    normal = solution.jac.T @ solution.jac  # residuals are over their sigmas: the inverse is the covariance
    fit = _Fit(solution.x[: free.size], np.linalg.inv(normal)[: free.size, : free.size], 2.0 * float(solution.cost))
    degrees = solution.fun.size - solution.x.size
    if problem.has_ellipse:
        fit, degrees = _with_ellipse(problem, fit, solution.jac[free.size : free.size + 3, : free.size]), degrees + 2
    values, covariance = problem.values(fit.x), np.zeros((len(PARAMETERS),) * 2)
    covariance[np.ix_(free, free)] = fit.covariance * np.outer(prior[free], prior[free])
    weak = _undetermined(fit.covariance, [PARAMETERS[i] for i in free])
    return Bundle(changed_rig(nominal, values), values, covariance, fit.chi2, degrees, weak)


@dataclass(frozen=True)
class _Problem:
    """Residuals over their standard deviations. Unknowns: parameters over prior sigma, then points (x, y, z)."""

    nominal: Rig
    outline: PoseMeasurement | None
    spots: tuple[KnownSpot, ...]
    vertical: PoseMeasurement | None
    prior: Array
    free: NDArray[np.intp]
    by_principal_point: Array

    @property
    def has_ellipse(self) -> bool:
        """True if the outline has more than a centre."""
        return self.outline is not None and len(self.outline.value) > 3

    def values(self, x: Array) -> Array:
        """Values of `PARAMETERS` at the unknowns, of which points are left out, shape (p,)."""
        values = np.zeros(len(PARAMETERS))
        # unknowns are in prior sigmas: their residuals are themselves
        values[self.free] = x[: self.free.size] * self.prior[self.free]
        return values

    def residuals(self, x: Array) -> Array:
        values = self.values(x)
        rig = changed_rig(self.nominal, values)
        parts = [x[: self.free.size]]
        if self.outline is not None:
            seen = apparent_outline(self.nominal, rig)[:3]
            parts.append(_whitened(seen - self.outline.value[:3], self.outline.covariance[:3, :3]))
        if self.vertical is not None:
            # a vertical found with another principal point is off to first order
            up = rig.T_world_camera.R.T[:2, 2] + self.by_principal_point @ (_centre_px(rig) - _centre_px(self.nominal))
            parts.append(_whitened(up - self.vertical.value, self.vertical.covariance))
        points = x[self.free.size :].reshape(-1, 3)
        if self.spots:
            parts.append(_spot_residuals(rig, values, self.spots, points))
        return np.concatenate(parts)

    def jacobian(self, x: Array) -> Array:
        """Forward differences of `residuals`. A point moves its own spot's rows alone: so all points move at once."""
        f, n, count = self.residuals(x), self.free.size, len(self.spots)
        step = x + _FORWARD * np.where(x >= 0.0, 1.0, -1.0) * np.maximum(1.0, np.abs(x)) - x
        J = np.zeros((f.size, x.size))
        for i in range(n):
            moved = x.copy()
            moved[i] += step[i]
            J[:, i] = (self.residuals(moved) - f) / step[i]
        if count:
            # every spot three times, moved along one axis after the other
            values, points, steps = self.values(x), x[n:].reshape(-1, 3), step[n:].reshape(-1, 3)
            every = np.concatenate([points + steps * axis for axis in np.eye(3)])
            moved = _spot_residuals(changed_rig(self.nominal, values), values, self.spots * 3, every)
            own, of_row = _spot_of_rows(self.spots), _spot_of_rows(self.spots * 3)
            rows = f.size - own.size + np.arange(own.size)
            for axis in range(3):
                change = moved[of_row // count == axis] - f[rows]
                J[rows, n + 3 * own + axis] = change / steps[own, axis]
        return J


@dataclass(frozen=True)
class _Fit:
    """Mean, shape (p,), and covariance of the free parameters, in units of their prior sigmas; and the misfit."""

    x: Array
    covariance: Array
    chi2: float


def _with_ellipse(problem: _Problem, fit: _Fit, vertex_rows: Array) -> _Fit:
    """Mean and covariance of a fit without the rim's ellipse, given the ellipse, too.

    The ellipse is quadratic in the mirror's tilt against the line of sight, r, shape (2,), and nearly linear in all
    else: e = E(r) + L x. Its error given the vertex has a mean of B (v - v(x)), which is linear in x, too. So for each
    r on a grid all else is normal, and the moments of r and l = (B V - L) x are sums over the grid, with V = dv/dx.
    x follows r and l linearly.

    Parameters
    ----------
    vertex_rows : shape (3, p)
        Derivatives of the vertex's whitened residuals by x.
    """
    assert problem.outline is not None
    C = problem.outline.covariance
    rig = changed_rig(problem.nominal, problem.values(fit.x))
    seen = apparent_outline(problem.nominal, rig)
    off = seen - problem.outline.value
    # regression of the ellipse on the vertex: what is left is independent of the fit so far
    B = np.linalg.solve(C[:3, :3], C[:3, 3:]).T
    adds = tilts_of_ellipse(rig, _TURN_RAD)
    turned, by_x = _ellipse_slopes(problem, fit.x)
    by_r = np.stack([adds(step) - adds(-step) for step in _TURN_RAD * np.eye(2)], axis=-1) / (2.0 * _TURN_RAD)
    V = np.linalg.cholesky(C[:3, :3]) @ vertex_rows
    of_x = np.concatenate([turned, B @ V - (by_x - by_r @ turned)])
    P = of_x @ fit.covariance @ of_x.T  # of (r, l)
    P[:2, :2] += _HELD_RAD**2 * np.eye(2)
    K = np.linalg.solve(P[:2, :2], P[:2, 2:]).T
    Q = P[2:, 2:] - K @ P[:2, 2:]  # of l, given r
    W = C[3:, 3:] - B @ C[:3, 3:] + Q  # of e - E(r) + l, given r
    L = np.linalg.cholesky(P[:2, :2])
    unit = _grid(float(np.abs(adds(_REACH * np.sqrt(np.diag(P)[:2]))).max() / np.sqrt(np.diag(W)).min()))
    r = unit @ L.T
    # misfit of the ellipse for every tilt of the grid
    y = r @ K.T - (adds(r) + off[3:] - B @ off[:3])
    misfit = np.sum(unit**2, axis=1) + np.sum(y * np.linalg.solve(W, y.T).T, axis=1)
    weight = np.exp(-0.5 * (misfit - misfit.min()))
    weight /= weight.sum()
    gain = np.linalg.solve(W, Q).T
    # mean of (r, l) at each node; then moments over the nodes
    z = np.concatenate([r, r @ K.T - y @ gain.T], axis=1)
    mean = weight @ z
    spread = (z - mean).T @ ((z - mean) * weight[:, None])
    spread[2:, 2:] += Q - gain @ Q
    # tilts may be held, with a variance of 0
    G = fit.covariance @ of_x.T @ np.linalg.pinv(P, rcond=1e-12, hermitian=True)
    # what the ellipse tells of (r, l) passes on to all parameters by regression
    covariance = fit.covariance - G @ (P - spread) @ G.T
    return _Fit(fit.x + G @ mean, 0.5 * (covariance + covariance.T), fit.chi2 + float(misfit.min()))


def _grid(steepness: float) -> Array:
    """Nodes over `_REACH` sigmas in two axes, shape (n, 2), so dense that an ellipse of this steepness is resolved."""
    count = int(np.clip(4.0 * steepness, *_NODES))
    axis = np.linspace(-_REACH, _REACH, count)
    return np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)


def _ellipse_slopes(problem: _Problem, x: Array) -> tuple[Array, Array]:
    """Derivatives by x of the tilt against the line of sight, as turns of the mirror about x and y, and of the ellipse.

    Both have the shape (2, p), radians and pixels.

    The image of a circle of radius q at the distance Z, with k = q / Z, has the ellipse
    -(f k / 4) (1 - k^2) (r^2 - g^2) to second order. Here g = b / (1 - k^2) and r = a - g are complex numbers, a the
    direction of the mirror's axis and b that of the circle's middle, both against the optical axis.
    """
    profile = problem.nominal.revolved.profile

    def tilt(rig: Rig) -> Array:
        pose = rig.T_camera_sphere
        a, c = pose.R[:, 2], pose.t + pose.R[:, 2] * profile.depth_m
        return np.asarray(a[:2] / a[2] - c[:2] / c[2] / (1.0 - (profile.rim_radius_m / c[2]) ** 2))

    def at(x: Array) -> Rig:
        return changed_rig(problem.nominal, problem.values(x))

    by_turn = []
    for name in _TURNS:
        plus, minus = (at(x).perturbed(Misalignment(**{name: sign * _TURN_RAD})) for sign in (1.0, -1.0))
        by_turn.append((tilt(plus) - tilt(minus)) / (2.0 * _TURN_RAD))
    turns, ellipses = [], []
    for step in _PART * np.eye(problem.free.size):
        plus, minus = at(x + step), at(x - step)
        turns.append((tilt(plus) - tilt(minus)) / (2.0 * _PART))
        seen = [apparent_outline(problem.nominal, rig)[3:] for rig in (plus, minus)]
        ellipses.append((seen[0] - seen[1]) / (2.0 * _PART))
    return np.linalg.solve(np.stack(by_turn, axis=-1), np.stack(turns, axis=-1)), np.stack(ellipses, axis=-1)


def _centre_px(rig: Rig) -> Array:
    return np.array([rig.camera.cx_px, rig.camera.cy_px])


def _spot_residuals(rig: Rig, values: Array, spots: Sequence[KnownSpot], points: Array) -> Array:
    """Pixels, and the finite ones of distance, height and azimuth, of all spots; points have the shape (K, 3)."""
    strokes = stroke_of(np.array([spot.stroke_m for spot in spots]), values)
    # the rig up by h is the point down by h
    up_points = points - strokes[:, None] * np.array(rig.stroke_axis_world)
    view, places = rig.at(0.0), np.concatenate([points, up_points])
    seen_px = np.array([s.uv_down_px for s in spots] + [s.uv_up_px for s in spots], float)
    covariance = np.array([s.covariance_down_px2 for s in spots] + [s.covariance_up_px2 for s in spots], float)
    off = (mirror_pixels(view, places, seen_px) - seen_px)[..., None]
    seen = np.linalg.solve(np.linalg.cholesky(covariance), off).ravel()
    flat = points[:, :2] - view.sphere_centre_m[:2]
    turn = np.arctan2(flat[:, 1], flat[:, 0]) - [spot.azimuth_rad for spot in spots]
    known = np.stack(
        [
            np.hypot(flat[:, 0], flat[:, 1]) - [spot.depth_m for spot in spots],
            points[:, 2] - [spot.height_m for spot in spots],
            # a difference of angles between -pi and pi
            np.arctan2(np.sin(turn), np.cos(turn)),
        ],
        axis=-1,
    )
    sigma = _place_sigmas(spots)
    return np.concatenate([seen, (known / sigma)[np.isfinite(sigma)]])


def _place_sigmas(spots: Sequence[KnownSpot]) -> Array:
    """Sigmas of distance, height and azimuth, shape (K, 3); infinite where one was not measured."""
    return np.array([(s.depth_sigma_m, s.height_sigma_m, s.azimuth_sigma_rad) for s in spots]).reshape(-1, 3)


def _spot_of_rows(spots: Sequence[KnownSpot]) -> NDArray[np.intp]:
    """Spot to which each row of `_spot_residuals` belongs."""
    every = np.arange(len(spots))
    pixels, places = np.repeat(every, 2), np.repeat(every, 3).reshape(-1, 3)
    return np.concatenate([pixels, pixels, places[np.isfinite(_place_sigmas(spots))]])


def mirror_pixels(view: View, points: Array, near_px: Array) -> Array:
    """Pixels (K, 2) at which world points (K, 3) are seen in the mirror, by Newton's method from pixels nearby."""
    uv = np.asarray(near_px, float)
    for _ in range(_NEWTON):
        ray, J = reflect_both(view, uv)
        r, w = ray.direction_world, points - ray.origin_world_m
        t = np.sum(w * r, axis=-1)[:, None, None]
        # what is across the ray, seen along two of its normals
        first = cross(r, np.where(np.abs(r[:, 2:]) < 0.9, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]))
        basis = np.stack([first, cross(r, first)], axis=-2)
        slope = -basis @ (J.origin_m_per_px + t * J.direction_per_px)
        uv = uv - np.linalg.solve(slope, basis @ w[..., None])[..., 0]
    return uv


def _start(rig: Rig, spot: KnownSpot) -> Array:
    """World point where the nominal rig's rays meet, moved to the known distance."""
    estimate = depth_exact(rig, spot.stroke_m, np.asarray(spot.uv_down_px), np.asarray(spot.uv_up_px))
    if not np.isfinite(estimate.depth_m):
        raise DatasetError(
            f"a calibration spot at ({spot.uv_down_px[0]:.1f}, {spot.uv_down_px[1]:.1f}) px has no depth with the "
            "nominal rig: its rays miss the mirror or do not meet; check the pixels and the rig"
        )
    point, centre = np.array(estimate.point_world_m), rig.at(0.0).sphere_centre_m
    # same azimuth, at the distance of the tape
    point[:2] = centre[:2] + (point[:2] - centre[:2]) * spot.depth_m / float(estimate.depth_m)
    return point


def _whitened(residual: Array, covariance: Array) -> Array:
    return np.linalg.solve(np.linalg.cholesky(covariance), residual)


def _undetermined(covariance: Array, names: Sequence[str]) -> tuple[WeakDirection, ...]:
    """Eigenvectors of the covariance in units of the prior, those with nearly all of its variance left."""
    size, vectors = np.linalg.eigh(covariance)
    weak = [i for i in np.argsort(-size) if size[i] > _WEAK]
    # 4 % of a direction's length: less does not help a reader
    parts = [{n: float(x) for n, x in zip(names, vectors[:, i], strict=True) if abs(x) > 0.2} for i in weak]
    return tuple(WeakDirection(shares, float(np.sqrt(size[i]))) for shares, i in zip(parts, weak, strict=True))


# -- outline and vertical of a true rig, as the nominal one gives them -------------------------------------------------

_STEP_PX = 2.0  # of the principal point, for differences: the vertical is smooth in it
_EDGES, _POINTS = 12, 8  # upright lines all around the sphere, and points of each
_DISTANCE_M = 2.5  # of a wall; it matters little, as in `vertical_edges`
_ELEVATIONS_RAD = (-0.35, 0.5)  # walls of a room


@lru_cache(maxsize=64)  # a fit moves its spots' points more often than the rig
def apparent_outline(nominal: Rig, true: Rig) -> Array:
    """Centre, shape (3,), or place, shape (5,), that the true rig's outline gives with the nominal camera and mirror.

    The pixels of a sphere's outline, as the nominal camera sees them, are a cone: its axis and its opening give the
    centre. Of a mirror of revolution it is the `contour` of the nominal one that is nearest.
    """
    uv = true.outline_px(90)
    if nominal.mirror.has_rim:
        return place_of_outline(nominal, uv)
    return sphere_from_rays(nominal.camera.rays(uv), nominal.sphere.radius_m)


def apparent_vertical(nominal: Rig, true: Rig) -> Array:
    """The vertical, x and y in the camera frame, that upright edges all around the true rig give with the nominal one.

    The sphere is where the outline puts it, as `find_vertical` wants it.
    """
    pose = replace(nominal.T_camera_sphere, translation_m=as_vector(apparent_outline(nominal, true)[:3]))
    edges = [image_of(true.at(0.0), line).uv_px for line in _lines(true)]
    return np.asarray(vertical_of(edges, replace(nominal, T_camera_sphere=pose)).up[:2])


def vertical_by_principal_point(nominal: Rig) -> Array:
    """Derivative of the apparent vertical by the true principal point, shape (2, 2), rad/px.

    Tilt, focal length, radius and distance leave the apparent vertical at the true one, a decentre of 1 mm turns it by
    some 5e-6 rad: only the principal point matters.
    """
    columns = []
    for name in ("cx_px", "cy_px"):
        both = []
        for step in (_STEP_PX, -_STEP_PX):
            camera = replace(nominal.camera, **{name: getattr(nominal.camera, name) + step})
            both.append(apparent_vertical(nominal, replace(nominal, camera=camera)))
        columns.append((both[0] - both[1]) / (2.0 * _STEP_PX))
    return np.stack(columns, axis=-1)


def _lines(rig: Rig) -> Array:
    """Points on upright lines about the sphere, shape (edges, points, 3), world."""
    azimuth = 2.0 * np.pi * np.arange(_EDGES)[:, None] / _EDGES
    # 0 times the azimuth: the shape of all edges by all points
    height = _DISTANCE_M * np.tan(np.linspace(*_ELEVATIONS_RAD, _POINTS)) + 0.0 * azimuth
    flat = [_DISTANCE_M * f(azimuth) + 0.0 * height for f in (np.cos, np.sin)]
    return np.asarray(np.stack([*flat, height], axis=-1) + rig.at(0.0).sphere_centre_m)
