"""Exact measurement model of the loop: spots in the image, with the bound as noise; and directions of rays, angles.

The image of a spot follows from the estimator's own projection in the rig that the robot really has; its standard
deviation is the Cramer-Rao bound of a coordinate at its light (`limits.processed_bound.SpotSigma`) for each of the
camera's exposures. A spot is seen where that bound is finite and at most `FAINTEST_PX`. Motion blur, rolling shutter
and speckle are left out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np

from phibench.datasets.film.moving_camera import BakedRoom
from phibench.datasets.frames.sensor_card import SensorCard, sensor_card
from phibench.estimator.geometry.reflection import reflect, reflect_jacobian
from phibench.estimator.geometry.sphere_image import SphereImage, SphereImager
from phibench.estimator.limits.best_stroke import spot_bound
from phibench.estimator.spots.spot_prediction import Laser
from phibench.robot.loop.arena import Arena, Boxes, boxes_of
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig
from phibench.scenes.room import chassis

EXPOSURES_S = (1 / 960, 1 / 480, 1 / 240, 1 / 120, 1 / 60, 1 / 30)
"""Exposures of the camera: a webcam halves and doubles them."""
FAINTEST_PX = 1.0
"""Spots whose bound is larger are not seen."""
OUTSIDE, HIDDEN, FAINT, BRIGHT, DARK = (
    "outside of the mirror's image",
    "hidden",
    "too faint",
    "too bright",
    "laser off",
)
SEEN = ""


class SpotOnSurface(NamedTuple):
    """Spot on a surface.

    Attributes
    ----------
    point_m, normal : shape (3,), world
    power : float
        Relative to the laser's.
    """

    point_m: Array
    normal: Array
    power: float


class SpotReading(NamedTuple):
    """One spot in one image.

    Attributes
    ----------
    u_px, v_px, sigma_px, electrons : float
        Measured place with its standard deviation, and electrons of the spot; 0 where it is not seen.
    cause : str
        Cause that it is not seen; `SEEN` where it is.
    pattern_px, texture_px : float
        Standard deviations of what frames share, of pixels only: the camera's fixed pattern, for frames whose spot lies
        on the same pixels, and what lies on the wall around the spot, for frames from about the same place.
    """

    u_px: float
    v_px: float
    sigma_px: float
    electrons: float
    cause: str
    pattern_px: float = 0.0
    texture_px: float = 0.0


class _Seen(NamedTuple):
    """Image of a spot, its place in the rig's frame, that lowered by the stroke, and the cosine at its surface."""

    image: SphereImage
    own_m: Array
    lowered_m: Array
    facing: float


def unseen_reading(cause: str) -> SpotReading:
    """Reading of a spot that is not seen."""
    return SpotReading(0.0, 0.0, 0.0, 0.0, cause)


@dataclass(frozen=True)
class SigmaTable:
    """Bound of a coordinate by the logarithm of the electrons, for one exposure, as plain arrays."""

    log_flux: Array
    log_sigma: Array

    def at(self, electrons: float) -> float:
        """Bound, pixels; infinite for spots fainter than the table, NaN for brighter ones."""
        # the bound falls evenly in logarithms: straight between nodes
        x = math.log(electrons) if electrons > 0.0 else -math.inf
        if x < self.log_flux[0]:
            return math.inf
        return math.exp(np.interp(x, self.log_flux, self.log_sigma)) if x <= self.log_flux[-1] else math.nan


@lru_cache(maxsize=8)
def sigma_tables(rig: Rig, preset: str) -> tuple[SigmaTable, ...]:
    """Bounds for each of `EXPOSURES_S`."""
    card = sensor_card(preset)
    return tuple(_table(rig, replace(card, exposure_s=exposure)) for exposure in EXPOSURES_S)


def _table(rig: Rig, card: SensorCard) -> SigmaTable:
    bound = spot_bound(rig, card)
    known = np.isfinite(bound.sigma_px)
    return SigmaTable(np.log(np.array(bound.flux_e)[known]), np.log(np.array(bound.sigma_px)[known]))


