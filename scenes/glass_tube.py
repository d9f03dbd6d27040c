"""Refraction by the wall of a glass tube, in closed form: rays going out, apparent points, area growth, transmittance.

The wall lies between two cylinders about one axis, with air on both sides. A ray keeps two numbers at a cylinder about
that axis: the direction cosine along it, q, times the refractive index, and the moment L = axis . (P x d), times the
index. Behind the wall both are what they were before it. The ray is therefore the old one, **turned about the axis and
lifted along it**. Seen along the axis a ray is a straight line at the distance b = L / w from it, w = sqrt(1 - q^2) in
air, and b_g = L / w_g, w_g = sqrt(n^2 - q^2) in glass. Between the radii r1 and r2 it goes round by
S(b) = asin(b / r1) - asin(b / r2) and on by C(b) = sqrt(r2^2 - b^2) - sqrt(r1^2 - b^2), which rises by q C / w. Hence

    turn = S(b_g) - S(b)          lift = q (C(b_g) / w_g - C(b) / w).

A ray from inside has |b| < r1 and |b_g| < |b|: it always enters the wall, and always leaves it.

The map of points along such rays has the determinant 1 + ..., see `stretch`: it says how an area across a bundle grows.
A bare wall passes 2 a b / (a^2 + b^2) of each polarisation, with r = (a - b) / (a + b) Fresnel's coefficient of one
face: (1 - R) / (1 + R) of a plate with all its inner reflections. Absorption is left out.

Points and directions have the shape (N, 3), world frame, metres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from phibench.scenes.frames import Array, BoolArray

_STEPS = 60  # four or five do, unless the wall is thick and the point near
_SETTLED_M = 1e-13  # of a step: below rounding of a room
_ENOUGH_M = 1e-12  # rounding of a room 100 m wide


@dataclass(frozen=True)
class Bend:
    """Turn (rad) and lift (m) of rays, shape (N,), and their derivatives by the moment L and the cosine q.

    The lift's derivative by L is the turn's by q.
    """

    turn: Array
    lift: Array
    turn_by_moment: Array
    turn_by_cosine: Array
    lift_by_cosine: Array


@dataclass(frozen=True)
class Crossing:
    """Rays from inside on their way through the wall.

    Attributes
    ----------
    inner_m, outer_m : arrays, shape (N, 3)
        Points on the inner and the outer face; NaN for rays along the axis.
    directions : array, shape (N, 3)
        Outside.
    crosses : bool array, shape (N,)
        The inner face is met between the ends of the tube.
    passes : bool array, shape (N,)
        The outer face, too. What crosses and does not pass ends in the wall, on a plate.
    transmittance : array, shape (N,)
    """

    inner_m: Array
    outer_m: Array
    directions: Array
    crosses: BoolArray
    passes: BoolArray
    transmittance: Array


@dataclass(frozen=True)
class GlassTube:
    """Tube in the world.

    Attributes
    ----------
    inner_m, outer_m : float
        Radii.
    index : float
        Refractive index.
    low_m, high_m : float
        Its ends along the axis, from the origin.
    origin_m, axis : arrays, shape (3,)
        A point of the axis, and its unit direction.
    """

    inner_m: float
    outer_m: float
    index: float
    low_m: float
    high_m: float
    origin_m: Array
    axis: Array

    def height_m(self, points_m: Array) -> Array:
        """Place along the axis, shape (N,)."""
        return np.asarray((points_m - self.origin_m) @ self.axis)

    def outside(self, points_m: Array) -> BoolArray:
        """Mask of points farther from the axis than the outer face, shape (N,)."""
        offset = points_m - self.origin_m
        across = offset - (offset @ self.axis)[:, None] * self.axis
        return np.asarray((across * across).sum(axis=1) > self.outer_m**2)

    def invariants(self, points_m: Array, directions: Array) -> tuple[Array, Array]:
        """Moment L (m) and cosine q of rays, shape (N,)."""
        moment = np.cross(points_m - self.origin_m, directions) @ self.axis
        return moment, directions @ self.axis

    def bend(self, moment: Array, cosine: Array) -> Bend:
        """Turn and lift of rays from inside."""
        w_g = np.sqrt(self.index**2 - cosine**2)
        w = np.sqrt(np.maximum(1.0 - cosine**2, 0.0))
        (S_g, S1_g, C_g), (S, S1, C) = (self._between(moment / one) for one in (w_g, w))
        b_g, b, q = moment / w_g, moment / w, cosine
        lift = C_g / w_g - C / w
        return Bend(
            turn=S_g - S,
            lift=q * lift,
            turn_by_moment=S1_g / w_g - S1 / w,
            turn_by_cosine=q * (b_g * S1_g / w_g**2 - b * S1 / w**2),
            lift_by_cosine=lift + q**2 * ((b_g**2 * S1_g + C_g) / w_g**3 - (b**2 * S1 + C) / w**3),
        )

    def turned(self, vectors: Array, angle: Array) -> Array:
        """Vectors turned about the axis (Rodrigues)."""
        along = (vectors @ self.axis)[:, None] * self.axis
        less = 2.0 * np.sin(0.5 * angle)[:, None] ** 2  # 1 - cos without cancellation
        return vectors - less * (vectors - along) + np.sin(angle)[:, None] * np.cross(self.axis, vectors)

    def leave(self, points_m: Array, directions: Array) -> Crossing:
        """Rays from inside, unit directions, through the wall."""
        offset = points_m - self.origin_m
        with np.errstate(divide="ignore", invalid="ignore"):
            L, q = self.invariants(points_m, directions)
            square = 1.0 - q * q
            towards = np.einsum("ni,ni->n", offset, directions) - (offset @ self.axis) * q
            s1, s2 = ((np.sqrt(square * r * r - L * L) - towards) / square for r in (self.inner_m, self.outer_m))
            bend = self.bend(L, q)
            inner = points_m + s1[:, None] * directions
            turned = self.turned(offset + s2[:, None] * directions, bend.turn)
            outer = self.origin_m + turned + bend.lift[:, None] * self.axis
            within = [(z > self.low_m) & (z < self.high_m) for z in map(self.height_m, (inner, outer))]
            onward = self.turned(directions, bend.turn)
            passing = self.transmittance(np.sqrt(square - (L / self.inner_m) ** 2))
        return Crossing(inner, outer, onward, within[0], within[0] & within[1], passing)

    def transmittance(self, cos: Array) -> Array:
        """Mean of both polarisations, shape of `cos`, the cosine of incidence on the inner face."""
        inside = np.sqrt(self.index**2 - 1.0 + cos * cos)
        s = 2.0 * cos * inside / (cos * cos + inside * inside)
        steep = self.index**2 * cos
        return np.asarray(0.5 * (s + 2.0 * steep * inside / (steep * steep + inside * inside)))

    def appearing(self, points_m: Array, moment: Array, cosine: Array) -> Array:
        """Points outside, turned and lowered so that rays from inside lead straight to them."""
        bend = self.bend(moment, cosine)
        lowered = points_m - self.origin_m - bend.lift[:, None] * self.axis
        return self.origin_m + self.turned(lowered, -bend.turn)

    def seen_from(self, places_m: Array, points_m: Array) -> tuple[Array, Array]:
        """Points outside as they appear from places inside, and the same areas' growth (`stretch`), shape (N,).

        NaN where no ray through the wall leads there.
        """
        seen, step = points_m, np.full(len(points_m), np.inf)
        with np.errstate(divide="ignore", invalid="ignore"):
            for _ in range(_STEPS):
                new = self.appearing(points_m, *self.invariants(places_m, _unit(seen - places_m)))
                step, seen = np.linalg.norm(new - seen, axis=1), new
                if not np.any(step > _SETTLED_M):
                    break
            lost = ~(step <= _ENOUGH_M)
            seen = np.where(lost[:, None], np.nan, seen)
            way, length = seen - places_m, np.linalg.norm(seen - places_m, axis=1)
            by_direction = (np.cross(self.axis, places_m - self.origin_m), np.broadcast_to(self.axis, seen.shape))
            gradients = (parts_across(vector, way / length[:, None], length) for vector in by_direction)
            return seen, self.stretch(seen, places_m, *gradients)

    def stretch(self, seen_m: Array, places_m: Array, moment_slope: Array, cosine_slope: Array) -> Array:
        """Area across a bundle outside over the same area where it appears, shape (N,).

        A point W' where light appears is at W = turn(W') + lift. With u = axis x W', and g and h the gradients of turn
        and lift by W', dW / dW' is a rotation times I + u g^T + axis h^T. Along the ray it changes no length, so that
        its determinant is that of the two directions across.

        Parameters
        ----------
        seen_m, places_m : arrays, shape (N, 3)
            W', and any place of the ray inside.
        moment_slope, cosine_slope : arrays, shape (N, 3)
            Gradients of L and q by W'.
        """
        bend = self.bend(*self.invariants(places_m, _unit(seen_m - places_m)))
        u = np.cross(self.axis, seen_m - self.origin_m)
        slopes = (bend.turn_by_moment, bend.turn_by_cosine), (bend.turn_by_cosine, bend.lift_by_cosine)
        g, h = (a[:, None] * moment_slope + b[:, None] * cosine_slope for a, b in slopes)
        gu, hu = (np.einsum("ni,ni->n", one, u) for one in (g, h))
        return np.abs((1.0 + gu) * (1.0 + h @ self.axis) - (g @ self.axis) * hu)

    def _between(self, b: Array) -> tuple[Array, Array, Array]:
        """S(b), its derivative, and C(b)."""
        near, far = (np.sqrt(r * r - b * b) for r in (self.inner_m, self.outer_m))
        return np.arcsin(b / self.inner_m) - np.arcsin(b / self.outer_m), 1.0 / near - 1.0 / far, far - near


def parts_across(vectors: Array, directions: Array, length: Array) -> Array:
    """Parts of vectors across unit directions, over the distance: (I - d d^T) v / l."""
    along = np.einsum("ni,ni->n", vectors, directions)
    return (vectors - along[:, None] * directions) / length[:, None]


def _unit(vectors: Array) -> Array:
    return vectors / np.linalg.norm(vectors, axis=1)[:, None]
