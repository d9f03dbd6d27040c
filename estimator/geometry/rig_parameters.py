"""What an error of the rig's parameters does to D, with the pixels as they are.

The parameters mean what they mean in a recipe's `[rig]`: decentre and z_c move the sphere centre along world axes, a
tilt turns the camera about its lens while the sphere stays, `f_px` is fx and fy together.

The numbers of a rig that a calibration may change, their names, and what is known of them beforehand.

`stroke_m` is an offset of every stroke and `stroke_scale` its relative error:
h_true = (1 + stroke_scale) h + stroke_m.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from phibench.datasets.errors import DatasetError
from phibench.estimator.geometry.triangulate import depth_exact
from phibench.scenes.frames import Array, Pose, as_matrix, as_vector, rotation_xyz
from phibench.scenes.rig import Rig
from phibench.scenes.validation import nearest

Change = Callable[[Rig, float], Rig]


def _camera(rig: Rig, **added: float) -> Rig:
    camera = replace(rig.camera, **{name: getattr(rig.camera, name) + value for name, value in added.items()})
    return replace(rig, camera=camera)


def _sphere_moved(rig: Rig, axis: int, by_m: float) -> Rig:
    moved = rig.T_camera_sphere.t + rig.T_world_camera.R.T @ (by_m * np.eye(3)[axis])
    return replace(rig, T_camera_sphere=replace(rig.T_camera_sphere, translation_m=as_vector(moved)))


def _tilted(rig: Rig, x_rad: float, y_rad: float) -> Rig:
    old = rig.T_world_camera
    R = np.array(rotation_xyz(x_rad, y_rad)) @ old.R
    sphere = R.T @ old.directions(rig.T_camera_sphere.t)
    camera = Pose("world", "camera", old.translation_m, as_matrix(R))
    return replace(rig, T_world_camera=camera, T_camera_sphere=Pose("camera", "sphere", as_vector(sphere)))


def _stroke_tilted(rig: Rig, x_rad: float, y_rad: float) -> Rig:
    axis = np.array(rotation_xyz(x_rad, y_rad)) @ np.array(rig.stroke_axis_world)
    return replace(rig, stroke_axis_world=as_vector(axis))


_CHANGES: dict[str, tuple[Change, float]] = {  # and a step of about the size of a real error
    "z_c_m": (lambda rig, x: _sphere_moved(rig, 2, x), 2e-4),
    "radius_m": (lambda rig, x: replace(rig, mirror=replace(rig.mirror, radius_m=rig.mirror.radius_m + x)), 1e-4),
    "f_px": (lambda rig, x: _camera(rig, fx_px=x, fy_px=x), 2.0),
    "cx_px": (lambda rig, x: _camera(rig, cx_px=x), 0.5),
    "cy_px": (lambda rig, x: _camera(rig, cy_px=x), 0.5),
    "decentre_x_m": (lambda rig, x: _sphere_moved(rig, 0, x), 1e-4),
    "decentre_y_m": (lambda rig, x: _sphere_moved(rig, 1, x), 1e-4),
    "tilt_x_rad": (lambda rig, x: _tilted(rig, x, 0.0), 5e-4),
    "tilt_y_rad": (lambda rig, x: _tilted(rig, 0.0, x), 5e-4),
    "stroke_tilt_x_rad": (lambda rig, x: _stroke_tilted(rig, x, 0.0), 1e-3),
    "stroke_tilt_y_rad": (lambda rig, x: _stroke_tilted(rig, 0.0, x), 1e-3),
}
RIG_PARAMETERS = ("stroke_m", *_CHANGES)
"""Order of gradients and covariances."""
_STROKE_STEP_M = 1e-3


def changed_rig(rig: Rig, parameter: str, by: float) -> Rig:
    """Rig with one parameter of `RIG_PARAMETERS`, the stroke excepted, larger by `by`."""
    return _CHANGES[_known(parameter, tuple(_CHANGES))][0](rig, by)


def rig_covariance(sigmas: Mapping[str, float]) -> Array:
    """Covariance, shape (p, p), of independent errors; parameters that are not named are exact.

    Raises
    ------
    ValueError
        If a name is not one of `RIG_PARAMETERS`, or a sigma is below 0.
    """
    for name, sigma in sigmas.items():
        if not sigma >= 0.0:
            raise ValueError(f"sigma of {_known(name, RIG_PARAMETERS)} = {sigma:g}: must be 0 or above")
    known = {_known(name, RIG_PARAMETERS): sigma for name, sigma in sigmas.items()}
    return np.diag([known.get(name, 0.0) ** 2 for name in RIG_PARAMETERS])


def rig_gradient(rig: Rig, stroke_m: ArrayLike, uv_down_px: Array, uv_up_px: Array, step: float = 1.0) -> Array:
    """dD by each of `RIG_PARAMETERS`, shape (..., p), metres per unit of the parameter.

    Differences of the exact estimator by five-point stencils: the error of one is fourth order in the step. `step`
    multiplies all steps. NaN where D is.
    """
    h = np.asarray(stroke_m, float)

    def depth(parameter: str, by: float) -> Array:
        if parameter == "stroke_m":
            return depth_exact(rig, h + by, uv_down_px, uv_up_px).depth_m
        return depth_exact(changed_rig(rig, parameter, by), h, uv_down_px, uv_up_px).depth_m

    steps = {"stroke_m": _STROKE_STEP_M, **{name: size for name, (_, size) in _CHANGES.items()}}
    return np.stack([_slope(partial(depth, name), step * size) for name, size in steps.items()], axis=-1)


def _slope(f: Callable[[float], Array], step: float) -> Array:
    near, far = f(step) - f(-step), f(2.0 * step) - f(-2.0 * step)
    return (8.0 * near - far) / (12.0 * step)


def _known(name: str, names: tuple[str, ...]) -> str:
    if name not in names:
        raise ValueError(f"no rig parameter '{name}'; {nearest(name, names)}")
    return name


STROKE_SCALE = "stroke_scale"
PARAMETERS = (*RIG_PARAMETERS, STROKE_SCALE)
"""Order of values and covariances."""
STROKE_PARAMETERS = ("stroke_m", STROKE_SCALE)
_STEPS = {
    "stroke_m": 1e-3,
    "z_c_m": 2e-4,
    "radius_m": 1e-4,
    "f_px": 2.0,
    "cx_px": 0.5,
    "cy_px": 0.5,
    "decentre_x_m": 1e-4,
    "decentre_y_m": 1e-4,
    "tilt_x_rad": 5e-4,
    "tilt_y_rad": 5e-4,
    "stroke_tilt_x_rad": 1e-3,
    "stroke_tilt_y_rad": 1e-3,
    STROKE_SCALE: 1e-3,
}
# A rig put together with care and measured by hand.
PRIOR_SIGMA: Mapping[str, float] = {
    "stroke_m": 5e-4,
    "z_c_m": 2e-3,
    "radius_m": 2.5e-4,
    "f_px": 4.3,
    "cx_px": 5.0,
    "cy_px": 5.0,
    "decentre_x_m": 1e-3,
    "decentre_y_m": 1e-3,
    "tilt_x_rad": math.radians(0.5),
    "tilt_y_rad": math.radians(0.5),
    "stroke_tilt_x_rad": math.radians(0.2),
    "stroke_tilt_y_rad": math.radians(0.2),
    STROKE_SCALE: 5e-4,
}
"""Standard deviations of independent errors of a rig whose numbers were read off a drawing and a ruler."""


LIMITS: Mapping[str, float] = {
    "stroke_m": 1.0,
    "z_c_m": 0.1,
    "radius_m": 0.1,
    "f_px": 1000.0,
    "cx_px": 2000.0,
    "cy_px": 2000.0,
    "decentre_x_m": 0.1,
    "decentre_y_m": 0.1,
    "tilt_x_rad": 0.5,
    "tilt_y_rad": 0.5,
    "stroke_tilt_x_rad": 0.5,
    "stroke_tilt_y_rad": 0.5,
    STROKE_SCALE: 0.5,
}
"""Largest size of a correction: those of a recipe's `[misalignment]`."""


