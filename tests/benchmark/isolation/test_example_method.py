"""The example that `phibench method new` writes: it finds the spot on rendered frames of every preset."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from phibench.benchmark.isolation import example_method
from phibench.benchmark.isolation.example_method import extract
from phibench.benchmark.pair_sets.dataset_pairs import dataset_pairs
from phibench.benchmark.scores.answer_errors import MATCH_PX
from phibench.datasets.read import open_finished
from phibench.estimator.interface import Answer, Pair


@pytest.mark.parametrize(
    "preset",
    ["mjpeg", *(pytest.param(name, marks=pytest.mark.slow) for name in ("mono-raw", "bayer-raw", "srgb8", "yuyv"))],
)
def test_the_example_finds_the_spots_of_a_rendered_room(smoke_dataset: Path, preset: str) -> None:
    """The recipe `smoke` has the room of `paper`, its lamps and two of its distances: at 1.975 m and at 3.18 m.

    `paper` itself, by `phibench score`: the aim is 95 % of 50 images in each preset.
    """
    pairs = dataset_pairs(open_finished(smoke_dataset), preset)
    found = visible = 0
    for number in range(len(pairs)):
        answer, truth = extract(pairs.pair(number)), pairs.truth(number)
        for spot, true in ((answer.down, truth.down), (answer.up, truth.up)):
            visible += true.visible
            distance = np.inf if spot.uv_px is None else np.hypot(*np.subtract(spot.uv_px, true.uv_px))
            found += true.visible and distance <= MATCH_PX
    assert visible >= 6
    assert found == visible


@pytest.mark.slow
def test_the_example_answers_without_laser_off_frames_and_without_a_spot(easy: Pair) -> None:
    without = replace(easy, down_off=None, up_off=None)
    # with one frame there is the room's slope below the spot: a tenth of a pixel between the two
    for one, other in zip(both(extract(without)), both(extract(easy)), strict=True):
        assert np.hypot(*np.subtract(one, other)) < 0.5
    assert easy.down_off is not None
    dark = replace(easy, down=easy.down_off)
    assert extract(dark).down.uv_px is None
    assert extract(dark).up == extract(easy).up


def both(answer: Answer) -> list[tuple[float, float]]:
    """Positions of both images."""
    assert answer.down.uv_px is not None
    assert answer.up.uv_px is not None
    return [answer.down.uv_px, answer.up.uv_px]


@pytest.fixture(scope="module")
def easy() -> Pair:
    from phibench.benchmark.isolation.easy_pairs import EasyPairs

    return EasyPairs().pair(0)


def test_the_example_is_short() -> None:
    """It is read by everybody who begins: 60 lines of text, without the empty ones."""
    lines = Path(example_method.__file__).read_text(encoding="utf-8").splitlines()
    assert sum(bool(line.strip()) for line in lines) <= 60
