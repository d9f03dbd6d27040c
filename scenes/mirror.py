"""Mirrors: what each of them says of itself, the polished metals that they are of, and the sphere.

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

Sources of the metals' refractive indices:

* Steel, austenitic stainless (about 316): B. Karlsson and C. G. Ribbing, "Optical constants and spectral selectivity of
  stainless steel and its oxides", J. Appl. Phys. 53, 6340 (1982), read from a figure, good to 1 to 2 %.
* Aluminium, evaporated: A. D. Rakic, "Algorithm for the determination of intrinsic optical constants of metal films:
  application to aluminum", Appl. Opt. 34, 4755 (1995).
* Gold, evaporated: P. B. Johnson and R. W. Christy, "Optical constants of the noble metals", Phys. Rev. B 6, 4370
  (1972).

A polished or oxidised surface reflects less than an evaporated film. A `ReflectanceTable` takes what was measured.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, fields, replace
from functools import cache, cached_property
from types import MappingProxyType
from typing import ClassVar, Literal, Protocol, Self

import numpy as np

from phibench.scenes.camera import Camera
from phibench.scenes.frames import Array, Pose
from phibench.scenes.holder import Extent
from phibench.scenes.validation import SceneError, finite, positive, within

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
        value,
        n - added.gradient,
        (I3 - n[..., :, None] * n[..., None, :]) / rho[..., None, None] - added.hessian_per_m,
    )


def deviation(points_m: Array, form: Form) -> Level:
    """H2(P) / |P|^2 + H3(P) / |P|^3 at points (..., 3): the same along a ray from the centre."""
    Q, T = form.tensors
    rho = np.linalg.norm(points_m, axis=-1)
    n, I3 = points_m / rho[..., None], np.eye(3)
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
    places = set(itertools.permutations("xyz".index(letter) for letter in monomial))
    result = np.zeros((3,) * len(monomial))
    for place in places:
        result[place] = coefficient / len(places)
    return result


# Metals.


MetalName = Literal["steel", "aluminium", "gold"]

# Wavelength in nm, n, k.
STEEL = np.array(
    [
        [400, 1.5249, 2.7925],
        [420, 1.5762, 2.9240],
        [440, 1.6386, 3.0555],
        [460, 1.7169, 3.1785],
        [480, 1.7921, 3.2933],
        [500, 1.8636, 3.4010],
        [520, 1.9349, 3.5072],
        [540, 2.0072, 3.6166],
        [560, 2.0807, 3.7298],
        [580, 2.1557, 3.8451],
        [600, 2.2325, 3.9594],
        [620, 2.3122, 4.0504],
        [640, 2.3962, 4.1378],
        [660, 2.4839, 4.2261],
        [680, 2.5731, 4.3155],
        [700, 2.6617, 4.4066],
    ]
)
_ALUMINIUM = np.array(
    [
        [364.66, 0.39877, 4.3957],
        [413.28, 0.52135, 5.0008],
        [442.8, 0.6079, 5.3676],
        [476.87, 0.7278, 5.7781],
        [516.6, 0.8734, 6.2418],
        [563.57, 1.0728, 6.7839],
        [619.93, 1.366, 7.4052],
        [652.25, 1.5724, 7.7354],
        [688.81, 1.8301, 8.0601],
        [729.32, 2.1606, 8.3565],
    ]
)
_GOLD = np.array(
    [
        [397.4, 1.47, 1.952],
        [413.3, 1.46, 1.958],
        [430.5, 1.45, 1.948],
        [450.9, 1.38, 1.914],
        [471.4, 1.31, 1.849],
        [495.9, 1.04, 1.833],
        [520.9, 0.62, 2.081],
        [548.6, 0.43, 2.455],
        [582.1, 0.29, 2.863],
        [616.8, 0.21, 3.272],
        [659.5, 0.14, 3.697],
        [704.5, 0.13, 4.103],
    ]
)
METALS = MappingProxyType({"steel": STEEL, "aluminium": _ALUMINIUM, "gold": _GOLD})
"""Tables of wavelength in nm, n and k."""
for _table in METALS.values():
    _table.setflags(write=False)

_SHORTEST_NM, _LONGEST_NM = 400.0, 700.0  # that the tables cover: the camera's filters and any visible laser


def known_metal(owner: str, name: str) -> None:
    """Raise `SceneError` for a metal that has no table."""
    if name not in METALS:
        raise SceneError(f"{owner}.metal = {name}: known are {', '.join(METALS)}")


@dataclass(frozen=True)
class ReflectanceTable:
    """Measured power reflectance of a mirror, unpolarised, linear between its wavelengths and angles.

    Parameters
    ----------
    wavelength_nm : floats, rising
        A single one stands for all wavelengths.
    value : floats
        One for each wavelength; or, row after row, one for each wavelength and angle.
    angle_deg : floats, rising
        Angles of incidence of the columns; beyond the first and last the nearest holds, so that one angle stands for
        all. Empty: values R are at normal incidence, and the metal says how they depend on the angle. With F by
        Fresnel's equations, a smaller R than F(0) is a factor, R(i) = F(i) R / F(0), as of dirt or scratches; of a
        larger one the loss is scaled, 1 - R(i) = (1 - F(i)) (1 - R) / (1 - F(0)). So R(i) stays within 0 and 1.
    """

    wavelength_nm: tuple[float, ...]
    value: tuple[float, ...]
    angle_deg: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        for name in ("wavelength_nm", "value", "angle_deg"):
            numbers = tuple(finite("ReflectanceTable", name, float(x)) for x in getattr(self, name))
            object.__setattr__(self, name, numbers)
        for name, low, high in (("wavelength_nm", 300.0, 1100.0), ("value", 0.0, 1.0), ("angle_deg", 0.0, 90.0)):
            for x in getattr(self, name):
                within("ReflectanceTable", name, x, low, high)
            if name != "value" and any(b <= a for a, b in itertools.pairwise(getattr(self, name))):
                raise SceneError(f"ReflectanceTable.{name} = {list(getattr(self, name))}: must rise")
        wanted = len(self.wavelength_nm) * max(len(self.angle_deg), 1)
        if len(self.value) != wanted or not wanted:
            raise SceneError(
                f"ReflectanceTable.value = {list(self.value)}: {len(self.value)} numbers for {len(self.wavelength_nm)} "
                f"wavelengths and {max(len(self.angle_deg), 1)} angles; give one for each wavelength and angle"
            )

    def row(self, wavelength_nm: float) -> Array:
        """Values at a wavelength, shape (angles,), or (1,) without angles.

        Raises
        ------
        SceneError
            If the table does not cover the wavelength.
        """
        nm, rows = np.array(self.wavelength_nm), np.reshape(self.value, (len(self.wavelength_nm), -1))
        if len(nm) > 1 and not nm[0] <= wavelength_nm <= nm[-1]:
            raise SceneError(
                f"ReflectanceTable.wavelength_nm = {list(self.wavelength_nm)}: does not cover {wavelength_nm:g} nm, "
                "which the laser or a colour filter needs; add a wavelength, or give a single one that stands for all"
            )
        return np.array([np.interp(wavelength_nm, nm, column) for column in rows.T])


@dataclass(frozen=True)
class BandReflectance:
    """Reflectance at one wavelength, by the angle of incidence: a metal's, a table's, or a mixture of the two.

    Attributes
    ----------
    index : complex
        Refractive index n + i k of the metal.
    gain, loss : float
        Factors of the metal's reflectance and of what that leaves: 1 without a table.
    angles_rad, values : arrays, shape (m,)
        Of a table with angles, which then counts alone; empty otherwise.
    """

    index: complex
    gain: float
    loss: float
    angles_rad: Array
    values: Array

    def at(self, cos_incidence: Array) -> Array:
        """Reflectance, shape of `cos_incidence` (cosine of the angle of incidence); NaN in, NaN out."""
        cos_i = np.asarray(cos_incidence, float)
        if len(self.values):
            angle = np.arccos(np.clip(cos_i, -1.0, 1.0))
            return np.where(np.isnan(cos_i), np.nan, np.interp(angle, self.angles_rad, self.values))
        fresnel = self.gain * _fresnel(self.index, cos_i)
        return fresnel if self.loss == 1.0 else 1.0 - self.loss * (1.0 - fresnel)


def _fresnel(index: complex, cos_i: Array) -> Array:
    """Unpolarised Fresnel power reflectance."""
    m2 = index**2
    with np.errstate(invalid="ignore"):  # NaN in, NaN out
        root = np.sqrt(m2 - (1.0 - cos_i * cos_i))
        r_s = (cos_i - root) / (cos_i + root)
        r_p = (m2 * cos_i - root) / (m2 * cos_i + root)
    return 0.5 * (np.abs(r_s) ** 2 + np.abs(r_p) ** 2)


class MetalSurface:
    """Reflectance of a polished metal: what mirrors of every shape share."""

    metal: MetalName
    roughness_alpha: float
    reflectance_table: ReflectanceTable | None

    @property
    def unsaid(self) -> tuple[str, ...]:
        """Fields that a document leaves out, as older ones did: a mirror of steel, without a measured reflectance."""
        idle = {"metal": self.metal == "steel", "reflectance_table": self.reflectance_table is None}
        return tuple(name for name, is_idle in idle.items() if is_idle)

    def refractive_index(self, wavelength_nm: float) -> complex:
        """Complex index n + i k of the metal, linear between the table's wavelengths (400 to 700 nm)."""
        if not _SHORTEST_NM <= wavelength_nm <= _LONGEST_NM:
            raise SceneError(f"wavelength_nm = {wavelength_nm}: the {self.metal}'s table covers 400 to 700 nm")
        table = METALS[self.metal]
        n, k = (float(np.interp(wavelength_nm, table[:, 0], table[:, i])) for i in (1, 2))
        return complex(n, k)

    def band(self, wavelength_nm: float) -> BandReflectance:
        """Reflectance at a wavelength."""
        index, table = self.refractive_index(wavelength_nm), self.reflectance_table
        none = np.empty(0)
        if table is None:
            return BandReflectance(index, 1.0, 1.0, none, none)
        row, normal = table.row(wavelength_nm), float(_fresnel(index, np.array(1.0)))
        if table.angle_deg:
            return BandReflectance(index, 1.0, 1.0, np.radians(table.angle_deg), row)
        value = float(row[0])
        return BandReflectance(index, min(value / normal, 1.0), min((1.0 - value) / (1.0 - normal), 1.0), none, none)

    def reflectance(self, cos_incidence: Array, wavelength_nm: float) -> Array:
        """Unpolarised power reflectance, shape of `cos_incidence` (cosine of the angle of incidence)."""
        return self.band(wavelength_nm).at(cos_incidence)


