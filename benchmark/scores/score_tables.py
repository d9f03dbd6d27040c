"""Tables of scores for a terminal, CSV, Markdown, LaTeX, JSON; numbers as text; sentences on frames, light, failures.

Units are those of `Metric.shown`: mrad for phi, per cent for rates and relative errors. CSV and JSON hold the numbers
of the files instead: SI, in full.
"""

from __future__ import annotations

import json
import math
import sys
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal, Protocol

import polars as pl
from rich.console import Console

from phibench.benchmark.pair_sets.dataset_pairs import Track, tracks_of
from phibench.benchmark.scores.failure_causes import CAUSES, KINDS, NOISE, TAKEN_FOR
from phibench.benchmark.scores.intervals import Estimate
from phibench.benchmark.scores.metrics import CHOSEN, METRICS, RANKS, applies
from phibench.benchmark.scores.score_document import ScoreDocument, Value
from phibench.benchmark.scores.strata import PairRange
from phibench.datasets.common.shown_text import TextTable, csv_table, latex, markdown, show_grid, table_console
from phibench.estimator.methods.registry import REFUSED

Form = Literal["terminal", "csv", "markdown", "latex", "json"]

HEADS = {
    "rank_phi_rad": "rank phi",
    "rank_depth": "rank D",
    "detection_rate": "found",
    "false_rate": "false",
    "rms_px": "rms",
    "rms_phi_rad": "rms phi",
    "rms_depth_relative": "rms D",
    "seconds": "time",
    "rms_counted_px": "rms, missed counted",
    "rms_depth_counted": "rms D, missed counted",
    "efficiency_px": "efficiency",
    "efficiency_pair_px": "efficiency, pair",
    "pull_deviation": "pull",
    "beyond_5_sigma": "beyond 5 sigma",
}
"""Metrics of a ranking with their heads; a narrow table has the first `NARROW` of them."""
NARROW = 8  # columns that fit into 80 signs
RANKS_OF_TRACKS: dict[Track, str] = {"localise": "localise", "find": "find", "depth": "average_recall"}
"""Metric that ranks a track; those of a score's tracks come first in its narrow tables."""
_TRACK_HEADS = {"localise": "error\n/ bound", "find": "find\nJ", "average_recall": "recall\nD"}
DIGITS = 3
"""Significant digits of a value in a table."""
FULL_OF_FALSE = 0.2
"""Share of false answers from which a line says what they are."""
FLAGGED = " !"
"""Mark behind the name of a method whose answers are better than the images allow."""
_FLAG_NOTE = "!: knows more than the images"
_STRATA = ("detection_rate", "false_rate", "rms_px", "rms_phi_rad", "rms_depth_relative", "efficiency_px")


# -- scores --------------------------------------------------------------------------------------------------------


def ranked_scores(documents: Sequence[ScoreDocument], by: str = "phi") -> list[ScoreDocument]:
    """Scores, the best first."""
    return sorted(documents, key=lambda document: rank_key(document, by))


def rank_key(document: ScoreDocument, by: str = "phi") -> float:
    """Rms error of phi or of D with missed spots and false detections counted; lower is better.

    Parameters
    ----------
    by : "phi" or "depth"
    """
    value = document.metrics[RANKS[by]].value
    return math.inf if value is None else value


def rank_words(by: str) -> str:
    """Name of the rank that a table goes by, with its definition."""
    what = {"phi": "phi: rms error of phi", "depth": "D: rms relative error of D"}[by]
    return f"ranked by {what}, missed spots and false detections counted"


BY_WORD = ("division", "rig")
"""Columns beside a method's name: what it was tuned on, by its author's word, and what it knows of the rig."""


def rig_known(document: ScoreDocument) -> str:
    """Knowledge that a method has of the rig: "nominal", "calibrated" or "self-calibrated".

    A calibration is "calibrated" if it was made from spots whose D was measured. One from outlines and vertical edges
    is "self-calibrated", and so is a method that corrects the rig from the pictures that it gets.
    """
    pair_set = document.pair_set
    if pair_set.get("calibration") and (pair_set.get("calibrated_from") or {}).get("spots", True):
        return "calibrated"
    return "self-calibrated" if pair_set.get("calibration") or document.method.self_calibrates else "nominal"


def division_and_rig(document: ScoreDocument) -> tuple[str, str]:
    """Cells of `BY_WORD`."""
    return document.method.division, rig_known(document)


