"""Checks across several keys of a recipe (names, places, strokes, the whole rig); warnings of legal but odd values.

A recipe is checked in two stages. The first one reads the document: keys, types and ranges, which the tables check, and
which tables go together (`table_faults`). The second one takes a recipe without such faults, and the scene that it
describes (`scene_faults`). Each stage reports all of its faults.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from phibench.datasets.recipe.distributions import DistributionTable, Table
from phibench.datasets.recipe.recipe_scene import (
    build_misalignment,
    build_rig,
    build_room,
    build_spot,
    build_target,
    build_true_rig,
    ceiling_m,
    drawn_mirror_faults,
    fixed_conic_faults,
    idle_holder_faults,
    idle_mirror_faults,
    rig_fault_of,
    text_by_keys,
    true_stroke_m,
)
from phibench.datasets.recipe.room_checks import low_room_faults, room_faults, room_table_faults
from phibench.datasets.recipe.spot_placement import free_margin_m
from phibench.datasets.recipe.tables import (
    DRAWABLE,
    MIN_STROKE_M,
    SENSOR_KEYS,
    SENSOR_OF_FRAME,
    DistractorTable,
    FramesTable,
    RandomHolderTable,
    RandomRigTable,
    RandomSpotTable,
    Recipe,
    RigTable,
    TargetTable,
)
from phibench.render.room.subpixel_grid import FilmGrid
from phibench.render.sensor.settings import SensorError, sensor
from phibench.scenes.mirror import OF_REVOLVED
from phibench.scenes.rig import Rig
from phibench.scenes.room import BOARD_SIZE_M, Room, board, chassis, cut_part
from phibench.scenes.validation import Fault, SceneError, close_names, nearest

_ON_BOARD, _BY_RAY = ("target", "across_m", "up_m"), ("azimuth_deg", "height_m")
_BOARD = "the board ({:.2f} m wide, {:.2f} m high)".format(*BOARD_SIZE_M)


def table_faults(raw: dict[str, Any]) -> Iterator[Fault]:
    """Tables of a document that do not go together, that are missing, or that cannot be drawn; the first stage."""
    tables = list(Recipe.model_fields)
    given = [key for key in ("experiments", "random") if key in raw]
    misspelt = [key for key in raw if key not in tables and set(close_names(key, tables)) & {"experiments", "random"}]
    if len(given) == 2:
        yield Fault("random", "given together with [[experiments]]; give one or the other")
    elif raw.get("experiments") == [] or not (given or misspelt or "rooms" in raw):  # [rooms] says what it needs
        what = "empty" if given else "missing"
        yield Fault("experiments", f"{what}; add [[experiments]] (which targets with which strokes) or [random]")
    if "random" in raw and raw.get("rigs"):
        yield Fault("rigs", "given together with [random], whose samples have rigs of their own; remove one")
    if isinstance(rigs := raw.get("rigs"), dict) and rigs and not rigs.get("misalignment"):
        yield Fault("rigs.misalignment", "draws nothing; add distributions of keys of [misalignment] or remove [rigs]")
    yield from room_table_faults(raw)
    drawn: Any = raw
    for key in ("random", "rig"):
        drawn = drawn.get(key) if isinstance(drawn, dict) else None
    for key in drawn if isinstance(drawn, dict) else ():
        if key in RigTable.model_fields and key not in (*DRAWABLE, "holder", "mirror"):
            is_word = key in ("preset", "laser_filter_response")
            why = "is not a number" if is_word else "must be the same for all samples"
            yield Fault(f"random.rig.{key}", f"cannot be drawn, it {why}; set {key} in [rig]")


@dataclass(frozen=True)
class _Scene:
    """Recipe without faults of its tables, and its room without boards; None where rooms are drawn."""

    recipe: Recipe
    room: Room | None

    @staticmethod
    def of(recipe: Recipe) -> _Scene:
        return _Scene(recipe, None if recipe.rooms is not None else build_room(recipe.room, ()))

    @property
    def spot(self) -> RandomSpotTable:
        """Table `[random.spot]`; an empty one where nothing is drawn."""
        return RandomSpotTable() if self.recipe.random is None else self.recipe.random.spot

    @property
    def drawn_rig(self) -> Table:
        """Table `[random.rig]`; an empty one where nothing is drawn."""
        return RandomRigTable() if self.recipe.random is None else self.recipe.random.rig


def scene_faults(recipe: Recipe) -> list[Fault]:
    """Faults between keys of a recipe, and of its scene; the second stage."""
    scene = _Scene.of(recipe)
    return [*room_faults(recipe), *(fault for rule in _RULES for fault in rule(scene))]


def warnings(recipe: Recipe) -> list[str]:
    """Warnings of what is legal but probably not meant."""
    result = []
    if not (_draws_outline(recipe) or build_true_rig(recipe).fits_image()):
        result.append("rig: the mirror's outline does not fit the image; spots near its rim may fall outside")
    used = _used_targets(recipe)
    unused = [target.name for target in recipe.targets if target.name not in used]
    if unused:
        what = "experiment uses" if recipe.random is None else "sample of [random] uses"
        result.append(f"targets: {', '.join(unused)} stand in the room but no {what} their spots")
    return result


_OF_THE_OUTLINE = ("z_c_m", "radius_m", "pixel_pitch_um", "fx_px", "fy_px", "cx_px", "cy_px", "mirror")


def _draws_outline(recipe: Recipe) -> bool:
    """Tell whether samples draw what makes the outline large or moves it: then no sample has the rig of `[rig]`."""
    return recipe.random is not None and any(getattr(recipe.random.rig, key) is not None for key in _OF_THE_OUTLINE)


def _used_targets(recipe: Recipe) -> set[str]:
    if recipe.random is not None:
        chosen = recipe.random.spot.target
        return {target.name for target in recipe.targets} if chosen is None else set(chosen.choice)
    return {name for experiment in recipe.experiments for name in experiment.targets}


# Names.


def _names(scene: _Scene) -> Iterator[Fault]:
    """Names that are given twice, and names of targets that are not there."""
    recipe = scene.recipe
    for key in ("targets", "experiments"):
        first: dict[str, int] = {}
        for i, table in enumerate(getattr(recipe, key)):
            # names that differ by case only are refused too: they become file names
            if (earlier := first.setdefault(table.name.casefold(), i)) != i:
                yield Fault(
                    f"{key}[{i}].name", f"'{table.name}' is also the name of {key}[{earlier}]; rename one of them"
                )
    known = [table.name for table in recipe.targets]
    wanted = [(f"experiments[{i}].targets", table.targets) for i, table in enumerate(recipe.experiments)]
    for path, names in (*wanted, *_choices(scene)) if known else ():
        for j, name in enumerate(names):
            if name not in known:
                yield Fault(f"{path}[{j}]", f"no target is called '{name}'; {nearest(name, known)}")


def _choices(scene: _Scene) -> list[tuple[str, tuple[str, ...]]]:
    """Lists of boards that are drawn from, with their paths."""
    places: list[tuple[str, RandomSpotTable | DistractorTable]] = [("random.spot", scene.spot)]
    places += [(f"distractors[{i}]", table) for i, table in enumerate(scene.recipe.distractors)]
    return [(f"{path}.target.choice", one.target.choice) for path, one in places if one.target is not None]


def _repeats(scene: _Scene) -> Iterator[Fault]:
    recipe = scene.recipe
    lists: list[tuple[str, Sequence[object]]] = [*_choices(scene)]
    for i, table in enumerate(recipe.experiments):
        lists += [(f"experiments[{i}].{key}", getattr(table, key)) for key in ("targets", "strokes_m")]
    if recipe.frames is not None:
        lists.append(("frames.presets", recipe.frames.presets))
    for path, values in lists:
        for j, value in enumerate(values):
            if value in values[:j]:
                yield Fault(f"{path}[{j}]", f"{value!r} is listed twice; remove one")


# What is drawn.


def _draws(scene: _Scene) -> Iterator[Fault]:
    if scene.recipe.random is None:
        return  # nothing is drawn
    spot, given = scene.spot, scene.spot.model_fields_set
    ray, on_board = ([key for key in keys if key in given] for keys in (_BY_RAY, _ON_BOARD))
    if ray and on_board:
        text = f"{', '.join(on_board)} (on a board) and {', '.join(ray)} (by a ray) are both given"
        yield Fault("random.spot", f"{text}; give one or the other")
    elif "elevation_deg" in given and not ray:
        yield Fault("random.spot.azimuth_deg", "missing; elevation_deg needs it, azimuth_deg and height_m make the ray")
    elif "hidden_elevation_deg" in given and not ("hidden" in given and ray):
        missing_key = "hidden" if ray else "azimuth_deg"
        text = "hidden_elevation_deg is the elevation of rays to spots that one image hides"
        yield Fault(f"random.spot.{missing_key}", f"missing; {text}")
    elif len(ray) == 1:
        [missing] = set(_BY_RAY) - set(ray)
        yield Fault(f"random.spot.{missing}", f"missing; {ray[0]} needs it, the two make the ray")
    if not ray:
        yield from _off_board(scene)
    yield from _off_wall("random.spot.height_m", spot.height_m, scene.room)


def _off_board(scene: _Scene) -> Iterator[Fault]:
    """Distributions that reach beyond where a spot of the drawn boards is wholly on its board."""
    spot = scene.spot
    drawn = [one for one in scene.recipe.targets if spot.target is None or one.name in spot.target.choice]
    for axis, key in enumerate(("across_m", "up_m") if drawn else ()):
        table = getattr(spot, key)
        farthest = 0.0 if table is None else max(map(abs, table.support))
        left, name = min((free_margin_m(scene.recipe.laser, target)[axis], target.name) for target in drawn)
        if left < 0.0:
            text = f"a spot at the centre of the board '{name}' already reaches {-left:.3f} m beyond its edge"
            yield Fault(f"random.spot.{key}", f"{text}; make the spot smaller (see laser.diameter_m)")
        elif farthest > left:
            text = f"reaches {farthest:g} m, where the spot leaves the board '{name}'"
            yield Fault(f"random.spot.{key}", f"{text}; stay within -{left:.3f} to {left:.3f}")


def _off_wall(path: str, table: DistributionTable | None, room: Room | None) -> Iterator[Fault]:
    """Heights of rays below the floor or above the lamps."""
    if table is None or room is None:
        return  # no ray, or drawn rooms with heights of their own
    (low, high), limit_m = table.support, ceiling_m(room)
    if low <= 0.0 or high >= limit_m:
        text = f"reaches from {low:g} to {high:g} m, beyond floor or lamps"
        yield Fault(path, f"{text}; stay above 0 and below {limit_m:.2f}")


def _frames(scene: _Scene) -> Iterator[Fault]:
    """Numbers of `[frames]` that the sensor does not take; its ranges are its own."""
    frames = scene.recipe.frames
    if frames is None:
        return  # no frames are taken
    for key in (*SENSOR_KEYS, "exposure_s"):
        table = getattr(frames, key)
        for value in dict.fromkeys(table.support) if isinstance(table, DistributionTable) else ():
            try:
                sensor("mjpeg", **{key: round(value) if key == "jpeg_quality" else value})
            except SensorError as error:
                yield Fault(f"frames.{key}", f"reaches {value:g}; stay with what the sensor takes ({error})")
    if frames.sensor is not None:
        yield from _sensor(frames, frames.sensor)


def _sensor(frames: FramesTable, numbers: dict[str, Any]) -> Iterator[Fault]:
    """Numbers of `[frames.sensor]` that a sensor does not take, that belong to a frame, or that are given twice."""
    given = {key: value for key, value in numbers.items() if key not in (*SENSOR_OF_FRAME, *SENSOR_KEYS)}
    for key in numbers:
        if key in SENSOR_OF_FRAME:
            yield Fault(f"frames.sensor.{key}", "is no number of a camera; leave it out")
        elif key in SENSOR_KEYS and key in frames.model_fields_set:
            yield Fault(f"frames.sensor.{key}", f"given together with frames.{key}; give one or the other")
        elif key in SENSOR_KEYS:
            given[key] = numbers[key]
    for preset in frames.presets:
        try:
            sensor(preset, **given)
        except SensorError as error:
            yield Fault("frames.sensor", str(error))
            return  # the other presets would say the same


def _distractors(scene: _Scene) -> Iterator[Fault]:
    for i, table in enumerate(scene.recipe.distractors):
        path, keys = f"distractors[{i}]", table.model_fields_set
        given = [key for key in (*_BY_RAY, "distance_m") if key in keys]
        if given and "target" in keys:
            text = f"given together with {', '.join(given)} (a ray); give one or the other"
            yield Fault(f"{path}.target", text)
        if given and (missing := [key for key in _BY_RAY if key not in keys]):
            yield Fault(f"{path}.{missing[0]}", f"missing; {given[0]} needs it, azimuth_deg and height_m make the ray")
        if table.kind == "glow" and "distance_m" not in keys:
            yield Fault(f"{path}.distance_m", "missing; a glow hangs free in the room, at distance_m along its ray")
        yield from _off_wall(f"{path}.height_m", table.height_m, scene.room)


# Spots, boards and the rig.


def _laser(scene: _Scene) -> Iterator[Fault]:
    laser = scene.recipe.laser
    growing = laser.model_fields_set & {"diameter_base_m", "diameter_growth_m_per_m"}
    if laser.diameter_m is not None and growing:
        yield Fault("laser.diameter_m", f"given together with {', '.join(sorted(growing))}; give one or the other")
    if laser.diameter_m is None and laser.diameter_base_m + laser.diameter_growth_m_per_m == 0.0:
        yield Fault("laser.diameter_base_m", "0.0 with no growth makes spots of diameter 0; give a number above 0")


def _holder(scene: _Scene) -> Iterator[Fault]:
    """Keys of a holder that none of its kinds has; a drawn kind makes the sizes of each of its names useful."""
    fixed, drawn = scene.recipe.rig.holder, getattr(scene.drawn_rig, "holder", RandomHolderTable())
    drawn_kind = getattr(drawn, "kind", None)
    kinds = (fixed.kind,) if drawn_kind is None else drawn_kind.choice
    yield from idle_holder_faults("rig.holder", sorted(fixed.model_fields_set), kinds)
    yield from idle_holder_faults("random.rig.holder", sorted(drawn.model_fields_set), kinds)


def _mirror(scene: _Scene) -> Iterator[Fault]:
    """Keys of a mirror of revolution that none of its shapes has."""
    table, drawn = scene.recipe.rig.mirror, getattr(scene.drawn_rig, "mirror", None)
    given = set() if drawn is None else drawn.model_fields_set
    if table is None:
        if given:
            yield Fault("rig.mirror", "missing; [random.rig.mirror] draws keys of it, give at least its shape")
        return  # a sphere
    shapes = getattr(getattr(drawn, "shape", None), "choice", (table.shape,))
    yield from idle_mirror_faults("rig.mirror", table, shapes)
    yield from drawn_mirror_faults("random.rig.mirror", {} if drawn is None else dict(drawn), shapes)
    if {"shape", "conic"} & given == {"shape"}:
        yield from fixed_conic_faults("rig.mirror", table, shapes)


def _rig(scene: _Scene) -> Iterator[Fault]:
    """Faults of the rig, nominal and true, and of the boards and strokes that do not go with it."""
    recipe = scene.recipe
    misplaced = dict(_places(scene))
    yield from misplaced.values()
    try:
        rig = build_rig(recipe.rig)
    except SceneError as error:
        yield rig_fault_of(error)
        return  # what follows needs the rig
    if rig.mirror.reflectance_table is not None:
        try:
            rig.mirror.band(recipe.laser.wavelength_nm)
        except SceneError as error:
            yield rig_fault_of(SceneError(text_by_keys(str(error))))
    yield from _without_axis(recipe, rig)
    try:
        FilmGrid.of(rig.camera, recipe.ambient.cells_per_pixel)
    except SceneError as error:
        yield Fault("ambient.cells_per_pixel", str(error))
    too_high = None if scene.room is None else _height(recipe.rig, rig, scene.room)
    if too_high is not None:
        yield too_high
    if recipe.rooms is not None:
        yield from low_room_faults(recipe, rig)
    if not rig.in_image():
        yield Fault("rig", "the mirror is outside of the image; move it or the principal point")
        return  # so would be the true one's
    targets = [(i, target) for i, target in enumerate(recipe.targets) if i not in misplaced]
    yield from _true_rig(recipe, rig, None if too_high else scene.room, targets)


def _without_axis(recipe: Recipe, rig: Rig) -> Iterator[Fault]:
    """Faults of deviations of a sphere that has neither axis nor rim."""
    tables: list[tuple[str, Table]] = [("misalignment", recipe.misalignment)]
    tables += [
        (f"{key}.misalignment", table.misalignment)
        for key in ("random", "rigs")
        if (table := getattr(recipe, key)) is not None
    ]
    for path, table in tables:
        for key in OF_REVOLVED:
            if key in table.model_fields_set and key in rig.mirror.without_effect:
                text = "is of mirrors of revolution; a sphere has neither axis nor rim: remove it, or give [rig.mirror]"
                yield Fault(f"{path}.{key}", text)


def _true_rig(
    recipe: Recipe, nominal: Rig, room: Room | None, targets: Sequence[tuple[int, TargetTable]]
) -> Iterator[Fault]:
    """Faults of the true rig; no strokes are judged where `room` is None."""
    deviation = build_misalignment(recipe.misalignment)
    strokes = [
        (f"experiments[{i}].strokes_m[{j}]", stroke_m)
        for i, experiment in enumerate(recipe.experiments)
        for j, stroke_m in enumerate(experiment.strokes_m)
    ]
    try:
        rig = nominal.perturbed(deviation)
        reached = [(path, stroke_m, true_stroke_m(deviation, stroke_m)) for path, stroke_m in strokes]
    except SceneError as error:
        yield Fault("misalignment", text_by_keys(str(error)))
        return  # what follows needs the rig
    if not rig.in_image():
        yield Fault("misalignment", "the mirror is outside of the image; take smaller deviations")
        return
    offsets_m = [0.0, *sorted({true_m for *_, true_m in reached})]
    for i, target in targets:
        cuts = ((part, h) for h in offsets_m if (part := cut_part(rig.at(h), board(build_target(target)))))
        if (cut := next(cuts, None)) is not None:
            text = f"{_BOARD} cuts the {cut[0]} at stroke {cut[1]:g} m"
            yield Fault(f"targets[{i}].depth_m", f"{text}; move it away from the axis or to another height")
    if room is None:
        return  # drawn rooms, or a rig that is too high by itself
    limit_m = ceiling_m(room)
    for path, stroke_m, true_m in reached:
        above_m = _top_m(rig, true_m) - limit_m
        if above_m >= 0.0:
            text = f"{stroke_m} lifts the {rig.top_part}'s top through the ceiling at {limit_m:.2f} m"
            yield Fault(path, f"{text}; give less than {stroke_m - above_m:.3f}")


def _top_m(rig: Rig, offset_m: float) -> float:
    return float(rig.at(offset_m).sphere_centre_m[2]) + rig.top_m


def _height(table: RigTable, rig: Rig, room: Room) -> Fault | None:
    """Fault of a rig that leaves no room for the shortest stroke."""
    above_m = _top_m(rig, MIN_STROKE_M) - ceiling_m(room)
    if above_m < 0.0:
        return None  # it stays below the ceiling
    given = {key: getattr(table, key) for key in ("camera_height_m", "z_c_m")}
    if rig.mirror.radius_m is not None:
        given["radius_m"] = rig.mirror.radius_m
    elif not any(given.values()):
        given["camera_height_m"] = rig.T_world_camera.translation_m[2]
    key, value = next((key, value) for key, value in given.items() if value is not None)
    text = f"{value} puts the {rig.top_part}'s top through the ceiling at {ceiling_m(room):.2f} m when it is down"
    return Fault(f"rig.{key}", f"{text}; give less than {value - above_m:.3f}")


def _places(scene: _Scene) -> Iterator[tuple[int, Fault]]:
    """Number and fault of targets that lie in solids, outside of the room, in the robot, or are too small."""
    recipe = scene.recipe
    for i, target in enumerate(recipe.targets):
        text = None if scene.room is None else _misplaced(recipe, scene.room, target)
        if text is None:
            diameter_m, limit_m = build_spot(recipe.laser, target).diameter_m, min(BOARD_SIZE_M)
            if diameter_m > limit_m:
                text = f"the spot's diameter is {diameter_m:g} m, its board measures {limit_m:g} m"
                text += "; make laser.diameter_m (or its growth) smaller"
        if text is not None:
            yield i, Fault(f"targets[{i}]", text)


def _misplaced(recipe: Recipe, bare: Room, target: TargetTable) -> str | None:
    """Say why a target cannot stand where it is, in a room that is `bare` without boards."""
    others = {other.name: other for other in recipe.targets if build_target(other) != build_target(target)}
    room, spot = build_room(recipe.room, others.values()), build_target(target).position_world_m
    where = f"depth_m {target.depth_m}, azimuth_deg {target.azimuth_deg}, height_m {target.height_m}"
    if (solid := room.solid_around(spot)) is not None:
        return f"the spot ({where}) lies inside '{solid}'; move it into the open"
    plate = board(build_target(target))
    if (part := next((part for part in chassis() if plate.meets(part)), None)) is not None:
        return f"{_BOARD} at {where} cuts '{part.name}'; move it away from the robot"
    # of the centres of the surfaces: walls, floor, ceiling
    centres = [surface.T_world_shape.translation_m for surface in bare.surfaces]
    extent = [(min(xs), max(xs)) for xs in zip(*centres, strict=True)]
    if not all(low <= x <= high for x, (low, high) in zip(spot, extent, strict=True)):
        size = ", ".join(f"{axis} {low:g} to {high:g} m" for axis, (low, high) in zip("xyz", extent, strict=True))
        return f"the spot ({where}) lies outside the room {size}; move it inside"
    return None


_RULES = (_names, _repeats, _draws, _frames, _distractors, _laser, _holder, _mirror, _rig)
