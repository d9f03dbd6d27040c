"""Manifest, rigs, rooms and poses of a data set against the plan of its recipe."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

from phibench.datasets.build.spot_task import OUT_OF_TOLERANCE, answer_spot, certificate_fault
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.plan.plan import PairPlan, Plan, make_plan
from phibench.datasets.plan.sampling import UNDRAWN
from phibench.datasets.read import Dataset
from phibench.datasets.store import schema
from phibench.datasets.store.checksums import held_room_files
from phibench.datasets.store.json_forms import same_document, to_json
from phibench.datasets.store.schema import ManifestRow, RoomInfo
from phibench.scenes.rig import POSITIONS


def plan_faults(dataset: Dataset) -> Iterator[str]:
    """Faults of manifest, rigs and poses against the plan of the recipe."""
    try:
        whole = make_plan(dataset.recipe, held_room_files(dataset.folder), dataset.info.shard)
    except DatasetError as error:
        yield f"{schema.INFO}: its recipe cannot be followed: {error}"
        return
    yield from _left_out_faults(whole, dataset)
    plan = whole.without(dataset.info.causes)
    rows, pairs = {row.sample_id: row for row in dataset.rows}, {pair.sample_id: pair for pair in plan.pairs}
    for name in sorted({*pairs, *plan.refused} - set(rows)):
        yield f"{schema.MANIFEST}: sample {name} of the recipe is missing"
    for name in sorted(set(rows) - set(pairs)):
        yield f"{schema.MANIFEST}: sample {name} is not in the recipe"
    if len(rows) != len(dataset.rows):
        yield f"{schema.MANIFEST}: a sample is listed twice"
    for name in (name for name in pairs if name in rows):
        yield from _row_faults(plan, pairs[name], rows[name])
    yield from _rig_faults(plan, dataset)
    yield from _room_faults(plan, dataset)
    held = [(pose.pose, pose.rig, pose.room) for pose in dataset.info.poses]
    if held != [(pose.pose_id, pose.rig, pose.room) for pose in plan.poses]:
        yield f"{schema.INFO}: the poses are not those of the recipe"


def _left_out_faults(whole: Plan, dataset: Dataset) -> Iterator[str]:
    """Faults of the list of samples that were left out: each must be of the recipe, and still be refused.

    One that was refused for its noise, or whose room cannot be built, is not rendered again here.
    """
    causes, pairs = dataset.info.causes, {pair.sample_id: pair for pair in whole.pairs}
    if len(causes) != len(dataset.info.left_out):
        yield f"{schema.INFO}: left_out lists a sample twice"
    for name, cause in causes.items():
        if name not in pairs and name not in whole.refused:
            yield f"{schema.INFO}: left_out lists {name}, which is not in the recipe"
        elif name in pairs and cause.startswith(UNDRAWN):
            yield f"{schema.INFO}: left_out lists {name}, which can be drawn"
        elif name in pairs and cause.startswith(OUT_OF_TOLERANCE):
            pair = pairs[name]
            spot, room = whole.spots[pair.spot], whole.room(pair.room)
            if not certificate_fault({p: answer_spot(whole.view(pair, p), spot, room) for p in POSITIONS}):
                yield f"{schema.INFO}: left_out lists {name}, whose certificates pass when they are computed again"


def _row_faults(plan: Plan, pair: PairPlan, row: ManifestRow) -> Iterator[str]:
    spot = plan.spots[pair.spot]
    expected = {
        **{name: getattr(pair, name) for name in ("experiment", "target", "rig", "nominal_rig", "room", "tries")},
        **{name: getattr(pair, name) for name in ("stroke_m", "nominal_stroke_m")},
        "drawn": dict(pair.drawn),
        "spot_world_m": spot.position_world_m,
        "spot_normal_world": spot.normal_world,
        "spot_beam_world": spot.beam_direction_world,
        "spot_diameter_m": spot.diameter_m,
    }
    for name, value in expected.items():
        if not same_document(getattr(row, name), value):
            yield f"{row.sample_id}: {name} is {getattr(row, name)}, the recipe gives {value}"


def _rig_faults(plan: Plan, dataset: Dataset) -> Iterator[str]:
    held = dataset.rigs.documents
    if set(held) != set(plan.rigs):
        yield f"{schema.RIGS}: the rigs are not those of the recipe"
    for name in (name for name in plan.rigs if name in held):
        if not same_document(_with_form(held[name]), json.loads(json.dumps(to_json(plan.rigs[name])))):
            yield f"{schema.RIGS}: {name} is not the rig that the recipe gives"


def _room_faults(plan: Plan, dataset: Dataset) -> Iterator[str]:
    if set(dataset.rooms) != set(plan.rooms):
        yield f"{schema.ROOMS}: the rooms are not those of the recipe"
    for info in dataset.rooms.infos.values():
        if info.source and info.room in plan.rooms:
            if not same_document(info.source, to_json(plan.rooms[info.room])):
                yield f"{schema.ROOMS}: {info.room} is not the room that the recipe gives"
            try:
                yield from _room_line_faults(plan, dataset, info)
            except DatasetError as error:  # a file that cannot be read
                yield str(error)


def _room_line_faults(plan: Plan, dataset: Dataset, info: RoomInfo) -> Iterator[str]:
    """Differences of a room's line from the room of its source."""
    room = dataset.rooms[info.room]
    for name, value in (("lit", room.lit), ("object_names", room.object_names(plan.rig.at(0.0)))):
        if getattr(info, name) != value:
            yield f"{schema.ROOMS}: {name} of {info.room} is not that of its source"


def _with_form(rig: dict[str, Any]) -> dict[str, Any]:
    """Document of a rig; one of schema version 4 knows no form, and its mirror has none. Nor has one of revolution."""
    mirror = rig.get("mirror")
    if not isinstance(mirror, dict) or "profile" in mirror:
        return rig
    return {**rig, "mirror": {"form": None, **mirror}}
