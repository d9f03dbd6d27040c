"""Photographs of a pair, laser on and off, one or several of each, and the pair of images made of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from phibench.calibration.captures.picture_files import (
    Photo,
    read_photo,
    require_colour,
    require_one_camera,
    sensor_choice,
)
from phibench.calibration.captures.rig_file import MeasuredRig, require_camera_size
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.frames.sensor_card import SensorCard
from phibench.datasets.frames.sensor_file import SensorFile
from phibench.estimator.interface import Pair
from phibench.scenes.rig import POSITIONS, Rig

LARGEST_SIGMA = 0.25  # of a length that somebody measured; a larger one is of another unit


@dataclass(frozen=True)
class PositionPhotos:
    """Pictures of one stroke position: laser on, and laser off where there are any."""

    on: tuple[Photo, ...]
    off: tuple[Photo, ...] = ()


@dataclass(frozen=True)
class PairPhotos:
    """Pictures of both positions.

    Raises
    ------
    DatasetError
        If the counts do not go together, or the pictures are of different cameras.
    """

    down: PositionPhotos
    up: PositionPhotos

    def __post_init__(self) -> None:
        counts = {p: (len(getattr(self, p).on), len(getattr(self, p).off)) for p in POSITIONS}
        if counts["down"] != counts["up"] or not counts["down"][0]:
            (a, b), (c, d) = counts["down"], counts["up"]
            raise DatasetError(
                f"pictures with the laser on: {a} down and {c} up; with the laser off: {b} down and {d} up; give as "
                "many of both positions"
            )
        if counts["down"][1] > counts["down"][0]:
            raise DatasetError("more pictures with the laser off than on: give at most as many")
        require_one_camera(self.all)

    @property
    def all(self) -> tuple[Photo, ...]:
        """All pictures, those with the laser on first."""
        return (*self.down.on, *self.up.on, *self.down.off, *self.up.off)

    @property
    def pictures_to_compare(self) -> tuple[tuple[Photo, Photo], ...]:
        """Pictures that are to be alike around the mirror: all others of a position with its first, and both firsts."""
        groups = [(*position.on, *position.off) for position in (self.down, self.up)]
        within = [(group[0], other) for group in groups for other in group[1:]]
        return (*within, (self.down.on[0], self.up.on[0]))


def read_photos(files: Mapping[str, Sequence[Path]], rig: Rig, sensor: SensorFile | None) -> PairPhotos:
    """Pictures of the files of "down", "up", "down_off" and "up_off".

    Raises
    ------
    DatasetError
        As `read_photo` and `PairPhotos`.
    """
    groups = {name: tuple(read_photo(path, rig, sensor) for path in paths) for name, paths in files.items()}
    return PairPhotos(*(PositionPhotos(groups[name], groups[f"{name}_off"]) for name in POSITIONS))


def require_fitting(photos: PairPhotos, rig: Rig, sensor: SensorFile | None) -> None:
    """Refuse pictures that do not fit to the rig's camera or to the sensor.

    Raises
    ------
    DatasetError
        As `require_colour`, `require_camera_size` and `sensor_choice`.
    """
    for photo in photos.all:
        require_colour(photo)
        require_camera_size(rig, photo.size_px, str(photo.path))
        sensor_choice(photo, sensor)


def pair_of_photos(photos: PairPhotos, stroke_m: float, known: MeasuredRig, card: SensorCard) -> Pair:
    """Pair of all frames; images of several are their means."""
    groups = {"down": photos.down.on, "up": photos.up.on, "down_off": photos.down.off, "up_off": photos.up.off}
    frames = {name: [photo.pixels for photo in group] for name, group in groups.items() if group}
    return Pair.of_frames(0, frames, rig=known.rig, stroke_m=stroke_m, card=card, beam=known.beam)


def frames_note(photos: PairPhotos) -> str:
    """Sentence on how many frames are used; empty for one."""
    count, offs = len(photos.down.on), len(photos.down.off)
    if count == 1:
        return ""
    return f"frames: {count} of each position with the laser on, {offs} with it off, fitted together"
