"""Dense sets: pairs and truth as of the data set, their sealed form, and the parts of a release made of them."""

from __future__ import annotations

import hashlib
import json
import shutil
import stat
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.sealed_sets import SECRET_SEED, with_secret_seed
from helpers.small_release import ask, part_of, snapshot

from phibench.benchmark.dense.dense_records import TruthErrors
from phibench.benchmark.pair_sets.dataset_pairs import dataset_pairs
from phibench.benchmark.release.release_make import release
from phibench.benchmark.sealed.dense_set import (
    DENSE_SEAL,
    DENSE_TRUTH,
    PLANES,
    DenseSet,
    first_pairs,
    pairs_of_sealed,
    seal_dense_set,
    write_dense_set,
)
from phibench.benchmark.sealed.sealed_set import seal, single_pairs
from phibench.cli.main import main
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.read import Dataset, open_finished
from phibench.datasets.recipe.load import with_numbers
from phibench.datasets.recipe.tables import FramesTable
from phibench.datasets.store.checksums import checksums_text, differing_files, read_checksums
from phibench.datasets.store.files import sha256
from phibench.datasets.store.layers import read_exr

KINDS = part_of("kinds", "tiny_kinds.toml", "pairs")
FRAMES = FramesTable(presets=["srgb8", "mjpeg"], laser_off=True).model_dump(mode="json")


def test_pairs_and_truth_are_those_of_the_data_set(dense_set: Path, kinds_dataset: Path) -> None:
    """Images byte for byte. D is rounded to float32, to 6e-8 of itself; places follow by 1e-5 px."""
    pairs, read = first_pairs(open_finished(kinds_dataset), 2), DenseSet(dense_set)
    assert len(pairs) == len(read) == 2
    assert {pairs.truth(k).sample_id for k in (0, 1)} == {row.sample_id for row in pairs.dataset.rows[:2]}
    for number in (0, 1):
        (one, other), (truth, held) = (
            (pairs.pair(number), read.pair(number)),
            (pairs.truth(number), read.truth(number)),
        )
        for name in ("down", "up"):
            assert np.array_equal(getattr(one, name), getattr(other, name))
        assert (one.rig, one.stroke_m, one.card) == (other.rig, other.stroke_m, other.card)
        assert np.array_equal(truth.found.cause, held.found.cause)
        assert np.array_equal(truth.found.glossy, held.found.glossy)
        np.testing.assert_allclose(held.depth_m, truth.depth_m, rtol=6e-8, equal_nan=True)
        np.testing.assert_allclose(held.found.uv_px, truth.found.uv_px, atol=1e-4, equal_nan=True)
        np.testing.assert_allclose(held.texture, truth.texture, rtol=4e-3)  # half of 1 / 256 of a mantissa from 0.5
        assert [truth.found.cause_name(code) for code in np.unique(truth.found.cause)] == [
            held.found.cause_name(code) for code in np.unique(held.found.cause)
        ]
        errors = TruthErrors(held)
        assert np.nanmax(np.abs(errors.calibration[held.scored])) < 1e-9  # the truth agrees with itself in float64


def test_a_set_is_kept_whole_and_damage_is_told(dense_set: Path, kinds_dataset: Path, tmp_path: Path) -> None:
    before = snapshot(dense_set)
    write_dense_set(first_pairs(open_finished(kinds_dataset), 2), dense_set)
    assert snapshot(dense_set) == before
    assert differing_files(dense_set, read_checksums(dense_set)) == []
    assert set(read_exr(dense_set / "truth" / "000000.exr").planes) == set(PLANES)
    copy = tmp_path / "copy"
    shutil.copytree(dense_set, copy)
    (copy / "truth" / "000001.exr").write_bytes(b"nothing")
    with pytest.raises(DatasetError, match=r"truth/000001\.exr was changed"):
        DenseSet(copy).truth(1)
    (copy / "mine.txt").write_text("mine")
    with pytest.raises(DatasetError, match="holds something else"):
        write_dense_set(first_pairs(open_finished(kinds_dataset), 2), copy)


