"""Polished metals: complex refractive index, and the reflectance that follows.

* Steel, austenitic stainless (about 316): B. Karlsson and C. G. Ribbing, "Optical constants and spectral selectivity of
  stainless steel and its oxides", J. Appl. Phys. 53, 6340 (1982), read from a figure, good to 1 to 2 %.
* Aluminium, evaporated: A. D. Rakic, "Algorithm for the determination of intrinsic optical constants of metal films:
  application to aluminum", Appl. Opt. 34, 4755 (1995).
* Gold, evaporated: P. B. Johnson and R. W. Christy, "Optical constants of the noble metals", Phys. Rev. B 6, 4370
  (1972).

A polished or oxidised surface reflects less than an evaporated film.
"""

from __future__ import annotations

from types import MappingProxyType
from typing import Literal

import numpy as np

from phibench.scenes.frames import Array
from phibench.scenes.validation import SceneError

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

_SHORTEST_NM, _LONGEST_NM = 400.0, 700.0


def known_metal(owner: str, name: str) -> None:
    """Raise `SceneError` for a metal that has no table."""
    if name not in METALS:
        raise SceneError(f"{owner}.metal = {name}: known are {', '.join(METALS)}")


class MetalSurface:
    """Reflectance of a polished metal: what mirrors of every shape share."""

    metal: MetalName
    roughness_alpha: float

    def refractive_index(self, wavelength_nm: float) -> complex:
        """Complex index n + i k of the metal, linear between the table's wavelengths (400 to 700 nm)."""
        if not _SHORTEST_NM <= wavelength_nm <= _LONGEST_NM:
            raise SceneError(f"wavelength_nm = {wavelength_nm}: the {self.metal}'s table covers 400 to 700 nm")
        table = METALS[self.metal]
        n, k = (float(np.interp(wavelength_nm, table[:, 0], table[:, i])) for i in (1, 2))
        return complex(n, k)

    def reflectance(self, cos_incidence: Array, wavelength_nm: float) -> Array:
        """Unpolarised Fresnel power reflectance, shape of `cos_incidence` (cosine of the angle of incidence)."""
        m2 = self.refractive_index(wavelength_nm) ** 2
        cos_i = np.asarray(cos_incidence, float)
        with np.errstate(invalid="ignore"):  # NaN in, NaN out
            root = np.sqrt(m2 - (1.0 - cos_i * cos_i))
            r_s = (cos_i - root) / (cos_i + root)
            r_p = (m2 * cos_i - root) / (m2 * cos_i + root)
        return 0.5 * (np.abs(r_s) ** 2 + np.abs(r_p) ** 2)
