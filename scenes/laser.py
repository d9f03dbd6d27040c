"""Laser spot: place, size, power, profile, beam, radiance and irradiance; diameter of a beam against the distance."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from phibench.scenes.frames import Array, Vector
from phibench.scenes.validation import SceneError, finite_vector, positive, unit_vector, within

Profile = Literal["gaussian", "uniform"]


@dataclass(frozen=True)
class LaserSpot:
    """A laser spot on diffuse (Lambertian) surfaces.

    Without a beam the spot is a flat disc in the plane of its normal. With a beam it is what parallel light of this
    profile leaves on the room's surfaces, over edges and around corners (`render.optics.beam_deposit`).

    Parameters
    ----------
    position_world_m : 3 floats
        Centre of the spot, world frame; where the beam's axis ends.
    normal_world : 3 floats
        Surface normal there, towards the room; made a unit vector.
    albedo : float in [0, 1] or None
        Diffuse albedo at the laser's wavelength; None, with a beam only, is each surface's own, its coat included.
    power_w, wavelength_nm : float
        Of the beam.
    profile : "gaussian" or "uniform"
        Irradiance across the spot.
    diameter_m : float
        Diameter of the disc ("uniform") or 1/e^2 diameter = 4 sigma ("gaussian", ISO 11146's D4sigma); across the
        beam where there is one.
    beam_direction_world : 3 floats or None
        Direction in which the light travels, against the normal; made a unit vector.
    """

    position_world_m: Vector
    normal_world: Vector
    diameter_m: float
    albedo: float | None = 0.7
    power_w: float = 1e-3
    wavelength_nm: float = 650.0
    profile: Profile = "gaussian"
    beam_direction_world: Vector | None = None

    def __post_init__(self) -> None:
        object.__setattr__(
            self, "position_world_m", finite_vector("LaserSpot", "position_world_m", self.position_world_m, 3)
        )
        object.__setattr__(self, "normal_world", unit_vector("LaserSpot", "normal_world", self.normal_world))
        positive("LaserSpot", "diameter_m", self.diameter_m)
        positive("LaserSpot", "power_w", self.power_w)
        if self.albedo is not None:
            within("LaserSpot", "albedo", self.albedo, 0.0, 1.0)
        within("LaserSpot", "wavelength_nm", self.wavelength_nm, 400.0, 700.0)
        if self.profile not in ("gaussian", "uniform"):
            raise SceneError(f"LaserSpot.profile = '{self.profile}': must be 'gaussian' or 'uniform'")
        self._check_beam()

    def _check_beam(self) -> None:
        if self.beam_direction_world is None:
            if self.albedo is None:
                raise SceneError("LaserSpot.albedo = None needs a beam: give beam_direction_world, or an albedo")
            return
        direction = unit_vector("LaserSpot", "beam_direction_world", self.beam_direction_world)
        object.__setattr__(self, "beam_direction_world", direction)
        if np.dot(direction, self.normal_world) >= 0.0:
            raise SceneError("LaserSpot.beam_direction_world must travel against normal_world, into the surface")

    @property
    def sigma_m(self) -> float:
        """Standard deviation of the Gaussian profile per axis, metres."""
        # D4sigma, as data sheets have it: the diameter is four standard deviations
        return self.diameter_m / 4.0

    @property
    def scale_m(self) -> float:
        """Length that the profile is stretched by: sigma of a Gaussian, radius of a uniform disc."""
        return self.sigma_m if self.profile == "gaussian" else self.diameter_m / 2.0

    def peak_exitance_w_m2(self) -> float:
        """Exitance at the centre of a flat spot: albedo x peak irradiance, W/m^2."""
        if self.albedo is None:
            raise SceneError("LaserSpot.albedo is that of the surfaces: the spot's exitance is not known without them")
        # power over peak irradiance: 2 pi sigma^2 of a Gaussian, the area of a disc
        area = 2.0 * math.pi * self.sigma_m**2 if self.profile == "gaussian" else math.pi * self.diameter_m**2 / 4.0
        return self.albedo * self.power_w / area

    def radiance_w_m2_sr(self, radius_m: Array) -> Array:
        """Radiance of a flat spot at distance `radius_m` from the centre, W/(m^2 sr), shape of `radius_m`."""
        # Lambert: radiance is exitance over pi
        return self.peak_exitance_w_m2() / math.pi * self._shape(radius_m)

    def irradiance_w_m2(self, radius_m: Array) -> Array:
        """Power per area across the beam at distance `radius_m` from its axis, W/m^2, shape of `radius_m`."""
        area = math.pi * self.scale_m**2 * (2.0 if self.profile == "gaussian" else 1.0)
        return self.power_w / area * self._shape(radius_m)

    def _shape(self, radius_m: Array) -> Array:
        """Profile, 1 on the axis."""
        r = np.asarray(radius_m, float)
        if self.profile == "gaussian":
            return np.exp(-0.5 * (r / self.sigma_m) ** 2)
        return np.asarray((r <= self.diameter_m / 2.0).astype(float))

    def tangents(self) -> tuple[Array, Array]:
        """Two unit vectors, shape (3,) each, that span the plane of the normal."""
        return _spanning(np.array(self.normal_world))

    def across_beam(self) -> tuple[Array, Array]:
        """Two unit vectors, shape (3,) each, across the beam; `tangents` where there is none."""
        if self.beam_direction_world is None:
            return self.tangents()
        return _spanning(np.array(self.beam_direction_world))


def _spanning(n: Array) -> tuple[Array, Array]:
    """Two unit vectors that span the plane of a normal."""
    # never near the normal: no small cross product
    helper = np.array([0.0, 0.0, 1.0]) if abs(n[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
    a = np.cross(helper, n)
    a /= np.linalg.norm(a)
    return a, np.cross(n, a)


@dataclass(frozen=True)
class Beam:
    """Laser beam of a data sheet: the diameter of the spot, D4sigma, grows with the distance.

    Parameters
    ----------
    diameter_base_m : float
        Diameter at the laser.
    diameter_growth_m_per_m : float
        Growth of the diameter with the distance.
    """

    diameter_base_m: float = 3e-3
    diameter_growth_m_per_m: float = 1e-3

    def __post_init__(self) -> None:
        for name in ("diameter_base_m", "diameter_growth_m_per_m"):
            within("Beam", name, getattr(self, name), 0.0, 1.0)

    def diameter_m(self, distance_m: float) -> float:
        """Diameter of the spot after `distance_m`."""
        return self.diameter_base_m + self.diameter_growth_m_per_m * distance_m


def beam_diameter_m(distance_m: float) -> float:
    """Diameter of the default laser's spot after `distance_m`: 3 mm + 1 mm per metre."""
    return Beam().diameter_m(distance_m)
