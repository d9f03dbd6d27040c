"""Blur and filters fitted to spots of a rig that says others."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from phibench.calibration.captures.spot_shape import (
    UNLIKE,
    SpotPicture,
    SpotShape,
    fit_shape,
    seen_through,
    spot_pictures,
)
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.read import Sample, open_dataset
from phibench.estimator.drawn_pairs import pairs_of
from phibench.estimator.interface import Pair, Spot
from phibench.scenes.rig import Rig

WRONG = np.array([0.95, 0.16, 0.06])  # 0.70 px, 0.10 and 0.03 are true: off by one sigma of the prior each


@pytest.fixture(scope="module")
def sample(tiny_dataset: Path) -> Sample:
    return next(s for s in open_dataset(tiny_dataset) if s.row.down.visible and s.row.up.visible)


def true_shape(rig: Rig) -> np.ndarray:
    return np.array([rig.camera.blur_sigma_px, *rig.camera.detector.laser_filter_response[1:]])


def drawn(folder: Path, sample: Sample, preset: str, draws: int) -> list[SpotPicture]:
    """Pictures with a rig that says `WRONG`."""
    rig = SpotShape(WRONG, np.eye(3)).rig(sample.rig)
    places = [Spot((side.u_px, side.v_px)) for side in (sample.row.down, sample.row.up)]
    pairs = pairs_of(open_dataset(folder), [sample], preset, draws)
    ready: list[Pair] = [replace(pairs.pair(k), rig=rig) for k in range(draws)]
    return [image for pair in ready for image in spot_pictures(pair, *places).values()]


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["bayer-raw", "srgb8", "mjpeg"])
def test_spots_say_their_blur_and_colour(tiny_dataset: Path, sample: Sample, preset: str) -> None:
    images = drawn(tiny_dataset, sample, preset, 2)
    prior, truth = SpotShape.prior(images[0].pair.rig), true_shape(sample.rig)
    assert np.allclose(prior.values, WRONG)
    found = fit_shape(images, prior)
    assert found.images == 4
    # 4 sigma: by chance in 2e-4 of all cases, for three numbers
    assert (np.abs(found.values - truth) < 4.0 * found.sigmas).all()
    # two bright pairs know the blur better than a person who never measured it
    assert found.sigmas[0] < 0.5 * prior.sigmas[0]
    assert abs(found.values[0] - truth[0]) < 0.4 * abs(WRONG[0] - truth[0])
    assert np.allclose(true_shape(found.rig(sample.rig)), found.values)


def test_an_uncertain_shape_widens_the_place(tiny_dataset: Path, sample: Sample) -> None:
    image = drawn(tiny_dataset, sample, "bayer-raw", 1)[0]
    prior = SpotShape.prior(image.pair.rig)
    wide, _ = seen_through(image, prior)
    half, _ = seen_through(image, replace(prior, covariance=prior.covariance / 4.0))
    assert np.linalg.eigvalsh(wide).min() >= -1e-15
    assert np.trace(wide) > 0.0
    assert np.allclose(half, wide / 4.0)


def test_a_light_in_two_parts_is_no_spot(tiny_dataset: Path, sample: Sample) -> None:
    image = drawn(tiny_dataset, sample, "bayer-raw", 1)[0]
    shape = SpotShape(true_shape(sample.rig), np.diag([0.02, 0.01, 0.01]) ** 2)
    on, off = (image.pair.images[name].astype(float) for name in ("down", "down_off"))
    light = on - off
    torn = off + 0.5 * light + 0.5 * np.roll(light, 4, axis=1)  # an even shift keeps the mosaic
    other = replace(image, pair=replace(image.pair, down=np.rint(torn).astype(np.uint16)))
    # half of the light is not where one spot has it; blur and room are as the model says in the whole one
    assert seen_through(image, shape)[1] < 0.2 < UNLIKE < seen_through(other, shape)[1]


def test_full_pixels_leave_the_shape_uncertain(tiny_dataset: Path, sample: Sample) -> None:
    image = drawn(tiny_dataset, sample, "bayer-raw", 1)[0]
    on = image.pair.images["down"].copy()
    v, u = np.unravel_index(np.argmax(on), on.shape)
    on[v, u] = image.pair.card.top_dn
    full = replace(image, pair=replace(image.pair, down=on))
    prior = SpotShape.prior(image.pair.rig)
    assert np.trace(seen_through(full, prior)[0]) > 0.5 * np.trace(seen_through(image, prior)[0])


def test_without_a_spot_the_prior_stands(sample: Sample) -> None:
    prior = SpotShape.prior(sample.rig)
    assert fit_shape([], prior) is prior


def test_a_document_holds_a_shape_and_nothing_else() -> None:
    shape = SpotShape(np.array([0.8, 0.12, 0.04]), np.diag([0.02, 0.01, 0.01]) ** 2, 8)
    again = SpotShape.of_document(shape.document())
    assert np.array_equal(again.values, shape.values)
    assert np.array_equal(again.covariance, shape.covariance)
    assert again.images == 8
    for wrong in (None, {}, {"values": [1, 2], "covariance": [[1]]}, {**shape.document(), "values": [99.0, 0.1, 0.1]}):
        with pytest.raises(DatasetError, match="make it again"):
            SpotShape.of_document(wrong)


def test_a_faint_light_beside_an_edge_in_jpeg_is_not_judged(tiny_dataset: Path, sample: Sample) -> None:
    image = drawn(tiny_dataset, sample, "mjpeg", 1)[0]
    shape = SpotShape(true_shape(sample.rig), np.diag([0.02, 0.01, 0.01]) ** 2)
    on, off = (image.pair.images[name].astype(float) for name in ("down", "down_off"))
    edge = np.zeros_like(on)
    edge[:, int(image.uv_px[0]) + 6 :] = 8.0  # codes of an edge beside the spot that the off frame's steps have hidden
    codes = np.clip(np.rint(off + 0.3 * (on - off) + edge), 0.0, 255.0).astype(np.uint8)
    # it leaves more than twice the light of the spot unexplained, and is none of it
    assert seen_through(replace(image, pair=replace(image.pair, down=codes)), shape)[1] == 0.0
