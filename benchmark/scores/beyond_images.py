"""Tests whether a score's answers are better than the images allow: by errors, exact answers, and faint spots found.

V is the least covariance of a position that any method on the images can have (`least_px2`). Errors of such a method
scatter by V or more, so that e^T V^-1 e is stochastically larger than chi^2. Four kinds of tests follow.

errors
    The sum of e^T V^-1 e over pairs or images is so small that chi^2 seldom is. Positions of a pair have 3 degrees of
    freedom, positions of one image 2, phi and D one. Images are tested one by one, for the truth may be in one of them:
    the down images, then the up images. Within each, thirds by the size of V are tested, too.
exact answers
    e^T V^-1 e is below q in more pairs than chance has it. q is chosen so that errors of the least covariance are below
    it in a share `EXACT` of the pairs, or less. A few exact answers among honest ones show here, not in sums.
finding
    More faint spots are found than any search can find: `most_found`.

Every image and pair enters once in a test, so that the summands are independent. A chance is that of one test over its
share of all tests' false alarms (Bonferroni with weights): a quarter for finding, of which a score has few cases, the
rest for the 24 others. Below `FALSE_ALARM` there is a flag: no larger share of methods at the limit are flagged, and a
smaller one of methods that are worse.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import polars as pl
import scipy
from scipy.special import log_ndtr

from phibench.scenes.frames import Array

RAW_MARGIN = 1.15
"""Largest rms at the raw pixels' bound over the smallest possible one. The bound takes the room behind the spot as
unknown and the fixed pattern as noise. A laser-off frame tells both in part. Known in full, the pattern is worth 13 %
of the rms at most on the Bayer spots of the recipe random (docs/measurements/scores.md), and 12 % on rendered mono
ones."""
MODEL_MARGIN = 1.3
"""The same of processed images, whose bound is that of a model: 10 to 30 % too large in a dark room (docs/limits)."""
FALSE_ALARM = 1e-3
"""Chance that a method at the smallest possible variances is flagged for any of `QUANTITIES`."""
EXACT = 1e-3
"""Share of pairs that errors of the least covariance make exact."""
QUANTITIES = ("positions", "phi", "D", "exact answers", "faint spots")
TESTS = 24
"""1 of positions of pairs, 4 of D; 4 of positions and 4 of phi, of each image; 3 of exact answers."""
TIMES, TIMES_FINDING = TESTS / 0.75, 1 / 0.25
"""By which the chance of one of these tests, and of that of finding, is multiplied: shares of 3/4 and 1/4."""
SNR_MARGIN = 1.15
"""Most by which the detectability d' of draws exceeds the stated signal to noise, in the median of a preset: 0.99 on
bayer-raw, 1.14 on srgb8, 1.10 on mjpeg (docs/measurements/scores.md)."""
_CLIPPED_PX2 = 0.5
"""Largest variance of V along any axis. Answers beyond 3 px count as missed, so that found ones have no larger errors:
those of N(0, V) cut off at 3 px are larger than those of N(0, 0.5 px^2) but for a share exp(-9) of 1e-4."""
_CELL_PX2 = 36.0
"""Places whose answers within 3 px have nothing in common are 6 px apart."""
_OF_THE_DISC = 0.25
"""Part of the mirror's disc that a search is told to look at: spots are not spread evenly over it."""
_SURE = 0.99  # a pair that everybody finds tells nothing of who knows more


@dataclass(frozen=True)
class Excess:
    """A quantity that is better than the images allow.

    Attributes
    ----------
    quantity : one of `QUANTITIES`
    part : str
        Images or pairs that show it best; "all pairs" for all.
    ratio : float
        Above 1. Of errors the smallest possible rms over that of the answers. Of the last two quantities, how often
        there are such answers over how often the images allow them.
    pairs : int
        Pairs, or images of one position.
    chance : float
        Of such answers for a method at the limit, for all tests together.
    """

    quantity: str
    part: str
    ratio: float
    pairs: int
    chance: float


