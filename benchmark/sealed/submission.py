"""Sealed set read as pairs; a method's answers to it (`submit`), checked and joined with the truth (`unseal`).

A submission says what a method answered on a sealed set and which method it was; it holds no images and no truth.
The command `submission check` is another thing: it checks a score file of an open set, by `score_check`.
Unsealing proves that truth and submission belong to the seal, and gives truths and outcomes for the score.
"""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Protocol

from pydantic import Field

from phibench.benchmark.isolation.answers import AnswerError, checked_answer
from phibench.benchmark.isolation.method_references import Reference, resolve
from phibench.benchmark.isolation.run_limits import RunLimits
from phibench.benchmark.isolation.runner import Harness, RunProvenance
from phibench.benchmark.pair_sets.frames_set import pair_of_files, read_truth_file
from phibench.benchmark.scores.score_document import Declared, MethodCard
from phibench.benchmark.sealed.sealed_set import SEAL, Seal, read_seal
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import InputFile, Name, Text
from phibench.datasets.store.files import write_text
from phibench.datasets.store.pair_files import MOST_PAIRS, PairFiles, PublicPair
from phibench.datasets.store.provenance import provenance
from phibench.datasets.store.schema import Document, Number, Vector2
from phibench.estimator.interface import FAILURES, Outcome, Pair, Spot
from phibench.estimator.pair_set import PairTruth, truth_folders

FORMAT = "phibench submission 1"
SINGLE_PAIRS = 4
"""Version of the task from which on a sealed set shows each sample once."""
Matrix = Annotated[tuple[Vector2, Vector2], Field(strict=False)]


# -- pairs ---------------------------------------------------------------------------------------------------------


class SealedPairs:
    """Pairs of a sealed set by number; every file is checked against its hash when it is read.

    Raises
    ------
    DatasetError
        If it is no sealed set, incomplete, or changed; in one sentence.
    """

    def __init__(self, folder: Path) -> None:
        self._seal = read_seal(folder)
        self._files = PairFiles(folder, PublicPair, self._seal.pairs, first=(SEAL,))
        self._truths: tuple[PairTruth, ...] | None = None

    def __len__(self) -> int:
        return len(self._files.rows)

    @property
    def folders(self) -> tuple[Path, ...]:
        """Folder of the set: the other pairs of a sample help."""
        return (self._files.folder,)

    @property
    def seal(self) -> Seal:
        """Seal of the set."""
        return self._seal

    @property
    def note(self) -> str:
        """Sentence on a set of the old kind; "" on others."""
        if self._seal.task_version >= SINGLE_PAIRS:
            return ""
        return (
            f"this set was sealed for task version {self._seal.task_version}, when a set could show a sample several "
            "times: its pairs help each other, so that a method that remembers them scores better than the images allow"
        )

    def pair(self, number: int) -> Pair:
        """Images of a pair, with what a user knows of the rig."""
        return pair_of_files(self._files, number)

    def with_truths(self, truths: Sequence[PairTruth]) -> SealedPairs:
        """The same set with the truths of all its pairs, by number."""
        opened = copy(self)
        opened._truths = tuple(truths)
        return opened

    def truth(self, number: int) -> PairTruth:
        """Exact answer for a pair, once the set is unsealed.

        Raises
        ------
        DatasetError
            If it is sealed: nobody who has only this folder has the truth.
        """
        self._files.row(number)
        if self._truths is not None:
            return self._truths[number]
        raise DatasetError(
            f"{self._files.folder} is sealed, the truth of pair {number} is not in it; "
            "send a submission to who sealed it"
        )

    def document(self) -> dict[str, Any]:
        """Provenance of the set."""
        return {"sealed": True, **self._seal.model_dump(mode="json")}

    def check(self) -> None:
        """Read every file once.

        Raises
        ------
        DatasetError
            If a file is missing, changed, or not of the set.
        """
        self._files.check()


# -- submissions ---------------------------------------------------------------------------------------------------


class SpotLine(Document):
    """`interface.Spot`."""

    uv_px: Vector2 | None
    covariance_px2: Matrix | None
    phi_rad: Number | None
    phi_convention: Text
    status: Text


class AnswerLine(Document):
    """One pair: an answer, or the failure that was instead of it."""

    number: Annotated[int, Field(ge=0, lt=MOST_PAIRS)]
    down: SpotLine | None
    up: SpotLine | None
    depth_m: Number | None
    sigma_depth_m: Number | None
    interval_depth_m: Vector2 | None = None
    seconds: Number
    failure: Name
    message: Text


class Submission(Document):
    """`submission.json`; `seal` is the id of the sealed set."""

    format: Name
    seal: Name
    task_version: int
    method: MethodCard
    isolation: Name = Field(default="", description="what the method could reach, by the word of who ran it")
    provenance: dict[str, Any]
    answers: Annotated[tuple[AnswerLine, ...], Field(strict=False)]


