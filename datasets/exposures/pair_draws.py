"""A benchmark's image pairs: sample, sensor preset, noise seed, exposure, search boxes and order of each.

A pair draw is one draw of the noise of one sample in one preset. It is a pure function of the data set's documents. All
numbers of `[frames]` are drawn per sample, each from a random stream of its own. The order is drawn, too, so that the
number of a pair says nothing about the scene.

`pair_draws` lists them, `CachedSample` reads a sample's layers once and makes the frame source of each.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from phibench.datasets.errors import DatasetError
from phibench.datasets.exposures.distractors import Distractor, distractors, present
from phibench.datasets.frames.request import Exposure, FrameRequest, whole_number
from phibench.datasets.frames.sensor_file import SensorFile
from phibench.datasets.frames.source import FrameSource, has_place
from phibench.datasets.read import Dataset, Sample
from phibench.datasets.recipe.distributions import DistributionTable, quantile
from phibench.datasets.recipe.tables import SENSOR_KEYS, FramesTable
from phibench.datasets.store.layers import SpotWindow
from phibench.datasets.store.schema import ManifestRow
from phibench.render.sensor.light import Region
from phibench.scenes.laser import LaserSpot
from phibench.scenes.random_streams import Name, generator
from phibench.scenes.rig import POSITIONS, Rig, View

BOX_MARGIN_PX = 4
"""A hinted spot is at least this far from the edges of its box."""
PRESETS = ("mono-raw", "bayer-raw", "srgb8", "mjpeg")
"""Presets of the first version: the numbers of their draws stay, and with them every byte of their frames."""
_LATER = {"yuyv": 2**32}  # first draw of a later preset
_FRAMES = 2**40  # draws between the frames of one image: more than any data set has
_CAMERAS = 2**31
_STREAM, _ORDER_STREAM = "take", "takes"  # names of random streams: another name would draw other numbers


@dataclass(frozen=True)
class PairDraw:
    """One draw of the noise of one sample in one preset; its frames are drawn by `CachedSample.source`.

    Attributes
    ----------
    number : int
        Its place in the drawn order, from 0.
    sample_id : str
    preset : str
    draw : int
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

    @property
    def noise_draw(self) -> int:
        """Draw of `FrameSource.frames`: another one in each preset, or JPEG frames would have a raw twin's noise."""
        if self.preset in _LATER:
            return _LATER[self.preset] + self.draw
        return self.draw * len(PRESETS) + PRESETS.index(self.preset)

    def frame_draws(self, laser: bool) -> tuple[int, ...]:
        """Draws of the single frames of an image; the first is `noise_draw`."""
        return tuple(self.noise_draw + k * _FRAMES for k in range(self.frames[0 if laser else 1]))


