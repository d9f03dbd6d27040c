"""Built-in method `joint_fit`: both spots as one point, of raw or processed images; posteriors of faint spots.

`joint_fit` first fits each image by itself: raw pixels by `raw_maximum_likelihood`, processed ones by `chain_fit`. It
then gives means, covariances and a 95 % interval of the posterior of both images (`joint_posterior`), which knows of
valleys and of several minima; D is the posterior's mean. Of raw pixels with laser-off frames the likelihood is that of
on - off, with the noise of both and the pattern of the spot alone. Where the maps do not hold the posterior, raw pixels
are fitted together (`spots.fit_joint`) and the positions of processed ones combined by their covariances
(`least_squares_depth`). Where the two are not one point, the separate answer stands, without a depth of its own.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from phibench.estimator.geometry.joint_posterior import JointPosterior, joint_posterior, single_posterior
from phibench.estimator.geometry.least_squares_depth import CombinedEstimate, combine
from phibench.estimator.geometry.status import Status
from phibench.estimator.interface import Answer, Matrix2, Pair, Spot
from phibench.estimator.methods.chain_fit import chain_fit, spot_likelihood
from phibench.estimator.methods.likelihood_maps import (
    FAINT_PX,
    SpotLikelihood,
    likelihood_map,
    pixels_likelihood,
    place_covariance,
)
from phibench.estimator.methods.raw_likelihood import over_known_room, raw_likelihood, raw_spot_data
from phibench.estimator.methods.spot_search import SharedPair, joint_or_separate, seen_depth_m
from phibench.estimator.spots.fit_joint import JointFit, fit_joint
from phibench.scenes.frames import Array
from phibench.scenes.rig import POSITIONS

_OTHER_SHAPE = 4.0  # by which a claim's variance exceeds the model's own where the light is not the model's
_MOST_CHI2 = 24.0  # of one degree of freedom: 1e-6 by chance


def joint_fit(pair: Pair) -> Answer:
    """Positions and depth of a pair; the separate answers where one image has no spot or the two are not one point.

    Nor are they taken from a spot that left the place where it was seen (`spot_boxes`).
    """
    shared = pair if isinstance(pair, SharedPair) else SharedPair.of(pair)
    separate = raw_likelihood(shared) if pair.card.output == "raw" else chain_fit(shared)
    return joint_or_separate(shared, separate, joint_of(shared, separate))


def joint_of(pair: Pair, separate: Answer) -> Answer:
    """Answer for both images together, from that for each by itself: `raw_maximum_likelihood`'s or `chain_fit`'s."""
    if separate.down.covariance_px2 is None or separate.up.covariance_px2 is None:
        return separate
    return (_raw if pair.card.output == "raw" else _processed)(pair, separate)


def with_posteriors(pair: Pair, separate: Answer) -> Answer:
    """Answer with mean and covariance of each image's own posterior for its faint spots; the rig enters nowhere."""
    depth_m = seen_depth_m(pair, separate)
    down, up = (_with_posterior(pair, name, getattr(separate, name), depth_m) for name in POSITIONS)
    return Answer(down, up)


def _with_posterior(pair: Pair, position: str, spot: Spot, depth_m: float | None) -> Spot:
    if spot.covariance_px2 is None or np.trace(spot.covariance_px2) < 2.0 * FAINT_PX**2:
        return spot
    of_spot = _likelihood(pair, position, spot, depth_m)
    places = None if of_spot is None else likelihood_map(of_spot)
    posterior = None if places is None else single_posterior(places)
    return spot if posterior is None else _joint_spot(*posterior)


def _likelihood(pair: Pair, position: str, spot: Spot, depth_m: float | None) -> SpotLikelihood | None:
    if pair.card.output != "raw":
        return spot_likelihood(pair, position, spot, depth_m)
    uv = np.array(spot.uv_px, float)
    return pixels_likelihood(over_known_room(pair, position, uv, depth_m), uv)