@dataclass(frozen=True)
class Submitted:
    """Result of `submit`: file, counts of answers and positions, commonest reason for no position, note on the set."""

    path: Path
    pairs: int
    answered: int
    positions: int
    silence: str
    note: str = ""


def submit(
    public: str | Path,
    method: str,
    out: str | Path,
    workers: int = 1,
    limits: RunLimits | None = None,
    declared: Declared | None = None,
) -> Submitted:
    """Run a method on a sealed set and write its answers.

    Parameters
    ----------
    public : folder of the sealed set
    method : str
        As for `isolation.runner.Harness`.
    out : JSON file to write
    workers : pairs that are worked on at a time
    limits : limits of the method for one pair
    declared : what its author says of it: division, and whether it calibrates the rig itself

    Raises
    ------
    DatasetError
        If the set was changed, the method cannot be run, or an answer is missing.
    """
    pairs, out = SealedPairs(Path(public)), Path(out)
    if out.is_dir():
        raise DatasetError(f"{out} is a folder; give a file such as submission.json, --out")
    pairs.check()
    reference = resolve(method)
    with Harness([reference], limits, workers, truth_folders(pairs)) as harness:
        outcomes = [outcome for (outcome,) in harness.outcomes(pairs, range(len(pairs)))]
        document = submission(pairs.seal, reference, outcomes, harness.isolations[0], harness.ran[0], declared)
    check_complete(document, pairs.seal, "the run")
    write_text(out, json.dumps(document.model_dump(mode="json"), indent=1, allow_nan=False) + "\n")
    spots = [spot for o in outcomes if o.answer is not None for spot in (o.answer.down, o.answer.up)]
    silent = Counter([f"{o.failure}: {o.message}" for o in outcomes if o.answer is None])
    silent.update(spot.status for spot in spots if spot.uv_px is None)
    positions = sum(spot.uv_px is not None for spot in spots)
    answered = sum(outcome.answer is not None for outcome in outcomes)
    silence = "".join(text for text, _ in silent.most_common(1))
    return Submitted(out, len(outcomes), answered, positions, silence, pairs.note)


def submission(
    seal: Seal,
    method: Reference,
    outcomes: Sequence[Outcome],
    isolation: str = "",
    ran: RunProvenance | None = None,
    declared: Declared | None = None,
) -> Submission:
    """Document of a method's outcomes on a sealed set, by number."""
    told = {**(declared or Declared()).fields(method.kind), **({} if ran is None else vars(ran))}
    return Submission(
        format=FORMAT,
        seal=seal.id,
        task_version=seal.task_version,
        method=MethodCard.of(method.name, **method.document(), **told),
        isolation=isolation,
        provenance=provenance(),
        answers=tuple(_line(outcome) for outcome in sorted(outcomes, key=lambda outcome: outcome.number)),
    )


def read_submission(path: Path) -> Submission:
    """Read a submission.

    Raises
    ------
    DatasetError
        If it is not readable or no submission; in one sentence.
    """
    file = InputFile(path, "give a submission, as `phibench seal submit` writes it")
    document = file.document(Submission)
    if document.format != FORMAT:
        raise DatasetError(f"{path} has the format '{document.format}', not '{FORMAT}'; write it with this phibench")
    return document


class _Answering(Protocol):
    """Document of answers, of spots or of dense pairs."""

    @property
    def seal(self) -> str: ...

    @property
    def task_version(self) -> int: ...

    @property
    def answers(self) -> Sequence[Any]: ...


class _Sealing(Protocol):
    """Seal of a set, of spots or of dense pairs."""

    @property
    def id(self) -> str: ...

    @property
    def task_version(self) -> int: ...

    @property
    def pairs(self) -> int: ...


def check_complete(document: _Answering, seal: _Sealing, name: str) -> None:
    """Refuse a submission of another seal or version, and one that has not each pair once; `name` is what it is called.

    Raises
    ------
    DatasetError
        In one sentence.
    """
    if document.seal != seal.id:
        raise DatasetError(
            f"{name} answers the seal {document.seal}, not {seal.id}; submit to the set that is unsealed"
        )
    if document.task_version != seal.task_version:
        text = f"{name} is of task version {document.task_version}, the seal of {seal.task_version}"
        raise DatasetError(f"{text}; submit again with the version of the seal")
    counts = Counter(line.number for line in document.answers)
    if twice := sorted(number for number, count in counts.items() if count > 1):
        raise DatasetError(f"{name} answers pair {twice[0]} twice; answer each once")
    if missing := sorted(set(range(seal.pairs)) - set(counts)):
        text = f"{name} lacks pair {missing[0]} ({len(missing)} of {seal.pairs} are missing)"
        raise DatasetError(f"{text}; a pair without a spot is answered with a status")
    if strange := sorted(set(counts) - set(range(seal.pairs))):
        raise DatasetError(f"{name} answers pair {strange[0]}, the seal has 0 to {seal.pairs - 1}; remove it")