def pair_draws(
    dataset: Dataset, preset: str | None = None, draws: int | None = None, sensor: SensorFile | None = None
) -> tuple[PairDraw, ...]:
    """All pair draws of a data set, by number.

    Parameters
    ----------
    dataset : Dataset
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
    found = [pair_draw for sample in dataset for pair_draw in _of_sample(sample, frames, presets, count, sensor)]
    name, seed = dataset.info.name, dataset.info.recipe["dataset"]["seed"]
    order = generator(name, seed, _ORDER_STREAM, "order", *presets, count).permutation(len(found))
    return tuple(replace(found[k], number=number) for number, k in enumerate(order))


def _of_sample(
    sample: Sample, frames: FramesTable, presets: tuple[str, ...], draws: int, sensor: SensorFile | None
) -> Iterator[PairDraw]:
    lights = present(sample.stream_names, sample.dataset.recipe.distractors)
    requests = {preset: _request(sample, frames, preset, sensor) for preset in presets}
    boxes = _boxes(sample, frames)
    for draw in range(draws):
        for preset, request in requests.items():
            yield PairDraw(0, sample.row.sample_id, preset, draw, request, frames.laser_off, boxes, lights)


def _request(sample: Sample, frames: FramesTable, preset: str, sensor: SensorFile | None) -> FrameRequest:
    if preset == "ideal":
        raise DatasetError("preset 'ideal' ends before the pixels: take bayer-raw, mono-raw, srgb8, yuyv or mjpeg")
    numbers = {key: _value(sample, key, given) for key in SENSOR_KEYS if (given := getattr(frames, key)) is not None}
    overrides = {key: round(value) if key == "jpeg_quality" else value for key, value in numbers.items()}
    overrides |= frames.sensor or {}
    if sensor is not None:
        overrides |= sensor.numbers
    return FrameRequest(
        preset,
        _exposure(sample, frames),
        laser_level=_value(sample, "laser_level", frames.laser_level),
        lamp_level=_value(sample, "lamp_level", frames.lamp_level),
        camera_seed=_camera_seed(sample, frames),
        overrides=overrides,
    )


def _exposure(sample: Sample, frames: FramesTable) -> Exposure:
    given = frames.exposure_s
    return _value(sample, "exposure_s", given) if isinstance(given, DistributionTable) else given


def _camera_seed(sample: Sample, frames: FramesTable) -> int:
    name, seed, sample_id = sample.stream_names
    owner = (sample_id,) if frames.camera == "per_sample" else ()
    return int(generator(name, seed, _STREAM, "camera", *owner).integers(_CAMERAS))


def _boxes(sample: Sample, frames: FramesTable) -> tuple[Region, Region] | None:
    """One pair of boxes for all draws of a sample: the overlap of several would tell where the spot is."""
    return None if _generator(sample, "hint").random() >= frames.hint else search_boxes(sample, frames.hint_box_px)


def search_boxes(sample: Sample, side_px: int) -> tuple[Region, Region]:
    """Boxes for both images of a sample, drawn from streams of its own: their centres tell nothing of the spot."""
    down, up = (_box(sample, position, side_px) for position in POSITIONS)
    return down, up


def _box(sample: Sample, position: str, side_px: int) -> Region:
    """Box that holds the spot anywhere with the same probability, as far as the image has room for it."""
    camera, row = sample.rig.camera, sample.truth_row(position)
    sizes = camera.width_px, camera.height_px
    random = _generator(sample, "box", position)
    place = (row.u_px, row.v_px) if has_place(row, (camera.height_px, camera.width_px)) else (None, None)
    u, v = (_start(random, centre, side_px, size) for centre, size in zip(place, sizes, strict=True))
    return Region(u, v, u + min(side_px, sizes[0]), v + min(side_px, sizes[1]))


def _start(random: np.random.Generator, centre_px: float | None, side_px: int, size_px: int) -> int:
    """First pixel of a box along one axis, in an image of `size_px` pixels."""
    last = max(size_px - side_px, 0)
    if centre_px is None:
        return int(random.integers(0, last + 1))
    # the spot is at least the margin from the box's edges, which lie half a pixel beyond its outer pixels
    low = int(np.ceil(centre_px + BOX_MARGIN_PX + 0.5 - side_px))
    high = int(np.floor(centre_px - BOX_MARGIN_PX + 0.5))
    low, high = (min(max(edge, 0), last) for edge in (low, high))
    return int(random.integers(low, high + 1))


def _value(sample: Sample, key: str, table: DistributionTable) -> float:
    return float(quantile(table, np.array([_generator(sample, key).random()]))[0])


def _generator(sample: Sample, *key: Name) -> np.random.Generator:
    return generator(*sample.stream_names, _STREAM, *key)


@dataclass(frozen=True)
class CachedSample:
    """A sample that keeps its layers; it is what `FrameSource` needs of one."""

    sample: Sample = field(repr=False)

    @property
    def row(self) -> ManifestRow:
        """Exact numbers."""
        return self.sample.row

    @property
    def rig(self) -> Rig:
        """The sample's rig."""
        return self.sample.rig

    @property
    def nominal_rig(self) -> Rig:
        """The nominal rig: the one that estimators are given."""
        return self.sample.nominal_rig

    @property
    def laser_spot(self) -> LaserSpot:
        """The laser spot."""
        return self.sample.laser_spot

    @property
    def stream_names(self) -> tuple[str, int, str]:
        """Data set, its seed, sample id."""
        return self.sample.stream_names

    @cached_property
    def distractors(self) -> tuple[Distractor, ...]:
        """Other lights of the sample."""
        return distractors(self.sample)

    def view(self, position: str) -> View:
        """Rig at a position."""
        return self.sample.view(position)

    def ambient(self, position: str) -> NDArray[np.float32]:
        """Ambient layer, shape (3, H, W)."""
        return self._layers[position][0]

    def spot(self, position: str) -> SpotWindow:
        """Spot layer."""
        return self._layers[position][1]

    @cached_property
    def _layers(self) -> dict[str, tuple[NDArray[np.float32], SpotWindow]]:
        return {position: (self.sample.ambient(position), self.sample.spot(position)) for position in POSITIONS}

    def source(self, pair_draw: PairDraw) -> FrameSource:
        """Source of the frames of a pair draw, distractors included.

        Raises
        ------
        DatasetError
            If a layer cannot be read; in one sentence.
        """
        request = self._locked(pair_draw.request)
        lights = {p: tuple(one.other(p, request.laser_level) for one in self.distractors) for p in POSITIONS}
        return FrameSource.from_request(self, request, lights)

    def _locked(self, request: FrameRequest) -> FrameRequest:
        """Request with the exposure and gain that auto exposure chooses for the down image, for all images."""
        if request.exposure != "auto":
            return request
        sensor = FrameSource.exposed(self, request)
        overrides = {**request.overrides, "analogue_gain": sensor.analogue_gain}
        return replace(request, exposure=sensor.exposure_s, overrides=overrides)
