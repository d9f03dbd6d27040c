"""Study `mirror`: fields and resolutions against other rays, bounds by another route, deviations, and a tiny run."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from rich.console import Console

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.recipe.recipe_scene import build_rig
from phibench.datasets.recipe.tables import RigTable
from phibench.estimator.geometry.line_of_sight import unhidden_places
from phibench.estimator.geometry.reflection import image_of
from phibench.estimator.geometry.sensitivities import PARAMETERS, sensitivity
from phibench.estimator.geometry.triangulate import depth_exact
from phibench.estimator.limits.processed_bound import SpotSigma
from phibench.estimator.spots.gaussian_spot import SpotBlur
from phibench.estimator.spots.spot_prediction import spot_blur
from phibench.render.optics.ray_tracer import trace_pixels
from phibench.render.optics.reflection_point import mirror_points
from phibench.render.optics.room_tracer import blocked_by, first_hit
from phibench.scenes.frames import Array
from phibench.scenes.laser import Beam
from phibench.scenes.misalignment import PARAMETERS as MISALIGNMENT
from phibench.scenes.misalignment import Misalignment
from phibench.scenes.rig import Rig
from phibench.scenes.room import escalade360
from phibench.studies.framework import StudyDatasets, StudyResult, read_settings
from phibench.studies.mirror.field import disc_shares, meridian, outline_radius_px
from phibench.studies.mirror.misalignment_costs import DIRECTIONS, UNCALIBRATED, errors, tolerance, usual_size
from phibench.studies.mirror.place_bounds import BlurBounds, place_bound
from phibench.studies.mirror.study import STUDY
from phibench.studies.mirror.tables import MirrorSettings, PlaceMap, pick_table
from phibench.studies.mirror.visible_places import floor_from_m, measured_places

SHAPES = ("sphere", "ellipsoid", "paraboloid", "hyperboloid", "cone")
STROKE_M = 0.425
TINY = """
rim_radius_m = 0.060
stroke_m = 0.425
presets = ["bayer-raw"]
exposure_s = 0.046
blurs_px = [0.65, 1.0]
heights_m = [0.5, 2.0]
depths_m = [1.0, 3.0]
curve_m = [0.5, 4.5, 2.0]
spot_height_m = 0.5
misaligned_m = [1.0, 3.0]
angles_deg = [60.0, 95.0]
viewpoints_deg = [45.0, 95.0]
azimuths_deg = [0.0, 180.0]
map_step_m = 0.4
map_height_m = 2.8
edge_px = 4.0
cost = 0.01
[mirrors.ball]
shape = "sphere"
[mirrors.dish]
shape = "hyperboloid"
"""


def _rig(shape: str, **keys: float) -> Rig:
    return build_rig(RigTable() if shape == "sphere" else RigTable.model_validate({"mirror": {"shape": shape, **keys}}))


def _theta(rig: Rig, radius_px: Array) -> Array:
    """theta of pixels along u by the simulator's tracer, radians."""
    middle = rig.camera.project(rig.sphere_in_camera_m)
    d = trace_pixels(rig.at(0.0), middle + radius_px[:, None] * np.array([1.0, 0.0])).directions
    return np.asarray(np.arctan2(d[:, 0], -d[:, 2]))


# -- field of view -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", SHAPES)
def test_resolution_is_that_of_two_traced_rays(shape: str) -> None:
    rig = _rig(shape)
    rays = meridian(rig)
    # central differences over 2e-3 px: the third derivative of theta is below 1e-4 per px^2 away from the limb, so that
    # they err by 1e-10 of the slope; rounding of theta, 1e-15 over 2e-3 px, is 1e-10 of a slope of 5e-3 rad / px
    inner = rays.radius_px[(rays.radius_px > 5.0) & (rays.radius_px < 0.9 * rays.radius_px[-1])][::50]
    slope = (_theta(rig, inner + 1e-3) - _theta(rig, inner - 1e-3)) / 2e-3
    found = np.array([rays.at(math.degrees(t), rays.px_per_rad) for t in _theta(rig, inner)])
    print(f"resolution against two traced rays, {shape}, largest: {np.abs(found * slope - 1.0).max():.1e}")
    np.testing.assert_allclose(found, 1.0 / slope, rtol=1e-7)


