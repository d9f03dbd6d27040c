"""Fit of a spot that is told where to look (`fit_at_truth`): whether an image allows a position that a method missed.

The built-in fit of the image's kind searches a small box about the true place. Where it comes as near to the truth as
the bound says, the light was there, and neither saturation, noise, compression nor an edge is why another method has
no right position.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol

import numpy as np

from phibench.estimator.interface import Answer, Box, Image, Pair
from phibench.estimator.methods.chain_fit import chain_fit
from phibench.estimator.methods.raw_likelihood import raw_likelihood
from phibench.estimator.methods.spot_search import square_around
from phibench.estimator.pair_set import ImageTruth, PairTruth
from phibench.estimator.spots.image_planes import PROCESSED

_BOX_PX = 24
_SIGMAS = 4.0  # of the bound: a fit at the bound is further off in 3e-4 of the cases


class FitAtTruth(Protocol):
    """Function that answers a pair as a fit at the truth does."""

    def __call__(self, pair: Pair, truth: PairTruth) -> Answer | None:
        """Answer; None where there is none."""


def fit_at_truth(pair: Pair, truth: PairTruth) -> Answer:
    """Answer of the built-in fit, which is shown boxes about the true places."""
    shown = replace(pair, box_down=_box_about(truth.down, pair.down), box_up=_box_about(truth.up, pair.up))
    return chain_fit(shown) if pair.card.output in PROCESSED else raw_likelihood(shown)


class KeptFits:
    """Fits at the truth, each made once: methods on the same pairs share them. Make a new one for other pairs."""

    def __init__(self) -> None:
        self._answers: dict[int, Answer] = {}

    def __call__(self, pair: Pair, truth: PairTruth) -> Answer:
        """Answer to a pair, by its number."""
        if truth.number not in self._answers:
            self._answers[truth.number] = fit_at_truth(pair, truth)
        return self._answers[truth.number]


def reaches_bound(answer: Answer | None, position: str, spot: ImageTruth, match_px: float) -> bool:
    """Tell whether an answer is as near to the truth as the bound says.

    Where the bound itself is so wide that four of its deviations exceed `match_px`, nothing is reached: an answer in
    the box would be near by chance.
    """
    answered, bound = getattr(answer, position, None), spot.bound_px2
    if answered is None or answered.uv_px is None or bound is None or not spot.visible:
        return False
    reach = _SIGMAS * float(np.sqrt(np.trace(bound) / 2.0))
    return reach <= match_px and float(np.linalg.norm(np.subtract(answered.uv_px, spot.uv_px))) <= reach


def _box_about(spot: ImageTruth, image: Image) -> Box | None:
    if not (spot.visible and np.isfinite(spot.uv_px).all()):
        return None
    return square_around(spot.uv_px, image.shape, _BOX_PX)
