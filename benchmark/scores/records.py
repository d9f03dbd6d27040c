"""Table that every score is computed from, one row per image: answer, truth, errors, bound; missed pairs counted.

A pair has two rows, "down" and "up"; columns of the pair are in both. Null where there is nothing: no answer, no
truth (a spot without an image), no claimed covariance, no bound, or a ray that does not reach. Never NaN.
`record_columns.COLUMNS` says what each column is.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
import polars as pl

from phibench.benchmark.scores.answer_errors import (
    Rules,
    best_constant,
    from_centre_px,
    in_ray_units,
    phi_of,
    phi_variance,
    pixel_errors,
    rank_squares,
    usable_covariance,
    whitened_errors,
    with_kept_results,
)
from phibench.benchmark.scores.beyond_images import searched_px2
from phibench.benchmark.scores.intervals import NORMAL_95
from phibench.benchmark.scores.pair_bounds import SpotBoundsOfImages, pair_bounds
from phibench.benchmark.scores.record_columns import COLUMNS, OF_FRAMES, TYPES
from phibench.datasets.common.errors import DatasetError
from phibench.estimator.geometry.least_squares_depth import nominal_depth
from phibench.estimator.geometry.phi import outline_circle
from phibench.estimator.geometry.triangulate import depth_exact
from phibench.estimator.interface import OK, Answer, Outcome, Spot
from phibench.estimator.pair_set import ImageTruth, PairTruth
from phibench.scenes.frames import Array
from phibench.scenes.rig import POSITIONS, Rig

_NO_MATRIX = np.full((2, 2), np.nan)
_BAYER = {(0, 0): "red", (1, 0): "green in red row", (0, 1): "green in blue row", (1, 1): "blue"}


def missed_relative(table: pl.DataFrame, rules: Rules) -> float:
    """Relative error of D as which a missed pair counts: that of the best constant answer, within the rules' limits."""
    depths = table.filter((pl.col("image") == "down") & pl.col("pair_visible"))["depth_m"].to_numpy()
    return min(rules.missed_relative, max(rules.least_missed_relative, best_constant(depths)))


def with_missed(table: pl.DataFrame, missed: float) -> pl.DataFrame:
    """Records with `COUNTED`, a missed pair counting as `missed`."""
    relative = table["depth_relative"].fill_null(np.nan).to_numpy()
    found, visible = (table[name].to_numpy() for name in ("depth_found", "pair_visible"))
    counted = np.where(found, np.minimum(np.abs(relative), missed), missed)
    squares = rank_squares(relative, found, visible, table["pair_false"].to_numpy(), missed)
    return table.with_columns(
        depth_counted=pl.Series(np.where(visible, counted, np.nan)).fill_nan(None), rank_depth2=pl.Series(squares)
    )


def record_table(truths: Sequence[PairTruth], outcomes: Sequence[Outcome], rules: Rules) -> pl.DataFrame:
    """Records of a run: `COLUMNS` of truths and outcomes side by side, two rows per pair, by number."""
    if not truths:
        raise DatasetError("a score of no pairs: give at least one")
    index: dict[tuple[Rig, Rig, int], list[int]] = {}
    for i, truth in enumerate(truths):
        # a calibration goes with its rig; its array is one object for all pairs, or rows that are equal stay apart
        index.setdefault((truth.nominal_rig, truth.true_rig, id(truth.calibration_covariance)), []).append(i)
    parts = [
        of_rig
        for (nominal, true, _), rows in index.items()
        for of_rig in _of_rigs(nominal, true, [truths[i] for i in rows], [outcomes[i] for i in rows], rules)
    ]
    columns = {name: _joined([of_rig[name] for of_rig in parts]) for name in parts[0]}
    table = pl.DataFrame(columns, schema_overrides=TYPES).sort("number", pl.col("image") == "up")
    return table.with_columns(pl.col(pl.Float64).fill_nan(None)).select(*COLUMNS)


