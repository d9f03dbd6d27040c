"""The one writer and the one reader of EXR files.

OpenEXR's Python module writes wrong pixels for arrays that are not C-contiguous, reads truncated files without
raising, and keeps header floats as float32 (all of 3.5). So: planes are forced to C-contiguous native float32, the
compression is lossless ZIP, exact parameters travel in one JSON string (attribute `phibench`), and that string carries
a CRC-32 per plane which is checked on reading.
"""

from __future__ import annotations

import contextlib
import errno
import io
import json
import os
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phibench.datasets.errors import DatasetError
from phibench.datasets.files import write_atomic

ATTRIBUTE = "phibench"
Plane = NDArray[np.float32]


@dataclass(frozen=True)
class Exr:
    """Content of one EXR file.

    Attributes
    ----------
    planes : dict of str to float32 arrays, shape (H, W)
    header : dict
        The JSON header that was given to `write_exr`.
    origin_px : (u0, v0)
        Image pixel of the first column and row (the EXR data window).
    """

    planes: dict[str, Plane]
    header: dict[str, Any]
    origin_px: tuple[int, int] = (0, 0)


def write_exr(
    path: Path, planes: Mapping[str, ArrayLike], header: Mapping[str, Any], origin_px: tuple[int, int] = (0, 0)
) -> Path:
    """Write named planes of one shape (H, W) as float32, losslessly compressed, atomically.

    Parameters
    ----------
    path : Path
    planes : mapping of str to array, shape (H, W)
        Any memory order, byte order and real type; rounded to float32. A finite value beyond float32 is refused.
    header : mapping
        Anything that JSON can hold; floats survive exactly.
    origin_px : (u0, v0)
        Image pixel of the first column and row.

    Raises
    ------
    DatasetError
        If the planes are none, not two-dimensional, empty, of several shapes or beyond float32.
    """
    arrays = {name: _float32(name, plane) for name, plane in planes.items()}
    _check_shapes(arrays)
    sums = {name: zlib.crc32(array.tobytes()) for name, array in arrays.items()}
    text = json.dumps({"header": dict(header), "crc32": sums}, allow_nan=False)

    def write(temporary: Path) -> None:
        _write(temporary, arrays, text, origin_px)
        try:
            read_exr(temporary)  # checks every pixel before the file gets its name
        except DatasetError as error:
            raise OSError(errno.EIO, "what was written does not read back") from error

    return write_atomic(path, write)


def read_exr(path: Path) -> Exr:
    """Read a file that `write_exr` wrote.

    Raises
    ------
    DatasetError
        If the file is missing, damaged, truncated or not one of ours.
    """
    import OpenEXR

    _check_readable(path)
    try:
        with _quiet(), OpenEXR.File(str(path), separate_channels=True) as file:
            if not file.parts:
                raise DatasetError(f"{path} is damaged or truncated")
            return _content(path, file.header(), {name: c.pixels for name, c in file.channels().items()})
    except (RuntimeError, ValueError, TypeError) as error:
        raise error if isinstance(error, DatasetError) else DatasetError(f"{path} is damaged: {error}") from error


def _write(path: Path, planes: dict[str, Plane], text: str, origin_px: tuple[int, int]) -> None:
    import OpenEXR

    height, width = next(iter(planes.values())).shape
    low = np.array(origin_px, np.int32)
    window = (low, low + np.array([width - 1, height - 1], np.int32))
    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "dataWindow": window,
        "displayWindow": window,
        ATTRIBUTE: text,
    }
    try:
        with OpenEXR.File(header, planes) as file:
            file.write(str(path))
    except RuntimeError as error:
        # "Failed to write pixel data to image file "NAME". File too large.": the reason is what follows the name
        reason = str(error).rsplit(str(path), 1)[-1].strip('". ') or "no reason given"
        code = next((code for code in errno.errorcode if os.strerror(code) == reason), errno.EIO)
        raise OSError(code, reason) from error


def _check_readable(path: Path) -> None:
    try:
        path.open("rb").close()
    except FileNotFoundError as error:
        raise DatasetError(f"{path} is missing") from error
    except OSError as error:
        raise DatasetError(f"{path} is not readable: {error.strerror or error}") from error


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keep what OpenEXR prints about a damaged file off the terminal: it is said once, by the exception."""
    try:
        terminal = os.dup(2)
    except OSError:  # closed by whoever started us: nothing can be printed there
        yield
        return
    try:
        with Path(os.devnull).open("w") as nowhere, contextlib.redirect_stdout(io.StringIO()):
            os.dup2(nowhere.fileno(), 2)
            yield
    finally:
        os.dup2(terminal, 2)
        os.close(terminal)


def _content(path: Path, header: dict[str, Any], planes: dict[str, Plane]) -> Exr:
    if ATTRIBUTE not in header:
        raise DatasetError(f"{path} was not written by phibench: it has no attribute '{ATTRIBUTE}'")
    document = json.loads(header[ATTRIBUTE])
    if {name: zlib.crc32(plane.tobytes()) for name, plane in planes.items()} != document["crc32"]:
        raise DatasetError(f"{path} is damaged: its pixels do not have the checksums of its header")
    u0, v0 = (int(x) for x in header["dataWindow"][0])
    return Exr(planes, document["header"], (u0, v0))


def _float32(name: str, plane: ArrayLike) -> Plane:
    array = np.asarray(plane)
    if array.dtype.kind not in "fiub":
        raise DatasetError(f"plane '{name}' has type {array.dtype}: real numbers are needed")
    with np.errstate(over="ignore"):
        result = np.ascontiguousarray(array, dtype=np.float32)
    if np.any(np.isinf(result) & np.isfinite(array)):
        raise DatasetError(f"plane '{name}' has a finite value beyond float32 (3.4e38)")
    return result


def _check_shapes(arrays: dict[str, Plane]) -> None:
    shapes = {array.shape for array in arrays.values()}
    if len(shapes) != 1:
        raise DatasetError(f"planes of one shape are needed, not of {len(shapes)}: {sorted(shapes)}")
    shape = shapes.pop()
    if len(shape) != 2 or 0 in shape:
        raise DatasetError(f"planes of shape (H, W), both above 0, are needed, not {shape}")
