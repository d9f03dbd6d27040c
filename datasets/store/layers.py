"""EXR files, written and read, and the layers of a data set in them: room's light, laser spot, exact geometry.

A layer is the image of one light source in expected photo-electrons per second. Three kinds of files: ambient (the
room), spot (the laser spot alone) and truth (no light, but exact geometry per pixel). One function writes them all, and
one reads them.

OpenEXR's Python module (3.5) writes wrong pixels for arrays that are not C-contiguous, reads truncated files without
raising, and keeps header floats as float32. Therefore planes are forced to C-contiguous native float32 or half, and the
compression is lossless: ZIP, or PIZ for halves, which takes half of ZIP's time there. Every program reads both; HTJ2K
and ZSTD would halve the files, but few programs read them (Mitsuba 3.9 does not). Exact parameters travel in one JSON
string (attribute `phibench`), with a CRC-32 per plane which is checked on reading.

Planes have the shape (H, W); stacks (3, h, w) hold R, G, B. FORMAT.md lists names and units.
"""

from __future__ import annotations

import errno
import json
import math
import os
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import PICTURE_PIXELS, InputFile, quiet_terminal
from phibench.datasets.common.shown_text import ShortForm
from phibench.datasets.store.files import require_file, write_atomic
from phibench.render.optics.truth import angle_planes
from phibench.scenes.camera import FILTERS, LARGEST_SIDE_PX
from phibench.scenes.frames import Array
from phibench.scenes.rig import View
from phibench.scenes.validation import printable_line

ATTRIBUTE = "phibench"
MOST_PLANES = 64  # of a file, more than any layer has
Plane = NDArray[np.float32]


@dataclass(frozen=True)
class ExrFile:
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
    path: Path,
    planes: Mapping[str, ArrayLike],
    header: Mapping[str, Any],
    origin_px: tuple[int, int] = (0, 0),
    *,
    half: bool = False,
) -> Path:
    """Write named planes of one shape (H, W) as float32, without loss, atomically.

    Parameters
    ----------
    planes : mapping of str to array, shape (H, W)
        Any memory order, byte order and real type; rounded to float32. A finite value beyond float32 is refused.
    header : mapping
        Anything that JSON can hold; floats survive exactly.
    origin_px : (u0, v0)
        Image pixel of the first column and row.
    half : bool
        Write float16 instead; a finite value beyond 65504 is refused.

    Raises
    ------
    DatasetError
        If the planes are none, not two-dimensional, empty, of several shapes or beyond float32.
    """
    kind = np.float16 if half else np.float32
    arrays = {name: _real(name, plane, kind) for name, plane in planes.items()}
    _check_shapes(arrays)
    sums = {name: zlib.crc32(array.data) for name, array in arrays.items()}
    text = json.dumps({"header": dict(header), "crc32": sums}, allow_nan=False)

    return write_atomic(path, lambda temporary: _write(temporary, arrays, text, origin_px, half))


def read_exr(path: Path, most_planes: int = MOST_PLANES) -> ExrFile:
    """Read a file that `write_exr` wrote; one with more planes is refused before they are decoded.

    Raises
    ------
    DatasetError
        If the file is missing, damaged, truncated or not one of ours.
    """
    import OpenEXR

    _check_readable(path)
    try:
        with quiet_terminal(), OpenEXR.File(str(path), header_only=True) as file:
            _check_size(path, [part.header for part in file.parts], most_planes)
        with quiet_terminal(), OpenEXR.File(str(path), separate_channels=True) as file:
            if not file.parts:
                raise DatasetError(f"{path} is damaged or truncated")
            return _content(path, file.header(), {name: c.pixels for name, c in file.channels().items()})
    except (RuntimeError, ValueError, TypeError, LookupError, AttributeError, OverflowError, MemoryError) as error:
        if isinstance(error, DatasetError):
            raise
        raise DatasetError(f"{path} is damaged: {printable_line(str(error), 300)}") from error


