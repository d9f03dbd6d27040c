"""Study `noise`: factors, cut sensor, elasticities, findings of made-up numbers, and a tiny run."""

from __future__ import annotations

import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from rich.console import Console

from phibench.benchmark.scores.answer_errors import Rules
from phibench.benchmark.scores.intervals import Estimate
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.exposures.expected_electrons import expected_region
from phibench.datasets.frames.sensor_card import card_of
from phibench.datasets.read import Sample, open_dataset
from phibench.estimator.limits.position_bound import spot_limit
from phibench.render.sensor.electrons import expected_electrons
from phibench.render.sensor.light import Region
from phibench.render.sensor.settings import sensor
from phibench.scenes.random_streams import generator
from phibench.scenes.rig import POSITIONS, Rig
from phibench.studies.framework import Finding, StudyDatasets, read_settings
from phibench.studies.image_cutout import Shot, SpotPair, bounds_of, cut_region, cut_rig, drawn_pair
from phibench.studies.noise.conditions import BASE, FACTORS, OFF, shot_and_rig
from phibench.studies.noise.study import STUDY
from phibench.studies.noise.tables import (
    Elasticity,
    around_base,
    base_findings,
    elasticities,
    floor_findings,
    limit_findings,
    ranking_findings,
    scatter_and_bias_px,
)

ROOT = Path(__file__).resolve().parents[2]
REF = "raw_maximum_likelihood"
TINY = f"""
recipe = "{(ROOT / "tests" / "tiny.toml").as_posix()}"
samples = ["seen-near-h0.500"]
presets = ["bayer-raw", "srgb8"]
methods = ["red_centroid", "off_difference", "raw_maximum_likelihood", "chain_fit", "joint_fit"]
places = 3
draws = 2
box_px = 48
resamples = 99
[levels]
power_mw = [0.5]
speckle_contrast = [1.0]
jpeg_quality = [50.0]
"""


# -- factors ------------------------------------------------------------------------------------------------------


def test_every_factor_changes_its_own_number_only() -> None:
    rig, base = Rig(), sensor("mjpeg", jpeg_quality=85)
    for name, factor in FACTORS.items():
        level = {"jpeg_quality": 40.0, "adc_bits": 12.0, "speckle_contrast": 0.5}.get(name, 2.0 * factor.base)
        shot, changed = shot_and_rig(name, "mjpeg", rig, level)
        numbers = shot.sensor.model_dump()
        different = {k for k, v in base.model_dump().items() if numbers[k] != v}
        assert different == {
            "exposure_s": {"exposure_s"},
            "read_noise_e": {"read_noise_e"},
            "jpeg_quality": {"jpeg_quality"},
            "adc_bits": {"adc_bits", "gain_dn_per_e", "black_level_dn"},
            "speckle_contrast": {"speckle_m"},
        }.get(name, set())
        assert (shot.laser_level != 1.0) == (name == "power_mw")
        assert (changed != rig) == (name in ("blur_sigma_px", "focus_distance_m"))
    assert shot_and_rig(BASE, "mjpeg", rig, OFF) == (Shot(base), rig)


def test_converters_share_their_range() -> None:
    for bits in (6, 8, 12):
        other, base = shot_and_rig("adc_bits", "bayer-raw", Rig(), float(bits))[0].sensor, sensor("bayer-raw")
        assert other.adc_bits == bits
        # black and the largest code stand for the same electrons, but for the code that 2^bits - 1 leaves
        assert other.black_level_dn / other.dn_per_e == pytest.approx(base.black_level_dn / base.dn_per_e)
        top, usual = (s.top_dn / s.dn_per_e for s in (other, base))
        assert top == pytest.approx(usual, abs=1.0 / min(other.dn_per_e, base.dn_per_e))


def test_speckle_contrast_is_that_of_the_flux() -> None:
    shot = shot_and_rig("speckle_contrast", "bayer-raw", Rig(), 0.5)[0]
    assert shot.sensor.speckle_m == pytest.approx(4.0)
    assert shot_and_rig("speckle_contrast", "bayer-raw", Rig(), OFF)[0].sensor.speckle_m is None


