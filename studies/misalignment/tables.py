"""Tables of the study `misalignment`: change of D by each parameter, its tolerance and its rank; findings from them.

Main table: a row per parameter, value, spot and estimator. Tolerance table: the value of each parameter that costs a
given part of D. Findings are made from both.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl
import scipy

from phibench.datasets.common.errors import DatasetError
from phibench.scenes.frames import Array
from phibench.scenes.misalignment import PARAMETERS, Misalignment
from phibench.scenes.rig import Rig
from phibench.scenes.validation import SceneError
from phibench.studies.framework import Finding
from phibench.studies.misaligned_rigs import (
    ALL,
    CALIBRATED,
    NOMINAL,
    Calibrate,
    Places,
    RenderedDeviation,
    calibrated_errors,
    errors,
    slopes,
)

STATISTICS = ("rms", "worst")
Errors = Callable[[Misalignment], Array]


@dataclass(frozen=True)
class Search:
    """Search for a tolerance.

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
    nominal: Rig, places: Places, search: Search, coarse: Search, calibrate: Calibrate, parameters: Sequence[str] = ALL
) -> Iterator[dict[str, Any]]:
    """One row per parameter, estimator, D and statistic over azimuths and signs; value None where it is never reached.

    Parameters
    ----------
    search : for the estimators with the nominal rig
    coarse : for the calibrated one, which takes a second a value
    parameters : names
    """
    for (names, of), how in zip(errors_by(nominal, places, calibrate), (search, coarse), strict=True):
        aligned = of(Misalignment())
        for parameter in parameters:
            values = tolerance(nominal, parameter, of, aligned, how)
            for i, estimator in enumerate(names):
                for j, depth in enumerate(places.depths_m):
                    for k, statistic in enumerate(STATISTICS):
                        yield _row(parameter, estimator, float(depth), places, statistic, values[k, i, j])


def errors_by(nominal: Rig, places: Places, calibrate: Calibrate) -> tuple[tuple[tuple[str, ...], Errors], ...]:
    """Relative errors (estimators, d, a) by misalignment: of all estimators with the nominal rig, and calibrated."""
    return (
        (NOMINAL, lambda m: errors(nominal, m, places)),
        ((CALIBRATED,), lambda m: calibrated_or_lost(nominal, m, places, calibrate)[None]),
    )


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
    deviation = PARAMETERS[parameter]

    def cost(value: float) -> Array:
        both = [of(Misalignment(**{parameter: s * value})) - aligned for s in signs(nominal, parameter, value)]
        # a rig that cannot be costs nothing: the search ends without a crossing
        return over_azimuths(np.concatenate(both, axis=-1) if both else np.zeros(aligned.shape))

    limit = min(search.largest * deviation.study, deviation.limit)
    return first_crossing(cost, search.cost, search.start * deviation.study, limit, search.factor)


Cost = Callable[[float], Array]
"""Value above 0 to costs, any shape; infinite where the value cannot be."""


def first_crossing(cost: Cost, target: float, start: float, limit: float, factor: float) -> Array:
    """Smallest value up to `limit` whose cost is `target`, in the shape of the costs; NaN where there is none.

    Costs are taken at start, start factor, start factor^2, ...; between two of them a power law is interpolated, and
    below `start` the cost counts as proportional to the value. The error of the power law is at most
    (ln factor)^2 / 8 times the curvature of ln(cost) over ln(value). Before a value that cannot be, the last one that
    can be is given.

    Parameters
    ----------
    cost : callable
    target, start, limit : float, above 0
    factor : float, above 1
    """
    before, low = start, np.asarray(cost(start), float)
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = np.where(low >= target, start * target / low, np.nan)
    while np.isnan(crossing).any() and before < limit:
        value = min(before * factor, limit)
        high = np.asarray(cost(value), float)
        new = np.isnan(crossing) & (high >= target)
        crossing = np.where(new, _between(before, value, low, high, target), crossing)
        before, low = value, high
    return crossing


def _between(a: float, b: float, low: Array, high: Array, target: float) -> Array:
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.log(target / low) / np.log(high / low)
    # no cost at all before: the crossing is anywhere in between, the upper end is taken
    share = np.where(np.isinf(high), 0.0, np.where(low > 0.0, share, 1.0))
    return a * (b / a) ** np.clip(share, 0.0, 1.0)


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
    deviation, reached = PARAMETERS[parameter], bool(np.isfinite(value))
    return {
        "parameter": parameter,
        "unit": deviation.unit,
        "estimator": estimator,
        "depth_m": depth_m,
        "stroke_m": places.stroke_m,
        "height_m": places.height_m,
        "statistic": statistic,
        "value": float(value) if reached else None,
        "value_over_study": float(value) / deviation.study if reached else None,
    }


