"""The whole benchmark: every built-in method on every preset that it takes, each pair drawn once, one report."""

from __future__ import annotations

import shutil
import textwrap
from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path

import polars as pl
import pytest
from helpers.processes import quiet
from helpers.sandbox_pairs import HEADER, method_file

from phibench.benchmark.isolation import method_references as resolving
from phibench.benchmark.isolation.guest_process import MethodProcess
from phibench.benchmark.isolation.method_references import GROUP, resolve
from phibench.benchmark.isolation.run_limits import MethodError, RunLimits
from phibench.benchmark.isolation.runner import Harness
from phibench.benchmark.pair_sets.dataset_pairs import TRACKS, dataset_pairs, tracks_of
from phibench.benchmark.reports import bench as benching
from phibench.benchmark.reports import figures
from phibench.benchmark.reports.bench import bench
from phibench.benchmark.scores.score import score
from phibench.benchmark.scores.score_files import read_score
from phibench.cli import main as cli
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.read import open_finished
from phibench.estimator.methods import spot_search
from phibench.estimator.methods.registry import METHODS
from phibench.estimator.methods.spot_search import SharedPair
from phibench.estimator.spots.detect import detect


@pytest.mark.slow
def test_the_benchmark_runs_what_accepts_each_preset(
    bench_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(figures, "encoded_figure", lambda *_: b"")  # thirty figures, which test_report.py draws
    names = ["red_centroid", "raw_maximum_likelihood"]
    done = bench(bench_dataset, tmp_path / "out", names, workers=1, pairs=2, console=quiet())
    raw = [f"bayer-raw-{name}{track}" for track in ("", "-localise") for name in names]
    others = [f"{preset}-red_centroid{track}" for preset in ("srgb8", "mjpeg") for track in ("", "-localise")]
    assert [path.stem for path in done.scores] == [*raw, *others]
    assert len(done.notes) == 4
    assert all("takes mono-raw, bayer-raw, not" in note or "takes bayer-raw, mono-raw" in note for note in done.notes)
    documents = [read_score(path) for path in done.scores]
    assert [document.pairs for document in documents] == [2] * 8
    tracks = [tracks_of(document.pair_set) for document in documents]
    assert tracks == [track for own in (2, 1, 1) for track in [("find", "depth")] * own + [("localise",)] * own]
    page = done.report.read_text()
    assert all(f"Track {track}" in page for track in TRACKS)
    assert "raw_maximum_likelihood" in page
    # one method alone on the same pairs answers the same: the harness keeps them apart
    one, other = (
        score(bench_dataset, names[0], "bayer-raw", pairs=2, track="find", console=quiet()).document,
        documents[0],
    )
    assert one.metrics["rms_px"] == other.metrics["rms_px"]
    assert one.worst == other.worst


@pytest.mark.slow
def test_registered_methods_run_beside_built_in_ones(
    bench_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A package's method that is `detect` by another name has its scores, to the last bit."""
    theirs = EntryPoint("theirs", "phibench.estimator.methods.registry:detected_spots", GROUP)
    monkeypatch.setattr(resolving, "entry_points", lambda group: [theirs])
    # all presets and the report are those of the test above
    monkeypatch.setattr(benching, "_presets", lambda _: ["bayer-raw", "mjpeg"])
    monkeypatch.setattr(benching, "write_report", lambda *_: tmp_path)
    done = bench(bench_dataset, tmp_path / "out", ["theirs", "detect"], pairs=1, console=quiet(), tracks=["depth"])
    documents = {path.stem: read_score(path) for path in done.scores}
    presets = {stem.removesuffix("-theirs") for stem in documents if stem.endswith("-theirs")}
    assert presets == {"bayer-raw", "mjpeg"}
    for preset in presets:
        theirs_, ours = documents[f"{preset}-theirs"], documents[f"{preset}-detect"]
        assert theirs_.method.kind == "package"
        assert theirs_.metrics["rms_counted_px"].value == ours.metrics["rms_counted_px"].value


@pytest.mark.parametrize(
    ("out", "names", "words"),
    [
        ("out", ["x"], "no method 'x' is built in or registered by a package; known: "),
        ("inside", None, "lies inside the data set"),
    ],
)
def test_a_benchmark_that_cannot_be_is_refused(
    bench_dataset: Path, tmp_path: Path, out: str, names: list[str] | None, words: str
) -> None:
    folder = bench_dataset / "out" if out == "inside" else tmp_path / out
    with pytest.raises(DatasetError, match=words):
        bench(bench_dataset, folder, names, console=quiet())


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["bayer-raw", "mjpeg"])
def test_shared_work_is_done_once_and_changes_no_answer(
    bench_dataset: Path, preset: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    pair = dataset_pairs(open_finished(bench_dataset), preset).pair(0)
    asked = [method for method in METHODS.values() if not method.refusal(pair)]
    alone = [repr(method(pair)) for method in asked]  # repr of a float tells every bit
    searches: list[int] = []
    monkeypatch.setattr(spot_search, "detect", lambda one: searches.append(one.number) or detect(one))
    for order in (1, -1):
        shared = SharedPair.of(pair)
        assert [repr(method(shared)) for method in asked[::order]] == alone[::order]
        assert len(shared.work.stages) == 2  # the search, and the fits of each image that joint_fit begins with
    assert len(asked) >= 9
    assert searches == [0, 0]
    # another pair has nothing of this one's work
    assert replace(shared, stroke_m=0.1).work.stages == {}


def test_a_method_of_others_neither_profits_from_shared_work_nor_changes_it(
    bench_dataset: Path, tmp_path: Path
) -> None:
    body = """
    from phibench.estimator.methods import spot_search
    from phibench.estimator.spots import detect
    spot_search.detect = detect.detect = lambda pair: 1 / 0
    return Answer(Spot((float(hasattr(pair, "work")), float(os.getpid()))), Spot.missing(type(pair).__name__))
    """
    foreign = method_file(tmp_path, textwrap.dedent(body), header=f"import os\n{HEADER}")
    pairs = dataset_pairs(open_finished(bench_dataset), "bayer-raw")
    names = ["red_centroid", foreign, "detect", "off_difference"]
    with Harness(names) as harness:
        done = list(harness.outcomes(pairs, range(2)))
        assert len(harness.isolations) == len(names)
        assert {"draw", "detect", "red_centroid", "off_difference"} <= set(harness.stages)
        assert harness.stages["off_difference"] < harness.stages["detect"]  # it found the search done
    for number, outcomes in enumerate(done):
        pair = pairs.pair(number)
        right = {name: repr(METHODS[name](pair)) for name in names if name in METHODS}
        assert {name: repr(one.answer) for name, one in zip(names, outcomes, strict=True) if name in right} == right
        answer = outcomes[1].answer
        assert answer is not None
        assert (answer.down.uv_px or (1.0,))[0] == 0.0
        assert answer.up.status == "Pair"
        # a method's time is what it takes alone, the search included
        assert outcomes[3].seconds > 0.5 * outcomes[0].seconds
    with pytest.raises(MethodError, match="built-in methods alone share a process"):
        MethodProcess(resolve("detect"), RunLimits(), others=[resolve(foreign)])


@pytest.mark.slow
def test_a_shared_process_that_ends_is_started_anew(bench_dataset: Path) -> None:
    pair = dataset_pairs(open_finished(bench_dataset), "bayer-raw").pair(0)
    process = MethodProcess(resolve("red_centroid"), RunLimits(), others=[resolve("detect")])
    try:
        first = process.ask(pair, 0)
        process.end()
        second = process.ask(pair, 1)
    finally:
        process.close()
    assert (repr(first.answer), repr(second.answer)) == tuple(
        repr(METHODS[n](pair)) for n in ("red_centroid", "detect")
    )


def test_a_data_set_that_becomes_unreadable_in_the_middle_keeps_the_records_so_far(
    bench_dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of every method; the sentence names sample, file and what was written."""
    damaged = Path(shutil.copytree(bench_dataset, tmp_path / "set"))
    order = [one.sample_id for one in dataset_pairs(open_finished(damaged)).pair_draws]
    first = {name: order.index(name) for name in set(order)}
    name = max(first, key=lambda sample: first[sample])
    layer = damaged / "spots" / f"{name}-up.exr"
    layer.write_bytes(layer.read_bytes()[:200])
    mine = method_file(tmp_path, "return Answer(Spot.missing('-'), Spot.missing('-'))")
    tokens = ["score", str(damaged), "--method", mine, "--method", "red_centroid", "--out", str(tmp_path / "x.json")]
    assert cli.main(tokens) == 2
    said = capsys.readouterr().err
    assert f"sample '{name}': " in said
    assert "is damaged" in said
    assert f"the records of the {first[name]} pairs before it are in" in said
    assert "run `phibench dataset repair`, then score again" in said
    kept = sorted(tmp_path.glob("*.so-far.parquet"))
    assert [path.name.removesuffix(".so-far.parquet") for path in kept] == ["x-my_phi-extract", "x-red_centroid"]
    for path in kept:
        assert sorted(pl.read_parquet(path)["number"].unique()) == list(range(first[name]))
    assert not list(tmp_path.glob("x*.json"))
