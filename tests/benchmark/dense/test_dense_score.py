"""Dense scores: from methods in processes of their own to files, tables and comparisons."""

from __future__ import annotations

import base64
import dataclasses
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from helpers.processes import quiet
from rich.console import Console

from phibench.benchmark.dense.dense_metrics import DENSE_METRICS
from phibench.benchmark.dense.dense_pairs import dense_pairs, require_curve
from phibench.benchmark.dense.dense_records import COLUMN_TYPES
from phibench.benchmark.dense.dense_results import write_dense_results
from phibench.benchmark.dense.dense_score import (
    DenseScored,
    compare_dense,
    read_dense,
    run_dense,
    saved_dense,
    score_dense,
)
from phibench.benchmark.dense.dense_tables import dense_board, dense_metrics_table, dense_strata_table
from phibench.benchmark.isolation.answers import AnswerError, checked_dense_answer, dense_answer_document, most_bytes
from phibench.benchmark.isolation.method_references import DENSE, resolve
from phibench.benchmark.isolation.run_limits import MethodError, RunLimits
from phibench.benchmark.scored_dataset import open_dataset
from phibench.cli.main import main
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.shown_text import text_of
from phibench.datasets.store.schema import RECORDS_SO_FAR
from phibench.estimator.dense.dense_interface import DenseAnswer, DensePair
from phibench.scenes.frames import Pose
from phibench.scenes.room import default_rig

METHODS = """
import numpy as np
from phibench.estimator.dense.dense_interface import DenseAnswer

def flat(pair):
    return DenseAnswer(depth_m=np.full(pair.shape, 2.0, np.float32), sigma_depth_m=np.full(pair.shape, 0.5, np.float32))

def colour(pair):
    return DenseAnswer(depth_m=pair.down.mean(axis=2) * pair.down[..., 0] + 1.0)

def small(pair):
    return DenseAnswer(depth_m=np.ones((10, 20)))

def writes(pair):
    pair.down[0, 0] = 0
"""


