"""Requests for frames (preset, exposure, levels, speed, crop, seed) from a caller's options and a recipe's `[frames]`.

A request is checked and frozen. The preset is one of the sensor's. `FrameOptions` are what a caller asks of a data
set's frames; `sample_request` makes the request of a sample of them and of the recipe's `[frames]`.

There is one meaning of the frames of a data set. Scores, `Sample.camera_frames`, training, exports and drawn files all
take them from `sample_request`. Each number of `[frames]` is drawn once per sample, from a random stream of its own,
and is the same in all presets and draws.
"""

from __future__ import annotations

import math
import numbers
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from phibench.datasets.common.errors import DatasetError, whole_number
from phibench.datasets.common.input_files import InputFile
from phibench.datasets.recipe.distributions import DistributionTable, quantile
from phibench.datasets.recipe.tables import SENSOR_KEYS, FramesTable
from phibench.render.sensor.light import Region
from phibench.render.sensor.settings import Sensor, SensorError, sensor
from phibench.scenes.random_streams import LEAST_SECRET_SEED, Name, generator, philox_key

Exposure = float | Literal["auto"] | None
AUTO: Literal["auto"] = "auto"
"""Exposure where neither caller nor recipe gives one, in every preset: a camera exposes by itself."""

_JPEG = b"\xff\xd8"  # start of image
# as wide as a recipe's: beyond them numbers overflow
_RANGES = {"lamp_level": (0.0, 1e6), "laser_level": (0.0, 1e6), "carriage_speed_m_s": (-1e3, 1e3)}


@dataclass(frozen=True)
class FrameRequest:
    """Everything that frames depend on besides the sample and the draw.

    Parameters
    ----------
    preset : str
        Name of a sensor's preset, such as "mjpeg"; "ideal" gives expected electrons.
    exposure : float, "auto" or None
        Seconds; "auto" is the camera's auto exposure for the down image, kept for all; None is the preset's time.
    lamp_level, laser_level : float
        Factors of the room's light and of the spot.
    carriage_speed_m_s : float
        Speed of the carriage along the stroke axis while the frame is read (rolling shutter).
    region : int, Region or None
        Side of a square around each spot, pixels; the same pixels in all frames; or the whole image.
    camera_seed : int
        Names the camera: frames of one seed share the fixed pattern. 0 is a camera like others.
    overrides : dict
        Other numbers of the preset, such as ``jpeg_quality=60``; `jpeg_qtables` may be a file, see `jpeg_tables`.
    """

    preset: str = "mjpeg"
    exposure: Exposure = AUTO
    lamp_level: float = 1.0
    laser_level: float = 1.0
    carriage_speed_m_s: float = 0.0
    region: int | Region | None = None
    camera_seed: int = 0
    overrides: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if "exposure_s" in self.overrides:
            if self.exposure not in (None, AUTO):
                raise DatasetError("exposure and exposure_s are both given: give one of them")
            object.__setattr__(self, "exposure", None)
        if isinstance(self.exposure, str) and self.exposure != "auto":
            raise DatasetError(f"exposure = '{self.exposure}': give seconds above 0, or 'auto'")
        if not isinstance(self.preset, str):
            raise DatasetError(f"preset = {self.preset!r}: give the name of a preset, such as 'mjpeg'")
        if isinstance(file := self.overrides.get("jpeg_qtables"), (str, Path)):
            object.__setattr__(self, "overrides", {**self.overrides, "jpeg_qtables": jpeg_tables(Path(file))})
        for name, (low, high) in _RANGES.items():
            object.__setattr__(self, name, _number(name, getattr(self, name), low, high))
        object.__setattr__(self, "camera_seed", whole_number("camera_seed", self.camera_seed))
        if isinstance(self.region, Region):
            for name, value in asdict(self.region).items():
                whole_number(f"region.{name}", value)
        elif self.region is not None:
            object.__setattr__(self, "region", whole_number("region", self.region, 1))
        with request_faults():
            self.sensor()  # refused now rather than at the first draw

    def sensor(self) -> Sensor:
        """Sensor before auto exposure."""
        seconds = {} if self.exposure in (None, "auto") else {"exposure_s": self.exposure}
        return sensor(self.preset, **seconds, **self.overrides)

    def document(self) -> dict[str, Any]:
        """The request as JSON can hold it."""
        return {**asdict(self), "overrides": dict(self.overrides)}


@dataclass(frozen=True)
class FrameOptions:
    """Options of a data set's frames as a caller gives them; all else is the recipe's `[frames]`, or its default.

    Parameters
    ----------
    preset : str
        Sensor preset, as in `FrameRequest`.
    given : mapping
        Fields of `FrameRequest` by name, and any number of the preset, such as ``jpeg_quality=60``.

    Raises
    ------
    DatasetError
        If an option has no such value; in one sentence.
    """

    preset: str = "mjpeg"
    given: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if "overrides" in self.given:
            raise DatasetError("overrides: give the numbers of the preset by name, such as jpeg_quality=60")
        if self.given.get("exposure") is not None and "exposure_s" in self.given:
            raise DatasetError("exposure and exposure_s are both given: give one of them")
        numbers = self.over(FrameRequest(self.preset)).overrides  # refused now rather than at the first draw
        fields = {key: value for key, value in self.given.items() if key not in numbers}
        object.__setattr__(self, "given", {**fields, **numbers})  # tables, where a file was given

    def over(self, request: FrameRequest) -> FrameRequest:
        """Request of this preset with what is given in place of its own."""
        fields = {key: value for key, value in self.given.items() if key in FrameRequest.__dataclass_fields__}
        numbers = {key: value for key, value in self.given.items() if key not in fields}
        if "exposure" in fields or "exposure_s" in numbers:
            request = replace(request, overrides=_without(request.overrides, "exposure_s"))
        return replace(request, **fields, overrides={**request.overrides, **numbers})

    @property
    def region(self) -> int | Region | None:
        """The crop that is asked for, as in `FrameRequest`."""
        return self.given.get("region")

    def sensor(self) -> Sensor:
        """Sensor without the recipe's numbers: its output and mosaic are those of every frame."""
        return self.over(FrameRequest(self.preset)).sensor()

    def document(self) -> dict[str, Any]:
        """The options as JSON can hold them."""
        plain = {key: asdict(value) if isinstance(value, Region) else value for key, value in self.given.items()}
        return {"preset": self.preset, **plain}


