"""`--sample` in every command that has it: a number or an id, with the same result and the same refusal."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from cyclopts import App

from phibench.cli import main as cli
from phibench.cli.main import main
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.read import open_dataset, place_of

FLAT = """
import numpy as np
from phibench.estimator.dense.dense_interface import DenseAnswer

def flat(pair):
    return DenseAnswer(depth_m=np.full(pair.shape, 2.0))
"""


def flat_method(folder: Path) -> str:
    """Reference of a method that takes no time."""
    (folder / "mine.py").write_text(FLAT, encoding="utf-8")
    return f"{folder / 'mine.py'}:flat"


COMMANDS: dict[str, Callable[[str, str, str], list[str]]] = {
    "dataset show": lambda folder, name, out: ["dataset", "show", folder, "--sample", name, "--html", f"{out}.html"],
    "dataset frames": lambda folder, name, out: [
        *("dataset", "frames", folder, "--sample", name, "--preset", "mono-raw", "--region", "32"),
        *("--workers", "1", "--out", out),
    ],
    "dataset panorama": lambda folder, name, out: [
        *(
            "dataset",
            "panorama",
            folder,
            "--sample",
            name,
            "--preset",
            "layers",
            "--width",
            "90",
            "--out",
            f"{out}.png",
        ),
    ],
    "export": lambda folder, name, out: [
        *("export", folder, "--to", "frames", "--sample", name, "--preset", "mono-raw", "--region", "32"),
        *("--workers", "1", "--out", out),
    ],
    "dense picture": lambda folder, name, out: [
        *("dense", "picture", folder, "--sample", name, "--method", flat_method(Path(out).parent), "--out", out),
    ],
    "calibrate": lambda folder, name, out: [
        *("calibrate", folder, "--sample", name, "--preset", "layers", "--out", f"{out}.json"),
    ],
}


def files(folder: Path) -> dict[str, bytes]:
    found = {file.name: file.read_bytes() for file in sorted(folder.rglob("*")) if file.is_file()}
    return {name: data for name, data in found.items() if not name.endswith((".json", ".jsonl", ".parquet"))}


SLOW = ("calibrate", "dense picture")  # two thirds of the time; that they take a number is asked of all commands below


@pytest.mark.parametrize("command", [pytest.param(c, marks=pytest.mark.slow) if c in SLOW else c for c in COMMANDS])
def test_a_number_does_what_the_id_does(
    tiny_dataset: Path, tmp_path: Path, command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Same files and words; a small image that cannot be calibrated is refused for that, and not for its number."""
    ids = [row.sample_id for row in open_dataset(tiny_dataset).rows]
    outs, said = [tmp_path / "number", tmp_path / "id"], []
    for out, name in zip(outs, ("1", ids[1]), strict=True):
        out.mkdir()
        code = main(COMMANDS[command](str(tiny_dataset), name, str(out / "made")))
        words = re.sub(r"after \d+ s", "", capsys.readouterr().err)  # a slow machine takes longer
        said.append((code, words.replace(str(out), "")))
    first, second = (files(out) for out in outs)
    assert said[0] == said[1]
    assert first == second
    assert (len(first) > 0) != (said[0][0] == 2)
    assert "no sample" not in said[0][1]


@pytest.mark.parametrize("command", COMMANDS)
def test_others_are_refused_alike(
    tiny_dataset: Path, tmp_path: Path, command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    ids = [row.sample_id for row in open_dataset(tiny_dataset).rows]
    for name, reason in (
        ("99", f"has {len(ids)}, numbered from 0 to {len(ids) - 1}"),
        ("nobody", "no sample 'nobody'"),
    ):
        assert main(COMMANDS[command](str(tiny_dataset), name, str(tmp_path / "made"))) == 2
        said = capsys.readouterr().err.strip().splitlines()
        assert reason in said[-1]


def test_no_command_with_this_option_is_left_out() -> None:
    """All commands with the option but `scene export`, which takes seconds for each scene."""

    def commands(app: App, before: tuple[str, ...] = ()) -> Iterator[str]:
        groups = [name for name in app if not name.startswith("-")]
        if not groups and any("--sample" in argument.names for argument in app.assemble_argument_collection()):
            yield " ".join(before)
        for name in groups:
            yield from commands(app[name], (*before, name))

    assert set(commands(cli.app)) - {"scene export"} == set(COMMANDS)


def test_an_id_goes_before_a_number() -> None:
    ids = ["7", "1", "0"]
    assert [place_of(name, ids, Path("x")) for name in ("7", "1", "0", "2")] == [0, 1, 2, 2]
    for name in ("3", "-1", "1.0", ""):
        with pytest.raises(DatasetError):
            place_of(name, ids, Path("x"))
    with pytest.raises(DatasetError, match="x has no samples"):
        place_of("0", [], Path("x"))


def test_a_sample_that_is_named_twice_comes_once(tiny_dataset: Path) -> None:
    dataset = open_dataset(tiny_dataset)
    name = dataset.rows[1].sample_id
    assert dataset.chosen(["1", name, "0"]) == (dataset[1], dataset[0])
    assert dataset["1"] == dataset[name]