# Every mirror.


class Mirror(Protocol):
    """Facts and geometry that scenes, recipes and files ask of a mirror, whatever its shape.

    The optics of a shape stand on both sides of the wall: `estimator.geometry.mirror_geometry` for estimators, and
    `reflection_point` and `ray_tracer` in `render.optics`, which certify each other.
    Points are in the mirror's own frame, called "sphere" in poses; its z axis leads away from a camera ahead.
    """

    @property
    def form(self) -> Form | None:
        """Deviation from the surface."""

    @property
    def shape(self) -> str:
        """Name of the surface."""

    @property
    def radius_m(self) -> float | None:
        """Radius of the sphere that the mirror is, but for its form; None for other surfaces."""

    @property
    def vertex_m(self) -> float:
        """Height of the vertex over the frame's origin."""

    @property
    def bound_m(self) -> float:
        """No point of the surface is farther from the origin than this."""

    @property
    def has_axes(self) -> bool:
        """Return True if it looks otherwise when it is turned about its origin."""

    @property
    def has_rim(self) -> bool:
        """Return True if it ends somewhere."""

    @property
    def without_effect(self) -> tuple[str, ...]:
        """Deviations of `misalignment.PARAMETERS` that mean nothing for it."""

    @property
    def least_theta_rad(self) -> float:
        """Angle from straight down, seen from the axis, below which it shows nothing."""

    @property
    def unsaid(self) -> tuple[str, ...]:
        """Fields that its document leaves out."""

    def level(self, points_m: Array) -> Level:
        """Level function at points (..., 3): 0 on the surface, above 0 before it."""

    def check_place(self, T_camera_mirror: Pose, camera: Camera) -> None:
        """Raise `SceneError` where the camera cannot see it so."""

    def extent(self, axis: Array) -> Extent:
        """Reach around the axis of a holder, a unit vector (3,)."""

    def outline(self, T_camera_mirror: Pose, count: int) -> Array:
        """Lines of sight, camera frame, shape (count, 3), that touch it: its occluding contour."""

    def grid(self, rings: int, spokes: int) -> tuple[Array, Array]:
        """Points and outward unit normals of its mesh, shape (rings, spokes, 3) each."""

    def drawn_lines(self) -> list[Array]:
        """Lines on it for a drawing, shape (n, 3) each; none where its outline alone says what it is."""

    def deviated(self, radius_m: float, rim_radius_m: float, roughness_alpha: float, form: Form) -> Self:
        """Mirror with these added."""


