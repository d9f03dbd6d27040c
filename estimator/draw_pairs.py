"""Pairs that are drawn from a data set, as a method sees them; their truth is in `benchmark.dataset_pairs`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from phibench.datasets.errors import DatasetError
from phibench.datasets.exposures.exposures import Take, TakenSample, takes
from phibench.datasets.frames.sensor_card import SensorCard, card_of
from phibench.datasets.frames.source import Frames, FrameSource
from phibench.datasets.read import Dataset, Sample
from phibench.estimator.interface import Box, Image, Pair


class DrawnPairs:
    """Pairs of a data set by number, as a method sees them; the layers of the last sample are kept.

    Parameters
    ----------
    dataset : Dataset
    taken : tuple of Take
        Numbered from 0.
    """

    def __init__(self, dataset: Dataset, taken: tuple[Take, ...]) -> None:
        self._dataset, self._takes = dataset, taken
        self._samples = {sample.row.sample_id: sample for sample in dataset}
        self._kept: TakenSample | None = None
        self._source: tuple[int, FrameSource] | None = None

    def __len__(self) -> int:
        return len(self._takes)

    @property
    def takes(self) -> tuple[Take, ...]:
        """What is drawn, by number; it tells the sample, so it is not for methods."""
        return self._takes

    @property
    def dataset(self) -> Dataset:
        """Where they come from."""
        return self._dataset

    def pair(self, number: int) -> Pair:
        """What a method sees; its arrays are read-only."""
        return self.pair_and_frames(number)[0]

    def pair_and_frames(self, number: int) -> tuple[Pair, Frames]:
        """What a method sees, and the frames behind it, with the camera's JPEG files."""
        take, sample, source = self.drawn_from(number)
        frames = source.frames(take.exposure_number, laser_off=take.laser_off)
        images = {name: _sealed(frame.image) for name, frame in frames.by_name.items()}
        box_down, box_up = (None, None) if take.boxes is None else tuple(map(_box, take.boxes))
        pair = Pair(
            number,
            **images,
            rig=sample.nominal_rig,
            stroke_m=sample.row.nominal_stroke_m,
            card=card_of(source.sides["down"].chain.sensor),
            box_down=box_down,
            box_up=box_up,
            beam=self._dataset.beam,
        )
        return pair, frames

    def image(self, number: int, position: str, laser: bool) -> Image:
        """One image of a pair, alone; the same bytes as in `pair`."""
        take, _, source = self.drawn_from(number)
        return source.frame(position, take.exposure_number, laser).image

    def card(self, number: int) -> SensorCard:
        """Numbers of the sensor, with the exposure that was chosen; no frame is drawn."""
        return card_of(self.drawn_from(number)[2].sides["down"].chain.sensor)

    def drawn_from(self, number: int) -> tuple[Take, TakenSample, FrameSource]:
        """What is drawn, the sample with its layers, and the source of its frames."""
        if not 0 <= number < len(self._takes):
            raise DatasetError(f"pair {number}: there are {len(self._takes)}, numbered from 0; ask for one of them")
        take = self._takes[number]
        kept = self._kept
        if kept is None or kept.row.sample_id != take.sample_id:
            kept = self._kept = TakenSample(self._samples[take.sample_id])
        if self._source is None or self._source[0] != number:
            self._source = number, kept.source(take)
        return take, kept, self._source[1]


def pairs_of(
    dataset: Dataset, samples: Sequence[Sample], preset: str, draws: int = 1, laser_off: bool = True
) -> DrawnPairs:
    """Pairs of some samples in one preset, in the order of the samples, then of the draws.

    Parameters
    ----------
    dataset : Dataset
    samples : of the data set
    preset : str
    draws : int
    laser_off : bool
        Whether frames with the laser off belong to them, whatever the recipe says.
    """
    order = {sample.row.sample_id: place for place, sample in enumerate(samples)}
    few = replace(dataset, rows=tuple(sample.row for sample in samples))
    taken = sorted(takes(few, preset, draws), key=lambda take: (order[take.sample_id], take.draw))
    numbered = (replace(take, number=number, laser_off=laser_off) for number, take in enumerate(taken))
    return DrawnPairs(few, tuple(numbered))


def _sealed(image: Image) -> Image:
    """Image that cannot be written to, nor through its base."""
    result = np.array(image)
    result.flags.writeable = False
    return result


def _box(region: Any) -> Box:
    height, width = region.shape
    return Box(region.u0_px, region.v0_px, width, height)
