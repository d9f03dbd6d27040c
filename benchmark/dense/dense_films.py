"""Dense pairs of films and their truth: frames at rest at both ends of each stroke, frames of the moving carriage.

All frames are drawn with the laser off (`Film.frame`), with the film's exposure, rolling shutter and motion blur, and
noise of their own. Heights are what the robot is told: the nominal stroke, the encoder at the frames' times, and the
speed of the carriage from row to row. Truth is that of the two frames at rest.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from phibench.benchmark.dense.dense_pairs import (
    DENSE_TASK_VERSION,
    FURTHER_DRAW,
    DenseTruth,
    certify,
    require_curve,
    texture_ratio,
    with_between,
)
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.film.film_read import Film, Films, open_films
from phibench.datasets.film.film_store import CHECKSUMS
from phibench.datasets.frames.sensor_card import card_of
from phibench.datasets.rooms.room_sources import NamedRoom
from phibench.datasets.store.files import sha256
from phibench.datasets.store.provenance import provenance
from phibench.estimator.dense.dense_interface import DensePair
from phibench.estimator.interface import Image
from phibench.scenes.motion.carriage import Carriage

MOST_BETWEEN = 6
"""Frames on the way that a pair has at most, evenly spaced in height: each costs `dense_stroke` some 3 CPU-s."""
_PRESET = "mjpeg"


@dataclass(frozen=True)
class FilmStroke:
    """Frames of one stroke of a film, by their numbers.

    Attributes
    ----------
    film_id : str
    down, up : int
        At rest, at the offset 0 and at the whole stroke.
    between : tuple of int
        On the way, from low to high.
    """

    film_id: str
    down: int
    up: int
    between: tuple[int, ...]


def strokes_of(film: Film, most: int = MOST_BETWEEN) -> list[FilmStroke]:
    """Strokes of a film between the stops 0.0 and 1.0, up or down, with at most so many frames on the way.

    Raises
    ------
    DatasetError
        If there is none, the film is of windows, or its rig does more than to go up and down; in one sentence.
    """
    name, plan = film.plan.film_id, film.plan
    if plan.window_px is not None:
        raise DatasetError(
            f'film {name} holds windows around the spot: a dense pair needs whole images, view = "full" in [film]'
        )
    if plan.scene.vibrations or plan.scene.drive is not None:
        moves = "vibrates" if plan.scene.drive is None else "drives"
        raise DatasetError(f"film {name}: the robot {moves}, and a dense pair has two exact poses; leave that out")
    times, told = plan.scene.times, film.table["encoder_m"].to_numpy()
    half = 0.5 * (times.exposure_s + times.readout_s)
    found = []
    for (low, before), (high, after) in _ends(plan.scene.carriage, plan.pair.stroke_m):
        # a frame at rest is exposed, its first and its last row, while the carriage stands
        first, last = (
            np.flatnonzero((times.frame_s - half >= begin) & (times.frame_s + half <= end))
            for begin, end in (before, after)
        )
        if len(first) and len(last):
            ends = {low: int(first[-1]), high: int(last[0])}
            between = _spread(np.arange(first[-1] + 1, last[0]), told, plan.pair.nominal_stroke_m, most)
            found.append(FilmStroke(name, ends[min(ends)], ends[max(ends)], between))
    if not found:
        raise DatasetError(
            f"film {name} has no stroke from the stop 0.0 to the stop 1.0 with a frame at rest at both ends; give such "
            f"stops, and pauses_s of {1.0 / times.rate_hz + 2.0 * half:.2g} s or more"
        )
    return found


_Rest = tuple[float, tuple[float, float]]  # offset, and the times between which the carriage rests there


def _ends(carriage: Carriage, stroke_m: float) -> list[tuple[_Rest, _Rest]]:
    """Rests at the offset 0 and at the stroke that follow each other."""
    legs = carriage.legs
    starts = [-math.inf, *(leg.start_s + leg.duration_s for leg in legs)]
    stands = zip(starts, [*(leg.start_s for leg in legs), math.inf], strict=True)
    rests = [rest for rest in zip(carriage.stops_m, stands, strict=True) if rest[0] in (0.0, stroke_m)]
    return [(one, other) for one, other in itertools.pairwise(rests) if one[0] != other[0]]


def _spread(frames: Any, told_m: Any, stroke_m: float, most: int) -> tuple[int, ...]:
    """Frames whose readings are nearest to evenly spaced heights, from low to high; each once."""
    inside = frames[(told_m[frames] > 0.0) & (told_m[frames] < stroke_m)]
    if not len(inside):
        return ()
    wanted = stroke_m * np.arange(1, most + 1) / (most + 1)
    nearest = np.abs(told_m[inside] - wanted[:, None]).argmin(axis=1)
    return tuple(sorted({int(k) for k in inside[nearest]}, key=told_m.__getitem__))


class DenseFilms:
    """Dense pairs of a folder of films by number, with their truth; a pair per stroke and draw of the noise.

    Each film has a camera of its own. The light of the last film is kept.

    Parameters
    ----------
    films : Films or path of their folder
    preset : str
        Of the sensor.
    draws : int
        Of the noise, for each stroke.
    pairs : int, optional
        Only the first so many.
    between : int
        Frames on the way that a pair has at most.

    Raises
    ------
    DatasetError
        If a film cannot be taken, or a number is out of its range; in one sentence.
    """

    def __init__(
        self,
        films: Films | str | Path,
        preset: str | None = None,
        draws: int = 1,
        pairs: int | None = None,
        between: int = 0,
    ) -> None:
        for name, number in (("draws", draws), ("pairs", pairs)):
            if number is not None and number < 1:
                raise DatasetError(f"{name} = {number}: must be 1 or above")
        self.films = films if isinstance(films, Films) else open_films(films)
        self._preset, self._between, self._asked = preset or _PRESET, between, (preset, draws, pairs, between)
        strokes = [stroke for film in self.films for stroke in strokes_of(film, between)]
        self._numbered = [(stroke, draw) for stroke in strokes for draw in range(draws)][:pairs]
        self._held: Film | None = None
        for stroke in strokes:
            plan = self.films.plans[stroke.film_id]
            require_curve(plan.nominal.rig, plan.pair.nominal_stroke_m, stroke.film_id)
            if between and not stroke.between:
                raise DatasetError(f"film {stroke.film_id} has no frame on the way of its stroke: raise its rate_hz")

    def __len__(self) -> int:
        return len(self._numbered)

    def __iter__(self) -> Iterator[tuple[DensePair, DenseTruth]]:
        """Pairs with their truths, by number."""
        return ((self.pair(number), self.truth(number)) for number in range(len(self)))

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle without light: another process opens the films itself."""
        return DenseFilms, (self.films.folder, *self._asked)

    @property
    def folders(self) -> tuple[Path, ...]:
        """Folder of the films, with the truth."""
        return (self.films.folder,)

    def stroke(self, number: int) -> tuple[Film, FilmStroke, int]:
        """Film, stroke and draw of a pair."""
        if not 0 <= number < len(self):
            raise DatasetError(f"pair {number}: there are {len(self)}, numbered from 0; ask for one of them")
        stroke, draw = self._numbered[number]
        if self._held is None or self._held.plan.film_id != stroke.film_id:
            self._held = self.films[stroke.film_id]
        return self._held, stroke, draw

    def pair(self, number: int) -> DensePair:
        """Images with the laser off, as a method sees them; the arrays are read-only."""
        film, stroke, draw = self.stroke(number)
        plan, card = film.plan, card_of(film.sensor(self._preset))
        frames = {name: [self._image(film, getattr(stroke, name), draw)] for name in ("down", "up")}
        pair = DensePair.of_frames(number, frames, rig=plan.nominal.rig, stroke_m=plan.pair.nominal_stroke_m, card=card)
        between, times = list(stroke.between), plan.nominal.times
        heights = film.table["encoder_m"].to_numpy()[between]
        # the carriage is known to go as it was told, and rows to be read one after the other
        rows = plan.nominal.carriage.velocity_m_per_s(times.frame_s[between]) * times.readout_s / times.height_px
        images = [self._image(film, frame, draw) for frame in between]
        return with_between(pair, images, tuple(heights.tolist()), tuple(rows.tolist()))

    def _image(self, film: Film, frame: int, draw: int) -> Image:
        camera = list(self.films.plans).index(film.plan.film_id)
        image = np.array(film.frame(frame, self._preset, draw, camera, laser=False).image)
        image.flags.writeable = False
        return image

    def truth(self, number: int) -> DenseTruth:
        """Exact answer for every pixel of the frame at rest below.

        Raises
        ------
        CertificateError
            If the estimator's projection puts a counterpart elsewhere.
        """
        film, stroke, draw = self.stroke(number)
        plan, room = film.plan, film.room_source
        found = film.correspondence(stroke.down, stroke.up)
        certify(found, plan.scene.rig.at(plan.pair.stroke_m))
        return DenseTruth(
            number=number,
            sample_id=stroke.film_id,
            draw=draw,
            preset=self._preset,
            room=room.name if isinstance(room, NamedRoom) else room.kind,
            stroke_m=plan.pair.stroke_m,
            true_rig=plan.scene.rig,
            given_rig=plan.nominal.rig,
            given_stroke_m=plan.pair.nominal_stroke_m,
            found=found,
            texture=texture_ratio(*(self._image(film, stroke.down, k) for k in (draw, draw + FURTHER_DRAW))),
        )

    def document(self) -> dict[str, Any]:
        """Provenance of the set."""
        info = self.films.info
        return {
            "name": info.name,
            "task_version": DENSE_TASK_VERSION,
            "sealed": False,
            "pairs": len(self),
            "samples": len({stroke.film_id for stroke, _ in self._numbered}),
            "presets": [self._preset],
            "seed": info.seed,
            "films_sha256": sha256(self.films.folder / CHECKSUMS),
            "provenance": provenance(),
            "frames": 1,
            **({"between": self._between} if self._between else {}),
        }
