"""Rules of a score (`Rules`); errors of answers in px and phi, pulls, squares for ranks; a cache of array functions.

Definitions, used by all metrics:

found
    The spot is visible and a position is given within `match_px` of the centre of the light.
missed
    The spot is visible and not found.
false detection
    A position is given where no spot is visible, or further than `match_px` from it. An image can be missed and
    falsely detected at once.
depth found
    Both spots of the pair are found, and a finite depth above 0 follows: the method's own, else that of the positions.

Errors are over found spots. "Missed counted" is over visible spots: a missed one counts as `match_px`, a missed depth
as the best constant answer for the set would (`best_constant`). The ranks also count false detections: see
`rank_squares`. No answer counts more than none, so that an error is cut off at what a missed spot costs.

A method that sees both images knows four coordinates of three unknowns. Its bound is smaller than that of the single
images: `least_squares_depth.joint_bound`. A smaller error than any method on the images can have shows knowledge from
elsewhere, such as where the boards of a room stand.

V is the least covariance of a method on the images: the joint bound of `beyond_images.least_px2`. Of every unbiased
method a squared error is V or more on average. Three numbers are tested by `beyond_images.excesses`:

* positions of a pair: e^T V^-1 e, errors first projected on the three unknowns of a pair, of 3 degrees of freedom: that
  projection of unbiased answers scatters by V or more;
* the position in one image: e^T V^-1 e with that image's part of V, of 2 degrees of freedom; where the other image
  shows no spot, V is that of the single image;
* phi of one image, and D: e^2 over its variance.

The kernels take n answers that share a nominal and a true rig; NaN where there is nothing to compare. Integer (u, v)
are pixel centres. Phi does not depend on the carriage: rigs are taken at the down position.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from phibench.datasets.common.errors import DatasetError
from phibench.estimator.geometry.phi import CONVENTIONS, GRADIENTS, estimate_phi, outline_circle
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig

Flags = NDArray[np.bool_]
P = ParamSpec("P")
T = TypeVar("T")

MATCH_PX = 3.0
"""A spot at 5 sigma, the faintest that counts as there, is placed to 0.3 to 0.5 px (blur 0.7 px; mono to Bayer), so
that 3 px is six standard deviations or more and an answer beyond it belongs to something else. A blind guess in the
mirror's disc (radius 339 px) is within 3 px of the spot with a chance of 8e-5."""


@dataclass(frozen=True)
class Rules:
    """Numbers of a score.

    Parameters
    ----------
    match_px : float
        Largest distance of a position from the truth that counts as found.
    missed_relative, least_missed_relative : float
        Largest and smallest relative depth error as which a missed pair counts; between them the best constant's. Below
        10 % all pairs are at nearly one depth, and a constant that is made of their truth tells nothing.
    missed_phi_rad : float
        Error of phi as which a missed spot counts, and a false detection in a rank. 3 px along the radius are 9 to
        19 mrad on the rigs of the shipped recipes, so that every found spot counts less than a missed one.
    confidence : float
        Of every interval.
    resamples : int
        Bootstrap resamples of the samples.
    least_samples : int
        With fewer samples a metric has no interval.
    least_compared : int
        With fewer samples a comparison has no verdict.
    """

    match_px: float = MATCH_PX
    missed_relative: float = 1.0
    least_missed_relative: float = 0.1
    missed_phi_rad: float = 0.02
    confidence: float = 0.95
    resamples: int = 1999
    least_samples: int = 5
    least_compared: int = 30

    def __post_init__(self) -> None:
        _above("match_px", self.match_px, 0.0)
        _above("least_missed_relative", self.least_missed_relative, 0.0)
        if not self.missed_relative >= self.least_missed_relative:
            raise DatasetError(
                f"Rules.missed_relative = {self.missed_relative:g}: must be least_missed_relative, "
                f"{self.least_missed_relative:g}, or above"
            )
        _above("missed_phi_rad", self.missed_phi_rad, 0.0)
        _above("resamples", self.resamples, 98)  # 99 are the least that hold an interval of 95 %
        _above("least_samples", self.least_samples, 1)
        _above("least_compared", self.least_compared, 1)
        if not 0.5 <= self.confidence < 1.0:
            raise DatasetError(f"Rules.confidence = {self.confidence:g}: allowed are 0.5 up to below 1")


def _above(name: str, value: float, low: float) -> None:
    if not value > low:
        raise DatasetError(f"Rules.{name} = {value:g}: must be above {low:g}")


def best_constant(depths_m: Array) -> float:
    """Relative rms error of the constant that is best for some true depths; NaN for none.

    Of c / D - 1 over n pairs the mean square is smallest for c = sum(1 / D) / sum(1 / D^2), where it is
    1 - sum(1 / D)^2 / (n sum(1 / D^2)).

    Parameters
    ----------
    depths_m : shape (n,), above 0
    """
    if not len(depths_m):
        return float("nan")
    q = 1.0 / np.asarray(depths_m, float)
    return float(np.sqrt(max(0.0, 1.0 - q.sum() ** 2 / (len(q) * np.sum(q * q)))))


def rank_squares(error: Array, found: Flags, expected: Flags, false: Flags, missed: float) -> Array:
    """Squared errors as the ranks count them, shape (n,).

    A found spot counts with its error, at most `missed`; a missed one as `missed`; each false detection as `missed`
    besides. A missed spot with a false detection so counts twice, and guessing costs more than silence.

    Parameters
    ----------
    error : shape (n,), NaN where there is none
    found, expected, false : shape (n,), bool
        `expected` is whether there is something to find.
    missed : float
        In the unit of the error.
    """
    size = np.where(found & np.isfinite(error), np.minimum(np.abs(error), missed), missed)
    return np.where(expected, size**2, 0.0) + np.where(false, missed**2, 0.0)


