"""Reader of a real camera's pictures: pixels, EXIF, JPEG tables, linear light, sensor preset; mixed cameras refused.

Formats are those of `camera_pictures`, and headerless raw (`.raw`). That holds nothing but DN, row by row: 8 bits, or
16 bits with the low byte first, whose size comes from the rig file and whose bits from the sensor file. No colour is
managed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.datasets.common.camera_pictures import IN_WORDS, Kind, Subsampling, read_camera_picture
from phibench.datasets.common.input_files import InputFile
from phibench.datasets.frames.sensor_card import SensorCard, card_of, sensor_card
from phibench.datasets.frames.sensor_file import SensorFile
from phibench.datasets.rooms.panorama_files import is_linear, read_light, srgb_codes
from phibench.estimator.interface import Image
from phibench.estimator.spots.camera_codes import quantisation
from phibench.estimator.spots.image_planes import ImageError, linear_planes
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig

_REMEDY = f"give the camera's own picture as {IN_WORDS}"


@dataclass(frozen=True)
class Photo:
    """A picture as the camera delivered it.

    Attributes
    ----------
    path : Path
    pixels : array, read-only
        By `kind`: "jpeg" and "rgb" (H, W, 3) uint8; "yuyv" (H, W, 2) uint8; "raw" (H, W) uint16, DN.
    kind : "jpeg", "rgb", "yuyv" or "raw"
    camera : str
        Maker and model of EXIF; "" where there is none.
    tables : arrays of shape (8, 8)
        Quantisation tables of a JPEG; none otherwise.
    subsampling : str
        Chroma of a JPEG, such as "4:2:2".
    orientation : int
        Of EXIF, by which the stored rows were turned upright; 1 for none.
    grey : bool
        The file has one channel of 8 bits.
    """

    path: Path
    pixels: Image = field(repr=False)
    kind: Kind
    camera: str = ""
    tables: tuple[Array, ...] = field(default=(), repr=False)
    subsampling: Subsampling | None = None
    orientation: int = 1
    grey: bool = False

    @property
    def size_px(self) -> tuple[int, int]:
        """(width, height)."""
        return self.pixels.shape[1], self.pixels.shape[0]


# -- reading ---------------------------------------------------------------------------------------------------------


def read_picture(path: Path) -> Photo:
    """Picture of a file with a head, without what a rig or a sensor file says.

    Raises
    ------
    ImageError
        If the file is no picture of the formats that are read (`camera_pictures`); in one sentence.
    """
    picture = read_camera_picture(InputFile(path, _REMEDY, ImageError))
    return Photo(
        path,
        picture.pixels,
        picture.kind,
        picture.camera,
        picture.tables,
        picture.subsampling,
        picture.orientation,
        picture.grey,
    )


def read_photo(path: Path, rig: Rig, given: SensorFile | None = None) -> Photo:
    """Picture of a file, headerless ones included.

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
        If the file is no picture of a camera, or has other pixels than any camera that is known here; in one sentence.
    """
    if path.suffix.lower() != ".raw":
        return read_picture(path)
    file = InputFile(path, _REMEDY, ImageError)
    return Photo(path, _sealed(_headerless(file, file.read(), rig, given)), "raw")


def read_linear(path: Path, given: SensorFile | None = None) -> NDArray[np.float32]:
    """Linear light of a picture, shape (H, W, 3), in any unit; of OpenEXR and Radiance HDR files, too.

    Raises
    ------
    DatasetError
        As `read_picture` and `panorama_files.read_light`.
    """
    if is_linear(path):
        return read_light(path)
    photo = read_picture(path)
    pixels, file = photo.pixels, InputFile(path, _REMEDY, ImageError)
    if given is None and photo.kind in ("jpeg", "rgb"):  # a sensor file says its own curve
        pixels = srgb_codes(file, file.read(), pixels)
    planes = linear_planes(pixels, sensor_choice(photo, given).card)
    return np.asarray(np.maximum(np.moveaxis(planes, 0, -1), 0.0), np.float32)


def require_colour(photo: Photo) -> None:
    """Refuse a grey picture of 8 bits: a spot in it is told by no colour, and its camera's chain is not known here.

    Raises
    ------
    ImageError
        In one sentence.
    """
    if photo.grey:
        raise ImageError(
            f"{photo.path} is a grey picture of 8 bits, in which no spot is fitted; give the camera's colour picture, "
            'or the DN of a monochrome sensor as PGM or PNG of 16 bits with --sensor and preset = "mono-raw"'
        )


def _sealed(image: NDArray[Any]) -> Image:
    image.flags.writeable = False
    return image


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
        if other.size_px == first.size_px[::-1] != first.size_px:
            raise ImageError(
                f"{other.path} is turned by 90 degrees against {first.path}: {other.size_px[0]} x {other.size_px[1]} "
                f"and {first.size_px[0]} x {first.size_px[1]} pixels; give all pictures as the camera delivers them"
            )
        for what, one, two in (
            ("size", f"{first.size_px[0]} x {first.size_px[1]}", f"{other.size_px[0]} x {other.size_px[1]}"),
            ("EXIF orientation", str(first.orientation), str(other.orientation)),
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


_PRESET = {"jpeg": "mjpeg", "rgb": "srgb8", "yuyv": "yuyv", "raw": "bayer-raw"}
_ALSO = {"raw": ("mono-raw",)}


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
            "bits and black level with --sensor, or a photograph with 8 bits"
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
