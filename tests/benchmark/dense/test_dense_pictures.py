"""Pictures of dense answers: what is drawn, by numbers, and that the same answer gives the same bytes."""

import io

import numpy as np
import pytest
from helpers.dense_truths import smaller, truth_of
from PIL import Image

from phibench.benchmark.dense.dense_pictures import CAUSE_GROUPS, DensePicture, free_space
from phibench.datasets.frames.sensor_card import sensor_card
from phibench.estimator.dense.dense_interface import DensePair
from phibench.scenes.room import default_rig


@pytest.fixture(scope="module")
def picture() -> DensePicture:
    rig = smaller(default_rig(), 6.0)
    truth = truth_of(rig)
    grey = np.full((*truth.depth_m.shape, 3), 90, np.uint8)
    pair = DensePair(0, grey, grey, rig, truth.stroke_m, sensor_card("srgb8"))
    depth = 1.05 * truth.depth_m
    depth[:, :80] = np.nan
    return DensePicture(pair, truth, depth, "five per cent too far")


def test_groups_are_the_causes_of_the_truth(picture: DensePicture) -> None:
    counts = np.bincount(picture.groups.ravel(), minlength=len(CAUSE_GROUPS))
    assert counts[0] == picture.truth.scored.sum()
    assert counts[4] == picture.truth.found.counts()["nothing"]
    assert counts.sum() == picture.depth_m.size
    assert counts[3] > 0


def test_points_lie_at_their_depth_on_the_rays(picture: DensePicture) -> None:
    points = picture.points_m(picture.truth.depth_m)
    known = np.isfinite(points[..., 0])
    assert known.any()
    np.testing.assert_allclose(points[known], picture.truth.found.point_world_m[known], atol=1e-9)


def test_free_space_is_that_of_a_round_wall() -> None:
    """A wall at 2 m on all sides but a gap, a board at 1 m, and one lone error in a hundred points of a sector."""
    turn = np.radians(np.arange(0.0, 340.0, 0.02))
    radius = np.where((turn > np.radians(90.0)) & (turn < np.radians(100.0)), 1.0, 2.0)
    radius[50] = 0.3
    points = radius[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    free = free_space(points)
    assert free[0] == pytest.approx(2.0)
    assert free[46:49] == pytest.approx(1.0)
    assert np.isnan(free[171:]).all()
    assert free.shape == (180,)


@pytest.mark.slow
def test_the_same_answer_gives_the_same_picture(picture: DensePicture) -> None:
    panoramas, above = picture.panoramas_png(), picture.from_above_png()
    assert Image.open(io.BytesIO(panoramas)).size == (800, 1040)
    assert Image.open(io.BytesIO(above)).size == (700, 620)
    assert picture.from_above_png() == above
