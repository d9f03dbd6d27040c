"""The same panorama without any model of the mirror: directions from a data set's truth layer, inverted by search.

The truth has, for every pixel, the outward normal and the world point that it sees. The ray leaves at
P = S + R n and goes to X, so that its direction is (X - P) / |X - P|. Of every grid point the pixel with the nearest
direction is looked up; the step to the place between pixels comes from differences over its 3 x 3 neighbours. A mirror
with an error of form is taken for its sphere here: at a peak of 50 um P is off by as much, and the place by 0.014 px.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from phibench.datasets.read import Sample
from phibench.estimator.panorama import Grid
from phibench.scenes.frames import Array

_ROUNDS = 4
_REACH_PX = 1.5  # the place must be within reach of the nearest pixel's neighbours


def ray_directions(sample: Sample, position: str) -> Array:
    """Unit vectors of the rays that leave the mirror, shape (H, W, 3), from the truth layer; NaN beside the mirror."""
    truth, row = sample.truth(position), sample.truth_row(position)
    angle, turn = truth["phi_normal_rad"], truth["azimuth_rad"]
    n = np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), -np.cos(angle)], axis=-1)
    X = np.stack([truth[name] for name in ("x_m", "y_m", "z_m")], axis=-1)
    away = X - (np.array(row.sphere_centre_world_m) + sample.rig.mirror.radius_m * n)
    return np.asarray(away / np.linalg.norm(away, axis=-1, keepdims=True))


def pixels_by_truth(directions: Array, grid: Grid) -> Array:
    """Image pixel (u, v) of every grid point, shape (H, W, 2), from `ray_directions`; NaN where no pixel shows it."""
    inner = np.zeros(directions.shape[:2], bool)
    inner[1:-1, 1:-1] = _with_neighbours(directions)
    v, u = np.nonzero(inner)
    if v.size == 0:
        return np.full((grid.height_px, grid.width_px, 2), np.nan)
    wanted = grid.directions().reshape(-1, 3)
    _, nearest = cKDTree(directions[v, u]).query(wanted)
    step = _steps(directions, v[nearest], u[nearest], wanted)
    uv = np.stack([u[nearest], v[nearest]], axis=-1) + step
    uv[~(np.abs(step) < _REACH_PX).all(axis=-1)] = np.nan
    return uv.reshape(grid.height_px, grid.width_px, 2)


def _with_neighbours(directions: Array) -> NDArray[np.bool_]:
    seen = np.asarray(np.isfinite(directions).all(axis=-1))
    shifts = [slice(0, -2), slice(1, -1), slice(2, None)]
    return np.logical_and.reduce([seen[rows, columns] for rows in shifts for columns in shifts])


def _steps(r: Array, v: NDArray[np.intp], u: NDArray[np.intp], wanted: Array) -> Array:
    """Steps (du, dv), shape (n, 2), at which the quadratic through the neighbours has the wanted direction."""
    here, left, right, above, below = r[v, u], r[v, u - 1], r[v, u + 1], r[v - 1, u], r[v + 1, u]
    by_u, by_v = 0.5 * (right - left), 0.5 * (below - above)
    uu, vv = right - 2.0 * here + left, below - 2.0 * here + above
    uv = 0.25 * (r[v + 1, u + 1] - r[v + 1, u - 1] - r[v - 1, u + 1] + r[v - 1, u - 1])
    step = np.zeros((len(v), 2))
    for _ in range(_ROUNDS):
        a, b = step[:, :1], step[:, 1:]
        model = here + a * by_u + b * by_v + 0.5 * (a * a * uu + b * b * vv) + a * b * uv
        slope = np.stack([by_u + a * uu + b * uv, by_v + b * vv + a * uv], axis=-1)
        normal = np.swapaxes(slope, -1, -2)
        step = step + np.linalg.solve(normal @ slope, normal @ (wanted - model)[..., None])[..., 0]
        step = np.clip(step, -2.0 * _REACH_PX, 2.0 * _REACH_PX)
    return step
