"""Reading recipe files."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from phibench.datasets.errors import RecipeError
from phibench.datasets.recipe import Recipe
from phibench.datasets.recipe_checks import semantic_faults
from phibench.datasets.recipe_height import height_faults
from phibench.render.model_faults import structural_faults
from phibench.scenes.names import nearest

RECIPES = Path(__file__).with_name("recipes")


def find_recipe(name: str | Path) -> Path:
    """Path of a recipe: a file, or the name of one that is shipped (such as ``paper``)."""
    path, shipped = Path(name), RECIPES / f"{name}.toml"
    if path.is_file() or not shipped.is_file():
        return path
    return shipped


def load_recipe(path: str | Path) -> Recipe:
    """Read and check a recipe.

    Raises
    ------
    RecipeError
        With one line per fault, all of them.
    """
    return parse_recipe(recipe_text(path), str(find_recipe(path)))


def recipe_text(path: str | Path) -> str:
    """TOML text of a recipe, by file or by name.

    Raises
    ------
    RecipeError
        If there is no such file, or it cannot be read; in one sentence.
    """
    return _text(find_recipe(path))


def parse_recipe(text: str, source: str = "recipe") -> Recipe:
    """Check the TOML text of a recipe; `source` is what the error calls it."""
    try:
        raw = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise RecipeError(f"{source} is not valid TOML: {error}") from error
    return check_recipe(raw, source)


def check_recipe(raw: dict[str, Any], source: str = "recipe") -> Recipe:
    """Check a recipe that is a dict already."""
    height = height_faults(raw)
    found = [*height, *semantic_faults(_judgeable(raw, strokes=not height))]
    explained = {fault.path for fault in found}  # better than that the key is unknown
    faults = [*(f for f in structural_faults(Recipe, raw) if not (f.unknown and f.path in explained)), *found]
    if faults:
        count = f"{len(faults)} fault" + "s" * (len(faults) > 1)
        raise RecipeError("\n".join([f"{source} has {count}:", *(f"  {fault}" for fault in faults)]))
    return Recipe.model_validate(raw)


def _judgeable(raw: dict[str, Any], strokes: bool) -> dict[str, Any]:
    """Recipe without the keys about which only faults that follow from others could be found.

    Experiments cannot name targets that have no names, and no stroke is short enough for a rig in the ceiling.
    """
    entries, targets = raw.get("experiments"), raw.get("targets")
    if not isinstance(entries, list):
        return raw
    named = isinstance(targets, list) and all(isinstance(t, dict) and isinstance(t.get("name"), str) for t in targets)
    dropped = {key for key, kept in (("targets", named), ("strokes_m", strokes)) if not kept}
    kept = [{k: v for k, v in e.items() if k not in dropped} if isinstance(e, dict) else e for e in entries]
    return {**raw, "experiments": kept}


def _text(path: Path) -> str:
    if path.is_dir():
        raise RecipeError(f"{path} is a folder; give a TOML file")
    if not path.is_file():
        shipped = nearest(path.name, sorted(file.stem for file in RECIPES.glob("*.toml")))
        raise RecipeError(f"there is no recipe {path}; give a TOML file or the name of a shipped recipe ({shipped})")
    try:
        return path.read_text(encoding="utf-8-sig")  # some editors put a byte order mark first
    except UnicodeDecodeError as error:
        raise RecipeError(f"{path} cannot be read: byte {error.start} is not UTF-8; save it as UTF-8") from error
    except OSError as error:
        raise RecipeError(f"{path} cannot be read: {error.strerror or error}") from error
