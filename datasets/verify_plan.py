"""Whether a data set holds what its recipe means: samples, poses, and for each sample its rig, spot and stroke."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

from phibench.datasets import layout
from phibench.datasets.codec import to_json
from phibench.datasets.errors import DatasetError
from phibench.datasets.manifest import same_number
from phibench.datasets.plan import PairPlan, Plan, make_plan
from phibench.datasets.read import Dataset
from phibench.datasets.schema import ManifestRow
from phibench.datasets.shard import shard_plan


def plan_faults(dataset: Dataset) -> Iterator[str]:
    """Faults of manifest, rigs and poses against the plan of the recipe."""
    try:
        plan = shard_plan(make_plan(dataset.recipe), dataset.info.shard)
    except DatasetError as error:
        yield f"{layout.INFO}: its recipe cannot be followed: {error}"
        return
    rows, pairs = {row.sample_id: row for row in dataset.rows}, {pair.sample_id: pair for pair in plan.pairs}
    for name in sorted(set(pairs) - set(rows)):
        yield f"{layout.MANIFEST}: sample {name} of the recipe is missing"
    for name in sorted(set(rows) - set(pairs)):
        yield f"{layout.MANIFEST}: sample {name} is not in the recipe"
    if len(rows) != len(dataset.rows):
        yield f"{layout.MANIFEST}: a sample is listed twice"
    for name in (name for name in pairs if name in rows):
        yield from _row_faults(plan, pairs[name], rows[name])
    yield from _rig_faults(plan, dataset)
    if [(pose.pose, pose.rig) for pose in dataset.info.poses] != [(pose.pose_id, pose.rig) for pose in plan.poses]:
        yield f"{layout.INFO}: the poses are not those of the recipe"


def _row_faults(plan: Plan, pair: PairPlan, row: ManifestRow) -> Iterator[str]:
    spot = plan.spots[pair.spot]
    expected = {
        **{name: getattr(pair, name) for name in ("experiment", "target", "rig", "nominal_rig", "tries")},
        **{name: getattr(pair, name) for name in ("stroke_m", "nominal_stroke_m")},
        "drawn": dict(pair.drawn),
        "spot_world_m": spot.position_world_m,
        "spot_normal_world": spot.normal_world,
        "spot_diameter_m": spot.diameter_m,
    }
    for name, value in expected.items():
        if not alike(getattr(row, name), value):
            yield f"{row.sample_id}: {name} is {getattr(row, name)}, the recipe gives {value}"


def _rig_faults(plan: Plan, dataset: Dataset) -> Iterator[str]:
    held = dataset.rigs.documents
    if set(held) != set(plan.rigs):
        yield f"{layout.RIGS}: the rigs are not those of the recipe"
    for name in (name for name in plan.rigs if name in held):
        if not alike(_with_form(held[name]), json.loads(json.dumps(to_json(plan.rigs[name])))):
            yield f"{layout.RIGS}: {name} is not the rig that the recipe gives"


def _with_form(rig: dict[str, Any]) -> dict[str, Any]:
    """Document of a rig; one of schema version 4 knows no form, and its mirror has none."""
    mirror = rig.get("mirror")
    return {**rig, "mirror": {"form": None, **mirror}} if isinstance(mirror, dict) else rig


def alike(a: Any, b: Any) -> bool:
    """Equality of nested documents, of their numbers to rounding."""
    if isinstance(a, dict) and isinstance(b, dict):
        return a.keys() == b.keys() and all(alike(a[key], b[key]) for key in a)
    if isinstance(a, list | tuple) and isinstance(b, list | tuple):
        return len(a) == len(b) and all(alike(x, y) for x, y in zip(a, b, strict=True))
    return same_number(a, b) if isinstance(a, float) and isinstance(b, float | int) else bool(a == b)
