"""When two log evidences of the study `cause` differ by enough to say so.

A sampler's own error leaves out modes that it lost. Five pairs of samplings of explanations with a free tilt differ by
2.0, 1.6, 2.6, 2.1 and 1.8 in log evidence, a scatter of 1.45 for one sampling (95 % of 0.9 to 3.6, five degrees of
freedom), where the sampler states 0.6 to 0.7; with fourteen more at 60 live points it is 1.76 (1.3 to 2.6), so that the
floor is no upper limit. Two samplings say next to nothing of their scatter, three a little.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

DECIDED = float(np.log(10.0))  # odds of 10 to 1
SIGMAS = 2.0  # how many errors a difference must exceed that by
ENOUGH = 3  # samplings whose scatter is an error
FLOOR = 1.5  # of the error of a log evidence of fewer samplings
Verdict = Literal["favoured", "disfavoured", "undecided"]
RULE = f"decided is what exceeds odds of 10 to 1 ({DECIDED:.1f}) by twice its error"


def evidence_error(measured: float, repeats: int) -> float:
    """Error of a log evidence, one sigma.

    Parameters
    ----------
    measured : float
        Larger of the sampler's own error and of the scatter of repeats, of their mean (`cause_sampler.pooled`).
    repeats : int
        Independent samplings; of fewer than `ENOUGH` the error is at least `FLOOR`.
    """
    return measured if repeats >= ENOUGH else max(measured, FLOOR)


def verdict(difference: float, error: float) -> Verdict:
    """What a difference of log evidences with an error of one sigma says of the first of the two."""
    if abs(difference) <= DECIDED + SIGMAS * error:
        return "undecided"
    return "favoured" if difference > 0.0 else "disfavoured"
