"""Mirror of revolution: a convex profile around an axis, cut at its rim.

In the mirror's frame the vertex is the origin, and z is the axis, away from the camera. With s = x^2 + y^2 the surface
is z = sag(s) for sqrt(s) <= rim radius,

    sag(s) = s / (R + w) + a_2 s^2 + a_3 s^3 + ...,     w = sqrt(R^2 - (1 + k) s),

R the vertex radius and k the conic constant, as for lenses. Without the polynomial it is the quadric

    x^2 + y^2 + (1 + k) z^2 - 2 R z = 0,

in other letters x^2 + y^2 + A z^2 + B z = C with A = 1 + k, B = -2 R, C = 0: a sphere (k = 0), an ellipsoid (k > -1), a
paraboloid (k = -1), a hyperboloid (k < -1), or a cone with its tip at the vertex (R = 0, k < -1, whose half angle has
the tangent sqrt(-1 - k)). Derivatives of the quadric's sag by s are 1 / (2 w) and (1 + k) / (4 w^3).

The profile has to be convex as seen from the camera: the second derivative by the radius, 2 sag' + 4 s sag'', is not
negative anywhere inside the rim. Of a quadric it is R^2 / w^3, and nothing needs to be looked at. The mirror and all
behind it, z >= sag, is then a convex body, so that of two points outside it at most one point of the mirror reflects
light from one to the other (`render.optics.revolved_reflection`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from phibench.scenes.frames import Array
from phibench.scenes.mirror import Level, MetalName, MetalSurface, ReflectanceTable, known_metal
from phibench.scenes.validation import SceneError, finite, positive, within

Shape = Literal["sphere", "ellipsoid", "paraboloid", "hyperboloid", "cone", "polynomial"]

_LARGEST_M = 1.0
_BISECTIONS = 55
_PLACES = 2001  # where a polynomial's curvature is looked at, from the axis to the rim
_WIDEST = 1.0 - 1e-6  # of an ellipsoid's equator: at it the slope is infinite


@dataclass(frozen=True)
class Sag:
    """Depth of a profile and its derivatives by s, the radius squared, shape (...).

    Attributes
    ----------
    z_m : array
    slope_per_m : array
        dz / ds.
    bend_per_m3 : array
        d2z / ds2.
    """

    z_m: Array
    slope_per_m: Array
    bend_per_m3: Array


@dataclass(frozen=True)
class Profile:
    """Convex profile of revolution.

    Parameters
    ----------
    vertex_radius_m : float
        R, radius of curvature at the vertex; 0 is a cone.
    conic : float
        k, the conic constant.
    rim_radius_m : float
    even_terms : floats
        a_2, a_3, ... in m^-3, m^-5, ...

    Raises
    ------
    SceneError
        If the profile folds, reaches its equator before the rim, or is not convex.
    """

    vertex_radius_m: float
    conic: float
    rim_radius_m: float
    even_terms: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        positive("Profile", "rim_radius_m", self.rim_radius_m)
        finite("Profile", "conic", self.conic)
        for name in ("rim_radius_m", "vertex_radius_m"):
            if not 0.0 <= getattr(self, name) <= _LARGEST_M:
                raise SceneError(f"Profile.{name} = {getattr(self, name)}: allowed range is 0 to {_LARGEST_M:g} m")
        object.__setattr__(
            self, "even_terms", tuple(finite("Profile", "even_terms", float(a)) for a in self.even_terms)
        )
        if self.vertex_radius_m == 0.0 and (not self.conic < -1.0 or any(self.even_terms)):
            raise SceneError(
                f"Profile.vertex_radius_m = 0 is a cone: its conic ({self.conic:g}) is below -1, without even terms"
            )
        if self.rim_radius_m > _WIDEST * self.equator_m:
            raise SceneError(
                f"Profile.rim_radius_m = {self.rim_radius_m:g}: the surface folds back at its equator, at "
                f"{self.equator_m:g} m from the axis; the rim must lie before it"
            )
        if not self.is_quadric:
            self._check_convex()
        if not self.depth_m <= _LARGEST_M:
            raise SceneError(
                f"Profile.rim_radius_m = {self.rim_radius_m:g}: the mirror would be {self.depth_m:.3g} m deep; allowed "
                f"is {_LARGEST_M:g} m; end it before, or make it flatter"
            )

    def _check_convex(self) -> None:
        s = np.linspace(1e-3, 1.0, _PLACES) ** 2 * self.rim_radius_m**2
        sag = self.sag(s)
        curved = (2.0 * sag.slope_per_m + 4.0 * s * sag.bend_per_m3) >= -1e-12 / self.rim_radius_m
        if curved.all() and (sag.slope_per_m > 0.0).all():
            return
        at = float(np.sqrt(s[np.argmin(curved & (sag.slope_per_m > 0.0))]))
        raise SceneError(
            f"Profile.even_terms = {list(self.even_terms)}: the surface is not convex towards the camera at {at:.4g} m "
            "from the axis; change it or conic, or end the mirror before, with rim_radius_m"
        )

    @property
    def equator_m(self) -> float:
        """Radius at which the quadric's slope is infinite; infinite where there is none."""
        return self.vertex_radius_m / math.sqrt(1.0 + self.conic) if self.conic > -1.0 else math.inf

    @property
    def is_quadric(self) -> bool:
        """Return True if the profile has no even terms."""
        return not any(self.even_terms)

    @property
    def shape(self) -> Shape:
        """Name of the surface."""
        if not self.is_quadric:
            return "polynomial"
        if self.vertex_radius_m == 0.0:
            return "cone"
        if self.conic < -1.0:
            return "hyperboloid"
        return "paraboloid" if self.conic == -1.0 else "sphere" if self.conic == 0.0 else "ellipsoid"

    @property
    def depth_m(self) -> float:
        """Height of the rim over the vertex."""
        return float(self.sag(np.array(self.rim_radius_m**2)).z_m)

    def sag(self, s_m2: Array) -> Sag:
        """z and its derivatives by s at squared radii of any shape; NaN beyond the equator."""
        R, A, s = self.vertex_radius_m, 1.0 + self.conic, np.asarray(s_m2, float)
        with np.errstate(invalid="ignore", divide="ignore"):
            w = np.sqrt(R * R - A * s)
            z, slope, bend = np.where(s > 0.0, s / (R + w), 0.0), 0.5 / w, 0.25 * A / (w * w * w)
        for i, a in enumerate(self.even_terms, start=2):
            z = z + a * s**i
            slope = slope + i * a * s ** (i - 1)
            bend = bend + i * (i - 1) * a * s ** (i - 2)
        return Sag(z, slope, bend)

    def radius_at_slope(self, slope: Array) -> Array:
        """Radius at which dz/dr has a value, shape (...); NaN where no place inside the rim has it, as on a cone."""
        t, R, A = np.asarray(slope, float), self.vertex_radius_m, 1.0 + self.conic
        if self.shape == "cone":
            return np.full(np.shape(t), np.nan)
        with np.errstate(invalid="ignore"):
            if self.is_quadric:
                r = t * R / np.sqrt(1.0 + A * t * t)
            else:
                low, high = np.zeros(np.shape(t)), np.full(np.shape(t), self.rim_radius_m)
                for _ in range(_BISECTIONS):
                    r = 0.5 * (low + high)
                    flatter = 2.0 * r * self.sag(r * r).slope_per_m < t
                    low, high = np.where(flatter, r, low), np.where(flatter, high, r)
                r = np.where(
                    t <= 2.0 * self.rim_radius_m * self.sag(np.array(self.rim_radius_m**2)).slope_per_m, r, np.nan
                )
            return np.where((t >= 0.0) & (r <= self.rim_radius_m), r, np.nan)

    def holds(self, point_m: Array) -> bool:
        """Return True if a point, shape (3,), lies on the mirror or behind it, within the equator."""
        return bool(point_m[2] >= self.sag(np.array(point_m[0] ** 2 + point_m[1] ** 2)).z_m)

    def level(self, points_m: Array) -> Level:
        """Level of the surface: 0 on it, above 0 before it, at points (..., 3): sag - z; of quadrics their polynomial.

        That of a hyperboloid or cone is below 0 inside the other sheet as well.
        """
        x, y, z = np.moveaxis(np.asarray(points_m, float), -1, 0)
        s, hessian = x * x + y * y, np.zeros((*np.shape(x), 3, 3))
        if self.is_quadric:
            A, R = 1.0 + self.conic, self.vertex_radius_m
            scale = 0.5 / max(R, self.rim_radius_m)  # makes the value a distance, nearly
            hessian[..., 0, 0] = hessian[..., 1, 1] = 2.0 * scale
            hessian[..., 2, 2] = 2.0 * scale * A
            gradient = 2.0 * scale * np.stack([x, y, A * z - R], axis=-1)
            return Level(scale * (s + A * z * z - 2.0 * R * z), gradient, hessian)
        sag = self.sag(s)
        flat = np.stack([x, y], axis=-1)
        hessian[..., :2, :2] = 4.0 * sag.bend_per_m3[..., None, None] * flat[..., :, None] * flat[..., None, :]
        hessian[..., :2, :2] += 2.0 * sag.slope_per_m[..., None, None] * np.eye(2)
        gradient = np.concatenate([2.0 * sag.slope_per_m[..., None] * flat, -np.ones((*np.shape(x), 1))], axis=-1)
        return Level(sag.z_m - z, gradient, hessian)


