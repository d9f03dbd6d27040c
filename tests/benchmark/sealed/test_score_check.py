"""Check of a score that is handed in: an honest one passes, and each fault is told in a sentence."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import polars as pl
import pytest
from helpers.processes import quiet

from phibench.benchmark.pair_sets.dataset_pairs import Track, dataset_pairs
from phibench.benchmark.scores.answer_errors import Rules
from phibench.benchmark.scores.score import saved_score, score, score_outcomes, with_isolation
from phibench.benchmark.scores.score_document import MethodCard, ScoreDocument
from phibench.benchmark.scores.score_files import read_records, read_score, write_score
from phibench.benchmark.sealed.score_check import check_score, schema_text
from phibench.cli import main as cli
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.read import open_finished
from phibench.datasets.store.files import sha256
from phibench.estimator.interface import Answer, Outcome, Spot

ROOT = Path(__file__).parents[3]
CARD = MethodCard.of(
    "my_phi:extract", kind="file", place="my_phi.py", sha256="0" * 64, packages={"numpy": "2.0"}, files_complete=True
)
Change = Callable[[pl.DataFrame], pl.DataFrame]


@pytest.fixture(scope="module")
def honest(bench_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Score of answers 0.3 px beside the truth, with claims, silent on one image, with a D and an angle of its own."""
    pairs = dataset_pairs(open_finished(bench_dataset), "bayer-raw")
    claim = ((0.09, 0.02), (0.02, 0.04))

    def outcome(number: int) -> Outcome:
        truth = pairs.truth(number)
        down, up = (Spot((one.uv_px[0] + 0.3, one.uv_px[1]), claim) for one in (truth.down, truth.up))
        if number == 1:
            return Outcome(number, Answer(down, Spot.missing("not seen")), 0.01)
        own = replace(up, phi_rad=truth.up.phi_rad["normal"] + 1e-4, phi_convention="normal")
        D = 1.01 * truth.depth_m
        return Outcome(number, Answer(down, own, D, 0.02, (0.9 * D, 1.2 * D)) if number else Answer(down, up), 0.01)

    scored = score_outcomes(CARD, pairs, [outcome(number) for number in range(len(pairs))], Rules())
    path = tmp_path_factory.mktemp("handed-in") / "mine.json"
    saved_score(with_isolation(scored, "isolated: read its own folder and the packages only, without network"), path)
    return path


