"""Distractors: where they are by other mathematics, how bright, when they are out, and regions to the bit."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.bench_samples import hidden, many, with_tables
from helpers.oracles import true_pixel
from helpers.sensor_light import moving, room, spot_at

from phibench.datasets.exposures.expected_electrons import expected_of_light
from phibench.datasets.exposures.pair_draws import CachedSample, pair_draws
from phibench.datasets.frames.distractors import MIN_APART_PX, Distractor, distractors, present_tables
from phibench.datasets.read import Dataset, Sample, open_dataset
from phibench.render.sensor.camera_chain import Chain
from phibench.render.sensor.electrons import NoiseStream, expected_electrons
from phibench.render.sensor.light import Light, OtherSpot, Region
from phibench.render.sensor.settings import sensor
from phibench.scenes.camera import Camera

SIZE = (72, 130)
CAMERA = Camera(width_px=130, height_px=72, fx_px=150.0, fy_px=150.0, cx_px=64.0, cy_px=35.0)
STREAM = NoiseStream(("others", 0))
IDEAL = sensor("ideal")


def light() -> Light:
    """Room and spot with a laser's reflection at the border, a lamp beside the spot and one over another."""
    others = (
        OtherSpot(spot_at(1.2, 70.4, electrons_per_s=4e5)),
        OtherSpot(spot_at(81.0, 36.0, electrons_per_s=3e5), follows_laser=False),
        OtherSpot(spot_at(82.5, 35.1, electrons_per_s=2e5)),
    )
    return replace(room(SIZE), others=others, laser_level=0.6)


def electrons(view: Light) -> np.ndarray:
    return expected_electrons(view, IDEAL, CAMERA, Region.whole(SIZE))


# Light on the sensor


def test_lights_add_up_pixel_by_pixel() -> None:
    both = light()
    assert both.spot is not None
    expected = both.ambient_electrons_per_s.astype(float)
    for image, level in [(both.spot, 0.6), *((o.image, 0.6 if o.follows_laser else 1.0) for o in both.others)]:
        rows, columns = image.electrons_per_s.shape[1:]
        for y in range(rows):
            for x in range(columns):
                v, u = image.v0_px + y, image.u0_px + x
                if 0 <= v < SIZE[0] and 0 <= u < SIZE[1]:
                    expected[:, v, u] += level * image.electrons_per_s[:, y, x]
    # sums of six float64 numbers: a few times eps
    np.testing.assert_allclose(electrons(both), expected * IDEAL.exposure_s, rtol=1e-14)


def test_with_the_laser_off_only_lamps_stay() -> None:
    both = light()
    lamps = replace(both, spot=None, others=tuple(o for o in both.others if not o.follows_laser))
    assert np.array_equal(electrons(both.laser_off()), electrons(lamps))
    bare = replace(both, spot=None, others=())
    assert electrons(both.laser_off())[0, 36, 81] > electrons(bare)[0, 36, 81] * 1.01


def test_what_lies_under_the_spot_holds_every_other_light() -> None:
    both = light()
    assert np.array_equal(electrons(both.without_spot()), electrons(replace(both, spot=None)))
    assert electrons(both.without_spot())[0, 35, 82] > electrons(both.laser_off())[0, 35, 82] * 1.01
    region = expected_of_light(both, sensor("mono-raw"), CAMERA)
    whole = expected_electrons(both, sensor("mono-raw"), CAMERA, Region.whole(SIZE))
    part = whole[
        region.v0_px : region.v0_px + region.mean_e.shape[0], region.u0_px : region.u0_px + region.mean_e.shape[1]
    ]
    # the same sums in another order; dark current is 3 e/s x 1/60 s
    np.testing.assert_allclose(region.mean_e, part + 0.05, rtol=1e-13)


