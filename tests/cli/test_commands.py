"""The tree of commands: the page that lists it, help that fits 80 columns, and answers to old spellings."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from cyclopts import App
from helpers.districts import DISTRICTS

from phibench.benchmark.isolation.run_limits import RunLimits
from phibench.cli import main as cli
from phibench.cli.main import OLD_COMMANDS, OLD_OPTIONS, OLD_POSITIONS
from phibench.cli.options import LIMITS, MEMORY_MB, SECONDS
from phibench.cli.studies import study_sentences
from phibench.studies.run import NAMES

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "commands.md"
LIMITED = ("method check", "score", "bench", "seal submit")


def commands(app: App = cli.app, before: tuple[str, ...] = ()) -> Iterator[str]:
    """Every command of the tree, "" and the groups included."""
    yield " ".join(before)
    for name in app:
        if not name.startswith("-"):
            yield from commands(app[name], (*before, name))


def leaves() -> set[str]:
    every = set(commands())
    return {name for name in every if name and not any(other.startswith(f"{name} ") for other in every)}


def table(heading: str) -> list[tuple[str, str]]:
    """Rows of the first table after a heading of the page, without its head."""
    lines = PAGE.read_text().split(heading)[1].splitlines()
    start = next(k for k, line in enumerate(lines) if line.startswith("|---"))
    rows = []
    for line in lines[start + 1 :]:
        if not line.startswith("|"):
            break
        left, right = (cell.strip() for cell in line.strip("|").split("|"))
        rows.append((left, right))
    return rows


def test_the_page_lists_every_command() -> None:
    named = {left.strip("`") for left, _ in table("# Commands")}
    others = {f"study {name}" for name in study_sentences()} - {"study noise"}  # named in the text of its row
    assert named | others == leaves()
    assert len(named) > 20


def test_the_page_lists_the_old_spellings() -> None:
    rows = dict(table("## Old spellings"))
    plain = {left.replace("`", ""): right.replace("`", "") for left, right in rows.items()}
    expected = {**OLD_COMMANDS, **{" ".join(key): new for key, new in OLD_OPTIONS.items()}}
    assert {key: plain[key] for key in expected} == expected
    assert len(plain) == len(expected) + len(OLD_POSITIONS) + 1  # and `score` without --method


def test_help_fits_80_columns(capsys: pytest.CaptureFixture[str], monkeypatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    for command in sorted(commands()):
        assert cli.main([*command.split(), "--help"]) == 0
        lines = capsys.readouterr().out.splitlines()
        assert len(lines) > 2, command
        assert max(map(len, lines)) <= 80, command
        assert not any("…" in line for line in lines), command  # nothing is cut off
        assert not any("--empty-" in line for line in lines), command


@pytest.mark.skipif(not shutil.which("bash"), reason="no bash here")
def test_bash_completes_commands_and_options(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = {
        "phibench m": "method measure",
        "phibench dataset ma": "make",
        "phibench dataset make --o": "--out",
        "phibench export x --to web": "webdataset",
        "phibench completion f": "fish",
    }
    assert cli.main(["completion", "bash"]) == 0
    script = tmp_path / "phibench"
    script.write_text(capsys.readouterr().out)
    calls = "".join(
        f'COMP_WORDS=({line}); COMP_CWORD={len(line.split()) - 1}; _phibench; echo "${{COMPREPLY[*]}}"\n'
        for line in lines
    )
    bash = ["bash", "--noprofile", "--norc", "-c", f"source {script}\ncomplete -p phibench\n{calls}"]
    child = subprocess.run(bash, capture_output=True, text=True, timeout=60, check=False)
    assert child.stderr == ""
    assert child.stdout.splitlines() == ["complete -F _phibench phibench", *lines.values()]


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_has_every_command(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["completion", shell]) == 0
    script = capsys.readouterr().out
    words = {word for name in leaves() for word in name.split()}
    assert len(words) > 40
    assert [word for word in words if not re.search(rf"\b{word}\b", script)] == []
    if shutil.which(shell):
        subprocess.run([shell, "-n"], input=script, capture_output=True, text=True, timeout=60, check=True)


@pytest.mark.parametrize(("old", "new"), OLD_COMMANDS.items())
def test_an_old_command_answers_with_the_new_one(old: str, new: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([*old.split(), "anything", "--out", "x"]) == 2
    said = capsys.readouterr().err
    assert f"is now `phibench {new}`" in said
    assert said.count("\n") == 1
    assert new.split(" --")[0] in leaves()


@pytest.mark.parametrize(("old", "new"), OLD_OPTIONS.items())
def test_an_old_option_answers_with_the_new_one(old, new: str, capsys: pytest.CaptureFixture[str]) -> None:
    command, option = old
    for words in ([option, "1"], [f"{option}=1"]):
        assert cli.main([*command.split(), "folder", *words]) == 2
        said = capsys.readouterr().err
        assert f"is now {new}" in said
        assert said.count("\n") == 1
    assert cli.main([*command.split(), "--help"]) == 0
    help_text = capsys.readouterr().out
    assert new.split(",")[0] in help_text
    assert not re.search(rf"{option}(\s|$)", help_text)


def test_a_folder_to_write_is_always_an_option(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["dataset", "merge", "out/a", "out/b"]) == 2
    said = capsys.readouterr().err
    assert "needs --out" in said
    assert said.count("\n") == 1


def test_score_without_a_method_names_the_command_of_the_tables(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["score", "out/paper"]) == 2
    assert "`phibench paper out/paper`" in capsys.readouterr().err


@pytest.mark.parametrize("option", ["--preset", "--draws", "--frames", "--rig"])
def test_options_of_the_misaligned_experiments(option: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["paper", "x", option, *(["2", "3"] if option == "--frames" else ["1"])]) == 2
    assert f"{option} is for the misaligned experiments" in capsys.readouterr().err
    assert cli.main(["paper", "x", "--misaligned", "--calibration", "c.json"]) == 2
    assert "--calibration does not go with --misaligned" in capsys.readouterr().err


@pytest.mark.parametrize("command", LIMITED)
def test_limits_wherever_methods_run(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([*command.split(), "--help"]) == 0
    said = capsys.readouterr().out
    assert "--seconds" in said
    assert "--memory-mb" in said
    assert "--fresh" in said
    assert "--allow" in said
    assert "default: 30.0" in " ".join(said.split())
    assert RunLimits(SECONDS, MEMORY_MB) == LIMITS.of_run == RunLimits()


def test_every_study_is_a_command() -> None:
    sentences = study_sentences()
    assert tuple(sentences) == NAMES
    assert len(NAMES) >= 8
    assert all(text[:1].isupper() and text.endswith(".") for text in sentences.values())


OLD_WORDS = re.compile(
    r"phibench (new-method|methods\b|check\b|submit\b|unseal\b|experiments\b|panorama\b|sensitivities\b|dataset seal\b)"
    r"|phibench score [\w/-]+\s*$"
)


def test_no_page_has_an_old_spelling() -> None:
    pages = [ROOT / "README.md", ROOT / "Makefile", *(ROOT / "docs").rglob("*.md"), *(ROOT / "datasets").rglob("*.md")]
    sources = [file for part in DISTRICTS for file in (ROOT / part).rglob("*.py")]
    checked = 0
    for file in [*pages, *sources]:
        checked += 1
        for line in file.read_text(encoding="utf-8").splitlines():
            assert not OLD_WORDS.search(line), f"{file}: {line}"
    assert checked > 200


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["loop", "bake", "--rooms", "0", "--out", "rooms"], "--rooms = 0: must be an integer, 1 or above"),
        (["loop", "run", "--episodes", "0"], "--episodes = 0: must be an integer, 1 or above"),
        (["loop", "show", "--episode", "-1", "--out", "a.mp4"], "--episode = -1: must be an integer, 0 or above"),
    ],
)
def test_counts_of_the_loop_are_checked(arguments, sentence, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert cli.main(arguments) == 2
    assert sentence in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_panorama_is_a_png(tiny_dataset, tmp_path, capsys):
    out = tmp_path / "unrolled.xyz"
    assert cli.main(["dataset", "panorama", str(tiny_dataset), "--out", str(out), "--width", "64"]) == 2
    assert "give a name that ends in .png" in capsys.readouterr().err
    assert not out.exists()
