"""Simple extractors on noise-free regions: what each is worth, and what it says when there is no spot."""

from __future__ import annotations

import numpy as np
import pytest
import scipy

from phibench.estimator.geometry.status import Status
from phibench.estimator.spots.simple_spots import LUMA, SIMPLE_METHODS, gaussian_least_squares, luma, windowed_centroid
from phibench.scenes.random_streams import generator

ORIGIN = np.array([300, 150])
# largest error on a round, pixel-integrated Gaussian of 0.9 px, mono, px: half a pixel; bias of the threshold; of the
# parabola; stop of the iteration; none but that of sampling at 0.9 px
WORST_PX = {
    "brightest_pixel": 0.5,
    "thresholded_centroid": 0.05,
    "laplacian_blob": 0.06,
    "windowed_centroid": 1e-4,
    "gaussian_least_squares": 1e-4,
}


def regions(sigma_px: float = 0.9, count: int = 200) -> tuple[np.ndarray, np.ndarray]:
    """Regions of 13 columns and 11 rows, and where their spots are in the image."""
    uv = np.array([6.0, 5.0]) + generator("simple spots").uniform(-0.5, 0.5, (count, 2))
    across, down = (
        np.diff(scipy.stats.norm.cdf(np.arange(m + 1) - 0.5, uv[:, i, None], sigma_px), axis=1)
        for i, m in ((0, 13), (1, 11))
    )
    return 4000.0 * down[:, :, None] * across[:, None, :] + 50.0, uv + ORIGIN


@pytest.mark.parametrize("name", SIMPLE_METHODS)
def test_accuracy_of_simple_methods_on_perfect_regions(name: str) -> None:
    images, uv = regions()
    found = SIMPLE_METHODS[name](images, ORIGIN)
    worst = np.abs(found.uv_px - uv).max()
    print(f"{name}: largest error {1e3 * worst:.3f} mpx, rms {1e3 * np.sqrt(np.mean((found.uv_px - uv) ** 2)):.3f} mpx")
    assert (found.status == Status.OK).all()
    assert worst < WORST_PX[name]
    assert np.abs(found.uv_px - uv - 0.5).max() > 0.2  # half a pixel off would be seen


def test_rms_of_the_brightest_pixel_is_that_of_rounding() -> None:
    """1 / sqrt(12) = 0.289 px; 2000 uniform numbers give it to 1.5 %."""
    images, uv = regions(count=1000)
    errors = SIMPLE_METHODS["brightest_pixel"](images, ORIGIN).uv_px - uv
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(12**-0.5, rel=0.06)


def test_point_sampled_gaussians_are_biased_below_half_a_pixel() -> None:
    images, uv = regions(0.3)
    bias = np.sqrt(np.mean((gaussian_least_squares(images, ORIGIN).uv_px - uv) ** 2))
    print(f"point-sampled Gaussian at a blur of 0.3 px: {1e3 * bias:.1f} mpx rms")
    assert 0.005 < bias < 0.1


@pytest.mark.parametrize("name", SIMPLE_METHODS)
def test_bad_regions_get_nan_and_a_status(name: str) -> None:
    images, _ = regions(count=4)
    images[1, 4, 4], images[2] = np.nan, 7.0
    found = SIMPLE_METHODS[name](images, np.tile(ORIGIN, (4, 1)))
    assert [Status(k) for k in found.status] == [Status.OK, Status.NOT_FINITE, Status.NO_SPOT, Status.OK]
    assert np.isnan(found.uv_px[1:3]).all()
    alone = SIMPLE_METHODS[name](images[3:], ORIGIN)  # neighbours do not matter
    np.testing.assert_allclose(found.uv_px[3:], alone.uv_px, rtol=0, atol=1e-12)


def test_colour_images_count_by_their_luma() -> None:
    images, _ = regions(count=5)
    colour = images[..., None] * np.array([1.0, 0.1, 0.03])
    assert sum(LUMA) == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose(luma(colour), images * (np.array(LUMA) @ [1.0, 0.1, 0.03]), rtol=1e-12)
    # the position of the spot does not depend on a common factor
    np.testing.assert_allclose(windowed_centroid(colour).uv_px, windowed_centroid(images).uv_px, rtol=0, atol=1e-9)
    with pytest.raises(ValueError, match=r"\(n, h, w\) or \(n, h, w, 3\)"):
        luma(images[0])
