"""Writer of films as videos (JPEG or YUYV in AVI or Matroska, MP4) and LeRobot data sets; reader of a video's frames.

JPEGs and YUYV frames go into the container as they are; reading gives the same bytes back. MP4 for looking at is
compressed again. `write_lerobot` lays videos and a Parquet row a frame out as LeRobot's data sets of version 3.0.
PyAV is imported when it is needed: `pip install 'phibench[film]'`.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import polars as pl
from numpy.typing import NDArray

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.parallel import parallel_map
from phibench.datasets.film.film_read import Film, Films, open_films
from phibench.datasets.store.files import require_file, write_atomic, write_bytes, write_text
from phibench.render.sensor.processing import jpeg_image
from phibench.scenes.validation import printable_line

Codec = Literal["mjpeg", "yuyv"]
PRESETS = ("mjpeg", "yuyv")
CONTAINERS = {".avi": "avi", ".mkv": "matroska", ".mp4": "mp4"}
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
    require_container(Path(f"film{container}"))
    target, name = Path(out), f"{{film}}-{preset}-{{draw:04d}}{container}"
    jobs = [
        replace(job, path=target / name.format(film=job.film_id, draw=job.draw))
        for job in _jobs(open_films(folder), "mjpeg" if preset == "mjpeg" else "yuyv", draws, camera_seed)
    ]
    _write_missing(jobs, workers)
    return [job.path for job in jobs]


def _jobs(films: Films, preset: Codec, draws: int, camera_seed: int) -> list[_Job]:
    """Videos of whole images, one a film and draw."""
    for film in films:
        if film.info.window_px is not None:
            raise DatasetError(
                f'{film.info.film} holds windows around the spot: give view = "full" in [film], or read it in Python'
            )
    return [
        _Job(films.folder, film_id, preset, draw, camera_seed, Path())
        for film_id in films.plans
        for draw in range(draws)
    ]


def _write_missing(jobs: Sequence[_Job], workers: int | None) -> None:
    todo = [job for job in jobs if not job.path.is_file()]
    for _ in parallel_map(partial(_write), todo, workers, in_order=False):
        pass


def _write(job: _Job) -> None:
    film = open_films(job.folder)[job.film_id]
    data = _packets(film, job.preset, job.draw, job.camera_seed)
    write_frames(job.path, data, job.preset, film.plan.size, film.plan.scene.times.rate_hz)


def _packets(film: Film, preset: Codec, draw: int, camera_seed: int) -> Iterator[bytes]:
    for number in range(len(film)):
        frame = film.frame(number, preset, draw, camera_seed)
        yield frame.image.tobytes() if frame.jpeg is None else frame.jpeg


# -- data to learn from -----------------------------------------------------------------------------------------------

LEROBOT = "v3.0"
"""Version of LeRobot's layout."""
_CAMERA, _IN_CHUNK, _STATS_FRAMES = "observation.images.camera", 1000, 10
_DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_VIDEO = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
_TASK = "find the laser spot in the mirror, and its distance"
_COLUMNS: dict[str, tuple[str, tuple[str, ...]]] = {
    "observation.state": ("float32", ("encoder_m", "tracks_m.left", "tracks_m.right", "laser_level")),
    "truth.spot_px": ("float64", ("row_light_u_px", "row_light_v_px")),
    "truth.phi_rad": ("float64", ("row_light_phi_ray_rad",)),
    "truth.depth_m": ("float64", ("row_light_depth_m",)),
    "truth.visible": ("bool", ("row_visible",)),
    "truth.carriage_m": ("float64", ("row_offset_m",)),
    "truth.rig_world_m": ("float64", ("row_rig_world_m.x", "row_rig_world_m.y", "row_rig_world_m.z")),
    "truth.rig_angles_rad": (
        "float64",
        ("row_rig_angles_rad.roll", "row_rig_angles_rad.pitch", "row_rig_angles_rad.yaw"),
    ),
}
"""Features of a frame: type, and the columns of `film.parquet`. What the robot is told, then what it has to find."""
_COUNTED = ("frame_index", "episode_index", "index", "task_index")


