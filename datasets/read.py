"""Reader of data sets (`Dataset`, `Sample`): truth and layers from the folder, and camera frames drawn from them.

Neither Mitsuba nor the recipe is needed.

>>> import phibench
>>> dataset = phibench.open_dataset("out/paper")  # doctest: +SKIP
>>> sample = dataset["table2-d3.180-h0.425"]  # doctest: +SKIP
>>> sample.row.depth_m, sample.row.down.phi_ray_rad, sample.expected_image("down").shape  # doctest: +SKIP
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import first_fault
from phibench.datasets.common.shown_text import ShortForm
from phibench.datasets.frames.distractors import Distractor, distractors
from phibench.datasets.frames.frame_request import FrameOptions, FrameRequest, sample_request
from phibench.datasets.frames.frame_source import Frames, FrameSource
from phibench.datasets.recipe.recipe_scene import beam_of, spot_albedo
from phibench.datasets.recipe.tables import Recipe
from phibench.datasets.store.checksums import check_documents
from phibench.datasets.store.layers import SpotWindow, read_ambient, read_ambient_variance, read_spot, read_truth
from phibench.datasets.store.metadata import Rigs, read_info, read_manifest, read_rigs
from phibench.datasets.store.parquet_tables import to_table
from phibench.datasets.store.schema import INFO, RIGS, ROOMS, DatasetInfo, ManifestRow, SpotRow
from phibench.datasets.store.sensitivity_file import read_sensitivities
from phibench.datasets.store.stored_rooms import Rooms, read_rooms
from phibench.scenes.laser import Beam, LaserSpot
from phibench.scenes.rig import POSITIONS, Rig, View
from phibench.scenes.room import Room
from phibench.scenes.validation import nearest, printable_line

if TYPE_CHECKING:
    from polars import DataFrame

    from phibench.render.optics.correspondence import Correspondence as Correspondence


@dataclass(frozen=True, repr=False)
class Dataset(ShortForm):
    """An opened data set: iterate over its samples, take one by id or place, or a part of them as a slice.

    Attributes
    ----------
    folder : Path
        Where it lies.
    info : DatasetInfo
        Content of `dataset.json`.
    rigs : Rigs
        By id: `dataset.rigs[row.rig]`; a sample's own is `sample.rig`.
    rooms : Rooms
        By id: `dataset.rooms[row.room]`; a sample's own is `sample.room`.
    rows : tuple of ManifestRow
        Exact numbers of the samples, in the order of the manifest.
    samples : tuple of Sample
        In the same order.
    """

    folder: Path
    info: DatasetInfo
    rigs: Rigs
    rooms: Rooms
    rows: tuple[ManifestRow, ...]

    @cached_property
    def samples(self) -> tuple[Sample, ...]:
        """All samples."""
        return tuple(Sample(self, row) for row in self.rows)

    @property
    def rig(self) -> Rig:
        """The true rig of all samples, where they share one.

        Raises
        ------
        DatasetError
            If there are several.
        """
        names = {row.rig for row in self.rows}
        if len(names) != 1:
            raise DatasetError(f"{self.folder} has {len(names)} rigs; take each sample's own, `sample.rig`")
        return self.rigs[names.pop()]

    @property
    def room(self) -> Room:
        """The room of all samples, where they share one.

        Raises
        ------
        DatasetError
            If there are several.
        """
        names = {row.room for row in self.rows}
        if len(names) != 1:
            raise DatasetError(f"{self.folder} has {len(names)} rooms; take each sample's own, `sample.room`")
        return self.rooms[names.pop()]

    @cached_property
    def recipe(self) -> Recipe:
        """The recipe, defaults filled in."""
        return stored_recipe(self.folder, self.info)

    def sensitivities(self) -> DataFrame:
        """dD/d(parameter) per sample and estimator, a polars table; docs/misalignment.md has its columns.

        Raises
        ------
        DatasetError
            If the folder has none, or one of another state of the data set.
        """
        return read_sensitivities(self.folder)

    @property
    def beam(self) -> Beam:
        """Diameter of the laser's spots by the recipe; single targets may differ."""
        return beam_of(self.recipe.laser)

    def __len__(self) -> int:
        return len(self.rows)

    def __iter__(self) -> Iterator[Sample]:
        return iter(self.samples)

    @overload
    def __getitem__(self, key: str | int) -> Sample: ...

    @overload
    def __getitem__(self, key: slice) -> Dataset: ...

    def __getitem__(self, key: str | int | slice) -> Sample | Dataset:
        """Sample of an id or a place (negative ones count from the end); of a slice a data set of these samples.

        Raises
        ------
        DatasetError
            If no sample has the id.
        IndexError
            If there is no such place.
        """
        if isinstance(key, slice):
            return replace(self, rows=self.rows[key])
        if isinstance(key, str):
            return self.chosen([key])[0]
        try:
            return self.samples[key]
        except IndexError:
            raise IndexError(f"sample {key}: {self.folder} has {len(self)}, numbered from 0") from None

    def chosen(self, names: Sequence[str]) -> tuple[Sample, ...]:
        """Samples of ids or numbers as people write them, each once; see `place_of`."""
        ids = [row.sample_id for row in self.rows]
        places = dict.fromkeys(place_of(name, ids, self.folder) for name in names)
        return tuple(self.samples[place] for place in places)

    def to_polars(self) -> DataFrame:
        """Truth of all samples as a polars table, one row each: columns as in `manifest.parquet` (see FORMAT.md)."""
        return to_table(self.rows)

    def __repr__(self) -> str:
        spots = [row.position(position) for row in self.rows for position in POSITIONS]
        poses, rigs = len({spot.pose for spot in spots}), len({row.rig for row in self.rows})
        counts = [_count(len(self), "stroke pair"), _count(poses, "mirror pose"), _count(rigs, "rig")]
        if self.info.left_out:
            counts.append(f"{len(self.info.left_out)} refused and left out")
        lines = {
            "samples": ", ".join(counts),
            "ids": _ends([row.sample_id for row in self.rows]),
            "depth D": _range([row.depth_m for row in self.rows]),
            "stroke h": _range([row.stroke_m for row in self.rows]),
            "spots": f"{sum(spot.visible for spot in spots)} of {len(spots)} visible",
            "image": self._image_size(),
            "presets": "none named by the recipe"
            if self.recipe.frames is None
            else ", ".join(self.recipe.frames.presets),
            "room": self._room_text(),
            "format": f"version {self.info.schema_version}" + (f", part {self.info.shard}" if self.info.shard else ""),
        }
        return "\n".join([f"Dataset '{self.info.name}' in {self.folder}", *(f"  {k:9}{v}" for k, v in lines.items())])

    def _room_text(self) -> str:
        infos = list(self.rooms.infos.values())
        if len(infos) != 1:
            return f"{len(infos)} rooms"
        kind = infos[0].source.get("kind", "named")
        name = self.recipe.room.name if kind == "named" else kind
        return f"{name}, {_count(len(infos[0].object_names), 'object')}"

    def _image_size(self) -> str:
        if not self.rows:
            return "-"
        camera = self.rigs[self.rows[0].rig].camera
        return f"{camera.width_px} x {camera.height_px} px"


