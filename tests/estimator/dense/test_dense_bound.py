"""Bound of dense matching against the exact Fisher matrix of both images, and against a maximum-likelihood matcher.

The matcher knows nothing of the texture but that it is a cubic spline with a knot each 4 px, over the window: the
finest that the lens's blur and the pixels leave. Each draw fits it together with 1 / D, to both images at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pytest

from phibench.datasets.frames.sensor_card import sensor_card
from phibench.estimator.dense.dense_bound import EpipolarMotion, dense_bound, matching_information, motion_of
from phibench.estimator.geometry.epipolar_line import up_image
from phibench.estimator.spots.image_planes import variance_e2
from phibench.scenes.frames import Array
from phibench.scenes.room import default_rig

HALF, STEP = 10, 4.0  # px: of the window of 21 px, and of the spline's knots
LEVEL_E, CONTRAST_E = 5000.0, 300.0
CARD = sensor_card("mono-raw")
# pixel of the down image, D and h: all azimuths, far with a short stroke and near with a long one
PLACES = (
    ((880.0, 360.0), 2.0, 0.4),
    ((639.0, 560.0), 1.2, 1.0),
    ((500.0, 250.0), 3.5, 0.2),
    ((800.0, 500.0), 1.0, 1.4),
    ((760.0, 360.0), 0.9, 0.4),
    ((420.0, 420.0), 4.0, 1.0),
)


@dataclass(frozen=True)
class Patch:
    """Window around a pixel, with a texture of its own."""

    uv_px: tuple[float, float]
    depth_m: float
    stroke_m: float

    @cached_property
    def geometry(self) -> tuple[Array, Array, float]:
        """Places of the up image's pixels in the down image, from the window's middle; e; |det M|."""
        at = up_image(default_rig(), self.stroke_m, np.array(self.uv_px), np.array(1.0 / self.depth_m))
        M = at.jacobian[:, :2]
        e, density = motion_of(at.jacobian)
        corners = (HALF + 0.5) * np.array([[-1, -1], [1, -1], [-1, 1], [1, 1]]) @ M.T + at.uv_px
        (u0, v0), (u1, v1) = np.floor(corners.min(axis=0)), np.ceil(corners.max(axis=0))
        grid = np.stack(np.meshgrid(np.arange(u0, u1 + 1), np.arange(v0, v1 + 1)), axis=-1).reshape(-1, 2)
        places = (grid - at.uv_px) @ np.linalg.inv(M).T
        return places[(np.abs(places) <= HALF + 0.5).all(axis=-1)], e, float(density)

    @cached_property
    def down(self) -> Array:
        """Rows of the spline at the down image's pixels."""
        side = np.arange(-HALF, HALF + 1.0)
        return spline(np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2))

    def up(self, change_per_m: float) -> Array:
        """Rows of the spline at the up image's pixels, for a 1 / D that is wrong by so much."""
        places, e, _ = self.geometry
        return spline(places - change_per_m * e)

    @cached_property
    def texture(self) -> Array:
        """Coefficients, electrons."""
        drawn = np.random.default_rng(5).normal(size=self.down.shape[1])
        return drawn * CONTRAST_E / np.std(self.down @ drawn)

    @cached_property
    def variance_e2(self) -> float:
        """Noise of a pixel at the mean level."""
        return float(variance_e2(np.array(LEVEL_E), CARD, alike=False))

    @cached_property
    def bound_per_m(self) -> float:
        """Least sigma of 1 / D by the library."""
        _, e, density = self.geometry
        image = LEVEL_E + (self.down @ self.texture).reshape(2 * HALF + 1, -1)
        wider = np.pad(image, 4, mode="reflect", reflect_type="odd")
        motion = EpipolarMotion(np.broadcast_to(e, (*wider.shape, 2)), np.full(wider.shape, density))
        told = matching_information(wider[None], CARD, motion, 2 * HALF + 1)
        return float(1.0 / np.sqrt(told[HALF + 4, HALF + 4]))

    def fisher_per_m(self) -> float:
        """Least sigma of 1 / D by the whole Fisher matrix: 1 / D and every coefficient of the texture."""
        step = 1e-4 / float(np.linalg.norm(self.geometry[1]))
        rows = np.concatenate([self.down, self.up(0.0)])
        moved = (self.up(step) - self.up(-step)) @ self.texture / (2.0 * step)
        by_depth = np.concatenate([np.zeros(len(self.down)), moved])
        left = by_depth - rows @ np.linalg.lstsq(rows, by_depth, rcond=None)[0]
        return float(np.sqrt(self.variance_e2) / np.linalg.norm(left))

    def scatter_per_m(self, draws: int) -> float:
        """Standard deviation of the maximum-likelihood 1 / D over draws of the noise."""
        rng = np.random.default_rng(11)
        mean = np.concatenate([self.down, self.up(0.0)]) @ self.texture
        images = mean[:, None] + np.sqrt(self.variance_e2) * rng.normal(size=(len(mean), draws))
        changes = self.bound_per_m * np.linspace(-5.0, 5.0, 11)
        likelihood = np.array([self._explained(change, images) for change in changes])
        k, draw = np.clip(likelihood.argmax(axis=0), 1, len(changes) - 2), np.arange(draws)
        before, here, after = (likelihood[k + side, draw] for side in (-1, 0, 1))
        vertex = 0.5 * (before - after) / (before - 2.0 * here + after)
        return float(np.std(changes[k] + vertex * (changes[1] - changes[0])))

    def _explained(self, change_per_m: float, images: Array) -> Array:
        """Sum of squares that the best texture explains, for each draw."""
        rows = np.concatenate([self.down, self.up(change_per_m)])
        right = rows.T @ images
        square = rows.T @ rows
        square[np.diag_indices_from(square)] += 1e-7 * np.trace(square) / len(square)  # corners that no pixel tells of
        return np.asarray(np.sum(right * np.linalg.solve(square, right), axis=0))


