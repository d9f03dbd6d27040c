"""Commands `phibench seal ...` and `submission ...`: frames without their truth, answers to them, and their checks."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from phibench.cli.options import KEEPERS, LIMITS, Limits, OwnOrPreset, Whole

seal = App(
    name="seal",
    group=KEEPERS,
    help="Seal a data set, answer a sealed one, and score the answers.",
)


@seal.command
def make(directory: Path, *, out: Path, preset: OwnOrPreset = None) -> int:
    """Write one pair of each sample without the truth, and a seal that says by hash which truth it was.

    Presets are dealt out over the samples. The truth goes into the data set's folder, as `seal_ID.truth.json`: keep
    both to yourself until the end.

    Parameters
    ----------
    directory
        Folder of a finished data set whose seed is a secret.
    out
        Folder to write and to publish; new or empty.
    preset
        One sensor preset, instead of those of the recipe's [frames].
    """
    from phibench.benchmark.sealed.sealed_set import seal as seal_dataset

    sealed = seal_dataset(directory, out, preset)
    for warning in sealed.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    print(f"{sealed.public}: {sealed.seal.pairs} pairs, seal {sealed.seal.id}; to be published")
    print(f"{sealed.truth_file}: the truth; not to be published before `phibench seal open`")
    return 0


@seal.command
def submit(
    public: Path,
    *,
    method: str,
    out: Path,
    workers: Whole = 1,
    limits: Limits = LIMITS,
) -> int:
    """Run a method on a sealed set and write its answers for who holds the truth.

    Parameters
    ----------
    public
        Folder of the sealed set.
    method
        A method: a name that `phibench method list` shows, or FILE.py:FUNCTION.
    out
        JSON file to write.
    workers
        Pairs that are worked on at a time.
    """
    from phibench.benchmark.sealed.submission import submit as submit_method

    done = submit_method(public, method, out, workers, limits.of_run)
    print(
        f"{done.path}: {done.answered} of {done.pairs} pairs answered, {done.positions} of {2 * done.pairs} positions"
    )
    if done.note:
        print(f"note: {done.note}", file=sys.stderr)
    if done.silence:
        print(f"most often without a position: {done.silence}")
    return 0


@seal.command(name="open")
def open_(public: Path, *, truth: Path, submission: Path, out: Path | None = None) -> int:
    """Prove that truth and submission belong to a sealed set, and score the submission.

    Parameters
    ----------
    public
        Folder of the sealed set.
    truth
        File that `phibench seal make` wrote into the data set's folder.
    submission
        File that `phibench seal submit` wrote.
    out
        JSON file for the score.
    """
    from phibench.benchmark.scores.answer_errors import Rules
    from phibench.benchmark.scores.score import isolated, saved, score_outcomes
    from phibench.benchmark.scores.score_tables import print_scores
    from phibench.benchmark.sealed.submission import unseal as unseal_set
    from phibench.datasets.common.errors import DatasetError
    from phibench.datasets.store.files import require_writable

    if out is not None:
        if out.suffix != ".json":
            raise DatasetError(f"--out {out}: a score is a JSON file; give a name that ends in .json")
        require_writable(out)
    opened = unseal_set(public, truth, submission)  # checks the hash of the truth before any score
    if opened.pairs.note:
        print(f"note: {opened.pairs.note}", file=sys.stderr)
    print(f"seal {opened.seal.id}: the truth is the sealed one, the submission has each of {opened.seal.pairs} pairs")
    scored = score_outcomes(opened.submission.method, opened.pairs, opened.outcomes, Rules())
    scored = isolated(scored, opened.submission.isolation)
    print_scores([scored if out is None else saved(scored, out)], "terminal", "phi", wide=False)
    if out is not None:
        print(f"written: {out}")
    return 0


submission = App(
    name="submission",
    group=KEEPERS,
    help="Check a score that is to be added to the results.",
)


@submission.command
def check(
    file: Path,
    *,
    data: Path | None = None,
    release: Path | None = None,
    method: str | None = None,
    workers: Whole = 1,
    limits: Limits = LIMITS,
    json: Annotated[bool, Parameter(negative="", help="The outcome as one JSON document.")] = False,
) -> int:
    """Check a score file of an open set: a sentence for each fault. The exit code is 1 if there is one.

    Form, version, hashes, pairs, impossible values, errors and statistics. With --data every column is built again from
    the answers. With --method as well the method is run again.

    Parameters
    ----------
    file
        JSON file that `phibench score --out` wrote, with its Parquet file beside it.
    data
        Folder of the data set that was scored: truth, bounds, errors, causes and worst images are computed again.
    release
        MANIFEST.json of a release: the data set must be one of it.
    method
        The method itself, as for `phibench score`: its hashes are compared, and with --data its answers.
    workers
        Pairs that are worked on at a time when the method is run again.
    """
    from phibench.benchmark.sealed.score_check import check_score

    checked = check_score(file, data, release, method, limits.of_run, workers)
    if json:
        sys.stdout.write(checked.text())
        return int(bool(checked.faults))
    for fault in checked.faults:
        print(fault)
    for left in checked.unchecked:
        print(f"not checked: {left}", file=sys.stderr)
    count = len(checked.faults)
    words = "no fault found" if not count else f"{count} fault{'s' * (count > 1)}"
    print(f"{file}: {checked.method} on {checked.pairs} pairs, {words}")
    return int(bool(count))


@submission.command
def schema() -> int:
    """Print the JSON schema of a score file."""
    from phibench.benchmark.sealed.score_check import schema_text

    sys.stdout.write(schema_text())
    return 0
