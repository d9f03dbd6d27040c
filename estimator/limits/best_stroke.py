"""Stroke with the smallest predicted error of depth D, and what limits it; position bound by a spot's electrons.

For a camera at infinity the rays to a spot at (D, z) leave the mirror at theta_k with tan(theta_k) = D / (z_k - z),
z_k the mirror's height at the down and the up position, so that an error s of both theta gives

    sigma_D = (D^2 / h) s sqrt((1 + x_1^2)^2 + (1 + x_2^2)^2),    x_k = (z_k - z) / D,   h = z_2 - z_1.

It falls as D^2 / h while h << D and rises as h^3 / D^2 beyond: for x_1 = 0 it is smallest at h = 2^(1/4) D, for a spot
half way up (x_1 = -x_2) at h = 2 D. `best_stroke` takes the same from the exact rays, with the spot's bound where it
appears in the mirror and with the covariance of the rig's parameters:

    sigma_D^2 = g_y C_y g_y + g_p C_p g_p + g_h^2 sigma_h^2 + higher orders    (`depth_general`, `stroke_curve`).

The last is what a rig's tolerance does beyond first order; a stroke at which the first order vanishes is no better than
that. sigma_D is a root mean square error: for a rig as built it contains the mean of the second order, a bias of
`depth_general`, which is not scatter about a mean.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.frames.sensor_card import SensorCard, sensor_card
from phibench.estimator.geometry.rig_parameters import PARAMETERS, prior_sigmas
from phibench.estimator.limits.processed_bound import SpotSigma, spot_sigma
from phibench.estimator.limits.stroke_curve import (
    FREE,
    StrokeCurve,
    Surroundings,
    grid_neighbours,
    stroke_curve,
    stroke_grid,
)
from phibench.estimator.spots.spot_prediction import spot_blur
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig

STROKES_M = (0.10, 1.40)
"""Of the paper's carriage."""
LEAST, LARGEST = "shortest stroke", "longest stroke"
ROOM_E_PER_S = (5.8e4, 4.9e4, 2.5e4)
"""Electrons per second and pixel behind R, G, B of a white wall of the lab, whose floor receives about 460 lx."""
_DEPTH_M = (0.05, 100.0)  # allowed D: from just outside the default mirror to beyond any room
_STROKE_M = (1e-3, 20.0)  # from a recipe's shortest stroke to twice its longest
_FINE = 21  # strokes between two of the grid: 0.3 % apart, and the minimum is flat


@dataclass(frozen=True)
class BestStroke:
    """A stroke and what is expected of it.

    Attributes
    ----------
    depth_m : float
        D that was asked for.
    stroke_m : float
        NaN where no stroke can be taken.
    sigma_m, sigma_spot_m, sigma_calibration_m, sigma_stroke_m, sigma_higher_order_m : float
        Predicted root mean square error of D and its parts, whose squares add up. The first three parts are standard
        deviations; the last contains a bias, see `stroke_curve`.
    limits : tuple of str
        What keeps the stroke from being better: "shortest stroke", "longest stroke", or the cause beside it, such as
        "ceiling"; empty at a minimum of the error. Where no stroke can be taken, all causes.
    curve : StrokeCurve
        Error of D by the stroke.
    """

    depth_m: float
    stroke_m: float
    sigma_m: float
    sigma_spot_m: float
    sigma_calibration_m: float
    sigma_stroke_m: float
    sigma_higher_order_m: float
    limits: tuple[str, ...]
    curve: StrokeCurve = field(repr=False)

    def near(self, share: float = 0.05) -> tuple[float, float]:
        """Shortest and longest stroke of the curve whose error is at most `share` above the best; NaN without one."""
        good = self.curve.strokes_m[self.curve.allowed_sigma_m <= (1.0 + share) * self.sigma_m]
        return (float(good[0]), float(good[-1])) if good.size else (math.nan, math.nan)


