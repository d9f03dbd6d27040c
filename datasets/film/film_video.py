"""Films as video files: the camera's own JPEGs or YUYV in AVI or Matroska, and MP4 for looking at.

JPEGs and YUYV frames go into the container as they are; reading gives the same bytes back. MP4 is compressed again.
PyAV is imported when it is needed: `pip install 'phibench[film]'`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from phibench.datasets.errors import DatasetError
from phibench.datasets.store.files import write_atomic
from phibench.scenes.validation import printable_line

Codec = Literal["mjpeg", "yuyv"]
CONTAINERS = {".avi": "avi", ".mkv": "matroska"}
_CODECS = {"mjpeg": ("mjpeg", "yuvj422p"), "yuyv": ("rawvideo", "yuyv422")}


def require_container(path: Path) -> str:
    """Format of a container by its name.

    Raises
    ------
    DatasetError
        If the name ends otherwise, or PyAV is not installed.
    """
    _av()
    if path.suffix not in CONTAINERS:
        raise DatasetError(f"{path}: give a file that ends in {' or '.join(CONTAINERS)}")
    return CONTAINERS[path.suffix]


def write_frames(path: Path, frames: Iterable[bytes], codec: Codec, size: tuple[int, int], rate_hz: float) -> Path:
    """Write frames, one packet each, as they are; size is (height, width).

    Raises
    ------
    DatasetError
        If the name or a frame will not do.
    """
    form, av = require_container(path), _av()
    name, pixels = _CODECS[codec]

    def write(temporary: Path) -> None:
        rate = Fraction(rate_hz).limit_denominator(1001)
        with av.open(str(temporary), "w", format=form, options={"fflags": "+bitexact"}) as container:
            stream = container.add_stream(name, rate=rate)
            stream.height, stream.width, stream.pix_fmt = *size, pixels
            stream.codec_context.flags |= av.codec.context.Flags.bitexact
            for number, data in enumerate(frames):
                packet = av.Packet(data)
                packet.stream, packet.time_base = stream, 1 / rate
                packet.pts = packet.dts = number
                packet.duration, packet.is_keyframe = 1, True
                container.mux(packet)

    return write_atomic(path, write)


def read_frames(path: Path) -> Iterator[bytes]:
    """Bytes of every frame of a container.

    Raises
    ------
    DatasetError
        If it cannot be read.
    """
    av = _av()
    try:
        with av.open(str(path)) as container:
            for packet in container.demux(video=0):
                if packet.size:
                    yield bytes(packet)
    except (OSError, ValueError) as error:
        raise DatasetError(f"{path} is no video that can be read: {printable_line(str(error))}") from error


def write_mp4(path: Path, pictures: Iterable[NDArray[np.uint8]], rate_hz: float) -> Path:
    """Write pictures (h, w, 3), uint8, sRGB, as H.264; odd rows or columns are left out.

    Raises
    ------
    DatasetError
        If the name does not end in .mp4.
    """
    if path.suffix != ".mp4":
        raise DatasetError(f"{path}: give a file that ends in .mp4")
    av = _av()

    def write(temporary: Path) -> None:
        with av.open(str(temporary), "w", format="mp4") as container:
            stream: Any = None
            for picture in pictures:
                even = picture[: picture.shape[0] // 2 * 2, : picture.shape[1] // 2 * 2]
                if stream is None:
                    stream = container.add_stream("libx264", rate=Fraction(rate_hz).limit_denominator(1001))
                    stream.height, stream.width, stream.pix_fmt = *even.shape[:2], "yuv420p"
                    stream.options = {"crf": "18"}
                container.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(even), format="rgb24")))
            if stream is not None:
                container.mux(stream.encode(None))

    return write_atomic(path, write)


def contact_sheet(pictures: Sequence[NDArray[np.uint8]], columns: int = 4) -> NDArray[np.uint8]:
    """Pictures of one size side by side, shape (rows h, columns w, 3)."""
    height, width = pictures[0].shape[:2]
    rows = -(-len(pictures) // columns)
    sheet = np.zeros((rows * height, columns * width, 3), np.uint8)
    for number, picture in enumerate(pictures):
        v, u = number // columns * height, number % columns * width
        sheet[v : v + height, u : u + width] = picture
    return sheet


def _av() -> Any:
    try:
        import av
    except ImportError as error:
        raise DatasetError("videos need PyAV, which is not installed: pip install 'phibench[film]'") from error
    return av
