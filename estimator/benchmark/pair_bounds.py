"""Bounds of pairs whose two spots are one point of the room, and the test whether answers are below them.

A method that sees both images knows four coordinates of three unknowns. Its bound is smaller than that of the single
images: `combine.joint_bound`. A smaller error than any method on the images can have shows knowledge from elsewhere,
such as where the boards of a room stand.

The test takes the largest covariance V that bounds every method (`SpotBoundsOfImages.possible_px2`). Of every unbiased
method on the images a squared error is V or more on average; at V errors are Gaussian. Answers are flagged where a sum
of squares is smaller than nearly all sums of such errors (`excesses`):

* positions: sum of e^T V^-1 e, of 3 degrees of freedom a pair. Errors are first projected on the three unknowns of a
  pair: that projection of unbiased answers scatters by V or more;
* phi and D: sum of e^2, as in the efficiency, against draws of the sum of V g^2 with standard normal g.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import polars as pl
from scipy.stats import chi2

from phibench.estimator.benchmark.answer_errors import kept, phi_variance
from phibench.estimator.geometry.combine import JointBound, information, joint_bound
from phibench.scenes.frames import Array
from phibench.scenes.random_streams import generator
from phibench.scenes.rig import Rig

RAW_MARGIN = 1.15
"""Largest rms at the raw pixels' bound over the smallest possible one. The bound takes the room behind the spot as
unknown and the fixed pattern as noise. A laser-off frame tells both in part. Known in full, the pattern is worth 13 %
of the rms at most on the Bayer spots of the recipe random (docs/measurements/scores.md), and 12 % on rendered mono
ones."""
MODEL_MARGIN = 1.3
"""The same of processed images, whose bound is that of a model: 10 to 30 % too large in a dark room (docs/limits)."""
FALSE_ALARM = 1e-3
"""Chance that a method at the smallest possible variances is flagged for any of `QUANTITIES`."""


@dataclass(frozen=True)
class PairBounds:
    """Joint bounds of n pairs that share a nominal rig, and what their answers make of them; NaN where there is none.

    Attributes
    ----------
    down_px2, up_px2 : shape (n, 2, 2), of (u, v)
    depth_m2 : shape (n,)
    possible_position_chi2 : shape (n,)
        Squared errors over what is possible, of 3 degrees of freedom.
    possible_phi_rad2, possible_depth_m2 : shape (n,)
        Smallest possible variances: sum of both images, and of D.
    """

    down_px2: Array
    up_px2: Array
    depth_m2: Array
    possible_position_chi2: Array
    possible_phi_rad2: Array
    possible_depth_m2: Array


@dataclass(frozen=True)
class SpotBoundsOfImages:
    """Both bounds of the single images of n pairs, shape (n, 2, 2): of the image, and of the raw pixels behind it."""

    image_px2: Array
    raw_px2: Array

    @property
    def possible_px2(self) -> Array:
        """Smallest covariance that a method can have: the larger of both, each less its margin."""
        raw, model = self.raw_px2 / RAW_MARGIN**2, self.image_px2 / MODEL_MARGIN**2
        with np.errstate(invalid="ignore"):
            larger = np.linalg.det(model) > np.linalg.det(raw)  # False for NaN
        return np.where(larger[:, None, None], model, raw)


def pair_bounds(
    rig: Rig,
    stroke_m: Array,
    depth_m: Array,
    true_px: tuple[Array, Array],
    bounds: tuple[SpotBoundsOfImages, SpotBoundsOfImages],
    errors_px: tuple[Array, Array],
) -> PairBounds:
    """Joint bounds of pairs, and their squared errors over what is possible.

    Parameters
    ----------
    rig : Rig, the nominal one
    stroke_m, depth_m : shape (n,)
    true_px, errors_px : (down, up), shape (n, 2) each
    bounds : (down, up)
    """
    at = rig, stroke_m, true_px[0], depth_m
    joint = _joint_bound(*at, *(one.image_px2 for one in bounds))
    possible_px2 = [one.possible_px2 for one in bounds]
    possible = _joint_bound(*at, *possible_px2)
    covariances = possible.covariance_down_px2, possible.covariance_up_px2
    phi_rad2 = [phi_variance(rig, uv, C) for uv, C in zip(true_px, covariances, strict=True)]
    return PairBounds(
        joint.covariance_down_px2,
        joint.covariance_up_px2,
        joint.variance_depth_m2,
        _projected(possible, possible_px2, errors_px),
        phi_rad2[0] + phi_rad2[1],
        possible.variance_depth_m2,
    )


_joint_bound = kept(joint_bound)


def _projected(joint: JointBound, covariances_px2: list[Array], errors_px: tuple[Array, Array]) -> Array:
    """b^T A^-1 b, b the information-weighted errors: chi^2 of three degrees, shape (n,)."""
    W1, W2 = (information(C) for C in covariances_px2)
    b = np.einsum("nji,njk,nk->ni", joint.jacobian, W2, errors_px[1])
    b[:, :2] += np.einsum("nij,nj->ni", W1, errors_px[0])
    with np.errstate(invalid="ignore"):
        good = np.isfinite(joint.information).all(axis=(1, 2)) & np.isfinite(b).all(axis=1)
    A = np.where(good[:, None, None], joint.information, np.eye(3))
    solved = np.linalg.solve(A, np.where(good[:, None], b, 0.0)[..., None])[..., 0]
    return np.where(good, np.einsum("ni,ni->n", b, solved), np.nan)


# -- more than the images tell -----------------------------------------------------------------------------------------

QUANTITIES = ("positions", "phi", "D")
_FREEDOM = 3  # of the positions of a pair
_DRAWS = 20_000
_FIRST = 64
_AT_ONCE = 2**21  # numbers drawn at a time: 16 MiB


@dataclass(frozen=True)
class Excess:
    """A quantity that is better than the images allow.

    Attributes
    ----------
    quantity : one of `QUANTITIES`
    ratio : float
        Smallest possible rms over the rms of the answers, above 1.
    pairs : int
    chance : float
        Of errors as small for a method at the bound, times the number of tests.
    """

    quantity: str
    ratio: float
    pairs: int
    chance: float


def excesses(records: pl.DataFrame) -> list[Excess]:
    """Quantities whose errors are smaller than any method on the images can have.

    Parameters
    ----------
    records : `metrics.prepared`
    """
    down = records.filter(pl.col("image") == "down")
    positions = down.filter("sharp_pair")["possible_position_chi2"].drop_nulls().to_numpy()
    phi = _columns(down.filter("sharp_pair"), "pair_phi_error_rad2", "possible_phi_rad2")
    depth = _columns(
        down.filter("sharp_depth").with_columns(depth_error_m2=pl.col("depth_error_m") ** 2),
        "depth_error_m2",
        "possible_depth_m2",
    )
    tried = [
        _excess("positions", positions.sum(), _FREEDOM * len(positions), len(positions), chi2.cdf),
        *(
            # both images of a pair share one number: correlated or not, their sum scatters no more than that
            _excess(quantity, squares.sum(), variances.sum(), len(squares), _drawn_below(quantity, variances))
            for quantity, (squares, variances) in zip(QUANTITIES[1:], (phi, depth), strict=True)
        ),
    ]
    return [one for one in tried if one.pairs and one.chance < FALSE_ALARM]


def _columns(table: pl.DataFrame, squares: str, variances: str) -> tuple[Array, Array]:
    there = table.select(squares, variances).drop_nulls()
    return there[squares].to_numpy(), there[variances].to_numpy()


def _excess(quantity: str, total: float, expected: float, pairs: int, below: Callable[[float, float], float]) -> Excess:
    """Outcome of one test; `below` is the chance of a sum up to `total` where `expected` is its mean."""
    chance = min(1.0, len(QUANTITIES) * float(below(total, expected))) if pairs else 1.0
    return Excess(quantity, float(np.sqrt(expected / total)) if total > 0.0 else np.inf, pairs, chance)


def _drawn_below(quantity: str, variances: Array) -> Callable[[float, float], float]:
    """Chance of a sum of V g^2 up to a number, from draws: (1 + draws below) / (1 + draws).

    Where the first draws alone give more than what is flagged, that is all that is said: the chance is no smaller.
    """

    def drawn() -> np.random.Generator:
        return generator("more than the images", quantity)

    def chance(total: float, _: float) -> float:
        first = np.count_nonzero(drawn().chisquare(1.0, (_FIRST, len(variances))) @ variances <= total)
        if len(QUANTITIES) * first > FALSE_ALARM * (1.0 + _DRAWS):
            return float((1.0 + first) / (1.0 + _DRAWS))
        rng, below = drawn(), 0
        rows = max(1, _AT_ONCE // len(variances))
        for start in range(0, _DRAWS, rows):
            sums = rng.chisquare(1.0, (min(rows, _DRAWS - start), len(variances))) @ variances
            below += int(np.count_nonzero(sums <= total))
        return (1.0 + below) / (1.0 + _DRAWS)

    return chance
