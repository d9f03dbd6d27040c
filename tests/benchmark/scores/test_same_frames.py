"""One meaning of the frames of a data set: scores, calls, training, crops, exports and drawn files show the same."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import phibench
from phibench.benchmark.export.export_make import export
from phibench.benchmark.export.pair_rows import ExportRequest, pair_key
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.exposures.draw_frames import draw_frames
from phibench.datasets.frames.frame_files import read_index
from phibench.datasets.frames.frame_request import FrameOptions
from phibench.datasets.recipe.load import parse_recipe, recipe_text
from phibench.datasets.training import CropSettings, PairDataset, SpotCrops
from phibench.render.sensor import settings

DRAW = 1
NAMES = ("down", "up", "down_off", "up_off")


def read_image(file: Path) -> np.ndarray:
    with Image.open(file) as picture:
        return np.asarray(picture)


@pytest.fixture(scope="module")
def folder(request: pytest.FixtureRequest, bench_dataset: Path, tiny_dataset: Path) -> Path:
    """Exposure, levels, quality, cameras and distractors by the recipe, and a recipe that says nothing of them."""
    return bench_dataset if request.param == "with [frames]" else tiny_dataset


@pytest.mark.parametrize(
    ("folder", "preset"),
    [
        pytest.param("with [frames]", "bayer-raw", marks=pytest.mark.slow),
        ("with [frames]", "mjpeg"),
        ("without", "srgb8"),
    ],
    indirect=["folder"],
)
def test_six_ways_give_the_same_bytes(folder: Path, tmp_path: Path, preset: str) -> None:
    """Frames of every visible sample of a set in one draw: the six agree byte by byte, with the numbers they state."""
    dataset = phibench.open_dataset(folder)
    assert (dataset.recipe.frames is None) == (dataset.info.name == "tiny")
    options = FrameOptions(preset)
    pairs = dataset.pairs(preset, draws=DRAW + 1)
    training = PairDataset(folder, preset, laser_off=True)
    training.set_epoch(DRAW)
    drawn = draw_frames(folder, options, DRAW + 1, out=tmp_path / "drawn", laser_off=True, workers=1).folder
    rows = read_index(drawn)
    request = ExportRequest("frames", options, DRAW + 1, laser_off=True)
    exported = export(folder, request, tmp_path / "export", workers=1).folder
    compared = 0
    for number, sample in enumerate(dataset):
        name = sample.row.sample_id
        k = pairs.number_of(name, DRAW)
        pair, truth = pairs.pair(k), pairs.truth(k)
        frames = sample.camera_frames(preset, DRAW, laser_off=True)
        for image in NAMES:
            scored = getattr(frames, image)  # the way that all others are held against
            if image in pair.images:
                np.testing.assert_array_equal(pair.images[image], scored)
            np.testing.assert_array_equal(training[number][image], scored)
            position, laser = image.removesuffix("_off"), "off" if image.endswith("_off") else "on"
            [row] = [
                row
                for row in rows.values()
                if (row.sample_id, row.position, row.laser, row.draw, row.kind)
                == (name, position, laser, DRAW, "frame")
            ]
            np.testing.assert_array_equal(read_image(drawn / row.file), scored)
            [file] = exported.rglob(f"*{pair_key(name, DRAW)}*{image}.*")
            assert file.read_bytes() == (drawn / row.file).read_bytes()
            stated = (row.exposure_s, row.analogue_gain, row.jpeg_quality, row.laser_level, row.lamp_level)
            told = (truth.exposure_s, truth.analogue_gain, truth.jpeg_quality, truth.laser_level, truth.lamp_level)
            assert stated == told
            assert stated[0] == pair.card.exposure_s
            compared += 1
    assert compared == 4 * len(dataset) > 4


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["bayer-raw", "mjpeg"])
@pytest.mark.parametrize("folder", ["with [frames]", "without"], indirect=True)
def test_crops_have_the_camera_of_the_pairs(folder: Path, preset: str) -> None:
    """Crops move spots and draw their own noise; exposure, gain, quality and levels are those of the pair."""
    dataset = phibench.open_dataset(folder)
    pairs = dataset.pairs(preset, draws=1)
    crops = SpotCrops([folder], [FrameOptions(preset)], 12, settings=CropSettings(side_px=16, laser_levels=(1.0, 1.0)))
    cards = {truth.sample_id: pair.card for pair, truth in pairs}
    for k in range(len(crops)):
        crop = crops.crop(k)
        assert crop.card == cards[crop.sample_id]


def test_a_pair_is_found_by_what_a_score_says_of_it(bench_dataset: Path) -> None:
    pairs = phibench.open_dataset(bench_dataset).pairs()
    truth = pairs.truth(2)
    assert pairs.number_of(truth.sample_id, truth.draw, truth.preset) == 2
    with pytest.raises(phibench.datasets.common.errors.DatasetError, match="there is no such pair"):
        pairs.number_of("nothing")
    with pytest.raises(phibench.datasets.common.errors.DatasetError, match="give one"):
        pairs.number_of(truth.sample_id)


def test_a_preset_added_to_the_table_works_or_is_refused(
    tiny_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One that ends at raw pixels works as the shipped ones; one that ends before pixels is told by its name."""
    table = tmp_path / "presets.toml"
    more = '[presets.dim-raw]\noutput = "raw"\nread_noise_e = 8.0\n\n[presets.dim-light]\noutput = "electrons"\n'
    table.write_text(f"{settings.PRESETS_FILE.read_text()}\n{more}")
    monkeypatch.setattr(settings, "PRESETS_FILE", table)
    test_six_ways_give_the_same_bytes(tiny_dataset, tmp_path, "dim-raw")
    scored = phibench.score(
        tiny_dataset,
        lambda pair: phibench.Answer(phibench.Spot.missing("-"), phibench.Spot.missing("-")),
        "dim-raw",
        pairs=1,
    )
    assert scored.records["preset"].unique().to_list() == ["dim-raw"]
    with pytest.raises(DatasetError, match="preset 'dim-light' ends before the pixels"):
        phibench.open_dataset(tiny_dataset).pairs("dim-light")
    with pytest.raises(DatasetError, match="preset 'dim-light' has no image file"):
        ExportRequest("frames", FrameOptions("dim-light"))
    assert phibench.EasyPairs("dim-raw").pair(0).down.dtype == np.uint16
    with pytest.raises(ValueError, match="no easy pairs for preset 'dim-light'"):
        phibench.EasyPairs("dim-light")
    text = f'{recipe_text("paper")}\n[frames]\npresets = ["dim-raw"]\n'
    with pytest.raises(DatasetError, match=r"frames\.presets\[0\]: 'dim-raw' is not allowed; give one of"):
        parse_recipe(text)
