"""List of the tasks of a plan, in the order of the recipe, each with its key.

A light map depends on the room and its settings; a view on rig, room, pose, settings and light map; a spot on rig,
room, laser and stroke; a sample (picture, noise budget) on its two views and its spot. A task stands before those that
name it in `needs`. The tasks of a room follow each other, so that a worker builds it once; all spots come first where
they share one room: they are quick and find faults of the recipe.
"""

from __future__ import annotations

import hashlib
import json
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from typing import Any, TypeVar

from phibench.datasets.build.bake_task import bake_room, bake_settings
from phibench.datasets.build.sample_task import finish_sample
from phibench.datasets.build.spot_task import make_spot
from phibench.datasets.build.tasks import BuildTask, task_key
from phibench.datasets.build.view_task import render_view
from phibench.datasets.plan.plan import PairPlan, Plan, PosePlan
from phibench.datasets.store.documents import to_json
from phibench.datasets.store.provenance import code_behind
from phibench.scenes.rig import POSITIONS

Tasks = dict[str, BuildTask]
P = TypeVar("P", PairPlan, PosePlan)


def plan_tasks(plan: Plan, versions: Mapping[str, Any]) -> Tasks:
    """Tasks by name; `versions` says what they run on (Python, packages, renderer)."""
    makers = _Makers(plan, versions)
    pairs, poses = _by_room(plan.pairs), _by_room(plan.poses)
    tasks: Tasks = {}
    for room_id in plan.rooms:
        spots = [makers.spot(pair) for pair in pairs[room_id]]
        bake = makers.bake(room_id)
        views = {pose.pose_id: makers.view(pose, bake) for pose in poses[room_id]}
        samples = [makers.sample(pair, spot, views) for pair, spot in zip(pairs[room_id], spots, strict=True)]
        tasks |= {task.name: task for task in (*spots, bake, *views.values(), *samples)}
    return tasks


def _by_room(entries: Iterable[P]) -> dict[str, list[P]]:
    """Pairs or poses by the id of their room."""
    by_room: dict[str, list[P]] = defaultdict(list)
    for entry in entries:
        by_room[entry.room].append(entry)
    return by_room


def task_names(plan: Plan) -> list[str]:
    """Names of all tasks in the order of `plan_tasks`, without their keys."""
    return list(plan_tasks(plan, {}))


def bake_task_name(room_id: str) -> str:
    """Name of the task whose result is a room's line."""
    return f"bake {room_id}"


def spot_task_name(pair: PairPlan) -> str:
    """Name of the task whose result is a sample's row, but for the noise."""
    return f"spot {pair.sample_id}"


def sample_task_name(pair: PairPlan) -> str:
    """Name of the task whose result is the noise of a sample."""
    return f"sample {pair.sample_id}"


class _Makers:
    """Makes tasks; what many keys share is hashed once."""

    def __init__(self, plan: Plan, versions: Mapping[str, Any]) -> None:
        self._plan, self._versions = plan, dict(versions)
        self._rooms = {name: _digest(to_json(source)) for name, source in plan.rooms.items()}
        self._rigs = {name: _digest(to_json(rig)) for name, rig in plan.rigs.items()}
        self._spots = {name: to_json(spot) for name, spot in plan.spots.items()}

    def spot(self, pair: PairPlan) -> BuildTask:
        plan = self._plan
        name, rig, spot = plan.recipe.dataset.name, plan.rigs[pair.rig], plan.spots[pair.spot]
        key = self._key(
            ["spot", name, self._rigs[pair.rig], self._rooms[pair.room], self._spots[pair.spot], asdict(pair)],
            make_spot,
        )
        return BuildTask(spot_task_name(pair), key, make_spot, (name, rig, plan.rooms[pair.room], spot, pair))

    def bake(self, room_id: str) -> BuildTask:
        plan, ambient = self._plan, self._plan.recipe.ambient
        scene = [_digest(to_json(plan.rig)), room_id, self._rooms[room_id]]
        key = self._key(["bake", *scene, asdict(bake_settings(ambient))], bake_room)
        return BuildTask(bake_task_name(room_id), key, bake_room, (plan.rig, room_id, plan.rooms[room_id], ambient))

    def view(self, pose: PosePlan, bake: BuildTask) -> BuildTask:
        plan = self._plan
        name, ambient = plan.recipe.dataset.name, plan.recipe.ambient
        inputs = ["view", name, self._rigs[pose.rig], self._rooms[pose.room], asdict(pose), ambient.model_dump()]
        key = self._key(inputs, render_view, (bake.key,))
        arguments = (name, plan.rigs[pose.rig], plan.rooms[pose.room], pose, ambient)
        return BuildTask(f"view {pose.pose_id}", key, render_view, arguments, (bake.name,))

    def sample(self, pair: PairPlan, spot: BuildTask, views: Mapping[str, BuildTask]) -> BuildTask:
        needs = list(
            {views[pair.pose_id(position)].name: views[pair.pose_id(position)] for position in POSITIONS}.values()
        )
        keys = tuple(task.key for task in (spot, *needs))
        key = self._key(["sample", pair.sample_id], finish_sample, keys)
        names = tuple(task.name for task in (spot, *needs))
        quality = self._plan.recipe.ambient.quality
        plan = self._plan
        arguments = (pair, plan.rigs[pair.rig], plan.rooms[pair.room], plan.spots[pair.spot], quality)
        return BuildTask(sample_task_name(pair), key, finish_sample, arguments, names)

    def _key(self, inputs: Any, function: Any, needs: tuple[str, ...] = ()) -> str:
        return task_key(inputs, code_behind(function.__module__), self._versions, needs)


def _digest(document: Any) -> str:
    return hashlib.sha256(json.dumps(document, sort_keys=True, allow_nan=False).encode()).hexdigest()
