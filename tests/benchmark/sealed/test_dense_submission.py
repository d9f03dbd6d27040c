"""Answers to a sealed dense set: their score is that of `dense score`, and what was changed or forged is refused."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from helpers.processes import quiet

from phibench.benchmark.dense.dense_score import run_dense
from phibench.benchmark.sealed.dense_set import DENSE_SEAL, DENSE_TRUTH, DenseSet, seal_dense_set
from phibench.benchmark.sealed.dense_submission import ANSWERS, SUBMISSION, SealedDensePairs, open_dense, submit_dense
from phibench.cli.main import main
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.store.checksums import checksums_text, read_checksums
from phibench.datasets.store.files import sha256
from phibench.datasets.store.layers import write_exr

METHODS = """
import numpy as np
from phibench.estimator.dense.dense_interface import DenseAnswer
from phibench.estimator.geometry.epipolar_line import up_image

def depths(pair):  # D by the brightness of each pixel, of this pair alone, in float64; half of the image is not known
    bright = pair.down.mean(axis=2) + pair.up.mean(axis=2)
    depth = 1.0 + bright / 200.0
    depth[:, ::2] = np.nan
    return DenseAnswer(depth_m=depth, sigma_depth_m=np.where(np.isnan(depth), np.nan, 1e-60 + bright / 1000.0))

def places(pair):  # pair 1 fails
    if pair.number == 1:
        raise ValueError("no texture in /home/somebody/secret/pair.png")
    v, u = np.mgrid[: pair.shape[0], : pair.shape[1]]
    pixels = np.stack([u, v], axis=-1).astype(float)
    return DenseAnswer(target_uv_px=up_image(pair.rig, pair.stroke_m, pixels, np.full(pair.shape, 0.4)).uv_px)
"""
NAMES = ("depths", "places")
# D is rounded to float32 by 6e-8 of itself; a place by 6e-5 px, of 1e-3 of D at the least disparity of these pairs
RELATIVE = {"depths": 1e-6, "places": 1e-3}


@pytest.fixture(scope="module")
def method(tmp_path_factory: pytest.TempPathFactory) -> str:
    file = tmp_path_factory.mktemp("methods") / "mine.py"
    file.write_text(METHODS, encoding="utf-8")
    return str(file)


@pytest.fixture(scope="module")
def true_set(dense_set: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Dense set with its truth's file, and beside it the sealed form, `public`. Read only."""
    folder = tmp_path_factory.mktemp("sealed") / "set"
    shutil.copytree(dense_set, folder)
    seal_dense_set(folder, folder.parent / "public")
    return folder


@pytest.fixture(scope="module")
def public(true_set: Path) -> Path:
    return true_set.parent / "public"


