"""Forecast of a run's cost: bytes on the disk, and seconds that finished tasks correct; and progress of its tasks.

The constants are wall-clock seconds of one process on an idle core of a 2-core AMD EPYC virtual machine (`llvm_ad_rgb`,
room `lab`). A first guess scales them by a short probe of this machine and its load; `make benchmark` shows how good it
is. Afterwards the tasks of the run itself say how long their kind takes.
"""

from __future__ import annotations

import math
import os
import statistics
import threading
import time
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from phibench.datasets.build.bake_task import bake_settings, is_cached
from phibench.datasets.build.tasks import BuildTask, Done, Executor, Outcome
from phibench.datasets.plan.plan import Plan
from phibench.render.optics.faces import TexelGrid, face_table
from phibench.render.room.bounced_light import BOUNCE_TEXEL_M, rays_by_area
from phibench.render.room.lamp_light import FIRST_RAYS
from phibench.render.room.light_map import fixed_shapes, texel_count
from phibench.scenes.room import Room

Light = Literal["baked", "cached", "none"]

# Seconds.
START_S = 7.0  # workers, Mitsuba in each, first kernels, hashes
VIEW_S = 0.3
VIEW_S_PER_MEGAPIXEL = 1.0  # refinement, truth, encoding, fsync
VIEW_S_PER_MEGASAMPLE = 0.1  # look-ups in the light map, a million of them
BAKE_S_PER_MEGATEXEL = 20.0  # grids, filters
_TRIANGLES = (0.028, -0.15)  # seconds per million rays: slope by log2 of the room's triangles, and at one triangle
_PENUMBRA = 1.0 / 27.0  # part of the pairs of texel and lamp that get all rays, by the same logarithm
CACHED_BAKE_S = 0.5
_MEASURED_ROOMS = 5  # of a kind: drawn rooms differ by a third; building one takes 0.2 s
SPOT_S = 0.5  # two positions with their certificates
SAMPLE_S_PER_MEGAPIXEL = 0.45  # picture, noise budget
_PROBE_CPU_S = 0.042  # of `_probe` on the machine above
_TRUST_S = 2.0  # the first guess weighs as much as tasks that should take this long

# Bytes.
_VIEW_BYTES = 50_000  # headers; a small image compresses less
_AMBIENT_BYTES_PX = 4.4  # six planes of halves: 3.8 in `paper`, 5.0 in `bench-dev`
_TRUTH_BYTES_PX = 6.4  # six float32 planes; what is outside the mirror compresses to nothing
_PREVIEW_BYTES_PX = 0.6  # PNG of 8 bits a colour: 0.4 in `paper`, 0.8 in `bench-dev`
_SPOT_BYTES = 8192
_TEXEL_BYTES = 25.0  # six float32 and a bool
_RESERVE = 1.1  # of a disc that is too small one learns too late


@dataclass(frozen=True)
class Forecast:
    """Cost of some tasks.

    Attributes
    ----------
    counts : dict
        Number of tasks of each kind.
    size : int
        Bytes on the disk.
    seconds : dict
        Seconds of one task of each kind, on an idle core of the machine of the constants.
    light : "baked", "cached" where the cache has every light map, or "none" where no room has any light to bake
    """

    counts: dict[str, int]
    size: int
    seconds: dict[str, float]
    light: Light = "baked"

    @property
    def cpu_s(self) -> float:
        """Seconds of all tasks on one core of the machine of the constants."""
        return sum(count * self.seconds[kind] for kind, count in self.counts.items())

    def text(self, workers: int, slowdown: float) -> str:
        """One sentence for the terminal."""
        pace = Pace(self.seconds, slowdown)
        counts = ", ".join(self._count(kind, n, pace) for kind, n in self.counts.items() if n)
        width = max(min(workers, sum(self.counts.values())), 1)
        seconds = START_S * slowdown + pace.left_s(self.counts, [], width)
        took = f"{duration(seconds)} with {workers} worker{'s' * (workers != 1)} (a first guess)"
        return f"to make: {counts}; about {megabytes(self.size)}, {took}"

    def _count(self, kind: str, number: int, pace: Pace) -> str:
        if kind != "bake":
            return f"{number} {kind}{'s' * (number != 1)}"
        if self.light == "none":
            return f"{number} room{'s' * (number != 1)} without a bake"
        what = "bake of the room's light" if number == 1 else "bakes of rooms' light"
        each = "" if number == 1 else " each"
        return f"{number} {what} ({'cached' if self.light == 'cached' else duration(pace.seconds(kind)) + each})"


