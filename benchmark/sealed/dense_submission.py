"""Sealed dense sets read: a dense method's answers to one (`submit_dense`), and their score with the truth.

submission.json   seal, method, and per pair its file, seconds or failure
answers/          planes of each answer (OpenEXR, float32): D or the place in the up image, and sigma of D
SHA256SUMS        of everything above

Planes are rounded to float32, so D to 6e-8 of itself and a place to 6e-5 px. Whoever has the truth scores the answers
by the functions of `dense score`. Nothing else of a submission is believed but its seconds and words about failures.
"""

from __future__ import annotations

import json
import shutil
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import polars as pl
from pydantic import Field
from rich.console import Console

from phibench.benchmark.dense.dense_document import dense_document
from phibench.benchmark.dense.dense_records import TruthErrors, pair_records
from phibench.benchmark.dense.dense_score import DenseScored
from phibench.benchmark.isolation.method_references import DENSE, resolve
from phibench.benchmark.isolation.run_limits import RunLimits
from phibench.benchmark.isolation.runner import Harness
from phibench.benchmark.scores.answer_errors import Rules
from phibench.benchmark.scores.score_document import Declared, MethodCard
from phibench.benchmark.sealed.dense_set import DENSE_SEAL, DenseSeal, DenseSet, dense_pair_of_files
from phibench.benchmark.sealed.sealed_set import public_sha256
from phibench.benchmark.sealed.submission import check_complete, without_folders
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import SETTINGS_BYTES, FileName, InputFile, Name, Text
from phibench.datasets.common.progress import Steps, progress_console
from phibench.datasets.store.checksums import filling, read_checksums, with_checksums, write_documents
from phibench.datasets.store.files import sha256
from phibench.datasets.store.layers import read_exr, write_exr
from phibench.datasets.store.pair_files import MOST_PAIRS, PAIRS, PairFiles, PublicPair
from phibench.datasets.store.provenance import provenance
from phibench.datasets.store.schema import CHECKSUMS, Document, Number
from phibench.estimator.dense.dense_interface import DenseAnswer, DensePair, require_shape
from phibench.estimator.interface import FAILURES, Outcome

SUBMISSION, ANSWERS = "submission.json", "answers"
_PLACES = ("target_u_px", "target_v_px")
_FORMS = (("depth_m",), _PLACES)  # of an answer: D, or the place in the up image
_SIGMA = "sigma_depth_m"
_AGAIN = "download the set again"
_SUBMIT = "submit again with `phibench seal submit`"


def is_dense_seal(public: Path) -> bool:
    """True if a folder says of itself that it is a sealed dense set."""
    return (public / DENSE_SEAL).is_file()


def _listed(folder: Path, remedy: str) -> dict[str, str]:
    """Hashes that the folder's list has; a folder of somebody else is not made again, but asked for."""
    if not (folder / CHECKSUMS).is_file():
        raise DatasetError(f"{folder / CHECKSUMS} is missing; {remedy}")
    return read_checksums(folder)


class SealedDensePairs:
    """Dense pairs of a sealed dense set by number; every file is checked against its hash when it is read.

    Raises
    ------
    DatasetError
        If it is no sealed dense set, incomplete or changed; in one sentence.
    """

    def __init__(self, folder: Path) -> None:
        file = InputFile(folder / DENSE_SEAL, _AGAIN, limit_bytes=SETTINGS_BYTES)
        self.seal = file.document(DenseSeal)
        if public_sha256(_listed(folder, _AGAIN)) != self.seal.public_sha256:
            raise file.fault(f"and {CHECKSUMS} do not belong together, one was changed")
        self._files = PairFiles(folder, PublicPair, self.seal.pairs, first=(DENSE_SEAL,))

    def __len__(self) -> int:
        return self.seal.pairs

    @property
    def folders(self) -> tuple[Path, ...]:
        """Folder of the set: the other pairs of a room help."""
        return (self._files.folder,)

    @property
    def rows(self) -> list[PublicPair]:
        """Lines of the pairs."""
        return self._files.rows

    def pair(self, number: int) -> DensePair:
        """Images (down, up) with the laser off, as a method sees them; the arrays are read-only."""
        return dense_pair_of_files(self._files, number)

    def check(self) -> None:
        """Read every file once.

        Raises
        ------
        DatasetError
            If a file is missing, changed, or not of the set.
        """
        self._files.check()


