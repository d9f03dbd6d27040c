"""Snell's law for vectors at the two faces of a tube: an oracle for the closed forms of `scenes.glass_tube`."""

from __future__ import annotations

import numpy as np

from phibench.scenes.glass_tube import GlassTube


def through(tube: GlassTube, points: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points on the inner and the outer face, and directions outside, of rays from inside, shape (N, 3)."""
    places, d = [points], directions
    for radius, before, behind in ((tube.inner_m, 1.0, tube.index), (tube.outer_m, tube.index, 1.0)):
        place, normal = _meet(tube, places[-1], d, radius)
        cos = np.sum(d * normal, axis=1, keepdims=True)
        sine = before / behind * (d - cos * normal)  # n1 sin(i) = n2 sin(t), along the face
        d = sine + np.sqrt(1.0 - np.sum(sine**2, axis=1, keepdims=True)) * normal
        places.append(place)
    return places[1], places[2], d


def _meet(tube: GlassTube, o: np.ndarray, d: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Point of a cylinder that rays from inside meet, and the outward normal there, by the quadratic formula."""
    z = tube.axis
    p, w = (v - np.outer(v @ z, z) for v in (o - tube.origin_m, d))
    a, b, c = np.sum(w * w, axis=1), 2.0 * np.sum(p * w, axis=1), np.sum(p * p, axis=1) - radius**2
    with np.errstate(invalid="ignore", divide="ignore"):
        t = ((-b + np.sqrt(b * b - 4.0 * a * c)) / (2.0 * a))[:, None]
    return o + t * d, (p + t * w) / radius