# -- the cut sensor -----------------------------------------------------------------------------------------------


def _pair(folder: Path) -> tuple[Any, SpotPair, Region]:
    dataset = open_dataset(folder)
    sample = dataset["seen-near-h0.500"]
    uv = [(sample.truth_row(p).u_px, sample.truth_row(p).v_px) for p in POSITIONS]
    region = cut_region(uv, (180, 320), 24)
    ambient = {p: sample.ambient(p)[(slice(None), *region.slices())].astype(float) for p in POSITIONS}
    rig = cut_rig(sample.rig, region)
    return sample, SpotPair.of(rig, sample.row.stroke_m, sample.laser_spot, dataset.room, ambient, "a"), region


def test_cut_sensor_sees_the_pixels_of_the_whole_one(tiny_dataset: Path) -> None:
    sample, pair, region = _pair(tiny_dataset)
    assert region.u0_px % 16 == 0
    assert region.v0_px % 16 == 0
    assert pair.depth_m == pytest.approx(sample.row.depth_m)
    shot = Shot(sensor("bayer-raw"))
    for p in POSITIONS:
        row, truth = sample.truth_row(p), pair.views[p].truth
        assert (truth.u_px + region.u0_px, truth.v_px + region.v0_px) == pytest.approx((row.u_px, row.v_px), abs=1e-9)
        side = shot.side(pair, p, 0)
        here = expected_electrons(side.light, side.chain.sensor, pair.rig.camera, Region.whole(side.light.size))
        whole = sample.frame_source("bayer-raw", exposure=None).sides[p]
        there = expected_electrons(whole.light, whole.chain.sensor, sample.rig.camera, region)
        np.testing.assert_allclose(here, there, rtol=1e-6)  # files hold the layers in 32 bits
        expected = spot_limit(expected_region(sample, p, shot.sensor), card_of(shot.sensor)).covariance_px2
        np.testing.assert_allclose(bounds_of(shot, pair)[p].bound_px2, expected, rtol=1e-4)


def test_draws_are_named_and_boxes_hold_their_spots(tiny_dataset: Path) -> None:
    _, pair, _ = _pair(tiny_dataset)
    shot, nominal = Shot(sensor("bayer-raw")), (pair.rig, pair.stroke_m)
    first, again, other = (drawn_pair(0, shot, pair, nominal, ("test", k), 40) for k in (0, 0, 1))
    assert np.array_equal(first.down, again.down)
    assert not np.array_equal(first.down, other.down)
    assert not np.array_equal(first.down_off, first.up_off)
    for k in range(20):
        drawn = drawn_pair(0, shot, pair, nominal, ("test", k), 40)
        for p, box in (("down", drawn.box_down), ("up", drawn.box_up)):
            assert box is not None
            truth = pair.views[p].truth
            assert box.u0_px + 4 <= truth.u_px <= box.u0_px + box.width_px - 4
            assert box.v0_px + 4 <= truth.v_px <= box.v0_px + box.height_px - 4


@pytest.mark.slow
def test_speckle_moves_the_bound_of_a_draw(tiny_dataset: Path) -> None:
    _, pair, _ = _pair(tiny_dataset)
    shot = shot_and_rig("speckle_contrast", "bayer-raw", pair.rig, 1.0)[0]
    electrons = [bounds_of(shot, pair, ("test", k))["down"].electrons for k in range(200)]
    mean = bounds_of(shot, pair)["down"].electrons
    # a contrast of 1: the standard error of the mean of 200 is 7 %, of the contrast about 10 %; 4 sigma
    assert np.mean(electrons) == pytest.approx(mean, rel=0.28)
    assert np.std(electrons) / np.mean(electrons) == pytest.approx(1.0, abs=0.4)


# -- numbers ------------------------------------------------------------------------------------------------------