class DenseAnswerLine(Document):
    """One pair: the file of its answer, or the failure that was instead of it."""

    number: Annotated[int, Field(ge=0, lt=MOST_PAIRS)]
    file: FileName | None
    seconds: Number
    failure: Name
    message: Text


class DenseSubmission(Document):
    """`submission.json` of a sealed dense set; `seal` is its id."""

    format: Literal["phibench dense submission 1"] = "phibench dense submission 1"
    seal: Name
    task_version: int
    method: MethodCard
    isolation: Name = Field(default="", description="what the method could reach, by the word of who ran it")
    provenance: dict[str, Any]
    answers: Annotated[tuple[DenseAnswerLine, ...], Field(strict=False, max_length=MOST_PAIRS)]


@dataclass(frozen=True)
class DenseSubmitted:
    """Result of `submit_dense`: folder, numbers of pairs and answers, commonest failure."""

    path: Path
    pairs: int
    answered: int
    silence: str


def submit_dense(
    public: Path,
    method: str,
    out: Path,
    workers: int = 1,
    limits: RunLimits | None = None,
    declared: Declared | None = None,
    console: Console | None = None,
) -> DenseSubmitted:
    """Run a dense method on a sealed dense set and write its answers as a folder.

    Parameters
    ----------
    public : folder of the sealed dense set
    method : str
        Built-in name, or "FILE.py:FUNCTION".
    out : folder to write; an earlier submission in it is replaced
    workers, limits, declared
        As for `submission.submit`.

    Raises
    ------
    DatasetError, MethodError
        If the set was changed, the folder holds something else, or the method cannot be run; in one sentence.
    """
    pairs, reference = SealedDensePairs(public), resolve(method, DENSE)
    pairs.check()
    with filling(out, lambda: _check_folder(out)):
        (out / CHECKSUMS).unlink(missing_ok=True)
        shutil.rmtree(out / ANSWERS, ignore_errors=True)
        lines: list[DenseAnswerLine] = []
        with Harness([reference], limits, workers, pairs.folders) as harness:
            with Steps(console or progress_console(), "dense pairs", len(pairs)) as steps:
                for first in range(0, len(pairs), workers):  # no more answers in memory than are worked on
                    asked = harness.outcomes(pairs, range(first, min(first + workers, len(pairs))))
                    lines += [_written(outcome, out) for (outcome,) in asked]
                    steps.reach(len(lines))
            isolation, ran = harness.isolations[0], harness.ran[0]
        told = {**(declared or Declared()).fields(reference.kind), **vars(ran)}
        document = DenseSubmission(
            seal=pairs.seal.id,
            task_version=pairs.seal.task_version,
            method=MethodCard.of(reference.name, **reference.document(), **told),
            isolation=isolation,
            provenance=provenance(),
            answers=tuple(lines),
        )
        text = json.dumps(document.model_dump(mode="json"), indent=1, allow_nan=False) + "\n"
        hashes = {line.file: sha256(out / line.file) for line in lines if line.file is not None}
        write_documents(out, with_checksums({SUBMISSION: text.encode()}, hashes))
    silent = Counter(f"{line.failure}: {line.message}" for line in lines if line.failure)
    answered = sum(line.file is not None for line in lines)
    return DenseSubmitted(out, len(lines), answered, "".join(text for text, _ in silent.most_common(1)))


def _check_folder(out: Path) -> None:
    held = [path.name for path in out.iterdir() if not path.name.startswith(".")] if out.is_dir() else []
    if set(held) - {SUBMISSION, ANSWERS, CHECKSUMS}:
        raise DatasetError(f"{out} holds something else: give a new folder, --out")


def _written(outcome: Outcome, out: Path) -> DenseAnswerLine:
    file, answer = None, outcome.dense
    if answer is not None:
        file = f"{ANSWERS}/{outcome.number:06d}.exr"
        write_exr(out / file, _planes(answer), {"kind": "dense answer", "number": outcome.number})
    seconds = float(outcome.seconds) if np.isfinite(outcome.seconds) else np.nan
    message = without_folders(outcome.message)
    return DenseAnswerLine(number=outcome.number, file=file, seconds=seconds, failure=outcome.failure, message=message)


def _planes(answer: DenseAnswer) -> dict[str, Any]:
    """Planes by name; a positive number below float32 becomes its least one, and stays positive."""
    least = np.finfo(np.float32).tiny
    places = answer.target_uv_px
    planes = {} if places is None else {name: places[..., axis] for axis, name in enumerate(_PLACES)}
    for name in ("depth_m", _SIGMA):
        if (plane := getattr(answer, name)) is not None:
            planes[name] = np.maximum(plane, least)  # NaN stays NaN
    return planes


