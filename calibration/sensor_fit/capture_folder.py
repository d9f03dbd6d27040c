"""Reader of a folder of frames from which a sensor is measured: its groups, notes, pictures and JPEG headers.

    capture.toml               optional: what the files do not say
    dark/*                     lens capped
    flat/LEVEL/*               an even surface; LEVEL is any name, two frames or more of each
    exposure/SECONDS/*         the same surface, lamp unchanged; SECONDS is a number
    dark-exposure/SECONDS/*    lens capped
    edge/*                     straight edges, 2 to 15 degrees from rows or columns
    chessboard/*               views of one chessboard

Files are PNG, PGM, TIFF or BMP with one plane of up to 16 bits (raw), headerless YUYV (`.yuyv`), PNG with
R, G, B, or the camera's JPEG. `docs/capture.py` writes such a folder.
"""

from __future__ import annotations

import hashlib
import io
import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from pydantic import Field

from phibench.datasets.common.camera_pictures import read_camera_picture
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import SETTINGS_BYTES, InputFile
from phibench.datasets.store.schema import Document
from phibench.estimator.spots.simple_spots import LUMA
from phibench.scenes.frames import Array
from phibench.scenes.validation import printable_line, structural_faults

Kind = Literal["bayer-raw", "mono-raw", "yuyv", "srgb8", "mjpeg"]
RAW = ("bayer-raw", "mono-raw")
MANIFEST = "capture.toml"
_SUFFIXES = (".png", ".pgm", ".tif", ".tiff", ".bmp", ".yuyv", ".jpg", ".jpeg")
_DRIFT = 0.02  # of the mean, from the least to the largest frame mean of one level
_DRIFT_OF_RANGE = 0.0025  # of full scale: levels near zero jitter by more than a share of themselves
_DRIFT_SIGMAS = 8.0  # of the frames' means: their own noise is no drift
_UNIT = "{0} of which unit? Write {0}.0 for seconds, {1:g} for milliseconds"  # a whole time may be either
_CHROMA_CODES = 20.0  # by which the mean chroma of an even surface may change more than its luma
_CONTAINER_BITS = 16  # files of 16 bits hold codes of fewer bits, too
_FRAME_BYTES = 512 * 2**20  # 250 million pixels of 16 bits


class CaptureError(DatasetError):
    """A folder of frames that cannot be used; the message is one sentence for the person at the terminal."""


class CaptureNotes(Document):
    """`capture.toml`: what the files do not say."""

    camera: str = Field(default="", max_length=200)
    format: Kind | None = None
    width_px: int | None = Field(default=None, ge=8, le=16384)
    height_px: int | None = Field(default=None, ge=8, le=16384)
    bits: int = Field(default=10, ge=8, le=16)
    exposure_s: float | None = Field(default=None, gt=0.0, le=60.0)
    scaled: bool = False  # the camera shrinks its frames after interpolation: not all pixels of the sensor
    analogue_gain: float = Field(default=1.0, ge=1.0, le=16.0)
    board_columns: int | None = Field(default=None, ge=3, le=100)
    board_rows: int | None = Field(default=None, ge=3, le=100)
    board_square_m: float | None = Field(default=None, gt=0.0, le=1.0)
    controls: dict[str, int | float | str] = Field(default_factory=dict)


@dataclass(frozen=True)
class FrameGroup:
    """Files of one level, exposure time or subject.

    Attributes
    ----------
    name : str
        Its folder below the capture, such as "flat/03".
    files : tuple of Path
        By name.
    seconds : float or None
        Exposure time that the folder's name states.
    photons : float or None
        Mean number per pixel that a descriptor states.
    """

    name: str
    files: tuple[Path, ...]
    seconds: float | None = None
    photons: float | None = None


@dataclass(frozen=True)
class FrameOrigin:
    """Camera that a file names in EXIF, "" for none, and the bits of a value as it is stored."""

    camera: str = ""
    bits: int = 8


