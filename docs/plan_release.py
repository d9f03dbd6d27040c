"""Plan of a release of 100 000 pairs on spot machines, by simulation: hours, CPU-hours, bytes and money.

    .venv/bin/python docs/plan_release.py

Tasks take the seconds that 125 pairs of bench-test took, and vary as theirs did. Machines are taken away at random
times and replaced. A machine that goes loses the task that each core is at, and the time until its successor works.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import numpy as np

PAIRS, ROOMS = 100_000, 1_000
# Mean and relative spread of CPU seconds of a task: 125 pairs of bench-test, `cpu_s` of its log.jsonl, nothing beside.
SECONDS = {"bake": (3.8, 0.53), "view": (3.0, 0.46), "spot": (0.79, 0.36), "sample": (0.41, 0.66)}
MB_A_PAIR = 22.2
# Before the first task: shards of 10 and 20 of 100 000 samples in 1000 rooms took 5.9 and 9.8 s, as many rooms in each.
PLAN_S, PLAN_S_A_ROOM, PLAN_S_A_PAIR = 2.0, 0.39, 0.01  # the first is for the numbers of all rooms and samples
START_S = 7.0  # Mitsuba and its kernels
# Assumptions, no measurements.
CORES, REPLACED_S = 16, 180.0
DOLLARS_A_CORE_HOUR, DOLLARS_A_GB_MONTH, DOLLARS_A_GB_OUT = 0.015, 0.023, 0.09


@dataclass(frozen=True)
class Layout:
    """Division of the pairs into parts, each worked off by one core at a time.

    Parameters
    ----------
    parts : number of parts
    own_rooms : True if a part is a data set with rooms of its own, False if it is a shard of one recipe
    """

    name: str
    parts: int
    own_rooms: bool

    @property
    def pairs(self) -> int:
        """Pairs of a part."""
        return PAIRS // self.parts

    @property
    def bakes(self) -> int:
        """Rooms that a part bakes: sample i of a recipe stands in room i modulo their number."""
        return max(ROOMS // self.parts, 1) if self.own_rooms else min(ROOMS, self.pairs)

    @property
    def plan_s(self) -> float:
        """Seconds until a part knows its tasks: those of its own samples and rooms."""
        return (0.0 if self.own_rooms else PLAN_S) + PLAN_S_A_ROOM * self.bakes + PLAN_S_A_PAIR * self.pairs


@dataclass(frozen=True)
class Outcome:
    """Hours by the clock, core-hours paid, core-hours lost to machines that went, and their number."""

    hours: float
    paid_h: float
    lost_h: float
    gone: int


def part_tasks(layout: Layout, draw: np.random.Generator) -> np.ndarray:
    """Seconds of all tasks of a part."""
    counts = {"bake": layout.bakes, "view": 2 * layout.pairs, "spot": layout.pairs, "sample": layout.pairs}
    drawn = []
    for kind, count in counts.items():
        mean, spread = SECONDS[kind]
        drawn.append(draw.gamma(1.0 / spread**2, mean * spread**2, count))
    return draw.permutation(np.concatenate(drawn))


def simulate(layout: Layout, machines: int, gone_per_hour: float, seed: int = 0) -> Outcome:
    """Run all parts on machines of `CORES` cores; a part that was cut off goes on where its journal ends."""
    draw = np.random.default_rng(seed)
    waiting = [(layout.plan_s + START_S, part_tasks(layout, draw)) for _ in range(layout.parts)]
    ends = draw.exponential(3600.0 / gone_per_hour, machines) if gone_per_hour else np.full(machines, np.inf)
    free = [(0.0, core) for core in range(machines * CORES)]
    heapq.heapify(free)
    paid = lost = latest = 0.0
    gone: set[tuple[int, float]] = set()
    queue = [(0.0, part) for part in range(layout.parts)]  # when each may start: a part that was cut off, later
    left = dict(enumerate(waiting))
    while queue:
        free_s, core = heapq.heappop(free)
        ready_s, part = heapq.heappop(queue)
        machine, start = core // CORES, max(free_s, ready_s)
        while start >= ends[machine]:  # it went while this core was idle, or another of its cores has met its end
            back = float(ends[machine]) + REPLACED_S
            ends[machine] = back + draw.exponential(3600.0 / gone_per_hour)
            start = max(start, back)
        head, tasks = left[part]
        done = start + head + np.cumsum(tasks)
        if done[-1] <= ends[machine]:
            paid, latest = paid + float(done[-1]) - start, max(latest, float(done[-1]))
            heapq.heappush(free, (float(done[-1]), core))
            continue
        end = float(ends[machine])
        kept = int(np.searchsorted(done, end))
        gone.add((machine, end))
        paid += end - start
        lost += end - float(done[kept - 1]) + head if kept else end - start
        left[part] = (head, tasks[kept:])
        heapq.heappush(queue, (end, part))
        heapq.heappush(free, (end, core))
    return Outcome(latest / 3600.0, paid / 3600.0, lost / 3600.0, len(gone))


LAYOUTS = (
    Layout("shards of one recipe", 1000, own_rooms=False),
    Layout("shards of one recipe", 100, own_rooms=False),
    Layout("data sets of 1000 pairs", 100, own_rooms=True),
    Layout("data sets of 100 pairs", 1000, own_rooms=True),
)


def main() -> None:
    """Print the tables of docs/measurements/releases.md."""
    size_gb = PAIRS * MB_A_PAIR / 1e3
    month, copy = size_gb * DOLLARS_A_GB_MONTH, size_gb * DOLLARS_A_GB_OUT
    print(f"{size_gb / 1e3:.1f} TB, {month:.0f} $ a month, {copy:.0f} $ a copy")
    print("| layout | parts | machines | taken away | hours | core-hours | lost | machines lost | dollars |")
    for layout in LAYOUTS:
        for machines, rate in ((6, 0.0), (6, 0.1), (63, 0.1), (63, 0.5)):
            one = simulate(layout, machines, rate)
            cost = one.paid_h * DOLLARS_A_CORE_HOUR
            print(
                f"| {layout.name} | {layout.parts} | {machines} | {rate:g}/h | {one.hours:.1f} | {one.paid_h:.0f} "
                f"| {one.lost_h:.1f} | {one.gone} | {cost:.2f} |"
            )


if __name__ == "__main__":
    main()
