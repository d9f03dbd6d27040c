"""Occluding contour of a mirror of revolution in the image: derivatives by position and tilt; position from its points.

r(t) is the contour's distance from a fixed place in the image, in the direction t from u towards v. Five numbers say
where the mirror is: x, y, z of its vertex in the camera frame, and e1, e2 of an ellipse r(t) + e1 cos 2t + e2 sin 2t.

A rim is a circle in space. Its image is an ellipse, which has five numbers, and they belong together like this. Let
the mirror face the lens from the distance Z of its rim, whose radius is q. A tilt of its axis by a small angle a
towards t = 0 brings each point of the rim nearer by a q cos t, and moves its image out by (f q / Z)(q / Z) a cos t:
to first order a shift, which a decentre by a q^2 / Z makes as well. In second order the circle is foreshortened, and
e1 = -(f q / Z) a^2 / 4 for a distant lens; at a fourth of Z perspective takes a third of it. So the picture gives the
vertex for a known tilt. Of the tilt it gives the size, above a degree or so, and the direction but for its sign.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import scipy

from phibench.calibration.outline.outline_least_squares import OutlinePixels, Place
from phibench.scenes.frames import Array, BoolArray, as_vector
from phibench.scenes.misalignment import Misalignment
from phibench.scenes.revolved_profile import rim_points
from phibench.scenes.rig import Rig

PLACES = 5
"""Numbers of a place: x, y, z of the vertex, metres; e1, e2, pixels."""
POINTS = 240  # a spline through so many is exact to 1e-6 px
_FEWER = 96  # exact to 1e-5 px
_STEP_M, _TILT_RAD = 1e-5, 1e-3  # of differences: contours are exact to 1e-6 px, and curve little over so much
_ROUNDS, _REST_PX = 12, 1e-9  # Newton's


@dataclass(frozen=True)
class Contour:
    """A contour and its derivatives.

    Attributes
    ----------
    middle_px : shape (2,)
        Place that r is counted from.
    radius_px : spline of t
    by_place : spline of t, with values of shape (5,)
        Derivatives of r.
    rim : shape (POINTS,)
        At even turns from -pi on: True where the rim is seen, and False where lines of sight touch the surface.
    depth_m : float
        Mean distance of the contour from the lens, along the optical axis.
    bend : float
        Mean of distance times curvature of the surface along the line of sight: a ray that is a small angle inside a
        contour that is no rim meets the surface with cos i = sqrt(2 bend angle).
    """

    middle_px: Array
    radius_px: scipy.interpolate.CubicSpline
    by_place: scipy.interpolate.CubicSpline
    rim: BoolArray
    depth_m: float
    bend: float

    def points_px(self, count: int = POINTS) -> Array:
        """Points of the contour at even turns, shape (count, 2)."""
        t = _turns(count)
        return self.middle_px + self.radius_px(t)[:, None] * np.stack([np.cos(t), np.sin(t)], axis=-1)

    def place_of(self, pixels: OutlinePixels) -> Place:
        """Place of pixels relative to the contour."""
        off = np.stack([pixels.u, pixels.v], axis=-1) - self.middle_px
        size, turn = np.hypot(*off.T), np.arctan2(off[:, 1], off[:, 0])
        radius, slope = self.radius_px(turn), self.radius_px(turn, 1)
        radial = off / size[:, None]
        across = np.stack([-radial[:, 1], radial[:, 0]], axis=-1)
        normal = radial - (slope / radius)[:, None] * across
        cosine = 1.0 / np.linalg.norm(normal, axis=-1)
        by_place = -self.by_place(turn) * cosine[:, None]
        return Place((size - radius) * cosine, by_place, normal * cosine[:, None], turn)

    def is_rim(self, turn_rad: Array) -> BoolArray:
        """True where the contour is the rim, at turns (n,)."""
        return np.asarray(self.rim[np.rint((turn_rad + np.pi) / (2.0 * np.pi) * POINTS).astype(int) % POINTS])


def place_of_rig(rig: Rig) -> Array:
    """Place of a rig's own mirror, shape (5,)."""
    return np.concatenate([rig.sphere_in_camera_m, np.zeros(2)])


def rig_at(rig: Rig, place: Array) -> Rig:
    """Rig with its vertex at a place, turned as it is.

    Raises
    ------
    SceneError
        If there is no such rig.
    """
    return replace(rig, T_camera_sphere=replace(rig.T_camera_sphere, translation_m=as_vector(place[:3])))


def contour_of(rig: Rig, place: Array) -> Contour:
    """Contour of the rig's mirror at a place, shape (5,).

    Raises
    ------
    SceneError
        If there is no such rig.
    """
    there = rig_at(rig, place)
    middle, t = there.outline_px(POINTS).mean(axis=0), _turns(POINTS)
    radius = _radius_at(t, there.outline_px(POINTS), middle)
    slopes = _slopes(rig, place, t, middle, POINTS)
    rim, depth_m, bend = _seen(there, t, middle)
    return Contour(
        middle,
        _closed(t, radius + place[3] * slopes[:, 3] + place[4] * slopes[:, 4]),
        _closed(t, slopes),
        rim,
        depth_m,
        bend,
    )


