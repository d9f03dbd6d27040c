"""A sample that cannot be made ends no run: the others are made, kept and whole, and one sentence says which it was."""

import json
import re
from pathlib import Path
from typing import Any

import pytest
from helpers import refusing_workers
from helpers.folders import contents
from helpers.inline_workers import make_inline
from helpers.processes import SMALLEST, quiet
from helpers.refusing_workers import REFUSED

from phibench.cli.main import main
from phibench.datasets.build import spot_task, tasks, workers
from phibench.datasets.build.journal import Journal
from phibench.datasets.common.errors import DatasetError, IncompleteError, RecipeError
from phibench.datasets.make import dry_run, make
from phibench.datasets.plan import sampling
from phibench.datasets.plan.plan import make_plan, shard_plan
from phibench.datasets.recipe.load import load_recipe
from phibench.datasets.store import schema
from phibench.datasets.verify import verify
from phibench.render.optics import certificate, spot_samples
from phibench.scenes.laser import LaserSpot
from phibench.scenes.room import Room, default_rig
from phibench.scenes.shapes import cuboid

DRAWN = """
[random]
samples = 3
stroke_m = 0.5

[random.spot]
target = { choice = ["near"] }
across_m = { uniform = [-0.02, 0.02] }
"""


@pytest.fixture(scope="module")
def recipe(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three samples with one rig and one stroke: they share their views, so that the test is quick."""
    path = tmp_path_factory.mktemp("refused") / "drawn.toml"
    path.write_text(SMALLEST.read_text().split("[[experiments]]")[0] + DRAWN)
    return path


@pytest.fixture(scope="module")
def whole(recipe: Path) -> Path:
    """The data set of which no sample is refused."""
    return make_inline(recipe, recipe.parent / "whole")


def task_files(out: Path) -> dict[str, bytes]:
    """Files that tasks have written, by name."""
    paths = ((path.relative_to(out).as_posix(), path) for path in out.rglob("*") if path.is_file())
    return {name: path.read_bytes() for name, path in paths if schema.is_task_file(name)}


def of_others(whole: Path) -> dict[str, bytes]:
    """Files of the tasks of the whole data set but those of the refused sample."""
    files = {name: data for name, data in task_files(whole).items() if REFUSED not in name}
    assert len(files) == len(task_files(whole)) - 3  # two spot layers and a picture
    return files


def finished_tasks(out: Path) -> list[str]:
    """Tasks that the log says were finished; the log is emptied."""
    entries = [json.loads(line) for line in (out / schema.LOG).read_text().splitlines()]
    (out / schema.LOG).write_text("")
    return sorted(entry["task"] for entry in entries if entry["ok"])


@pytest.mark.parametrize("count", [pytest.param(1, marks=pytest.mark.slow), 2])
def test_a_refused_sample_ends_no_run(
    recipe: Path, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, count: int
) -> None:
    """The others have the bytes of a run without it."""
    out = tmp_path / "out"
    monkeypatch.setattr(workers, "perform", refusing_workers.perform)
    with pytest.raises(IncompleteError) as caught:
        make(recipe, out, workers=count, console=quiet())
    first, line = str(caught.value).splitlines()
    assert first.startswith("1 of 3 samples are refused, all others are kept")
    assert line.startswith(f"  {REFUSED} is refused: a certificate is out of tolerance (down: chief ray 0.01 px (")
    assert line.endswith("; give another seed, or `--samples 1` for those before random-000001 alone")
    assert task_files(out) == of_others(whole)
    assert not (out / schema.CHECKSUMS).exists()


@pytest.mark.usefixtures("inline")
def test_the_same_command_tries_the_refused_sample_only(
    recipe: Path, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    monkeypatch.setattr(tasks, "perform", refusing_workers.perform)
    every = 3 * 2 + 2 + 1  # spots and samples, views, the light
    for made in (every - 2, 0):
        with pytest.raises(IncompleteError, match="1 of 3 samples are refused"):
            make(recipe, out, workers=1, console=quiet())
        assert len(finished_tasks(out)) == made
    assert verify(out).faults == (
        f"{out} was not finished: {REFUSED} is missing of 3 samples; run `phibench dataset make` again",
    )
    monkeypatch.undo()
    make_inline(recipe, out)
    assert finished_tasks(out) == [f"sample {REFUSED}", f"spot {REFUSED}"]
    assert contents(out) == contents(whole)


def never(number: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let no draw of a sample be possible."""
    sample = sampling._Makers._sample

    def refusing(self: Any, drawn: int, *rest: Any) -> Any:
        return "the wall is in the way" if drawn == number else sample(self, drawn, *rest)

    monkeypatch.setattr(sampling._Makers, "_sample", refusing)


@pytest.mark.usefixtures("inline")
def test_a_sample_that_cannot_be_drawn_ends_no_run(
    recipe: Path, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    never(1, monkeypatch)
    out = tmp_path / "out"
    reason = "has no possible rig, spot and stroke in 100 draws; the last: the wall is in the way; change the"
    assert f"will be refused: {REFUSED}: {reason}" in dry_run(recipe, out, workers=1)
    for _ in range(2):  # the second time, nothing but that sample is left
        assert main(["dataset", "make", str(recipe), "--out", str(out), "--workers", "1"]) == 1
        assert re.search(rf"samples are refused.*\n  {REFUSED} is refused: {reason}", capsys.readouterr().err)
    assert task_files(out) == of_others(whole)
    assert not (out / schema.CHECKSUMS).exists()
    assert main(["dataset", "verify", str(out)]) == 1
    assert f"{out} was not finished: {REFUSED} is missing of 3 samples" in capsys.readouterr().out


def test_a_refused_sample_keeps_its_place_among_shards(recipe: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Shards own the same samples as without it, so that those that are finished stay good."""
    plan = make_plan(load_recipe(recipe))
    never(1, monkeypatch)
    lacking = make_plan(load_recipe(recipe))
    assert list(lacking.refused) == [REFUSED]
    for shard in ("1/2", "2/2"):
        owned = [pair for pair in shard_plan(plan, shard).pairs if pair.sample_id != REFUSED]
        assert list(shard_plan(lacking, shard).pairs) == owned
    assert [list(shard_plan(lacking, f"{i}/2").refused) for i in (1, 2)] == [[], [REFUSED]]


@pytest.mark.usefixtures("inline")
def test_a_recipe_of_which_no_sample_is_possible_ends_at_once(
    recipe: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sampling._Makers, "_sample", lambda *_: "the wall is in the way")
    with pytest.raises(RecipeError, match="sample 0 has no possible rig, spot and stroke in 100 draws"):
        make(recipe, tmp_path / "out", workers=1, console=quiet())
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("inline")
def test_a_bug_beside_a_refused_sample_is_no_refusal(
    recipe: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A task that fails by a fault of the program is reported as before, with its traceback."""
    never(1, monkeypatch)
    monkeypatch.setattr("phibench.datasets.build.sample_task.save_png", lambda *_: 1 / 0)
    with pytest.raises(DatasetError, match=r"2 of \d+ tasks failed(.|\n)*ZeroDivisionError") as caught:
        make(recipe, tmp_path / "out", workers=1, console=quiet())
    assert not isinstance(caught.value, IncompleteError)
    assert "spot random-000002" in Journal(tmp_path / "out").entries


def test_a_layer_of_too_few_pairs_is_made_again_before_its_sample_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """An edge cuts the light. 2^6 pairs are wrong by some percent of the flux, of which 0.3 % are allowed."""
    view, spot = default_rig().at(0.4), LaserSpot((2.0, 0.0, 0.5), (-1, 0, 0), 5e-3)
    room = Room("cut", (), (cuboid("screen", (1.9, -0.501, 0.5), (0.01, 1.0, 1.0), (0.5, 0.5, 0.5)),))
    enough = spot_task.answer_spot(view, spot, room).layer.total_electrons_per_s[0]
    monkeypatch.setattr(spot_samples, "_LOG2_DENSE", 6)
    monkeypatch.setattr(spot_task, "_LOG2_MORE_PAIRS", (17,))
    monkeypatch.setattr(certificate, "_LOG2_RAYS", (15,))
    with monkeypatch.context() as never_again:
        never_again.setattr(spot_task, "_LOG2_MORE_PAIRS", ())
        few = spot_task.answer_spot(view, spot, room)
    more = spot_task.answer_spot(view, spot, room)
    assert few.certificate is not None
    assert more.certificate is not None
    assert not few.certificate.passed
    assert more.certificate.passed
    # 2^17 Sobol' pairs: to about 1e-3 of the flux; the same pairs give the same layer
    assert more.layer.total_electrons_per_s[0] == pytest.approx(enough, rel=1e-12)
    assert few.layer.total_electrons_per_s[0] != pytest.approx(enough, rel=3e-3)