def _raw(pair: Pair, separate: Answer) -> Answer:
    starts = [np.array([spot.uv_px], float) for spot in (separate.down, separate.up)]
    depth_m = seen_depth_m(pair, separate)
    down, up = (raw_spot_data(pair, p, start[0], depth_m) for p, start in zip(POSITIONS, starts, strict=True))
    likelihoods = [pixels_likelihood(data, start[0]) for data, start in zip((down, up), starts, strict=True)]
    if _of_other_shape(separate, likelihoods):
        return _combined(pair, separate)
    posterior = _posterior(pair, likelihoods)
    if posterior is not None and posterior.status == Status.OK:
        return separate if not posterior.misfit < _MOST_CHI2 else _posterior_answer(posterior)
    return _answer(fit_joint(pair.rig, pair.stroke_m, down, up, *starts), separate)


def _processed(pair: Pair, separate: Answer) -> Answer:
    depth_m = seen_depth_m(pair, separate)
    likelihoods = [spot_likelihood(pair, p, getattr(separate, p), depth_m) for p in POSITIONS]
    if _of_other_shape(separate, likelihoods):
        return _combined(pair, separate)
    posterior = _posterior(pair, likelihoods)
    if posterior is not None and posterior.status == Status.OK:
        return separate if not posterior.misfit < _MOST_CHI2 else _posterior_answer(posterior)
    return _combined(pair, separate)


def _of_other_shape(separate: Answer, likelihoods: Sequence[SpotLikelihood | None]) -> bool:
    """True if a fit claims far more than its model's likelihood: its light has another shape, as on an edge.

    Not of faint spots: their likelihood has valleys, and the posterior says what they claim.
    """
    for position, likelihood in zip(POSITIONS, likelihoods, strict=True):
        own = math.inf if likelihood is None else float(np.trace(place_covariance(likelihood)))
        claimed = np.trace(np.array(getattr(separate, position).covariance_px2))
        if own < 2.0 * FAINT_PX**2 and claimed > _OTHER_SHAPE * own:
            return True
    return False


def _combined(pair: Pair, separate: Answer) -> Answer:
    """Answer from both positions and their claims, pixels left aside."""
    (uv1, C1), (uv2, C2) = (
        (np.array([spot.uv_px], float), np.array([spot.covariance_px2], float)) for spot in (separate.down, separate.up)
    )
    return _answer(combine(pair.rig, pair.stroke_m, uv1, C1, uv2, C2), separate)


def _posterior(pair: Pair, likelihoods: Sequence[SpotLikelihood | None]) -> JointPosterior | None:
    """Posterior of both images; None where one has no likelihood about its fit."""
    down, up = (None if likelihood is None else likelihood_map(likelihood) for likelihood in likelihoods)
    return None if down is None or up is None else joint_posterior(pair.rig, pair.stroke_m, down, up)


def _posterior_answer(found: JointPosterior) -> Answer:
    return Answer(
        _joint_spot(found.uv_down_px, found.covariance_down_px2),
        _joint_spot(found.uv_up_px, found.covariance_up_px2),
        found.depth_m,
        found.sigma_m,
        found.interval_m,
    )


def _answer(found: JointFit | CombinedEstimate, separate: Answer) -> Answer:
    if int(found.status[0]) != Status.OK or not found.chi2[0] < _MOST_CHI2:
        return separate
    return Answer(
        _joint_spot(found.uv_down_px[0], found.covariance_down_px2[0]),
        _joint_spot(found.uv_up_px[0], found.covariance_up_px2[0]),
        float(found.depth_m[0]),
        float(found.sigma_m[0]),
    )


def _joint_spot(uv_px: Array, covariance_px2: Array) -> Spot:
    (a, b), (c, d) = covariance_px2.tolist()
    matrix: Matrix2 = ((a, b), (c, d))
    return Spot((float(uv_px[0]), float(uv_px[1])), matrix)
