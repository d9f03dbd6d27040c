"""Sealed sets: the public folder tells no truth, and whatever is tampered with is refused in one sentence."""

from __future__ import annotations

import hashlib
import json
import math
import shutil
import stat
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.bench_samples import hidden
from helpers.processes import quiet
from helpers.sealed_sets import refusal, tampered
from PIL import Image

from phibench.benchmark.pair_sets.dataset_pairs import dataset_pairs
from phibench.benchmark.pair_sets.frames_set import TruthRow, truth_document, truth_of
from phibench.benchmark.reports.bench import open_in_browser
from phibench.benchmark.scores.score_files import read_score
from phibench.benchmark.sealed.sealed_set import (
    Sealed,
    board_warnings,
    check_seed,
    earlier_warnings,
    seal,
    sequence_warnings,
    single_pairs,
)
from phibench.benchmark.sealed.submission import SealedPairs, submit
from phibench.cli import main as cli
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.read import open_dataset
from phibench.datasets.recipe.load import load_recipe
from phibench.datasets.recipe.tables import Recipe
from phibench.estimator.pair_set import PairTruth
from phibench.scenes.laser import Beam


@pytest.fixture
def copy(sealed: Sealed, tmp_path: Path) -> Path:
    return shutil.copytree(sealed.public, tmp_path / "public")


# What goes out


def test_the_public_pairs_are_the_pairs(secret_dataset: Path, sealed: Sealed) -> None:
    here, there = single_pairs(dataset_pairs(open_dataset(secret_dataset))), SealedPairs(sealed.public)
    assert len(here) == len(there) == 3
    for i in range(3):
        ours, theirs = here.pair(i), there.pair(i)
        assert set(ours.images) == set(theirs.images)
        for name, image in ours.images.items():
            assert image.dtype == theirs.images[name].dtype
            assert np.array_equal(image, theirs.images[name]), (i, name)
            assert not theirs.images[name].flags.writeable
        assert (ours.rig, ours.stroke_m, ours.card) == (theirs.rig, theirs.stroke_m, theirs.card)
        assert (ours.box_down, ours.box_up) == (theirs.box_down, theirs.box_up)
        assert ours.beam == theirs.beam == Beam()


def digits(value: float) -> list[str]:
    """Seven digits or more of a number, as decimal texts would show them; none of what is not a measured number."""
    if not math.isfinite(value) or value == round(value, 3):
        return []
    if abs(value) >= 1.0:
        return [f"{abs(value):.12f}"[:8]]
    scientific = f"{abs(value):.12e}"
    return [scientific[:8], scientific.replace(".", "")[:7]]


def secrets_of(truth: PairTruth) -> list[list[str]]:
    """Texts of the numbers of a pair's truth but rig and stroke, which are public, and of its sample's name."""
    numbers: list[float] = [truth.depth_m]
    for spot in (truth.down, truth.up):
        numbers += [*spot.uv_px, *spot.phi_rad.values(), spot.azimuth_rad, spot.electrons, spot.peak_e, spot.snr]
        numbers += [x for light in spot.distractions for x in (*light.uv_px, light.electrons)]
        numbers += [] if spot.raw_bound_px2 is None else spot.raw_bound_px2.ravel().tolist()
    return [[truth.sample_id], *(texts for number in numbers if (texts := digits(number)))]


def test_no_public_file_holds_a_number_of_the_truth(secret_dataset: Path, sealed: Sealed) -> None:
    """Chance: 7 digits of 100 numbers in the 150 hexadecimal digits that the salt makes random, 1e-4."""
    pairs = single_pairs(dataset_pairs(open_dataset(secret_dataset)))
    secret = {tuple(texts) for i in range(3) for texts in secrets_of(pairs.truth(i))}
    assert len(secret) > 50
    checked = 0
    for path in sealed.public.rglob("*"):
        if path.is_file():
            content = path.read_bytes()
            assert [text for texts in secret for text in texts if text.encode() in content] == [], path.name
            checked += 1
    assert checked == 15
    assert stat.S_IMODE(sealed.truth_file.stat().st_mode) == 0o600
    found = sealed.truth_file.read_text()
    assert [texts for texts in secret if not any(text in found for text in texts)] == []  # it finds them where they are