@pytest.fixture(scope="module")
def methods(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("methods") / "mine.py"
    file.write_text(METHODS, encoding="utf-8")
    return file


def flat(pair: DensePair) -> DenseAnswer:
    return DenseAnswer(np.full(pair.shape, 2.0, np.float32), sigma_depth_m=np.full(pair.shape, 0.5, np.float32))


@pytest.fixture(scope="module")
def scored(tiny_dataset: Path) -> DenseScored:
    return score_dense(tiny_dataset, flat, "mjpeg", console=quiet())


def test_the_oracle_scores_nothing(tiny_dataset: Path) -> None:
    """A function that knows the truth: every error is below 1e-9, every recall 1."""
    opened = open_dataset(tiny_dataset)
    pairs = dense_pairs(opened, "mjpeg")
    truths = [pairs.truth(number).found.uv_px for number in range(len(pairs))]
    found = score_dense(opened, lambda pair: DenseAnswer(target_uv_px=truths[pair.number]), "mjpeg", console=quiet())
    metrics = found.document.metrics
    for name in ("median_relative", "rms_relative", "mae_m", "rmse_m", "disparity_rmse_deg", "matching", "above_2"):
        assert metrics[name].value < 1e-9, name
    assert metrics["recall"].value == metrics["answered"].value == 1.0
    assert {part.by for part in found.document.strata} >= {"depth", "elevation", "texture", "edge", "stroke"}


@pytest.mark.slow
def test_a_process_of_its_own_answers_as_the_function_does(
    tiny_dataset: Path, methods: Path, scored: DenseScored, tmp_path: Path
) -> None:
    names = [f"{methods}:{name}" for name in ("flat", "small", "writes")]
    one, small, writes = run_dense(names, dense_pairs(open_dataset(tiny_dataset), "mjpeg"), console=quiet())
    different = [name for name in one.records.columns if name not in ("seconds", "message")]
    assert one.records.select(different).equals(scored.records.select(different))
    assert one.document.results_sha256 == scored.document.results_sha256
    assert one.document.method.sha256
    assert one.document.isolation
    assert small.document.failures == {"invalid": 2}
    assert "the answer has (10, 20) pixels, the down image (180, 320)" in small.records["message"][0]
    assert writes.document.failures == {"mutated": 2}


def test_a_method_that_wants_colours_is_told_so_on_raw_images(tiny_dataset: Path, methods: Path) -> None:
    pairs = dense_pairs(open_dataset(tiny_dataset), "bayer-raw", pairs=1)
    (found,) = run_dense([f"{methods}:colour"], pairs, console=quiet())
    assert found.document.failures == {"error": 1}
    assert "images of 'bayer-raw' are raw, (H, W) without colours" in found.records["message"][0]


@pytest.mark.slow
def test_built_in_methods_run_in_processes_of_their_own(tiny_dataset: Path) -> None:
    pairs = dense_pairs(open_dataset(tiny_dataset), "mjpeg", pairs=1)
    assert not resolve("dense_sgbm", DENSE).shares
    central, exact = run_dense(["dense_sgbm", "dense_sgbm_exact"], pairs, console=quiet())
    assert central.document.failures == exact.document.failures == {}
    assert central.document.method.kind == "built-in"
    # the same matches: they differ by what the central model adds
    assert central.records["answered"][0] == pytest.approx(exact.records["answered"][0], abs=0.02)
    assert central.records["median"][0] != exact.records["median"][0]


def test_metrics_are_means_over_pairs(scored: DenseScored) -> None:
    whole = scored.records.filter(pl.col("by") == "all")
    assert scored.records.schema == COLUMN_TYPES
    assert len(whole) == 2
    value = {name: scored.document.metrics[name].value for name in DENSE_METRICS}
    assert value["median_relative"] == pytest.approx(whole["median"].to_numpy().mean(), rel=1e-12)
    assert value["rms_relative"] == pytest.approx(np.sqrt(whole["square"].to_numpy().mean()), rel=1e-12)
    assert value["coverage"] == pytest.approx(whole["coverage"].to_numpy().mean(), rel=1e-12)
    assert scored.document.metrics["recall"].note == "under 5 samples"


def test_a_score_comes_back_from_its_file(tiny_dataset: Path, scored: DenseScored, tmp_path: Path) -> None:
    kept = saved_dense(scored, tmp_path / "a.json")
    assert read_dense(tmp_path / "a.json") == kept.document
    other = saved_dense(score_dense(tiny_dataset, half_right, "mjpeg", console=quiet()), tmp_path / "b.json")
    (recall, *_) = compare_dense(tmp_path / "a.json", tmp_path / "b.json")
    assert recall.name == "recall"
    assert recall.first == kept.document.metrics["recall"].value
    assert recall.second == other.document.metrics["recall"].value
    assert recall.better == "too few samples"
    for table in (dense_board([kept.document]), dense_strata_table(kept.document), dense_metrics_table(kept.document)):
        assert "flat" in text_of(table)
    heads = text_of(dense_strata_table(kept.document)).splitlines()[1]
    assert heads.split() == ["pixels", "recall", "answered", "median", "above", "central"]  # whole, in 80 columns
    document = json.loads((tmp_path / "a.json").read_text())
    (tmp_path / "a.json").write_text(json.dumps({**document, "kind": "phibench score"}))
    with pytest.raises(DatasetError, match="is no score"):
        read_dense(tmp_path / "a.json")


def test_a_page_of_results_has_the_numbers_of_its_files(
    tiny_dataset: Path, scored: DenseScored, tmp_path: Path
) -> None:
    flat = saved_dense(scored, tmp_path / "a.json").document
    half = saved_dense(score_dense(tiny_dataset, half_right, "mjpeg", console=quiet()), tmp_path / "b.json").document
    files, page = [tmp_path / "a.json", tmp_path / "b.json"], tmp_path / "page.md"
    assert main(["dense", "show", *map(str, files), "--out", str(page)]) == 0
    text = page.read_text()
    assert write_dense_results(files[::-1], tmp_path / "again.md").read_text() == text
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line[:1] == "|"]
    heads = next(row for row in rows if row[:2] == ["method", "recall / %"])
    shown = {row[0]: dict(zip(heads, row, strict=True)) for row in rows[rows.index(heads) + 2 :][:2]}
    best, worst = sorted((flat, half), key=lambda score: -(score.metrics["recall"].value or 0.0))
    assert list(shown) == [best.method.name, worst.method.name]
    for score in (flat, half):
        for head, name in (("recall / %", "recall"), ("median error / %", "median_relative")):
            value = 100.0 * (score.metrics[name].value or 0.0)
            assert float(shown[score.method.name][head].split()[0]) == pytest.approx(value, rel=5e-3)
    assert f"| {best.method.name} - {worst.method.name} |" in text
    with pytest.raises(DatasetError, match=f"{flat.method.name} has two scores"):
        write_dense_results([files[0], files[0]], page)