def in_order(outcomes: Iterable[Outcome], count: int) -> list[Outcome]:
    """Outcomes by number.

    Raises
    ------
    DatasetError
        If a pair has several, or a number is not 0 to count - 1.
    """
    ordered = sorted(outcomes, key=lambda outcome: outcome.number)
    numbers = [outcome.number for outcome in ordered]
    if len(set(numbers)) != len(numbers):
        twice = next(number for number in numbers if numbers.count(number) > 1)
        raise DatasetError(f"pair {twice} has several outcomes: a score takes one of each pair")
    if numbers and not (numbers[0] >= 0 and numbers[-1] < count):
        raise DatasetError(f"outcomes of pairs {numbers[0]} to {numbers[-1]}, but the set has {count} pairs from 0 up")
    return ordered


def _joined(parts: list[Any]) -> Any:
    """Parts of a column, all arrays or all lists, one after the other."""
    return np.concatenate(parts) if isinstance(parts[0], np.ndarray) else [value for part in parts for value in part]


def _of_rigs(
    nominal: Rig, true: Rig, truths: list[PairTruth], outcomes: list[Outcome], rules: Rules
) -> list[dict[str, Any]]:
    """Columns of pairs that share their rigs, of each image: its own, then the pairs'."""
    images = {p: _image_columns(p, nominal, true, truths, outcomes, rules) for p in POSITIONS}
    pair = _pair_columns(nominal, truths, outcomes, images)
    pair |= _joint_columns(nominal, truths, images, pair)
    return [{**images[p], **pair} for p in POSITIONS]


def _image_columns(
    position: str, nominal: Rig, true: Rig, truths: list[PairTruth], outcomes: list[Outcome], rules: Rules
) -> dict[str, Any]:
    spots: list[ImageTruth] = [getattr(truth, position) for truth in truths]
    answers = [_spot(outcome, position) for outcome in outcomes]
    xy, uv = _stack(spot.uv_px for spot in spots), _stack(map(_position, answers))
    error, phi = pixel_errors(true, xy, uv), _phi_columns(nominal, true, xy, uv, spots, answers)
    given, visible = np.isfinite(uv).all(axis=1), np.array([spot.visible for spot in spots])
    # of a real pair nobody knows the spot's place: any position counts as found, and D tells what it is worth
    known = ~visible | np.isfinite(xy).all(axis=1)
    near = error.distance_px <= rules.match_px  # False for NaN
    detected = visible & np.where(known, near, given)
    false = given & ~detected
    claimed = usable_covariance(_claimed(answers))
    pull = whitened_errors(np.stack([error.du_px, error.dv_px], -1), claimed)
    bound, raw = (_bounds(spots, name) for name in ("bound_px2", "raw_bound_px2"))
    return {
        "image": [position] * len(spots),
        "azimuth_rad": [spot.azimuth_rad for spot in spots],
        "electrons": [float(spot.electrons) for spot in spots],
        "snr": [float(spot.snr) for spot in spots],
        "saturated": [bool(spot.saturated) for spot in spots],
        "visible": visible,
        "unseen_because": [spot.cause for spot in spots],
        "u_true_px": xy[:, 0],
        "v_true_px": xy[:, 1],
        **dict(zip(("u_axis_px", "v_axis_px"), _stack(spot.axis_px for spot in spots).T, strict=True)),
        "from_centre_px": from_centre_px(true, xy),
        "bayer": [_bayer(x) for x in xy],
        "status": [_status(*both) for both in zip(answers, outcomes, strict=True)],
        "u_px": uv[:, 0],
        "v_px": uv[:, 1],
        "du_px": error.du_px,
        "dv_px": error.dv_px,
        "distance_px": error.distance_px,
        "radial_px": error.radial_px,
        "tangential_px": error.tangential_px,
        "detected": detected,
        "missed": visible & ~detected,
        "false_detection": false,
        "counted_px": np.where(visible & known, np.where(detected, error.distance_px, rules.match_px), np.nan),
        **phi,
        **_parts("claimed", claimed),
        "pull_u": pull[:, 0],
        "pull_v": pull[:, 1],
        "mahalanobis2": np.sum(pull**2, axis=-1),
        "bound_px2": np.trace(bound, axis1=1, axis2=2),
        **_parts("bound", bound),
        "raw_bound_px2": np.trace(raw, axis1=1, axis2=2),
        **_parts("raw_bound", raw),
        "bound_phi_rad2": phi_variance(nominal, xy, bound),
        "rank_phi2_rad2": np.where(
            known,
            rank_squares(_ranked_phi_error(nominal, spots, uv, phi), detected, visible, false, rules.missed_phi_rad),
            np.nan,
        ),
    }


