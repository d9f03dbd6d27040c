"""Columns of a score's records (meaning, type), and numbers of the tracks localise, find and depth computed from them.

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
from phibench.benchmark.scores.intervals import NORMAL_95
from phibench.scenes.frames import Array

COLUMNS: dict[str, str] = {
    "number": "pair, as in the pair set",
    "sample_id": "sample; intervals resample these",
    "draw": "draw of the noise",
    "image": "down or up",
    "preset": "preset of the sensor",
    "jpeg_quality": "libjpeg's quality; null unless MJPEG",
    "exposure_s": "exposure time of both images",
    "analogue_gain": "gain before the converter",
    "laser_level": "factor of the laser's light",
    "lamp_level": "factor of the room's light",
    "hinted": "whether the method got boxes",
    "depth_m": "D of the light",
    "axis_depth_m": "D of the beam's axis",
    "stroke_m": "h",
    "azimuth_rad": "azimuth of the mirror's normal",
    "electrons": "expected electrons of the spot",
    "snr": "signal to noise of the light, place and room known (docs/limits.md)",
    "saturated": "a pixel of the spot is expected above saturation",
    "visible": "whether the chief ray reaches the sensor",
    "unseen_because": "why not; none if visible",
    "u_true_px": "centre of the light",
    "v_true_px": "centre of the light",
    "u_axis_px": "image of the beam's axis",
    "v_axis_px": "image of the beam's axis",
    "from_centre_px": "true distance from the image of the sphere centre",
    "bayer": "2 x 2 cell's pixel that holds the true position",
    "status": "ok, or the method's or the harness's word why there is no position",
    "u_px": "answer",
    "v_px": "answer",
    "du_px": "answer - truth",
    "dv_px": "answer - truth",
    "distance_px": "hypot(du, dv)",
    "radial_px": "error outwards from the image of the sphere centre",
    "tangential_px": "error across it, u towards v",
    "detected": "visible, and a position within match_px",
    "missed": "visible and not detected",
    "false_detection": "a position where the spot is not visible, or further than match_px from it",
    "counted_px": "distance_px if detected, match_px if missed",
    "phi_convention": "ray, normal, incidence or outline",
    "phi_from": "method or pixels",
    "phi_rad": "the method's, else estimator.geometry.phi of its pixel through the nominal rig",
    "phi_true_rad": "truth in that convention; outline: estimator.geometry.phi of the true pixel through the true rig",
    "phi_error_rad": "phi_rad - phi_true_rad, in units of phi_ray: times d phi_ray / d phi along the gradient",
    "claimed_uu_px2": "claimed variance of u",
    "claimed_uv_px2": "claimed covariance of u and v",
    "claimed_vv_px2": "claimed variance of v",
    "pull_u": "first component of L^-1 e, C = L L^T the claimed covariance",
    "pull_v": "second component",
    "mahalanobis2": "e^T C^-1 e",
    "bound_px2": "trace of the bound (docs/limits.md): expected squared distance at it",
    "bound_uu_px2": "the bound itself: variance of u",
    "bound_uv_px2": "covariance of u and v",
    "bound_vv_px2": "variance of v",
    "raw_bound_px2": "as bound_px2, of the raw pixels behind the image",
    "raw_bound_uu_px2": "that bound itself: variance of u",
    "raw_bound_uv_px2": "covariance of u and v",
    "raw_bound_vv_px2": "variance of v",
    "bound_phi_rad2": "variance of phi at the bound",
    "pair_bound_px2": "as bound_px2, of both images together: one point of the room",
    "pair_bound_uu_px2": "that bound itself: variance of u",
    "pair_bound_uv_px2": "covariance of u and v",
    "pair_bound_vv_px2": "variance of v",
    "pair_bound_phi_rad2": "variance of phi at that bound",
    "rank_phi2_rad2": "square that the rank by phi sums: error (of outline: of phi_ray), missed and false",
    "pair_visible": "both spots are visible",
    "pair_false": "a false detection in either image, or a D of the method's own where a spot is not visible",
    "pair_electrons": "the fainter spot's electrons",
    "depth_found": "both spots are found, and a finite depth above 0 follows",
    "depth_from": "method or pixels",
    "depth_estimate_m": "D of the answer",
    "depth_error_m": "depth_estimate_m - depth_m",
    "depth_relative": "depth_error_m / depth_m",
    "depth_sigma_m": "claimed: the method's with its own depth, else from its covariances; with a calibration's part",
    "claimed_sigma_m": "the method's sigma of its own D, without a calibration's part",
    "claimed_low_m": "lower end of the method's 95 % interval of its own D",
    "claimed_high_m": "upper end",
    "depth_pull": "depth_error_m / depth_sigma_m; of real pairs the tape's standard deviation is added",
    "depth_within": "D in the claimed 95 % interval: the method's own, widened as its sigma is, else |pull| <= 1.96",
    "bound_depth_m2": "variance of D at the bounds of both spots, each by itself; without calibration",
    "pair_bound_depth_m2": "the same of both images together",
    "possible_position_chi2": "errors of the pair's positions over what is possible, squared; 3 degrees of freedom",
    "possible_depth_m2": "smallest possible variance of D",
    "possible_spot_px2": "trace of the smallest possible covariance of this position, at most 0.5 px^2 along any axis",
    "possible_spot_chi2": "squared error of this position over that covariance; 2 degrees of freedom",
    "possible_spot_phi_rad2": "smallest possible variance of this phi",
    "searched_px2": "area in which a search has to look for the spot: its box, or a quarter of the mirror's disc",
    "seconds": "inside the method",
    "failure": "of the harness; empty if none",
    "message": "about the failure",
}
COUNTED: dict[str, str] = {
    "depth_counted": "|depth_relative|, at most what a miss costs; that too if not found; null unless pair_visible",
    "rank_depth2": "square that the rank by D sums: relative error, missed and false detection",
}
"""Columns that follow from all pairs together: `records.with_missed`."""
OF_FRAMES = ("exposure_s", "analogue_gain", "laser_level", "lamp_level")
_WHOLE = ("number", "draw", "jpeg_quality")
_TEXTS = (
    *("sample_id", "image", "preset", "unseen_because", "bayer"),
    *("status", "phi_convention", "phi_from", "depth_from", "failure", "message"),
)
_TRUTH_VALUES = (
    *("hinted", "saturated", "visible", "detected", "missed"),
    *("false_detection", "pair_visible", "pair_false", "depth_found", "depth_within"),
)
TYPES = {
    **dict.fromkeys(_WHOLE, pl.Int64()),
    **dict.fromkeys(_TEXTS, pl.String()),
    **dict.fromkeys(_TRUTH_VALUES, pl.Boolean()),
    **dict.fromkeys(OF_FRAMES, pl.Float64()),
}
COLUMN_TYPES: dict[str, pl.DataType] = {name: TYPES.get(name, pl.Float64()) for name in (*COLUMNS, *COUNTED)}
"""Type of every column."""


# -- tracks ------------------------------------------------------------------------------------------------------------

LOCALISED = pl.col("visible") & pl.col("bound_px2").is_not_null() & (pl.col("bound_px2") < 1.0)
"""Spots of `localise`: rms distance at the bound below 1 px."""
LEAST_RATIO = 0.1
THRESHOLDS = (0.005, 0.01, 0.02, 0.05, 0.10, 0.20)
"""Relative errors of D that count as right, of the average recall."""
LONGEST_INTERVAL = 20.0
_ALPHA = 0.05
_AT_ONCE = 32  # spots whose 4096 nodes are taken together: 1 MB, which stays in a processor's cache


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
    bounds, means = bound_px2[known, None, None], np.empty(len(along))
    for start in range(0, len(along), _AT_ONCE):
        part = slice(start, start + _AT_ONCE)
        square = along[part, :, None] * rho2
        np.minimum(square, MATCH_PX**2, out=square)
        square /= bounds[part]
        np.maximum(square, LEAST_RATIO**2, out=square)
        np.log(square, out=square)
        square *= 0.5
        means[part] = square.mean(axis=(1, 2))
    result[known] = means
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
        low = np.where(np.isfinite(own_low), depth - np.hypot(depth - own_low, added), depth - NORMAL_95 * sigma)
        high = np.where(np.isfinite(own_high), depth + np.hypot(own_high - depth, added), depth + NORMAL_95 * sigma)
        outside = np.maximum(low - true, 0.0) + np.maximum(true - high, 0.0)
        score = (high - low + 2.0 / _ALPHA * outside) / (2.0 * NORMAL_95 * bound)
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