@dataclass(frozen=True)
class Capture:
    """A folder of frames, looked through but not read.

    Attributes
    ----------
    folder : Path
    notes : CaptureNotes
    kind : str
        Format of its frames, see `Kind`.
    dark : FrameGroup or None
    flats, exposures, dark_exposures : tuples of FrameGroup
    edges, chessboards : FrameGroup or None
    """

    folder: Path
    notes: CaptureNotes
    kind: Kind
    size: tuple[int, int]
    dark: FrameGroup | None
    flats: tuple[FrameGroup, ...] = ()
    exposures: tuple[FrameGroup, ...] = ()
    dark_exposures: tuple[FrameGroup, ...] = ()
    edges: FrameGroup | None = None
    chessboards: FrameGroup | None = None
    _count: int = field(default=0)
    _camera: str = ""

    @property
    def frames(self) -> int:
        """Number of files."""
        return self._count

    def read(self, path: Path) -> NDArray[Any]:
        """One frame: raw (h, w); yuyv (h, w, 2), Y' and in turns Cb, Cr; others (h, w, 3).

        Raises
        ------
        CaptureError
            If the file is no frame of the capture's kind and size.
        """
        kind, image, source = read_frame(path, self.notes)
        if (camera := source.camera) and self._camera and camera != self._camera:
            raise CaptureError(
                f"{path} is of {camera} and the first frame of {self._camera}: a folder holds one camera's"
            )
        if (kind in RAW) != (self.kind in RAW) or (kind not in RAW and kind != self.kind):
            raise CaptureError(f"{path} is {kind} and the first frame {self.kind}: a folder holds one format")
        if image.shape[:2] != self.size:
            (h, w), (height, width) = image.shape[:2], self.size
            raise CaptureError(
                f"{path} has {w} x {h} pixels and the first frame {width} x {height}: a folder holds one size"
            )
        return image

    def stack(self, group: FrameGroup) -> NDArray[Any]:
        """All frames of a group that must not have changed, first axis the frame.

        Raises
        ------
        CaptureError
            If there is one frame only, one came twice, or the level drifts.
        """
        if len(group.files) < 2:
            raise CaptureError(
                f"{self.folder / group.name} has one frame: noise needs two or more of each level, better 16"
            )
        frames = np.stack([self.read(path) for path in group.files])
        self._refuse_drift(group, frames)
        self._refuse_twins(group, frames)
        return frames

    def _refuse_twins(self, group: FrameGroup, frames: NDArray[Any]) -> None:
        """Refuse one frame under two names: its noise counts once. Frames of one or two codes may be alike."""
        for k, twin in self._twins(frames):
            if np.median(np.abs(np.diff(frames[k].astype(float), n=2, axis=0))) >= 1.0:
                one, other = (group.files[i].name for i in (twin, k))
                raise CaptureError(
                    f"{self.folder / group.name}: {one} and {other} are the same frame; noise needs frames that were "
                    "taken one by one, so drop what the camera or its program sent twice"
                )

    @staticmethod
    def _twins(frames: NDArray[Any]) -> Iterator[tuple[int, int]]:
        first: dict[bytes, int] = {}
        for k, frame in enumerate(frames):
            twin = first.setdefault(hashlib.sha256(frame.tobytes()).digest(), k)
            if twin != k:
                yield k, twin

    def _refuse_drift(self, group: FrameGroup, frames: NDArray[Any]) -> None:
        values = frames[..., 0] if self.kind == "yuyv" else frames
        means = np.array([frame.mean() for frame in values])
        noise = float((values[1].astype(float) - values[0]).std()) / np.sqrt(0.5 * values[0].size)
        low, high = float(means.min()), float(means.max())
        # an exposure that the camera changes moves all pixels; single lines of noise move the mean by far less
        if high - low > max(_DRIFT * high, _DRIFT_OF_RANGE * self.full_scale, _DRIFT_SIGMAS * noise):
            capped = group in (self.dark, *self.dark_exposures)
            remedy = (
                "cap the lens, darken the room and let the camera warm up"
                if capped
                else "switch auto exposure, auto gain and auto white balance off, and let lamp and camera warm up"
            )
            raise CaptureError(
                f"{self.folder / group.name}: the mean goes from {low:.1f} to {high:.1f} within one level, and "
                f"{100.0 * _DRIFT:g} % of it or {100.0 * _DRIFT_OF_RANGE:g} % of full scale are allowed; {remedy}"
            )

    @property
    def full_scale(self) -> int:
        """Largest code."""
        return int((1 << self.notes.bits) - 1) if self.kind in RAW else 255


