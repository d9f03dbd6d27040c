"""Films as video files: the camera's own JPEGs or YUYV in AVI or Matroska, and MP4 for looking at.

JPEGs and YUYV frames go into the container as they are; reading gives the same bytes back. MP4 is compressed again.
PyAV is imported when it is needed: `pip install 'phibench[film]'`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.parallel import parallel_map
from phibench.datasets.film.film_read import Film, open_films
from phibench.datasets.store.files import require_file, write_atomic
from phibench.scenes.validation import printable_line

Codec = Literal["mjpeg", "yuyv"]
PRESETS = ("mjpeg", "yuyv")
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
        rate = Fraction(rate_hz).limit_denominator(1001)  # 29.97 is 30000 / 1001
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
        # as a file: a pipe would be waited for, and a name may be an address to the library
        with require_file(path).open("rb") as file, av.open(file) as container:
            for packet in container.demux(video=0):
                if packet.size:
                    yield bytes(packet)
    except (OSError, ValueError, LookupError, RuntimeError) as error:
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
                even = picture[: picture.shape[0] // 2 * 2, : picture.shape[1] // 2 * 2]  # yuv420p halves both sides
                if stream is None:
                    # 29.97 Hz are 30000/1001
                    stream = container.add_stream("libx264", rate=Fraction(rate_hz).limit_denominator(1001))
                    stream.height, stream.width, stream.pix_fmt = *even.shape[:2], "yuv420p"
                    stream.options = {"crf": "18"}
                container.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(even), format="rgb24")))
            if stream is not None:
                container.mux(stream.encode(None))

    return write_atomic(path, write)


# -- whole films ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Job:
    folder: Path
    film_id: str
    preset: Codec
    draw: int
    camera_seed: int
    path: Path


def write_videos(
    folder: str | Path,
    out: str | Path,
    preset: str = "mjpeg",
    draws: int = 1,
    camera_seed: int = 0,
    container: str = ".mkv",
    workers: int | None = None,
) -> list[Path]:
    """Write a video of every film and draw; videos that are there are kept.

    Raises
    ------
    DatasetError
        If the films are windows, or the preset is not one that a camera sends.
    """
    if preset not in PRESETS:
        raise DatasetError(f"preset '{preset}': a camera sends {' or '.join(PRESETS)}; read other presets in Python")
    opened, target = open_films(folder), Path(out)
    require_container(Path(f"film{container}"))
    jobs = []
    for film in opened:
        if film.info.window_px is not None:
            raise DatasetError(
                f'{film.info.film} holds windows around the spot: give view = "full" in [film], or read it in Python'
            )
        name = f"{film.info.film}-{preset}-{{:04d}}{container}"
        codec: Codec = "mjpeg" if preset == "mjpeg" else "yuyv"
        jobs += [
            _Job(Path(folder), film.info.film, codec, draw, camera_seed, target / name.format(draw))
            for draw in range(draws)
        ]
    todo = [job for job in jobs if not job.path.is_file()]
    for _ in parallel_map(partial(_write), todo, workers, in_order=False):
        pass
    return [job.path for job in jobs]


def _write(job: _Job) -> None:
    film = open_films(job.folder)[job.film_id]
    data = _packets(film, job.preset, job.draw, job.camera_seed)
    write_frames(job.path, data, job.preset, film.plan.size, film.plan.scene.times.rate_hz)


def _packets(film: Film, preset: Codec, draw: int, camera_seed: int) -> Iterator[bytes]:
    for number in range(len(film)):
        frame = film.frame(number, preset, draw, camera_seed)
        yield frame.image.tobytes() if frame.jpeg is None else frame.jpeg


def _av() -> Any:
    try:
        import av
    except ImportError as error:
        raise DatasetError("videos need PyAV, which is not installed: pip install 'phibench[film]'") from error
    return av
