"""Sections of a report: paragraphs, pictures and tables of text; those of the tracks and of a run's time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from phibench.benchmark.reports.figures import EmbeddedFigure
from phibench.benchmark.reports.track_tables import track_tables
from phibench.benchmark.scores.score_document import ScoreDocument


@dataclass(frozen=True)
class Section:
    """A further part of a report, such as a study: paragraphs, pictures and tables of text.

    Attributes
    ----------
    paragraphs : plain text
    pictures : tuple of EmbeddedFigure
    tables : rows of cells, the first row being heads
    captions : one for each table, or none at all
    """

    title: str
    paragraphs: tuple[str, ...] = ()
    pictures: tuple[EmbeddedFigure, ...] = ()
    tables: tuple[tuple[tuple[str, ...], ...], ...] = ()
    captions: tuple[str, ...] = ()


def tracks_section(documents: Sequence[ScoreDocument]) -> Section | None:
    """Section with the tables of all tracks; None where no score belongs to one."""
    tables = track_tables(documents)
    if not tables:
        return None
    words = (
        "localise: spots with a bound below 1 px, in boxes of 64 px. find and depth: whole frames. Division closed: "
        "tuned on dev alone, by its author's word. Rig: what the method was given, or corrects itself.",
        "find: J is found spots / (visible spots + false answers). A guess pays only where it is right with a chance "
        "above J / (1 + J). depth: both spots must be found, so that a constant D counts nothing.",
        "Ordered by the mean place over presets. Overlapping intervals settle no order: phibench compare ONE.json "
        "OTHER.json does, from 30 samples on. A star: too few samples for an interval. The rows of a perfect method "
        "are Gaussian errors at the bound.",
    )
    cells = tuple((table.heads, *table.rows) for table in tables)
    return Section("Tracks", words, (), cells, tuple(table.title for table in tables))


def time_section(times: Mapping[str, Mapping[str, float]]) -> Section:
    """Section on where the time of a run went.

    Parameters
    ----------
    times : preset to stage to CPU-seconds a pair
    """
    stages = list(dict.fromkeys(stage for seconds in times.values() for stage in seconds))
    heads = ("stage", *(f"{preset} / ms" for preset in times))
    rows = [(stage, *(_milliseconds(seconds.get(stage)) for seconds in times.values())) for stage in stages]
    total = ("all", *(_milliseconds(sum(seconds.values())) for seconds in times.values()))
    words = (
        "CPU time of one pair, the mean over all pairs of a preset. Frames are drawn once for all methods; built-in "
        "methods share the search for the spot, and joint_fit begins with the fits of each image.",
        "Methods of others are not in this table: their time is in the ranking.",
    )
    return Section("Where the time went", words, (), ((heads, *rows, total),), ("Stages",))


def _milliseconds(seconds: float | None) -> str:
    return "" if seconds is None else f"{1e3 * seconds:.1f}"