def forecast(plan: Plan, tasks: Collection[BuildTask]) -> Forecast:
    """Cost of these tasks of a plan."""
    counts = Counter(task.kind for task in tasks)
    pixels = plan.rig.camera.width_px * plan.rig.camera.height_px
    texels, bake_s = _bake_means(plan) if counts["bake"] else (0.0, 0.0)
    size = {
        "bake": _TEXEL_BYTES * texels,
        "view": _VIEW_BYTES + pixels * (_AMBIENT_BYTES_PX + _TRUTH_BYTES_PX + _PREVIEW_BYTES_PX),
        "spot": 2.0 * _SPOT_BYTES,
        "sample": 0.5 * pixels * _PREVIEW_BYTES_PX,
    }
    total = sum(count * size.get(kind, 0.0) for kind, count in counts.items())
    seconds = _seconds(plan, pixels / 1e6, bake_s)
    return Forecast(dict(counts), int(_RESERVE * total), seconds, _light(plan) if counts["bake"] else "none")


def _light(plan: Plan) -> Light:
    """Tell where the light of a plan's rooms comes from.

    Only the first room of each kind is made and looked up: it takes a while. So "cached" is said where there is no
    other room with light.
    """
    lit = [(share, room) for share, room in _rooms_of_kinds(plan, 1) if room.lit]
    if not lit:
        return "none"
    settings = bake_settings(plan.recipe.ambient)
    is_all = round(sum(share for share, _ in lit) * len(plan.rooms)) == len(lit)
    cached = is_all and all(is_cached(plan.rig.at(0.0), room, settings) for _, room in lit)
    return "cached" if cached else "baked"


def _seconds(plan: Plan, megapixels: float, bake_s: float) -> dict[str, float]:
    samples = megapixels * 2 * plan.recipe.ambient.cells_per_pixel**2 * VIEW_S_PER_MEGASAMPLE
    return {
        "bake": bake_s,
        "view": VIEW_S + megapixels * VIEW_S_PER_MEGAPIXEL + samples,
        "spot": SPOT_S,
        "sample": megapixels * SAMPLE_S_PER_MEGAPIXEL,
    }


def _bake_means(plan: Plan) -> tuple[float, float]:
    """Texels of a light map and seconds of its bake, means over the rooms of a plan; some of a kind stand for all."""
    texels = seconds = 0.0
    for share, room in _rooms_of_kinds(plan, _MEASURED_ROOMS):
        texels += share * texel_count(room, plan.recipe.ambient.texel_m) if room.lit else 0.0
        seconds += share * _room_s(plan, room)
    return texels, seconds


def _room_s(plan: Plan, room: Room) -> float:
    """Seconds of the light map of a room, baked or taken from the cache."""
    if not room.lit or is_cached(plan.rig.at(0.0), room, bake_settings(plan.recipe.ambient)):
        return CACHED_BAKE_S
    return light_map_s(plan, room)


