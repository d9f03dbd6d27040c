"""Rig: camera and mirror on one carriage that moves along the stroke axis.

`Rig` describes the down position; `Rig.at(offset_m)` gives the `View` that one image is taken from.

The mirror's outline is where lines of sight touch it. For a mirror with a form error, g(P) = 0 on the surface
(`mirror.level`), and a point P of the outline as seen from the eye E has grad g . (P - E) = 0. In the half-plane of the
eye, the centre and a direction across there is one such point, because the mirror is convex and holds the centre.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from phibench.scenes.camera import Camera
from phibench.scenes.frames import Array, Pose, Vector, as_matrix, as_vector, rotation_xyz
from phibench.scenes.glass_tube import GlassTube
from phibench.scenes.holder import Extent, Holder, holder_shapes, holder_tube
from phibench.scenes.mirror import Form, SphereMirror, deviation, level
from phibench.scenes.misalignment import Misalignment, Motion
from phibench.scenes.revolved_mirror import RevolvedMirror, rim_points
from phibench.scenes.shapes import Cuboid, Prism
from phibench.scenes.validation import SceneError, finite, positive, unit_vector

_AROUND = 360  # places of the rim
_STEPS = 8  # Newton's method starts within the form's slopes, some 1e-3 rad
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
    for _ in range(_STEPS):
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


Mirror = SphereMirror | RevolvedMirror
POSITIONS = ("down", "up")  # stroke positions 1 and 2 of the paper


@dataclass(frozen=True)
class Stroke:
    """A stroke (baseline) of `stroke_m` metres: position 1 is down at 0, position 2 is up at h."""

    stroke_m: float

    def __post_init__(self) -> None:
        positive("Stroke", "stroke_m", self.stroke_m)

    def offset_m(self, position: str) -> float:
        """Carriage offset along the stroke axis, metres, for "down" or "up"."""
        return {"down": 0.0, "up": self.stroke_m}[position]


@dataclass(frozen=True)
class Rig:
    """Camera, mirror and how they are mounted; the carriage is at the down position.

    Parameters
    ----------
    camera : Camera
        Intrinsics, lens and detector.
    mirror : Mirror
        Shape and metal.
    T_world_camera : Pose
        Camera pose at the down position.
    T_camera_sphere : Pose
        Mirror pose in the camera frame; aligned optics have the translation (0, 0, z_c). Its rotation says how a form
        error and a mirror's axis lie, and means nothing for a perfect sphere.
    stroke_axis_world : 3 floats
        Direction of the stroke, made a unit vector.
    motion : Motion or None
        What else moves the rig between the two images: it holds at every carriage position but down.
    holder : Holder or None
        What carries the mirror; None is nothing that is seen.
    """

    camera: Camera = field(default_factory=Camera)
    mirror: Mirror = field(default_factory=SphereMirror)
    T_world_camera: Pose = Pose("world", "camera", (0.0, 0.0, 0.45))
    T_camera_sphere: Pose = Pose("camera", "sphere", (0.0, 0.0, 0.26))
    stroke_axis_world: Vector = (0.0, 0.0, 1.0)
    motion: Motion | None = None
    holder: Holder | None = None

    def __post_init__(self) -> None:
        axis = unit_vector("Rig", "stroke_axis_world", self.stroke_axis_world)
        object.__setattr__(self, "stroke_axis_world", axis)
        for name, frames in (("T_world_camera", ("world", "camera")), ("T_camera_sphere", ("camera", "sphere"))):
            pose = getattr(self, name)
            if (pose.target, pose.source) != frames:
                raise SceneError(f"Rig.{name} joins frames {pose.target}, {pose.source}: must be {frames}")
        for nm in self.camera.detector.band_wavelength_nm if self.mirror.reflectance_table else ():
            self.mirror.band(nm)
        if isinstance(self.mirror, RevolvedMirror):
            self._check_revolved(self.mirror)
            self._check_holder()
            return
        distance, radius = math.hypot(*self.T_camera_sphere.translation_m), self.mirror.bound_m
        if self.T_camera_sphere.translation_m[2] <= radius or distance <= radius:
            raise SceneError(
                f"Rig.T_camera_sphere: the sphere centre is {self.T_camera_sphere.translation_m[2]:.4f} m in front of "
                f"the camera; it must be more than the mirror radius {radius:.4f} m"
            )
        self._check_holder()

    def _check_holder(self) -> None:
        if self.holder is not None:
            self.holder.check(self.extent, self.camera.aperture_radius_m)

    def _check_revolved(self, mirror: RevolvedMirror) -> None:
        """Raise `SceneError` if the lens is inside the mirror or behind its rim."""
        lens = self.T_camera_sphere.inverse().t
        ahead_m = self.T_camera_sphere.translation_m[2]
        if mirror.profile.holds(lens + [0.0, 0.0, mirror.reach_m]):
            raise SceneError(
                f"Rig.T_camera_sphere: the lens is inside the mirror, whose vertex is at {ahead_m:.4f} m in front of "
                "it; put the vertex farther away"
            )
        if ahead_m <= 0.0:
            raise SceneError(
                f"Rig.T_camera_sphere: the mirror's vertex is at {ahead_m:.4f} m in front of the lens; it must be "
                "above 0: put the vertex farther away"
            )
        if not lens[2] < mirror.profile.depth_m - mirror.reach_m:
            raise SceneError("Rig.T_camera_sphere: the lens is behind the mirror's rim; turn the mirror towards it")
        if mirror.profile.shape == "cone":
            self._check_cone(mirror.profile.rim_radius_m)

    def _check_cone(self, rim_radius_m: float) -> None:
        """Raise `SceneError` for a cone of which the image shows the tip alone.

        Nearer to the tip than the aperture's diameter a part of the lens sees no reflection.
        """
        camera, aperture_m = self.camera, self.camera.aperture_radius_m
        u, v = camera.width_px - 0.5, camera.height_px - 0.5
        rays = camera.rays(np.array([[-0.5, -0.5], [u, -0.5], [-0.5, v], [u, v]]))
        tip = self.T_camera_sphere.t
        shown_m = np.linalg.norm(rays[:, :2] / rays[:, 2:] * tip[2] - tip[:2], axis=1).max()
        seen_m = min(rim_radius_m, float(shown_m) if np.isfinite(shown_m) else math.inf)
        if seen_m <= 2.0 * aperture_m:
            raise SceneError(
                f"Profile.rim_radius_m = {rim_radius_m:g}: the tip of the cone is all that is seen, up to {seen_m:.2g} "
                f"m from the axis; more than {2.0 * aperture_m:.2g} m, the lens's aperture, is needed"
            )

    @property
    def sphere(self) -> SphereMirror:
        """The mirror, where it is a sphere.

        Raises
        ------
        SceneError
            If it is not: what asks holds for spheres alone.
        """
        if isinstance(self.mirror, RevolvedMirror):
            raise SceneError(f"only spherical mirrors are computed here; the rig's is a {self.mirror.profile.shape}")
        return self.mirror

    @property
    def sphere_in_camera_m(self) -> Array:
        """Sphere centre in the camera frame, shape (3,), metres."""
        return self.T_camera_sphere.t

    @property
    def extent(self) -> Extent:
        """Reach of the mirror around the axis of a holder, the line from the lens to the sphere centre or the vertex.

        Of a mirror of revolution, whose profile rises to the rim, the rim is what reaches farthest.
        """
        if isinstance(self.mirror, SphereMirror):
            return Extent(self.mirror.bound_m, self.mirror.bound_m, self.mirror.radius_m)
        profile, turn = self.mirror.profile, np.linspace(0.0, 2.0 * np.pi, _AROUND, endpoint=False)
        flat = profile.rim_radius_m * np.stack([np.cos(turn), np.sin(turn)])
        rim = np.concatenate([flat, np.full((1, _AROUND), profile.depth_m)])
        axis = self.T_camera_sphere.R.T @ (self.sphere_in_camera_m / np.linalg.norm(self.sphere_in_camera_m))
        along = axis @ rim
        wide_m = float(np.linalg.norm(rim - axis[:, None] * along, axis=0).max())
        return Extent(wide_m + self.mirror.reach_m, float(along.max()) + self.mirror.reach_m, profile.depth_m)

    @property
    def top_m(self) -> float:
        """Height of the rig's highest part above the sphere centre: the mirror's top, or its holder's."""
        return max(self.mirror.bound_m, 0.0 if self.holder is None else self.holder.top_m)

    @property
    def top_part(self) -> str:
        """Name of the rig's highest part: "mirror" or "holder"."""
        return "mirror" if self.holder is None else "holder"

    def at(self, offset_m: float) -> View:
        """Return the rig with its carriage moved by `offset_m` along the stroke axis."""
        finite("Rig", "offset_m", offset_m)
        return View(self, float(offset_m), None if offset_m == 0.0 else self.motion)

    def perturbed(self, misalignment: Misalignment) -> Rig:
        """Return the true rig where this is the nominal one.

        The true stroke is `misalignment.stroke_m(nominal)`: strokes are no part of a rig. A perfect sphere that gets a
        form gets its axes as well: the world's, at the down position.

        Raises
        ------
        SceneError
            If the true rig cannot exist.
        """
        if misalignment == Misalignment():
            return self
        T_world_camera, T_camera_sphere = misalignment.poses(self.T_world_camera, self.T_camera_sphere)
        mirror = misalignment.mirror(self.mirror)
        is_new = isinstance(mirror, SphereMirror) and mirror.form is not None and self.sphere.form is None
        if is_new:
            axes = rotation_xyz(misalignment.mirror_tilt_x_rad, misalignment.mirror_tilt_y_rad)
            T_camera_sphere = replace(T_camera_sphere, rotation=as_matrix(T_world_camera.R.T @ np.array(axes)))
        return Rig(
            camera=misalignment.camera(self.camera),
            mirror=mirror,
            T_world_camera=T_world_camera,
            T_camera_sphere=T_camera_sphere,
            stroke_axis_world=misalignment.stroke_axis(self.stroke_axis_world),
            motion=misalignment.motion(self.motion),
            holder=self.holder,
        )

    def outline_px(self, count: int = 720) -> Array:
        """Image of the mirror's outline (its occluding contour), shape (count, 2), pixels."""
        if isinstance(self.mirror, RevolvedMirror):
            turns = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
            rim_m = rim_points(self.mirror.surface, self.T_camera_sphere.inverse().t, turns)
            return self.camera.project(self.T_camera_sphere.points(rim_m))
        s = self.sphere_in_camera_m
        distance = float(np.linalg.norm(s))
        axis = s / distance
        side = np.cross(axis, [0.0, 1.0, 0.0] if abs(axis[1]) < 0.9 else [1.0, 0.0, 0.0])  # never near the axis
        side /= np.linalg.norm(side)
        turn = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)[:, None]
        rim = np.cos(turn) * side + np.sin(turn) * np.cross(axis, side)
        if self.sphere.form is not None:
            turned = self.T_camera_sphere.R
            limb = limb_points(-s @ turned, rim @ turned, self.sphere.radius_m, self.sphere.form)
            return self.camera.project(self.T_camera_sphere.points(limb))
        sine = self.sphere.radius_m / distance
        return self.camera.project(math.sqrt(1.0 - sine * sine) * axis + sine * rim)

    def in_image(self) -> bool:
        """Return True if the mirror's middle or any of its outline lies inside the image."""
        places = np.vstack([self.camera.project(self.sphere_in_camera_m), self.outline_px(24)])
        return bool(np.any(self.camera.contains(places)))

    def fits_image(self) -> bool:
        """Return True if the whole outline of the mirror lies inside the image."""
        return bool(np.all(self.camera.contains(self.outline_px())))


