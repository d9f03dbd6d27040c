"""Reader of pairs in files (one line of `pairs.jsonl` each, images under `frames/`), and the models of such lines.

Sealed sets and frames sets hold their pairs so. The lines of a sealed set say what a user knows; those of a frames set
hold the truth, too. Every file is checked against its hash when it is read.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, field_validator, model_validator

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import FileName, InputFile, Name
from phibench.datasets.store.checksums import read_checksums
from phibench.datasets.store.files import read_rows
from phibench.datasets.store.json_forms import to_json
from phibench.datasets.store.schema import CHECKSUMS, Document, Number, TruthFolder
from phibench.scenes.camera import LARGEST_SIDE_PX, Camera

PAIRS, FRAMES = "pairs.jsonl", "frames"
FRAMES_SET = TruthFolder.FRAMES_SET.value
"""File that says of a folder that it is a frames set."""
MOST_PAIRS = 1_000_000  # of a set: its index then has 400 MiB
LEAST_BOX_PX = 16
"""Side of the smallest box, as in a recipe."""
IMAGES = {"down", "up"}
IMAGES_OFF = {"down_off", "up_off"}
_AGAIN = "download the set again"
_MODES = ("RGB", "I;16", "L", "LA")  # of PNG and JPEG as sets of pairs hold them
_Pixel = Annotated[int, Field(ge=-LARGEST_SIDE_PX, le=LARGEST_SIDE_PX)]
_Side = Annotated[int, Field(ge=1, le=LARGEST_SIDE_PX)]


class PublicBox(Document):
    """A region hint, as `interface.Box`."""

    u0_px: _Pixel
    v0_px: _Pixel
    width_px: _Side
    height_px: _Side


class PublicPair(Document):
    """One line of `pairs.jsonl`; `files` by image name: "down", "up", and "down_off", "up_off" where they are."""

    number: Annotated[int, Field(ge=0, lt=MOST_PAIRS)]
    files: dict[str, FileName]
    stroke_m: Annotated[float, Field(gt=0.0, le=1000.0)]
    rig: dict[str, Any]
    card: dict[str, Any]
    box_down: PublicBox | None
    box_up: PublicBox | None
    beam: dict[str, Any] | None = None

    @field_validator("files")
    @classmethod
    def _both_images(cls, files: dict[str, str]) -> dict[str, str]:
        if set(files) not in (IMAGES, IMAGES | IMAGES_OFF):
            raise ValueError("the images down and up are needed, and down_off and up_off both or neither")
        if strange := [name for name in files.values() if not name.startswith(f"{FRAMES}/")]:
            raise ValueError(f"the image {strange[0]} does not lie in {FRAMES}/")
        return files


# keys of "phibench truth 1"
_RENAMED = {"believed_rig": "nominal_rig", "believed_stroke_m": "nominal_stroke_m"}
_LARGEST = 1e100  # of a number of a truth: its square is a double, too


def _sensible(value: float) -> float:
    if abs(value) > _LARGEST:
        raise ValueError(f"{value} is beyond +-{_LARGEST}")
    return value


_Real = Annotated[float, AfterValidator(_sensible)]
_RealOrNan = Annotated[Number, AfterValidator(_sensible)]
_Place = Annotated[tuple[_RealOrNan, _RealOrNan], Field(strict=False)]
_Matrix = Annotated[tuple[_Place, _Place], Field(strict=False)]


class DistractionRow(Document):
    """A `Distraction` in the truth's file."""

    kind: Name
    uv_px: _Place
    electrons: _RealOrNan


class AnglesRow(Document):
    """The three phi of a spot."""

    ray: _RealOrNan
    normal: _RealOrNan
    incidence: _RealOrNan


class SpotTruthRow(Document):
    """A `ImageTruth` in the truth's file."""

    uv_px: _Place
    phi_rad: AnglesRow
    azimuth_rad: _RealOrNan
    visible: bool
    cause: Name
    electrons: _RealOrNan
    peak_e: _RealOrNan
    snr: _RealOrNan
    saturated: bool
    bound_px2: _Matrix | None
    raw_bound_px2: _Matrix | None
    distractions: Annotated[tuple[DistractionRow, ...], Field(strict=False, max_length=1000)]
    axis_px: _Place = (math.nan, math.nan)


