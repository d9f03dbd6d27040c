"""Running a study; its folder written and read (`study.json`, `findings.md`, tables, drawings); studies by name.

`run_study` is `phibench study`; `section` reads a folder back for the report. A full study can also be published: its
document goes beside the page of the study, whose numbers a test holds against it.
"""

from __future__ import annotations

import hashlib
import importlib
import json
import time
import traceback
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from pydantic import Field
from rich.console import Console

from phibench.benchmark.reports.report_sections import Section
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import FileName, InputFile
from phibench.datasets.common.progress import progress_console
from phibench.datasets.store.files import require_writable, sha256, write_bytes, write_text
from phibench.datasets.store.parquet_tables import parquet_bytes
from phibench.datasets.store.provenance import provenance
from phibench.datasets.store.schema import Document
from phibench.scenes.validation import nearest, printable_line
from phibench.studies.framework import (
    Drawing,
    Finding,
    Settings,
    Study,
    StudyDatasets,
    StudyResult,
    findings_table,
    markdown_table,
    read_settings,
)

KIND: Literal["phibench study"] = "phibench study"
DOCUMENT = "study.json"
_AGAIN = "run `phibench study` again"
FINDINGS = "findings.md"
DATA = "data"
NAMES = tuple(sorted(path.parent.name for path in Path(__file__).parent.glob("*/study.py")))
"""Folders with a study: adding one is adding its folder."""


class DrawingEntry(Document):
    """A drawing in the folder."""

    name: FileName
    kind: Literal["svg", "png"]
    alt: str


class StudyDocument(Document):
    """Content of `study.json`, and of the published document of a study."""

    kind: Literal["phibench study"] = KIND
    version: Literal[2] = 2
    name: str
    title: str
    question: str
    quick: bool
    settings: dict[str, Any]
    findings: tuple[Finding, ...]
    notes: tuple[str, ...]
    drawings: tuple[DrawingEntry, ...]
    shown: dict[str, tuple[tuple[str, ...], ...]] = Field(description="tables of text by caption, heads first")
    files: dict[FileName, str] = Field(description="SHA-256 of every other file by name")
    provenance: dict[str, Any]


def write_study(out: Path, study: Study[Any], settings: Settings, quick: bool, result: StudyResult) -> Path:
    """Write a result into a folder, the document last; files of an earlier run are replaced.

    Returns
    -------
    path : Path of `study.json`
    """
    out.mkdir(parents=True, exist_ok=True)
    (out / DOCUMENT).unlink(missing_ok=True)  # a folder without it holds no study
    files = {}
    for name, data in _files(study, settings, result).items():
        write_bytes(out / name, data)
        files[name] = hashlib.sha256(data).hexdigest()
    drawings = tuple(DrawingEntry(name=d.name, kind=d.kind, alt=d.alt) for d in result.drawings)  # type: ignore[arg-type]
    document = _document(study, settings, quick, result).model_copy(update={"drawings": drawings, "files": files})
    return _written(out / DOCUMENT, document)


def publish_study(folder: Path, study: Study[Any], settings: Settings, result: StudyResult, seconds: float) -> Path:
    """Write the document of a full study as `NAME.json`, beside the page of the study.

    Returns
    -------
    path : Path of `NAME.json`; it names no other files, and tells when the study ran and for how long
    """
    document = _document(study, settings, False, result)
    date = datetime.now(UTC).strftime("%d %B %Y").removeprefix("0")
    run = {"date": date, "duration": f"{seconds // 60:.0f} min {seconds % 60:.0f} s"}
    return _written(
        folder / f"{study.name}.json", document.model_copy(update={"provenance": run | document.provenance})
    )


def _document(study: Study[Any], settings: Settings, quick: bool, result: StudyResult) -> StudyDocument:
    return StudyDocument(
        name=study.name,
        title=study.title,
        question=study.question,
        quick=quick,
        settings=settings.model_dump(mode="json"),
        findings=result.findings,
        notes=result.notes,
        drawings=(),
        shown=result.shown,
        files={},
        provenance=dict(provenance()),
    )


def _written(path: Path, document: StudyDocument) -> Path:
    return write_text(path, document.model_dump_json(indent=1) + "\n")


def read_study(folder: Path) -> StudyDocument:
    """The document of a study's folder.

    Raises
    ------
    DatasetError
        If there is no finished study, it is of another version, or a file was changed.
    """
    path = folder / DOCUMENT
    if not path.is_file():
        raise DatasetError(f"{folder} holds no study: {DOCUMENT} is missing; make one with `phibench study`")
    document = InputFile(path, _AGAIN).document(StudyDocument)
    for name, digest in document.files.items():
        if not (folder / name).is_file() or sha256(folder / name) != digest:
            raise DatasetError(f"{folder / name} is missing or was changed after the study; run `phibench study` again")
    return document


