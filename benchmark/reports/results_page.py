"""Results of many methods on the presets of a data set: a page in Markdown, a page in HTML, and a JSON document.

All three come from score files alone, and the same files give the same bytes. Scores of the same pairs make one part,
usually one preset. Each part has the ranking with intervals, the paired differences against one method, strata and
causes. Differences and their verdicts are those of `compare`.
"""

from __future__ import annotations

import json
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import polars as pl

from phibench.benchmark.reports.report_page import report_html
from phibench.benchmark.reports.report_sections import Section, tracks_section
from phibench.benchmark.reports.track_tables import track_tables
from phibench.benchmark.scores.answer_errors import Rules
from phibench.benchmark.scores.compare import (
    Difference,
    compare_records,
    differences_json,
    note_on_code,
    note_on_others,
    same_pairs,
)
from phibench.benchmark.scores.metrics import METRICS, applies
from phibench.benchmark.scores.score_document import ScoreDocument, StratumScore
from phibench.benchmark.scores.score_files import read_records, read_score
from phibench.benchmark.scores.score_tables import (
    BY_WORD,
    DIGITS,
    FLAGGED,
    cause_table,
    cell_parts,
    division_and_rig,
    frames_line,
    head,
    light_line,
    ranked_scores,
    refusal_text,
    shown_parts,
    starred_value,
)
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.shown_text import TextTable, markdown, markdown_cell, markdown_text, table_lines
from phibench.datasets.store.files import write_text

AGAINST = "chain_fit"
_BOARD = ("rank_phi_rad", "rank_depth", "detection_rate", "false_rate")
_ERRORS = ("median_px", "rms_px", "median_depth_relative", "rms_depth_relative")
_CLAIMS = ("efficiency_px", "efficiency_pair_px", "pull_deviation", "beyond_5_sigma", "coverage_depth")
_DIFFERENCES = ("rank_phi_rad", "rank_depth", "detection_rate", "median_px", "rms_px")
_STRATA = ("spot", "signal", "depth", "stroke", "hint", "quality")
_SHOWN = 4
"""Methods whose strata are shown: the best ones, and the one that the others are compared with."""
_HEADS = {"median_px": "median", "median_depth_relative": "median D", "coverage_depth": "coverage of D"}  # short ones


@dataclass(frozen=True)
class ScoreGroup:
    """Scores of the same pairs, the best first, and their differences against one of them.

    Attributes
    ----------
    scores : tuple of ScoreDocument
    against : str
        Name of the method that the others are compared with.
    differences : dict of method to its differences
    notes : tuple of str
        What a reader of the numbers has to know.
    """

    title: str
    scores: tuple[ScoreDocument, ...]
    against: str
    differences: Mapping[str, Sequence[Difference]]
    notes: tuple[str, ...]


def read_parts(files: Sequence[Path], against: str = AGAINST, by: str = "phi", seed: int = 0) -> list[ScoreGroup]:
    """Scores on disk by what they were taken on, in the order in which these come.

    Parameters
    ----------
    files : JSON files of `score --out`, their Parquet files beside them
    against : name of a method; where a part has none of it, its best
    by : "phi" or "depth", for the rank
    seed : of the bootstrap of differences

    Raises
    ------
    DatasetError
        If there is no score, one cannot be read, or a method has two scores of the same pairs.
    """
    if not files:
        raise DatasetError("results of nothing: give the JSON files that `phibench score --out` wrote")
    groups: dict[str, list[tuple[ScoreDocument, pl.DataFrame]]] = {}
    for path in files:
        document = read_score(path)
        key = json.dumps([same_pairs(document), document.pairs, document.rules], sort_keys=True)
        group = groups.setdefault(key, [])
        if any(other.method.name == document.method.name for other, _ in group):
            raise DatasetError(f"{path}: {document.method.name} has another score of the same pairs; give one of them")
        group.append((document, read_records(path, document)))
    every = [document for group in groups.values() for document, _ in group]
    return [_part(group, every, against, by, seed) for group in groups.values()]


def _part(
    group: Sequence[tuple[ScoreDocument, pl.DataFrame]],
    every: Sequence[ScoreDocument],
    against: str,
    by: str,
    seed: int,
) -> ScoreGroup:
    tables = {document.method.name: table for document, table in group}
    refusals = {name: why for name, table in tables.items() if (why := refusal_text(table))}
    documents = [document for document, _ in group]
    order = ranked_scores([one for one in documents if one.method.name not in refusals] or documents, by)
    base = next((one for one in order if one.method.name == against), order[0])
    name = base.method.name
    rules = Rules()
    differences = {
        one.method.name: compare_records(tables[name], tables[one.method.name], rules, "compare", seed)
        for one in order
        if one is not base
    }
    notes = [f"{one.method.name}: {flag.text}" for one in order for flag in one.flags]
    notes += [f"{one.method.name}: {text}" for one in order if (text := note_on_code(base, one))]
    notes += [f"{name} is not compared: it {why}" for name, why in refusals.items()]
    title = ", ".join(base.pair_set.get("presets", ())) or "pairs"
    if apart := note_on_others(order, every):
        notes, title = [apart, *notes], f"{title}, {base.pairs} pairs"
    return ScoreGroup(title, tuple(order), name, differences, tuple(notes))


