"""Mirrors of revolution with a form error: surface, rays both ways, layers, views and sensitivities."""

from __future__ import annotations

import dataclasses
import json
import math
from types import ModuleType

import numpy as np
import pytest
from helpers.form_oracles import fermat_on_disc
from helpers.lamp_views import LAMP_ROOM, lamp_image, lamp_window, moments, traced_lamp
from helpers.revolved_rigs import PROFILES, revolved
from scipy.special import eval_jacobi

from phibench.datasets.store.json_forms import from_json, to_json
from phibench.estimator.geometry.reflection import image_of
from phibench.estimator.geometry.reflection import reflect as estimated
from phibench.estimator.geometry.sensitivities import PARAMETERS, pixel_gradient
from phibench.render.optics.certificate import certify
from phibench.render.optics.ray_tracer import lens_rays, reflect, trace_pixels
from phibench.render.optics.reflection_point import mirror_points
from phibench.render.optics.spot_layer import spot_layer
from phibench.render.optics.truth import spot_truth
from phibench.render.room.mirror_intersection import mirror_intersection
from phibench.render.setup.variant import activate
from phibench.scenes.form_error import HARMONICS, Form
from phibench.scenes.frames import Array
from phibench.scenes.laser import LaserSpot
from phibench.scenes.misalignment import PARAMETERS as MISALIGNMENT
from phibench.scenes.misalignment import Misalignment
from phibench.scenes.revolved_mirror import RevolvedMirror
from phibench.scenes.revolved_profile import FormedProfile
from phibench.scenes.rig import Rig, View
from phibench.scenes.validation import SceneError

CURVED = [shape for shape in PROFILES if shape != "cone"]
SIZES_M = (2e-5, 1e-3)  # of every peak: a study's, and the largest, drawn smaller until the surface is convex
SPOT = LaserSpot((2.0, 0.7, 0.5), (-1.0, -0.3, 0.1), 5e-3)


@pytest.fixture(scope="module")
def mi() -> ModuleType:
    return activate()


def formed(shape: str, form: Form, **more: object) -> Rig:
    rig = revolved(shape, **more)  # type: ignore[arg-type]
    return dataclasses.replace(rig, mirror=dataclasses.replace(rig.mirror, form=form))


def drawn(shape: str, size_m: float, seed: int) -> Rig:
    """Rig off its axis with all peaks drawn within `size_m`, or within less where that is not convex."""
    rng = np.random.default_rng([seed, len(shape)])
    for shrink in np.geomspace(1.0, 1e-2, 60):
        try:
            return formed(shape, Form(*rng.uniform(-size_m * shrink, size_m * shrink, 12)), aligned=False)
        except SceneError:
            continue
    raise AssertionError("no form is possible")


def surface_of(rig: Rig) -> FormedProfile:
    assert isinstance(rig.mirror, RevolvedMirror)
    assert isinstance(rig.mirror.surface, FormedProfile)
    return rig.mirror.surface


def seen(view: View, count: int, seed: int) -> tuple[Array, Array]:
    """Pixels on the mirror, and points 0.3 to 6 m along their reflected rays."""
    rng = np.random.default_rng(seed)
    uv = view.rig.outline_px().mean(axis=0) + rng.uniform(-420.0, 420.0, (4 * count, 2))
    rays = trace_pixels(view, uv)
    hit = np.flatnonzero(np.isfinite(rays.cos_incidence))[:count]
    assert len(hit) == count
    return uv[hit], (rays.points_m + rng.uniform(0.3, 6.0, (len(uv), 1)) * rays.directions)[hit]


def pixels_of(view: View, points: Array) -> Array:
    found = mirror_points(view, points, np.broadcast_to(view.camera_centre_m, points.shape))
    return view.rig.camera.project(view.T_world_camera.inverse().points(found.points_m))


