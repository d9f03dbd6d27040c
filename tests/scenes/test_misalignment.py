"""Misalignment: what each parameter moves, by SciPy's rotations; ranges; recipes; what a data set says of it."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.drawn_values import drawing
from helpers.oracles import camera_at, random_rig
from helpers.recipes import changed, complaints
from helpers.revolved_rigs import revolved
from scipy.spatial.transform import Rotation

from phibench.datasets.common.errors import RecipeError
from phibench.datasets.plan.plan import make_plan, shard_plan
from phibench.datasets.read import open_finished
from phibench.datasets.recipe import tables
from phibench.datasets.recipe.load import check_recipe
from phibench.datasets.store.json_forms import from_json, to_json
from phibench.datasets.store.layers import read_ambient, read_truth
from phibench.datasets.verify import verify
from phibench.estimator.geometry.triangulate import depth_exact
from phibench.render.sensor.light import spot_velocity_px_per_s
from phibench.scenes.form_error import HARMONICS, Form
from phibench.scenes.frames import Pose
from phibench.scenes.laser import LaserSpot
from phibench.scenes.mirror import OF_REVOLVED
from phibench.scenes.misalignment import PARAMETERS, Misalignment, Motion
from phibench.scenes.rig import Rig
from phibench.scenes.room import c310_rig, carriage, default_rig
from phibench.scenes.validation import SceneError
from phibench.studies.paper.paper_tables import score_estimators

EPS = 1e-14  # metres or cosines: a few roundings of numbers of order 1


def draw(rng: np.random.Generator, size: float = 1.0) -> Misalignment:
    """All parameters but the form, uniform within their study magnitudes times `size`; roughness not below 0."""
    names = [name for name in PARAMETERS if name not in HARMONICS]
    values = {name: rng.uniform(-1.0, 1.0) * size * PARAMETERS[name].study for name in names}
    return Misalignment(**{**values, "roughness_alpha": abs(values["roughness_alpha"])})


def test_all_are_zero_by_default_and_zero_changes_nothing() -> None:
    assert set(dataclasses.asdict(Misalignment()).values()) == {0.0}
    tilted = Rig(stroke_axis_world=(0.03, -0.01, 1.0), motion=Motion((1e-3, 0.0, 0.0)))
    for rig in (default_rig(), tilted):
        assert rig.perturbed(Misalignment()) == rig
    assert Misalignment().stroke_m(0.1 + 0.2) == 0.1 + 0.2
    assert len(PARAMETERS) == 41


@pytest.mark.parametrize("name", PARAMETERS)
def test_every_parameter_has_a_range(name: str) -> None:
    limit = PARAMETERS[name].limit
    for value in (math.nan, math.inf, 1.001 * limit, -1.001 * limit):
        with pytest.raises(SceneError, match=f"Misalignment.{name} = "):
            Misalignment(**{name: value})
    assert getattr(Misalignment(**{name: -limit}), name) == -limit
    assert 0.0 < PARAMETERS[name].study < limit


@pytest.mark.slow
@pytest.mark.parametrize("name", PARAMETERS)
def test_each_parameter_changes_the_rig_or_the_stroke(name: str) -> None:
    """One at a time: something changes, and what is changed is not shared with another parameter by mistake."""
    value = min(0.5 * PARAMETERS[name].study, 4e-4)  # which every parameter may be
    one = Misalignment(**{name: value})
    if name in OF_REVOLVED:
        rig = revolved("paraboloid")
        names = [other for other in PARAMETERS if other not in (name, *HARMONICS)]
        assert rig.perturbed(one) not in [rig, *(rig.perturbed(Misalignment(**{other: value})) for other in names)]
        return
    rigs = {other: default_rig().perturbed(Misalignment(**{other: value})) for other in PARAMETERS if other != name}
    if name.startswith("stroke_") and "tilt" not in name:
        assert default_rig().perturbed(one) == default_rig()
        assert one.stroke_m(0.5) != 0.5
    else:
        assert default_rig().perturbed(one) not in [default_rig(), *rigs.values()]
        assert one.stroke_m(0.5) == 0.5


def test_the_table_has_what_a_calibration_needs() -> None:
    """A parameter has a step and a prior, or neither; both are far inside the limit; `apply` changes it alone."""
    fitted = [one for one in PARAMETERS.values() if math.isfinite(one.prior_sigma)]
    assert len(fitted) == 16
    for name, one in PARAMETERS.items():
        assert one.name == name
        assert math.isfinite(one.step) == math.isfinite(one.prior_sigma)
    for one in fitted:
        assert 0.0 < 2.0 * one.step < one.limit  # five-point differences take two steps
        assert 0.0 < 4.0 * one.prior_sigma < one.limit
        assert one.apply(default_rig(), one.step) == default_rig().perturbed(Misalignment(**{one.name: one.step}))
    camera = PARAMETERS["focal_relative"].apply(default_rig(), 0.01).camera
    assert camera.fx_px == pytest.approx(1.01 * default_rig().camera.fx_px)


def test_poses_against_scipy() -> None:
    """All at once, on rigs that are tilted already: lens, axes and sphere centre at both ends of the stroke."""
    rng, checked = np.random.default_rng(1), 0
    for _ in range(100):
        nominal, m = random_rig(rng), draw(rng)
        true = nominal.perturbed(m)
        lens, axes = nominal.T_world_camera.t, nominal.T_world_camera.R
        sphere = lens + axes @ nominal.T_camera_sphere.t + [m.decentre_x_m, m.decentre_y_m, m.axial_m]
        axes = Rotation.from_euler("xy", [m.tilt_x_rad, m.tilt_y_rad]).as_matrix() @ axes
        stroke = Rotation.from_euler("xy", [m.stroke_tilt_x_rad, m.stroke_tilt_y_rad]).apply(nominal.stroke_axis_world)
        turn = Rotation.from_euler("xyz", [m.roll_rad, m.pitch_rad, m.yaw_rad]).as_matrix()
        h = m.stroke_m(0.7)
        up_lens = lens + h * stroke + [m.shift_x_m, m.shift_y_m, m.shift_z_m]
        assert h == pytest.approx((1.0 + m.stroke_relative) * 0.7 + m.stroke_offset_m, abs=EPS)
        for view, (eye, R, ball) in (
            (true.at(0.0), (lens, axes, sphere)),
            (true.at(h), (up_lens, turn @ axes, up_lens + turn @ (sphere - lens))),
        ):
            assert np.abs(view.camera_centre_m - eye).max() < EPS
            assert np.abs(view.T_world_camera.R - R).max() < EPS
            assert np.abs(view.sphere_centre_m - ball).max() < EPS
            assert np.abs(camera_at(true, view.offset_m)[0] - eye).max() < EPS
        checked += 1
    assert checked == 100


def test_camera_and_mirror_get_what_is_added() -> None:
    m, nominal = draw(np.random.default_rng(2)), c310_rig()
    true = nominal.perturbed(m)
    for name in ("cx_px", "cy_px", "k1", "k2", "k3", "p1", "p2", "focus_distance_m"):
        assert getattr(true.camera, name) == getattr(nominal.camera, name) + getattr(m, name)
    assert true.camera.fx_px == nominal.camera.fx_px * (1.0 + m.focal_relative)
    assert true.camera.fy_px == nominal.camera.fy_px * (1.0 + m.focal_relative)
    assert true.mirror.radius_m == 0.06 + m.radius_m
    assert true.mirror.roughness_alpha == m.roughness_alpha


def test_the_motion_holds_everywhere_but_down_and_follows_through_a_file() -> None:
    rig = default_rig().perturbed(Misalignment(pitch_rad=0.01, shift_y_m=2e-3))
    down, still = rig.at(0.0), default_rig().at(0.0)
    assert np.array_equal(down.sphere_centre_m, still.sphere_centre_m)
    for offset in (1e-6, 0.5, -0.1):
        assert rig.at(offset).camera_centre_m == pytest.approx([0.0, 2e-3, 0.45 + offset], abs=EPS)
    assert from_json(Rig, json.loads(json.dumps(to_json(rig)))) == rig
    assert hash(rig) != hash(default_rig())


def test_motions_of_a_rig_add_up() -> None:
    first, second = Misalignment(roll_rad=0.01, shift_x_m=1e-3), Misalignment(yaw_rad=-0.02, shift_x_m=2e-3)
    view = default_rig().perturbed(first).perturbed(second).at(0.3)
    turn = Rotation.from_euler("z", -0.02) * Rotation.from_euler("x", 0.01)
    assert np.abs(view.T_world_camera.R - turn.as_matrix()).max() < EPS
    assert view.camera_centre_m == pytest.approx([3e-3, 0.0, 0.75], abs=EPS)


def test_a_motion_is_a_rotation_and_finite() -> None:
    with pytest.raises(SceneError, match="not a rotation"):
        Motion(rotation=((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, -1.0)))
    with pytest.raises(SceneError, match="not a rotation"):  # lengths and angles to 1e-9
        Motion(rotation=((1.0 + 1e-8, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))
    with pytest.raises(SceneError, match="not a rotation"):
        Motion(rotation=((1.0, 1e-8, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))
    with pytest.raises(SceneError, match="finite"):
        Motion((math.nan, 0.0, 0.0))


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"radius_m": 0.1}, "in front of"),
        ({"axial_m": -0.1, "radius_m": 0.1}, "in front of"),
        ({"radius_m": -0.07}, "radius_m = -0.0"),
        ({"roughness_alpha": -1e-3}, "roughness_alpha"),
        ({"k1": -900.0}, "folds"),
        ({"focus_distance_m": -0.3}, "focus_distance_m"),
    ],
)
def test_an_impossible_true_rig_is_refused(values: dict[str, float], words: str) -> None:
    nominal = dataclasses.replace(default_rig(), T_camera_sphere=Pose("camera", "sphere", (0.0, 0.0, 0.15)))
    with pytest.raises(SceneError, match=words):
        nominal.perturbed(Misalignment(**values))


def test_a_stroke_that_vanishes_is_refused() -> None:
    with pytest.raises(SceneError, match=r"= -0\.2 make the stroke"):
        Misalignment(stroke_offset_m=-0.2).stroke_m(0.1)


def test_housing_and_mast_follow_the_motion() -> None:
    rig = default_rig().perturbed(Misalignment(shift_x_m=0.05, yaw_rad=0.3))
    housing, mast = carriage(rig.at(0.4))
    assert housing.T_world_shape.translation_m[0] == pytest.approx(0.05, abs=1e-3)
    assert housing.T_world_shape.R == pytest.approx(Rotation.from_euler("z", 0.3).as_matrix(), abs=EPS)
    assert mast.T_world_shape.translation_m[0] == pytest.approx(0.05, abs=1e-3)


def test_the_motion_is_no_part_of_the_carriages_speed() -> None:
    """At the down position the spot moves as without the motion, which comes later."""
    spot = LaserSpot((2.0, 0.5, 0.5), (-1, 0, 0), 5e-3)
    moved = default_rig().perturbed(Misalignment(pitch_rad=0.1, shift_z_m=0.05))
    for rig in (default_rig(), moved):
        assert spot_velocity_px_per_s(rig.at(0.0), spot, 0.2) == spot_velocity_px_per_s(
            default_rig().at(0.0), spot, 0.2
        )
    assert spot_velocity_px_per_s(moved.at(0.4), spot, 0.2) != spot_velocity_px_per_s(default_rig().at(0.4), spot, 0.2)


# -- recipes -------------------------------------------------------------------------------------------------------


def test_a_recipe_knows_the_parameters_of_scenes() -> None:
    for table in (tables.MisalignmentTable, tables.RandomMisalignmentTable):
        assert list(table.model_fields) == list(PARAMETERS)


def test_a_fixed_misalignment_makes_a_true_rig_beside_the_nominal_one() -> None:
    plan = make_plan(check_recipe({**changed(), "misalignment": {"tilt_x_rad": 0.01, "stroke_relative": 0.01}}))
    plain = make_plan(check_recipe(changed()))
    assert plan.rigs["rig"] == plain.rigs["rig"] == plan.rig
    assert plan.rigs["true"] == plan.rig.perturbed(Misalignment(tilt_x_rad=0.01))
    for pair, ideal in zip(plan.pairs, plain.pairs, strict=True):
        assert (pair.sample_id, pair.nominal_stroke_m) == (ideal.sample_id, ideal.stroke_m)
        assert (pair.rig, pair.nominal_rig, ideal.rig, ideal.nominal_rig) == ("true", "rig", "rig", "rig")
        assert pair.stroke_m == round(1.01 * ideal.stroke_m, 9)
        assert ideal.stroke_m == ideal.nominal_stroke_m
        assert pair.pose_id("up").startswith("true-h")


def test_a_stroke_error_alone_keeps_the_rig() -> None:
    plan = make_plan(check_recipe({**changed(), "misalignment": {"stroke_offset_m": 0.002}}))
    assert set(plan.rigs) == {"rig"}
    assert all(pair.stroke_m == round(pair.nominal_stroke_m + 0.002, 9) for pair in plan.pairs)


@pytest.mark.parametrize(
    ("values", "path", "words"),
    [
        ({"tilt_xx_rad": 0.1}, "misalignment.tilt_xx_rad", ("unknown", "'tilt_x_rad'")),
        ({"tilt_x_rad": 0.6}, "misalignment.tilt_x_rad", ("0.6", "from -0.5 up to 0.5")),
        ({"tilt_x_rad": "x"}, "misalignment.tilt_x_rad", ("'x'", "a number")),
        ({"radius_m": -0.07}, "misalignment", ("radius_m", "above 0")),
        ({"axial_m": -0.1, "radius_m": 0.1}, "misalignment", ("in front of",)),
        ({"stroke_offset_m": -1.0}, "misalignment", ("it must stay above 0",)),
        ({"roughness_alpha": -0.01}, "misalignment", ("roughness_alpha", "0.0 to 0.05")),
        ({"form_20_m": 0.002}, "misalignment.form_20_m", ("0.002", "from -0.001 up to 0.001")),
        ({"radius_m": -0.056, "form_33c_m": 1e-3}, "misalignment", ("too far from round", "make it smaller")),
    ],
)
def test_faults_of_a_recipe(values: dict[str, Any], path: str, words: tuple[str, ...]) -> None:
    [line] = complaints({**changed(), "misalignment": values})
    assert line.startswith(f"{path}: ")
    assert [word for word in words if word not in line] == []


@pytest.mark.parametrize(
    ("values", "path", "words"),
    [
        ({"tilt_xx_rad": 0.1}, "random.misalignment.tilt_xx_rad", ("unknown", "'tilt_x_rad'")),
        ({"pitch_rad": {"uniform": [0.0, 0.6]}}, "random.misalignment.pitch_rad", ("0.6", "from -0.5 up to 0.5")),
        ({"pitch_rad": {"uniform": [0.2, 0.1]}}, "random.misalignment.pitch_rad.uniform", ("below the high",)),
    ],
)
def test_faults_of_distributions(values: dict[str, Any], path: str, words: tuple[str, ...]) -> None:
    [line] = complaints(drawing(misalignment=values))
    assert line.startswith(f"{path}: ")
    assert [word for word in words if word not in line] == []


def test_drawn_misalignments_are_rigs_beside_drawn_nominal_ones() -> None:
    spread = {"normal": [0.0, 1e-3], "clip": [-3e-3, 3e-3]}
    drawn = drawing(
        rig={"fx_px": {"uniform": [1400, 1550]}}, misalignment={"pitch_rad": spread, "stroke_offset_m": spread}
    )
    plan = make_plan(check_recipe({**drawn, "misalignment": {"yaw_rad": 0.01}}))
    plain = make_plan(check_recipe(drawing(rig={"fx_px": {"uniform": [1400, 1550]}})))
    assert len(plan.pairs) == 50
    for pair, ideal in zip(plan.pairs, plain.pairs, strict=True):
        values = dict(pair.drawn)
        m = Misalignment(yaw_rad=0.01, **{k: values[f"misalignment.{k}"] for k in ("pitch_rad", "stroke_offset_m")})
        assert plan.rigs[pair.nominal_rig] == plain.rigs[ideal.rig]  # the other draws have not moved
        assert plan.rigs[pair.rig] == plan.rigs[pair.nominal_rig].perturbed(m)
        assert pair.nominal_stroke_m == ideal.stroke_m == values["stroke_m"]
        assert pair.stroke_m == round(m.stroke_m(pair.nominal_stroke_m), 9)
        assert (pair.rig[0], pair.nominal_rig[0], pair.rig[1:]) == ("r", "n", pair.nominal_rig[1:])
    assert len({dict(pair.drawn)["misalignment.pitch_rad"] for pair in plan.pairs}) == 50
    fewer = make_plan(
        check_recipe({**drawn, "random": {**drawn["random"], "samples": 20}, "misalignment": {"yaw_rad": 0.01}})
    )
    assert list(fewer.rigs.items()) == list(plan.rigs.items())[: len(fewer.rigs)]
    assert fewer.pairs == plan.pairs[:20]
    part = shard_plan(plan, "2/5")
    assert set(part.rigs) == {name for pair in part.pairs for name in (pair.rig, pair.nominal_rig)}


def test_a_drawn_rig_that_cannot_be_is_drawn_again() -> None:
    plan = make_plan(check_recipe(drawing(misalignment={"roughness_alpha": {"uniform": [-0.01, 0.01]}})))
    assert all(plan.rigs[pair.rig].mirror.roughness_alpha >= 0.0 for pair in plan.pairs)
    assert max(pair.tries for pair in plan.pairs) > 1


@pytest.mark.parametrize(
    ("values", "words"),
    [({"shift_x_m": 0.25}, "cuts the mirror at stroke 0.4"), ({"pitch_rad": 0.5}, ""), ({"decentre_x_m": -0.05}, "")],
)
def test_a_board_in_the_way_of_the_true_rig_is_refused(values: dict[str, float], words: str) -> None:
    """A board 0.3 m ahead at the height of the raised mirror is reached by a shift, not by a pitch of 0.13 m there."""
    raw = changed(targets=[{"name": "a", "depth_m": 0.3, "azimuth_deg": 0.0, "height_m": 1.11}])
    recipe = {**raw, "misalignment": values}
    if words:
        [line] = complaints(recipe)
        assert line.startswith("targets[0].depth_m: ")
        assert words in line
    else:
        check_recipe(recipe)


def test_drawn_motions_keep_clear_of_boards_and_the_ceiling() -> None:
    targets = [{"name": "a", "depth_m": 0.5, "azimuth_deg": 0.0, "height_m": 1.4}]
    raw = {
        **drawing(misalignment={"shift_x_m": {"uniform": [-0.9, 0.9]}}, stroke_m={"choice": [0.6]}),
        "targets": targets,
    }
    plan = make_plan(check_recipe(raw))
    shifts = np.array([dict(pair.drawn)["misalignment.shift_x_m"] for pair in plan.pairs])
    assert max(pair.tries for pair in plan.pairs) > 1
    assert not np.any((shifts > 0.44) & (shifts < 0.58))  # the mirror, 0.06 m, through the board, 0.02 m
    assert np.any(shifts > 0.58)
    with pytest.raises(RecipeError, match=r"is above the ceiling or what hangs from it, at 3\.00 m"):
        make_plan(check_recipe(drawing(misalignment={"shift_z_m": 1.0}, stroke_m={"uniform": [1.35, 1.4]})))


# -- data sets -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_data_set_says_what_is_true_and_what_is_nominal(misaligned_dataset: Path) -> None:
    report = verify(misaligned_dataset)
    assert report.ok, report.faults
    dataset = open_finished(misaligned_dataset)
    nominal, true = dataset.rigs["rig"], dataset.rigs["true"]
    wrong = Misalignment(0.0, 2e-3, tilt_x_rad=0.01, yaw_rad=0.02, form_31c_m=5e-5)
    assert dataset.rig == true == nominal.perturbed(wrong)
    assert (nominal.mirror.form, true.mirror.form) == (None, Form(form_31c_m=5e-5))
    assert len(dataset.samples) >= 2
    for sample in dataset:
        assert (sample.rig, sample.nominal_rig) == (true, nominal)
        assert sample.row.stroke_m == round(1.01 * sample.row.nominal_stroke_m, 9)
        assert sample.view("up").motion is not None
        offset = np.array(sample.row.spot_world_m)[:2] - [0.0, 2e-3]
        assert sample.row.depth_m == pytest.approx(np.hypot(*offset), abs=1e-12)
        assert sample.row.up.sphere_centre_world_m == pytest.approx(sample.view("up").sphere_centre_m, abs=1e-12)


def test_scores_are_those_of_who_believes_the_nominal_rig(misaligned_dataset: Path) -> None:
    dataset = open_finished(misaligned_dataset)
    exact = {
        s.sample_id: s
        for s in score_estimators(dataset)
        if (s.estimator, s.source, s.status) == ("exact", "truth", "ok")
    }
    assert exact
    for name, result in exact.items():
        sample = dataset[name]
        pixels = [np.array([spot.u_px, spot.v_px]) for spot in (sample.row.down, sample.row.up)]
        nominal = depth_exact(sample.nominal_rig, sample.row.nominal_stroke_m, *pixels)
        assert result.estimate_m == float(nominal.depth_m)
        assert abs(result.relative_error) > 1e-3  # 0.6 degrees of tilt are seen


def test_a_moved_view_is_the_view_of_a_rig_that_was_built_there(misaligned_dataset: Path) -> None:
    """Ambient and truth layers of the up position, to the bit: the motion enters by the pose and by nothing else.

    The truth's D alone counts from the sphere at the down position, where the two rigs differ.
    """
    from phibench.datasets.build.bake_task import bake_settings, read_light_map
    from phibench.render.optics.truth import truth_layer
    from phibench.render.room.ambient_layer import render_ambient
    from phibench.render.room.noise_budget import BUDGETS
    from phibench.render.setup.variant import activate

    activate()
    dataset = open_finished(misaligned_dataset)
    sample, settings = dataset.samples[0], dataset.recipe.ambient
    view = sample.view("up")
    built = dataclasses.replace(sample.rig, T_world_camera=view.T_world_camera, motion=None).at(0.0)
    [pose] = [pose for pose in dataset.info.poses if pose.pose == sample.row.up.pose]
    light, budget = read_light_map(misaligned_dataset, "room"), BUDGETS[settings.quality]
    layer = render_ambient(
        built, dataset.room, light, bake_settings(settings), settings.cells_per_pixel, pose.ambient_seed, budget=budget
    )
    stored = read_ambient(misaligned_dataset / sample.row.up.view_ambient_file)
    assert stored.max() > 0.0
    np.testing.assert_allclose(stored, layer.electrons_per_s, rtol=2.0**-11)  # halves
    planes, truth = (
        read_truth(misaligned_dataset / sample.row.up.view_truth_file, view),
        truth_layer(built, dataset.room.shapes(built)),
    )
    for name, plane in planes.items():
        if name != "depth_m":
            assert np.array_equal(truth[name].astype(np.float32), plane.astype(np.float32), equal_nan=True), name
    still = dataclasses.replace(sample.rig, motion=None).at(view.offset_m)
    other = render_ambient(
        still, dataset.room, light, bake_settings(settings), settings.cells_per_pixel, pose.ambient_seed, budget=budget
    )
    assert not np.array_equal(other.electrons_per_s, stored)


# -- the page ------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_page_has_the_tables_of_the_code() -> None:
    """docs/misalignment.md against `python docs/draw_misalignment.py`."""
    folder = Path(__file__).resolve().parents[2] / "docs"
    spec = importlib.util.spec_from_file_location("draw_misalignment", folder / "draw_misalignment.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    page = (folder / "misalignment.md").read_text(encoding="utf-8")
    for text in (module.parameter_table(), module.budget_table(), module.estimator_table()):
        assert text.count("\n") > 10
        assert text in page
