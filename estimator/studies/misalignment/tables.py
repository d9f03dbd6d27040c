"""Tolerance table: which value of each parameter costs a given part of D.

Main table of the study `misalignment`: a row per parameter, value, spot and estimator.

What the study `misalignment` says: sentences from numbers.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl
from scipy import stats

from phibench.datasets.errors import DatasetError
from phibench.estimator.studies.framework import Row
from phibench.estimator.studies.misaligned_rigs import (
    CALIBRATED,
    NOMINAL,
    Calibrate,
    Places,
    Rendered,
    calibrated_errors,
    errors,
    slopes,
)
from phibench.estimator.studies.misalignment.interactions import Interactions
from phibench.estimator.studies.statistics import first_crossing
from phibench.scenes.frames import Array
from phibench.scenes.misalignment import PARAMETERS, Misalignment
from phibench.scenes.rig import Rig
from phibench.scenes.validation import SceneError

STATISTICS = ("rms", "worst")
Errors = Callable[[Misalignment], Array]


@dataclass(frozen=True)
class Search:
    """How a tolerance is looked for.

    Parameters
    ----------
    cost : float
        Relative change of D that is allowed.
    start, largest : float
        First and last value, in units of the study's magnitude; the parameter's own limit also ends the search.
    factor : float
        Between values.
    """

    cost: float
    start: float
    largest: float
    factor: float


def tolerance_rows(
    nominal: Rig, places: Places, search: Search, coarse: Search, calibrate: Calibrate
) -> Iterator[dict[str, Any]]:
    """One row per parameter, estimator, D and statistic over azimuths and signs; value None where it is never reached.

    Parameters
    ----------
    nominal, places, calibrate
    search : for the estimators that believe the nominal rig
    coarse : for the calibrated one, which takes a second a value
    """

    def by_nominal(m: Misalignment) -> Array:
        return errors(nominal, m, places)

    def by_calibrated(m: Misalignment) -> Array:
        return calibrated_or_lost(nominal, m, places, calibrate)[None]

    for names, of, how in ((NOMINAL, by_nominal, search), ((CALIBRATED,), by_calibrated, coarse)):
        aligned = of(Misalignment())
        for parameter in PARAMETERS:
            values = tolerance(nominal, parameter, of, aligned, how)
            for i, estimator in enumerate(names):
                for j, depth in enumerate(places.depths_m):
                    for k, statistic in enumerate(STATISTICS):
                        yield _row(parameter, estimator, float(depth), places, statistic, values[k, i, j])


def signs(nominal: Rig, parameter: str, size: float) -> tuple[float, ...]:
    """Signs that a parameter of a size can have: a mirror cannot be smoother than smooth."""
    return tuple(sign for sign in (1.0, -1.0) if _possible(nominal, Misalignment(**{parameter: sign * size})))


def _possible(nominal: Rig, m: Misalignment) -> bool:
    try:
        nominal.perturbed(m)
    except SceneError:
        return False
    return True


def tolerance(nominal: Rig, parameter: str, of: Errors, aligned: Array, search: Search) -> Array:
    """Values at which the cost is reached, shape (statistics, estimators, d); NaN where it never is."""
    one = PARAMETERS[parameter]

    def cost(value: float) -> Array:
        both = [of(Misalignment(**{parameter: s * value})) - aligned for s in signs(nominal, parameter, value)]
        # a rig that cannot be costs nothing: the search ends without a crossing
        return over_azimuths(np.concatenate(both, axis=-1) if both else np.zeros(aligned.shape))

    limit = min(search.largest * one.study, one.limit)
    return first_crossing(cost, search.cost, search.start * one.study, limit, search.factor)


def over_azimuths(changes: Array) -> Array:
    """Rms and largest magnitude over the last axis, shape (2, ...); infinite where a spot has no estimate."""
    known = np.where(np.isfinite(changes), np.abs(changes), np.inf)
    return np.stack([np.sqrt(np.mean(known**2, axis=-1)), np.max(known, axis=-1)])


def calibrated_or_lost(nominal: Rig, m: Misalignment, places: Places, calibrate: Calibrate) -> Array:
    """Errors of the calibrated estimator; NaN where the rig cannot be or be calibrated."""
    try:
        return calibrated_errors(nominal, m, places, calibrate)
    except (SceneError, DatasetError, np.linalg.LinAlgError):
        return np.full(places.points_m.shape[:-1], np.nan)


def _row(
    parameter: str, estimator: str, depth_m: float, places: Places, statistic: str, value: float
) -> dict[str, Any]:
    one, reached = PARAMETERS[parameter], bool(np.isfinite(value))
    return {
        "parameter": parameter,
        "unit": one.unit,
        "estimator": estimator,
        "depth_m": depth_m,
        "stroke_m": places.stroke_m,
        "height_m": places.height_m,
        "statistic": statistic,
        "value": float(value) if reached else None,
        "value_over_study": float(value) / one.study if reached else None,
    }


PLACE = ("depth_m", "azimuth_deg")


def study_table(nominal: Rig, strokes: Sequence[Places], calibrate: Calibrate) -> pl.DataFrame:
    """Every parameter at plus and minus its study's magnitude; the calibrated estimator at the first stroke only.

    Columns
    -------
    parameter, unit, value, estimator, stroke_m, height_m, depth_m, azimuth_deg
    error_relative : (estimate - D) / D of the misaligned rig
    whole_relative : change of it by the misalignment
    first_order_relative : slope times value; null for the calibrated estimator
    """
    parts = [_nominal(nominal, places) for places in strokes]
    return pl.concat([*parts, _calibrated(nominal, strokes[0], calibrate)])


def rendered_table(found: Sequence[Rendered], places: Places) -> pl.DataFrame:
    """Rows of rendered spots: rendered and predicted change of D's relative error."""
    frames = []
    for one in found:
        for name, change, predicted in zip(NOMINAL, one.change, one.predicted, strict=True):
            frames.append(
                _frame(
                    one.parameter, one.value, name, places, {"rendered_relative": change, "whole_relative": predicted}
                )
            )
    return pl.concat(frames)


