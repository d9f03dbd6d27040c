"""Blur of a spot's image as the user's rig predicts it: the optics' own, defocus with astigmatism, and roughness."""

from __future__ import annotations

import math

import numpy as np

from phibench.estimator.reflection import reflect
from phibench.scenes.rig import Rig


def spot_sigma_px(rig: Rig, uv_px: tuple[float, float]) -> float:
    """Standard deviation of the spot's image, root mean square of both axes, pixels.

    sigma^2 = blur^2 + defocus^2 + roughness^2. The virtual images of a far point lie R cos(i) / 2 (tangential) and
    R / (2 cos i) (sagittal) behind the mirror (Coddington's equations); a point image at the depth z is a disc of the
    radius fx a |1/z - 1/z_f| (a: lens aperture), whose variance is a quarter of its radius squared. The size of the
    spot itself (0.2 px at 2 m) is left out. NaN where the pixel does not see the mirror.

    Parameters
    ----------
    rig : Rig
    uv_px : (u, v), pixels
    """
    camera = rig.camera
    view = rig.at(0.0)
    ray = camera.rays(np.array(uv_px))
    hit = reflect(view, np.array(uv_px))
    start = view.T_world_camera.inverse().points(hit.origin_world_m)[2]
    cosine = math.cos(float(hit.incidence_rad))
    halves = rig.mirror.radius_m / 2.0 * np.array([cosine, 1.0 / cosine])
    depth = start + halves * ray[2]
    disc = camera.fx_px * camera.aperture_radius_m * np.abs(1.0 / depth - 1.0 / camera.focus_distance_m)
    variance = camera.blur_sigma_px**2 + float(np.mean(disc**2)) / 4.0
    return math.sqrt(variance)
