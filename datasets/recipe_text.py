"""The text of a recipe with other numbers in it: the file that a data set keeps must say what it was made from."""

from __future__ import annotations

import re

from phibench.datasets.errors import RecipeError
from phibench.datasets.recipe_file import parse_recipe


def with_numbers(text: str, source: str, samples: int | None, seed: int | None) -> str:
    """TOML text with another `[random].samples` and `[dataset].seed`; None leaves a number as it is.

    Raises
    ------
    RecipeError
        If the recipe is faulty, has no `[random]` to take samples from, or does not have its tables as tables.
    """
    if samples is not None:
        if parse_recipe(text, source).random is None:
            raise RecipeError(
                f"--samples {samples}: {source} draws nothing, it has no [random]; leave --samples out or give a "
                "recipe that draws its samples, such as bench-dev"
            )
        text = _replaced(text, "random", "samples", samples)
    if seed is not None:
        text = _replaced(text, "dataset", "seed", seed)
    recipe = parse_recipe(text, source)
    held = (None if recipe.random is None else recipe.random.samples, recipe.dataset.seed)
    if (samples is not None and held[0] != samples) or (seed is not None and held[1] != seed):
        raise RecipeError(f"{source}: --samples and --seed need [dataset] and [random] as tables with headings of [ ]")
    return text


def _replaced(text: str, table: str, key: str, value: int) -> str:
    """Text with `key = value` in `[table]`; a comment behind the old number stays."""
    head = re.search(rf"^[ \t]*\[[ \t]*{table}[ \t]*\].*$", text, re.MULTILINE)
    if head is None:
        return text
    following = re.search(r"^[ \t]*\[", text[head.end() :], re.MULTILINE)
    end = len(text) if following is None else head.end() + following.start()
    body, count = re.subn(
        rf"^([ \t]*{key}[ \t]*=[ \t]*)[^\s#]+", rf"\g<1>{value}", text[head.end() : end], count=1, flags=re.MULTILINE
    )
    if not count:
        body = f"\n{key} = {value}{body}"
    return text[: head.end()] + body + text[end:]
