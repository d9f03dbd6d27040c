"""Measured reflectance of a mirror: table, spot, views and recipe against sums by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from helpers.room_files import recipe

from phibench.datasets.common.errors import RecipeError
from phibench.datasets.recipe.load import check_recipe
from phibench.datasets.recipe.recipe_scene import build_rig
from phibench.datasets.recipe.tables import RigTable
from phibench.datasets.store.json_forms import from_json, to_json
from phibench.estimator.spots.spot_prediction import Laser, spot_electrons_per_s
from phibench.render.optics.certificate import certify
from phibench.render.optics.spot_layer import spot_layer
from phibench.render.optics.truth import spot_truth
from phibench.render.setup.variant import activate
from phibench.scenes.laser import LaserSpot
from phibench.scenes.metals import ReflectanceTable
from phibench.scenes.mirror import SphereMirror
from phibench.scenes.misalignment import Misalignment
from phibench.scenes.rig import Rig

BANDS_NM = (460.0, 540.0, 610.0)
ANGLES = ReflectanceTable((450.0, 700.0), (0.50, 0.40, 0.90, 0.60, 0.70, 0.80), (0.0, 40.0, 80.0))
SPOT = LaserSpot((2.0, 0.6, 0.5), (-1.0, -0.3, 0.0), 5e-3)


def by_hand(cos: float, nm: float) -> float:
    """Bilinear in wavelength and angle, by the weights of four corners."""
    rows = ((0.50, 0.40, 0.90), (0.60, 0.70, 0.80))
    t, angle = (nm - 450.0) / 250.0, min(float(np.degrees(np.arccos(cos))), 80.0)
    k = 0 if angle < 40.0 else 1
    x = (angle - 40.0 * k) / 40.0
    return sum(wt * wx * rows[i][k + j] for i, wt in ((0, 1.0 - t), (1, t)) for j, wx in ((0, 1.0 - x), (1, x)))


def test_a_table_of_angles_is_bilinear_and_its_last_angle_holds() -> None:
    mirror = SphereMirror(reflectance_table=ANGLES)
    for nm in (450.0, 533.0, 650.0, 700.0):
        cos = np.cos(np.linspace(0.0, 1.57, 60))
        assert mirror.reflectance(cos, nm) == pytest.approx([by_hand(c, nm) for c in cos], abs=1e-12)
    assert np.isnan(mirror.reflectance(np.array([np.nan]), 650.0)).all()


def test_without_angles_the_metal_says_how_it_depends_on_the_angle() -> None:
    """Below the metal's value it is a factor; above, the loss is scaled, so that all is reflected at grazing."""
    cos = np.cos(np.linspace(0.0, 0.5 * np.pi, 200))
    steel = SphereMirror().reflectance(cos, 650.0)
    for value in (0.0, 0.05, 0.5, steel[0], 0.9, 1.0):
        found = SphereMirror(reflectance_table=ReflectanceTable((650.0,), (value,))).reflectance(cos, 650.0)
        expected = (
            steel * value / steel[0] if value < steel[0] else 1.0 - (1.0 - steel) * (1.0 - value) / (1.0 - steel[0])
        )
        assert found == pytest.approx(expected, abs=1e-14)
        assert found[0] == pytest.approx(value, abs=1e-14)
        assert 0.0 <= found.min() <= found.max() <= 1.0


@pytest.mark.parametrize(
    "table", [None, ANGLES, ReflectanceTable((450.0, 700.0), (0.5, 0.9)), ReflectanceTable((650.0,), (0.4,), (0.0,))]
)
def test_the_views_kernel_has_the_same_reflectance(table: ReflectanceTable | None) -> None:
    """Single precision near cos = 1, where the angle is its root: 3e-4 rad of an angle, 1e-4 of a slope of 0.5."""
    mi = activate()
    from phibench.render.room.mirror_intersection import mirror_bands

    rig = Rig(mirror=SphereMirror(reflectance_table=table))
    cos = np.cos(np.linspace(0.01, 1.55, 300))
    for band, nm in zip(mirror_bands(mi, rig), rig.camera.detector.band_wavelength_nm, strict=True):
        found = np.array(band(mi.Float(cos.astype(np.float32))))
        assert found == pytest.approx(rig.mirror.reflectance(cos, nm), abs=1e-4)


