"""Bounds of pairs whose two spots are one point of the room, and the test whether answers are below them.

A method that sees both images knows four coordinates of three unknowns. Its bound is smaller than that of the single
images: `combine.joint_bound`. A smaller error than any method on the images can have shows knowledge from elsewhere,
such as where the boards of a room stand.

The test takes the largest covariance that bounds every method, `possible_px2`:

    chi^2 = sum over pairs of e^T V^-1 e,   E(chi^2) >= degrees of freedom for every unbiased method on the images.

A method at the bound has Gaussian errors, whose sum has the law of chi^2. An answer set is flagged where the lower tail
is below `FALSE_ALARM` over the number of tests. Errors of positions are first projected on the three unknowns of a
pair: of every unbiased answer that projection scatters by V or more.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import polars as pl
from scipy.stats import chi2

from phibench.estimator.benchmark.answer_errors import phi_variance
from phibench.estimator.geometry.combine import JointBound, information, joint_bound
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig

RAW_MARGIN = 1.15
"""Largest rms at the raw pixels' bound over the smallest possible one. The bound takes the room behind the spot as
unknown and the fixed pattern as noise. A laser-off frame tells both in part: known, they are worth 0.4 % and 2 to 12 %
of the rms on the spots of bench-dev (docs/measurements/scores.md)."""
MODEL_MARGIN = 1.3
"""The same of processed images, whose bound is that of a model: 10 to 30 % too large in a dark room (docs/limits)."""
FALSE_ALARM = 1e-3
"""Chance that a method at the bound is flagged by any of `QUANTITIES`."""


@dataclass(frozen=True)
class PairBounds:
    """Joint bounds of n pairs that share a nominal rig, and what their answers make of them; NaN where there is none.

    Attributes
    ----------
    down_px2, up_px2 : shape (n, 2, 2), of (u, v)
    depth_m2 : shape (n,)
    position_chi2, phi_chi2, depth_chi2 : shape (n,)
        Squared errors over what is possible; degrees of freedom as in `QUANTITIES`.
    """

    down_px2: Array
    up_px2: Array
    depth_m2: Array
    position_chi2: Array
    phi_chi2: Array
    depth_chi2: Array


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
    errors_phi_rad: tuple[Array, Array],
    error_depth_m: Array,
) -> PairBounds:
    """Joint bounds of pairs, and their squared errors over what is possible.

    Parameters
    ----------
    rig : Rig, the nominal one
    stroke_m, depth_m, error_depth_m : shape (n,)
    true_px, errors_px : (down, up), shape (n, 2) each
    bounds : (down, up)
    errors_phi_rad : (down, up), shape (n,) each
    """
    at = rig, stroke_m, true_px[0], depth_m
    joint = joint_bound(*at, *(one.image_px2 for one in bounds))
    possible_px2 = [one.possible_px2 for one in bounds]
    possible = joint_bound(*at, *possible_px2)
    covariances = possible.covariance_down_px2, possible.covariance_up_px2
    phi2 = [
        error**2 / phi_variance(rig, uv, C) for error, uv, C in zip(errors_phi_rad, true_px, covariances, strict=True)
    ]
    return PairBounds(
        joint.covariance_down_px2,
        joint.covariance_up_px2,
        joint.variance_depth_m2,
        _projected(possible, possible_px2, errors_px),
        # the mean of both: no more spread than one of them, whatever their correlation
        0.5 * (phi2[0] + phi2[1]),
        error_depth_m**2 / possible.variance_depth_m2,
    )


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

QUANTITIES: dict[str, tuple[str, str, int]] = {
    "positions": ("sharp_pair", "possible_position_chi2", 3),
    "phi": ("sharp_pair", "possible_phi_chi2", 1),
    "D": ("sharp_depth", "possible_depth_chi2", 1),
}
"""What is tested: the column that says which pairs count, that of their squares, and its degrees of freedom."""


@dataclass(frozen=True)
class Excess:
    """A quantity that is better than the images allow.

    Attributes
    ----------
    quantity : key of `QUANTITIES`
    ratio : float
        Smallest possible rms over the rms of the answers, above 1.
    pairs : int
    chance : float
        Of errors as small at the bound, times the number of tests.
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
    found = []
    for quantity, (counts, column, freedom) in QUANTITIES.items():
        squares = records.filter((pl.col("image") == "down") & pl.col(counts))[column].drop_nulls().to_numpy()
        total, expected = float(squares.sum()), freedom * len(squares)
        chance = min(1.0, len(QUANTITIES) * float(chi2.cdf(total, expected))) if expected else 1.0
        if chance < FALSE_ALARM:
            ratio = float(np.sqrt(expected / total)) if total > 0.0 else np.inf
            found.append(Excess(quantity, ratio, len(squares), chance))
    return found
