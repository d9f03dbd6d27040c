"""First triangle along rays, by a loop over all triangles."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from phibench.render.optics.faces import face_table
from phibench.scenes.shapes import Shape


def by_determinants(shapes: Sequence[Shape], origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, ...]:
    """Distance, object and face of the first triangle, shape (N,) each: a loop over triangles, Cramer's rule."""
    table = face_table(shapes)
    distance, face = np.full(len(origins), np.inf), np.full(len(origins), -1)
    for corners, patch in zip(table.corners_m, table.patch, strict=True):
        e1, e2 = corners[1] - corners[0], corners[2] - corners[0]
        across = np.cross(directions, e2)
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = 1.0 / (across @ e1)
            from_corner = origins - corners[0]
            b1 = np.einsum("ni,ni->n", from_corner, across) * scale
            turned = np.cross(from_corner, e1)
            b2 = np.einsum("ni,ni->n", directions, turned) * scale
            t = turned @ e2 * scale
            nearer = (b1 >= 0) & (b2 >= 0) & (b1 + b2 <= 1) & (t > 0) & (t < distance)
        distance[nearer], face[nearer] = t[nearer], patch
    return distance, np.where(face >= 0, table.shape[face], -1), face
