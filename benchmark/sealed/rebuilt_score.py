"""A score made again, from its records or by its method, and compared; the method's hashes, packages and files checked.

Answers come out of the records, truth and images out of the data set. The scorer's own functions do it, so that nothing
is believed but the answers, the seconds and words about failures. Without the method only the form of what is said of
it can be checked, and what this installation knows: built-in methods, and packages that are installed here.
"""

from __future__ import annotations

import base64
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from rich.console import Console

from phibench.benchmark.isolation.method_references import Reference, resolve
from phibench.benchmark.isolation.run_limits import MethodError, RunLimits
from phibench.benchmark.scores.answer_errors import Rules
from phibench.benchmark.scores.score import Scored, run_and_score, score_outcomes
from phibench.benchmark.scores.score_document import BUILT_IN, SCORER, MethodCard, ScoreDocument
from phibench.benchmark.scores.worst_images import EncodedPicture
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import InputFile
from phibench.datasets.store.provenance import code_behind, program_version
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
    table : as of `records.record_table`, two rows for each pair, down and up

    Raises
    ------
    DatasetError
        If a row has no answer that a method can give.
    """
    rows = iter(table.iter_rows(named=True))
    return [_outcome(down, up) for down, up in zip(rows, rows, strict=True)]


def score_from_records(
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


def pictures_alike(given: EncodedPicture | None, right: EncodedPicture | None) -> bool:
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


def column_differences(table: pl.DataFrame, right: pl.DataFrame, names: Sequence[str], source: str) -> Iterator[str]:
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
            yield f"records.{name} of pair {number} {image} is {short_value(a)}, not {short_value(b)}, {source}{more}"


def _same(given: pl.Series, right: pl.Series) -> Any:
    if given.dtype != right.dtype:
        return np.zeros(len(given), bool)
    if not right.dtype.is_float():
        return given.eq_missing(right).to_numpy()
    a, b = (x.cast(pl.Float64()).fill_null(np.nan).to_numpy() for x in (given, right))
    return np.isclose(a, b, rtol=RELATIVE, atol=ABSOLUTE, equal_nan=True)


def short_value(value: Any) -> str:
    """A value in at most 60 signs."""
    text = f"{value:.6g}" if isinstance(value, float) else repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


# -- the method --------------------------------------------------------------------------------------------------------

_HASH = re.compile("[0-9a-f]{64}")
_ALWAYS = "numpy"
"""Package that every method's process has: the interface needs it."""


@dataclass(frozen=True)
class CheckNotes:
    """Faults, and what could not be checked, a sentence each."""

    faults: tuple[str, ...]
    unchecked: tuple[str, ...]


def check_card(document: ScoreDocument, method: str | None = None) -> CheckNotes:
    """Check what a score says of its method and of the program that scored it.

    Parameters
    ----------
    method : the method itself, as `phibench score` takes it

    Raises
    ------
    MethodError
        If the method cannot be found.
    """
    card = document.method
    faults = [*_of_form(card), *_of_program(document)]
    unchecked = [] if card.files_complete else ["method.files: the system did not tell every file that was opened"]
    unchecked += [f"method.files.{name}: it has no hash" for name, found in card.files.items() if found is None]
    reference = _known(card) if method is None else resolve(method)
    if reference is not None:
        faults += _of_reference(card, reference)
    else:
        unchecked.append("method.sha256, modules, files and packages: give the method itself, --method")
    if document.program != program_version() or "changed" in document.program:
        unchecked.append(f"code_sha256: it was scored by {document.program or 'a program that is not told'}")
    return CheckNotes(tuple(faults), tuple(unchecked))


def _of_form(card: MethodCard) -> Iterator[str]:
    if not card.sha256:
        yield "method.sha256 is missing: nobody can tell which code was scored"
    hashes = {"sha256": card.sha256, **card.modules, **card.files}
    for name, found in hashes.items():
        if found and not _HASH.fullmatch(found):
            yield f"method: the hash of {name} is no SHA-256, 64 digits from 0 to f"
    if card.kind == BUILT_IN and (card.division, card.self_calibrates) != ("closed", False):
        yield "method.division: built-in methods are closed and take the rig as it is given"
    if not card.packages.get(_ALWAYS):
        yield f"method.packages lacks {_ALWAYS}, which every method loads: nobody can tell which packages ran"


def _of_program(document: ScoreDocument) -> Iterator[str]:
    program = program_version()
    if document.program == program and "changed" not in program and document.code_sha256 != code_behind(SCORER):
        yield f"code_sha256 is not that of {program}, which it says has scored it"


def _known(card: MethodCard) -> Reference | None:
    """The method as it is installed here: a built-in one, or one of a package in the same version."""
    if card.kind not in ("built-in", "package"):
        return None
    try:
        reference = resolve(card.reference)
    except MethodError:  # not here: nothing to compare with
        return None
    return reference if (reference.kind, reference.version) == (card.kind, card.version) else None


def _of_reference(card: MethodCard, reference: Reference) -> Iterator[str]:
    right = MethodCard.of(reference.name, **reference.document())
    for name in ("kind", "function", "version", "sha256", "sees"):
        given, found = getattr(card, name), getattr(right, name)
        if given != found:
            yield f"method.{name} is {_short(given)}, and that of {reference.name} is {_short(found)}"
    yield from _of_files("modules", card.modules, right.modules)


def _of_files(kind: str, given: Mapping[str, str | None], right: Mapping[str, str | None]) -> Iterator[str]:
    for name in sorted(set(given) ^ set(right)):
        place = "the method" if name in right else "the score"
        yield f"method.{kind}: {place} alone has {name}"
    for name in sorted(set(given) & set(right)):
        if given[name] != right[name]:
            yield f"method.{kind}.{name} has another hash than the method's file"


def _short(value: str | None) -> str:
    return repr(value) if value is None or len(value) <= 40 else f"{value[:12]!r} and so on"


def check_run(
    document: ScoreDocument,
    table: pl.DataFrame,
    method: str,
    pairs: PairSet,
    limits: RunLimits,
    workers: int,
    console: Console,
) -> CheckNotes:
    """Run the method again and compare its answers, packages and files; parameters as for `check_score`.

    Raises
    ------
    MethodError
        If it cannot be started.
    """
    (again,) = run_and_score([method], pairs, workers, console, "pairs again", document.seed, limits)
    names = [name for name in again.records.columns if name not in GIVEN]
    faults = list(column_differences(table, again.records, names, "what the method answers here"))
    given, right = document.method, again.document.method
    if right.files_complete:
        faults += _of_files("files", given.files, right.files)
    if lacking := sorted(set(right.packages) - set(given.packages)):
        faults.append(f"method.packages lacks {', '.join(lacking)}, which the method loads here")
    other = [name for name, version in given.packages.items() if right.packages.get(name) != version]
    unchecked = [
        f"method.packages.{name}: {given.packages[name]} there, {right.packages.get(name)} here" for name in other
    ]
    return CheckNotes(tuple(faults), tuple(unchecked))
