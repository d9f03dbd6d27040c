"""Keys of a holder: each without effect is one sentence, by the recipe's own names."""

from pathlib import Path
from typing import Any

import pytest
from helpers.room_files import recipe

from phibench.calibration.captures.rig_file import read_rig_file
from phibench.datasets.common.errors import DatasetError, RecipeError
from phibench.datasets.recipe.load import check_recipe, load_recipe
from phibench.datasets.recipe.mirror_tables import HolderTable
from phibench.datasets.recipe.recipe_scene import HOLDER_KINDS


def with_holder(fixed: dict[str, Any], drawn: dict[str, Any] | None = None) -> dict[str, Any]:
    raw = recipe(panoramas=[], meshes=[], count=1)
    raw["rig"] = {**raw.get("rig", {}), "holder": fixed}
    raw["random"] = {**raw["random"], "rig": {"holder": drawn or {}}}
    return raw


def test_every_size_of_a_holder_has_its_kinds() -> None:
    assert set(HOLDER_KINDS) == set(HolderTable.model_fields) - {"kind"}


@pytest.mark.parametrize(
    ("fixed", "drawn", "begin"),
    [
        ({"radius_m": 0.004}, {}, 'rig.holder.radius_m: has no effect on a holder of kind "none"; remove it, or give'),
        ({"kind": "rods", "glass_index": 1.5}, {}, 'rig.holder.glass_index: has no effect on a holder of kind "rods"'),
        ({"kind": "post", "wall_m": 0.003}, {}, 'rig.holder.wall_m: has no effect on a holder of kind "post"; remove'),
        ({"kind": "tube", "azimuth_deg": 5.0}, {}, "rig.holder.azimuth_deg: has no effect on a holder of kind"),
        ({"wall_m": 0.003}, {"kind": {"choice": ["none", "post"]}}, "rig.holder.wall_m: has no effect on a holder"),
        ({}, {"circle_m": 0.09}, 'random.rig.holder.circle_m: has no effect on a holder of kind "none"'),
        ({"kind": "tube"}, {"kind": "rods", "glass_index": 1.5}, "random.rig.holder.glass_index: has no effect"),
        ({"kind": "rods", "circle_m": 0.03}, {}, "rig.holder.circle_m: 0.03: the rods would stand inside the mirror"),
        ({"kind": "tube", "plate_m": 0.03}, {}, "rig.holder.plate_m: 0.03: the tube's wall would stand outside"),
        ({"kind": "glass", "wall_m": 0.003}, {}, "rig.holder.kind: 'glass' is not allowed; give one of 'none'"),
        ({}, {"kind": 3}, "random.rig.holder.kind: 3 is not allowed; give a name or { choice = [names] }: 'none'"),
    ],
)
def test_a_key_without_effect_is_one_sentence(fixed: dict[str, Any], drawn: dict[str, Any], begin: str) -> None:
    with pytest.raises(RecipeError) as caught:
        check_recipe(with_holder(fixed, drawn))
    _, line = str(caught.value).splitlines()
    assert line.startswith(f"  {begin}")


@pytest.mark.parametrize(
    ("fixed", "drawn"),
    [
        ({"kind": "tube", "radius_m": 0.005}, {}),  # sets how far the plates reach
        ({"wall_m": 0.003, "azimuth_deg": 10.0}, {"kind": {"choice": ["rods", "tube"]}}),
        ({}, {"kind": {"choice": ["none", "rods", "tube"]}, "wall_m": {"uniform": [0.002, 0.003]}, "radius_m": 0.004}),
        ({"kind": "rods"}, {"circle_m": {"uniform": [0.08, 0.083]}}),
    ],
)
def test_sizes_of_any_kind_that_may_be_drawn_are_taken(fixed: dict[str, Any], drawn: dict[str, Any]) -> None:
    assert check_recipe(with_holder(fixed, drawn))


def test_a_rig_file_has_the_same_keys(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text('[rig.holder]\nkind = "rods"\nwall_m = 0.003\n')
    with pytest.raises(DatasetError, match=r'rig\.holder\.wall_m: has no effect on a holder of kind "rods"'):
        read_rig_file(path)


@pytest.mark.parametrize("data", [b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR", b"\x76\x2f\x31\x01\x02\0\0\0"], ids=["PNG", "EXR"])
def test_a_picture_is_no_recipe(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "room.toml"
    path.write_bytes(data)
    with pytest.raises(
        RecipeError, match=r"room\.toml is no TOML recipe: it is a picture or another binary file; give"
    ):
        load_recipe(path)
