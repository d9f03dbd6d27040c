"""Dense pairs and answers: frames as those of `Pair`, and a sentence for what is no answer."""

from typing import Any

import numpy as np
import pytest

from phibench.datasets.frames.sensor_card import card_of
from phibench.estimator.dense.dense_interface import DenseAnswer, DensePair, require_shape
from phibench.render.sensor.settings import sensor
from phibench.scenes.rig import Rig

DEPTH = np.array([[1.0, np.nan], [2.0, 3.0]])


def test_a_pair_has_frames_as_a_pair_of_spots_has_them() -> None:
    known: dict[str, Any] = {"rig": Rig(), "stroke_m": 0.4, "card": card_of(sensor("mjpeg"))}
    frames = {
        "down": [np.full((2, 3), 10, np.uint8), np.full((2, 3), 13, np.uint8)],
        "up": [np.zeros((2, 3), np.uint8)],
    }
    pair = DensePair.of_frames(7, frames, **known)
    assert (pair.count("down"), pair.count("up"), pair.count("down_off")) == (2, 1, 0)
    assert pair.down.dtype == np.float32
    assert (pair.down == 11.5).all()
    assert not pair.down.flags.writeable
    assert pair.shape == (720, 1280)
    assert repr(pair).startswith("Dense pair 7\n")
    single = DensePair.of_frames(1, {"down": frames["down"][:1], "up": frames["up"]}, **known)
    assert single.frames is None
    assert single.stack("up").shape == (1, 2, 3)


def test_an_answer_knows_where_it_says_something() -> None:
    assert DenseAnswer(DEPTH).answered.tolist() == [[True, False], [True, True]]
    places = np.stack([DEPTH, DEPTH], axis=-1)
    assert DenseAnswer(target_uv_px=places, sigma_depth_m=0.1 * DEPTH).answered.sum() == 3


@pytest.mark.parametrize(
    ("planes", "sentence"),
    [
        ({}, "neither given"),
        ({"depth_m": DEPTH, "target_uv_px": np.zeros((2, 2, 2))}, "both given"),
        ({"depth_m": DEPTH.tolist()}, "is a list"),
        ({"depth_m": DEPTH[0]}, r"has shape \(2,\): \(H, W\)"),
        ({"target_uv_px": DEPTH}, r"\(H, W, 2\) is needed"),
        ({"depth_m": np.ones((2, 2), int)}, "is of int64"),
        ({"depth_m": np.full((2, 2), np.inf)}, "infinite at 4"),
        ({"depth_m": -DEPTH}, "0 or below at 3 pixels.*Most are negative: .* disparity of the wrong sign"),
        ({"depth_m": 1e9 * DEPTH}, "above 1e6 m at 3"),
        ({"target_uv_px": np.array([[[1.0, np.nan]]])}, "only one of u and v at 1"),
        ({"target_uv_px": np.full((1, 1, 2), 1e7)}, "beyond 1e\\+06 px"),
        ({"depth_m": DEPTH, "sigma_depth_m": DEPTH[:1]}, "sigma_depth_m has shape"),
        ({"depth_m": DEPTH, "sigma_depth_m": 0.0 * DEPTH}, "sigma_depth_m is 0 or below"),
        ({"depth_m": DEPTH, "sigma_depth_m": np.full((2, 2), np.nan)}, "NaN at 3 pixels"),
    ],
)
def test_what_is_no_answer_is_told_in_a_sentence(planes: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        DenseAnswer(**planes)


def test_an_answer_of_another_image_is_refused() -> None:
    require_shape(DenseAnswer(DEPTH), (2, 2))
    with pytest.raises(ValueError, match="Rows come first"):
        require_shape(DenseAnswer(np.ones((3, 2))), (2, 3))
