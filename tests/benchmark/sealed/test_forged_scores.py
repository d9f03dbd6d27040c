"""Forged scores: each attack on the results that was tried, and the column that tells it.

`check_score` builds every column again from the answers, so that what is no answer cannot be forged.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import polars as pl
import pytest
from helpers.processes import quiet

from phibench.benchmark.pair_sets.dataset_pairs import dataset_pairs
from phibench.benchmark.scores.record_columns import COLUMN_TYPES
from phibench.benchmark.scores.score import Scored, score
from phibench.benchmark.scores.score_files import read_records, read_score, write_score
from phibench.benchmark.sealed import score_check
from phibench.benchmark.sealed.rebuilt_score import GIVEN, column_differences, outcomes_of_records, score_from_records
from phibench.benchmark.sealed.score_check import check_score
from phibench.cli import main as cli
from phibench.datasets.read import open_finished

Change = Callable[[pl.DataFrame], pl.DataFrame]
METHOD = """
from phibench.estimator.interface import Answer, Spot

def extract(pair):
    if pair.number == 1:
        raise ValueError("not this one")
    claim = ((0.09, 0.02), (0.02, 0.04))
    down = Spot((150.0 + pair.number, 60.0), claim)
    up = Spot((170.25, 95.5), claim, 0.7, "normal")
    return Answer(down, up if pair.number else Spot.missing("not seen"), 2.5, 0.02, (2.4, 2.7))
