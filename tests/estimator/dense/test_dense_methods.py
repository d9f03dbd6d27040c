"""Dense methods in a square room whose D is known without the renderer; maps against the exact projection."""

import sys
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from helpers.revolved_rigs import revolved
from helpers.textured_rooms import TILTED, TexturedRoom, small_rig

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.frames.sensor_card import sensor_card
from phibench.estimator.dense.dense_interface import DenseAnswer, DensePair
from phibench.estimator.dense.dense_methods import DENSE_METHODS
from phibench.estimator.dense.panorama_matchers import (
    dense_flow,
    dense_sgbm,
    dense_sgbm_exact,
    dense_sift,
)
from phibench.estimator.dense.sweep import dense_stroke, dense_sweep, hidden_points
from phibench.estimator.dense.unrolled_pair import luma_codes, maps_of
from phibench.estimator.geometry.epipolar_line import up_image
from phibench.estimator.geometry.reflection import image_of
from phibench.scenes.frames import Array

WIDTH_PX = 320  # a third of the default's, as the small rig's pixels
STROKE_M = 0.4


@cache
def room(tilted: bool) -> tuple[DensePair, Array]:
    return TexturedRoom().pair(small_rig(TILTED) if tilted else small_rig(), STROKE_M)


def errors(answer: DenseAnswer, depth_m: Array) -> Array:
    """Relative errors of the answers."""
    assert answer.depth_m is not None
    known = answer.answered & np.isfinite(depth_m)
    return np.asarray((answer.depth_m / depth_m - 1.0)[known])


@pytest.mark.parametrize("shape", ["sphere", "tilted", "hyperboloid"])
def test_maps_are_the_exact_projection(shape: str) -> None:
    rig = revolved("hyperboloid") if shape == "hyperboloid" else small_rig(TILTED if shape == "tilted" else None)
    maps = maps_of(rig, 1.4, 96)
    rng = np.random.default_rng(3)
    i, j = rng.integers(0, maps.grid.height_px, 60), rng.integers(0, 96, 60)
    depth = 1.0 / rng.uniform(0.05, 2.5, 60)
    view = rig.at(0.0)
    down = image_of(view, view.sphere_centre_m + 1e9 * maps.grid.directions()[i, j]).uv_px
    np.testing.assert_allclose(maps.down_px[i, j], down, atol=1e-3)
    planes = np.full((maps.grid.height_px, 96), 0.5)
    planes[i, j] = 1.0 / depth
    exact = up_image(rig, 1.4, down, planes[i, j]).uv_px
    np.testing.assert_allclose(maps.up_px_of(planes)[i, j], exact, atol=1e-3)
    np.testing.assert_allclose(maps.up_px(1.3)[i, j], up_image(rig, 1.4, down, np.full(60, 1.3)).uv_px, atol=1e-3)


def test_maps_of_a_moving_carriage_have_each_row_at_its_own_height() -> None:
    """The carriage rises by 10 mm from the first row to the last: places that are solved row by row are 0.13 px off."""
    rig, rise_m = small_rig(TILTED), 0.01
    maps, height = maps_of(rig, STROKE_M, 96), rig.camera.height_px
    down = maps.down_px.reshape(-1, 2)[::97]
    inverse = np.random.default_rng(4).uniform(0.05, 2.0, maps.down_px.shape[:2])
    still = up_image(rig, STROKE_M, down, inverse.reshape(-1)[::97]).uv_px
    exact = still
    for _ in range(6):
        heights = STROKE_M + rise_m / height * (exact[:, 1] - 0.5 * (height - 1))
        rows = zip(heights, down, inverse.reshape(-1)[::97], strict=True)
        exact = np.concatenate([up_image(rig, float(h), uv[None], np.array([q])).uv_px for h, uv, q in rows])
    found = replace(maps, row_m=rise_m / height).up_px_of(inverse).reshape(-1, 2)[::97]
    np.testing.assert_allclose(found, exact, atol=1e-3)
    assert np.abs(exact - still).max() > 0.1


@pytest.mark.slow
@pytest.mark.parametrize("tilted", [False, True])
def test_the_sweep_finds_the_room(tilted: bool) -> None:
    """The small rig's pixel is 23 mrad: at 2.5 m, and a stroke of 0.4 m, one of disparity is 0.14 of D.

    The print has 12 codes rms and waves of 0.6 m: 4 codes a pixel along the elevation. With 1.5 codes of noise in a
    difference, the smallest window, of 60 image pixels, tells 0.05 px: 0.67 % of D, a median of 0.45 %. Corners of the
    room, which no plane describes, add to that: 0.51 % was measured. The limit of 0.7 % is not derived: it was set
    after that measurement, and guards against what makes it worse by a third.
    """
    pair, depth = room(tilted)
    answer = dense_sweep(pair, WIDTH_PX)
    error = errors(answer, depth)
    assert answer.answered.sum() > 0.5 * np.isfinite(depth).sum()
    assert np.median(np.abs(error)) < 0.007
    assert abs(np.median(error)) < 0.002
    assert answer.sigma_depth_m is not None


