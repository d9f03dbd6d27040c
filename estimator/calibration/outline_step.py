"""One Gauss-Newton step of the outline's fit: sphere centre and blur."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from phibench.estimator.calibration.limb import limb_of
from phibench.estimator.calibration.limb_image import ImageError, Plane
from phibench.estimator.calibration.outline_pixels import OutlinePixels, place_of, through_taps
from phibench.estimator.calibration.sectors import Sectors, sandwich, sector_weights
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig


@dataclass(frozen=True)
class Step:
    """A step of (x, y, z of s, blur variance), and what is known where it starts.

    Attributes
    ----------
    move : shape (4,), metres and square pixels
    covariance : shape (4, 4)
    contrast, residual : float
        See `outline.Outline`.
    sectors_used : int
    model : shape (N,)
        Light of the pixels, as fitted.
    """

    move: Array
    covariance: Array
    contrast: float
    residual: float
    sectors_used: int
    model: Array


def step_from(
    pixels: OutlinePixels,
    planes: tuple[Plane, ...],
    rig: Rig,
    s: Array,
    blur_px2: float,
    sectors: int,
    half_px: float,
    jpeg: bool = False,
) -> Step:
    """Linearise the light around (s, blur) and solve, robustly within sectors and over them.

    Raises
    ------
    ImageError
        If there is no light across the outline.
    """
    place, limb = place_of(pixels, s, rig.mirror.radius_m), limb_of(rig, s, blur_px2)
    light, slope, curvature, turned, squared = through_taps(pixels, planes, limb, place)
    where = Sectors.of(pixels.plane, place.turn_rad, sectors)
    d = place.d_px / half_px
    # JPEG's lack of fine waves looks like a slope on both sides of the limb more than like the room's curvature
    room = np.stack([light, light * where.offset, turned, light * d if jpeg else squared], axis=-1)
    fit = where.fit(pixels.y, room)
    level = fit.model / light
    by_parameters = np.concatenate([place.by_s * slope[:, None], 0.5 * curvature[:, None]], axis=-1)
    columns = fit.without_nuisance(np.concatenate([by_parameters, slope[:, None]], axis=-1) * level[:, None])
    J, shift = columns[:, :4], columns[:, 4]
    trust = np.ones(sectors)
    for _ in range(4):
        weight = fit.weight * trust[where.sector]
        A = J.T @ (weight[:, None] * J)
        if not np.isfinite(A).all() or np.linalg.matrix_rank(A, tol=1e-12 * np.abs(A).max()) < 1:
            raise ImageError("an image without a mirror: there is no light across the outline")
        move = np.asarray(np.linalg.lstsq(A, J.T @ (weight * fit.residual), rcond=1e-14)[0], np.float64)
        left = fit.residual - J @ move
        trust = sector_weights(where, fit.weight, shift, left)
    scores = where.summed(J * (weight * left)[:, None])
    used = int(np.any(scores != 0.0, axis=-1).sum())
    return Step(move, sandwich(A, scores), _contrast(where, pixels.y, light, d), fit.relative_residual, used, fit.model)


def _contrast(where: Sectors, y: Array, light: Array, d: Array) -> float:
    """Median over sectors of the steel's fall of light, in units of itself, with level and slope free."""
    fit = where.fit(y, np.stack([np.ones_like(y), d, light - 1.0], axis=-1))
    with np.errstate(all="ignore"):
        ratio = fit.coefficients[:, 2] / fit.coefficients[:, 0]
    good = ratio[np.isfinite(ratio)]
    return float(np.median(good)) if good.size else 0.0