def test_field_of_a_sphere_ends_at_its_tangent() -> None:
    # the ray that touches goes on; 1e-3 px inside, cos i = 2.4e-3 turns it back by 2 cos i, 0.28 degrees
    tangent = 180.0 - math.degrees(math.asin(0.06 / 0.26))
    low, high = meridian(_rig("sphere")).field_deg()
    assert tangent - 0.3 < high < tangent
    assert 0.0 < low < 1.0
    assert outline_radius_px(_rig("sphere")) == pytest.approx(1430.0 * math.tan(math.asin(0.06 / 0.26)), abs=1e-6)


@pytest.mark.parametrize("half_angle_deg", [45.0, 51.0])
def test_cone_in_closed_form(half_angle_deg: float) -> None:
    # a flat side turns all rays alike: theta = 180 - 2 alpha + beta, tan(beta) = u / f, to the rounding of the camera
    rig = _rig("cone", half_angle_deg=half_angle_deg)
    rays, f = meridian(rig), rig.camera.fx_px
    beta = np.arctan(rays.radius_px / f)
    np.testing.assert_allclose(rays.theta_rad, math.pi - 2.0 * math.radians(half_angle_deg) + beta, atol=1e-12)
    np.testing.assert_allclose(rays.px_per_rad, (f**2 + rays.radius_px**2) / f, rtol=1e-9)
    rim_z = 0.22 + 0.06 / math.tan(math.radians(half_angle_deg))
    assert rays.radius_px[-1] == pytest.approx(f * 0.06 / rim_z - 1e-3, abs=1e-6)


def test_viewpoints_are_one_where_the_lens_is_in_the_focus() -> None:
    rays = meridian(_rig("hyperboloid"))
    assert rays.viewpoint_spread_m((0.0, 180.0), 0.0) < 1e-9
    # the inner focus of a hyperboloid of eccentricity e and lens distance l lies l (e - 1) / (e + 1) behind the vertex
    assert rays.viewpoint_m[500] == pytest.approx(0.22 * 0.25 / 2.25, abs=1e-9)
    assert meridian(_rig("sphere")).viewpoint_spread_m((45.0, 95.0), 4.0) > 5e-3
    assert math.isnan(meridian(_rig("cone")).viewpoint_spread_m((45.0, 60.0), 4.0))


def test_the_rim_of_a_hyperboloid_in_its_focus_shows_what_its_closed_form_says() -> None:
    """Its ray leaves the rim as if from the inner focus: 3.92 degrees above the horizon. 4 px inside it is 3.27."""
    rig = _rig("hyperboloid")
    rays, profile = meridian(rig), rig.mirror.profile
    focus_m = 0.22 * 0.25 / 2.25
    rim_deg = 90.0 + math.degrees(math.atan2(profile.depth_m - focus_m, profile.rim_radius_m))
    assert rim_deg == pytest.approx(93.9211, abs=1e-4)
    assert rays.field_deg(0.0)[1] == pytest.approx(rim_deg, abs=5e-4)
    assert rays.field_deg(4.0)[1] == pytest.approx(93.273, abs=2e-3)


def test_rays_pass_their_viewpoints() -> None:
    rig = _rig("paraboloid")
    rays = meridian(rig)
    some = slice(100, None, 200)
    middle = rig.camera.project(rig.sphere_in_camera_m)
    traced = trace_pixels(rig.at(0.0), middle + rays.radius_px[some, None] * np.array([1.0, 0.0]))
    to = rig.at(0.0).sphere_centre_m + rays.viewpoint_m[some, None] * np.array([0.0, 0.0, 1.0]) - traced.points_m
    assert np.abs(np.cross(to, traced.directions)).max() < 1e-12


