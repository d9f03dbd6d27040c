"""The mirror's form error: harmonics, surface, ranges, outline, and rays that meet it."""

from __future__ import annotations

import json
import math
from importlib.util import find_spec

import numpy as np
import pytest
from helpers.form_oracles import radius_at
from helpers.formed_mirrors import formed
from scipy.special import sph_harm_y

from phibench.datasets.store.json_forms import from_json, to_json
from phibench.estimator.geometry.reflection import reflect as estimated
from phibench.render.optics.ray_tracer import lens_rays, meet, reflect, trace_pixels
from phibench.render.optics.reflection_point import bundle_spread, fermat_points, mirror_points
from phibench.render.optics.spot_layer import spot_layer
from phibench.render.optics.truth import spot_truth, truth_layer
from phibench.scenes.form_error import HARMONICS, Form, curvatures, deviation, directions, gradients_by_parameter, level
from phibench.scenes.frames import Pose, rotation_xyz
from phibench.scenes.laser import LaserSpot
from phibench.scenes.mirror import SphereMirror
from phibench.scenes.misalignment import PARAMETERS, Misalignment
from phibench.scenes.rig import Rig, View
from phibench.scenes.room import default_rig
from phibench.scenes.validation import SceneError

R = 0.06
SPOT = LaserSpot((2.0, 0.7, 0.5), (-1.0, -0.3, 0.1), 5e-3)


def draw_form(rng: np.random.Generator, size_m: float) -> Form:
    return Form(*rng.uniform(-size_m, size_m, len(HARMONICS)))


def random_view(rng: np.random.Generator, size_m: float = 1e-3) -> View:
    tilts = dict(zip(("tilt_x_rad", "tilt_y_rad", "yaw_rad", "roll_rad"), rng.uniform(-0.03, 0.03, 4), strict=True))
    return formed(draw_form(rng, size_m), **tilts).at(0.4)


# -- the surface ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("name", HARMONICS)
def test_harmonics_are_scipys_scaled_to_a_peak_of_one(name: str) -> None:
    """A multiple of SciPy's harmonic (sign by the table of `scenes/form.py`); its peak is 1 within the lattice's pitch.

    The lattice's 20000 points are 0.025 rad apart: a peak of degree 3 is missed by at most 6 x 0.0125^2 = 1e-3.
    """
    n, degree, order = directions(20000), int(name[5]), int(name[6])
    ours = deviation(n, Form(**{name: 1.0})).value_m
    complex_value = sph_harm_y(degree, order, np.arccos(n[:, 2]), np.arctan2(n[:, 1], n[:, 0]))
    theirs = complex_value.imag if name[7] == "s" else complex_value.real
    scale = (-1.0) ** order * (ours @ ours) / abs(ours @ theirs)  # SciPy has the phase of Condon and Shortley
    assert ours == pytest.approx(scale * theirs, abs=1e-13)
    assert 0.999 < np.abs(ours).max() <= 1.0