def refusal_text(records: pl.DataFrame) -> str:
    """Reason for which a built-in method took none of the pairs, such as "takes srgb8, not bayer-raw"; "" if it did.

    Parameters
    ----------
    records : as of `records.record_table`
    """
    said = set(records.select("failure", "status").rows())
    ((failure, status),) = said if len(said) == 1 else (("", ""),)
    return status if not failure and status.startswith(REFUSED) else ""


def leaderboard(documents: Sequence[ScoreDocument], by: str = "phi", wide: bool = False) -> TextTable:
    """One row per method, the best first; `wide` adds intervals and the last columns."""
    first = documents[0]
    names = tuple(HEADS) if wide else (*_ranking_of_tracks(first), *HEADS)[:NARROW]
    rows = []
    for document in ranked_scores(documents, by):
        sees = document.method.sees
        cells = (_cell(name, document.metrics[name], wide) if applies(name, sees) else "" for name in names)
        words = division_and_rig(document) if wide else ()
        rows.append((f"{document.method.name}{FLAGGED if document.flags else ''}", *words, *cells))
    interval = f" {100 * first.rules['confidence']:g} % intervals over samples below the values." if wide else ""
    title = f"{_pairs_in_words(first)}, {rank_words(by)}"
    flagged = _FLAG_NOTE if any(document.flags for document in documents) else ""
    note = " ".join(filter(None, (frames_line(first), light_line(first), interval.strip(), flagged)))
    words, columns = (BY_WORD, "Lll") if wide else ((), "L")
    return TextTable(title, ("method", *words, *map(head, names)), tuple(rows), columns + "r" * len(names), note)


def _ranking_of_tracks(document: ScoreDocument) -> list[str]:
    """Metrics by which the tracks of a score rank; they come first in its tables."""
    return [RANKS_OF_TRACKS[track] for track in tracks_of(document.pair_set)]


def score_table(document: ScoreDocument, by: str = "phi") -> TextTable:
    """One row per metric of one method, with its interval; of a method that finds nothing, rows with values alone."""
    title = f"{document.method.name}: {_pairs_in_words(document)}, {rank_words(by)}"
    there = [name for name in HEADS if applies(name, document.method.sees)]
    order = [*_ranking_of_tracks(document), *sorted(there, key=lambda name: name != RANKS[by])]
    if not _finds(document):
        order = [name for name in order if document.metrics[name].value is not None]
    rows = ((METRICS[name].text, METRICS[name].shown[1], *_parts(name, document.metrics[name])) for name in order)
    interval = f"{100 * document.rules['confidence']:g} % interval"
    return TextTable(
        title,
        ("metric", "unit", "value", interval),
        tuple(rows),
        "LlrL",
        " ".join(filter(None, (frames_line(document), light_line(document)))),
    )


def strata_table(document: ScoreDocument, wide: bool = False) -> TextTable:
    """One row per stratum of one method."""
    rows = []
    for stratum in (document.whole, *document.strata):
        there = ((name, stratum.metrics.get(name)) for name in _STRATA)
        cells = ("" if value is None else _in_stratum(name, value, wide) for name, value in there)
        rows.append((stratum.by, stratum.label, str(stratum.images), *cells))
    note = f"*: fewer than {document.rules['least_samples']:g} samples, no interval"
    heads = ("by", "stratum", "images", *map(head, _STRATA))
    return TextTable(f"{document.method.name}: strata", heads, tuple(rows), "ll" + "r" * (1 + len(_STRATA)), note)


def _in_stratum(name: str, value: Value, wide: bool) -> str:
    shown, interval = shown_parts(name, value)
    return starred_value((shown, interval if wide or interval.startswith("(") else ""))


def cause_table(documents: Sequence[ScoreDocument]) -> TextTable:
    """Images without a right position: of one method by cause, of several one row per method."""
    title = "Images without a right position"
    kinds = tuple(KINDS.values())
    if len(documents) > 1:
        rows = tuple((d.method.name, *_kind_totals(d), ", ".join(_most_frequent(d))) for d in documents)
        return TextTable(title, ("method", *kinds, "most frequent causes"), rows, "LrrrL")
    (document,) = documents
    counts = ((cause, document.causes[cause]) for cause in CAUSES)
    rows = tuple((cause, *(str(kind[k]) for k in KINDS), CAUSES[cause]) for cause, kind in counts if any(kind.values()))
    return TextTable(title, ("cause", *kinds, "definition"), rows, "lrrrL")


def _kind_totals(document: ScoreDocument) -> Iterator[str]:
    return (str(sum(kinds[kind] for kinds in document.causes.values())) for kind in KINDS)