def study_table(
    nominal: Rig, strokes: Sequence[Places], calibrate: Calibrate, parameters: Sequence[str] = ALL
) -> pl.DataFrame:
    """Each parameter at plus and minus its study's magnitude; the calibrated estimator at the first stroke only.

    Columns
    -------
    parameter, unit, value, estimator, stroke_m, height_m, depth_m, azimuth_deg
    error_relative : (estimate - D) / D of the misaligned rig
    whole_relative : change of it by the misalignment
    first_order_relative : slope times value; null for the calibrated estimator
    """
    usual_sizes = {name: PARAMETERS[name].study for name in parameters}
    # as far as such a rig can be
    values = [(name, sign * size) for name, size in usual_sizes.items() for sign in signs(nominal, name, size)]
    nominal_rows = (
        frame
        for places in strokes
        for frame in _changes(
            places, values, *errors_by(nominal, places, calibrate)[0], slopes(nominal, places, parameters=parameters)
        )
    )
    return pl.concat([*nominal_rows, *_changes(strokes[0], values, *errors_by(nominal, strokes[0], calibrate)[1])])


def rendered_table(found: Sequence[RenderedDeviation], places: Places) -> pl.DataFrame:
    """Rows of rendered spots: rendered and predicted change of D's relative error."""
    frames = []
    for estimate in found:
        for name, change, predicted in zip(NOMINAL, estimate.change, estimate.predicted, strict=True):
            columns = {"rendered_relative": change, "whole_relative": predicted}
            frames.append(_frame(estimate.parameter, estimate.value, name, places, columns))
    return pl.concat(frames)


def _changes(
    places: Places,
    values: Sequence[tuple[str, float]],
    names: Sequence[str],
    of: Errors,
    slope: Mapping[str, Array] | None = None,
) -> Iterator[pl.DataFrame]:
    """Rows of some estimators; null in place of first orders where there is no slope."""
    aligned = of(Misalignment())
    for parameter, value in values:
        changed = of(Misalignment(**{parameter: value}))
        first = np.full(changed.shape, np.nan) if slope is None else slope[parameter] * value
        for name, error, before, linear in zip(names, changed, aligned, first, strict=True):
            columns = {"error_relative": error, "whole_relative": error - before, "first_order_relative": linear}
            yield _frame(parameter, value, name, places, columns)


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
    """Rms and worst relative change of D by a parameter of its usual size, for one estimator, shape (d,)."""

    parameter: str
    estimator: str
    depths_m: Array
    rms: Array
    worst: Array


def ranking(table: pl.DataFrame, estimator: str, stroke_m: float) -> list[Rank]:
    """Parameters by their largest rms over all D, the costliest first; over azimuths and both signs."""
    mine = table.filter((pl.col("estimator") == estimator) & (pl.col("stroke_m") == stroke_m))
    ranks = []
    for parameter in mine["parameter"].unique(maintain_order=True):
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


# -- findings ------------------------------------------------------------------------------------------------------

_LISTED = 5  # costliest parameters
_LEFT = 3  # of them after a calibration
_NOTABLE = 1e-3  # of D: a smaller change counts as none
# as people state tolerances
_SCALES = {"m": (1e3, "mm"), "rad": (math.degrees(1.0), "deg"), "px": (1.0, "px"), "1": (1.0, "")}


def cost_findings(ranks: Sequence[Rank]) -> Iterator[Finding]:
    """Costliest parameters of one estimator at the usual size, at the nearest and the farthest D."""
    for rank in ranks[:_LISTED]:
        for i in (0, -1):
            what = f"{rank.parameter} {usual_text(rank.parameter)}, D = {rank.depths_m[i]:g} m"
            label = f"change of D, {rank.estimator}: {what}"
            yield Finding(label, 100.0 * rank.rms[i], unit="%")


def slope_findings(miss: tuple[str, float, float], target: float) -> Iterator[Finding]:
    """Largest difference of slope times error and whole change: the reach of the sensitivities alone."""
    name, depth, off = miss
    label = f"slope times error against the whole change, largest difference ({name}, D = {depth:g} m)"
    yield Finding(label, 100.0 * off, unit="% of D").judged("<=", 100.0 * target)


def rendered_findings(found: Sequence[RenderedDeviation], tolerance: float) -> Iterator[Finding]:
    """Rendered against predicted changes of D, from centroids of noise-free layers."""
    off, name = worst_disagreement(found)
    worst = Finding(f"rendered against predicted change of D, largest difference ({name})", off, unit="of D")
    yield worst.judged("<=", tolerance)
    yield Finding("rendered estimates", sum(estimate.change.size for estimate in found))
    drift = 1e3 * max(estimate.centroid_px for estimate in found)
    yield Finding("centroid against chief ray, largest drift by a misalignment", drift, unit="mpx")