def open_capture(folder: Path) -> Capture:
    """Look a folder through.

    Raises
    ------
    CaptureError
        If there is no such folder, it has no frames, or its notes are not valid.
    """
    if not folder.is_dir():
        raise CaptureError(f"{folder} is no folder: give one with dark/, flat/LEVEL/ and others, see docs/capture.md")
    notes = read_notes(folder / MANIFEST)
    groups = {
        "dark": _group(folder, "dark"),
        "edges": _group(folder, "edge"),
        "chessboards": _group(folder, "chessboard"),
    }
    series = {
        "flats": tuple(_series(folder, "flat", False)),
        "exposures": tuple(_series(folder, "exposure", True)),
        "dark_exposures": tuple(_series(folder, "dark-exposure", True)),
    }
    every = [g for g in groups.values() if g is not None] + [g for many in series.values() for g in many]
    if not every:
        raise CaptureError(
            f"{folder} has no frames: put them into dark/, flat/LEVEL/, exposure/SECONDS/, edge/ or chessboard/ as "
            f"{', '.join(_SUFFIXES)}"
        )
    kind, first, source = read_frame(every[0].files[0], notes)
    if kind in RAW:
        flat = series["flats"][0] if series["flats"] else every[0]
        notes = _with_bits(notes, flat.files[0], read_frame(flat.files[0], notes)[2].bits)
    count = sum(len(group.files) for group in every)
    size = (first.shape[0], first.shape[1])
    found = Capture(folder, notes, kind, size, **groups, **series, _count=count, _camera=source.camera)  # type: ignore[arg-type]
    if kind == "yuyv":
        _refuse_chroma_first(found)
    return found


def _refuse_chroma_first(capture: Capture) -> None:
    """Refuse frames whose second plane is what follows the light: their bytes are those of UYVY."""
    groups = [group for group in (capture.dark, *capture.flats, *capture.exposures) if group is not None]
    means = np.array([capture.read(group.files[0]).mean(axis=(0, 1)) for group in groups]).reshape(-1, 2)
    luma_codes, chroma_codes = np.ptp(means, axis=0) if len(means) else (0.0, 0.0)
    if chroma_codes > luma_codes + _CHROMA_CODES:
        raise CaptureError(
            f"{capture.folder}: from level to level the chroma changes by {chroma_codes:.0f} codes and the luma by "
            f"{luma_codes:.0f}: the bytes are those of UYVY, chroma first; exchange the two bytes of each pixel"
        )


def _with_bits(notes: CaptureNotes, path: Path, stored: int) -> CaptureNotes:
    """Notes with the bits that raw files have, where that is fewer than 16; stated ones must lie in them."""
    if "bits" not in notes.model_fields_set:
        return notes.model_copy(update={"bits": stored}) if stored < _CONTAINER_BITS else notes
    if notes.bits > stored:
        raise CaptureError(
            f"{path} has {stored} bits a pixel, and {MANIFEST} says bits = {notes.bits}: write those of its codes"
        )
    return notes


