"""Writer of a frame (PNG, JPEG, EXR) and its preview; index of a folder of frames; each folder is for one request.

A frame is written as PNG, as the chain's JPEG, or as EXR; a frame that a viewer shows dark gets a preview for
people. The index has one row per file: its SHA-256, every number that it depends on, and the truth of its image. It is
written twice, as `frames.jsonl` and as `frames.parquet`.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import FileName, InputFile
from phibench.datasets.frames.frame_source import Frame
from phibench.datasets.store.files import read_rows, write_bytes, write_text
from phibench.datasets.store.layers import write_exr
from phibench.datasets.store.parquet_tables import model_table, parquet_bytes
from phibench.datasets.store.schema import Document, Number, Position, TruthFile, described
from phibench.render.sensor import processing
from phibench.render.sensor.settings import Sensor
from phibench.scenes.camera import FILTERS
from phibench.scenes.validation import printable_line

VALUES = {
    "electrons": "expected electrons in one exposure behind R, G, B, float32",
    "raw": "DN of the converter, not scaled, in 16 bits; RGGB by the pixel's place on the sensor",
    "srgb8": "sRGB, 8 bits",
    "yuyv": "Y' and, in turns, Cb (even columns of the sensor) and Cr, 8 bits, the bytes of a YUYV buffer",
    "mjpeg": "sRGB, 8 bits, in a JPEG",
}
PREVIEW = "sRGB, 8 bits, for people; not the camera's"


def suffix(sensor: Sensor, whole: bool) -> str:
    """End of the file's name; a part of an MJPEG frame is no JPEG file of the camera and goes into a PNG."""
    if sensor.output == "electrons":
        return ".exr"
    return ".jpg" if sensor.output == "mjpeg" and whole else ".png"


def has_preview(sensor: Sensor) -> bool:
    """True if a picture for people is wanted, because the frame itself is dark or unreadable to a viewer."""
    return sensor.output in ("electrons", "raw", "yuyv")


def write_frame(path: Path, frame: Frame, names: tuple[str, int, str]) -> Path:
    """Write one frame, atomically; `names` are data set, seed and sample id for the EXR's header."""
    if frame.sensor.output == "electrons":
        header = {"kind": "frame", "unit": "electrons", "exposure_s": frame.sensor.exposure_s}
        header |= dict(zip(("dataset", "dataset_seed", "sample_id"), names, strict=True))
        header |= {"position": frame.position, "laser": frame.laser, "draw": frame.draw}
        planes = dict(zip(FILTERS, frame.image, strict=True))
        return write_exr(path, planes, header, (frame.region.u0_px, frame.region.v0_px))
    return write_bytes(path, frame.jpeg if frame.jpeg is not None else png_bytes(frame.image))


def write_preview(path: Path, frame: Frame) -> Path:
    """Write the picture of a frame, atomically."""
    return write_bytes(path, png_bytes(preview(frame)))


def png_bytes(image: NDArray[Any]) -> bytes:
    """PNG of an image, shape (h, w) of 16 bits, (h, w, 2) or (h, w, 3) of 8; two planes are grey and opacity."""
    buffer = io.BytesIO()
    # stated: the bytes must not follow Pillow's default
    Image.fromarray(image).save(buffer, format="PNG", compress_level=6)
    return buffer.getvalue()


def preview(frame: Frame) -> NDArray[np.uint8]:
    """Picture of a frame of electrons, DN or Y'CbCr as the preset's processing would show it, shape (h, w, 3)."""
    sensor = frame.sensor
    if sensor.output == "yuyv":
        first, width = frame.region.u0_px % 2, frame.image.shape[1]
        # reflection gives a pair that the crop divides the chroma of the pair beside
        whole = [(0, 0), (first, (first + width) % 2), (0, 0)]
        padded = np.pad(frame.image, whole, mode="reflect" if width > 1 else "edge")
        return processing.rgb_from_yuyv(padded, sensor)[:, first : first + width]
    if sensor.output == "raw":
        # interpolation starts at a red pixel and needs two rows and columns: reflection keeps the filters' order
        before = frame.region.v0_px % 2, frame.region.u0_px % 2
        padded = frame.image
        for axis, (first, length) in enumerate(zip(before, frame.image.shape, strict=True)):
            width = [(0, 0), (0, 0)]
            width[axis] = (first, 1)
            padded = np.pad(padded, width, mode="reflect" if length > 1 else "edge")
        linear = processing.linear_rgb(processing.linear_signal(padded, sensor, np.float32), sensor)
        height, length = frame.image.shape
        linear = linear[..., before[0] : before[0] + height, before[1] : before[1] + length]
    else:
        full_scale_e = (sensor.top_dn - sensor.black_level_dn) / sensor.dn_per_e
        linear = processing.white_balanced(frame.image / full_scale_e, sensor.white_balance)
        linear = processing.colour_corrected(linear, sensor.colour_matrix)
    return processing.eight_bit(processing.rendered(linear, sensor))


# The index.


