"""Drawn data sets: more samples keep every byte, every row verifies, every sample is scored with its own rig."""

import json
import math
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars
import pytest
from helpers.damage import write_checksums, write_manifest
from helpers.drawn_values import shipped
from helpers.folders import contents, done
from helpers.inline_workers import InlineWorkerPool
from helpers.processes import quiet, said

from phibench.datasets.build.dataset_build import plan_tasks
from phibench.datasets.build.forecast import forecast
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.make import dry_run, make
from phibench.datasets.merge_repair import merge, repair
from phibench.datasets.plan.plan import make_plan
from phibench.datasets.read import open_dataset, open_finished
from phibench.datasets.recipe.load import load_recipe
from phibench.datasets.rooms.room_sources import room_of
from phibench.datasets.show import contact_sheet
from phibench.datasets.store import schema
from phibench.datasets.store.layers import read_exr
from phibench.datasets.store.metadata import read_manifest
from phibench.datasets.verify import verify
from phibench.render.optics.truth import spot_truth
from phibench.scenes.rig import POSITIONS
from phibench.studies.paper.paper_tables import score_estimators

TINY = Path(__file__).resolve().parents[2] / "tiny_random.toml"


def with_samples(count: int, folder: Path, text: str | None = None) -> Path:
    path = folder / f"{count}.toml"
    path.write_text((text or TINY.read_text()).replace("samples = 3", f"samples = {count}"))
    return path


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Three drawn samples. Read only: copy it to change it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("phibench.datasets.make.WorkerPool", InlineWorkerPool)
        yield make(TINY, tmp_path_factory.mktemp("random") / "out", workers=1, console=quiet())


@pytest.fixture
def copy(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "copy"))


# More samples.


@pytest.mark.slow
@pytest.mark.usefixtures("inline")
def test_more_samples_keep_every_byte_and_render_only_the_new_ones(made: Path, copy: Path, tmp_path: Path) -> None:
    (copy / schema.LOG).write_text("")
    make(with_samples(5, tmp_path), copy, workers=1, console=quiet())
    new = ("000003", "000004")
    views = [f"view {pose.pose}" for pose in open_dataset(copy).info.poses if pose.rig.endswith(new)]
    assert len(views) == 4
    assert done(copy) == sorted([*views, *(f"{kind} random-{number}" for kind in ("spot", "sample") for number in new)])
    of_all = {schema.INFO, schema.MANIFEST, schema.TABLE, schema.RECIPE, schema.RIGS, schema.CHECKSUMS, schema.JOURNAL}
    of_all.add(schema.CROISSANT)
    before, after = contents(made), contents(copy)
    kept = set(before) - of_all
    assert len(kept) == 2 + 6 * 3 + 6 + 3  # room, its light map; ambient, truth, preview of six poses; spots; previews
    assert {name for name in kept if after[name] != before[name]} == set()
    for name in (schema.MANIFEST, schema.RIGS):
        assert after[name].startswith(before[name])
    fresh = make(tmp_path / "5.toml", tmp_path / "fresh", workers=1, console=quiet())
    assert contents(fresh) == after
    _fewer_samples(copy, before, after)


def _fewer_samples(copy: Path, before: dict[str, bytes], after: dict[str, bytes]) -> None:
    """Fewer samples into a finished folder of five: all five stay, the first three are those of three."""
    for options in ({}, {"samples": 3}, {"samples": 4}):
        make(TINY, copy, workers=1, console=(console := quiet()), **options)  # type: ignore[arg-type]
        assert f"keeps its 5 samples; the first {options.get('samples', 3)} of them are those" in said(console)
        assert contents(copy) == after
    assert "keeps its 5 samples" in dry_run(TINY, copy)
    assert after[schema.MANIFEST].splitlines()[:3] == before[schema.MANIFEST].splitlines()
    assert "holds 20 finished tasks (5 spots, 10 views, 5 samples) that" in refusal(copy, seed=7)
    # an unfinished one is not finished by the way, and what there is of it not deleted
    (copy / schema.CHECKSUMS).rename(copy.parent / "aside")
    text = refusal(copy, samples=3)
    assert "holds 8 finished tasks (2 spots, 4 views, 2 samples) that" in text
    assert "made with 5 samples; give" in text
    (copy.parent / "aside").rename(copy / schema.CHECKSUMS)
    assert contents(copy) == after
    make(TINY, copy, workers=1, console=(console := quiet()), replace=True)
    assert "keeps" not in said(console)
    assert contents(copy) == before