def _parts(name: str, matrices: Array) -> dict[str, Array]:
    """Columns of symmetric matrices of (u, v), shape (n, 2, 2)."""
    places = {"uu": (0, 0), "uv": (0, 1), "vv": (1, 1)}
    return {f"{name}_{part}_px2": matrices[:, i, j] for part, (i, j) in places.items()}


def _ranked_phi_error(nominal: Rig, spots: list[ImageTruth], uv: Array, phi: dict[str, Any]) -> Array:
    """Error of phi that ranks; of "outline" that of phi_ray at the answered pixel.

    "outline" is a formula in the image, true of any rig: no error of the nominal rig would count.
    """
    truth = np.array([s.phi_rad.get("ray", np.nan) for s in spots])
    formula = np.array([convention == "outline" for convention in phi["phi_convention"]])
    return np.where(formula, phi_of("ray", nominal, uv) - truth, phi["phi_error_rad"])


def _phi_columns(
    nominal: Rig, true: Rig, xy: Array, uv: Array, spots: list[ImageTruth], answers: list[Spot | None]
) -> dict[str, Any]:
    own = np.array([_own_phi(answer) for answer in answers])
    convention = [
        a.phi_convention if a is not None and np.isfinite(x) else "ray" for a, x in zip(answers, own, strict=True)
    ]
    phi = np.where(np.isfinite(own), own, phi_of("ray", nominal, uv))
    outline = _true_phi("outline", true, xy)
    truth = np.array([s.phi_rad.get(c, o) for s, c, o in zip(spots, convention, outline, strict=True)])
    return {
        "phi_convention": [c if np.isfinite(x) else None for c, x in zip(convention, phi, strict=True)],
        "phi_from": [_from(*x) for x in zip(np.isfinite(own), np.isfinite(phi), strict=True)],
        "phi_rad": phi,
        "phi_true_rad": truth,
        "phi_error_rad": (phi - truth) * in_ray_units(true, xy, convention),
    }


def _joint_columns(
    nominal: Rig, truths: list[PairTruth], images: dict[str, dict[str, Any]], pair: dict[str, Any]
) -> dict[str, Any]:
    """Columns of the bounds of both images together; those of single images are added to `images`."""
    spots = {p: [getattr(t, p) for t in truths] for p in POSITIONS}
    singles = [SpotBoundsOfImages(*(_bounds(spots[p], name) for name in _BOUND_NAMES)) for p in POSITIONS]
    (xy1, e1), (xy2, e2) = (
        [np.stack([images[p][u], images[p][v]], -1) for u, v in (_TRUE_PX, _ERROR_PX)] for p in POSITIONS
    )
    joint = pair_bounds(
        nominal, _nominal_stroke_m(truths), pair["depth_m"], (xy1, xy2), (singles[0], singles[1]), (e1, e2)
    )
    for position, uv, C in zip(POSITIONS, (xy1, xy2), (joint.down_px2, joint.up_px2), strict=True):
        images[position]["pair_bound_px2"] = np.trace(C, axis1=1, axis2=2)
        images[position] |= _parts("pair_bound", C)
        images[position]["pair_bound_phi_rad2"] = phi_variance(nominal, uv, C)
    for place, position in enumerate(POSITIONS):
        for name in ("possible_spot_px2", "possible_spot_chi2", "possible_spot_phi_rad2"):
            images[position][name] = getattr(joint, name)[place]
    return {
        "pair_bound_depth_m2": joint.depth_m2,
        "possible_position_chi2": joint.possible_position_chi2,
        "possible_depth_m2": joint.possible_depth_m2,
    }