def test_no_name_says_what_it_is_of(secret_dataset: Path, sealed: Sealed) -> None:
    words = {word for row in open_dataset(secret_dataset).rows for word in (row.sample_id, row.target, "tinybench")}
    for path in sealed.public.rglob("*"):
        assert not any(word in path.name for word in words)
    text = (sealed.public / "pairs.jsonl").read_text() + (sealed.public / "seal.json").read_text()
    assert not any(f'"{word}' in text for word in words)


def test_images_hold_pixels_and_nothing_else(sealed: Sealed) -> None:
    files = sorted((sealed.public / "frames").iterdir())
    assert len(files) == 12
    assert {path.suffix for path in files} == {".png", ".jpg"}
    for path in files:
        with Image.open(path) as image:
            assert set(image.info) <= {"jfif", "jfif_version", "jfif_unit", "jfif_density"}
            assert len(image.getexif()) == 0
        if path.suffix == ".png":
            assert png_chunks(path.read_bytes()) <= {b"IHDR", b"IDAT", b"IEND"}
        else:
            assert b"\xff\xfe" not in path.read_bytes()[:20]  # no comment


def png_chunks(data: bytes) -> set[bytes]:
    kinds, at = set(), 8
    while at < len(data):
        kinds.add(data[at + 4 : at + 8])
        at += 12 + int.from_bytes(data[at : at + 4], "big")
    return kinds


def test_times_of_files_are_all_the_same(sealed: Sealed) -> None:
    assert {path.stat().st_mtime for path in (sealed.public, *sealed.public.rglob("*"))} == {315532800.0}


def test_the_sums_are_of_every_file(sealed: Sealed) -> None:
    lines = (line.split("  ") for line in (sealed.public / "SHA256SUMS").read_text().splitlines())
    listed = {name: digest for digest, name in lines}
    files = {p.relative_to(sealed.public).as_posix() for p in sealed.public.rglob("*") if p.is_file()} - {"SHA256SUMS"}
    assert set(listed) == files
    for name, digest in listed.items():
        assert hashlib.sha256((sealed.public / name).read_bytes()).hexdigest() == digest


def test_the_salt_makes_every_seal_another(secret_dataset: Path, sealed: Sealed, tmp_path: Path) -> None:
    again = seal(shutil.copytree(secret_dataset, tmp_path / "set"), tmp_path / "public", console=quiet())
    assert again.seal.public_sha256 == sealed.seal.public_sha256  # the same frames to the byte
    assert again.seal.truth_sha256 != sealed.seal.truth_sha256
    salts = {json.loads(one.truth_file.read_text())["salt"] for one in (again, sealed)}
    assert len(salts) == 2
    assert all(len(bytes.fromhex(salt)) == 32 for salt in salts)
    assert not any(salt in path.read_text() for salt in salts for path in sealed.public.glob("*.json*"))


def test_a_sealed_set_has_no_truth(sealed: Sealed) -> None:
    with pytest.raises(DatasetError, match="is sealed, the truth of pair 2 is not in it"):
        SealedPairs(sealed.public).truth(2)
    with pytest.raises(DatasetError, match="pair 3: there are 3"):
        SealedPairs(sealed.public).pair(3)


@pytest.mark.slow
def test_truth_survives_its_file_to_the_bit(secret_dataset: Path) -> None:
    pairs = dataset_pairs(hidden(open_dataset(secret_dataset), "up"))
    for i in range(len(pairs)):
        truth = pairs.truth(i)
        document = json.loads(json.dumps(truth_document(truth), allow_nan=False))
        again = truth_of(TruthRow.model_validate(document))
        assert truth_document(again) == truth_document(truth)
        assert again.true_rig == truth.true_rig
        for spot, other in ((truth.down, again.down), (truth.up, again.up)):
            assert (spot.uv_px, spot.phi_rad, spot.distractions) == (other.uv_px, other.phi_rad, other.distractions)
            assert np.array_equal(np.array(spot.raw_bound_px2), np.array(other.raw_bound_px2))


def test_truth_of_version_1_is_read(secret_dataset: Path) -> None:
    """Version 1 said "believed" for "nominal"."""
    truth = dataset_pairs(open_dataset(secret_dataset)).truth(0)
    document = truth_document(truth)
    old = {name.replace("nominal", "believed"): value for name, value in document.items()}
    assert {"believed_rig", "believed_stroke_m"} <= set(old)
    assert truth_document(truth_of(TruthRow.model_validate(old))) == document


