"""Joint fit of both images: its geometry against other mathematics, the fit against least squares, its failures.

`tests/test_accuracy_joint.py` holds it against the bound.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.joint_pairs import BAYER, MONO, RIG, Pairs, drawn_pairs
from helpers.oracles import random_rig, random_spot, true_pixel

from phibench.estimator.geometry.epipolar_line import up_image
from phibench.estimator.geometry.least_squares_depth import combine, joint_bound
from phibench.estimator.geometry.reflection import image_of
from phibench.estimator.geometry.status import Status
from phibench.estimator.geometry.triangulate import depth_exact
from phibench.estimator.spots.fit_joint import fit_joint
from phibench.estimator.spots.fit_raw import spot_data
from phibench.estimator.spots.gaussian_spot import SpotBlur, SpotModel
from phibench.estimator.spots.raw_pixels import GaussLaw, PixelNoise, spot_regions
from phibench.scenes.frames import Array
from phibench.scenes.random_streams import generator


def some_pairs(count: int = 12) -> tuple[Array, Array, Array, Array]:
    """Exact pixels of points at all azimuths: (u, v) down and up, D, h."""
    rng = generator("joint", "geometry")
    D, h, azimuth = rng.uniform(0.8, 4.5, count), rng.uniform(0.2, 1.2, count), rng.uniform(0.0, 2.0 * np.pi, count)
    centre = RIG.at(0.0).sphere_centre_m
    X = np.column_stack([centre[0] + D * np.cos(azimuth), centre[1] + D * np.sin(azimuth), np.full(count, 0.5)])
    up = np.array([image_of(RIG.at(offset), x).uv_px for offset, x in zip(h, X, strict=True)])
    return image_of(RIG.at(0.0), X).uv_px, up, D, h


# -- geometry --------------------------------------------------------------------------------------------------------


def test_image_of_points_against_alhazens_quartic() -> None:
    """60 random misaligned, distorted rigs; the quartic's pixel is exact to 4e-13 px (docs/measurements.md)."""
    rng, checked = generator("mirror image"), 0
    for _ in range(60):
        rig, spot, offset = random_rig(rng), random_spot(rng), float(rng.uniform(0.0, 1.4))
        image = image_of(rig.at(offset), spot)
        assert image.status == Status.OK
        # two steps of Newton's tolerance of 1e-10 px, and the rounding of both
        np.testing.assert_allclose(image.uv_px, true_pixel(rig, offset, spot), rtol=0, atol=1e-9)
        checked += 1
    assert checked == 60


def test_derivatives_of_the_image_by_the_point_against_differences() -> None:
    rng = generator("mirror image", "slopes")
    rig, h = random_rig(rng), 1e-5
    spots = np.stack([random_spot(rng) for _ in range(20)])
    image = image_of(rig.at(0.3), spots)
    for axis in range(3):
        step = h * np.eye(3)[axis]
        slope = (image_of(rig.at(0.3), spots + step).uv_px - image_of(rig.at(0.3), spots - step).uv_px) / (2.0 * h)
        # rounding: 1e-12 px / 1e-5 m; curvature: h^2 f''' / 6 with f''' about 1e3 px/m^3
        np.testing.assert_allclose(image.px_per_m[..., axis], slope, rtol=0, atol=1e-4)


def test_points_that_no_pixel_shows_have_a_status() -> None:
    view = RIG.at(0.0)
    above = view.sphere_centre_m + [0.0, 0.0, 3.0]  # behind the sphere
    image = image_of(view, np.stack([above, np.full(3, np.nan), np.array([2.0, 1.0, 0.3])]))
    assert [Status(k) for k in image.status] == [Status.NOT_CONVERGED, Status.NOT_FINITE, Status.OK]
    assert np.isnan(image.uv_px[:2]).all()


def test_up_image_and_its_derivatives() -> None:
    down, up, D, h = some_pairs()
    image = up_image(RIG, h, down, 1.0 / D)
    np.testing.assert_allclose(image.uv_px, up, rtol=0, atol=1e-9)
    e = 1e-5
    slopes = [
        (up_image(RIG, h, down + e * step, 1.0 / D).uv_px - up_image(RIG, h, down - e * step, 1.0 / D).uv_px)
        for step in np.eye(2)
    ]
    slopes.append(up_image(RIG, h, down, 1.0 / D + e).uv_px - up_image(RIG, h, down, 1.0 / D - e).uv_px)
    # rounding: 1e-11 px of Newton's stop / 2e-5; the largest derivative is some 100 px m
    np.testing.assert_allclose(image.jacobian, np.stack(slopes, -1) / (2.0 * e), rtol=1e-5, atol=1e-5)


