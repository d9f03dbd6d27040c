"""Estimator's geometry with mirrors of revolution: against the simulator, differences, and the sphere."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from helpers.revolved_rigs import PROFILES, revolved

from phibench.estimator.geometry.least_squares_depth import combine, depth_general
from phibench.estimator.geometry.paper_depth import depth_paper, depth_revolved, paper_gradient, revolved_gradient
from phibench.estimator.geometry.phi import CONVENTIONS, GRADIENTS
from phibench.estimator.geometry.reflection import image_of, reflect, reflect_jacobian
from phibench.estimator.geometry.rig_parameters import RIG_PARAMETERS, has_effect, moves_rays, rig_gradient
from phibench.estimator.geometry.sensitivities import PARAMETERS, pixel_gradient, sensitivity
from phibench.estimator.geometry.status import Status
from phibench.estimator.geometry.triangulate import ESTIMATORS, depth_exact
from phibench.render.optics.ray_tracer import trace_pixels
from phibench.render.optics.reflection_point import mirror_points
from phibench.scenes.frames import Array, rotation_xyz
from phibench.scenes.holder import fitted_holder
from phibench.scenes.mirror import OF_REVOLVED
from phibench.scenes.misalignment import PARAMETERS as MISALIGNMENT
from phibench.scenes.misalignment import Misalignment
from phibench.scenes.revolved_profile import cone, sphere_cap
from phibench.scenes.rig import Rig, View
from phibench.scenes.room import default_rig

STROKE_M = 0.4


def rng_of(*names: object) -> np.random.Generator:
    return np.random.default_rng([ord(c) for c in "".join(map(str, names))])


def on_the_mirror(view: View, count: int, rng: np.random.Generator) -> Array:
    """Random pixels that see the mirror, shape (count, 2)."""
    uv = view.rig.outline_px().mean(axis=0) + rng.uniform(-380.0, 380.0, (3 * count + 20, 2))
    seen = uv[reflect(view, uv).status == Status.OK][:count]
    assert len(seen) == count
    return seen


def chief_pixels(view: View, points: Array) -> Array:
    """The simulator's pixels of points, shape (n, 2); NaN where they are not seen."""
    found = mirror_points(view, points, np.broadcast_to(view.camera_centre_m, points.shape))
    return view.rig.camera.project(view.T_world_camera.inverse().points(found.points_m))