class Sensing:
    """Spots as one rig sees them.

    Parameters
    ----------
    rig : Rig
        The true one, with a perfect sphere.
    preset : str
        Sensor of the bounds, "bayer-raw" or another.
    laser : Laser
    """

    def __init__(self, rig: Rig, preset: str = "bayer-raw", laser: Laser | None = None) -> None:
        self.rig, self.laser = rig, laser or Laser()
        self.imager = SphereImager(rig, self.laser.wavelength_nm)
        self._preset = preset
        self._axis = np.array(rig.stroke_axis_world)
        self._robot: Boxes = boxes_of(chassis())
        response = rig.camera.detector.laser_electrons_per_joule(self.laser.wavelength_nm)[0]
        # Lambert: radiance = albedo x irradiance / pi; the red filter sees the laser
        self._electrons_per_etendue_s = self.laser.power_w * self.laser.albedo / np.pi * response

    @cached_property
    def _tables(self) -> tuple[SigmaTable, ...]:
        return sigma_tables(self.rig, self._preset)

    def read(
        self,
        lights: Sequence[SpotOnSurface],
        placement: tuple[Array, Array],
        stroke_m: float,
        exposure: int,
        arena: Arena | None,
        rng: np.random.Generator | None,
    ) -> list[SpotReading]:
        """Readings of spots, in their order.

        Parameters
        ----------
        lights : sequence of SpotOnSurface
        placement : (3, 3) and (3,)
            Rotation and origin of the rig's frame in the world, `vehicle.rig_placement`.
        exposure : int
            Index of `EXPOSURES_S`.
        arena : Arena or None
            None is a room in which nothing stands in the way, the robot included.
        rng : Generator or None
            For the noise; None gives the exact place.
        """
        R, origin = placement
        seen = [self._image(light, R, origin, stroke_m) for light in lights]
        hidden = self._hidden(seen, placement, stroke_m, arena)
        return [
            self._reading(image, light.power, exposure, rng, stands)
            for image, light, stands in zip(seen, lights, hidden, strict=True)
        ]

    def unhidden(
        self, lights: Sequence[SpotOnSurface], placement: tuple[Array, Array], stroke_m: float, arena: Arena
    ) -> list[tuple[float, float] | str]:
        """Pixel of each light that a baked room shows, by the room's own shapes; else the cause, `OUTSIDE` or `HIDDEN`.

        Brightness does not count.
        """
        R, origin = placement
        assert arena.baked is not None
        seen = [self._image(light, R, origin, stroke_m) for light in lights]
        robot = self._hidden(seen, placement, stroke_m, None, robot=True)
        result: list[tuple[float, float] | str] = []
        for image, light, stands in zip(seen, lights, robot, strict=True):
            if image is None:
                result.append(OUTSIDE)
            elif stands or image.facing <= 0.0 or self._in_shadow(image, light, placement, stroke_m, arena.baked):
                result.append(HIDDEN)
            else:
                result.append((image.image.u_px, image.image.v_px))
        return result

    def _in_shadow(
        self, seen: _Seen, light: SpotOnSurface, placement: tuple[Array, Array], stroke_m: float, room: BakedRoom
    ) -> bool:
        mirror = np.array(self.imager.mirror_point_m(seen.image, *seen.lowered_m.tolist())) + stroke_m * self._axis
        start = mirror @ placement[0].T + placement[1]
        return room.blocks(start, light.point_m)

    def _image(self, light: SpotOnSurface, R: Array, origin: Array, stroke_m: float) -> _Seen | None:
        # rows times R are R^T times columns: from the world into the frame of the rig
        own = (light.point_m - origin) @ R
        # the rig is up by the stroke, which is the point being lower by it
        lowered = own - stroke_m * self._axis
        image = self.imager.image(*lowered.tolist())
        return None if image is None else _Seen(image, own, lowered, -float((R @ np.array(image.ray)) @ light.normal))

    def _reading(
        self, seen: _Seen | None, power: float, exposure: int, rng: np.random.Generator | None, hidden: bool
    ) -> SpotReading:
        if seen is None:
            return unseen_reading(OUTSIDE)
        if hidden or seen.facing <= 0.0:
            return unseen_reading(HIDDEN)
        image = seen.image
        light = self._electrons_per_etendue_s * self.imager.reflectance(image.cos_incidence)
        electrons = power * light * image.etendue_m2_sr_per_m2 * seen.facing * EXPOSURES_S[exposure]
        sigma = self._tables[exposure].at(electrons)
        # NaN is a spot brighter than the table, infinity one that is fainter
        if not sigma <= FAINTEST_PX:
            return unseen_reading(BRIGHT if math.isnan(sigma) else FAINT)
        # the bound is that of one coordinate; both are drawn by themselves
        du, dv = (0.0, 0.0) if rng is None else (sigma * rng.standard_normal(2)).tolist()
        return SpotReading(image.u_px + du, image.v_px + dv, sigma, electrons, SEEN)

    def _hidden(
        self,
        seen: Sequence[_Seen | None],
        placement: tuple[Array, Array],
        stroke_m: float,
        arena: Arena | None,
        robot: bool = False,
    ) -> list[bool]:
        """True where the room or the robot stands between spot and mirror; the camera's housing is too small to.

        Without an arena nothing does, or the `robot` alone.
        """
        found = [image for image in seen if image is not None]
        if (arena is None and not robot) or not found:
            return [False] * len(seen)
        own = np.array([image.own_m for image in found])
        mirror = np.array([self.imager.mirror_point_m(image.image, *image.lowered_m.tolist()) for image in found])
        mirror += stroke_m * self._axis
        R, origin = placement
        stands = self._robot.block(mirror, own)
        if arena is not None:
            stands |= arena.sight.block(mirror @ R.T + origin, own @ R.T + origin)
        each = iter(stands.tolist())
        return [image is not None and next(each) for image in seen]


