"""Reading of recipes, by file or shipped name: TOML text, all its faults, the text with another seed or sample count.

All faults of the tables come in one go; where there are none, all faults of the scene do (`checks`).

A data set keeps the text of its recipe, so a number that the command line changes is changed in the text as well.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from phibench.datasets.common.errors import RecipeError
from phibench.datasets.common.input_files import SETTINGS_BYTES, InputFile
from phibench.datasets.recipe.checks import scene_faults, table_faults
from phibench.datasets.recipe.room_checks import file_faults
from phibench.datasets.recipe.tables import Recipe
from phibench.datasets.rooms.room_files import RoomFiles
from phibench.scenes.validation import nearest, structural_faults

RECIPES = Path(__file__).parents[1] / "recipes"


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
        With one line per fault: all of the tables, or else all of the scene.
    """
    return parse_recipe(recipe_text(path), str(find_recipe(path)), recipe_files(path))


def recipe_files(path: str | Path) -> RoomFiles:
    """Files of rooms of a recipe: they lie beside it, or in `rooms/` where it lies in a data set."""
    folder = find_recipe(path).parent
    return RoomFiles(folder / "rooms" if (folder / "dataset.json").is_file() else folder)


def recipe_text(path: str | Path) -> str:
    """TOML text of a recipe, by file or by name.

    Raises
    ------
    RecipeError
        If there is no such file, or it cannot be read; in one sentence.
    """
    return _text(find_recipe(path))


def parse_recipe(text: str, source: str = "recipe", files: RoomFiles | None = None) -> Recipe:
    """Check the TOML text of a recipe; `source` is what the error calls it.

    The files of its rooms are looked for where `files` says in which folder they lie.
    """
    return check_recipe(_input_file(Path(source)).toml_of(text), source, files)


def check_recipe(raw: dict[str, Any], source: str = "recipe", files: RoomFiles | None = None) -> Recipe:
    """Check a recipe that is a dict already."""
    structural = structural_faults(Recipe, raw)
    tables = list(table_faults(raw))
    explained = {fault.path for fault in tables}  # better than that the key is unknown
    faults = [*(f for f in structural if not (f.unknown and f.path in explained)), *tables]
    if not faults:
        recipe = Recipe.model_validate(raw)
        faults = [*scene_faults(recipe), *([] if files is None else file_faults(recipe, files))]
    if faults:
        count = f"{len(faults)} fault" + "s" * (len(faults) > 1)
        raise RecipeError("\n".join([f"{source} has {count}:", *(f"  {fault}" for fault in faults)]))
    return recipe


def _text(path: Path) -> str:
    if path.is_dir():
        raise RecipeError(f"{path} is a folder; give a TOML file")
    if not path.is_file():
        shipped = nearest(path.name, sorted(file.stem for file in RECIPES.glob("*.toml")))
        raise RecipeError(f"there is no recipe {path}; give a TOML file or the name of a shipped recipe ({shipped})")
    data = _input_file(path).read()
    if b"\0" in data[:4096]:  # never in a text of UTF-8 that people write, and early in pictures and archives
        raise RecipeError(
            f"{path} is no TOML recipe: it is a picture or another binary file; give a .toml file, which may name "
            "pictures in [[rooms.panoramas]]"
        )
    return _input_file(path).text(data, encoding="utf-8-sig")  # some editors put a byte order mark first


def _input_file(path: Path) -> InputFile:
    return InputFile(path, "mend it, and save it as UTF-8", RecipeError, SETTINGS_BYTES)


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
