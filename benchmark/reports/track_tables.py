"""Tables of the tracks: one row per method, one column per preset, the track's number with its interval.

They come first in a report and in results. Division and what a method knows of the rig stand beside its name: whoever
is given a calibration does not compete with whoever is not.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from phibench.benchmark.pair_sets.dataset_pairs import TRACKS, Track, tracks_of
from phibench.benchmark.scores.metrics import METRICS
from phibench.benchmark.scores.score_document import ScoreDocument
from phibench.benchmark.scores.score_tables import (
    BY_WORD,
    FLAGGED,
    RANKS_OF_TRACKS,
    rig_known,
    shown_parts,
    starred_value,
)
from phibench.datasets.common.shown_text import TextTable


@dataclass(frozen=True)
class TrackNumbers:
    """Numbers of a track beside the one that ranks it (`RANKS_OF_TRACKS`).

    `perfect` are metrics of the pairs alone, by the name of their row.
    """

    title: str
    beside: tuple[str, ...]
    perfect: Mapping[str, str]


NUMBERS: dict[Track, TrackNumbers] = {
    "localise": TrackNumbers(
        "Track localise: error over bound, geometric mean, lower is better",
        ("median_localise", "p95_localise"),
        {"perfect, one image": "perfect_localise", "perfect, both images": "perfect_localise_pair"},
    ),
    "find": TrackNumbers(
        "Track find: Jaccard index at 3 px, higher is better", ("detection_rate", "false_rate", "false_per_empty"), {}
    ),
    "depth": TrackNumbers(
        "Track depth: average recall of D within 0.5 to 20 %, higher is better",
        ("depth_rate", "median_depth_relative", "interval_score"),
        {},
    ),
}


def track_tables(documents: Sequence[ScoreDocument], beside: bool = True) -> list[TextTable]:
    """Tables of all tracks that some score belongs to: method by preset, then the numbers beside it if wanted."""
    tables = []
    for track in TRACKS:
        own = [document for document in documents if track in tracks_of(document.pair_set)]
        if own:
            tables += [_by_preset(track, own), *([_beside(track, own)] if beside else [])]
    return tables


def preset_name(document: ScoreDocument) -> str:
    """Presets of a score in words."""
    return ", ".join(document.pair_set.get("presets", ())) or "pairs"


def _by_preset(track: Track, documents: Sequence[ScoreDocument]) -> TextTable:
    numbers = NUMBERS[track]
    presets = list(dict.fromkeys(map(preset_name, documents)))
    rows: dict[tuple[str, str, str], dict[str, ScoreDocument]] = {}
    for document in documents:
        name = f"{document.method.name}{FLAGGED if document.flags else ''}"
        rows.setdefault((name, document.method.division, rig_known(document)), {})[preset_name(document)] = document
    order = sorted(rows.items(), key=lambda row: _mean_place(row[1], documents, track))
    made = [(*key, *(_cell(RANKS_OF_TRACKS[track], own.get(preset)) for preset in presets)) for key, own in order]
    firsts = {preset: next(one for one in documents if preset_name(one) == preset) for preset in presets}
    for name, metric in numbers.perfect.items():
        made.append((name, "", "", *(_cell(metric, firsts[preset]) for preset in presets)))
    ordered = "Ordered by the mean place over presets. " if len(presets) > 1 else ""
    compared = "phibench compare ONE.json OTHER.json does, from 30 samples on"
    note = f"{ordered}Overlapping intervals settle no order: {compared}."
    return TextTable(numbers.title, ("method", *BY_WORD, *presets), tuple(made), "lll" + "r" * len(presets), note)


def _mean_place(own: Mapping[str, ScoreDocument], documents: Sequence[ScoreDocument], track: Track) -> float:
    """Mean over presets of the number of methods that are better; a preset that a method lacks tells nothing."""
    places = []
    for preset, document in own.items():
        others = [_key(other, track) for other in documents if preset_name(other) == preset]
        places.append(sum(other < _key(document, track) for other in others))
    return sum(places) / len(places)


def _key(document: ScoreDocument, track: Track) -> float:
    """Number that is smaller for the better method; infinite where there is none."""
    name = RANKS_OF_TRACKS[track]
    value = document.metrics[name].value
    if value is None:
        return math.inf
    return value if METRICS[name].better == "lower" else -value


def _beside(track: Track, documents: Sequence[ScoreDocument]) -> TextTable:
    names = NUMBERS[track].beside
    order = sorted(documents, key=lambda one: (preset_name(one), _key(one, track)))
    rows = [(preset_name(one), one.method.name, *(_cell(name, one) for name in names)) for one in order]
    heads = [f"{METRICS[name].text} / {METRICS[name].shown[1]}".removesuffix(" / 1") for name in names]
    return TextTable(f"Beside it, {track}", ("preset", "method", *heads), tuple(rows), "ll" + "r" * len(names))


def _cell(name: str, document: ScoreDocument | None) -> str:
    return "" if document is None else starred_value(shown_parts(name, document.metrics[name]))
