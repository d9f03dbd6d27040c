"""Learning curve of `learned_crop`: what rooms held out say of more crops, rooms, steps, weights and of another loss.

python docs/measure_learning.py out/bench-dev --held 6 --crops 6000

Needs `pip install 'phibench[learned-training]'`. One row for each change of a short training, at the same crops held
out; "rows" names those that are wanted.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from tools import crop_training as training

CHANGES: Mapping[str, Mapping[str, Any]] = {
    "as it is": {},
    "half of the crops": {"crops": 0.5},
    "quarter of the crops": {"crops": 0.25},
    "half of the rooms": {"rooms": 0.5},
    "quarter of the rooms": {"rooms": 0.25},
    "half of the steps": {"passes": 0.5},
    "twice the steps": {"passes": 2.0},
    "four times the steps": {"passes": 4.0},
    "half of the planes": {"planes": 0.5},
    "twice the planes": {"planes": 2.0},
    "errors beyond 4 deviations squared": {"far": 1e9},
    "errors beyond 2 deviations by distance": {"far": 2.0},
}


@contextmanager
def changed_network(planes: float, far: float) -> Iterator[None]:
    """Another number of planes, and of deviations beyond which errors count by their distance, in `crop_training`."""
    wide = round(training.PLANES_OUT * planes)
    more = wide - training.PLANES_OUT
    f1, (f2, inner, outer), (d1, pooled, hidden), d2 = training.DENSE
    dense = (f1, (f2, inner, outer + 2 * more), (d1, pooled + more, hidden), d2)
    convolutions = tuple((name, wide if k else of, *rest) for k, (name, of, *rest) in enumerate(training.CONVOLUTIONS))
    changes = {"PLANES_OUT": wide, "DENSE": dense, "CONVOLUTIONS": convolutions, "_FAR": far}
    with patch.multiple(training, **changes):
        yield


def row(change: Mapping[str, Any], items: training.Items, seen: list[str], held: list[str], passes: int) -> str:
    """Train once; numbers of seen and held-out crops."""
    rooms = seen[: max(1, round(len(seen) * change.get("rooms", 1.0)))]
    given, checks = items.of(rooms), items.of(held)
    if "rooms" in change:  # as many steps: each crop is seen more often
        passes = round(passes / change["rooms"])
    kept = np.arange(0, len(given.planes), round(1.0 / change.get("crops", 1.0)))
    passes = round(passes / change.get("crops", 1.0) * change.get("passes", 1.0))
    given = training.Items(*(column[kept] for column in vars(given).values()))
    before = time.process_time()
    settings = replace(training.TrainingSettings(), passes=passes)
    with changed_network(change.get("planes", 1.0), change.get("far", training._FAR)):
        weights = training.train_crop(given, settings)
        parts = [_numbers(training.answers_of(weights, part)) for part in (given, checks)]
        counts = f"{len(given.planes)} | {sum(w.size for w in weights.values())}"
    return f"{counts} | {(time.process_time() - before) / 60.0:.1f} | " + " | ".join(parts)


def _numbers(answers: training.Answers) -> str:
    """Loss, and the geometric mean of errors with its standard error over views."""
    distance = np.log(np.hypot(*answers.error_px.T))
    a = -0.5 * np.log(np.linalg.det(answers.covariance_px2))
    loss = (np.minimum(answers.squared_pull, training._TAIL) - a).mean()
    mean = np.exp(distance.mean())
    return f"{loss:.3f} | {mean:.4f} +- {mean * distance.std() / len(distance) ** 0.5:.4f}"


def main() -> None:
    """Read the options, draw the crops once, train for each row."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--held", type=int, default=6, help="rooms held out")
    parser.add_argument("--crops", type=int, default=6000)
    parser.add_argument("--passes", type=int, default=16)
    parser.add_argument("--rows", nargs="+", default=list(CHANGES), choices=list(CHANGES))
    options = parser.parse_args()
    with patch.object(training, "HELD_OUT", options.held):
        seen, held = training.rooms_of(options.folder, 0)
    settings = replace(training.TrainingSettings(), crops=options.crops)
    crops = training.crops_of(options.folder, settings, seen + held, options.crops, training.POOL_SEED)
    items = training.items_of(crops, settings)
    print("change | views | weights | CPU-min | seen: loss | seen: error, px | held out: loss | held out: error, px")
    for name in options.rows:
        print(f"{name} | {row(CHANGES[name], items, seen, held, options.passes)}", flush=True)


if __name__ == "__main__":
    main()
