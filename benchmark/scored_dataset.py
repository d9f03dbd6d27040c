"""Data set as `phibench.open_dataset` gives it: samples, and the pairs that a score shows a method.

>>> import phibench
>>> dataset = phibench.open_dataset("out/paper")  # doctest: +SKIP
>>> pairs = dataset.pairs("mjpeg")  # doctest: +SKIP
>>> pair, truth = pairs.pair(3), pairs.truth(3)  # doctest: +SKIP
>>> pair = pairs.pair(pairs.number_of("table2-d3.180-h0.425"))  # doctest: +SKIP
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from phibench.benchmark.pair_sets.frames_set import FramesSet
from phibench.datasets import read
from phibench.datasets.frames.sensor_file import SensorFile
from phibench.datasets.store.pair_files import is_frames_set

if TYPE_CHECKING:
    from phibench.benchmark.dense.dense_pairs import DensePairs
    from phibench.benchmark.pair_sets.dataset_pairs import DatasetPairs, Track


class ScoredDataset(read.Dataset):
    """A `Dataset` that also gives its pairs as scores do."""

    def pairs(
        self,
        preset: str | None = None,
        draws: int | None = None,
        *,
        hints: bool = True,
        boxes_px: int | None = None,
        sensor: SensorFile | None = None,
        track: Track | None = None,
    ) -> DatasetPairs:
        """Pairs with their truths: the same numbers and bytes as in `phibench score` with the same options.

        Iterate for (pair, truth); `pair(k)` and `truth(k)` give one of each; `number_of` finds a pair by its sample.

        Parameters
        ----------
        preset : str, optional
            Sensor preset; those of the recipe's `[frames]` if not given.
        draws : int, optional
            Draws of the noise per sample and preset; the recipe's if not given.
        hints : bool
            Show the boxes of pairs that have some.
        boxes_px : int, optional
            Side of a box for every pair, pixels.
        sensor : SensorFile, optional
            Numbers of a measured camera.
        track : "localise", "find" or "depth", optional
            Boxes as that track shows them.

        Raises
        ------
        DatasetError
            If neither recipe nor caller names a preset, or a number is out of its range.
        """
        from phibench.benchmark.pair_sets.dataset_pairs import dataset_pairs

        pairs = dataset_pairs(self, preset, draws, hints=hints, boxes_px=boxes_px, sensor=sensor)
        return pairs if track is None else pairs.of_track(track)

    def dense_pairs(
        self, preset: str | None = None, draws: int | None = None, *, pairs: int | None = None, frames: int = 1
    ) -> DensePairs:
        """Pairs of images with the laser off, and the truth of their pixels (docs/dense.md).

        The images are those of `pairs` with the laser off, byte for byte; of samples with the same two views one is
        taken. Parameters and errors as for `benchmark.dense.dense_pairs.dense_pairs`.
        """
        from phibench.benchmark.dense.dense_pairs import dense_pairs

        return dense_pairs(self, preset, draws, pairs, frames)


def open_dataset(folder: str | Path) -> ScoredDataset | FramesSet:
    """Open a data set, or a frames set; layers and frames are read when they are asked for.

    Raises
    ------
    DatasetError
        If the folder is missing, not a data set, of another schema version, or its manifest or rigs are damaged.
    """
    if is_frames_set(folder):
        return FramesSet(folder)
    opened = read.open_dataset(folder)
    return ScoredDataset(opened.folder, opened.info, opened.rigs, opened.rooms, opened.rows)