def place_of(name: str, ids: Sequence[str], folder: Path) -> int:
    """Place of a sample of an id, or of a number counted from 0; an id goes first.

    Raises
    ------
    DatasetError
        If there is none.
    """
    if name in ids:
        return ids.index(name)
    if not ids:
        raise DatasetError(f"{folder} has no samples")
    if re.fullmatch(r"[0-9]{1,9}", name):
        if int(name) < len(ids):
            return int(name)
        raise DatasetError(f"sample {name}: {folder} has {len(ids)}, numbered from 0 to {len(ids) - 1}")
    raise DatasetError(f"no sample '{printable_line(name, 80)}'; {nearest(name, ids)}")


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


def _range(values: Sequence[float]) -> str:
    return f"{min(values):.3f} to {max(values):.3f} m" if values else "-"


def _ends(names: Sequence[str]) -> str:
    """First and last of some names."""
    return ", ".join(names) if len(names) < 3 else f"{names[0]}, ..., {names[-1]}"


@dataclass(frozen=True, repr=False)
class Sample(ShortForm):
    """Sample: pair of images (down, up) of one spot. `position` is "down" or "up" everywhere."""

    dataset: Dataset = field(repr=False)
    row: ManifestRow

    def __repr__(self) -> str:
        places = (f"{p} {_place(self.row.position(p))}" for p in POSITIONS)
        numbers = (f"D = {self.row.centre_depth_m:.3f} m", f"h = {self.row.stroke_m:.3f} m", *places)
        return f"Sample('{self.row.sample_id}': {', '.join(numbers)})"

    def truth_row(self, position: str) -> SpotRow:
        """Exact answer for the spot."""
        if position not in POSITIONS:
            raise DatasetError(f"position '{position}': must be 'down' or 'up'")
        return self.row.position(position)

    @property
    def rig(self) -> Rig:
        """The sample's true rig."""
        return self.dataset.rigs[self.row.rig]

    @property
    def object_names(self) -> tuple[str, ...]:
        """Name by `object_id` of the truth layers: those of the room, then the parts of the rig's holder."""
        holder = self.rig.holder
        of_room = self.dataset.rooms.info(self.row.room).object_names
        return of_room if holder is None else (*of_room, *holder.part_names)

    @property
    def nominal_rig(self) -> Rig:
        """Nominal rig, which estimators are given with `row.nominal_stroke_m`; the true one without misalignment."""
        return self.dataset.rigs[self.row.nominal_rig]

    @property
    def room(self) -> Room:
        """The sample's room; built from its source when it is asked for."""
        return self.dataset.rooms[self.row.room]

    def view(self, position: str) -> View:
        """Rig at that position."""
        return self.rig.at(self.truth_row(position).offset_m)

    @property
    def laser_spot(self) -> LaserSpot:
        """The laser spot as a scene description."""
        laser = self.dataset.recipe.laser
        return LaserSpot(
            position_world_m=self.row.spot_world_m,
            normal_world=self.row.spot_normal_world,
            diameter_m=self.row.spot_diameter_m,
            albedo=spot_albedo(laser.albedo, self.row.spot_beam_world),
            beam_direction_world=self.row.spot_beam_world,
            power_w=laser.power_w,
            wavelength_nm=laser.wavelength_nm,
            profile=laser.profile,
        )

    def ambient(self, position: str) -> NDArray[np.float32]:
        """Ambient layer, shape (3, H, W), electrons per second behind R, G, B."""
        return read_ambient(self.dataset.folder / self.truth_row(position).view_ambient_file, **self._view(position))

    def ambient_variance(self, position: str) -> NDArray[np.float32]:
        """Variance of the ambient layer's own noise, shape (3, H, W), (electrons per second) squared."""
        path = self.dataset.folder / self.truth_row(position).view_ambient_file
        return read_ambient_variance(path, **self._view(position))

    def truth(self, position: str) -> dict[str, NDArray[Any]]:
        """Truth of every pixel centre: planes of shape (H, W), NaN where there is nothing (see FORMAT.md)."""
        path = self.dataset.folder / self.truth_row(position).view_truth_file
        return read_truth(path, self.view(position), **self._view(position))

    def correspondence(self, position: str = "down") -> Correspondence:
        """Place in the other image of the room point that each pixel of this one shows, or why it is not seen there.

        Computed from the room and the true rig in float64, in some 1.5 CPU-seconds; no layer is read.
        """
        from phibench.render.optics.correspondence import correspondence

        other = {"down": "up", "up": "down"}
        self.truth_row(position)
        return correspondence(self.room, self.view(position), self.view(other[position]))

    def spot(self, position: str) -> SpotWindow:
        """Spot layer; an empty window where no light of the spot reaches the image."""
        name = self.truth_row(position).spot_file
        if name is None:
            return SpotWindow.empty()
        owner = {"dataset": self.dataset.info.name, "sample_id": self.row.sample_id, "position": position}
        return read_spot(self.dataset.folder / name, **owner)

    def expected_image(self, position: str, laser: bool = True) -> NDArray[np.float64]:
        """Image without noise, shape (3, H, W), expected electrons per second: ambient, plus the spot if `laser`."""
        image = self.ambient(position).astype(float)
        if laser:
            self.spot(position).add_to(image)
        return image

    def camera_frames(self, preset: str = "mjpeg", draw: int = 0, *, laser_off: bool = False, **options: Any) -> Frames:
        """Draw the pair as the C310 delivers it: `frames.down`, `frames.up`, for MJPEG also `frames.jpeg`.

        They are the frames that a score shows a method: exposure, lamps, laser, camera and sensor are those of the
        recipe's `[frames]`, with auto exposure by default. Layers are read anew each time: to draw many, keep
        `frame_source` or `region_frames`.

        Parameters
        ----------
        preset : str
            Name of a sensor's preset, such as "mjpeg": where the camera's chain ends.
        draw : int
            Number of the noise realisation, 0 or above.
        laser_off : bool
            Also `frames.down_off` and `frames.up_off`.
        **options : Any
            In place of the recipe's: exposure (seconds, "auto", or None for the preset's time), lamp_level,
            laser_level, carriage_speed_m_s, region, camera_seed, and any number of the preset, such as
            ``jpeg_quality=60``.

        Raises
        ------
        DatasetError
            If the request cannot be met or a layer cannot be read; in one sentence.
        """
        return self.frame_source(preset, **options).frames(draw, laser_off=laser_off)

    def frame_source(self, preset: str = "mjpeg", **options: Any) -> FrameSource:
        """Layers read once, for many draws: `source.frames(k)`; options as for `camera_frames`."""
        return FrameSource.from_request(self, self.frame_request(FrameOptions(preset, options)))

    def region_frames(self, preset: str = "mjpeg", side_px: int = 64, **options: Any) -> FrameSource:
        """Return the source of squares around each spot: the pixels of the whole frames, to the bit."""
        return self.frame_source(preset, region=side_px, **options)

    def frame_request(self, options: FrameOptions) -> FrameRequest:
        """Request of this sample's frames: the recipe's `[frames]`, and the options in its place."""
        return sample_request(self.stream_names, self.dataset.recipe.frames, options)

    @property
    def distractors(self) -> tuple[Distractor, ...]:
        """Other lights of the sample; computed when first asked for."""
        return distractors(self)

    @property
    def stream_names(self) -> tuple[str, int, str]:
        """Names of this sample's noise streams: data set, its seed, sample id."""
        return self.dataset.info.name, self.dataset.recipe.dataset.seed, self.row.sample_id

    def _view(self, position: str) -> dict[str, str]:
        """Fields that the headers of the view's layers must have."""
        return {"dataset": self.dataset.info.name, "pose": self.truth_row(position).pose}


