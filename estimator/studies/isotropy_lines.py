"""Epipolar lines: where the up image shows the points that lie on the ray of one down pixel (Figure 1 of the paper)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from phibench.estimator.epipolar import range_at
from phibench.estimator.panorama import Grid
from phibench.estimator.phi import outline_circle
from phibench.estimator.reflection import reflect
from phibench.estimator.studies.misaligned import seen_px
from phibench.estimator.studies.misalignment_rendered import centroids_px
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig, View


@dataclass(frozen=True)
class Line:
    """An epipolar line.

    Attributes
    ----------
    depths_m : shape (n,)
    uv_px : shape (n, 2), exact
    rendered_px : shape (n, 2), centroids of rendered spots; empty where none were rendered
    down_px : shape (2,)
    beside_radius_px : float
        Largest distance of the points from the line through the image of the mirror's centre and the down pixel.
    beside_line_px : float
        Largest distance from the best straight line of any direction.
    rendered_beside_px : float
        As `beside_radius_px`, of the rendered points; NaN without.
    columns_px : shape (n,)
        Columns of the points in the panorama, as the nominal rig unrolls it.
    bend_px : float
        Largest less smallest of them, the down pixel's column included.
    """

    depths_m: Array
    uv_px: Array
    rendered_px: Array
    down_px: Array
    beside_radius_px: float
    beside_line_px: float
    rendered_beside_px: float
    columns_px: Array
    bend_px: float


def epipolar_line(
    nominal: Rig, true: Rig, stroke_m: float, down_point_m: Array, depths_m: Array, grid: Grid, render: bool
) -> Line:
    """Line of the down pixel that shows a point.

    Parameters
    ----------
    nominal : Rig
        Believed: centre of the mirror's image, and the panorama.
    true : Rig
    stroke_m : float, true
    down_point_m : shape (3,)
    depths_m : shape (n,), of the points on the ray
    grid : Grid
    render : bool
    """
    down, up = true.at(0.0), true.at(stroke_m)
    down_px = seen_px(down, down_point_m)
    ray = reflect(down, down_px)
    t = range_at(ray.origin_world_m - down.sphere_centre_m, ray.direction_world, depths_m)
    X = ray.origin_world_m + t[:, None] * ray.direction_world
    uv = seen_px(up, X)
    rendered = centroids_px(up, X) if render else np.empty((0, 2))
    centre = outline_circle(nominal)[0]
    columns = _columns(nominal, stroke_m, down_px, uv, grid)
    return Line(
        depths_m,
        uv,
        rendered,
        down_px,
        float(np.max(beside(uv, centre, down_px))),
        float(np.max(beside_best(uv))),
        float(np.max(beside(rendered, centre, down_px))) if render else float("nan"),
        columns[1:],
        float(np.ptp(columns)),
    )


def beside(points_px: Array, a_px: Array, b_px: Array) -> Array:
    """Distances, shape (n,), of points (n, 2) from the line through a and b."""
    along = (b_px - a_px) / np.linalg.norm(b_px - a_px)
    off = points_px - a_px
    return np.abs(off[:, 0] * along[1] - off[:, 1] * along[0])


def beside_best(points_px: Array) -> Array:
    """Distances, shape (n,), of points (n, 2) from their best straight line (total least squares)."""
    off = points_px - points_px.mean(axis=0)
    across = np.linalg.svd(off, full_matrices=False)[2][-1]
    return np.abs(off @ across)


def _columns(nominal: Rig, stroke_m: float, down_px: Array, uv: Array, grid: Grid) -> Array:
    """Columns of the down pixel and of the up pixels, shape (1 + n,), without a jump at the seam."""
    views: tuple[tuple[View, Array], ...] = ((nominal.at(0.0), down_px[None]), (nominal.at(stroke_m), uv))
    columns = np.concatenate([grid.place(reflect(view, at).direction_world)[:, 0] for view, at in views])
    return np.unwrap(columns, period=grid.width_px)