def _most_frequent(document: ScoreDocument, count: int = 3) -> list[str]:
    wrong = Counter({cause: kinds["missed"] + kinds["false"] for cause, kinds in document.causes.items()})
    names = {"method": "the method's own"}  # it stands in a column of methods
    return [f"{names.get(cause, cause)} {number}" for cause, number in wrong.most_common(count) if number]


def _finds(document: ScoreDocument) -> bool:
    """Tell whether a method has found a spot, so that there are errors to show."""
    return bool(document.metrics["detection_rate"].value)


def _pairs_in_words(document: ScoreDocument) -> str:
    """Say how many pairs there were, such as "5 pairs mjpeg, 4 with search boxes"."""
    presets, boxes = ", ".join(document.pair_set.get("presets", ())), document.pair_set.get("hinted")
    pairs = " ".join(filter(None, (f"{document.pairs} pair{'s' * (document.pairs != 1)}", presets)))
    return f"{pairs}, {boxes} with search boxes" if boxes else pairs


def frames_line(document: ScoreDocument) -> str:
    """Sentences on how the frames of a score were taken; "" where nobody knows."""
    shown = {
        "exposure_s": ("exposure", 1e3, "ms"),
        "analogue_gain": ("gain", 1.0, ""),
        "jpeg_quality": ("JPEG quality", 1.0, ""),
        "laser_level": ("laser", 1.0, ""),
        "lamp_level": ("lamps", 1.0, ""),
    }
    there = {name: spread for name in shown if (spread := document.frames.get(name)) is not None}
    words = {name: f"{shown[name][0]} {spread.text(*shown[name][1:])}" for name, spread in there.items()}
    levels = [words.pop(name) for name in ("laser_level", "lamp_level") if name in words]
    draws = f"{document.draws} noise draw{'s' * (document.draws != 1)}"
    return (
        f"Frames: {', '.join(words.values())}. Light: {', '.join([*levels, draws])}." if "exposure_s" in there else ""
    )


def light_line(document: ScoreDocument) -> str:
    """Sentences on how far the light, to which a score refers, lies from the beam's axis; "" where nobody knows."""
    shift, depth = (document.light.get(name) for name in ("shift_px", "depth_m"))
    if shift is None:
        return ""
    text = f"Scores refer to the centre of the light. It is {_median_and_most(shift)} mpx at most from the beam's axis."
    return text if depth is None else f"{text} D of the two differs by {_median_and_most(depth)} mm at most."


def _median_and_most(spread: PairRange) -> str:
    """Median and largest value of a spread, in thousandths, two digits."""
    median, most = (f"{float(f'{1e3 * x:.2g}'):g}" for x in (spread.median, spread.high))
    return f"{median} (median) and {most}"


# -- lines beside the tables ---------------------------------------------------------------------------------------


def false_line(records: pl.DataFrame, boxed: bool = False) -> str:
    """Sentence on what the false answers are, with advice; "" unless a fifth of the answers are false.

    Parameters
    ----------
    records : with causes
    boxed : every spot has a box around it, so that the search cannot be narrowed
    """
    answers = records.filter(pl.col("u_px").is_not_null())
    false = answers.filter("false_detection")
    if not len(false) or len(false) < FULL_OF_FALSE * len(answers):
        return ""  # too few false answers to say what they are
    kinds = Counter(false["taken_for"].to_list())
    ((kind, number),) = Counter(kind.removesuffix(NOISE) for kind in kinds.elements()).most_common(1)
    # one place may look like either; a method subtracts the laser-off image everywhere or nowhere
    bright = ("lamp", "region")
    subtracts = sum(kinds[cause + NOISE] for cause in bright) > sum(kinds[cause] for cause in bright)
    what, advice = TAKEN_FOR[kind + NOISE if kind in bright and subtracts else kind]
    narrower = "" if boxed else "; --track localise narrows the search"
    return f"{100 * number / len(answers):.0f} % of the answers are {what}: {advice}{narrower}"


def failure_line(records: pl.DataFrame) -> str:
    """Sentence on a method that failed on every pair, with its most frequent failure; "" where an answer came back.

    Parameters
    ----------
    records : as of `records.record_table`
    """
    asked = records.filter(pl.col("image") == "down")
    said = Counter(asked.select("failure", "message").rows())
    if not said or any(failure == "" for failure, _ in said):
        return ""  # some pairs were answered
    ((failure, message), number) = min(said.items(), key=lambda item: (-item[1], item[0]))
    often = "for example" if number == 1 else "each time" if number == len(asked) else f"{number} times"
    pairs = "the only pair" if len(asked) == 1 else f"all {len(asked)} pairs, {often}"
    first = asked.filter(failure=failure, message=message).row(0, named=True)
    return f"failed on {pairs} with {': '.join(filter(None, (failure, message)))}; {pair_in_words(first)}"


