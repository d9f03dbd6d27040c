"""`phibench bench`: every built-in method on a data set, and one report."""

from __future__ import annotations

import sys
from pathlib import Path

from phibench.estimator.cli_words import Whole


def bench(
    directory: Path,
    *,
    out: Path,
    methods: str | None = None,
    pairs: Whole | None = None,
    workers: Whole = 1,
    calibration: Path | None = None,
) -> int:
    """Run the built-in methods on every preset of a data set and write scores and a report.

    Parameters
    ----------
    directory
        Folder of a finished data set.
    out
        Folder for the scores and report.html.
    methods
        Names of methods, joined by commas; all that are installed by default.
    pairs
        Only the first so many of each preset.
    workers
        Pairs that are worked on at a time.
    calibration
        File of `phibench calibrate`: only its rig's pairs, with the calibrated rig and stroke.
    """
    from phibench.estimator.bench.run_all import bench as run_bench
    from phibench.estimator.bench.run_all import show

    names = None if methods is None else methods.split(",")
    done = run_bench(directory, out, names, workers, pairs, calibration=calibration)
    for note in done.notes:
        print(f"note: {note}", file=sys.stderr)
    print(f"{done.report}: the report on {len(done.scores)} scores")
    show(done.report)
    return 0