def seen_from_both(rig: Rig, count: int, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Points that both positions see, and their pixels by the simulator."""
    views, kept = (rig.at(0.0), rig.at(STROKE_M)), []
    uv = on_the_mirror(views[0], 40 * count, rng)
    rays = trace_pixels(views[0], uv)
    points = rays.points_m + rng.uniform(0.5, 6.0, (len(uv), 1)) * rays.directions
    kept = [chief_pixels(view, points) for view in views]
    good = np.flatnonzero(np.isfinite(kept[0]).all(axis=1) & np.isfinite(kept[1]).all(axis=1))[:count]
    assert len(good) == count
    return points[good], kept[0][good], kept[1][good]


@pytest.mark.parametrize("aligned", [True, False], ids=["aligned", "off axis"])
@pytest.mark.parametrize("shape", PROFILES)
def test_accuracy_rays_and_images_are_the_simulators(shape: str, aligned: bool) -> None:
    """10 000 pixels by other mathematics, both ways, 1e-9 px; rounding of rays is 1e-14 rad, some more at a cone's tip.

    Newton on a convex function against the quadratic formula; bisection and Newton in the image against the least path.
    """
    view, rng = revolved(shape, aligned=aligned).at(0.0), rng_of("rays", shape)
    uv = view.rig.outline_px().mean(axis=0) + rng.uniform(-380.0, 380.0, (10_000, 2))
    ours, theirs = reflect(view, uv), trace_pixels(view, uv)
    seen = np.isfinite(theirs.cos_incidence) & (theirs.cos_incidence > 2e-3)
    assert seen.sum() > 3000
    assert (ours.status[seen] == Status.OK).all()
    assert (ours.status[np.isnan(theirs.cos_incidence)] != Status.OK).all()
    assert ours.origin_world_m[seen] == pytest.approx(theirs.points_m[seen], abs=1e-14)
    assert ours.direction_world[seen] == pytest.approx(theirs.directions[seen], abs=1e-11)
    points = theirs.points_m[seen] + rng.uniform(0.3, 6.0, (seen.sum(), 1)) * theirs.directions[seen]
    image = image_of(view, points)
    assert (image.status == Status.OK).all()  # no point inside the rim is lost
    worst = float(np.linalg.norm(image.uv_px - uv[seen], axis=1).max())
    print(f"{shape}, {'aligned' if aligned else 'off axis'}: {worst:.1e} px")
    assert worst < 1e-9


@pytest.mark.parametrize("shape", PROFILES)
def test_derivatives_of_rays_and_images(shape: str) -> None:
    """Analytic against central differences of 0.01 px and 0.1 mm, which err by the square: 1e-6 and less."""
    view = revolved(shape, aligned=False).at(0.0)
    uv = on_the_mirror(view, 60, rng_of("slopes", shape))
    J, step = reflect_jacobian(view, uv), 0.01
    for axis in (0, 1):
        shift = step * np.eye(2)[axis]
        plus, minus = reflect(view, uv + shift), reflect(view, uv - shift)
        for ours, name in (
            (J.origin_m_per_px, "origin_world_m"),
            (J.direction_per_px, "direction_world"),
            (J.normal_per_px, "normal_world"),
        ):
            differences = (getattr(plus, name) - getattr(minus, name)) / (2.0 * step)
            good = np.isfinite(differences).all(axis=1)  # at the rim a neighbour may miss
            assert good.sum() >= 55
            scale = np.abs(ours[good]).max()
            assert ours[good, :, axis] == pytest.approx(differences[good], abs=1e-5 * scale, rel=1e-4)
    ray = reflect(view, uv)
    points, small = ray.origin_world_m + 2.0 * ray.direction_world, 1e-4
    image = image_of(view, points)
    for axis in range(3):
        move = small * np.eye(3)[axis]
        difference = (image_of(view, points + move).uv_px - image_of(view, points - move).uv_px) / (2.0 * small)
        good = np.isfinite(difference).all(axis=1)
        assert good.sum() >= 50
        scale = np.abs(image.px_per_m[good]).max()
        assert image.px_per_m[good, :, axis] == pytest.approx(difference[good], abs=1e-5 * scale, rel=1e-4)


@pytest.mark.parametrize("shape", PROFILES)
def test_accuracy_exact_depth_from_true_pixels(shape: str) -> None:
    """A misaligned rig, known: D to 1e-9 by the simulator's pixels. 1e-12 px and some hundred px per 1/D are 1e-12."""
    deviation = Misalignment(tilt_x_rad=0.01, decentre_x_m=0.002, stroke_tilt_y_rad=0.005, k1=0.01)
    rig = revolved(shape).perturbed(deviation)
    points, down, up = seen_from_both(rig, 20, rng_of("depth", shape))
    centre = rig.at(0.0).sphere_centre_m
    D = np.hypot(*(points - centre)[:, :2].T)
    rays = reflect(rig.at(0.0), down).direction_world, reflect(rig.at(STROKE_M), up).direction_world
    apart = np.linalg.norm(np.cross(*rays), axis=1) > 0.01  # of the rays, else D follows from rounding
    assert apart.sum() >= 10
    pixels, C = (down[apart], up[apart]), np.tile(0.01 * np.eye(2), (apart.sum(), 1, 1))
    for found in (depth_exact(rig, STROKE_M, *pixels), depth_general(rig, STROKE_M, *pixels, C, C)):
        assert (found.status == Status.OK).all()
        assert found.depth_m == pytest.approx(D[apart], rel=1e-9)
    both = combine(rig, STROKE_M, pixels[0], C, pixels[1], C)
    assert both.depth_m == pytest.approx(D[apart], rel=1e-7)  # it ends where a step is small against its sigma


@pytest.mark.parametrize("shape", PROFILES)
def test_accuracy_exact_depth_through_a_glass_tube(shape: str) -> None:
    """D to 1e-9 and images to 1e-9 px by the simulator's pixels, off axis: Snell's law there, closed forms here."""
    rig = revolved(shape, aligned=False)
    holder = fitted_holder("tube", rig.mirror.profile.rim_radius_m, rig.mirror.profile.depth_m)
    rig, rng = dataclasses.replace(rig, holder=holder), rng_of("tube", shape)
    turn, D = rng.uniform(0.0, 2.0 * np.pi, 60), rng.uniform(1.0, 4.0, 60)
    heights = rng.uniform(1.05, 1.2, 60) if shape == "cone" else rng.uniform(0.2, 0.5, 60)
    points = np.stack([D * np.cos(turn), D * np.sin(turn), heights], axis=1)
    down, up = (chief_pixels(rig.at(offset), points) for offset in (0.0, STROKE_M))
    seen = np.isfinite(down).all(axis=1) & np.isfinite(up).all(axis=1)
    assert seen.sum() >= 20
    assert image_of(rig.at(0.0), points[seen]).uv_px == pytest.approx(down[seen], abs=1e-9)
    found = depth_exact(rig, STROKE_M, down[seen], up[seen])
    expected = np.hypot(*(points[seen] - rig.at(0.0).sphere_centre_m)[:, :2].T)
    assert found.depth_m == pytest.approx(expected, rel=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        *("radius_m", "decentre_x_m", "axial_m", "tilt_y_rad", "mirror_tilt_x_rad", "mirror_tilt_y_rad"),
        *("focal_relative", "pitch_rad", "k1"),
    ],
)
@pytest.mark.parametrize("shape", [shape for shape in PROFILES if shape != "cone"])
def test_sensitivities_of_the_pixel_against_the_simulator(shape: str, name: str) -> None:
    """d(u, v)/dp by the estimator, and by differences of the simulator's pixels."""
    rig, step = revolved(shape), 0.01 * MISALIGNMENT[name].study
    points, _, up = seen_from_both(rig, 4, rng_of("sensitivity", shape))
    plus, minus = (
        chief_pixels(rig.perturbed(Misalignment(**{name: s * step})).at(STROKE_M), points) for s in (1.0, -1.0)
    )
    expected = (plus - minus) / (2.0 * step)
    for i, point in enumerate(points):
        ours = pixel_gradient(rig.at(STROKE_M), up[i], point)[:, PARAMETERS.index(name)]
        assert ours == pytest.approx(expected[i], rel=1e-4, abs=1e-5 * np.abs(expected).max())