def nothing_answered(scored: Sequence[HasScore]) -> bool:
    """True if some method failed on every pair, or all methods refuse the pairs."""
    return any(failure_line(one.records) for one in scored) or all(refusal_text(one.records) for one in scored)


def pair_in_words(row: Mapping[str, Any]) -> str:
    """Name of a pair: `dataset.pairs(preset).number_of` takes these words."""
    return f"first pair: sample {row['sample_id']}, draw {row['draw']}, {row['preset']}"


def _printed(one: HasScore) -> list[str]:
    """Last lines that the method printed before it first failed; empty if there are none."""
    return [f"printed for the first pair that failed:\n{one.output}"] if one.output else []


def silences(records: pl.DataFrame, count: int = 3) -> list[str]:
    """Most frequent messages of a method or of its process for images without a position, one line each."""
    words = pl.when(pl.col("message") != "").then(pl.col("failure") + ": " + pl.col("message"))
    said = records.filter(pl.col("u_px").is_null()).with_columns(words=words.otherwise(pl.col("status")))
    most = said.group_by("words").len().sort("len", "words", descending=[True, False]).head(count)
    return [
        f"{number} of {len(records)} images without a position: {text}; "
        f"{pair_in_words(said.filter(words=text).row(0, named=True))}"
        for text, number in most.rows()
    ]


def depth_line(document: ScoreDocument) -> str:
    """Pull and coverage of D, the calibration's part included."""
    pull, within = (document.metrics[name].estimate for name in ("pull_depth", "coverage_depth"))
    share = one_line(within, 100.0, 1)
    return f"{document.method.name}: pull of D {one_line(pull, 1.0, 3)}; within 1.96 sigma of D {share} %, 95 is right"


# -- output --------------------------------------------------------------------------------------------------------


class HasScore(Protocol):
    """A score with its records, as `score.Scored`."""

    @property
    def document(self) -> ScoreDocument:
        """The score."""

    @property
    def output(self) -> str:
        """Last lines that the method printed before it first failed."""

    @property
    def records(self) -> pl.DataFrame:
        """One row per image."""


def print_scores(scored: Sequence[HasScore], form: str, by: str, wide: bool, calibrated: bool = False) -> None:
    """Print scores of methods on the same pairs.

    Parameters
    ----------
    scored : sequence of HasScore
    form : one of the `Form`s
        "terminal" has further tables and lines; the others are one table, or one JSON object a line.
    by : "phi" or "depth"
    wide : bool
        Show every interval.
    calibrated : bool
        Say how well the predicted error of D holds.
    """
    refusals = {id(each): f"not compared: it {why}" for each in scored if (why := refusal_text(each.records))}
    every = [each.document for each in scored]
    documents = [each.document for each in scored if id(each) not in refusals] or every
    board = leaderboard(documents, by, wide)
    if form != "terminal":
        table = {"markdown": markdown, "latex": latex}
        whole = {"csv": scores_csv, "json": scores_json}
        sys.stdout.write(table[form](board) if form in table else whole[form](every, by))
        return
    console = table_console(wide)
    show_grid(console, board if wide or len(documents) > 1 else score_table(documents[0], by))
    failed = {id(each): line for each in scored if (line := failure_line(each.records))}
    failed |= refusals
    for each in scored:
        for line in method_lines(each):
            _line(console, line)
    missing = any(any(kind.values()) for document in documents for kind in document.causes.values())
    if missing and (len(scored) > 1 or not failed):
        show_grid(console, cause_table(documents))
    for each in scored:
        said = [] if id(each) in failed else silences(each.records)
        lines = [*([depth_line(each.document)] if calibrated and _finds(each.document) else []), *said, *_printed(each)]
        lines += [each.document.isolation] if each.document.isolation.startswith("not isolated") else []
        for line in lines:
            _line(console, f"{each.document.method.name}: {line}")
    if len(documents) == 1 and _finds(documents[0]):
        show_grid(console, strata_table(documents[0], wide))


def method_lines(one: HasScore) -> list[str]:
    """Sentences on a method: it failed or refused every pair, it knows too much, what its false answers are."""
    why = refusal_text(one.records)
    failure = f"not compared: it {why}" if why else failure_line(one.records)
    told = filter(None, (failure, *(flag.text for flag in one.document.flags), _false_line(one)))
    return [f"{one.document.method.name}: {line}" for line in told]


