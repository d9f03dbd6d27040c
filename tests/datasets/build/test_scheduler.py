"""Scheduling: needs first, a window that does not grow, killers of workers found out; the forecast of the time left."""

import heapq
import resource
import time
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

import pytest

from phibench.datasets.build.forecast import Pace, TaskProgress
from phibench.datasets.build.journal import Entry, FolderHead, Journal
from phibench.datasets.build.task_runner import AHEAD, TRIALS, schedule
from phibench.datasets.build.tasks import BuildTask, Done, Failed, TaskResult


def nothing(out: Path) -> TaskResult:
    return TaskResult(())


def task(name: str, *needs: str) -> BuildTask:
    return BuildTask(name, "key", nothing, (), needs)


class Simulated:
    """Workers in simulated time, each with a queue; a poisoned task kills its worker, and all in its queue with it."""

    def __init__(
        self, workers: int, poison: Iterable[str] = (), bugs: Iterable[str] = (), seconds: float = 1.0
    ) -> None:
        self._poison, self._bugs, self._seconds = set(poison), set(bugs), seconds
        self._free = [(0.0, worker) for worker in range(workers)]
        self._queues: dict[int, list[tuple[float, BuildTask]]] = {worker: [] for worker in range(workers)}
        self._events: list[tuple[float, int, int]] = []
        self._ready: list[tuple[BuildTask, Done | Failed]] = []
        self._count = 0
        self.now, self.flying, self.most, self.runs = 0.0, 0, 0, Counter[str]()

    def width(self) -> int:
        return len(self._queues)

    def submit(self, task: BuildTask) -> None:
        self.flying += 1
        self.most = max(self.most, self.flying)
        at, worker = heapq.heappop(self._free)
        end = max(at, self.now) + self._seconds
        self._queues[worker].append((end, task))
        heapq.heappush(self._free, (end, worker))
        self._count += 1
        heapq.heappush(self._events, (end, self._count, worker))

    def next(self) -> tuple[BuildTask, Done | Failed]:
        while not self._ready:
            self.now, _, worker = heapq.heappop(self._events)
            queue = self._queues[worker]
            if queue and queue[0][0] <= self.now:
                self._end(queue)
        self.flying -= 1
        return self._ready.pop(0)

    def _end(self, queue: list[tuple[float, BuildTask]]) -> None:
        _, task = queue.pop(0)
        self.runs[task.name] += 1
        if task.name in self._poison:
            self._ready += [(one, Failed("killed", lethal=True)) for one in (task, *(t for _, t in queue))]
            queue.clear()
        elif task.name in self._bugs:
            self._ready.append((task, Failed("a bug")))
        else:
            self._ready.append((task, Done({}, None, self._seconds, 1.0, "w")))


def test_all_are_done_once_and_needs_come_first() -> None:
    tasks = [task(f"c{i}", f"b{i}", "a") for i in range(20)] + [task(f"b{i}", "a") for i in range(20)] + [task("a")]
    names = [done.name for done, _ in schedule(tasks, Simulated(3))]
    assert sorted(names) == sorted(one.name for one in tasks)
    position = {name: i for i, name in enumerate(names)}
    assert all(position[need] < position[one.name] for one in tasks for need in one.needs)


def test_needs_that_are_not_to_be_done_are_done() -> None:
    assert [one.name for one, _ in schedule([task("preview", "view")], Simulated(1))] == ["preview"]


@pytest.mark.parametrize("workers", [1, 4])
def test_a_poisoned_task_takes_no_innocent_with_it(workers: int) -> None:
    tasks = [task(f"t{i}") for i in range(40)] + [task("reader", "t7"), task("reader of the reader", "reader")]
    executor = Simulated(workers, poison=("t7", "t9"))
    outcomes = {one.name: outcome for one, outcome in schedule(tasks, executor)}
    failed = {name: outcome.cause for name, outcome in outcomes.items() if isinstance(outcome, Failed)}
    assert set(failed) == {"t7", "t9", "reader", "reader of the reader"}
    assert f"died every time, {TRIALS} in all (killed)" in failed["t7"]
    assert failed["reader"] == "not made, because t7 failed"
    assert len(outcomes) == len(tasks)
    assert executor.runs["t7"] in (TRIALS, TRIALS - 1)  # less one if it never ran before its worker died of the other
    assert executor.most <= AHEAD * workers


def test_a_bug_is_not_repeated_and_the_others_go_on() -> None:
    executor = Simulated(2, bugs=("t3",))
    outcomes = {one.name: outcome for one, outcome in schedule([task(f"t{i}") for i in range(9)], executor)}
    assert [name for name, outcome in outcomes.items() if isinstance(outcome, Failed)] == ["t3"]
    assert executor.runs["t3"] == 1


