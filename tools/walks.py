"""Walks through the library: which of its files and functions run on three ways, counted while they run.

    python tools/walks.py FOLDER [--list]

The ways: a recipe's `stroke_m` to an MJPEG frame; two MJPEG pairs to a score by a function in this process; four
pictures to D with sigma. All modules are imported before, so that only calls count; tasks run in this process.
"""

from __future__ import annotations

import argparse
import importlib
import inspect
import multiprocessing
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import CodeType, FrameType
from typing import Any
from unittest.mock import patch

from phibench.datasets.build.parts import OwnProcess
from phibench.datasets.build.workers import describe
from phibench.datasets.common.progress import progress_console

ROOT = Path(__file__).resolve().parent.parent
DISTRICTS = ("scenes", "render", "datasets", "estimator", "calibration", "benchmark", "robot", "studies")
RECIPE = """
[dataset]
name = "walk"
seed = 0

[ambient]
quality = "training"
texel_m = 0.5
lamp_rays = 4
bounces = 2
bounce_rays = 8
final_rays = 8

[[targets]]
name = "near"
depth_m = 1.975
azimuth_deg = 100.0
height_m = 0.50

[[experiments]]
name = "seen"
targets = ["near"]
strokes_m = [0.5, 0.6]
"""
RIG = "[rig]\n"


class InThisProcess:
    """Pool of workers that are this process."""

    width = 1

    def __init__(self, out: Path, *_: object) -> None:
        self._out = out

    def __enter__(self) -> InThisProcess:
        return self

    def __exit__(self, *_: object) -> None:
        return None

    def environment(self) -> dict[str, object]:
        """As of workers."""
        return {key: value for key, value in describe().items() if key != "worker"}

    def executor(self, _: int) -> OwnProcess:
        """Executor of tasks."""
        return OwnProcess(self._out)


@contextmanager
def counted(calls: Counter[CodeType]) -> Iterator[None]:
    """Count calls of the library's functions."""
    places = tuple(f"{ROOT / name}/" for name in DISTRICTS)

    def profile(frame: FrameType, event: str, _: Any) -> None:
        code = frame.f_code
        # the paths of a checkout go through the links in `phibench`
        if event == "call" and code.co_flags & inspect.CO_OPTIMIZED and real(code).startswith(places):
            calls[code] += 1

    sys.setprofile(profile)
    try:
        yield
    finally:
        sys.setprofile(None)


_REAL: dict[str, str] = {}


def real(code: CodeType) -> str:
    """File of a code, links followed."""
    name = code.co_filename
    if name not in _REAL:
        _REAL[name] = str(Path(name).resolve())
    return _REAL[name]


def to_frame(folder: Path) -> Callable[[], object]:
    """Way from a recipe's `stroke_m` to an MJPEG frame."""
    from phibench.datasets.make import make
    from phibench.datasets.read import open_dataset

    recipe = folder / "walk.toml"
    recipe.write_text(RECIPE, encoding="utf-8")

    def way() -> object:
        with patch("phibench.datasets.make.WorkerPool", InThisProcess):
            make(recipe, folder / "data", 1, progress_console())
        return open_dataset(folder / "data")[0].camera_frames("mjpeg", laser_off=True)

    return way


def to_score(folder: Path) -> Callable[[], object]:
    """Way from two MJPEG pairs to a score, by a function in this process."""
    from phibench.benchmark.scores.score import score
    from phibench.estimator.interface import Answer, Pair, Spot

    def brightest(pair: Pair) -> Answer:
        images = (pair.down, pair.up)
        places = [divmod(int(image.sum(axis=2).argmax()), image.shape[1]) for image in images]
        return Answer(*(Spot((float(u), float(v))) for v, u in places))

    return lambda: score(folder / "data", brightest, "mjpeg", out=folder / "score.json")


def to_depth(folder: Path) -> Callable[[], object]:
    """Way from four pictures to D with sigma."""
    from phibench.cli.captures import PairPictures, measure
    from phibench.datasets.read import open_dataset

    rig, sample = folder / "rig.toml", open_dataset(folder / "data")[0]
    rig.write_text(RIG, encoding="utf-8")
    frames = sample.camera_frames("mjpeg", laser_off=True).by_name
    paths = {name: folder / f"{name}.jpg" for name in frames}
    for name, frame in frames.items():
        paths[name].write_bytes(frame.jpeg or b"")
    pair = PairPictures((paths["down"],), (paths["up"],), sample.row.stroke_m, (paths["down_off"],), (paths["up_off"],))
    return lambda: measure(rig=rig, pair=pair)


WAYS = {"recipe to frame": to_frame, "pairs to score": to_score, "pictures to D": to_depth}


def walk(name: str, folder: Path, shows_files: bool) -> None:
    """Go one way and print what ran; alone in its process, so that no cache is warm."""
    for district in DISTRICTS:
        for file in sorted((ROOT / district).rglob("*.py")):
            module = ".".join(file.relative_to(ROOT).with_suffix("").parts)
            try:
                importlib.import_module(module if module.startswith("phibench.") else f"phibench.{module}")
            except ImportError as error:
                print(f"not imported: {module}: {error}", file=sys.stderr)
    way, calls = WAYS[name](folder), Counter[CodeType]()
    with counted(calls):
        way()
    functions = Counter(str(Path(real(code)).relative_to(ROOT)) for code in calls)
    print(f"{name}: {len(functions)} files, {len(calls)} functions")
    if shows_files:
        for file, count in sorted(functions.items(), key=lambda item: item[1]):
            ran = sorted(code.co_qualname for code in calls if real(code) == str(ROOT / file))
            print(f"    {count:4d} {file}: {', '.join(ran[:6])}")


def main() -> None:
    """Go the three ways, one after the other: the first makes the data set of the others."""
    parser = argparse.ArgumentParser(description=__doc__)
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
