"""Picture files of a real camera: JPEG, PNG, PGM and headerless raw, with what each tells about its camera.

A JPEG keeps its quantisation tables and the subsampling of its chroma. A PGM or a PNG of 16 bits holds DN of the
mosaic. Headerless raw (`.raw`) holds nothing but DN, row by row: 8 bits, or 16 bits with the low byte first, whose size
comes from the rig file and whose bits from the sensor file. Pixels stay as they are: no colour is managed, nothing is
turned.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image as Picture
from PIL import JpegImagePlugin

from phibench.datasets.frames.sensor_card import SensorCard, card_of, sensor_card
from phibench.datasets.frames.sensor_file import SensorFile
from phibench.datasets.input_files import PICTURE_PIXELS, InputFile
from phibench.estimator.interface import Image
from phibench.estimator.spots.image_planes import ImageError
from phibench.estimator.spots.jpeg_coefficients import quantisation
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig
from phibench.scenes.validation import printable_line

_ORIENTATION, _MAKE, _MODEL = 0x0112, 0x010F, 0x0110  # EXIF tags
Subsampling = Literal["4:4:4", "4:2:2", "4:2:0"]
_SAMPLING: dict[int, Subsampling] = {0: "4:4:4", 1: "4:2:2", 2: "4:2:0"}
_REMEDY = "give the camera's own file"
_PGM = re.compile(rb"P5(?:\s+|\s*#[^\n]*\n\s*)+(\d+)(?:\s+|\s*#[^\n]*\n\s*)+(\d+)(?:\s+|\s*#[^\n]*\n\s*)+(\d+)\s")
Kind = Literal["jpeg", "rgb", "raw"]


@dataclass(frozen=True)
class Photo:
    """A picture as the camera delivered it.

    Attributes
    ----------
    path : Path
    pixels : array, read-only
        By `kind`: "jpeg" and "rgb" (H, W, 3) uint8; "raw" (H, W) uint16, DN.
    kind : "jpeg", "rgb" or "raw"
    camera : str
        Maker and model of EXIF; "" where there is none.
    tables : arrays of shape (8, 8)
        Quantisation tables of a JPEG; none otherwise.
    subsampling : str
        Chroma of a JPEG, such as "4:2:2".
    """

    path: Path
    pixels: Image = field(repr=False)
    kind: Kind
    camera: str = ""
    tables: tuple[Array, ...] = field(default=(), repr=False)
    subsampling: Subsampling | None = None

    @property
    def size_px(self) -> tuple[int, int]:
        """(width, height)."""
        return self.pixels.shape[1], self.pixels.shape[0]


# -- reading ---------------------------------------------------------------------------------------------------------


def read_photo(path: Path, rig: Rig, given: SensorFile | None = None) -> Photo:
    """Picture of a file.

    Parameters
    ----------
    path : Path
    rig : Rig
        Of headerless raw files: their width and height.
    given : SensorFile, optional
        Of a sensor file: the bits of headerless raw files.

    Raises
    ------
    ImageError
        If the file is no picture of a camera, is turned by EXIF, or has other pixels than any camera that is known
        here; in one sentence.
    """
    file = InputFile(path, _REMEDY, ImageError)
    data = file.read()
    if path.suffix.lower() == ".raw":
        return Photo(path, _sealed(_headerless(file, data, rig, given)), "raw")
    if data[:2] == b"P5":
        return Photo(path, _sealed(_pgm(file, data)), "raw")
    picture = file.picture(data=data)
    exif = picture.getexif()
    turned = exif.get(_ORIENTATION, 1)
    if turned != 1:
        raise file.fault(
            f"is turned by EXIF (orientation {printable_line(str(turned), 10)}): its pixels are not in the order of "
            "the sensor that rig and calibration speak of"
        )
    camera = printable_line(" ".join(str(exif[tag]) for tag in (_MAKE, _MODEL) if tag in exif), 80)
    if picture.mode in ("I;16", "I;16B", "I"):
        return Photo(path, _sealed(_sixteen_bits(file, picture)), "raw", camera)
    if picture.mode not in ("RGB", "RGBA"):
        raise file.fault(
            f"is a {picture.format} file of mode {picture.mode}: colour of 8 bits, or one channel of 16 bits is read"
        )
    pixels = np.array(picture.convert("RGB"))
    if picture.format != "JPEG":
        return Photo(path, _sealed(pixels), "rgb", camera)
    tables = tuple(np.array(table, float).reshape(8, 8) for _, table in sorted(picture.quantization.items()))  # type: ignore[attr-defined]
    sampling = _SAMPLING.get(JpegImagePlugin.get_sampling(picture))
    if sampling is None or not tables:
        raise file.fault("is a JPEG with another chroma than 4:4:4, 4:2:2 or 4:2:0")
    return Photo(path, _sealed(pixels), "jpeg", camera, tables, sampling)


def _sealed(image: NDArray[Any]) -> Image:
    image.flags.writeable = False
    return image


def _sixteen_bits(file: InputFile, picture: Picture.Image) -> NDArray[np.uint16]:
    values = np.array(picture)
    if values.min(initial=0) < 0 or values.max(initial=0) > 65535:
        raise file.fault("has pixels beyond 16 bits")
    return values.astype(np.uint16)


def _pgm(file: InputFile, data: bytes) -> NDArray[np.uint16]:
    """DN of a binary PGM; Pillow would stretch them to 16 bits."""
    head = _PGM.match(data[:1000])
    if head is None or any(len(text) > 6 for text in head.groups()):
        raise file.fault("is not a picture of the format PGM")
    width, height, top = (int(text) for text in head.groups())
    if not (0 < width * height <= PICTURE_PIXELS and 0 < top < 65536):
        raise file.fault(f"is a PGM of {width} x {height} pixels up to {top}: no picture of a camera")
    kind = np.dtype(np.uint8) if top < 256 else np.dtype(">u2")
    if len(data) - head.end() != width * height * kind.itemsize:
        raise file.fault(f"is a PGM of another size than the {width} x {height} pixels that it tells")
    return np.frombuffer(data, kind, offset=head.end()).reshape(height, width).astype(np.uint16)


def _headerless(file: InputFile, data: bytes, rig: Rig, given: SensorFile | None) -> NDArray[np.uint16]:
    if given is None:
        raise file.fault("is headerless: its bits and black level are in no file; give them with --sensor")
    width, height = rig.camera.width_px, rig.camera.height_px
    top_dn = given.sensor("bayer-raw").top_dn
    kind = np.dtype(np.uint8) if top_dn < 256 else np.dtype("<u2")
    if len(data) != width * height * kind.itemsize:
        raise file.fault(
            f"has {len(data)} bytes: {width} x {height} pixels of the rig file in {8 * kind.itemsize} bits are "
            f"{width * height * kind.itemsize}"
        )
    pixels = np.frombuffer(data, kind).reshape(height, width).astype(np.uint16)
    if pixels.max(initial=0) > top_dn:
        raise file.fault(f"has DN up to {pixels.max()}: the sensor file's end at {top_dn}")
    return pixels


# -- one camera ------------------------------------------------------------------------------------------------------


def require_one_camera(photos: Sequence[Photo]) -> None:
    """Refuse pictures of different cameras, and one picture given twice.

    Raises
    ------
    ImageError
        In one sentence: which two differ, and in what.
    """
    first = photos[0]
    for other in photos[1:]:
        for what, one, two in (
            ("size", f"{first.size_px[0]} x {first.size_px[1]}", f"{other.size_px[0]} x {other.size_px[1]}"),
            ("kind", first.kind, other.kind),
            ("camera", first.camera, other.camera),
            ("chroma", first.subsampling or "", other.subsampling or ""),
        ):
            if one != two:
                raise ImageError(
                    f"{first.path} and {other.path} are of different cameras: {what} {one or 'not named'} and "
                    f"{two or 'not named'}; give pictures of one camera with one setting"
                )
        if len(first.tables) != len(other.tables) or not all(map(np.array_equal, first.tables, other.tables)):
            raise ImageError(
                f"{first.path} and {other.path} have different quantisation tables: two cameras, or a quality that "
                "changed; give pictures of one camera with one quality"
            )
    for number, photo in enumerate(photos):
        twin = next((other for other in photos[:number] if np.array_equal(photo.pixels, other.pixels)), None)
        if twin is not None and photo.pixels.any():
            raise ImageError(f"{twin.path} and {photo.path} are the same picture; give one of each position")


# -- the sensor behind a picture -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SensorChoice:
    """Sensor that a measurement works with.

    Attributes
    ----------
    card : SensorCard
    assumed : bool
        A preset by the kind of file, because no sensor file was given.
    note : str
        One sentence.
    """

    card: SensorCard
    assumed: bool
    note: str


_PRESET = {"jpeg": "mjpeg", "rgb": "srgb8", "raw": "bayer-raw"}
_ALSO = {"rgb": ("yuyv",), "raw": ("mono-raw",)}


def sensor_choice(photo: Photo, given: SensorFile | None = None) -> SensorChoice:
    """Sensor of a picture: of the sensor file, or the preset of its kind; JPEG tables are always the picture's own.

    The chain of a sensor file ends where the kind of picture says: a file that was fitted to DN holds for the same
    camera's JPEG, too.

    Raises
    ------
    ImageError
        If the picture's DN are beyond the sensor's, or the file's numbers allow no such picture.
    """
    preset = _PRESET[photo.kind]
    if given is None:
        card, source = sensor_card(preset), f"assumed, preset {preset}"
    else:
        preset = given.preset if given.preset in _ALSO.get(photo.kind, ()) else preset
        card, source = card_of(given.sensor(preset)), f"of the sensor file, as {preset}"
    if photo.kind == "raw" and photo.pixels.max(initial=0) > card.top_dn:
        raise ImageError(
            f"{photo.path} has DN up to {photo.pixels.max()}: the sensor's end at {card.top_dn}; give the camera's "
            "bits and black level with --sensor"
        )
    text = "" if given is not None else "; the covariance is widened by the fit's misfit where that is above 1"
    if photo.subsampling is not None:
        quality, off = nearest_quality(photo.tables)
        luma, chroma = photo.tables[0], photo.tables[min(1, len(photo.tables) - 1)]
        own = None if off == 0.0 else (_steps(luma), _steps(chroma))
        card = replace(card, jpeg_quality=quality, jpeg_subsampling=photo.subsampling, jpeg_qtables=own)
        text = f", JPEG quality {quality}{'' if own is None else ' (about: tables of its own)'}{text}"
    return SensorChoice(card, given is None, f"sensor: {source}{text}")


def _steps(table: Array) -> tuple[int, ...]:
    return tuple(int(step) for step in table.ravel())


def nearest_quality(tables: Sequence[Array]) -> tuple[int, float]:
    """Quality of libjpeg whose tables are nearest, and the rms of the logarithm of the steps' ratio."""
    luma, chroma = tables[0], tables[min(1, len(tables) - 1)]

    def off(quality: int) -> float:
        a, b = quantisation(quality)
        ratios = np.log(np.concatenate([luma / a, chroma / b]))
        return float(np.sqrt(np.mean(ratios**2)))

    best = min(range(100, 0, -1), key=off)
    return best, off(best)
