"""The whole benchmark in one call: every method on the presets that it accepts, scores, one report."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bench_samples import describe, run
from test_make import quiet

from phibench.datasets.errors import DatasetError
from phibench.datasets.read import open_dataset
from phibench.estimator.bench.dataset_pairs import dataset_pairs
from phibench.estimator.bench.pair_set import PairSet
from phibench.estimator.bench.run_all import KeptPairs, Parts, bench, show
from phibench.estimator.seat.outcome import Outcome
from phibench.estimator.seat.pair import Pair


class RawOnly:
    """A built-in method, as far as the benchmark looks at it."""

    def refusal(self, pair: Pair) -> str:
        if pair.box_down is None:
            return "needs region hints"
        return "" if pair.card.output == "raw" else "takes raw"


def test_the_benchmark_runs_what_accepts_each_preset(bench_dataset: Path, tmp_path: Path) -> None:
    class Everything(RawOnly):
        def refusal(self, pair: Pair) -> str:
            return ""

    ran: list[tuple[str, int]] = []

    def counted(method: str, pairs: PairSet) -> Sequence[Outcome]:
        ran.append((method, len(pairs)))
        return run(method, pairs)

    def score(method: Any, pairs: PairSet, outcomes: Any, path: Path | None) -> dict[str, Any]:
        assert path is not None
        path.parent.mkdir(exist_ok=True)
        path.write_text(json.dumps({**method, "outcomes": len(outcomes)}))
        return {}

    def report(paths: Sequence[Path], page: Path) -> Path:
        page.write_text(" ".join(path.name for path in paths))
        return page

    parts = Parts({"raw": RawOnly(), "any": Everything()}, describe, counted, score, report)
    done = bench(bench_dataset, tmp_path / "out", parts=parts, console=quiet())
    assert [path.stem for path in done.scores] == ["bayer-raw-raw", "bayer-raw-any", "srgb8-any", "mjpeg-any"]
    assert done.notes == ("raw is left out on srgb8: takes raw", "raw is left out on mjpeg: takes raw")
    assert ran == [("raw", 3), ("any", 3), ("any", 3), ("any", 3)]
    assert "bayer-raw-raw.json" in done.report.read_text()
    assert not show(done.report)  # no terminal here
    with pytest.raises(DatasetError, match="no built-in method 'x'; known: raw, any"):
        bench(bench_dataset, tmp_path / "out", ["x"], parts, quiet())
    with pytest.raises(DatasetError, match="lies inside the data set"):
        bench(bench_dataset, bench_dataset / "out", None, parts, quiet())


def test_pairs_that_are_few_are_drawn_once(bench_dataset: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pairs = dataset_pairs(open_dataset(bench_dataset), "srgb8")
    kept = KeptPairs(pairs)
    assert kept.pair(2) is kept.pair(2)
    assert np.array_equal(kept.pair(2).up, pairs.pair(2).up)
    assert (len(kept), kept.document(), kept.truth(1).number) == (3, pairs.document(), 1)
    monkeypatch.setattr("phibench.estimator.bench.run_all._KEPT", 2)
    assert kept.pair(1) is not kept.pair(1)
