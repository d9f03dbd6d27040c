"""Data sets made, repaired and merged (`make`, `repair`, `merge`), with the table of sensitivities in them.

`phibench.make` and the command line call these. They render through `datasets`, which may not import the estimators
that the table needs, and write the table beside the result.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Unpack

from rich.console import Console

from phibench.datasets import make as rendering
from phibench.datasets import merge_repair
from phibench.estimator.geometry.sensitivity_table import keep_sensitivities


def make(
    recipe: str | Path,
    out: str | Path,
    workers: int | None = None,
    console: Console | None = None,
    scheduler: str | None = None,
    **options: Unpack[rendering.MakeKeywords],
) -> Path:
    """Make the data set of a recipe; parameters and errors are those of `phibench.datasets.make.make`.

    A shard has no table of sensitivities: `merge` writes that of the whole.
    """
    folder = rendering.make(recipe, out, workers, console, scheduler, **options)
    if options.get("shard") is None:
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
