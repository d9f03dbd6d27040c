"""The whole benchmark: every built-in method on every preset that it takes, each pair drawn once, one report."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.processes import quiet

from phibench.datasets.errors import DatasetError
from phibench.estimator.benchmark.document import read_score
from phibench.estimator.benchmark.score import bench, score


def test_the_benchmark_runs_what_accepts_each_preset(bench_dataset: Path, tmp_path: Path) -> None:
    names = ["red_centroid", "raw_maximum_likelihood"]
    done = bench(bench_dataset, tmp_path / "out", names, workers=2, console=quiet())
    stems = ["bayer-raw-red_centroid", "bayer-raw-raw_maximum_likelihood", "srgb8-red_centroid", "mjpeg-red_centroid"]
    assert [path.stem for path in done.scores] == stems
    assert len(done.notes) == 2
    assert all("takes mono-raw, bayer-raw, not" in note or "takes bayer-raw, mono-raw" in note for note in done.notes)
    documents = [read_score(path) for path in done.scores]
    assert [document.pairs for document in documents] == [3, 3, 3, 3]
    assert "raw_maximum_likelihood" in done.report.read_text()
    # one method alone on the same pairs answers the same: the harness keeps them apart
    one, other = score(bench_dataset, names[0], "bayer-raw", console=quiet()).document, documents[0]
    assert one.metrics["rms_px"] == other.metrics["rms_px"]
    assert one.worst == other.worst


@pytest.mark.parametrize(
    ("out", "names", "words"),
    [
        ("out", ["x"], "no built-in method 'x'; known: "),
        ("inside", None, "lies inside the data set"),
    ],
)
def test_a_benchmark_that_cannot_be_is_refused(
    bench_dataset: Path, tmp_path: Path, out: str, names: list[str] | None, words: str
) -> None:
    folder = bench_dataset / "out" if out == "inside" else tmp_path / out
    with pytest.raises(DatasetError, match=words):
        bench(bench_dataset, folder, names, console=quiet())