def spline(places: Array) -> Array:
    """Rows of all cubic splines with knots each STEP over the window, at places (n, 2)."""
    count = int((2 * HALF + 1) / STEP) + 3
    x = places[..., None] / STEP - (np.arange(count) - 0.5 * (count - 1))
    a = np.abs(x)
    rows = np.where(a < 1.0, 2.0 / 3.0 - a**2 + 0.5 * a**3, np.where(a < 2.0, (2.0 - a) ** 3 / 6.0, 0.0))
    return np.asarray((rows[:, 0, :, None] * rows[:, 1, None, :]).reshape(len(places), -1))


@pytest.mark.parametrize("place", PLACES)
def test_the_bound_is_that_of_the_whole_fisher_matrix(place: tuple[tuple[float, float], float, float]) -> None:
    """At the window's border the sums over pixels and the spline share it differently: some per cent."""
    patch = Patch(*place)
    assert 0.95 < patch.fisher_per_m() / patch.bound_per_m < 1.15


@pytest.mark.parametrize("place", PLACES)
def test_a_matcher_scatters_as_the_bound_says_over_1000_draws(place: tuple[tuple[float, float], float, float]) -> None:
    """1000 draws tell a standard deviation to 2 %; printed with -s, for docs/measurements/dense.md."""
    patch = Patch(*place)
    ratio = patch.scatter_per_m(1000) / patch.bound_per_m
    print(f"{patch.uv_px} D {patch.depth_m} m h {patch.stroke_m} m: scatter {ratio:.3f} of the bound")
    assert 0.95 <= ratio <= 1.15


def test_without_texture_the_bound_is_infinite_and_grows_with_the_square_of_d() -> None:
    rig = default_rig()
    depth = np.full((720, 1280), np.nan)
    depth[350:370, 870:890] = 2.0
    flat = np.full((1, 720, 1280), LEVEL_E)
    assert np.isinf(dense_bound(rig, 0.4, CARD, flat, depth)[360, 880])
    assert np.isnan(dense_bound(rig, 0.4, CARD, flat, depth)[100, 100])
    columns = LEVEL_E + CONTRAST_E * np.sin(2.0 * np.pi * np.arange(1280) / 12.0)
    printed = np.broadcast_to(columns, (1, 720, 1280))
    near = dense_bound(rig, 0.4, CARD, printed, depth, 9)[360, 880]
    far = dense_bound(rig, 0.4, CARD, printed, 2.0 * depth, 9)[360, 880]
    # twice as far, the place hardly moves with 1 / D in another way: by the parallax of near points, some per cent
    assert far / near == pytest.approx(4.0, rel=0.15)
    full = CARD.full_well_e + printed
    assert np.isinf(dense_bound(rig, 0.4, CARD, full, depth, 9)[360, 880])
    # a mosaic's pixels tell what their own filter sees: three equal planes are as good as no filter
    mosaic = sensor_card("bayer-raw")
    same = dense_bound(rig, 0.4, mosaic, np.repeat(printed, 3, axis=0), depth, 9)[360, 880]
    assert same == pytest.approx(near, rel=0.02)