class TruthRow(Document):
    """A `PairTruth` in the truth's file, of version 1 or 2."""

    number: Annotated[int, Field(ge=0, lt=MOST_PAIRS)]
    sample_id: Name
    draw: Annotated[int, Field(ge=0, lt=MOST_PAIRS)]
    preset: Name
    jpeg_quality: Annotated[int, Field(ge=1, le=100)] | None
    hinted: bool
    depth_m: _Real
    stroke_m: _Real
    true_rig: dict[str, Any]
    nominal_rig: dict[str, Any]
    down: SpotTruthRow
    up: SpotTruthRow
    nominal_stroke_m: _Real | None
    exposure_s: _Real | None = None
    analogue_gain: _Real | None = None
    laser_level: _Real | None = None
    lamp_level: _Real | None = None
    axis_depth_m: _RealOrNan = math.nan
    box_px2: _Real = float(LEAST_BOX_PX**2)

    @model_validator(mode="before")
    @classmethod
    def _names_of_version_1(cls, document: Any) -> Any:
        if not isinstance(document, dict):
            return document
        renamed = {old: new for old, new in _RENAMED.items() if new not in document}
        return {renamed.get(name, name): value for name, value in document.items()}


class FramesRow(PublicPair):
    """One line of a frames set: a pair with its truth."""

    truth: TruthRow


def public_fields(pair: Any, files: dict[str, str]) -> dict[str, Any]:
    """Fields of a `PublicPair` of an `interface.Pair` whose images lie in files."""
    boxes = {name: getattr(pair, name) for name in ("box_down", "box_up")}
    return {
        "number": pair.number,
        "files": files,
        "stroke_m": pair.stroke_m,
        "rig": to_json(pair.rig),
        "card": to_json(pair.card),
        "beam": None if pair.beam is None else to_json(pair.beam),
        **{name: None if box is None else PublicBox(**asdict(box)) for name, box in boxes.items()},
    }


def is_frames_set(folder: str | Path) -> bool:
    """True if a folder says of itself that it is a frames set."""
    return (Path(folder) / FRAMES_SET).is_file()


def is_imported(folder: str | Path) -> bool:
    """True if a folder says of itself that it is an imported set."""
    return (Path(folder) / TruthFolder.IMPORTED.value).is_file()


Row = TypeVar("Row", bound=PublicPair)


class PairFiles(Generic[Row]):
    """Lines and images of a folder of pairs.

    Parameters
    ----------
    kind : type
        Of its lines: `PublicPair`, or a kind of it.
    count : int, optional
        Number of pairs that it must hold; at least one by default.
    first : sequence of str
        Files that are checked at once, beside `pairs.jsonl`.

    Raises
    ------
    DatasetError
        If a file is missing, changed or not listed, or the lines are not those of the pairs; in one sentence.
    """

    def __init__(self, folder: Path, kind: type[Row], count: int | None = None, first: Sequence[str] = ()) -> None:
        self.folder, self._listed = folder, read_checksums(folder)
        for name in (*first, PAIRS):
            self.read(name)
        self.rows = read_rows(folder / PAIRS, kind)
        count = max(len(self.rows), 1) if count is None else count
        if [row.number for row in self.rows] != list(range(count)):
            raise DatasetError(f"{folder / PAIRS} does not hold the pairs 0 to {count - 1}; download it again")

    def row(self, number: int) -> Row:
        """Line of a pair."""
        if not 0 <= number < len(self.rows):
            raise DatasetError(f"pair {number}: there are {len(self.rows)}, numbered from 0; ask for one of them")
        return self.rows[number]

    def read(self, name: str) -> bytes:
        """Bytes of a file of the set."""
        if name not in self._listed:
            raise DatasetError(f"{self.folder / name} is not listed in {CHECKSUMS}; {_AGAIN}")
        data = InputFile(self.folder / name, _AGAIN).read()
        if hashlib.sha256(data).hexdigest() != self._listed[name]:
            raise DatasetError(
                f"{self.folder / name} was changed, its SHA-256 is not the listed one; download it again"
            )
        return data

    def image(self, name: str, camera: Camera) -> NDArray[Any]:
        """Image of a file, of the camera's size, read-only: 16 bits with one channel, or 8 bits."""
        file = InputFile(self.folder / name, _AGAIN)
        picture = file.picture(data=self.read(name))
        if picture.size != (camera.width_px, camera.height_px):
            raise file.fault(f"has {picture.width} x {picture.height} pixels, not those of the pair's camera")
        if picture.mode not in _MODES:
            raise file.fault(f"is a picture of mode {picture.mode}: allowed are {', '.join(_MODES)}")
        image = np.array(picture)
        result = image.astype(np.uint16) if image.ndim == 2 else image
        result.flags.writeable = False
        return result

    def check(self) -> None:
        """Read every file once.

        Raises
        ------
        DatasetError
            If a file is missing, changed, or not of the set.
        """
        for name in self._listed:
            self.read(name)
        paths = [path for path in (self.folder / FRAMES).rglob("*") if path.is_symlink() or not path.is_dir()]
        if strays := sorted({path.relative_to(self.folder).as_posix() for path in paths} - set(self._listed)):
            raise DatasetError(f"{self.folder / strays[0]} is not of the set; remove it")
