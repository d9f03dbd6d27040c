"""Predicted error of depth D against the stroke h, higher orders included, and the causes that rule a stroke out.

Beyond first order, rigs are drawn in pairs of opposite deviations. The error of D of a rig that deviates by p is
e(p) = g p + p H p / 2 + third order + ... Of the pair p, -p, half the sum of both errors is the even part, to which the
linear prediction is blind, and half the difference is the odd part: the linear one with the third order. The even part
matters where the linear part passes through 0: a tilt of half a degree does so near h = 0.3 D. The third order adds
28 % to the linear part at D = 2.18 m, h = 0.45 m and takes 14 % off at 1.4 m. The even part is no scatter about 0: its
mean, some -40 mm for a rig as built at D = 2.18 m and h = 0.9 m, is a bias of `depth_general`, which takes D at the
nominal rig.

A rig raised by h sees a point as a rig that stays sees the point lowered by h, so that all strokes are one array.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
import scipy
from numpy.typing import NDArray

from phibench.estimator.geometry.least_squares_depth import depth_general
from phibench.estimator.geometry.line_of_sight import first_blocker
from phibench.estimator.geometry.reflection import MirrorImage, image_of, reflect
from phibench.estimator.geometry.rig_parameters import PARAMETERS, changed_rig, stroke_of
from phibench.estimator.geometry.status import Status
from phibench.estimator.limits.processed_bound import SpotSigma
from phibench.estimator.spots.spot_prediction import Laser, spot_electrons_per_s
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig
from phibench.scenes.room import escalade360

_PAIRS = 32  # within 2.5 % of what 128 give
_STEP = 0.1  # of a sigma, for first derivatives: third order is then 1 % of what it is at one sigma
_SEED = 0  # the scramble is part of the rule, not a noise draw
_LOG_STEP = 0.35  # the part is smooth in the logarithm of the stroke: interpolated between


# -- curve -----------------------------------------------------------------------------------------------------------

FREE = ""
"""Cause of a stroke that nothing stands in the way of."""
CEILING, NO_IMAGE, MIRROR_EDGE, IMAGE_EDGE, OCCLUDED = (
    "ceiling",
    "no image in the mirror",
    "mirror's edge",
    "image's edge",
    "occluded by",  # and the name of the solid
)
TOO_BRIGHT, TOO_FAINT, NO_BOUND = (
    "the spot is brighter than the bound is known for",
    "the spot is fainter than the bound is known for",
    "no finite error of D",
)
"""Causes of strokes that nothing stands in the way of, but whose error is not known."""


@dataclass(frozen=True)
class Surroundings:
    """Places of the spots, their light, and what bounds the strokes besides the carriage.

    Parameters
    ----------
    heights_m : tuple of float
        Heights of the spots above the floor; the error is the root mean square over them.
    azimuths_rad : tuple of float
        Directions of the spots, as a tilt or a decentre matters along the spot's azimuth only; likewise.
    room_height_m : float
        The mirror's top stays below it.
    robot : bool
        The robot, its mast and the camera's housing may stand in the way.
    edge_px : float
        Least distance of a spot from the edge of the mirror and of the image: the blur's skirt and the fit's window.
    laser : Laser
        Spot and its light.
    """

    heights_m: tuple[float, ...] = (0.5,)
    azimuths_rad: tuple[float, ...] = tuple(2.0 * math.pi * k / 8.0 for k in range(8))
    room_height_m: float = 3.0
    robot: bool = True
    edge_px: float = 4.0
    laser: Laser = Laser()

    def points_m(self, rig: Rig, depth_m: float) -> Array:
        """Places of the spots, shape (m, 3), about the vertical line through the sphere centre when down."""
        axis = rig.at(0.0).sphere_centre_m
        return np.array(
            [
                (axis[0] + depth_m * math.cos(a), axis[1] + depth_m * math.sin(a), z)
                for z in self.heights_m
                for a in self.azimuths_rad
            ]
        )

    def wall_normals(self) -> Array:
        """Normals of upright walls that face the axis, shape (m, 3)."""
        return np.array([(-math.cos(a), -math.sin(a), 0.0) for _ in self.heights_m for a in self.azimuths_rad])


@dataclass(frozen=True)
class StrokeCurve:
    """Predicted error of D by stroke, shape (n,), metres; root mean square over the places of the spot.

    Attributes
    ----------
    sigma_spot_m, sigma_calibration_m, sigma_stroke_m
        From the pixels' noise, the rig's parameters and the single stroke, to first order; NaN where the spot has no
        image.
    sigma_higher_order_m
        What the rig's parameters do beyond, a mean error (bias) included: `beyond_first_order_m`.
    causes : tuple of str
        Cause that a stroke cannot be taken, or that its error is not known; `FREE` where neither.
    """

    strokes_m: Array
    sigma_spot_m: Array = field(repr=False)
    sigma_calibration_m: Array = field(repr=False)
    sigma_stroke_m: Array = field(repr=False)
    sigma_higher_order_m: Array = field(repr=False)
    causes: tuple[str, ...] = field(repr=False)

    @property
    def sigma_m(self) -> Array:
        """All parts together: their squares add up."""
        parts = (self.sigma_spot_m, self.sigma_calibration_m, self.sigma_stroke_m, self.sigma_higher_order_m)
        return np.asarray(np.sqrt(sum(error_m**2 for error_m in parts)))

    @property
    def allowed_sigma_m(self) -> Array:
        """All parts together, infinite where the stroke cannot be taken."""
        free = np.array([cause == FREE for cause in self.causes])
        return np.where(free & np.isfinite(self.sigma_m), self.sigma_m, np.inf)


def stroke_curve(
    rig: Rig,
    depth_m: float,
    strokes_m: Array,
    spot: SpotSigma,
    covariance_rig: Array,
    around: Surroundings,
    exposure_s: float,
    stroke_sigma_m: float,
) -> StrokeCurve:
    """Predicted error of D for strokes, shape (n,); parameters as for `best_stroke.best_stroke`."""
    h, points = np.asarray(strokes_m, float), around.points_m(rig, depth_m)
    images = [_images(rig, points, offset) for offset in (np.zeros(1), h)]
    # walls face the axis, so that the cosine is that of an upright wall at this azimuth
    electrons = [spot_electrons_per_s(rig, around.laser, image, around.wall_normals()) * exposure_s for image in images]
    C_down, C_up = (_covariance(image, spot, light) for image, light in zip(images, electrons, strict=True))
    down, up = (image.uv_px for image in images)
    depth = depth_general(rig, h[:, None], down, up, C_down, C_up, covariance_rig, np.asarray(stroke_sigma_m))
    parts = (depth.sigma_spot_m, depth.sigma_calibration_m, depth.sigma_stroke_m)
    of_spot, of_rig, of_stroke = (np.sqrt(np.mean(errors_m**2, axis=-1)) for errors_m in parts)
    even = beyond_first_order_m(rig, h, points, C_down, C_up, covariance_rig, stroke_sigma_m)
    curve = StrokeCurve(h, of_spot, of_rig, of_stroke, even, causes(rig, points, images[0], images[1], h, around))
    return replace(curve, causes=_with_unknown(curve, spot, electrons[0], electrons[1]))


def causes(
    rig: Rig, points_m: Array, down: MirrorImage, up: MirrorImage, strokes_m: Array, around: Surroundings
) -> tuple[str, ...]:
    """Cause that each stroke, shape (n,), cannot be taken for spots at all of the points, shape (m, 3)."""
    first = _fault(rig, points_m, down.uv_px[0], 0.0, around)
    return tuple(
        first or _fault(rig, points_m, uv, float(h), around) for uv, h in zip(up.uv_px, strokes_m, strict=True)
    )


def _fault(rig: Rig, points_m: Array, uv_px: Array, offset_m: float, around: Surroundings) -> str:
    """Cause that the rig at one offset does not see all of the points, which it has at pixels (m, 2)."""
    view = rig.at(offset_m)
    if view.sphere_centre_m[2] + rig.mirror.bound_m > around.room_height_m:
        return CEILING
    if not np.isfinite(uv_px).all():
        return NO_IMAGE
    if np.any(outline_distance_px(rig, uv_px) < around.edge_px):
        return MIRROR_EDGE
    if not np.all(rig.camera.contains(uv_px - around.edge_px) & rig.camera.contains(uv_px + around.edge_px)):
        return IMAGE_EDGE
    if not around.robot:
        return FREE
    mirror = reflect(view, uv_px).origin_world_m
    eye = np.broadcast_to(view.camera_centre_m, mirror.shape)
    name = first_blocker(escalade360(view), ((mirror, points_m), (eye, mirror)))
    return FREE if name is None else f"{OCCLUDED} {name}"


def _images(rig: Rig, points_m: Array, offsets_m: Array) -> MirrorImage:
    """Images of points, shape (m, 3), from offsets, shape (n,), of the carriage: shape (n, m)."""
    # the rig up by h sees what the rig down sees of a point lower by h
    lowered = points_m - offsets_m[:, None, None] * np.array(rig.stroke_axis_world)
    return image_of(rig.at(0.0), lowered)


def _with_unknown(curve: StrokeCurve, spot: SpotSigma, down_e: Array, up_e: Array) -> tuple[str, ...]:
    """Causes, with those of free strokes whose error is not known; spots' electrons (1, m) and (n, m)."""
    # a stroke is unknown if either of its images is
    light_e = np.concatenate([np.broadcast_to(down_e, up_e.shape), up_e], axis=-1)
    unknown = np.select(
        [(light_e > spot.flux_e[-1]).any(axis=-1), (light_e < spot.flux_e[0]).any(axis=-1)],
        [TOO_BRIGHT, TOO_FAINT],
        NO_BOUND,
    )
    known = np.isfinite(curve.sigma_m)
    return tuple(
        str(why) if cause == FREE and not fine else cause
        for cause, fine, why in zip(curve.causes, known, unknown, strict=True)
    )


