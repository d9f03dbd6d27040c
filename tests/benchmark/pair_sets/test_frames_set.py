"""Frames sets against the data set that their frames come from: the same pairs, truths and records, to the bit."""

import json
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import phibench
from phibench.benchmark.export.export_make import export
from phibench.benchmark.export.pair_rows import ExportRequest
from phibench.benchmark.pair_sets.dataset_pairs import tracks_of
from phibench.benchmark.pair_sets.frames_set import FramesSet
from phibench.benchmark.reports.bench import SHIPPED
from phibench.benchmark.scored_dataset import ScoredDataset
from phibench.benchmark.scores.score import score
from phibench.cli.main import main
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.frames.frame_request import FrameOptions
from phibench.datasets.store.checksums import checksums_text
from phibench.datasets.store.files import sha256
from phibench.datasets.training import PairDataset
from phibench.estimator.interface import Pair

IMAGES = ("down", "up", "down_off", "up_off")


@pytest.fixture(scope="module", params=["mjpeg", "bayer-raw"])
def frames(request: pytest.FixtureRequest, tiny_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> FramesSet:
    """Frames set of two draws, in a preset of JPEG files and in one of PNG files."""
    out = tmp_path_factory.mktemp("frames") / request.param
    wanted = ExportRequest("frames", FrameOptions(request.param), draws=2, laser_off=True, scored=True)
    return FramesSet(export(tiny_dataset, wanted, out, workers=1).folder)


def same(a: Pair, b: Pair) -> bool:
    numbers = (a.number, a.rig, a.stroke_m, a.card, a.box_down, a.box_up, a.beam)
    images = [np.array_equal(getattr(a, name), getattr(b, name)) for name in IMAGES]
    return numbers == (b.number, b.rig, b.stroke_m, b.card, b.box_down, b.box_up, b.beam) and all(images)


def test_pairs_and_truths_are_those_of_the_layers(frames: FramesSet, tiny_dataset: Path) -> None:
    opened = phibench.open_dataset(tiny_dataset)
    assert isinstance(opened, ScoredDataset)
    layers = opened.pairs(frames.preset, 2)
    assert len(frames) == len(layers) == 4
    for number, (pair, truth) in enumerate(frames):
        assert same(pair, layers.pair(number))
        wanted = layers.truth(number)
        assert truth.depth_m == wanted.depth_m
        assert repr(truth) == repr(wanted)
        for a, b in ((truth.down, wanted.down), (truth.up, wanted.up)):
            assert a.uv_px == b.uv_px or not b.visible
            assert (a.bound_px2 is None) == (b.bound_px2 is None)
            assert a.bound_px2 is None or np.array_equal(a.bound_px2, b.bound_px2)
        assert frames.number_of(truth.sample_id, truth.draw) == number


@pytest.mark.slow
def test_a_score_has_the_same_records(frames: FramesSet, tiny_dataset: Path, tmp_path: Path) -> None:
    """All records but the seconds; both scores are of the same pairs for `compare`."""
    here = score(frames.folder, "red_centroid", draws=2, out=tmp_path / "a.json")
    there = score(tiny_dataset, "red_centroid", frames.preset, draws=2, out=tmp_path / "b.json")
    assert here.records.drop("seconds").equals(there.records.drop("seconds"))
    assert main(["compare", str(tmp_path / "a.json"), str(tmp_path / "b.json")]) == 0


def test_tracks_have_the_boxes_of_the_layers(frames: FramesSet, tiny_dataset: Path) -> None:
    drawn = phibench.open_dataset(tiny_dataset).pairs(frames.preset, frames.info.draws, track="localise")
    localised = frames.of_track("localise")
    assert len(localised) == len(drawn) > 0
    for pair, truth in localised:
        other = drawn.pair(drawn.number_of(truth.sample_id, truth.draw))
        assert (pair.box_down, pair.box_up) == (other.box_down, other.box_up)
        assert truth.hinted
    assert tracks_of(localised.document()) == ("localise",)
    whole = frames.of_track("depth")
    assert all(pair.box_down is None for pair, _ in whole)
    assert tracks_of(whole.document()) == ("find", "depth")


def test_a_part_of_the_set(frames: FramesSet) -> None:
    assert [truth.draw for _, truth in frames.pairs(draws=1)] == [0, 0]
    first = frames.pairs(frames.preset, pairs=3, hints=False)
    pairs = list(first)
    assert [pair.number for pair, _ in pairs] == [truth.number for _, truth in pairs] == [0, 1, 2]
    assert all(pair.box_down is None and not truth.hinted for pair, truth in pairs)
    again = pickle.loads(pickle.dumps(first))
    assert same(again.pair(2), first.pair(2))


def test_training_takes_it(frames: FramesSet, tiny_dataset: Path) -> None:
    held = PairDataset(frames.folder, frames.preset, laser_off=True)
    drawn = PairDataset(tiny_dataset, frames.preset, laser_off=True, samples=held.sample_ids)
    for epoch in (0, 1):
        held.set_epoch(epoch)
        drawn.set_epoch(epoch)
        for index in range(len(held)):
            a, b = held[index], drawn[index]
            assert set(a) == set(b)
            assert all(np.array_equal(a[name], b[name], equal_nan=a[name] != a[name]) for name in set(a) - set(IMAGES))
            assert all(np.array_equal(a[name], b[name]) for name in IMAGES)
    held.set_epoch(2)
    with pytest.raises(DatasetError, match="its draws are its epochs"):
        held[0]


def _lose_a_frame(folder: Path) -> None:
    next((folder / "frames").rglob("*-0000.down.*")).unlink()


def _change_a_frame(folder: Path) -> None:
    next((folder / "frames").rglob("*-0000.up.*")).write_bytes(b"no picture")


def _other_version(folder: Path) -> None:
    info = json.loads((folder / "frames_set.json").read_text())
    (folder / "frames_set.json").write_text(json.dumps({**info, "task_version": 1}))


def _one_line_less(folder: Path) -> None:
    lines = (folder / "pairs.jsonl").read_text().splitlines(keepends=True)
    (folder / "pairs.jsonl").write_text("".join(lines[:-1]))
    files = [path for path in folder.rglob("*") if path.is_file() and path.name != "SHA256SUMS"]
    hashes = {path.relative_to(folder).as_posix(): sha256(path) for path in files}
    (folder / "SHA256SUMS").write_text(checksums_text(hashes))


@pytest.mark.parametrize("frames", ["mjpeg"], indirect=True)
@pytest.mark.parametrize(
    ("harm", "words"),
    [
        (_lose_a_frame, "is missing; download the set again"),
        (_change_a_frame, "was changed, its SHA-256 is not the listed one"),
        (_other_version, "is of task version 1"),
        (_one_line_less, "does not hold the pairs 0 to"),
        (lambda folder: (folder / "SHA256SUMS").unlink(), "SHA256SUMS is missing"),
    ],
    ids=["lost", "changed", "version", "short", "unfinished"],
)
def test_damage_is_one_sentence(
    harm: Callable[[Path], None], words: str, frames: FramesSet, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    folder = tmp_path / "copy"
    shutil.copytree(frames.folder, folder)
    harm(folder)
    assert main(["score", str(folder), "--method", "red_centroid"]) == 2
    told = capsys.readouterr().err
    assert words in told
    assert "Traceback" not in told


@pytest.mark.parametrize("frames", ["mjpeg"], indirect=True)
@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--preset", "srgb8"], "none of 'srgb8'"),
        (["--draws", "3"], "holds 1 to 2 of each sample"),
        (["--boxes", "64"], "holds frames that are drawn"),
        (["--frames", "6", "6"], "holds frames that are drawn"),
    ],
)
def test_what_it_does_not_hold_is_refused(
    words: list[str], told: str, frames: FramesSet, capsys: pytest.CaptureFixture
) -> None:
    assert main(["score", str(frames.folder), "--method", "red_centroid", *words]) == 2
    assert told in capsys.readouterr().err


def test_a_command_that_needs_layers_says_what_the_folder_is(capsys: pytest.CaptureFixture) -> None:
    for command in (["dataset", "show"], ["paper"], ["calibrate", "--out", "x.json"]):
        assert main([*command, str(SHIPPED)]) == 2
        told = capsys.readouterr().err
        assert f"{SHIPPED} is a frames set" in told
        assert "layers" in told
