"""Rays at the sphere against Fermat's path, Alhazen's quartic and finite differences."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.oracles import (
    alhazen_quartic,
    fermat_on_sphere,
    fermat_path,
    random_rig,
    random_spot,
    true_pixel,
    true_reflection,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from phibench.estimator.geometry.reflection import GRAZING_COSINE, reflect, reflect_jacobian
from phibench.estimator.geometry.status import Status
from phibench.scenes.rig import Rig
from phibench.scenes.room import c310_rig

CENTRE = np.array([639.5, 359.5])


def test_oracles_agree_with_each_other():
    rng = np.random.default_rng(11)
    for _ in range(20):
        a = np.array([*rng.normal(0, 0.05, 2), -rng.uniform(0.25, 0.6)])
        b = random_spot(rng) - [0, 0, 0.7]
        quartic, path, sphere = (f(a, b, 0.06) for f in (alhazen_quartic, fermat_path, fermat_on_sphere))
        # float64 ulp of 0.06 is 7e-18; both are rounded to float64 once after arithmetic of 18 digits and more
        assert np.abs(quartic - path).max() < 1e-16
        # a minimum of a float64 path (ulp 4e-16 m, curvature about 20 /m) is flat over sqrt(4e-16 / 20) = 5e-9 m
        assert np.abs(quartic - sphere).max() < 5e-8


def test_accuracy_reflection_point_and_ray_for_random_rigs():
    rng = np.random.default_rng(12)
    worst_point = worst_ray = checked = 0.0
    for _ in range(200):
        rig, spot, offset = random_rig(rng), random_spot(rng), rng.uniform(0.0, 1.4)
        P = true_reflection(rig, offset, spot)
        result = reflect(rig.at(offset), true_pixel(rig, offset, spot))
        assert result.status == Status.OK
        to_spot = (spot - result.origin_world_m) / np.linalg.norm(spot - result.origin_world_m)
        worst_point = max(worst_point, np.abs(result.origin_world_m - P).max())
        worst_ray = max(worst_ray, np.abs(result.direction_world - to_spot).max())
        checked += 1
    assert checked == 200
    # one ulp of a pixel coordinate (1e-13 px) is 2e-17 m on the mirror at 0.2 m, up to 1 / cos i = 10 times that;
    # 1e-14 m and 1e-12 rad leave a factor of 50 for the arithmetic of frames at 2 m from the origin (ulp 4e-16)
    assert worst_point < 1e-14
    assert worst_ray < 1e-12


def test_accuracy_angles_obey_the_law_of_reflection():
    """phi_i = phi_n + alpha and theta = 2 phi_n + alpha, for aligned optics."""
    uv = CENTRE + np.stack([np.linspace(1.0, 338.0, 500), np.zeros(500)], -1)
    result = reflect(Rig().at(0.0), uv)
    assert np.all(result.status == Status.OK)
    alpha = np.arctan(np.linspace(1.0, 338.0, 500) / 1430.0)
    phi_n = np.arctan2(result.normal_world[:, 0], -result.normal_world[:, 2])
    theta = np.arctan2(result.direction_world[:, 0], -result.direction_world[:, 2])
    # towards the outline rounding of the discriminant (1e-18 m^2) grows as 1 / cos i, here 1 / 0.07: 1e-14 rad
    np.testing.assert_allclose(result.incidence_rad, phi_n + alpha, rtol=0, atol=1e-13)
    np.testing.assert_allclose(theta, 2 * phi_n + alpha, rtol=0, atol=2e-13)


@settings(derandomize=True, deadline=None, max_examples=200)
@given(st.floats(-340, 340), st.floats(-340, 340), st.floats(-1.4, 1.4))
def test_reflection_stays_on_the_sphere_and_in_the_plane_of_incidence(du, dv, offset):
    view = c310_rig().at(offset)
    result = reflect(view, CENTRE + [du, dv])
    if result.status != Status.OK:
        assert np.isnan(result.origin_world_m).all()
        return
    n, r = result.normal_world, result.direction_world
    camera_ray = result.origin_world_m - view.camera_centre_m
    d = camera_ray / np.linalg.norm(camera_ray)
    # directions from points at 2 m (ulp 4e-16) that lie 0.2 m apart: 1e-15 / 0.2
    assert np.linalg.norm(result.origin_world_m - view.sphere_centre_m) == pytest.approx(0.06, abs=2e-15)
    assert abs(np.linalg.norm(r) - 1) < 1e-14
    assert abs(r @ n + d @ n) < 2e-14
    assert abs(np.cross(d, n) @ r) < 2e-14
    assert d @ n < 0 < r @ n


@pytest.mark.parametrize("make_rig", [Rig, c310_rig, lambda: random_rig(np.random.default_rng(13))])
def test_jacobian_against_differences(make_rig):
    view, step = make_rig().at(0.3), 1e-4
    rng = np.random.default_rng(14)
    outline = view.rig.outline_px()
    centre, radius = outline.mean(axis=0), np.linalg.norm(outline - outline.mean(axis=0), axis=1).min()
    turn, r = rng.uniform(0, 2 * np.pi, 300), radius * np.sqrt(rng.uniform(0.001, 0.9, 300))
    uv = centre + np.stack([r * np.cos(turn), r * np.sin(turn)], -1)
    uv = uv[np.isfinite(reflect(view, uv).incidence_rad)]
    assert len(uv) == 300
    jacobian = reflect_jacobian(view, uv)
    for axis in (0, 1):
        e = step * np.eye(2)[axis]
        plus, minus = reflect(view, uv + e), reflect(view, uv - e)
        pairs = (
            ("origin_world_m", jacobian.origin_m_per_px),
            ("direction_world", jacobian.direction_per_px),
            ("normal_world", jacobian.normal_per_px),
            ("incidence_rad", jacobian.incidence_rad_per_px),
        )
        for name, analytic in pairs:
            numeric = (getattr(plus, name) - getattr(minus, name)) / (2 * step)
            # rounding 1e-15 / 2e-4 = 5e-12; truncation step^2 f''' / 6, f''' < 1e-3 / px^3 (incidence, near the axis)
            np.testing.assert_allclose(analytic[..., axis], numeric, rtol=1e-6, atol=2e-10, err_msg=name)


def test_bad_rays_get_nan_and_a_status():
    # outline radius of the default rig: f tan(asin(R / z_c)); 1e-5 px inside it cos i is 2.3e-4
    edge = 1430.0 * np.tan(np.arcsin(0.06 / 0.26))
    cases = [
        ((100.0, 0.0), Status.OK),
        ((0.0, 0.0), Status.ON_AXIS),
        ((edge - 1e-5, 0.0), Status.GRAZING),
        ((edge + 1e-5, 0.0), Status.MISSES_MIRROR),
        ((-600.0, 300.0), Status.MISSES_MIRROR),
        ((np.nan, 0.0), Status.NOT_FINITE),
        ((np.inf, 0.0), Status.NOT_FINITE),
    ]
    uv = CENTRE + np.array([offset for offset, _ in cases])
    result, jacobian = reflect(Rig().at(0.0), uv), reflect_jacobian(Rig().at(0.0), uv)
    assert [Status(s) for s in result.status] == [status for _, status in cases]
    for array in (result.origin_world_m, result.direction_world, result.normal_world, jacobian.direction_per_px):
        assert np.isfinite(array[0]).all()
        assert np.isnan(array[1:]).all()


def test_pixel_beyond_the_distortion_model_is_not_finite():
    assert reflect(c310_rig().at(0.0), np.array([5e6, 0.0])).status == Status.NOT_FINITE


def test_grazing_limit_is_where_it_says():
    assert GRAZING_COSINE == 1e-3
    sine = np.sqrt(1 - np.array([1.1e-3, 0.9e-3]) ** 2) * 0.06 / 0.26  # of the angle between ray and axis
    uv = CENTRE + np.stack([1430.0 * np.tan(np.arcsin(sine)), np.zeros(2)], -1)
    assert list(reflect(Rig().at(0.0), uv).status) == [Status.OK, Status.GRAZING]


def test_leading_axes_are_kept_and_do_not_mix():
    uv = CENTRE + np.random.default_rng(15).uniform(-200, 200, (3, 4, 2))
    whole, single = reflect(Rig().at(0.1), uv), reflect(Rig().at(0.1), uv[1, 2])
    assert whole.direction_world.shape == (3, 4, 3)
    assert whole.status.shape == (3, 4)
    np.testing.assert_allclose(whole.direction_world[1, 2], single.direction_world, rtol=0, atol=1e-15)