def _place(spot: SpotRow) -> str:
    """Position of a spot in its image, or why there is none."""
    return f"({spot.centre.u_px:.2f}, {spot.centre.v_px:.2f}) px" if spot.visible else f"not visible: {spot.cause}"


def open_dataset(folder: str | Path) -> Dataset:
    """Open a data set; layers are read when they are asked for.

    Raises
    ------
    DatasetError
        If the folder is missing, not a data set, of another schema version, or its manifest or rigs are damaged.
    """
    folder = Path(folder)
    info = read_info(folder)
    rows = tuple(read_manifest(folder))
    if len(rows) != info.samples:
        raise DatasetError(f"{folder}: the manifest has {len(rows)} rows instead of {info.samples}")
    rigs = read_rigs(folder)
    if len(rigs) != info.rigs:
        raise DatasetError(f"{folder}: {RIGS} has {len(rigs)} rigs instead of {info.rigs}")
    stored_recipe(folder, info)
    rooms = read_rooms(folder, info)
    if len(rooms) != info.rooms:
        raise DatasetError(f"{folder}: {ROOMS} has {len(rooms)} rooms instead of {info.rooms}")
    return Dataset(folder, info, rigs, rooms, rows)


def stored_recipe(folder: Path, info: DatasetInfo) -> Recipe:
    """Recipe in a `dataset.json`, defaults filled in.

    Raises
    ------
    DatasetError
        If it is none.
    """
    try:
        return Recipe.model_validate(info.recipe)
    except ValidationError as error:
        text = f"{folder / INFO} is damaged: recipe.{first_fault(error)}"
        raise DatasetError(f"{text}; run `phibench dataset repair`") from error


def open_finished(folder: str | Path) -> Dataset:
    """Open a data set whose making was finished and whose manifest and description are the signed ones.

    Raises
    ------
    DatasetError
        As `open_dataset`, and if `SHA256SUMS` is missing or does not fit manifest, rigs or `dataset.json`.
    """
    read_info(Path(folder))  # not a data set at all is said first
    check_documents(Path(folder))
    return open_dataset(folder)
