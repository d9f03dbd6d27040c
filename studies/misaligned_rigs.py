"""For several studies: errors of D of misaligned rigs (one, thousands, rendered spots), and a simulated calibration.

A spot's pixel in either image is that of the true rig's chief ray; a pixel outside of the image counts as none. The
error is (estimate - D) / D, with D from the true sphere. Its *change* is the error less that of the aligned rig. So an
error of the estimator itself (a convention of phi) is no cost of the misalignment.

Four parts follow each other: one rig at a time (`errors`, `slopes`); thousands of rigs as arrays (`errors_of_many`);
rendered spots, whose centroids confirm the chief rays (`rendered_deviations`); and a simulated calibration
(`CalibrationSetup`). The second part takes spheres only, and chief rays from the simulator's solution of Alhazen's
problem. So it is also a check of the first, which takes the estimator's.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from phibench.calibration.outline.outline_result import PoseMeasurement
from phibench.calibration.rig.bundle import Bundle, KnownSpot, apparent_outline, calibrate
from phibench.datasets.common.errors import DatasetError
from phibench.estimator.geometry.reflection import image_of
from phibench.estimator.geometry.rig_parameters import PRIOR_SIGMA, prior_sigmas
from phibench.estimator.geometry.sensitivities import PARAMETERS as ANALYTIC
from phibench.estimator.geometry.sensitivities import sensitivity
from phibench.estimator.geometry.triangulate import ESTIMATORS, depth_exact, exact_gradient
from phibench.render.optics.reflection_point import reflection_points
from phibench.render.optics.spot_layer import spot_layer
from phibench.scenes.frames import Array
from phibench.scenes.laser import LaserSpot, beam_diameter_m
from phibench.scenes.mirror import OF_REVOLVED
from phibench.scenes.misalignment import PARAMETERS, Misalignment
from phibench.scenes.rig import Rig, View
from phibench.scenes.validation import SceneError

NOMINAL = ("paper_ray", "paper_normal", "paper_incidence", "paper_outline", "exact")
CALIBRATED = "exact_calibrated"
ALL = tuple(name for name in PARAMETERS if name not in OF_REVOLVED)
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
    """Relative errors of D, shape (estimators, d, a), by estimators with the nominal rig; NaN without one."""
    down, up = pixels(nominal, misalignment, places)
    D = true_depth_m(nominal, misalignment, places)
    return np.stack([ESTIMATORS[name](nominal, places.stroke_m, down, up).depth_m / D - 1.0 for name in names])


def calibrated_errors(nominal: Rig, misalignment: Misalignment, places: Places, calibrate: Calibrate) -> Array:
    """The same of the exact estimator with a rig calibrated for this misalignment, shape (d, a)."""
    down, up = pixels(nominal, misalignment, places)
    calibration = calibrate(misalignment)
    h = calibration.stroke(np.asarray(places.stroke_m))
    return depth_exact(calibration.rig, h, down, up).depth_m / true_depth_m(nominal, misalignment, places) - 1.0


def true_depth_m(nominal: Rig, misalignment: Misalignment, places: Places) -> Array:
    """D from the true sphere, shape (d, a)."""
    try:
        centre = nominal.perturbed(misalignment).at(0.0).sphere_centre_m
    except SceneError:
        return np.full(places.points_m.shape[:-1], np.nan)
    return np.hypot(*np.moveaxis(places.points_m - centre, -1, 0)[:2])


def slopes(
    nominal: Rig, places: Places, names: tuple[str, ...] = NOMINAL, parameters: Sequence[str] = ALL
) -> dict[str, Array]:
    """Derivatives of the relative error by parameters at the aligned rig, shape (estimators, d, a) each.

    Analytic where `sensitivities` has them, else differences of the whole change.
    """
    gradients = np.array([[_gradients(name, nominal, places, p) for p in _flat(places)] for name in names])
    shape = (len(names), *places.points_m.shape[:-1])
    result = {}
    for name in parameters:
        if name in ANALYTIC:
            result[name] = gradients[..., ANALYTIC.index(name)].reshape(shape)
        else:
            step = _SMALL * PARAMETERS[name].study
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
    gradient = sensitivity(name, nominal, places.stroke_m, nominal, places.stroke_m, point_m)
    D = float(np.hypot(point_m[0], point_m[1]))
    # d(estimate / D - 1) = d estimate / D - estimate dD / D^2
    return (gradient.estimate_gradient - gradient.estimate_m / D * gradient.truth_gradient) / D


def _flat(places: Places) -> Array:
    return places.points_m.reshape(-1, 3)


# -- many rigs at once -----------------------------------------------------------------------------------------------

_BROWN = ("k1", "k2", "k3", "p1", "p2")
_LENS = ("fx_px", "fy_px", "cx_px", "cy_px")


@dataclass(frozen=True)
class _Views:
    """Views of m rigs: lens and sphere centres (m, 3), camera axes (m, 3, 3), radii (m,), camera numbers (m, 9)."""

    lens_m: Array
    sphere_m: Array
    axes: Array
    radius_m: Array
    numbers: Array


def errors_of_many(nominal: Rig, drawn: Sequence[Misalignment], places: Places, names: tuple[str, ...]) -> Array:
    """Relative errors of D, shape (m, estimators, d, a), as `errors` has them for one rig.

    A distortion that folds the image is not refused here: check the largest coefficients beforehand.

    Raises
    ------
    ValueError
        If a mirror has an error of form.
    """
    undistorted = [nominal.perturbed(replace(m, **dict.fromkeys(_BROWN, 0.0))) for m in drawn]
    if any(rig.sphere.form is not None for rig in undistorted):
        raise ValueError("errors_of_many: a mirror has an error of form; spheres only")
    down = _views([rig.at(0.0) for rig in undistorted], drawn)
    up = _views([rig.at(m.stroke_m(places.stroke_m)) for rig, m in zip(undistorted, drawn, strict=True)], drawn)
    seen = [_seen_px(views, places.points_m, nominal) for views in (down, up)]
    D = np.hypot(*np.moveaxis(places.points_m - down.sphere_m[:, None, None], -1, 0)[:2])
    return np.stack([ESTIMATORS[name](nominal, places.stroke_m, *seen).depth_m / D - 1.0 for name in names], axis=1)


def _views(views: Sequence[View], drawn: Sequence[Misalignment]) -> _Views:
    lens = [[getattr(view.rig.camera, name) for name in _LENS] for view in views]
    brown = [
        [getattr(view.rig.camera, name) + getattr(m, name) for name in _BROWN]
        for view, m in zip(views, drawn, strict=True)
    ]
    return _Views(
        np.array([view.camera_centre_m for view in views]),
        np.array([view.sphere_centre_m for view in views]),
        np.array([view.T_world_camera.R for view in views]),
        np.array([view.rig.sphere.radius_m for view in views]),
        np.concatenate([lens, brown], axis=1),
    )


def _seen_px(views: _Views, points_m: Array, nominal: Rig) -> Array:
    """Pixels (m, d, a, 2) of points (d, a, 3); NaN outside of the image."""
    flat = points_m.reshape(-1, 3)
    m, k = len(views.radius_m), len(flat)
    radius, sphere = views.radius_m[:, None, None], views.sphere_m[:, None]
    points = ((flat - sphere) / radius).reshape(-1, 3)
    eyes = np.broadcast_to((views.lens_m[:, None] - sphere) / radius, (m, k, 3)).reshape(-1, 3)
    mirror, _ = reflection_points(points, eyes, 1.0)
    away = sphere + radius * mirror.reshape(m, k, 3) - views.lens_m[:, None]
    x, y, z = np.moveaxis(away @ views.axes, -1, 0)  # R^T of the pose, as rows
    fx, fy, cx, cy, k1, k2, k3, p1, p2 = views.numbers.T[:, :, None]
    x, y = x / z, y / z
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    u = fx * (x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)) + cx
    v = fy * (y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y) + cy
    uv = np.stack([u, v], axis=-1)
    return np.where(nominal.camera.contains(uv)[..., None], uv, np.nan).reshape(m, *points_m.shape[:-1], 2)


# -- rendered spots --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class RenderedDeviation:
    """One parameter at one value.

    Attributes
    ----------
    change : shape (estimators, d, a), relative change of D from rendered spots
    predicted : same, from the chief rays
    centroid_px : float
        Largest change of (centroid - chief ray), by the misalignment, in either image: what blur and aberrations do.
    explained : shape (d, a)
        Relative change of D of the exact estimator that 1 px of such a shift could make, at most.
    """

    parameter: str
    value: float
    change: Array
    predicted: Array
    centroid_px: float
    explained: Array


def rendered_deviations(nominal: Rig, places: Places, parameters: Sequence[str] = ALL) -> Iterator[RenderedDeviation]:
    """Parameters at the study's magnitude, one at a time."""
    aligned = _errors(nominal, Misalignment(), places)
    before = errors(nominal, Misalignment(), places)
    down, up = pixels(nominal, Misalignment(), places)
    per_px = np.abs(exact_gradient(nominal, places.stroke_m, down, up)).sum(axis=-1) / places.depths_m[:, None]
    for name in parameters:
        m = Misalignment(**{name: PARAMETERS[name].study})
        seen = _errors(nominal, m, places)
        moved = [np.abs(a - b).max() for a, b in zip(seen.beside_px, aligned.beside_px, strict=True)]
        predicted = errors(nominal, m, places) - before
        yield RenderedDeviation(
            name, PARAMETERS[name].study, seen.errors - aligned.errors, predicted, max(map(float, moved)), per_px
        )


