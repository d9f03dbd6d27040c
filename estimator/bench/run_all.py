"""The whole benchmark on one data set: every built-in method on every preset that it accepts, then one report."""

from __future__ import annotations

import os
import sys
import webbrowser
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from rich.console import Console

from phibench.datasets.errors import DatasetError
from phibench.datasets.files import require_writable
from phibench.datasets.progress import Steps
from phibench.datasets.read import Dataset, open_finished
from phibench.estimator.bench.calibrated_pairs import CalibratedPairs, of_calibration
from phibench.estimator.bench.dataset_pairs import dataset_pairs
from phibench.estimator.bench.document import MethodCard, write_score
from phibench.estimator.bench.pair_set import PairSet
from phibench.estimator.bench.report import write_report
from phibench.estimator.bench.score_method import Scored, score_methods
from phibench.estimator.calibration.file import read_calibration
from phibench.estimator.methods.built_in import BuiltIn
from phibench.estimator.methods.registry import METHODS
from phibench.estimator.seat.harness import Harness
from phibench.estimator.seat.limits import Limits
from phibench.estimator.seat.pair import Box
from phibench.estimator.seat.resolve import resolve

PRESETS = ("bayer-raw", "srgb8", "mjpeg")
"""Of a data set whose recipe has no `[frames]`."""
REPORT = "report.html"
_PROBE_BOX = Box(0, 0, 16, 16)  # a method that needs boxes takes the pairs that have some


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
    workers: int = 1,
    pairs: int | None = None,
    console: Console | None = None,
    calibration: str | Path | None = None,
) -> Benched:
    """Run built-in methods on all presets of a data set and write scores and a report.

    Parameters
    ----------
    folder : finished data set
    out : folder for `<preset>-<method>.json` and `report.html`
    methods : names of built-in methods; all by default
    workers : pairs that are worked on at a time
    pairs : the first so many of each preset; all by default
    console : where progress goes; by default the standard error
    calibration : file of `phibench calibrate`; the pairs are then those of its rig, with its numbers

    Raises
    ------
    DatasetError
        If the data set will not do, or a method is unknown.
    """
    dataset, out = open_finished(folder), Path(out)
    console, chosen = console or Console(stderr=True), _chosen(METHODS, methods)
    if out.resolve() == dataset.folder.resolve() or dataset.folder.resolve() in out.resolve().parents:
        raise DatasetError(f"{out} lies inside the data set, whose files are signed; give a folder outside, --out")
    require_writable(out / REPORT)
    scores, notes = [], []
    for preset in _presets(dataset):
        taken = wanted_pairs(dataset, preset, pairs=pairs, calibration=calibration)
        refusals = {name: refusal(METHODS[name], taken) for name in chosen}
        notes += [f"{name} is left out on {preset}: {why}" for name, why in refusals.items() if why]
        names = [name for name, why in refusals.items() if not why]
        for name, scored in zip(names, run_and_score(names, taken, workers, console, preset), strict=True):
            path = out / f"{preset}-{name}.json"
            write_score(path, scored.document, scored.records)
            scores.append(path)
    if not scores:
        raise DatasetError(f"none of {', '.join(chosen)} takes a preset of {folder}: give other --methods")
    return Benched(write_report(scores, out / REPORT), tuple(scores), tuple(notes))


def run_and_score(
    references: Sequence[str],
    pairs: PairSet,
    workers: int,
    console: Console,
    title: str,
    seed: int = 0,
    limits: Limits | None = None,
) -> list[Scored]:
    """Score methods on the same pairs, each in a process of its own; parameters as for `bench`.

    Raises
    ------
    MethodError
        If a method cannot be found or imported.
    """
    found, limits = [resolve(reference) for reference in references], limits or Limits()
    cards = [MethodCard.of(name, **method.document()) for name, method in zip(references, found, strict=True)]
    if not cards:
        return []
    with Harness(found, limits, workers) as harness, Steps(console, title, len(pairs)) as steps:
        return score_methods(cards, pairs, harness.outcomes, None, seed, asdict(limits), steps.reach)


def wanted_pairs(
    dataset: Dataset,
    preset: str | None,
    draws: int | None = None,
    pairs: int | None = None,
    hints: bool = True,
    calibration: str | Path | None = None,
) -> PairSet:
    """As `dataset_pairs`; with a calibration file its rig's pairs, with the calibrated rig, stroke and covariance.

    Raises
    ------
    DatasetError
        As `dataset_pairs`, or if the calibration cannot be read or is that of another rig.
    """
    if calibration is None:
        return dataset_pairs(dataset, preset, draws, pairs, hints)
    read = read_calibration(calibration)
    return CalibratedPairs(dataset_pairs(of_calibration(dataset, read), preset, draws, pairs, hints), read)


def refusal(method: BuiltIn, pairs: PairSet) -> str:
    """Why a built-in method cannot take the pairs of a preset; "" if it can."""
    return method.refusal(replace(pairs.pair(0), box_down=_PROBE_BOX, box_up=_PROBE_BOX))


def show(page: Path) -> bool:
    """Open a page in a browser, where somebody sits before one; return whether it was opened."""
    display = sys.platform in ("darwin", "win32") or any(
        os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")
    )
    return sys.stdout.isatty() and display and webbrowser.open(page.resolve().as_uri())


def _presets(dataset: Dataset) -> tuple[str, ...]:
    frames = dataset.recipe.frames
    return PRESETS if frames is None else frames.presets


def _chosen(known: Mapping[str, BuiltIn], wanted: Sequence[str] | None) -> list[str]:
    names = list(known) if wanted is None else list(dict.fromkeys(wanted))
    if strange := [name for name in names if name not in known]:
        raise DatasetError(f"no built-in method '{strange[0]}'; known: {', '.join(known)}")
    return names
