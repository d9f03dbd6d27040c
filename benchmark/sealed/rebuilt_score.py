"""A score built again: answers out of its records, truth and images out of the data set.

The scorer's own functions do it, so that nothing is believed but the answers, the seconds and words about failures.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from phibench.benchmark.scores.answer_errors import Rules
from phibench.benchmark.scores.document import EncodedPicture, ScoreDocument
from phibench.benchmark.scores.score import Scored, score_outcomes
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import InputFile
from phibench.estimator.geometry.phi import CONVENTIONS
from phibench.estimator.interface import FAILURES, Answer, Matrix2, Outcome, Spot
from phibench.estimator.pair_set import PairSet
from phibench.scenes.frames import Array

GIVEN = ("seconds", "message")
"""Columns that nothing else tells: the run's clock, and words about a failure."""


def outcomes_of_records(table: pl.DataFrame) -> list[Outcome]:
    """Answers of a method, and the failures instead of them, as its score has them.

    Parameters
    ----------
    table : as of `records.records`, two rows for each pair, down and up

    Raises
    ------
    DatasetError
        If a row has no answer that a method can give.
    """
    rows = iter(table.iter_rows(named=True))
    return [_outcome(down, up) for down, up in zip(rows, rows, strict=True)]


def rebuilt(
    document: ScoreDocument, table: pl.DataFrame, pairs: PairSet, told: Callable[[int], None] = lambda done: None
) -> Scored:
    """Score of the same answers, made anew: truth, errors, bounds, pulls, ranks, causes, metrics and worst images.

    Parameters
    ----------
    document, table : of the score
    pairs : PairSet
        Those that were scored.
    told : callable
        Given the number of pairs that are done, now and then.
    """
    outcomes = outcomes_of_records(table)
    return score_outcomes(document.method, pairs, outcomes, Rules(), document.seed, document.limits, told)


_CODES = 2.0  # mean difference of two coders' JPEG pictures of one frame


def alike(given: EncodedPicture | None, right: EncodedPicture | None) -> bool:
    """Tell whether two pictures show the same: coders of other versions write other bytes."""
    if given is None or right is None or given.base64 == right.base64:
        return given == right
    place = {"base64"}
    if given.model_dump(exclude=place) != right.model_dump(exclude=place):
        return False  # another size or text
    try:
        first, second = (_pixels(picture) for picture in (given, right))
    except (DatasetError, ValueError):  # no picture: not the same
        return False
    return first.shape == second.shape and float(np.abs(first - second).mean()) <= _CODES


def _pixels(picture: EncodedPicture) -> Array:
    data = base64.b64decode(picture.base64, validate=True)
    return np.asarray(InputFile(Path("picture"), "score again").picture(data=data), float)


def _outcome(down: dict[str, Any], up: dict[str, Any]) -> Outcome:
    number, seconds = down["number"], math.nan if down["seconds"] is None else down["seconds"]
    if down["failure"]:
        if down["failure"] not in FAILURES:
            raise DatasetError(f"records.failure of pair {number} is none of {', '.join(FAILURES)}: score again")
        return Outcome(number, None, seconds, down["failure"], down["message"] or "")
    own = down["depth_from"] == "method"
    interval = (down["claimed_low_m"], down["claimed_high_m"])
    answer = Answer(
        _spot(down),
        _spot(up),
        down["depth_estimate_m"] if own else None,
        down["claimed_sigma_m"] if own else None,
        None if not own or None in interval else interval,
    )
    return Outcome(number, answer, seconds, "", down["message"] or "")


def _spot(row: dict[str, Any]) -> Spot:
    place = (row["u_px"], row["v_px"])
    own = row["phi_from"] == "method"
    if own and row["phi_convention"] not in CONVENTIONS:
        raise DatasetError(
            f"records.phi_convention of pair {row['number']} {row['image']} is none of {', '.join(CONVENTIONS)}: "
            "score again"
        )
    return Spot(
        None if None in place else place,
        _covariance(row),
        row["phi_rad"] if own else None,
        row["phi_convention"] if own else "ray",
        row["status"] or "",
    )


def _covariance(row: dict[str, Any]) -> Matrix2 | None:
    uu, uv, vv = (row[f"claimed_{name}_px2"] for name in ("uu", "uv", "vv"))
    return None if None in (uu, uv, vv) else ((uu, uv), (uv, vv))


# -- comparing ------------------------------------------------------------------------------------------------------

RELATIVE, ABSOLUTE = 1e-6, 1e-12
"""Tolerance of a number that is computed again: other processors and versions of libraries round otherwise."""


def differences(table: pl.DataFrame, right: pl.DataFrame, names: Sequence[str], source: str) -> Iterator[str]:
    """Columns that are not as they have to be, a sentence each with its first row."""
    for name in names:
        if name not in table.columns:
            yield f"records: the column {name} is missing"
            continue  # the other columns are compared all the same
        rows = np.flatnonzero(~_same(table[name], right[name]))
        if len(rows):
            number, image = table.select("number", "image").row(int(rows[0]))
            a, b = table[name][int(rows[0])], right[name][int(rows[0])]
            more = f", and {len(rows) - 1} more" if len(rows) > 1 else ""
            yield f"records.{name} of pair {number} {image} is {short(a)}, not {short(b)}, {source}{more}"


def _same(given: pl.Series, right: pl.Series) -> Any:
    if given.dtype != right.dtype:
        return np.zeros(len(given), bool)
    if not right.dtype.is_float():
        return given.eq_missing(right).to_numpy()
    a, b = (x.cast(pl.Float64()).fill_null(np.nan).to_numpy() for x in (given, right))
    return np.isclose(a, b, rtol=RELATIVE, atol=ABSOLUTE, equal_nan=True)


def short(value: Any) -> str:
    """A value in at most 60 signs."""
    text = f"{value:.6g}" if isinstance(value, float) else repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