def test_up_image_refuses_no_depth() -> None:
    down, _, _, h = some_pairs(3)
    image = up_image(RIG, h, down, np.array([0.0, -1.0, np.nan]))
    assert (image.status != Status.OK).all()
    assert np.isnan(image.uv_px).all()


# -- generalised least squares --------------------------------------------------------------------------------------


def covariances() -> tuple[Array, Array]:
    return 1e-4 * np.array([[1.0, 0.3], [0.3, 2.0]]), 1e-4 * np.array([[4.0, -1.0], [-1.0, 1.0]])


def test_combine_returns_exact_pixels_and_their_depth() -> None:
    down, up, D, h = some_pairs()
    C1, C2 = covariances()
    best = combine(RIG, h, down, C1, up, C2)
    assert (best.status == Status.OK).all()
    np.testing.assert_allclose(best.depth_m, D, rtol=1e-9)
    np.testing.assert_allclose(best.uv_down_px, down, rtol=0, atol=1e-9)
    assert best.chi2.max() < 1e-10


@pytest.mark.slow
def test_combine_against_draws() -> None:
    """Depth's scatter is its sigma, chi^2 has one degree of freedom, and the midpoint is no better.

    20 000 draws: a standard deviation is known to 0.5 %; 2.5 % are five of them, a false alarm below 1e-6.
    """
    down, up, D, h = (x[0] for x in some_pairs())
    C1, C2 = covariances()
    rng = generator("combine", "draws")
    x, y = rng.multivariate_normal(down, C1, 20_000), rng.multivariate_normal(up, C2, 20_000)
    best, midpoint = combine(RIG, h, x, C1, y, C2), depth_exact(RIG, h, x, y, C1, C2)
    sigma = np.sqrt(joint_bound(RIG, h, down, D, C1, C2).variance_depth_m2)
    assert best.depth_m.std() == pytest.approx(float(sigma), rel=0.025)
    # mean of a chi^2 of one degree: 1 +- sqrt(2 / n) = 0.01
    assert best.chi2.mean() == pytest.approx(1.0, abs=0.05)
    assert np.mean(best.chi2 > 3.8415) == pytest.approx(0.05, abs=5.0 * np.sqrt(0.05 * 0.95 / 20_000))
    assert best.depth_m.std() < midpoint.depth_m.std()
    # covariances that are 30 % too large are noticed
    wrong = combine(RIG, h, x, 1.3 * C1, y, 1.3 * C2)
    assert wrong.chi2.mean() != pytest.approx(1.0, abs=0.05)


def test_the_constraint_never_costs_information() -> None:
    down, up, D, h = some_pairs(40)
    rng, checked = generator("combine", "bounds"), 0
    for _ in range(20):
        A, B = rng.normal(0.0, 0.02, (2, 2, 2))
        C1, C2 = A @ A.T + 1e-6 * np.eye(2), B @ B.T + 1e-6 * np.eye(2)
        joint = np.sqrt(joint_bound(RIG, h, down, D, C1, C2).variance_depth_m2)
        free = depth_exact(RIG, h, down, up, C1, C2).sigma_m
        assert (joint <= free * (1.0 + 1e-9)).all()
        checked += int((joint < 0.99 * free).sum())
    assert checked > 100  # and it gains something


def test_chi2_notices_spots_that_are_not_one_point() -> None:
    down, up, _, h = some_pairs()
    C = 1e-4 * np.eye(2)
    radial = (up - RIG.camera.project(RIG.sphere_in_camera_m)) / 100.0
    across = np.stack([-radial[:, 1], radial[:, 0]], axis=-1)
    beside = up + 0.5 * across / np.linalg.norm(across, axis=1, keepdims=True)
    assert combine(RIG, h, down, C, beside, C).chi2.min() > 100.0


def test_combine_gives_a_status_for_bad_input() -> None:
    down, up, _, h = some_pairs(3)
    C = np.repeat(1e-4 * np.eye(2)[None], 3, axis=0)
    C[1] = 0.0
    up[2] = np.nan
    best = combine(RIG, h, down, C, up, C)
    assert [Status(k) for k in best.status] == [Status.OK, Status.NOT_FINITE, Status.NOT_FINITE]
    assert np.isnan(best.depth_m[1:]).all()


# -- the fit ---------------------------------------------------------------------------------------------------------