INDEX = TruthFile.FRAMES.value
INDEX_TABLE = TruthFile.FRAMES_TABLE.value
REQUEST = "request.json"
TRUTH = ("visible", "cause", "u_px", "v_px", "phi_ray_rad", "phi_normal_rad", "phi_incidence_rad", "azimuth_rad")
"""Fields of a row as in the manifest's `down` or `up`, places and angles of its `light`."""
_IMAGES = (".exr", ".jpg", ".png")


class FrameRow(Document):
    """One file: one line of `frames.jsonl`, one row of `frames.parquet`. FORMAT.md describes it; a test compares."""

    file: FileName = described("-", "name of the file, relative to the folder")
    sha256: str = described("-", "SHA-256 of the file")
    kind: Literal["frame", "preview"] = described("-", "'frame', or 'preview': a picture for people")
    values: str = described("-", "meaning of the numbers in the file")
    dataset: str = described("-", "name of the data set")
    dataset_seed: int = described("-", "its seed; in `frames.parquet` a text if it has 128 bits")
    sample_id: str = described("-", "id of the sample, in the data set's manifest")
    position: Position = described("-", "stroke position, 'down' or 'up'")
    laser: Literal["on", "off"] = described("-", "'on' or 'off'")
    draw: int = described("-", "draw of the noise, from 0")
    preset: str = described("-", "preset of the sensor")
    exposure_s: float = described("s", "exposure time that was used")
    analogue_gain: float = described("1", "gain before the converter that was used")
    jpeg_quality: int | None = described("-", "libjpeg's quality; null unless the camera sends JPEG")
    laser_level: float = described("1", "factor of the laser's light")
    lamp_level: float = described("1", "factor of the room's light")
    u0_px: int = described("px", "column of the sensor that is the file's first column")
    v0_px: int = described("px", "row of the sensor that is the file's first row")
    width_px: int = described("px", "columns of the file")
    height_px: int = described("px", "rows of the file")
    depth_m: float = described("m", "D of the spot's light")
    stroke_m: float = described("m", "stroke h of the pair, the true one")
    visible: bool = described(
        "-", "whether the chief ray of the spot reaches the sensor; of the position, laser on or off"
    )
    cause: str = described("-", "why not; 'none' if visible")
    u_px: Number = described("px", "true centre of the spot's light on the sensor; in the file at u_px - u0_px")
    v_px: Number = described("px", "true centre of the spot's light on the sensor; in the file at v_px - v0_px")
    phi_ray_rad: Number = described("rad", "as in the manifest")
    phi_normal_rad: Number = described("rad", "as in the manifest")
    phi_incidence_rad: Number = described("rad", "as in the manifest")
    azimuth_rad: Number = described("rad", "as in the manifest")
    sensor: dict[str, Any] = described("-", "all numbers of the sensor, after auto exposure")
    request: dict[str, Any] = described("-", "what was asked for")
    key: str = described("-", "hash of all that the file depends on, layers and code included")


def read_index(folder: Path) -> dict[str, FrameRow]:
    """Rows by file name; none where there is no index.

    Raises
    ------
    DatasetError
        With the number of the first line that is not a row.
    """
    path = folder / INDEX
    if not path.exists():
        return {}  # a new folder
    try:
        return {row.file: row for row in read_rows(path, FrameRow)}
    except DatasetError as error:
        raise DatasetError(f"{error}; delete the file and run the command again") from error


def write_index(folder: Path, rows: Iterable[FrameRow]) -> Path:
    """Write all rows in both forms, sorted by file name; each file is complete or not there."""
    ordered = sorted(rows, key=lambda row: row.file)
    write_bytes(folder / INDEX_TABLE, parquet_bytes(model_table(FrameRow, ordered)))
    lines = (json.dumps(row.model_dump(mode="json"), allow_nan=False) + "\n" for row in ordered)
    return write_text(folder / INDEX, "".join(lines))


def claim(folder: Path, dataset: tuple[str, int], wanted: dict[str, Any]) -> None:
    """Write down what the folder is for, before its first frame; refuse one that has frames of something else.

    Raises
    ------
    DatasetError
        With the names and values that differ, or if the note is damaged.
    """
    path = folder / REQUEST
    meant = {"dataset": dataset[0], "dataset_seed": dataset[1], **wanted}
    if not path.exists() or not _has_frames(folder):
        write_text(path, json.dumps(meant, indent=1, allow_nan=False) + "\n")
        return  # a new folder, or one whose run was cut off before its first frame
    held = InputFile(path, "give another folder, `--out FOLDER`").json()
    meant = json.loads(json.dumps(meant))
    if other := [name for name in {**meant, **held} if held.get(name) != meant.get(name)]:
        shown = ((printable_line(name, 60), _shown(held.get(name)), _shown(meant.get(name))) for name in other[:20])
        texts = ", ".join(f"{name} {there}, not {right}" for name, there, right in shown)
        raise DatasetError(f"{folder} holds frames with {texts}: give another folder, `--out FOLDER`")


def _shown(value: Any) -> str:
    return "not given" if value is None else printable_line(str(value), 60)


def _has_frames(folder: Path) -> bool:
    """True if a frame is there, in the index or not."""
    return any(path.suffix in _IMAGES for path in folder.iterdir())
