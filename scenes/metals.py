"""Polished metals of mirrors: refractive indices, measured reflectance tables, reflectance by angle and wavelength.

Sources of the metals' refractive indices:

* Steel, austenitic stainless (about 316): B. Karlsson and C. G. Ribbing, "Optical constants and spectral selectivity of
  stainless steel and its oxides", J. Appl. Phys. 53, 6340 (1982), read from a figure, good to 1 to 2 %.
* Aluminium, evaporated: A. D. Rakic, "Algorithm for the determination of intrinsic optical constants of metal films:
  application to aluminum", Appl. Opt. 34, 4755 (1995).
* Gold, evaporated: P. B. Johnson and R. W. Christy, "Optical constants of the noble metals", Phys. Rev. B 6, 4370
  (1972).

A polished or oxidised surface reflects less than an evaporated film. A `ReflectanceTable` takes what was measured.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

import numpy as np

from phibench.scenes.frames import Array
from phibench.scenes.validation import SceneError, finite, within

MetalName = Literal["steel", "aluminium", "gold"]

# Wavelength in nm, n, k.
STEEL = np.array(
    [
        [400, 1.5249, 2.7925],
        [420, 1.5762, 2.9240],
        [440, 1.6386, 3.0555],
        [460, 1.7169, 3.1785],
        [480, 1.7921, 3.2933],
        [500, 1.8636, 3.4010],
        [520, 1.9349, 3.5072],
        [540, 2.0072, 3.6166],
        [560, 2.0807, 3.7298],
        [580, 2.1557, 3.8451],
        [600, 2.2325, 3.9594],
        [620, 2.3122, 4.0504],
        [640, 2.3962, 4.1378],
        [660, 2.4839, 4.2261],
        [680, 2.5731, 4.3155],
        [700, 2.6617, 4.4066],
    ]
)
_ALUMINIUM = np.array(
    [
        [364.66, 0.39877, 4.3957],
        [413.28, 0.52135, 5.0008],
        [442.8, 0.6079, 5.3676],
        [476.87, 0.7278, 5.7781],
        [516.6, 0.8734, 6.2418],
        [563.57, 1.0728, 6.7839],
        [619.93, 1.366, 7.4052],
        [652.25, 1.5724, 7.7354],
        [688.81, 1.8301, 8.0601],
        [729.32, 2.1606, 8.3565],
    ]
)
_GOLD = np.array(
    [
        [397.4, 1.47, 1.952],
        [413.3, 1.46, 1.958],
        [430.5, 1.45, 1.948],
        [450.9, 1.38, 1.914],
        [471.4, 1.31, 1.849],
        [495.9, 1.04, 1.833],
        [520.9, 0.62, 2.081],
        [548.6, 0.43, 2.455],
        [582.1, 0.29, 2.863],
        [616.8, 0.21, 3.272],
        [659.5, 0.14, 3.697],
        [704.5, 0.13, 4.103],
    ]
)
METALS = MappingProxyType({"steel": STEEL, "aluminium": _ALUMINIUM, "gold": _GOLD})
"""Tables of wavelength in nm, n and k."""
for _table in METALS.values():
    _table.setflags(write=False)

_SHORTEST_NM, _LONGEST_NM = 400.0, 700.0  # that the tables cover: the camera's filters and any visible laser


def known_metal(owner: str, name: str) -> None:
    """Raise `SceneError` for a metal that has no table."""
    if name not in METALS:
        raise SceneError(f"{owner}.metal = {name}: known are {', '.join(METALS)}")


@dataclass(frozen=True)
class ReflectanceTable:
    """Measured power reflectance of a mirror, unpolarised, linear between its wavelengths and angles.

    Parameters
    ----------
    wavelength_nm : floats, rising
        A single one stands for all wavelengths.
    value : floats
        One for each wavelength; or, row after row, one for each wavelength and angle.
    angle_deg : floats, rising
        Angles of incidence of the columns; beyond the first and last the nearest holds, so that one angle stands for
        all. Empty: values R are at normal incidence, and the metal says how they depend on the angle. With F by
        Fresnel's equations, a smaller R than F(0) is a factor, R(i) = F(i) R / F(0), as of dirt or scratches; of a
        larger one the loss is scaled, 1 - R(i) = (1 - F(i)) (1 - R) / (1 - F(0)). So R(i) stays within 0 and 1.
    """

    wavelength_nm: tuple[float, ...]
    value: tuple[float, ...]
    angle_deg: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        for name in ("wavelength_nm", "value", "angle_deg"):
            numbers = tuple(finite("ReflectanceTable", name, float(x)) for x in getattr(self, name))
            object.__setattr__(self, name, numbers)
        for name, low, high in (("wavelength_nm", 300.0, 1100.0), ("value", 0.0, 1.0), ("angle_deg", 0.0, 90.0)):
            for x in getattr(self, name):
                within("ReflectanceTable", name, x, low, high)
            if name != "value" and any(b <= a for a, b in itertools.pairwise(getattr(self, name))):
                raise SceneError(f"ReflectanceTable.{name} = {list(getattr(self, name))}: must rise")
        wanted = len(self.wavelength_nm) * max(len(self.angle_deg), 1)
        if len(self.value) != wanted or not wanted:
            raise SceneError(
                f"ReflectanceTable.value = {list(self.value)}: {len(self.value)} numbers for {len(self.wavelength_nm)} "
                f"wavelengths and {max(len(self.angle_deg), 1)} angles; give one for each wavelength and angle"
            )

    def row(self, wavelength_nm: float) -> Array:
        """Values at a wavelength, shape (angles,), or (1,) without angles.

        Raises
        ------
        SceneError
            If the table does not cover the wavelength.
        """
        nm, rows = np.array(self.wavelength_nm), np.reshape(self.value, (len(self.wavelength_nm), -1))
        if len(nm) > 1 and not nm[0] <= wavelength_nm <= nm[-1]:
            raise SceneError(
                f"ReflectanceTable.wavelength_nm = {list(self.wavelength_nm)}: does not cover {wavelength_nm:g} nm, "
                "which the laser or a colour filter needs; add a wavelength, or give a single one that stands for all"
            )
        return np.array([np.interp(wavelength_nm, nm, column) for column in rows.T])


@dataclass(frozen=True)
class BandReflectance:
    """Reflectance at one wavelength, by the angle of incidence: a metal's, a table's, or a mixture of the two.

    Attributes
    ----------
    index : complex
        Refractive index n + i k of the metal.
    gain, loss : float
        Factors of the metal's reflectance and of what that leaves: 1 without a table.
    angles_rad, values : arrays, shape (m,)
        Of a table with angles, which then counts alone; empty otherwise.
    """

    index: complex
    gain: float
    loss: float
    angles_rad: Array
    values: Array

    def at(self, cos_incidence: Array) -> Array:
        """Reflectance, shape of `cos_incidence` (cosine of the angle of incidence); NaN in, NaN out."""
        cos_i = np.asarray(cos_incidence, float)
        if len(self.values):
            angle = np.arccos(np.clip(cos_i, -1.0, 1.0))
            return np.where(np.isnan(cos_i), np.nan, np.interp(angle, self.angles_rad, self.values))
        fresnel = self.gain * _fresnel(self.index, cos_i)
        return fresnel if self.loss == 1.0 else 1.0 - self.loss * (1.0 - fresnel)


def _fresnel(index: complex, cos_i: Array) -> Array:
    """Unpolarised Fresnel power reflectance."""
    m2 = index**2
    with np.errstate(invalid="ignore"):  # NaN in, NaN out
        root = np.sqrt(m2 - (1.0 - cos_i * cos_i))
        r_s = (cos_i - root) / (cos_i + root)
        r_p = (m2 * cos_i - root) / (m2 * cos_i + root)
    return 0.5 * (np.abs(r_s) ** 2 + np.abs(r_p) ** 2)


class MetalSurface:
    """Reflectance of a polished metal: what mirrors of every shape share."""

    metal: MetalName
    roughness_alpha: float
    reflectance_table: ReflectanceTable | None

    @property
    def unsaid(self) -> tuple[str, ...]:
        """Fields that a document leaves out, as older ones did: a mirror of steel, without a measured reflectance."""
        idle = {"metal": self.metal == "steel", "reflectance_table": self.reflectance_table is None}
        return tuple(name for name, is_idle in idle.items() if is_idle)

    def refractive_index(self, wavelength_nm: float) -> complex:
        """Complex index n + i k of the metal, linear between the table's wavelengths (400 to 700 nm)."""
        if not _SHORTEST_NM <= wavelength_nm <= _LONGEST_NM:
            raise SceneError(f"wavelength_nm = {wavelength_nm}: the {self.metal}'s table covers 400 to 700 nm")
        table = METALS[self.metal]
        n, k = (float(np.interp(wavelength_nm, table[:, 0], table[:, i])) for i in (1, 2))
        return complex(n, k)

    def band(self, wavelength_nm: float) -> BandReflectance:
        """Reflectance at a wavelength."""
        index, table = self.refractive_index(wavelength_nm), self.reflectance_table
        none = np.empty(0)
        if table is None:
            return BandReflectance(index, 1.0, 1.0, none, none)
        row, normal = table.row(wavelength_nm), float(_fresnel(index, np.array(1.0)))
        if table.angle_deg:
            return BandReflectance(index, 1.0, 1.0, np.radians(table.angle_deg), row)
        value = float(row[0])
        return BandReflectance(index, min(value / normal, 1.0), min((1.0 - value) / (1.0 - normal), 1.0), none, none)

    def reflectance(self, cos_incidence: Array, wavelength_nm: float) -> Array:
        """Unpolarised power reflectance, shape of `cos_incidence` (cosine of the angle of incidence)."""
        return self.band(wavelength_nm).at(cos_incidence)
