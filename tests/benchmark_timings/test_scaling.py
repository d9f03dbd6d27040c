"""Benchmarks of the generator: tasks per hour at 1 and 2 workers, and what the forecast said (`make benchmark`)."""

import os
import time
from pathlib import Path

import pytest
from helpers.processes import quiet

from phibench.datasets.build.dataset_build import plan_tasks
from phibench.datasets.build.forecast import START_S, Pace, forecast, slowdown
from phibench.datasets.build.task_runner import schedule
from phibench.datasets.build.tasks import Done
from phibench.datasets.build.workers import local_environment, local_workers, versions
from phibench.datasets.make import make
from phibench.datasets.plan.plan import make_plan
from phibench.datasets.recipe.load import load_recipe, parse_recipe

TINY = Path(__file__).resolve().parents[1] / "tiny.toml"
STROKES = ", ".join(f"{0.5 + k / 100.0:.2f}" for k in range(24))


def per_hour(count: int, folder: Path) -> float:
    """Tasks per hour of warm workers: 24 quarter-size views, 24 spots and previews."""
    plan = make_plan(parse_recipe(TINY.read_text().replace("[0.5]", f"[{STROKES}]").replace("[1.4]", "[0.5]")))
    tasks = plan_tasks(plan, versions(local_environment())).values()
    folder.mkdir()
    with local_workers(count, folder) as workers:
        warm = plan_tasks(make_plan(load_recipe(TINY)), {}).values()
        assert all(isinstance(outcome, Done) for _, outcome in schedule(warm, workers))
        began = time.perf_counter()
        assert all(isinstance(outcome, Done) for _, outcome in schedule(tasks, workers))
        return len(tasks) / (time.perf_counter() - began) * 3600.0


@pytest.mark.skipif((os.cpu_count() or 1) < 2, reason="needs two cores")
def test_two_workers_do_twice_as_much(benchmark, tmp_path: Path) -> None:
    """Efficiency at 2 workers; on a machine that does other work as well, it says nothing."""
    if benchmark.disabled:
        pytest.skip("a benchmark")
    one = per_hour(1, tmp_path / "1")
    two = benchmark.pedantic(per_hour, (2, tmp_path / "2"), rounds=1)
    print(f"\n1 worker {one:.0f} tasks/h, 2 workers {two:.0f} tasks/h, efficiency {two / one / 2.0:.0%}")
    benchmark.extra_info.update(one=one, two=two, efficiency=two / one / 2.0)
    assert two / one / 2.0 >= 0.85


def test_the_forecast_of_the_time(benchmark, tmp_path: Path) -> None:
    """`smoke` at full size: the first guess is not off by more than a factor of two, here."""
    if benchmark.disabled:
        pytest.skip("a benchmark")
    plan = make_plan(load_recipe("smoke"))
    cost, factor = forecast(plan, list(plan_tasks(plan, {}).values())), slowdown(1)
    guess = START_S * factor + Pace(cost.seconds, factor).left_s(cost.counts, [], 1)
    began = time.perf_counter()
    benchmark.pedantic(make, ("smoke", tmp_path / "smoke", 1, quiet()), rounds=1)
    took = time.perf_counter() - began
    print(f"\nforecast {guess:.1f} s, took {took:.1f} s")
    assert 0.5 < took / guess < 2.0
