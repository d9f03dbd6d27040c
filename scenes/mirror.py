"""The spherical mirror, its form error, and the optical constants of its steel.

Source of the table: austenitic stainless steel (about 316), B. Karlsson and C. G. Ribbing,
"Optical constants and spectral selectivity of stainless steel and its oxides", J. Appl. Phys. 53, 6340 (1982),
read from a figure, good to 1 to 2 %.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from phibench.scenes.checks import SceneError, positive, within
from phibench.scenes.form import Form, curvatures, directions, level
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

_LEAST_CURVATURE = 0.5  # times 1/R: convex with a margin, so that every point has one image at most
_PLACES = 500  # where the curvature is looked at, 9 degrees apart: peaks of degree 3 are missed by 5 % at most


@dataclass(frozen=True)
class SphereMirror:
    """A polished stainless-steel sphere.

    Parameters
    ----------
    radius_m : float
    roughness_alpha : float
        Beckmann roughness (rms slope x sqrt 2); 0 is an ideal mirror, 0.005 blurs by about 1 px.
    form : Form or None
        Deviations from the sphere; None is a perfect one, and so is a `Form` whose numbers are all 0.
    """

    radius_m: float = 0.060
    roughness_alpha: float = 0.0
    form: Form | None = None

    def __post_init__(self) -> None:
        positive("SphereMirror", "radius_m", self.radius_m)
        within("SphereMirror", "roughness_alpha", self.roughness_alpha, 0.0, 0.05)
        if self.form is None:
            return
        if not any(self.form.coefficients_m):
            object.__setattr__(self, "form", None)
            return
        _check_convex(self.radius_m, self.form)

    @property
    def bound_m(self) -> float:
        """No point of the surface is farther from the centre than this; the radius of a perfect sphere."""
        return self.radius_m if self.form is None else self.radius_m + self.form.bound_m

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


def _check_convex(radius_m: float, form: Form) -> None:
    """Raise `SceneError` for a form that is too far from round."""
    if form.bound_m < 0.5 * radius_m:
        least = float(curvatures(level(radius_m * directions(_PLACES), radius_m, form))[0].min()) * radius_m
        if least >= _LEAST_CURVATURE:
            return
        found = f"its curvature falls to {least:.2f} of the sphere's; at least {_LEAST_CURVATURE} is needed"
    else:
        found = f"its peaks add up to {form.bound_m:g} m; less than half the radius is needed"
    raise SceneError(f"SphereMirror.form is too far from round for radius_m = {radius_m:g}: {found}; make it smaller")