@pytest.mark.parametrize("name", HARMONICS)
def test_signs_and_axes(name: str) -> None:
    """Places where the table says what the value is, axes of the sphere's own frame."""
    x, y, z, xz, yz, xy = ([1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [0, 1, 1], [1, 1, 0])
    expected = {
        "form_20_m": [(z, 1.0), (x, -0.5), (y, -0.5)],
        "form_21c_m": [(xz, 1.0), (z, 0.0)],
        "form_21s_m": [(yz, 1.0), (z, 0.0)],
        "form_22c_m": [(x, 1.0), (y, -1.0)],
        "form_22s_m": [(xy, 1.0), (x, 0.0)],
        "form_30_m": [(z, 1.0), ([0, 0, -1], -1.0)],
        "form_31c_m": [([2, 0, math.sqrt(11)], 1.0), (x, -3.0 * math.sqrt(15.0) / 16.0)],
        "form_31s_m": [([0, 2, math.sqrt(11)], 1.0), (y, -3.0 * math.sqrt(15.0) / 16.0)],
        "form_32c_m": [([math.sqrt(2), 0, 1], 1.0), ([0, math.sqrt(2), 1], -1.0)],
        "form_32s_m": [([1, 1, 1], 1.0), ([1, -1, 1], -1.0)],
        "form_33c_m": [(x, 1.0), ([-1, 0, 0], -1.0)],
        "form_33s_m": [(y, -1.0), ([0, -1, 0], 1.0)],
    }[name]
    for place, value in expected:
        found = deviation(np.array([place], float), Form(**{name: 1.0})).value_m[0]
        assert found == pytest.approx(value, abs=1e-14)


def test_gradient_and_hessian_against_differences() -> None:
    """Central differences, h = 1e-5 m at 0.06 m: third derivatives of 1e-3 / 0.06^3 leave 1e-8 of the Hessian's 17."""
    rng, h = np.random.default_rng(1), 1e-5
    form, P = draw_form(rng, 1e-3), 0.06 * directions(50) * rng.uniform(0.8, 1.2, (50, 1))
    at = level(P, R, form)
    for i in range(3):
        after, before = (level(P + sign * h * np.eye(3)[i], R, form) for sign in (1, -1))
        assert np.abs((after.value_m - before.value_m) / (2 * h) - at.gradient[:, i]).max() < 1e-7
        assert np.abs((after.gradient - before.gradient) / (2 * h) - at.hessian_per_m[:, i]).max() < 1e-4
    assert np.abs(at.hessian_per_m).max() > 10.0


def test_the_surface_is_where_the_radius_says() -> None:
    """The level function against the oracle's angles."""
    rng = np.random.default_rng(2)
    form, n = draw_form(rng, 1e-3), directions(100)
    P = np.array([float(radius_at(one, R, form)) * one for one in n])
    assert np.abs(level(P, R, form).value_m).max() < 1e-16
    assert np.abs(np.linalg.norm(P, axis=-1) - R).max() > 1e-3


def test_derivatives_by_the_parameters() -> None:
    P, rng = R * directions(20), np.random.default_rng(3)
    form = draw_form(rng, 1e-3)
    values, gradients = gradients_by_parameter(P)
    added = deviation(P, form)
    assert np.tensordot(form.coefficients_m, values, 1) == pytest.approx(added.value_m, abs=1e-17)
    assert np.tensordot(form.coefficients_m, gradients, 1) == pytest.approx(added.gradient, abs=1e-15)


def test_curvatures_of_a_sphere_and_at_a_pole() -> None:
    """At the pole of r = R + c P2(z): 1/R' - (d2 r)/R'^2 with R' = R + c and d2 r = -3 c, both ways."""
    low, high = curvatures(level(R * directions(50), R, Form()))
    assert np.concatenate([low, high]) == pytest.approx(1.0 / R, rel=1e-7)  # the square root of a rounding
    c = 1e-3
    low, high = curvatures(level(np.array([[0.0, 0.0, R + c]]), R, Form(form_20_m=c)))
    expected = 1.0 / (R + c) + 3.0 * c / (R + c) ** 2
    assert (low[0], high[0]) == (pytest.approx(expected, rel=1e-7), pytest.approx(expected, rel=1e-7))


# -- scenes --------------------------------------------------------------------------------------------------------


def test_a_form_of_zeros_is_a_perfect_sphere() -> None:
    assert SphereMirror(form=Form()) == SphereMirror()
    assert SphereMirror(form=Form()).form is None
    assert default_rig().perturbed(Misalignment(form_20_m=1e-4)).perturbed(Misalignment(form_20_m=-1e-4)).mirror == (
        default_rig().mirror
    )


def test_form_parameters_are_those_of_the_misalignment() -> None:
    assert [name for name in PARAMETERS if name.startswith("form_")] == list(HARMONICS)
    assert [PARAMETERS[name].study for name in HARMONICS] == [2e-5] * 12


def test_forms_add_up_and_follow_through_a_file() -> None:
    rig = formed(Form(form_20_m=1e-4)).perturbed(Misalignment(form_20_m=2e-4, form_33s_m=-1e-5))
    assert rig.sphere.form == Form(form_20_m=1e-4 + 2e-4, form_33s_m=-1e-5)
    assert from_json(Rig, json.loads(json.dumps(to_json(rig)))) == rig


def test_the_form_lies_along_the_worlds_axes_and_goes_with_the_rig() -> None:
    """Also where the nominal camera is tilted; a tilt of the camera leaves it; a yaw between the images takes it."""
    R_nominal = rotation_xyz(0.02, -0.03)
    nominal = Rig(T_world_camera=Pose("world", "camera", (0, 0, 0.45), R_nominal))
    rig = nominal.perturbed(Misalignment(form_22c_m=1e-4, tilt_x_rad=0.01, yaw_rad=0.1))
    assert rig.at(0.0).form_axes == pytest.approx(np.eye(3), abs=1e-14)
    assert rig.at(0.4).form_axes == pytest.approx(np.array(rotation_xyz(0, 0, 0.1)), abs=1e-14)
    plain = nominal.perturbed(Misalignment(tilt_x_rad=0.01, yaw_rad=0.1))
    for offset in (0.0, 0.4):  # the axes that a form would get
        assert plain.at(offset).form_axes == pytest.approx(rig.at(offset).form_axes, abs=1e-14)


@pytest.mark.parametrize("name", HARMONICS)
def test_the_largest_form_is_possible_and_more_than_the_mirror_bears_is_not(name: str) -> None:
    assert SphereMirror(form=Form(**{name: 1e-3})).bound_m == R + 1e-3
    with pytest.raises(SceneError, match=r"SphereMirror.form is too far from round"):
        SphereMirror(form=Form(**{name: 0.02}))
    with pytest.raises(SceneError, match=r"too far from round.*make it smaller"):
        SphereMirror(form=Form(**{name: 0.04}))


def test_faults_of_a_form() -> None:
    with pytest.raises(SceneError, match=r"Form.form_30_m = nan: must be a finite number"):
        Form(form_30_m=math.nan)
    with pytest.raises(SceneError, match=r"Misalignment.form_30_m = 0.002"):
        Misalignment(form_30_m=0.002)


def test_outline_against_the_rays_that_just_meet_the_mirror() -> None:
    """A millionth of the outline's radius inside, rays hit; as far outside, they miss (cos i there: 1.5e-3)."""
    rng, checked = np.random.default_rng(4), 0
    for _ in range(5):
        view = random_view(rng)
        outline = view.rig.outline_px(90)
        middle = outline.mean(axis=0)
        inside, outside = (middle + scale * (outline - middle) for scale in (1.0 - 1e-6, 1.0 + 1e-6))
        assert np.isfinite(trace_pixels(view, inside).cos_incidence).all()
        assert np.isnan(trace_pixels(view, outside).cos_incidence).all()
        assert np.abs(outline - default_rig().outline_px(90)).max() > 1.0
        checked += len(outline)
    assert checked == 450


# -- rays ----------------------------------------------------------------------------------------------------------


def test_rays_from_values_against_newtons_method() -> None:
    """`form_trace` (values) and the estimator (gradients): <= 1e-14 m and 2e-12, the whole image, forms to 1 mm.

    A ray's place is known to 1e-16 m over cos i, its normal, by differences of values, to a few 1e-13 (`form_trace`).
    The estimator gives up at cos i = 1e-3.
    """
    rng, checked = np.random.default_rng(5), 0
    for _ in range(4):
        view = random_view(rng)
        uv = np.stack(np.meshgrid(np.arange(280.0, 1001.0, 6.5), np.arange(0.0, 720.0, 6.5)), axis=-1).reshape(-1, 2)
        uv = np.concatenate([uv, [view.rig.camera.project(view.rig.sphere_in_camera_m)]])  # through the centre
        traced, newton = trace_pixels(view, uv), estimated(view, uv)
        hit = traced.cos_incidence > 1e-3
        assert np.array_equal(hit, np.isfinite(newton.incidence_rad))
        assert hit[-1]
        assert np.abs(traced.points_m - newton.origin_world_m)[hit].max() < 1e-14
        assert np.abs(traced.directions - newton.direction_world)[hit].max() < 2e-12
        checked += hit.sum()
    assert checked > 20000


@pytest.mark.skipif(find_spec("mitsuba") is None, reason="needs Mitsuba")
def test_rays_inside_a_kernel_against_those_in_float64() -> None:
    """The ambient layer's rays start 200 to 300 mm off, in float64: some ulp of 6e-14 mm, over cos i >= 0.05."""
    from phibench.render.room.mirror_intersection import mirror_intersection
    from phibench.render.setup.variant import activate

    mi, rng = activate(), np.random.default_rng(6)
    view = random_view(rng)
    uv = np.stack(np.meshgrid(np.arange(280.0, 1001.0, 6.5), np.arange(0.0, 720.0, 6.5)), axis=-1).reshape(-1, 2)
    origins, ways = lens_rays(view, uv)
    expected = reflect(view, origins, ways)
    origins = 1e3 * (origins - view.sphere_centre_m)
    ray = mi.Point3d(*origins.T), mi.Vector3d(*ways.T)
    points, normals, found = (np.array(x).T for x in mirror_intersection(mi, view)(*ray))
    sure = expected.cos_incidence > 0.05
    assert sure.sum() > 5000
    assert found[sure].all()
    assert not found[_beyond(view, uv)].any()
    assert np.abs(points - 1e3 * (expected.points_m - view.sphere_centre_m))[sure].max() < 1e-11
    assert np.abs(normals - expected.normals)[sure].max() < 1e-12


def _beyond(view: View, uv: np.ndarray) -> np.ndarray:
    """Pixels a tenth of a pixel and more outside the outline: where float32 has no doubt."""
    from skimage.measure import points_in_poly

    outline = view.rig.outline_px(2000)
    middle = outline.mean(axis=0)
    return ~points_in_poly(uv, middle + (1.0 + 0.1 / 330.0) * (outline - middle))


def test_where_there_is_no_reflection() -> None:
    """Behind the mirror; both ends see the point wherever one is found; a point and an eye in one place."""
    rng = np.random.default_rng(7)
    form = draw_form(rng, 1e-3)
    eyes = np.tile([0.0, 0.0, -0.26], (3000, 1))
    points = directions(3000) * rng.uniform(0.2, 4.0, (3000, 1))
    found, normals, lit = fermat_points(points, eyes, R, form)
    assert 1500 < lit.sum() < 3000
    assert np.isnan(found[~lit]).all()
    assert np.abs(level(found[lit], R, form).value_m).max() < 1e-16
    u, v = ((end - found)[lit] / np.linalg.norm((end - found)[lit], axis=-1, keepdims=True) for end in (points, eyes))
    assert np.all(np.sum(u * normals[lit], axis=-1) >= 0.0)
    assert np.all(np.sum(v * normals[lit], axis=-1) >= 0.0)
    assert np.abs(u + v - 2.0 * np.sum(u * normals[lit], axis=-1, keepdims=True) * normals[lit]).max() < 1e-12
    # what is refused is in the mirror's shadow: the straight line to the eye meets the mirror, or all but does
    way = eyes[~lit] - points[~lit]
    inner, _, _ = meet(points[~lit], way / np.linalg.norm(way, axis=-1, keepdims=True), R, form)
    assert np.isfinite(inner).all()
    back = fermat_points(eyes[:1] * 2.0, eyes[:1], R, form)[0]
    assert np.linalg.norm(back) == pytest.approx(float(radius_at(back[0] / np.linalg.norm(back), R, form)), abs=1e-16)


def test_spread_of_the_bundle_against_rays_that_fan_out() -> None:
    """Area at the lens per solid angle at the spot, by differences of rays from the spot: relative 1e-6.

    Rays 1e-6 rad apart land some 1e-5 m apart; they are found to 1e-15 m, second differences are 1e-6 of the first.
    """
    rng, checked, h = np.random.default_rng(8), 0, 1e-6
    for _ in range(40):
        view, point = random_view(rng), np.array([[*rng.uniform(-3, 3, 2), rng.uniform(0.1, 2.0)]])
        eye = view.camera_centre_m[None]
        found = mirror_points(view, point, eye)
        if not found.lit[0]:
            continue
        way = (found.points_m - point)[0] / np.linalg.norm(found.points_m - point)
        final = (eye - found.points_m)[0] / np.linalg.norm(eye - found.points_m)
        cos_i = np.array([final @ found.normals[0]])
        ends = []
        for tangent in np.linalg.svd(way[None])[2][1:]:
            for sign in (1.0, -1.0):
                d = way + sign * h * tangent
                ray = reflect(view, point, (d / np.linalg.norm(d))[None])
                along = (eye - ray.points_m)[0] @ final / (ray.directions[0] @ final)
                ends.append(ray.points_m[0] + along * ray.directions[0])
        a, b = (ends[0] - ends[1]) / (2 * h), (ends[2] - ends[3]) / (2 * h)
        area = abs(np.cross(a, b) @ final)
        spread = bundle_spread(view, found, eye, cos_i)[0]
        # at grazing incidence the rays curve more: differences err by (h / cos i^2)^2, roundings by 1e-15 / h / cos i
        assert spread == pytest.approx(area, rel=1e-7 / cos_i[0] ** 2)
        sphere = bundle_spread(default_rig().at(0.4), found, eye, cos_i)[0]
        checked += abs(spread / sphere - 1.0) > 0.01
    assert checked > 20  # and Coddington's equations for the sphere would be wrong


def test_a_vanishing_form_is_the_sphere() -> None:
    """A form of 1e-13 m through the general way against the closed forms of the perfect sphere."""
    plain, tiny = (formed(form).at(0.4) for form in (Form(), Form(form_20_m=1e-13)))
    assert tiny.rig.sphere.form is not None
    a, b = (spot_truth(view, SPOT, ()) for view in (plain, tiny))
    assert math.dist((a.u_px, a.v_px), (b.u_px, b.v_px)) < 1e-7
    assert (a.visible, a.cause) == (b.visible, b.cause)
    for name in ("phi_ray_rad", "phi_normal_rad", "phi_incidence_rad", "azimuth_rad", "path_spot_mirror_m"):
        assert getattr(a, name) == pytest.approx(getattr(b, name), abs=1e-10)
    layer, other = (spot_layer(view, SPOT, ()) for view in (plain, tiny))
    assert np.abs(layer.electrons_per_s - other.electrons_per_s).max() < 1e-7 * layer.electrons_per_s.max()
    assert plain.rig.outline_px(30) == pytest.approx(tiny.rig.outline_px(30), abs=1e-8)


@pytest.mark.slow
def test_the_truth_layer_is_that_of_the_form() -> None:
    """Pixel by pixel the world point that the estimator's own ray through the pixel reaches; the sphere's is not."""
    from phibench.scenes.shapes import cuboid

    rng = np.random.default_rng(9)
    view = random_view(rng, 3e-4)
    walls = (cuboid("room", (0.0, 0.0, 1.5), (8.0, 7.0, 3.0), (0.5, 0.5, 0.5)),)
    planes, plain = truth_layer(view, walls), truth_layer(default_rig().at(0.4), walls)
    seen = np.argwhere(planes["object_id"] >= 0)
    assert len(seen) > 300000
    chosen = seen[rng.integers(len(seen), size=300)]
    v, u = chosen.T
    ray = estimated(view, np.stack([u, v], axis=-1).astype(float))
    hit = np.stack([planes[name][v, u] for name in ("x_m", "y_m", "z_m")], axis=-1)
    miss = np.linalg.norm(np.cross(hit - ray.origin_world_m, ray.direction_world), axis=-1)
    assert miss.max() < 1e-9
    assert planes["phi_incidence_rad"][v, u] == pytest.approx(ray.incidence_rad, abs=1e-9)
    assert np.nanmax(np.abs(plain["x_m"] - planes["x_m"])) > 0.01
