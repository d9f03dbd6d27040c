"""Columns of the records that the numbers of the three tracks are made of.

`localise`: every visible spot whose bound is below 1 px, in a box of 64 px with the spot anywhere in its middle half.
What ranks is the geometric mean over spots of error over bound: a ratio counts as 0.1 at least, an error as 3 px at
most, no answer as 3 px. A method whose errors are Gaussian with the image's bound as covariance has 0.75 where the
bound is round, exp(-gamma / 2), and less where it is long; `perfect_log` integrates over the bound of each spot.

`find`: whole frames, spots visible in both images, one or none. What ranks is the Jaccard index of positions within
3 px, J = found / (visible + false). F1 is 2 J / (1 + J). A further answer that is right with chance p adds to J on
average where p > J / (1 + J): a guess pays only from there on.

`depth`: pairs as whole frames. What ranks is the average recall: the share of visible pairs whose D is within 0.5, 1,
2, 5, 10 and 20 %, averaged over these thresholds; both spots must be found, so that a constant D counts nothing. For
claims there is the mean 95 % interval score over 3.92 sigma of the pair's bound, each cut at 20,

    (u - l) + (2 / 0.05) (max(l - D, 0) + max(D - u, 0)),

of found pairs (T. Gneiting, A. Raftery, J. Am. Stat. Assoc. 102, 359, 2007): 1.19 for a right claim at the bound. Its
geometric mean would be improper: halving sigma wins.
"""

from __future__ import annotations

import numpy as np
import polars as pl

from phibench.benchmark.scores.answer_errors import MATCH_PX
from phibench.scenes.frames import Array

LOCALISED = pl.col("visible") & pl.col("bound_px2").is_not_null() & (pl.col("bound_px2") < 1.0)
"""Spots of `localise`: rms distance at the bound below 1 px."""
LEAST_RATIO = 0.1
THRESHOLDS = (0.005, 0.01, 0.02, 0.05, 0.10, 0.20)
"""Relative errors of D that count as right, of the average recall."""
LONGEST_INTERVAL = 20.0
_ALPHA, _SIGMAS = 0.05, 1.959963984540054


def track_columns(records: pl.DataFrame) -> pl.DataFrame:
    """Records with what the tracks' metrics take: ratios and their logarithms, recall of D, interval scores."""
    bound, distance = (records[name].to_numpy().astype(float) for name in ("bound_px2", "distance_px"))
    error = np.where(np.isfinite(distance), np.minimum(distance, MATCH_PX), MATCH_PX)
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.maximum(error / np.sqrt(bound), LEAST_RATIO)
        log = np.log(ratio)
    return records.with_columns(
        localise_ratio=_series(ratio),
        localise_log=_series(log),
        perfect_image_log=_series(perfect_log(_matrices(records, "bound"), bound)),
        perfect_pair_log=_series(perfect_log(_matrices(records, "pair_bound"), bound)),
        visible_or_false=pl.col("visible").cast(pl.Int64) + pl.col("false_detection").cast(pl.Int64),
        depth_recall=_series(_recall(records)),
        interval_score=_series(interval_scores(records)),
    )


def perfect_log(covariance_px2: Array, bound_px2: Array, radii: int = 256, angles: int = 16) -> Array:
    """Expected logarithm of the ratio of `localise` for Gaussian errors, shape (n,); NaN where there is no bound.

    Parameters
    ----------
    covariance_px2 : shape (n, 2, 2)
        Of the errors.
    bound_px2 : shape (n,)
        Trace of the image's bound, by which ratios are taken.
    radii, angles : int
        Nodes: quantiles of the Rayleigh distribution, and of the angle in a quarter turn.
    """
    known = np.isfinite(covariance_px2).all(axis=(1, 2)) & np.isfinite(bound_px2)
    result = np.full(len(bound_px2), np.nan)
    if not known.any():
        return result
    variances = np.maximum(np.linalg.eigvalsh(covariance_px2[known]), 0.0)
    rho2 = -2.0 * np.log1p(-(np.arange(radii) + 0.5) / radii)
    theta = (np.arange(angles) + 0.5) * (0.5 * np.pi / angles)
    along = variances[:, :1] * np.cos(theta) ** 2 + variances[:, 1:] * np.sin(theta) ** 2
    square = np.minimum(along[..., None] * rho2, MATCH_PX**2) / bound_px2[known, None, None]
    result[known] = 0.5 * np.log(np.maximum(square, LEAST_RATIO**2)).mean(axis=(1, 2))
    return result


def interval_scores(records: pl.DataFrame) -> Array:
    """Interval score of the claimed 95 % interval over 3.92 sigma of the pair's bound, at most 20; NaN without any.

    The interval is the method's own, widened by what a calibration adds to its sigma, or D -+ 1.96 sigma.
    """
    names = ("depth_m", "depth_estimate_m", "depth_sigma_m", "claimed_sigma_m", "claimed_low_m", "claimed_high_m")
    true, depth, sigma, own_sigma, own_low, own_high = (records[name].to_numpy().astype(float) for name in names)
    bound = np.sqrt(records["pair_bound_depth_m2"].to_numpy().astype(float))
    with np.errstate(invalid="ignore", divide="ignore"):
        added = np.sqrt(np.maximum(np.nan_to_num(sigma**2 - own_sigma**2), 0.0))
        low = np.where(np.isfinite(own_low), depth - np.hypot(depth - own_low, added), depth - _SIGMAS * sigma)
        high = np.where(np.isfinite(own_high), depth + np.hypot(own_high - depth, added), depth + _SIGMAS * sigma)
        outside = np.maximum(low - true, 0.0) + np.maximum(true - high, 0.0)
        score = (high - low + 2.0 / _ALPHA * outside) / (2.0 * _SIGMAS * bound)
    return np.minimum(score, LONGEST_INTERVAL)


def _recall(records: pl.DataFrame) -> Array:
    relative = np.abs(records["depth_relative"].to_numpy().astype(float))
    found = records["depth_found"].to_numpy()
    within = [found & (relative <= threshold) for threshold in THRESHOLDS]  # False for NaN
    return np.mean(within, axis=0)


def _matrices(records: pl.DataFrame, stem: str) -> Array:
    uu, uv, vv = (records[f"{stem}_{axes}_px2"].to_numpy().astype(float) for axes in ("uu", "uv", "vv"))
    return np.stack([uu, uv, uv, vv], axis=-1).reshape(-1, 2, 2)


def _series(values: Array) -> pl.Series:
    return pl.Series(values).fill_nan(None)