def test_an_interrupted_run_goes_on(tiny_dataset: Path, methods: Path, tmp_path: Path) -> None:
    """Only pairs that have no records are asked for; other limits, or a cut file, begin anew."""
    pairs, reference = dense_pairs(open_dataset(tiny_dataset), "mjpeg"), f"{methods}:flat"
    target = tmp_path / "a.json"
    whole = run_dense([reference], pairs, console=quiet())[0]

    class Interrupted:
        """Pairs whose second one cannot be read."""

        def __getattr__(self, name: str) -> Any:
            return getattr(pairs, name)

        def __len__(self) -> int:
            return len(pairs)

        def pair(self, number: int) -> DensePair:
            if number == 1:
                raise DatasetError("sample 'b': views/b.exr cannot be read")
            return pairs.pair(number)

    with pytest.raises(DatasetError, match="cannot be read"):
        run_dense([reference], Interrupted(), console=quiet(), files=[target])  # type: ignore[arg-type]
    kept = target.with_suffix(RECORDS_SO_FAR)
    assert pl.read_parquet(kept)["number"].unique().to_list() == [0]
    said = Console(file=io.StringIO(), width=200)
    resumed = run_dense([reference], pairs, console=said, files=[target])[0]
    assert "1 of 2 pairs are those of a run that was interrupted" in said.file.getvalue()  # type: ignore[attr-defined]
    assert resumed.document.results_sha256 == whole.document.results_sha256
    whole_file = kept.read_bytes()
    for limits, data in ((RunLimits(seconds=50.0), whole_file), (RunLimits(), whole_file[: len(whole_file) // 2])):
        kept.write_bytes(data)
        said = Console(file=io.StringIO(), width=200)
        run_dense([reference], pairs, console=said, files=[target], limits=limits)
        assert "interrupted" not in said.file.getvalue()  # type: ignore[attr-defined]
    saved_dense(resumed, target)
    assert target.is_file()
    assert not kept.exists()


def test_the_command_tells_by_its_exit_code_that_every_pair_failed(
    tiny_dataset: Path, methods: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of a method that answers, `test_the_commands_of_the_seat` has the exit code 0."""
    words = ["dense", "score", str(tiny_dataset), "--preset", "mjpeg", "--pairs", "1"]
    assert main([*words, "--method", f"{methods}:small"]) == 1
    assert "1 pairs failed" in capsys.readouterr().out


def half_right(pair: DensePair) -> DenseAnswer:
    return DenseAnswer(np.full(pair.shape, 1.5))


def test_scores_of_other_pairs_do_not_compare(scored: DenseScored, tiny_dataset: Path, tmp_path: Path) -> None:
    saved_dense(scored, tmp_path / "a.json")
    saved_dense(score_dense(tiny_dataset, flat, "srgb8", console=quiet()), tmp_path / "b.json")
    with pytest.raises(DatasetError, match="different pair sets \\(presets\\)"):
        compare_dense(tmp_path / "a.json", tmp_path / "b.json")


def test_a_mirror_without_an_epipolar_curve_is_refused() -> None:
    rig = default_rig()
    require_curve(rig, 0.4, "one")
    aside = Pose("camera", "sphere", (5.0, 0.0, 0.26))
    with pytest.raises(DatasetError, match="no pixel of the down image has an epipolar curve"):
        require_curve(dataclasses.replace(rig, T_camera_sphere=aside), 0.4, "one")


# What a hostile process may send.

GOOD: dict[str, Any] = dense_answer_document(DenseAnswer(np.ones((2, 3)), sigma_depth_m=np.ones((2, 3), np.float32)))


def test_planes_come_back_with_their_types() -> None:
    answer = checked_dense_answer(json.loads(json.dumps(GOOD)), (2, 3))
    assert answer.depth_m is not None
    assert answer.sigma_depth_m is not None
    assert (answer.depth_m.dtype, answer.sigma_depth_m.dtype) == (np.float64, np.float32)
    assert len(json.dumps(dense_answer_document(DenseAnswer(np.ones((50, 60)))))) < most_bytes((50, 60))


def forged(**fields: Any) -> dict[str, Any]:
    return {"planes": {"depth_m": {**GOOD["planes"]["depth_m"], **fields}}}


@pytest.mark.parametrize(
    ("document", "words"),
    [
        ({"wrong": "the method returned None"}, "returned None"),
        ({}, "cannot be read: KeyError"),
        ({"planes": 3}, "cannot be read: TypeError"),
        ({"planes": {}}, "neither given"),
        (forged(type="O"), "is no plane of float32 or float64"),
        (forged(shape=[2, 1 << 20]), "is no plane"),
        (forged(shape=[2, 2]), "has 48 bytes"),
        (forged(shape=[2, True]), "is no plane"),
        (forged(base64="not base64!"), "cannot be read"),
        (forged(base64=base64.b64encode(np.full(6, -1.0).tobytes()).decode()), "0 or below at 6"),
        (forged(shape=[3, 2]), "Rows come first"),
    ],
)
def test_a_forged_answer_is_one_sentence(document: dict[str, Any], words: str) -> None:
    with pytest.raises(AnswerError, match=words) as caught:
        checked_dense_answer(document, (2, 3))
    assert "\n" not in str(caught.value)


# The command line.


def test_the_commands_of_the_seat(tiny_dataset: Path, methods: Path, tmp_path: Path, capsys: Any) -> None:
    out = tmp_path / "s.json"
    command = ["dense", "score", str(tiny_dataset), "--preset", "mjpeg", "--pairs", "1", "--out", str(out)]
    assert main([*command, "--method", f"{methods}:flat"]) == 0
    assert "recall" in capsys.readouterr().out
    for by in ("methods", "parts", "metrics"):
        assert main(["dense", "show", str(out), "--by", by]) == 0
        assert "mine:flat" in capsys.readouterr().out
    assert main(["dense", "compare", str(out), str(out)]) == 0
    assert "Too few samples" in capsys.readouterr().out
    assert main(["dense", "list"]) == 0
    assert main(["dense", "new", str(tmp_path / "mine.py")]) == 0
    assert "mine.py:depth" in (tmp_path / "mine.py").read_text(encoding="utf-8")
    assert main(["dense", "show"]) == 1


@pytest.mark.slow
def test_the_example_method_passes_its_check(tmp_path: Path, capsys: Any) -> None:
    """Three pairs of 12 s beside other work, in a process of its own."""
    assert main(["dense", "new", str(tmp_path / "mine.py")]) == 0
    assert main(["dense", "check", f"{tmp_path / 'mine.py'}:depth", "--seconds", "300"]) == 0
    assert "nothing wrong" in capsys.readouterr().out


def test_names_of_no_method_are_answered_with_the_seats_own_words(tmp_path: Path) -> None:
    with pytest.raises(MethodError, match=r"`phibench dense list` lists what there is\. .*my_depth\.py:depth"):
        resolve("nothing", DENSE)
    with pytest.raises(MethodError, match="`phibench dense new"):
        resolve(f"{tmp_path / 'absent.py'}:depth", DENSE)


@pytest.mark.slow
def test_the_picture_of_a_sample(tiny_dataset: Path, methods: Path, tmp_path: Path, capsys: Any) -> None:
    """Both PNGs of a method of a file; a wrong sample, method or answer is a sentence, and nothing is written."""
    command = ["dense", "picture", str(tiny_dataset), "--out", str(tmp_path / "out"), "--method"]
    for words, said in (
        ([f"{methods}:flat", "--sample", "nope"], "no sample 'nope'"),
        (["nope"], "no method 'nope'"),
        ([f"{methods}:small"], "invalid: the answer has (10, 20) pixels"),
    ):
        assert main([*command, *words]) == 2
        assert said in capsys.readouterr().err
    assert not list(tmp_path.glob("out/*.png"))
    assert main([*command, f"{methods}:flat", "--sample", "1"]) == 0
    assert sorted(file.name for file in (tmp_path / "out").iterdir()) == ["above.png", "panoramas.png"]