def light_map_s(plan: Plan, room: Room) -> float:
    """Seconds of baking the light map of a room: rays are texels times rays per texel."""
    ambient = plan.recipe.ambient
    table = face_table(fixed_shapes(room))
    doubled = math.log2(max(len(table.patch), 64))  # below 64 triangles a ray costs as much as with 64
    fine = TexelGrid.of(table, ambient.texel_m).count
    sizes = (max(ambient.indirect_texel_m, ambient.texel_m), max(BOUNCE_TEXEL_M, ambient.texel_m))
    indirect, coarse = (
        rays_by_area(TexelGrid.of(table, size), rays, size).sum()
        for size, rays in zip(sizes, (ambient.final_rays, ambient.bounce_rays), strict=True)
    )
    # every other texel faces a lamp
    # the rest: twice
    lamps = 0.5 * fine * table.emits.sum() * (FIRST_RAYS + 2.0 * _PENUMBRA * doubled * ambient.lamp_rays)
    rays = lamps + 2.0 * indirect + coarse
    return float(rays * (_TRIANGLES[0] * doubled + _TRIANGLES[1]) + fine * BAKE_S_PER_MEGATEXEL) / 1e6


def _rooms_of_kinds(plan: Plan, most: int) -> Iterator[tuple[float, Room]]:
    """Rooms of each kind, so many at most and the first among them, and the part of all rooms that each stands for."""
    for kind in dict.fromkeys(source.kind for source in plan.rooms.values()):
        names = [name for name, source in plan.rooms.items() if source.kind == kind]
        chosen = names[:: math.ceil(len(names) / most)]
        yield from ((len(names) / len(chosen) / len(plan.rooms), plan.room(name)) for name in chosen)


def megabytes(count: int) -> str:
    """Bytes for people."""
    if count < 1e6:
        return f"{count / 1e6:.1f} MB"
    return f"{count / 1e6:.0f} MB" if count < 5e9 else f"{count / 1e9:.0f} GB"


def duration(seconds: float) -> str:
    """Seconds for people."""
    if seconds < 1.0:
        return "under 1 s"
    return f"{seconds:.0f} s" if seconds < 90.0 else f"{seconds / 60.0:.0f} min"


# Seconds while the tasks run.


def slowdown(workers: int) -> float:
    """Factor by which a task takes longer here and now than on the idle machine of the constants.

    A fixed piece of work is timed. Its CPU time is this machine's speed; wall-clock over CPU time r says how many other
    processes want the cores: r = (others + 1) / cores where that is above 1, and else the load average says it.
    """
    cores, wall_s, cpu_s = os.cpu_count() or 1, time.perf_counter(), time.process_time()
    _probe()
    cpu_s = max(time.process_time() - cpu_s, 1e-3)  # a clock of a coarse system may not have moved
    waiting = (time.perf_counter() - wall_s) / cpu_s
    # a probe that had to wait tells more than the load, which is a mean of the last minute
    others = max(waiting * cores - 1.0, 0.0) if waiting > 1.2 else min(os.getloadavg()[0], cores - 1.0)
    return cpu_s / _PROBE_CPU_S * max((others + workers) / cores, 1.0)


def _probe() -> None:
    """Arithmetic and scattered reads, as tracing has; sorting would tell whether the processor has AVX-512."""
    values = np.linspace(0.0, 1.0, 200_000)
    scattered = np.arange(values.size) * 7919 % values.size  # a prime: all places, none beside the one before
    for _ in range(20):
        values = np.sin(values[scattered] + 1e-3)


