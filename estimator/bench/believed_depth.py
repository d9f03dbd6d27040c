"""D of two positions through the believed rig, with its predicted error: of the pixels, and of a calibration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from phibench.estimator.depth_general import depth_general
from phibench.estimator.triangulate import depth_exact
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig

_ROUND_PX2 = 0.1**2


@dataclass(frozen=True)
class BelievedDepth:
    """Depths, shape (n,), NaN where there is none.

    Attributes
    ----------
    depth_m, sigma_m : shape (n,)
        All of the predicted error; NaN where no covariance of the pixels is claimed.
    calibration_sigma_m : shape (n,)
        The calibration's part of it at these pixels, whatever the pixels' covariance; 0 for a rig that counts as exact.
    """

    depth_m: Array
    sigma_m: Array
    calibration_sigma_m: Array


def believed_depth(
    rig: Rig,
    stroke_m: Array,
    uv_px: tuple[Array, Array],
    covariance_px2: tuple[Array, Array],
    calibration: Array | None,
) -> BelievedDepth:
    """Depths of pairs of positions, shape (n, 2) each.

    Without a calibration the rays' midpoint; with one the weighted point of `depth_general`, and the midpoint where no
    covariance is claimed.
    """
    plain = depth_exact(rig, stroke_m, *uv_px, *covariance_px2)
    if calibration is None:
        return BelievedDepth(plain.depth_m, plain.sigma_m, np.zeros_like(plain.depth_m))
    (down, up), (C1, C2) = uv_px, covariance_px2
    general = depth_general(rig, stroke_m, down, up, C1, C2, calibration)
    claimed = np.isfinite(general.sigma_m)
    # equal weights where there is no claim: the calibration's part is then that of round spots of one size
    unclaimed = _calibration_sigma_m(rig, stroke_m, uv_px, calibration)
    part = np.hypot(general.sigma_calibration_m, general.sigma_stroke_m)
    return BelievedDepth(
        np.where(claimed, general.depth_m, plain.depth_m), general.sigma_m, np.where(claimed, part, unclaimed)
    )


def _calibration_sigma_m(rig: Rig, stroke_m: Array, uv_px: tuple[Array, Array], calibration: Array) -> Array:
    round_px2 = np.broadcast_to(_ROUND_PX2 * np.eye(2), (len(uv_px[0]), 2, 2))
    at = depth_general(rig, stroke_m, *uv_px, round_px2, round_px2, calibration)
    return np.hypot(at.sigma_calibration_m, at.sigma_stroke_m)
