"""Rooms baked into a folder, and a camera that moves through them: frames of any pose, drawn without Mitsuba.

`bake_rooms` makes a folder: `rooms.json`, which says what each room is made from, and a light map for each. Baking
needs Mitsuba and takes some CPU-s a room. `open_baked_rooms` reads them anywhere. `MovingCamera` then draws whole
frames, or windows of them, through the sensor's chain (`render.sensor`): room (`render.film.room_image`), spots, noise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from phibench.datasets.build.task_runner import bring_all
from phibench.datasets.build.tasks import BuildTask, TaskResult, task_key
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import FileName, InputFile
from phibench.datasets.common.progress import progress_console
from phibench.datasets.frames.frame_request import request_faults
from phibench.datasets.rooms.room_sources import GeneratedRoom
from phibench.datasets.store.checksums import filling
from phibench.datasets.store.files import write_bytes, write_text
from phibench.datasets.store.json_forms import from_json, to_json
from phibench.datasets.store.provenance import code_behind, provenance
from phibench.datasets.store.schema import Document, TruthFolder, described
from phibench.render.film.room_image import LitRoom, Placement, quick_spot, room_image
from phibench.render.optics.faces import TexelGrid
from phibench.render.optics.room_tracer import blocked_by, own_geometry
from phibench.render.room.light_map import ARRAYS, BakeSettings, light_map_bytes
from phibench.render.sensor.camera_chain import Chain
from phibench.render.sensor.electrons import NoiseStream
from phibench.render.sensor.light import Light, OtherSpot, Region
from phibench.render.sensor.settings import Sensor, sensor
from phibench.scenes.frames import Array
from phibench.scenes.laser import LaserSpot
from phibench.scenes.random_streams import Name
from phibench.scenes.rig import Rig
from phibench.scenes.room import Room
from phibench.scenes.validation import SceneError
from phibench.scenes.worlds.room_properties import drawn_properties

INFO = TruthFolder.BAKED_ROOMS.value
_AGAIN = "run `phibench loop bake` again"
_TRIES = 20  # properties that leave no place for a lamp are drawn again


class BakedRoomInfo(Document):
    """One room of `rooms.json`."""

    name: FileName = described("-", "name of the room")
    source: dict[str, Any] = described("-", "what the room is made from, field by field")
    digest: str = described("-", "SHA-256 of all that the room is")
    texel_m: float = described("m", "size of the light map's texels")


class BakedSetInfo(Document):
    """`rooms.json`, written last."""

    kind: Literal["phibench baked rooms"] = "phibench baked rooms"
    version: Literal[1] = 1
    rooms: tuple[BakedRoomInfo, ...] = described("-", "all rooms")


@dataclass(frozen=True)
class BakedRoom:
    """Room with its light.

    Parameters
    ----------
    room : Room
        Without the robot.
    irradiance_w_m2 : array, shape (texels, 3)
    """

    name: str
    room: Room
    texel_m: float
    irradiance_w_m2: NDArray[np.float32]

    @cached_property
    def lit(self) -> LitRoom:
        """Faces with their light; made once."""
        geometry = own_geometry(self.room)
        return LitRoom(geometry, TexelGrid.of(geometry.table, self.texel_m), self.irradiance_w_m2)

    def blocks(self, start_m: Array, end_m: Array) -> bool:
        """Tell whether a shape of the room stands between two world points, shape (3,)."""
        return int(blocked_by(self.lit.geometry, start_m[None], end_m[None])[0]) >= 0


# -- baking ----------------------------------------------------------------------------------------------------------


def bake_rooms(
    out: Path,
    count: int,
    *stream: Name,
    settings: BakeSettings | None = None,
    fits: Callable[[Room], bool] | None = None,
    workers: int | None = None,
    console: Console | None = None,
) -> int:
    """Bake generated rooms that a named stream draws; light maps that the user's cache has are taken from there.

    Rooms that `fits`, a function at the top of a module, does not take are drawn again.

    Raises
    ------
    DatasetError
        If the folder cannot be written, or Mitsuba is not installed.
    """
    console, settings = console or progress_console(), settings or BakeSettings()
    code = code_behind(__name__)
    tasks = [_bake_task(number, stream, settings, fits, code) for number in range(count)]
    with filling(out):
        brought = bring_all({task.name: task for task in tasks}, out, workers, console, "rooms", sign=INFO)
        infos = brought.results(BakedRoomInfo)
        write_text(out / INFO, BakedSetInfo(rooms=tuple(infos)).model_dump_json(indent=1) + "\n")
    return count


def _bake_task(
    number: int, stream: tuple[Name, ...], settings: BakeSettings, fits: Callable[[Room], bool] | None, code: str
) -> BuildTask:
    rule = None if fits is None else f"{fits.__module__}.{fits.__qualname__}"
    key = task_key([number, stream, asdict(settings), rule], code, {"packages": provenance()["packages"]})
    return BuildTask(f"room room{number:03d}", key, bake_drawn_room, (settings, stream, number, fits))


def bake_drawn_room(
    out: Path, settings: BakeSettings, stream: tuple[Name, ...], number: int, fits: Callable[[Room], bool] | None
) -> TaskResult:
    """Task: write the light map of a drawn room below `out`; the result is its `BakedRoomInfo`."""
    from phibench.datasets.build.bake_task import light_map
    from phibench.datasets.build.view_task import start_renderer

    try:
        start_renderer()
    except ImportError as error:
        raise DatasetError("baking needs Mitsuba: pip install 'phibench[render]'") from error
    source, room = _drawn_room(fits, *stream, number)
    light = light_map(Rig().at(0.0), room, settings)
    name = f"room{number:03d}"
    write_bytes(out / f"{name}.npz", light_map_bytes(light))
    info = BakedRoomInfo(name=name, source=to_json(source), digest=room.digest, texel_m=settings.texel_m)
    return TaskResult((f"{name}.npz",), info.model_dump(mode="json"))


def _drawn_room(fits: Callable[[Room], bool] | None, *stream: Name) -> tuple[GeneratedRoom, Room]:
    for turn in range(_TRIES):
        names = (*stream, turn) if turn else stream
        source = GeneratedRoom(drawn_properties(*names), names)
        try:
            room = replace(source.build(), robot=False)
        except SceneError:  # the lamps have no place: the next room of the stream
            continue
        if fits is None or fits(room):
            return source, room
    asked = "" if fits is None else " and does what is asked of it"
    raise DatasetError(f"no room of the stream {stream} has a place for its lamps{asked}; take another stream")


def open_baked_rooms(folder: str | Path) -> dict[str, BakedRoom]:
    """Baked rooms of a folder, by name.

    Raises
    ------
    DatasetError
        If it holds none, a file is missing or damaged, or this version makes another room of the same source.
    """
    path = Path(folder)
    if not (path / INFO).is_file():
        raise DatasetError(f"{path} holds no baked rooms: it has no {INFO}; make them with `phibench loop bake`")
    info = InputFile(path / INFO, _AGAIN).document(BakedSetInfo)
    return {entry.name: _read(path, entry) for entry in info.rooms}


def _read(folder: Path, info: BakedRoomInfo) -> BakedRoom:
    room = replace(from_json(GeneratedRoom, info.source).build(), robot=False)
    if room.digest != info.digest:
        raise DatasetError(f"{folder / INFO}: {info.name} is another room in this version; {_AGAIN}")
    light = InputFile(folder / f"{info.name}.npz", _AGAIN).arrays(ARRAYS)["irradiance_w_m2"]
    baked = BakedRoom(info.name, room, info.texel_m, light)
    if light.shape != (baked.lit.texels.count, 3):  # type: ignore[attr-defined]
        raise DatasetError(f"{folder / info.name}.npz has {len(light)} texels, not those of its room; {_AGAIN}")
    return baked


# -- camera ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class MovingCamera:
    """Camera on a rig that stands anywhere in a room.

    Parameters
    ----------
    rig : Rig
        The true one, with a smooth mirror and no holder.
    preset : str
        Of the sensor.
    camera_seed : int
        Of its fixed pattern.

    Raises
    ------
    SceneError
        If the rig has a holder or a rough mirror: their light is not computed here.
    """

    rig: Rig
    preset: str = "bayer-raw"
    camera_seed: int = 0

    def __post_init__(self) -> None:
        if self.rig.holder is not None or self.rig.mirror.roughness_alpha > 0.0:
            raise SceneError(
                "MovingCamera: frames of a robot that drives need a smooth mirror without a holder; "
                "take roughness_alpha = 0 and holder = None"
            )

    def sensor(self, exposure_s: float) -> Sensor:
        """Sensor at an exposure."""
        with request_faults():
            return sensor(self.preset, exposure_s=exposure_s)

    def light(
        self,
        room: BakedRoom,
        placement: Placement,
        stroke_m: float,
        spots: Sequence[LaserSpot],
        regions: Sequence[Region],
    ) -> Light:
        """Light on some regions of the image; elsewhere there is none.

        Parameters
        ----------
        placement : (3, 3) and (3,)
            Rotation and origin of the rig's frame in the world.
        spots : sequence of LaserSpot
            In the rig's frame; those that are seen.
        regions : sequence of Region
        """
        view = self.rig.at(stroke_m)
        size = self.rig.camera.height_px, self.rig.camera.width_px
        ambient = np.zeros((3, *size), np.float32)
        for region in regions:
            ambient[(slice(None), *region.slices())] = room_image(view, placement, room.lit, region)
        others = tuple(OtherSpot(quick_spot(view, spot)) for spot in spots)
        return Light(ambient, f_number=self.rig.camera.f_number, others=others)

    def frames(self, light: Light, exposure_s: float, regions: Sequence[Region], *stream: Name) -> list[NDArray[Any]]:
        """Pixels of regions, one draw, named by the stream: as `Chain.frame`."""
        chain = Chain(self.sensor(exposure_s), self.camera_seed, self.rig.camera)
        with request_faults():
            return [chain.frame(light, NoiseStream(stream), region) for region in regions]


def window_around(camera: Any, u_px: float, v_px: float, side_px: int) -> Region:
    """Square of the image about a place, moved inwards at its borders."""
    u, v = np.clip((u_px, v_px), 0.0, (camera.width_px - 1.0, camera.height_px - 1.0))
    return Region.around(float(u), float(v), (camera.height_px, camera.width_px), side_px)
