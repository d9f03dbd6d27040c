"""Which candidates of both images are the spot: they must show one point of the room.

The ray of a pixel of the down image passes points at distances D; their images sweep a curve in the up image, for
tilted rigs too. A candidate of the up image belongs to it if it lies near the curve.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from phibench.estimator.epipolar import up_image
from phibench.estimator.spot_verdict import Verdicts
from phibench.scenes.frames import Array, BoolArray
from phibench.scenes.rig import Rig

NEAREST_M, FARTHEST_M = 0.3, 12.0  # of D
NEAR_CURVE_PX = 4.0  # what a rig that is not quite as believed moves the curve by
_POINTS = 48
_FLUX_RATIO = 6.0  # of one spot in both images, at most
_STRONGER = 1.5  # a single candidate over a pair's: others have half the spot's light at most
_MOST = 24  # candidates of an image that are compared


@dataclass(frozen=True)
class Thresholds:
    """Least significance of a candidate alone, of each of a pair, and of their root mean square."""

    alone: float
    each: float
    together: float


@dataclass(frozen=True)
class Choice:
    """Rows of the chosen candidates; None where there is none."""

    down: int | None = None
    up: int | None = None


def choose(rig: Rig, stroke_m: float, down: Verdicts, up: Verdicts, least: Thresholds, sure: bool) -> Choice:
    """Choose the strongest consistent pair, or one candidate alone.

    Parameters
    ----------
    rig : Rig
    stroke_m : float
    down, up : Verdicts
        Candidates, pixels of the whole image, strongest first.
    least : Thresholds
    sure : bool
        Whether the candidates are known to be red or the laser's; otherwise a pair is always preferred.
    """
    fits = consistent(rig, stroke_m, down.uv_px[:_MOST], up.uv_px[:_MOST])
    ratio = up.electrons[None, :_MOST] / np.maximum(down.electrons[:_MOST, None], 1e-9)
    fits &= (ratio < _FLUX_RATIO) & (ratio > 1.0 / _FLUX_RATIO)
    z_down, z_up = down.z[:_MOST, None], up.z[None, :_MOST]
    fits &= (np.minimum(z_down, z_up) >= least.each) & (z_down**2 + z_up**2 >= 2.0 * least.together**2)
    single = _single(down, up, least.alone)
    if not fits.any():
        return single
    row = int(np.flatnonzero(fits.any(axis=1))[0])
    pair = Choice(row, int(np.flatnonzero(fits[row])[0]))
    if sure and single.down is not None and down.electrons[single.down] > _STRONGER * down.electrons[row]:
        return Choice(single.down)
    return pair


def consistent(rig: Rig, stroke_m: float, uv_down_px: Array, uv_up_px: Array) -> BoolArray:
    """Whether pixels of both images can show one point, shape (n, m), for pixels (n, 2) and (m, 2)."""
    if len(uv_down_px) == 0 or len(uv_up_px) == 0:
        return np.zeros((len(uv_down_px), len(uv_up_px)), bool)
    curve = epipolar_curve(rig, stroke_m, uv_down_px)
    return np.asarray(_distance(curve, uv_up_px) < NEAR_CURVE_PX)


def epipolar_curve(rig: Rig, stroke_m: float, uv_down_px: Array) -> Array:
    """Images in the up frame of the points seen by pixels of the down frame, shape (n, k, 2), near ones first.

    The points lie at k values of D from `NEAREST_M` to `FARTHEST_M`, even in 1 / D, which is nearly even in pixels.
    """
    q = np.linspace(1.0 / NEAREST_M, 1.0 / FARTHEST_M, _POINTS)
    return up_image(rig, stroke_m, uv_down_px[:, None, :], q).uv_px


def _distance(curve: Array, points: Array) -> Array:
    """Distance of points (m, 2) from polylines (n, k, 2), shape (n, m); infinite where there is no line."""
    start, along = curve[:, None, :-1], np.diff(curve, axis=1)[:, None]
    to = points[None, :, None] - start
    with np.errstate(all="ignore"):
        share = np.clip(np.sum(to * along, axis=-1) / np.sum(along * along, axis=-1), 0.0, 1.0)
        distance = np.linalg.norm(to - share[..., None] * along, axis=-1)
    return np.min(np.where(np.isfinite(distance), distance, np.inf), axis=-1)


def _single(down: Verdicts, up: Verdicts, alone: float) -> Choice:
    """The more significant one of the strongest candidates that pass alone; both could not be one point."""
    rows = [int(np.flatnonzero(side.z >= alone)[0]) if (side.z >= alone).any() else None for side in (down, up)]
    if rows[0] is None or rows[1] is None:
        return Choice(rows[0], rows[1])
    return Choice(rows[0]) if down.z[rows[0]] >= up.z[rows[1]] else Choice(None, rows[1])
