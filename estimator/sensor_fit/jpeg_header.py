"""Header of a JPEG file: quantisation tables, subsampling of chroma, restart interval."""

from __future__ import annotations

import io
from dataclasses import dataclass

from PIL import Image

from phibench.estimator.sensor_fit.capture_folder import CaptureError

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
    except OSError as error:
        raise CaptureError(f"{name} is no JPEG file; give the bytes that the camera sent") from error
    if len(layers) != 3 or not tables:
        raise CaptureError(f"{name} has {len(layers)} planes: a colour JPEG of the camera has three")
    of_luma, of_chroma = (tuple(int(step) for step in tables[layers[k][3]]) for k in (0, 1))
    factors = (layers[0][1] // layers[1][1], layers[0][2] // layers[1][2])
    if factors not in _SUBSAMPLING:
        raise CaptureError(f"{name} has chroma of {factors[0]} x {factors[1]} pixels: 4:4:4, 4:2:2 and 4:2:0 are known")
    found = (of_luma, of_chroma)
    return JpegHeader(found, _quality(found), _SUBSAMPLING[factors], _restart_interval(data))


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
        if marker == 0xDD:
            return int.from_bytes(data[place + 4 : place + 6], "big")
        if marker == 0xDA:
            return 0
        place += 2 + length
    return 0