def refusal(out: Path, **options: int) -> str:
    with pytest.raises(DatasetError) as caught:
        make(TINY, out, workers=1, console=quiet(), **options)  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_a_drawn_data_set_is_what_its_recipe_means(made: Path) -> None:
    report = verify(made, console=quiet())
    assert (report.faults, report.samples) == ((), 3)
    dataset, drawn = open_finished(made), make_plan(load_recipe(TINY))
    for sample, pair in zip(dataset, drawn.pairs, strict=True):
        assert sample.rig == drawn.rigs[pair.rig]
        assert sample.view("up") == drawn.view(pair, "up")
        assert sample.laser_spot == drawn.spots[pair.spot]
        assert sample.row.drawn == dict(pair.drawn)
        assert (sample.row.tries, sample.row.rig) == (1, sample.row.sample_id.replace("random-", "r"))
        assert sample.expected_image("up").shape == (3, 90, 160)
        distance = math.dist(sample.row.spot_world_m[:2], sample.rig.at(0.0).sphere_centre_m[:2])
        assert sample.row.depth_m == pytest.approx(distance, rel=1e-14)
    with pytest.raises(DatasetError, match=r"has 3 rigs; take each sample's own"):
        _ = dataset.rig
    with pytest.raises(DatasetError, match="no rig 'r7'"):
        dataset.rigs["r7"]
    assert contact_sheet(dataset, quiet()).shape[2] == 3


@pytest.mark.usefixtures("inline")
def test_spots_of_rays_are_rendered_and_verified(tmp_path: Path) -> None:
    head = TINY.read_text().split("[random.spot]")[0].replace("samples = 3", "samples = 2").replace("[rig]", "[rig]", 1)
    text = head + "[random.spot]\nazimuth_deg = { uniform = [60, 200] }\nheight_m = { uniform = [0.4, 1.0] }\n"
    (tmp_path / "ray.toml").write_text(text)
    out = make(tmp_path / "ray.toml", tmp_path / "out", workers=1, console=quiet())
    assert verify(out, console=quiet()).faults == ()
    for sample in open_dataset(out):
        assert {"spot.azimuth_deg", "spot.height_m"} <= set(sample.row.drawn)
        for position in POSITIONS:
            row, truth = sample.truth_row(position), sample.truth(position)
            if row.visible:  # the pixel's own ray meets the same thing
                k = truth["object_id"][round(row.v_px), round(row.u_px)]
                assert sample.dataset.rooms.info(sample.row.room).object_names[k] == sample.row.target


def test_what_was_drawn_has_columns(made: Path) -> None:
    table = polars.read_parquet(made / schema.TABLE)
    rows = read_manifest(made)
    names = [name for name in table.columns if name.startswith("drawn.")]
    assert names == [f"drawn.{key}" for key in rows[0].drawn]
    assert table["drawn.rig.z_c_m"].to_list() == [row.drawn["rig.z_c_m"] for row in rows]
    assert table["drawn.spot.target"].to_list() == [row.target for row in rows]
    assert table["tries"].to_list() == [1, 1, 1]
    assert table["rig"].to_list() == [row.rig for row in rows]


@pytest.mark.parametrize(
    "change", ["drawn", "tries", "rig", "nominal_rig", "stroke_m", "nominal_stroke_m", "spot_world_m"]
)
def test_a_row_that_the_recipe_does_not_draw_is_found_though_signed(copy: Path, change: str) -> None:
    rows = read_manifest(copy)
    value = {
        "drawn": {**rows[1].drawn, "rig.z_c_m": 0.27},
        "tries": 2,
        "rig": rows[0].rig,
        "nominal_rig": rows[0].rig,
        "stroke_m": rows[1].stroke_m + 1e-9,
        "nominal_stroke_m": rows[1].stroke_m + 1e-9,
        "spot_world_m": (*rows[1].spot_world_m[:2], rows[1].spot_world_m[2] + 1e-9),
    }[change]
    write_manifest(copy, [rows[0], rows[1].model_copy(update={change: value}), rows[2]])
    write_checksums(copy)
    faults = verify(copy, truth_layers=False, console=quiet()).faults
    assert [fault for fault in faults if fault.startswith(f"random-000001: {change} is")]


