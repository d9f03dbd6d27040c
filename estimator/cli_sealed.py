"""Sealed sets: `phibench dataset seal`, `phibench submit` and `phibench unseal`."""

from __future__ import annotations

import json
import sys
from pathlib import Path

from cyclopts import App

from phibench.estimator.cli_words import Whole


def register(app: App, dataset: App) -> None:
    """Add the commands to the command line."""
    dataset.command(seal)
    app.command(submit)
    app.command(unseal)


def seal(directory: Path, *, out: Path, preset: str | None = None) -> int:
    """Write the frames of a data set without the truth, and a seal that says by hash which truth it was.

    The truth goes into the data set's folder, as seal_<id>.truth.json: keep both to yourself until the end.

    Parameters
    ----------
    directory
        Folder of a finished data set whose seed is a secret.
    out
        Folder to write and to publish; new or empty.
    preset
        One sensor preset, instead of those of the recipe's [frames].
    """
    from phibench.estimator.bench.seal import seal as seal_dataset

    sealed = seal_dataset(directory, out, preset)
    for warning in sealed.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    print(f"{sealed.public}: {sealed.seal.pairs} pairs, seal {sealed.seal.id}; to be published")
    print(f"{sealed.truth_file}: the truth; not to be published before `phibench unseal`")
    return 0


def submit(public: Path, *, method: str, out: Path, workers: Whole | None = None) -> int:
    """Run a method on a sealed set and write its answers for who holds the truth.

    Parameters
    ----------
    public
        Folder of the sealed set.
    method
        Name of a built-in method, or a file and its function, such as mine.py:extract.
    out
        JSON file to write.
    workers
        Number of processes; the harness decides by default.
    """
    from phibench.estimator.bench.submission import submit as submit_method
    from phibench.estimator.bench.wiring import harness

    done = submit_method(public, method, out, harness(workers))
    print(f"{done.path}: {done.answered} of {done.pairs} pairs answered")
    return 0


def unseal(public: Path, *, truth: Path, submission: Path, out: Path | None = None) -> int:
    """Prove that truth and submission belong to a sealed set, and score the submission.

    Parameters
    ----------
    public
        Folder of the sealed set.
    truth
        File that `phibench dataset seal` wrote into the data set's folder.
    submission
        File that `phibench submit` wrote.
    out
        JSON file for the score.
    """
    from phibench.estimator.bench.unseal import unseal as unseal_set
    from phibench.estimator.bench.wiring import scorer

    opened = unseal_set(public, truth, submission)
    print(f"seal {opened.seal.id}: the truth is the sealed one, the submission has each of {opened.seal.pairs} pairs")
    document = scorer()(opened.submission.method.model_dump(), opened.pairs, opened.outcomes, out)
    print(json.dumps(document, indent=1, allow_nan=False) if out is None else f"{out}: the score")
    return 0
