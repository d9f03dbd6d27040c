"""Walks: count of files and functions that run from recipe to frame, from pairs to score, and from pictures to D.

    python -m tools.walks FOLDER [--list]

The ways: a recipe's `stroke_m` to an MJPEG frame; two MJPEG pairs to a score by a function in this process; four
pictures to D with sigma. All modules are imported before, so that only calls count; tasks run in this process.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import inspect
import multiprocessing
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import CodeType, FrameType
from typing import Any
from unittest.mock import patch

from phibench.calibration.captures.measure import measure, read_setting
from phibench.calibration.captures.pair_photos import PairPhotos, PositionPhotos
from phibench.calibration.captures.picture_files import read_photo
from phibench.datasets.build.task_runner import OwnProcess
from phibench.datasets.build.workers import describe
from phibench.datasets.common.progress import progress_console
from phibench.datasets.make import make
from phibench.datasets.read import open_dataset
from phibench.estimator.interface import Answer, Pair, Spot

ROOT = Path(__file__).resolve().parent.parent
DISTRICTS = ("scenes", "render", "datasets", "estimator", "calibration", "benchmark", "robot", "studies")
RECIPE = """
dataset = {name = "walk", seed = 0}
ambient = {quality = "training", texel_m = 0.5, lamp_rays = 4, bounces = 2, bounce_rays = 8, final_rays = 8}
targets = [{name = "near", depth_m = 1.975, azimuth_deg = 100.0, height_m = 0.50}]
experiments = [{name = "seen", targets = ["near"], strokes_m = [0.5, 0.6]}]
"""


class InThisProcess(contextlib.AbstractContextManager["InThisProcess"]):
    """Pool of workers that are this process."""

    width = 1

    def __init__(self, out: Path, *_: object) -> None:
        self._out = out

    def __exit__(self, *_: object) -> None:
        return None

    def environment(self) -> dict[str, object]:
        """As of workers."""
        return {key: value for key, value in describe().items() if key != "worker"}

    def executor(self, _: int) -> OwnProcess:
        """Executor of tasks."""
        return OwnProcess(self._out)


def to_frame(folder: Path) -> Callable[[], object]:
    """Way from a recipe's `stroke_m` to an MJPEG frame."""
    recipe = folder / "walk.toml"
    recipe.write_text(RECIPE, encoding="utf-8")

    def way() -> object:
        with patch("phibench.datasets.make.WorkerPool", InThisProcess):
            make(recipe, folder / "data", 1, progress_console())
        return open_dataset(folder / "data")[0].camera_frames("mjpeg")

    return way


def to_score(folder: Path) -> Callable[[], object]:
    """Way from two MJPEG pairs to a score, by a function in this process."""
    from phibench.benchmark.scores.score import score

    def brightest(pair: Pair) -> Answer:
        places = [divmod(int(image.sum(axis=2).argmax()), image.shape[1]) for image in (pair.down, pair.up)]
        down, up = (Spot((float(u), float(v))) for v, u in places)
        return Answer(down, up)

    return lambda: score(folder / "data", brightest, "mjpeg", out=folder / "score.json")


def to_depth(folder: Path) -> Callable[[], object]:
    """Way from four pictures to D with sigma."""
    sample, rig = open_dataset(folder / "data")[0], folder / "rig.toml"
    rig.write_text("[rig]\n", encoding="utf-8")
    for name, frame in sample.camera_frames("mjpeg", laser_off=True).by_name.items():
        (folder / f"{name}.jpg").write_bytes(frame.jpeg or b"")

    def way() -> object:
        setting = read_setting(rig)
        on_off = (
            [(read_photo(folder / f"{position}{end}.jpg", setting.known.rig, None),) for end in ("", "_off")]
            for position in ("down", "up")
        )
        return measure(PairPhotos(*(PositionPhotos(*frames) for frames in on_off)), sample.row.stroke_m, setting)

    return way


WAYS = {"recipe to frame": to_frame, "pairs to score": to_score, "pictures to D": to_depth}


def walk(name: str, folder: Path, lists: bool) -> None:
    """Go one way and print what ran; alone in its process, so that no cache is warm."""
    files = {str(file): file for district in DISTRICTS for file in (ROOT / district).rglob("*.py")}
    for file in files.values():
        with contextlib.suppress(ImportError):  # of packages that are not installed
            importlib.import_module(".".join(("phibench", *file.relative_to(ROOT).with_suffix("").parts)))
    way, calls = WAYS[name](folder), set[CodeType]()
    known: dict[CodeType, bool] = {}

    def profile(frame: FrameType, event: str, _: Any) -> None:
        code = frame.f_code
        if code not in known:  # the paths go through the links in `phibench`; bodies of classes are no functions
            is_function = bool(code.co_flags & inspect.CO_OPTIMIZED) and not code.co_name.startswith("<")
            known[code] = is_function and str(Path(code.co_filename).resolve()) in files
        if event == "call" and known[code]:
            calls.add(code)

    sys.setprofile(profile)
    try:
        way()
    finally:
        sys.setprofile(None)
    counts = Counter(str(Path(code.co_filename).resolve().relative_to(ROOT)) for code in calls)
    lines = sum((ROOT / path).read_text(encoding="utf-8").count("\n") for path in counts)
    print(f"{name}: {len(counts)} files of {lines} lines, {len(calls)} functions")
    for path, count in counts.most_common() if lists else ():
        ran = sorted(code.co_qualname for code in calls if code.co_filename.endswith(f"/{path}"))
        print(f"    {count:4d} {path}: {', '.join(ran[:6])}")


def main() -> None:
    """Go the three ways, one after the other: the first makes the data set of the others."""
    parser = argparse.ArgumentParser("python -m tools.walks", description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path, help="for the data set; empty or not there")
    parser.add_argument("--list", action="store_true", help="print the files with the functions that ran")
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    for name in WAYS:
        process = multiprocessing.get_context("spawn").Process(target=walk, args=(name, given.folder, given.list))
        process.start()
        process.join()


if __name__ == "__main__":
    main()