def test_verify_takes_dense_sets_and_their_sealed_form(
    dense_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Every file but that of the secret is listed; a flipped bit and a stray file are faults."""
    folder = tmp_path / "set"
    shutil.copytree(dense_set, folder)
    public = seal_dense_set(folder, tmp_path / "public")
    for whole in (folder, public):
        assert main(["dataset", "verify", str(whole)]) == 0
    damaged = public / "frames" / "000001-up.jpg"
    damaged.write_bytes(damaged.read_bytes()[:-1] + b"x")
    (public / "mine.txt").write_text("mine")
    capsys.readouterr()
    assert main(["dataset", "verify", str(public)]) == 1
    told = capsys.readouterr().out
    assert "frames/000001-up.jpg" in told
    assert "mine.txt is not of the export" in told
    assert "2 faults" in told


def test_a_data_set_in_one_room_is_refused(tiny_dataset: Path) -> None:
    for choose in (first_pairs, pairs_of_sealed):
        with pytest.raises(DatasetError, match="has no rooms of its own: a dense set needs a recipe with"):
            choose(open_finished(tiny_dataset), 2)


def _framed(folder: Path) -> Dataset:
    """Data set with frames of two presets in its recipe, as a test set has them."""
    dataset = open_finished(folder)
    return replace(dataset, info=dataset.info.model_copy(update={"recipe": dataset.info.recipe | {"frames": FRAMES}}))


def test_the_sealed_form_tells_no_truth_and_shows_no_new_frame(kinds_dataset: Path, tmp_path: Path) -> None:
    dataset = _framed(kinds_dataset)
    pairs, all_sealed = pairs_of_sealed(dataset, 3), single_pairs(dataset_pairs(dataset))
    shown = {(draw.sample_id, draw.draw) for draw in all_sealed.pair_draws if draw.preset == "mjpeg"}
    assert {(draw.sample_id, draw.draw) for draw in pairs.pair_draws} == shown
    folder = write_dense_set(pairs, tmp_path / "set")
    public = seal_dense_set(folder, tmp_path / "public")
    frames = {path.read_bytes() for path in (public / "frames").iterdir()}
    of_spots = [all_sealed.pair_and_frames(k)[1].by_name for k in range(len(all_sealed))]
    assert frames <= {each[name].jpeg for each in of_spots for name in ("down_off", "up_off")}
    line = json.loads((public / "pairs.jsonl").read_text().splitlines()[0])
    assert set(line) == {"number", "files", "stroke_m", "rig", "card", "box_down", "box_up", "beam"}
    assert {path.name for path in public.iterdir()} == {"pairs.jsonl", "frames", DENSE_SEAL, "SHA256SUMS"}
    told = (folder / DENSE_TRUTH).read_bytes()
    assert stat.S_IMODE((folder / DENSE_TRUTH).stat().st_mode) == 0o600
    assert json.loads((public / DENSE_SEAL).read_text())["truth_sha256"] == hashlib.sha256(told).hexdigest()
    assert json.loads(told)["sums_sha256"] == hashlib.sha256((folder / "SHA256SUMS").read_bytes()).hexdigest()
    assert differing_files(public, read_checksums(public)) == []
    with pytest.raises(DatasetError, match="is sealed and holds no truth"):
        DenseSet(public)


def _with_frames(folder: Path, recipe: str) -> None:
    """Give a data set a recipe with frames, as making it again would."""
    document = json.loads((folder / "dataset.json").read_text())
    document["recipe"]["frames"] = FRAMES
    (folder / "dataset.json").write_text(json.dumps(document, indent=1) + "\n")
    (folder / "recipe.toml").write_text(with_numbers(recipe, "hidden", None, SECRET_SEED))
    listed = read_checksums(folder) | {name: sha256(folder / name) for name in ("dataset.json", "recipe.toml")}
    (folder / "SHA256SUMS").write_text(checksums_text(listed))


@pytest.mark.usefixtures("inline")
def test_parts_of_a_release_are_dense_sets(kinds_dataset: Path, tmp_path: Path) -> None:
    """The open part shows what `--use` gives. The sealed one shows the work folder's data set of the secret seed."""
    work = tmp_path / "work"
    work.mkdir()
    recipe = tmp_path / "hidden.toml"
    recipe.write_text(KINDS.text() + '\n[frames]\npresets = ["mjpeg"]\n', encoding="utf-8")
    open_part = replace(KINDS, name="dense-dev", kind="dense", source="kinds")
    hidden = replace(part_of("dense-test", str(recipe), "sealed-dense"), source="hidden")
    _with_frames(with_secret_seed(kinds_dataset, work / "phibench-v4-hidden"), recipe.read_text())
    (tmp_path / "seed").write_text(f"{SECRET_SEED}\n")
    (tmp_path / "seed").chmod(0o600)
    made = release(ask(tmp_path, [open_part, hidden], use=[kinds_dataset]), seal)
    parts = made.manifest.parts
    assert {name: (part.kind, part.count_text) for name, part in parts.items()} == {
        "phibench-v4-dense-dev": ("dense", "3"),
        "phibench-v4-dense-test": ("sealed-dense", "2 of 3"),  # samples that are dealt MJPEG, of two presets
    }
    assert parts["phibench-v4-dense-dev"].files == 3 * 3 + 3  # two images and planes a pair; index, description, list
    assert parts["phibench-v4-dense-test"].files == 2 * 2 + 3
    assert differing_files(made.out, read_checksums(made.out)) == []


def test_the_command_scores_a_dense_set(dense_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    method = tmp_path / "mine.py"
    method.write_text(
        "import numpy as np\nfrom phibench.estimator.dense.dense_interface import DenseAnswer\n\n"
        "def depth(pair):\n    return DenseAnswer(np.full(pair.shape, 2.0))\n"
    )
    out = tmp_path / "score.json"
    assert main(["dense", "score", str(dense_set), "--method", f"{method}:depth", "--out", str(out)]) == 0
    assert json.loads(out.read_text())["pairs"] == 2
    assert main(["dense", "score", str(dense_set), "--preset", "srgb8", "--method", f"{method}:depth"]) == 2
    assert "holds frames that are drawn: leave --preset" in capsys.readouterr().err