# -- directions of pixels --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Direction:
    """Direction of the ray that leaves the mirror, in the rig's frame.

    Parameters
    ----------
    azimuth_rad, rise : float
        Rise is the tangent of the elevation, up counts.
    covariance : shape (2, 2)
    uv_px, covariance_px2 : shapes (2,), (2, 2)
        Of the pixel.
    shared_px : 2 floats
        `pattern_px` and `texture_px` of its reading, which are not part of the covariances.
    stroke_sigma_m : float
        Standard deviation of the stroke's reading, which is part of `covariance` but not of that of the pixel.
    """

    azimuth_rad: float
    rise: float
    covariance: Array
    uv_px: Array
    covariance_px2: Array
    shared_px: tuple[float, float] = (0.0, 0.0)
    stroke_sigma_m: float = 0.0

    @property
    def values(self) -> Array:
        """Both numbers, shape (2,)."""
        return np.array([self.azimuth_rad, self.rise])


def direction_of(rig: Rig, u_px: float, v_px: float, sigma_px: float) -> Direction | None:
    """Direction that a pixel belongs to, by the nominal rig; None where no ray leaves the mirror."""
    return direction_with(rig, u_px, v_px, sigma_px**2 * np.eye(2))


def direction_read(rig: Rig, reading: SpotReading) -> Direction | None:
    """Direction of a reading, with what its error shares with that of other frames."""
    direction = direction_of(rig, reading.u_px, reading.v_px, reading.sigma_px)
    return None if direction is None else replace(direction, shared_px=(reading.pattern_px, reading.texture_px))


def direction_with(rig: Rig, u_px: float, v_px: float, covariance_px2: Array) -> Direction | None:
    """Same, with the covariance of the pixel, shape (2, 2)."""
    view, uv = rig.at(0.0), np.array([u_px, v_px])
    ray = reflect(view, uv)
    r, dr = ray.direction_world, reflect_jacobian(view, uv).direction_per_px
    if not np.isfinite(dr).all():
        return None
    across2 = r[0] ** 2 + r[1] ** 2
    across = math.sqrt(across2)
    J = np.array(
        [
            # azimuth, then rise z / across, by the vector
            [-r[1] / across2, r[0] / across2, 0.0],
            [-r[2] * r[0] / across**3, -r[2] * r[1] / across**3, 1.0 / across],
        ]
    )
    J = J @ dr
    covariance = J @ covariance_px2 @ J.T
    return Direction(math.atan2(r[1], r[0]), float(r[2] / across), covariance, uv, covariance_px2)


def wrapped_angle(angle_rad: float) -> float:
    """Angle between -pi and pi."""
    return math.remainder(angle_rad, 2.0 * math.pi)


def angles(d: Array) -> Array:
    """Azimuth and rise of vectors, shape (N, 3), shape (N, 2)."""
    return np.stack([np.arctan2(d[:, 1], d[:, 0]), d[:, 2] / np.hypot(d[:, 0], d[:, 1])], axis=-1)


def wrapped_differences(difference: Array) -> Array:
    """Differences with their azimuth between -pi and pi."""
    # sine and cosine know no jump at half a turn
    azimuth = np.arctan2(np.sin(difference[:, 0]), np.cos(difference[:, 0]))
    return np.stack([azimuth, difference[:, 1]], axis=-1)


def angle_slopes(d: Array) -> Array:
    """Derivatives of azimuth and rise by the vector, shape (N, 2, 3)."""
    x, y, z = d.T
    across2 = x**2 + y**2
    across = np.sqrt(across2)
    zero = np.zeros_like(x)
    # azimuth atan2(y, x), rise z / hypot(x, y)
    rows = (-y / across2, x / across2, zero), (-z * x / across**3, -z * y / across**3, 1.0 / across)
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
