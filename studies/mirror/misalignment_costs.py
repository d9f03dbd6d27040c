"""Cost of a misalignment: the error of D by each kind of deviation, and the size that costs a share of D."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from phibench.estimator.geometry.reflection import image_of
from phibench.estimator.geometry.triangulate import depth_exact
from phibench.scenes.frames import Array
from phibench.scenes.misalignment import PARAMETERS as MISALIGNMENT
from phibench.scenes.misalignment import Misalignment
from phibench.scenes.rig import Rig
from phibench.scenes.validation import SceneError

_LARGEST = 256.0  # of the sizes that are tried, over the usual one
_NO_ERROR = 1e-9  # of D
_WIDER, _HALVINGS = 1.2, 6  # to 0.15 %: tables have two digits


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


def usual_size(kind: str) -> float:
    """Usual size of a kind, in its unit: what is left after careful mounting."""
    return MISALIGNMENT[DIRECTIONS[kind][0]].study


def unit_of_kind(kind: str) -> str:
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
    largest = min(_LARGEST * usual_size(kind), MISALIGNMENT[DIRECTIONS[kind][0]].limit)

    def too_large(size: float) -> bool:
        return bool(np.max(errors(rig, kind, size, points_m, stroke_m)) >= cost)

    at_usual = float(np.max(errors(rig, kind, usual_size(kind), points_m, stroke_m)))
    share = np.clip(cost / max(at_usual, _NO_ERROR), 1.0 / _LARGEST, _LARGEST) if np.isfinite(at_usual) else 0.5
    low = high = min(float(share) * usual_size(kind), largest)
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


def root_of_squares(found: Mapping[str, float], kinds: Sequence[str]) -> float:
    """Root of the sum of squares of errors of some kinds."""
    return float(np.sqrt(sum(found[kind] ** 2 for kind in kinds)))