# -- opened ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class DenseOpened:
    """Score of a submission, and the id of the seal that truth and submission were proved to belong to."""

    seal: str
    scored: DenseScored


def open_dense(
    public: Path, truth: Path, submission: Path, seed: int = 0, console: Console | None = None
) -> DenseOpened:
    """Join a submission with the truth that was sealed, and score it.

    Parameters
    ----------
    public : folder of the sealed dense set
    truth : `dense.truth.json` in the dense set with the truth
    submission : folder that `submit_dense` wrote
    seed : of the bootstrap

    Raises
    ------
    DatasetError
        If a file was changed, the truth is not the sealed one, or the submission answers another seal or not each pair
        once; in one sentence.
    """
    pairs = SealedDensePairs(public)
    pairs.check()
    true = _true_set(truth, pairs)
    document = _read_submission(submission)
    check_complete(document, pairs.seal, str(submission))
    listed, tables = _listed(submission, _SUBMIT), []
    with Steps(console or progress_console(), "dense pairs", len(true)) as steps:
        for line in sorted(document.answers, key=lambda line: line.number):
            errors = TruthErrors(true.truth(line.number))
            answer, failure, message = _answer(submission, line, listed, errors.truth.depth_m.shape)
            tables.append(pair_records(errors, answer, line.seconds, failure, message))
            steps.advance()
    table = pl.concat(tables)
    told = dense_document(document.method, true.document(), table, Rules(), seed, {}, document.isolation)
    return DenseOpened(pairs.seal.id, DenseScored(told, table))


def _true_set(truth: Path, pairs: SealedDensePairs) -> DenseSet:
    file = InputFile(truth, "give the dense.truth.json that was made with the sealed set", limit_bytes=SETTINGS_BYTES)
    if not truth.is_file():
        raise file.fault("is missing")
    if sha256(truth) != pairs.seal.truth_sha256:
        raise file.fault("is not the truth that was sealed")
    folder = truth.parent
    if file.json().get("sums_sha256") != sha256(folder / CHECKSUMS):
        raise DatasetError(f"{folder / CHECKSUMS} was changed after the set was sealed; put the dense set back")
    true = DenseSet(folder)
    shown = [PublicPair(**{k: v for k, v in dict(row).items() if k != "truth"}) for row in true.rows]
    if shown != pairs.rows:
        raise DatasetError(f"{pairs.folders[0] / PAIRS} does not show the pairs of {folder}; {_AGAIN}")
    return true


def _read_submission(folder: Path) -> DenseSubmission:
    if not folder.is_dir():
        raise DatasetError(f"{folder} is no folder: answers to dense pairs are one with {SUBMISSION}; {_SUBMIT}")
    return InputFile(folder / SUBMISSION, _SUBMIT).document(DenseSubmission)


def _answer(
    folder: Path, line: DenseAnswerLine, listed: dict[str, str], shape: Sequence[int]
) -> tuple[DenseAnswer | None, str, str]:
    """Answer of a line, its failure and the message, by the rules of the isolation: what is no answer is "invalid"."""
    known = line.failure in ("", *FAILURES) and (line.file is None) == bool(line.failure)
    if not known or line.seconds < 0.0:
        raise DatasetError(f"{folder / SUBMISSION}: pair {line.number} is neither answered nor failed; {_SUBMIT}")
    if line.file is None:
        return None, line.failure, line.message
    path = folder / line.file
    file = InputFile(path, _SUBMIT)
    if line.file not in listed or not path.is_file() or sha256(path) != listed[line.file]:
        raise file.fault(f"is missing, or not the file that {CHECKSUMS} lists")
    planes = read_exr(path, most_planes=1 + len(_PLACES)).planes
    form = next((form for form in _FORMS if set(planes) - {_SIGMA} == set(form)), None)
    if form is None:
        raise file.fault(f"has the planes {', '.join(sorted(planes))}: depth_m, or {' and '.join(_PLACES)}, are needed")
    try:
        depth = planes.get("depth_m")
        places = None if depth is not None else np.stack([planes[name] for name in _PLACES], axis=-1)
        answer = DenseAnswer(depth, places, planes.get(_SIGMA))
        require_shape(answer, (shape[0], shape[1]))
    except ValueError as error:
        return None, "invalid", str(error)
    return answer, "", ""