def test_the_spots_flux_is_that_of_the_table(monkeypatch: pytest.MonkeyPatch) -> None:
    """A table of one angle is a factor; the certificate and the estimator's prediction follow a table of angles."""
    steel, half = Rig(), Rig(mirror=SphereMirror(reflectance_table=ReflectanceTable((650.0,), (0.5,), (0.0,))))
    truth = spot_truth(steel.at(0.0), SPOT, ())
    R = steel.mirror.reflectance(np.cos(np.array(truth.phi_incidence_rad)), 650.0)
    one, two = (spot_layer(rig.at(0.0), SPOT, ()).total_electrons_per_s[0] for rig in (steel, half))
    assert two / one == pytest.approx(0.5 / float(R), rel=1e-4)  # the bundle's angles differ by 0.01 rad
    rig = Rig(mirror=SphereMirror(reflectance_table=ANGLES))
    view = rig.at(0.0)
    layer = spot_layer(view, SPOT, ())
    assert certify(view, SPOT, (), spot_truth(view, SPOT, ()), layer).passed
    expected = by_hand(float(np.cos(truth.phi_incidence_rad)), 650.0) / float(R)
    assert layer.total_electrons_per_s[0] / one == pytest.approx(expected, rel=1e-3)
    monkeypatch.setattr("phibench.render.optics.certificate._LOG2_RAYS", (13,))
    assert not certify(steel.at(0.0), SPOT, (), truth, layer).passed


def test_the_prediction_follows_the_table() -> None:
    from phibench.estimator.geometry.reflection import image_of

    steel, other = Rig(), Rig(mirror=SphereMirror(reflectance_table=ANGLES))
    image = image_of(steel.at(0.0), np.array([SPOT.position_world_m]))
    wall = np.array([SPOT.normal_world])
    one, two = (float(spot_electrons_per_s(rig, Laser(), image, wall)[0]) for rig in (steel, other))
    cos = np.cos(spot_truth(steel.at(0.0), SPOT, ()).phi_incidence_rad)
    assert two / one == pytest.approx(
        by_hand(float(cos), 650.0) / float(steel.mirror.reflectance(cos, 650.0)), rel=1e-9
    )


def test_a_recipe_builds_it_keeps_it_and_stays_what_it_was_without() -> None:
    table = {"wavelength_nm": [450.0, 700.0], "value": list(ANGLES.value), "angle_deg": [0.0, 40.0, 80.0]}
    for shape in (None, {"shape": "cone"}):
        rig = build_rig(RigTable.model_validate({"reflectance": table, **({"mirror": shape} if shape else {})}))
        assert rig.mirror.reflectance_table == ANGLES
        assert from_json(Rig, to_json(rig)) == rig
        bent = rig.perturbed(Misalignment(radius_m=1e-4, roughness_alpha=1e-3))
        assert bent.mirror.reflectance_table == ANGLES
        assert bent.mirror.roughness_alpha == 1e-3
    assert "reflectance" not in RigTable().model_dump()
    assert "reflectance_table" not in to_json(Rig())["mirror"]


@pytest.mark.parametrize(
    ("table", "laser_nm", "begin"),
    [
        ({"wavelength_nm": [450.0], "value": [1.2]}, 650.0, "rig.reflectance.value[0]: 1.2"),
        ({"wavelength_nm": [450.0, 700.0], "value": [0.5]}, 650.0, "rig.reflectance.value: [0.5]: 1 numbers for 2"),
        (
            {"wavelength_nm": [700.0, 450.0], "value": [0.5, 0.5]},
            650.0,
            "rig.reflectance.wavelength_nm: [700.0, 450.0]: must",
        ),
        (
            {"wavelength_nm": [450.0, 620.0], "value": [0.5, 0.5]},
            650.0,
            "rig.reflectance.wavelength_nm: [450.0, 620.0]: does",
        ),
        (
            {"wavelength_nm": [600.0, 700.0], "value": [0.5, 0.5]},
            650.0,
            "rig.reflectance.wavelength_nm: [600.0, 700.0]: does",
        ),
        ({"value": [0.5]}, 650.0, "rig.reflectance.wavelength_nm: missing"),
    ],
)
def test_a_table_that_does_not_do_is_one_sentence(table: dict[str, Any], laser_nm: float, begin: str) -> None:
    raw = recipe(panoramas=[], meshes=[], count=1)
    raw["rig"] = {**raw.get("rig", {}), "reflectance": table}
    raw["laser"] = {**raw.get("laser", {}), "wavelength_nm": laser_nm}
    with pytest.raises(RecipeError) as caught:
        check_recipe(raw)
    _, line = str(caught.value).splitlines()
    assert line.startswith(f"  {begin}")
