"""Spots that are made of parts: their images against sums of Gaussians, and their prediction against spot layers."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.mirror_fits import BEAM, places, rig_of

from phibench.estimator.spots.gaussian_spot import SpotBlur, SpotParts, spot_images
from phibench.estimator.spots.spot_prediction import spot_blur
from phibench.scenes.rig import Rig


def test_images_of_parts_are_sums_of_their_images() -> None:
    """Products of matrices against one part after the other: to rounding."""
    rng, m, k, shape = np.random.default_rng(0), 4, 7, (14, 17)
    offset, weight = rng.normal(0.0, 1.5, (m, k, 2)), rng.random((m, k))
    one = SpotBlur(rng.uniform(0.6, 0.9, m), rng.uniform(0.9, 1.1, m), rng.uniform(-0.05, 0.05, m))
    place, flux = rng.uniform(6.0, 9.0, (m, 2)), rng.uniform(100.0, 1000.0, m)
    whole = SpotBlur(np.full(m, 2.0), np.ones(m), np.zeros(m), SpotParts(offset, weight, one))
    expected = sum(
        weight[:, i, None, None, None] * spot_images(place + offset[:, i], flux, one, shape) for i in range(k)
    )
    found = spot_images(place, flux, whole, shape)
    assert found == pytest.approx(expected, abs=1e-13 * np.abs(expected).max())
    some = whole.rows(np.array([2, 0]))
    assert spot_images(place[[2, 0]], flux[[2, 0]], some, shape) == pytest.approx(found[[2, 0]])
    assert spot_images(place, flux, whole, shape, by_width=True).shape == (m, 4, *shape)  # a free width knows no parts


@pytest.mark.parametrize(("shape", "least", "most"), [("hyperboloid", 0.003, 0.001), ("cone", 0.08, 0.008)])
def test_the_predicted_image_is_the_layers(shape: str, least: float, most: float) -> None:
    """Centroids of layers lie beside the chief ray's place by more than `least`, and from the predicted one by `most`.

    Where no noise is, a fit is as wrong as that. Pixels of the images differ by less than 3 % of the brightest.
    """
    beside, error = [], []
    for place in places(shape, 3):
        layer, parts = place.layer, place.blur.parts
        assert parts is not None
        middle = place.uv_px + parts.weight @ parts.offset_px
        beside.append(np.linalg.norm(layer.centroid_uv_px - place.uv_px))
        error.append(np.linalg.norm(layer.centroid_uv_px - middle))
        at = (place.uv_px - [layer.u0_px, layer.v0_px])[None]
        image = spot_images(at, np.ones(1), place.blur.each(1), layer.electrons_per_s.shape[1:])[0, 2]
        assert np.abs(image - layer.electrons_per_s[0]).max() < 0.03 * image.max()
    assert max(beside) > least
    assert max(error) < most


def test_a_spheres_spot_is_one_gaussian() -> None:
    """Its numbers stay what they were; a mirror without a depth gets its parts for a far point."""
    assert spot_blur(Rig(), (430.0, 300.0), 2.0, BEAM).parts is None
    rig = rig_of("paraboloid")
    near, far = spot_blur(rig, (430.0, 300.0), 2.0, BEAM).parts, spot_blur(rig, (430.0, 300.0)).parts
    assert near is not None
    assert far is not None
    assert np.abs(near.weight @ near.offset_px - far.weight @ far.offset_px).max() < 0.002