# -- tables ------------------------------------------------------------------------------------------------------------


def grids(part: ScoreGroup) -> list[TextTable]:
    """Tables of a part: ranking, errors, claims, differences, strata, causes."""
    causes = cause_table(part.scores)
    if len(part.scores) == 1:
        causes = TextTable(causes.title, causes.heads[:-1], tuple(row[:-1] for row in causes.rows), causes.columns[:-1])
    made = [
        _board(part, "Ranking", _BOARD),
        _board(part, "Errors of found spots and depths", _ERRORS),
        _board(part, "Efficiency and claims", _CLAIMS),
    ]
    return [*made, *([_differences(part)] if part.differences else []), _strata(part), causes]


def _head(name: str) -> str:
    text, _, unit = head(name).partition("\n")
    return " / ".join(filter(None, (_HEADS.get(name, text), unit)))


def _board(part: ScoreGroup, title: str, names: Sequence[str]) -> TextTable:
    rows = []
    for score in part.scores:
        cells = (
            starred_value(shown_parts(m, score.metrics[m])) if applies(m, score.method.sees) else "" for m in names
        )
        words = division_and_rig(score) if names is _BOARD else ()
        rows.append((f"{score.method.name}{FLAGGED if score.flags else ''}", *words, *cells))
    heads, columns = (BY_WORD, "lll") if names is _BOARD else ((), "l")
    note = " ".join(filter(None, (frames_line(part.scores[0]), light_line(part.scores[0]))))
    return TextTable(title, ("method", *heads, *map(_head, names)), tuple(rows), columns + "r" * len(names), note)


def _differences(part: ScoreGroup) -> TextTable:
    rows = []
    for name, found in part.differences.items():
        by_name = {difference.name: difference for difference in found}
        cells = (_change(by_name[metric]) for metric in _DIFFERENCES)
        rows.append((name, *cells))
    heads = ("method", *map(_head, _DIFFERENCES))
    return TextTable(f"Method minus {part.against}", heads, tuple(rows), "l" + "r" * len(_DIFFERENCES))


_SIGNS = {"second": " **", "first": " **", "no difference shown": "", "too few samples": ""}


def _change(one: Difference) -> str:
    factor = METRICS[one.name].shown[0]
    return starred_value(cell_parts(one.difference, factor, DIGITS, significant=True)) + _SIGNS[one.better]


def _strata(part: ScoreGroup) -> TextTable:
    """Found spots and their median error in each stratum; of one method per column."""
    order = [score for score in part.scores if score.method.name != part.against]
    base = next(score for score in part.scores if score.method.name == part.against)
    shown = [*order[: _SHOWN - 1], base]
    rows = []
    for stratum in base.strata:
        if stratum.by in _STRATA:
            cells = (_in_stratum(score, stratum) for score in shown)
            rows.append((stratum.by, stratum.label, str(stratum.images), *cells))
    heads = ("by", "stratum", "images", *(score.method.name for score in shown))
    return TextTable("Found / %; median error / px", heads, tuple(rows), "llr" + "r" * len(shown))


def _in_stratum(one: ScoreDocument, wanted: StratumScore) -> str:
    for stratum in one.strata:
        if (stratum.by, stratum.label) == (wanted.by, wanted.label):
            shown, _ = shown_parts("detection_rate", stratum.metrics["detection_rate"])
            median = stratum.metrics["median_px"].estimate
            return f"{shown}; {starred_value(cell_parts(median, METRICS['median_px'].shown[0], 2, significant=True))}"
    return ""


# -- pages -------------------------------------------------------------------------------------------------------------

_INTRODUCTION = """# Results

`phibench results` writes this page from score files. Do not edit it by hand.
[Scoring](scoring.md) defines every number; [how to add a result](submission.md) is a page of its own.
"""
_LEGEND = """Values have 95 % intervals over samples in brackets. A star: too few samples for an interval.
A blank: the metric is not that method's. A dash: nothing to compute it from.

| table | what it shows |
|---|---|
| Ranking | rms errors with missed spots and false detections counted, the best rank of {quantity} first; found, false |
| Errors of found spots and depths | each method over what it has found itself: who finds less has easier spots |
| the same: division, rig | what a method was tuned on and what it knows of the rig ([rules](submission.md#divisions)) |
| Efficiency and claims | rms at the bound over rms; deviation of pulls, 1 is right; coverage of D, 95 is right |
| the same: beyond 5 sigma | share of claims off by more than 5 sigma, 0 is right; pulls leave out errors of 3 px |
| Method minus | paired differences on the same samples; two stars: shown by an exact test, Holm over 16 metrics |
| Found; median error | strata, of the best methods and of the one that is compared with |
| Images without a right position | counts by kind, and their most frequent causes |
"""


