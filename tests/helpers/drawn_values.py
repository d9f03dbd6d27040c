"""Drawn values of a recipe."""

from typing import Any

from helpers.recipes import changed

from phibench.datasets.recipe.load import load_recipe


def drawing(**values: Any) -> dict[str, Any]:
    """A sound recipe with `[random]`, changed."""
    raw = {key: value for key, value in changed().items() if key != "experiments"}
    return {**raw, "random": {"samples": 50, "stroke_m": {"uniform": [0.1, 1.4]}, **values}}


RAY = {"azimuth_deg": {"uniform": [0, 360]}, "height_m": {"uniform": [0.35, 1.5]}}


def shipped(count: int) -> Any:
    random = load_recipe("random").random
    assert random is not None
    return random.model_copy(update={"samples": count})