def read_frame(path: Path, notes: CaptureNotes) -> tuple[Kind, NDArray[Any], FrameOrigin]:
    """One frame with its kind and source: see `Capture.read`."""
    file = InputFile(path, "give the camera's own frame", CaptureError, _FRAME_BYTES)
    if path.suffix.lower() == ".yuyv":
        return "yuyv", _yuyv(file, notes), FrameOrigin()
    picture = read_camera_picture(file)
    source = FrameOrigin(picture.camera, picture.bits)
    if picture.orientation != 1:
        raise file.fault(
            f"is turned by EXIF (orientation {picture.orientation}): `exiftool -Orientation= FILE` ends that"
        )
    if picture.kind == "jpeg":
        return "mjpeg", picture.pixels, source
    if picture.kind == "yuyv":
        second = picture.pixels[..., 1]
        if notes.format not in (None, "yuyv"):
            raise file.fault(f"has two planes, and {MANIFEST} says {notes.format}: save it without opacity")
        is_even = notes.format is None and int(second.min()) == int(second.max())
        if is_even and (second.flat[0] != 128 or picture.pixels[..., 0].std() > 0.0):
            raise file.fault(
                f"has a second plane of {int(second.flat[0])} alone, as opacity is: save grey alone, or write "
                f'format = "yuyv" into {MANIFEST} if it is chroma'
            )
        return "yuyv", picture.pixels, source
    if picture.kind == "raw" or picture.mode == "L":
        values = picture.pixels if picture.kind == "raw" else picture.pixels[..., 0].astype(np.uint16)
        if notes.format in (None, *RAW):
            return ("mono-raw" if notes.format == "mono-raw" else "bayer-raw"), values, source
        raise file.fault(f"has one plane, and {MANIFEST} says {notes.format}")
    if picture.mode in ("RGB", "RGBA", "RGBX"):
        return "srgb8", picture.pixels, source
    raise file.fault(f"has the mode {picture.mode}: one plane (raw), two (YUYV) or R, G, B are read")


def _yuyv(file: InputFile, notes: CaptureNotes) -> NDArray[np.uint8]:
    data = file.read()
    if notes.width_px is None or notes.height_px is None:
        raise file.fault(f"has no header: write width_px and height_px into {MANIFEST}")
    if len(data) != 2 * notes.width_px * notes.height_px:
        raise file.fault(
            f"has {len(data)} bytes, and YUYV of {notes.width_px} x {notes.height_px} has "
            f"{2 * notes.width_px * notes.height_px}"
        )
    return np.frombuffer(data, np.uint8).reshape(notes.height_px, notes.width_px, 2)


def read_notes(path: Path) -> CaptureNotes:
    """Notes of a capture; without a file those of the default camera.

    Raises
    ------
    CaptureError
        If the file is not valid.
    """
    if not path.exists():
        return CaptureNotes()
    file = InputFile(path, "docs/capture.md has an example", CaptureError, SETTINGS_BYTES)
    tables = file.toml()
    if faults := structural_faults(CaptureNotes, tables):
        raise file.fault(f"is damaged: {'; '.join(map(str, faults))}")
    if isinstance(time := tables.get("exposure_s"), int):
        raise file.fault(f"has exposure_s = {_UNIT.format(time, time / 1000)}")
    return CaptureNotes.model_validate(tables)


def _group(folder: Path, name: str, seconds: float | None = None) -> FrameGroup | None:
    place = folder / name
    if not place.is_dir():
        return None
    files = tuple(sorted(p for p in place.iterdir() if p.suffix.lower() in _SUFFIXES and p.is_file()))
    return FrameGroup(name, files, seconds) if files else None


def _series(folder: Path, name: str, timed: bool) -> Iterator[FrameGroup]:
    place = folder / name
    for level in sorted(place.iterdir()) if place.is_dir() else []:
        seconds = _seconds(level) if timed and level.is_dir() else None
        if level.is_dir() and (group := _group(folder, f"{name}/{level.name}", seconds)):
            yield group


