"""What a calibration makes of a misaligned rig: simulated measurements in, `bundle.calibrate` out.

Measured are the outline of the mirror, and a few laser spots at known distances with the study's own stroke. What is
believed beforehand is the nominal rig, each number as good as the study's magnitude says.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from phibench.datasets.errors import DatasetError
from phibench.estimator.calibration.apparent import apparent_centre
from phibench.estimator.calibration.bundle import Bundle, KnownSpot, calibrate
from phibench.estimator.calibration.measured import Measured
from phibench.estimator.calibration.parameters import PRIOR_SIGMA, prior_sigmas
from phibench.estimator.studies.misaligned import seen_px
from phibench.scenes.frames import Array
from phibench.scenes.misalignment import PARAMETERS, Misalignment
from phibench.scenes.rig import Rig

_SAME = {  # names of the calibration's parameters that a study's misalignment calls otherwise
    "stroke_m": "stroke_offset_m",
    "stroke_scale": "stroke_relative",
    "z_c_m": "axial_m",
}


@dataclass(frozen=True)
class Bench:
    """How a rig is calibrated.

    Parameters
    ----------
    points_m : shape (k, 3)
        Calibration spots.
    pixel_sigma_px, distance_sigma_m : float
        Of a spot, in each image and axis, and of its distance from the stroke axis.
    outline_sigma_m : 3 floats
        Of the sphere centre from the outline, camera axes.
    """

    points_m: Array
    pixel_sigma_px: float
    distance_sigma_m: float
    outline_sigma_m: tuple[float, float, float]

    def calibrated(
        self, nominal: Rig, stroke_m: float, misalignment: Misalignment, rng: np.random.Generator | None = None
    ) -> Bundle:
        """Rig from exact measurements, or from measurements with noise from `rng`.

        Raises
        ------
        DatasetError
            If a calibration spot is not in the image, or the fit finds no start.
        """
        true, h = nominal.perturbed(misalignment), misalignment.stroke_m(stroke_m)
        outline = apparent_centre(nominal, true) + _noise(rng, np.array(self.outline_sigma_m))
        down, up = (seen_px(true.at(offset), self.points_m) for offset in (0.0, h))
        if not np.isfinite([down, up]).all():
            raise DatasetError("a calibration spot is not in the image of the misaligned rig")
        down, up = (uv + _noise(rng, np.full(uv.shape, self.pixel_sigma_px)) for uv in (down, up))
        centre = true.at(0.0).sphere_centre_m
        D = np.hypot(*(self.points_m - centre).T[:2])
        D = D + _noise(rng, np.full(D.shape, self.distance_sigma_m))
        C = self.pixel_sigma_px**2 * np.eye(2)
        spots = [
            KnownSpot(d, u, C, C, stroke_m, float(each), self.distance_sigma_m)
            for d, u, each in zip(down, up, D, strict=True)
        ]
        measured = Measured(outline, np.diag(np.square(self.outline_sigma_m)))
        return calibrate(nominal, measured, spots, sigmas=believed_sigmas(nominal))


def believed_sigmas(nominal: Rig) -> Array:
    """Priors, shape (p,): the study's magnitudes, or the calibration's own where they are larger."""
    focal_px = nominal.camera.fx_px * PARAMETERS["focal_relative"].study
    study = {name: PARAMETERS[_SAME.get(name, name)].study for name in PRIOR_SIGMA if name != "f_px"}
    return prior_sigmas({name: max(PRIOR_SIGMA[name], {**study, "f_px": focal_px}[name]) for name in PRIOR_SIGMA})


def _noise(rng: np.random.Generator | None, sigma: Array) -> Array:
    return np.zeros(sigma.shape) if rng is None else rng.normal(0.0, sigma)
