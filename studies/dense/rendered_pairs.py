"""Rendered pairs: bound of D by stroke over a room's texture; near space and free floor that methods get right.

The bound takes the down image's texture, exposure and noise, and any stroke: only the up image changes with that. So
one rendered room tells of all strokes. It is asked in the middle of each cell of 3 x 3 pixels, whose motion stands for
that of the cell: a window has one D in any case. Answers are those of a pair's own stroke.

Two shares tell what is right. A pixel of the near space, which ends at a given D, is right if it is answered and its D
is off by no more than a given length; a pixel that the up image does not show counts as well. The free floor ends in
each sector of two degrees at the nearest thing in a robot's way, or where the near space ends. A sector is right if
that radius is off by no more than the same length, and counts by its area.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from phibench.benchmark.dense.dense_pairs import DensePairs, DenseTruth
from phibench.benchmark.dense.dense_pictures import OBSTACLE_M, free_space
from phibench.benchmark.dense.dense_records import central_depths, depths_of
from phibench.datasets.frames.sensor_card import SensorCard
from phibench.estimator.dense.dense_bound import (
    BOUND_WINDOW_PX,
    EpipolarMotion,
    matching_information,
    motion_of,
    sigma_of,
)
from phibench.estimator.dense.dense_interface import DensePair
from phibench.estimator.dense.dense_methods import DENSE_METHODS
from phibench.estimator.geometry.epipolar_line import range_at, up_image
from phibench.estimator.geometry.reflection import room_rays
from phibench.render.optics.correspondence import Correspondence, correspondence
from phibench.render.optics.faces import IntArray
from phibench.scenes.frames import Array, BoolArray
from phibench.scenes.rig import Rig
from phibench.studies.dense.perfect_matches import coarser_rig

METHODS = ("dense_sweep", "dense_sgbm")
PERFECT = "perfect matches, central model"
ANSWERS = (*METHODS, PERFECT)
_STEP_PX = 2  # of the lattice
CELL_PX = 3  # odd: the middle of a cell is a pixel's centre


@dataclass(frozen=True)
class NearLimits:
    """Near space: pixels of the room below a D, and the largest error of D that is right."""

    near_m: float
    right_m: float

    def pixels(self, found: Correspondence) -> BoolArray:
        """Mask of the near space, shape (H, W)."""
        with np.errstate(invalid="ignore"):
            return np.asarray(found.of_room & (found.depth_m < self.near_m))

    def share(self, found: Correspondence, error_m: Array) -> float:
        """Share of the near space with an error (or a sigma) small enough; NaN without any near space."""
        near = self.pixels(found)
        with np.errstate(invalid="ignore"):
            return float(np.mean(np.abs(error_m[near]) <= self.right_m)) if near.any() else np.nan


@dataclass(frozen=True)
class FreeFloor:
    """Rays of a lattice of the room's pixels, which see where the floor is free.

    Parameters
    ----------
    index : array of int
        Numbers of the pixels, row by row.
    origin_m, direction : arrays, shape (n, 3)
        Rays from the mirror, from the sphere's centre.
    centre_m : float
        Height of that centre above the floor.
    true_m : array
        True radius of the free floor in each sector; NaN where no ray tells.
    """

    index: IntArray
    origin_m: Array
    direction: Array
    centre_m: float
    near: NearLimits
    true_m: Array = field(default_factory=lambda: np.empty(0))

    @classmethod
    def of(cls, truth: DenseTruth, near: NearLimits) -> FreeFloor:
        """Floor of a pair's room."""
        view, lattice = truth.given_rig.at(0.0), np.zeros(truth.depth_m.shape, bool)
        lattice[::_STEP_PX, ::_STEP_PX] = True
        index = np.flatnonzero(lattice & truth.found.of_room)
        v, u = np.divmod(index, truth.true_rig.camera.width_px)
        rays = room_rays(view, np.stack([u, v], axis=-1).astype(float))
        centre = view.sphere_centre_m
        floor = cls(index, rays.origin_world_m - centre, rays.direction_world, float(centre[2]), near)
        return replace(floor, true_m=floor.radii_m(truth.depth_m))

    def radii_m(self, depth_m: Array) -> Array:
        """Radius of the free floor in each sector by a plane of D."""
        depth = depth_m.reshape(-1)[self.index]
        known = np.isfinite(depth)
        origin, direction = self.origin_m[known], self.direction[known]
        points = origin + range_at(origin, direction, depth[known])[:, None] * direction
        height = points[:, 2] + self.centre_m
        in_the_way = (height > OBSTACLE_M[0]) & (height < OBSTACLE_M[1])
        return np.minimum(free_space(points[in_the_way, :2]), self.near.near_m)

    def share(self, depth_m: Array) -> float:
        """Share of the free floor's area in sectors that are right."""
        told = np.isfinite(self.true_m)
        area = self.true_m[told] ** 2
        with np.errstate(invalid="ignore"):
            right = np.abs(self.radii_m(depth_m)[told] - self.true_m[told]) <= self.near.right_m
        return float(area[right].sum() / area.sum()) if told.any() else np.nan