def _nominal(nominal: Rig, places: Places) -> pl.DataFrame:
    slope, aligned = slopes(nominal, places), errors(nominal, Misalignment(), places)
    frames = []
    for parameter, value in _values(nominal):
        found = errors(nominal, Misalignment(**{parameter: value}), places)
        for i, name in enumerate(NOMINAL):
            columns = {
                "error_relative": found[i],
                "whole_relative": found[i] - aligned[i],
                "first_order_relative": slope[parameter][i] * value,
            }
            frames.append(_frame(parameter, value, name, places, columns))
    return pl.concat(frames)


def _calibrated(nominal: Rig, places: Places, calibrate: Calibrate) -> pl.DataFrame:
    aligned = calibrated_or_lost(nominal, Misalignment(), places, calibrate)
    frames = []
    for parameter, value in _values(nominal):
        found = calibrated_or_lost(nominal, Misalignment(**{parameter: value}), places, calibrate)
        columns = {
            "error_relative": found,
            "whole_relative": found - aligned,
            "first_order_relative": np.full(found.shape, np.nan),
        }
        frames.append(_frame(parameter, value, CALIBRATED, places, columns))
    return pl.concat(frames)


def _values(nominal: Rig) -> list[tuple[str, float]]:
    return [(name, sign * one.study) for name, one in PARAMETERS.items() for sign in signs(nominal, name, one.study)]


def _frame(parameter: str, value: float, estimator: str, places: Places, columns: dict[str, Array]) -> pl.DataFrame:
    D, turn = np.broadcast_arrays(places.depths_m[:, None], np.degrees(places.azimuths_rad))
    table = {"depth_m": D.ravel(), "azimuth_deg": turn.ravel(), **{key: x.ravel() for key, x in columns.items()}}
    words = {
        "parameter": parameter,
        "unit": PARAMETERS[parameter].unit,
        "value": value,
        "estimator": estimator,
        "stroke_m": places.stroke_m,
        "height_m": places.height_m,
    }
    frame = pl.DataFrame(table).with_columns(*(pl.lit(x).alias(key) for key, x in words.items()))
    return frame.select(*words, *table).fill_nan(None)


@dataclass(frozen=True)
class Rank:
    """What a parameter of the study's magnitude costs one estimator: rms and worst relative change of D, shape (d,)."""

    parameter: str
    estimator: str
    depths_m: Array
    rms: Array
    worst: Array


def ranking(table: pl.DataFrame, estimator: str, stroke_m: float) -> list[Rank]:
    """Parameters by their largest rms over all D, the costliest first; over azimuths and both signs."""
    mine = table.filter((pl.col("estimator") == estimator) & (pl.col("stroke_m") == stroke_m))
    ranks = []
    for parameter in PARAMETERS:
        rows = mine.filter(pl.col("parameter") == parameter).sort("depth_m", "azimuth_deg", "value")
        depths = rows["depth_m"].unique(maintain_order=True).to_numpy()
        changes = rows["whole_relative"].fill_null(np.nan).to_numpy().reshape(len(depths), -1)
        rms, worst = over_azimuths(changes)
        ranks.append(Rank(parameter, estimator, depths, rms, worst))
    return sorted(ranks, key=lambda rank: (-float(np.max(rank.rms)), rank.parameter))


