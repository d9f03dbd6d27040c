"""Easy pairs: their truth by other mathematics, and that a pair is what its truth says."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from helpers.oracles import alhazen_quartic

from phibench.benchmark.isolation.easy_pairs import BOX_PX, EasyPairs
from phibench.estimator.geometry.reflection import image_of
from phibench.estimator.geometry.triangulate import depth_exact
from phibench.estimator.spots.raw_pixels import raw_electrons
from phibench.scenes.rig import Rig
from phibench.scenes.room import c310_rig

COUNT = 30


def test_mirror_images_against_alhazens_quartic() -> None:
    """Both solve the same point; 1e-9 rad of the ray is below 2e-7 px."""
    checked = 0
    for rig in (Rig(), c310_rig()):
        for number in range(10):
            place = np.array([2.0 * math.cos(number), 2.5 * math.sin(number), 0.1 + 0.15 * number])
            view = rig.at(0.1 * number)
            centre = view.sphere_centre_m
            P = alhazen_quartic(view.camera_centre_m - centre, place - centre, rig.sphere.radius_m) + centre
            expected = rig.camera.project(view.T_world_camera.inverse().points(P))
            np.testing.assert_allclose(image_of(view, place).uv_px, expected, rtol=0, atol=1e-6)
            checked += 1
    assert checked == 20


def test_a_point_that_the_mirror_does_not_show_has_no_image() -> None:
    view = Rig().at(0.0)
    assert all(math.isnan(x) for x in image_of(view, view.sphere_centre_m + [0.0, 0.0, 3.0]).uv_px)


def test_truth_closes() -> None:
    """True pixels and rig give the true depth; 1e-7 px times 0.3 m per px is 3e-8 m."""
    for number in range(COUNT):
        truth = EasyPairs().truth(number)
        depth = depth_exact(Rig(), truth.stroke_m, np.array(truth.down.uv_px), np.array(truth.up.uv_px)).depth_m
        assert float(depth) == pytest.approx(truth.depth_m, abs=1e-6)
        assert truth.down.visible
        assert not truth.down.saturated
        assert truth.down.phi_rad["normal"] < truth.down.phi_rad["ray"] < truth.down.phi_rad["incidence"]


@pytest.mark.parametrize(
    ("preset", "shape", "kind"), [("bayer-raw", (720, 1280), "u2"), ("srgb8", (720, 1280, 3), "u1")]
)
def test_images_are_what_a_pair_promises(preset: str, shape: tuple[int, ...], kind: str) -> None:
    pair = EasyPairs(preset).pair(0)
    for image in pair.images.values():
        assert image.shape == shape
        assert image.dtype == np.dtype(kind)
    assert len(pair.images) == 4
    assert pair.card.name == preset


def test_boxes_hold_their_spots_anywhere() -> None:
    offsets = []
    for number in range(COUNT):
        truth, boxes = EasyPairs().truth(number), EasyPairs().boxes(number)
        for box, spot in zip(boxes, (truth.down, truth.up), strict=True):
            assert box is not None
            offset = np.subtract(spot.uv_px, (box.u0_px, box.v0_px))
            assert (offset > 8.0).all()
            assert (offset < BOX_PX - 8.0).all()
            offsets.append(offset)
    assert np.std(offsets, axis=0).min() > 5.0  # not in the middle
    assert EasyPairs(hinted=False).boxes(0) == (None, None)


def test_noise_is_that_of_the_sensor() -> None:
    """Differences of two exposures of one camera on 60 x 60 red pixels; the variance of 3600 numbers is good to 2.4 %,
    so 12 % is 5 sigma; PRNU and DSNU drop out of it.
    """
    pair = EasyPairs().pair(3)
    assert pair.down_off is not None
    assert pair.up_off is not None
    a, b = (raw_electrons(image, pair.card)[0:120:2, 0:120:2] for image in (pair.down_off, pair.up_off))
    mean = float((a + b).mean() / 2.0)
    expected = 2.0 * (mean + pair.card.read_noise_e**2 + 1.0 / (12.0 * pair.card.dn_per_e**2))
    assert float((a - b).var()) == pytest.approx(expected, rel=0.12)
    assert float((a - b).var()) != pytest.approx(2.0 * expected, rel=0.12)


def test_frames_are_drawn_anew_and_again_the_same() -> None:
    first, again = EasyPairs().pair(1), EasyPairs().pair(1)
    np.testing.assert_array_equal(first.down, again.down)
    assert first.down_off is not None
    assert first.up_off is not None
    a, b = (image[:100, :100].astype(float) for image in (first.down_off, first.up_off))
    pattern = np.corrcoef((a - a.mean()).ravel(), (b - b.mean()).ravel())[0, 1]
    assert pattern < 0.98  # the mosaic is common, the noise is not
    other = replace(EasyPairs(), preset="mono-raw").pair(1)
    assert not np.array_equal(other.down, first.down)
