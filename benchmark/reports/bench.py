"""Runs that end in one report: all methods on every preset and track of a data set, and the demo.

The demo is two built-in methods and the example of `phibench method new` on five shipped pairs, a frames set of camera
JPEGs in `pair_sets/demo`: `docs/make_demo.py` makes it. They are copied beside the scores, where a method of one's own
finds them as any other set.
"""

from __future__ import annotations

import os
import shutil
import sys
import webbrowser
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from phibench.benchmark.isolation.method_references import installed_methods, write_example
from phibench.benchmark.isolation.run_limits import RunLimits
from phibench.benchmark.pair_sets.dataset_pairs import TRACKS, Track, tracks_of
from phibench.benchmark.pair_sets.frames_set import FramesSet
from phibench.benchmark.pair_sets.wanted_pairs import PairChoice, open_scored, wanted_pairs
from phibench.benchmark.reports.report_page import write_report
from phibench.benchmark.reports.report_sections import time_section
from phibench.benchmark.scores.score import Scored, run_and_score, saved_scores
from phibench.benchmark.scores.score_files import records_kept
from phibench.benchmark.scores.score_tables import failure_line
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.progress import progress_console
from phibench.datasets.read import Dataset
from phibench.datasets.store.files import require_writable
from phibench.estimator.interface import Box
from phibench.estimator.methods.registry import METHODS, BuiltIn
from phibench.estimator.pair_set import PairSet

if TYPE_CHECKING:
    from phibench.calibration.captures.imported_set import ImportedSet

PRESETS = ("bayer-raw", "srgb8", "mjpeg")
"""Of a data set whose recipe has no `[frames]`."""
REPORT = "report.html"
_PROBE_BOX = Box(0, 0, 16, 16)  # a method that needs boxes takes the pairs that have some


@dataclass(frozen=True)
class Benched:
    """Files of a run: the report and the scores. `notes` says which methods were left out, and why.

    `failures` are sentences on methods that failed on every pair.
    """

    report: Path
    scores: tuple[Path, ...]
    notes: tuple[str, ...]
    failures: tuple[str, ...] = ()


def bench(
    folder: str | Path,
    out: str | Path,
    methods: Sequence[str] | None = None,
    workers: int = 1,
    pairs: int | None = None,
    console: Console | None = None,
    calibration: str | Path | None = None,
    limits: RunLimits | None = None,
    tracks: Sequence[Track] | None = None,
) -> Benched:
    """Run built-in methods and those of installed packages on all presets and tracks; write scores and a report.

    Parameters
    ----------
    folder : finished data set
    out : folder for `report.html`, `<preset>-<method>.json` of whole frames, and `<preset>-<method>-localise.json`
    methods : names of methods that are built in or registered by a package; all by default
    workers : pairs that are worked on at a time
    pairs : the first so many of each preset; all by default
    console : where progress goes; by default the standard error
    calibration : file of `phibench calibrate`; the pairs are then those of its rig, with its numbers
    limits : limits of every method for one pair
    tracks : those that are run, all by default; "find" and "depth" are one run on whole frames

    Raises
    ------
    DatasetError
        If the data set will not do, or a method is unknown.
    """
    dataset, out = open_scored(folder), Path(out)
    console = console or progress_console()
    chosen = _chosen(list(dict.fromkeys([*METHODS, *(point.name for point in installed_methods())])), methods)
    if out.resolve() == dataset.folder.resolve() or dataset.folder.resolve() in out.resolve().parents:
        raise DatasetError(f"{out} lies inside the data set, whose files are signed; give a folder outside, --out")
    require_writable(out / REPORT)
    scores, notes, failures, times = [], [], [], dict[str, dict[str, float]]()
    for preset, track in product(_presets(dataset), _runs(dataset, tracks)):
        taken = wanted_pairs(dataset, PairChoice(preset, pairs=pairs, calibration=calibration, track=track))
        # what a package's method takes is known to nobody: it is asked, and its answers say so
        refusals = {name: refusal_reason(METHODS[name], taken) if name in METHODS else "" for name in chosen}
        run = f"{preset}, localise" if track == "localise" else preset
        notes += [f"{name} is left out on {run}: {why}" for name, why in refusals.items() if why]
        names = [name for name, why in refusals.items() if not why]
        stages: dict[str, float] = {}
        ending = "-localise" if track == "localise" else ""
        paths = [out / f"{preset}-{name}{ending}.json" for name in names]
        with records_kept(paths):
            done = run_and_score(names, taken, workers, console, run, limits=limits, stages=stages)
        times[run] = {stage: seconds / len(taken) for stage, seconds in stages.items()}
        saved_scores(done, paths)
        failures += [f"{one.document.method.name} {line}" for one in done if (line := failure_line(one.records))]
        scores += paths
    if not scores:
        raise DatasetError(f"none of {', '.join(chosen)} takes a preset of {folder}: give another --method")
    page = write_report(scores, out / REPORT, [time_section(times)])
    return Benched(page, tuple(scores), tuple(notes), tuple(failures))