def write_lerobot(
    folder: str | Path, out: str | Path, draws: int = 1, camera_seed: int = 0, workers: int | None = None
) -> Path:
    """Write films of whole images as a LeRobot data set: an episode a film and draw. Videos that are there are kept.

    The videos hold the camera's own JPEGs. Films have no actions: nobody drives by what is seen.

    Raises
    ------
    DatasetError
        If the films are windows, or their rate is no whole number of frames a second, as LeRobot asks.
    """
    films, target, tasks = open_films(folder), Path(out), _tasks()
    _av()
    jobs = [
        replace(job, path=target / _VIDEO.format(video_key=_CAMERA, **_place(number)))
        for number, job in enumerate(_jobs(films, "mjpeg", draws, camera_seed))
    ]
    rates = {film.plan.scene.times.rate_hz for film in films}
    if len(rates) != 1 or not (rate_hz := min(rates)).is_integer():
        told = ", ".join(f"{rate:g}" for rate in sorted(rates))
        raise DatasetError(f"{folder}: rate_hz = {told}; LeRobot asks for one whole number, such as 30, in [film]")
    _write_missing(jobs, workers)
    tables, first = [], 0
    for number, job in enumerate(jobs):
        tables.append(_rows(films[job.film_id], number, first, rate_hz))
        first += len(tables[-1])
        write_bytes(target / _DATA.format(**_place(number)), _parquet(tables[-1]))
    episodes = pl.DataFrame([_episode(number, table, rate_hz) for number, table in enumerate(tables)])
    write_bytes(target / "meta/episodes/chunk-000/file-000.parquet", _parquet(episodes))
    write_bytes(target / "meta/tasks.parquet", tasks)
    write_text(target / "meta/stats.json", json.dumps(_stats(pl.concat(tables), [job.path for job in jobs])) + "\n")
    info = _info(films[jobs[0].film_id].plan.size, int(rate_hz), len(tables), first)
    return write_text(target / "meta/info.json", json.dumps(info, indent=1) + "\n")


def _place(number: int) -> dict[str, int]:
    return {"chunk_index": number // _IN_CHUNK, "file_index": number % _IN_CHUNK}


def _parquet(table: pl.DataFrame) -> bytes:
    buffer = io.BytesIO()
    table.write_parquet(buffer)
    return buffer.getvalue()


def _tasks() -> bytes:
    """Table of tasks as pandas writes it: LeRobot takes the names of its rows, which polars cannot write."""
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError as error:
        raise DatasetError("--lerobot needs pyarrow: pip install 'phibench[film,export]'") from error
    columns = [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy, "metadata": None}
        for name, kind, numpy in (("task_index", "int64", "int64"), ("task", "unicode", "object"))
    ]
    about = {"index_columns": ["task"], "columns": columns, "column_indexes": [], "pandas_version": "2.0.0"}
    table = pa.table({"task_index": pa.array([0], pa.int64()), "task": pa.array([_TASK])})
    buffer = io.BytesIO()
    pq.write_table(table.replace_schema_metadata({"pandas": json.dumps(about)}), buffer)
    return buffer.getvalue()


def _rows(film: Film, episode: int, first: int, rate_hz: float) -> pl.DataFrame:
    """Rows of an episode's frames; `first` is the index of the first one in the whole."""
    table, count = film.table, len(film)
    columns = [
        pl.Series("timestamp", np.arange(count) / rate_hz, pl.Float32),
        pl.Series("frame_index", np.arange(count)),
        pl.Series("episode_index", np.full(count, episode)),
        pl.Series("index", first + np.arange(count)),
        pl.Series("task_index", np.zeros(count, int)),
    ]
    for name, (kind, sources) in _COLUMNS.items():
        values = np.stack([_values(table, source) for source in sources], axis=1).astype(kind)
        own = values[:, 0] if len(sources) == 1 else values
        columns.append(pl.Series(name, np.ascontiguousarray(own)))
    return pl.DataFrame(columns)