@pytest.mark.parametrize("velocity", [(0.0, 0.0), (140.0, -90.0)])
@pytest.mark.parametrize("preset", ["ideal", "mono-raw", "bayer-raw", "srgb8", "mjpeg"])
def test_a_region_is_the_whole_frame_there(preset: str, velocity: tuple[float, float]) -> None:
    view, chain = moving(light(), velocity, sensor(preset)), Chain(sensor(preset), 3, CAMERA)
    whole = chain.frame(view, STREAM)
    without = chain.frame(replace(view, others=()), STREAM)
    assert not np.array_equal(whole, without)
    random = np.random.default_rng(5)
    checked = 0
    for _ in range(30):
        u0, u1 = np.sort(random.choice(SIZE[1] + 1, 2, replace=False))
        v0, v1 = np.sort(random.choice(SIZE[0] + 1, 2, replace=False))
        part = Region(int(u0), int(v0), int(u1), int(v1))
        index = part.slices() if whole.shape[:2] == SIZE else (..., *part.slices())
        assert np.array_equal(chain.frame(view, STREAM, part), whole[index])
        checked += 1
    assert checked == 30


# Where and how bright


@pytest.fixture(scope="module")
def dataset(bench_dataset: Path) -> Dataset:
    return open_dataset(bench_dataset)


@pytest.fixture(scope="module")
def found(dataset: Dataset) -> list[tuple[Sample, Distractor]]:
    pairs = [(sample, one) for sample in dataset for one in distractors(sample)]
    assert {one.kind for _, one in pairs} == {"spot", "led", "glow"}
    return pairs


def test_the_place_is_alhazens(found: list[tuple[Sample, Distractor]]) -> None:
    """Roots of Alhazen's quartic and OpenCV's camera, neither of which the renderer uses."""
    checked = 0
    for sample, one in found:
        for position, truth in one.truths.items():
            if truth.visible:
                place = true_pixel(sample.rig, sample.truth_row(position).offset_m, np.array(one.spot.position_world_m))
                # roots of a quartic in long double: 1e-9 px is 1e4 times what they are good for
                np.testing.assert_allclose((truth.u_px, truth.v_px), place, atol=1e-8)
                checked += 1
    assert checked >= 12


def test_the_light_is_at_its_place(found: list[tuple[Sample, Distractor]]) -> None:
    checked = 0
    for _, one in found:
        for position, layer in one.layers.items():
            truth = one.truths[position]
            if not truth.visible or layer.electrons_per_s.sum() < 0.999 * layer.total_electrons_per_s.sum():
                continue
            image = layer.electrons_per_s[0]
            u = layer.u0_px + image.sum(axis=0) @ np.arange(image.shape[1]) / image.sum()
            v = layer.v0_px + image.sum(axis=1) @ np.arange(image.shape[0]) / image.sum()
            # energy centroid minus chief ray: coma and defocus of these near discs stay below a fiftieth of a pixel
            assert math.hypot(u - truth.u_px, v - truth.v_px) < 0.02
            checked += 1
    assert checked >= 12


def test_each_is_as_bright_as_drawn_and_never_more_than_half_the_spot(
    found: list[tuple[Sample, Distractor]],
) -> None:
    for sample, one in found:
        ratios = [
            layer.total_electrons_per_s[0] / sample.truth_row(position).electrons_per_s[0]
            for position, layer in one.layers.items()
            if sample.truth_row(position).visible
        ]
        assert max(ratios) <= 0.5 + 1e-12
        if one.kind == "spot":  # the recipe gives this one a number
            assert max(ratios) == pytest.approx(0.4, rel=1e-12)


def test_none_is_in_the_spots_window_and_each_is_in_the_down_image(found: list[tuple[Sample, Distractor]]) -> None:
    for sample, one in found:
        assert one.truths["down"].visible
        for position, truth in one.truths.items():
            row = sample.truth_row(position)
            assert not math.hypot(truth.u_px - row.u_px, truth.v_px - row.v_px) < MIN_APART_PX


def test_the_power_is_that_of_the_layer(found: list[tuple[Sample, Distractor]]) -> None:
    """The disc in the truth would give the same layer: its power was scaled with it."""
    from phibench.render.optics.spot_layer import spot_layer

    sample, one = found[0]
    view = sample.view("down")
    again = spot_layer(view, one.spot, sample.room.shapes(view))
    np.testing.assert_allclose(again.electrons_per_s, one.layers["down"].electrons_per_s, rtol=1e-12, atol=1e-12)


