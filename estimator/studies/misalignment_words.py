"""What the study `misalignment` says: sentences from numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import stats

from phibench.estimator.studies.misalignment_interactions import Interactions
from phibench.estimator.studies.misalignment_rendered import Rendered
from phibench.estimator.studies.misalignment_table import Rank
from phibench.estimator.studies.result import Row
from phibench.scenes.frames import Array
from phibench.scenes.misalignment import PARAMETERS

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
