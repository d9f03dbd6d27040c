"""Experiments of the paper, and D as its user reads it from a true rig: two pixels -> phi -> equation (4) or (5).

Everything is closed form and vectorised, so that a sampler can afford a hundred thousand rigs. The mirror image is
Alhazen's problem in the plane of lens, sphere centre and spot. It takes no Newton step in pixels, unlike
`geometry.reflection`, which the tests hold it against. Coordinates: origin at the true sphere centre, down; z up;
D counts from there. The last axis is experiments (n); parameters are scalars, or (m, 1) for m rigs at once.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from phibench.estimator.geometry.paper_depth import load_published
from phibench.scenes.frames import Array, BoolArray
from phibench.scenes.rig import Rig

Convention = Literal["ray", "normal", "incidence", "outline"]
Parameters = Mapping[str, Array]
TABLES = 4
_NEWTON_STEPS = 3  # the error of the start is some 0.1 rad, then 5e-4, 1e-8 and 1e-17
_STEP_PX = 1e-4  # of the differences: curvature costs 1e-4 of the slope, rounding 1e-9


@dataclass(frozen=True)
class Experiments:
    """Experiments of the paper.

    Parameters
    ----------
    table : shape (n,), 0 to 3 for Tables 1 to 4
    depth_m, stroke_m : shape (n,), as the paper measured them
    estimate_m : shape (n,), printed estimate
    rounding_m : shape (n,), step of the last printed digit
    """

    table: NDArray[np.int64]
    depth_m: Array
    stroke_m: Array
    estimate_m: Array
    rounding_m: Array

    def __len__(self) -> int:
        return len(self.table)

    def chosen(self, keep: BoolArray) -> Experiments:
        """Some of them, by a mask of shape (n,)."""
        depth, stroke, estimate, rounding = (
            x[keep] for x in (self.depth_m, self.stroke_m, self.estimate_m, self.rounding_m)
        )
        return Experiments(self.table[keep], depth, stroke, estimate, rounding)

    def with_estimates(self, estimate_m: Array) -> Experiments:
        """The same with other estimates."""
        return Experiments(self.table, self.depth_m, self.stroke_m, estimate_m, self.rounding_m)

    @cached_property
    def of_table(self) -> Array:
        """1 where an experiment is of a table, shape (4, n)."""
        return (self.table == np.arange(TABLES)[:, None]).astype(float)

    @property
    def same_target(self) -> BoolArray:
        """Pairs of experiments with the same spot, shape (n, n): same table and same depth."""
        return (self.table[:, None] == self.table) & (self.depth_m[:, None] == self.depth_m)


def published_experiments() -> Experiments:
    """The 25 published results; Table 4 is printed to the millimetre."""
    rows = load_published()
    table = np.array([int(row.experiment.removeprefix("table")) - 1 for row in rows])
    depth, stroke, estimate = (
        np.array([getattr(row, name) for row in rows]) for name in ("real_depth_m", "baseline_m", "estimated_depth_m")
    )
    return Experiments(table, depth, stroke, estimate, np.where(table == TABLES - 1, 0.001, 0.01))


@dataclass(frozen=True)
class Reader:
    """Way from pixels to an estimate.

    Parameters
    ----------
    convention : "ray", "normal", "incidence" or "outline"
        What is taken for phi (`estimator.geometry.phi`).
    equation : 4 or 5
        Equation of the paper that gives D.
    centred : bool
        Whether radii count from the image of the sphere (section 5 of the paper centres it) or from the principal
        point, where an aligned rig has it. "outline" measures the radius of the mirror's image in either case.
    """

    convention: Convention = "ray"
    equation: Literal[4, 5] = 4
    centred: bool = False


@dataclass(frozen=True)
class PaperReading:
    """Inverse depths and how pixel noise moves them.

    Parameters
    ----------
    inverse_depth_per_m : shape (..., n)
        1 / estimate: nearly linear in the pixels where the estimate itself is not.
    by_down, by_up : shape (..., n)
        Its derivatives by the radius in either image, per metre and pixel.
    """

    inverse_depth_per_m: Array
    by_down: Array
    by_up: Array

    @property
    def depth_m(self) -> Array:
        """Estimates."""
        return 1.0 / self.inverse_depth_per_m


def read_depths(parameters: Parameters, experiments: Experiments, reader: Reader, rig: Rig) -> PaperReading:
    """Noise-free estimates of experiments with true rigs, and their slopes by the radii in the images.

    Parameters
    ----------
    parameters : by name, each a scalar or shape (m, 1) for m rigs
        Of the true rig: `z_c_m`, `height_1_m` to `height_4_m` (spot above the sphere centre, down, by table), and what
        `PARAMETERS` and `AZIMUTHS` list, 0 where missing.
    rig : Rig
        Focal length and radius that the reader takes as nominal.

    Returns
    -------
    PaperReading
        NaN where the reader's pixel misses the reader's mirror.
    """
    down, up = radii_px(parameters, experiments, reader, rig)
    nudged = (np.stack([down, down + _STEP_PX, down]), np.stack([up, up, up + _STEP_PX]))
    value, by_down, by_up = inverse_depth(parameters, experiments, reader, rig, *nudged)
    return PaperReading(value, (by_down - value) / _STEP_PX, (by_up - value) / _STEP_PX)


PARAMETERS = (
    "decentre_x_m",
    "decentre_y_m",
    "tilt_x_rad",
    "tilt_y_rad",
    "roll_rad",
    "pitch_rad",
    "stroke_relative",
    "stroke_offset_m",
    "focal_relative",
    "axial_m",
    "radius_m",
    "cx_px",
    "cy_px",
)
"""Errors of the rig, in the sense of `scenes.misalignment`."""
AZIMUTHS = ("azimuth_1_rad", "azimuth_2_rad", "azimuth_3_rad", "azimuth_4_rad")
"""Azimuths of the tables' spots, from world x."""