@pytest.mark.parametrize("seed", [0, 1, 123456, 2**63 - 1, 2**127, 2**128 - 1])
def test_a_set_with_a_seed_that_can_be_found_is_not_sealed(seed: int, secret_dataset: Path) -> None:
    with pytest.raises(DatasetError, match=r"shorter than 128 bits.*--secret-seed FILE") as caught:
        check_seed(Path("mine"), seed)
    assert seed < 10 or str(seed) not in str(caught.value)
    check_seed(secret_dataset, open_dataset(secret_dataset).recipe.dataset.seed)


def test_a_refused_set_leaves_nothing_behind(tiny_dataset: Path, tmp_path: Path) -> None:
    tokens = ["seal", "make", str(tiny_dataset), "--out", str(tmp_path / "public")]
    assert cli.main(tokens) == 2
    assert list(tmp_path.iterdir()) == []


def test_a_sealed_set_shows_each_sample_once(secret_dataset: Path, sealed: Sealed) -> None:
    """The attack of issue 13: a cache keyed by the rig averages over presets and draws. Here it never hits."""
    public = SealedPairs(sealed.public)
    keys = [(pair.rig, pair.stroke_m) for pair in map(public.pair, range(len(public)))]
    assert len(set(keys)) == len(keys) == 3
    dataset = open_dataset(secret_dataset)
    for preset, draws in ((None, 1), (None, 4), ("mjpeg", 3)):
        everything = dataset_pairs(dataset, preset, draws)
        chosen = single_pairs(everything).pair_draws
        assert len(everything) > len(chosen) == 3
        assert len({one.sample_id for one in chosen}) == 3
        # presets are dealt out evenly, and numbers say nothing of what was left out
        assert len({one.preset for one in chosen}) == (3 if preset is None else 1)
        assert [one.number for one in chosen] == [0, 1, 2]
        places = {(d.sample_id, d.preset, d.draw): d.number for d in everything.pair_draws}
        drawn = [places[one.sample_id, one.preset, one.draw] for one in chosen]
        assert drawn == sorted(drawn)


def test_a_second_seal_of_the_same_samples_is_warned_of(tmp_path: Path) -> None:
    assert earlier_warnings(tmp_path) == ()
    (tmp_path / "seal_0123456789abcdef.truth.json").write_text("{}")
    [warning] = earlier_warnings(tmp_path)
    assert "was sealed before (seal_0123456789abcdef)" in warning


def test_boards_that_everybody_knows_are_warned_of() -> None:
    shipped = load_recipe("random")
    [warning] = board_warnings("random", shipped)
    assert "where the shipped recipe 'random' puts them" in warning
    moved = tuple(one.model_copy(update={"depth_m": 1.01 * one.depth_m}) for one in shipped.targets)
    assert board_warnings("random", shipped.model_copy(update={"targets": moved})) == ()
    assert board_warnings("mine", shipped) == ()
    assert board_warnings("bench-test", load_recipe("bench-test")) == ()  # rooms without boards


