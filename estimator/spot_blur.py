"""Blur of a spot's image along u and along v, as the rig predicts it: the lens's own, and defocus with astigmatism."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from phibench.estimator.reflection import reflect
from phibench.scenes.rig import Rig


def spot_blur(rig: Rig, uv_px: ArrayLike) -> tuple[float, float]:
    """Sigma along u, pixels, and sigma along v over it; the lens's blur and 1 where the pixel does not see the mirror.

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
    share = away**2 / max(float(away @ away), 1e-12)  # of the radial direction along u and v
    variances = camera.blur_sigma_px**2 + (disc[0] ** 2 * share + disc[1] ** 2 * (1.0 - share)) / 4.0
    if not np.isfinite(variances).all():
        return camera.blur_sigma_px, 1.0
    return float(np.sqrt(variances[0])), float(np.sqrt(variances[1] / variances[0]))


def round_blur_px(rig: Rig, uv_px: ArrayLike) -> float:
    """Blur of a round spot with the same variance: root mean square of both axes of `spot_blur`, pixels."""
    sigma, ratio = spot_blur(rig, uv_px)
    return sigma * float(np.sqrt(0.5 * (1.0 + ratio * ratio)))
