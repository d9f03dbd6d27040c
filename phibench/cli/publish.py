"""Commands `export`, `release`, `fetch`, `seal`, `submission`: publish data sets, answer sealed ones, check scores."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import App, Parameter

from phibench.cli.dataset import DrawOptions
from phibench.cli.options import (
    DEFAULT_PRESET,
    KEEPERS,
    LIMITS,
    OWN_WORD,
    DataFolder,
    Limits,
    OutFolder,
    OwnOrPreset,
    OwnWord,
    Preset,
    Whole,
    Workers,
    parts,
    released,
)


@Parameter(name="*")
@dataclass(frozen=True)
class SplitOptions:
    """Parts of an export.

    Parameters
    ----------
    split_by
        What no two splits share: "both" rig and room, or one of them.
    validation
        Share of the pairs, at most; a set of one rig or room is all for training.
    test
        Share of the pairs, at most; the rest is for training.
    pairs_per_shard
        Pairs in one file of Parquet or tar, or in one folder of image files.
    """

    split_by: Literal["both", "rig", "room"] = "both"
    validation: float = 0.1
    test: float = 0.1
    pairs_per_shard: Whole = 64


_TENTHS, _ALL_DRAWS = SplitOptions(), DrawOptions()


def export(
    directory: DataFolder,
    *,
    to: Literal["parquet", "webdataset", "frames"],
    out: OutFolder,
    preset: Preset = DEFAULT_PRESET,
    laser_off: bool | None = None,
    drawing: DrawOptions = _ALL_DRAWS,
    splits: SplitOptions = _TENTHS,
) -> int:
    """Write a data set's pairs for other tools, with truth, splits, card, licence and Croissant description.

    What is finished already is kept. `phibench dataset verify` checks an export, too. Files with an exposure, a region
    or a camera of their own are not for `score`.

    Parameters
    ----------
    to
        "parquet" (read by `datasets`), "webdataset" (tar files) or "frames" (image files; `score` takes them, too).
    preset
        Where the camera's chain ends: "mono-raw", "bayer-raw", "srgb8", "yuyv" or "mjpeg" (the camera's own JPEG).
    laser_off
        Also every image without the spot; by default for "frames" whose recipe has them.
    """
    from phibench.benchmark.export.export_make import export as export_pairs
    from phibench.benchmark.export.export_make import scored_with_laser_off
    from phibench.benchmark.export.pair_rows import ExportRequest

    options = drawing.options(preset, {})
    scored = to == "frames" and not options.given  # other sensors and numbers are not those of any score
    shares = (splits.split_by, splits.validation, splits.test, splits.pairs_per_shard)
    # as methods are scored on it
    off = scored_with_laser_off(directory) if laser_off is None and scored else bool(laser_off)
    request = ExportRequest(to, options, drawing.draws, off, *shares, samples=drawing.sample, scored=scored)
    done = export_pairs(directory, request, out, workers=drawing.workers)
    for note in done.notes:
        print(f"note: {note}")
    counts = ", ".join(f"{count} {name}" for name, count in done.pairs.items())
    print(f"{done.folder}: pairs {counts}; {done.made} shards written, {done.kept} kept")
    return 0


def release(
    *,
    out: Path,
    work: Path,
    secret_seed: Path | None = None,
    part: Annotated[tuple[str, ...], Parameter(negative="", completer=parts)] = (),
    samples: Whole | None = None,
    use: Annotated[tuple[Path, ...], Parameter(negative="")] = (),
    workers: Workers = None,
    dry_run: bool = False,
) -> int:
    """Make the frozen benchmark as archives to be published, with a list of their hashes.

    What is finished already is kept, so that a run that ended early goes on.

    Parameters
    ----------
    out
        Folder to publish: archives, MANIFEST.json, SHA256SUMS, card, licence and Croissant.
    work
        Folder of the data sets, not to be published: it holds the truth of the sealed part.
    secret_seed
        File with the seed of the sealed part, outside --out; one is drawn if there is no such file. Other parts need
        none.
    part
        "dev", "test", "paper", "mirrors", "films", "drives", "dense-dev", "dense-test" or "starter".
        May be given several times; all by default.
    samples
        Samples of each part that draws its samples, instead of the recipe's number.
    use
        Folder of a finished data set of a part, to be packed in place of a rendered one. May be given several times.
    dry_run
        Say how many samples, bytes and CPU-hours each part takes; render nothing.
    """
    from phibench.benchmark.release import release_make
    from phibench.benchmark.release.release_parts import chosen_parts
    from phibench.benchmark.sealed.sealed_set import seal

    request = release_make.ReleaseRequest(chosen_parts(part), out, work, secret_seed, samples, use, workers=workers)
    if dry_run:
        for line in release_make.forecast_lines(request):
            print(line)
        return 0
    done = release_make.release(request, seal)
    for name, held in sorted(done.manifest.parts.items()):
        print(f"{name}: {held.count_text} samples, {len(held.archives)} archives, {held.download / 1e6:.1f} MB")
    print(f"{out}: {done.made} archives written, {done.kept} kept; SHA-256 of MANIFEST.json: {done.digest}")
    return 0


def fetch(
    name: Annotated[str, Parameter(completer=released)],
    *,
    out: Path,
    from_: Annotated[str | None, Parameter(name="--from")] = None,
    manifest_sha256: str | None = None,
) -> int:
    """Fetch a released data set and check every file; what was fetched before a break is kept.

    Parameters
    ----------
    name
        "phibench-v4-dev", or its last word.
    out
        Folder that the data set will be. It has this name only when all of it is there.
    from_
        Folder of a release, or its address with http:// or https://; by default that in PHIBENCH_SOURCE.
    manifest_sha256
        SHA-256 that the release's MANIFEST.json must have.
    """
    from phibench.benchmark.release.fetch import fetch as fetch_set

    done = fetch_set(name, out, from_, manifest_sha256=manifest_sha256)
    what = f"{done.fetched} of {done.archives} archives fetched" if done.fetched else "there already"
    print(f"{done.folder}: {done.title}, {what}; every file has its SHA-256")
    return 0


# -- frames without their truth, and answers to them -------------------------------------------------------------------

seal = App(name="seal", group=KEEPERS, help="Seal a data set, answer a sealed one, and score the answers.")


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
    public: Path, *, method: str, out: Path, workers: Whole = 1, limits: Limits = LIMITS, own: OwnWord = OWN_WORD
) -> int:
    """Run a method on a sealed set and write its answers for who holds the truth; exit code 1 if it answered no pair.

    Parameters
    ----------
    public
        Folder of the sealed set; that of a sealed dense set asks a dense method.
    method
        A method: a name that `phibench method list` or `phibench dense list` shows, or FILE.py:FUNCTION.
    out
        JSON file to write; for a dense set a folder.
    workers
        Pairs that are worked on at a time.
    """
    from phibench.benchmark.sealed.dense_submission import is_dense_seal, submit_dense
    from phibench.benchmark.sealed.submission import submit as submit_method

    if is_dense_seal(public):
        dense = submit_dense(public, method, out, workers, limits.of_run, own.declared([method]))
        print(f"{dense.path}: {dense.answered} of {dense.pairs} pairs answered")
        if dense.silence:
            print(f"most often without an answer: {dense.silence}")
        return int(dense.answered == 0)
    done = submit_method(public, method, out, workers, limits.of_run, own.declared([method]))
    print(
        f"{done.path}: {done.answered} of {done.pairs} pairs answered, {done.positions} of {2 * done.pairs} positions"
    )
    if done.note:
        print(f"note: {done.note}", file=sys.stderr)
    if done.silence:
        print(f"most often without a position: {done.silence}")
    return int(done.answered == 0)


@seal.command(name="open")
def open_(public: Path, *, truth: Path, submission: Path, out: Path | None = None) -> int:
    """Prove that truth and submission belong to a sealed set, and score the submission.

    Parameters
    ----------
    public
        Folder of the sealed set.
    truth
        File that `phibench seal make` wrote into the data set's folder; of a dense set its dense.truth.json.
    submission
        File that `phibench seal submit` wrote; for a dense set the folder.
    out
        JSON file for the score.
    """
    from phibench.benchmark.scores.answer_errors import Rules
    from phibench.benchmark.scores.score import saved_score, score_outcomes, with_isolation
    from phibench.benchmark.scores.score_tables import nothing_answered, print_scores
    from phibench.benchmark.sealed.dense_submission import is_dense_seal
    from phibench.benchmark.sealed.submission import unseal as unseal_set
    from phibench.datasets.common.errors import DatasetError
    from phibench.datasets.store.files import require_writable

    if out is not None:
        if out.suffix != ".json":
            raise DatasetError(f"--out {out}: a score is a JSON file; give a name that ends in .json")
        require_writable(out)
    if is_dense_seal(public):
        return _open_dense(public, truth, submission, out)
    opened = unseal_set(public, truth, submission)  # checks the hash of the truth before any score
    if opened.pairs.note:
        print(f"note: {opened.pairs.note}", file=sys.stderr)
    print(f"seal {opened.seal.id}: the truth is the sealed one, the submission has each of {opened.seal.pairs} pairs")
    scored = score_outcomes(opened.submission.method, opened.pairs, opened.outcomes, Rules())
    scored = with_isolation(scored, opened.submission.isolation)
    print_scores([scored if out is None else saved_score(scored, out)], "terminal", "phi", wide=False)
    if out is not None:
        print(f"written: {out}")
    return int(nothing_answered([scored]))


def _open_dense(public: Path, truth: Path, submission: Path, out: Path | None) -> int:
    """Score of dense answers; the exit code is 1 if no pair was answered."""
    from phibench.benchmark.dense.dense_score import saved_dense
    from phibench.benchmark.dense.dense_tables import dense_board, dense_failures
    from phibench.benchmark.sealed.dense_submission import open_dense
    from phibench.datasets.common.shown_text import show_grid, table_console

    opened = open_dense(public, truth, submission)
    scored = opened.scored if out is None else saved_dense(opened.scored, out)
    document = scored.document
    print(f"seal {opened.seal}: the truth is the sealed one, the submission has each of {document.pairs} pairs")
    show_grid(table_console(False), dense_board([document]))
    for line in dense_failures(scored.records):
        print(f"{document.method.name}: {line}")
    if out is not None:
        print(f"written: {out}")
    return int(sum(document.failures.values()) == document.pairs)


submission = App(name="submission", group=KEEPERS, help="Check a score that is to be added to the results.")


@submission.command
def check(
    file: Path,
    *,
    data: Path | None = None,
    release: Path | None = None,
    method: str | None = None,
    calibration: Path | None = None,
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
    calibration
        File of `phibench calibrate`, of a score that was made with it: --data needs it to make the pairs.
    workers
        Pairs that are worked on at a time when the method is run again.
    """
    from phibench.benchmark.sealed.score_check import check_score

    checked = check_score(file, data, release, method, limits.of_run, workers, calibration=calibration)
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