def test_they_are_a_pure_function_of_the_sample(bench_dataset: Path, found: list[tuple[Sample, Distractor]]) -> None:
    sample, one = found[0]
    again = distractors(open_dataset(bench_dataset)[sample.row.sample_id])[0]
    assert again.spot == one.spot
    assert np.array_equal(again.layers["up"].electrons_per_s, one.layers["up"].electrons_per_s)


def test_they_come_as_often_as_the_recipe_says(bench_dataset: Path) -> None:
    dataset = many(bench_dataset, 2000, distractors=[{"kind": "spot", "probability": 0.3}, {"kind": "spot"}])
    numbers = [present_tables(sample.stream_names, sample.dataset.recipe.distractors) for sample in dataset]
    # binomial, n = 2000, p = 0.3: sigma 20.5; 4 sigma, false alarms 6e-5
    assert abs(sum(0 in found for found in numbers) - 600) < 82
    assert all(1 in found for found in numbers)


def test_a_reflection_is_not_on_the_samples_own_board(dataset: Dataset) -> None:
    own, checked = {row.target for row in dataset.rows}, 0
    for sample in with_tables(dataset, distractors=[{"kind": "spot", "target": {"choice": sorted(own)}}]):
        for one in distractors(sample):
            position = np.array(one.spot.position_world_m)
            board = next(t for t in sample.dataset.recipe.targets if t.name == sample.row.target)
            centre = board.depth_m * np.array(
                [math.cos(math.radians(board.azimuth_deg)), math.sin(math.radians(board.azimuth_deg))]
            )
            assert np.hypot(*(position[:2] - centre)) > 0.25  # half a board's diagonal
            checked += 1
    assert checked >= 2
    nowhere = with_tables(dataset, distractors=[{"kind": "spot", "target": {"choice": [dataset.rows[0].target]}}])
    assert distractors(nowhere.samples[0]) == ()


def test_without_a_spot_there_is_nothing_to_be_compared_with(dataset: Dataset) -> None:
    assert distractors(hidden(dataset, "down", "up").samples[0]) == ()
    half = distractors(hidden(dataset, "up").samples[0])
    assert half
    row = dataset.rows[0]
    spot = next(one for one in half if one.kind == "spot")
    assert spot.layers["down"].total_electrons_per_s[0] / row.down.electrons_per_s[0] == pytest.approx(0.4, rel=1e-12)


def test_frames_of_a_take_hold_them(dataset: Dataset) -> None:
    """Mean of the difference with and without, over the pixels of one distractor, laser on and off."""
    pair_draw = next(t for t in pair_draws(dataset, "mono-raw"))
    kept = CachedSample.of(dataset[pair_draw.sample_id])
    bare = with_tables(dataset, distractors=[])[pair_draw.sample_id]
    source, plain = kept.source(pair_draw), CachedSample.of(bare).source(pair_draw)
    checked = 0
    for laser in (True, False):
        frames = [s.frame("down", 0, laser).image.astype(float) for s in (source, plain)]
        for one in kept.distractors:
            truth = one.truths["down"]
            side = source.sides["down"].chain.sensor
            box = Region.around(truth.u_px, truth.v_px, frames[0].shape, 13)
            difference = (frames[0] - frames[1])[box.slices()].sum() / side.dn_per_e
            rate = float(one.layers["down"].total_electrons_per_s.sum())
            wanted = rate * side.exposure_s * pair_draw.request.laser_level * (laser or not one.follows_laser)
            ambient = source.sides["down"].light.ambient_electrons_per_s[:, *box.slices()].sum() * side.exposure_s
            # shot and read noise of 169 pixels in two frames, PRNU of the light; 5 sigma, false alarms 6e-7
            sigma = math.sqrt(2.0 * (ambient + wanted + 169 * (side.read_noise_e**2 + 1.0)))
            assert abs(difference - wanted) < 5.0 * sigma + 0.02 * wanted, one.kind
            checked += 1
    assert checked >= 4
    lamp = next(one for one in kept.distractors if not one.follows_laser)
    assert lamp.other("down", 0.5).image.electrons_per_s.sum() == pytest.approx(
        0.5 * lamp.layers["down"].electrons_per_s.sum()
    )
