"""The three angles that the paper calls phi, and the azimuth, of rays leaving the mirror.

All angles are measured against the world's vertical (DESIGN section 3, paper/errata).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from phibench.scenes.frames import Array


@dataclass(frozen=True)
class MirrorAngles:
    """Angles in radians, arrays of shape (N,).

    Attributes
    ----------
    phi_ray_rad
        theta / 2, theta the angle between the ray that leaves the mirror and the downward vertical.
    phi_normal_rad
        Polar angle of the outward mirror normal from the downward vertical.
    phi_incidence_rad
        Angle of incidence.
    azimuth_rad
        Of the mirror normal's horizontal part, from world x towards world y.
    """

    phi_ray_rad: Array
    phi_normal_rad: Array
    phi_incidence_rad: Array
    azimuth_rad: Array


def mirror_angles(normals: Array, directions: Array) -> MirrorAngles:
    """Angles of unit outward normals and unit leaving directions, both of shape (N, 3), world frame."""
    return MirrorAngles(
        phi_ray_rad=0.5 * _from_downward(directions),
        phi_normal_rad=_from_downward(normals),
        phi_incidence_rad=_between(normals, directions),
        azimuth_rad=np.arctan2(normals[..., 1], normals[..., 0]),
    )


def _from_downward(v: Array) -> Array:
    return np.arctan2(np.hypot(v[..., 0], v[..., 1]), -v[..., 2])


def _between(a: Array, b: Array) -> Array:
    """Angle between unit vectors, accurate for small and large angles (Kahan)."""
    return 2.0 * np.arctan2(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1))