def _covariance(image: MirrorImage, spot: SpotSigma, electrons: Array) -> Array:
    variance = np.where(image.status == Status.OK, spot.at(electrons) ** 2, np.nan)
    return np.asarray(np.where(np.isfinite(variance), variance, np.nan)[..., None, None] * np.eye(2))


def outline_distance_px(rig: Rig, uv_px: Array) -> Array:
    """Distance of pixels, shape (m, 2), from the mirror's outline, inwards: angle times focal length.

    That of a mirror that is no sphere is a polygon in the image.
    """
    radius_m = rig.mirror.radius_m
    if radius_m is None:
        corners = rig.outline_px()
        side, to = np.roll(corners, -1, axis=0) - corners, uv_px[:, None] - corners
        # nearest place on each side of the polygon of the outline
        share = np.clip(np.sum(to * side, axis=-1) / np.sum(side * side, axis=-1), 0.0, 1.0)
        near = np.linalg.norm(to - share[..., None] * side, axis=-1).min(axis=-1)
        return np.where(reflect(rig.at(0.0), uv_px).status == Status.OK, near, -near)
    centre = rig.sphere_in_camera_m
    away = np.arccos(np.clip(rig.camera.rays(uv_px) @ centre / np.linalg.norm(centre), -1.0, 1.0))
    # a sphere is seen under the half angle asin(R / distance)
    rim = math.asin(radius_m / float(np.linalg.norm(centre)))
    return np.asarray((rim - away) * rig.camera.fx_px)


