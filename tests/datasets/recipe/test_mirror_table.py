"""`[rig.mirror]`: what it builds, which keys go together, and that spheres stay what they were."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from helpers.room_files import recipe

from phibench.datasets.common.errors import RecipeError
from phibench.datasets.recipe import mirror_tables
from phibench.datasets.recipe.load import check_recipe
from phibench.datasets.recipe.mirror_tables import OF_SHAPES, MirrorShape, MirrorTable
from phibench.datasets.recipe.recipe_scene import build_rig, fixed_conic_faults
from phibench.datasets.recipe.tables import RigTable
from phibench.datasets.store.json_forms import from_json, to_json
from phibench.scenes.revolved_mirror import RevolvedMirror
from phibench.scenes.rig import Rig
from phibench.scenes.validation import SceneError

SHAPES: dict[str, dict[str, Any]] = {
    "ellipsoid": {},
    "paraboloid": {"vertex_radius_m": 0.05},
    "hyperboloid": {},
    "cone": {"half_angle_deg": 50.0},
    "polynomial": {"even_terms": [20.0, 300.0]},
}


def table(**rig: Any) -> RigTable:
    return RigTable.model_validate(rig)


def profile_of(rig: Rig) -> Any:
    assert isinstance(rig.mirror, RevolvedMirror)
    return rig.mirror.profile


@pytest.mark.parametrize("shape", SHAPES)
def test_every_shape_is_built_fits_the_image_and_survives_its_file(shape: str) -> None:
    rig = build_rig(table(mirror={"shape": shape, **SHAPES[shape]}, tilt_x_rad=0.01, decentre_x_m=0.002))
    assert profile_of(rig).shape == shape
    assert build_rig(table(mirror={"shape": shape, **SHAPES[shape]})).fits_image()
    assert from_json(Rig, to_json(rig)) == rig
    # the camera is tilted, and the mirror's axis stays upright
    assert rig.at(0.0).T_world_sphere.R[:, 2] == pytest.approx([0.0, 0.0, 1.0], abs=1e-15)
    assert rig.at(0.0).sphere_centre_m - rig.at(0.0).camera_centre_m == pytest.approx([0.002, 0.0, 0.22], abs=1e-15)
    assert rig.camera.focus_distance_m > 0.22


@pytest.mark.parametrize("z_c_m", [0.2, 0.3])
def test_the_lens_is_in_the_focus_of_a_hyperboloid(z_c_m: float) -> None:
    """The foci of s - 2 R z + (1 + k) z^2 = 0 are at z = R / (1 + e) and R / (1 - e), e^2 = -k."""
    profile = profile_of(build_rig(table(z_c_m=z_c_m, mirror={"shape": "hyperboloid"})))
    assert profile.vertex_radius_m / (1.0 - np.sqrt(-profile.conic)) == pytest.approx(-z_c_m, rel=1e-12)


def test_every_key_has_its_shapes() -> None:
    assert set(OF_SHAPES) == {key for shape in mirror_tables.SHAPES.values() for key in shape.keys}
    assert set(OF_SHAPES) == set(MirrorTable.model_fields) - {"shape", "rim_radius_m", "tilt_x_rad", "tilt_y_rad"}


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ({"keys": "conic", "conic": 0.2}, "keys must be a tuple"),
        ({"keys": ("vertex_radius", "conic"), "conic": 0.2}, "there is no key 'vertex_radius'; did you mean"),
        ({"keys": ("vertex_radius_m", "conic")}, "without conic it is a cone; give its conic"),
        ({"keys": ("half_angle_deg",), "low": 0.0}, "without conic it is a cone; give its conic"),
        ({"keys": ("half_angle_deg", "conic"), "conic": 0.2}, "half_angle_deg is a cone's"),
        ({"keys": ("conic",), "conic": -0.2, "low": 0.0}, "conic = -0.2 must be above 0"),
        ({"keys": ("conic",), "conic": 2.5, "low": 0.0, "high": 2.0}, "conic = 2.5 must be above 0 and below 2"),
        ({"keys": ("conic",), "conic": 0.5, "low": 1.0, "high": 0.0}, "conic = 0.5 must be above 1 and below 0"),
        ({"keys": ("conic",), "conic": np.nan}, "conic = nan must be finite"),
        ({"keys": ("conic",), "conic": -2.0, "high": 0.0, "lens_in_focus": True}, "lens_in_focus is for conics below"),
    ],
)
def test_a_wrong_line_of_the_shapes_is_refused_and_named(line: dict[str, Any], reason: str) -> None:
    with pytest.raises(SceneError) as caught:
        MirrorShape(**line)
    said = str(caught.value)
    assert said.startswith(f"MirrorShape(keys={line['keys']!r}, conic={line.get('conic')}, low=")
    assert f"is no shape of [rig.mirror]: {reason}" in said


def test_a_range_with_two_ends_is_said_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(mirror_tables.SHAPES, "ellipsoid", MirrorShape(("conic",), 0.2, low=0.0, high=2.0))
    faults = fixed_conic_faults("m", MirrorTable(shape="ellipsoid", conic=3.0), ("ellipsoid",))
    assert 'm.conic: is 3; a conic of shape = "ellipsoid" is above 0 and below 2' in str(faults[0])


@pytest.mark.parametrize(
    ("rig", "begin"),
    [
        ({"mirror": {"shape": "cone", "conic": -2.0}}, 'rig.mirror.conic: has no effect on shape = "cone"'),
        ({"mirror": {"shape": "paraboloid", "half_angle_deg": 40.0}}, "rig.mirror.half_angle_deg: has no effect"),
        ({"mirror": {"shape": "polynomial"}}, "rig.mirror.even_terms: is missing"),
        ({"mirror": {"shape": "torus"}}, "rig.mirror.shape: 'torus' is not allowed; give one of 'ellipsoid'"),
        ({"mirror": {"rim_radius_m": 0.05}}, "rig.mirror.shape: missing"),
        ({"mirror": {"shape": "hyperboloid", "conic": -0.5}}, "rig.mirror.conic: -0.5: below -1 for shape"),
        ({"mirror": {"shape": "ellipsoid", "conic": -1.5}}, "rig.mirror.conic: -1.5: above -1 for shape"),
        ({"mirror": {"shape": "ellipsoid", "rim_radius_m": 0.09}}, "rig.mirror.rim_radius_m: 0.09: the surface folds"),
        (
            {"mirror": {"shape": "polynomial", "even_terms": [-500.0]}},
            "rig.mirror.even_terms: [-500.0]: the surface is",
        ),
        (
            {"mirror": {"shape": "polynomial", "even_terms": [1e12]}},
            "rig.mirror.rim_radius_m: 0.06: the mirror would be",
        ),
        ({"mirror": {"shape": "hyperboloid", "conic": -1.0001}}, "rig.mirror.rim_radius_m: 0.06: the mirror would be"),
        ({"mirror": {"shape": "cone", "half_angle_deg": 3.0}}, "rig.mirror.rim_radius_m: 0.06: the mirror would be"),
        ({"mirror": {"shape": "cone", "rim_radius_m": 5e-4}}, "rig.mirror.rim_radius_m: 0.0005: the tip of the cone"),
        ({"mirror": {"shape": "paraboloid", "vertex_radius_m": -0.06}}, "rig.mirror.vertex_radius_m: -0.06 is not"),
        ({"radius_m": 0.05, "mirror": {"shape": "cone"}}, "rig.radius_m: 0.05: is a sphere's"),
        (
            {"holder": {"kind": "rods", "circle_m": 0.05}, "mirror": {"shape": "cone"}},
            "rig.holder.circle_m: 0.05: the rods would stand inside the mirror",
        ),
        ({"metal": "brass"}, "rig.metal: 'brass' is not allowed; give one of 'steel'"),
    ],
)
def test_what_does_not_go_together_is_one_sentence(rig: dict[str, Any], begin: str) -> None:
    raw = recipe(panoramas=[], meshes=[], count=1)
    raw["rig"] = {**raw.get("rig", {}), **rig}
    with pytest.raises(RecipeError) as caught:
        check_recipe(raw)
    _, line = str(caught.value).splitlines()
    assert line.startswith(f"  {begin}")


@pytest.mark.parametrize(
    ("deviation", "begin"),
    [
        ({"axial_m": -0.1}, "misalignment: Rig.T_camera_sphere: the lens is inside the mirror"),
        ({"radius_m": -0.059}, "misalignment: rig.mirror.rim_radius_m = 0.06: the mirror would be 1.8 m deep"),
        ({"radius_m": -0.1}, "misalignment: rig.mirror.vertex_radius_m = -0.04"),
        ({"form_30_m": 5e-4}, "misalignment: the form error bends the paraboloid too far: at 0.06 m from its axis"),
    ],
)
def test_a_true_mirror_that_cannot_be_is_one_sentence(deviation: dict[str, float], begin: str) -> None:
    raw = recipe(panoramas=[], meshes=[], count=1)
    raw["rig"] = {**raw.get("rig", {}), "z_c_m": 0.08, "mirror": {"shape": "paraboloid"}}
    with pytest.raises(RecipeError) as caught:
        check_recipe(raw | {"misalignment": deviation})
    _, line = str(caught.value).splitlines()
    assert line.startswith(f"  {begin}")


def test_a_cone_may_not_be_all_tip() -> None:
    """An image 2 mm wide at the mirror shows the tip alone, whatever the rim; beside the axis it shows more."""
    rig = build_rig(table(mirror={"shape": "cone"}))
    narrow = replace(rig.camera, width_px=12, height_px=12, cx_px=5.5, cy_px=5.5)
    with pytest.raises(SceneError, match=r"the tip of the cone is all that is seen, up to 0.0013 m"):
        replace(rig, camera=narrow)
    assert replace(rig, camera=replace(narrow, cx_px=-100.0)).mirror == rig.mirror


def test_a_sphere_of_steel_says_nothing_of_shape_or_metal() -> None:
    """Hashes of recipes and of rigs stay what they were."""
    assert not {"mirror", "metal"} & table(radius_m=0.05).model_dump().keys()
    assert "metal" not in to_json(build_rig(table()))["mirror"]
    gold = build_rig(table(metal="gold"))
    assert to_json(gold)["mirror"]["metal"] == "gold"
    assert from_json(Rig, to_json(gold)) == gold
