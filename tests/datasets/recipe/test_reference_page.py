"""RECIPE.md is what the generator writes, and the generator says what the models and presets say."""

import re
from pathlib import Path

import pytest

from phibench.datasets.recipe.recipe_scene import build_rig
from phibench.datasets.recipe.tables import RigTable
from phibench.scenes.room import RIGS
from tools import reference_page

PAGE = (Path(reference_page.__file__).resolve().parents[1] / "datasets" / "RECIPE.md").read_text(encoding="utf-8")


def test_the_page_is_the_generated_one() -> None:
    assert reference_page.recipe_page() == PAGE, "run python -m tools.reference_page > datasets/RECIPE.md"


@pytest.mark.parametrize("heading", reference_page.TABLES)
def test_every_key_has_its_line(heading: str) -> None:
    section = PAGE.split(f"## `{heading}`\n")[1].split("\n## ")[0]
    fields = list(reference_page.TABLES[heading].model_fields)
    base = reference_page.DRAWN_FROM.get(heading)
    if base is None:
        assert re.findall(r"^\| `(\w+)` \|", section, flags=re.MULTILINE) == fields
        return
    # a table of distributions has the keys and ranges of the table that it draws: they stand there alone
    (keys,) = re.findall(rf"^Keys: all of `{re.escape(base)}`(.*?), each", section, flags=re.MULTILINE | re.DOTALL)
    drawn, fixed = reference_page.TABLES[heading], reference_page.TABLES[base]
    assert fields == [key for key in fixed.model_fields if f"`{key}`" not in keys]
    for key in fields:
        if drawn.model_fields[key].description == fixed.model_fields[key].description:  # not so of tables in a table
            assert reference_page._allowed(key, drawn) == f"{reference_page._allowed(key, fixed)} (or drawn)"


def test_units_ranges_and_defaults_are_there() -> None:
    line = next(line for line in PAGE.splitlines() if line.startswith("| `wavelength_nm` | nm | 4"))
    assert line.split(" | ")[1:4] == ["nm", "400 to 700", "650"]
    [line] = [line for line in PAGE.splitlines() if line.startswith("| `strokes_m`")]
    assert "0.001 to 10" in line


@pytest.mark.parametrize("name", RIGS)
def test_a_recipe_that_writes_the_presets_values_gets_the_preset(name: str) -> None:
    """The column can be typed in: it gives the same rig, from either preset."""
    rig = RIGS[name]()
    values = {key: reference_page.preset_value(rig, key) for key in RigTable.model_fields}
    table = {key: value for key, value in values.items() if value is not None}
    table |= {key: int(table[key]) for key in ("width_px", "height_px")}
    assert RigTable.model_fields.keys() - table == {"preset", "holder", "mirror", "metal", "reflectance"}
    for other in RIGS:
        assert build_rig(RigTable.model_validate({"preset": other, **table})) == rig