def stroke_grid(low_m: float, high_m: float, count: int = 81) -> Array:
    """Strokes from low to high, evenly in their logarithm."""
    return np.geomspace(low_m, high_m, count)  # the error of D goes with ratios of strokes


def grid_neighbours(grid: Sequence[float], index: int) -> tuple[float, float]:
    """Values before and after an element."""
    return grid[max(index - 1, 0)], grid[min(index + 1, len(grid) - 1)]


# -- beyond first order ----------------------------------------------------------------------------------------------


def covariance_root(covariance: Array) -> Array:
    """Matrix A with A A^T = C, shape (p, p), of a covariance that may be singular and has mixed units."""
    # metres, radians and pixels: the correlation matrix has no units, and its eigenvalues are comparable
    scale = np.sqrt(np.diag(covariance))
    safe = np.where(scale > 0.0, scale, 1.0)
    value, vector = np.linalg.eigh(covariance / np.outer(safe, safe))
    return np.asarray(safe[:, None] * vector * np.sqrt(np.maximum(value, 0.0)))


def beyond_first_order_m(
    rig: Rig,
    strokes_m: Array,
    points_m: Array,
    covariance_down_px2: Array,
    covariance_up_px2: Array,
    covariance_rig: Array,
    stroke_sigma_m: float,
) -> Array:
    """Root of the mean square error of D beyond first order, over rigs and points, shape (n,), metres.

    Even part squared, bias included, plus odd part squared less linear part squared of the same rigs; 0 where the
    higher orders make the error smaller than the linear one.

    Parameters
    ----------
    rig : Rig, the nominal one
    strokes_m : shape (n,), rising
    points_m : shape (m, 3)
    covariance_down_px2, covariance_up_px2 : shapes (1 or n, m, 2, 2)
    covariance_rig : shape (p, p)
    """
    if not np.any(covariance_rig):
        return np.zeros(len(strokes_m))
    chosen = _chosen(strokes_m)
    h, up_px2 = strokes_m[chosen], np.broadcast_to(covariance_up_px2, (len(strokes_m), *covariance_up_px2.shape[1:]))
    root, normals = covariance_root(covariance_rig), _normals(_PAIRS)
    # rigs at random, then a small step along each column of the root, for the linear part
    deviations = np.concatenate([normals @ root.T, _STEP * root.T])
    seen = [_seen(rig, v, h, points_m) for v in (*deviations, *-deviations)]
    down, up, true = (np.stack(column) for column in zip(*seen, strict=True))
    C_down, C_up = covariance_down_px2, up_px2[chosen]
    depth = depth_general(rig, h[:, None], down, up, C_down, C_up, covariance_rig, np.asarray(stroke_sigma_m))
    square_m2 = _between(strokes_m, h, _beyond_m2(depth.depth_m - true, normals))
    return np.asarray(np.sqrt(np.maximum(square_m2, 0.0)))


