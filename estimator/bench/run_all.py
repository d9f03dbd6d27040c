"""The whole benchmark on one data set: every built-in method on every preset that it accepts, then one report."""

from __future__ import annotations

import os
import sys
import webbrowser
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rich.console import Console

from phibench.datasets.errors import DatasetError
from phibench.datasets.read import Dataset, open_finished
from phibench.estimator.bench.dataset_pairs import dataset_pairs
from phibench.estimator.bench.pair_set import PairSet
from phibench.estimator.bench.truth import PairTruth
from phibench.estimator.bench.wiring import (
    Describe,
    Report,
    Run,
    Score,
    built_in,
    describer,
    harness,
    reporter,
    scorer,
)
from phibench.estimator.seat.pair import Box, Pair

PRESETS = ("bayer-raw", "srgb8", "mjpeg")
"""Of a data set whose recipe has no `[frames]`."""
REPORT = "report.html"
_KEPT = 32
"""Pairs of a preset that stay in memory, some 10 MB each: up to so many are drawn once for all methods."""
_PROBE_BOX = Box(0, 0, 16, 16)  # a method that needs boxes takes the pairs that have some


@dataclass(frozen=True)
class Parts:
    """What the benchmark is put together from; a test gives its own."""

    methods: Mapping[str, Any]
    describe: Describe
    run: Run
    score: Score
    report: Report

    @classmethod
    def installed(cls, workers: int | None = None) -> Parts:
        """Those of this installation."""
        return cls(built_in(), describer(), harness(workers), scorer(), reporter())


@dataclass(frozen=True)
class Benched:
    """What a run wrote: the report, the score files, and which methods were left out, why."""

    report: Path
    scores: tuple[Path, ...]
    notes: tuple[str, ...]


def bench(
    folder: str | Path,
    out: str | Path,
    methods: Sequence[str] | None = None,
    parts: Parts | None = None,
    console: Console | None = None,
) -> Benched:
    """Run methods on all presets of a data set and write scores and a report.

    Parameters
    ----------
    folder : finished data set
    out : folder for `<preset>-<method>.json` and `report.html`
    methods : names of built-in methods; all by default
    parts : Parts, optional
        Harness, methods, score and report; those of this installation by default.
    console : where progress goes; by default the standard error

    Raises
    ------
    DatasetError
        If the data set will not do, or a method is unknown.
    """
    dataset, out = open_finished(folder), Path(out)
    parts, console = parts or Parts.installed(), console or Console(stderr=True)
    chosen = _chosen(parts.methods, methods)
    if out.resolve() == dataset.folder.resolve() or dataset.folder.resolve() in out.resolve().parents:
        raise DatasetError(f"{out} lies inside the data set, whose files are signed; give a folder outside, --out")
    scores, notes = [], []
    for preset in _presets(dataset):
        pairs = KeptPairs(dataset_pairs(dataset, preset))
        for name in chosen:
            if why := refusal(parts.methods[name], pairs):
                notes.append(f"{name} is left out on {preset}: {why}")
                continue
            console.print(f"{preset}: {name} on {len(pairs)} pairs", highlight=False)
            path = out / f"{preset}-{name}.json"
            parts.score(parts.describe(name), pairs, parts.run(name, pairs), path)
            scores.append(path)
    return Benched(parts.report(scores, out / REPORT), tuple(scores), tuple(notes))


class KeptPairs:
    """Pairs that are drawn once where they are few.

    Parameters
    ----------
    pairs : PairSet
    """

    def __init__(self, pairs: PairSet) -> None:
        self._pairs = pairs
        self._drawn: dict[int, Pair] = {}

    def __len__(self) -> int:
        return len(self._pairs)

    def pair(self, number: int) -> Pair:
        """What a method sees; its arrays are read-only, so that all may have the same."""
        if len(self) > _KEPT:
            return self._pairs.pair(number)
        if number not in self._drawn:
            self._drawn[number] = self._pairs.pair(number)
        return self._drawn[number]

    def truth(self, number: int) -> PairTruth:
        """The exact answer."""
        return self._pairs.truth(number)

    def document(self) -> dict[str, Any]:
        """Provenance of the set."""
        return self._pairs.document()


def refusal(method: Any, pairs: PairSet) -> str:
    """Why a built-in method cannot take the pairs of a preset; "" if it can."""
    why: str = method.refusal(replace(pairs.pair(0), box_down=_PROBE_BOX, box_up=_PROBE_BOX))
    return why


def show(page: Path) -> bool:
    """Open a page in a browser, where somebody sits before one; return whether it was opened."""
    display = sys.platform in ("darwin", "win32") or any(
        os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")
    )
    return sys.stdout.isatty() and display and webbrowser.open(page.resolve().as_uri())


def _presets(dataset: Dataset) -> tuple[str, ...]:
    frames = dataset.recipe.frames
    return PRESETS if frames is None else frames.presets


def _chosen(known: Mapping[str, Any], wanted: Sequence[str] | None) -> list[str]:
    names = list(known) if wanted is None else list(dict.fromkeys(wanted))
    if strange := [name for name in names if name not in known]:
        raise DatasetError(f"no built-in method '{strange[0]}'; known: {', '.join(known)}")
    return names
