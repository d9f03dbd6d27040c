"""Report on scores as one HTML page: ranking, verdict, figures, sections that others add; nothing fetched, no script.

The template is `report.html.j2`. Scores of the same pairs by the same rules make one ranking, in the units of
`score_tables`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import polars as pl
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from phibench.benchmark.pair_sets.dataset_pairs import tracks_of
from phibench.benchmark.reports.figures import (
    EmbeddedFigure,
    cause_bars,
    error_maps,
    error_panels,
    has_open_marks,
    method_keys,
    pull_histogram,
    radius_panels,
)
from phibench.benchmark.reports.report_sections import Section, tracks_section
from phibench.benchmark.scores.compare import note_on_others, same_pairs
from phibench.benchmark.scores.failure_causes import CAUSES, KINDS
from phibench.benchmark.scores.metrics import METRICS, RANKS, applies
from phibench.benchmark.scores.score_document import ScoreDocument
from phibench.benchmark.scores.score_files import read_records, read_score
from phibench.benchmark.scores.score_tables import (
    BY_WORD,
    FULL_OF_FALSE,
    HEADS,
    RANKS_OF_TRACKS,
    division_and_rig,
    failure_line,
    false_line,
    frames_line,
    head,
    light_line,
    rank_key,
    rank_words,
    refusal_text,
    shown_parts,
)
from phibench.benchmark.scores.worst_images import EncodedPicture
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.store.files import write_text

_TEMPLATE = "report.html.j2"
_STRATA = (
    "detection_rate",
    "false_rate",
    "rms_px",
    "median_px",
    "p95_px",
    "rms_phi_rad",
    "rms_depth_relative",
    "efficiency_px",
    "efficiency_pair_px",
    "pull_deviation",
    "beyond_5_sigma",
)
_LEAST_FOUND = 0.5
"""Share of found spots below which a method is said to fail."""


@dataclass(frozen=True)
class Ranking:
    """Scores that were taken on the same pairs, the best first, with all that is shown of them.

    Attributes
    ----------
    verdict : str
        Which method is best, and what fails.
    frames : dict of str to EncodedPicture
        Whole frames by key; several methods may fail on the same one.
    frame_of : dict
        (method, place among its worst) to the key of its frame.
    false_lines : dict of str to str
        What the false detections of a method are, where it has many.
    apart : str
        Sentence on scores that count another number of pairs; empty where there are none.
    """

    title: str
    verdict: str
    pair_set: Mapping[str, object]
    scores: Mapping[str, ScoreDocument]
    keys: Mapping[str, EmbeddedFigure]
    curves: Sequence[EmbeddedFigure]
    maps: Mapping[str, EmbeddedFigure]
    by_radius: Sequence[EmbeddedFigure]
    causes: EmbeddedFigure
    pulls: EmbeddedFigure | None
    frames: Mapping[str, EncodedPicture]
    frame_of: Mapping[tuple[str, int], str]
    false_lines: Mapping[str, str]
    apart: str

    @property
    def placed(self) -> bool:
        """True where the places of the spots are known; of real pairs nobody has measured them."""
        return any(score.metrics["rms_counted_px"].value is not None for score in self.scores.values())

    @property
    def has_open_marks(self) -> bool:
        """True where a curve has a point without an interval."""
        return any(has_open_marks(score) for score in self.scores.values())

    @property
    def board(self) -> list[str]:
        """Metrics of the ranking; without places those that have a value, and the pull of D."""
        return self._valued([*HEADS, "pull_depth"]) if not self.placed else list(HEADS)

    @property
    def strata_metrics(self) -> list[str]:
        """Metrics of the strata; without places those that have a value."""
        return self._valued(_STRATA) if not self.placed else list(_STRATA)

    @property
    def claiming(self) -> dict[str, ScoreDocument]:
        """Scores of methods that claim a covariance."""
        return {name: one for name, one in self.scores.items() if one.metrics["beyond_5_sigma"].value is not None}

    def _valued(self, names: Sequence[str]) -> list[str]:
        return [name for name in names if any(score.metrics[name].value is not None for score in self.scores.values())]

    @property
    def occurring(self) -> list[str]:
        """Causes that some method has an image of, in the order in which they are tried."""
        return [cause for cause in CAUSES if any(any(s.causes[cause].values()) for s in self.scores.values())]


def write_report(files: Sequence[Path], out: Path, sections: Sequence[Section] = (), by: str = "phi") -> Path:
    """Write a report about scores on disk.

    Parameters
    ----------
    files : JSON files of `score --method`, their Parquet files beside them
    out : HTML file
    sections : further sections after the scores
    by : "phi" or "depth", for the rank

    Raises
    ------
    DatasetError
        If there is neither a score nor a section, or a file is no score or lacks its records.
    """
    if not (files or sections):
        raise DatasetError(
            "a report of nothing: give at least one JSON file that `score --method --out` wrote, or the folder of a "
            "study (--study)"
        )
    read = [(path, read_score(path)) for path in files]
    return write_text(
        out, report_html([(document, read_records(path, document)) for path, document in read], sections, by)
    )


def report_html(
    scores: Sequence[tuple[ScoreDocument, pl.DataFrame]],
    sections: Sequence[Section] = (),
    by: str = "phi",
    title: str = "phibench report",
) -> str:
    """The page as text; the same scores give the same text."""
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
        lstrip_blocks=True,
    )  # fmt: skip
    environment.globals.update(
        applies=applies,
        head=head,
        division_and_rig=division_and_rig,
        by_word=BY_WORD,
        frames_line=frames_line,
        light_line=light_line,
        parts=shown_parts,
        ranked_by=rank_words(by),
        definitions=CAUSES,
        kinds=KINDS,
    )
    environment.filters["json"] = lambda value: json.dumps(value, indent=1)
    every = [document for document, _ in scores]
    rankings = [_ranking(number, group, every, by) for number, group in enumerate(_groups(scores), 1)]
    front = [section] if (section := tracks_section(every)) else []
    return environment.get_template(_TEMPLATE).render(rankings=rankings, front=front, sections=sections, title=title)


def _groups(scores: Sequence[tuple[ScoreDocument, pl.DataFrame]]) -> list[list[tuple[ScoreDocument, pl.DataFrame]]]:
    """Scores by what they were taken on and by which rules."""
    groups: dict[str, list[tuple[ScoreDocument, pl.DataFrame]]] = {}
    for document, table in scores:
        key = json.dumps([same_pairs(document), document.pairs, document.rules], sort_keys=True)
        groups.setdefault(key, []).append((document, table))
    return list(groups.values())


def _ranking(
    number: int, group: list[tuple[ScoreDocument, pl.DataFrame]], every: Sequence[ScoreDocument], by: str
) -> Ranking:
    refusals = {document.method.name: why for document, table in group if (why := refusal_text(table))}
    left_out = [f"{name} is not compared: it {why}." for name, why in refusals.items()]
    compared = [item for item in group if item[0].method.name not in refusals] or group
    failed = [f"{document.method.name} {line}." for document, table in compared if (line := failure_line(table))]
    order = sorted(compared, key=lambda item: rank_key(item[0], by))
    names = _distinct([document.method.name for document, _ in order])
    scores = {name: document for name, (document, _) in zip(names, order, strict=True)}
    tables = {name: table for name, (_, table) in zip(names, order, strict=True)}
    pair_set = order[0][0].pair_set
    presets: Any = pair_set.get("presets", ())
    apart = note_on_others([document for document, _ in order], every)
    counted = (f"{order[0][0].pairs} pairs",) if apart else ()
    title = ", ".join([str(pair_set.get("name", "unnamed")), *presets, *counted])
    frames, frame_of = _frames(number, scores)
    return Ranking(
        title=title,
        verdict=" ".join([report_verdict(scores, by), *left_out, *failed]),
        pair_set=pair_set,
        scores=scores,
        keys=method_keys(names),
        curves=error_panels(scores),
        maps=error_maps(tables),
        by_radius=radius_panels(tables),
        causes=cause_bars(scores),
        pulls=pull_histogram(tables),
        frames=frames,
        frame_of=frame_of,
        false_lines={
            name: line
            for name, table in tables.items()
            if (line := false_line(table, "localise" in tracks_of(scores[name].pair_set)))
        },
        apart=apart,
    )


def report_verdict(scores: Mapping[str, ScoreDocument], by: str) -> str:
    """Sentences on which method is best and what fails.

    Parameters
    ----------
    scores : by name, the best first
    by : "phi" or "depth"
    """
    best, first = next(iter(scores.items()))
    metric, quantity = RANKS[by], {"phi": "phi", "depth": "D"}[by]
    if first.metrics[metric].value is None:
        return "No method has a rank on these pairs."
    if not any(_rate(score, "detection_rate") for score in scores.values()):
        return "No method finds a spot on these pairs."
    number, interval = shown_parts(metric, first.metrics[metric])
    rate = _rate(first, "detection_rate")
    missing = {name: kind["missed"] + kind["false"] for name, kind in first.causes.items()}
    cause = max(missing, key=lambda name: missing[name])
    placed = first.metrics["rms_counted_px"].value is not None  # of real pairs no cause can be told
    why = f", most of the others are missed {_because(cause)}" if missing[cause] and placed else ""
    alone = "is best by" if len(scores) > 1 else "has, by the rank of"
    parts = [f"{best}: {flag.text}." for flag in first.flags]
    parts += _first_of_tracks(scores)
    parts += [
        f"{best} {alone} {quantity}: {number} {METRICS[metric].shown[1]} {interval}; "
        f"it finds {100 * rate:.3g} % of the spots{why}."
    ]
    blind = [name for name, score in scores.items() if _rate(score, "detection_rate") < _LEAST_FOUND]
    wrong = [name for name, score in scores.items() if _rate(score, "false_rate") >= FULL_OF_FALSE]
    if blind:
        parts.append(f"Less than half of the spots: {_listed(blind)}.")
    if wrong:
        parts.append(f"False detections in {100 * FULL_OF_FALSE:g} % of the images or more: {_listed(wrong)}.")
    return " ".join(parts if blind or wrong else [*parts, "No method finds less than half."])


def _first_of_tracks(scores: Mapping[str, ScoreDocument]) -> list[str]:
    """A sentence for each track of some scores: who is first, with the track's number."""
    told = []
    for track in tracks_of(next(iter(scores.values())).pair_set):
        name = RANKS_OF_TRACKS[track]
        values = {method: score.metrics[name].value for method, score in scores.items()}
        known = {method: value for method, value in values.items() if value is not None}
        if known:
            best = (min if METRICS[name].better == "lower" else max)(known.values())
            first = [method for method, value in known.items() if value == best]
            told.append(
                f"Track {track}: {_listed(first)}, {' '.join(shown_parts(name, scores[first[0]].metrics[name]))}."
            )
    return told


def _because(cause: str) -> str:
    """The most frequent cause in words."""
    return "by its own fault: the light was there" if cause == "method" else f"for the cause '{cause}'"


def _rate(score: ScoreDocument, metric: str) -> float:
    return score.metrics[metric].value or 0.0


def _listed(names: Sequence[str], most: int = 3) -> str:
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def _frames(
    number: int, scores: Mapping[str, ScoreDocument]
) -> tuple[dict[str, EncodedPicture], dict[tuple[str, int], str]]:
    """Whole frames of the worst images, each once, and which image has which."""
    ids: dict[str, str] = {}
    frames: dict[str, EncodedPicture] = {}
    places: dict[tuple[str, int], str] = {}
    for name, score in scores.items():
        for place, image in enumerate(score.worst):
            if image.frame is not None:
                key = ids.setdefault(image.frame.base64, f"frame-{number}-{len(ids) + 1}")
                frames[key], places[name, place] = image.frame, key
    return frames, places


def _distinct(names: list[str]) -> list[str]:
    """Names, with a number where one occurs again."""
    return [f"{name} ({names[:i].count(name) + 1})" if names.count(name) > 1 else name for i, name in enumerate(names)]
