"""The frame of the studies: settings, folders, reports; each study has a test file of its own."""

from __future__ import annotations

import json
from pathlib import Path

import polars as pl
import pytest
from pydantic import Field
from rich.console import Console

from phibench.datasets.errors import DatasetError
from phibench.estimator.benchmark.report import write_report
from phibench.estimator.cli.main import main
from phibench.estimator.studies.framework import StudyDatasets, Result, Settings, Study, canvas, drawn, read_settings
from phibench.estimator.studies.run import find_study, read_study, section, write_study


class Counting(Settings):
    """Settings of the study below."""

    upto: int = Field(ge=1, le=100)
    step: int = Field(default=1, ge=1)
    ends: tuple[float, float] | None = Field(default=None, strict=False)


def _count(settings: Counting, datasets: StudyDatasets) -> Result:
    numbers = list(range(0, settings.upto, settings.step))
    with canvas() as figure:
        figure.subplots().plot(numbers, numbers)
        drawing = drawn("line", figure, f"A line up to {numbers[-1]}.")
    return Result(
        {"table": pl.DataFrame({"number": numbers})},
        (f"There are {len(numbers)} numbers.",),
        (drawing,),
        {"Numbers": (("number",), *((str(n),) for n in numbers))},
        ("nothing is left out",),
    )


COUNT = Study("count", "Counting", "How many numbers are there?", Counting, _count)


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


def test_same_study_same_bytes(tmp_path: Path, datasets: StudyDatasets) -> None:
    first, second = (_written(tmp_path / name, datasets) for name in "ab")
    names = sorted(path.name for path in first.iterdir())
    assert names == ["findings.md", "line.svg", "settings.json", "study.json", "table.parquet"]
    assert all((first / name).read_bytes() == (second / name).read_bytes() for name in names)


def test_read_back_and_in_a_report(tmp_path: Path, datasets: StudyDatasets) -> None:
    folder = _written(tmp_path / "study", datasets)
    assert read_study(folder).findings == ("There are 5 numbers.",)
    page = write_report([], tmp_path / "report.html", [section(folder)]).read_text(encoding="utf-8")
    for words in (
        "Study: Counting",
        "How many numbers",
        "There are 5 numbers.",
        "data:image/svg",
        "nothing is left out",
    ):
        assert words in page
    assert "<caption>Numbers</caption>" in page


def test_changed_or_missing_files_are_refused(tmp_path: Path, datasets: StudyDatasets) -> None:
    folder = _written(tmp_path / "study", datasets)
    (folder / "line.svg").write_text("other", encoding="utf-8")
    with pytest.raises(DatasetError, match=r"line\.svg is missing or was changed"):
        read_study(folder)
    document = json.loads((folder / "study.json").read_text(encoding="utf-8"))
    (folder / "study.json").write_text(json.dumps({**document, "version": 2}), encoding="utf-8")
    with pytest.raises(DatasetError, match="not the document of a study"):
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
