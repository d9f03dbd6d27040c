"""Reader of pictures with linear light: photographs, OpenEXR, Radiance HDR, and equirectangular panoramas of them.

Photographs of 8 bits count as sRGB and are turned upright as their EXIF data say. EXR and HDR files hold linear values.
All give an array of bands R, G, B in any unit, upper row first.

Radiance HDR: G. Ward, in Graphics Gems II (1991); a pixel holds three mantissas and an exponent e, and means
mantissa x 2^(e - 136). Rows may be run-length coded, a byte plane at a time.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from phibench.datasets.common.camera_pictures import IN_WORDS, read_camera_picture
from phibench.datasets.common.input_files import PICTURE_PIXELS, InputFile, quiet_terminal
from phibench.datasets.rooms.room_files import RoomError
from phibench.render.sensor.srgb import srgb_decoded
from phibench.scenes.validation import printable_line

Light = NDArray[np.float32]
"""Shape (rows, columns, 3), linear, 0 or more, finite."""

ASPECT = 2.0  # columns over rows of an equirectangular picture
_ASPECT_TOLERANCE = 0.01  # a picture that was scaled has lost a row or column
_LEAST_ROWS = 16
_REMEDY = f"give a picture as {IN_WORDS}, OpenEXR or Radiance HDR"
_HDR_MAGIC = (b"#?RADIANCE", b"#?RGBE")
_OVERSHOOT = 0.01  # of the light, below 0
_EXR_MAGIC = b"\x76\x2f\x31\x01"
_EXR_VALUES = 4 * PICTURE_PIXELS  # of all channels: R, G, B and A of the largest picture
_EXPOSURE = re.compile(rb"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_ROWS = 256  # decoded at once


def read_panorama(path: Path) -> Light:
    """Linear light of an equirectangular picture.

    Raises
    ------
    RoomError
        If the file cannot be read, or its sides are not 2 : 1 within 1 %.
    """
    light = read_light(path)
    rows, columns = light.shape[:2]
    if rows < _LEAST_ROWS or abs(columns / rows - ASPECT) > ASPECT * _ASPECT_TOLERANCE:
        raise RoomError(
            f"{path} has {columns} x {rows} pixels: an equirectangular panorama is twice as wide as high, within 1 %, "
            f"and has {_LEAST_ROWS} rows or more; give the whole sphere, uncut"
        )
    return light


def read_light(path: Path) -> Light:
    """Linear light of a picture.

    Raises
    ------
    RoomError
        If the file is missing, damaged, too large or of another kind, or holds values that are no light.
    """
    file = InputFile(path, _REMEDY, RoomError)
    data = file.read()
    if data[:4] == _EXR_MAGIC:
        light = _exr(file)
    elif data.startswith(_HDR_MAGIC):
        light = _hdr(file, data)
    else:
        light = _photograph(file, data)
    lit = np.maximum(light, 0.0)
    # lossy compression overshoots beside lamps, below 0 as well
    if not np.isfinite(light).all() or lit.sum(dtype=float) - light.sum(dtype=float) > _OVERSHOOT * lit.sum(
        dtype=float
    ):
        raise file.fault(
            f"has pixels that are no finite numbers, or negative ones of more than {100 * _OVERSHOOT:g} % of its light"
        )
    return np.asarray(lit, dtype=np.float32)


def is_linear(path: Path) -> bool:
    """Tell whether a file begins like OpenEXR or Radiance HDR, whose values are linear."""
    data = InputFile(path, _REMEDY, RoomError).read()
    return data[:4] == _EXR_MAGIC or data.startswith(_HDR_MAGIC)


def _photograph(file: InputFile, data: bytes) -> Light:
    picture = read_camera_picture(file, data)
    if picture.kind not in ("jpeg", "rgb"):
        raise file.fault("is no photograph of 8 bits: of DN of a mosaic and of YUYV the colours are not known here")
    linear = srgb_decoded(np.arange(256) / 255.0).astype(np.float32)
    return linear[picture.pixels]


def _exr(file: InputFile) -> Light:
    """Channels R, G and B, or Y alone, of an OpenEXR file."""
    import OpenEXR

    with file.decoding("is a damaged OpenEXR file"):
        with quiet_terminal(), OpenEXR.File(str(file.path), header_only=True) as opened:
            low, high = (np.asarray(corner, dtype=np.int64) for corner in opened.header()["dataWindow"])
            channels, parts = len(opened.header().get("channels", ())), len(opened.parts)
        columns, rows = (high - low + 1).tolist()
        if not (0 < columns and 0 < rows and columns * rows <= PICTURE_PIXELS):
            raise file.fault(f"has {columns} x {rows} pixels: at most {PICTURE_PIXELS:.0e} are read")
        if parts != 1 or columns * rows * channels > _EXR_VALUES:
            raise file.fault(f"has {channels} channels in {parts} parts: one part with R, G and B is read")
        with quiet_terminal(), OpenEXR.File(str(file.path), separate_channels=True) as opened:
            planes = {name: np.asarray(channel.pixels) for name, channel in opened.channels().items()}
    names = ("R", "G", "B") if "R" in planes else ("Y", "Y", "Y")
    if not all(name in planes and planes[name].shape == (rows, columns) for name in names):
        raise file.fault("has no channels R, G and B of one size")
    return np.stack([planes[name].astype(np.float32) for name in names], axis=-1)


# Radiance HDR.


def _hdr(file: InputFile, data: bytes) -> Light:
    head, _, rest = data.partition(b"\n\n")
    if b"FORMAT=32-bit_rle_rgbe" not in head:
        raise file.fault("is no Radiance file of the format 32-bit_rle_rgbe")
    line, _, pixels = rest.partition(b"\n")
    size = re.fullmatch(rb"-Y (\d{1,6}) \+X (\d{1,6})\s*", line)
    if size is None:
        raise file.fault("is a Radiance file whose first row is not the upper one, from left to right")
    rows, columns = int(size[1]), int(size[2])
    if not 0 < rows * columns <= PICTURE_PIXELS:
        raise file.fault(f"has {columns} x {rows} pixels: at most {PICTURE_PIXELS:.0e} are read")
    try:
        coded = _hdr_pixels(pixels, rows, columns)
    except (IndexError, ValueError) as error:
        raise file.fault("is a damaged Radiance file: its rows do not have the stated length") from error
    exposure = _exposure(file, head)
    light = np.empty((rows, columns, 3), np.float32)
    for start in range(0, rows, _ROWS):
        lines = coded[start : start + _ROWS]
        # RGBE: 128 of the exponent, 8 of the mantissa's bits
        scale = np.exp2(lines[..., 3].astype(np.int32) - 136.0) * (lines[..., 3] > 0)
        light[start : start + _ROWS] = lines[..., :3] * (scale / exposure)[..., None]
    return light


def _exposure(file: InputFile, head: bytes) -> float:
    """Product of all exposures that a header states."""
    exposure = 1.0
    for text in re.findall(rb"^EXPOSURE=(.*)$", head, re.M):
        exposure *= float(text) if _EXPOSURE.fullmatch(text.strip()) else 0.0
        if not 1e-30 < exposure < 1e30:  # float32 ends at 1e38
            shown = printable_line(text.decode("latin-1").strip(), 40)
            raise file.fault(f"has EXPOSURE={shown}: a number above 0 is needed")
    return exposure


def _hdr_pixels(data: bytes, rows: int, columns: int) -> NDArray[np.uint8]:
    """Mantissas and exponents, shape (rows, columns, 4)."""
    if data[:2] != b"\x02\x02" or not 8 <= columns < 32768:  # the newer code's limits, by Radiance's own reader
        if len(data) != 4 * rows * columns:
            raise ValueError("neither plain nor of the newer run-length code")
        return np.frombuffer(data, np.uint8).reshape(rows, columns, 4)
    result = np.empty((rows, 4, columns), np.uint8)
    at = 0
    for row in result:
        if data[at : at + 4] != bytes((2, 2, columns >> 8, columns & 255)):
            raise ValueError("no head of a row")
        at = _hdr_row(data, at + 4, row)
    return result.transpose(0, 2, 1)


def _hdr_row(data: bytes, at: int, row: NDArray[np.uint8]) -> int:
    """Decode the four byte planes of a row; return the place after it."""
    columns = row.shape[1]
    for plane in row:
        decoded = bytearray()
        while len(decoded) < columns:
            count = data[at]
            if count > 128:  # a run; otherwise as many single bytes
                decoded += data[at + 1 : at + 2] * (count - 128)
                at += 2
            else:
                decoded += data[at + 1 : at + 1 + count]
                at += 1 + count
                if count == 0:
                    raise ValueError("a run of no length")
        plane[:] = np.frombuffer(decoded, np.uint8)
    return at
