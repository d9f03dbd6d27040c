"""Pairs of a data set: what a method gets is what the takes say, and the truth is the data set's, with its bounds."""

from __future__ import annotations

import base64
import io
import json
import math
import pickle
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from helpers.bench_samples import hidden, with_tables
from PIL import Image

from phibench.benchmark.pair_sets.dataset_pairs import (
    LOCALISE_BOX_PX,
    LOCALISE_MARGIN_PX,
    DatasetPairs,
    SpotInImage,
    dataset_pairs,
    spot_bounds,
    tracks_of,
)
from phibench.benchmark.pair_sets.wanted_pairs import PairChoice
from phibench.benchmark.scored_dataset import open_dataset as scored_dataset
from phibench.benchmark.scores.worst_images import worst_images
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.exposures.expected_electrons import expected_of_light, expected_region
from phibench.datasets.exposures.pair_draws import CachedSample, FrameCounts
from phibench.datasets.frames.sensor_card import card_of
from phibench.datasets.read import Dataset, open_dataset
from phibench.estimator.geometry.triangulate import depth_exact
from phibench.estimator.interface import Pair
from phibench.estimator.limits.position_bound import spot_limit
from phibench.estimator.pair_set import PairTruth
from phibench.estimator.spots.raw_pixels import noise_of
from phibench.render.sensor.electrons import NoiseStream
from phibench.render.sensor.light import Region
from phibench.scenes.rig import POSITIONS

SHAPES = {
    "mono-raw": ((180, 320), np.uint16),
    "bayer-raw": ((180, 320), np.uint16),
    "srgb8": ((180, 320, 3), np.uint8),
    "yuyv": ((180, 320, 2), np.uint8),
    "mjpeg": ((180, 320, 3), np.uint8),
}


@pytest.fixture(scope="module")
def dataset(bench_dataset: Path) -> Dataset:
    return open_dataset(bench_dataset)


@pytest.fixture(scope="module")
def pairs(dataset: Dataset) -> DatasetPairs:
    return dataset_pairs(dataset)


def every(pairs: DatasetPairs) -> list[tuple[Pair, PairTruth]]:
    return [(pairs.pair(i), pairs.truth(i)) for i in range(len(pairs))]


@pytest.mark.slow
def test_pairs_are_the_frames_of_their_takes(dataset: Dataset, pairs: DatasetPairs) -> None:
    assert len(pairs) == 9
    for pair_draw in pairs.pair_draws:
        pair = pairs.pair(pair_draw.number)
        frames = CachedSample.of(dataset[pair_draw.sample_id]).source(pair_draw).frames(pair_draw.draw, laser_off=True)
        assert set(pair.images) == {"down", "up", "down_off", "up_off"}
        for name, image in pair.images.items():
            assert np.array_equal(image, frames.by_name[name].image)
        assert pair.card == card_of(frames.by_name["up"].sensor)
        assert (pair.card.output == "mjpeg") == (pair_draw.preset == "mjpeg")
        assert pair.stroke_m == dataset[pair_draw.sample_id].row.stroke_m


def test_several_frames_are_a_mean_with_their_number_and_have_their_own_bound(dataset: Dataset) -> None:
    single = dataset_pairs(dataset, "bayer-raw", pairs=1)
    several = dataset_pairs(dataset, "bayer-raw", pairs=1, frames=FrameCounts(3, 2))
    one, many = single.pair(0), several.pair(0)
    assert [many.count(name) for name in ("down", "up", "down_off", "up_off")] == [3, 3, 2, 2]
    for name, image in one.images.items():
        stack = many.stack(name)
        assert one.count(name) == 1
        assert stack.dtype == image.dtype
        assert np.array_equal(stack[0], image)  # the first frame is that of a pair of single ones
        assert not np.array_equal(stack[0], stack[1])
        assert np.allclose(many.images[name], stack.mean(axis=0), rtol=1e-6)
        for held in (stack, many.images[name]):
            with pytest.raises(ValueError, match="read-only"):
                held[0, 0] = 0
    draw = several.pair_draws[0]
    source = CachedSample.of(dataset[draw.sample_id]).source(draw)
    sample, side = dataset[draw.sample_id], source.sides["down"]
    row, bound = sample.row.down, several.truth(0).down.bound_px2
    spot = SpotInImage((row.u_px, row.v_px), row.electrons_per_s, row.visible)
    expected = spot_bounds(side, sample.rig, spot, frames=FrameCounts(3, 2)).bound_px2
    assert bound is not None
    assert expected is not None
    assert np.allclose(bound, expected)