def _records(levels: dict[float, float], places: int = 8, found: bool = True) -> pl.DataFrame:
    """Records whose distance is `levels[level]` times a number of the place."""
    of_place = generator("test", "places").uniform(0.5, 1.5, places)
    rows = [
        {"sample_id": f"s-{k}", "sample": "s", "preset": "bayer-raw", "factor": "power_mw", "level": level}
        | {"method": REF, "image": p, "detected": found, "visible": True, "distance_px": size * of_place[k]}
        | {"bound_px2": level**-2.0}
        for level, size in levels.items()
        for k in range(places)
        for p in POSITIONS
    ]
    return pl.DataFrame(rows)


def test_elasticity_of_a_power_law() -> None:
    # the same places at all levels: their spread cancels, and the law is met exactly
    (e,) = elasticities(_records({x: x**-0.7 for x in (0.1, 0.3, 1.0, 1.5)}), Rules(resamples=99))
    assert (e.low, e.high) == (0.3, 1.5)
    assert e.estimate.value == pytest.approx(-0.7, abs=1e-12)
    assert e.bound == pytest.approx(-1.0)
    assert e.estimate.low == pytest.approx(-0.7, abs=1e-9)
    (missed,) = elasticities(_records({0.3: 1.0, 1.5: 1.0}, found=False), Rules(resamples=99))
    assert math.isnan(missed.estimate.value)


@pytest.mark.parametrize(
    ("levels", "base", "span"),
    [
        ([0.1, 0.3, 1.0, 1.5], 1.0, (0.3, 1.5)),
        ([0.1, 0.3, 1.0], 1.0, (0.3, 1.0)),
        ([1.0, 2.0, 4.0], 1.0, (1.0, 2.0)),
        ([0.0, 0.4, 0.7, 1.0], 0.0, (0.4, 1.0)),
        ([1.0], 1.0, None),
        ([0.0], 0.0, None),
    ],
)
def test_levels_beside_the_base(levels: list[float], base: float, span: tuple[float, float] | None) -> None:
    assert around_base(levels, base) == span


def test_scatter_and_bias_are_told_apart() -> None:
    # each place is off by 0.3 px and scatters by 0.1 px a coordinate; 400 places x 2 images x 2 draws
    random = generator("test", "scatter")
    rows = []
    for k in range(400):
        turn = random.uniform(0.0, 6.28)
        for image in POSITIONS:
            for _ in range(2):
                du, dv = 0.3 * np.array([np.cos(turn), np.sin(turn)]) + 0.1 * random.standard_normal(2)
                rows.append({"sample_id": f"s-{k:03d}", "image": image, "detected": True, "du_px": du, "dv_px": dv})
    table = pl.DataFrame(rows).with_columns(distance_px=(pl.col("du_px") ** 2 + pl.col("dv_px") ** 2).sqrt())
    scatter, bias = scatter_and_bias_px(table)
    # 1600 degrees of freedom: 1.8 % of the scatter; 4 sigma
    assert scatter == pytest.approx(0.1 * math.sqrt(2.0), rel=0.07)
    assert bias == pytest.approx(0.3, rel=0.03)


# -- findings -----------------------------------------------------------------------------------------------------


def _row(factor: str, level: float, method: str = REF, **changes: float) -> dict[str, Any]:
    row: dict[str, Any] = {"sample": "s", "preset": "bayer-raw", "factor": factor, "level": level, "method": method}
    for name, value in {
        "rms_px": 0.03,
        "rms_phi_rad": 1e-4,
        "rms_depth_relative": 1e-3,
        "bias_depth_relative": 0.0,
        "efficiency_px": 1.0,
        "detection_rate": 1.0,
        "scatter_px": 0.03,
        "bias_px": 0.0,
    }.items():
        value = changes.get(name, value)
        row |= {name: value, f"{name}_low": 0.9 * value, f"{name}_high": 1.1 * value}
    return {**row, "bound_px": 0.03, "bound_depth_relative": 1e-3, "saturated": changes.get("saturated", 0.0)}


def _limits(*rows: dict[str, Any]) -> dict[str, Finding]:
    lead = f"bayer-raw, s: {REF}, "
    return {f.label.removeprefix(lead): f for f in limit_findings(pl.DataFrame(rows), "s", "bayer-raw")}