def _seconds(level: Path) -> float:
    if not re.fullmatch(r"\d+(\.\d+)?(e-?\d+)?", level.name) or not 0.0 < float(level.name) <= 60.0:
        raise CaptureError(
            f"{printable_line(str(level))}: the folder's name must be its exposure time, seconds, such as 0.0100"
        )
    if level.name.isdigit():
        raise CaptureError(f"{printable_line(str(level))}: {_UNIT.format(int(level.name), int(level.name) / 1000)}")
    return float(level.name)


def luma(image: NDArray[Any], kind: Kind) -> Array:
    """Y' of a processed frame, shape (h, w), BT.601, on 0 to 255 (that of YUYV as it is)."""
    if kind == "yuyv":
        return image[..., 0].astype(float)
    return np.asarray(image.astype(float) @ np.array(LUMA))


# -- header of a JPEG file --------------------------------------------------------------------------------------------

_SUBSAMPLING = {(1, 1): "4:4:4", (2, 1): "4:2:2", (2, 2): "4:2:0"}


@dataclass(frozen=True)
class JpegHeader:
    """Tables and layout that all JPEG files of a camera share.

    Attributes
    ----------
    tables : tables of luma and chroma, 64 steps each, row by row
    quality : libjpeg's quality that has these tables, or None
    subsampling : "4:4:4", "4:2:2" or "4:2:0"
    restart_interval : minimum coded units between restart markers; 0 for none
    """

    tables: tuple[tuple[int, ...], tuple[int, ...]]
    quality: int | None
    subsampling: str
    restart_interval: int


def read_header(data: bytes, name: str) -> JpegHeader:
    """Header of a JPEG file.

    Raises
    ------
    CaptureError
        If it is no baseline JPEG of three components.
    """
    try:
        with Image.open(io.BytesIO(data), formats=("JPEG",)) as picture:
            tables = picture.quantization  # type: ignore[attr-defined]
            layers = picture.layer  # type: ignore[attr-defined]
    except (OSError, ValueError, SyntaxError, LookupError, TypeError, struct.error) as error:
        raise CaptureError(f"{name} is no JPEG file; give the bytes that the camera sent") from error
    if len(layers) != 3 or not tables:
        raise CaptureError(f"{name} has {len(layers)} planes: a colour JPEG of the camera has three")
    if any(layer[3] not in tables or not layer[1] or not layer[2] for layer in layers):
        raise CaptureError(f"{name} is a damaged JPEG file: its planes have no tables or no size")
    of_luma, of_chroma = (tuple(int(step) for step in tables[layers[k][3]]) for k in (0, 1))
    factors = (layers[0][1] // layers[1][1], layers[0][2] // layers[1][2])
    if factors not in _SUBSAMPLING:
        raise CaptureError(f"{name} has chroma of {factors[0]} x {factors[1]} pixels: 4:4:4, 4:2:2 and 4:2:0 are known")
    qtables = (of_luma, of_chroma)
    return JpegHeader(qtables, _quality(qtables), _SUBSAMPLING[factors], _restart_interval(data))


def _quality(tables: tuple[tuple[int, ...], tuple[int, ...]]) -> int | None:
    return next((q for q in range(1, 101) if _tables_of(q) == tables), None)


def _tables_of(quality: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    file = io.BytesIO()
    Image.new("RGB", (8, 8)).save(file, "JPEG", quality=quality)
    with Image.open(file) as picture:
        tables = picture.quantization  # type: ignore[attr-defined]
    return tuple(tables[0]), tuple(tables[1])


def _restart_interval(data: bytes) -> int:
    """Value of the segment DRI before the scan."""
    place = 2
    while place + 4 <= len(data) and data[place] == 0xFF:
        marker, length = data[place + 1], int.from_bytes(data[place + 2 : place + 4], "big")
        if marker == 0xDD:  # DRI: the restart interval
            return int.from_bytes(data[place + 4 : place + 6], "big")
        if marker == 0xDA:  # SOS: the coded image begins
            return 0
        place += 2 + length
    return 0
