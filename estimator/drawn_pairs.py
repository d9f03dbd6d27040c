"""Pairs of a data set as a method sees them, drawn with sensor noise: a set (`DrawnPairs`), a few (`pairs_of`).

A pair is simulated when it is asked for: the same bytes every time. Its truth is in `pair_sets.dataset_pairs`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.exposures.pair_draws import CachedSample, FrameCounts, PairDraw, pair_draws
from phibench.datasets.frames.frame_source import Frame, Frames, FrameSource
from phibench.datasets.frames.sensor_card import SensorCard, card_of
from phibench.datasets.read import Dataset, Sample
from phibench.estimator.interface import Box, Image, Pair


class DrawnPairs:
    """Pairs of a data set by number, as a method sees them; the layers of the last sample are kept.

    Parameters
    ----------
    pair_draws : tuple of PairDraw
        Numbered from 0.
    """

    def __init__(self, dataset: Dataset, pair_draws: tuple[PairDraw, ...]) -> None:
        self._dataset, self._pair_draws = dataset, pair_draws
        self._samples = {sample.row.sample_id: sample for sample in dataset}
        self._kept: CachedSample | None = None
        self._source: tuple[int, FrameSource] | None = None

    def __len__(self) -> int:
        return len(self._pair_draws)

    @property
    def pair_draws(self) -> tuple[PairDraw, ...]:
        """Sample and noise realisation of every pair, by number; methods must not see it."""
        return self._pair_draws

    @property
    def folders(self) -> tuple[Path, ...]:
        """Folder of the data set, with the truth."""
        return (self._dataset.folder,)

    @property
    def dataset(self) -> Dataset:
        """Data set that the pairs come from."""
        return self._dataset

    def pair(self, number: int) -> Pair:
        """Pair of images (down, up) as a method sees it; the arrays are read-only."""
        return self.pair_and_frames(number)[0]

    @contextmanager
    def named(self, number: int) -> Iterator[None]:
        """Name the sample of a pair in the message of what cannot be read."""
        try:
            yield
        except DatasetError as error:
            if not 0 <= number < len(self._pair_draws):
                raise
            raise DatasetError(f"sample '{self._pair_draws[number].sample_id}': {error}") from error

    def pair_and_frames(self, number: int) -> tuple[Pair, Frames]:
        """Pair as a method sees it, and the first frame of each image, with the camera's JPEG file."""
        with self.named(number):
            return self._pair_and_frames(number)

    def _pair_and_frames(self, number: int) -> tuple[Pair, Frames]:
        pair_draw, sample, source = self.drawn_from(number)
        frames = source.frames(pair_draw.draw, laser_off=pair_draw.laser_off)
        images = {name: _each(source, pair_draw, frame) for name, frame in frames.by_name.items()}
        box_down, box_up = (None, None) if pair_draw.boxes is None else tuple(map(_box, pair_draw.boxes))
        pair = Pair.of_frames(
            number,
            images,
            rig=sample.nominal_rig,
            stroke_m=sample.row.nominal_stroke_m,
            card=card_of(source.sides["down"].chain.sensor),
            box_down=box_down,
            box_up=box_up,
            beam=self._dataset.beam,
        )
        return pair, frames

    def image(self, number: int, position: str, laser: bool) -> Image:
        """First frame of one image of a pair, alone; the same bytes as in `pair`."""
        pair_draw, _, source = self.drawn_from(number)
        return source.frame(position, pair_draw.draw, laser).image

    def card(self, number: int) -> SensorCard:
        """Numbers of the sensor, with the exposure that was chosen; no frame is simulated."""
        return card_of(self.drawn_from(number)[2].sides["down"].chain.sensor)

    def drawn_from(self, number: int) -> tuple[PairDraw, CachedSample, FrameSource]:
        """Description of a pair, its sample with the layers, and the source of its frames."""
        if not 0 <= number < len(self._pair_draws):
            raise DatasetError(
                f"pair {number}: there are {len(self._pair_draws)}, numbered from 0; ask for one of them"
            )
        pair_draw = self._pair_draws[number]
        kept = self._kept
        if kept is None or kept.row.sample_id != pair_draw.sample_id:
            kept = self._kept = CachedSample.of(self._samples[pair_draw.sample_id])
        if self._source is None or self._source[0] != number:
            self._source = number, kept.source(pair_draw)
        return pair_draw, kept, self._source[1]


def pairs_of(
    dataset: Dataset,
    samples: Sequence[Sample],
    preset: str,
    draws: int = 1,
    laser_off: bool = True,
    frames: FrameCounts | None = None,
) -> DrawnPairs:
    """Pairs of some samples in one preset, in the order of the samples, then of the noise realisations.

    Parameters
    ----------
    samples : of the data set
    draws : int
        Noise realisations of each sample.
    laser_off : bool
        Whether frames with the laser off belong to them, whatever the recipe says.
    frames : FrameCounts, optional
        Of each position; one of each by default.
    """
    order = {sample.row.sample_id: place for place, sample in enumerate(samples)}
    few = replace(dataset, rows=tuple(sample.row for sample in samples))
    chosen = sorted(pair_draws(few, preset, draws), key=lambda pair_draw: (order[pair_draw.sample_id], pair_draw.draw))
    counts = (1, 1) if frames is None else (frames.on, frames.off)
    numbered = (replace(draw, number=k, laser_off=laser_off, frames=counts) for k, draw in enumerate(chosen))
    return DrawnPairs(few, tuple(numbered))


def _each(source: FrameSource, pair_draw: PairDraw, first: Frame) -> list[Image]:
    """Frames of one image."""
    others = range(1, pair_draw.frames[0 if first.laser else 1])
    images = [first.image, *(source.frame(first.position, first.draw, first.laser, k).image for k in others)]
    return [_sealed(image) for image in images]


def _sealed(image: Image) -> Image:
    """Image that cannot be written to, nor through its base."""
    result = np.array(image)
    result.flags.writeable = False
    return result


def _box(region: Any) -> Box:
    height, width = region.shape
    return Box(region.u0_px, region.v0_px, width, height)