class Pace:
    """Seconds of a task by kind: the first guess, corrected by the tasks that have ended.

    Parameters
    ----------
    expected : dict
        Seconds by kind, on the idle machine of the constants.
    workers : int
        The first task of a kind compiles kernels in every worker, and counts only until there are others.
    """

    def __init__(self, expected: Mapping[str, float], slowdown: float, workers: int = 1) -> None:
        self._expected, self._slowdown, self._workers = dict(expected), slowdown, workers
        self._measured: dict[str, list[float]] = {}

    def add(self, kind: str, seconds: float) -> None:
        """Count a task that has ended."""
        self._measured.setdefault(kind, []).append(seconds)

    def seconds(self, kind: str) -> float:
        """Expect this of a task: the median of the last ones of its kind, or else the guess times what others took."""
        if self._measured.get(kind):
            return self._median_s(kind)
        told = {one: len(taken) * self._expected.get(one, 0.0) for one, taken in self._measured.items()}
        took = sum(len(self._measured[one]) * self._median_s(one) for one, expected in told.items() if expected)
        factor = (_TRUST_S * self._slowdown + took) / (_TRUST_S + sum(told.values()))
        return self._expected.get(kind, 0.0) * factor

    def _median_s(self, kind: str) -> float:
        taken = self._measured[kind]
        return statistics.median((taken[self._workers :] or taken)[-8:])

    def left_s(self, waiting: Mapping[str, int], running: Iterable[tuple[str, float]], width: int) -> float:
        """Seconds until all have ended: tasks that wait by kind, and kind and age of those that run.

        Views and samples wait for light maps, each of which is one task.
        """
        left = {kind: count * self.seconds(kind) for kind, count in waiting.items()}
        bakes = waiting.get("bake", 0)
        for kind, age_s in running:
            bakes += kind == "bake"
            # a task that takes longer than expected is likely to go on for a while
            left[kind] = left.get(kind, 0.0) + max(self.seconds(kind) - age_s, 0.2 * age_s)
        bake_s, total_s = left.get("bake", 0.0), sum(left.values())
        after_bake_s = total_s - bake_s - left.get("spot", 0.0)
        return max(total_s / width, bake_s / max(min(bakes, width), 1) + after_bake_s / width)


class TaskProgress:
    """Account of a run: which tasks are running, since when, and how long the rest will take.

    It is an `Executor` that passes everything on to another one. Tasks run in the order in which they are submitted,
    as many at a time as there are workers: a good approximation of what dask does. One thread submits and waits;
    another one may ask for the rest.
    """

    def __init__(self, tasks: Iterable[BuildTask], pace: Pace) -> None:
        self._executor: Executor | None = None
        self._pace, self._lock, self._width = pace, threading.Lock(), 1
        self._left = {task.name: task.kind for task in tasks}
        self._submitted: dict[str, float | None] = {}  # when they began

    def watch(self, executor: Executor) -> TaskProgress:
        """Pass tasks on to an executor from now on."""
        self._executor = executor
        return self

    def width(self) -> int:
        """Return the number of tasks that run at a time."""
        self._width = max(self._workers.width(), 1)
        return self._width

    @property
    def _workers(self) -> Executor:
        assert self._executor is not None, "watch an executor first"
        return self._executor

    def submit(self, task: BuildTask) -> None:
        """Begin a task, or queue it."""
        with self._lock:
            self._submitted[task.name] = None
            self._begin()
        self._workers.submit(task)

    def next(self) -> Outcome:
        """Wait for any submitted task."""
        task, outcome = self._workers.next()
        with self._lock:
            self._submitted.pop(task.name, None)
            self._begin()
            if isinstance(outcome, Done):
                self._pace.add(task.kind, outcome.seconds)
        return task, outcome

    def settle(self, task: BuildTask) -> None:
        """Count a task that will not be done again."""
        with self._lock:
            self._left.pop(task.name, None)

    def running(self) -> list[tuple[str, float]]:
        """Name and age in seconds of the tasks that run."""
        now = time.monotonic()
        with self._lock:
            return [(name, now - began) for name, began in self._submitted.items() if began is not None]

    def running_text(self) -> str:
        """Say the same in words."""
        return ", ".join(f"{name} ({age_s:.0f} s)" for name, age_s in self.running()[:4])

    def left_s(self) -> float:
        """Seconds until all tasks have ended."""
        running = self.running()
        with self._lock:
            waiting = Counter(self._left.values())
            ages = [(self._left[name], age_s) for name, age_s in running if name in self._left]
            waiting.subtract(Counter(kind for kind, _ in ages))
            return self._pace.left_s(waiting, ages, self._width)

    def _begin(self) -> None:
        for name in list(self._submitted)[: self._width]:
            if self._submitted[name] is None:
                self._submitted[name] = time.monotonic()