def test_one_frame_on_and_off_has_the_bound_of_both(dataset: Dataset) -> None:
    """Asked for, the bound takes the room from the laser-off frame alone; without it, as a level behind each filter."""
    single, counted = (dataset_pairs(dataset, "bayer-raw", pairs=1, frames=n) for n in (None, FrameCounts(1, 1)))
    for name, image in single.pair(0).images.items():
        assert np.array_equal(image, counted.pair(0).images[name])
    bounds = [pairs.truth(0).down.bound_px2 for pairs in (single, counted, counted.of_track("find"))]
    assert all(bound is not None for bound in bounds)
    level, room, again = (float(np.trace(bound)) for bound in bounds if bound is not None)
    assert level < room == again < 2.0 * level  # at most, where the room makes the noise, its own as much again
    assert (single.document().get("frames"), counted.document()["frames"]) == (None, [[1, 1]])


def test_a_report_shows_yuyv_in_colour(dataset: Dataset) -> None:
    """Two planes, luma and chroma in turns, are no picture."""
    pairs = dataset_pairs(dataset, "yuyv", pairs=1)
    truth = pairs.truth(0)
    assert truth.down.bound_px2 is not None
    assert np.isfinite(truth.down.bound_px2).all()
    u, v = truth.down.uv_px
    row = {"number": 0, "image": "down", "sample_id": truth.sample_id, "depth_m": truth.depth_m, "electrons": 1.0}
    row |= {"status": "no spot", "cause": "method", "visible": True, "detected": False, "u_true_px": u, "v_true_px": v}
    missing = {"distance_px": None, "u_px": None, "v_px": None}
    [shown] = worst_images(pl.DataFrame([row | missing]), pairs)
    for picture in (shown.crop, shown.frame):
        assert picture
        with Image.open(io.BytesIO(base64.b64decode(picture.base64))) as opened:
            assert opened.mode == "RGB"


@pytest.mark.parametrize("preset", SHAPES)
def test_images_have_the_shapes_of_their_preset_and_cannot_be_written(dataset: Dataset, preset: str) -> None:
    pair = dataset_pairs(dataset, preset, pairs=1).pair(0)
    assert len(pair.images) == 4
    for image in pair.images.values():
        assert (image.shape, image.dtype.type) == SHAPES[preset]
        assert image.base is None  # nobody can write through a base
        with pytest.raises(ValueError, match="read-only"):
            image[0, 0] = 0


@pytest.mark.slow
def test_boxes_for_every_pair_are_those_of_a_recipe_that_has_them(dataset: Dataset) -> None:
    """64 pixels a side, the spot 4 px from their edges or more, from the recipe's own streams."""
    boxed = dataset_pairs(dataset, boxes_px=64)
    hinting = with_tables(dataset, frames={**dataset.info.recipe["frames"], "hint": 1.0, "hint_box_px": 64})
    by_recipe, checked = dataset_pairs(hinting), 0
    for number in range(len(boxed)):
        pair, other, truth = boxed.pair(number), by_recipe.pair(number), boxed.truth(number)
        assert (pair.box_down, pair.box_up) == (other.box_down, other.box_up)
        assert truth.hinted
        for position in POSITIONS:
            box, spot = getattr(pair, f"box_{position}"), getattr(truth, position)
            assert box is not None
            assert (box.width_px, box.height_px) == (64, 64)
            if spot.visible:
                u, v = spot.uv_px
                assert 4 <= u + 0.5 - box.u0_px <= 60
                assert 4 <= v + 0.5 - box.v0_px <= 60
                checked += 1
    assert checked > 10
    assert boxed.document()["boxes_px"] == 64
    assert dataset_pairs(dataset).document()["boxes_px"] is None
    for given, words in (({"boxes_px": 8}, "must be 16 or above"), ({"boxes_px": 64, "hints": False}, "--no-hints")):
        with pytest.raises(DatasetError, match=words):
            dataset_pairs(dataset, **given)


