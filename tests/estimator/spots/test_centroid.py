"""The centroid on images whose answer is known: pixel-integrated Gaussians."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr

from phibench.estimator.geometry.status import Status
from phibench.estimator.spots.simple_spots import MAX_WIDTH_PX, find_spot

SHAPE = (120, 160)


def gaussian(u: float, v: float, sigma_u: float, sigma_v: float, flux: float = 5e5) -> np.ndarray:
    """Frame (3, H, W) of a spot, the Gaussian integrated over every pixel; columns are u."""
    columns, rows = (
        np.diff(ndtr((np.arange(-0.5, n) - centre) / sigma))
        for n, centre, sigma in ((SHAPE[1], u, sigma_u), (SHAPE[0], v, sigma_v))
    )
    return flux * np.array([1.0, 0.1, 0.03])[:, None, None] * rows[:, None] * columns


@pytest.mark.parametrize(("u", "v"), [(80.0, 60.0), (80.5, 59.5), (80.31, 60.87), (30.11, 97.73)])
@pytest.mark.parametrize("sigma", [(1.0, 1.0), (0.9, 2.7), (3.0, 1.5)])
def test_centroid_finds_the_position(u, v, sigma):
    spot = find_spot(gaussian(u, v, *sigma))
    assert spot.status is Status.OK
    # the centroid of box-integrated samples is off by up to exp(-2 pi^2 sigma^2) / pi: 4e-8 px at 0.9;
    # the cut at 1e-9 of the peak leaves out less than 1e-9 x 20 px
    np.testing.assert_allclose(spot.uv_px, [u, v], rtol=0, atol=1e-7)
    assert spot.flux == pytest.approx(5e5, rel=1e-8)


def test_narrow_spot_keeps_the_bias_of_its_sampling():
    """At 0.3 px the centroid itself is biased; a test that saw 0 would not test pixels."""
    spot = find_spot(gaussian(80.25, 60.0, 0.3, 0.3))
    # first harmonic of the box-integrated sampling, largest at 1/4 pixel; the second vanishes there
    assert spot.uv_px[0] - 80.25 == pytest.approx(-np.exp(-2 * np.pi**2 * 0.3**2) / np.pi, rel=1e-5)


def test_background_is_subtracted():
    off = np.random.default_rng(51).uniform(1e4, 1e5, (3, *SHAPE))
    off[:, 5, 5] = 1e7  # a lamp brighter than the spot
    on = off + gaussian(80.31, 60.87, 1.0, 1.0)
    spot = find_spot(on, off)
    assert spot.status is Status.OK
    # rounding of 1e5 (1.5e-11) over the 15 x 15 window, arm 7 px, by 5e5 of flux
    np.testing.assert_allclose(spot.uv_px, [80.31, 60.87], rtol=0, atol=1e-7)
    assert np.abs(find_spot(on).uv_px - [80.31, 60.87]).max() > 1 or find_spot(on).status is not Status.OK


def test_window_is_as_small_as_the_spot():
    u0, v0, u1, v1 = find_spot(gaussian(80.0, 60.0, 1.0, 2.0)).window
    # 1e-9 of the peak is 6.4 sigma
    assert 12 <= u1 - u0 <= 16
    assert 24 <= v1 - v0 <= 29


def test_region_selects_one_of_two_spots():
    frame = gaussian(40.2, 60.0, 1.0, 1.0) + 3 * gaussian(120.4, 60.0, 1.0, 1.0)
    np.testing.assert_allclose(find_spot(frame).uv_px, [120.4, 60.0], rtol=0, atol=1e-7)
    np.testing.assert_allclose(find_spot(frame, region=(0, 0, 80, 120)).uv_px, [40.2, 60.0], rtol=0, atol=1e-7)


@pytest.mark.parametrize(
    ("frame", "status"),
    [
        (np.zeros((3, *SHAPE)), Status.NO_SPOT),
        (-gaussian(80.0, 60.0, 1.0, 1.0), Status.NO_SPOT),
        (gaussian(1.0, 60.0, 1.0, 1.0), Status.SPOT_CUT),
        (gaussian(158.0, 60.0, 1.0, 1.0), Status.SPOT_CUT),
        (gaussian(80.0, 118.0, 1.0, 1.0), Status.SPOT_CUT),
        (np.full((3, *SHAPE), np.nan), Status.NOT_FINITE),
        (np.ones((3, 400, 400)) + np.eye(400), Status.SPOT_CUT),
    ],
)
def test_no_position_rather_than_a_wrong_one(frame, status):
    spot = find_spot(frame)
    assert spot.status is status
    assert np.isnan(spot.uv_px).all()


def test_spot_near_the_edge_that_is_whole_is_used():
    # 8 px from the edge: 6.4 sigma fit
    spot = find_spot(gaussian(8.3, 60.0, 1.0, 1.0))
    assert spot.status is Status.OK
    assert spot.uv_px[0] == pytest.approx(8.3, abs=1e-7)


def test_noise_everywhere_is_not_isolated():
    noise = np.random.default_rng(52).normal(0.0, 1.0, (3, 500, 500))
    noise[:, 250, 250] = 1e6
    spot = find_spot(noise)
    assert spot.status is Status.NOT_ISOLATED
    u0, v0, u1, v1 = spot.window
    assert MAX_WIDTH_PX < max(u1 - u0, v1 - v0) <= MAX_WIDTH_PX + 2


def test_empty_region_has_no_spot():
    assert find_spot(gaussian(80, 60, 1, 1), region=(5, 5, 5, 9)).status is Status.NO_SPOT
