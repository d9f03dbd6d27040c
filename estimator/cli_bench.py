"""`phibench bench`: every built-in method on a data set, and one report."""

from __future__ import annotations

import sys
from pathlib import Path

from phibench.estimator.cli_words import Whole


def bench(directory: Path, *, out: Path, methods: str | None = None, workers: Whole | None = None) -> int:
    """Run the built-in methods on every preset of a data set and write scores and a report.

    Parameters
    ----------
    directory
        Folder of a finished data set.
    out
        Folder for the scores and report.html.
    methods
        Names of methods, joined by commas; all that are installed by default.
    workers
        Number of processes of each method.
    """
    from phibench.estimator.bench.run_all import Parts, show
    from phibench.estimator.bench.run_all import bench as run_bench

    names = None if methods is None else methods.split(",")
    done = run_bench(directory, out, names, Parts.installed(workers))
    for note in done.notes:
        print(f"note: {note}", file=sys.stderr)
    print(f"{done.report}: the report on {len(done.scores)} scores")
    show(done.report)
    return 0
