"""Places that both images of a pair show, clear of outline and robot, and the floor's nearest one."""

from __future__ import annotations

import numpy as np

from phibench.estimator.geometry.line_of_sight import unhidden_places
from phibench.estimator.geometry.reflection import MirrorImage, image_of
from phibench.estimator.geometry.status import Status
from phibench.estimator.limits.stroke_curve import outline_distance_px
from phibench.scenes.frames import Array, BoolArray
from phibench.scenes.rig import Rig

_FLOOR_M, _FLOOR_STEP_M = 0.1, 0.02  # nearest place of the floor that is tried, and from one to the next
_CHUNK = 500  # points whose distances from all sides of the outline are taken at once


def measured_places(rig: Rig, points_m: Array, stroke_m: float, edge_px: float, azimuths_rad: Array) -> BoolArray:
    """Places that both images of a pair show, from every one of the azimuths, shape (n,).

    Parameters
    ----------
    rig : Rig, aligned
    points_m : shape (n, 3), in the upright plane through world x
    edge_px : float
        Least distance from the outline of the mirror and from the edge of the image.
    azimuths_rad : shape (a,)
        The places are turned about the mirror's axis; what the robot hides differs between them.
    """
    turned = [points_m @ _about_z(a).T for a in azimuths_rad]
    fine = [shown_places(rig, points_m, offset, edge_px) for offset in (0.0, stroke_m)]
    free = [unhidden_places(rig, points, offset) for points in turned for offset in (0.0, stroke_m)]
    return np.asarray(np.all([*fine, *free], axis=0))


def shown_places(rig: Rig, points_m: Array, offset_m: float, edge_px: float) -> BoolArray:
    """Places whose image lies inside the mirror's and the camera's, shape (n,); the robot is not asked."""
    parts = np.array_split(points_m, max(len(points_m) // _CHUNK, 1))
    return np.concatenate([_shown(rig, points, offset_m, edge_px) for points in parts])


def _shown(rig: Rig, points_m: Array, offset_m: float, edge_px: float) -> BoolArray:
    image = raised_image(rig, points_m, offset_m)
    seen = np.asarray(image.status == Status.OK)
    uv = np.where(seen[:, None], image.uv_px, rig.camera.project(rig.sphere_in_camera_m))
    inside = rig.camera.contains(uv - edge_px) & rig.camera.contains(uv + edge_px)
    return np.asarray(seen & inside & (outline_distance_px(rig, uv) >= edge_px))


def raised_image(rig: Rig, points_m: Array, offset_m: float) -> MirrorImage:
    """Image of places by a raised rig: that of lowered places by the rig where it is."""
    return image_of(rig.at(0.0), points_m - offset_m * np.array(rig.stroke_axis_world))


def _about_z(angle_rad: float) -> Array:
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def floor_from_m(rig: Rig, stroke_m: float, edge_px: float, azimuth_rad: float, last_m: float) -> float:
    """Least distance from which on every spot on the floor is measured up to the last, NaN where the last is not."""
    D = np.arange(_FLOOR_M, last_m + 0.5 * _FLOOR_STEP_M, _FLOOR_STEP_M)
    points = np.stack([D, np.zeros_like(D), np.zeros_like(D)], axis=-1)
    missing = np.flatnonzero(~measured_places(rig, points, stroke_m, edge_px, np.array([azimuth_rad])))
    first = missing[-1] + 1 if missing.size else 0
    return float(D[first]) if first < len(D) else float("nan")