def test_a_set_of_the_old_kind_is_read_and_says_what_it_is(
    sealed: Sealed, submitted: Path, copy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert SealedPairs(sealed.public).note == ""
    document = json.loads((copy / "seal.json").read_text())
    before = hashlib.sha256((copy / "seal.json").read_bytes()).hexdigest()
    (copy / "seal.json").write_text(json.dumps({**document, "task_version": 3}))
    sums = copy / "SHA256SUMS"
    sums.write_text(sums.read_text().replace(before, hashlib.sha256((copy / "seal.json").read_bytes()).hexdigest()))
    old = tampered(lambda d: d.update(task_version=3), submitted, tmp_path / "old.json")
    words = ["seal", "open", str(copy), "--truth", str(sealed.truth_file), "--submission", str(old)]
    assert cli.main(words) == 0
    assert "note: this set was sealed for task version 3, when a set could show" in capsys.readouterr().err


def test_samples_of_a_sobol_sequence_are_warned_of(secret_dataset: Path) -> None:
    recipe = open_dataset(secret_dataset).recipe
    assert recipe.random is not None
    [warning] = sequence_warnings(with_random(recipe, "sobol"))
    assert 'sequence = "independent"' in warning
    assert sequence_warnings(with_random(recipe, "independent")) == ()
    assert sequence_warnings(recipe.model_copy(update={"random": None})) == ()
    shipped = load_recipe("bench-test").random
    assert shipped is not None
    assert shipped.sequence == "independent"


def with_random(recipe: Recipe, sequence: str) -> Recipe:
    assert recipe.random is not None
    return recipe.model_copy(update={"random": recipe.random.model_copy(update={"sequence": sequence})})


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(bytes(data))


def test_a_changed_frame_is_refused(sealed: Sealed, submitted: Path, method: str, copy: Path, tmp_path: Path) -> None:
    frame = sorted((copy / "frames").iterdir())[7]
    flip(frame)
    assert f"{frame.name} was changed" in refusal(copy, sealed.truth_file, submitted)
    with pytest.raises(DatasetError, match=f"{frame.name} was changed"):
        submit(copy, method, tmp_path / "s.json")
    with pytest.raises(DatasetError, match=f"{frame.name} was changed"):
        SealedPairs(copy).pair(int(frame.name[:6]))


def test_a_frame_changed_with_its_hash_is_refused(sealed: Sealed, submitted: Path, copy: Path) -> None:
    frame = sorted((copy / "frames").iterdir())[0]
    before = hashlib.sha256(frame.read_bytes()).hexdigest()
    flip(frame)
    sums = copy / "SHA256SUMS"
    sums.write_text(sums.read_text().replace(before, hashlib.sha256(frame.read_bytes()).hexdigest()))
    assert "do not belong together" in refusal(copy, sealed.truth_file, submitted)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda c: (c / "seal.json").unlink(), "is no sealed set"),
        (lambda c: (c / "SHA256SUMS").unlink(), "is missing"),
        (lambda c: (c / "seal.json").write_text("{"), "seal.json is damaged"),
        (lambda c: flip(c / "pairs.jsonl"), "pairs.jsonl was changed"),
        (lambda c: next((c / "frames").iterdir()).unlink(), "is missing"),
        (lambda c: (c / "frames" / "note.png").write_bytes(b"x"), "is not of the set"),
    ],
)
def test_a_spoiled_set_is_refused(sealed: Sealed, submitted: Path, copy: Path, spoil: Any, words: str) -> None:
    spoil(copy)
    assert words in refusal(copy, sealed.truth_file, submitted)


def test_a_folder_that_will_not_do_is_refused(secret_dataset: Path, tmp_path: Path) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "x").write_text("x")
    for out, words in ((tmp_path / "full", "not an empty folder"), (secret_dataset / "public", "lies inside")):
        with pytest.raises(DatasetError, match=words):
            seal(secret_dataset, out, console=quiet())
    assert not list(secret_dataset.glob("seal_*"))


def test_an_interrupted_seal_leaves_nothing(
    secret_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copy = shutil.copytree(secret_dataset, tmp_path / "set")

    def fail(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("phibench.benchmark.sealed.sealed_set.truth_text", fail)
    with pytest.raises(KeyboardInterrupt):
        seal(copy, tmp_path / "public", "bayer-raw", quiet())
    assert [path.name for path in tmp_path.iterdir()] == ["set"]
    assert not list(copy.glob("seal_*"))


# Command line


def test_the_commands_say_what_they_did(
    sealed: Sealed, method: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, score = tmp_path / "s.json", tmp_path / "score.json"
    assert cli.main(["seal", "submit", str(sealed.public), "--method", method, "--out", str(out)]) == 0
    words = ["seal", "open", str(sealed.public), "--truth", str(sealed.truth_file), "--submission", str(out)]
    assert cli.main([*words, "--out", str(score)]) == 0
    said = capsys.readouterr().out
    assert "2 of 3 pairs answered" in said
    assert "the truth is the sealed one" in said
    assert "mine:extract" in said
    document = read_score(score)
    assert (document.pairs, document.failures["error"], document.method.place) == (3, 1, "mine.py")
    assert not open_in_browser(score)  # no terminal here


def test_seal_on_the_command_line(secret_dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    copy = shutil.copytree(secret_dataset, tmp_path / "set")
    tokens = ["seal", "make", str(copy), "--out", str(tmp_path / "public"), "--preset", "mjpeg"]
    assert cli.main(tokens) == 0
    said = capsys.readouterr()
    assert "warning: the boards" not in said.err
    assert "3 pairs, seal" in said.out
    assert "shipped recipe" not in said.err
    assert len(list(copy.glob("seal_*.truth.json"))) == 1
    assert cli.main(tokens) == 2
    assert "not an empty folder" in capsys.readouterr().err
