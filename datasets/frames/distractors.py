"""Distractors, lights that a method may take for the laser spot: random places, images and truth for each sample.

They are flat Lambertian discs at the laser's wavelength, with an exact place in both images, as the spot has. A
sample's distractors are a pure function of the recipe, the sample's names and its row of the manifest. They are
computed when frames are, and never stored.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from phibench.datasets.recipe.distributions import DistributionTable, quantile
from phibench.datasets.recipe.recipe_scene import spot_albedo
from phibench.datasets.recipe.spot_placement import by_ray, spot_on_board
from phibench.datasets.recipe.tables import DistractorTable, Recipe
from phibench.datasets.store.layers import SpotWindow
from phibench.datasets.store.schema import ManifestRow, SpotRow
from phibench.datasets.store.stored_rooms import Rooms
from phibench.render.optics.room_tracer import room_geometry
from phibench.render.optics.spot_layer import SpotLayer, spot_layer
from phibench.render.optics.truth import SpotTruth, spot_truth
from phibench.render.sensor.light import OtherSpot
from phibench.scenes.frames import Vector
from phibench.scenes.laser import LaserSpot
from phibench.scenes.random_streams import Name, generator
from phibench.scenes.rig import POSITIONS, View
from phibench.scenes.room import BOARD_SIZE_M, Room

MIN_APART_PX = 12.0
"""Nearer than this a distractor would lie in the spot's window, and the spot's own place would be in doubt."""
TRIES = 20  # places that are drawn for one: a room that shows none of them has none

Names = tuple[str, int, str]


class _Rooms(Protocol):
    """Data set as distractors need it."""

    @property
    def recipe(self) -> Recipe:
        """Its recipe."""

    @property
    def rooms(self) -> Rooms:
        """Its rooms."""


class _Sample(Protocol):
    """Sample as distractors need it; `phibench.datasets.read.Sample` is one."""

    @property
    def dataset(self) -> _Rooms:
        """Its data set."""

    @property
    def row(self) -> ManifestRow:
        """Exact numbers."""

    @property
    def stream_names(self) -> Names:
        """Data set, its seed, sample id."""

    def truth_row(self, position: str) -> SpotRow:
        """Exact answer for the spot."""

    def view(self, position: str) -> View:
        """Rig at a position."""


@dataclass(frozen=True)
class Distractor:
    """One light beside the spot.

    Attributes
    ----------
    kind : "spot", "glow" or "led"
    follows_laser : bool
        Whether it goes out with the laser.
    spot : LaserSpot
        The disc, its power such that the flux ratio is that of the recipe.
    layers : mapping of position to SpotLayer
        Electrons per second at laser level 1.
    truths : mapping of position to SpotTruth
    """

    kind: str
    follows_laser: bool
    spot: LaserSpot
    layers: Mapping[str, SpotLayer] = field(repr=False)
    truths: Mapping[str, SpotTruth] = field(repr=False)

    def other(self, position: str, laser_level: float) -> OtherSpot:
        """Its light in one view; a lamp that stays on keeps its ratio to the spot at this level."""
        level = 1.0 if self.follows_laser else laser_level
        layer = self.layers[position]
        stacks = (layer.electrons_per_s, layer.du_electrons_per_s_px, layer.dv_electrons_per_s_px)
        window = SpotWindow(layer.u0_px, layer.v0_px, *(level * stack for stack in stacks))
        return OtherSpot(window, self.follows_laser)


def present_tables(names: Names, tables: tuple[DistractorTable, ...]) -> tuple[int, ...]:
    """Numbers of the tables that a sample was drawn to have."""
    return tuple(i for i, table in enumerate(tables) if _unit(names, i, "present") < table.probability)


def distractors(sample: _Sample) -> tuple[Distractor, ...]:
    """Distractors of a sample, in the order of the recipe; those that find no place are left out.

    They stay with the sample, which is frozen: all presets and draws have the same, and their room takes long to build.
    """
    kept = vars(sample)
    if _KEPT not in kept:
        kept[_KEPT] = _found(sample)
    placed: tuple[Distractor, ...] = kept[_KEPT]
    return placed


_KEPT = "_distractors"


def _found(sample: _Sample) -> tuple[Distractor, ...]:
    tables = sample.dataset.recipe.distractors
    if not any(sample.truth_row(position).visible for position in POSITIONS):
        return ()  # who cannot see the spot is not distracted from it
    numbers = present_tables(sample.stream_names, tables)
    if not numbers:
        return ()
    room = sample.dataset.rooms.geometry(sample.row.room)
    placed = (_placed(sample, room, i, tables[i]) for i in numbers)
    return tuple(distractor for distractor in placed if distractor is not None)


def _placed(sample: _Sample, room: Room, number: int, table: DistractorTable) -> Distractor | None:
    """First of `TRIES` places that the down image shows, apart from the spot in both images."""
    views = {position: sample.view(position) for position in POSITIONS}
    rooms = {position: room_geometry(room, view) for position, view in views.items()}
    for attempt in range(TRIES):
        spot = _drawn_spot(sample, room, number, table, attempt)
        if spot is None:
            continue  # the ray meets nothing: another draw
        truths = {position: spot_truth(view, spot, rooms[position]) for position, view in views.items()}
        if not truths["down"].visible or any(_too_near(sample, position, truths[position]) for position in POSITIONS):
            continue  # unseen, or in the spot's window: another draw
        layers = {position: spot_layer(view, spot, rooms[position]) for position, view in views.items()}
        ratio = max(_ratio(sample, position, layers[position]) for position in POSITIONS)
        if ratio > 0.0:
            wanted = _value(sample.stream_names, number, "flux_ratio", table.flux_ratio)
            scaled = {position: _scaled(layer, wanted / ratio) for position, layer in layers.items()}
            spot = replace(spot, power_w=spot.power_w * wanted / ratio)
            return Distractor(table.kind, table.follows_laser, spot, scaled, truths)
    return None


def _ratio(sample: _Sample, position: str, layer: SpotLayer) -> float:
    """Electrons relative to the spot's; 0 where the spot is not seen."""
    row = sample.truth_row(position)
    return float(layer.total_electrons_per_s.sum() / sum(row.electrons_per_s)) if row.visible else 0.0