def _values(table: pl.DataFrame, source: str) -> NDArray[Any]:
    """Column, or the part of one that holds lists; NaN for null."""
    column, _, part = source.partition(".")
    if not part:
        return table[column].to_numpy()
    place = {"left": 0, "right": 1, "x": 0, "y": 1, "z": 2, "roll": 0, "pitch": 1, "yaw": 2}[part]
    return table[column].list.get(place).to_numpy()


def _episode(number: int, table: pl.DataFrame, rate_hz: float) -> dict[str, Any]:
    video, first = f"videos/{_CAMERA}", int(table["index"][0])
    return {
        "episode_index": number,
        "tasks": [_TASK],
        "length": len(table),
        "dataset_from_index": first,
        "dataset_to_index": first + len(table),
        **{f"data/{name}": value for name, value in _place(number).items()},
        **{f"{video}/{name}": value for name, value in _place(number).items()},
        f"{video}/from_timestamp": 0.0,
        f"{video}/to_timestamp": len(table) / rate_hz,
        "meta/episodes/chunk_index": 0,
        "meta/episodes/file_index": 0,
    }


def _stats(table: pl.DataFrame, videos: Sequence[Path]) -> dict[str, dict[str, Any]]:
    """Least, greatest, mean and standard deviation of each feature; of pictures 0 to 1, by colour, of some frames."""
    made = {}
    for name in table.columns:
        values = table[name].to_numpy().astype(float).reshape(len(table), -1)
        made[name] = _moments(values[np.isfinite(values).all(axis=1)], (-1,))
    pixels = []
    for video in videos:
        frames = list(read_frames(video))
        pixels += [
            jpeg_image(jpeg)[::4, ::4].reshape(-1, 3) / 255.0 for jpeg in frames[:: -(-len(frames) // _STATS_FRAMES)]
        ]
    return {**made, _CAMERA: _moments(np.concatenate(pixels), (3, 1, 1))}


def _moments(values: NDArray[Any], shape: tuple[int, ...]) -> dict[str, Any]:
    if not len(values):  # a spot that no frame shows
        return {"count": [0]}
    parts = {"min": values.min(0), "max": values.max(0), "mean": values.mean(0), "std": values.std(0)}
    return {**{name: part.reshape(shape).tolist() for name, part in parts.items()}, "count": [len(values)]}


def _info(size: tuple[int, int], rate_hz: int, episodes: int, frames: int) -> dict[str, Any]:
    height, width = size
    video = {"video.height": height, "video.width": width, "video.codec": "mjpeg", "video.pix_fmt": "yuvj422p"}
    video |= {"video.is_depth_map": False, "video.fps": rate_hz, "video.channels": 3, "has_audio": False}
    camera = {"dtype": "video", "shape": [height, width, 3], "names": ["height", "width", "channels"], "info": video}
    counted = {name: {"dtype": "int64", "shape": [1], "names": None} for name in _COUNTED}
    own = {
        name: {"dtype": kind, "shape": [len(sources)], "names": list(sources)}
        for name, (kind, sources) in _COLUMNS.items()
    }
    return {
        "codebase_version": LEROBOT,
        "robot_type": "phibench",
        "total_episodes": episodes,
        "total_frames": frames,
        "total_tasks": 1,
        "chunks_size": _IN_CHUNK,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": rate_hz,
        "splits": {"train": f"0:{episodes}"},
        "data_path": _DATA,
        "video_path": _VIDEO,
        "features": {_CAMERA: camera, **own, "timestamp": {"dtype": "float32", "shape": [1], "names": None}, **counted},
    }


def _av() -> Any:
    try:
        import av
    except ImportError as error:
        raise DatasetError("videos need PyAV, which is not installed: pip install 'phibench[film]'") from error
    return av