@dataclass(frozen=True)
class RobotPose:
    """Place of a robot that has driven, and its flippers.

    Parameters
    ----------
    T_world_rig : Pose
        Of the frame in which rig and robot are written: the world's before the robot drives.
    flipper_rad : float
        Angle of the flippers; 0 is ahead, up counts.
    """

    T_world_rig: Pose
    flipper_rad: float


@dataclass(frozen=True)
class View:
    """A rig with its carriage at one offset, and moved where it is not down: what one image is taken from.

    `robot` says where the robot has driven to; None is where it starts. `motion` comes after it.
    """

    rig: Rig
    offset_m: float
    motion: Motion | None = None
    robot: RobotPose | None = None

    @cached_property
    def T_world_camera(self) -> Pose:
        """Camera pose in the world."""
        shift = self.offset_m * np.array(self.rig.stroke_axis_world)
        carried = replace(self.rig.T_world_camera, translation_m=as_vector(self.rig.T_world_camera.t + shift))
        if self.robot is not None:
            carried = self.robot.T_world_rig @ replace(carried, target="rig")
        return carried if self.motion is None else self.motion.moved(carried)

    @cached_property
    def T_world_sphere(self) -> Pose:
        """Mirror pose in the world."""
        return self.T_world_camera @ self.rig.T_camera_sphere

    @cached_property
    def form_axes(self) -> Array:
        """Axes of the mirror's form as columns, world, shape (3, 3); where there is none, those that one would get."""
        mirror = self.rig.mirror
        if isinstance(mirror, RevolvedMirror) or mirror.form is not None:
            return self.T_world_sphere.R
        driven = np.eye(3) if self.robot is None else self.robot.T_world_rig.R
        return driven if self.motion is None else np.array(self.motion.rotation) @ driven

    @cached_property
    def holder_shapes(self) -> tuple[Prism | Cuboid, ...]:
        """Shapes of the mirror's holder, in the world."""
        rig = self.rig
        if rig.holder is None:
            return ()
        return holder_shapes(rig.holder, self.T_world_camera, self.sphere_centre_m, rig.extent.back_m)

    @cached_property
    def tube(self) -> GlassTube | None:
        """Wall of glass around the mirror, in the world; None where the holder is no tube."""
        rig = self.rig
        if rig.holder is None or rig.holder.kind != "tube":
            return None
        return holder_tube(rig.holder, self.T_world_camera, self.sphere_centre_m)

    @property
    def camera_centre_m(self) -> Array:
        """Lens centre in the world, shape (3,), metres."""
        return self.T_world_camera.t

    @property
    def sphere_centre_m(self) -> Array:
        """Sphere centre in the world, shape (3,), metres."""
        return self.T_world_sphere.t