@pytest.mark.parametrize("shape", PROFILES)
def test_a_tilt_of_the_mirror_alone(shape: str) -> None:
    """Vertex and camera stay; exact depth of the simulator's pixels to 1e-9; dD/d(tilt) by two ways.

    Five-point differences of the midpoint's D, and the analytic chain through the pixels: both at the true rig, where
    they are each other's negative. The differences err by 1e-8, and by what the pixels' slopes lose.
    """
    wrong = Misalignment(mirror_tilt_x_rad=0.012, mirror_tilt_y_rad=-0.02, decentre_x_m=1e-3, tilt_y_rad=0.005)
    nominal = revolved(shape)
    rig, still = nominal.perturbed(wrong), nominal.perturbed(Misalignment(decentre_x_m=1e-3, tilt_y_rad=0.005))
    assert rig.at(0.0).sphere_centre_m == pytest.approx(still.at(0.0).sphere_centre_m, abs=1e-15)
    assert rig.T_world_camera == still.T_world_camera
    turned = np.array(rotation_xyz(0.012, -0.02)) @ [0.0, 0.0, 1.0]
    assert rig.at(0.0).T_world_sphere.R[:, 2] == pytest.approx(turned, abs=1e-14)
    points, down, up = seen_from_both(rig, 6, rng_of("tilt", shape))
    D = np.linalg.norm(points[:, :2] - rig.at(0.0).sphere_centre_m[:2], axis=1)
    found = depth_exact(rig, STROKE_M, down, up)
    apart = np.isfinite(found.depth_m)
    assert apart.sum() >= 3
    assert found.depth_m[apart] == pytest.approx(D[apart], rel=1e-9)
    gradient = rig_gradient(rig, STROKE_M, down[apart], up[apart])
    # a stencil of 1e-3 rad may take a ray off the rim, or off the side of a cone that it was on
    whole = np.isfinite(gradient).all(axis=1)
    assert whole.sum() >= 2
    for i in np.flatnonzero(whole):
        point = points[apart][i]
        ours = sensitivity("exact", rig, STROKE_M, rig, STROKE_M, point).estimate_gradient
        for name in ("mirror_tilt_x_rad", "mirror_tilt_y_rad"):
            a, b = ours[PARAMETERS.index(name)], -gradient[i, RIG_PARAMETERS.index(name)]
            assert a == pytest.approx(b, rel=1e-5, abs=1e-5 * D[apart][i])
    assert (gradient[whole, RIG_PARAMETERS.index("rim_radius_m")] == 0.0).all()


def test_a_sphere_has_neither_axis_nor_rim() -> None:
    """What they change of a sphere is nothing: its rays, and its derivatives."""
    rig = default_rig()
    other = rig.perturbed(Misalignment(mirror_tilt_x_rad=0.1, rim_radius_m=1e-3))
    uv = np.array([[800.0, 300.0], [500.0, 420.0]])
    a, b = reflect(rig.at(0.0), uv), reflect(other.at(0.0), uv)
    assert (a.direction_world == b.direction_world).all()
    named = dict(zip(RIG_PARAMETERS, has_effect(rig), strict=False))
    assert [name for name, is_one in named.items() if not is_one] == list(OF_REVOLVED)
    assert not has_effect(revolved("cone"))[RIG_PARAMETERS.index("radius_m")]
    assert has_effect(revolved("paraboloid")).all()
    assert moves_rays(revolved("paraboloid")).sum() == has_effect(rig).sum() + 2


