"""Data sets that are finished without their refused samples: the same bytes however it came to that."""

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from helpers import inline_workers, refusing_workers
from helpers.damage import write_checksums
from helpers.folders import contents
from helpers.inline_workers import make_inline
from helpers.processes import SMALLEST, quiet
from helpers.sealed_sets import with_secret_seed

from phibench.benchmark.export.export_make import export
from phibench.benchmark.export.pair_rows import ExportRequest
from phibench.benchmark.sealed.sealed_set import seal
from phibench.cli.main import main
from phibench.datasets.build import sample_task, spot_task, tasks, workers
from phibench.datasets.build.journal import Journal
from phibench.datasets.build.tasks import BuildTask, Done, Failed
from phibench.datasets.common.errors import DatasetError, IncompleteError
from phibench.datasets.frames.frame_request import FrameOptions
from phibench.datasets.make import dry_run, make
from phibench.datasets.merge_repair import merge, repair
from phibench.datasets.plan import sampling
from phibench.datasets.plan.plan import make_plan
from phibench.datasets.read import open_finished
from phibench.datasets.recipe.load import load_recipe, parse_recipe
from phibench.datasets.show import summary
from phibench.datasets.store import schema
from phibench.datasets.verify import verify
from phibench.render.optics.certificate import certify

# every sample has its own rig and views, which go with it; numbers 1 and 3 are refused below
OWN_RIGS = """
[random]
samples = 5
stroke_m = 0.5

[random.rig]
fx_px = { uniform = [176.0, 181.0] }

[random.spot]
target = { choice = ["near"] }
across_m = { uniform = [-0.02, 0.02] }
"""
TEXT = SMALLEST.read_text().split("[[experiments]]")[0] + OWN_RIGS
LEFT_OUT = ["random-000001", "random-000003"]


