"""The laser spot on a wall: place, size, power, profile; the beam's diameter against the distance."""

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
    """A laser spot on a diffuse (Lambertian) wall; the spot is a flat disc in the wall's plane.

    Parameters
    ----------
    position_world_m : 3 floats
        Centre of the spot, world frame.
    normal_world : 3 floats
        Wall normal, towards the room; made a unit vector.
    albedo : float in [0, 1]
        Diffuse albedo of the wall at the laser's wavelength.
    power_w, wavelength_nm : float
    profile : "gaussian" or "uniform"
    diameter_m : float
        Diameter of the disc ("uniform") or 1/e^2 diameter = 4 sigma ("gaussian", ISO 11146's D4sigma).
    """

    position_world_m: Vector
    normal_world: Vector
    diameter_m: float
    albedo: float = 0.7
    power_w: float = 1e-3
    wavelength_nm: float = 650.0
    profile: Profile = "gaussian"

    def __post_init__(self) -> None:
        object.__setattr__(
            self, "position_world_m", finite_vector("LaserSpot", "position_world_m", self.position_world_m, 3)
        )
        object.__setattr__(self, "normal_world", unit_vector("LaserSpot", "normal_world", self.normal_world))
        positive("LaserSpot", "diameter_m", self.diameter_m)
        positive("LaserSpot", "power_w", self.power_w)
        within("LaserSpot", "albedo", self.albedo, 0.0, 1.0)
        within("LaserSpot", "wavelength_nm", self.wavelength_nm, 400.0, 700.0)
        if self.profile not in ("gaussian", "uniform"):
            raise SceneError(f"LaserSpot.profile = '{self.profile}': must be 'gaussian' or 'uniform'")

    @property
    def sigma_m(self) -> float:
        """Standard deviation of the Gaussian profile per axis, metres."""
        return self.diameter_m / 4.0

    def peak_exitance_w_m2(self) -> float:
        """Exitance at the centre of the spot: albedo x peak irradiance, W/m^2."""
        area = 2.0 * math.pi * self.sigma_m**2 if self.profile == "gaussian" else math.pi * self.diameter_m**2 / 4.0
        return self.albedo * self.power_w / area

    def radiance_w_m2_sr(self, radius_m: Array) -> Array:
        """Radiance at distance `radius_m` from the centre, W/(m^2 sr), shape of `radius_m`."""
        r = np.asarray(radius_m, float)
        if self.profile == "gaussian":
            shape = np.exp(-0.5 * (r / self.sigma_m) ** 2)
        else:
            shape = (r <= self.diameter_m / 2.0).astype(float)
        return self.peak_exitance_w_m2() / math.pi * shape

    def tangents(self) -> tuple[Array, Array]:
        """Two unit vectors, shape (3,) each, that span the wall's plane."""
        n = np.array(self.normal_world)
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
    diameter_growth_m_per_m : float
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