def bright(s: object = BAYER) -> Pairs:
    return drawn_pairs(s, 2.5, 0.5, 20_000.0, 100.0, 12, 3)  # type: ignore[arg-type]


@pytest.mark.parametrize("s", [MONO, BAYER], ids=lambda s: s.name)
def test_at_high_signal_the_joint_fit_is_the_combination_of_separate_fits(s: object) -> None:
    """Asymptotically equal: they differ by less than a tenth of a standard deviation at 20 000 electrons."""
    pairs = bright(s)
    joint = pairs.joint()
    one, two = pairs.separate(pairs.down), pairs.separate(pairs.up)
    both = combine(RIG, pairs.stroke_m, one.uv_px, one.covariance_px2, two.uv_px, two.covariance_px2)
    good = (joint.status == Status.OK) & (both.status == Status.OK)
    assert good.sum() >= 30
    difference = (joint.depth_m - both.depth_m)[good] / joint.sigma_m[good]
    assert np.abs(difference).max() < 0.1
    np.testing.assert_allclose(joint.sigma_m[good], both.sigma_m[good], rtol=0.02)
    # second order in the errors: a fifth of what is three sigma off
    np.testing.assert_allclose(joint.chi2[good], both.chi2[good], rtol=0.2, atol=0.1)
    # the midpoint of the separate fits is another estimator: it differs by more
    midpoint = depth_exact(RIG, pairs.stroke_m, one.uv_px, two.uv_px).depth_m
    assert np.abs((joint.depth_m - midpoint)[good] / joint.sigma_m[good]).max() > np.abs(difference).max()


def test_a_wrong_stroke_shows_in_the_depth_and_a_wrong_tilt_in_chi2() -> None:
    pairs = bright(MONO)
    right = pairs.joint()
    regions = pairs.regions(pairs.down), pairs.regions(pairs.up)
    starts = pairs.down.uv_px, pairs.up.uv_px
    stroke = fit_joint(RIG, 1.02 * pairs.stroke_m, *regions, *starts)
    tilted = replace(RIG, stroke_axis_world=(0.02, 0.0, 1.0))
    tilt = fit_joint(tilted, pairs.stroke_m, *regions, *starts)
    assert np.median(np.abs(right.depth_m / pairs.depth_m - 1.0)) < 0.005
    assert np.median(stroke.depth_m / pairs.depth_m) == pytest.approx(1.02, abs=0.005)
    assert np.nanmedian(tilt.chi2) > 10.0 * np.median(right.chi2)


def test_a_fit_does_not_depend_on_its_neighbours() -> None:
    pairs = bright()
    together = pairs.joint()
    down, up = pairs.regions(pairs.down), pairs.regions(pairs.up)
    i = np.array([7])
    alone = fit_joint(RIG, pairs.stroke_m, down.rows(i), up.rows(i), together.uv_down_px[i], together.uv_up_px[i])
    # another start: the fit stops 1e-4 standard deviations from the minimum
    assert abs(alone.depth_m[0] - together.depth_m[7]) < 1e-3 * together.sigma_m[7]


def test_bad_regions_get_nan_and_a_status() -> None:
    rng = generator("joint", "bad")
    down, up, _, h = some_pairs(3)
    origin = [np.rint(uv).astype(int) - 7 for uv in (down, up)]
    empty = rng.poisson(100.0, (2, 3, 15, 15)).astype(float)
    empty[0, 1, 4, 4] = np.nan  # one pixel is missing: it is left out
    law, blur, model = GaussLaw(PixelNoise(16.0)), SpotBlur(0.7), SpotModel(None)
    regions = [spot_data(spot_regions(x, o), law, blur, model) for x, o in zip(empty, origin, strict=True)]
    fit = fit_joint(RIG, h, regions[0], regions[1], down, up)
    assert (fit.status != Status.OK).all()
    for values in (fit.depth_m, fit.sigma_m, fit.uv_down_px, fit.covariance_up_px2, fit.chi2):
        assert np.isnan(values).all()


def test_shapes_that_do_not_go_together_are_refused() -> None:
    pairs = bright(MONO)
    down, up = pairs.regions(pairs.down), pairs.regions(pairs.up)
    with pytest.raises(ValueError, match="one of each is needed"):
        fit_joint(RIG, 0.5, down, up.rows(np.arange(3)), pairs.down.uv_px, pairs.up.uv_px)
    with pytest.raises(ValueError, match="3 x 3 pixels"):
        spot_regions(np.zeros((2, 2)), (0, 0))