def steps() -> Array:
    """Steps for differences, shape (p,), about the size of a real error."""
    return np.array([_STEPS[name] for name in PARAMETERS])


def prior_sigmas(changes: Mapping[str, float] | None = None) -> Array:
    """Standard deviations beforehand, shape (p,), with changes by name; 0 holds a parameter.

    Raises
    ------
    DatasetError
        If a name is unknown or a value below 0.
    """
    sigmas = dict(PRIOR_SIGMA)
    for name, sigma in (changes or {}).items():
        if name not in sigmas:
            raise DatasetError(f"no rig parameter '{name}'; {nearest(name, PARAMETERS)}")
        if not (sigma >= 0.0 and math.isfinite(sigma)):
            raise DatasetError(f"sigma of {name} = {sigma:g}: must be 0 or above")
        sigmas[name] = sigma
    return np.array([sigmas[name] for name in PARAMETERS])


def changed(rig: Rig, values: Array) -> Rig:
    """Rig with every parameter larger by its value, shape (p,); the stroke's own are left to `stroke_of`."""
    for name, value in zip(PARAMETERS, values, strict=True):
        if value != 0.0 and name not in STROKE_PARAMETERS:
            rig = changed_rig(rig, name, float(value))
    return rig


def stroke_of(stroke_m: Array, values: Array) -> Array:
    """Strokes with scale and offset applied, shape of `stroke_m`, metres."""
    offset, scale = (values[PARAMETERS.index(name)] for name in STROKE_PARAMETERS)
    return np.asarray(stroke_m, float) * (1.0 + scale) + offset