# -- surface -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", HARMONICS)
def test_polynomials_are_scipys_with_a_peak_of_one(name: str) -> None:
    """R(n, m) = rho^m P(0, m) of Jacobi at 2 rho^2 - 1, degree (n - m) / 2; and without piston, tilt or power."""
    degree, order = int(name[5]), int(name[6])
    t, weight = np.polynomial.legendre.leggauss(8)  # exact for degree 15 in rho^2
    rho, turn = np.sqrt(0.5 * (t + 1.0))[:, None], np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
    x, y = 0.05 * rho * np.cos(turn), 0.05 * rho * np.sin(turn)
    surface = FormedProfile(PROFILES["paraboloid"], Form(**{name: 1.0}), 0.05)
    ours = surface.deviation(x, y).z_m
    wave = np.sin(order * turn) if "s_m" in name else np.cos(order * turn)
    assert ours == pytest.approx(
        rho**order * eval_jacobi(degree - order, 0, order, 2.0 * rho**2 - 1.0) * wave, abs=1e-13
    )
    for other in (np.ones_like(x), x, y, x * x + y * y):
        assert abs((weight[:, None] * ours * other).sum()) < 1e-12
    edge = np.linspace(0.0, 2.0 * np.pi, 361)
    rim = surface.deviation(0.05 * np.cos(edge), 0.05 * np.sin(edge))
    assert max(np.abs(rim.z_m).max(), np.abs(ours).max()) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("shape", CURVED)
def test_derivatives_of_the_surface(shape: str) -> None:
    """Five-point differences, h = 0.1 mm: some 1e-9 of the slopes, where h is short against all lengths."""
    surface, rng, h = surface_of(drawn(shape, 1e-3, 1)), np.random.default_rng(2), 1e-4
    x, y = rng.uniform(-0.02, 0.02, (2, 40))

    def slope(name: str, a: float, b: float) -> Array:
        near, far = (
            getattr(surface.heights(x + k * a, y + k * b), name) - getattr(surface.heights(x - k * a, y - k * b), name)
            for k in (h, 2.0 * h)
        )
        return np.asarray((8.0 * near - far) / (12.0 * h))

    at = surface.heights(x, y)
    for value, name, way in (
        (at.x, "z_m", (1.0, 0.0)),
        (at.y, "z_m", (0.0, 1.0)),
        (at.xx_per_m, "x", (1.0, 0.0)),
        (at.xy_per_m, "x", (0.0, 1.0)),
        (at.xy_per_m, "y", (1.0, 0.0)),
        (at.yy_per_m, "y", (0.0, 1.0)),
    ):
        assert np.abs(value - slope(name, *way)).max() < 1e-6 * max(np.abs(value).max(), 1.0)


@pytest.mark.parametrize("shape", CURVED)
def test_a_form_that_is_too_large_is_one_sentence(shape: str) -> None:
    """0.02 mm of any peak is possible. What is refused has, somewhere, less than half of the ideal's curvature."""
    for name in HARMONICS:
        formed(shape, Form(**{name: 2e-5}))
    with pytest.raises(SceneError, match=r"the form error bends the \w+ too far: at .* form_33s_m smaller"):
        formed(shape, Form(form_30_m=5e-4))
    profile, c = PROFILES["paraboloid"], 2e-3
    # astigmatism adds -2 c N / q^2 to 1 / R across, and so at the vertex half is left at c = q^2 / (4 R)
    assert surface_of(formed("paraboloid", Form(form_22c_m=c))).heights(np.zeros(1), np.zeros(1)).xx_per_m[
        0
    ] == pytest.approx(1.0 / 0.06 - 2.0 * c / profile.rim_radius_m**2)


def test_a_cone_bears_no_form() -> None:
    with pytest.raises(SceneError, match=r"no form error leaves a cone convex"):
        revolved("cone").perturbed(Misalignment(form_22c_m=1e-6))


def test_forms_add_up_keep_their_disc_and_follow_through_a_file() -> None:
    first = revolved("hyperboloid").perturbed(Misalignment(form_20_m=1e-5))
    rig = first.perturbed(Misalignment(form_20_m=2e-5, form_33s_m=-1e-5, rim_radius_m=-1e-3))
    assert rig.mirror.form == Form(form_20_m=1e-5 + 2e-5, form_33s_m=-1e-5)
    assert surface_of(rig).disc_m == 0.06  # a mirror that is cut keeps its surface
    assert rig.mirror.profile.rim_radius_m == pytest.approx(0.059)
    assert from_json(Rig, json.loads(json.dumps(to_json(rig)))) == rig
    plain = revolved("hyperboloid")
    assert not {"form", "form_radius_m"} & to_json(plain)["mirror"].keys()  # as written before there was one
    assert first.perturbed(Misalignment(form_20_m=-1e-5)) == plain
    assert from_json(Rig, to_json(plain)) == plain


