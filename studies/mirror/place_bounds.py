"""Places that a pair measures, the bound of D there, and the cost of every misalignment.

The blur of a spot differs between mirrors: a cone is flat along its side and focuses there much farther off than
across. D depends on the radius in the image alone, whose bound for a spot with the radial sigma s_r and the tangential
one s_t is taken from round spots of s = sqrt(s_r s_t):

    sigma_r = sigma_round(s) s_r / s.

Where the spot's own light is the noise, sigma_round grows as s, and where the background is, as s^2: sigma_r is then
s_r / sqrt(N) and proportional to s_r sqrt(s_r s_t), as for an elliptic Gaussian spot.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from phibench.datasets.frames.sensor_card import SensorCard
from phibench.estimator.geometry.reflection import MirrorImage, blocked, image_of, reflect
from phibench.estimator.geometry.status import Status
from phibench.estimator.geometry.triangulate import depth_exact
from phibench.estimator.limits.best_stroke import ROOM_E_PER_S
from phibench.estimator.limits.processed_bound import SpotSigma, spot_sigma
from phibench.estimator.limits.stroke_curve import outline_distance_px
from phibench.estimator.spots.gaussian_spot import SpotBlur
from phibench.estimator.spots.spot_prediction import Laser, spot_blur, spot_electrons_per_s
from phibench.scenes.frames import Array, BoolArray
from phibench.scenes.laser import Beam
from phibench.scenes.misalignment import PARAMETERS as MISALIGNMENT
from phibench.scenes.misalignment import Misalignment
from phibench.scenes.rig import Rig
from phibench.scenes.room import escalade360
from phibench.scenes.validation import SceneError

_WALL_NORMAL = np.array([-1.0, 0.0, 0.0])  # an upright wall along world x, facing the mirror
_FLOOR_M, _FLOOR_STEP_M = 0.1, 0.02  # nearest place of the floor that is tried, and from one to the next
_LARGEST = 256.0  # of the sizes that are tried, over the usual one
_NO_ERROR = 1e-9  # of D
_WIDER, _HALVINGS = 1.2, 6  # to 0.15 %: tables have two digits
_CHUNK = 500  # points whose distances from all sides of the outline are taken at once


# -- visibility --------------------------------------------------------------------------------------------------------


def measured(rig: Rig, points_m: Array, stroke_m: float, edge_px: float, azimuths_rad: Array) -> BoolArray:
    """Places that both images of a pair show, from every one of the azimuths, shape (n,).

    Parameters
    ----------
    rig : Rig, aligned
    points_m : shape (n, 3), in the upright plane through world x
    stroke_m : float
    edge_px : float
        Least distance from the outline of the mirror and from the edge of the image.
    azimuths_rad : shape (a,)
        The places are turned about the mirror's axis; what the robot hides differs between them.
    """
    turned = [points_m @ _about_z(a).T for a in azimuths_rad]
    fine = [shown(rig, points_m, offset, edge_px) for offset in (0.0, stroke_m)]
    free = [unhidden(rig, points, offset) for points in turned for offset in (0.0, stroke_m)]
    return np.asarray(np.all([*fine, *free], axis=0))


def shown(rig: Rig, points_m: Array, offset_m: float, edge_px: float) -> BoolArray:
    """Places whose image lies inside the mirror's and the camera's, shape (n,); the robot is not asked."""
    parts = np.array_split(points_m, max(len(points_m) // _CHUNK, 1))
    return np.concatenate([_shown(rig, points, offset_m, edge_px) for points in parts])


def _shown(rig: Rig, points_m: Array, offset_m: float, edge_px: float) -> BoolArray:
    image = _image(rig, points_m, offset_m)
    seen = np.asarray(image.status == Status.OK)
    uv = np.where(seen[:, None], image.uv_px, rig.camera.project(rig.sphere_in_camera_m))
    inside = rig.camera.contains(uv - edge_px) & rig.camera.contains(uv + edge_px)
    return np.asarray(seen & inside & (outline_distance_px(rig, uv) >= edge_px))


def unhidden(rig: Rig, points_m: Array, offset_m: float) -> BoolArray:
    """Places that robot, mast and housing do not hide on the way to the mirror, shape (n,)."""
    view, image = rig.at(offset_m), _image(rig, points_m, offset_m)
    mirror = reflect(view, image.uv_px).origin_world_m
    known = np.asarray(np.isfinite(mirror).all(axis=-1))
    start = np.where(known[:, None], mirror, view.sphere_centre_m)
    solids = escalade360(view)
    inside = [_holds(solid.T_world_shape.inverse().points(points_m), solid.size_m) for solid in solids]
    return np.asarray(known & ~np.any([*inside, *(blocked(solid, start, points_m) for solid in solids)], axis=0))


def _holds(points_m: Array, size_m: Sequence[float]) -> BoolArray:
    return np.asarray(np.all(np.abs(points_m) <= 0.5 * np.array(size_m), axis=-1))


def _image(rig: Rig, points_m: Array, offset_m: float) -> MirrorImage:
    """Image of places by a raised rig: that of lowered places by the rig where it is."""
    return image_of(rig.at(0.0), points_m - offset_m * np.array(rig.stroke_axis_world))


def _about_z(angle_rad: float) -> Array:
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def floor_from_m(rig: Rig, stroke_m: float, edge_px: float, azimuth_rad: float, last_m: float) -> float:
    """Least distance from which on every spot on the floor is measured up to the last, NaN where the last is not."""
    D = np.arange(_FLOOR_M, last_m + 0.5 * _FLOOR_STEP_M, _FLOOR_STEP_M)
    points = np.stack([D, np.zeros_like(D), np.zeros_like(D)], axis=-1)
    missing = np.flatnonzero(~measured(rig, points, stroke_m, edge_px, np.array([azimuth_rad])))
    first = missing[-1] + 1 if missing.size else 0
    return float(D[first]) if first < len(D) else float("nan")


# -- bound -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class BlurBounds:
    """Bound of a coordinate by electrons and blur, for one sensor over a white wall.

    Attributes
    ----------
    blurs_px : tuple of float
        Sigma of round spots, rising.
    bounds : tuple of SpotSigma, one per blur
    exposure_s : float
    """

    blurs_px: tuple[float, ...]
    bounds: tuple[SpotSigma, ...]
    exposure_s: float

    def round_at(self, flux_e: ArrayLike, blur_px: float) -> float:
        """Bound for a round spot, pixels, log-log between the blurs; infinite beyond them."""
        if not self.blurs_px[0] <= blur_px <= self.blurs_px[-1]:
            return float("inf")
        values = np.array([float(bound.at(flux_e)) for bound in self.bounds])
        return float(np.exp(np.interp(np.log(blur_px), np.log(self.blurs_px), np.log(values))))

    def at(self, flux_e: float, blur: SpotBlur) -> tuple[float, float]:
        """Bounds along and across the radius, pixels, for a spot on the image's u axis."""
        radial, tangential = float(blur.sigma_px), float(blur.sigma_px * blur.ratio)
        middle = float(np.sqrt(radial * tangential))
        at_middle = self.round_at(flux_e, middle)
        return at_middle * radial / middle, at_middle * tangential / middle


