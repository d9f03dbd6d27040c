"""Request of an export (`ExportRequest`), its rows, one per pair of images and draw of the noise, and their splits.

Splits are made of whole groups. Two samples that share a rig or a room are in one group, whatever the draw: what is
learned about one of them would be known of the other.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, get_args

from phibench.datasets.common.errors import DatasetError, whole_number
from phibench.datasets.frames.frame_files import png_bytes, suffix
from phibench.datasets.frames.frame_request import FrameOptions
from phibench.datasets.frames.frame_source import Frames, FrameSource
from phibench.datasets.read import Dataset
from phibench.datasets.store.parquet_tables import to_table
from phibench.datasets.store.schema import ManifestRow, TruthFile
from phibench.render.sensor.settings import Sensor
from phibench.scenes.random_streams import generator

if TYPE_CHECKING:
    from polars import DataFrame

Form = Literal["parquet", "webdataset", "frames"]
SplitBy = Literal["both", "rig", "room"]
INDEX = TruthFile.PAIRS_TABLE.value
SPLITS = ("train", "validation", "test")
_DOTLESS = str.maketrans("._", "_=")
POSITION_FIELDS = ("exposure_s", "analogue_gain", "u0_px", "v0_px", "width_px", "height_px")
"""What a draw adds to `down.` and `up.` of the manifest's columns; FORMAT.md's rows of frames describe them."""


@dataclass(frozen=True)
class ExportRequest:
    """All that an export depends on besides the data set.

    Parameters
    ----------
    form : "parquet", "webdataset" or "frames"
        Container of the pairs.
    frames : FrameOptions
        What they do not give is the recipe's `[frames]` of each sample.
    draws : int
        Draws 0 to draws - 1 of every pair.
    laser_off : bool
        Also every image without the spot.
    samples : tuple of str
        Ids or numbers of the samples; all of them where it is empty.
    scored : bool
        Pairs as they are scored, with their truth: a frames set. Of plain files with the recipe's own frames.
    split_by : "both", "rig" or "room"
        What no two splits share.
    validation, test : float
        Shares of the pairs, at most; the rest is for training.
    pairs_per_shard : int
        Pairs in one file of a form that has shards.
    """

    form: Form
    frames: FrameOptions
    draws: int = 1
    laser_off: bool = False
    split_by: SplitBy = "both"
    validation: float = 0.1
    test: float = 0.1
    pairs_per_shard: int = 64
    samples: tuple[str, ...] = ()
    scored: bool = False

    def __post_init__(self) -> None:
        for name, value, kinds in (("to", self.form, Form), ("split_by", self.split_by, SplitBy)):
            if value not in get_args(kinds):
                raise DatasetError(f"{name} = {value!r}: give one of {', '.join(get_args(kinds))}")
        whole_number("draws", self.draws, 1)
        whole_number("pairs_per_shard", self.pairs_per_shard, 1)
        if not (0.0 <= self.validation and 0.0 <= self.test and self.validation + self.test < 1.0):
            shares = f"validation = {self.validation:g}, test = {self.test:g}"
            raise DatasetError(f"{shares}: give shares from 0 on, below 1 together")
        if self.scored and (self.form != "frames" or self.frames.given):
            raise DatasetError("pairs that are scored are plain files with the recipe's own frames: leave options out")
        if self.frames.sensor().output == "electrons":
            raise DatasetError(f"preset '{self.frames.preset}' has no image file that others read: give another preset")

    @property
    def images(self) -> tuple[tuple[str, str, bool], ...]:
        """Column, position, laser on or off of every image of a pair."""
        lasers = (True, False) if self.laser_off else (True,)
        return tuple(
            (f"image_{position}{'' if laser else '_off'}", position, laser)
            for position in ("down", "up")
            for laser in lasers
        )

    @property
    def end(self) -> str:
        """End of an image file's name."""
        return suffix(self.frames.sensor(), self.frames.region is None)

    def part_of(self, dataset: Dataset) -> Dataset:
        """The data set's samples that are asked for."""
        if not self.samples:
            return dataset
        return replace(dataset, rows=tuple(sample.row for sample in dataset.chosen(self.samples)))

    def document(self) -> dict[str, Any]:
        """The request as JSON."""
        plain = {name: getattr(self, name) for name in self.__dataclass_fields__ if name != "frames"}
        plain["samples"] = list(self.samples)
        return {**plain, "frames": json.loads(json.dumps(self.frames.document()))}