def added(old: Form | None, new: Form) -> Form:
    """Sum of two forms in the same frame."""
    return new if old is None else Form(*(a + b for a, b in zip(old.coefficients_m, new.coefficients_m, strict=True)))


OF_REVOLVED = ("mirror_tilt_x_rad", "mirror_tilt_y_rad", "rim_radius_m")
"""Deviations of mirrors of revolution: a perfect sphere has neither axis nor rim."""


# The sphere.


_LEAST_CURVATURE = 0.5  # times 1/R: convex with a margin, so that every point has one image at most
_PLACES = 500  # where the curvature is looked at, 9 degrees apart: peaks of degree 3 are missed by 5 % at most


@dataclass(frozen=True)
class SphereMirror(MetalSurface):
    """A polished metal sphere.

    Parameters
    ----------
    radius_m : float
        R.
    roughness_alpha : float
        Beckmann roughness (rms slope x sqrt 2); 0 is an ideal mirror, 0.005 blurs by about 1 px.
    form : Form or None
        Deviations from the sphere; None is a perfect one, and so is a `Form` whose numbers are all 0.
    metal : "steel", "aluminium" or "gold"
        Gives the reflectance.
    reflectance_table : ReflectanceTable or None
        Measured reflectance instead of the metal's.
    """

    radius_m: float = 0.060
    roughness_alpha: float = 0.0
    form: Form | None = None
    metal: MetalName = "steel"
    reflectance_table: ReflectanceTable | None = None

    shape: ClassVar[str] = "sphere"
    has_rim: ClassVar[bool] = False
    without_effect: ClassVar[tuple[str, ...]] = OF_REVOLVED
    least_theta_rad: ClassVar[float] = 0.0

    def __post_init__(self) -> None:
        positive("SphereMirror", "radius_m", self.radius_m)
        within("SphereMirror", "roughness_alpha", self.roughness_alpha, 0.0, 0.05)
        known_metal("SphereMirror", self.metal)
        if self.form is None:
            return
        if not any(self.form.coefficients_m):
            object.__setattr__(self, "form", None)
            return
        _check_convex(self.radius_m, self.form)

    @property
    def bound_m(self) -> float:
        """No point of the surface is farther from the centre than this; the radius of a perfect sphere."""
        return self.radius_m if self.form is None else self.radius_m + self.form.bound_m

    @property
    def vertex_m(self) -> float:
        """Height of the lowest point of the sphere, over its centre."""
        return -self.radius_m

    @property
    def has_axes(self) -> bool:
        """Return True with a form."""
        return self.form is not None

    def level(self, points_m: Array) -> Level:
        """g of the module's docstring at points (..., 3) in the sphere's frame."""
        return level(points_m, self.radius_m, self.form or Form())

    def check_place(self, T_camera_mirror: Pose, camera: Camera) -> None:
        """Raise `SceneError` if the sphere is not wholly before the camera."""
        ahead_m, distance = T_camera_mirror.translation_m[2], math.hypot(*T_camera_mirror.translation_m)
        if ahead_m <= self.bound_m or distance <= self.bound_m:
            raise SceneError(
                f"Rig.T_camera_sphere: the sphere centre is {ahead_m:.4f} m in front of the camera; it must be more "
                f"than the mirror radius {self.bound_m:.4f} m"
            )

    def extent(self, axis: Array) -> Extent:
        """Reach of the sphere, from its centre."""
        return Extent(self.bound_m, self.bound_m, self.radius_m)

    def outline(self, T_camera_mirror: Pose, count: int) -> Array:
        """Lines of sight that touch the sphere, camera frame, shape (count, 3)."""
        s = T_camera_mirror.t
        distance = float(np.linalg.norm(s))
        axis = s / distance
        side = np.cross(axis, [0.0, 1.0, 0.0] if abs(axis[1]) < 0.9 else [1.0, 0.0, 0.0])  # never near the axis
        side /= np.linalg.norm(side)
        turn = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)[:, None]
        rim = np.cos(turn) * side + np.sin(turn) * np.cross(axis, side)
        if self.form is not None:
            turned = T_camera_mirror.R
            return T_camera_mirror.points(limb_points(-s @ turned, rim @ turned, self.radius_m, self.form))
        sine = self.radius_m / distance
        return np.asarray(math.sqrt(1.0 - sine * sine) * axis + sine * rim)

    def grid(self, rings: int, spokes: int) -> tuple[Array, Array]:
        """Points and outward unit normals from pole to pole, shape (rings, spokes, 3)."""
        polar = np.linspace(0.0, np.pi, rings)[:, None]
        turn = np.linspace(0.0, 2.0 * np.pi, spokes, endpoint=False)
        grid = np.broadcast_arrays(np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar))
        n, form = np.stack(grid, axis=-1), self.form or Form()
        points = (self.radius_m + deviation(n, form).value_m)[..., None] * n
        normals = level(points, self.radius_m, form).gradient
        return points, normals / np.linalg.norm(normals, axis=-1, keepdims=True)

    def drawn_lines(self) -> list[Array]:
        """Return no lines: a sphere is drawn as a disc."""
        return []

    def deviated(self, radius_m: float, rim_radius_m: float, roughness_alpha: float, form: Form) -> Self:
        """Sphere with these added; it has no rim."""
        alpha = self.roughness_alpha + roughness_alpha
        return replace(self, radius_m=self.radius_m + radius_m, roughness_alpha=alpha, form=added(self.form, form))


def _check_convex(radius_m: float, form: Form) -> None:
    """Raise `SceneError` for a form that is too far from round."""
    if form.bound_m < 0.5 * radius_m:
        least = float(curvatures(level(radius_m * directions(_PLACES), radius_m, form))[0].min()) * radius_m
        if least >= _LEAST_CURVATURE:
            return
        told = f"its curvature falls to {least:.2f} of the sphere's; at least {_LEAST_CURVATURE} is needed"
    else:
        told = f"its peaks add up to {form.bound_m:g} m; less than half the radius is needed"
    raise SceneError(f"SphereMirror.form is too far from round for radius_m = {radius_m:g}: {told}; make it smaller")


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
        rho1 = -rho * np.sum(
            at.gradient * n1, axis=-1, keepdims=True
        )  # d rho / d angle: n is radial, grad g = n - grad f
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
