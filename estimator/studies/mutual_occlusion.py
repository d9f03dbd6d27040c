"""What two sensors side by side hide from each other; one sensor that moves hides nothing from itself.

A spot counts only if both see it. Sensor A at the first place loses the spots behind sensor B at the second, and the
other way round. Hiding bodies are the mirror, the camera's housing and the mast; the chassis is common to both.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from phibench.estimator.mirror_image import image_of
from phibench.estimator.reflection import reflect
from phibench.render.raycast import blocked_by
from phibench.scenes.frames import Array, Pose, as_vector
from phibench.scenes.rig import Rig, View
from phibench.scenes.robot import carriage


def hidden_by(seeing: View, other: View, points_m: Array) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Whether the other sensor cuts the ray from a point (n, 3) to the seeing sensor's mirror, shape (n,)."""
    P = reflect(seeing, image_of(seeing, points_m).uv_px).origin_world_m
    along = points_m - P
    length = np.linalg.norm(along, axis=-1)
    r = along / length[:, None]
    to_sphere = other.sphere_centre_m - P
    t = np.clip(np.sum(to_sphere * r, axis=-1), 0.0, length)
    by_mirror = np.linalg.norm(to_sphere - t[:, None] * r, axis=-1) < other.rig.mirror.radius_m
    return by_mirror | (blocked_by(carriage(other), P, points_m) >= 0)


def hidden_share(rig: Rig, apart_m: float, points_m: Array) -> tuple[float, float]:
    """Share of points (n, 3) that a pair of fixed sensors loses, and that one sensor, moved, loses to itself.

    The second of the pair stands `apart_m` along world x. The moving sensor is hidden by nothing but its own housing
    and mast, at each place.
    """
    a, b = rig.at(0.0), moved(rig, apart_m).at(0.0)
    pair = hidden_by(a, b, points_m) | hidden_by(b, a, points_m)
    own = np.zeros(len(points_m), bool)
    for view in (a, b):
        P = reflect(view, image_of(view, points_m).uv_px).origin_world_m
        own |= blocked_by(carriage(view), P, points_m) >= 0
    return float(pair.mean()), float(own.mean())


def moved(rig: Rig, by_m: float) -> Rig:
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
    A = b * b * (cosine2 * m * m - 1.0)
    B = 2.0 * cosine2 * level * m * b
    C = b * b + cosine2 * level * level - rig.mirror.radius_m**2
    roots = np.roots([A, B, C])
    inside = [float(root.real) for root in roots if abs(root.imag) < 1e-12 and 0.0 < root.real < 1.0]
    return math.acos(max(inside)) if inside and A + B + C < 0.0 else 0.0
