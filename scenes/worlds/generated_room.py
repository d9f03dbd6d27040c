"""Generator of a room from its properties and a named random stream: doors, windows, furniture, objects, lamps, sun.

Each subject (openings, furniture, things near the robot, things on the floor, walls, ceiling, lamps) has streams of its
own, and comes after those that it must keep clear of. A change of the lamps therefore changes no furniture, and a
change of the furniture no materials. Rooms that are equal to the bit come from equal properties and names.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from phibench.scenes.random_streams import Name, generator
from phibench.scenes.room import Room, Sun
from phibench.scenes.shapes import Bitmap, Rectangle, Shape, Uniform
from phibench.scenes.validation import SceneError
from phibench.scenes.worlds import fixtures, floor_and_near_things, furniture, graphics, standing_objects
from phibench.scenes.worlds.assembly import Assembly, AssemblyShape, Footprint, Piece, footprint_of, moved_parts
from phibench.scenes.worlds.floor_plan import FREE_DISC_M, FloorPlan, Layout, Wall, floor_plan, patch_count, shell
from phibench.scenes.worlds.graphics import radiance_bitmap
from phibench.scenes.worlds.lamps import EFFICACY_LM_W, band_radiance, hang_lamps
from phibench.scenes.worlds.materials import MaterialSet, Surface, one_of
from phibench.scenes.worlds.room_properties import RoomProperties

MOST_LIGHTS = 12  # emitting rectangles: each is sampled by itself
MOST_PATCHES = 3200  # faces of a room: the bake's grids and the time of a ray grow with them
_FEWEST_PATCHES = 30  # of a piece of furniture, but for boxes
_TRIES = 25  # random places for a piece; what does not fit is left out
_FURNITURE_PATCHES, _WALL_PATCHES, _NEAR_PATCHES, _FLOOR_PATCHES = 1050, 330, 220, 180  # of subjects
_SUN_K, _SCREEN_K = 5500.0, 6500.0  # the direct sun; a screen's usual white
_DESK_LUMEN = 400.0  # of a small lamp
_FLOORS = {
    "office": ("plain_carpet", "floor_tiles", "planks", "terrazzo", "parquet"),
    "home": ("planks", "parquet", "carpet", "checker_floor", "plain_carpet"),
    "workshop": ("screed", "floor_tiles", "screed", "checker_floor"),
    "laboratory": ("floor_tiles", "terrazzo", "screed", "checker_floor"),
    "store": ("screed", "terrazzo", "floor_tiles", "planks"),
}
_WALLS = {
    "office": ("plaster", "plaster", "wallpaper", "wall_boards", "concrete_wall"),
    "home": ("wallpaper", "wallpaper", "plaster", "wall_boards", "brick_wall"),
    "workshop": ("concrete_wall", "painted_brick", "brick_wall", "plaster"),
    "laboratory": ("wall_tiles", "plaster", "painted_brick", "plaster"),
    "store": ("painted_brick", "plaster", "concrete_wall", "wall_boards"),
}
_CEILINGS = ("plaster", "ceiling_panels", "plaster", "concrete_wall", "wall_boards")


def generate_room(properties: RoomProperties, *stream: Name) -> Room:
    """Room with these properties; whatever they leave open is drawn from the named stream.

    The robot's stroke axis is the world's z axis, its front +x. Free of everything are the robot's floor disc (0.55 m,
    up to 0.35 m) and an upright cylinder of 0.20 m about the axis, from the floor to the ceiling.

    Raises
    ------
    SceneError
        If no lamp finds a place, which no properties within their ranges are known to cause.
    """
    return _Generator(properties, stream).room()


class _Generator:
    """One room in the making; the methods go from the shell inwards."""

    def __init__(self, properties: RoomProperties, stream: tuple[Name, ...]) -> None:
        self.properties, self.stream = properties, stream
        self.materials = MaterialSet(properties, stream)
        self.plan: FloorPlan = floor_plan(properties)
        self.layout = Layout(self.plan)
        self.window_walls: list[Wall] = []

    def rng(self, *names: Name) -> np.random.Generator:
        return generator(*self.stream, *names)

    def room(self) -> Room:
        self._openings()
        self._skirting()
        self._furniture()
        self._near()
        self._floor_things()
        self._wall_things()
        self._ceiling_things()
        lights = MOST_LIGHTS - len(self.window_walls) - self.properties.desk_lamps - self.properties.indicator_lamps
        hang_lamps(self.layout, self.materials, self.rng("lamps"), min(self.properties.lamps, lights))
        self._indicators()
        return self._assembled()

    # Subjects.

    def _openings(self) -> None:
        p = self.properties
        for k in range(p.windows):
            rng = self.rng("window", k)
            for _ in range(_TRIES):
                wall = self.plan.walls[rng.integers(len(self.plan.walls))]
                made = fixtures.window(
                    rng, self.materials, min(float(rng.uniform(0.9, 2.6)), wall.length_m - 0.6), p.height_m
                )
                if wall.length_m > 1.6 and self._on_wall("window", made, wall, rng, 0.12):
                    self.window_walls.append(wall)
                    break
        for k in range(p.doors):
            rng = self.rng("door", k)
            made = fixtures.door(
                # others are mostly closed
                rng,
                self.materials,
                p.door_angle_deg if k == 0 else float(rng.choice([0.0, 0.0, 70.0])),
            )
            for _ in range(_TRIES):
                wall = self.plan.walls[rng.integers(len(self.plan.walls))]
                if self._on_wall("door", made, wall, rng, 0.75):
                    break

    def _on_wall(self, kind: str, made: Assembly, wall: Wall, rng: np.random.Generator, depth_m: float) -> bool:
        """Place a thing somewhere along a wall if it fits; it takes at least a depth of the room."""
        low, high = made.bounds_m()
        room = (0.05 + high[0], wall.length_m - 0.05 + low[0])  # local x runs against the wall's direction
        if room[1] <= room[0]:
            return False
        x, y = wall.place(float(rng.uniform(*room)), 0.0)
        whole = footprint_of(made, x, y, wall.yaw_rad)
        deep = max(-float(low[1]), depth_m)
        off = 0.5 * deep + 0.0205  # the outline's margin; the thing itself is at the wall
        middle = 0.5 * float(low[0] + high[0])
        centre = (
            x + middle * -wall.along[0] + off * wall.normal[0],
            y + middle * -wall.along[1] + off * wall.normal[1],
        )
        taken = Footprint(*centre, wall.yaw_rad, (whole.half_m[0], 0.5 * deep), whole.z)
        # a door's way may leave the outline
        if not self.layout.is_free(taken, 0.02, FREE_DISC_M + 0.1, outline=depth_m < 0.7):
            return False
        self.layout.put(kind, made, x, y, wall.yaw_rad, taken)
        return True

    def _skirting(self) -> None:
        rng = self.rng("skirting")
        high, surface = (
            float(rng.uniform(0.05, 0.12)),
            one_of(rng, self.materials, ("white_lacquer", "dark_wood", "light_wood", "grey_plastic")),
        )
        # from the floor to a head's height
        doors = [taken for taken in self.layout.taken if taken.z[0] < 0.05 and taken.z[1] > 1.9]
        for wall in self.plan.walls:
            for k, (start, end) in enumerate(_gaps(wall, doors)):
                made = Assembly()
                made.box("board", (0.0, end - start), (-0.014, -0.002), (0.0, high), surface)
                x, y = wall.place(end, 0.0)
                pose = (x, y, wall.yaw_rad)
                kind = f"skirting_{wall.name.rpartition('_')[2]}_{k + 1}"
                self.layout.put(kind, made, *pose, Footprint(x, y, 0.0, (0.0, 0.0), (-2.0, -1.0)))

    def _furniture(self) -> None:
        count, spent = round(self.properties.furniture_per_m2 * self.plan.area_m2), 0
        for k in range(count):
            rng, left = self.rng("furniture", k), _FURNITURE_PATCHES - spent
            if left < _FEWEST_PATCHES:
                break
            # two of five stand free
            table = (furniture.AGAINST_WALLS, furniture.FREE)[int(k % 5 in (1, 3))][self.properties.use]
            kind = list(table)[rng.integers(len(table))]
            if table is furniture.FREE[self.properties.use]:
                spent += self._free_piece(kind, table[kind], rng, left)
            else:
                spent += self._wall_piece(kind, table[kind], rng, left)
        for k in range(self.properties.figures):
            self._free_piece("figure", standing_objects.figure, self.rng("figure", k))

    def _wall_piece(self, kind: str, piece: Piece, rng: np.random.Generator, most: int) -> int:
        """Place a piece of at most so many patches at a wall; return its patches, 0 if it finds no place."""
        made = piece(rng, self.materials)
        if patch_count(made.parts) > most:
            return 0
        low, high = made.bounds_m()
        for _ in range(_TRIES):
            wall = self.plan.walls[rng.integers(len(self.plan.walls))]
            free = (0.03 + high[0], wall.length_m - 0.03 + low[0])
            if free[1] <= free[0]:
                continue
            x, y = wall.place(float(rng.uniform(*free)), float(high[1]) + float(rng.uniform(0.02, 0.06)))
            if self.layout.is_free(footprint_of(made, x, y, wall.yaw_rad), 0.02, FREE_DISC_M + 0.07):
                self.layout.put(kind, made, x, y, wall.yaw_rad)
                return patch_count(made.parts)
        return 0

    def _free_piece(self, kind: str, piece: Piece, rng: np.random.Generator, most: int = MOST_PATCHES) -> int:
        made = piece(rng, self.materials)
        if patch_count(made.parts) > most:
            return 0
        for _ in range(_TRIES):
            x, y = float(rng.uniform(0.3, self.plan.length_m - 0.3)), float(rng.uniform(0.3, self.plan.width_m - 0.3))
            turn = float(rng.integers(4)) * math.pi / 2.0 + float(rng.normal(0.0, 0.12))  # nearly along the walls
            if rng.random() < 0.3:  # some stand anyhow
                turn = float(rng.uniform(-math.pi, math.pi))
            if self.layout.is_free(footprint_of(made, x, y, turn), 0.05, FREE_DISC_M + 0.07):
                self.layout.put(kind, made, x, y, turn)
                return patch_count(made.parts)
        return 0

    def _near(self) -> None:
        spent = 0
        for k in range(self.properties.near_objects):
            rng = self.rng("near", k)
            kind = int(rng.integers(len(floor_and_near_things.NEAR_THINGS)))
            made = floor_and_near_things.NEAR_THINGS[kind](rng, self.materials)
            for _ in range(_TRIES if spent < _NEAR_PATCHES else 0):
                # from just outside the free cylinder
                angle, off = float(rng.uniform(-math.pi, math.pi)), float(rng.uniform(0.27, 1.0))
                x, y = self.plan.robot[0] + off * math.cos(angle), self.plan.robot[1] + off * math.sin(angle)
                turn = angle + math.pi / 2.0 + float(rng.normal(0.0, 0.2))  # +y towards the axis
                place = footprint_of(made, x, y, turn)
                if self.layout.is_free(place, 0.02, 0.0) and self.layout.leaves_the_robot(made, x, y, turn):
                    self.layout.put(f"near_{floor_and_near_things.NEAR_THINGS[kind].__name__}", made, x, y, turn)
                    spent += patch_count(made.parts)
                    break

    def _floor_things(self) -> None:
        spent = 0
        for k in range(self.properties.floor_objects):
            rng = self.rng("floor", k)
            piece = floor_and_near_things.FLOOR_THINGS[rng.integers(len(floor_and_near_things.FLOOR_THINGS))]
            if spent < _FLOOR_PATCHES:
                spent += self._free_piece(piece.__name__, piece, rng)

    def _wall_things(self) -> None:
        length, spent = sum(wall.length_m for wall in self.plan.walls), 0
        pieces, placed = fixtures.WALL_THINGS[self.properties.use], set()
        for k in range(round(self.properties.wall_objects_per_m * length)):
            rng = self.rng("wall", k)
            piece = pieces[rng.integers(len(pieces))]
            if spent > _WALL_PATCHES:
                break
            if piece in placed and piece in fixtures.ONE_EACH:
                continue
            made = piece(rng, self.materials)
            if made.bounds_m()[1, 2] > self.properties.height_m - 0.05:  # higher than the room
                continue
            for _ in range(_TRIES):
                wall = self.plan.walls[rng.integers(len(self.plan.walls))]
                if self._on_wall(piece.__name__, made, wall, rng, 0.1):
                    spent += patch_count(made.parts)
                    placed.add(piece)
                    break

    def _ceiling_things(self) -> None:
        rng = self.rng("ceiling")
        # where pipes are not hidden
        chance = {"workshop": 0.9, "store": 0.8, "laboratory": 0.6, "office": 0.25, "home": 0.1}[self.properties.use]
        for wall in self.plan.walls:
            length = wall.length_m - 0.3
            made = fixtures.ceiling_run(rng, self.materials, length)
            x, y = wall.place(wall.length_m / 2.0, 0.03)
            if rng.random() < chance and self.layout.is_free(footprint_of(made, x, y, wall.yaw_rad), 0.01, 0.3):
                self.layout.put("ceiling_run", made, x, y, wall.yaw_rad)

    def _indicators(self) -> None:
        for k in range(self.properties.indicator_lamps):
            rng = self.rng("indicator", k)
            made, half, z = Assembly(), float(rng.uniform(0.01, 0.02)), float(rng.uniform(0.4, 2.0))
            case = self.materials.surface("dark_plastic")
            made.box("case", (-0.05, 0.05), (-0.03, -0.003), (z - 0.05, z + 0.05), case)
            made.panel("light", (0.0, -0.032, z), (0.0, -1.0, 0.0), (2.0 * half, 2.0 * half), case, "indicator")
            for _ in range(2 * _TRIES):  # small: worth more tries
                wall = self.plan.walls[rng.integers(len(self.plan.walls))]
                if self._on_wall("indicator", made, wall, rng, 0.3):
                    break

    # Assembly.

    def _assembled(self) -> Room:
        if not any(part.role == "lamp" for part in self.layout.parts):
            raise SceneError("generate_room: no lamp finds a place; lower furniture_per_m2 or near_objects")
        walls, floor, ceiling = self._shell_surfaces()
        parts = [AssemblyShape(surface) for surface in shell(self.plan, floor, ceiling, walls)]
        parts += self._switched_on()
        shapes = [part.shape for part in moved_parts(parts, self.plan.T_world_plan)]
        lights = tuple(shape for shape in shapes if isinstance(shape, Rectangle))
        solids: tuple[Shape, ...] = tuple(shape for shape in shapes if not isinstance(shape, Rectangle))
        name = "generated:" + ":".join(str(part) for part in self.stream)
        return Room(name, lights, solids, sun=self._sun())

    def _shell_surfaces(self) -> tuple[tuple[Surface, ...], Surface, Surface]:
        p, rng = self.properties, self.rng("shell")
        floors, walls = _FLOORS[p.use], _WALLS[p.use]
        floor = self.materials.shell("floor", floors[rng.integers(len(floors))], p.floor_albedo)
        ceiling = self.materials.shell("ceiling", _CEILINGS[rng.integers(len(_CEILINGS))], p.ceiling_albedo)
        first, other = walls[rng.integers(len(walls))], walls[rng.integers(len(walls))]
        main = self.materials.shell("wall", first, p.wall_albedo)
        # one wall of another colour
        accent = self.materials.shell("wall", other, p.wall_albedo * 0.85) if rng.random() < 0.5 else main
        count = len(self.plan.walls)
        return tuple(accent if k == count // 2 else main for k in range(count)), floor, ceiling

    def _switched_on(self) -> list[AssemblyShape]:
        """Parts with their light: lamps share the room's flux; screens, bulbs, sky and views as stated."""
        p, parts = self.properties, self.layout.parts
        lamp = self._lamp_radiance(parts)
        sky = band_radiance(p.sky_cd_m2, p.sky_temperature_k)
        chosen = {
            role: self._chosen(parts, role, most) for role, most in (("bulb", p.desk_lamps), ("screen", p.screens))
        }
        done = []
        for k, part in enumerate(parts):
            shape = part.shape
            if not part.role or not isinstance(shape, Rectangle) or k not in chosen.get(part.role, {k}):
                done.append(part)
            elif part.role == "lamp":
                done.append(_emitting(shape, lamp))
            elif part.role == "bulb":
                area = shape.size_m[0] * shape.size_m[1]
                done.append(_emitting(shape, band_radiance(_DESK_LUMEN / (math.pi * area), p.colour_temperature_k)))
            elif part.role == "sky":
                done.append(_emitting(shape, sky, window=True))
            elif part.role == "indicator":
                done.append(
                    _emitting(shape, np.array([1.0, 0.03, 0.0]) * self.rng("indicator", shape.name).uniform(2.0, 30.0))
                )
            else:
                done.append(self._shining(shape, part.role, sky))
        return done

    def _lamp_radiance(self, parts: Sequence[AssemblyShape]) -> np.ndarray:
        """All lamps alike: their flux, pi L A each, over the floor's area is the stated illuminance."""
        p = self.properties
        sizes = [part.shape.size_m for part in parts if part.role == "lamp" and isinstance(part.shape, Rectangle)]
        area = sum(size[0] * size[1] for size in sizes)
        return band_radiance(p.illuminance_lx * self.plan.area_m2 / (math.pi * area), p.colour_temperature_k)

    def _chosen(self, parts: Sequence[AssemblyShape], role: str, most: int) -> set[int]:
        """Numbers of the parts that are switched on."""
        numbers = [k for k, part in enumerate(parts) if part.role == role]
        return {int(k) for k in self.rng(role).permutation(numbers)[:most]} if numbers else set()

    def _shining(self, shape: Rectangle, role: str, sky: np.ndarray) -> AssemblyShape:
        """Screen or view whose texture is its light."""
        if role == "screen":
            values = graphics.screen(self.rng("screen", shape.name), (40, 64))
            white = band_radiance(self.properties.screen_cd_m2, _SCREEN_K)
        else:
            assert isinstance(shape.texture, Bitmap)
            values, white = shape.texture.values.astype(float), sky
        bitmap = radiance_bitmap(values, shape.size_m, white)
        return AssemblyShape(replace(shape, texture=bitmap, coat=0.0), role)

    def _sun(self) -> Sun | None:
        """Sun before the first window, if there is one and it shines."""
        p = self.properties
        if not p.sun or not self.window_walls:
            return None
        nx, ny = self.window_walls[0].normal
        azimuth, up = math.atan2(-ny, -nx) + math.radians(p.sun_azimuth_deg), math.radians(p.sun_elevation_deg)
        towards = np.array([math.cos(up) * math.cos(azimuth), math.cos(up) * math.sin(azimuth), math.sin(up)])
        world = self.plan.T_world_plan.directions(towards)
        relative = band_radiance(1.0, _SUN_K)
        irradiance = p.sun_lx * relative / float(relative @ np.array(EFFICACY_LM_W))
        return Sun(tuple(float(x) for x in world), tuple(float(x) for x in irradiance))


