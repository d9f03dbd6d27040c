"""Scores as one HTML page: everything is in the file, nothing is fetched, no script runs."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import polars as pl
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from phibench.datasets.errors import DatasetError
from phibench.datasets.files import write_text
from phibench.estimator.bench import figures
from phibench.estimator.bench.compare import same_pairs
from phibench.estimator.bench.document import ScoreDocument, read_records, read_score
from phibench.estimator.bench.picture import Picture
from phibench.estimator.bench.tables import BOARD, cell_parts, rank_key

_TEMPLATE = "report.html.j2"
_STRATA = ("detection_rate", "false_rate", "rms_px", "median_px", "p95_px", "rms_phi_rad", "rms_depth_relative")
_STRATA_TOO = ("efficiency_px", "pull_deviation")


@dataclass(frozen=True)
class Section:
    """A further part of a report, such as a study: paragraphs, pictures and tables of text.

    Attributes
    ----------
    title : str
    paragraphs : plain text
    pictures : tuple of Picture
    tables : rows of cells, the first row being heads
    captions : one for each table, or none at all
    """

    title: str
    paragraphs: tuple[str, ...] = ()
    pictures: tuple[Picture, ...] = ()
    tables: tuple[tuple[tuple[str, ...], ...], ...] = ()
    captions: tuple[str, ...] = ()


@dataclass(frozen=True)
class Ranking:
    """Scores that were taken on the same pairs, with all that is shown of them."""

    pair_set: Mapping[str, object]
    scores: Mapping[str, ScoreDocument]
    curves: Picture
    image_map: Picture
    by_radius: Picture
    causes: Picture
    pulls: Picture | None


def write_report(files: Sequence[Path], out: Path, sections: Sequence[Section] = ()) -> Path:
    """Write a report about scores on disk.

    Parameters
    ----------
    files : JSON files of `score --method`, their Parquet files beside them
    out : HTML file
    sections : what follows the scores

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
    return write_text(out, report_html([(document, read_records(path, document)) for path, document in read], sections))


def report_html(scores: Sequence[tuple[ScoreDocument, pl.DataFrame]], sections: Sequence[Section] = ()) -> str:
    """The page as text; the same scores give the same text."""
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
        lstrip_blocks=True,
    )  # fmt: skip
    environment.globals.update(board=BOARD, parts=cell_parts, strata_metrics=(*_STRATA, *_STRATA_TOO))
    environment.filters["json"] = lambda value: json.dumps(value, indent=1)
    rankings = [_ranking(group) for group in _groups(scores)]
    return environment.get_template(_TEMPLATE).render(rankings=rankings, sections=sections)


def _groups(scores: Sequence[tuple[ScoreDocument, pl.DataFrame]]) -> list[list[tuple[ScoreDocument, pl.DataFrame]]]:
    """Scores by what they were taken on and by which rules."""
    groups: dict[str, list[tuple[ScoreDocument, pl.DataFrame]]] = {}
    for document, table in scores:
        key = json.dumps([same_pairs(document), document.pairs, document.rules], sort_keys=True)
        groups.setdefault(key, []).append((document, table))
    return list(groups.values())


def _ranking(group: list[tuple[ScoreDocument, pl.DataFrame]]) -> Ranking:
    order = sorted(group, key=lambda item: rank_key(item[0]))
    names = _distinct([document.method.name for document, _ in order])
    scores = {name: document for name, (document, _) in zip(names, order, strict=True)}
    tables = {name: table for name, (_, table) in zip(names, order, strict=True)}
    return Ranking(
        order[0][0].pair_set,
        scores,
        figures.error_curves(scores),
        figures.error_map(tables),
        figures.error_by_radius(tables),
        figures.cause_bars(scores),
        figures.pull_histogram(tables),
    )


def _distinct(names: list[str]) -> list[str]:
    """Names, with a number where one occurs again."""
    return [f"{name} ({names[:i].count(name) + 1})" if names.count(name) > 1 else name for i, name in enumerate(names)]