def _too_near(sample: _Sample, position: str, truth: SpotTruth) -> bool:
    row = sample.truth_row(position)
    return math.hypot(truth.u_px - row.u_px, truth.v_px - row.v_px) < MIN_APART_PX  # False where one is NaN


def _scaled(layer: SpotLayer, factor: float) -> SpotLayer:
    return replace(
        layer,
        electrons_per_s=factor * layer.electrons_per_s,
        du_electrons_per_s_px=factor * layer.du_electrons_per_s_px,
        dv_electrons_per_s_px=factor * layer.dv_electrons_per_s_px,
        total_electrons_per_s=factor * layer.total_electrons_per_s,
    )


def _drawn_spot(sample: _Sample, room: Room, number: int, table: DistractorTable, attempt: int) -> LaserSpot | None:
    """Disc at one drawn place; None where there can be none."""
    place = _ray_place if table.azimuth_deg is not None else _board_place
    spot = place(sample, room, number, table, attempt)
    if spot is None:
        return None
    recipe = sample.dataset.recipe
    return LaserSpot(
        *spot,
        diameter_m=_value(sample.stream_names, number, "diameter_m", table.diameter_m),
        albedo=max(spot_albedo(recipe.laser.albedo, None) or 0.0, 0.01),  # its power is scaled to the flux ratio anyway
        power_w=recipe.laser.power_w,
        wavelength_nm=recipe.laser.wavelength_nm,
        profile=recipe.laser.profile if table.kind == "spot" else "uniform",
    )


def _ray_place(
    sample: _Sample, room: Room, number: int, table: DistractorTable, attempt: int
) -> tuple[Vector, Vector] | None:
    """Position and normal on a horizontal ray from the axis: free in the room, or where it ends."""
    names = sample.stream_names
    azimuth_deg, height_m, distance_m = (
        0.0 if given is None else _value(names, number, key, given, attempt)
        for key, given in (
            ("azimuth_deg", table.azimuth_deg),
            ("height_m", table.height_m),
            ("distance_m", table.distance_m),
        )
    )
    if table.distance_m is None:
        [spot] = by_ray(sample.dataset.recipe.laser, room, np.array([azimuth_deg]), np.array([height_m]))
        return None if isinstance(spot, str) else (spot[1].position_world_m, spot[1].normal_world)
    x, y = math.cos(math.radians(azimuth_deg)), math.sin(math.radians(azimuth_deg))
    position = (distance_m * x, distance_m * y, height_m)
    return None if room.solid_around(position) is not None else (position, (-x, -y, 0.0))


def _board_place(
    sample: _Sample, _room: Room, number: int, table: DistractorTable, attempt: int
) -> tuple[Vector, Vector] | None:
    """Position and normal anywhere on a board that is not the sample's own."""
    recipe, names = sample.dataset.recipe, sample.stream_names
    allowed = None if table.target is None else set(table.target.choice)
    boards = [t for t in recipe.targets if t.name != sample.row.target and (allowed is None or t.name in allowed)]
    if not boards:
        return None  # the sample's own board is the only one
    board = boards[int(_unit(names, number, "target", attempt) * len(boards))]
    reach_m = _value(names, number, "diameter_m", table.diameter_m)
    across_m, up_m = (
        (2.0 * _unit(names, number, key, attempt) - 1.0) * max(size_m / 2.0 - reach_m, 0.0)
        for key, size_m in zip(("across", "up"), BOARD_SIZE_M, strict=True)
    )
    spot = spot_on_board(recipe.laser, board, across_m, up_m)
    return spot.position_world_m, spot.normal_world


def _value(names: Names, number: int, key: str, table: DistributionTable, attempt: int = 0) -> float:
    return float(quantile(table, np.array(_unit(names, number, key, attempt))[None])[0])


def _unit(names: Names, number: int, *key: Name) -> float:
    """Number in [0, 1) of a stream of its own."""
    return float(generator(*names, "distractor", number, *key).random())
