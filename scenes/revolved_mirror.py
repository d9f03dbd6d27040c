"""Mirror of revolution (`RevolvedMirror`): profile, metal, form error, outline and mesh; check that the camera sees it.

In the mirror's frame the vertex is the origin, and z is the axis, away from the camera (`revolved_profile`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Self

import numpy as np

from phibench.scenes.camera import Camera
from phibench.scenes.form_error import Form, Level, form_sum
from phibench.scenes.frames import Array, Pose
from phibench.scenes.holder import Extent
from phibench.scenes.metals import MetalName, MetalSurface, ReflectanceTable, known_metal
from phibench.scenes.revolved_profile import LARGEST_M, FormedProfile, Profile, Shape, rim_points
from phibench.scenes.validation import SceneError, within

_AROUND = 360  # places of the rim


@dataclass(frozen=True)
class RevolvedMirror(MetalSurface):
    """A polished mirror of revolution.

    Parameters
    ----------
    profile : Profile
        Curve that is revolved.
    roughness_alpha : float
        Beckmann roughness; 0 is an ideal mirror.
    metal : "steel", "aluminium" or "gold"
        Gives the reflectance.
    reflectance_table : ReflectanceTable or None
        Measured reflectance instead of the metal's.
    form : Form or None
        Form error, by peaks of `revolved_profile`'s polynomials; None is a perfect surface, as is a `Form` of zeros.
    form_radius_m : float
        Radius of the disc of these polynomials; 0 is replaced by the rim's.
    """

    profile: Profile
    roughness_alpha: float = 0.0
    metal: MetalName = "steel"
    reflectance_table: ReflectanceTable | None = None
    form: Form | None = None
    form_radius_m: float = 0.0

    radius_m: ClassVar[None] = None
    has_axes: ClassVar[bool] = True
    has_rim: ClassVar[bool] = True

    def __post_init__(self) -> None:
        within("RevolvedMirror", "roughness_alpha", self.roughness_alpha, 0.0, 0.05)
        known_metal("RevolvedMirror", self.metal)
        within("RevolvedMirror", "form_radius_m", self.form_radius_m, 0.0, LARGEST_M)
        if self.form is None or not any(self.form.coefficients_m):
            object.__setattr__(self, "form", None)
            object.__setattr__(self, "form_radius_m", 0.0)
            return
        if self.profile.shape == "cone":
            raise SceneError(
                "no form error leaves a cone convex, because its side has no curvature: a point could have several "
                "images; remove form_20_m ... form_33s_m, or take another shape"
            )
        object.__setattr__(self, "form_radius_m", self.form_radius_m or self.profile.rim_radius_m)
        FormedProfile(self.profile, self.form, self.form_radius_m).check()

    @cached_property
    def surface(self) -> Profile | FormedProfile:
        """Surface of the mirror."""
        return self.profile if self.form is None else FormedProfile(self.profile, self.form, self.form_radius_m)

    @property
    def shape(self) -> Shape:
        """Name of the profile."""
        return self.profile.shape

    @property
    def reach_m(self) -> float:
        """No point of the surface is farther from the ideal one than this, along the axis."""
        return self.surface.reach_m

    @property
    def without_effect(self) -> tuple[str, ...]:
        """A cone has no vertex radius."""
        return ("radius_m",) if self.shape == "cone" else ()

    @property
    def least_theta_rad(self) -> float:
        """Twice what is left of the half angle to 90 degrees, of a cone; otherwise 0."""
        return float(np.pi - 2.0 * np.arctan(np.sqrt(-1.0 - self.profile.conic))) if self.shape == "cone" else 0.0

    @property
    def unsaid(self) -> tuple[str, ...]:
        """As of every mirror, and the form where there is none."""
        return super().unsaid + (("form", "form_radius_m") if self.form is None else ())

    @property
    def bound_m(self) -> float:
        """No point of the surface is farther from the vertex than this."""
        return math.hypot(self.profile.rim_radius_m, self.profile.depth_m) + self.reach_m

    def level(self, points_m: Array) -> Level:
        """Level of the surface: 0 on it, above 0 before it, at points (..., 3) in the mirror's frame."""
        return self.surface.level(points_m)

    def check_place(self, T_camera_mirror: Pose, camera: Camera) -> None:
        """Raise `SceneError` if the lens is inside the mirror or behind its rim."""
        lens, ahead_m = T_camera_mirror.inverse().t, T_camera_mirror.translation_m[2]
        if self.profile.holds(lens + [0.0, 0.0, self.reach_m]):
            raise SceneError(
                f"Rig.T_camera_sphere: the lens is inside the mirror, whose vertex is at {ahead_m:.4f} m in front of "
                "it; put the vertex farther away"
            )
        if ahead_m <= 0.0:
            raise SceneError(
                f"Rig.T_camera_sphere: the mirror's vertex is at {ahead_m:.4f} m in front of the lens; it must be "
                "above 0: put the vertex farther away"
            )
        if not lens[2] < self.profile.depth_m - self.reach_m:
            raise SceneError("Rig.T_camera_sphere: the lens is behind the mirror's rim; turn the mirror towards it")
        if self.shape == "cone":
            _check_cone(self.profile.rim_radius_m, T_camera_mirror.t, camera)

    def extent(self, axis: Array) -> Extent:
        """Reach around an axis: the rim, to which the profile rises, is what reaches farthest."""
        profile, turn = self.profile, np.linspace(0.0, 2.0 * np.pi, _AROUND, endpoint=False)
        flat = profile.rim_radius_m * np.stack([np.cos(turn), np.sin(turn)])
        rim = np.concatenate([flat, np.full((1, _AROUND), profile.depth_m)])
        along = axis @ rim
        wide_m = float(np.linalg.norm(rim - axis[:, None] * along, axis=0).max())
        return Extent(wide_m + self.reach_m, float(along.max()) + self.reach_m, profile.depth_m)

    def outline(self, T_camera_mirror: Pose, count: int) -> Array:
        """Points of the rim or of the limb before it, camera frame, shape (count, 3)."""
        turns = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
        return T_camera_mirror.points(rim_points(self.surface, T_camera_mirror.inverse().t, turns))

    def grid(self, rings: int, spokes: int) -> tuple[Array, Array]:
        """Points and unit normals, shape (rings, spokes, 3): rings lie closer towards the rim, which may be steep."""
        radii_m = self.profile.rim_radius_m * np.sin(np.linspace(0.5 * np.pi, 0.0, rings))
        return self.surface.grid(radii_m, np.linspace(0.0, 2.0 * np.pi, spokes, endpoint=False))

    def drawn_lines(self) -> list[Array]:
        """Rings and meridians."""
        rim, turn = self.profile.rim_radius_m, np.linspace(0.0, 2.0 * np.pi, 33)
        circle = np.stack([np.cos(turn), np.sin(turn)], axis=1)
        lines = [s * rim * circle for s in (0.25, 0.5, 0.75, 1.0)]
        lines += [np.linspace(-rim, rim, 17)[:, None] * circle[k] for k in (0, 4, 8, 12)]
        return [np.column_stack([flat, self.profile.heights(*flat.T).z_m]) for flat in lines]

    def deviated(self, radius_m: float, rim_radius_m: float, roughness_alpha: float, form: Form) -> Self:
        """Mirror with these added, `radius_m` to the vertex radius; a cone has none and stays as it is.

        A new form belongs to the disc of the nominal rim: where the mirror is cut does not change its surface.
        """
        profile, disc_m = self.profile, self.form_radius_m or self.profile.rim_radius_m
        if rim_radius_m:
            profile = replace(profile, rim_radius_m=profile.rim_radius_m + rim_radius_m)
        if radius_m and self.shape != "cone":
            profile = replace(profile, vertex_radius_m=profile.vertex_radius_m + radius_m)
        alpha, form = self.roughness_alpha + roughness_alpha, form_sum(self.form, form)
        return replace(self, profile=profile, roughness_alpha=alpha, form=form, form_radius_m=disc_m)


def _check_cone(rim_radius_m: float, tip: Array, camera: Camera) -> None:
    """Raise `SceneError` for a cone of which the image shows the tip alone.

    Nearer to the tip than the aperture's diameter a part of the lens sees no reflection.
    """
    u, v, aperture_m = camera.width_px - 0.5, camera.height_px - 0.5, camera.aperture_radius_m
    rays = camera.rays(np.array([[-0.5, -0.5], [u, -0.5], [-0.5, v], [u, v]]))
    shown_m = np.linalg.norm(rays[:, :2] / rays[:, 2:] * tip[2] - tip[:2], axis=1).max()
    seen_m = min(rim_radius_m, float(shown_m) if np.isfinite(shown_m) else math.inf)
    if seen_m <= 2.0 * aperture_m:
        raise SceneError(
            f"Profile.rim_radius_m = {rim_radius_m:g}: the tip of the cone is all that is seen, up to {seen_m:.2g} "
            f"m from the axis; more than {2.0 * aperture_m:.2g} m, the lens's aperture, is needed"
        )
