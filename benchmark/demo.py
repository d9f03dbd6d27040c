"""Demo: two built-in methods and the example of `phibench method new` on five pairs that are shipped.

The pairs are camera JPEGs with their truth, a frames set in `pair_sets/demo`: `docs/make_demo.py` makes it. They are
copied beside the scores, where a method of one's own finds them as any other set.
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from phibench.benchmark.isolation.resolve import write_example
from phibench.benchmark.pair_sets.frames_set import FramesSet
from phibench.benchmark.scores.report import write_report
from phibench.benchmark.scores.score import Scored, run_and_score, saved_each
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.progress import progress_console
from phibench.datasets.store.files import require_writable

SHIPPED = Path(__file__).parent / "pair_sets" / "demo"
METHODS = ("red_centroid", "chain_fit")
"""A simple method, and the best one on processed images."""
EXAMPLE, FRAMES, REPORT = "my_phi.py", "frames", "report.html"


@dataclass(frozen=True)
class Demo:
    """Result: the page, the scores, the set of pairs and the example method that lie beside it."""

    page: Path
    scores: tuple[Scored, ...]
    pairs: Path
    example: Path


def demo(out: Path, console: Console | None = None) -> Demo:
    """Score the methods of the demo and write one page; an example that was changed is kept and scored.

    Raises
    ------
    DatasetError
        If the folder cannot be written, or holds other files.
    """
    strange = [path.name for path in (out.iterdir() if out.is_dir() else ()) if path.name not in _OWN]
    if strange:
        raise DatasetError(f"{out} holds other files, such as {sorted(strange)[0]}: give an empty folder, --out")
    require_writable(out / REPORT)
    pairs, example = out / FRAMES, out / EXAMPLE
    if not pairs.exists():
        shutil.copytree(SHIPPED, pairs)
    if not example.exists():
        write_example(example)
    references = [*METHODS, f"{example}:extract"]
    scored = run_and_score(references, FramesSet(pairs), 1, console or progress_console(), "pairs")
    files = [out / name for name in _SCORES]
    saved = saved_each(scored, files)
    return Demo(write_report(files, out / REPORT), tuple(saved), pairs, example)


_SCORES = (*(f"{name}.json" for name in METHODS), "my_phi.json")
_OWN = {EXAMPLE, FRAMES, REPORT, "__pycache__", *_SCORES, *(name.replace(".json", ".parquet") for name in _SCORES)}
