"""Takes: every sample in every preset once, numbers from named streams, boxes that tell nothing, nothing rendered."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy
from helpers.bench_samples import many, with_tables
from helpers.processes import quiet
from helpers.recipes import changed, complaints

from phibench.datasets.build.dataset_build import plan_tasks
from phibench.datasets.build.journal import Journal
from phibench.datasets.common.errors import DatasetError, RecipeError
from phibench.datasets.exposures import search_boxes as module
from phibench.datasets.exposures.pair_draws import CachedSample, PairDraw, pair_draws
from phibench.datasets.exposures.search_boxes import BOX_MARGIN_PX
from phibench.datasets.frames.frame_source import noise_draw
from phibench.datasets.frames.sensor_file import SensorFile
from phibench.datasets.make import make, make_from_plan
from phibench.datasets.plan.plan import make_plan
from phibench.datasets.read import Dataset, open_dataset, open_finished
from phibench.datasets.recipe.load import load_recipe, parse_recipe, recipe_text, with_numbers
from phibench.datasets.recipe.recipe_scene import build_rig
from phibench.datasets.recipe.tables import Recipe, RigTable
from phibench.datasets.store.metadata import recipe_sha256
from phibench.render.sensor.camera_chain import auto_exposed
from phibench.render.sensor.light import Light, Region

TINY_BENCH = Path(__file__).resolve().parents[2] / "tiny_bench.toml"
FALSE_ALARM = 1e-4
"""Of each statistical test below, had it random streams; the streams are fixed, so it passes or fails for good."""


@pytest.fixture
def dataset(bench_dataset: Path) -> Dataset:
    return open_dataset(bench_dataset)


def test_every_sample_is_taken_in_every_preset_and_draw_once(dataset: Dataset) -> None:
    found = pair_draws(dataset, draws=2)
    assert [pair_draw.number for pair_draw in found] == list(range(len(found)))
    keys = {(pair_draw.sample_id, pair_draw.preset, pair_draw.draw) for pair_draw in found}
    presets = ("bayer-raw", "srgb8", "mjpeg")
    assert keys == {(row.sample_id, p, d) for row in dataset.rows for p in presets for d in (0, 1)}
    assert len(found) == len(keys) == 18


def test_takes_are_a_pure_function_of_the_documents(bench_dataset: Path, dataset: Dataset) -> None:
    assert pair_draws(dataset) == pair_draws(open_dataset(bench_dataset))
    fewer = pair_draws(replace(dataset, rows=dataset.rows[:2]))
    by_key = {(pair_draw.sample_id, pair_draw.preset): pair_draw for pair_draw in pair_draws(dataset)}
    assert len(fewer) == 6
    for pair_draw in fewer:  # what is drawn for a sample does not depend on which others there are
        assert replace(pair_draw, number=0) == replace(by_key[pair_draw.sample_id, pair_draw.preset], number=0)


def test_another_seed_draws_other_numbers(dataset: Dataset) -> None:
    other = with_tables(dataset, dataset={"name": "tinybench", "seed": 1})
    exposures = [
        {pair_draw.sample_id: pair_draw.request.exposure for pair_draw in pair_draws(d)} for d in (dataset, other)
    ]
    assert all(exposures[0][name] != exposures[1][name] for name in exposures[0])


def rank_correlation(found: tuple[PairDraw, ...]) -> float:
    return float(
        scipy.stats.spearmanr(
            [pair_draw.number for pair_draw in found], [int(pair_draw.sample_id[-6:]) for pair_draw in found]
        )[0]
    )


def test_numbers_do_not_follow_depth(bench_dataset: Path) -> None:
    found = pair_draws(many(bench_dataset, 400), "bayer-raw")
    # Spearman's rho of 400 independent ranks has the standard deviation 1 / sqrt(399) = 0.05; 4 of them: 6e-5
    assert abs(rank_correlation(found)) < 0.2
    in_order = tuple(
        replace(pair_draw, number=i) for i, pair_draw in enumerate(sorted(found, key=lambda t: t.sample_id))
    )
    assert rank_correlation(in_order) > 0.99


def test_numbers_are_drawn_per_sample_and_shared_by_presets(dataset: Dataset) -> None:
    per_sample: dict[str, set[tuple[Any, ...]]] = {}
    for pair_draw in pair_draws(dataset):
        request = pair_draw.request
        numbers = (request.exposure, request.laser_level, request.camera_seed, *sorted(request.overrides.items()))
        per_sample.setdefault(pair_draw.sample_id, set()).add(numbers)
        assert type(request.overrides["jpeg_quality"]) is int
        assert request.overrides["jpeg_quality"] in (60, 85)
        assert 0.5 <= request.laser_level <= 1.0
        assert request.lamp_level == 1.0
    assert [len(found) for found in per_sample.values()] == [1, 1, 1]
    assert len(set.union(*per_sample.values())) == 3


def test_exposures_have_the_recipes_distribution(bench_dataset: Path) -> None:
    found = pair_draws(many(bench_dataset, 500), "mjpeg")
    u = np.log(np.array([pair_draw.request.exposure for pair_draw in found]) / 0.004) / np.log(4.0)
    assert scipy.stats.kstest(u, "uniform").pvalue > FALSE_ALARM
    assert scipy.stats.kstest(u**1.3, "uniform").pvalue < FALSE_ALARM  # another law is noticed
    levels = np.array([pair_draw.request.laser_level for pair_draw in found])
    # two independent columns of 500: correlation 1 / sqrt(500) = 0.045; 4 sigma, false alarms 6e-5
    assert abs(np.corrcoef(u, levels)[0, 1]) < 0.18


def test_cameras_are_per_sample_or_one(dataset: Dataset) -> None:
    frames = dataset.info.recipe["frames"]
    assert len({pair_draw.request.camera_seed for pair_draw in pair_draws(dataset)}) == 3
    assert (
        len({t.request.camera_seed for t in pair_draws(with_tables(dataset, frames={**frames, "camera": "one"}))}) == 1
    )


def test_a_recipe_has_the_numbers_of_a_measured_camera(dataset: Dataset) -> None:
    """All presets take them, beside what is drawn; a sensor file of the command line goes before them."""
    frames = dataset.info.recipe["frames"]
    numbers = {"gain_dn_per_e": 0.3, "adc_bits": 12, "white_balance": [1.5, 1.0, 1.8]}
    given = with_tables(dataset, frames={**frames, "sensor": numbers})
    for pair_draw in pair_draws(given):
        sensor = pair_draw.request.sensor()
        assert (sensor.gain_dn_per_e, sensor.adc_bits, sensor.white_balance) == (0.3, 12, (1.5, 1.0, 1.8))
        assert sensor.jpeg_quality in (60, 85)
    file = SensorFile("bayer-raw", {"gain_dn_per_e": 0.2})
    assert {p.request.sensor().gain_dn_per_e for p in pair_draws(given, sensor=file)} == {0.2}
    plain = with_tables(dataset, frames={**frames, "sensor": None})
    assert recipe_sha256(plain.recipe) == recipe_sha256(dataset.recipe) != recipe_sha256(given.recipe)


def boxes(bench_dataset: Path, count: int = 1500) -> tuple[np.ndarray, Dataset, list[Region]]:
    """Place of the spot's light in its box along u, down; data set; boxes. The light is 0.9 px from the beam's axis."""
    dataset = many(bench_dataset, count, frames={"hint": 1.0, "hint_box_px": 32})
    down = dataset.rows[0].down
    assert down.light is not None
    torn = down.light.model_copy(update={"u_px": down.u_px + 0.7, "v_px": down.v_px - 0.6})
    down = down.model_copy(update={"light": torn})
    dataset = replace(dataset, rows=tuple(row.model_copy(update={"down": down}) for row in dataset.rows))
    found = [pair_draw.boxes[0] for pair_draw in pair_draws(dataset, "bayer-raw") if pair_draw.boxes is not None]
    assert len(found) == count
    u_px = dataset.rows[0].down.centre.u_px
    return np.array([u_px - (box.u0_px - 0.5) for box in found]), dataset, found


@pytest.mark.slow
def test_a_spot_is_anywhere_in_its_box(bench_dataset: Path) -> None:
    places, dataset, found = boxes(bench_dataset)
    row = dataset.rows[0].down.centre
    for box in found:
        assert box.shape == (32, 32)
        assert box.u0_px - 0.5 + BOX_MARGIN_PX <= row.u_px <= box.u1_px - 0.5 - BOX_MARGIN_PX
        assert box.v0_px - 0.5 + BOX_MARGIN_PX <= row.v_px <= box.v1_px - 0.5 - BOX_MARGIN_PX
    # 24 or 25 equally probable whole-pixel starts: chi square of their counts
    counts = np.unique(np.round(places - places.min()), return_counts=True)[1]
    assert len(counts) in (24, 25)
    assert scipy.stats.chisquare(counts).pvalue > FALSE_ALARM
    favoured = np.eye(len(counts), dtype=int)[12] * 60  # the centre
    assert scipy.stats.chisquare(counts + favoured).pvalue < FALSE_ALARM


def test_a_box_at_the_border_stays_in_the_image() -> None:
    random = np.random.default_rng(3)
    starts = [
        module._start(random, centre, 32, BOX_MARGIN_PX, 320) for centre in (-0.5, 2.0, 160.0, 318.0, 319.5) * 100
    ]
    checked = 0
    for centre, start in zip((-0.5, 2.0, 160.0, 318.0, 319.5) * 100, starts, strict=True):
        assert 0 <= start <= 288
        assert start - 0.5 <= centre <= start + 31.5
        checked += 1
    assert checked == 500
    assert module._start(random, 5.0, 64, BOX_MARGIN_PX, 48) == 0  # a box larger than the image is the image


def test_without_a_place_of_the_spot_the_box_is_anywhere(bench_dataset: Path) -> None:
    dataset = many(bench_dataset, 600, frames={"hint": 1.0, "hint_box_px": 32})
    nowhere = dataset.rows[0].down.model_copy(
        update={"u_px": float("nan"), "v_px": float("nan"), "visible": False, "cause": "no_reflection"}
    )
    dataset = replace(dataset, rows=tuple(row.model_copy(update={"down": nowhere}) for row in dataset.rows))
    starts = [pair_draw.boxes[0].u0_px for pair_draw in pair_draws(dataset, "bayer-raw") if pair_draw.boxes is not None]
    assert scipy.stats.kstest(np.array(starts) / 288.0, "uniform").pvalue > FALSE_ALARM
    assert len(starts) == 600


@pytest.mark.slow
def test_hints_come_as_often_as_the_recipe_says(bench_dataset: Path) -> None:
    hinted = sum(pair_draw.boxes is not None for pair_draw in pair_draws(many(bench_dataset, 1000), "bayer-raw"))
    # binomial, n = 1000, p = 0.5: sigma 16; 4 sigma, false alarms 6e-5
    assert abs(hinted - 500) < 64


def test_a_data_set_without_the_table_needs_a_preset(tiny_dataset: Path) -> None:
    dataset = open_dataset(tiny_dataset)
    with pytest.raises(DatasetError, match=r"no \[frames\] that names presets; give one"):
        pair_draws(dataset)
    [first, *_] = pair_draws(dataset, "mjpeg")
    assert (first.preset, first.boxes, first.laser_off, first.distractors) == ("mjpeg", None, True, ())
    with pytest.raises(DatasetError, match="'ideal' ends before the pixels"):
        pair_draws(dataset, "ideal")
    with pytest.raises(DatasetError, match="draws = 0"):
        pair_draws(dataset, "mjpeg", 0)


def test_automatic_exposure_is_the_down_images_and_kept(dataset: Dataset) -> None:
    dataset = with_tables(dataset, frames={"exposure_s": "auto"})
    [pair_draw, *_] = pair_draws(dataset, "srgb8")
    assert pair_draw.request.exposure == "auto"
    kept = CachedSample.of(dataset[pair_draw.sample_id])
    sensors = [kept.source(pair_draw).sides[position].chain.sensor for position in ("down", "up")]
    alone = dataset[pair_draw.sample_id].frame_source("srgb8", exposure="auto").sides
    assert sensors[0] == sensors[1] == alone["down"].chain.sensor == alone["up"].chain.sensor
    up = Light(kept.ambient("up"), f_number=kept.rig.camera.f_number, lamp_level=pair_draw.request.lamp_level)
    assert auto_exposed(pair_draw.request.sensor(), up) != sensors[1]  # of the up image it would have been another


# Nothing of the tables is rendered


def test_the_tables_enter_no_task(bench_dataset: Path) -> None:
    raw = open_dataset(bench_dataset).info.recipe
    keys = [
        {name: task.key for name, task in plan_tasks(make_plan(Recipe.model_validate(recipe)), {}).items()}
        for recipe in (raw, {**raw, "frames": {"draws": 7}, "distractors": []}, {**raw, "laser": {"albedo": 0.6}})
    ]
    assert keys[0] == keys[1]
    assert keys[0] != keys[2]


@pytest.mark.usefixtures("inline")
def test_a_changed_table_writes_the_documents_and_nothing_else(bench_dataset: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(bench_dataset, tmp_path / "copy")
    text = TINY_BENCH.read_text().replace("hint = 0.5", "hint = 0.25")
    before = {task: entry.files for task, entry in Journal(copy).entries.items()}
    done = make_from_plan(make_plan(parse_recipe(text)), text, copy, 1, quiet())
    assert set(done) == {"dataset.json", "recipe.toml", "SHA256SUMS"}
    assert {task: entry.files for task, entry in Journal(copy).entries.items()} == before
    changed_set = open_finished(copy)
    assert changed_set.recipe.frames is not None
    assert changed_set.recipe.frames.hint == 0.25
    assert changed_set.info.recipe_sha256 != open_dataset(bench_dataset).info.recipe_sha256


# Numbers on the command line


def test_the_kept_recipe_has_the_numbers_of_the_command_line() -> None:
    text = with_numbers(recipe_text("bench-dev"), "bench-dev", 20, 7)
    recipe = parse_recipe(text)
    assert recipe.random is not None
    assert (recipe.random.samples, recipe.dataset.seed) == (20, 7)
    plain = load_recipe("bench-dev").model_dump()
    assert recipe.model_dump() == {
        **plain,
        "dataset": {**plain["dataset"], "seed": 7},
        "random": {**plain["random"], "samples": 20},
    }
    assert text.count("\n") == recipe_text("bench-dev").count("\n")


def test_a_number_that_the_recipe_leaves_out_is_added() -> None:
    text = TINY_BENCH.read_text().replace("seed = 0\n", "").replace("samples = 3\n", "")
    recipe = parse_recipe(with_numbers(text, "t", 5, 2**63 - 1))
    assert recipe.random is not None
    assert (recipe.random.samples, recipe.dataset.seed) == (5, 2**63 - 1)


@pytest.mark.parametrize(
    ("name", "samples", "seed", "words"),
    [
        ("paper", 3, None, "it has no [random]; leave --samples out"),
        ("bench-dev", 0, None, "random.samples"),
        ("bench-dev", None, -1, "dataset.seed"),
    ],
)
def test_numbers_that_cannot_be_are_refused(name: str, samples: int | None, seed: int | None, words: str) -> None:
    with pytest.raises(RecipeError) as caught:
        with_numbers(recipe_text(name), name, samples, seed)
    assert words in str(caught.value)


def test_tables_in_one_line_are_refused_rather_than_ignored() -> None:
    text = TINY_BENCH.read_text().replace('[dataset]\nname = "tinybench"\nseed = 0\n', "")
    text = 'dataset = { name = "tinybench", seed = 0 }\n' + text
    with pytest.raises(RecipeError, match="as tables with headings"):
        with_numbers(text, "t", None, 4)


@pytest.mark.slow
@pytest.mark.usefixtures("inline")
def test_make_renders_what_the_command_line_says(tmp_path: Path) -> None:
    from phibench.datasets.merge_repair import repair

    out = make(TINY_BENCH, tmp_path / "one", 1, quiet(), samples=1, seed=9)
    info = json.loads((out / "dataset.json").read_text())
    assert (info["samples"], info["recipe"]["dataset"]["seed"], info["recipe"]["random"]["samples"]) == (1, 9, 1)
    assert repair(out, 1, quiet()) == []  # the kept recipe is the one that the description names


# Faults of the recipe

FRAMES = {"frames": {"presets": ["mjpeg"]}}
SPOT = {"kind": "spot"}


@pytest.mark.parametrize(
    ("tables", "path", "words"),
    [
        ({"frames": {"presets": ["ideal"]}}, "frames.presets[0]", ("'ideal'", "'mono-raw'")),
        ({"frames": {"presets": []}}, "frames.presets", ("at least 1",)),
        ({"frames": {"presets": ["mjpeg", "mjpeg"]}}, "frames.presets[1]", ("twice",)),
        ({"frames": {"draws": 0}}, "frames.draws", ("0", "an integer from 1")),
        ({"frames": {"exposure_s": 20.0}}, "frames.exposure_s", ("reaches 20", "exposure_s")),
        ({"frames": {"jpeg_quality": {"uniform": [60, 90]}}}, "frames.jpeg_quality", ("whole number",)),
        ({"frames": {"jpeg_quality": {"choice": [60.5]}}}, "frames.jpeg_quality", ("whole number",)),
        ({"frames": {"jpeg_quality": 101}}, "frames.jpeg_quality", ("reaches 101",)),
        ({"frames": {"laser_level": {"uniform": [-1, 1]}}}, "frames.laser_level", ("reaches -1", "0 up to 1e+06")),
        ({"frames": {"analogue_gain": 0.5}}, "frames.analogue_gain", ("reaches 0.5",)),
        ({"frames": {"hint": 1.5}}, "frames.hint", ("1.5", "from 0 up to 1")),
        ({"frames": {"hnt": 1.0}}, "frames.hnt", ("unknown", "'hint'")),
        ({"frames": {"sensor": {"gain": 0.3}}}, "frames.sensor", ("gain", "unknown")),
        ({"frames": {"sensor": {"prnu": 2.0}}}, "frames.sensor", ("prnu", "up to 0.2")),
        ({"frames": {"sensor": {"exposure_s": 0.01}}}, "frames.sensor.exposure_s", ("no number of a camera",)),
        ({"frames": {"sensor": {"sigma": {"prnu": 0.1}}}}, "frames.sensor.sigma", ("leave it out",)),
        ({"frames": {"prnu": 0.01, "sensor": {"prnu": 0.02}}}, "frames.sensor.prnu", ("one or the other",)),
        ({"rig": {"laser_filter_response": [1.0, 0.1]}}, "rig.laser_filter_response", ("a list of 3",)),
        ({"rig": {"laser_filter_response": [1.0, 0.1, 2.0]}}, "rig.laser_filter_response[2]", ("2.0", "up to 1")),
        ({"distractors": [{"kind": "sun"}]}, "distractors[0].kind", ("'sun'", "'glow'")),
        ({"distractors": [{**SPOT, "flux_ratio": 0.6}]}, "distractors[0].flux_ratio", ("reaches 0.6", "to 0.5")),
        ({"distractors": [{**SPOT, "target": "x"}]}, "distractors[0].target.choice[0]", ("'x'", "known: a")),
        ({"distractors": [{**SPOT, "height_m": 1.0}]}, "distractors[0].azimuth_deg", ("missing", "height_m")),
        (
            {"distractors": [{**SPOT, "azimuth_deg": 1.0, "height_m": 3.5}]},
            "distractors[0].height_m",
            ("beyond floor or lamps",),
        ),
        (
            {"distractors": [{"kind": "glow", "azimuth_deg": 1.0, "height_m": 1.0}]},
            "distractors[0].distance_m",
            ("missing", "hangs free"),
        ),
        (
            {"distractors": [{**SPOT, "target": "a", "azimuth_deg": 1.0, "height_m": 1.0}]},
            "distractors[0].target",
            ("one or the other",),
        ),
        ({"distractors": [{**SPOT, "probability": 2.0}]}, "distractors[0].probability", ("2.0", "up to 1")),
    ],
)
def test_each_fault_is_one_line_that_helps(tables: dict[str, Any], path: str, words: tuple[str, ...]) -> None:
    found = complaints(changed(**tables))
    [line] = [line for line in found if line.startswith(f"{path}:")]
    assert all(word in line for word in words), line
    assert len(found) == 1


def test_the_filters_of_the_recipe_are_the_detectors() -> None:
    table = RigTable.model_validate({"laser_filter_response": [1.0, 0.2, 0.05]})
    assert build_rig(table).camera.detector.laser_filter_response == (1.0, 0.2, 0.05)
    assert build_rig(RigTable()).camera.detector.laser_filter_response == (1.0, 0.10, 0.03)


def test_no_two_pair_draws_of_a_sample_share_their_noise(dataset: Dataset) -> None:
    """A raw frame with the noise of an MJPEG one would tell the JPEG's spot better than the JPEG itself."""
    found = pair_draws(
        with_tables(dataset, frames={"presets": ["mono-raw", "bayer-raw", "srgb8", "yuyv", "mjpeg"], "draws": 3})
    )
    keys = {(one.sample_id, noise_draw(one.preset, one.draw, k)) for one in found for k in range(2)}
    assert len(keys) == 2 * len(found) == 30 * len(dataset)
    # a later preset moves none of the older ones' numbers: their frames stay the same to the byte
    assert noise_draw("mjpeg", 2) == 11


def test_all_pair_draws_of_a_sample_have_one_pair_of_boxes(dataset: Dataset) -> None:
    """Of several boxes the overlap would tell where the spot is."""
    found = pair_draws(with_tables(dataset, frames={"presets": ["bayer-raw", "mjpeg"], "draws": 5, "hint": 1.0}))
    boxes = {(pair_draw.sample_id, pair_draw.boxes) for pair_draw in found}
    assert len(boxes) == len(dataset)
    assert None not in {box for _, box in boxes}
