"""Camera frames of films of whole images: a video per film and draw, of the camera's own MJPEG or YUYV frames."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from phibench.datasets.errors import DatasetError
from phibench.datasets.film.film_read import Film, open_films
from phibench.datasets.film.film_video import Codec, require_container, write_frames
from phibench.datasets.parallel import parallel_map

PRESETS = ("mjpeg", "yuyv")


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
    films: Sequence[str] | None = None,
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
    for film in opened if films is None else [opened[name] for name in dict.fromkeys(films)]:
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
