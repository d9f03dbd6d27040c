"""The spherical mirror and the optical constants of its steel.

Source of the table: austenitic stainless steel (about 316), B. Karlsson and C. G. Ribbing,
"Optical constants and spectral selectivity of stainless steel and its oxides", J. Appl. Phys. 53, 6340 (1982),
read from a figure, good to 1 to 2 %.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from phibench.scenes.checks import SceneError, positive, within
from phibench.scenes.frames import Array

# wavelength in nm, n, k
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
STEEL.setflags(write=False)


@dataclass(frozen=True)
class SphereMirror:
    """A polished stainless-steel sphere.

    Parameters
    ----------
    radius_m : float
    roughness_alpha : float
        Beckmann roughness (rms slope x sqrt 2); 0 is an ideal mirror, 0.005 blurs by about 1 px.
    """

    radius_m: float = 0.060
    roughness_alpha: float = 0.0

    def __post_init__(self) -> None:
        positive("SphereMirror", "radius_m", self.radius_m)
        within("SphereMirror", "roughness_alpha", self.roughness_alpha, 0.0, 0.05)

    def refractive_index(self, wavelength_nm: float) -> complex:
        """Complex index n + i k of the steel, linear between the table's wavelengths (400 to 700 nm)."""
        if not STEEL[0, 0] <= wavelength_nm <= STEEL[-1, 0]:
            raise SceneError(f"wavelength_nm = {wavelength_nm}: the steel's table covers 400 to 700 nm")
        n, k = (float(np.interp(wavelength_nm, STEEL[:, 0], STEEL[:, i])) for i in (1, 2))
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
