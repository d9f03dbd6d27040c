"""Errors of D where the rig is misaligned and the estimator does not know it.

A spot's place in both images is that of the true rig's chief ray; a place outside of the image is none. The error is
(estimate - D) / D, with D from the true sphere, as everywhere; its *change* is the error less that of the aligned rig,
so that what an estimator has wrong anyway (a convention of phi) is no cost of the misalignment.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from phibench.estimator.calibration.bundle import Bundle
from phibench.estimator.mirror_image import image_of
from phibench.estimator.score import ESTIMATORS
from phibench.estimator.sensitivities import PARAMETERS as ANALYTIC
from phibench.estimator.sensitivities import sensitivity
from phibench.estimator.triangulate import depth_exact
from phibench.scenes.checks import SceneError
from phibench.scenes.frames import Array
from phibench.scenes.laser import LaserSpot, beam_diameter_m
from phibench.scenes.misalignment import PARAMETERS, Misalignment
from phibench.scenes.rig import Rig, View

NOMINAL = ("paper_ray", "paper_normal", "paper_incidence", "paper_outline", "exact")
CALIBRATED = "exact_calibrated"
_SMALL = 0.01  # of the study's magnitude: step of a slope that nothing gives in closed form

Calibrate = Callable[[Misalignment], Bundle]
"""A true rig's misalignment to what a calibration of the nominal one makes of it."""


@dataclass(frozen=True)
class Places:
    """Spots of one stroke, on circles about the stroke axis.

    Parameters
    ----------
    depths_m : shape (d,)
    azimuths_rad : shape (a,)
    height_m : float, above the floor
    stroke_m : float
    """

    depths_m: Array
    azimuths_rad: Array
    height_m: float
    stroke_m: float
    points_m: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        D, a = np.asarray(self.depths_m, float)[:, None], np.asarray(self.azimuths_rad, float)
        flat = (D * np.cos(a), D * np.sin(a), np.full((D.size, a.size), self.height_m))
        object.__setattr__(self, "points_m", np.stack(flat, axis=-1))


def seen_px(view: View, points_m: Array) -> Array:
    """Pixels (..., 2) of points (..., 3); NaN where the image does not show them."""
    uv = image_of(view, points_m).uv_px
    return np.where(view.rig.camera.contains(uv)[..., None], uv, np.nan)


def pixels(nominal: Rig, misalignment: Misalignment, places: Places) -> tuple[Array, Array]:
    """Pixels of all spots, shape (d, a, 2), in the down and the up image of the misaligned rig; NaN if it cannot be."""
    try:
        true, h = nominal.perturbed(misalignment), misalignment.stroke_m(places.stroke_m)
    except SceneError:
        nothing = np.full((*places.points_m.shape[:-1], 2), np.nan)
        return nothing, nothing
    return seen_px(true.at(0.0), places.points_m), seen_px(true.at(h), places.points_m)


def errors(nominal: Rig, misalignment: Misalignment, places: Places, names: tuple[str, ...] = NOMINAL) -> Array:
    """Relative errors of D, shape (estimators, d, a), by estimators that believe the nominal rig; NaN without one."""
    down, up = pixels(nominal, misalignment, places)
    D = true_depth_m(nominal, misalignment, places)
    return np.stack([ESTIMATORS[name](nominal, places.stroke_m, down, up).depth_m / D - 1.0 for name in names])


def calibrated_errors(nominal: Rig, misalignment: Misalignment, places: Places, calibrate: Calibrate) -> Array:
    """The same of the exact estimator with a rig calibrated for this misalignment, shape (d, a)."""
    down, up = pixels(nominal, misalignment, places)
    found = calibrate(misalignment)
    h = found.stroke(np.asarray(places.stroke_m))
    return depth_exact(found.rig, h, down, up).depth_m / true_depth_m(nominal, misalignment, places) - 1.0


def true_depth_m(nominal: Rig, misalignment: Misalignment, places: Places) -> Array:
    """D from the true sphere, shape (d, a)."""
    try:
        centre = nominal.perturbed(misalignment).at(0.0).sphere_centre_m
    except SceneError:
        return np.full(places.points_m.shape[:-1], np.nan)
    return np.hypot(*np.moveaxis(places.points_m - centre, -1, 0)[:2])


def slopes(nominal: Rig, places: Places, names: tuple[str, ...] = NOMINAL) -> dict[str, Array]:
    """Derivatives of the relative error by every parameter at the aligned rig, shape (estimators, d, a) each.

    Analytic where `sensitivities` has them, else differences of the whole change.
    """
    found = np.array([[_gradients(name, nominal, places, p) for p in _flat(places)] for name in names])
    shape = (len(names), *places.points_m.shape[:-1])
    result = {}
    for name, one in PARAMETERS.items():
        if name in ANALYTIC:
            result[name] = found[..., ANALYTIC.index(name)].reshape(shape)
        else:
            step = _SMALL * one.study
            both = [errors(nominal, Misalignment(**{name: s * step}), places, names) for s in (1.0, -1.0)]
            result[name] = (both[0] - both[1]) / (2.0 * step)
    return result


def spot_of(point_m: Array) -> LaserSpot:
    """Laser spot of the default size on a wall that faces the stroke axis."""
    D = float(np.hypot(point_m[0], point_m[1]))
    return LaserSpot(
        tuple(float(x) for x in point_m), (-float(point_m[0]) / D, -float(point_m[1]) / D, 0.0), beam_diameter_m(D)
    )


def _gradients(name: str, nominal: Rig, places: Places, point_m: Array) -> Array:
    found = sensitivity(name, nominal, places.stroke_m, nominal, places.stroke_m, point_m)
    D = float(np.hypot(point_m[0], point_m[1]))
    # d(estimate / D - 1) = d estimate / D - estimate dD / D^2
    return (found.estimate_gradient - found.estimate_m / D * found.truth_gradient) / D


def _flat(places: Places) -> Array:
    return places.points_m.reshape(-1, 3)
