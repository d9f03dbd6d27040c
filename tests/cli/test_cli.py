"""The command line: exit codes, one sentence per mistake, no traceback, no Mitsuba where none is needed."""

from __future__ import annotations

import functools
import io
import json
import math
import re
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import pytest
from helpers.processes import wait_until
from rich.console import Console

from phibench.cli import main as cli
from phibench.datasets.common.errors import DatasetError, RecipeError
from phibench.datasets.common.progress import Steps, StillRunning, progress_console
from phibench.datasets.make import MakeOptions
from phibench.datasets.verify import Report
from phibench.scenes.validation import SceneError
from phibench.studies.paper.paper_tables import Score


def run_with(monkeypatch, error):
    """Run `phibench dataset verify x` with a verification that raises."""

    def fail(directory, workers):
        raise error

    monkeypatch.setattr("phibench.datasets.verify.verify", fail)
    return cli.main(["dataset", "verify", "x"])


@pytest.mark.parametrize(
    ("error", "sentence"),
    [
        (SceneError("Stroke.stroke_m = 0: must be above 0"), "Stroke.stroke_m = 0: must be above 0"),
        (DatasetError("no manifest"), "no manifest"),
        (RecipeError("unknown key"), "unknown key"),
        (OSError(28, "No space left on device", "/out/x.exr"), "No space left on device: /out/x.exr"),
        (OSError("gone"), "gone"),
    ],
)
def test_mistakes_end_in_one_sentence(monkeypatch, capsys, error, sentence):
    assert run_with(monkeypatch, error) == 2
    out, err = capsys.readouterr()
    assert err == f"phibench: {sentence}\n"
    assert out == ""


@pytest.mark.parametrize(("faults", "code"), [((), 0), (("a.exr is damaged", "b.exr is missing"), 1)])
def test_verify_prints_every_fault(monkeypatch, capsys, faults, code):
    monkeypatch.setattr("phibench.datasets.verify.verify", lambda directory, workers: Report(faults, 9, 3))
    assert cli.main(["dataset", "verify", "x"]) == code
    assert capsys.readouterr().out.splitlines() == [*faults, f"x: 9 files, 3 samples, {len(faults)} faults"]


def test_interrupt_is_130(monkeypatch, capsys):
    assert run_with(monkeypatch, KeyboardInterrupt()) == 130
    assert capsys.readouterr().err.count("\n") == 1


def test_a_fault_of_ours_is_called_one(monkeypatch, capsys):
    assert run_with(monkeypatch, ValueError("ours")) == 3
    err = capsys.readouterr().err
    assert err.startswith("phibench: ValueError: ours (test_cli.py:")
    assert "fault of phibench: please report" in err
    assert err.count("\n") == 1
    monkeypatch.setenv("PHIBENCH_TRACEBACK", "1")
    with pytest.raises(ValueError, match="ours"):
        run_with(monkeypatch, ValueError("ours"))


@pytest.mark.parametrize("tokens", [["dataset", "verify"], ["scroe", "x"], ["score", "x", "--colour", "red"]])
def test_unknown_words_are_2(tokens, capsys):
    assert cli.main(tokens) == 2
    out, err = capsys.readouterr()
    assert "Traceback" not in out + err
    assert out + err


def test_score_of_a_folder_that_is_not_there(tmp_path, capsys):
    assert cli.main(["score", str(tmp_path / "nothing"), "--method", "detect"]) == 2
    assert "nothing" in capsys.readouterr().err


def test_scores_are_written_to_a_file(monkeypatch, tmp_path, capsys):
    scores = (Score("a", "mine", 2.0, 0.5, "exact", "truth", 2.1, 0.1, 0.05, math.nan, "ok"),)
    monkeypatch.setattr("phibench.datasets.read.open_finished", lambda directory: None)
    monkeypatch.setattr("phibench.studies.paper.paper_tables.score_estimators", lambda dataset, calibration: scores)
    assert cli.main(["paper", "x", "--out", str(tmp_path / "scores.json")]) == 0
    document = json.loads((tmp_path / "scores.json").read_text())
    assert document["scores"][0]["estimate_m"] == 2.1
    assert document["scores"][0]["published_m"] is None
    assert document["summary"][0]["rms"] == pytest.approx(0.05)
    assert "numpy" in document["provenance"]["packages"]
    narrow = capsys.readouterr().out
    assert "+5.000" in narrow
    assert max(map(len, narrow.splitlines())) <= 80
    assert cli.main(["paper", "x", "--wide"]) == 0
    assert "2.1000" in capsys.readouterr().out


def test_doctor_returns_its_exit_code(monkeypatch):
    def run(command, **options):
        assert command[1:] == ["-m", "phibench.render.setup.doctor"]
        return type("Done", (), {"returncode": 3})

    monkeypatch.setattr(cli.subprocess, "run", run)
    assert cli.main(["doctor"]) == 3


@pytest.mark.parametrize("command", ["score", "doctor", "dataset"])
def test_help_names_every_command(command, capsys):
    assert cli.main(["--help"]) == 0
    assert command in capsys.readouterr().out


@pytest.mark.slow
def test_help_and_score_load_no_renderer(python):
    code = """
import sys
from phibench.cli import main as cli
cli.main(["--help"])
heavy = {"numpy", "scipy", "pydantic", "mitsuba"} & set(sys.modules)
assert not heavy, heavy
cli.main(["score", "nowhere", "--method", "detect"])
cli.main(["paper", "nowhere"])
assert not {"mitsuba", "drjit"} & set(sys.modules)
"""
    done = python(code)
    assert done.returncode == 0, done.stderr