"""


@dataclass(frozen=True)
class Honest:
    """A score that `phibench score` wrote, its method, and the same built again."""

    path: Path
    method: Path
    again: Scored


@pytest.fixture(scope="module")
def honest(bench_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Honest:
    folder = tmp_path_factory.mktemp("forged")
    method, path = folder / "mine.py", folder / "honest.json"
    method.write_text(METHOD)
    score(bench_dataset, f"{method}:extract", "bayer-raw", out=path, console=quiet())
    document = read_score(path)
    pairs = dataset_pairs(open_finished(bench_dataset), "bayer-raw")
    return Honest(path, method, score_from_records(document, read_records(path, document), pairs))


@pytest.fixture
def once(honest: Honest, monkeypatch: pytest.MonkeyPatch) -> None:
    """The score is not built again for each forgery whose answers are the same: it is that of the unchanged file."""
    monkeypatch.setattr(score_check, "score_from_records", lambda *arguments: honest.again)


def faults(path: Path, data: Path, **others: Any) -> tuple[str, ...]:
    return check_score(path, data, console=quiet(), **others).faults


def everywhere(**values: Any) -> Change:
    return lambda t: t.with_columns(**{k: pl.when(pl.col(k).is_not_null()).then(pl.lit(x)) for k, x in values.items()})


def the_truth_as_answers(t: pl.DataFrame) -> pl.DataFrame:
    """Errors of nothing, with what is possible made so small that no flag shows."""
    exact = dict.fromkeys(("du_px", "dv_px", "distance_px", "radial_px", "tangential_px", "phi_error_rad"), 0.0)
    possible = {"possible_position_chi2": 3.0, "possible_spot_chi2": 2.0, "possible_depth_m2": 1e-30}
    return t.with_columns(
        u_px=pl.col("u_true_px"),
        v_px=pl.col("v_true_px"),
        phi_rad=pl.col("phi_true_rad"),
        depth_estimate_m=pl.col("depth_m"),
        depth_from=pl.lit("pixels"),
        **{name: pl.lit(value) for name, value in {**exact, **possible}.items()},
    )


FORGERIES: dict[str, tuple[Change, str]] = {
    "rank of phi": (everywhere(rank_phi2_rad2=1e-12), "records.rank_phi2_rad2"),
    "relative error of D": (everywhere(depth_relative=1e-6, depth_error_m=1e-6), "records.depth_error_m"),
    "rank of D": (everywhere(rank_depth2=1e-12, depth_counted=1e-6), "records.rank_depth2"),
    "pulls": (everywhere(pull_u=1.0, pull_v=-1.0, mahalanobis2=2.0), "records.pull_u"),
    "cause": (everywhere(cause="occluded", kind="unseen"), "records.cause"),
}


def forged(honest: Honest, path: Path, change: Change) -> Path:
    """The score with changed records; its statistics are looked at where no column is wrong."""
    document = read_score(honest.path)
    write_score(path, document, change(read_records(honest.path, document)))
    return path


@pytest.mark.usefixtures("once")
@pytest.mark.parametrize("name", FORGERIES)
def test_a_forgery_is_told_by_its_column(honest: Honest, bench_dataset: Path, tmp_path: Path, name: str) -> None:
    change, sentence = FORGERIES[name]
    told = faults(forged(honest, tmp_path / "mine.json", change), bench_dataset)
    assert any(text.startswith(sentence) for text in told), told


@pytest.mark.slow
def test_the_truth_as_answers_does_not_hide_what_is_possible(
    honest: Honest, bench_dataset: Path, tmp_path: Path
) -> None:
    told = faults(forged(honest, tmp_path / "mine.json", the_truth_as_answers), bench_dataset)
    for name in ("possible_position_chi2", "possible_spot_chi2", "possible_depth_m2", "depth_sigma_m"):
        assert any(text.startswith(f"records.{name}") for text in told), told


ANSWERS = {
    *("u_px", "v_px", "claimed_uu_px2", "claimed_uv_px2", "claimed_vv_px2", "phi_from", "phi_rad", "phi_convention"),
    *("status", "failure", "depth_from", "depth_estimate_m", "claimed_sigma_m", "claimed_low_m", "claimed_high_m"),
}
OTHERS = sorted({*COLUMN_TYPES, "kind", "cause", "taken_for"} - ANSWERS - set(GIVEN))


def other(values: pl.Series) -> pl.Series:
    """Column with one value changed, of the first row that has one."""
    place = next((i for i, x in enumerate(values) if x is not None), 0)
    old, kind = values[place], values.dtype
    new = not old if kind == pl.Boolean() else "other" if kind == pl.String() else (old or 0) * 1.01 + 1
    return pl.Series(values.name, [int(new) if kind == pl.Int64() and i == place else new if i == place else x
                                   for i, x in enumerate(values)], kind)  # fmt: skip


@pytest.mark.slow
@pytest.mark.usefixtures("once")
def test_every_column_that_is_no_answer_is_compared(honest: Honest, bench_dataset: Path, tmp_path: Path) -> None:
    table = read_records(honest.path, read_score(honest.path))
    assert faults(forged(honest, tmp_path / "mine.json", lambda same: same), bench_dataset) == ()
    right = honest.again.records
    names = [name for name in right.columns if name not in GIVEN]
    assert set(OTHERS) <= set(names)
    for name in OTHERS:
        told = list(column_differences(table.with_columns(other(table[name])), right, names, "what the data give"))
        assert [text.split(" ")[0] for text in told] == [f"records.{name}"]
    assert len(OTHERS) > 70


def test_answers_come_back_out_of_the_records(honest: Honest) -> None:
    table = read_records(honest.path, read_score(honest.path))
    first, failed, last = outcomes_of_records(table)
    assert (failed.answer, failed.failure) == (None, "error")
    assert first.answer is not None
    assert last.answer is not None
    assert (first.answer.down.uv_px, first.answer.up.status) == ((150.0, 60.0), "not seen")
    assert (first.answer.depth_m, first.answer.sigma_depth_m, first.answer.interval_depth_m) == (2.5, 0.02, (2.4, 2.7))
    assert last.answer.up.covariance_px2 == ((0.09, 0.02), (0.02, 0.04))
    assert (last.answer.up.phi_rad, last.answer.up.phi_convention) == (0.7, "normal")
    assert honest.again.records.equals(table)


@pytest.mark.slow
@pytest.mark.usefixtures("once")
def test_parts_of_the_document_that_no_record_holds(honest: Honest, bench_dataset: Path, tmp_path: Path) -> None:
    document = read_score(honest.path)
    worst, pair_set = document.worst, document.pair_set
    changes: dict[str, dict[str, Any]] = {
        "worst.0.sample_id": {"worst": [worst[0].model_copy(update={"sample_id": "else"}), *worst[1:]]},
        "worst.0.crop": {"worst": [worst[0].model_copy(update={"crop": worst[1].crop}), *worst[1:]]},
        "pair_set.recipe_sha256": {"pair_set": {**pair_set, "recipe_sha256": "0" * 64}},
        "light": {"light": {"shift_px": None, "depth_m": None}},
        "results_sha256": {"results_sha256": "0" * 64},
    }
    for words, change in changes.items():
        write_score(tmp_path / "mine.json", document.model_copy(update=change), honest.again.records)
        told = faults(tmp_path / "mine.json", bench_dataset)
        assert [text for text in told if not text.startswith(words)] == []
        assert told, words


# -- the method ------------------------------------------------------------------------------------------------


def test_the_method_is_run_again(honest: Honest, bench_dataset: Path, tmp_path: Path) -> None:
    reference = f"{honest.method}:extract"
    checked = check_score(honest.path, bench_dataset, method=reference, console=quiet())
    assert checked.faults == ()
    assert not [text for text in checked.unchecked if text.startswith("method")]
    document = read_score(honest.path)
    assert document.method.packages["numpy"]
    # other code under the same name, and a file of weights that the score does not tell of
    (tmp_path / "weights.bin").write_bytes(b"1 2 3")
    other_code = METHOD.replace("150.0", "151.0").replace(
        "def extract", "from pathlib import Path\n(Path(__file__).parent / 'weights.bin').read_bytes()\n\ndef extract"
    )
    (tmp_path / "mine.py").write_text(other_code)
    told = faults(honest.path, bench_dataset, method=f"{tmp_path / 'mine.py'}:extract")
    assert "method.sha256 is" in told[0]
    assert any(text.startswith("records.u_px of pair 0 down is 150, not 151") for text in told)
    assert any("method.files: the method alone has weights.bin" in text for text in told)


def test_what_a_score_says_of_its_method_has_a_form(honest: Honest, tmp_path: Path) -> None:
    document = read_score(honest.path)
    wrong = {"packages": {"scipy": "1.0"}, "files": {"a.onnx": "x", "b.onnx": None}, "files_complete": False}
    card = document.method.model_copy(update=wrong)
    write_score(tmp_path / "mine.json", document.model_copy(update={"method": card}), honest.again.records)
    checked = check_score(tmp_path / "mine.json", console=quiet())
    assert [text.split(",")[0] for text in checked.faults] == [
        "method: the hash of a.onnx is no SHA-256",
        "method.packages lacks numpy",
    ]
    assert "method.files.b.onnx: it has no hash" in checked.unchecked
    assert "method.files: the system did not tell every file that was opened" in checked.unchecked


@pytest.mark.slow
def test_the_code_is_that_of_the_program(honest: Honest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("phibench.benchmark.sealed.rebuilt_score.program_version", lambda: "phibench 0.2.0")
    document = read_score(honest.path).model_copy(update={"program": "phibench 0.2.0"})
    for changes, count in (({}, 0), ({"code_sha256": "0" * 64}, 1)):
        write_score(tmp_path / "mine.json", document.model_copy(update=changes), honest.again.records)
        told = check_score(tmp_path / "mine.json", console=quiet()).faults
        assert len([text for text in told if text.startswith("code_sha256 is not that of phibench 0.2.0")]) == count


def test_the_command_runs_the_method_again(
    honest: Honest, bench_dataset: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    (tmp_path / "mine.py").write_text(METHOD.replace("60.0", "61.0"))
    call = ["submission", "check", str(honest.path), "--method", f"{tmp_path / 'mine.py'}:extract"]
    assert cli.main(call) == 1
    assert "method.sha256 is" in capsys.readouterr().out