@pytest.fixture(scope="module")
def answers(public: Path, method: str, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Submission of each method. Read only."""
    folder = tmp_path_factory.mktemp("answers")
    for name in NAMES:
        submit_dense(public, f"{method}:{name}", folder / name, console=quiet())
    return {name: folder / name for name in NAMES}


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_a_submission_scores_as_the_method_does(
    name: str, answers: dict[str, Path], public: Path, true_set: Path, method: str
) -> None:
    """Metrics of answers in files and of the method on the set with truth differ by the rounding of the planes."""
    opened = open_dense(public, true_set / DENSE_TRUTH, answers[name], console=quiet()).scored
    (direct,) = run_dense([f"{method}:{name}"], DenseSet(true_set), console=quiet())
    assert opened.document.failures == direct.document.failures == ({"error": 1} if name == "places" else {})
    assert opened.document.pair_set == direct.document.pair_set  # `dense compare` takes both
    assert opened.document.method.model_dump(exclude={"reference"}) == direct.document.method.model_dump(
        exclude={"reference"}
    )
    assert opened.document.method.reference == f"mine:{name}"  # no folder of who submits
    assert opened.records["answered"].max() > 0.4  # type: ignore[operator]  # it ran
    for column, kind in opened.records.schema.items():
        one, other = opened.records[column], direct.records[column]
        if kind != pl.Float64:
            assert column == "message" or one.equals(other), column
        elif column != "seconds":
            least = 2.0 / 200  # a share of 200 pixels or more, of which two may lie at a threshold
            atol = least if column.startswith(("above", "recall", "coverage")) else 1e-6
            a, b = (x.fill_null(-1.0).to_numpy() for x in (one, other))
            np.testing.assert_allclose(a, b, rtol=RELATIVE[name], atol=atol, err_msg=column)


def test_a_submission_holds_no_folder_of_who_made_it(answers: dict[str, Path]) -> None:
    text = (answers["places"] / SUBMISSION).read_text()
    assert "no texture in pair.png" in text
    assert "somebody" not in text
    assert sorted(path.name for path in (answers["places"] / ANSWERS).iterdir()) == ["000000.exr"]


def test_the_same_command_replaces_its_answers_and_nothing_else(
    public: Path, method: str, answers: dict[str, Path], tmp_path: Path
) -> None:
    out = tmp_path / "answers"
    shutil.copytree(answers["depths"], out)
    done = submit_dense(public, f"{method}:places", out, console=quiet())
    assert (done.pairs, done.answered) == (2, 1)
    assert done.silence.startswith("error: ")
    assert set(read_checksums(out)) == {SUBMISSION, f"{ANSWERS}/000000.exr"}
    (out / "notes.txt").write_text("mine")
    with pytest.raises(DatasetError, match="holds something else: give a new folder, --out"):
        submit_dense(public, f"{method}:depths", out, console=quiet())


def _signed(folder: Path) -> None:
    """List the files of a folder anew, as who forges one does."""
    files = [path for path in folder.rglob("*") if path.is_file() and path.name != "SHA256SUMS"]
    hashes = {path.relative_to(folder).as_posix(): sha256(path) for path in files}
    (folder / "SHA256SUMS").write_text(checksums_text(hashes))


def _edited(change: Callable[[dict[str, Any]], Any]) -> Callable[[Path], None]:
    def edit(folder: Path) -> None:
        document = json.loads((folder / SUBMISSION).read_text())
        change(document)
        (folder / SUBMISSION).write_text(json.dumps(document))

    return edit


def _planes(**planes: Any) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        write_exr(folder / ANSWERS / "000001.exr", planes, {})

    return write


def _garbage(folder: Path) -> None:
    (folder / ANSWERS / "000001.exr").write_bytes(b"v/1\x01 no picture")


SMALL = np.ones((4, 4))
FORGED = {
    "another seal": (_edited(lambda d: d.update(seal="0" * 16)), "answers the seal 0000000000000000, not"),
    "another version": (_edited(lambda d: d.update(task_version=2)), "is of task version 2, the seal of 1"),
    "a pair is missing": (_edited(lambda d: d["answers"].pop()), r"lacks pair 1 \(1 of 2 are missing\)"),
    "a pair twice": (_edited(lambda d: d["answers"].append(d["answers"][0])), "answers pair 0 twice"),
    "neither": (_edited(lambda d: d["answers"][0].update(file=None)), "pair 0 is neither answered nor failed"),
    "time below 0": (_edited(lambda d: d["answers"][0].update(seconds=-1.0)), "pair 0 is neither answered nor failed"),
    "a file elsewhere": (_edited(lambda d: d["answers"][1].update(file="../x.exr")), r"answers\.1\.file"),
    "a file that is not there": (
        _edited(lambda d: d["answers"][1].update(file="answers/2.exr")),
        r"2\.exr is missing, or not the file that SHA256SUMS lists; submit again",
    ),
    "no picture": (_garbage, r"000001\.exr is damaged"),
    "other planes": (_planes(depth=SMALL), r"000001\.exr has the planes depth: depth_m, or target_u_px and"),
    "D and places": (_planes(depth_m=SMALL, target_u_px=SMALL), "has the planes depth_m, target_u_px: "),
    "many planes": (_planes(**{f"p{k}": SMALL for k in range(9)}), "it has 9 planes, at most 3"),
}


@pytest.mark.parametrize("kind", FORGED)
def test_what_is_no_submission_is_refused(
    kind: str, answers: dict[str, Path], public: Path, true_set: Path, tmp_path: Path
) -> None:
    """One sentence each, also where the list of files was made anew."""
    forge, told = FORGED[kind]
    folder = tmp_path / "forged"
    shutil.copytree(answers["depths"], folder)
    forge(folder)
    _signed(folder)
    with pytest.raises(DatasetError, match=told) as caught:
        open_dense(public, true_set / DENSE_TRUTH, folder, console=quiet())
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "planes",
    [{"depth_m": SMALL}, {"depth_m": np.full((180, 320), -1.0)}, {"target_u_px": SMALL, "target_v_px": SMALL}],
    ids=["shape", "sign", "places"],
)
def test_what_is_no_answer_counts_as_invalid(
    planes: dict[str, Any], answers: dict[str, Path], public: Path, true_set: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "forged"
    shutil.copytree(answers["depths"], folder)
    _planes(**planes)(folder)
    _signed(folder)
    opened = open_dense(public, true_set / DENSE_TRUTH, folder, console=quiet())
    assert opened.scored.document.failures == {"invalid": 1}


def test_a_changed_set_or_another_truth_is_refused(
    answers: dict[str, Path], public: Path, true_set: Path, tmp_path: Path, method: str
) -> None:
    other = tmp_path / "other"
    shutil.copytree(true_set, other / "set")
    truth = other / "set" / DENSE_TRUTH
    truth.unlink()
    with pytest.raises(DatasetError, match="is missing; give the dense"):
        open_dense(public, truth, answers["depths"], console=quiet())
    seal_dense_set(other / "set", other / "public")  # the same pairs, sealed again: another secret number
    with pytest.raises(DatasetError, match="is not the truth that was sealed"):
        open_dense(public, truth, answers["depths"], console=quiet())
    shutil.copytree(answers["depths"], other / "answers")
    (other / "answers" / "SHA256SUMS").unlink()
    with pytest.raises(DatasetError, match="SHA256SUMS is missing; submit again"):
        open_dense(public, true_set / DENSE_TRUTH, other / "answers", console=quiet())
    shutil.copytree(public, other / "unlisted", ignore=shutil.ignore_patterns("SHA256SUMS"))
    with pytest.raises(DatasetError, match="SHA256SUMS is missing; download the set again"):
        SealedDensePairs(other / "unlisted")
    shutil.copy(true_set / DENSE_TRUTH, truth)
    (other / "set" / "pairs.jsonl").write_text("")
    _signed(other / "set")
    with pytest.raises(DatasetError, match="was changed after the set was sealed"):
        open_dense(public, truth, answers["depths"], console=quiet())
    frame = other / "public" / "frames" / "000001-up.jpg"
    frame.write_bytes(frame.read_bytes()[:-1] + b"x")
    with pytest.raises(DatasetError, match=r"000001-up\.jpg was changed"):
        submit_dense(other / "public", f"{method}:depths", tmp_path / "out", console=quiet())
    _signed(other / "public")
    with pytest.raises(DatasetError, match="do not belong together, one was changed"):
        SealedDensePairs(other / "public")
    assert not (tmp_path / "out").exists()


def test_the_commands(public: Path, true_set: Path, method: str, tmp_path: Path, capsys: Any) -> None:
    out, score = tmp_path / "answers", tmp_path / "score.json"
    assert main(["seal", "submit", str(public), "--method", f"{method}:places", "--out", str(out)]) == 0
    told = capsys.readouterr().out
    assert "1 of 2 pairs answered" in told
    assert "most often without an answer: error: ValueError: no texture" in told
    truth = str(true_set / DENSE_TRUTH)
    given = ["seal", "open", str(public), "--truth", truth, "--submission", str(out), "--out", str(score)]
    assert main(given) == 0
    assert "the submission has each of 2 pairs" in capsys.readouterr().out
    assert json.loads(score.read_text())["kind"] == "phibench dense score"
    assert main(["dense", "score", str(public), "--method", f"{method}:places"]) == 2
    assert "answer it with `phibench seal submit`" in capsys.readouterr().err
    assert main(["seal", "submit", str(public), "--method", "joint_fit", "--out", str(tmp_path / "x")]) == 2
    assert (public / DENSE_SEAL).is_file()
