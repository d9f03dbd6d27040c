"""Check of what a score says of its method: hashes, packages and files, and its answers by running it again.

Without the method only the form can be checked, and what this installation knows: built-in methods, and packages that
are installed here. With it, hashes are compared. With the data set as well it is run again.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import polars as pl
from rich.console import Console

from phibench.benchmark.isolation.resolve import MethodError, Reference, RunLimits, resolve
from phibench.benchmark.scores.document import SCORER, MethodCard, ScoreDocument
from phibench.benchmark.scores.score import run_and_score
from phibench.benchmark.sealed.rebuilt_score import GIVEN, differences
from phibench.datasets.common.version import program_version
from phibench.datasets.store.provenance import code_behind
from phibench.estimator.pair_set import PairSet

_HASH = re.compile("[0-9a-f]{64}")
_ALWAYS = "numpy"
"""Package that every method's process has: the interface needs it."""


@dataclass(frozen=True)
class Told:
    """Faults, and what could not be checked, a sentence each."""

    faults: tuple[str, ...]
    unchecked: tuple[str, ...]


def check_card(document: ScoreDocument, method: str | None = None) -> Told:
    """Check what a score says of its method and of the program that scored it.

    Parameters
    ----------
    document : ScoreDocument
    method : the method itself, as `phibench score` takes it

    Raises
    ------
    MethodError
        If the method cannot be found.
    """
    card = document.method
    faults = [*_of_form(card), *_of_program(document)]
    unchecked = [] if card.files_complete else ["method.files: the system did not tell every file that was opened"]
    unchecked += [f"method.files.{name}: it has no hash" for name, found in card.files.items() if found is None]
    reference = _known(card) if method is None else resolve(method)
    if reference is not None:
        faults += _of_reference(card, reference)
    else:
        unchecked.append("method.sha256, modules, files and packages: give the method itself, --method")
    if document.program != program_version() or "changed" in document.program:
        unchecked.append(f"code_sha256: it was scored by {document.program or 'a program that is not told'}")
    return Told(tuple(faults), tuple(unchecked))


def _of_form(card: MethodCard) -> Iterator[str]:
    if not card.sha256:
        yield "method.sha256 is missing: nobody can tell which code was scored"
    hashes = {"sha256": card.sha256, **card.modules, **card.files}
    for name, found in hashes.items():
        if found and not _HASH.fullmatch(found):
            yield f"method: the hash of {name} is no SHA-256, 64 digits from 0 to f"
    if not card.packages.get(_ALWAYS):
        yield f"method.packages lacks {_ALWAYS}, which every method loads: nobody can tell which packages ran"


def _of_program(document: ScoreDocument) -> Iterator[str]:
    program = program_version()
    if document.program == program and "changed" not in program and document.code_sha256 != code_behind(SCORER):
        yield f"code_sha256 is not that of {program}, which it says has scored it"


def _known(card: MethodCard) -> Reference | None:
    """The method as it is installed here: a built-in one, or one of a package in the same version."""
    if card.kind not in ("built-in", "package"):
        return None
    try:
        reference = resolve(card.reference)
    except MethodError:  # not here: nothing to compare with
        return None
    return reference if (reference.kind, reference.version) == (card.kind, card.version) else None


def _of_reference(card: MethodCard, reference: Reference) -> Iterator[str]:
    right = MethodCard.of(reference.name, **reference.document())
    for name in ("kind", "function", "version", "sha256", "sees"):
        given, found = getattr(card, name), getattr(right, name)
        if given != found:
            yield f"method.{name} is {_short(given)}, and that of {reference.name} is {_short(found)}"
    yield from _of_files("modules", card.modules, right.modules)


def _of_files(kind: str, given: Mapping[str, str | None], right: Mapping[str, str | None]) -> Iterator[str]:
    for name in sorted(set(given) ^ set(right)):
        place = "the method" if name in right else "the score"
        yield f"method.{kind}: {place} alone has {name}"
    for name in sorted(set(given) & set(right)):
        if given[name] != right[name]:
            yield f"method.{kind}.{name} has another hash than the method's file"


def _short(value: str | None) -> str:
    return repr(value) if value is None or len(value) <= 40 else f"{value[:12]!r} and so on"


def check_run(
    document: ScoreDocument,
    table: pl.DataFrame,
    method: str,
    pairs: PairSet,
    limits: RunLimits,
    workers: int,
    console: Console,
) -> Told:
    """Run the method again and compare its answers, packages and files; parameters as for `check_score`.

    Raises
    ------
    MethodError
        If it cannot be started.
    """
    (again,) = run_and_score([method], pairs, workers, console, "pairs again", document.seed, limits)
    names = [name for name in again.records.columns if name not in GIVEN]
    faults = list(differences(table, again.records, names, "what the method answers here"))
    given, right = document.method, again.document.method
    if right.files_complete:
        faults += _of_files("files", given.files, right.files)
    if lacking := sorted(set(right.packages) - set(given.packages)):
        faults.append(f"method.packages lacks {', '.join(lacking)}, which the method loads here")
    other = [name for name, version in given.packages.items() if right.packages.get(name) != version]
    unchecked = [
        f"method.packages.{name}: {given.packages[name]} there, {right.packages.get(name)} here" for name in other
    ]
    return Told(tuple(faults), tuple(unchecked))
