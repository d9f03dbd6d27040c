"""Convex profile of a mirror of revolution: conic with even polynomial terms, its rim, form error, occluding contour.

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

**Form error.** h(x, y), in metres, positive towards the camera, makes the surface z = sag - h N, N = sqrt(1 + 4 s
sag'^2) being 1 over the cosine of the slope. This is the definition: h N lies along the axis, at the same x and y. To
first order in h that is h along the normal; at 0.2 mm the two surfaces differ by up to 12 um. h is a sum of peak times
Zernike polynomial on the disc of the rim, whose largest magnitude is 1. With rho the radius over the rim's, and phi the
angle from x to y:

    20   6 rho^4 - 6 rho^2 + 1                     spherical aberration
    21   (3 rho^3 - 2 rho) cos, sin phi            coma
    22   rho^2 cos, sin 2 phi                      astigmatism
    30   20 rho^6 - 30 rho^4 + 12 rho^2 - 1        secondary spherical aberration
    31   (10 rho^5 - 12 rho^3 + 3 rho) cos, sin phi
    32   (4 rho^4 - 3 rho^2) cos, sin 2 phi
    33   rho^3 cos, sin 3 phi                      trefoil

These are fringe Zernike polynomials 5 to 16 (J. C. Wyant and K. Creath, "Basic wavefront aberration theory for optical
metrology", Applied Optics and Optical Engineering XI, 1992, table III). The degree is half the sum of power and order.
Degrees 0 and 1 are parameters already: axial shift, tilt, radius.

z - sag / 2 has to remain convex: then the body does, and keeps half of its curvature. A cone has none along its side:
the mean of -h over circles around the axis would be convex, and so rise from the axis on. Without a part in 1 and rho^2
it is then 0. What is left has two signs on every circle. So no form error leaves a cone convex.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from phibench.scenes.form_error import HARMONICS, Form, Level
from phibench.scenes.frames import Array
from phibench.scenes.validation import SceneError, finite, positive

ComplexArray = NDArray[np.complexfloating]
Shape = Literal["sphere", "ellipsoid", "paraboloid", "hyperboloid", "cone", "polynomial"]

LARGEST_M = 1.0
"""Of a radius, a rim, a depth."""
_BISECTIONS = 55
_PLACES = 2001  # where a polynomial's curvature is looked at, from the axis to the rim
_WIDEST = 1.0 - 1e-6  # of an ellipsoid's equator: at it the slope is infinite


@dataclass(frozen=True)
class Sag:
    """Depth of a profile and its derivatives by s, the radius squared, shape (...).

    Attributes
    ----------
    z_m : array
        Sag, along the axis.
    slope_per_m : array
        dz / ds.
    bend_per_m3 : array
        d2z / ds2.
    """

    z_m: Array
    slope_per_m: Array
    bend_per_m3: Array


@dataclass(frozen=True)
class Heights:
    """Surface z(x, y) and its derivatives at places of any one shape."""

    z_m: Array
    x: Array
    y: Array
    xx_per_m: Array
    xy_per_m: Array
    yy_per_m: Array


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
        Where the mirror ends, from the axis.
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

    form: ClassVar[None] = None
    reach_m: ClassVar[float] = 0.0

    def __post_init__(self) -> None:
        positive("Profile", "rim_radius_m", self.rim_radius_m)
        finite("Profile", "conic", self.conic)
        for name in ("rim_radius_m", "vertex_radius_m"):
            if not 0.0 <= getattr(self, name) <= LARGEST_M:
                raise SceneError(f"Profile.{name} = {getattr(self, name)}: allowed range is 0 to {LARGEST_M:g} m")
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
        if not self.depth_m <= LARGEST_M:
            raise SceneError(
                f"Profile.rim_radius_m = {self.rim_radius_m:g}: the mirror would be {self.depth_m:.3g} m deep; allowed "
                f"is {LARGEST_M:g} m; end it before, or make it flatter"
            )

    def _check_convex(self) -> None:
        s = np.linspace(1e-3, 1.0, _PLACES) ** 2 * self.rim_radius_m**2
        sag = self.sag(s)
        # d2z/dr2 with s = r^2: 2 z' + 4 s z''
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
            # s / (R + w) in place of (R - w) / (1 + k): no cancellation near the vertex, and k = -1 is none of its own
            z, slope, bend = np.where(s > 0.0, s / (R + w), 0.0), 0.5 / w, 0.25 * A / (w * w * w)
        for i, a in enumerate(self.even_terms, start=2):
            z = z + a * s**i
            slope = slope + i * a * s ** (i - 1)
            bend = bend + i * (i - 1) * a * s ** (i - 2)
        return Sag(z, slope, bend)

    def heights(self, x: Array, y: Array) -> Heights:
        """z at places off the axis, and its derivatives."""
        return _raised(self.sag(x * x + y * y), x, y)

    def points(self, across: Array, radius: Array) -> Array:
        """Points, shape (n, 3), at radii (n,) in directions (n, 2) across the axis."""
        return np.concatenate([radius[:, None] * across, self.sag(radius**2).z_m[:, None]], axis=-1)

    def grid(self, radii_m: Array, turns_rad: Array) -> tuple[Array, Array]:
        """Points and unit normals, shape (rings, spokes, 3), for falling radii."""
        sag = self.sag(radii_m**2)
        # a cone's tip has the normals of all its spokes
        rise = (
            2.0 * radii_m * sag.slope_per_m
            if self.shape != "cone"
            else np.full_like(radii_m, (-1.0 - self.conic) ** -0.5)
        )
        across = np.stack([np.cos(turns_rad), np.sin(turns_rad)], axis=-1)

        def grid(flat: Array, z: Array) -> Array:
            tall = np.broadcast_to(z[:, None, None], (len(radii_m), len(turns_rad), 1))
            return np.concatenate([flat[:, None, None] * across, tall], axis=-1)

        normals = grid(rise, np.full_like(rise, -1.0))
        return grid(radii_m, sag.z_m), normals / np.linalg.norm(normals, axis=-1, keepdims=True)

    @property
    def ideal(self) -> Profile:
        """The profile itself: it has no form error."""
        return self

    def radius_at_slope(self, slope: Array) -> Array:
        """Radius at which dz/dr has a value, shape (...); NaN where no place inside the rim has it, as on a cone."""
        t, R, A = np.asarray(slope, float), self.vertex_radius_m, 1.0 + self.conic
        if self.shape == "cone":
            return np.full(np.shape(t), np.nan)
        with np.errstate(invalid="ignore"):
            if self.is_quadric:
                # slope of a quadric, r / sqrt(R^2 - (1 + k) r^2), solved for r
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
        if not self.is_quadric:
            return height_level(self, points_m)
        x, y, z = np.moveaxis(np.asarray(points_m, float), -1, 0)
        s, hessian, A, R = x * x + y * y, np.zeros((*np.shape(x), 3, 3)), 1.0 + self.conic, self.vertex_radius_m
        scale = 0.5 / max(R, self.rim_radius_m)  # makes the value a distance, nearly
        hessian[..., 0, 0] = hessian[..., 1, 1] = 2.0 * scale
        hessian[..., 2, 2] = 2.0 * scale * A
        gradient = 2.0 * scale * np.stack([x, y, A * z - R], axis=-1)
        return Level(scale * (s + A * z * z - 2.0 * R * z), gradient, hessian)


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


# Form error.

_LEAST_CURVATURE = 0.5  # of the ideal's, as of a sphere's
_RADII, _TURNS = 40, 48  # where it is looked at: the curvature has up to three waves around, and degree 4 along


@dataclass(frozen=True)
class FormedProfile:
    """Profile with a form error: peaks of the polynomials above, on a disc of a radius; `RevolvedMirror` checks it."""

    ideal: Profile
    form: Form
    disc_m: float

    @property
    def rim_radius_m(self) -> float:
        """Radius of the rim."""
        return self.ideal.rim_radius_m

    @property
    def reach_m(self) -> float:
        """No point of the surface is farther from the ideal one than this, along the axis."""
        return self.form.bound_m * float(lengthening(self.ideal, np.array(self.rim_radius_m**2))[0])

    @cached_property
    def _polynomials(self) -> tuple[ComplexArray, ...]:
        return disc_polynomials(self.form)

    def heights(self, x: Array, y: Array) -> Heights:
        """z at places off the axis, and its derivatives."""
        s = x * x + y * y
        sag, h = self.ideal.sag(s), self.deviation(x, y)
        ideal, (N, N1, N2) = _raised(sag, x, y), lengthening(self.ideal, s, sag)
        return Heights(
            ideal.z_m - h.z_m * N,
            ideal.x - h.x * N - 2.0 * x * N1 * h.z_m,
            ideal.y - h.y * N - 2.0 * y * N1 * h.z_m,
            ideal.xx_per_m - h.xx_per_m * N - 4.0 * x * N1 * h.x - (2.0 * N1 + 4.0 * N2 * x * x) * h.z_m,
            ideal.xy_per_m - h.xy_per_m * N - 2.0 * N1 * (y * h.x + x * h.y) - 4.0 * N2 * x * y * h.z_m,
            ideal.yy_per_m - h.yy_per_m * N - 4.0 * y * N1 * h.y - (2.0 * N1 + 4.0 * N2 * y * y) * h.z_m,
        )

    def deviation(self, x: Array, y: Array) -> Heights:
        """h and its derivatives: the real part of w0 + w1 p + w2 p^2 + w3 p^3, polynomials w in t = |p|^2.

        p = X + i Y is the place in radii of the disc. With the sum S as a function of p and t, the derivative by X is
        S_p + 2 X S_t, and that by Y is i S_p + 2 Y S_t.
        """
        w0, w1, w2, (w3,) = self._polynomials
        X, Y = x / self.disc_m, y / self.disc_m
        p, t = X + 1j * Y, X * X + Y * Y
        a, b = (w1[2] * t + w1[1]) * t + w1[0], w2[1] * t + w2[0]
        b_t, wave = 2.0 * w1[2] * t + w1[1], w3 * p
        S = ((w0[3] * t + w0[2]) * t + w0[1]) * t + w0[0] + p * (a + p * (b + wave))
        S_p, S_pp = a + p * (2.0 * b + 3.0 * wave), 2.0 * b + 6.0 * wave
        S_t = (3.0 * w0[3] * t + 2.0 * w0[2]) * t + w0[1] + p * (b_t + w2[1] * p)
        S_tp, S_tt = b_t + 2.0 * w2[1] * p, (6.0 * w0[3] * t + 2.0 * w0[2] + 2.0 * w1[2] * p).real
        k, k2, twice_t = 1.0 / self.disc_m, 1.0 / self.disc_m**2, 2.0 * S_t.real
        return Heights(
            S.real,
            k * (S_p.real + X * twice_t),
            k * (Y * twice_t - S_p.imag),
            k2 * (S_pp.real + twice_t + 4.0 * X * (S_tp.real + X * S_tt)),
            k2 * (2.0 * (Y * S_tp.real - X * S_tp.imag) - S_pp.imag + 4.0 * X * Y * S_tt),
            k2 * (twice_t - S_pp.real + 4.0 * Y * (Y * S_tt - S_tp.imag)),
        )

    def points(self, across: Array, radius: Array) -> Array:
        """Points, shape (n, 3), at radii (n,) in directions (n, 2) across the axis."""
        flat = radius[:, None] * across
        return np.concatenate([flat, self.heights(*flat.T).z_m[:, None]], axis=-1)

    def grid(self, radii_m: Array, turns_rad: Array) -> tuple[Array, Array]:
        """Points and unit normals, shape (rings, spokes, 3), for falling radii."""
        x, y = radii_m[:, None] * np.cos(turns_rad), radii_m[:, None] * np.sin(turns_rad)
        at = self.heights(x, y)
        normals = np.stack([at.x, at.y, np.full(x.shape, -1.0)], axis=-1)
        return np.stack([x, y, at.z_m], axis=-1), normals / np.linalg.norm(normals, axis=-1, keepdims=True)

    def level(self, points_m: Array) -> Level:
        """Level of the surface: 0 on it, above 0 before it, at points (..., 3)."""
        return height_level(self, points_m)

    def check(self) -> None:
        """Raise `SceneError` where too little is left of the ideal's curvature.

        The least root of det(H - ratio H_ideal) = 0, H the second derivatives of z.
        """
        r = np.linspace(0.0, 1.0, _RADII + 1)[1:, None] * self.rim_radius_m
        turn = np.linspace(0.0, 2.0 * np.pi, _TURNS, endpoint=False)
        ours, ideal = (surface.heights(r * np.cos(turn), r * np.sin(turn)) for surface in (self, self.ideal))
        (a, b, c), (d, e, f) = ((k.xx_per_m, k.xy_per_m, k.yy_per_m) for k in (ours, ideal))
        det, mean = d * f - e * e, 0.5 * (a * f + c * d) - b * e
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = (mean - np.sqrt(np.maximum(mean**2 - det * (a * c - b * b), 0.0))) / det
        ratio = np.where(np.isfinite(ratio), ratio, -np.inf)
        at = np.unravel_index(np.argmin(ratio), ratio.shape)
        if not ratio[at] >= _LEAST_CURVATURE:
            raise SceneError(
                f"the form error bends the {self.ideal.shape} too far: at {float(r[at[0], 0]):.2g} m from its axis the "
                f"curvature falls to {ratio[at]:.2f} of the ideal's; at least {_LEAST_CURVATURE} is needed, so that "
                "every point has one image; make form_20_m ... form_33s_m smaller"
            )


def _raised(sag: Sag, x: Array, y: Array) -> Heights:
    steep, bend = 2.0 * sag.slope_per_m, 4.0 * sag.bend_per_m3
    return Heights(sag.z_m, steep * x, steep * y, steep + bend * x * x, bend * x * y, steep + bend * y * y)


def disc_polynomials(form: Form) -> tuple[ComplexArray, ...]:
    """Coefficients by powers of rho^2, metres, of w0 to w3 in `deviation`: those of cosines, less i those of sines."""
    f = {name[5:-2]: getattr(form, name) for name in HARMONICS}
    c = {f"{n}{m}": f[f"{n}{m}c"] - 1j * f[f"{n}{m}s"] for n, m in ("21", "22", "31", "32", "33")}
    return (
        f["20"] * np.array([1.0 + 0.0j, -6.0, 6.0, 0.0]) + f["30"] * np.array([-1.0, 12.0, -30.0, 20.0]),
        c["21"] * np.array([-2.0, 3.0, 0.0]) + c["31"] * np.array([3.0, -12.0, 10.0]),
        c["22"] * np.array([1.0, 0.0]) + c["32"] * np.array([-3.0, 4.0]),
        c["33"] * np.ones(1),
    )


def lengthening(profile: Profile, s: Array, sag: Sag | None = None) -> tuple[Array, Array, Array]:
    """N and its derivatives by s: N^2 = 1 + 4 s p^2 with p = sag'."""
    sag, A = sag or profile.sag(s), 1.0 + profile.conic
    p, p1 = sag.slope_per_m, sag.bend_per_m3
    p2 = 0.375 * A * A / np.sqrt(profile.vertex_radius_m**2 - A * s) ** 5
    for i, a in enumerate(profile.even_terms[1:], start=3):
        p2 = p2 + i * (i - 1) * (i - 2) * a * s ** (i - 3)
    N = np.sqrt(1.0 + 4.0 * s * p * p)
    N1 = (2.0 * p * p + 4.0 * s * p * p1) / N
    return N, N1, (8.0 * p * p1 + 4.0 * s * (p1 * p1 + p * p2) - N1 * N1) / N


def height_level(surface: Profile | FormedProfile, points_m: Array) -> Level:
    """z(x, y) less the height, at points (..., 3)."""
    x, y, z = np.moveaxis(np.asarray(points_m, float), -1, 0)
    at, hessian = surface.heights(x, y), np.zeros((*np.shape(x), 3, 3))
    hessian[..., 0, 0], hessian[..., 1, 1] = at.xx_per_m, at.yy_per_m
    hessian[..., 0, 1] = hessian[..., 1, 0] = at.xy_per_m
    return Level(at.z_m - z, np.stack([at.x, at.y, np.full(np.shape(x), -1.0)], axis=-1), hessian)


def rim_points(profile: Profile | FormedProfile, eye_m: Array, turns_rad: Array) -> Array:
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
    return profile.points(across, radius)


def _faces(profile: Profile | FormedProfile, across: Array, radius: Array, eye_m: Array) -> Array:
    P = profile.points(across, radius)
    return np.einsum("ni,ni->n", profile.level(P).gradient, eye_m - P) > 0.0