def slope_misses(table: pl.DataFrame, estimator: str) -> tuple[str, float, float]:
    """Parameter, D and size of the largest difference between slope times value and the whole change."""
    mine = table.filter(pl.col("estimator") == estimator).drop_nulls(["whole_relative", "first_order_relative"])
    off = mine.with_columns(off=(pl.col("whole_relative") - pl.col("first_order_relative")).abs()).sort("off")
    last = off.row(-1, named=True)
    return str(last["parameter"]), float(last["depth_m"]), float(last["off"])


_LISTED = 5
_ADDITIVE = 0.9
_NOTABLE = 1e-3  # of D: a change of less is not worth a word
_SCALES = {"m": (1e3, "mm"), "rad": (math.degrees(1.0), "deg"), "px": (1.0, "px"), "1": (1.0, "")}


def ranked(ranks: Sequence[Rank], estimator_words: str) -> str:
    """Which parameters cost most, at the nearest and the farthest D."""
    first, last = ranks[0].depths_m[0], ranks[0].depths_m[-1]
    parts = [
        f"{one.parameter} ({shown(one.parameter, PARAMETERS[one.parameter].study)}) "
        f"{percent(one.rms[0])} and {percent(one.rms[-1])}"
        for one in ranks[:_LISTED]
    ]
    return (
        f"With misalignments of the usual size, one at a time, {estimator_words} changes most (rms over azimuths and "
        f"signs, % of D at D = {first:g} and {last:g} m) by {'; '.join(parts)}."
    )


def slope_sentence(miss: tuple[str, float, float], target: float) -> str:
    """How far the sensitivities alone lead."""
    name, depth, off = miss
    verdict = "slopes do" if off <= target else "slopes are not enough for errors of this size"
    size = f"{percent(off)} % of D ({name}, D = {depth:g} m)"
    return f"Slope times error misses the whole change by at most {size}: {verdict}."


def rendered_sentence(found: Sequence[Rendered], tolerance: float) -> str:
    """Whether rendered spots move D as predicted."""
    off, name = worst_disagreement(found)
    count = sum(one.change.size for one in found)
    shift = max(one.centroid_px for one in found)
    verdict = "as predicted" if off <= tolerance else "not as predicted"
    return (
        f"Rendered spots (centroids of noise-free layers, {count} estimates) move D {verdict}: the largest difference "
        f"is {off:.1e} of D ({name}), {tolerance:.0e} are allowed; centroid and chief ray drift apart by at most "
        f"{1e3 * shift:.2f} mpx."
    )


def worst_disagreement(found: Sequence[Rendered]) -> tuple[float, str]:
    """Largest |rendered - predicted| change and its parameter; infinite where one of them is missing."""
    sizes = []
    for one in found:
        off = np.abs(one.change - one.predicted)
        sizes.append((float(np.max(np.where(np.isfinite(off), off, np.inf))), one.parameter))
    return max(sizes)


def tolerance_sentence(rows: Sequence[dict[str, Any]], estimator: str, depth_m: float, cost: float) -> str:
    """Which values cost that part of D, the tightest against the study's magnitude first."""
    mine = [
        row for row in rows if row["estimator"] == estimator and row["statistic"] == "rms" and row["depth_m"] == depth_m
    ]
    reached = sorted((row for row in mine if row["value"] is not None), key=lambda row: float(row["value_over_study"]))
    tight = [row for row in reached if row["value_over_study"] < 1.0]
    parts = ", ".join(f"{row['parameter']} {shown(row['parameter'], row['value'])}" for row in reached[:_LISTED])
    never = [row["parameter"] for row in mine if row["value"] is None]
    rest = f"; within the range searched {_list(never)} never {'does' if len(never) == 1 else 'do'}" if never else ""
    head = (
        f"{percent(cost)} % of D at D = {depth_m:g} m (rms over azimuths, exact estimator, nominal numbers) is cost by"
    )
    return f"{head} {parts or 'none'}; {len(tight)} of {len(mine)} parameters do so below their usual size{rest}."


def calibrated_sentence(ranks: Sequence[Rank], before: Sequence[Rank]) -> str:
    """What is left after a calibration."""
    far = max(float(np.max(one.rms)) for one in before)
    left = [f"{one.parameter} {percent(one.rms[0])} and {percent(one.rms[-1])}" for one in ranks[:3]]
    largest = float(np.max(ranks[0].rms))
    size = "less" if largest < far else "no less"
    untouched = {one.parameter: one for one in before}
    worse = [one.parameter for one in ranks if bool(np.any(one.rms > untouched[one.parameter].rms + _NOTABLE))]
    harm = f"; it makes {_list(worse)} worse" if worse else ""
    return (
        f"After a calibration from the outline and a few spots {size} is left: at most {percent(largest)} % of D "
        f"against {percent(far)} %; the largest, at D = {ranks[0].depths_m[0]:g} and {ranks[0].depths_m[-1]:g} m, "
        f"are {'; '.join(left)}{harm}."
    )


