"""Errors of D of many misaligned rigs at once, for studies that draw thousands: numbers of rigs as arrays.

The chief rays come from the simulator's solution of Alhazen's problem, scaled to a sphere of radius 1, so that this is
also a check of `misaligned.errors`, which takes the estimator's. Spherical mirrors only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from phibench.estimator.score import ESTIMATORS
from phibench.estimator.studies.misaligned import Places
from phibench.render.alhazen import reflection_points
from phibench.scenes.frames import Array
from phibench.scenes.misalignment import Misalignment
from phibench.scenes.rig import Rig, View

_BROWN = ("k1", "k2", "k3", "p1", "p2")
_LENS = ("fx_px", "fy_px", "cx_px", "cy_px")


@dataclass(frozen=True)
class _Views:
    """Views of m rigs: lens and sphere centres (m, 3), camera axes (m, 3, 3), radii (m,), camera numbers (m, 9)."""

    lens_m: Array
    sphere_m: Array
    axes: Array
    radius_m: Array
    numbers: Array


def errors_of_many(nominal: Rig, drawn: Sequence[Misalignment], places: Places, names: tuple[str, ...]) -> Array:
    """Relative errors of D, shape (m, estimators, d, a), as `misaligned.errors` has them for one rig.

    A distortion that folds the image is not refused here: check the largest coefficients beforehand.

    Raises
    ------
    ValueError
        If a mirror has an error of form.
    """
    undistorted = [nominal.perturbed(replace(m, **dict.fromkeys(_BROWN, 0.0))) for m in drawn]
    if any(rig.mirror.form is not None for rig in undistorted):
        raise ValueError("errors_of_many: a mirror has an error of form; spheres only")
    down = _views([rig.at(0.0) for rig in undistorted], drawn)
    up = _views([rig.at(m.stroke_m(places.stroke_m)) for rig, m in zip(undistorted, drawn, strict=True)], drawn)
    seen = [_seen_px(views, places.points_m, nominal) for views in (down, up)]
    D = np.hypot(*np.moveaxis(places.points_m - down.sphere_m[:, None, None], -1, 0)[:2])
    return np.stack([ESTIMATORS[name](nominal, places.stroke_m, *seen).depth_m / D - 1.0 for name in names], axis=1)


def _views(views: Sequence[View], drawn: Sequence[Misalignment]) -> _Views:
    lens = [[getattr(view.rig.camera, name) for name in _LENS] for view in views]
    brown = [
        [getattr(view.rig.camera, name) + getattr(m, name) for name in _BROWN]
        for view, m in zip(views, drawn, strict=True)
    ]
    return _Views(
        np.array([view.camera_centre_m for view in views]),
        np.array([view.sphere_centre_m for view in views]),
        np.array([view.T_world_camera.R for view in views]),
        np.array([view.rig.mirror.radius_m for view in views]),
        np.concatenate([lens, brown], axis=1),
    )


def _seen_px(views: _Views, points_m: Array, nominal: Rig) -> Array:
    """Pixels (m, d, a, 2) of points (d, a, 3); NaN outside of the image."""
    flat = points_m.reshape(-1, 3)
    m, k = len(views.radius_m), len(flat)
    radius, sphere = views.radius_m[:, None, None], views.sphere_m[:, None]
    points = ((flat - sphere) / radius).reshape(-1, 3)
    eyes = np.broadcast_to((views.lens_m[:, None] - sphere) / radius, (m, k, 3)).reshape(-1, 3)
    mirror, _ = reflection_points(points, eyes, 1.0)
    away = sphere + radius * mirror.reshape(m, k, 3) - views.lens_m[:, None]
    x, y, z = np.moveaxis(away @ views.axes, -1, 0)  # R^T of the pose, as rows
    fx, fy, cx, cy, k1, k2, k3, p1, p2 = views.numbers.T[:, :, None]
    x, y = x / z, y / z
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    u = fx * (x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)) + cx
    v = fy * (y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y) + cy
    uv = np.stack([u, v], axis=-1)
    return np.where(nominal.camera.contains(uv)[..., None], uv, np.nan).reshape(m, *points_m.shape[:-1], 2)
