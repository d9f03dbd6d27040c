"""Rig of camera and mirror on a carriage, strokes and their positions, the `View` of one image, and the robot's pose.

`Rig` describes the down position; `Rig.at(offset_m)` gives the `View` that one image is taken from.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from phibench.scenes.camera import Camera
from phibench.scenes.frames import Array, Pose, Vector, as_matrix, as_vector, rotation_xyz
from phibench.scenes.glass_tube import GlassTube
from phibench.scenes.holder import Extent, Holder, holder_shapes, holder_tube
from phibench.scenes.mirror import SphereMirror
from phibench.scenes.misalignment import Misalignment, Motion
from phibench.scenes.revolved_mirror import RevolvedMirror
from phibench.scenes.shapes import Cuboid, Prism
from phibench.scenes.validation import SceneError, finite, positive, unit_vector

AnyMirror = SphereMirror | RevolvedMirror
"""Every kind of mirror that a rig's document may hold; code asks for a `Mirror`."""
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
    mirror : AnyMirror
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
    mirror: AnyMirror = field(default_factory=SphereMirror)
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
        self.mirror.check_place(self.T_camera_sphere, self.camera)
        if self.holder is not None:
            self.holder.check(self.extent, self.camera.aperture_radius_m)

    @property
    def sphere(self) -> SphereMirror:
        """The mirror, where it is a sphere.

        Raises
        ------
        SceneError
            If it is not: what asks holds for spheres alone.
        """
        if not isinstance(self.mirror, SphereMirror):
            raise SceneError(f"only spherical mirrors are computed here; the rig's is a {self.mirror.shape}")
        return self.mirror

    @property
    def revolved(self) -> RevolvedMirror:
        """The mirror, where it is one of revolution.

        Raises
        ------
        SceneError
            If it is not: what asks holds for mirrors with an axis and a rim.
        """
        if not isinstance(self.mirror, RevolvedMirror):
            raise SceneError(f"only mirrors of revolution are computed here; the rig's is a {self.mirror.shape}")
        return self.mirror

    @property
    def sphere_in_camera_m(self) -> Array:
        """Sphere centre in the camera frame, shape (3,), metres."""
        return self.T_camera_sphere.t

    @property
    def extent(self) -> Extent:
        """Reach of the mirror around a holder's axis: the line from the lens to the sphere centre or the vertex."""
        # camera frame; R^T turns it into the frame of the mirror
        towards = self.sphere_in_camera_m / np.linalg.norm(self.sphere_in_camera_m)
        return self.mirror.extent(self.T_camera_sphere.R.T @ towards)

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
        # the down image is the reference: what moves between the images acts on every other offset
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
        # a form error gives a sphere axes: those of the world, turned by the tilt of the mirror
        if mirror.has_axes and not self.mirror.has_axes:
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
        return self.camera.project(self.mirror.outline(self.T_camera_sphere, count))

    def in_image(self) -> bool:
        """Return True if the mirror's middle or any of its outline lies inside the image."""
        # the middle alone does for a mirror whose outline lies all around the image
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
        # in this order: stroke in the frame of the rig, the way of the robot, what moved between the images
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
        if self.rig.mirror.has_axes:
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