def test_a_stroke_without_images_between_is_the_sweep() -> None:
    pair, _ = room(True)
    two, whole = dense_sweep(pair, WIDTH_PX), dense_stroke(pair, WIDTH_PX)
    assert np.array_equal(two.depth_m, whole.depth_m, equal_nan=True)
    assert np.array_equal(two.sigma_depth_m, whole.sigma_depth_m, equal_nan=True)


def test_images_between_tell_one_stripe_from_the_next() -> None:
    """Stripes of 0.4 m repeat along each wall: over 1 m of stroke several D fit two images, and one fits all four."""
    pair, depth = TexturedRoom(stripes_m=0.4, contrast=25.0).pair(small_rig(), 1.0, between_m=(0.25, 0.5))
    wrong = {}
    for method in (dense_sweep, dense_stroke):
        error = errors(method(pair, WIDTH_PX), depth)
        assert len(error) > 0.2 * np.isfinite(depth).sum()
        wrong[method.__name__] = float(np.mean(np.abs(error) > 0.2))
    print(wrong)
    assert wrong["dense_stroke"] < 0.5 * wrong["dense_sweep"]


def test_flow_and_features_use_the_rays_of_a_tilted_rig() -> None:
    """A tenth of a pixel is 1.4 % of D. Flow smooths what turns with the elevation: it is wrong by 0.2 px here.

    Its limit of 4 % is not derived: 3.0 % was measured before it was set.
    """
    pair, depth = room(True)
    for method, share, median in ((dense_flow, 0.3, 0.04), (dense_sift, 1e-3, 0.02)):
        answer = method(pair, WIDTH_PX)
        assert answer.answered.sum() > share * np.isfinite(depth).sum(), method.__name__
        assert np.median(np.abs(errors(answer, depth))) < median, method.__name__


def test_the_central_model_costs_what_perfect_matches_say() -> None:
    """Both read the same disparities: they differ by what eq. (5) is wrong, 0.2 to 2 % here."""
    pair, _ = room(False)
    central, exact = dense_sgbm(pair, WIDTH_PX), dense_sgbm_exact(pair, WIDTH_PX)
    assert central.depth_m is not None
    assert exact.depth_m is not None
    apart = np.abs(central.depth_m / exact.depth_m - 1.0)
    assert 0.002 < np.nanmedian(apart) < 0.02
    assert np.nanmean(np.isfinite(apart)) > 0.3 * np.mean(exact.answered)


def test_an_image_without_texture_gets_no_answer_or_a_large_sigma() -> None:
    pair = TexturedRoom(contrast=0.0).pair(small_rig(), STROKE_M)[0]
    answer = dense_sweep(pair, WIDTH_PX)
    assert answer.depth_m is not None
    assert answer.sigma_depth_m is not None
    assert answer.answered.mean() < 0.05
    assert dense_sift(pair, WIDTH_PX).answered.sum() == 0


def test_a_point_behind_another_is_hidden() -> None:
    """A near patch moves down over what lies below it; nothing else is hidden."""
    maps = maps_of(small_rig(), STROKE_M, WIDTH_PX)
    inverse = np.full((maps.grid.height_px, WIDTH_PX), 0.2)
    inverse[50:60, 100:120] = 1.0
    mask = hidden_points(maps, inverse)
    rows, columns = np.nonzero(mask)
    assert 100 <= columns.min()
    assert columns.max() < 120
    assert rows.min() > 59
    # 10 rows move by the angle that 0.4 m are at 1 m, less the angle at 5 m
    assert 150 <= mask.sum() <= 250


def test_codes_are_the_same_from_raw_and_processed_images() -> None:
    """A grey of half the linear range has the code that sRGB gives it."""
    raw, coded = sensor_card("mono-raw"), sensor_card("srgb8")
    half = np.full((4, 4), raw.black_level_dn + 0.5 * (raw.top_dn - raw.black_level_dn))
    assert luma_codes(half, raw)[0, 0] == pytest.approx(187.5, abs=0.1)
    assert luma_codes(np.full((4, 4, 3), 187, np.uint8), coded)[0, 0] == pytest.approx(187.0, abs=1e-3)
    with pytest.raises(DatasetError, match="dense methods take bayer-raw"):
        luma_codes(half, replace(raw, output="electrons"))


def test_a_method_says_what_it_lacks(monkeypatch: pytest.MonkeyPatch) -> None:
    pair, _ = room(False)
    assert {method.refusal(pair) for method in DENSE_METHODS.values()} == {""}
    with pytest.raises(DatasetError, match="does not show all elevations"):
        dense_sgbm(replace(pair, rig=revolved("cone")), WIDTH_PX)
    monkeypatch.setitem(sys.modules, "cv2", None)
    for method in DENSE_METHODS.values():
        with pytest.raises(DatasetError, match=r"needs OpenCV: pip install 'phibench\[dense\]'"):
            method(pair)
