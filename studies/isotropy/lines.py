"""Epipolar lines (Figure 1 of the paper); azimuths that two sensors side by side hide; findings, a table, a drawing.

An epipolar line holds the pixels of the up image that show the points on the ray of one down pixel. A spot counts as
seen only if both sensors see it. Sensor A at the first place loses the spots behind sensor B at the second, and the
other way round. Hiding bodies are the mirror, the camera's housing and the mast; the chassis is common to both.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import polars as pl

from phibench.estimator.geometry.epipolar_line import range_at
from phibench.estimator.geometry.panorama import PanoramaGrid
from phibench.estimator.geometry.phi import outline_circle
from phibench.estimator.geometry.reflection import image_of, reflect
from phibench.render.optics.room_tracer import blocked_by
from phibench.scenes.frames import Array, Pose, as_vector
from phibench.scenes.rig import Rig, View
from phibench.scenes.room import carriage
from phibench.studies.framework import COLOURS, Drawing, Finding, canvas, finished_drawing
from phibench.studies.misaligned_rigs import centroids_px, seen_px


@dataclass(frozen=True)
class Line:
    """An epipolar line.

    Attributes
    ----------
    depths_m : shape (n,)
    uv_px : shape (n, 2), exact
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
    down_px: Array
    beside_radius_px: float
    beside_line_px: float
    rendered_beside_px: float
    columns_px: Array
    bend_px: float


def epipolar_line(
    nominal: Rig, true: Rig, stroke_m: float, down_point_m: Array, depths_m: Array, grid: PanoramaGrid, render: bool
) -> Line:
    """Line of the down pixel that shows a point.

    Parameters
    ----------
    nominal : Rig
        Nominal: centre of the mirror's image, and the panorama.
    stroke_m : float, true
    down_point_m : shape (3,)
    depths_m : shape (n,), of the points on the ray
    grid : PanoramaGrid
    """
    down, up = true.at(0.0), true.at(stroke_m)
    down_px = seen_px(down, down_point_m)
    ray = reflect(down, down_px)
    t = range_at(ray.origin_world_m - down.sphere_centre_m, ray.direction_world, depths_m)
    X = ray.origin_world_m + t[:, None] * ray.direction_world
    uv = seen_px(up, X)
    centre = outline_circle(nominal)[0]
    columns = _columns(nominal, stroke_m, down_px, uv, grid)
    return Line(
        depths_m,
        uv,
        down_px,
        float(np.max(line_distances(uv, centre, down_px))),
        float(np.max(best_line_distances(uv))),
        float(np.max(line_distances(centroids_px(up, X), centre, down_px))) if render else float("nan"),
        columns[1:],
        float(np.ptp(columns)),
    )


def line_distances(points_px: Array, a_px: Array, b_px: Array) -> Array:
    """Distances, shape (n,), of points (n, 2) from the line through a and b."""
    along = (b_px - a_px) / np.linalg.norm(b_px - a_px)
    off = points_px - a_px
    return np.abs(off[:, 0] * along[1] - off[:, 1] * along[0])


def best_line_distances(points_px: Array) -> Array:
    """Distances, shape (n,), of points (n, 2) from their best straight line (total least squares)."""
    off = points_px - points_px.mean(axis=0)
    # the direction of least scatter is the normal of the best line
    across = np.linalg.svd(off, full_matrices=False)[2][-1]
    return np.abs(off @ across)


def _columns(nominal: Rig, stroke_m: float, down_px: Array, uv: Array, grid: PanoramaGrid) -> Array:
    """Columns of the down pixel and of the up pixels, shape (1 + n,), without a jump at the seam."""
    views: tuple[tuple[View, Array], ...] = ((nominal.at(0.0), down_px[None]), (nominal.at(stroke_m), uv))
    columns = np.concatenate([grid.place(reflect(view, at).direction_world)[:, 0] for view, at in views])
    return np.unwrap(columns, period=grid.width_px)


def hidden_flags(seeing: View, other: View, points_m: Array) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Flags of points (n, 3) whose ray to the seeing sensor's mirror the other sensor cuts, shape (n,)."""
    P = reflect(seeing, image_of(seeing, points_m).uv_px).origin_world_m
    along = points_m - P
    length = np.linalg.norm(along, axis=-1)
    r = along / length[:, None]
    to_sphere = other.sphere_centre_m - P
    # the place nearest to the other centre, on the way to the point and not beyond it
    t = np.clip(np.sum(to_sphere * r, axis=-1), 0.0, length)
    by_mirror = np.linalg.norm(to_sphere - t[:, None] * r, axis=-1) < other.rig.sphere.radius_m
    return by_mirror | (blocked_by(carriage(other), P, points_m) >= 0)


def hidden_share(rig: Rig, apart_m: float, points_m: Array) -> tuple[float, float]:
    """Share of points (n, 3) that a pair of fixed sensors loses, and that one sensor, moved, loses to itself.

    The second of the pair stands `apart_m` along world x. The moving sensor is hidden by nothing but its own housing
    and mast, at each place.
    """
    a, b = rig.at(0.0), moved_rig(rig, apart_m).at(0.0)
    pair = hidden_flags(a, b, points_m) | hidden_flags(b, a, points_m)
    own = np.zeros(len(points_m), bool)
    for view in (a, b):
        P = reflect(view, image_of(view, points_m).uv_px).origin_world_m
        own |= blocked_by(carriage(view), P, points_m) >= 0
    return float(pair.mean()), float(own.mean())