# -- phi and eq. (4) -------------------------------------------------------------------------------------------------


def test_eq_4_of_a_sphere_is_the_papers() -> None:
    """r = R sin phi and z = -R cos phi but for a constant: both formulas, and their gradients, to rounding."""
    phi1, phi2 = np.array([0.62, 0.7, 0.75]), np.array([0.55, 0.66, 0.72])
    cap = sphere_cap(0.06, 0.058)
    ours, papers = depth_revolved(phi1, phi2, 0.4, cap, np.eye(2)), depth_paper(phi1, phi2, 0.4, 0.06, np.eye(2))
    assert ours.depth_m == pytest.approx(papers.depth_m, rel=1e-14)
    assert ours.sigma_m == pytest.approx(papers.sigma_m, rel=1e-12)
    assert revolved_gradient(phi1, phi2, 0.4, cap) == pytest.approx(paper_gradient(phi1, phi2, 0.4, 0.06), rel=1e-12)


@pytest.mark.parametrize("shape", [shape for shape in PROFILES if shape != "cone"])
def test_gradient_of_eq_4_against_differences(shape: str) -> None:
    """Fourth-order differences of 1e-4 rad: 1e-9 of the value."""
    profile, step = PROFILES[shape], 1e-4
    steepest = np.arctan(2.0 * profile.rim_radius_m * profile.sag(np.array(profile.rim_radius_m**2)).slope_per_m)
    phi1, phi2 = 0.95 * steepest, 0.85 * steepest
    gradient = revolved_gradient(phi1, phi2, 0.4, profile)
    assert np.isfinite(gradient).all()
    for axis in (0, 1):
        e = np.eye(2)[axis]
        k = step * np.array([-2.0, -1.0, 1.0, 2.0])
        f = depth_revolved(phi1 + k * e[0], phi2 + k * e[1], 0.4, profile).depth_m
        assert gradient[axis] == pytest.approx((8.0 * (f[2] - f[1]) - (f[3] - f[0])) / (12.0 * step), rel=1e-8)


def test_a_cone_has_no_depth_by_eq_4_and_a_slope_beyond_the_rim_none_either() -> None:
    """A cone's normal has one angle. A paraboloid of 45 degrees at the rim has no normal of 50."""
    assert depth_revolved(0.7, 0.6, 0.4, cone(0.8, 0.06)).status == Status.OUT_OF_RANGE
    assert depth_revolved(np.radians(50.0), 0.6, 0.4, PROFILES["paraboloid"]).status == Status.OUT_OF_RANGE
    assert depth_revolved(np.radians(44.0), 0.6, 0.4, PROFILES["paraboloid"]).status == Status.OK


@pytest.mark.parametrize("convention", CONVENTIONS)
@pytest.mark.parametrize("shape", ["ellipsoid", "hyperboloid", "polynomial"])
def test_gradients_of_phi_against_differences(shape: str, convention: str) -> None:
    """Central differences of 0.01 px: 1e-6 of the value."""
    view, step = revolved(shape).at(0.0), 0.01
    uv = on_the_mirror(view, 30, rng_of("phi", shape))
    uv = uv[np.linalg.norm(uv - view.rig.outline_px().mean(axis=0), axis=1) < 250.0]
    gradient = GRADIENTS[convention](view, uv)
    for axis in (0, 1):
        shift = step * np.eye(2)[axis]
        plus, minus = (CONVENTIONS[convention](view, uv + s * shift) for s in (1.0, -1.0))
        assert gradient[:, axis] == pytest.approx((plus - minus) / (2.0 * step), rel=1e-4, abs=1e-8)
    assert len(uv) >= 10


def test_every_estimator_answers_or_says_why() -> None:
    """Of a hyperboloid the exact estimator is right, and eq. (4) with phi of the ray near it where it has an answer."""
    rig = revolved("hyperboloid")
    points, down, up = seen_from_both(rig, 10, rng_of("all"))
    D = np.hypot(*points[:, :2].T)
    for name, estimator in ESTIMATORS.items():
        found = [estimator(rig, STROKE_M, a, b) for a, b in zip(down, up, strict=True)]
        assert len(found) == len(D)
        for depth, one in zip(D, found, strict=True):
            assert np.isfinite(one.depth_m) == (one.status == Status.OK)
            if name == "exact" and one.status == Status.OK:
                assert one.depth_m == pytest.approx(depth, rel=1e-6)