def test_floors_are_decided_by_the_interval() -> None:
    rows = [
        _row("power_mw", 1.5),
        _row("power_mw", 1.5, "red_centroid", efficiency_px=0.05, rms_px=0.6),
        _row("power_mw", 1.5, "detect", efficiency_px=0.5),
        _row("power_mw", 9.0, "detect", saturated=1.0),
    ]
    found = {f.label: f for f in floor_findings(pl.DataFrame(rows), "s", "bayer-raw")}
    lead = "bayer-raw, s, 1.5 mW: "  # the strongest without full pixels
    assert found[f"{lead}red_centroid, rms distance"].value == pytest.approx(600.0)
    words = {"red_centroid": "missed", REF: "met", "detect": "undecided"}
    assert {name: found[f"{lead}{name}, rms / bound"].verdict for name in words} == words
    assert not list(floor_findings(pl.DataFrame(rows[3:]), "s", "bayer-raw"))  # full at every power
    assert not list(floor_findings(pl.DataFrame([_row("adc_bits", 8.0)]), "s", "bayer-raw"))  # power not changed


def test_where_the_bound_is_useless() -> None:
    good = [_row("power_mw", 0.3), _row(BASE, 0.0)]
    assert {k: (f.value, f.unit) for k, f in _limits(*good).items()} == {"levels not surely off the bound": (2, "of 2")}
    faint = _limits(*good, _row("power_mw", 0.1, detection_rate=0.4))["spots found, laser power, mW 0.1"]
    assert (faint.value, faint.verdict) == (40.0, "missed")
    below = _limits(*good, _row("read_noise_e", 16.0, efficiency_px=1.5))["rms / bound, read noise, e- 16"]
    assert (below.relation, below.threshold, below.verdict) == (">=", 0.9, "missed")
    full = _limits(*good, _row("power_mw", 3.0, saturated=0.5, efficiency_px=0.4))
    assert full["rms / bound with full pixels, laser power, mW 3"].value == pytest.approx(2.5)
    assert full["levels not surely off the bound"].unit == "of 3"


def test_where_the_reference_leaves_the_bound() -> None:
    away = _row("focus_distance_m", 0.19, efficiency_px=0.5, scatter_px=0.04, bias_px=0.05)
    found = _limits(_row(BASE, 0.0), away)
    left = found["rms / bound, focus distance, m 0.19"]
    assert (left.relation, left.threshold, left.verdict) == ("<=", 1.25, "missed")
    assert found["scatter, focus distance, m 0.19"].value == pytest.approx(40.0)
    assert found["bias, focus distance, m 0.19"].value == pytest.approx(50.0)
    full = _limits(_row(BASE, 0.0), _row("power_mw", 3.0, efficiency_px=0.3, saturated=1.0))
    assert not any(f.verdict for f in full.values())  # full pixels are no reason to leave it


def _elasticity(factor: str, value: float, half: float) -> Elasticity:
    estimate = Estimate(value, value - half, value + half)
    return Elasticity("s", "bayer-raw", factor, REF, 0.5, 2.0, estimate, value)


def _ranking(*found: Elasticity) -> list[Finding]:
    return list(ranking_findings(found, "s", "bayer-raw"))


def test_ranking_starts_with_the_largest_and_tells_what_is_sure() -> None:
    strong, weak = _elasticity("power_mw", -0.9, 0.1), _elasticity("read_noise_e", 0.2, 0.1)
    found = _ranking(_elasticity("adc_bits", 0.01, 0.1), weak, strong)
    assert [f.label.removeprefix("bayer-raw, s: d ln rms / d ln ") for f in found[:3]] == [
        "laser power",
        "read noise",
        "converter",
    ]
    assert [f.verdict for f in found[:3]] == ["met", "met", "undecided"]
    assert (found[3].value, found[3].verdict) == (pytest.approx(0.7), "met")
    close = _ranking(strong, _elasticity("exposure_s", -0.85, 0.1))[-1]
    assert close.label == "bayer-raw, s: size of the slope for laser power less that for exposure"
    assert close.verdict == "undecided"
    assert not _ranking(_elasticity("focus_distance_m", 1.0, 0.1))