def _false_line(one: HasScore) -> str:
    return false_line(one.records, "localise" in tracks_of(one.document.pair_set))


def _line(console: Console, text: str) -> None:
    console.print(text, emoji=False, highlight=False, markup=False)


def scores_csv(documents: Sequence[ScoreDocument], by: str = "phi") -> str:
    """One row per method: every metric with its interval, in the units of the files, in full."""
    ends = {name: ("", "_low", "_high", *(("_share",) if METRICS[name].family in CHOSEN else ())) for name in METRICS}
    names = [f"{name}{end}" for name in METRICS for end in ends[name]]
    rows = []
    for document in ranked_scores(documents, by):
        values = ((document.metrics[name], len(ends[name])) for name in METRICS)
        numbers = [
            x for estimate, n in values for x in (estimate.value, estimate.low, estimate.high, estimate.share)[:n]
        ]
        flags = ", ".join(flag.quantity for flag in document.flags)
        counts = document.pairs, document.images, document.samples
        rows.append([document.method.name, *division_and_rig(document), *counts, flags, *numbers])
    return csv_table(["method", *BY_WORD, "pairs", "images", "samples", "knows_more", *names], rows)


def scores_json(documents: Sequence[ScoreDocument], by: str = "phi") -> str:
    """One JSON object a line: a score without its pictures."""
    bare = (d.model_copy(update={"worst": []}) for d in ranked_scores(documents, by))
    return "".join(json.dumps(d.model_dump(mode="json"), allow_nan=False) + "\n" for d in bare)


# -- numbers -------------------------------------------------------------------------------------------------------


def head(name: str) -> str:
    """Head of a metric's column, its unit on the second line."""
    if name in _TRACK_HEADS:
        return _TRACK_HEADS[name]
    unit = METRICS[name].shown[1]
    text = "pull of D" if name == "pull_depth" else HEADS.get(name, METRICS[name].text)
    return text if unit == "1" else f"{text}\n{unit}"


def shown_parts(name: str, value: Value) -> tuple[str, str]:
    """Value and interval of a metric in the unit of tables; an efficiency with the share of spots that it rests on."""
    shown, interval = cell_parts(value.estimate, METRICS[name].shown[0], DIGITS, significant=True)
    if METRICS[name].kind != "efficiency" or value.value is None or value.share is None:
        return shown, interval
    return f"{shown} of {100.0 * value.share:.0f} %", interval


def _parts(name: str, value: Value) -> tuple[str, str]:
    shown, interval = shown_parts(name, value)
    return shown, interval or value.note


def _cell(name: str, value: Value, wide: bool) -> str:
    shown, interval = shown_parts(name, value)
    return f"{shown}\n{interval}" if wide and interval else shown


def starred_value(parts: tuple[str, str]) -> str:
    """Value and interval on one line, with a star in place of the reason why there is none."""
    value, interval = parts
    return f"{value} *" if interval.startswith("(") else f"{value} {interval}".strip()


def one_line(estimate: Estimate, factor: float = 1.0, digits: int = 3) -> str:
    """Value and interval on one line."""
    return " ".join(word for word in cell_parts(estimate, factor, digits) if word)


_NOTHING = 1e-9  # of an interval's upper end: quantiles of few samples come as 1e-50 for 0


def cell_parts(estimate: Estimate, factor: float, digits: int, significant: bool = False) -> tuple[str, str]:
    """Value and interval, or value and why there is none; "-" alone where there is no value."""
    if not math.isfinite(estimate.value):
        return "-", ""
    value = number(factor * estimate.value, digits, significant)
    if not math.isfinite(estimate.low):
        return value, f"({estimate.note})" if estimate.note else ""
    least = estimate.low if abs(estimate.low) > _NOTHING * abs(estimate.high) else 0.0
    low, high = (number(factor * x, digits, significant) for x in (least, estimate.high))
    return value, f"[{low}, {high}]"


def number(value: float, digits: int, significant: bool = False) -> str:
    """A number, "-" where there is none; one below its last digit as a power of ten, not as 0."""
    if not math.isfinite(value):
        return "-"
    if significant or 0.0 < abs(value) < 0.5 * 10.0**-digits:
        if abs(value) >= 10.0**digits:
            return f"{value:.0f}"
        return f"{value:.{max(digits - 1, 0)}e}" if 0.0 < abs(value) < 1e-3 else f"{value:.{digits}g}"
    return f"{value:.{digits}f}"
