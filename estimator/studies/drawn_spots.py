"""Spots that methods find in drawn frames of a data set, with the bounds of their positions; a process per core."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from phibench.datasets.read import Dataset, open_finished
from phibench.datasets.takes import Take, takes
from phibench.estimator.bench.dataset_pairs import DatasetPairs
from phibench.estimator.methods.registry import METHODS
from phibench.estimator.seat.pair import Spot
from phibench.scenes.frames import Array

_NOWHERE = (float("nan"), float("nan"))


@dataclass(frozen=True)
class FoundSpots:
    """What was found in the draws of one sample.

    Attributes
    ----------
    sample_id : str
    uv_px : dict of method to array, shape (draws, 2, 2)
        Pixels by draw and position (down, up); NaN where a method has none.
    bounds_px2 : shape (2, 2, 2)
        Bound of the covariance of (u, v) of the processed image, down and up; NaN where there is none.
    """

    sample_id: str
    uv_px: dict[str, Array]
    bounds_px2: Array


def found_spots(
    dataset: Dataset, preset: str, draws: Mapping[str, int], workers: int | None = None
) -> dict[str, FoundSpots]:
    """Positions by sample, auto exposure.

    Parameters
    ----------
    dataset : Dataset
    preset : str
    draws : dict of method to int
        How many draws of the noise each method reads; draw k is the same frame for all.
    workers : int, optional
        Processes; they change no number.
    """
    job = partial(_found, dataset.folder, preset, dict(draws))
    names = [sample.row.sample_id for sample in dataset]
    count = min(workers or os.cpu_count() or 1, len(names))
    if count <= 1:
        return dict(zip(names, map(job, names), strict=True))
    # spawned: forking a process that has threads (polars) can hang
    with ProcessPoolExecutor(count, mp_context=multiprocessing.get_context("spawn")) as pool:
        return dict(zip(names, pool.map(job, names), strict=True))


def auto_takes(dataset: Dataset, preset: str, draws: int) -> tuple[Take, ...]:
    """Takes at the exposure that the camera chooses, by sample and draw."""
    ordered = sorted(takes(dataset, preset, draws), key=lambda take: (take.sample_id, take.draw))
    return tuple(
        replace(take, number=i, request=replace(take.request, exposure="auto")) for i, take in enumerate(ordered)
    )


def _found(folder: Path, preset: str, draws: dict[str, int], sample_id: str) -> FoundSpots:
    dataset = open_finished(folder)
    taken = [take for take in auto_takes(dataset, preset, max(draws.values())) if take.sample_id == sample_id]
    pairs = DatasetPairs(dataset, tuple(replace(take, number=i) for i, take in enumerate(taken)))
    found: dict[str, list[Array]] = {name: [] for name in draws}
    for number in range(len(pairs)):
        pair = pairs.pair(number)
        for name, count in draws.items():
            if number < count:
                answer = METHODS[name](pair)
                found[name].append(np.array([_place(answer.down), _place(answer.up)]))
    truth = pairs.truth(0)
    bounds = [np.full((2, 2), np.nan) if s.bound_px2 is None else s.bound_px2 for s in (truth.down, truth.up)]
    return FoundSpots(sample_id, {name: np.stack(places) for name, places in found.items()}, np.stack(bounds))


def _place(spot: Spot) -> tuple[float, float]:
    return _NOWHERE if spot.uv_px is None else spot.uv_px