@dataclass(frozen=True)
class _Seen:
    errors: Array
    beside_px: tuple[Array, Array]


def _errors(nominal: Rig, misalignment: Misalignment, places: Places) -> _Seen:
    """Relative errors (estimators, d, a) from rendered centroids, and centroids less chief rays in both images."""
    true, h = nominal.perturbed(misalignment), misalignment.stroke_m(places.stroke_m)
    centroids = [centroids_px(true.at(offset), places.points_m) for offset in (0.0, h)]
    D = true_depth_m(nominal, misalignment, places)
    estimates = [ESTIMATORS[name](nominal, places.stroke_m, *centroids).depth_m / D - 1.0 for name in NOMINAL]
    chief = pixels(nominal, misalignment, places)
    return _Seen(np.stack(estimates), (centroids[0] - chief[0], centroids[1] - chief[1]))


def centroids_px(view: View, points_m: Array) -> Array:
    """Centroids (..., 2) of the rendered images of spots at points (..., 3); nothing stands in the way."""
    return np.array([centroid_px(view, point) for point in points_m.reshape(-1, 3)]).reshape(*points_m.shape[:-1], 2)


def centroid_px(view: View, point_m: Array) -> tuple[float, float]:
    """Centroid of one spot's rendered layer, red plane: sums over pixels, as an estimator would form them.

    Raises
    ------
    DatasetError
        If no light reaches the image.
    """
    layer = spot_layer(view, spot_of(point_m), ())
    image = layer.electrons_per_s[0]
    if not image.sum() > 0.0:
        raise DatasetError(f"no light of a spot at {point_m.tolist()} reaches the image; choose other depths_m")
    v, u = np.mgrid[: image.shape[0], : image.shape[1]]
    return (layer.u0_px + float(np.sum(u * image) / image.sum()), layer.v0_px + float(np.sum(v * image) / image.sum()))