@pytest.mark.slow
def test_a_pair_knows_nothing_of_the_scene(pairs: DatasetPairs) -> None:
    """All that a pair has besides images: number, rig, stroke, card, boxes; none of them a number of the truth."""
    names = {field.name for field in fields(Pair)}
    images = {"down", "up", "down_off", "up_off", "frames"}
    known = {"number", "rig", "calibration_covariance", "stroke_m", "card", "beam", "box_down", "box_up"}
    assert names - images == known
    for pair, truth in every(pairs):
        text = " ".join(repr(getattr(pair, name)) for name in names - images)
        numbers = (truth.depth_m, *truth.down.uv_px, *truth.up.uv_px, *truth.down.phi_rad.values())
        assert not any(repr(value)[:8] in text for value in numbers)
        assert truth.sample_id not in text


@pytest.mark.slow
def test_the_truth_is_the_manifests(dataset: Dataset, pairs: DatasetPairs) -> None:
    for pair_draw, (pair, truth) in zip(pairs.pair_draws, every(pairs), strict=True):
        row = dataset[pair_draw.sample_id].row
        assert (truth.number, truth.sample_id, truth.preset, truth.draw) == (
            pair.number,
            pair_draw.sample_id,
            pair_draw.preset,
            pair_draw.draw,
        )
        assert (truth.depth_m, truth.axis_depth_m) == (row.light_depth_m, row.depth_m)
        assert (truth.stroke_m, truth.hinted) == (row.stroke_m, pair.box_down is not None)
        assert truth.true_rig == truth.nominal_rig == pair.rig == dataset[pair_draw.sample_id].rig
        assert truth.jpeg_quality == (
            pair_draw.request.overrides["jpeg_quality"] if pair_draw.preset == "mjpeg" else None
        )
        for position in POSITIONS:
            spot, known = getattr(truth, position), row.position(position)
            assert spot.axis_px == (known.u_px, known.v_px)
            assert spot.uv_px == pytest.approx(np.add(spot.axis_px, known.coma_shift_px), abs=1e-12)
            assert known.light is not None
            assert spot.phi_rad["ray"] == known.light.phi_ray_rad
            assert {light.kind for light in spot.distractions} <= {"spot", "led", "glow"}
            if (box := getattr(pair, f"box_{position}")) is not None:
                assert box.u0_px + 3.5 <= known.u_px <= box.u0_px + box.width_px - 4.5
        axis = depth_exact(pair.rig, pair.stroke_m, truth.down.axis_px, truth.up.axis_px)
        assert float(axis.depth_m) == pytest.approx(truth.axis_depth_m, rel=1e-9)
        light = depth_exact(pair.rig, pair.stroke_m, truth.down.uv_px, truth.up.uv_px)
        assert float(light.depth_m) == pytest.approx(truth.depth_m, rel=1e-3)  # coma of the optics: see the page model


