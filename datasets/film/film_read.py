"""Reading of films: truth, light and camera frames of any frame, without Mitsuba.

A frame is drawn from the light when it is asked for, any number of times: the light holds rolling shutter, motion blur
and the laser's code already. A window of a frame has the same pixels as the whole frame of a film of whole images.

Examples
--------
>>> films = open_films("out/films")  # doctest: +SKIP
>>> film = films["table2-d3.180-h0.425"]  # doctest: +SKIP
>>> film.frame(17, "bayer-raw", draw=3).image.shape  # doctest: +SKIP
(48, 48)
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import polars
from numpy.typing import NDArray

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.exposures.expected_electrons import ExpectedRegion, expected_of_light
from phibench.datasets.film.film_plan import FilmPlan, film_plans
from phibench.datasets.film.film_store import (
    CHECKSUMS,
    FILM,
    INFO,
    LIGHT_IMAGES,
    LIGHTS,
    RECIPE,
    SCHEMA_VERSION,
    SPOTS,
    FilmFolder,
    FilmInfo,
    SetInfo,
    read_document,
    read_spots,
    read_table,
    read_view,
)
from phibench.datasets.frames.frame_request import request_faults
from phibench.datasets.plan.plan import Plan
from phibench.datasets.recipe.load import parse_recipe, recipe_files, recipe_text
from phibench.datasets.rooms.room_sources import RoomSource
from phibench.datasets.store.layers import SpotWindow
from phibench.render.film.key_views import PoseParts, blended
from phibench.render.film.moving_rows import RowsImage
from phibench.render.optics.correspondence import Correspondence, correspondence
from phibench.render.optics.room_tracer import room_geometry
from phibench.render.optics.truth import truth_layer
from phibench.render.sensor.camera_chain import Chain
from phibench.render.sensor.electrons import NoiseStream
from phibench.render.sensor.light import Light, OtherSpot, Region
from phibench.render.sensor.processing import jpeg_image
from phibench.render.sensor.settings import Sensor, sensor
from phibench.scenes.frames import Array
from phibench.scenes.motion.film_scene import FilmScene
from phibench.scenes.rig import View


@dataclass(frozen=True)
class FilmFrame:
    """One frame as the camera delivers it.

    Attributes
    ----------
    image : array
        As `phibench.datasets.frames.frame_source.Frame.image`, on `region`.
    jpeg : bytes or None
        The file that the camera sends; None for a window and for other outputs than "mjpeg".
    frame, draw : int
        Number of the frame in its film, and of the noise realisation.
    sensor : Sensor
        With the film's exposure.
    region : Region
        Part of the image.
    """

    image: NDArray[Any] = field(repr=False)
    jpeg: bytes | None = field(repr=False)
    frame: int
    draw: int
    sensor: Sensor
    region: Region


@dataclass(frozen=True)
class Film:
    """One film of a data set.

    Attributes
    ----------
    folder : FilmFolder
        Where it lies.
    plan : FilmPlan
        Scene, nominal scene, encoder.
    info : FilmInfo
        Content of its document.
    """

    folder: FilmFolder
    plan: FilmPlan
    info: FilmInfo
    _set: Plan = field(repr=False)

    def __len__(self) -> int:
        return self.info.frames

    def __repr__(self) -> str:
        height, width = self.plan.region.shape
        return f"<film {self.plan.film_id}: {len(self)} frames of {width} x {height} px>"

    @cached_property
    def table(self) -> polars.DataFrame:
        """Truth, a row per frame: the columns of FORMAT.md."""
        return read_table(self.folder.path / FILM, self.info.frames)

    @property
    def light_depth_m(self) -> float:
        """D of the light on the surfaces, of a robot and a target that stand: mean of the frames that see it."""
        return float(np.nanmean(self.table["row_light_depth_m"].to_numpy()))

    @cached_property
    def spots(self) -> list[RowsImage]:
        """Spot in every frame, electrons per second over the exposure."""
        return read_spots(self.folder.path / SPOTS, self.info.frames)

    @cached_property
    def lights_table(self) -> polars.DataFrame:
        """Truth of other lights, a row per light and frame: `light`, and the columns of `table` without the encoder."""
        frames = self.info.frames * len(self.plan.scene.lights)
        return read_table(self.folder.path / LIGHTS, frames) if frames else polars.DataFrame()

    @cached_property
    def light_spots(self) -> list[list[RowsImage]]:
        """Other lights, one list per light, as `spots`."""
        count = range(len(self.plan.scene.lights))
        return [read_spots(self.folder.path / LIGHT_IMAGES.format(n), self.info.frames) for n in count]

    @cached_property
    def views(self) -> NDArray[np.float32]:
        """Key views of the room, shape (keys, 3, h, w), electrons per second."""
        region = self.info.region
        poses = ((part, float(place)) for part, places in enumerate(self.info.keys) for place in places)
        return np.stack([read_view(self.folder.view(*pose), region) for pose in poses])

    @cached_property
    def _parts(self) -> PoseParts:
        return PoseParts.of(self.plan.scene)

    def room(self, frame: int) -> NDArray[np.float32]:
        """Room in a frame on the film's region, shape (3, h, w), electrons per second over each row's exposure."""
        region = self.info.region
        rows = np.arange(region.v0_px, region.v1_px).astype(float)
        return blended(self.views, self._parts.row_weights(self.info.keys, self._number(frame), rows))

    def light(self, frame: int) -> Light:
        """Light of a frame; outside of the film's region there is none."""
        region, (height, width) = self.info.region, self.plan.size
        ambient = np.zeros((3, height, width), np.float32)
        ambient[(slice(None), *region.slices())] = self.room(frame)
        return film_light(self.plan.scene, ambient, self.spots[frame], [images[frame] for images in self.light_spots])

    def window(self, frame: int, side_px: int | None = None) -> Region:
        """Pixels of a frame that are drawn: the square around the spot, or the whole image.

        Raises
        ------
        DatasetError
            If `side_px` is larger than the film's windows.
        """
        row, most = self.table.row(self._number(frame), named=True), self.info.window_px
        side = most if side_px is None else side_px
        if side is None:
            return Region.whole(self.plan.size)
        if most is not None and side > most:
            raise DatasetError(f"window of {side} px: the film holds {most} px around the spot; ask for no more")
        return Region.around(row["row_u_px"], row["row_v_px"], self.plan.size, min(side, *self.plan.size))

    def sensor(self, preset: str = "mjpeg", **changes: Any) -> Sensor:
        """Sensor of the film: a preset with the film's exposure and read-out."""
        times = self.plan.scene.times
        if fixed := {"exposure_s", "readout_s"} & set(changes):
            raise DatasetError(f"{fixed.pop()} is that of the film, whose motion blur it is; change [film] instead")
        with request_faults():
            return sensor(preset, exposure_s=times.exposure_s, readout_s=times.readout_s, **changes)

    def frame(
        self,
        number: int,
        preset: str = "mjpeg",
        draw: int = 0,
        camera_seed: int = 0,
        *,
        laser: bool = True,
        side_px: int | None = None,
        **changes: Any,
    ) -> FilmFrame:
        """One draw of a frame.

        Parameters
        ----------
        number, draw : int
            Of the frame, and of the noise realisation.
        preset : str
            Of the sensor.
        camera_seed : int
            Frames of one seed share the fixed pattern.
        laser : bool
            False switches the laser off, whatever the code says.
        side_px : int, optional
            Side of the window, at most that of the film; the film's own by default.
        **changes : Any
            Numbers of the preset.

        Raises
        ------
        DatasetError
            If there is no such frame, preset or number.
        """
        region = self.window(number, side_px)
        return self._drawn(number, self.sensor(preset, **changes), draw, camera_seed, laser, region)

    def cut_out(
        self,
        number: int,
        preset: str = "mjpeg",
        draw: int = 0,
        camera_seed: int = 0,
        *,
        laser: bool = True,
        **changes: Any,
    ) -> FilmFrame:
        """One draw of all that a film holds of a frame; some 20 px at the borders of windows lack their neighbours."""
        return self._drawn(number, self.sensor(preset, **changes), draw, camera_seed, laser, self.info.region)

    def _drawn(
        self, number: int, chosen: Sensor, draw: int, camera_seed: int, laser: bool, region: Region
    ) -> FilmFrame:
        light = self.light(number) if laser else self.light(number).laser_off()
        chain, jpeg = Chain(chosen, camera_seed, self.plan.scene.rig.camera), None
        stream = NoiseStream((*self.plan.names, "film", "on" if laser else "off", number, draw))
        with request_faults():
            if chosen.output == "mjpeg" and region == Region.whole(light.size):
                jpeg = chain.jpeg_bytes(light, stream)
                return FilmFrame(jpeg_image(jpeg), jpeg, number, draw, chosen, region)
            return FilmFrame(chain.frame(light, stream, region), jpeg, number, draw, chosen, region)

    def expected(self, number: int, preset: str = "bayer-raw", margin_px: int = 4, **changes: Any) -> ExpectedRegion:
        """Means and derivatives around the spot of a frame, as `datasets.exposures.expected_electrons`."""
        return expected_of_light(
            self.light(number), self.sensor(preset, **changes), self.plan.scene.rig.camera, margin_px
        )

    def truth_layer(self, number: int, time_s: float | None = None) -> dict[str, Array]:
        """Exact geometry of every pixel in the pose of a frame, or of any time: `render.optics.truth.truth_layer`."""
        view = self._view(number) if time_s is None else self.plan.scene.view_at(time_s)
        return truth_layer(view, room_geometry(self._set.room(self.plan.pair.room), view))

    def correspondence(self, number: int, other: int) -> Correspondence:
        """Counterparts of the pixels of a frame in another one, both in the poses of their times, in some CPU-s."""
        return correspondence(self._set.room(self.plan.pair.room), self._view(number), self._view(other))

    @property
    def room_source(self) -> RoomSource:
        """Source that the room is made from."""
        return self._set.rooms[self.plan.pair.room]

    def _view(self, frame: int) -> View:
        return self.plan.scene.view_at(float(self.plan.scene.times.frame_s[self._number(frame)]))

    def _number(self, frame: int) -> int:
        if not 0 <= frame < self.info.frames:
            raise DatasetError(f"frame {frame}: film {self.info.film} has frames 0 to {self.info.frames - 1}")
        return frame