@pytest.mark.slow
def test_an_honest_score_has_no_fault(honest: Path, bench_dataset: Path, capsys: pytest.CaptureFixture[str]) -> None:
    checked = check_score(honest, bench_dataset)
    assert checked.faults == ()
    assert [text.split(":")[0] for text in checked.unchecked if not text.startswith("code_sha256")] == [
        "method.sha256, modules, files and packages",
        "seconds, limits, isolation and division",
        "that the data set is a released one",
    ]
    assert cli.main(["submission", "check", str(honest), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)  # the document and nothing else
    assert (document["valid"], document["faults"], document["pairs"]) == (True, [], 3)
    assert len([text for text in document["unchecked"] if not text.startswith("code_sha256")]) == 4


@pytest.mark.slow
@pytest.mark.parametrize("track", ["localise", "find"])
def test_a_score_of_a_track_is_built_again_as_that_track(bench_dataset: Path, tmp_path: Path, track: Track) -> None:
    """Boxes are the track's: called another one, the records' hints and the pair set are told."""
    pairs = dataset_pairs(open_finished(bench_dataset), "bayer-raw").of_track(track)
    answers = [Outcome(number, Answer(*2 * (Spot.missing("-"),)), 0.01) for number in range(len(pairs))]
    scored = score_outcomes(CARD, pairs, answers, Rules())
    path = tmp_path / "mine.json"
    saved_score(with_isolation(scored, "isolated: read its own folder and the packages only, without network"), path)
    assert check_score(path, bench_dataset).faults == ()
    document = read_score(path)
    other = {"localise": "find", "find": "localise"}[track]
    changed = document.model_copy(update={"pair_set": {**document.pair_set, "track": other}})
    write_score(path, changed, read_records(path, document))
    assert any("hinted" in fault for fault in check_score(path, bench_dataset).faults)
    unknown = document.model_copy(update={"pair_set": {**document.pair_set, "track": "guess"}})
    write_score(path, unknown, read_records(path, document))
    assert any("pair_set.track is 'guess'" in fault for fault in check_score(path).faults)


def _with_metric(document: ScoreDocument) -> dict[str, Any]:
    better = document.metrics["rms_px"].model_copy(update={"value": 0.1})
    return {"metrics": {**document.metrics, "rms_px": better}}


def _at_once(document: ScoreDocument) -> dict[str, Any]:
    """Faults of the document that do not hide one another."""
    wrong = {"sealed": True, "task_version": 4, "pairs": 500, "boxes_px": 64}
    return {
        "pair_set": {**document.pair_set, **wrong},
        "rules": {**document.rules, "match_px": 3.5},
        "isolation": "not isolated: no Landlock",
        "method": document.method.model_copy(update={"sha256": None}),
        "samples": 500,
    }


SENTENCES = (
    "the score is not of an open set",
    "task_version is 4, this program scores task",
    "pairs is 3 and pair_set.pairs 500",
    "rules.match_px is 3.5, and results are by 3",
    "pair_set.boxes_px is 64",
    "the method was not isolated",
    "nobody can tell which code was scored",
    "samples is 500, and the records have 3",
)


@pytest.mark.slow
def test_a_built_in_method_is_closed_and_takes_the_rig_as_it_is(honest: Path, tmp_path: Path) -> None:
    """Of a method of one's own the word stands; of a built-in one phibench knows."""
    document = read_score(honest)
    own = document.method.model_copy(update={"division": "closed", "self_calibrates": True})
    for card, told in ((own, False), (own.model_copy(update={"kind": "built-in", "division": "open"}), True)):
        path = tmp_path / "mine.json"
        write_score(path, document.model_copy(update={"method": card}), read_records(honest, document))
        assert any("method.division: built-in" in fault for fault in check_score(path).faults) is told


def test_each_fault_of_the_document_is_told(honest: Path, tmp_path: Path) -> None:
    document = read_score(honest)
    path = tmp_path / "mine.json"
    write_score(path, document.model_copy(update=_at_once(document)), read_records(honest, document))
    faults = check_score(path).faults
    assert [sentence for sentence in SENTENCES if not any(sentence in fault for fault in faults)] == []
    assert len(faults) == len(SENTENCES)


def test_statistics_are_those_of_the_records(honest: Path, tmp_path: Path) -> None:
    document = read_score(honest)
    path, changed = tmp_path / "mine.json", {"failures": {**document.failures, "crash": 2}, **_with_metric(document)}
    write_score(path, document.model_copy(update=changed), read_records(honest, document))
    faults = check_score(path).faults
    assert len(faults) == 2
    assert "metrics.rms_px.value is 0.1, and the records give 0.3" in faults[0]
    assert faults[1].startswith("failures")


def _first(table: pl.DataFrame, **values: Any) -> pl.DataFrame:
    first = pl.arange(len(table)) == 0
    return table.with_columns(**{name: pl.when(first).then(x).otherwise(pl.col(name)) for name, x in values.items()})


RECORDS: dict[str, tuple[Change, str]] = {
    "pair left out": (lambda t: t.filter(pl.col("number") != 1), "no answer for pair 1"),
    "error": (lambda t: _first(t, du_px=0.01), "records.du_px of pair 0 down is 0.01, not 0.3"),
    "found": (lambda t: t.with_columns(detected=True), "records.detected of pair 1 up"),
    "bound": (lambda t: _first(t, bound_px2=-1.0), "records.bound_px2: -1 is impossible, it is 0 or above"),
    "infinite": (lambda t: _first(t, phi_rad=float("inf")), "records.phi_rad: a number that is not finite"),
    "larger bound": (lambda t: t.with_columns(bound_px2=4.0 * pl.col("bound_px2")), "records.bound_px2 of pair 0 down"),
    "other truth": (
        lambda t: t.with_columns(u_true_px=pl.col("u_px"), du_px=0.0 * pl.col("u_px")),
        "records.u_true_px of pair 0 down",
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", list(RECORDS))
def test_a_fault_of_the_records_is_told(honest: Path, bench_dataset: Path, tmp_path: Path, name: str) -> None:
    change, sentence = RECORDS[name]
    document = read_score(honest)
    path = tmp_path / "mine.json"
    write_score(path, document, change(read_records(honest, document)))
    faults = check_score(path, bench_dataset).faults
    assert any(sentence in fault for fault in faults), faults


def test_the_data_set_is_the_releases(honest: Path, bench_dataset: Path, tmp_path: Path) -> None:
    release = tmp_path / "MANIFEST.json"
    for digest, count in ((sha256(bench_dataset / "SHA256SUMS"), 0), ("0" * 64, 1)):
        release.write_text(json.dumps({"parts": {"phibench-v4-dev": {"sums_sha256": digest}}}))
        assert len(check_score(honest, release=release).faults) == count


def test_another_version_is_one_sentence(honest: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "old.json"
    path.write_text(json.dumps({**json.loads(honest.read_text()), "version": 2}))
    assert cli.main(["submission", "check", str(path)]) == 2
    said = capsys.readouterr().err.strip()
    assert "has version 2, this program reads 6: score again" in said
    assert "\n" not in said
    path.write_text(honest.read_text())
    with pytest.raises(DatasetError, match="missing: it belongs to"):
        check_score(path)


@pytest.mark.slow
def test_a_method_that_runs_here_is_not_taken(bench_dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "here.json"
    score(bench_dataset, lambda pair: Answer(*2 * (Spot.missing("-"),)), "bayer-raw", out=out, console=quiet())
    assert any("not isolated" in fault for fault in check_score(out).faults)


def test_the_published_schema_is_that_of_the_files(honest: Path) -> None:
    """`phibench submission schema > docs/score.schema.json` writes it anew."""
    assert (ROOT / "docs" / "score.schema.json").read_text() == schema_text()
    published = json.loads(schema_text())
    assert set(published["required"]) <= set(json.loads(honest.read_text())) <= set(published["properties"])