def blur_bounds(card: SensorCard, response: tuple[float, float, float], blurs_px: Sequence[float]) -> BlurBounds:
    """Table of bounds for a sensor, over a white wall of the lab."""
    room = [rate * card.exposure_s for rate in ROOM_E_PER_S]
    # a processed bound costs a covariance of the codes at every flux
    fluxes = tuple(np.geomspace(100.0, 1e6, 25 if card.output == "raw" else 9).tolist())
    bounds = tuple(spot_sigma(card, blur, room, response, flux_e=fluxes) for blur in blurs_px)
    return BlurBounds(tuple(blurs_px), bounds, card.exposure_s)


@dataclass(frozen=True)
class PlaceBound:
    """Bound of D at one place.

    Attributes
    ----------
    relative : float
        Standard deviation of D over D; NaN where a pair does not measure the place.
    theta_rad : (down, up)
        Of the rays, from straight down.
    radial_blur_px : float
        Larger sigma of both spots along the radius.
    """

    relative: float
    theta_rad: tuple[float, float]
    radial_blur_px: float


NOTHING = PlaceBound(float("nan"), (float("nan"), float("nan")), float("nan"))


def place_bound(rig: Rig, table: BlurBounds, depth_m: float, height_m: float, stroke_m: float) -> PlaceBound:
    """Bound of D for a spot of the default laser on an upright wall along world x, the rig known exactly."""
    point = np.array([depth_m, 0.0, height_m])
    pixels, covariances, thetas, blurs = [], [], [], []
    for offset in (0.0, stroke_m):
        image = _image(rig, point, offset)
        if image.status != Status.OK:
            return NOTHING
        blur = spot_blur(rig, image.uv_px, depth_m, Beam())
        light = float(spot_electrons_per_s(rig, Laser(), image, _WALL_NORMAL)) * table.exposure_s
        ray = reflect(rig.at(0.0), image.uv_px).direction_world
        pixels.append(image.uv_px)
        covariances.append(np.diag(np.square(table.at(light, blur))))
        thetas.append(float(np.arctan2(ray[0], -ray[2])))
        blurs.append(float(blur.sigma_px))
    depth = depth_exact(rig, stroke_m, *pixels, *covariances)
    return PlaceBound(float(depth.sigma_m) / depth_m, (thetas[0], thetas[1]), max(blurs))


# -- misalignments -----------------------------------------------------------------------------------------------------