def _check_size(path: Path, headers: list[dict[str, Any]], most_planes: int) -> None:
    """Refuse a file that declares more pixels, planes or parts than any layer has, before they are decoded."""
    header = headers[0] if headers else {}
    if "dataWindow" not in header or "channels" not in header:
        raise DatasetError(f"{path} is damaged or truncated")
    if len(headers) > 1 or len(header["channels"]) > most_planes:
        what = f"{len(headers)} parts" if len(headers) > 1 else f"{len(header['channels'])} planes"
        raise DatasetError(f"{path} was not written by phibench: it has {what}, at most {most_planes} in one part")
    low, high = (np.asarray(corner, dtype=np.int64) for corner in header["dataWindow"])
    width, height = (high - low + 1).tolist()
    if not (0 < width <= LARGEST_SIDE_PX and 0 < height <= LARGEST_SIDE_PX and width * height <= PICTURE_PIXELS):
        raise DatasetError(f"{path} is damaged: it says that it has {width} x {height} pixels")


def _write(path: Path, planes: dict[str, NDArray[Any]], text: str, origin_px: tuple[int, int], half: bool) -> None:
    import OpenEXR

    height, width = next(iter(planes.values())).shape
    low = np.array(origin_px, np.int32)
    window = (low, low + np.array([width - 1, height - 1], np.int32))
    header = {
        "compression": OpenEXR.PIZ_COMPRESSION if half else OpenEXR.ZIP_COMPRESSION,
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
    """Refuse what is missing, a folder or a pipe; the library opens it by name."""
    try:
        require_file(path).open("rb").close()
    except FileNotFoundError as error:
        raise DatasetError(f"{path} is missing") from error
    except OSError as error:
        raise DatasetError(f"{path} is not readable: {error.strerror or error}") from error


def _content(path: Path, header: dict[str, Any], planes: dict[str, Plane]) -> ExrFile:
    if ATTRIBUTE not in header:
        raise DatasetError(f"{path} was not written by phibench: it has no attribute '{ATTRIBUTE}'")
    document = InputFile(path, "render it again").json(header[ATTRIBUTE].encode())
    if not isinstance(document.get("header"), dict):
        raise DatasetError(f"{path} is damaged: its attribute '{ATTRIBUTE}' has no header")
    if {name: zlib.crc32(np.ascontiguousarray(plane).data) for name, plane in planes.items()} != document.get("crc32"):
        raise DatasetError(f"{path} is damaged: its pixels do not have the checksums of its header")
    u0, v0 = (int(x) for x in header["dataWindow"][0])
    return ExrFile(
        {name: plane.astype(np.float32, copy=False) for name, plane in planes.items()}, document["header"], (u0, v0)
    )


def _real(name: str, plane: ArrayLike, kind: type[np.floating]) -> NDArray[Any]:
    array = np.asarray(plane)
    if array.dtype.kind not in "fiub":
        raise DatasetError(f"plane '{name}' has type {array.dtype}: real numbers are needed")
    with np.errstate(over="ignore"):
        result = np.ascontiguousarray(array, dtype=kind)
    if array.dtype != kind and (endless := np.isinf(result)).any() and np.any(np.isfinite(array[endless])):
        largest = "float32 (3.4e38)" if kind is np.float32 else "float16 (65504)"
        raise DatasetError(f"plane '{name}' has a finite value beyond {largest}")
    return result


def _check_shapes(arrays: dict[str, NDArray[Any]]) -> None:
    shapes = {array.shape for array in arrays.values()}
    if len(shapes) != 1:
        raise DatasetError(f"planes of one shape are needed, not of {len(shapes)}: {sorted(shapes)}")
    shape = shapes.pop()
    if len(shape) != 2 or 0 in shape:
        raise DatasetError(f"planes of shape (H, W), both above 0, are needed, not {shape}")


# Layers: their planes, and what their headers say.

STORED_TRUTH_PLANES = ("x_m", "y_m", "z_m", "depth_m", "path_m", "object_id")
"""Planes of a file; the angles at the mirror follow from the rig and the pixel, and `read_truth` computes them."""
AMBIENT_PLANES = (*FILTERS, *(f"sd.{name}" for name in FILTERS))
_SD_BITS = 4  # of a standard deviation's fraction: 3 %, which is less than is known of it
SPOT_STACKS = {"electrons_per_s": "", "du_electrons_per_s_px": "du.", "dv_electrons_per_s_px": "dv."}
"""Arrays of a spot layer, shape (3, h, w), and the prefix of their planes: R, G, B, du.R, ..."""
SPOT_PLANES = tuple(prefix + name for prefix in SPOT_STACKS.values() for name in FILTERS)


@dataclass(frozen=True, repr=False)
class SpotWindow(ShortForm):
    """A spot layer: images of one spot on a small window.

    Attributes
    ----------
    u0_px, v0_px : int
        Image pixel of the window's first column and row; the window may reach beyond the image.
    electrons_per_s : array, shape (3, h, w), float64
        Expected photo-electrons per second per pixel behind R, G, B. h = w = 0 where no light reaches the image.
    du_electrons_per_s_px, dv_electrons_per_s_px : arrays, shape (3, h, w)
        Derivatives with respect to a shift of the spot's image by +u, +v.
    """

    u0_px: int
    v0_px: int
    electrons_per_s: Array
    du_electrons_per_s_px: Array
    dv_electrons_per_s_px: Array

    def _shown(self) -> dict[str, Any]:
        return {"first pixel": (self.u0_px, self.v0_px), "electrons/s": self.electrons_per_s}

    @classmethod
    def empty(cls) -> SpotWindow:
        """Return the window of a spot that sends no light to the image."""
        none = np.zeros((3, 0, 0))
        return cls(0, 0, none, none, none)

    def add_to(self, image: Array, gain: float = 1.0) -> None:
        """Add `gain` times the window to an image, shape (3, H, W), in place; what lies outside is lost."""
        height, width = image.shape[1:]
        rows, columns = self.electrons_per_s.shape[1:]
        v0, v1 = max(self.v0_px, 0), min(self.v0_px + rows, height)
        u0, u1 = max(self.u0_px, 0), min(self.u0_px + columns, width)
        if v0 < v1 and u0 < u1:
            electrons = self.electrons_per_s[:, v0 - self.v0_px : v1 - self.v0_px, u0 - self.u0_px : u1 - self.u0_px]
            image[:, v0:v1, u0:u1] += gain * electrons


def write_ambient(path: Path, planes: NDArray[Any], variance: NDArray[Any], header: Mapping[str, Any]) -> Path:
    """Write an ambient layer and its variance, shape (3, H, W) each, as halves: planes R, G, B, sd.R, sd.G, sd.B.

    A half rounds by 2^-11 at most: 0.05 of the sensor's noise of a pixel that is almost full (12 000 electrons), and
    less of others. Values are divided by a power of two, `scale` in the header.
    """
    with np.errstate(invalid="ignore"):
        noise = np.sqrt(variance)
    largest = max(float(np.max(planes, initial=0.0)), float(np.nanmax(noise, initial=0.0)))
    scale = 2.0 ** math.ceil(math.log2(largest / 32768.0)) if 0.0 < largest < math.inf else 1.0
    halves = (np.asarray(planes / scale, dtype=np.float16), _coarse(np.asarray(noise / scale, dtype=np.float16)))
    header = {"kind": "ambient", "unit": "electrons/s", **header, "scale": scale}
    return write_exr(path, dict(zip(AMBIENT_PLANES, np.concatenate(halves), strict=True)), header, half=True)


def _coarse(halves: NDArray[np.float16]) -> NDArray[np.float16]:
    """Finite halves, rounded to the bits of a standard deviation: they shrink to half of their size."""
    step = np.uint16(1 << (10 - _SD_BITS))
    rounded = ((halves.view(np.uint16) + step // 2) // step * step).view(np.float16)
    return np.where(np.isfinite(halves), rounded, halves)


def read_ambient(path: Path, **owner: str) -> NDArray[np.float32]:
    """Read an ambient layer, shape (3, H, W), electrons per second; `owner` as in `read_layer`."""
    file = read_layer(path, "ambient", FILTERS, **owner)
    return _scaled(path, file, "")


def read_ambient_variance(path: Path, **owner: str) -> NDArray[np.float32]:
    """Read the variance of an ambient layer, shape (3, H, W), (electrons per second) squared; `owner` likewise."""
    return read_ambient_pair(path, **owner)[1]


def read_ambient_pair(path: Path, **owner: str) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Read an ambient layer and its variance; `owner` likewise."""
    file = read_layer(path, "ambient", FILTERS, **owner)
    planes = _scaled(path, file, "")
    if "var.R" in file.planes:  # before version 8
        return planes, _scaled(path, file, "var.")
    if missing := [name for name in AMBIENT_PLANES if name not in file.planes]:
        raise DatasetError(f"{path} lacks the planes {', '.join(missing)}")
    return planes, np.square(_scaled(path, file, "sd."))


def _scaled(path: Path, file: ExrFile, prefix: str) -> NDArray[np.float32]:
    scale = file.header.get("scale", 1.0)
    if not isinstance(scale, float | int) or not 0.0 < scale < math.inf:
        raise DatasetError(f"{path} has the scale {printable_line(str(scale), 60)} instead of a number above 0")
    return np.stack([file.planes[prefix + name] for name in FILTERS]) * np.float32(scale)


def write_truth(path: Path, planes: Mapping[str, Array], header: Mapping[str, Any]) -> Path:
    """Write a truth layer: the planes `STORED_TRUTH_PLANES`."""
    return write_exr(path, {name: planes[name] for name in STORED_TRUTH_PLANES}, {"kind": "truth", **header})


def read_truth(path: Path, view: View, **owner: str) -> dict[str, NDArray[Any]]:
    """Read a truth layer of a view: float64 planes (H, W) with NaN where there is nothing; `object_id` int32, -1 there.

    The planes are `truth.TRUTH_PLANES`. Angles are computed in double, also where an older file holds them.
    """
    file = read_layer(path, "truth", STORED_TRUTH_PLANES, **owner)
    planes: dict[str, NDArray[Any]] = {name: file.planes[name].astype(float) for name in STORED_TRUTH_PLANES[:-1]}
    ids = file.planes["object_id"].astype(np.int32)
    camera = view.rig.camera
    if ids.shape != (camera.height_px, camera.width_px):
        raise DatasetError(f"{path} has {ids.shape} pixels instead of {(camera.height_px, camera.width_px)}")
    return {**planes, **angle_planes(view, ids >= 0), "object_id": ids}


def write_spot(path: Path, layer: SpotWindow, header: Mapping[str, Any]) -> Path:
    """Write a spot layer: planes R, G, B and their derivatives, in a data window."""
    stacks = ((prefix, getattr(layer, name)) for name, prefix in SPOT_STACKS.items())
    planes = {prefix + name: plane for prefix, stack in stacks for name, plane in zip(FILTERS, stack, strict=True)}
    header = {"kind": "spot", "unit": "electrons/s", **header}
    return write_exr(path, planes, header, (layer.u0_px, layer.v0_px))


def read_spot(path: Path, **owner: str) -> SpotWindow:
    """Read a spot layer; `owner` as in `read_layer`."""
    file = read_layer(path, "spot", SPOT_PLANES, **owner)
    stacks = [
        np.stack([file.planes[prefix + name] for name in FILTERS]).astype(float) for prefix in SPOT_STACKS.values()
    ]
    return SpotWindow(*file.origin_px, *stacks)


def read_layer(path: Path, kind: str, planes: tuple[str, ...], **owner: str) -> ExrFile:
    """Read a layer and check what it is.

    Parameters
    ----------
    kind : "ambient", "truth" or "spot"
    planes : names of the planes that must be there
    **owner : str
        What the header must say: `dataset`, and `pose` or `sample_id` and `position`. A file of another pose or
        sample under the right name is refused.

    Raises
    ------
    DatasetError
        If the file cannot be read or is not that layer.
    """
    try:
        file = read_exr(path)
    except DatasetError as error:
        raise DatasetError(f"{error}; `phibench dataset repair` renders it again") from error
    if file.header.get("kind") != kind:
        raise DatasetError(f"{path} holds a layer of kind '{file.header.get('kind')}', not '{kind}'")
    if missing := [name for name in planes if name not in file.planes]:
        raise DatasetError(f"{path} lacks the planes {', '.join(missing)}")
    if wrong := [key for key, value in owner.items() if file.header.get(key) != value]:
        held, meant = (", ".join(f"{key} {table.get(key)}" for key in wrong) for table in (file.header, owner))
        raise DatasetError(f"{path} is the {kind} layer of {held}, not of {meant}; run `phibench dataset verify`")
    return file