_BOUND_NAMES = ("bound_px2", "raw_bound_px2")
_TRUE_PX, _ERROR_PX = ("u_true_px", "v_true_px"), ("du_px", "dv_px")


def _searched_px2(nominal: Rig, truths: list[PairTruth]) -> Array:
    radius = float(outline_circle(nominal)[1])
    boxes = (t.box_px2 if t.hinted else None for t in truths)
    return np.array([searched_px2(radius, box) for box in boxes])


def _nominal_stroke_m(truths: list[PairTruth]) -> Array:
    return np.array([t.stroke_m if t.nominal_stroke_m is None else t.nominal_stroke_m for t in truths], float)


def _pair_columns(
    nominal: Rig, truths: list[PairTruth], outcomes: list[Outcome], images: dict[str, dict[str, Any]]
) -> dict[str, Any]:
    down, up = (images[p] for p in POSITIONS)
    bounds = [_bounds([getattr(t, p) for t in truths], "bound_px2") for p in POSITIONS]
    claims = [usable_covariance(_claimed([_spot(o, p) for o in outcomes])) for p in POSITIONS]
    true_m, h = (np.array([getattr(t, name) for t in truths], float) for name in ("depth_m", "stroke_m"))
    true_sigma_m = np.array([t.depth_sigma_m for t in truths])
    nominal_h = _nominal_stroke_m(truths)
    answers, truth = (
        [np.stack([i[u], i[v]], -1) for i in (down, up)] for u, v in (("u_px", "v_px"), ("u_true_px", "v_true_px"))
    )
    calibration = truths[0].calibration_covariance
    found_m = nominal_depth(nominal, nominal_h, (answers[0], answers[1]), (claims[0], claims[1]), calibration)
    own, own_sigma = (np.array([_own_depth(o.answer, name) for o in outcomes]) for name in ("depth_m", "sigma_depth_m"))
    has_own = np.isfinite(own)
    of_own = np.hypot(own_sigma, found_m.calibration_sigma_m)
    depth, sigma = np.where(has_own, own, found_m.depth_m), np.where(has_own, of_own, found_m.sigma_m)
    pull = (depth - true_m) / np.where(sigma > 0.0, np.hypot(sigma, true_sigma_m), np.nan)
    intervals = np.array([_own_interval(o.answer) for o in outcomes])
    within = _within(depth, true_m, pull, intervals, np.hypot(found_m.calibration_sigma_m, true_sigma_m))
    both = down["visible"] & up["visible"]
    false = down["false_detection"] | up["false_detection"] | (has_own & ~both)
    found = down["detected"] & up["detected"] & (depth > 0.0)  # False for NaN
    return {
        "number": [t.number for t in truths],
        "sample_id": [t.sample_id for t in truths],
        "draw": [t.draw for t in truths],
        "preset": [t.preset for t in truths],
        "jpeg_quality": [t.jpeg_quality for t in truths],
        **{name: [getattr(t, name) for t in truths] for name in OF_FRAMES},
        "hinted": [t.hinted for t in truths],
        "searched_px2": _searched_px2(nominal, truths),
        "depth_m": true_m,
        "axis_depth_m": np.array([t.axis_depth_m for t in truths], float),
        "stroke_m": h,
        "pair_visible": both,
        "pair_false": false,
        "pair_electrons": np.minimum(down["electrons"], up["electrons"]),
        "depth_found": found,
        "depth_from": [_from(*x) for x in zip(has_own, np.isfinite(depth), strict=True)],
        "depth_estimate_m": depth,
        "depth_error_m": depth - true_m,
        "depth_relative": depth / true_m - 1.0,
        "depth_sigma_m": sigma,
        "claimed_sigma_m": np.where(has_own, own_sigma, np.nan),
        "claimed_low_m": intervals[:, 0],
        "claimed_high_m": intervals[:, 1],
        "depth_pull": pull,
        "depth_within": within,
        "bound_depth_m2": _bound_depth(nominal, nominal_h, *truth, *bounds).sigma_m ** 2,
        "seconds": [float(o.seconds) for o in outcomes],
        "failure": [o.failure for o in outcomes],
        "message": [o.message for o in outcomes],
    }