def least_px2(bound_px2: Array, raw_px2: Array) -> Array:
    """Smallest covariances of single images, shape (n, 2, 2): the larger of both bounds, each less its margin."""
    raw, model = raw_px2 / RAW_MARGIN**2, bound_px2 / MODEL_MARGIN**2
    with np.errstate(invalid="ignore"):
        larger = np.linalg.det(model) > np.linalg.det(raw)  # False for NaN
    return np.where(larger[:, None, None], model, raw)


def clipped_covariances(covariance_px2: Array) -> Array:
    """Covariances, shape (n, 2, 2), with no variance above 0.5 px^2 along any axis; NaN stays."""
    good = np.asarray(np.isfinite(covariance_px2).all(axis=(1, 2)))
    values, axes = np.linalg.eigh(np.where(good[:, None, None], covariance_px2, np.eye(2)))
    # same axes, smaller variances: V = sum of value x axis axis^T
    cut = (axes * np.minimum(values, _CLIPPED_PX2)[:, None, :]) @ np.swapaxes(axes, 1, 2)
    return np.where(good[:, None, None], cut, np.nan)


def squares(error_px: Array, covariance_px2: Array) -> Array:
    """e^T V^-1 e, shape (n,); NaN where there is none."""
    good = np.asarray(np.isfinite(covariance_px2).all(axis=(1, 2)))
    V = np.where(good[:, None, None], covariance_px2, np.eye(2))
    solved = np.linalg.solve(V, error_px[..., None])[..., 0]
    return np.where(good, np.sum(error_px * solved, axis=-1), np.nan)


# -- finding -----------------------------------------------------------------------------------------------------------


def searched_px2(radius_px: float, box_px2: float | None) -> float:
    """Area in which a spot is sought: its box, or a part of the mirror's disc."""
    return _OF_THE_DISC * np.pi * radius_px**2 if box_px2 is None else box_px2


def most_found(snr: Array, area_px2: Array) -> Array:
    """Largest chance of finding a spot, shape (n,): that of the best choice among M places of which one holds it.

    Whoever tells a searcher M places, the true one among them, 6 px apart, makes the search no harder. The best choice
    is then the largest of M independent normal numbers, of which one has the mean s and all others 0. It is right with
    the chance of E[Phi(z + s)^(M - 1)], z standard normal (J. M. Wozencraft, I. M. Jacobs, Principles of Communication
    Engineering, 1965, ch. 4). A spot in both images has s^2 = s1^2 + s2^2: the places are then places of pairs.

    Parameters
    ----------
    snr : shape (n,), s, place and room known
    area_px2 : shape (n,)
        In which the spot is as likely in one place as in another; M of them are in it.
    """
    places = np.maximum(np.floor(area_px2 / _CELL_PX2), 1.0)
    logs = (places - 1.0)[:, None] * log_ndtr(_Z + np.asarray(snr, float)[:, None])
    return np.asarray(np.clip(np.exp(logs) @ _WEIGHT, 0.0, 1.0))


_Z = np.linspace(-9.0, 9.0, 601)
_WEIGHT = np.exp(-0.5 * _Z**2) / np.exp(-0.5 * _Z**2).sum()
"""Nodes and weights of the standard normal law: the trapezoidal rule is exact to 1e-12 for what is as smooth."""


def at_least(found: int, chances: Array) -> float:
    """Chance that at least so many of independent events happen."""
    law = np.ones(1)
    for p in chances:
        # law of a sum of independent events of unlike chances, one event at a time
        law = np.convolve(law, [1.0 - p, p])
    return float(min(1.0, law[found:].sum()))


# -- tests -------------------------------------------------------------------------------------------------------------


def excesses(records: pl.DataFrame) -> list[Excess]:
    """Quantities that are better than any method on the images can have them, each with its clearest part.

    Parameters
    ----------
    records : `metrics.prepared_records`
    """
    suspicious = [one for one in _tried(records) if one.pairs and one.ratio > 1.0 and one.chance < FALSE_ALARM]
    named = ([one for one in suspicious if one.quantity == quantity] for quantity in QUANTITIES)
    return [min(some, key=lambda one: one.chance) for some in named if some]


