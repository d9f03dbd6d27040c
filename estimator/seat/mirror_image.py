"""Where a world point appears in the mirror: the pixel whose reflected ray meets the point."""

from __future__ import annotations

import numpy as np
from scipy.optimize import root

from phibench.estimator.reflection import reflect
from phibench.scenes.frames import Array
from phibench.scenes.rig import View

_STEP = 1e-12  # relative, of the solver's last step
_CLOSE_RAD = 1e-9  # what remains between the ray and the point; 1e-7 px and less


def mirror_image(view: View, point_world_m: Array) -> tuple[float, float]:
    """Pixel (u, v) of a point, NaN where the mirror does not show it.

    Solved by Newton-like steps (scipy's hybrid method) on the two components of the ray's direction across the
    direction to the point, from the image of the mirror's point halfway between camera and target.

    Parameters
    ----------
    view : View
    point_world_m : shape (3,), metres
    """
    start = _first_guess(view, point_world_m)
    solution = root(lambda uv: _miss(view, uv, point_world_m), start, jac=None, method="hybr", tol=_STEP)
    if not np.linalg.norm(_miss(view, solution.x, point_world_m)) < _CLOSE_RAD:
        return float("nan"), float("nan")
    return float(solution.x[0]), float(solution.x[1])


def _first_guess(view: View, point: Array) -> Array:
    """Image of the sphere's point whose normal halves the angle at the centre between camera and target."""
    centre = view.sphere_centre_m
    to_camera, to_point = (x / np.linalg.norm(x) for x in (view.camera_centre_m - centre, point - centre))
    normal = to_camera + to_point
    surface = centre + view.rig.mirror.radius_m * normal / max(float(np.linalg.norm(normal)), 1e-12)
    return view.rig.camera.project(view.T_world_camera.inverse().points(surface))


def _miss(view: View, uv: Array, point: Array) -> Array:
    """Components of the ray across the way from the mirror to the point, shape (2,); large where there is no ray."""
    ray = reflect(view, uv)
    if not np.isfinite(ray.direction_world).all():
        return np.full(2, 2.0)
    way = point - ray.origin_world_m
    way = way / np.linalg.norm(way)
    side = np.cross(way, [0.0, 0.0, 1.0])
    side /= max(float(np.linalg.norm(side)), 1e-12)
    across = np.stack([side, np.cross(side, way)])
    ahead = float(ray.direction_world @ way)
    return across @ ray.direction_world if ahead > 0.0 else np.full(2, 2.0)
