"""What outline and upright edges of a true rig look like to who believes another camera and radius."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from phibench.estimator.calibration.vertical_edges import vertical_of
from phibench.estimator.mirror_image import image_of
from phibench.scenes.frames import Array, as_vector
from phibench.scenes.rig import Rig

_STEP_PX = 2.0
_EDGES, _POINTS = 12, 8
_DISTANCE_M = 2.5
_ELEVATIONS_RAD = (-0.35, 0.5)  # walls of a room


def apparent_centre(believed: Rig, true: Rig) -> Array:
    """Sphere centre, camera frame, shape (3,), that the true rig's outline gives with the believed camera and radius.

    The true outline's pixels, as the believed camera sees them, are a cone: its axis and its opening give the centre.
    """
    uv = true.outline_px(90)
    rays = believed.camera.rays(uv)
    x = np.linalg.lstsq(rays, np.ones(len(rays)), rcond=None)[0]  # n / cos a0
    cosine = 1.0 / np.linalg.norm(x)
    return np.asarray(x * cosine * believed.mirror.radius_m / np.sqrt((1.0 - cosine) * (1.0 + cosine)))


def apparent_vertical(believed: Rig, true: Rig) -> Array:
    """The vertical, x and y in the camera frame, that upright edges all around the true rig give with the believed one.

    The sphere is where the outline puts it, as `find_vertical` wants it.
    """
    pose = replace(believed.T_camera_sphere, translation_m=as_vector(apparent_centre(believed, true)))
    edges = [image_of(true.at(0.0), line).uv_px for line in _lines(true)]
    return np.asarray(vertical_of(edges, replace(believed, T_camera_sphere=pose)).up[:2])


def vertical_by_principal_point(believed: Rig) -> Array:
    """Derivative of the apparent vertical by the true principal point, shape (2, 2), rad/px.

    Tilt, focal length, radius and distance leave the apparent vertical at the true one, a decentre of 1 mm turns it by
    some 5e-6 rad: only the principal point matters.
    """
    columns = []
    for name in ("cx_px", "cy_px"):
        both = []
        for step in (_STEP_PX, -_STEP_PX):
            camera = replace(believed.camera, **{name: getattr(believed.camera, name) + step})
            both.append(apparent_vertical(believed, replace(believed, camera=camera)))
        columns.append((both[0] - both[1]) / (2.0 * _STEP_PX))
    return np.stack(columns, axis=-1)


def _lines(rig: Rig) -> Array:
    """Points on upright lines about the sphere, shape (edges, points, 3), world."""
    azimuth = 2.0 * np.pi * np.arange(_EDGES)[:, None] / _EDGES
    height = _DISTANCE_M * np.tan(np.linspace(*_ELEVATIONS_RAD, _POINTS)) + 0.0 * azimuth
    flat = [_DISTANCE_M * f(azimuth) + 0.0 * height for f in (np.cos, np.sin)]
    return np.asarray(np.stack([*flat, height], axis=-1) + rig.at(0.0).sphere_centre_m)