@pytest.mark.slow
def test_bounds_are_of_the_image_and_of_the_raw_pixels_behind_it(pairs: DatasetPairs) -> None:
    """Processing takes information away: no processed bound is below the raw one, but for what its model leaves out.

    It takes the spot as a Gaussian of the rig's blur and the room as level; the layers' own spot differs by its size
    (0.2 px in a blur of 0.7 px: 4 % of the width, 8 % of the variance), hence 0.8.
    """
    found = {truth.preset: truth for _, truth in every(pairs)}
    for preset, truth in found.items():
        for spot in (truth.down, truth.up):
            assert spot.raw_bound_px2 is not None
            assert np.linalg.eigvalsh(spot.raw_bound_px2).min() > 0.0
            if preset == "bayer-raw":
                assert np.array_equal(spot.bound_px2, spot.raw_bound_px2)
            elif spot.bound_px2 is not None:
                assert np.trace(spot.bound_px2) > 0.8 * np.trace(spot.raw_bound_px2)
    assert found["srgb8"].down.bound_px2 is not None
    by_sample: dict[str, list[np.ndarray]] = {}
    for _, truth in every(pairs):
        assert truth.down.raw_bound_px2 is not None
        by_sample.setdefault(truth.sample_id, []).append(truth.down.raw_bound_px2)
    assert all(np.array_equal(one, other) for one, *others in by_sample.values() for other in others)


@pytest.mark.slow
def test_without_other_lights_and_levels_the_bound_is_that_of_the_sample(dataset: Dataset) -> None:
    """At a long exposure the room alone fills pixels without filters: there they carry nothing."""
    checked = {"full": 0, "mono-raw": 0, "bayer-raw": 0}
    long_s = 16 / 60
    for exposure_s in (1 / 60, long_s, 1 / 500):
        plain = with_tables(dataset, frames={"camera": "one", "exposure_s": exposure_s}, distractors=[])
        for preset in ("mono-raw", "bayer-raw"):
            found = dataset_pairs(plain, preset)
            for i in range(len(found)):
                truth = found.truth(i)
                for position in POSITIONS:
                    sample = plain[truth.sample_id]
                    sensor = sample.frame_source(preset, exposure=exposure_s).sides[position].chain.sensor
                    limit = spot_limit(expected_region(sample, position, sensor), card_of(sensor))
                    bound, saturated = getattr(truth, position).bound_px2, getattr(truth, position).saturated
                    if exposure_s == long_s and preset == "mono-raw":
                        checked["full"] += 1
                        assert bound is None
                        assert np.isnan(limit.covariance_px2).all()
                        assert saturated
                    else:
                        assert np.array_equal(bound, limit.covariance_px2)
                        checked[preset] += 1
    assert checked == {"full": 6, "mono-raw": 12, "bayer-raw": 18}


def test_a_distractor_is_background_in_the_bound(dataset: Dataset) -> None:
    """A bound never falls when light is added, and hardly rises: distractors are 12 px and more away."""
    bounds = []
    for lights in ([], [{"kind": "led", "azimuth_deg": {"uniform": [0.0, 360.0]}, "height_m": 0.8}]):
        found = dataset_pairs(with_tables(dataset, distractors=lights), "bayer-raw")
        bounds.append({found.truth(i).sample_id: found.truth(i).down.bound_px2 for i in range(len(found))})
    for name, without in bounds[0].items():
        assert without is not None
        within = bounds[1][name]
        assert within is not None
        assert np.linalg.eigvalsh(within - without).min() > -1e-12
        assert np.trace(within) < 1.2 * np.trace(without)