DIRECTIONS: Mapping[str, tuple[str, ...]] = {
    "mirror aside": ("decentre_x_m", "decentre_y_m"),
    "mirror higher": ("axial_m",),
    "mirror tilted": ("mirror_tilt_y_rad", "mirror_tilt_x_rad"),
    "vertex radius": ("radius_m",),
    "camera tilted": ("tilt_y_rad", "tilt_x_rad"),
    "focal length": ("focal_relative",),
    "principal point": ("cx_px", "cy_px"),
    "distortion k1": ("k1",),
    "distortion k2": ("k2",),
    "distortion k3": ("k3",),
    "distortion p1, p2": ("p2", "p1"),
    "stroke, offset": ("stroke_offset_m",),
    "stroke, scale": ("stroke_relative",),
    "stroke axis tilted": ("stroke_tilt_y_rad", "stroke_tilt_x_rad"),
    "tilt between images": ("pitch_rad", "roll_rad"),
    "turn between images": ("yaw_rad",),
    "aside between images": ("shift_x_m", "shift_y_m"),
    "up between images": ("shift_z_m",),
}
"""Parameters of a rig by kind. Of two of a kind the first acts along world x, where the spots are, and the other
across; the costlier counts. Form errors are a sphere's; the plane of focus, roughness and rim move no ray."""
UNCALIBRATED = (
    "stroke, offset",
    "tilt between images",
    "turn between images",
    "aside between images",
    "up between images",
)
"""Kinds that differ from pair to pair, so that no calibration knows them."""


def usual(kind: str) -> float:
    """Usual size of a kind, in its unit: what is left after careful mounting."""
    return MISALIGNMENT[DIRECTIONS[kind][0]].study


def unit(kind: str) -> str:
    """Unit of a kind: "m", "rad", "px" or "1"."""
    return MISALIGNMENT[DIRECTIONS[kind][0]].unit


def errors(rig: Rig, kind: str, size: float, points_m: Array, stroke_m: float) -> Array:
    """Largest error of D relative to D by a deviation of this size, over directions and signs, shape (n,).

    Pairs of the rig that deviates are measured with the nominal one, by the exact estimator. Infinite where the pair is
    lost: the spot leaves the mirror, or the rays part.

    Parameters
    ----------
    rig : Rig, the nominal one
    kind : of `DIRECTIONS`
    size : float, in the kind's unit
    points_m : shape (n, 3)
    stroke_m : float, the nominal stroke
    """
    along, *across = DIRECTIONS[kind]
    # an aligned rig and its mirror image across world x are one, so that both signs across give the same
    signed = [{along: size}, {along: -size}, *({name: size} for name in across)]
    return np.asarray(
        np.max([_errors_of(rig, Misalignment(**deviation), points_m, stroke_m) for deviation in signed], axis=0)
    )


def _errors_of(rig: Rig, wrong: Misalignment, points_m: Array, stroke_m: float) -> Array:
    try:
        true = rig.perturbed(wrong)
    except SceneError:  # there is no such rig
        return np.full(len(points_m), np.inf)
    down, up = _pixels(true, points_m, wrong.stroke_m(stroke_m))
    away = points_m[:, :2] - true.at(0.0).sphere_centre_m[:2]
    D = np.hypot(away[:, 0], away[:, 1])
    relative = np.abs(depth_exact(rig, stroke_m, down, up).depth_m / D - 1.0)
    return np.asarray(np.where(np.isfinite(relative), relative, np.inf))


def _pixels(true: Rig, points_m: Array, stroke_m: float) -> tuple[Array, Array]:
    """Down and up pixels of points, each of shape (n, 2)."""
    if true.motion is not None:
        return image_of(true.at(0.0), points_m).uv_px, image_of(true.at(stroke_m), points_m).uv_px
    lowered = points_m - stroke_m * np.array(true.stroke_axis_world)
    both = image_of(true.at(0.0), np.concatenate([points_m, lowered])).uv_px
    return both[: len(points_m)], both[len(points_m) :]


def tolerance(rig: Rig, kind: str, points_m: Array, stroke_m: float, cost: float) -> float:
    """Least size of a kind that costs so much of D at the costliest place; NaN where no size up to the largest does.

    Whole errors are searched, not slopes: near a cone's tip a deviation turns the azimuth, which has no first order.
    The search begins where the error would be in proportion to that of the usual size, and bisects in the logarithm.
    """
    largest = min(_LARGEST * usual(kind), MISALIGNMENT[DIRECTIONS[kind][0]].limit)

    def too_large(size: float) -> bool:
        return bool(np.max(errors(rig, kind, size, points_m, stroke_m)) >= cost)

    at_usual = float(np.max(errors(rig, kind, usual(kind), points_m, stroke_m)))
    share = np.clip(cost / max(at_usual, _NO_ERROR), 1.0 / _LARGEST, _LARGEST) if np.isfinite(at_usual) else 0.5
    low = high = min(float(share) * usual(kind), largest)
    while too_large(low):
        low, high = low / _WIDER, low
    while low == high or not too_large(high):
        if high >= largest:
            return float("nan")
        low, high = high, min(_WIDER * high, largest)
    for _ in range(_HALVINGS):
        middle = float(np.sqrt(low * high))
        low, high = (low, middle) if too_large(middle) else (middle, high)
    return float(np.sqrt(low * high))


def together(found: Mapping[str, float], kinds: Sequence[str]) -> float:
    """Root of the sum of squares of errors of some kinds."""
    return float(np.sqrt(sum(found[kind] ** 2 for kind in kinds)))