def sensitivities_kept(monkeypatch) -> list[Path]:
    """Folders whose sensitivities are asked for, instead of writing them."""
    kept: list[Path] = []
    monkeypatch.setattr("phibench.benchmark.make_dataset.keep_sensitivities", kept.append)
    return kept


@pytest.mark.parametrize(("before", "after"), [("", "1"), ("2", "2")])
def test_linear_algebra_has_one_thread_unless_asked(python, before, after):
    """It must be set before NumPy is loaded."""
    code = """
import os, sys
os.environ.pop("OPENBLAS_NUM_THREADS", None)
if sys.argv[1]:
    os.environ["OPENBLAS_NUM_THREADS"] = sys.argv[1]
from phibench.cli.main import main
assert "numpy" not in sys.modules
assert main(["--version"]) == 0
print(os.environ["OPENBLAS_NUM_THREADS"])
"""
    done = python(code, before)
    assert done.stdout.splitlines()[-1] == after, done.stderr


def test_repair_prints_what_it_made(monkeypatch, capsys):
    monkeypatch.setattr("phibench.datasets.merge_repair.repair", lambda *_, **__: ["view h0.000", "SHA256SUMS"])
    kept = sensitivities_kept(monkeypatch)
    assert cli.main(["dataset", "repair", "x", "--workers", "2"]) == 0
    assert kept == [Path("x")]
    assert capsys.readouterr().out.splitlines() == ["made again: view h0.000", "made again: SHA256SUMS"]


def test_merge_takes_any_number_of_shards(monkeypatch, tmp_path):
    calls = []

    def merge(out: Path, shards: tuple[Path, ...], console: object) -> Path:
        calls.append((out, list(shards)))
        return out

    monkeypatch.setattr("phibench.datasets.merge_repair.merge", merge)
    kept = sensitivities_kept(monkeypatch)
    assert cli.main(["dataset", "merge", str(tmp_path / "a"), str(tmp_path / "b"), "--out", str(tmp_path / "o")]) == 0
    assert calls == [(tmp_path / "o", [tmp_path / "a", tmp_path / "b"])]
    assert kept == [tmp_path / "o"]


def test_make_passes_shard_and_scheduler_on(monkeypatch, tmp_path):
    calls = []
    monkeypatch.setattr("phibench.datasets.make.make", lambda *args, **options: calls.append((args, options)))
    tokens = [
        "dataset",
        "make",
        "smoke",
        "--out",
        str(tmp_path),
        "--workers",
        "3",
        "--shard",
        "2/5",
        "--scheduler",
        "s",
    ]
    kept = sensitivities_kept(monkeypatch)
    assert cli.main(tokens) == 0
    assert kept == []  # a shard's are made when it is merged
    ((arguments, options),) = calls
    assert arguments == ("smoke", tmp_path, 3, None, "s")
    assert MakeOptions(**options) == MakeOptions(shard="2/5")


def lines_of(written: io.StringIO) -> list[str]:
    return written.getvalue().splitlines()


def wait_for(done: Callable[[], object]) -> None:
    wait_until(done, "a line")


def test_a_command_that_counts_nothing_says_that_it_runs():
    with StillRunning(Console(file=(written := io.StringIO())), "phibench study cause", every_s=0.1):
        wait_for(lambda: len(lines_of(written)) >= 2)
    assert [
        line for line in lines_of(written) if not re.fullmatch(r"phibench study cause: running for \d+ s", line)
    ] == []
    with StillRunning(Console(file=(written := io.StringIO())), "phibench method list"):  # a quick one says nothing
        time.sleep(0.2)
    assert lines_of(written) == []


def test_a_command_that_counts_is_not_spoken_over():
    console = Console(file=(written := io.StringIO()))
    with ExitStack() as steps:
        steps.enter_context(Steps(console, "pairs", 1))
        with StillRunning(console, "phibench bench", every_s=0.1):
            time.sleep(0.4)
            assert lines_of(written) == []
            steps.close()
            wait_for(lambda: "phibench bench: running for" in written.getvalue())


def test_every_command_is_told_of(monkeypatch, capsys):
    """A slow command is named by its first two words."""
    assert progress_console().stderr
    quick = functools.partialmethod(StillRunning.__init__, every_s=0.1)
    monkeypatch.setattr(StillRunning, "__init__", quick)
    console = Console(file=(written := io.StringIO()))
    monkeypatch.setattr("phibench.datasets.common.progress.progress_console", lambda: console)

    def slow(_folder: Path, workers: int) -> Report:
        wait_for(written.getvalue)
        return Report((), 0, 0)

    monkeypatch.setattr("phibench.datasets.verify.verify", slow)
    assert cli.main(["dataset", "verify", "x"]) == 0
    assert re.match(r"phibench dataset verify: running for \d+ s\n", written.getvalue())
    out = capsys.readouterr().out
    assert out == "x: 0 files, 0 samples, 0 faults\n"


def test_verify_prints_one_document_and_nothing_else(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for faults, code in (((), 0), (("views/x is missing",), 1)):
        report = Report(faults, files=7, samples=2, notes=("odd",))
        monkeypatch.setattr("phibench.datasets.verify.verify", lambda folder, workers, report=report: report)
        assert cli.main(["dataset", "verify", "x", "--json"]) == code
        document = json.loads(capsys.readouterr().out)
        assert document == {"faults": list(faults), "files": 7, "samples": 2, "notes": ["odd"], "valid": code == 0}
