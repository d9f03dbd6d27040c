"""Parts of a data set for job arrays: shard i of n, by position in the recipe, so that nobody has to agree on anything.

A shard owns a contiguous run of samples (neighbours share views) and renders every view that these need; a view that
two shards need is rendered by both, to the same bytes. A shard is a data set of its own, complete and readable.
"""

from __future__ import annotations

from dataclasses import replace

from phibench.datasets.errors import DatasetError
from phibench.datasets.plan import Plan
from phibench.scenes.rig import POSITIONS


def shard_plan(plan: Plan, shard: str | None) -> Plan:
    """Plan of one shard, "i/n" with i from 1 to n; None is the whole.

    Raises
    ------
    DatasetError
        If that is no shard, or has no sample.
    """
    if shard is None:
        return plan
    i, n = parse_shard(shard)
    first, end = (k * len(plan.pairs) // n for k in (i - 1, i))
    if first == end:
        raise DatasetError(f"shard {shard} is empty: there are {len(plan.pairs)} samples; use at most as many shards")
    pairs = plan.pairs[first:end]
    poses, spots = {pair.pose_id(p) for pair in pairs for p in POSITIONS}, {pair.spot for pair in pairs}
    rigs = {name for pair in pairs for name in (pair.rig, pair.nominal_rig)}
    return replace(
        plan,
        rigs={name: rig for name, rig in plan.rigs.items() if name in rigs},
        spots={name: spot for name, spot in plan.spots.items() if name in spots},
        poses=tuple(pose for pose in plan.poses if pose.pose_id in poses),
        pairs=pairs,
        shard=f"{i}/{n}",
    )


def parse_shard(shard: str) -> tuple[int, int]:
    """Return i and n of "i/n"."""
    i, slash, n = shard.partition("/")
    if not (slash and i.isdecimal() and n.isdecimal() and 1 <= int(i) <= int(n)):
        raise DatasetError(f"shard '{shard}': must be i/n with i from 1 to n, such as 1/4")
    return int(i), int(n)