@dataclass(frozen=True)
class PixelErrors:
    """Errors of n positions, pixels, shape (n,).

    Attributes
    ----------
    du_px, dv_px : answer - truth
    radial_px, tangential_px
        The same along and across the direction from the image of the sphere centre to the true position; radial
        errors, outwards above 0, make errors of phi and D, tangential ones (u towards v above 0) only turn the azimuth.
    """

    du_px: Array
    dv_px: Array
    radial_px: Array
    tangential_px: Array

    @property
    def distance_px(self) -> Array:
        """Distance of the answer from the truth."""
        return np.hypot(self.du_px, self.dv_px)


def pixel_errors(true_rig: Rig, true_px: Array, answer_px: Array) -> PixelErrors:
    """Errors of positions, shape (n, 2) both."""
    error = np.asarray(answer_px, float) - true_px
    outward = true_px - outline_circle(true_rig)[0]
    with np.errstate(invalid="ignore"):  # at the centre itself there is no direction
        a = outward / np.linalg.norm(outward, axis=-1, keepdims=True)
    radial = error[:, 0] * a[:, 0] + error[:, 1] * a[:, 1]
    # cross product with the outward direction: positive turns from u to v
    tangential = error[:, 1] * a[:, 0] - error[:, 0] * a[:, 1]
    return PixelErrors(error[:, 0], error[:, 1], radial, tangential)


_KEPT = 256  # results: of a part of a set with a rig each, until the next method


@dataclass(frozen=True)
class _ByValue:
    key: Hashable
    value: Any = field(compare=False)

    @classmethod
    def of(cls, value: Any) -> _ByValue:
        return cls((value.shape, value.dtype.str, value.tobytes()) if isinstance(value, np.ndarray) else value, value)


def with_kept_results(function: Callable[P, T]) -> Callable[P, T]:
    """The function with its last results kept: what follows from a truth alone is the same for all methods.

    Arguments go by position, arrays are compared by their bytes. Arrays in the results are read only.
    """

    @lru_cache(_KEPT)
    def of_values(*arguments: _ByValue) -> Any:
        result = function(*(argument.value for argument in arguments))  # type: ignore[call-arg]
        for array in (result, *getattr(result, "__dict__", {}).values()):
            if isinstance(array, np.ndarray):
                array.flags.writeable = False
        return result

    def once(*arguments: P.args, **named: P.kwargs) -> T:
        assert not named
        found: T = of_values(*map(_ByValue.of, arguments))
        return found

    return once


@with_kept_results
def from_centre_px(rig: Rig, uv_px: Array) -> Array:
    """Distance from the image of the sphere centre, shape (n,)."""
    return np.asarray(np.linalg.norm(uv_px - outline_circle(rig)[0], axis=-1))


def phi_of(convention: str, rig: Rig, uv_px: Array) -> Array:
    """Phi at pixels, shape (n,), radians."""
    return CONVENTIONS[convention](rig.at(0.0), uv_px)


@with_kept_results
def phi_variance(rig: Rig, uv_px: Array, covariance_px2: Array, convention: str = "ray") -> Array:
    """Variance of phi, shape (n,), rad^2: g C g^T; NaN for covariances, shape (n, 2, 2), that are NaN."""
    return estimate_phi(convention, rig.at(0.0), uv_px, covariance_px2).variance_rad2


def usable_covariance(covariance_px2: Array) -> Array:
    """Covariances, shape (n, 2, 2), NaN where one is not symmetric and positive definite."""
    C = np.asarray(covariance_px2, float)
    with np.errstate(invalid="ignore"):
        # both halves come through the same arithmetic
        symmetric = np.isclose(C[:, 0, 1], C[:, 1, 0], rtol=1e-9, atol=0.0)
        definite = (C[:, 0, 0] > 0.0) & (C[:, 0, 0] * C[:, 1, 1] - C[:, 0, 1] * C[:, 1, 0] > 0.0)
        finite = np.isfinite(C).all(axis=(1, 2))
    return np.where((symmetric & definite & finite)[:, None, None], C, np.nan)


def whitened_errors(error_px: Array, covariance_px2: Array) -> Array:
    """L^-1 e, shape (n, 2), with C = L L^T (Cholesky, lower): independent with variance 1 if C is right.

    Parameters
    ----------
    error_px : shape (n, 2)
    covariance_px2 : shape (n, 2, 2), positive definite or NaN
    """
    C = covariance_px2
    with np.errstate(invalid="ignore", divide="ignore"):
        # Cholesky factor of 2 x 2 covariances, solved by hand for all at once
        l11 = np.sqrt(C[:, 0, 0])
        l21 = C[:, 0, 1] / l11
        l22 = np.sqrt(C[:, 1, 1] - l21**2)
        first = error_px[:, 0] / l11
        return np.stack([first, (error_px[:, 1] - l21 * first) / l22], axis=-1)


def in_ray_units(rig: Rig, uv_px: Array, conventions: Sequence[str]) -> Array:
    """d phi_ray / d phi of each sense, shape (n,), at pixels (n, 2): a pixel off is then one error in all senses.

    Along the gradient of the other sense: (g_ray . g) / (g . g).
    """
    view, factor = rig.at(0.0), np.ones(len(uv_px))
    named = np.array(conventions)
    for sense in sorted(set(conventions) - {"ray"}):
        chosen = named == sense
        with np.errstate(all="ignore"):
            g, ray = (GRADIENTS[name](view, uv_px[chosen]) for name in (sense, "ray"))
            # along its own gradient a change of this phi is so much of a change of phi_ray
            factor[chosen] = np.sum(g * ray, axis=-1) / np.sum(g * g, axis=-1)
    return factor
