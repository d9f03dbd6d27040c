"""Recipes with changes, and the faults that they have."""

from typing import Any

import pytest

from phibench.datasets.common.errors import RecipeError
from phibench.datasets.recipe.load import check_recipe

SOUND: dict[str, Any] = {
    "dataset": {"name": "x"},
    "targets": [{"name": "a", "depth_m": 2.0, "azimuth_deg": 10.0, "height_m": 0.5}],
    "experiments": [{"name": "e", "targets": ["a"], "strokes_m": [0.4]}],
}


def changed(**tables: Any) -> dict[str, Any]:
    return {**SOUND, **tables}


def complaints(raw: dict[str, Any]) -> list[str]:
    with pytest.raises(RecipeError) as caught:
        check_recipe(raw)
    head, *lines = str(caught.value).splitlines()
    assert head.startswith(f"recipe has {len(lines)} fault")
    return [line.strip() for line in lines]


def target(**values: Any) -> dict[str, Any]:
    return {**SOUND["targets"][0], **values}
