"""Verdict on a calibration in one sentence.

Three marks. "bad": the data contradict each other or the priors beyond chance. "doubtful": something unusual that a
person should look at. "good": neither. Parameters that only the prior knows are named under every mark.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from phibench.calibration.outline.outline_result import Outline
from phibench.calibration.rig.bundle import Bundle
from phibench.estimator.geometry.rig_parameters import PARAMETERS
from phibench.scenes.frames import Array

GOOD, DOUBTFUL, BAD = "good", "doubtful", "bad"
_P = (0.01, 1e-4)  # probability of a larger chi2: below the first doubtful, below the second bad
_FAR_SIGMAS = (3.0, 5.0)  # largest correction over its prior sigma, of 13: by chance in 3 % and in 1e-5 of all rigs
_ARC = 0.75  # an outline is refused below 0.6
_RIM_ARC = 0.3  # a rim below 0.2: in rooms full of things a third of it lies before a plain part of them
_SHIFT_PX = 0.4  # rms over sectors; in `lab` MJPEG frames have 0.18 px, raw ones 0.12 px, layers 0.05 px
_ONLY_PRIOR = 0.9  # of the prior's sigma is left: the data say next to nothing


@dataclass(frozen=True)
class Verdict:
    """Mark of a calibration.

    Attributes
    ----------
    mark : str
        "good", "doubtful" or "bad".
    reasons : tuple of str
        What speaks against it, the worst first; nothing for a good one.
    numbers : str
        chi2 and residuals.
    only_prior : tuple of str
        Parameters of which the data say next to nothing.
    """

    mark: str
    reasons: tuple[str, ...]
    numbers: str
    only_prior: tuple[str, ...]

    def __str__(self) -> str:
        why = f" ({'; '.join(self.reasons)})" if self.reasons else ""
        prior = f"; known from the prior only: {', '.join(self.only_prior)}" if self.only_prior else ""
        return f"calibration {self.mark}{why}: {self.numbers}{prior}"


def verdict_of(bundle: Bundle, prior: Array, outlines: list[Outline]) -> Verdict:
    """Judge a calibration.

    Parameters
    ----------
    bundle
    prior : shape (p,)
        Standard deviations that the fit began with.
    outlines : of the images that it used
    """
    p = float(chdtrc(bundle.degrees, bundle.chi2)) if bundle.degrees > 0 else 1.0
    with np.errstate(all="ignore"):
        far = np.nan_to_num(np.abs(bundle.values) / prior)
        left = np.sqrt(np.diag(bundle.covariance)) / prior
    worst, arc = int(np.argmax(far)), min(outline.arc for outline in outlines)
    least = _ARC if outlines[0].ellipse_px is None else _RIM_ARC
    shift_px = max(outline.shift_rms_px for outline in outlines)
    faults = [
        # an underflow of p is a bad fit
        (_level(-np.log(max(p, 1e-300)), *(-np.log(_P))), f"chi2 is too large, p = {p:.1e}"),
        (_level(far[worst], *_FAR_SIGMAS), f"{PARAMETERS[worst]} is corrected by {far[worst]:.1f} prior sigmas"),
        (_level(-arc, -least), f"only {100.0 * arc:.0f} % of an outline could be used"),
        (_level(shift_px, _SHIFT_PX), f"an outline is off by {shift_px:.2f} px rms: another mirror, or a bad frame"),
    ]
    faults = sorted((fault for fault in faults if fault[0]), key=lambda fault: -fault[0])
    numbers = (
        f"chi2 {bundle.chi2:.1f} for {bundle.degrees} degrees of freedom (p = {p:.2g}), "
        f"outline residual {shift_px:.3f} px rms over {100.0 * arc:.0f} % of it"
    )
    only = tuple(n for n, x, s in zip(PARAMETERS, left, prior, strict=True) if s > 0.0 and x > _ONLY_PRIOR)
    mark = (GOOD, DOUBTFUL, BAD)[max((level for level, _ in faults), default=0)]
    return Verdict(mark, tuple(text for _, text in faults), numbers, only)


def _level(value: float, *limits: float) -> int:
    """Number of limits that a value is above."""
    return sum(bool(value > limit) for limit in limits)
