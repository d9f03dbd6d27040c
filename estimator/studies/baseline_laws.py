"""The laws of eq. (7): a noise error that grows as D^2 and falls as 1/h; and what the published errors do instead."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import polars as pl

from phibench.estimator.studies.power_law import PowerLaw, fit_power_law
from phibench.scenes.frames import Array
from phibench.scenes.streams import generator

EXPECTED = (2.0, -1.0)  # eq. (7): exponents of D and of h


@dataclass(frozen=True)
class LawFit:
    """Exponents of D and h of one quantity."""

    name: str
    law: PowerLaw
    cases: int

    @property
    def holds(self) -> tuple[bool, bool]:
        """Whether 2 and -1 lie in the intervals."""
        return self.law.holds(0, EXPECTED[0]), self.law.holds(1, EXPECTED[1])


@dataclass(frozen=True)
class Curve:
    """What the published errors of one table do with h: rms of what a law leaves, metres.

    Attributes
    ----------
    experiment : str
    signs : int
        Changes of sign along h.
    rms_m, inverse_m, line_m, offset_m : float
        Root mean square of the errors, and of the residuals of c/h, a + b h, and a + b/h (over degrees of freedom).
    law : PowerLaw
        Of the absolute errors with h.
    """

    experiment: str
    signs: int
    rms_m: float
    inverse_m: float
    line_m: float
    offset_m: float
    law: PowerLaw


def laws_of_noise(table: pl.DataFrame, method: str, resamples: int) -> list[LawFit]:
    """Exponents of the scatter of our estimates, of the bound, and of the geometry with and without the sines."""
    rows = table.filter((pl.col("sense") == "exact") & (pl.col("method") == method))
    bases = rows.select("depth_m", "stroke_m").to_numpy().T
    sines, sd, bound, per_px, disparity = (
        rows[name].to_numpy() for name in ("sines", "sd_m", "bound_m", "m_per_px", "bound_disparity_rad")
    )
    quantities = {
        "scatter of the estimates": sd,
        "scatter, per disparity error and with the sines": sd * sines / disparity,
        "bound": bound,
        "bound, per disparity error and with the sines": bound * sines / disparity,
        "one pixel of noise": per_px,
    }
    return [_fit(name, values, bases, resamples) for name, values in quantities.items()]


def published_curve(experiment: str, stroke_m: Array, error_m: Array, resamples: int) -> Curve:
    """Laws of the published errors of one table, strokes in rising order."""
    ones, inverse = np.ones_like(stroke_m), 1.0 / stroke_m
    random = generator("study", "baseline", "published", experiment)
    return Curve(
        experiment,
        int(np.count_nonzero(np.diff(np.sign(error_m)))),
        float(np.sqrt(np.mean(error_m**2))),
        _left(error_m, inverse[:, None]),
        _left(error_m, np.stack([ones, stroke_m], -1)),
        _left(error_m, np.stack([ones, inverse], -1)),
        fit_power_law(np.abs(error_m), stroke_m[None], random, resamples),
    )


def _fit(name: str, values: Array, bases: Array, resamples: int) -> LawFit:
    law = fit_power_law(values, bases, generator("study", "baseline", "law", name), resamples)
    return LawFit(name, law, int(np.isfinite(values).sum()))


def _left(y: Array, design: Array) -> float:
    """Residual standard deviation of least squares."""
    residual = y - design @ np.linalg.lstsq(design, y, rcond=None)[0]
    return float(np.sqrt(residual @ residual / (len(y) - design.shape[1])))