def outcomes_of(document: Submission) -> list[Outcome]:
    """Outcomes of a submission, by number."""
    return [_outcome(line) for line in sorted(document.answers, key=lambda line: line.number)]


def _line(outcome: Outcome) -> AnswerLine:
    answer = outcome.answer
    return AnswerLine(
        number=outcome.number,
        down=None if answer is None else _spot_line(answer.down),
        up=None if answer is None else _spot_line(answer.up),
        depth_m=None if answer is None else _finite(answer.depth_m),
        sigma_depth_m=None if answer is None else _finite(answer.sigma_depth_m),
        interval_depth_m=None if answer is None else answer.interval_depth_m,
        seconds=math.nan if _finite(outcome.seconds) is None else float(outcome.seconds),
        failure=outcome.failure,
        message=without_folders(outcome.message),
    )


_FOLDERS = re.compile(r"""(?<![\w.:/\\])(?:~|[A-Za-z]:)?[\\/](?:[^\\/\s'"<>|:]+[\\/])+""")


def without_folders(text: str) -> str:
    """Message without the folders of the paths in it: a submission is published, a user's folders are his."""
    for folder in (Path.cwd(), Path.home()):
        text = text.replace(f"{folder}/", "") if len(folder.parts) > 1 else text
    return _FOLDERS.sub("", text)


def _spot_line(spot: Spot) -> SpotLine:
    uv, covariance = spot.uv_px, spot.covariance_px2
    matrix = None
    if covariance is not None:
        (uu, cross), (vu, vv) = covariance
        matrix = (float(uu), float(cross)), (float(vu), float(vv))
    return SpotLine(
        uv_px=None if uv is None else (float(uv[0]), float(uv[1])),
        covariance_px2=matrix,
        phi_rad=_finite(spot.phi_rad),
        phi_convention=spot.phi_convention,
        status=spot.status,
    )


def _finite(value: float | None) -> float | None:
    """Python float; None for what is not finite, which JSON cannot hold."""
    return None if value is None or not math.isfinite(value) else float(value)


def _outcome(line: AnswerLine) -> Outcome:
    """Outcome of a line, by the rules of the isolation: what is no answer there is none here."""
    has_answer = line.down is not None and line.up is not None
    if line.failure not in ("", *FAILURES) or has_answer == bool(line.failure) or line.seconds < 0.0:
        raise DatasetError(
            f"the submission's pair {line.number} is not one that `phibench seal submit` writes: "
            f"an answer or a failure of {', '.join(FAILURES)}, and seconds of 0 or above; submit again"
        )
    if line.down is None or line.up is None:
        return Outcome(line.number, None, line.seconds, line.failure, line.message)
    try:
        answer = checked_answer({**_plain(line), "down": _plain(line.down), "up": _plain(line.up)})
    except AnswerError as error:
        return Outcome(line.number, None, line.seconds, "invalid", str(error))
    return Outcome(line.number, answer, line.seconds)


def _plain(line: Document) -> dict[str, Any]:
    """Fields as `checked_answer` takes them: JSON's lists."""
    fields: dict[str, Any] = json.loads(line.model_dump_json())
    return fields


@dataclass(frozen=True)
class Unsealed:
    """Pairs with their truth, outcomes by number, and what they were proved to belong to."""

    seal: Seal
    submission: Submission
    pairs: SealedPairs
    outcomes: tuple[Outcome, ...]


def unseal(public: str | Path, truth: str | Path, submission: str | Path) -> Unsealed:
    """Join a submission with the truth that was sealed.

    Parameters
    ----------
    public : folder of the sealed set
    truth : file that `seal` wrote beside the data set
    submission : file that `submit` wrote

    Raises
    ------
    DatasetError
        If a file of the set was changed, the truth is not the sealed one, or the submission answers another seal or
        not each pair once; in one sentence.
    """
    pairs = SealedPairs(Path(public))
    pairs.check()
    truths = read_truth_file(Path(truth), pairs.seal.truth_sha256)
    if [truth_of_pair.number for truth_of_pair in truths] != list(range(len(pairs))):
        raise DatasetError(f"{truth} does not hold the truth of each pair once; seal the data set again")
    document = read_submission(Path(submission))
    check_complete(document, pairs.seal, str(submission))
    return Unsealed(pairs.seal, document, pairs.with_truths(truths), tuple(outcomes_of(document)))