@dataclass(frozen=True)
class BoundAtStroke:
    """Bound of a room's pixels at one stroke.

    Attributes
    ----------
    twice : float
        Share of the room's pixels that both images show.
    median, p90 : float
        Of sigma_D / D over these.
    over_all : float
        Median over all pixels of the room, those that the up image does not show with an infinite sigma.
    near : float
        Share of the near space with a sigma small enough.
    """

    stroke_m: float
    twice: float
    median: float
    p90: float
    over_all: float
    near: float


@dataclass(frozen=True)
class MethodOutcome:
    """Share answered, median relative error of the answers, shares of the near space and the free floor right."""

    answered: float
    median: float
    near: float
    floor: float


@dataclass(frozen=True)
class RenderedRoom:
    """All that is asked of one rendered pair."""

    sample_id: str
    room: str
    stroke_m: float
    bounds: tuple[BoundAtStroke, ...]
    outcomes: Mapping[str, MethodOutcome]


def rendered_room(pairs: DensePairs, strokes_m: Sequence[float], near: NearLimits, number: int) -> RenderedRoom:
    """Bounds and answers of one pair."""
    pair, truth = pairs.pair(number), pairs.truth(number)
    sample = pairs.dataset[truth.sample_id]
    planes_e = sample.ambient("down").astype(float) * pair.card.exposure_s
    coarse, bounds = coarser_rig(truth.true_rig, CELL_PX), []
    for stroke_m in strokes_m:
        found = correspondence(sample.room, coarse.at(0.0), coarse.at(stroke_m))
        sigma = cell_bound(truth.true_rig, stroke_m, pair.card, planes_e, found)
        bounds.append(bound_at(stroke_m, found, sigma, near))
    answers = {name: _depths(name, pair, truth) for name in ANSWERS}
    floor = FreeFloor.of(truth, near)
    outcomes = {name: outcome(depth, truth, near, floor) for name, depth in answers.items()}
    return RenderedRoom(truth.sample_id, truth.room, truth.stroke_m, tuple(bounds), outcomes)


def cell_bound(rig: Rig, stroke_m: float, card: SensorCard, planes_e: Array, found: Correspondence) -> Array:
    """Least sigma of D in the cells' middles, shape as `found`'s, which has a pixel for each cell."""
    px_m, density = np.full((*found.seen.shape, 2), np.nan), np.full(found.seen.shape, np.nan)
    v, u = np.nonzero(found.seen)
    middles = np.stack([u, v], axis=-1).astype(float) * CELL_PX + CELL_PX // 2
    jacobian = up_image(rig, stroke_m, middles, 1.0 / found.depth_m[found.seen]).jacobian
    px_m[found.seen], density[found.seen] = motion_of(jacobian)
    height, width = planes_e.shape[1:]
    motion = EpipolarMotion(
        *(plane.repeat(CELL_PX, 0).repeat(CELL_PX, 1)[:height, :width] for plane in (px_m, density))
    )
    told = matching_information(planes_e, card, motion, BOUND_WINDOW_PX)[
        CELL_PX // 2 :: CELL_PX, CELL_PX // 2 :: CELL_PX
    ]
    return np.where(found.seen, sigma_of(told, found.depth_m), np.nan)


def bound_at(stroke_m: float, found: Correspondence, sigma_m: Array, near: NearLimits) -> BoundAtStroke:
    """Statistics of a map of sigma of D, which is NaN where the up image does not show the point."""
    relative = sigma_m[found.seen] / found.depth_m[found.seen]
    whole = np.concatenate([relative, np.full(int(found.of_room.sum()) - len(relative), np.inf)])
    median, p90 = (float(np.quantile(relative, share, method="inverted_cdf")) for share in (0.5, 0.9))
    over_all = float(np.quantile(whole, 0.5, method="inverted_cdf"))
    return BoundAtStroke(stroke_m, len(relative) / len(whole), median, p90, over_all, near.share(found, sigma_m))


def outcome(depth_m: Array, truth: DenseTruth, near: NearLimits, floor: FreeFloor) -> MethodOutcome:
    """Numbers of an answer's D, NaN where there is none."""
    error = np.abs(depth_m / truth.depth_m - 1.0)[truth.scored]
    known = np.isfinite(error)
    median = float(np.median(error[known])) if known.any() else np.nan
    right = near.share(truth.found, depth_m - truth.depth_m)
    return MethodOutcome(float(known.mean()), median, right, floor.share(depth_m))


def _depths(name: str, pair: DensePair, truth: DenseTruth) -> Array:
    if name == PERFECT:
        return central_depths(truth.given_rig, truth.given_stroke_m, truth.found.uv_px, truth.scored)
    return depths_of(DENSE_METHODS[name](pair), truth.given_rig, truth.given_stroke_m)