def _tried(records: pl.DataFrame) -> Iterator[Excess]:
    down = records.filter(pl.col("image") == "down")
    pairs = down.filter("sharp_pair").drop_nulls("possible_position_chi2")
    deep = down.filter("sharp_depth").drop_nulls("possible_depth_m2")
    depth = (deep["depth_error_m"] ** 2 / deep["possible_depth_m2"]).to_numpy()
    yield _of_errors("positions", "all pairs", pairs["possible_position_chi2"].to_numpy(), 3)
    yield from _by_thirds("D", "pairs", depth, deep["possible_depth_m2"].to_numpy(), 1)
    images = {name: _found_images(records, name) for name in ("down", "up")}
    for name, rows in images.items():
        size = rows["possible_spot_px2"].to_numpy()
        yield from _by_thirds("positions", f"{name} images", rows["possible_spot_chi2"].to_numpy(), size, 2)
        yield from _by_thirds("phi", f"{name} images", rows["spot_phi_chi2"].to_numpy(), size, 1)
    both = pl.concat(images.values())
    yield _of_exact("positions", both, "possible_spot_chi2", float(scipy.stats.chi2.ppf(EXACT / 2.0, 2)))
    yield _of_exact("phi", both, "spot_phi_chi2", float(scipy.stats.chi2.ppf(EXACT / 2.0, 1)))
    deep = deep.with_columns(of_depth=pl.Series(depth))
    yield _of_exact("D", deep, "of_depth", float(scipy.stats.chi2.ppf(EXACT, 1)))
    yield _of_finding(records)


def _found_images(records: pl.DataFrame, name: str) -> pl.DataFrame:
    """Images of one position with a found spot and a bound."""
    ratio = pl.col("phi_error_rad") ** 2 / pl.col("possible_spot_phi_rad2")
    chosen = records.filter((pl.col("image") == name) & pl.col("detected")).with_columns(spot_phi_chi2=ratio)
    return chosen.drop_nulls(["possible_spot_chi2", "spot_phi_chi2"])


def _of_errors(quantity: str, part: str, values: Array, freedom: int) -> Excess:
    n, total = len(values), float(values.sum())
    # too small a sum of squares is the suspicious side
    chance = min(1.0, TIMES * float(scipy.stats.chi2.cdf(total, freedom * n))) if n else 1.0
    return Excess(quantity, part, float(np.sqrt(freedom * n / total)) if total > 0.0 else np.inf, n, chance)


def _by_thirds(quantity: str, part: str, values: Array, sizes: Array, freedom: int) -> Iterator[Excess]:
    """The whole, then its thirds by the size of the bound."""
    yield _of_errors(quantity, f"all {part}", values, freedom)
    order = np.argsort(sizes, kind="stable")
    for name, rows in zip(("smallest", "middle", "largest"), np.array_split(order, 3), strict=True):
        yield _of_errors(quantity, f"{part}, third with the {name} bounds", values[rows], freedom)


def _of_exact(quantity: str, table: pl.DataFrame, column: str, least: float) -> Excess:
    """Pairs of which an answer is exact; each image is allowed its part of `EXACT`."""
    pairs = table.group_by("number").agg(pl.col(column).min() < least)
    n, hits = len(pairs), int(pairs[column].sum())
    chance = min(1.0, TIMES * float(scipy.stats.binom.sf(hits - 1, n, EXACT))) if n else 1.0
    return Excess("exact answers", f"{quantity}, all pairs", hits / (n * EXACT) if n else 0.0, n, chance)


def _of_finding(records: pl.DataFrame) -> Excess:
    """Pairs of which a spot is found, among those that a search may miss."""
    seen = (
        records.filter("visible")
        .drop_nulls("snr")  # of pictures that were not rendered it is not known
        .group_by("number", maintain_order=True)
        .agg(found=pl.col("detected").any(), snr=(pl.col("snr") ** 2).sum().sqrt(), area=pl.col("searched_px2").first())
    )
    chances = most_found(SNR_MARGIN * seen["snr"].to_numpy(), seen["area"].fill_null(0.0).to_numpy())
    faint = chances < _SURE
    hits, chances = int(seen["found"].to_numpy()[faint].sum()), chances[faint]
    chance = min(1.0, TIMES_FINDING * at_least(hits, chances)) if hits else 1.0
    expected = float(chances.sum())
    return Excess("faint spots", "all pairs", hits / expected if expected else 0.0, len(chances), chance)