def moved_rig(rig: Rig, by_m: float) -> Rig:
    """The same rig elsewhere along world x."""
    old = rig.T_world_camera
    shift = as_vector(old.t + np.array([by_m, 0.0, 0.0]))
    return replace(rig, T_world_camera=Pose("world", "camera", shift, old.rotation))


def half_width_rad(rig: Rig, apart_m: float, depth_m: float, height_m: float) -> float:
    """Half of the azimuths that the other mirror hides from an aligned sensor, closed form; 0 where it hides none.

    The ray lies in the vertical plane of the spot's azimuth a. With (rho, zeta) its start relative to the mirror's
    centre, m its slope and e its elevation, its distance d from the other centre, at the same height, is given by
    d^2 = (b sin a)^2 + cos(e)^2 (zeta + m (b cos a - rho))^2. d = R is a quadratic in cos a.
    """
    view, point = rig.at(0.0), np.array([depth_m, 0.0, height_m]) + [*rig.at(0.0).sphere_centre_m[:2], 0.0]
    ray = reflect(view, image_of(view, point).uv_px)
    start, r = ray.origin_world_m - view.sphere_centre_m, ray.direction_world
    m, cosine2, b = float(r[2] / np.hypot(*r[:2])), float(np.sum(r[:2] ** 2)), apart_m
    level = float(start[2] - m * np.hypot(*start[:2]))
    # A cos(a)^2 + B cos(a) + C = d^2 - R^2; below 0 at a = 0 where the other mirror hides anything
    A = b * b * (cosine2 * m * m - 1.0)
    B = 2.0 * cosine2 * level * m * b
    C = b * b + cosine2 * level * level - rig.sphere.radius_m**2
    roots = np.roots([A, B, C])
    # rounding of a real root
    inside = [float(root.real) for root in roots if abs(root.imag) < 1e-12 and 0.0 < root.real < 1.0]
    return math.acos(max(inside)) if inside and A + B + C < 0.0 else 0.0


# -- what comes of it --------------------------------------------------------------------------------------------------

STRAIGHT_PX = 0.1
"""A tenth of a pixel matters, less does not."""


def occlusion_findings(hidden: pl.DataFrame, apart_m: float) -> Iterator[Finding]:
    """Shares of all azimuths that two fixed sensors hide from each other, and one moving sensor from itself."""
    for row in hidden.iter_rows(named=True):
        label = f"hidden from each other, two sensors {apart_m:.3g} m apart, spot at {row['height_m']:g} m"
        yield Finding(label, 100.0 * row["pair"], unit="%")
    largest = 100.0 * float(np.max(hidden["own"].to_numpy()))
    yield Finding("hidden from itself, one sensor that moves, largest", largest, unit="%").judged("<=", 0.0)


def line_findings(aligned: Sequence[Line], tilted: Sequence[Line]) -> Iterator[Finding]:
    """Distances of epipolar lines from the radius, the panorama's column, and their best straight line."""
    for name, lines in (("aligned rig", aligned), ("misaligned rig", tilted)):
        for word, key, unit in (
            ("exact points beside the radius", "beside_radius_px", "px"),
            ("rendered spots beside the radius", "rendered_beside_px", "px"),
            ("panorama, beside the column", "bend_px", "columns"),
            ("exact points beside a straight line", "beside_line_px", "px"),
        ):
            largest = max(getattr(line, key) for line in lines)
            yield Finding(f"epipolar lines, {name}: {word}", largest, unit=unit).judged("<=", STRAIGHT_PX)


def line_table(lines: tuple[Sequence[Line], Sequence[Line]]) -> pl.DataFrame:
    """A row per rig and line."""
    return pl.DataFrame(
        [
            {
                "rig": name,
                "down_u_px": float(line.down_px[0]),
                "down_v_px": float(line.down_px[1]),
                "beside_radius_px": line.beside_radius_px,
                "beside_line_px": line.beside_line_px,
                "rendered_beside_px": line.rendered_beside_px,
                "panorama_bend_px": line.bend_px,
            }
            for name, each in zip(("aligned", "misaligned"), lines, strict=True)
            for line in each
        ]
    )


def lines_drawing(aligned: Sequence[Line], tilted: Sequence[Line], centre_px: Array) -> Drawing:
    """Epipolar lines in the image, and their columns in the panorama."""
    with canvas(9.0, 4.2) as figure:
        left, right = figure.subplots(1, 2)
        for i, (name, lines) in enumerate((("aligned", aligned), ("misaligned", tilted))):
            for k, line in enumerate(lines):
                label = name if k == 0 else None
                left.plot(*line.uv_px.T, "-", color=COLOURS[i], label=label, linewidth=1.2)
                left.plot(*line.down_px, "o", color=COLOURS[i], markersize=3)
                right.plot(line.columns_px - line.columns_px[-1], line.depths_m, ".-", color=COLOURS[i], label=label)
        for line in aligned:
            left.plot(*np.stack([centre_px, line.down_px]).T, ":", color=COLOURS[6], linewidth=0.6)
        left.set(xlabel="u, px", ylabel="v, px", title="image: down pixel (dot), up image of its ray (line)")
        left.set_aspect("equal")
        left.invert_yaxis()
        right.set(xlabel="column - column of the farthest point, px", ylabel="D, m", title="panorama", yscale="log")
        left.legend(loc="upper left", fontsize=8)
        bend = [max(line.bend_px for line in lines) for lines in (aligned, tilted)]
        alt = (
            "Epipolar lines: radial in the image and vertical in the panorama for the aligned rig "
            f"({bend[0]:.1e} columns), up to {bend[1]:.2g} columns off for the misaligned one."
        )
        return finished_drawing("lines", figure, alt)
