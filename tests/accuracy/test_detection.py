"""Detection without a hint in generated rooms: spots above 10 sigma that are found, and false ones, by preset.

`pytest --study -s tests/accuracy/test_detection.py` renders 12 rooms of bench-dev with a seed of its own, puts 25
spots into each, and prints the figures. Nothing of `detect` was tuned on them. Intervals take rooms as samples.
`tests/helpers/detections.py` prints the same of a data set that is there already.
"""

from __future__ import annotations

import pytest
from helpers.detections import PRESETS, told
from helpers.further_spots import with_further_spots
from helpers.inline_workers import make_inline

from phibench.datasets.read import Dataset, open_dataset
from phibench.datasets.recipe.load import recipe_text, with_numbers

ROOMS, SPOTS, SEED = 12, 25, 4242


@pytest.mark.study
@pytest.mark.parametrize("preset", PRESETS)
def test_detection_in_generated_rooms(preset: str, in_rooms: Dataset) -> None:
    """Required: 99 % found and 0.5 % false on bayer-raw and srgb8. An interval that excludes it fails."""
    found, false = told(in_rooms, preset)
    if preset != "mjpeg":
        assert found.high >= 0.99
        assert false.low <= 0.005


@pytest.fixture(scope="module")
def in_rooms(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("detection")
    recipe = folder / "recipe.toml"
    recipe.write_text(with_numbers(recipe_text("bench-dev"), "bench-dev", ROOMS, SEED), encoding="utf-8")
    make_inline(recipe, folder / "rooms")
    return with_further_spots(open_dataset(folder / "rooms"), folder / "spots", SPOTS, SEED)
