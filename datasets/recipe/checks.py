"""Checks across several keys of a recipe: names, places, strokes, and the rig as a whole.

The tables check types and ranges. The checks here work on the raw document, so that their faults are
reported together with those. A faulty key is left out of what they look at: one mistake gives one line.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, cast

from phibench.datasets.recipe.build import (
    build_misalignment,
    build_rig,
    build_room,
    build_spot,
    build_target,
    build_true_rig,
    by_keys,
    ceiling_m,
    drawn_mirror_faults,
    fixed_conic_faults,
    idle_holder_keys,
    idle_mirror_keys,
    rig_fault_of,
    true_stroke_m,
)
from phibench.datasets.recipe.distributions import (
    Raw,
    boards_of,
    distribution_of,
    list_of,
    sound_of,
    table_of,
    tables_of,
)
from phibench.datasets.recipe.mirror_tables import HolderTable, MirrorTable
from phibench.datasets.recipe.room_checks import low_rooms, room_faults
from phibench.datasets.recipe.room_tables import RoomTable
from phibench.datasets.recipe.spot_placement import cut_part, free_margin_m
from phibench.datasets.recipe.tables import (
    DRAWABLE,
    MAX_STROKE_M,
    MIN_STROKE_M,
    SENSOR_KEYS,
    SENSOR_OF_FRAME,
    AmbientTable,
    LaserTable,
    MisalignmentTable,
    RandomHolderTable,
    RandomMirrorTable,
    Recipe,
    RigTable,
    TargetTable,
)
from phibench.render.room.subpixel_grid import FilmGrid
from phibench.render.sensor.settings import SensorError, sensor
from phibench.scenes.catalog import BOARD_SIZE_M, board
from phibench.scenes.mirror import OF_REVOLVED
from phibench.scenes.misalignment import Misalignment
from phibench.scenes.rig import Rig
from phibench.scenes.room import Room, chassis
from phibench.scenes.validation import Fault, SceneError, close_names, nearest

_ON_BOARD, _BY_RAY = ("target", "across_m", "up_m"), ("azimuth_deg", "height_m")
_BOARD = "the board ({:.2f} m wide, {:.2f} m high)".format(*BOARD_SIZE_M)


def semantic_faults(raw: Raw) -> list[Fault]:
    """Faults between keys; faulty keys are passed over."""
    draft = _Draft.of(raw)
    return [
        *(
            *_purpose(raw),
            *room_faults(raw),
            *_names(draft),
            *_repeats(raw),
            *_draws(draft),
            *_frames(raw),
            *_distractors(draft),
        ),
        *(*_laser(draft.laser), *_holder(raw), *_mirror(raw), *_rig(draft)),
    ]


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


# Tables of a document that may be faulty.


@dataclass(frozen=True)
class _Draft:
    """Tables of a document without their faulty keys; None where too little is left of one."""

    raw: Raw
    rig: RigTable | None
    misalignment: MisalignmentTable | None
    room: RoomTable | None
    laser: LaserTable | None
    targets: list[tuple[int, TargetTable]]

    @classmethod
    def of(cls, raw: Raw) -> _Draft:
        single = (("rig", RigTable), ("misalignment", MisalignmentTable), ("room", RoomTable), ("laser", LaserTable))
        targets = [(i, sound_of(entry, TargetTable)) for i, entry in tables_of(raw, "targets")]
        sound: Any = [sound_of(raw.get(key, {}), model) for key, model in single]
        rig, misalignment, room, laser = sound
        room = None if "rooms" in raw else room  # drawn ones have heights of their own
        return cls(raw, rig, misalignment, room, laser, [(i, table) for i, table in targets if table is not None])

    @property
    def names(self) -> list[str]:
        """Names of all targets, the faulty ones too."""
        return [entry["name"] for _, entry in tables_of(self.raw, "targets") if isinstance(entry.get("name"), str)]


# Names.


def _purpose(raw: Raw) -> Iterator[Fault]:
    """A recipe has `[[experiments]]` or `[random]`, and `[rigs]` with experiments only."""
    tables = list(Recipe.model_fields)
    given = [key for key in ("experiments", "random") if key in raw]
    misspelt = [key for key in raw if key not in tables and set(close_names(key, tables)) & {"experiments", "random"}]
    if len(given) == 2:
        yield Fault("random", "given together with [[experiments]]; give one or the other")
    elif raw.get("experiments") == [] or not (given or misspelt or "rooms" in raw):  # [rooms] says what it needs
        what = "empty" if given else "missing"
        yield Fault("experiments", f"{what}; add [[experiments]] (which targets with which strokes) or [random]")
    if "random" in raw and table_of(raw, "rigs"):
        yield Fault("rigs", "given together with [random], whose samples have rigs of their own; remove one")
    if table_of(raw, "rigs") and not table_of(raw, "rigs", "misalignment"):
        yield Fault("rigs.misalignment", "draws nothing; add distributions of keys of [misalignment] or remove [rigs]")


def _names(draft: _Draft) -> Iterator[Fault]:
    """Names that are given twice, and names of targets that are not there."""
    for key in ("targets", "experiments"):
        first: dict[str, int] = {}
        for i, entry in tables_of(draft.raw, key):
            name = entry.get("name")
            # names that differ by case only are refused too: they become file names
            if isinstance(name, str) and (earlier := first.setdefault(name.casefold(), i)) != i:
                yield Fault(f"{key}[{i}].name", f"'{name}' is also the name of {key}[{earlier}]; rename one of them")
    known = draft.names
    if len(known) < len(list_of(draft.raw, "targets")) or not known:
        return  # a target without a name is a fault of its own
    wanted = [
        (f"experiments[{i}].targets", list_of(entry, "targets")) for i, entry in tables_of(draft.raw, "experiments")
    ]
    for path, names in (*wanted, *_choices(draft.raw)):
        for j, name in enumerate(names):
            if isinstance(name, str) and name not in known:
                yield Fault(f"{path}[{j}]", f"no target is called '{name}'; {nearest(name, known)}")


def _choices(raw: Raw) -> Iterator[tuple[str, list[Any]]]:
    """Lists of boards that are drawn from, with their paths."""
    yield "random.spot.target.choice", boards_of(table_of(raw, "random", "spot"))
    for i, entry in tables_of(raw, "distractors"):
        yield f"distractors[{i}].target.choice", boards_of(entry)


def _repeats(raw: Raw) -> Iterator[Fault]:
    experiments = tables_of(raw, "experiments")
    lists = [(f"experiments[{i}].{key}", list_of(e, key)) for i, e in experiments for key in ("targets", "strokes_m")]
    for path, values in (*lists, *_choices(raw), ("frames.presets", list_of(table_of(raw, "frames"), "presets"))):
        for j, value in enumerate(values):
            if value in values[:j]:
                yield Fault(f"{path}[{j}]", f"{value!r} is listed twice; remove one")


# What is drawn.


def _draws(draft: _Draft) -> Iterator[Fault]:
    for key in table_of(draft.raw, "random", "rig"):
        if key in RigTable.model_fields and key not in (*DRAWABLE, "holder", "mirror"):
            why = (
                "is not a number" if key in ("preset", "laser_filter_response") else "must be the same for all samples"
            )
            yield Fault(f"random.rig.{key}", f"cannot be drawn, it {why}; set {key} in [rig]")
    spot = table_of(draft.raw, "random", "spot")
    ray, on_board = ([key for key in keys if key in spot] for keys in (_BY_RAY, _ON_BOARD))
    if ray and on_board:
        text = f"{', '.join(on_board)} (on a board) and {', '.join(ray)} (by a ray) are both given"
        yield Fault("random.spot", f"{text}; give one or the other")
    elif "elevation_deg" in spot and not ray:
        yield Fault("random.spot.azimuth_deg", "missing; elevation_deg needs it, azimuth_deg and height_m make the ray")
    elif "hidden_elevation_deg" in spot and not ("hidden" in spot and ray):
        missing_key = "hidden" if ray else "azimuth_deg"
        text = "hidden_elevation_deg is the elevation of rays to spots that one image hides"
        yield Fault(f"random.spot.{missing_key}", f"missing; {text}")
    elif len(ray) == 1:
        [missing] = set(_BY_RAY) - set(ray)
        yield Fault(f"random.spot.{missing}", f"missing; {ray[0]} needs it, the two make the ray")
    if draft.laser is not None and not ray and "random" in draft.raw:
        yield from _off_board(spot, draft.laser, [table for _, table in draft.targets])
    yield from _off_wall("random.spot.height_m", spot.get("height_m"), draft.room)


def _off_board(spot: Raw, laser: LaserTable, targets: Sequence[TargetTable]) -> Iterator[Fault]:
    """Distributions that reach beyond where a spot of the drawn boards is wholly on its board."""
    chosen = boards_of(spot)
    drawn = [target for target in targets if not chosen or target.name in chosen]
    for axis, key in enumerate(("across_m", "up_m") if drawn else ()):
        table = distribution_of(spot.get(key, 0.0))
        if table is None:
            continue  # told by the table
        farthest = max(map(abs, table.support))
        left, name = min((free_margin_m(laser, target)[axis], target.name) for target in drawn)
        if left < 0.0:
            text = f"a spot at the centre of the board '{name}' already reaches {-left:.3f} m beyond its edge"
            yield Fault(f"random.spot.{key}", f"{text}; make the spot smaller (see laser.diameter_m)")
        elif farthest > left:
            text = f"reaches {farthest:g} m, where the spot leaves the board '{name}'"
            yield Fault(f"random.spot.{key}", f"{text}; stay within -{left:.3f} to {left:.3f}")


def _off_wall(path: str, given: object, room: RoomTable | None) -> Iterator[Fault]:
    """Heights of rays below the floor or above the lamps."""
    table = distribution_of(given)
    if table is None or room is None:
        return  # told by the tables
    (low, high), limit_m = table.support, ceiling_m(build_room(room, ()))
    if low <= 0.0 or high >= limit_m:
        text = f"reaches from {low:g} to {high:g} m, beyond floor or lamps"
        yield Fault(path, f"{text}; stay above 0 and below {limit_m:.2f}")


def _frames(raw: Raw) -> Iterator[Fault]:
    """Numbers of `[frames]` that the sensor does not take; its ranges are its own."""
    frames = table_of(raw, "frames")
    for key in (*SENSOR_KEYS, "exposure_s"):
        table = distribution_of(frames.get(key))
        for value in dict.fromkeys(table.support) if table is not None else ():
            if key == "jpeg_quality" and value != int(value):
                continue  # told by the table
            try:
                sensor("mjpeg", **{key: round(value) if key == "jpeg_quality" else value})
            except SensorError as error:
                yield Fault(f"frames.{key}", f"reaches {value:g}; stay with what the sensor takes ({error})")
    yield from _sensor(frames)


def _sensor(frames: Raw) -> Iterator[Fault]:
    """Numbers of `[frames.sensor]` that a sensor does not take, that belong to a frame, or that are given twice."""
    numbers = frames.get("sensor")
    if not isinstance(numbers, dict):
        return  # told by the table
    given = {key: value for key, value in numbers.items() if key not in (*SENSOR_OF_FRAME, *SENSOR_KEYS)}
    for key in numbers:
        if key in SENSOR_OF_FRAME:
            yield Fault(f"frames.sensor.{key}", "is no number of a camera; leave it out")
        elif key in frames and key in SENSOR_KEYS:
            yield Fault(f"frames.sensor.{key}", f"given together with frames.{key}; give one or the other")
        elif key in SENSOR_KEYS:
            given[key] = numbers[key]
    presets = frames.get("presets")
    for preset in presets if isinstance(presets, list) else ("bayer-raw",):
        try:
            sensor(str(preset), **given)
        except SensorError as error:
            yield Fault("frames.sensor", str(error))
            return  # the other presets would say the same


def _distractors(draft: _Draft) -> Iterator[Fault]:
    for i, table in tables_of(draft.raw, "distractors"):
        path, given = f"distractors[{i}]", [key for key in (*_BY_RAY, "distance_m") if key in table]
        if given and "target" in table:
            text = f"given together with {', '.join(given)} (a ray); give one or the other"
            yield Fault(f"{path}.target", text)
        if given and (missing := [key for key in _BY_RAY if key not in table]):
            yield Fault(f"{path}.{missing[0]}", f"missing; {given[0]} needs it, azimuth_deg and height_m make the ray")
        if table.get("kind") == "glow" and "distance_m" not in table:
            yield Fault(f"{path}.distance_m", "missing; a glow hangs free in the room, at distance_m along its ray")
        yield from _off_wall(f"{path}.height_m", table.get("height_m"), draft.room)


# Spots, boards and the rig.


def _laser(laser: LaserTable | None) -> Iterator[Fault]:
    if laser is None:
        return  # told by the table
    growing = laser.model_fields_set & {"diameter_base_m", "diameter_growth_m_per_m"}
    if laser.diameter_m is not None and growing:
        yield Fault("laser.diameter_m", f"given together with {', '.join(sorted(growing))}; give one or the other")
    if laser.diameter_m is None and laser.diameter_base_m + laser.diameter_growth_m_per_m == 0.0:
        yield Fault("laser.diameter_base_m", "0.0 with no growth makes spots of diameter 0; give a number above 0")


def _holder(raw: Raw) -> Iterator[Fault]:
    """Keys of a holder that none of its kinds has; a drawn kind makes the sizes of each of its names useful."""
    fixed, drawn = table_of(raw, "rig", "holder"), table_of(raw, "random", "rig", "holder")
    sound, chosen = sound_of(fixed, HolderTable), sound_of(drawn, RandomHolderTable)
    for table, holder in ((fixed, sound), (drawn, chosen)):
        if holder is None or ("kind" in table and "kind" not in holder.model_fields_set):
            return  # told by the tables
    assert sound is not None
    assert chosen is not None
    drawn_kind = getattr(chosen, "kind", None)
    kinds = (sound.kind,) if drawn_kind is None else drawn_kind.choice
    yield from idle_holder_keys("rig.holder", sorted(sound.model_fields_set), kinds)
    yield from idle_holder_keys("random.rig.holder", sorted(chosen.model_fields_set), kinds)


def _mirror(raw: Raw) -> Iterator[Fault]:
    """Keys of a mirror of revolution that none of its shapes has."""
    table, drawn = table_of(raw, "rig", "mirror"), table_of(raw, "random", "rig", "mirror")
    sound, chosen = sound_of(table, MirrorTable), sound_of(drawn, RandomMirrorTable)
    if drawn and not table:
        yield Fault("rig.mirror", "missing; [random.rig.mirror] draws keys of it, give at least its shape")
    if not table or sound is None or not table.keys() <= sound.model_fields_set:
        return  # told by the tables
    shapes = getattr(getattr(chosen, "shape", None), "choice", (sound.shape,))
    yield from idle_mirror_keys("rig.mirror", sound, shapes)
    yield from drawn_mirror_faults("random.rig.mirror", {} if chosen is None else dict(chosen), shapes)
    if {"shape", "conic"} & drawn.keys() == {"shape"}:
        yield from fixed_conic_faults("rig.mirror", sound, shapes)


def _rig(draft: _Draft) -> Iterator[Fault]:
    """Faults of the rig, nominal and true, and of the boards and strokes that do not go with it."""
    misplaced = dict(_places(draft))
    yield from misplaced.values()
    rig, room = None, None if draft.room is None else build_room(draft.room, ())
    if draft.rig is not None:
        try:
            rig = build_rig(draft.rig)
        except SceneError as error:
            yield rig_fault_of(error)
    if draft.rig is None or rig is None:
        return  # told by the table
    if draft.laser is not None and rig.mirror.reflectance_table is not None:
        try:
            rig.mirror.band(draft.laser.wavelength_nm)
        except SceneError as error:
            yield rig_fault_of(SceneError(by_keys(str(error))))
    yield from _without_axis(draft.raw, rig)
    yield from _cells(rig, sound_of(draft.raw.get("ambient", {}), AmbientTable))
    too_high = None if room is None else _height(draft.rig, rig, room)
    if too_high is not None:
        yield too_high
    if "rooms" in draft.raw:
        yield from low_rooms(draft.raw, rig)
    if not rig.in_image():
        yield Fault("rig", "the mirror is outside of the image; move it or the principal point")
    elif draft.misalignment is not None:
        targets = [(i, target) for i, target in draft.targets if i not in misplaced]
        yield from _true_rig(
            rig, build_misalignment(draft.misalignment), None if too_high else room, targets, draft.raw
        )


def _without_axis(raw: Raw, rig: Rig) -> Iterator[Fault]:
    """Faults of deviations of a sphere that has neither axis nor rim."""
    for path in (("misalignment",), ("random", "misalignment"), ("rigs", "misalignment")):
        for key in table_of(raw, *path):
            if key in OF_REVOLVED and key in rig.mirror.without_effect:
                text = "is of mirrors of revolution; a sphere has neither axis nor rim: remove it, or give [rig.mirror]"
                yield Fault(".".join((*path, key)), text)


def _true_rig(
    nominal: Rig, deviation: Misalignment, room: Room | None, targets: list[tuple[int, TargetTable]], raw: Raw
) -> Iterator[Fault]:
    """Faults of the true rig; no strokes are judged where `room` is None."""
    strokes = [
        (f"experiments[{i}].strokes_m[{j}]", stroke_m)
        for i, experiment in tables_of(raw, "experiments")
        for j, stroke_m in enumerate(list_of(experiment, "strokes_m"))
        if type(stroke_m) in (int, float) and 0.0 < stroke_m <= MAX_STROKE_M
    ]
    try:
        rig = nominal.perturbed(deviation)
        reached = [(path, stroke_m, true_stroke_m(deviation, float(stroke_m))) for path, stroke_m in strokes]
    except SceneError as error:
        yield Fault("misalignment", by_keys(str(error)))
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
    for path, stroke_m, true_m in reached if room is not None else ():
        above_m = _top_m(rig, true_m) - ceiling_m(cast(Room, room))
        if above_m >= 0.0:
            text = (
                f"{stroke_m} lifts the {rig.top_part}'s top through the ceiling at {ceiling_m(cast(Room, room)):.2f} m"
            )
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


def _cells(rig: Rig, ambient: AmbientTable | None) -> Iterator[Fault]:
    try:
        FilmGrid.of(rig.camera, 1 if ambient is None else ambient.cells_per_pixel)
    except SceneError as error:
        yield Fault("ambient.cells_per_pixel", str(error))


def _places(draft: _Draft) -> Iterator[tuple[int, Fault]]:
    """Number and fault of targets that lie in solids, outside of the room, in the robot, or are too small."""
    for i, target in draft.targets:
        text = None if draft.room is None else _misplaced(draft.room, target, [other for _, other in draft.targets])
        if text is None and draft.laser is not None:
            diameter_m, limit_m = build_spot(draft.laser, target).diameter_m, min(BOARD_SIZE_M)
            if diameter_m > limit_m:
                text = f"the spot's diameter is {diameter_m:g} m, its board measures {limit_m:g} m"
                text += "; make laser.diameter_m (or its growth) smaller"
        if text is not None:
            yield i, Fault(f"targets[{i}]", text)


def _misplaced(table: RoomTable, target: TargetTable, targets: Sequence[TargetTable]) -> str | None:
    """Say why a target cannot stand where it is."""
    others = {other.name: other for other in targets if build_target(other) != build_target(target)}
    room, spot = build_room(table, others.values()), build_target(target).position_world_m
    where = f"depth_m {target.depth_m}, azimuth_deg {target.azimuth_deg}, height_m {target.height_m}"
    if (solid := room.solid_around(spot)) is not None:
        return f"the spot ({where}) lies inside '{solid}'; move it into the open"
    plate = board(build_target(target))
    if (part := next((part for part in chassis() if plate.meets(part)), None)) is not None:
        return f"{_BOARD} at {where} cuts '{part.name}'; move it away from the robot"
    # of the centres of the surfaces: walls, floor, ceiling
    centres = [surface.T_world_shape.translation_m for surface in build_room(table, ()).surfaces]
    extent = [(min(xs), max(xs)) for xs in zip(*centres, strict=True)]
    if not all(low <= x <= high for x, (low, high) in zip(spot, extent, strict=True)):
        size = ", ".join(f"{axis} {low:g} to {high:g} m" for axis, (low, high) in zip("xyz", extent, strict=True))
        return f"the spot ({where}) lies outside the room {size}; move it inside"
    return None
