"""Attack: two commands that start together, three hundred times."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.processes import SMALLEST

STARTS = 300
RUN = """
import json, os, sys, time
from pathlib import Path
from phibench.datasets import make
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.plan.plan import make_plan
from phibench.datasets.recipe.load import load_recipe
from rich.console import Console

me, recipe, folder, starts = int(sys.argv[1]), sys.argv[2], Path(sys.argv[3]), int(sys.argv[4])
plan, outcomes = make_plan(load_recipe(recipe)), []

def wait_for(path):
    end = time.monotonic() + 60.0
    while not path.exists() and time.monotonic() < end:
        pass

def say(name):
    (folder / f"{name}-{me}").write_text("")
    wait_for(folder / f"{name}-{1 - me}")

def hold(_plan, _recipe, out, *_):  # in place of the tasks: until the other has an outcome, too
    outcomes.append(None)
    say(f"ended-{out.name}")
    return []

make._make = hold
for number in range(starts):
    say(f"ready-{number}")
    try:
        make.make_from_plan(plan, "", folder / str(number), 1, Console(quiet=True))
    except DatasetError as error:
        outcomes.append(str(error))
        say(f"ended-{number}")
print(json.dumps({"process": os.getpid(), "outcomes": outcomes}))
"""


@pytest.mark.slow
def test_of_two_that_start_together_exactly_one_wins(tmp_path: Path) -> None:
    """The commands wait for each other before every start; who wins holds the folder until the other is refused."""
    commands = [[sys.executable, "-c", RUN, str(me), str(SMALLEST), str(tmp_path), str(STARTS)] for me in (0, 1)]
    runs = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for command in commands]
    said = [json.loads(run.communicate(timeout=600)[0]) for run in runs]
    processes, outcomes = [one["process"] for one in said], [one["outcomes"] for one in said]
    assert [len(each) for each in outcomes] == [STARTS, STARTS]
    for number, pair in enumerate(zip(*outcomes, strict=True)):
        assert pair.count(None) == 1, pair
        winner = pair.index(None)
        refused = f"another run (process {processes[winner]}) is writing to {tmp_path / str(number)};"
        assert pair[1 - winner].startswith(refused)
    assert {pair.index(None) for pair in zip(*outcomes, strict=True)} == {0, 1}  # neither was always first
