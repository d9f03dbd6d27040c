"""The frame of the studies: settings, findings, folders, reports; each study has a test file of its own."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import polars as pl
import pytest
from pydantic import Field
from rich.console import Console

import phibench.studies
from phibench.benchmark.reports.report_page import write_report
from phibench.cli.main import main
from phibench.datasets.common.errors import DatasetError
from phibench.studies import run
from phibench.studies.framework import (
    Finding,
    Settings,
    Study,
    StudyDatasets,
    StudyResult,
    canvas,
    findings_table,
    finished_drawing,
    markdown_table,
    number,
    read_settings,
)
from phibench.studies.run import find_study, publish_study, read_study, run_study, section, write_study


class Counting(Settings):
    """Settings of the study below."""

    upto: int = Field(ge=1, le=100)
    step: int = Field(default=1, ge=1)
    ends: tuple[float, float] | None = None


def _count(settings: Counting, datasets: StudyDatasets) -> StudyResult:
    numbers = list(range(0, settings.upto, settings.step))
    with canvas() as figure:
        figure.subplots().plot(numbers, numbers)
        drawing = finished_drawing("line", figure, f"A line up to {numbers[-1]}.")
    return StudyResult(
        {"table": pl.DataFrame({"number": numbers})},
        (Finding("count of numbers", len(numbers)).judged(">=", 3),),
        (drawing,),
        {"Numbers": (("number",), *((str(n),) for n in numbers))},
        ("nothing is left out",),
    )


COUNT = Study("count", "Counting", "How many numbers are there?", Counting, _count)


@pytest.mark.parametrize(
    ("ends", "relation", "threshold", "verdict"),
    [
        ((1.0, 0.5, 1.5), "<=", 2.0, "met"),
        ((1.0, 0.5, 1.5), "<=", 1.2, "undecided"),
        ((1.0, 0.5, 1.5), "<=", 0.4, "missed"),
        ((1.0, 0.5, 1.5), ">=", 0.4, "met"),
        ((1.0, 0.5, 1.5), ">=", 1.2, "undecided"),
        ((1.0, 0.5, 1.5), ">=", 2.0, "missed"),
        ((1.0, 0.5, 1.5), "=", 1.2, "met"),
        ((1.0, 0.5, 1.5), "=", 2.0, "missed"),
        ((1.0, 0.5, 1.5), "!=", 1.2, "undecided"),
        ((1.0, 0.5, 1.5), "!=", 2.0, "met"),
        ((1.0, None, None), "<=", 1.0, "met"),
        ((1.1, None, None), "<=", 1.0, "missed"),
        ((1.0, math.nan, math.nan), ">=", 1.5, "missed"),
        ((None, None, None), "<=", 1.0, "undecided"),
        ((math.inf, None, None), "<=", 1.0, "undecided"),
    ],
)
def test_the_whole_interval_decides(ends: Any, relation: Any, threshold: float, verdict: str) -> None:
    found = Finding("x", *ends).judged(relation, threshold)
    assert found.verdict == verdict
    assert found.threshold == threshold


@pytest.mark.parametrize(
    ("value", "text"),
    [(2.0, "2"), (0.73251, "0.733"), (123.4, "123"), (6240.0, "6240"), (1234.5, "1234"), (5.4e-6, "5.40e-06")]
    + [(-0.98, "-0.980"), (None, "-"), (math.nan, "-")],
)
def test_numbers_have_three_digits(value: float | None, text: str) -> None:
    assert number(value) == text


def test_tables_leave_empty_columns_out() -> None:
    plain = Finding("a|b", 1.5)
    assert findings_table([plain]) == (("finding", "value"), ("a|b", "1.50"))
    assert markdown_table(findings_table([plain])).splitlines()[-1] == "| a\\|b | 1.50 |"
    ranged = Finding.ranged("c", (0.01, 0.005, 0.015), "%", 100.0)
    rows = findings_table([plain, ranged.judged("<=", 2.0)])
    assert rows[0] == ("finding", "value", "95 %", "unit", "threshold", "verdict")
    assert rows[1] == ("a|b", "1.50", "", "", "", "")
    assert rows[2] == ("c", "1", "0.500 to 1.50", "%", "<= 2", "met")


def test_a_label_stands_once() -> None:
    with pytest.raises(DatasetError, match="same label: a"):
        StudyResult({}, (Finding("a", 1.0), Finding("a", 2.0)))


HEAD = '''"""Study `{name}`: a folder with a fault."""
from phibench.studies.framework import Finding, Settings, Study, StudyResult
class Own(Settings):
    pass
def run(settings, datasets):
    return {result}
'''


@pytest.mark.parametrize(
    ("end", "result", "begin"),
    [
        ("", "None", "studies/{}/study.py has no STUDY; end it with"),
        ('STUDY = Study("{}", "T", "Q?", Own)', "None", "studies/{}/study.py line 7 has a fault: TypeError"),
        ('STUDY = Study("{}", "T", "Q?", Own, ran)', "None", "studies/{}/study.py line 7 has a fault: NameError"),
        ('STUDY = Study("{}", "T", "Q?", run, Own)', "None", "studies/{}/study.py line 7 has a fault: DatasetError"),
        ('STUDY = Study("{}", "T", "Q?", Own, run)\nimport sos', "None", "studies/{}/study.py line 8 has a fault: Mod"),
        ('STUDY = Study("{}", "T", "Q?", Own, lambda s: s)', "None", "studies/{}/study.py line 7 has a fault: Data"),
        ("STUDY = (", "None", "studies/{}/study.py has a fault: SyntaxError: '(' was never closed (study.py, line 7)"),
        ('STUDY = Study("other", "T", "Q?", Own, run)', "None", "studies/{}/study.py: its STUDY is called 'other'"),
        ('__doc__ = "x"\nSTUDY = Study("{}", "T", "Q?", Own, run)', "None", "studies/{}/study.py: its first line must"),
        ('STUDY = Study("{}", "T", "Q?", Own, run)', "None", "studies/{}: run gives a NoneType; it must give"),
        ('STUDY = Study("{}", "T", "Q?", Own, run)', "StudyResult(dict(a=1), ())", "StudyResult.tables holds a int"),
        ('STUDY = Study("{}", "T", "Q?", Own, run)', "StudyResult(dict(), (1.0,))", "StudyResult.findings holds a"),
    ],
)
def test_a_fault_in_a_study_names_its_file(
    end: str, result: str, begin: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = tmp_path.name  # a module is imported once, and each case has another
    (tmp_path / "studies" / name).mkdir(parents=True)
    code = HEAD.format(name=name, result=result) + end.replace("{}", name) + "\n"
    (tmp_path / "studies" / name / "study.py").write_text(code, encoding="utf-8")
    (tmp_path / "none.toml").write_text("", encoding="utf-8")
    monkeypatch.setattr(phibench.studies, "__path__", [*phibench.studies.__path__, str(tmp_path / "studies")])
    monkeypatch.setattr(run, "NAMES", (name,))
    with pytest.raises(DatasetError) as caught:
        run_study(name, tmp_path / "out", settings=tmp_path / "none.toml", console=Console(quiet=True))
    assert str(caught.value).startswith(begin.replace("{}", name))


@pytest.fixture
def datasets(tmp_path: Path) -> StudyDatasets:
    return StudyDatasets(tmp_path / "data", Console(quiet=True))


def _written(folder: Path, datasets: StudyDatasets) -> Path:
    settings = Counting(upto=5)
    write_study(folder, COUNT, settings, True, COUNT.run(settings, datasets))
    return folder


def test_settings_take_the_reduced_numbers_only_when_asked(tmp_path: Path) -> None:
    file = tmp_path / "count.toml"
    file.write_text("upto = 50\nstep = 2\n[quick]\nupto = 4\n", encoding="utf-8")
    assert read_settings(COUNT, False, file) == Counting(upto=50, step=2)
    assert read_settings(COUNT, True, file) == Counting(upto=4, step=2)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("upto = 0", ("upto: 0", "from 1 up to")),
        ("upto = 5\nwidth = 3", ("width",)),
        ("step = 1", ("upto",)),
        ("upto = ", ("not valid TOML",)),
        ("upto = 5\nquick = 3", ("[quick]", "table")),
        ("upto = 5\nends = [1.0]", ("ends[1]: missing", "add a number")),
        ("upto = 5\nends = [1.0, 3.0, 4.0]", ("ends: [1.0, 3.0, 4.0]", "give a list of 2 (a number)")),
    ],
)
def test_bad_settings_end_in_a_sentence(tmp_path: Path, text: str, words: tuple[str, ...]) -> None:
    file = tmp_path / "count.toml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(DatasetError) as caught:
        read_settings(COUNT, False, file)
    said = str(caught.value).replace(str(tmp_path), "")
    assert all(word in said for word in words), said


class Nested(Settings):
    """An array of arrays, and arrays in tables."""

    strokes_m: tuple[tuple[float, float], ...]
    inner: dict[str, Counting] = Field(default_factory=dict)
    several: tuple[Counting, ...] = ()


NESTED = Study("nested", "Nested", "Do arrays come in?", Nested, lambda settings, datasets: StudyResult({}, ()))


def test_an_array_fills_a_tuple_wherever_it_stands(tmp_path: Path) -> None:
    file = tmp_path / "settings.toml"
    file.write_text(
        "strokes_m = [[0.1, 0.4]]\ninner.a = { upto = 1, ends = [0, 1.5] }\n[[several]]\nupto = 2", encoding="utf-8"
    )
    a, b = Counting(upto=1, ends=(0.0, 1.5)), Counting(upto=2)
    assert read_settings(NESTED, False, file) == Nested(strokes_m=((0.1, 0.4),), inner={"a": a}, several=(b,))
    file.write_text('strokes_m = [[0.1, "0.4"]]', encoding="utf-8")  # entries stay strict
    with pytest.raises(DatasetError, match=r"strokes_m\[0\]\[1\]: '0.4' is not allowed; give a number"):
        read_settings(NESTED, False, file)
    file.write_text("strokes_m = 0.4", encoding="utf-8")
    with pytest.raises(DatasetError, match=r"strokes_m: 0.4 is not allowed; give a list"):
        read_settings(NESTED, False, file)


def test_same_study_same_bytes(tmp_path: Path, datasets: StudyDatasets) -> None:
    first, second = (_written(tmp_path / name, datasets) for name in "ab")
    names = sorted(path.name for path in first.iterdir())
    assert names == ["findings.md", "line.svg", "settings.json", "study.json", "table.parquet"]
    assert all((first / name).read_bytes() == (second / name).read_bytes() for name in names)


def test_read_back_and_in_a_report(tmp_path: Path, datasets: StudyDatasets) -> None:
    folder = _written(tmp_path / "study", datasets)
    assert read_study(folder).findings == (Finding("count of numbers", 5.0, None, None, "", ">=", 3.0, "met"),)
    page = write_report([], tmp_path / "report.html", [section(folder)]).read_text(encoding="utf-8")
    for words in (
        "Study: Counting",
        "How many numbers",
        "count of numbers",
        "data:image/svg",
        "nothing is left out",
    ):
        assert words in page
    assert "<caption><span>Numbers</span></caption>" in page
    assert "<caption><span>Findings</span></caption>" in page
    text = (folder / "findings.md").read_text(encoding="utf-8")
    assert "| count of numbers | 5 | >= 3 | met |" in text


def test_the_published_document_names_no_files(tmp_path: Path, datasets: StudyDatasets) -> None:
    settings = Counting(upto=5)
    path = publish_study(tmp_path, COUNT, settings, COUNT.run(settings, datasets), 75.0)
    assert path == tmp_path / "count.json"
    document = json.loads(path.read_text(encoding="utf-8"))
    assert (document["files"], document["drawings"], document["quick"]) == ({}, [], False)
    assert document["findings"][0]["value"] == 5.0
    assert document["provenance"]["duration"] == "1 min 15 s"


def test_changed_or_missing_files_are_refused(tmp_path: Path, datasets: StudyDatasets) -> None:
    folder = _written(tmp_path / "study", datasets)
    (folder / "line.svg").write_text("other", encoding="utf-8")
    with pytest.raises(DatasetError, match=r"line\.svg is missing or was changed"):
        read_study(folder)
    document = json.loads((folder / "study.json").read_text(encoding="utf-8"))
    (folder / "study.json").write_text(json.dumps({**document, "version": 1}), encoding="utf-8")
    with pytest.raises(DatasetError, match=r"study\.json is damaged"):
        read_study(folder)
    (folder / "study.json").unlink()
    with pytest.raises(DatasetError, match="holds no study"):
        read_study(folder)


def test_mistakes_on_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(DatasetError, match="did you mean 'noise'"):
        find_study("nois")
    assert main(["study", "nois", "--out", str(tmp_path)]) == 2
    assert "nois" in capsys.readouterr().err
    assert main(["report", "--study", str(tmp_path), "--out", str(tmp_path / "r.html")]) == 2
    assert "holds no study" in capsys.readouterr().err
    assert main(["report", "--out", str(tmp_path / "r.html")]) == 2
    assert "a report of nothing" in capsys.readouterr().err
    assert main(["study", "noise", "--workers", "0", "--out", str(tmp_path)]) == 2
    assert "--workers 0" in capsys.readouterr().err
    assert main(["study", "noise", "--quick", "--publish", str(tmp_path), "--out", str(tmp_path)]) == 2
    assert "--publish goes without --quick" in capsys.readouterr().err