def _without(numbers: Mapping[str, Any], name: str) -> dict[str, Any]:
    return {key: value for key, value in numbers.items() if key != name}


def jpeg_tables(path: Path) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Quantisation tables of luma and chroma, 64 steps each, row by row, of a JPEG or a text file.

    A text file is what `cjpeg -qtables` takes: whole numbers row by row, one table or two, and comments after "#". A
    file with one table gives it to both.

    Raises
    ------
    DatasetError
        If the file has no such tables.
    """
    file = InputFile(path, "give a JPEG of the camera, or 64 or 128 whole numbers from 1 to 255 in a text file")
    data = file.read()
    if data.startswith(_JPEG):
        held = file.picture(("JPEG",), data).quantization  # type: ignore[attr-defined]
        tables = [tuple(held[key]) for key in sorted(held)][:2]
    else:
        words = " ".join(line.partition("#")[0] for line in file.text(data).splitlines()).split()
        if len(words) not in (64, 128) or not all(word.isascii() and word.isdigit() for word in words):
            raise file.fault("holds no quantisation tables")
        steps = [int(word[:6]) for word in words]  # a word of thousands of digits is no step, and slow
        tables = [tuple(steps[k : k + 64]) for k in range(0, len(steps), 64)]
    if not all(1 <= step <= 255 for table in tables for step in table):
        raise file.fault("has steps outside 1 to 255")
    return tables[0], tables[-1]


def exposure_of(text: str) -> Exposure:
    """Exposure from a word: "auto", "preset" (the preset's time) or seconds.

    Raises
    ------
    DatasetError
        If it is neither.
    """
    if text in ("auto", "preset"):
        return "auto" if text == "auto" else None
    try:
        return float(text)
    except ValueError as error:
        raise DatasetError(f"exposure = '{text}': give seconds above 0, 'auto', or 'preset'") from error


def _number(name: str, value: Any, low: float, high: float) -> float:
    """Return `value` as a Python float within its range."""
    number = math.nan if isinstance(value, bool) or not isinstance(value, numbers.Real) else float(value)
    if not low <= number <= high:
        raise DatasetError(f"{name} = {value!r}: must be a number from {low:g} to {high:g}")
    return number


@contextmanager
def request_faults() -> Iterator[None]:
    """Say what the sensor refuses as a fault of the request."""
    try:
        yield
    except SensorError as error:
        raise DatasetError(str(error)) from error


# -- requests of samples -----------------------------------------------------------------------------------------------

Names = tuple[str, int, str]
_CAMERAS = 2**31  # numbers of cameras; those of a secret seed have all 128 bits
_STREAM = "take"  # name of the random streams: another name would draw other numbers


def sample_request(names: Names, frames: FramesTable | None, options: FrameOptions) -> FrameRequest:
    """Request of a sample.

    Parameters
    ----------
    names : (data set, its seed, sample id)
        Of the random streams.
    frames : FramesTable or None
        The recipe's `[frames]`; its defaults where there is none.
    options : FrameOptions
        What goes before it.

    Raises
    ------
    DatasetError
        If a number is out of its range; in one sentence.
    """
    table = frames or FramesTable()
    request = FrameRequest(
        options.preset,
        _exposure(names, table),
        laser_level=_value(names, "laser_level", table.laser_level),
        lamp_level=_value(names, "lamp_level", table.lamp_level),
        camera_seed=_camera_seed(names, table),
        overrides=_numbers(names, table),
    )
    return options.over(request)


def _numbers(names: Names, frames: FramesTable) -> dict[str, Any]:
    """Numbers of the preset that the recipe gives."""
    drawn = {key: _value(names, key, given) for key in SENSOR_KEYS if (given := getattr(frames, key)) is not None}
    return {key: round(value) if key == "jpeg_quality" else value for key, value in drawn.items()} | (
        frames.sensor or {}
    )


def _exposure(names: Names, frames: FramesTable) -> Exposure:
    given = frames.exposure_s
    return _value(names, "exposure_s", given) if isinstance(given, DistributionTable) else AUTO


def _camera_seed(names: Names, frames: FramesTable) -> int:
    """Name of the camera's fixed pattern. Of a secret root it has 128 bits of it: 31 bits are found by trying all."""
    name, seed, sample_id = names
    owner = (sample_id,) if frames.camera == "per_sample" else ()
    if seed >= LEAST_SECRET_SEED:
        low, high = philox_key(name, seed, _STREAM, "camera", *owner).tolist()
        return int(low) + (int(high) << 64)
    return int(generator(name, seed, _STREAM, "camera", *owner).integers(_CAMERAS))


def _value(names: Names, key: str, table: DistributionTable) -> float:
    return float(quantile(table, np.array([sample_stream(names, key).random()]))[0])


def sample_stream(names: Names, *key: Name) -> np.random.Generator:
    """Random stream of one number of a sample's frames."""
    return generator(*names, _STREAM, *key)