def results_page(parts: Sequence[ScoreGroup], by: str = "phi") -> str:
    """The page in Markdown."""
    text = [_INTRODUCTION, _LEGEND.format(quantity={"phi": "phi", "depth": "D"}[by])]
    text.append("## What was scored\n\n" + "\n".join(_sources(parts)) + "\n")
    if tables := track_tables(_every(parts)):
        text.append("## Tracks\n")
        text += [_titled(table) for table in tables]
    for part in parts:
        text.append(f"## {markdown_text(part.title)}\n")
        text += [_titled(grid) for grid in grids(part)]
        text += ["".join(f"{_item(note)}\n" for note in part.notes)] * bool(part.notes)
    return "\n".join(text)


def _every(parts: Sequence[ScoreGroup]) -> list[ScoreDocument]:
    return [score for part in parts for score in part.scores]


def _titled(grid: TextTable) -> str:
    """Table in Markdown below its title in bold."""
    _, _, rest = markdown(grid).partition("\n\n")
    lines = [line if line.startswith("|") else textwrap.fill(line, 120) for line in rest.split("\n")]
    return "\n".join([f"**{markdown_text(grid.title)}**", "", *lines])


def _item(note: str) -> str:
    """Item of a list, a sentence in lines of at most 120 characters."""
    text = markdown_text(note if note.endswith(".") else f"{note}.")
    return textwrap.fill(f"* {text}", 120, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)


_SOURCE_HEADS = ("preset", "data set", "pairs", "samples", "task", "hash of the data set", "scored by")


def _sources(parts: Sequence[ScoreGroup]) -> list[str]:
    return table_lines(_SOURCE_HEADS, [tuple(map(markdown_cell, row)) for row in _source_rows(parts)])


def results_html(parts: Sequence[ScoreGroup], by: str = "phi") -> str:
    """The page in HTML: one file, nothing fetched, no script."""
    intro = (
        "Values have 95 % intervals over samples in brackets. A star: too few samples for an interval.",
        "Two stars in a paired difference: shown by the test, corrected for 16 metrics.",
        f"Methods are ordered by the rank of {by if by == 'phi' else 'D'}.",
    )
    sections = [Section("What was scored", intro, (), ((_SOURCE_HEADS, *_source_rows(parts)),), ("",))]
    sections += [section] if (section := tracks_section(_every(parts))) else []
    for part in parts:
        made = grids(part)
        tables = tuple((grid.heads, *grid.rows) for grid in made)
        sections.append(Section(part.title, part.notes, (), tables, tuple(grid.title for grid in made)))
    return report_html([], sections, by, title="phibench results")


def _source_rows(parts: Sequence[ScoreGroup]) -> Iterator[tuple[str, ...]]:
    for part in parts:
        first = part.scores[0]
        programs = told_programs({score.program or "not told" for score in part.scores})
        digest = str(first.pair_set.get("dataset_sha256"))[:12]
        cells = (part.title, first.pair_set.get("name"), first.pairs, first.samples, first.pair_set.get("task_version"))
        yield (*map(str, cells), digest, programs)


def told_programs(programs: Iterable[str]) -> str:
    """Programs of scores, the commits of one version together."""
    commits: dict[str, list[str]] = {}
    for program in sorted(programs):
        version, _, commit = program.partition(" (commit ")
        commits.setdefault(version, []).extend(filter(None, [commit.removesuffix(")")]))
    return ", ".join(f"{version} (commit {', '.join(some)})" if some else version for version, some in commits.items())


def results_document(parts: Sequence[ScoreGroup]) -> dict[str, Any]:
    """JSON document: per part the scores without pictures and the paired differences, SI units in full."""
    return {
        "kind": "phibench results",
        "version": 1,
        "parts": [
            {
                "title": part.title,
                "against": part.against,
                "scores": [score.model_copy(update={"worst": []}).model_dump(mode="json") for score in part.scores],
                "differences": {name: json.loads(differences_json(found)) for name, found in part.differences.items()},
                "notes": list(part.notes),
            }
            for part in parts
        ],
    }


def write_results(parts: Sequence[ScoreGroup], out: Path | None, html: Path | None, by: str = "phi") -> list[Path]:
    """Write the pages that are wanted; their paths."""
    made = ((out, results_page), (html, results_html))
    return [write_text(path, page(parts, by)) for path, page in made if path is not None]