def radii_px(parameters: Parameters, experiments: Experiments, reader: Reader, rig: Rig) -> Array:
    """Distance of the spot's image from the reader's centre, shape (2, ..., n), pixels, down and up."""
    axis = _axis(parameters)
    ray = _camera_ray(_spot_from_sphere(parameters, experiments), axis, _true_radius_m(parameters, rig))
    focal_px = _true_focal_px(parameters, rig)
    u, v = (focal_px * x for x in _image(ray, parameters))
    if reader.centred:
        u0, v0 = sphere_image_px(parameters, rig)
    else:
        u0, v0 = (-_get(parameters, name) for name in ("cx_px", "cy_px"))
    return np.hypot(u - u0, v - v0)


def sphere_image_px(parameters: Parameters, rig: Rig) -> tuple[Array, Array]:
    """Image of the sphere centre from the true principal point, (u, v), pixels: (0, 0) for an aligned rig."""
    u, v = (_true_focal_px(parameters, rig) * x for x in _image(_axis(parameters), parameters))
    return u, v


def inverse_depth(
    parameters: Parameters, experiments: Experiments, reader: Reader, rig: Rig, down_px: Array, up_px: Array
) -> Array:
    """1 / D by equation (4), or (5), from radii, shape (..., n); the printed stroke and the nominal rig are used."""
    R, h = rig.sphere.radius_m, experiments.stroke_m
    phi = phi_of(parameters, reader, rig, np.stack([down_px, up_px]))
    (S1, S2), (C1, C2) = np.sin(2.0 * phi), np.cos(2.0 * phi)
    sine = S1 * C2 - C1 * S2
    if reader.equation == 5:
        return np.asarray(sine / (h * S1 * S2))
    (s1, s2), (c1, c2) = np.sin(phi), np.cos(phi)
    # eq. (4) with its epsilon, times cos 2phi_1 cos 2phi_2; h - lambda by eq. (3)
    return np.asarray(sine / ((h - R * (c2 - c1)) * S1 * S2 + R * (s2 * C2 * S1 - s1 * C1 * S2)))


def phi_of(parameters: Parameters, reader: Reader, rig: Rig, radius_px: Array) -> Array:
    """Angle of a reader who takes the rig as aligned, from radii in the image.

    sin i = z_c / R sin(alpha), phi_n = i - alpha. NaN where the pixel misses the mirror.
    """
    with np.errstate(invalid="ignore"):
        if reader.convention == "outline":
            return np.asarray(np.arcsin(radius_px / _outline_px(parameters, rig)))
        alpha = np.arctan(radius_px / rig.camera.fx_px)
        incidence = np.arcsin(_get(parameters, "z_c_m") / rig.sphere.radius_m * np.sin(alpha))
    return np.asarray(incidence - _CAMERA_RAYS[reader.convention] * alpha)


_CAMERA_RAYS = {"ray": 0.5, "normal": 1.0, "incidence": 0.0}  # how many alpha phi is short of the incidence


def _true_radius_m(parameters: Parameters, rig: Rig) -> Array:
    return rig.sphere.radius_m + _get(parameters, "radius_m")


def _true_focal_px(parameters: Parameters, rig: Rig) -> Array:
    return rig.camera.fx_px * (1.0 + _get(parameters, "focal_relative"))


def _outline_px(parameters: Parameters, rig: Rig) -> Array:
    """Radius of the mirror's outline as measured in the image."""
    x, y, z = _axis(parameters)
    R = _true_radius_m(parameters, rig)
    return np.asarray(_true_focal_px(parameters, rig) * R / np.sqrt(x * x + y * y + z * z - R * R))