def _emitting(shape: Rectangle, radiance: np.ndarray, window: bool = False) -> AssemblyShape:
    values = tuple(float(x) for x in radiance)
    return AssemblyShape(
        replace(shape, texture=Uniform((0.0, 0.0, 0.0)), radiance_w_m2_sr=values, coat=0.0, window=window)
    )


def _gaps(wall: Wall, doors: Sequence[Footprint]) -> list[tuple[float, float]]:
    """Stretches of a wall that no door interrupts, metres from its start."""
    start, gaps = 0.004, []
    blocked = []
    for taken in doors:
        offset = (taken.x - wall.start[0], taken.y - wall.start[1])
        along = offset[0] * wall.along[0] + offset[1] * wall.along[1]
        off = offset[0] * wall.normal[0] + offset[1] * wall.normal[1]
        if (
            abs(off) < 1.3
            and 0.0 < along < wall.length_m
            and abs(math.remainder(taken.yaw_rad - wall.yaw_rad, 2.0 * math.pi)) < 0.01
        ):
            blocked.append((along - taken.half_m[0] - 0.01, along + taken.half_m[0] + 0.01))
    for low, high in sorted(blocked):
        if low - start > 0.1:
            gaps.append((start, low))
        start = max(start, high)
    if wall.length_m - 0.018 - start > 0.1:
        gaps.append((start, wall.length_m - 0.018))
    return gaps