def test_base_case_as_findings() -> None:
    found = {f.label: f for f in base_findings(pl.DataFrame([_row(BASE, 0.0)]), "s", "bayer-raw")}
    rms = found[f"bayer-raw, s: {REF}, rms distance"]
    assert (rms.value, rms.low, rms.high) == pytest.approx((30.0, 27.0, 33.0))
    assert found["bayer-raw, s: bound of the distance"].value == 30.0
    assert found[f"bayer-raw, s: {REF}, rms / bound"].low == pytest.approx(0.909, abs=5e-4)
    (none,) = base_findings(pl.DataFrame([_row(BASE, 0.0, rms_px=math.nan)]), "s", "bayer-raw")
    assert none.value is None


# -- settings and a run -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("power_mw = [0.5]", "power = [0.5]", ("levels.power", "power_mw")),
        ('"bayer-raw", "srgb8"', '"raw"', ("presets[0]", "'bayer-raw'")),
        ('"red_centroid"', '"red"', ("no 'red'", "red_centroid")),
        ("draws = 2", "draws = 1", ("draws",)),
    ],
)
def test_bad_settings(tmp_path: Path, tiny_dataset: Path, old: str, new: str, words: tuple[str, ...]) -> None:
    with pytest.raises(DatasetError) as caught:
        _run(tmp_path, tiny_dataset, TINY.replace(old, new))
    assert all(word in str(caught.value) for word in words)


def test_shipped_settings_cover_every_factor() -> None:
    for short in (False, True):
        settings = read_settings(STUDY, short)
        assert set(settings.levels.given) == set(FACTORS)


def _run(tmp_path: Path, dataset: Path, text: str = TINY) -> Any:
    file, data = tmp_path / "noise.toml", tmp_path / "data"
    file.write_text(text, encoding="utf-8")
    if not data.exists():
        shutil.copytree(dataset, data / "tiny")
    return STUDY.run(read_settings(STUDY, False, file), StudyDatasets(data, Console(quiet=True), 1))


def test_tiny_study(tmp_path: Path, tiny_dataset: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # large pixels of the tiny camera are full of the room's light: the lamps go off
    monkeypatch.setattr(Sample, "ambient", lambda *_: np.zeros((3, 180, 320), np.float32))
    result = _run(tmp_path, tiny_dataset)
    table = result.tables["table"]
    cases = table.select("preset", "factor", "level").unique()
    # base, its copies as levels of two factors, and one level more of each; JPEG quality acts on neither preset
    assert len(cases) == 2 * (1 + 2 + 2)
    assert set(table.filter(preset="bayer-raw")["method"]) == {"red_centroid", "off_difference", REF, "joint_fit"}
    power = table.filter(preset="bayer-raw", factor="power_mw", method=REF).sort("level")
    assert power["bound_px"][0] > 1.3 * power["bound_px"][1]
    base = table.filter(preset="bayer-raw", factor=BASE).sort("method")
    red = base.filter(method="red_centroid")
    assert red["bias_px"][0] > red["scatter_px"][0]  # the mosaic's floor is bias
    leads = {finding.label.split(":")[0] for finding in result.findings}
    assert {f"{preset}, seen-near-h0.500" for preset in ("bayer-raw", "srgb8")} <= leads
    assert [d.name for d in result.drawings][-1] == "ranking-seen-near-h0.500"


@pytest.mark.slow
def test_a_base_case_must_be_seen_and_levels_allowed(tmp_path: Path, tiny_dataset: Path) -> None:
    with pytest.raises(DatasetError, match="not visible in both images"):
        _run(tmp_path, tiny_dataset, TINY.replace("seen-near-h0.500", "half-hidden-h1.400"))
    with pytest.raises(DatasetError, match="levels of speckle_contrast: 3 is not allowed"):
        _run(tmp_path, tiny_dataset, TINY.replace("speckle_contrast = [1.0]", "speckle_contrast = [3.0]"))
