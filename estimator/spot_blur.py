"""Blur of a spot's image along u and along v, as the rig predicts it: the lens's own, and defocus with astigmatism."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from phibench.estimator.reflection import reflect
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig


@dataclass(frozen=True)
class SpotBlur:
    """Second moments of a spot's image.

    Attributes
    ----------
    sigma_px : float, along u
    ratio : float, sigma along v over it
    mixed_px2 : float, mixed moment of u and v
    """

    sigma_px: float
    ratio: float = 1.0
    mixed_px2: float = 0.0

    @classmethod
    def of(cls, moments_px2: Array) -> SpotBlur:
        """From a covariance matrix."""
        sigma = np.sqrt(np.diag(moments_px2))
        return cls(float(sigma[0]), float(sigma[1] / sigma[0]), float(moments_px2[0, 1]))

    @property
    def round_px(self) -> float:
        """Sigma of a round spot with the same variance: root mean square of both axes."""
        return self.sigma_px * float(np.sqrt(0.5 * (1.0 + self.ratio**2)))


def spot_blur(rig: Rig, uv_px: ArrayLike) -> SpotBlur:
    """Blur that the rig predicts; the lens's alone where the pixel does not see the mirror.

    The virtual images of a far point lie R cos(i) / 2 (tangential: along the radius from the mirror's centre) and
    R / (2 cos i) (sagittal) behind the mirror (Coddington's equations). A point at the depth z is a disc of the radius
    fx a |1/z - 1/z_f|, a the lens's aperture, whose variance along an axis is a quarter of its radius squared. The
    spot's own size, 0.2 px at 2 m, and the mirror's roughness are left out.

    Parameters
    ----------
    rig : Rig
    uv_px : shape (2,)
    """
    camera, view, uv = rig.camera, rig.at(0.0), np.asarray(uv_px, float)
    into_camera = view.T_world_camera.inverse()
    hit = reflect(view, uv)
    cosine = np.cos(float(hit.incidence_rad))
    halves = 0.5 * rig.mirror.radius_m * np.array([cosine, 1.0 / cosine])
    depth_m = into_camera.points(hit.origin_world_m)[2] + halves * camera.rays(uv)[2]
    disc = camera.fx_px * camera.aperture_radius_m * (1.0 / depth_m - 1.0 / camera.focus_distance_m)
    away = uv - camera.project(into_camera.points(view.sphere_centre_m))
    along = np.outer(away, away) / max(float(away @ away), 1e-12)  # the radial direction
    moments = camera.blur_sigma_px**2 * np.eye(2) + 0.25 * (disc[0] ** 2 * along + disc[1] ** 2 * (np.eye(2) - along))
    return SpotBlur.of(moments) if np.isfinite(moments).all() else SpotBlur(camera.blur_sigma_px)