def worst_disagreement(found: Sequence[RenderedDeviation]) -> tuple[float, str]:
    """Largest |rendered - predicted| change and its parameter; infinite where one of them is missing."""
    sizes = []
    for estimate in found:
        off = np.abs(estimate.change - estimate.predicted)
        sizes.append((float(np.max(np.where(np.isfinite(off), off, np.inf))), estimate.parameter))
    return max(sizes)


def tolerance_findings(
    rows: Sequence[dict[str, Any]], estimator: str, depth_m: float, cost: float
) -> Iterator[Finding]:
    """Tightest tolerances against the usual sizes, and the number of parameters that exceed theirs."""
    mine = tolerances_of(rows, estimator, depth_m)
    reached = [row for row in mine if row["value"] is not None]
    head = f"tolerance for {100.0 * cost:g} % of D, {estimator}, D = {depth_m:g} m"
    for row in reached[:_LISTED]:
        scale, unit = _SCALES[PARAMETERS[row["parameter"]].unit]
        yield Finding(f"{head}: {row['parameter']}", scale * row["value"], unit=unit)
    tight = sum(row["value_over_study"] < 1.0 for row in reached)
    yield Finding(f"{head}: parameters below their usual size", tight, unit=f"of {len(mine)}")
    never = ", ".join(row["parameter"] for row in mine if row["value"] is None)
    yield Finding(f"{head}: parameters that never reach it ({never or 'none'})", len(mine) - len(reached))


def calibrated_findings(ranks: Sequence[Rank], before: Sequence[Rank]) -> Iterator[Finding]:
    """Change of D that a calibration leaves, and the parameters that it makes worse."""
    far = 100.0 * max(float(np.max(rank.rms)) for rank in before)
    yield Finding("largest change of D before a calibration", far, unit="%")
    left = Finding("largest change of D after a calibration", 100.0 * float(np.max(ranks[0].rms)), unit="%")
    yield left.judged("<=", far)
    for rank in ranks[:_LEFT]:
        for i in (0, -1):
            label = f"change of D after a calibration: {rank.parameter}, D = {rank.depths_m[i]:g} m"
            yield Finding(label, 100.0 * rank.rms[i], unit="%")
    untouched = {rank.parameter: rank for rank in before}
    for rank in ranks:
        excess = 100.0 * float(np.max(rank.rms - untouched[rank.parameter].rms))
        if not excess <= 100.0 * _NOTABLE:
            worse = Finding(f"change of D that a calibration adds: {rank.parameter}", excess, unit="%")
            yield worse.judged("<=", 100.0 * _NOTABLE)


def noise_findings(noise: Array, depths_m: Array) -> Iterator[Finding]:
    """Noise of the calibration's own measurements, shape (draws, d, a)."""
    low, rms, high = noise_intervals(noise)
    for D, *ends in zip(depths_m, rms, low, high, strict=True):
        label = f"noise of the calibration, {len(noise)} calibrations of an aligned rig, D = {D:g} m"
        yield Finding.ranged(label, ends, "%", 100.0)


def noise_intervals(noise: Array) -> tuple[Array, Array, Array]:
    """Lower end, rms and upper end over azimuths and draws, shape (d,); Student's t for the mean square.

    The errors at the azimuths of one draw belong together: a draw counts once.
    """
    squares = np.mean(noise**2, axis=-1)
    n = len(squares)
    spread = squares.std(axis=0, ddof=1) / math.sqrt(n) / squares.mean(axis=0)
    half = np.exp(0.5 * scipy.stats.t.ppf(0.975, n - 1) * spread)  # of a root: half the relative error
    rms = np.sqrt(squares.mean(axis=0))
    return rms / half, rms, rms * half


def tolerances_of(rows: Sequence[dict[str, Any]], estimator: str, depth_m: float) -> list[dict[str, Any]]:
    """Rms tolerances of an estimator at one D, the tightest against the usual size first, those never reached last."""
    mine = [r for r in rows if (r["estimator"], r["statistic"], r["depth_m"]) == (estimator, "rms", depth_m)]
    return sorted(mine, key=lambda r: math.inf if r["value_over_study"] is None else float(r["value_over_study"]))


def value_text(parameter: str, value: float) -> str:
    """A value with a unit that people use."""
    scale, unit = _SCALES[PARAMETERS[parameter].unit]
    return f"{scale * value:.3g} {unit}".strip()


def usual_text(parameter: str) -> str:
    """Its usual size with a unit that people use."""
    return value_text(parameter, PARAMETERS[parameter].study)


def percent_text(relative: float) -> str:
    """Two digits of a per cent; "lost" where there is no estimate."""
    return f"{100.0 * relative:.2g}" if math.isfinite(relative) else "lost"
