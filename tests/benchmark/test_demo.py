"""The demo as a newcomer runs it: five pairs of five kinds, three methods, one page, and the example changed."""

import shutil
from pathlib import Path

import pytest

from phibench.benchmark.export.export_make import verify_export
from phibench.benchmark.pair_sets.frames_set import FramesSet
from phibench.benchmark.reports import figures
from phibench.benchmark.reports.bench import DEMO_METHODS, EXAMPLE, FRAMES, REPORT, SHIPPED
from phibench.cli.main import main

METHODS = """
from phibench import Answer, Spot


def failing(pair):
    raise ValueError("no idea")


def silent(pair):
    return Answer(Spot.missing("dark"), Spot.missing("dark"))
"""


def test_the_shipped_frames_are_verified_as_a_frames_set(tmp_path: Path) -> None:
    """It has no dataset.json and no journal, which a data set with layers must have."""
    assert verify_export(SHIPPED) == []
    copy = tmp_path / "frames"
    shutil.copytree(SHIPPED, copy)
    lost = next(copy.rglob("*.up.jpg"))
    lost.unlink()
    assert verify_export(copy) == [f"{lost.relative_to(copy).as_posix()} is missing"]


def test_the_pairs_are_of_five_kinds() -> None:
    """Found, faint, hidden in one image, beside a lamp, saturated; each in a room of its own; 4 MB at most."""
    shipped = FramesSet(SHIPPED)
    shipped.check()
    truths = [shipped.truth(number) for number in range(len(shipped))]
    assert len(truths) == 5
    both = [truth for truth in truths if truth.down.visible and truth.up.visible]
    assert len(both) == 4
    faintest = [min(truth.down.snr, truth.up.snr) for truth in both]
    assert sum(snr < 15.0 for snr in faintest) == 1
    assert sum(truth.down.saturated or truth.up.saturated for truth in both) >= 1
    assert {truth.preset for truth in truths} == {"mjpeg"}
    assert sum(path.stat().st_size for path in SHIPPED.rglob("*") if path.is_file()) < 4e6


@pytest.mark.slow  # three methods on five whole frames, twice: 20 CPU-s
def test_the_demo_writes_one_page_and_scores_a_changed_example(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    out = tmp_path / "demo"
    assert main(["demo", "--out", str(out)]) == 0
    shown = capsys.readouterr().out
    assert all(name in shown for name in (*DEMO_METHODS, "extract", f"{out / REPORT}"))
    page = (out / REPORT).read_text(encoding="utf-8")
    assert all(name in page for name in DEMO_METHODS)
    assert len(FramesSet(out / FRAMES)) == 5
    example = out / EXAMPLE
    example.write_text(example.read_text(encoding="utf-8") + "\n# mine\n", encoding="utf-8")
    assert main(["demo", "--out", str(out)]) == 0
    assert example.read_text(encoding="utf-8").endswith("# mine\n")


def test_a_method_that_fails_on_every_pair_ends_in_1(
    tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Score, comparison, report and check of a submission say so."""
    (tmp_path / "mine.py").write_text(METHODS)
    command = ["score", str(SHIPPED), "--pairs", "1", "--track", "find", "--out", str(tmp_path / "run.json")]
    wanted = [f"{tmp_path}/mine.py:{name}" for name in ("failing", "silent")]
    assert main([*command, "--method", wanted[0], "--method", wanted[1]]) == 1
    told = "failed on the only pair with error: ValueError: no idea"
    assert f"mine:failing: {told}" in " ".join(capsys.readouterr().out.split())
    failed, silent = (tmp_path / f"run-mine-{name}.json" for name in ("failing", "silent"))
    assert main(["compare", str(failed), str(silent)]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert f"note: {failed}: mine:failing {told}" in shown
    assert f"note: {silent}" not in shown
    monkeypatch.setattr(figures, "encoded_figure", lambda *_: b"")  # the words are the subject
    page = tmp_path / "page.html"
    assert main(["report", str(failed), str(silent), "--out", str(page)]) == 0
    assert f"mine:failing {told}" in page.read_text(encoding="utf-8")
    assert main(["submission", "check", str(failed)]) == 1
    assert f"the method {told}" in capsys.readouterr().out


def test_a_folder_of_other_files_or_without_access_is_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    (tmp_path / "thesis.tex").write_text("mine")
    assert main(["demo", "--out", str(tmp_path)]) == 2
    assert "holds other files, such as thesis.tex" in capsys.readouterr().err
    (tmp_path / "file").write_text("no folder")
    assert main(["demo", "--out", str(tmp_path / "file" / "demo")]) == 2
    told = capsys.readouterr().err
    assert "cannot be written" in told
    assert "Traceback" not in told