def noise_sentence(noise: Array, depths_m: Array) -> str:
    """Noise of the calibration's own measurements, shape (draws, d, a)."""
    low, rms, high = noise_intervals(noise)
    parts = [
        f"{percent(r)} ({percent(a)} to {percent(b)}) % at {D:g} m"
        for D, a, r, b in zip(depths_m, low, rms, high, strict=True)
    ]
    return (
        f"The calibration's own noise, an aligned rig calibrated {len(noise)} times, costs {', '.join(parts)} (95 %)."
    )


def noise_intervals(noise: Array) -> tuple[Array, Array, Array]:
    """Lower end, rms and upper end over azimuths and draws, shape (d,); Student's t for the mean square.

    The errors at the azimuths of one draw belong together: a draw counts once.
    """
    squares = np.mean(noise**2, axis=-1)
    n = len(squares)
    spread = squares.std(axis=0, ddof=1) / math.sqrt(n) / squares.mean(axis=0)
    half = np.exp(0.5 * stats.t.ppf(0.975, n - 1) * spread)  # of a root: half the relative error
    rms = np.sqrt(squares.mean(axis=0))
    return rms / half, rms, rms * half


def interaction_sentence(found: Sequence[Interactions]) -> str:
    """Whether errors add up."""
    signed = [one for one in found if one.output == "error"]
    sums = [f"{one.indices[-2]:.2f} ({one.low[-2]:.2f} to {one.high[-2]:.2f}) at {one.depth_m:g} m" for one in signed]
    all_high, any_low = all(one.low[-2] >= _ADDITIVE for one in signed), any(one.high[-2] < _ADDITIVE for one in signed)
    verdict = "they add" if all_high else "they do not simply add" if any_low else "whether they add is not decided"
    biggest = max(signed, key=lambda one: float(np.max(one.total)))
    top = int(np.argmax(biggest.total))
    together = ", ".join(
        f"{percent(one.indices[-1])} ({percent(one.low[-1])} to {percent(one.high[-1])}) % at {one.depth_m:g} m"
        for one in signed
    )
    return (
        f"All drawn at once, uniform up to their usual size, they cost {together} of D (rms, 95 %, spots along x); "
        f"the first-order Sobol indices sum to {', '.join(sums)}: {verdict}; the largest total index is "
        f"{biggest.total[top]:.2f} ({biggest.low[len(biggest.parameters) + top]:.2f} to "
        f"{biggest.high[len(biggest.parameters) + top]:.2f}), {biggest.parameters[top]} at {biggest.depth_m:g} m."
    )


def ranking_rows(ranks: Sequence[Rank], calibrated: Sequence[Rank]) -> tuple[Row, ...]:
    """Table: what every parameter costs, % of D, rms over azimuths."""
    after = {one.parameter: one for one in calibrated}
    depths = [f"{D:g} m" for D in ranks[0].depths_m]
    heads = ("parameter", "size", *depths, *(f"calibrated, {D}" for D in depths))
    return (
        heads,
        *(
            (
                one.parameter,
                shown(one.parameter, PARAMETERS[one.parameter].study),
                *map(percent, one.rms),
                *map(percent, after[one.parameter].rms),
            )
            for one in ranks
        ),
    )


def tolerance_table(rows: Sequence[dict[str, Any]], statistic: str, estimators: Sequence[str]) -> tuple[Row, ...]:
    """Table: the value of every parameter that costs 1 % of D, per estimator and D."""
    mine = {(r["parameter"], r["estimator"], r["depth_m"]): r["value"] for r in rows if r["statistic"] == statistic}
    depths = sorted({depth for _, _, depth in mine})
    heads = ("parameter", *(f"{name}, {D:g} m" for name in estimators for D in depths))
    return (
        heads,
        *(
            (p, *(_cell(p, mine[p, name, D]) for name in estimators for D in depths))
            for p in PARAMETERS
            if any(mine[p, name, D] is not None for name in estimators for D in depths)
        ),
    )


def shown(parameter: str, value: float) -> str:
    """A value with a unit that people use."""
    scale, unit = _SCALES[PARAMETERS[parameter].unit]
    return f"{scale * value:.3g} {unit}".strip()


def percent(relative: float) -> str:
    """Two digits of a per cent; "lost" where there is no estimate."""
    return f"{100.0 * relative:.2g}" if math.isfinite(relative) else "lost"


def _cell(parameter: str, value: float | None) -> str:
    return "-" if value is None else shown(parameter, value)


def _list(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
