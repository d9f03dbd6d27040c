"""Dense pairs: the laser-off frames of the spot pairs, one of each two views, and the truth with its certificate."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from phibench.benchmark.dense.dense_pairs import CertificateError, DensePairs, certify, dense_pairs, texture_ratio
from phibench.benchmark.pair_sets.dataset_pairs import DatasetPairs
from phibench.benchmark.scored_dataset import ScoredDataset, open_dataset
from phibench.datasets.common.errors import DatasetError


@pytest.fixture(scope="module")
def dataset(tiny_dataset: Path) -> ScoredDataset:
    opened = open_dataset(tiny_dataset)
    assert isinstance(opened, ScoredDataset)
    return opened


@pytest.fixture(scope="module")
def pairs(dataset: ScoredDataset) -> DensePairs:
    return dataset.dense_pairs("mjpeg")


def test_images_are_the_laser_off_frames_of_the_spot_pairs(dataset: ScoredDataset, pairs: DensePairs) -> None:
    spots = dataset.pairs("mjpeg")
    off = DatasetPairs(dataset, tuple(replace(draw, laser_off=True) for draw in spots.pair_draws))
    assert len(pairs) == 2
    for number, draw in enumerate(pairs.pair_draws):
        pair, spot = pairs.pair(number), off.pair(off.number_of(draw.sample_id, draw.draw))
        assert np.array_equal(pair.down, spot.down_off)
        assert np.array_equal(pair.up, spot.up_off)
        assert not pair.down.flags.writeable
        assert (pair.rig, pair.stroke_m, pair.card) == (spot.rig, spot.stroke_m, spot.card)
        assert pair.number == number
    several = dataset.dense_pairs("mjpeg", frames=3).pair(0)
    assert several.count("down") == 3
    assert np.array_equal(several.stack("up")[0], pairs.pair(0).up)


def test_samples_with_the_same_two_views_are_taken_once(dataset: ScoredDataset) -> None:
    twice = replace(dataset, rows=(*dataset.rows, replace_id(dataset.rows[0], "again")))
    assert [draw.sample_id for draw in dense_pairs(twice, "mjpeg").pair_draws].count("again") == 0
    assert len(dense_pairs(twice, "mjpeg", draws=2)) == 4


def replace_id(row, name):
    return row.model_copy(update={"sample_id": name})


def test_truth_has_its_certificate_and_a_moved_counterpart_has_none(pairs: DensePairs) -> None:
    truth = pairs.truth(0)
    sample = pairs.dataset[truth.sample_id]
    assert certify(truth.found, sample.view("up")) < 1e-9
    moved = replace(truth.found, uv_px=truth.found.uv_px + 1e-5)
    with pytest.raises(CertificateError, match="differ by 1e-05 px"):
        certify(moved, sample.view("up"))
    assert truth.room == "lab"
    shown = np.isfinite(truth.depth_m)
    assert np.array_equal(shown, np.isfinite(truth.elevation_rad))
    assert (truth.scored & ~shown).sum() == 0


def test_images_between_are_those_of_shorter_strokes(dataset: ScoredDataset, pairs: DensePairs) -> None:
    """Two experiments of one lab and rig: 0.5 and 1.4 m from the same down view."""
    whole = dense_pairs(dataset, "mjpeg", between=True)
    short, long = sorted(range(2), key=lambda number: pairs.pair(number).stroke_m)
    assert whole.pair(short).between is None
    pair = whole.pair(long)
    assert pair.between is not None
    assert pair.between_m == (pairs.pair(short).stroke_m,) == (0.5,)
    assert np.array_equal(pair.between[0], pairs.pair(short).up)
    assert np.array_equal(pair.up, pairs.pair(long).up)
    assert whole.document()["between"] is True
    assert not pair.between.flags.writeable


def test_images_between_need_pairs_of_other_strokes(dataset: ScoredDataset) -> None:
    with pytest.raises(DatasetError, match="no two pairs have the same rig, room and down view"):
        dense_pairs(dataset[:1], "mjpeg", between=True)
    with pytest.raises(DatasetError, match="one of each height"):
        dense_pairs(dataset, "mjpeg", frames=2, between=True)


def test_texture_is_that_of_the_image_without_its_noise() -> None:
    """A ramp of slope s under noise of deviation n has s^2 / n^2; a flat image has none.

    Over 81 pixels the noise's variance is known to 16 %, and over some 1300 windows of independent ones to 3 %. Flat
    images leave the product of two independent gradients, of mean 0.
    """
    rng, slope, noise = np.random.default_rng(0), 3.0, 2.0
    ramp = slope * np.arange(400.0)[None, :] * np.ones((300, 1))
    for image, expected in ((ramp, slope**2 / noise**2), (np.zeros((300, 400)), 0.0)):
        ratio = texture_ratio(*((image + noise * rng.normal(size=image.shape))[..., None] for _ in range(2)))
        assert np.median(ratio) == pytest.approx(expected, rel=0.05, abs=0.05)


def test_a_pickled_set_gives_the_same_pairs(pairs: DensePairs) -> None:
    import pickle

    again = pickle.loads(pickle.dumps(pairs))
    assert np.array_equal(again.pair(1).down, pairs.pair(1).down)
    assert again.document() == pairs.document()


def test_what_has_no_truth_of_pixels_is_refused(dataset: ScoredDataset) -> None:
    with pytest.raises(DatasetError, match="has no truth of pixels"):
        dense_pairs("somewhere", "mjpeg")
    with pytest.raises(DatasetError, match="pairs = 0"):
        dense_pairs(dataset, "mjpeg", pairs=0)
    with pytest.raises(DatasetError, match="frames = 0"):
        dense_pairs(dataset, "mjpeg", frames=0)