def place_of_outline(rig: Rig, outline_px: Array, start: Array | None = None, ellipse: bool = True) -> Array:
    """Place, shape (5,), whose contour is nearest to points (n, 2) all around, as this rig's camera sees them.

    Parameters
    ----------
    rig : Rig
        Nominal: camera, profile, and how the mirror is turned.
    outline_px : shape (n, 2)
    start : shape (5,), optional
        The rig's own place by default.
    ellipse : bool
        Without, e1 and e2 stay 0: for points that are not exact.
    """
    middle, inverse = _way_back(rig if start is None else rig_at(rig, start), ellipse)
    turn = _turns(_FEWER)
    there, place = _radius_at(turn, outline_px, middle), place_of_rig(rig) if start is None else start
    for _ in range(_ROUNDS):
        radius = _radius_at(turn, rig_at(rig, place).outline_px(_FEWER), middle)
        radius = radius + place[3] * np.cos(2.0 * turn) + place[4] * np.sin(2.0 * turn)
        move = inverse @ (there - radius)
        place = place + np.pad(move, (0, PLACES - len(move)))
        if not np.abs(move).max() > _REST_PX:
            break
    return place


@lru_cache(maxsize=8)
def _way_back(rig: Rig, ellipse: bool) -> tuple[Array, Array]:
    """Middle of a rig's own contour, and the place's change with its radii; slopes change little on the way there."""
    middle = rig.outline_px(POINTS).mean(axis=0)
    slopes = _slopes(rig, place_of_rig(rig), _turns(_FEWER), middle, _FEWER)
    return middle, np.asarray(np.linalg.pinv(slopes[:, : PLACES if ellipse else 3]))


def aside_by_tilt_m(rig: Rig) -> float:
    """Distance by which the vertex of an upright mirror seems to be aside, per radian of a tilt of its axis, m/rad."""
    true = rig.perturbed(Misalignment(mirror_tilt_y_rad=_TILT_RAD))
    return float(np.linalg.norm((place_of_outline(rig, true.outline_px(_FEWER)) - place_of_rig(rig))[:2])) / _TILT_RAD


def tilts_of_ellipse(rig: Rig, size_rad: float) -> Callable[[Array], Array]:
    """Ellipses, shape (..., 2), that tilts of the mirror about x and y of the world add, to second order.

    Differences of tilts of `size_rad` give the quadratic form of each number.
    """

    def ellipse(x: float, y: float) -> Array:
        true = rig.perturbed(Misalignment(mirror_tilt_x_rad=x, mirror_tilt_y_rad=y))
        return place_of_outline(rig, true.outline_px(POINTS))[3:]

    s = size_rad
    xx, yy = (0.5 * (ellipse(*a) + ellipse(*b)) for a, b in (((s, 0), (-s, 0)), ((0, s), (0, -s))))
    xy = 0.25 * (ellipse(s, s) + ellipse(-s, -s) - ellipse(s, -s) - ellipse(-s, s))
    x1, y1 = (0.5 * (ellipse(*a) - ellipse(*b)) for a, b in (((s, 0), (-s, 0)), ((0, s), (0, -s))))

    def of(tilt: Array) -> Array:
        x, y = tilt[..., :1] / s, tilt[..., 1:] / s
        return np.asarray(x * x * xx + y * y * yy + x * y * xy + x * x1 + y * y1)

    return of


def _slopes(rig: Rig, place: Array, turn: Array, middle: Array, count: int) -> Array:
    """Derivatives of the radii at turns (n,) by a place, shape (n, 5), by `count` points of the outline."""
    columns = []
    for i in range(3):
        step = _STEP_M * np.eye(PLACES)[i]
        plus, minus = (_radius_at(turn, rig_at(rig, place + s * step).outline_px(count), middle) for s in (1.0, -1.0))
        columns.append((plus - minus) / (2.0 * _STEP_M))
    return np.stack([*columns, np.cos(2.0 * turn), np.sin(2.0 * turn)], axis=-1)


def _turns(count: int) -> Array:
    return np.asarray(-np.pi + 2.0 * np.pi * np.arange(count) / count)


def _closed(t: Array, values: Array) -> scipy.interpolate.CubicSpline:
    """Periodic spline through values at rising turns."""
    turns, closed = np.append(t, t[0] + 2.0 * np.pi), np.concatenate([values, values[:1]])
    return scipy.interpolate.CubicSpline(turns, closed, bc_type="periodic")


def _radius_at(turn: Array, outline_px: Array, middle: Array) -> Array:
    """Distance of a closed curve, of which points are given, from a place within it, at turns (n,)."""
    off = outline_px - middle
    angle = np.arctan2(off[:, 1], off[:, 0])
    order = np.argsort(angle)
    spline = _closed(angle[order], np.hypot(*off.T)[order])
    return np.asarray(spline(turn))


def _seen(rig: Rig, t: Array, middle: Array) -> tuple[BoolArray, float, float]:
    """Parts where the rim is seen, mean depth, and mean `bend` of the rest."""
    profile = rig.revolved.profile
    eye = rig.T_camera_sphere.inverse().t
    P = rim_points(profile, eye, np.linspace(0.0, 2.0 * np.pi, POINTS, endpoint=False))
    # a contour that is the rim is on it to rounding
    rim = np.hypot(P[:, 0], P[:, 1]) > (1.0 - 1e-9) * profile.rim_radius_m
    in_camera = rig.T_camera_sphere.points(P)
    off = rig.camera.project(in_camera) - middle
    angle = np.arctan2(off[:, 1], off[:, 0])
    nearest = np.argmin(np.abs(np.exp(1j * t[:, None]) - np.exp(1j * angle)), axis=1)
    depth_m = float(in_camera[:, 2].mean())
    if rim.all():
        return rim, depth_m, 0.0
    touched = P[~rim]
    sight = touched - eye
    distance = np.linalg.norm(sight, axis=-1)
    level, d = profile.level(touched), sight / distance[:, None]
    curvature = np.einsum("ni,nij,nj->n", d, level.hessian_per_m, d) / np.linalg.norm(level.gradient, axis=-1)
    return rim[nearest], depth_m, float(np.mean(distance * curvature))