def by_vertex_radius(profile: Profile, points_m: Array) -> tuple[Array, Array]:
    """Derivatives of the level function and of its gradient by R, at points (..., 3) of the surface.

    The gradient's part along itself is left out: it changes the length and not the normal. A cone has no radius.
    """
    x, y, z = np.moveaxis(np.asarray(points_m, float), -1, 0)
    if profile.shape == "cone":
        return np.zeros_like(x), np.zeros((*np.shape(x), 3))
    if profile.is_quadric:
        scale = 0.5 / max(profile.vertex_radius_m, profile.rim_radius_m)
        return -2.0 * scale * z, np.broadcast_to([0.0, 0.0, -2.0 * scale], (*np.shape(x), 3))
    R, s = profile.vertex_radius_m, x * x + y * y
    w = np.sqrt(R * R - (1.0 + profile.conic) * s)
    turned = -R / w**3
    return -s / ((R + w) * w), np.stack([turned * x, turned * y, np.zeros_like(x)], axis=-1)


def sphere_cap(radius_m: float, rim_radius_m: float) -> Profile:
    """Cap of a sphere."""
    return Profile(radius_m, 0.0, rim_radius_m)


def paraboloid(vertex_radius_m: float, rim_radius_m: float) -> Profile:
    """Paraboloid; its focal length is half the vertex radius."""
    return Profile(vertex_radius_m, -1.0, rim_radius_m)