@pytest.fixture(scope="module")
def recipe(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("left-out") / "drawn.toml"
    path.write_text(TEXT)
    return path


@pytest.fixture(scope="module")
def whole(recipe: Path) -> Path:
    """The data set of which no sample is refused."""
    return make_inline(recipe, recipe.parent / "whole")


@cache
def refused() -> tuple[Any, str]:
    """A `certify` that refuses the spots of numbers 1 and 3, the same one for all tests, and the down view of 3."""
    plan = make_plan(parse_recipe(TEXT))
    spots = [plan.spots[name].position_world_m for name in LEFT_OUT]

    def certified(view: Any, spot: Any, *rest: Any) -> Any:
        found = certify(view, spot, *rest)
        bad = spot.position_world_m in spots
        return replace(found, chief_difference_px=0.01, passed=False) if bad else found

    return certified, f"view {next(pair for pair in plan.pairs if pair.sample_id == LEFT_OUT[1]).pose_id('down')}"


def refusing() -> pytest.MonkeyPatch:
    """Refuse the spot of number 1, and both the down view and the spot of number 3; the caller undoes it.

    The view comes after the spot in a run that is left alone: the spot's cause is the sample's.
    """
    patch, (certified, view), do = pytest.MonkeyPatch(), refused(), tasks.perform

    def perform(task: BuildTask, *rest: Any) -> Done | Failed:
        return Failed("its room cannot be built", refused=True) if task.name == view else do(task, *rest)

    patch.setattr(spot_task, "certify", certified)
    patch.setattr(tasks, "perform", perform)
    patch.setattr("phibench.datasets.make.WorkerPool", inline_workers.InlineWorkerPool)
    return patch


@pytest.fixture
def refusals() -> Iterator[pytest.MonkeyPatch]:
    patch = refusing()
    yield patch
    patch.undo()


@pytest.fixture(scope="module")
def finished(recipe: Path) -> Path:
    """The data set that is finished without the two."""
    out, patch = recipe.parent / "finished", refusing()
    make(recipe, out, workers=1, console=quiet(), leave_out_refused=True)
    patch.undo()
    return out


def test_it_is_whole_but_for_the_refused_samples(whole: Path, finished: Path) -> None:
    dataset, before = open_finished(finished), open_finished(whole)
    assert [row.sample_id for row in dataset.rows] == [f"random-{k:06d}" for k in (0, 2, 4)]
    assert dataset.rows == tuple(row for row in before.rows if row.sample_id not in LEFT_OUT)
    assert dataset.info.samples == 3
    assert list(dataset.info.causes) == LEFT_OUT
    cause = "a certificate is out of tolerance (down: chief ray 0.01 px (tolerance 1e-06)"
    assert all(text.startswith(cause) for text in dataset.info.causes.values())
    # nothing of theirs is left, and every layer of the others has the bytes that it has beside them
    held, wanted = contents(finished), contents(whole)
    rigs = [row.rig for row in before.rows if row.sample_id in LEFT_OUT]
    files = {name for name in held if schema.is_task_file(name)}
    theirs = {name for name in wanted if any(one in name for one in (*LEFT_OUT, *(f"{rig}-" for rig in rigs)))}
    assert len(theirs) == 2 * (2 * 3 + 2 + 1)  # each: files of two views, two spot layers, a picture
    assert files == {name for name in wanted if schema.is_task_file(name)} - theirs
    there = (path for path in (finished / "views").rglob("*") if path.is_file())
    assert {path.relative_to(finished).as_posix() for path in there} <= files
    assert all(held[name] == wanted[name] for name in files)
    assert len(dataset.rigs) == len(before.rigs) - 2
    about = json.loads((finished / schema.CROISSANT).read_text())["description"]
    assert "3 pairs, 3 rigs, 1 room. Left out, because refused: 2 pairs." in about
    assert "2 refused and left out" in repr(dataset)
    assert [one["sample_id"] for one in summary(finished)["left_out"]] == LEFT_OUT
    assert "left_out" not in json.loads((whole / schema.INFO).read_text())


@pytest.mark.slow
@pytest.mark.parametrize(("tasks_done", "newest_first"), [(1, False), (6, True), (11, False), (17, True)])
def test_kills_and_the_order_of_tasks_change_no_byte(
    recipe: Path,
    finished: Path,
    refusals: pytest.MonkeyPatch,
    tmp_path: Path,
    tasks_done: int,
    newest_first: bool,
) -> None:
    """A kill between two tasks, then the same command; `newest_first` runs a view before the spot."""
    out, perform, count = tmp_path / "out", tasks.perform, 0

    def killed(*arguments: Any) -> Done | Failed:
        nonlocal count
        count += 1
        if count > tasks_done:
            raise KeyboardInterrupt
        return perform(*arguments)

    refusals.setattr(inline_workers.InlineExecutor, "newest_first", newest_first)
    options: Any = {"workers": 1, "console": quiet(), "leave_out_refused": True}
    refusals.setattr(tasks, "perform", killed)
    with pytest.raises(KeyboardInterrupt):
        make(recipe, out, **options)
    refusals.setattr(tasks, "perform", perform)
    make(recipe, out, **options)
    assert contents(out) == contents(finished)


def said(capsys: pytest.CaptureFixture[str]) -> str:
    return capsys.readouterr().err


def test_what_it_says_and_that_it_is_finished(
    recipe: Path,
    finished: Path,
    refusals: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Without the option the error names it; with it what is there is kept; a third run does nothing."""
    out = tmp_path / "out"
    words = ["dataset", "make", str(recipe), "--out", str(out), "--workers", "1"]
    assert main(words) == 1
    assert "not finished (`phibench dataset make ... --leave-out-refused` finishes it without them):" in said(capsys)
    assert not (out / schema.CHECKSUMS).exists()
    (out / schema.LOG).unlink()
    option = [*words, "--leave-out-refused"]
    assert "will be left out" not in dry_run(recipe, out, workers=1)  # what a certificate says is known later
    assert main(option) == 0
    text = said(capsys)
    assert f"{out}: 2 of 5 samples are refused and left out: {', '.join(LEFT_OUT)}; dataset.json lists them:" in text
    assert f"\n  {LEFT_OUT[0]}: a certificate is out of tolerance (down: chief ray 0.01 px (" in text
    assert not (out / schema.LOG).exists()  # no task was done again
    assert contents(out) == contents(finished)
    assert f"will be left out: {LEFT_OUT[0]}: a certificate" in dry_run(recipe, out, leave_out_refused=True)
    assert main(option) == 0
    assert f"{out} is complete, nothing to do; 2 of 5 samples are refused and left out: " in said(capsys)
    assert not (out / schema.LOG).exists()
    # without the option the end of the data set would be lost
    assert main(words) == 2
    text = said(capsys)
    assert f"{out} is finished, and 2 of 5 samples are refused and left out" in text
    assert "add `--leave-out-refused` to keep it so, or `--replace` to try them again" in text
    assert "will be refused" in dry_run(recipe, out, workers=1)
    assert contents(out) == contents(finished)
    assert main([*words, "--replace"]) == 1
    assert not (out / schema.CHECKSUMS).exists()
    assert main(option) == 0
    assert contents(out) == contents(finished)


def test_more_samples_are_added_and_fewer_keep_them(
    recipe: Path, finished: Path, refusals: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    options: Any = {"workers": 1, "console": quiet(), "leave_out_refused": True}
    make(recipe, out, samples=4, **options)
    (out / schema.LOG).unlink()
    make(recipe, out, **options)
    names = [json.loads(line)["task"] for line in (out / schema.LOG).read_text().splitlines()]
    assert len(names) == 4  # spot, two views and sample of number 4
    assert {name.rsplit("-")[-1] for name in names if not name.startswith("view")} == {"000004"}
    assert contents(out) == contents(finished)
    make(recipe, out, samples=2, **options)
    assert contents(out) == contents(finished)


@pytest.mark.usefixtures("refusals")
def test_shards_merge_to_the_same_bytes(recipe: Path, finished: Path, tmp_path: Path) -> None:
    options: Any = {"workers": 1, "console": quiet(), "leave_out_refused": True}
    parts = [make(recipe, tmp_path / f"part{i}", shard=f"{i}/2", **options) for i in (1, 2)]
    assert [list(open_finished(part).info.causes) for part in parts] == [LEFT_OUT[:1], LEFT_OUT[1:]]
    merged = merge(tmp_path / "merged", parts, quiet())
    assert contents(merged) == contents(finished)
    assert verify(merged, console=quiet()).faults == ()


@pytest.mark.usefixtures("refusals")
def test_without_one_sample_there_is_no_data_set(recipe: Path, tmp_path: Path) -> None:
    """A shard of which every sample is refused stays unfinished, and the option is not offered."""
    with pytest.raises(IncompleteError, match=r"1 of 1 samples are refused.*the data set is not finished:") as caught:
        make(recipe, tmp_path / "out", workers=1, console=quiet(), shard="2/5", leave_out_refused=True)
    assert "--leave-out-refused" not in str(caught.value)
    assert not (tmp_path / "out" / schema.CHECKSUMS).exists()


@pytest.mark.slow
@pytest.mark.usefixtures("refusals")
@pytest.mark.parametrize(
    "lost",
    [
        [schema.INFO],
        [schema.MANIFEST, schema.CROISSANT],
        ["spots/random-000002-up.exr", "previews/random-000004.png"],
        [schema.JOURNAL],
    ],
)
def test_repair_gives_the_same_bytes(finished: Path, tmp_path: Path, lost: list[str]) -> None:
    out = tmp_path / "out"
    shutil.copytree(finished, out)
    for name in lost:
        (out / name).unlink()
    assert verify(out, console=quiet()).faults
    done = repair(out, 1, quiet())
    assert not any(name.split(" ")[-1] in LEFT_OUT for name in done)
    assert contents(out) == contents(finished)
    assert repair(out, 1, quiet()) == []


def test_a_sample_that_cannot_be_drawn_is_left_out(recipe: Path, whole: Path, tmp_path: Path) -> None:
    out, sample = tmp_path / "out", sampling._Makers._sample
    options: Any = {"workers": 1, "console": quiet(), "leave_out_refused": True}

    def never(self: Any, number: int, *rest: Any) -> Any:
        return "the wall is in the way" if number == 1 else sample(self, number, *rest)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sampling._Makers, "_sample", never)
        patch.setattr("phibench.datasets.make.WorkerPool", inline_workers.InlineWorkerPool)
        assert f"will be left out: {LEFT_OUT[0]}: has no possible rig" in dry_run(recipe, out, leave_out_refused=True)
        make(recipe, out, **options)
        held = contents(out)
        assert verify(out, console=quiet()).faults == ()
        make(recipe, out, **options)
        assert contents(out) == held
        info = open_finished(out).info
        assert info.samples == 4
        assert info.causes[LEFT_OUT[0]].startswith("has no possible rig, spot and stroke in 100 draws; the last: the")
    # where the sample can be drawn after all, it is made; the folder keeps its draws, and no code has changed here
    fault = f"{schema.INFO}: left_out lists {LEFT_OUT[0]}, which can be drawn"
    assert verify(out, console=quiet()).faults == (fault,)
    (out / schema.DRAWS).unlink()
    make_inline(recipe, out, replace=True)
    assert contents(out) == contents(whole)


def test_noise_above_its_budget_is_left_out(recipe: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The last task of a sample refuses it when its views are there; they go again."""
    budget, spoilt = sample_task.spot_noise, list[Any]()

    def loud(view: Any, truth: Any, *rest: Any) -> Any:
        found = budget(view, truth, *rest)
        spoilt.append(view.rig) if not spoilt else None
        return replace(found, phi_render_rad=1.0) if view.rig == spoilt[0] else found

    monkeypatch.setattr(sample_task, "spot_noise", loud)
    out = make_inline(recipe, tmp_path / "out", leave_out_refused=True)
    ((name, cause),) = open_finished(out).info.causes.items()
    assert name == "random-000000"
    assert "noise" in cause
    assert len(open_finished(out)) == 4
    assert verify(out, console=quiet()).faults == ()


def forged(finished: Path, out: Path, left_out: list[dict[str, str]]) -> tuple[str, ...]:
    """Faults of a data set with another list, signed anew and in its journal."""
    shutil.copytree(finished, out)
    info = json.loads((out / schema.INFO).read_text()) | {"left_out": left_out}
    (out / schema.INFO).write_text(json.dumps(info, indent=1) + "\n")
    write_checksums(out)
    with Journal(out) as journal:
        assert journal.head is not None
        journal.begin(replace(journal.head, info=(out / schema.INFO).read_text()), list(journal.entries))
    return verify(out, console=quiet()).faults


@pytest.mark.usefixtures("refusals")
def test_verify_looks_at_the_list(finished: Path, tmp_path: Path) -> None:
    assert verify(finished, console=quiet()).faults == ()
    true = [one.model_dump() for one in open_finished(finished).info.left_out]
    assert forged(finished, tmp_path / "true", true) == ()
    fewer = forged(finished, tmp_path / "fewer", true[:1])
    assert f"{schema.MANIFEST}: sample {LEFT_OUT[1]} of the recipe is missing" in fewer
    strange = [*true, {"sample_id": "random-000099", "cause": "none"}]
    assert forged(finished, tmp_path / "strange", strange) == (
        f"{schema.INFO}: left_out lists random-000099, which is not in the recipe",
    )
    assert forged(finished, tmp_path / "twice", [*true, true[0]]) == (f"{schema.INFO}: left_out lists a sample twice",)
    both = [*true, {"sample_id": "random-000000", "cause": "none"}]
    assert f"{schema.MANIFEST}: sample random-000000 is not in the recipe" in " ".join(
        forged(finished, tmp_path / "both", both)
    )


def test_verify_computes_certificates_again(finished: Path) -> None:
    """Here they pass: nothing refuses them outside of the patch that made the set."""
    assert verify(finished, console=quiet()).faults == tuple(
        f"{schema.INFO}: left_out lists {name}, whose certificates pass when they are computed again"
        for name in LEFT_OUT
    )


@pytest.mark.parametrize(
    ("entry", "where"),
    [
        ({"sample_id": "random-000001"}, "left_out.0.cause"),
        ({"sample_id": 1, "cause": "x"}, "left_out.0.sample_id"),
        ({"sample_id": "a\nb", "cause": "x"}, "left_out.0.sample_id"),
        ({"sample_id": "a", "cause": "x", "more": 1}, "left_out.0.more"),
        ("random-000001", "left_out.0"),
    ],
)
def test_a_list_that_is_none_is_refused(finished: Path, tmp_path: Path, entry: Any, where: str) -> None:
    out = tmp_path / "out"
    out.mkdir()
    info = json.loads((finished / schema.INFO).read_text()) | {"left_out": [entry]}
    (out / schema.INFO).write_text(json.dumps(info))
    with pytest.raises(DatasetError, match=where) as caught:
        open_finished(out)
    assert "\n" not in str(caught.value)


def test_pairs_are_exported_and_scored(finished: Path, tmp_path: Path) -> None:
    request = ExportRequest("parquet", FrameOptions("mjpeg"), 1, False, "both", 0.1, 0.1, 64)
    done = export(finished, request, tmp_path / "export", workers=1)
    assert sum(done.pairs.values()) == 3
    score = tmp_path / "score.json"
    words = ["--method", "detect", "--preset", "mjpeg", "--draws", "1", "--workers", "1", "--out", str(score)]
    assert main(["score", str(finished), *words]) == 0
    assert json.loads(score.read_text())["pairs"] == 3


def test_a_seal_tells_nobody_what_was_left_out(finished: Path, tmp_path: Path) -> None:
    out, public = with_secret_seed(finished, tmp_path / "set"), tmp_path / "public"
    seal(out, public, "mjpeg", quiet())
    assert json.loads((public / "seal.json").read_text())["pairs"] == 3
    texts = [path.read_text() for path in public.iterdir() if path.is_file()]
    assert len(texts) == 3
    assert not any(word in text for text in texts for word in (*LEFT_OUT, "left_out", "certificate"))


@pytest.mark.slow
def test_workers_change_no_byte(recipe: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "perform", refusing_workers.perform)
    outs = []
    for count in (1, 2):
        options: Any = {"workers": count, "console": quiet(), "leave_out_refused": True}
        outs.append(contents(make(recipe, tmp_path / str(count), **options)))
    assert outs[0] == outs[1]
    assert list(open_finished(tmp_path / "1").info.causes) == LEFT_OUT[:1]


def test_a_recipe_of_experiments_may_leave_samples_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The order is the recipe's; views of a rig that others have stay."""
    plan = make_plan(load_recipe(SMALLEST))
    first = plan.pairs[0]

    def certified(view: Any, spot: Any, *rest: Any) -> Any:
        found = certify(view, spot, *rest)
        bad = spot == plan.spots[first.spot]
        return replace(found, chief_difference_px=0.01, passed=False) if bad else found

    monkeypatch.setattr(spot_task, "certify", certified)
    out = make_inline(SMALLEST, tmp_path / "out", leave_out_refused=True)
    dataset = open_finished(out)
    assert [row.sample_id for row in dataset.rows] == [pair.sample_id for pair in plan.pairs[1:]]
    assert list(dataset.info.causes) == [first.sample_id]
    assert verify(out, console=quiet()).faults == ()
