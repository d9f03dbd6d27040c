"""Misalignment of a rig: deviations with unit and range, applied to its nominal parts; its motion between two images.

`Misalignment` holds one number for every `RigParameter` of `PARAMETERS`; all are 0 by default. Recipes, calibrations,
sensitivities and studies use these names. `Motion` is what moves the whole rig between the two images of a pair.

Conventions: world axes (z up; the robot's front is world +x); angles turn right-handed. The form's x, y, z are the
world's at the down position, about the sphere centre; from there the form goes with the rig. That of a mirror of
revolution lies in its own frame, and its harmonics are polynomials on the rim's disc (`scenes.revolved_profile`). Of
several deviations at once: the sphere moves first, then the camera turns about its lens and leaves sphere and lens
where they are. A recipe's `decentre`, `tilt` and `stroke_tilt` in `[rig]` mean the same as here. A mirror of revolution
moves with its vertex, and turns about it: its tilt is its own, besides that of the camera.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace
from typing import Any, Protocol, Self, TypeVar

import numpy as np

from phibench.scenes.camera import Camera
from phibench.scenes.form_error import HARMONICS, Form
from phibench.scenes.frames import IDENTITY, Array, Matrix, Pose, Vector, as_matrix, as_vector, rotation_xyz
from phibench.scenes.mirror import Mirror
from phibench.scenes.validation import SceneError, within


@dataclass(frozen=True)
class Motion:
    """Turn about the lens centre, then shift, in world axes; camera and mirror go together.

    Parameters
    ----------
    translation_m : 3 floats
        Shift of the lens centre.
    rotation : 3 x 3 nested tuple, proper orthogonal to 1e-9
        Turn about the lens centre, where the carriage has brought it.
    """

    translation_m: Vector = (0.0, 0.0, 0.0)
    rotation: Matrix = IDENTITY

    def __post_init__(self) -> None:
        checked = Pose("world", "world", self.translation_m, self.rotation)
        object.__setattr__(self, "translation_m", checked.translation_m)
        object.__setattr__(self, "rotation", checked.rotation)

    def moved(self, T_world_camera: Pose) -> Pose:
        """Camera pose after the motion."""
        return replace(
            T_world_camera,
            translation_m=as_vector(T_world_camera.t + np.array(self.translation_m)),
            rotation=as_matrix(np.array(self.rotation) @ T_world_camera.R),
        )

    def part(self, share: float) -> Motion | None:
        """Motion of which a share has happened: shift and angle of turn in proportion; None for 0."""
        if share in (0.0, 1.0):
            return self if share else None
        shift = share * np.array(self.translation_m)
        return Motion(as_vector(shift), as_matrix(self.turns(np.array([share]))[0]))

    def turns(self, shares: Array) -> Array:
        """Rotation matrices of shares of the turn, shape (N, 3, 3), for shares of the shape (N,)."""
        R = np.array(self.rotation)
        axis = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])  # 2 sin(angle) times the axis
        size = float(np.linalg.norm(axis))
        if size == 0.0:
            return np.broadcast_to(np.eye(3), (len(shares), 3, 3))
        x, y, z = axis / size
        K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        angle = np.asarray(shares, float)[:, None, None] * math.atan2(size, float(np.trace(R)) - 1.0)
        return np.asarray(np.eye(3) + np.sin(angle) * K + 2.0 * np.sin(0.5 * angle) ** 2 * (K @ K))

    def then(self, other: Motion) -> Motion:
        """Both motions, `other` last; both turn about the lens centre, so that shifts add."""
        shift = np.array(self.translation_m) + np.array(other.translation_m)
        return Motion(as_vector(shift), as_matrix(np.array(other.rotation) @ np.array(self.rotation)))


class _Perturbed(Protocol):
    """A `Rig`, which imports this module."""

    def perturbed(self, misalignment: Misalignment) -> Self: ...


_Rig = TypeVar("_Rig", bound=_Perturbed)
_Mirror = TypeVar("_Mirror", bound=Mirror)
_FOCAL_PX = 1430.0  # of the C310, for which a focal length's step and prior were set in pixels


@dataclass(frozen=True)
class RigParameter:
    """One deviation of a rig.

    Attributes
    ----------
    name : str
        As in a recipe's `[misalignment]`.
    unit : str
        "m", "rad", "px" or "1".
    limit : float
        Largest allowed magnitude.
    study : float
        Magnitude that a study takes unless told otherwise: what is left after careful mounting.
    meaning : str
        What it is, in words.
    step : float
        For differences, about the size of a real error; NaN for a parameter that no calibration fits.
    prior_sigma : float
        Standard deviation for a rig whose numbers were read off a drawing and a ruler; NaN as for `step`.
    """

    name: str
    unit: str
    limit: float
    study: float
    meaning: str
    step: float = math.nan
    prior_sigma: float = math.nan

    def apply(self, rig: _Rig, by: float) -> _Rig:
        """Rig with this parameter larger by `by`; strokes are no part of a rig, see `Misalignment.stroke_m`."""
        return rig.perturbed(Misalignment(**{self.name: by}))


def _number(
    unit: str, limit: float, study: float, meaning: str, *, step: float = math.nan, sigma: float = math.nan
) -> Any:
    """Field of one parameter: all of its `RigParameter` but the name."""
    entry = {"unit": unit, "limit": limit, "study": study, "meaning": meaning, "step": step, "prior_sigma": sigma}
    return field(default=0.0, metadata=entry)


@dataclass(frozen=True)
class Misalignment:
    """Deviations of the true rig from the nominal one; `PARAMETERS` has unit, range and meaning of each.

    Raises
    ------
    SceneError
        If a number is beyond its range.
    """

    decentre_x_m: float = _number(
        "m", 0.1, 1e-3, "sphere centre moved along world +x, at the down position", step=1e-4, sigma=1e-3
    )
    decentre_y_m: float = _number(
        "m", 0.1, 1e-3, "sphere centre moved along world +y, at the down position", step=1e-4, sigma=1e-3
    )
    axial_m: float = _number(
        "m", 0.1, 1e-3, "sphere centre moved along world +z, away from the lens", step=2e-4, sigma=2e-3
    )
    tilt_x_rad: float = _number(
        "rad",
        0.5,
        8.7e-3,
        "camera turned about world x through its lens; the sphere stays",
        step=5e-4,
        sigma=math.radians(0.5),
    )
    tilt_y_rad: float = _number(
        "rad",
        0.5,
        8.7e-3,
        "camera turned about world y through its lens; the sphere stays",
        step=5e-4,
        sigma=math.radians(0.5),
    )
    radius_m: float = _number("m", 0.1, 6e-4, "added to the mirror's radius", step=1e-4, sigma=2.5e-4)
    focal_relative: float = _number(
        "1",
        0.5,
        0.01,
        "added to fx and fy, relative to them; the aperture follows fx",
        step=2.0 / _FOCAL_PX,
        sigma=4.3 / _FOCAL_PX,
    )
    cx_px: float = _number("px", 2000.0, 15.0, "added to the principal point u", step=0.5, sigma=5.0)
    cy_px: float = _number("px", 2000.0, 15.0, "added to the principal point v", step=0.5, sigma=5.0)
    k1: float = _number("1", 1000.0, 0.03, "added to the radial distortion k1")
    k2: float = _number("1", 1000.0, 0.3, "added to the radial distortion k2")
    k3: float = _number("1", 1000.0, 1.0, "added to the radial distortion k3")
    p1: float = _number("1", 1000.0, 1e-3, "added to the tangential distortion p1")
    p2: float = _number("1", 1000.0, 1e-3, "added to the tangential distortion p2")
    focus_distance_m: float = _number("m", 100.0, 0.05, "added to the distance of the plane of focus")
    stroke_relative: float = _number(
        "1", 0.5, 2e-3, "true stroke is (1 + this) x nominal stroke + stroke_offset_m", step=1e-3, sigma=5e-4
    )
    stroke_offset_m: float = _number("m", 1.0, 1e-3, "added to the stroke", step=1e-3, sigma=5e-4)
    stroke_tilt_x_rad: float = _number(
        "rad", 0.5, 8.7e-3, "stroke axis turned about world x", step=1e-3, sigma=math.radians(0.2)
    )
    stroke_tilt_y_rad: float = _number(
        "rad", 0.5, 8.7e-3, "stroke axis turned about world y, after x", step=1e-3, sigma=math.radians(0.2)
    )
    roll_rad: float = _number("rad", 0.5, 1.7e-3, "rig turned about world x between the images, left side up")
    pitch_rad: float = _number("rad", 0.5, 1.7e-3, "rig turned about world y between the images, front down")
    yaw_rad: float = _number("rad", 0.5, 1.7e-3, "rig turned about world z between the images, front to the left")
    shift_x_m: float = _number("m", 1.0, 1e-3, "rig moved along world +x between the images")
    shift_y_m: float = _number("m", 1.0, 1e-3, "rig moved along world +y between the images")
    shift_z_m: float = _number("m", 1.0, 1e-3, "rig moved along world +z between the images")
    roughness_alpha: float = _number("1", 0.05, 2e-3, "added to the mirror's Beckmann roughness")
    form_20_m: float = _number("m", 1e-3, 2e-5, "form: peak of (3 z^2 - 1)/2, added to the mirror's radius")
    form_21c_m: float = _number("m", 1e-3, 2e-5, "form: peak of 2 x z")
    form_21s_m: float = _number("m", 1e-3, 2e-5, "form: peak of 2 y z")
    form_22c_m: float = _number("m", 1e-3, 2e-5, "form: peak of x^2 - y^2")
    form_22s_m: float = _number("m", 1e-3, 2e-5, "form: peak of 2 x y")
    form_30_m: float = _number("m", 1e-3, 2e-5, "form: peak of (5 z^3 - 3 z)/2")
    form_31c_m: float = _number("m", 1e-3, 2e-5, "form: peak of 0.726 x (5 z^2 - 1)")
    form_31s_m: float = _number("m", 1e-3, 2e-5, "form: peak of 0.726 y (5 z^2 - 1)")
    form_32c_m: float = _number("m", 1e-3, 2e-5, "form: peak of 2.598 z (x^2 - y^2)")
    form_32s_m: float = _number("m", 1e-3, 2e-5, "form: peak of 5.196 x y z")
    form_33c_m: float = _number("m", 1e-3, 2e-5, "form: peak of x^3 - 3 x y^2")
    form_33s_m: float = _number("m", 1e-3, 2e-5, "form: peak of 3 x^2 y - y^3")
    mirror_tilt_x_rad: float = _number(
        "rad",
        0.5,
        8.7e-3,
        "mirror of revolution turned about world x through its vertex",
        step=5e-4,
        sigma=math.radians(0.5),
    )
    mirror_tilt_y_rad: float = _number(
        "rad",
        0.5,
        8.7e-3,
        "mirror of revolution turned about world y through its vertex",
        step=5e-4,
        sigma=math.radians(0.5),
    )
    rim_radius_m: float = _number(
        "m", 0.1, 1e-4, "added to the rim's radius of a mirror of revolution", step=5e-5, sigma=5e-5
    )

    def __post_init__(self) -> None:
        for name, parameter in PARAMETERS.items():
            object.__setattr__(self, name, float(getattr(self, name)))
            within("Misalignment", name, getattr(self, name), -parameter.limit, parameter.limit)

    def camera(self, nominal: Camera) -> Camera:
        """True camera."""
        scale = 1.0 + self.focal_relative
        added = {name: getattr(nominal, name) + getattr(self, name) for name in _ADDED_TO_CAMERA}
        return replace(nominal, fx_px=nominal.fx_px * scale, fy_px=nominal.fy_px * scale, **added)

    def mirror(self, nominal: _Mirror) -> _Mirror:
        """True mirror; forms add up in the mirror's own frame."""
        form = Form(**{name: getattr(self, name) for name in HARMONICS})
        return nominal.deviated(self.radius_m, self.rim_radius_m, self.roughness_alpha, form)

    def poses(self, T_world_camera: Pose, T_camera_sphere: Pose) -> tuple[Pose, Pose]:
        """True camera pose in the world and sphere pose in the camera, both down."""
        moved_m = (self.decentre_x_m, self.decentre_y_m, self.axial_m)
        tilt = (self.mirror_tilt_x_rad, self.mirror_tilt_y_rad)
        if not any((*moved_m, self.tilt_x_rad, self.tilt_y_rad, *tilt)):
            return T_world_camera, T_camera_sphere
        R = np.array(rotation_xyz(self.tilt_x_rad, self.tilt_y_rad)) @ T_world_camera.R
        sphere = T_world_camera.directions(T_camera_sphere.t) + moved_m  # from the lens, world axes
        own = R.T @ np.array(rotation_xyz(*tilt)) if any(tilt) else R.T
        turned = own @ T_world_camera.R @ T_camera_sphere.R
        return (
            replace(T_world_camera, rotation=as_matrix(R)),
            replace(T_camera_sphere, translation_m=as_vector(R.T @ sphere), rotation=as_matrix(turned)),
        )

    def stroke_axis(self, nominal: Vector) -> Vector:
        """True direction of the stroke, world."""
        if not any((self.stroke_tilt_x_rad, self.stroke_tilt_y_rad)):
            return nominal
        return as_vector(np.array(rotation_xyz(self.stroke_tilt_x_rad, self.stroke_tilt_y_rad)) @ np.array(nominal))

    def motion(self, nominal: Motion | None) -> Motion | None:
        """Motion between the images: Rz(yaw) Ry(pitch) Rx(roll) about the lens centre when up, then the shift."""
        turn, shift_m = (self.roll_rad, self.pitch_rad, self.yaw_rad), (self.shift_x_m, self.shift_y_m, self.shift_z_m)
        if not any((*turn, *shift_m)):
            return nominal
        added = Motion(shift_m, rotation_xyz(*turn))
        return added if nominal is None else nominal.then(added)

    def stroke_m(self, nominal_stroke_m: float) -> float:
        """True stroke.

        Raises
        ------
        SceneError
            If it is not above 0.
        """
        true_m = (1.0 + self.stroke_relative) * nominal_stroke_m + self.stroke_offset_m
        if not true_m > 0.0:
            raise SceneError(
                f"Misalignment: stroke_relative = {self.stroke_relative:g} and stroke_offset_m = "
                f"{self.stroke_offset_m:g} make the stroke {nominal_stroke_m:g} m {true_m:g} m; it must stay above 0"
            )
        return true_m


PARAMETERS = {entry.name: RigParameter(entry.name, **entry.metadata) for entry in fields(Misalignment)}
"""All parameters of `Misalignment` by name, in order."""

_ADDED_TO_CAMERA = ("cx_px", "cy_px", "k1", "k2", "k3", "p1", "p2", "focus_distance_m")