def simulate(samples: int, workers: int, folder: Path) -> tuple[int, float, float, Simulated]:
    """Tasks, CPU-seconds, MB grown: scheduling and journal of a data set whose tasks take no time."""
    tasks = [task(f"spot {i}") for i in range(samples)] + [task(f"view {i}") for i in range(2 * samples)]
    tasks += [task(f"sample {i}", f"spot {i}", f"view {2 * i}", f"view {2 * i + 1}") for i in range(samples)]
    row = {"sample_id": "x" * 24, **{f"number_{i}_m": 0.1 + i / 3.0 for i in range(80)}}  # about as long as a real one
    before, began = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time()
    executor = Simulated(workers)
    with Journal(folder) as journal:
        journal.begin(FolderHead("{}", ""), [])
        for one, outcome in schedule(tasks, executor):
            assert isinstance(outcome, Done)
            files = {f"{one.kind}s/{one.name}.exr": "0" * 64}
            journal.add(Entry(one.name, "0" * 64, files, row if one.kind == "spot" else None))
        journal.begin(FolderHead("{}", ""), [one.name for one in tasks])
    seconds = time.process_time() - began
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1e3
    return len(tasks), seconds, grown, executor


@pytest.mark.parametrize("samples", [2_000, pytest.param(100_000, marks=pytest.mark.slow)])
def test_a_thousand_workers_do_not_wait_for_us(tmp_path: Path, samples: int) -> None:
    """The window, the journal and its rewriting. 1 000 workers with tasks of 2 s take 500 a second: be faster."""
    count, seconds, grown, executor = simulate(samples, 1000, tmp_path)
    ideal = count / 1000.0  # every simulated task takes a second
    text = f"{count} tasks, {count / seconds:.0f} tasks/s, {grown:.0f} MB, {1e6 * grown / count:.0f} bytes a task"
    size = sum(file.stat().st_size for file in tmp_path.iterdir())
    print(f"\n{text}, workers busy {ideal / executor.now:.1%}, journal {size / 1e6:.0f} MB")
    assert count / seconds > 1000.0
    assert executor.most <= AHEAD * 1000
    assert executor.now < ideal + 5.0


# The forecast of the seconds that are left.

SECONDS = {"spot": 0.2, "bake": 80.0, "view": 4.5, "sample": 0.4}


def test_the_forecast_learns_from_the_tasks_of_the_run() -> None:
    """A machine four times slower than the first guess; kernels are compiled in the first view of both workers."""
    pace = Pace(SECONDS, 1.0, workers=2)
    assert pace.left_s({"bake": 1, "view": 10, "spot": 5}, [], 2) == pytest.approx(80.0 + 22.5)
    # two workers bake two rooms at a time
    assert pace.left_s({"bake": 12}, [], 2) == pytest.approx(12 * 80.0 / 2)
    assert pace.left_s({"bake": 1}, [], 2) == pytest.approx(80.0)
    for _ in range(25):
        pace.add("spot", 0.8)
    assert pace.seconds("view") == pytest.approx(4.0 * 4.5, rel=0.3)
    pace.add("bake", 320.0)
    assert pace.seconds("view") == pytest.approx(4.0 * 4.5, rel=0.05)
    for seconds in (40.0, 41.0):
        pace.add("view", seconds)
    assert pace.seconds("view") == 40.5
    for _ in range(3):
        pace.add("view", 18.0)
    assert pace.seconds("view") == 18.0
    assert pace.left_s({"view": 4}, [("view", 9.0), ("view", 9.0)], 2) == pytest.approx(45.0)
    for _ in range(8):
        pace.add("view", 4.5)  # the other load has gone
    assert pace.seconds("view") == 4.5


def test_a_task_that_takes_longer_than_expected_is_expected_to_go_on() -> None:
    pace = Pace(SECONDS, 1.0)
    assert pace.left_s({}, [("bake", 60.0)], 1) == pytest.approx(20.0)
    assert pace.left_s({}, [("bake", 200.0)], 1) == pytest.approx(40.0)


def test_the_account_of_a_run_knows_what_is_running() -> None:
    tasks = [*(task(f"spot {i}") for i in range(4)), task("bake room"), task("view 0", "bake room")]
    progress, seen = TaskProgress(tasks, Pace(SECONDS, 1.0, 2)), []
    for done, _ in schedule(tasks, progress.watch(Simulated(2))):
        progress.settle(done)
        seen.append([name for name, _ in progress.running()])
    assert seen[0] == ["spot 1", "spot 2"]
    assert seen[-1] == []
    assert progress.left_s() == 0.0