# -- rays ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size_m", SIZES_M)
@pytest.mark.parametrize("shape", CURVED)
def test_accuracy_pixel_to_point_and_back(shape: str, size_m: float) -> None:
    """1e-9 px is required: 2000 pixels by rays and least path; the estimator's rays and images; none is lost."""
    view = drawn(shape, size_m, 3).at(0.3)
    uv, points = seen(view, 2000, 4)
    miss = np.linalg.norm(pixels_of(view, points) - uv, axis=1)
    print(f"{shape} {size_m:g}: {miss.max():.1e} px")
    assert miss.max() < 1e-9  # not NaN either
    rays, ours = trace_pixels(view, uv), estimated(view, uv)
    assert np.abs(ours.origin_world_m - rays.points_m).max() < 1e-14
    assert np.abs(ours.direction_world - rays.directions).max() < 2e-12
    if size_m == SIZES_M[0]:
        assert np.linalg.norm(image_of(view, points[:200]).uv_px - uv[:200], axis=1).max() < 1e-9


def least_path(shape: str, size_m: float, count: int) -> None:
    rig, moved, worst = drawn(shape, size_m, 5), 0.0, 0.0
    view, ideal = rig.at(0.3), dataclasses.replace(rig, mirror=dataclasses.replace(rig.mirror, form=None)).at(0.3)
    uv, points = seen(view, count, 6)
    into = view.T_world_sphere.inverse()
    for place, point in zip(uv, points, strict=True):
        P = fermat_on_disc(into.points(point), into.points(view.camera_centre_m), surface_of(rig))
        oracle = rig.camera.project(rig.T_camera_sphere.points(P[None]))[0]
        worst = max(worst, math.dist(oracle, place), math.dist(oracle, pixels_of(view, point[None])[0]))
        moved = max(moved, math.dist(pixels_of(ideal, point[None])[0], place))
    print(f"{shape} {size_m:g}: {worst:.1e} px, moved by {moved:.1f} px")
    assert worst < 1e-6
    assert moved > (0.1 if size_m < 1e-4 else 1.0)


@pytest.mark.parametrize("shape", CURVED)
def test_accuracy_against_the_least_path(shape: str) -> None:
    """1e-6 px is required; the oracle is good to some 1e-10 px; without the form the spot is elsewhere."""
    least_path(shape, 2e-5, 4)


@pytest.mark.slow
@pytest.mark.study
@pytest.mark.parametrize("size_m", SIZES_M)
@pytest.mark.parametrize("shape", CURVED)
def test_accuracy_against_many_least_paths(shape: str, size_m: float) -> None:
    least_path(shape, size_m, 100)


@pytest.mark.parametrize("name", HARMONICS)
def test_a_wrong_sign_of_any_polynomial_is_noticed(name: str) -> None:
    """The comparison above with one sign turned is off by more than 1e-3 px."""
    view = formed("hyperboloid", Form(*([1e-5] * 12)), aligned=False).at(0.3)
    uv, points = seen(view, 3, 7)
    turned = dataclasses.replace(surface_of(view.rig).form, **{name: -1e-5})
    wrong, into, off = FormedProfile(PROFILES["hyperboloid"], turned, 0.06), view.T_world_sphere.inverse(), []
    for place, point in zip(uv, points, strict=True):
        P = fermat_on_disc(into.points(point), into.points(view.camera_centre_m), wrong)
        off.append(math.dist(view.rig.camera.project(view.rig.T_camera_sphere.points(P[None]))[0], place))
    assert max(off) > 1e-3