def test_snr_squared_is_twice_the_likelihood_ratio_of_the_spot(dataset: Dataset) -> None:
    """Draws of the chain under a dim laser: Gaussian pixels with and without the spot at its true place."""
    plain = with_tables(dataset, distractors=[])
    found = dataset_pairs(plain, "bayer-raw")
    pair_draw = found.pair_draws[0]
    full = CachedSample.of(plain[pair_draw.sample_id]).source(pair_draw).sides["down"]
    side = replace(full, light=replace(full.light, laser_level=0.02))
    sample, row = plain[pair_draw.sample_id], plain[pair_draw.sample_id].row.down
    card, region = card_of(side.chain.sensor), expected_of_light(side.light, side.chain.sensor, side.chain.camera)
    with_spot, without = ((mean, noise_of(card).variance_e2(mean)) for mean in (region.mean_e, region.background_e))
    height, width = region.mean_e.shape
    part = Region(region.u0_px, region.v0_px, region.u0_px + width, region.v0_px + height)
    ratios = []
    for draw in range(400):
        chain = replace(side.chain, camera_seed=draw)  # another fixed pattern each time: it counts as noise
        x = (
            chain.frame(side.light, NoiseStream(("snr", draw)), part).astype(float) - card.black_level_dn
        ) / card.dn_per_e
        terms = [(x - mean) ** 2 / variance + np.log(variance) for mean, variance in (without, with_spot)]
        ratios.append(np.sum(terms[0] - terms[1]))
    snr = spot_bounds(side, sample.rig, SpotInImage((row.u_px, row.v_px), row.electrons_per_s, True)).snr
    assert 4.0 < snr < 12.0
    # the mean of 400 draws is good to 2 snr / 20; the noise that grows with the light makes up to 25 %
    assert np.mean(ratios) == pytest.approx(1.12 * snr**2, rel=0.12, abs=4.0 * 2.0 * snr / 20.0)


def test_electrons_are_those_of_the_whole_spot(dataset: Dataset, pairs: DatasetPairs) -> None:
    mono = dataset_pairs(dataset, "mono-raw")
    for found, planes in ((mono, (1.0, 1.0, 1.0)), (pairs, (1.0, 0.0, 0.0))):
        pair_draw = found.pair_draws[0]
        source, truth = CachedSample.of(dataset[pair_draw.sample_id]).source(pair_draw), found.truth(0)
        side = source.sides["down"]
        assert side.light.spot is not None
        rate = side.light.spot.electrons_per_s.sum(axis=(1, 2)) @ planes
        # the window leaves out 8e-11 of the flux
        assert truth.down.electrons == pytest.approx(
            rate * side.chain.sensor.exposure_s * pair_draw.request.laser_level, rel=1e-8
        )
        assert 0.0 < truth.down.peak_e < truth.down.electrons + 1e4


def test_a_long_exposure_saturates_and_is_said_to(dataset: Dataset) -> None:
    for seconds, saturated in ((0.0005, False), (0.5, True)):
        found = dataset_pairs(with_tables(dataset, frames={"exposure_s": seconds}), "bayer-raw", pairs=1)
        pair, truth = found.pair(0), found.truth(0)
        assert truth.down.saturated is saturated
        u, v = (round(x) for x in truth.down.uv_px)
        assert bool((pair.down[v - 1 : v + 2, u - 1 : u + 2] >= pair.card.top_dn).any()) is saturated


def test_a_hidden_spot_has_no_bounds(dataset: Dataset) -> None:
    found = dataset_pairs(hidden(dataset, "up"), "bayer-raw")
    truth = next(
        found.truth(i) for i in range(len(found)) if found.pair_draws[i].sample_id == dataset.rows[0].sample_id
    )
    assert (truth.up.visible, truth.up.cause, truth.up.snr, truth.up.saturated) == (False, "occluded:crate", 0.0, False)
    assert truth.up.bound_px2 is truth.up.raw_bound_px2 is None
    assert truth.down.visible
    assert truth.down.raw_bound_px2 is not None


@pytest.mark.slow
def test_order_and_subsets(dataset: Dataset, pairs: DatasetPairs) -> None:
    first = dataset_pairs(dataset, pairs=2)
    assert len(first) == 2
    assert np.array_equal(first.pair(1).up, pairs.pair(1).up)
    backwards = [pairs.pair(i).down.sum() for i in reversed(range(9))]
    assert backwards[::-1] == [pair.down.sum() for pair, _ in every(pairs)]  # what was asked before does not matter
    assert len(dataset_pairs(dataset, "mjpeg", draws=3)) == 9