def hyperboloid(lens_m: float, eccentricity: float, rim_radius_m: float) -> Profile:
    """Hyperboloid whose outer focus, where the lens belongs, is `lens_m` before the vertex."""
    if not eccentricity > 1.0:
        raise SceneError(f"hyperboloid: eccentricity = {eccentricity:g} must be above 1")
    return Profile(positive("hyperboloid", "lens_m", lens_m) * (eccentricity - 1.0), -(eccentricity**2), rim_radius_m)


def cone(half_angle_rad: float, rim_radius_m: float) -> Profile:
    """Cone with so large an angle between axis and surface."""
    if not 0.05 <= half_angle_rad <= 0.5 * math.pi - 0.05:
        raise SceneError(
            f"cone: half_angle_rad = {half_angle_rad:g}: allowed range is 0.05 to {0.5 * math.pi - 0.05:.3f}"
        )
    return Profile(0.0, -1.0 - math.tan(half_angle_rad) ** 2, rim_radius_m)


def image_depth_m(profile: Profile) -> float:
    """Depth behind the vertex at which a far room's virtual image lies: R / 2; behind a cone, half its height."""
    return 0.5 * (profile.vertex_radius_m or profile.depth_m)


@dataclass(frozen=True)
class RevolvedMirror(MetalSurface):
    """A polished mirror of revolution.

    Parameters
    ----------
    profile : Profile
    roughness_alpha : float
        Beckmann roughness; 0 is an ideal mirror.
    metal : "steel", "aluminium" or "gold"
    reflectance_table : ReflectanceTable or None
        Measured reflectance instead of the metal's.
    """

    profile: Profile
    roughness_alpha: float = 0.0
    metal: MetalName = "steel"
    reflectance_table: ReflectanceTable | None = None

    def __post_init__(self) -> None:
        within("RevolvedMirror", "roughness_alpha", self.roughness_alpha, 0.0, 0.05)
        known_metal("RevolvedMirror", self.metal)

    @property
    def bound_m(self) -> float:
        """No point of the surface is farther from the vertex than this."""
        return math.hypot(self.profile.rim_radius_m, self.profile.depth_m)

    def level(self, points_m: Array) -> Level:
        """Level of the surface: 0 on it, above 0 before it, at points (..., 3) in the mirror's frame."""
        return self.profile.level(points_m)


def rim_points(profile: Profile, eye_m: Array, turns_rad: Array) -> Array:
    """Occluding contour as seen from an eye, mirror's frame, shape (N, 3), metres.

    In each half-plane around the axis it is the rim, where that is seen, or else the place where lines of sight touch
    the surface: grad g . (P - eye) changes its sign once on a convex profile, and bisection finds where.
    """
    across = np.stack([np.cos(turns_rad), np.sin(turns_rad)], axis=-1)
    high = np.full(len(across), profile.rim_radius_m)
    low = np.zeros(len(across))
    seen = _faces(profile, across, high, eye_m)
    for _ in range(0 if seen.all() else _BISECTIONS):
        middle = 0.5 * (low + high)
        facing = _faces(profile, across, middle, eye_m)
        low, high = np.where(facing, middle, low), np.where(facing, high, middle)
    radius = np.where(seen, profile.rim_radius_m, 0.5 * (low + high))
    return _points(profile, across, radius)


def _points(profile: Profile, across: Array, radius: Array) -> Array:
    return np.concatenate([radius[:, None] * across, profile.sag(radius**2).z_m[:, None]], axis=-1)


def _faces(profile: Profile, across: Array, radius: Array, eye_m: Array) -> Array:
    P = _points(profile, across, radius)
    return np.einsum("ni,ni->n", profile.level(P).gradient, eye_m - P) > 0.0
