"""Mirrors: the protocol `Mirror` that all follow, and the sphere, which may have a form error (`form_error`)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar, Protocol, Self

import numpy as np

from phibench.scenes.camera import Camera
from phibench.scenes.form_error import Form, Level, curvatures, deviation, directions, form_sum, level, limb_points
from phibench.scenes.frames import Array, Pose
from phibench.scenes.holder import Extent
from phibench.scenes.metals import MetalName, MetalSurface, ReflectanceTable, known_metal
from phibench.scenes.validation import SceneError, positive, within


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


OF_REVOLVED = ("mirror_tilt_x_rad", "mirror_tilt_y_rad", "rim_radius_m")
"""Deviations of mirrors of revolution: a perfect sphere has neither axis nor rim."""


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
    def has_axes(self) -> bool:
        """Return True with a form."""
        return self.form is not None

    def level(self, points_m: Array) -> Level:
        """g of `form_error` at points (..., 3) in the sphere's frame."""
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
        # a cone of half angle asin(R / distance) touches the sphere
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
        return replace(self, radius_m=self.radius_m + radius_m, roughness_alpha=alpha, form=form_sum(self.form, form))


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
