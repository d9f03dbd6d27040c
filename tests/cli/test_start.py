"""What a newcomer asks for first: every line that is printed works, and the recipes are those of the files."""

import shlex

import pytest

from phibench.cli.main import main
from phibench.cli.start import _FIRST
from phibench.datasets.recipe.load import RECIPES


def test_every_command_that_start_prints_is_there(capsys: pytest.CaptureFixture) -> None:
    assert main(["start"]) == 0
    shown = capsys.readouterr().out
    assert len(_FIRST) == 8
    for command, meaning in _FIRST:
        assert command in shown
        assert meaning in shown
        name, *words = shlex.split(command)
        assert name == "phibench"
        options = [word for word in words if word.startswith("--")]
        groups = [word for word in words[:2] if word.isalpha()]
        helped = [words[:n] for n in (2, 1) if len(groups) >= n]
        assert main([*(helped[0] if words[0] in ("recipe", "dataset", "method") else words[:1]), "--help"]) == 0
        page = capsys.readouterr().out
        assert [option for option in options if option not in page] == []


def test_recipes_are_listed_and_printed_as_their_files(capsys: pytest.CaptureFixture) -> None:
    assert main(["recipe", "list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    files = sorted(RECIPES.glob("*.toml"))
    assert [line.split()[0] for line in lines] == [path.stem for path in files]
    assert all(len(line.split()) > 2 for line in lines)
    for path in files:
        assert main(["recipe", "show", path.stem]) == 0
        assert capsys.readouterr().out == path.read_text(encoding="utf-8")
    for name, told in (("nope", "known: bench-dev"), ("bench_dev", "did you mean 'bench-dev'? known: bench-dev")):
        assert main(["recipe", "show", name]) == 2
        assert f"no recipe '{name}' is shipped; {told}" in capsys.readouterr().err