@dataclass(frozen=True)
class DrawnPair:
    """One draw of one pair: bytes of its images by column, and what the draw adds to the sample's row."""

    key: str
    sample_id: str
    draw: int
    images: Mapping[str, bytes]
    added: Mapping[str, float | int | str | None]


def pair_key(sample_id: str, draw: int) -> str:
    """Name of a pair in one draw, no other's. It has no dot, for a name in a WebDataset ends at its first one.

    A dot becomes "_", and "_" becomes "=", which no sample's name has.
    """
    return f"{sample_id.translate(_DOTLESS)}-{draw:04d}"


def drawn_pair(
    source: FrameSource, row: ManifestRow, draw: int, request: ExportRequest, frames: Frames | None = None
) -> DrawnPair:
    """Draw one pair, or take its frames."""
    images: dict[str, bytes] = {}
    asked = source.request
    added: dict[str, float | int | str | None] = {"draw": draw, "preset": asked.preset}
    added |= {"jpeg_quality": source.jpeg_quality, "laser_level": asked.laser_level, "lamp_level": asked.lamp_level}
    for column, position, laser in request.images:
        name = position if laser else f"{position}_off"
        frame = source.frame(position, draw, laser) if frames is None else frames.by_name[name]
        images[column] = frame.jpeg if frame.jpeg is not None else png_bytes(frame.image)
        added |= {f"{position}.{name}": value for name, value in _numbers(frame.sensor, frame.region).items()}
    return DrawnPair(pair_key(row.sample_id, draw), row.sample_id, draw, images, added)


def _numbers(sensor: Sensor, region: Any) -> dict[str, float | int]:
    height, width = region.shape
    values = sensor.exposure_s, sensor.analogue_gain, region.u0_px, region.v0_px, width, height
    return dict(zip(POSITION_FIELDS, values, strict=True))


def pair_table(rows: Sequence[ManifestRow], drawn: Sequence[tuple[str, Mapping[str, Any]]]) -> DataFrame:
    """Rows as a table: all columns of `manifest.parquet`, and what the draws add.

    Parameters
    ----------
    rows : sequence of ManifestRow
        Of the manifest.
    drawn : sequence of pairs
        Sample id and what is added ("key", "split", "draw", ...) of each row of the table, all with the same names.
    """
    import polars

    kinds = {"jpeg_quality": polars.Int64} if drawn and "jpeg_quality" in drawn[0][1] else {}  # it may be null in all
    added = polars.DataFrame([{"sample_id": name, **values} for name, values in drawn], schema_overrides=kinds)
    table = added.join(to_table(rows), on="sample_id", how="left", maintain_order="left")
    first = [name for name in ("key", "split") if name in table.columns]
    return table.select(*first, *(name for name in table.columns if name not in first))


# Splits.


def splits(dataset: Dataset, request: ExportRequest) -> dict[str, str]:
    """Split by sample id; all of a set whose samples hang together is "train".

    Groups come in a random order that their names and the set's seed give. They fill the test split, then the
    validation split, each as far as its share goes; what is left is for training.
    """
    groups = sorted(_groups(dataset.rows, request.split_by), key=min)
    seed = dataset.recipe.dataset.seed
    order = generator(dataset.info.name, seed, "export", request.split_by).permutation(len(groups))
    total = len(dataset.rows)
    split_of: dict[str, str] = {}
    room = {"test": request.test * total, "validation": request.validation * total}
    for number in order:
        group = groups[number]
        # a share times a whole number rounds
        fits = next((name for name in room if len(group) <= room[name] + 1e-9), "train")
        if fits in room:
            room[fits] -= len(group)
        split_of |= dict.fromkeys(group, fits)
    return {row.sample_id: split_of[row.sample_id] for row in dataset.rows}


def _groups(rows: Sequence[ManifestRow], split_by: SplitBy) -> list[list[str]]:
    """Samples that hang together by what they share: the connected parts of the graph of rigs and rooms."""
    parent: dict[str, str] = {}

    def root(name: str) -> str:
        while parent.setdefault(name, name) != name:
            name = parent[name]
        return name

    shared = [[f"rig {row.rig}"] * (split_by != "room") + [f"room {row.room}"] * (split_by != "rig") for row in rows]
    for names in shared:
        parent[root(names[0])] = root(names[-1])
    groups: dict[str, list[str]] = {}
    for row, names in zip(rows, shared, strict=True):
        groups.setdefault(root(names[0]), []).append(row.sample_id)
    return list(groups.values())