def film_light(scene: FilmScene, room: NDArray[Any], spot: RowsImage, others: Sequence[RowsImage] = ()) -> Light:
    """Light of a frame from its room, shape (3, H, W), the target's spot and the other lights' in their order."""
    stacks = (spot.electrons_per_s, spot.du_electrons_per_s_px, spot.dv_electrons_per_s_px)
    told = zip(others, scene.lights, strict=True)
    beside = tuple(OtherSpot(image, light.follows_laser) for image, light in told if image.electrons_per_s.size)
    window = SpotWindow(spot.u0_px, spot.v0_px, *stacks)
    return Light(room, window, f_number=scene.rig.camera.f_number, others=beside)


@dataclass(frozen=True)
class Films:
    """A data set of films, by id."""

    folder: Path
    info: SetInfo
    plans: dict[str, FilmPlan]
    _set: Plan = field(repr=False)

    def __getitem__(self, film_id: str) -> Film:
        if film_id not in self.plans:
            raise DatasetError(f"{self.folder} has no film '{film_id}'; it has {', '.join(list(self.plans)[:8])}")
        folder = FilmFolder.of(self.folder, film_id)
        return Film(folder, self.plans[film_id], folder.info(), self._set)

    def __iter__(self) -> Iterator[Film]:
        return (self[film_id] for film_id in self.plans)

    def __len__(self) -> int:
        return len(self.plans)


def open_films(folder: str | Path) -> Films:
    """Open a finished data set of films.

    Raises
    ------
    DatasetError
        If it is none, is not finished, or is of another version; in one sentence.
    """
    path = Path(folder)
    if not (path / INFO).is_file():
        raise DatasetError(f"{path} holds no films: it has no {INFO}; make them with `phibench film make`")
    if not (path / CHECKSUMS).is_file():
        raise DatasetError(f"{path} was not finished; run `phibench film make` again")
    info = read_document(path / INFO, SetInfo)
    if info.schema_version != SCHEMA_VERSION:
        raise DatasetError(f"{path} has the layout {info.schema_version}, {SCHEMA_VERSION} is read; make it again")
    recipe = parse_recipe(recipe_text(path / RECIPE), str(path / RECIPE))
    plan, films = film_plans(recipe, recipe_files(path / RECIPE))
    return Films(path, info, {film.film_id: film for film in films}, plan)