def section(folder: Path) -> Section:
    """Section of a report about the study in a folder."""
    document = read_study(folder)
    drawings = [(entry, folder / f"{entry.name}.{entry.kind}") for entry in document.drawings]
    pictures = [
        Drawing(entry.name, InputFile(path, _AGAIN).read(), entry.alt, entry.kind).picture() for entry, path in drawings
    ]
    size = "Reduced version of the study (--quick)." if document.quick else ""
    notes = tuple(f"Note: {note}" for note in document.notes)
    return Section(
        title=f"Study: {document.title}",
        paragraphs=tuple(filter(None, (document.question, *notes, size))),
        pictures=tuple(pictures),
        tables=(findings_table(document.findings), *document.shown.values()),
        captions=("Findings", *document.shown),
    )


def findings_text(study: Study[Any], result: StudyResult) -> str:
    """The findings as Markdown: question, table, notes, further tables, drawings."""
    lines = [f"# {study.title}", "", study.question, "", markdown_table(findings_table(result.findings)), ""]
    lines += [f"* Note: {note}" for note in result.notes] + [""] * bool(result.notes)
    for caption, rows in result.shown.items():
        lines += [caption, "", markdown_table(rows), ""]
    for drawing in result.drawings:
        lines += [f"![{drawing.alt}]({drawing.file_name})", ""]
    return "\n".join(lines)


def _files(study: Study[Any], settings: Settings, result: StudyResult) -> dict[str, bytes]:
    tables = {f"{name}.parquet": parquet_bytes(table) for name, table in result.tables.items()}
    drawings = {drawing.file_name: drawing.data for drawing in result.drawings}
    text = json.dumps(settings.model_dump(mode="json"), indent=1) + "\n"
    return {**tables, **drawings, "settings.json": text.encode(), FINDINGS: findings_text(study, result).encode()}


def find_study(name: str) -> Study[Any]:
    """Study of a name; each module `studies/NAME/study.py` has its `STUDY`.

    Raises
    ------
    DatasetError
        If there is none, or its module cannot be imported or lacks a part of a study: the file, the line, and what.
    """
    if name not in NAMES:
        raise DatasetError(f"no study '{name}'; {nearest(name, NAMES)}")
    path = f"studies/{name}/study.py"
    try:
        module = importlib.import_module(f"phibench.studies.{name}.study")
    except (MemoryError, OSError):
        raise
    except Exception as error:  # whatever its author's code raises
        lines = [f.lineno for f in traceback.extract_tb(error.__traceback__) if f.filename.endswith(path)]
        place = f" line {lines[-1]}" if lines else ""
        fault = printable_line(f"{type(error).__name__}: {error}")
        raise DatasetError(f"{path}{place} has a fault: {fault}") from error
    study = getattr(module, "STUDY", None)
    if not isinstance(study, Study):
        raise DatasetError(f"{path} has no STUDY; end it with STUDY = Study(name, title, question, settings, run)")
    if study.name != name:
        raise DatasetError(f"{path}: its STUDY is called '{study.name}'; give it the name of its folder, '{name}'")
    if not (module.__doc__ or "").startswith(f"Study `{name}`: "):
        raise DatasetError(f'{path}: its first line must be """Study `{name}`: its help."""')
    return study


def run_study(
    name: str,
    out: Path,
    quick: bool = False,
    settings: Path | None = None,
    data: Path | None = None,
    workers: int | None = None,
    console: Console | None = None,
    publish: Path | None = None,
) -> StudyResult:
    """Run a study and write its folder.

    Parameters
    ----------
    name : name of the study
    out : folder
    quick : take the reduced settings
    settings : TOML file in place of the study's own
    data : folder of the data sets; by default `data` in `out`
    workers : processes that render
    console : where progress goes; by default the standard error
    publish : folder of the pages, for the document of a full study

    Raises
    ------
    DatasetError
        If there is no such study, its settings have faults, or its data sets cannot be had or lack what it needs.
    """
    study = find_study(name)
    if publish is not None and quick:
        raise DatasetError("--publish goes without --quick: the pages state the numbers of the full study")
    chosen = read_settings(study, quick, settings)
    if workers is not None and workers < 1:
        raise DatasetError(f"--workers {workers}: at least 1 is needed")
    if data is not None and data.exists() and not data.is_dir():
        raise DatasetError(f"--data {data} is a file; give the folder of the data sets")
    for document in (out / DOCUMENT, *((publish / f"{name}.json",) if publish else ())):
        require_writable(document)
    start = time.monotonic()
    result = study.run(chosen, StudyDatasets(data or out / DATA, console or progress_console(), workers))
    if not isinstance(result, StudyResult):
        raise DatasetError(f"studies/{name}: run gives a {type(result).__name__}; it must give a StudyResult")
    write_study(out, study, chosen, quick, result)
    if publish is not None:
        publish_study(publish, study, chosen, result, time.monotonic() - start)
    return result