@pytest.mark.parametrize("shape", CURVED)
def test_accuracy_rays_of_views_that_meet_the_mirror(mi: ModuleType, shape: str) -> None:
    """10 000 rays from all over the lens: the same are hits; places to 1e-14 m, normals to 1e-11 (0.2 mm of form)."""
    view, rng = drawn(shape, 2e-4, 8).at(0.3), np.random.default_rng(9)
    uv = view.rig.outline_px().mean(axis=0) + rng.uniform(-420.0, 420.0, (10_000, 2))
    origins, directions = lens_rays(view, uv, rng.uniform(-6e-4, 6e-4, uv.shape))
    rays, start = reflect(view, origins, directions), 1e3 * (origins - view.sphere_centre_m)
    point, normal, found = (
        np.array(x).T for x in mirror_intersection(mi, view)(mi.Vector3d(start.T), mi.Vector3d(directions.T))
    )
    assert np.isfinite(point).all()
    assert np.isfinite(normal).all()
    hit = np.isfinite(rays.cos_incidence)
    assert 2_500 < hit.sum() < 7_500
    assert np.array_equal(found, hit)
    assert np.abs(1e-3 * point + view.sphere_centre_m - rays.points_m)[hit].max() < 1e-14
    assert np.abs(normal - rays.normals)[hit].max() < 1e-11


# -- light ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", ["ellipsoid", "hyperboloid", "polynomial"])
def test_accuracy_certificates(shape: str) -> None:
    """Chief ray <= 1e-6 px, centroid <= 0.002 px, flux <= 0.3 %: rays from the camera, a rough mirror included."""
    view = formed(shape, surface_of(drawn(shape, 1e-4, 10)).form, aligned=False, alpha=0.002).at(0.3)
    certificate = certify(view, SPOT, (), spot_truth(view, SPOT, ()), spot_layer(view, SPOT, ()))
    print(certificate)
    assert certificate.passed


def test_a_certificate_notices_the_layer_of_another_form(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("phibench.render.optics.certificate._LOG2_RAYS", (13,))
    form = Form(form_21c_m=2e-6, form_31c_m=-2e-6)
    view = formed("hyperboloid", form).at(0.3)
    truth = spot_truth(view, SPOT, ())
    assert certify(view, SPOT, (), truth, spot_layer(view, SPOT, ())).passed
    for other in (Form(), Form(*(-peak for peak in form.coefficients_m))):
        wrong = formed("hyperboloid", other).at(0.3)
        assert not certify(view, SPOT, (), truth, spot_layer(wrong, SPOT, ())).passed
        assert not certify(view, SPOT, (), spot_truth(wrong, SPOT, ()), spot_layer(view, SPOT, ())).passed


@pytest.mark.slow
def test_accuracy_ambient_image_of_a_lamp() -> None:
    """Flux 0.2 % and centroid 0.03 px of a lamp in the mirror, against float64 rays; the ideal's is elsewhere."""
    view = formed("hyperboloid", Form(form_22s_m=2e-4, form_31c_m=5e-5)).at(0.2)
    crop = lamp_window(view)
    flux, u, v = moments(lamp_image(view, LAMP_ROOM, crop))
    expected = moments(traced_lamp(view, crop))
    print(f"{flux / expected[0] - 1.0:.1e}, {math.dist((u, v), expected[1:]):.3f} px")
    assert flux == pytest.approx(expected[0], rel=2e-3)
    assert math.dist((u, v), expected[1:]) < 0.03
    ideal = moments(traced_lamp(revolved("hyperboloid").at(0.2), crop))
    assert math.dist(ideal[1:], (u, v)) > 0.5


# -- sensitivities -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", ["ellipsoid", "hyperboloid", "flattened"])
def test_accuracy_sensitivities_of_the_pixel(shape: str) -> None:
    """d(u, v)/dp against five-point differences of the simulator's pixels, a form being there already: 1e-6."""
    rig, names = drawn(shape, 5e-5, 11), (*HARMONICS, "radius_m", "mirror_tilt_x_rad")
    view = rig.at(0.3)
    uv, points = seen(view, 2, 12)
    for name in names:
        step = 0.1 * MISALIGNMENT[name].study
        a, b, c, d = (
            pixels_of(rig.perturbed(Misalignment(**{name: k * step})).at(0.3), points) for k in (-2, -1, 1, 2)
        )
        expected = (a - 8.0 * b + 8.0 * c - d) / (12.0 * step)
        for i, point in enumerate(points):
            ours = pixel_gradient(view, uv[i], point)[:, PARAMETERS.index(name)]
            assert ours == pytest.approx(expected[i], abs=1e-6 * max(np.abs(expected).max(), 1.0))