_true_phi, _bound_depth = with_kept_results(phi_of), with_kept_results(depth_exact)


def _spot(outcome: Outcome, position: str) -> Spot | None:
    return None if outcome.answer is None else getattr(outcome.answer, position)


def _position(spot: Spot | None) -> tuple[float, float]:
    """(u, v), NaN where there is none; a status other than "ok" takes a position back."""
    if spot is None or spot.status != OK or spot.uv_px is None or not np.isfinite(spot.uv_px).all():
        return math.nan, math.nan
    return spot.uv_px


def _status(spot: Spot | None, outcome: Outcome) -> str:
    if spot is None:
        return outcome.failure or "no answer"
    return spot.status if spot.status != OK or np.isfinite(_position(spot)).all() else "no position"


def _claimed(spots: list[Spot | None]) -> Array:
    claims = (None if spot is None else spot.covariance_px2 for spot in spots)
    return np.stack([_NO_MATRIX if claim is None else np.asarray(claim, float) for claim in claims])


def _own_phi(spot: Spot | None) -> float:
    if spot is None or spot.phi_rad is None or not np.isfinite(_position(spot)).all():
        return math.nan
    return spot.phi_rad


def _own_depth(answer: Answer | None, name: str) -> float:
    value = None if answer is None else getattr(answer, name)
    return math.nan if value is None else float(value)


def _own_interval(answer: Answer | None) -> tuple[float, float]:
    interval = None if answer is None or answer.depth_m is None else answer.interval_depth_m
    return (math.nan, math.nan) if interval is None else interval


def _within(depth: Array, true_m: Array, pull: Array, intervals: Array, added_m: Array) -> list[bool | None]:
    """Truth of D in the claimed interval, None where none is claimed; `added_m` are errors that it leaves out."""
    more = NORMAL_95 * np.nan_to_num(added_m)
    low, high = depth - np.hypot(depth - intervals[:, 0], more), depth + np.hypot(intervals[:, 1] - depth, more)
    inside = np.where(np.isfinite(low), (low <= true_m) & (true_m <= high), np.abs(pull) <= NORMAL_95)
    known = np.isfinite(true_m) & (np.isfinite(low) | np.isfinite(pull))
    return [bool(x) if there else None for x, there in zip(inside, known, strict=True)]


def _from(own: bool, there: bool) -> str | None:
    if not there:
        return None
    return "method" if own else "pixels"


def _bounds(spots: list[ImageTruth], name: str) -> Array:
    matrices: Iterator[Array | None] = (getattr(spot, name) for spot in spots)
    return np.stack([_NO_MATRIX if matrix is None else np.asarray(matrix, float) for matrix in matrices])


def _bayer(uv_px: Array) -> str | None:
    if not np.isfinite(uv_px).all():
        return None
    u, v = np.floor(uv_px + 0.5).astype(int) % 2
    return _BAYER[int(u), int(v)]


def _stack(points: Iterable[tuple[float, float]]) -> Array:
    return np.array(list(points), float).reshape(-1, 2)