def test_a_changed_or_missing_rig_is_found(copy: Path) -> None:
    lines = (copy / schema.RIGS).read_text().splitlines(keepends=True)
    other = json.loads(lines[1])
    other["resolved"]["camera"]["cx_px"] += 1e-6
    (copy / schema.RIGS).write_text(lines[0] + json.dumps(other) + "\n" + lines[2])
    with pytest.raises(DatasetError, match=r"rigs\.jsonl is damaged"):
        open_finished(copy)
    write_checksums(copy)
    faults = verify(copy, truth_layers=False, console=quiet()).faults
    assert "rigs.jsonl: r000001 is not the rig that the recipe gives" in faults
    assert [fault for fault in faults if fault.startswith("random-000001 down: u_px")]
    assert not [fault for fault in faults if fault.startswith("random-000000")]
    (copy / schema.RIGS).write_text(lines[0])
    with pytest.raises(DatasetError, match="1 rigs instead of 3"):
        open_dataset(copy)
    (copy / schema.RIGS).write_text("{}\n")
    with pytest.raises(DatasetError, match="line 1 is damaged"):
        open_dataset(copy)


@pytest.mark.usefixtures("inline")
def test_shards_give_the_same_bytes(made: Path, tmp_path: Path) -> None:
    parts = [make(TINY, tmp_path / f"s{i}", workers=1, console=quiet(), shard=f"{i}/2") for i in (1, 2)]
    assert [len(open_dataset(part).rigs) for part in parts] == [1, 2]
    assert verify(parts[1], truth_layers=False, console=quiet()).faults == ()
    assert contents(merge(tmp_path / "merged", parts[::-1], quiet())) == contents(made)


@pytest.mark.usefixtures("inline")
def test_what_is_damaged_is_made_again(made: Path, copy: Path) -> None:
    pose = open_dataset(copy).info.poses[3]
    (copy / pose.files["truth"]).write_bytes(b"")
    (copy / schema.RIGS).unlink()
    assert repair(copy, 1, quiet()) == [f"view {pose.pose}", schema.RIGS, schema.CHECKSUMS]
    assert contents(copy) == contents(made)


def test_the_forecast_counts_every_view(made: Path) -> None:
    drawn = make_plan(load_recipe(TINY))
    cost = forecast(drawn, plan_tasks(drawn, {}).values())
    assert cost.counts == {"spot": 3, "bake": 1, "view": 6, "sample": 3}
    size = sum(len(data) for data in contents(made).values())
    assert 0.8 < cost.size / size < 1.6


def test_headers_name_the_rigs_pose(made: Path) -> None:
    poses = open_dataset(made).info.poses
    assert len({pose.pose for pose in poses}) == 6
    for pose in poses:
        assert read_exr(made / pose.files["truth"]).header["pose"] == pose.pose
        assert pose.pose.startswith(pose.rig + "-h")


# Estimators.


def test_estimators_use_each_samples_rig(made: Path) -> None:
    dataset = open_finished(made)
    exact = [
        s for s in score_estimators(dataset) if s.estimator == "exact" and s.source == "truth" and s.status == "ok"
    ]
    assert len(exact) == sum(row.down.visible and row.up.visible for row in dataset.rows) >= 2
    for one in exact:
        assert abs(one.relative_error) < 1e-11  # as for random rigs in test_triangulate
    rows = [
        row.model_copy(update={"nominal_rig": dataset.rows[0].rig}) for row in dataset.rows
    ]  # the first rig for all
    wrong = [
        s
        for s in score_estimators(replace(dataset, rows=tuple(rows)))
        if s.estimator == "exact" and s.source == "truth"
    ]
    assert max(abs(s.relative_error) for s in wrong[1:] if s.status == "ok") > 1e-3


@pytest.mark.slow
def test_the_exact_depth_comes_out_of_80_drawn_rigs() -> None:
    from phibench.estimator.geometry.triangulate import depth_exact

    drawn = make_plan(load_recipe("random").model_copy(update={"random": shipped(80)}))
    errors = []
    for pair in drawn.pairs:
        spot, rig = drawn.spots[pair.spot], drawn.rigs[pair.rig]
        room = room_of(drawn.rooms[pair.room])
        truths = [spot_truth(drawn.view(pair, p), spot, room.shapes(drawn.view(pair, p))) for p in POSITIONS]
        pixels = [np.array([truth.u_px, truth.v_px]) for truth in truths]
        depth_m = math.dist(spot.position_world_m[:2], rig.at(0.0).sphere_centre_m[:2])
        errors.append(abs(float(depth_exact(rig, pair.stroke_m, *pixels).depth_m) / depth_m - 1.0))
    assert len(errors) == 80
    # pixels to 1e-13, metres per pixel of disparity grow as D^2 / h: about 20 m/px for D = 4.2 m, h = 0.1 m
    assert max(errors) < 1e-11