def _beyond_m2(errors_m: Array, normals: Array) -> Array:
    """Mean square beyond first order, shape (n,), of errors (2 (k + p), n, m): rigs, steps, and their opposites."""
    plus, minus = np.split(errors_m, 2)
    # opposite rigs: the odd part holds first and third order, the even one second and fourth
    even, odd = 0.5 * (plus + minus), 0.5 * (plus - minus)
    k = len(normals)
    linear = np.einsum("kp,pnm->knm", normals, odd[k:] / _STEP)
    # what the first-order formula has already counted is taken off
    return np.asarray(np.mean(even[:k] ** 2 + odd[:k] ** 2 - linear**2, axis=(0, 2)))


def _between(strokes_m: Array, known_m: Array, values: Array) -> Array:
    """Values at strokes, from those at known ones, smoothly in the logarithm; NaN beyond the finite ones."""
    finite = np.isfinite(values)
    if finite.sum() < 2:  # nothing to interpolate between
        return np.where(np.isin(strokes_m, known_m[finite]), values[finite].sum(), np.nan)
    smooth = scipy.interpolate.PchipInterpolator(np.log(known_m[finite]), values[finite], extrapolate=False)
    return np.asarray(smooth(np.log(strokes_m)))


def _seen(rig: Rig, values: Array, strokes_m: Array, points_m: Array) -> tuple[Array, Array, Array]:
    """Down pixels (1, m, 2), up pixels (n, m, 2) and true D (1, m) of a rig that deviates."""
    true = changed_rig(rig, values)
    view, axis = true.at(0.0), np.array(true.stroke_axis_world)
    offsets = np.append(0.0, stroke_of(strokes_m, values))
    pixels = image_of(view, points_m - offsets[:, None, None] * axis).uv_px  # both at once: a call's own time counts
    up = pixels[1:]
    down = np.broadcast_to(pixels[:1], up.shape)
    # the true D counts from the mirror of the rig that deviates
    away = points_m[:, :2] - view.sphere_centre_m[:2]
    return down, up, np.hypot(away[:, 0], away[:, 1])[None]


def _chosen(strokes_m: Array) -> NDArray[np.int64]:
    """Indices of strokes of which no two neighbours are further apart than the step, the ends among them."""
    goals = np.arange(np.log(strokes_m[0]), np.log(strokes_m[-1]), _LOG_STEP)
    nearest = np.searchsorted(np.log(strokes_m), goals, side="right") - 1
    return np.unique([*nearest.tolist(), 0, len(strokes_m) - 1]).astype(np.int64)


@lru_cache(maxsize=1)
def _normals(count: int) -> Array:
    """Quasi-random normal numbers, shape (count, p)."""
    p = len(PARAMETERS)
    engine = scipy.stats.qmc.Sobol(p, scramble=True, rng=_SEED)
    return np.asarray(scipy.stats.qmc.MultivariateNormalQMC(np.zeros(p), engine=engine, rng=_SEED).random(count))