def _axis(parameters: Parameters) -> tuple[Array, Array, Array]:
    """Lens to true sphere centre; an aligned reader takes (0, 0, z_c)."""
    z = _get(parameters, "z_c_m") + _get(parameters, "axial_m")
    return _get(parameters, "decentre_x_m"), _get(parameters, "decentre_y_m"), z


def _spot_from_sphere(parameters: Parameters, experiments: Experiments) -> tuple[Array, Array, Array]:
    """Spot from the sphere centre; the last component has the leading axis down, up."""
    height, azimuth = (_by_table(parameters, name, experiments) for name in ("height_{}_m", "azimuth_{}_rad"))
    stroke = (1.0 + _get(parameters, "stroke_relative")) * experiments.stroke_m + _get(parameters, "stroke_offset_m")
    x, y = experiments.depth_m * np.cos(azimuth), experiments.depth_m * np.sin(azimuth)
    if "roll_rad" in parameters or "pitch_rad" in parameters:
        return _turned(parameters, (x, y, height), (x, y, height - stroke))
    return x, y, np.stack(np.broadcast_arrays(height, height - stroke))


def _turned(
    parameters: Parameters, down: tuple[Array, Array, Array], up: tuple[Array, Array, Array]
) -> tuple[Array, Array, Array]:
    """Spot where the rig has turned about its lens in between: the spot turns back about the lens, for the up image."""
    axis = _axis(parameters)
    from_lens = (up[0] + axis[0], up[1] + axis[1], up[2] + axis[2])
    back = _turned_back(from_lens, _get(parameters, "roll_rad"), _get(parameters, "pitch_rad"))
    pairs = (np.broadcast_arrays(first, second - q) for first, second, q in zip(down, back, axis, strict=True))
    x, y, z = (np.stack(pair) for pair in pairs)
    return x, y, z


def _by_table(parameters: Parameters, name: str, experiments: Experiments) -> Array:
    """Values of the parameters of the four tables for each experiment, shape (..., n)."""
    tables = [table for table in range(TABLES) if name.format(table + 1) in parameters]
    if not tables:
        return _ZERO
    values = np.concatenate([np.atleast_1d(parameters[name.format(table + 1)]) for table in tables], axis=-1)
    return np.asarray(values @ experiments.of_table[tables])


def _camera_ray(
    spot: tuple[Array, Array, Array], axis: tuple[Array, Array, Array], radius_m: Array
) -> tuple[Array, Array, Array]:
    """Direction lens to reflection point, world, components of shape (2, ..., n).

    In the plane of lens, sphere centre and spot, angles counted at the sphere centre from the lens: the lens at A, the
    spot at B and gamma, the reflection point at R and t, with A B sin(2t - gamma) = R (A sin t - B sin(gamma - t)).
    """
    (qx, qy, qz), (x, y, z) = axis, spot
    A = np.sqrt(qx * qx + qy * qy + qz * qz)
    qx, qy, qz = qx / A, qy / A, qz / A
    along = -(qx * x + qy * y + qz * z)  # of the spot, towards the lens
    px, py, pz = x + along * qx, y + along * qy, z + along * qz
    across = np.sqrt(px * px + py * py + pz * pz)
    gamma = np.arctan2(across, along)
    near, far = radius_m / A, radius_m / np.sqrt(across * across + along * along)
    t = 0.5 * gamma
    for _ in range(_NEWTON_STEPS):
        rest = gamma - t
        slope = 2.0 * np.cos(t - rest) - far * np.cos(t) - near * np.cos(rest)
        t = t - (np.sin(t - rest) - far * np.sin(t) + near * np.sin(rest)) / slope
    back, side = 1.0 - near * np.cos(t), near * np.sin(t) / across  # over A: along the axis, and across it
    return qx * back + side * px, qy * back + side * py, qz * back + side * pz


def _image(direction: tuple[Array, Array, Array], parameters: Parameters) -> tuple[Array, Array]:
    """Normalised image coordinates of world directions in the camera Ry(tilt_y) Rx(tilt_x)."""
    x, y, z = direction
    if "tilt_x_rad" not in parameters and "tilt_y_rad" not in parameters:
        return x / z, y / z
    x, y, z = _turned_back(direction, _get(parameters, "tilt_x_rad"), _get(parameters, "tilt_y_rad"))
    return x / z, y / z


def _turned_back(vector: tuple[Array, Array, Array], a: Array, b: Array) -> tuple[Array, Array, Array]:
    """Components of a vector in axes that were turned by Ry(b) Rx(a)."""
    x, y, z = vector
    cb, sb, ca, sa = np.cos(b), np.sin(b), np.cos(a), np.sin(a)
    x1, z1 = cb * x - sb * z, sb * x + cb * z  # undo Ry, then Rx
    return x1, ca * y + sa * z1, -sa * y + ca * z1


def _get(parameters: Parameters, name: str) -> Array:
    return parameters.get(name, _ZERO)


_ZERO: Array = np.zeros(())