def best_stroke(
    depth_m: float,
    rig: Rig | None = None,
    *,
    covariance_rig: Array | None = None,
    stroke_sigma_m: float = 0.0,
    strokes_m: tuple[float, float] = STROKES_M,
    around: Surroundings | None = None,
    card: SensorCard | None = None,
    spot: SpotSigma | None = None,
) -> BestStroke:
    """Stroke with the smallest predicted error of D for a spot at a distance.

    Parameters
    ----------
    depth_m : float
        D, horizontal distance of the spot from the stroke axis.
    rig : Rig
        The default rig if not given.
    covariance_rig : shape (p, p)
        Of `rig_parameters.PARAMETERS`: a calibration's covariance, zeros for the pixels' noise alone. By
        default what a rig put together by hand is good for (`PRIOR_SIGMA`).
    stroke_sigma_m : float
        Error of the single stroke, besides what the parameters say of all strokes.
    strokes_m : tuple of float
        Shortest and longest stroke.
    around : Surroundings
        Heights, azimuths and laser of the spots, room height, robot, distance from edges.
    card : SensorCard
        Sensor and exposure; preset "mjpeg" if not given.
    spot : SpotSigma
        Bound of a coordinate by the spot's electrons; made from the card over a white wall of the lab if not given.
        Make it once with `spot_bound` where many distances are asked for.

    Returns
    -------
    BestStroke
        Best stroke with its error, and what limits it.

    Raises
    ------
    DatasetError
        If a number is out of its range.

    Examples
    --------
    >>> import numpy as np
    >>> from phibench.datasets.frames.sensor_card import sensor_card
    >>> from phibench.estimator.geometry.rig_parameters import PARAMETERS
    >>> exact = np.zeros((len(PARAMETERS),) * 2)
    >>> best = best_stroke(1.0, covariance_rig=exact, strokes_m=(0.1, 2.0), card=sensor_card("bayer-raw"))
    >>> best.limits
    ()
    """
    _check(depth_m, strokes_m, stroke_sigma_m)
    rig, card = rig or Rig(), card or sensor_card("mjpeg")
    covariance = np.diag(prior_sigmas() ** 2) if covariance_rig is None else np.asarray(covariance_rig, float)
    _check_covariance(covariance)
    curve_of = partial(
        stroke_curve,
        rig,
        depth_m,
        spot=spot or spot_bound(rig, card),
        covariance_rig=covariance,
        around=around or Surroundings(),
        exposure_s=card.exposure_s,
        stroke_sigma_m=stroke_sigma_m,
    )
    curve = curve_of(strokes_m=stroke_grid(*strokes_m))
    if not np.isfinite(curve.allowed_sigma_m).any():
        nothing = (math.nan,) * 6  # all of `BestStroke` between D and its limits
        return BestStroke(depth_m, *nothing, tuple(dict.fromkeys(curve.causes)), curve)
    index = int(np.argmin(curve.allowed_sigma_m))
    # the minimum lies between the two neighbours of the best stroke of the grid
    fine = curve_of(strokes_m=np.linspace(*grid_neighbours(curve.strokes_m.tolist(), index), _FINE))
    at = int(np.argmin(fine.allowed_sigma_m))
    return BestStroke(
        depth_m=depth_m,
        stroke_m=float(fine.strokes_m[at]),
        sigma_m=float(fine.sigma_m[at]),
        sigma_spot_m=float(fine.sigma_spot_m[at]),
        sigma_calibration_m=float(fine.sigma_calibration_m[at]),
        sigma_stroke_m=float(fine.sigma_stroke_m[at]),
        sigma_higher_order_m=float(fine.sigma_higher_order_m[at]),
        limits=_limits(curve, index),
        curve=curve,
    )


def spot_bound(rig: Rig, card: SensorCard) -> SpotSigma:
    """Bound by the spot's electrons for a rig and a sensor, over a white wall.

    Parameters
    ----------
    rig : Rig
        Its blur half way out in the mirror's image.
    card : SensorCard
        Sensor whose noise counts.
    """
    centre = rig.camera.project(rig.sphere_in_camera_m)
    rim = rig.outline_px(4)[0]
    blur = spot_blur(rig, 0.4 * centre + 0.6 * rim)  # one place stands for all: defocus changes little over the mirror
    r, g, b = rig.camera.detector.laser_filter_response
    # the background costs information by its own shot noise
    room = [rate * card.exposure_s for rate in ROOM_E_PER_S]
    # behind the processing every flux costs a covariance of the codes; the bound is smooth enough for 9 of them
    fluxes = np.geomspace(100.0, 1e6, 25 if card.output == "raw" else 9)
    return spot_sigma(card, blur.round_px, room, (r, g, b), flux_e=tuple(fluxes.tolist()))


def _limits(curve: StrokeCurve, index: int) -> tuple[str, ...]:
    """Causes beside the best element of a curve on the side where the error would fall further."""
    # "not a >= b" holds for NaN too: a stroke without any error, such as one behind the rim, limits as well
    last, sigma = len(curve.strokes_m) - 1, curve.sigma_m
    limits = []
    if index == 0 and sigma[0] < sigma[1]:
        limits.append(LEAST)
    elif index > 0 and curve.causes[index - 1] != FREE and not sigma[index - 1] >= sigma[index]:
        limits.append(curve.causes[index - 1])
    if index == last and sigma[last] < sigma[last - 1]:
        limits.append(LARGEST)
    elif index < last and curve.causes[index + 1] != FREE and not sigma[index + 1] >= sigma[index]:
        limits.append(curve.causes[index + 1])
    return tuple(dict.fromkeys(limits))


def _check(depth_m: float, strokes_m: tuple[float, float], stroke_sigma_m: float) -> None:
    if not _DEPTH_M[0] <= depth_m <= _DEPTH_M[1]:
        raise DatasetError(f"depth_m = {depth_m:g}: must be {_DEPTH_M[0]:g} to {_DEPTH_M[1]:g} m")
    low, high = strokes_m
    if not _STROKE_M[0] <= low < high <= _STROKE_M[1]:
        raise DatasetError(
            f"strokes_m = ({low:g}, {high:g}): must be two rising numbers from {_STROKE_M[0]:g} to {_STROKE_M[1]:g} m"
        )
    if not 0.0 <= stroke_sigma_m < math.inf:
        raise DatasetError(f"stroke_sigma_m = {stroke_sigma_m:g}: must be 0 or above")


def _check_covariance(covariance: Array) -> None:
    p = len(PARAMETERS)
    if covariance.shape != (p, p):
        raise DatasetError(f"covariance_rig has the shape {covariance.shape}: must be ({p}, {p}), see PARAMETERS")
    # a singular covariance has eigenvalues 0, which rounding may make negative
    if not np.isfinite(covariance).all() or np.linalg.eigvalsh(0.5 * (covariance + covariance.T)).min() < -1e-12:
        raise DatasetError("covariance_rig is no covariance: it must be finite and positive semi-definite")