def test_draws_are_independent(dataset: Dataset) -> None:
    """Differences of on and off frames of one pattern, of two draws: their noise is uncorrelated."""
    found = dataset_pairs(dataset, "bayer-raw", draws=2)
    first, second = (t.number for t in found.pair_draws if t.sample_id == dataset.rows[0].sample_id)
    noise = []
    for number in (first, second):
        pair = found.pair(number)
        assert pair.down_off is not None
        noise.append((pair.down.astype(float) - pair.down_off)[::2, ::2].ravel())
    assert found.truth(first).down.uv_px == found.truth(second).down.uv_px
    quiet = np.abs(np.array(noise)).max(axis=0) < 30.0  # without the spot and the lights that follow the laser
    assert quiet.mean() > 0.9
    correlation = np.corrcoef(np.array(noise)[:, quiet])[0, 1]
    assert abs(correlation) < 4.0 / math.sqrt(quiet.sum())  # 4 sigma, false alarms 6e-5
    assert np.std(noise[0][quiet]) > 0.5


def test_what_cannot_be_is_refused(dataset: Dataset, pairs: DatasetPairs) -> None:
    for number in (-1, 9):
        with pytest.raises(DatasetError, match=f"pair {number}: there are 9"):
            pairs.pair(number)
    with pytest.raises(DatasetError, match="pairs = 0"):
        dataset_pairs(dataset, pairs=0)
    with pytest.raises(DatasetError, match="no sensor preset 'raw'"):
        dataset_pairs(dataset, "raw")


def test_the_document_says_where_it_comes_from(pairs: DatasetPairs) -> None:
    document = pairs.document()
    assert json.loads(json.dumps(document, allow_nan=False)) == document
    assert (document["name"], document["pairs"], document["samples"], document["sealed"]) == ("tinybench", 9, 3, False)
    assert document["presets"] == ["bayer-raw", "mjpeg", "srgb8"]


@pytest.mark.slow
def test_tracks_show_boxes_of_their_own_or_whole_frames(bench_dataset: Path, tmp_path: Path) -> None:
    """The spot lies in the middle half of the box, in layers and in frames alike; other tracks have no box."""
    dataset = scored_dataset(bench_dataset)
    localised = dataset.pairs("mjpeg", track="localise")
    inside = 0
    for pair, truth in localised:
        for box, spot in ((pair.box_down, truth.down), (pair.box_up, truth.up)):
            assert box is not None
            assert (box.width_px, box.height_px) == (LOCALISE_BOX_PX, LOCALISE_BOX_PX)
            if truth.hinted and spot.visible:
                # between pixel edges; near the image's edge the box has no room
                u, v = spot.uv_px[0] - box.u0_px + 0.5, spot.uv_px[1] - box.v0_px + 0.5
                inside += (
                    LOCALISE_MARGIN_PX <= u <= LOCALISE_BOX_PX - LOCALISE_MARGIN_PX
                    and LOCALISE_MARGIN_PX <= v <= LOCALISE_BOX_PX - LOCALISE_MARGIN_PX
                )
    assert inside >= len(localised)
    assert tracks_of(localised.document()) == ("localise",)
    for track in ("find", "depth"):
        whole = dataset.pairs("mjpeg", track=track)
        assert all(pair.box_down is None and pair.box_up is None for pair, _ in whole)
        assert tracks_of(whole.document()) == ("find", "depth")
    again = pickle.loads(pickle.dumps(localised))
    assert again.pair(0).box_down == localised.pair(0).box_down
    assert again.document()["track"] == "localise"


@pytest.mark.parametrize("more", [{"hints": False}, {"boxes_px": 32}])
def test_a_track_leaves_no_other_boxes(more: dict[str, Any]) -> None:
    with pytest.raises(DatasetError, match="--track localise says which boxes there are"):
        PairChoice("mjpeg", track="localise", **more)