def test_shares_of_the_disc_are_those_of_random_pixels() -> None:
    rig, offset = _rig("paraboloid"), 0.0
    rays, rng = meridian(rig), np.random.default_rng(7)
    found = disc_shares(rig, rays, offset, np.linspace(0.0, math.pi, 25))
    radius, turn = rays.radius_px[-1] * np.sqrt(rng.random(4000)), 2.0 * math.pi * rng.random(4000)
    uv = rig.camera.project(rig.sphere_in_camera_m) + radius[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    traced = trace_pixels(rig.at(offset), uv)
    robot = first_hit(escalade360(rig.at(offset)), traced.points_m, traced.directions).object_id >= 0
    above = ~robot & (traced.directions[:, 2] > 0.0)
    # standard deviations of shares of 0.1 and 0.3 of 4000 pixels are 0.5 and 0.7 %; four of them, and 0.3 % of the grid
    assert found.robot == pytest.approx(robot.mean(), abs=0.023)
    assert found.above_horizon == pytest.approx(above.mean(), abs=0.032)
    assert found.robot + found.below_horizon + found.above_horizon == pytest.approx(1.0)
    assert 20.0 < found.robot_theta_deg[0] < found.robot_theta_deg[1] < 60.0


# -- places ------------------------------------------------------------------------------------------------------------


def test_the_robot_hides_what_the_tracer_says() -> None:
    rig, rng = _rig("paraboloid"), np.random.default_rng(3)
    D, Z = rng.uniform(0.3, 0.7, 400), rng.uniform(0.0, 0.3, 400)  # low and near
    points = np.stack([D, np.zeros(400), Z], axis=-1)
    for offset, least in ((0.0, 50), (STROKE_M, 0)):
        view = rig.at(offset)
        mirror = mirror_points(view, points, np.broadcast_to(view.camera_centre_m, points.shape)).points_m
        free = blocked_by(escalade360(view), points, mirror) < 0
        assert np.array_equal(unhidden_places(rig, points, offset), free)
        assert least <= (~free).sum() < 350


def test_places_outside_of_the_field_are_not_measured() -> None:
    # the cone of 90 degrees sees from the horizon up: from 1.095 m, the tip's height when up
    rig, step = _rig("cone"), 0.05
    heights = np.arange(0.0, 2.5, step)
    points = np.stack([np.full_like(heights, 4.0), np.zeros_like(heights), heights], axis=-1)
    seen = heights[measured_places(rig, points, STROKE_M, 4.0, np.array([0.0]))]
    assert seen.min() == pytest.approx(0.45 + 0.22 + STROKE_M, abs=step)
    # down, its rim sees up to 102 degrees less four pixels
    top = 0.45 + 0.22 + 4.0 * math.tan(math.radians(meridian(rig).field_deg(4.0)[1] - 90.0))
    assert seen.max() == pytest.approx(top, abs=2.0 * step)  # the rim lies 60 mm higher and nearer than the tip


def test_nearest_spot_on_the_floor() -> None:
    rig = _rig("sphere")
    front, beside = (floor_from_m(rig, STROKE_M, 4.0, a, 3.0) for a in (0.0, 0.5 * math.pi))
    assert beside < front  # the robot is longer than it is wide
    # beside it: over the edge of the body, 0.155 m aside and 0.30 m high, from the mirror's side 0.67 m high and
    # 0.03 m off, the floor begins at 0.155 + 0.30 (0.155 + 0.03) / (0.67 - 0.30) or less; the track hides less
    assert 0.25 < beside < 0.40
    assert math.isnan(floor_from_m(_rig("cone"), STROKE_M, 4.0, 0.0, 3.0))


def test_map_of_places() -> None:
    seen = np.array([[False, True, True], [True, False, True], [False, False, True]])
    found = PlaceMap(np.array([1.0, 2.0, 3.0]), np.array([0.0, 0.5, 1.0]), seen)
    assert found.share == pytest.approx(5.0 / 9.0)
    assert found.heights_at(1.1) == (0.5, 0.5)
    assert found.heights_at(9.0) == (0.0, 1.0)


# -- bound -------------------------------------------------------------------------------------------------------------

_FLAT_PX = 0.1


def _flat_table() -> BlurBounds:
    """The same bound for all fluxes and blurs."""
    flat = SpotSigma((1.0, 1e9), (_FLAT_PX, _FLAT_PX))
    return BlurBounds((0.1, 10.0), (flat, flat), 1.0)


def _pixels(rig: Rig, point_m: Array) -> Array:
    """u and v, down and up, by the least path of the simulator, shape (4,)."""
    pixels = []
    for offset in (0.0, STROKE_M):
        view = rig.at(offset)
        at = mirror_points(view, point_m[None], view.camera_centre_m[None]).points_m
        pixels.append(rig.camera.project(view.T_world_camera.inverse().points(at))[0])
    return np.concatenate(pixels)


@pytest.mark.parametrize(("shape", "depth_m"), [("sphere", 1.0), ("paraboloid", 3.18), ("hyperboloid", 4.18)])
def test_bound_of_d_is_that_of_the_fisher_matrix(shape: str, depth_m: float) -> None:
    """Fisher matrix of a point in space from four coordinates, by differences of least paths."""
    rig, point, step = _rig(shape), np.array([depth_m, 0.0, 0.5]), 1e-4
    J = np.stack(
        [(_pixels(rig, point + d) - _pixels(rig, point - d)) / (2.0 * step) for d in step * np.eye(3)], axis=-1
    )
    sigmas = []
    for offset in (0.0, STROKE_M):  # the place of each spot's image by the rig where it is: a lowered point
        blur = spot_blur(rig, image_of(rig.at(0.0), point - [0.0, 0.0, offset]).uv_px, depth_m, Beam())
        radial, tangential = float(blur.sigma_px), float(blur.sigma_px * blur.ratio)
        sigmas += [_FLAT_PX * math.sqrt(radial / tangential), _FLAT_PX * math.sqrt(tangential / radial)]
    covariance = np.linalg.inv(J.T @ np.diag(np.array(sigmas) ** -2.0) @ J)
    found = place_bound(rig, _flat_table(), depth_m, 0.5, STROKE_M)
    # differences over 0.2 mm of functions that bend over 1 m err by 1e-8; rounding of 1e-13 px over 0.2 mm as little
    apart = found.relative * depth_m / math.sqrt(covariance[0, 0]) - 1.0
    print(f"bound of D against differences of least paths, {shape}: {apart:.1e}")
    assert abs(apart) < 1e-5
    assert found.theta_rad[0] > found.theta_rad[1]


def test_no_bound_where_nothing_is_seen() -> None:
    assert math.isnan(place_bound(_rig("paraboloid"), _flat_table(), 1.0, 2.9, STROKE_M).relative)
    assert math.isfinite(place_bound(_rig("sphere"), _flat_table(), 1.0, 2.0, STROKE_M).relative)


def _fisher_sigma(u_px: float, v_px: float, electrons: float, background: float) -> float:
    """Bound of u for a Gaussian spot of these sigmas on pixels of 1, centred, by sums of (d mu / du)^2 / mu."""
    x = np.arange(-15, 16)
    gauss = [np.exp(-0.5 * (x / s) ** 2) / (s * math.sqrt(2.0 * math.pi)) for s in (u_px, v_px)]
    mu = electrons * np.outer(gauss[0], gauss[1])
    return float(np.sum((mu * x[:, None] / u_px**2) ** 2 / (mu + background)) ** -0.5)


@pytest.mark.parametrize("background", [1e-6, 10.0, 1e4])
def test_elliptic_spots_from_round_ones(background: float) -> None:
    # exact where the spot's own light or the background is the noise; between, off by a few per cent
    u, v, electrons = 2.4, 0.9, 5000.0
    middle = math.sqrt(u * v)
    flat = SpotSigma((1.0, 1e9), (_fisher_sigma(middle, middle, electrons, background),) * 2)
    found, _ = BlurBounds((0.1, 10.0), (flat, flat), 1.0).at(electrons, SpotBlur(u, v / u))
    # 0.9 px on point-sampled pixels: sums differ from integrals by 1e-4
    assert found == pytest.approx(_fisher_sigma(u, v, electrons, background), rel=1e-3)


def test_no_bound_beyond_the_tabulated_blurs() -> None:
    table = BlurBounds((0.7, 1.4), (SpotSigma((1.0, 1e9), (0.1, 0.1)), SpotSigma((1.0, 1e9), (0.4, 0.4))), 1.0)
    assert table.round_at(100.0, 0.7 * math.sqrt(2.0)) == pytest.approx(0.2)  # half way in the logarithms
    assert math.isinf(table.round_at(100.0, 0.6))
    assert math.isinf(table.round_at(100.0, 1.5))


# -- misalignments -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", ["sphere", "hyperboloid"])
def test_small_errors_follow_the_analytic_derivatives(shape: str) -> None:
    rig, point = _rig(shape), np.array([2.5, 0.0, 0.5])
    slope = dict(zip(PARAMETERS, sensitivity("exact", rig, STROKE_M, rig, STROKE_M, point).error_gradient, strict=True))
    for kind, names in DIRECTIONS.items():
        if kind == "turn between images":  # a yaw, which has no first order
            continue
        size = 1e-3 * usual_size(kind)
        # second orders are 1e-3 of what they are at the usual size, where they are at most as large as the first
        wanted = size * max(abs(slope[name]) for name in names) / 2.5
        assert errors(rig, kind, size, point[None], STROKE_M)[0] == pytest.approx(wanted, rel=2e-3, abs=1e-11), kind


@pytest.mark.parametrize(("shape", "keys"), [("paraboloid", {}), ("cone", {"half_angle_deg": 51.0})])
def test_errors_of_the_usual_size_from_least_paths(shape: str, keys: dict[str, float]) -> None:
    """Pixels of the deviating rig by the simulator; beside a cone's tip they move by tens of pixels."""
    rig, point = _rig(shape, **keys), np.array([4.18, 0.0, 0.5])
    for kind, sizes in (("mirror aside", (1e-3, 2e-4)), ("camera tilted", (8.7e-3,))):
        for size in sizes:
            found = []
            for name in DIRECTIONS[kind]:
                for sign in (1.0, -1.0):
                    true = rig.perturbed(Misalignment(**{name: sign * size}))
                    pixels = _pixels(true, point)
                    axis = true.at(0.0).sphere_centre_m
                    D = math.hypot(point[0] - axis[0], point[1] - axis[1])
                    found.append(abs(float(depth_exact(rig, STROKE_M, pixels[:2], pixels[2:]).depth_m) / D - 1.0))
            mine = errors(rig, kind, size, point[None], STROKE_M)[0]
            print(f"error of D by {kind}, {shape}: {mine:.4f}, against least paths: {mine / max(found) - 1.0:.1e}")
            # pixels agree to 1e-10, of slopes of 1e-3 of D per pixel at least
            assert mine == pytest.approx(max(found), rel=1e-6)


def test_every_parameter_that_moves_a_ray_is_of_one_kind() -> None:
    named = [name for names in DIRECTIONS.values() for name in names]
    forms = {name for name in MISALIGNMENT if name.startswith("form_")}
    assert sorted(named) == sorted(set(MISALIGNMENT) - forms - {"focus_distance_m", "roughness_alpha", "rim_radius_m"})
    assert set(UNCALIBRATED) <= set(DIRECTIONS)
    for names in DIRECTIONS.values():  # of one kind: one unit and one usual size
        assert len({(MISALIGNMENT[name].unit, MISALIGNMENT[name].study) for name in names}) == 1


def test_tolerances_cost_what_they_may() -> None:
    points = np.array([(1.0, 0.0, 0.5), (3.18, 0.0, 0.5)])
    for shape, kind in (("sphere", "principal point"), ("hyperboloid", "mirror aside"), ("paraboloid", "focal length")):
        rig = _rig(shape)
        size = tolerance(rig, kind, points, STROKE_M, 0.01)
        # the search stops at 0.15 %, and errors grow in proportion or faster
        assert errors(rig, kind, size, points, STROKE_M).max() == pytest.approx(0.01, rel=0.01)
    wide, seen = _rig("cone", half_angle_deg=51.0), points[1:]
    assert math.isnan(tolerance(wide, "vertex radius", seen, STROKE_M, 0.01))  # a cone has none
    # near the tip a shift across turns the azimuth: the error grows as its square
    small, large = (errors(wide, "mirror aside", size, seen, STROKE_M)[0] for size in (5e-5, 1e-4))
    assert 3.0 < large / small < 5.0


# -- the study ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> tuple[MirrorSettings, StudyResult]:
    # some 10 s: tolerances of 17 kinds of deviations are searched for two mirrors
    folder = tmp_path_factory.mktemp("mirror")
    (folder / "mirror.toml").write_text(TINY, encoding="utf-8")
    settings = read_settings(STUDY, False, folder / "mirror.toml")
    return settings, STUDY.run(settings, StudyDatasets(folder, Console(quiet=True), 1))


@pytest.mark.slow
def test_tiny_study(tiny: tuple[MirrorSettings, StudyResult]) -> None:
    _, result = tiny
    table = result.tables["table"]
    far = {row["mirror"]: row for row in table.filter(depth_m=3.0, height_m=0.5).to_dicts()}
    assert far["dish"]["sigma_relative"] < 0.4 * far["ball"]["sigma_relative"]
    high = {row["mirror"]: row["sigma_relative"] for row in table.filter(depth_m=3.0, height_m=2.0).to_dicts()}
    assert math.isfinite(high["ball"])
    assert math.isnan(high["dish"])  # not seen: no value
    costs = result.tables["costs"]
    assert costs.filter(mirror="dish", deviation="mirror aside")["parameters"][0] == "decentre_x_m, decentre_y_m"
    assert costs["depth_m"].unique().sort().to_list() == [1.0, 3.0]
    shares = result.tables["map"].group_by("mirror").agg(pl.col("measured").mean())
    assert dict(shares.iter_rows())["ball"] > 2.0 * dict(shares.iter_rows())["dish"]
    assert [drawing.file_name for drawing in result.drawings] == ["mirror.png"]


@pytest.mark.slow
def test_the_table_for_the_choice_names_best_and_worst(tiny: tuple[MirrorSettings, StudyResult]) -> None:
    heads, *rows = tiny[1].shown["Pick a mirror"]
    assert heads == ("criterion", "unit", "ball", "dish", "best", "worst")
    ends = {row[0]: row[-2:] for row in rows}
    assert ends["bound of D at 3 m"] == ("dish", "ball")
    assert ends["seen above the horizon"] == ("ball", "dish")
    assert ends["mirror aside that costs 1 %"] == ("ball", "dish")
    values = {f.label: f.value for f in tiny[1].findings}
    row = next(row for row in rows if row[0] == "bound of D at 3 m")
    assert float(row[3]) == pytest.approx(values["bound of D at 3 m, best: dish"], rel=0.01)
    ratio = values["bound of D at 3 m, best: dish"] * values["bound of D at 3 m, ball over dish"]
    assert ratio == pytest.approx(values["bound of D at 3 m, worst: ball"])


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("depths_m = [1.0, 3.0]\ncurve", "depths_m = [3.0, 1.0]\ncurve", ("depths_m = [3.0, 1.0]", "must rise")),
        ("curve_m = [0.5, 4.5, 2.0]", "curve_m = [4.5, 0.5, 2.0]", ("curve_m", "first < last")),
        ('shape = "hyperboloid"', 'shape = "hyperboloid"\nconic = -0.5', ("mirrors.dish", "conic")),
        ('shape = "hyperboloid"', 'shape = "cone"\nconic = -3.0', ("mirrors.dish: conic has no effect", '"cone"')),
        ('shape = "hyperboloid"', 'shape = "polynomial"', ("mirrors.dish: even_terms is missing",)),
        ('shape = "sphere"', 'shape = "sphere"\nconic = 0.0', ("mirrors.ball: conic has no effect",)),
        ('shape = "hyperboloid"', 'shape = "polynomial"\neven_terms = [-500.0]', ("mirrors.dish", "not convex")),
        ("rim_radius_m = 0.060", "rim_radius_m = 0.09", ("mirrors.ball", "smaller rim_radius_m")),
        ('shape = "sphere"', 'shape = "torus"', ("mirrors.ball.shape", "paraboloid")),
    ],
)
def test_bad_settings(tmp_path: Path, old: str, new: str, words: tuple[str, ...]) -> None:
    file = tmp_path / "mirror.toml"
    assert old in TINY
    file.write_text(TINY.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(DatasetError) as caught:
        STUDY.run(read_settings(STUDY, False, file), StudyDatasets(tmp_path, Console(quiet=True), 1))
    assert all(word in str(caught.value) for word in words), str(caught.value)


def test_shipped_settings_are_sound() -> None:
    full, quick = (read_settings(STUDY, short) for short in (False, True))
    assert len(quick.azimuths_deg) < len(full.azimuths_deg)
    assert list(full.mirrors) == list(quick.mirrors)
    assert next(iter(full.mirrors)) == "sphere"
    assert set(full.misaligned_m) <= set(full.depths_m)


@pytest.mark.slow
def test_pick_table_without_any_value(tiny: tuple[MirrorSettings, StudyResult]) -> None:
    assert pick_table({}, tiny[0])[1][-2:] == ("-", "-")
