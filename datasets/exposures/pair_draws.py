"""Pair draws of a benchmark (`pair_draws`): sample, preset, seed, frame counts, boxes, order; samples kept in memory.

A pair draw is one draw of the noise of one sample in one preset. It is a pure function of the data set's documents.
Its frames are those of `Sample.camera_frames`. The order is drawn, so that the number of a pair says nothing about the
scene.

`pair_draws` lists them, `CachedSample` reads a sample's layers once and makes the frame source of each.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from phibench.datasets.common.errors import DatasetError, whole_number
from phibench.datasets.exposures.search_boxes import search_boxes
from phibench.datasets.frames.distractors import Distractor, distractors, present_tables
from phibench.datasets.frames.frame_request import FrameOptions, FrameRequest, sample_stream
from phibench.datasets.frames.frame_source import FrameSource
from phibench.datasets.frames.sensor_card import presets_of
from phibench.datasets.frames.sensor_file import SensorFile
from phibench.datasets.read import Dataset, Sample
from phibench.datasets.recipe.tables import FramesTable
from phibench.datasets.store.layers import SpotWindow
from phibench.render.sensor.light import Region
from phibench.scenes.random_streams import generator
from phibench.scenes.rig import POSITIONS

_ORDER_STREAM = "takes"  # name of a random stream: another name would draw another order


@dataclass(frozen=True)
class FrameCounts:
    """Frames per position.

    Attributes
    ----------
    on, off : int, 1 or more
        With the laser, and without it.
    """

    on: int = 1
    off: int = 1

    def __post_init__(self) -> None:
        if self.on < 1 or self.off < 1:
            raise ValueError(f"{self.on} frames with the laser on and {self.off} with it off: 1 or more of each needed")


@dataclass(frozen=True)
class PairDraw:
    """One draw of the noise of one sample in one preset; its frames are drawn by `CachedSample.source`.

    Attributes
    ----------
    number : int
        Its place in the drawn order, from 0.
    draw : int
        As in `FrameSource.frames`.
    request : FrameRequest
        With exposure "auto" where the camera chooses it.
    laser_off : bool
        Whether frames with the laser off belong to it.
    boxes : (down, up) or None
        Region hints; both or none.
    distractors : tuple of int
        Tables of the recipe's `[[distractors]]` that the sample was drawn to have.
    frames : (on, off)
        Frames of each position with the laser on, and with it off where they belong to it.
    """

    number: int
    sample_id: str
    preset: str
    draw: int
    request: FrameRequest = field(repr=False)
    laser_off: bool
    boxes: tuple[Region, Region] | None
    distractors: tuple[int, ...]
    frames: tuple[int, int] = (1, 1)


def pair_draws(
    dataset: Dataset, preset: str | None = None, draws: int | None = None, sensor: SensorFile | None = None
) -> tuple[PairDraw, ...]:
    """All pair draws of a data set, by number.

    Parameters
    ----------
    preset : str, optional
        This one instead of the recipe's; needed where the recipe has no `[frames]`, whose defaults then hold.
    draws : int, optional
        Draws of the noise instead of the recipe's.
    sensor : SensorFile, optional
        Its numbers go before the recipe's and the preset's; its preset is taken where none is given.

    Raises
    ------
    DatasetError
        If there is no preset, or one that gives no pixels.
    """
    frames = dataset.recipe.frames
    if preset is None and sensor is not None:
        preset = sensor.preset
    if frames is None and preset is None:
        raise DatasetError(
            f"{dataset.folder}: its recipe has no [frames] that names presets; give one, such as --preset bayer-raw"
        )
    frames = frames or FramesTable()
    presets = frames.presets if preset is None else (preset,)
    count = frames.draws if draws is None else whole_number("draws", draws, 1)
    ordered = [pair_draw for sample in dataset for pair_draw in _of_sample(sample, frames, presets, count, sensor)]
    name, seed = dataset.info.name, dataset.recipe.dataset.seed
    order = generator(name, seed, _ORDER_STREAM, "order", *presets, count).permutation(len(ordered))
    return tuple(replace(ordered[k], number=number) for number, k in enumerate(order))


def _of_sample(
    sample: Sample, frames: FramesTable, presets: tuple[str, ...], draws: int, sensor: SensorFile | None
) -> Iterator[PairDraw]:
    lights = present_tables(sample.stream_names, sample.dataset.recipe.distractors)
    requests = {preset: _request(sample, preset, sensor) for preset in presets}
    boxes = _boxes(sample, frames)
    for draw in range(draws):
        for preset, request in requests.items():
            yield PairDraw(0, sample.row.sample_id, preset, draw, request, frames.laser_off, boxes, lights)


def _request(sample: Sample, preset: str, sensor: SensorFile | None) -> FrameRequest:
    request = sample.frame_request(FrameOptions(preset, {} if sensor is None else dict(sensor.numbers)))
    if request.sensor().output == "electrons":
        raise DatasetError(f"preset '{preset}' ends before the pixels: take one of {', '.join(presets_of())}")
    return request


def _boxes(sample: Sample, frames: FramesTable) -> tuple[Region, Region] | None:
    """One pair of boxes for all draws of a sample: the overlap of several would tell where the spot is."""
    hinted = sample_stream(sample.stream_names, "hint").random() < frames.hint
    return search_boxes(sample, frames.hint_box_px) if hinted else None


@dataclass(frozen=True, repr=False)
class CachedSample(Sample):
    """A sample that keeps its layers and other lights, for many draws."""

    @classmethod
    def of(cls, sample: Sample) -> CachedSample:
        """The same sample, keeping what it has read."""
        return cls(sample.dataset, sample.row)

    @cached_property
    def distractors(self) -> tuple[Distractor, ...]:
        """Other lights of the sample."""
        return distractors(self)

    def ambient(self, position: str) -> NDArray[np.float32]:
        """Ambient layer, shape (3, H, W)."""
        return self._layers[position][0]

    def spot(self, position: str) -> SpotWindow:
        """Spot layer."""
        return self._layers[position][1]

    @cached_property
    def _layers(self) -> dict[str, tuple[NDArray[np.float32], SpotWindow]]:
        return {position: (Sample.ambient(self, position), Sample.spot(self, position)) for position in POSITIONS}

    def source(self, pair_draw: PairDraw) -> FrameSource:
        """Source of the frames of a pair draw, distractors included.

        Raises
        ------
        DatasetError
            If a layer cannot be read; in one sentence.
        """
        return FrameSource.from_request(self, pair_draw.request)
