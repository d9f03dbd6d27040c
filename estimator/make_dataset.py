"""Making whole data sets: what `datasets` renders, and the sensitivities of every estimator beside it.

`datasets` may not import the estimators, so the two come together here. The command line and Python programs call the
same functions and get the same folder.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from phibench.datasets import make as rendering
from phibench.datasets import merge_repair
from phibench.estimator.paper.sensitivity_table import keep_sensitivities


def make(
    recipe: str | Path,
    out: str | Path,
    workers: int | None = None,
    console: Console | None = None,
    scheduler: str | None = None,
    shard: str | None = None,
    samples: int | None = None,
    seed: int | None = None,
) -> Path:
    """Make the data set of a recipe; parameters and errors are those of `phibench.datasets.make.make`.

    A shard has no table of sensitivities: `merge` writes that of the whole.
    """
    folder = rendering.make(recipe, out, workers, console, scheduler, shard, samples, seed)
    if shard is None:
        keep_sensitivities(folder)
    return folder


def repair(
    folder: str | Path, workers: int | None = None, console: Console | None = None, scheduler: str | None = None
) -> list[str]:
    """Make a data set whole again; return what was done. Errors are those of `phibench.datasets.merge_repair`."""
    done = merge_repair.repair(folder, workers, console, scheduler)
    keep_sensitivities(Path(folder))
    return done


def merge(out: str | Path, shards: Sequence[str | Path], console: Console | None = None) -> Path:
    """Put finished shards together. Errors are those of `phibench.datasets.merge_repair`."""
    folder = merge_repair.merge(out, shards, console)
    keep_sensitivities(folder)
    return folder