def refusal_reason(method: BuiltIn, pairs: PairSet) -> str:
    """Reason for which a built-in method cannot take the pairs of a preset; "" if it can."""
    pair = pairs.pair(0)
    whole = "find" in tracks_of(pairs.document())
    return method.refusal(pair if whole else replace(pair, box_down=_PROBE_BOX, box_up=_PROBE_BOX))


def open_in_browser(page: Path) -> bool:
    """Open a page in a browser, where somebody sits before one; return whether it was opened."""
    display = sys.platform in ("darwin", "win32") or any(
        os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")
    )
    return sys.stdout.isatty() and display and webbrowser.open(page.resolve().as_uri())


def _runs(dataset: Dataset | ImportedSet | FramesSet, tracks: Sequence[Track] | None) -> list[Track | None]:
    """Runs that the tracks need: whole frames serve two of them. Of pictures nobody knows where boxes belong."""
    if not isinstance(dataset, Dataset | FramesSet):
        return [None]
    wanted = set(TRACKS if tracks is None else tracks)
    runs: list[Track | None] = ["find"] if wanted & {"find", "depth"} else []
    return [*runs, *(["localise"] if "localise" in wanted else [])]  # type: ignore[list-item]


def _presets(dataset: Dataset | ImportedSet | FramesSet) -> tuple[str, ...]:
    if not isinstance(dataset, Dataset):
        return (dataset.preset,)
    frames = dataset.recipe.frames
    return PRESETS if frames is None else frames.presets


def _chosen(known: Sequence[str], wanted: Sequence[str] | None) -> list[str]:
    names = list(known) if wanted is None else list(dict.fromkeys(wanted))
    if strange := [name for name in names if name not in known]:
        raise DatasetError(
            f"no method '{strange[0]}' is built in or registered by a package; known: {', '.join(known)}"
        )
    return names


# -- the demo ----------------------------------------------------------------------------------------------------------

SHIPPED = Path(__file__).parent.parent / "pair_sets" / "demo"
DEMO_METHODS = ("red_centroid", "detect")
"""A simple method, and the matched filter that the fits begin with; fits take a second a pair."""
EXAMPLE, FRAMES = "my_phi.py", "frames"


@dataclass(frozen=True)
class Demo:
    """Result: the page, the scores, the set of pairs and the example method that lie beside it."""

    page: Path
    scores: tuple[Scored, ...]
    pairs: Path
    example: Path


def demo(out: Path, console: Console | None = None) -> Demo:
    """Score the methods of the demo and write one page; an example that was changed is kept and scored.

    Raises
    ------
    DatasetError
        If the folder cannot be written, or holds other files.
    """
    strange = [path.name for path in (out.iterdir() if out.is_dir() else ()) if path.name not in _OWN]
    if strange:
        raise DatasetError(f"{out} holds other files, such as {sorted(strange)[0]}: give an empty folder, --out")
    require_writable(out / REPORT)
    pairs, example = out / FRAMES, out / EXAMPLE
    if not pairs.exists():
        shutil.copytree(SHIPPED, pairs)
    if not example.exists():
        write_example(example)
    references = [*DEMO_METHODS, f"{example}:extract"]
    scored = run_and_score(references, FramesSet(pairs).of_track("find"), 1, console or progress_console(), "pairs")
    files = [out / name for name in _SCORES]
    saved = saved_scores(scored, files)
    return Demo(write_report(files, out / REPORT), tuple(saved), pairs, example)


_SCORES = (*(f"{name}.json" for name in DEMO_METHODS), "my_phi.json")
_OWN = {EXAMPLE, FRAMES, REPORT, "__pycache__", *_SCORES, *(name.replace(".json", ".parquet") for name in _SCORES)}