# -- a simulated calibration -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class CalibrationSetup:
    """Simulated calibration: the mirror's outline, and a few laser spots at known distances.

    Each number of the nominal rig counts as good as the study's magnitude says.

    Parameters
    ----------
    points_m : shape (k, 3)
        Calibration spots.
    pixel_sigma_px, distance_sigma_m : float
        Of a spot, in each image and axis, and of its distance from the stroke axis.
    outline_sigma_m : 3 floats
        Of the sphere centre from the outline, camera axes.
    """

    points_m: Array
    pixel_sigma_px: float
    distance_sigma_m: float
    outline_sigma_m: tuple[float, float, float]

    def calibrated(
        self, nominal: Rig, stroke_m: float, misalignment: Misalignment, rng: np.random.Generator | None = None
    ) -> Bundle:
        """Rig from exact measurements, or from measurements with noise from `rng`.

        Raises
        ------
        DatasetError
            If a calibration spot is not in the image, or the fit finds no start.
        """
        true, h = nominal.perturbed(misalignment), misalignment.stroke_m(stroke_m)
        outline = apparent_outline(nominal, true) + _noise(rng, np.array(self.outline_sigma_m))
        down, up = (seen_px(true.at(offset), self.points_m) for offset in (0.0, h))
        if not np.isfinite([down, up]).all():
            raise DatasetError("a calibration spot is not in the image of the misaligned rig")
        down, up = (uv + _noise(rng, np.full(uv.shape, self.pixel_sigma_px)) for uv in (down, up))
        centre = true.at(0.0).sphere_centre_m
        D = np.hypot(*(self.points_m - centre).T[:2])
        D = D + _noise(rng, np.full(D.shape, self.distance_sigma_m))
        C = self.pixel_sigma_px**2 * np.eye(2)
        spots = [
            KnownSpot(d, u, C, C, stroke_m, float(each), self.distance_sigma_m)
            for d, u, each in zip(down, up, D, strict=True)
        ]
        measured = PoseMeasurement(outline, np.diag(np.square(self.outline_sigma_m)))
        return calibrate(nominal, measured, spots, sigmas=nominal_sigmas())


def nominal_sigmas() -> Array:
    """Priors, shape (p,): the study's magnitudes, or the calibration's own where they are larger."""
    return prior_sigmas({name: max(sigma, PARAMETERS[name].study) for name, sigma in PRIOR_SIGMA.items()})


def _noise(rng: np.random.Generator | None, sigma: Array) -> Array:
    return np.zeros(sigma.shape) if rng is None else rng.normal(0.0, sigma)
