"""Exports against the data set that they come from, through the libraries of others."""

import importlib.metadata
import io
import json
import re
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from phibench.benchmark.export.export_make import ExportOutcome, export, verify_export
from phibench.benchmark.export.pair_rows import ExportRequest, Form, pair_key, splits
from phibench.cli.main import main
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.frames.frame_request import FrameOptions
from phibench.datasets.read import open_dataset


def snapshot(folder: Path) -> dict[str, bytes]:
    """All files of an export but the lock and the diary's temporary ones."""
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def request_of(form: Form, **options: Any) -> ExportRequest:
    given = {"region": options.pop("region")} if "region" in options else {}
    frames = FrameOptions(options.pop("preset", "srgb8"), given)
    return ExportRequest(form, frames, **{"draws": 2, "pairs_per_shard": 3, **options})


def exported(dataset: Path, out: Path, form: Form, **options: Any) -> ExportOutcome:
    return export(dataset, request_of(form, **options), out, workers=1)


@pytest.fixture(scope="module", params=["parquet", "webdataset", "frames"])
def done(request: pytest.FixtureRequest, tiny_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One export in each form."""
    return exported(tiny_dataset, tmp_path_factory.mktemp("export") / request.param, request.param).folder


def read_back(folder: Path, cache: Path) -> dict[str, tuple[dict[str, Any], Any]]:
    """Rows and images (down) of an export by key, read by the library that its form is meant for."""
    form = json.loads((folder / "export.json").read_text())["form"]
    if form == "parquet":
        import datasets

        rows = datasets.load_dataset(str(folder), split="train", cache_dir=str(cache))
        return {row["key"]: (row, row["image_down"]) for row in rows}
    if form == "webdataset":
        import webdataset

        shards = sorted(str(path) for path in (folder / "shards").iterdir())
        samples = webdataset.WebDataset(shards, shardshuffle=False).decode("pil")
        return {sample["__key__"]: (sample["json"], sample["down.png"]) for sample in samples}
    import polars

    rows = polars.read_parquet(folder / "pairs.parquet").iter_rows(named=True)
    return {row["key"]: (row, Image.open(folder / row["image_down"])) for row in rows}


def test_others_read_the_same_numbers_and_images(done: Path, tiny_dataset: Path, tmp_path: Path) -> None:
    dataset, found = open_dataset(tiny_dataset), read_back(done, tmp_path)
    table = dataset.to_polars().to_dicts()
    assert len(found) == 2 * len(table) > 0
    for row in table:
        sample = dataset[row["sample_id"]]
        source = sample.frame_source("srgb8")
        for draw in (0, 1):
            numbers, image = found[f"{row['sample_id'].replace('.', '_')}-{draw:04d}"]
            assert {name: numbers[name] for name in row} == row  # all columns, to the bit
            frame = source.frame("down", draw)
            assert np.array_equal(np.asarray(image), frame.image)
            assert (numbers["down.u0_px"], numbers["down.exposure_s"]) == (frame.region.u0_px, frame.sensor.exposure_s)


@pytest.mark.slow
def test_croissant_is_valid_and_gives_the_rows(done: Path) -> None:
    import mlcroissant

    found = mlcroissant.Dataset(jsonld=str(done / "croissant.json"))  # raises what is not valid
    records = list(found.records("pairs"))
    document = json.loads((done / "croissant.json").read_text())
    assert "http://mlcommons.org/croissant/1.1" in document["conformsTo"]
    assert sum(name.startswith("rai:") for name in document) >= 10
    assert "integers at pixel centres" in document["description"]  # half a pixel would be a wrong product
    rows = list(read_index(done))
    assert [record["pairs/key"].decode() for record in records] == [row["key"] for row in rows]
    assert [record["pairs/down.u_px"] for record in records] == [row["down.u_px"] for row in rows]


def read_index(folder: Path) -> Sequence[dict[str, Any]]:
    import polars

    return polars.read_parquet(folder / "pairs.parquet").to_dicts()


def test_same_bytes_again_and_with_other_workers(done: Path, tiny_dataset: Path, tmp_path: Path) -> None:
    """Two processes in one of the forms: to start them takes longer than all else here."""
    form = json.loads((done / "export.json").read_text())["form"]
    export(tiny_dataset, request_of(form), tmp_path / "other", workers=2 if form == "webdataset" else 1)
    assert snapshot(tmp_path / "other") == snapshot(done)


@pytest.mark.slow
def test_what_is_lost_or_changed_alone_is_made_again(done: Path, tiny_dataset: Path, tmp_path: Path) -> None:
    """A flipped bit is found; the next run mends it and keeps the other shards."""
    folder = tmp_path / "copy"
    shutil.copytree(done, folder)
    form = json.loads((folder / "export.json").read_text())["form"]
    victim = next(
        path for path in sorted(folder.rglob("*")) if path.suffix in (".tar", ".png") or "data" in path.parts[-2]
    )
    data = bytearray(victim.read_bytes())
    data[len(data) // 2] ^= 1
    victim.write_bytes(bytes(data))
    faults = verify_export(folder)
    assert len(faults) == 1
    assert victim.name in faults[0]
    again = exported(tiny_dataset, folder, form)
    assert (again.made, again.kept) == (1, 1)
    assert verify_export(folder) == []
    assert snapshot(folder) == snapshot(done)


def test_jpegs_are_the_cameras_own(tiny_dataset: Path, tmp_path: Path) -> None:
    import polars

    out = exported(tiny_dataset, tmp_path / "jpeg", "parquet", preset="mjpeg", draws=1).folder
    dataset = open_dataset(tiny_dataset)
    table = polars.concat(polars.read_parquet(path) for path in sorted((out / "data").iterdir()))
    assert table.height == len(dataset)
    for row in table.iter_rows(named=True):
        source = dataset[row["sample_id"]].frame_source("mjpeg")
        assert row["image_up"]["bytes"] == source.frame("up", 0).jpeg
        assert Image.open(io.BytesIO(row["image_up"]["bytes"])).format == "JPEG"


@given(st.lists(st.text("ab._-", min_size=1, max_size=4), min_size=2, max_size=2, unique=True))
def test_keys_of_other_samples_differ_and_have_no_dot(names: list[str]) -> None:
    """Samples of targets "d1.5" and "d1_5" had one key, and so one file for the images of both."""
    assert pair_key("e-d1.5-h0.400", 0) != pair_key("e-d1_5-h0.400", 0)
    keys = [pair_key(name, 0) for name in names]
    assert keys[0] != keys[1]
    assert not any("." in key for key in keys)


@dataclass(frozen=True)
class Row:
    sample_id: str
    rig: str
    room: str


def splits_of(pairs: Sequence[tuple[int, int]], **options: Any) -> dict[str, str]:
    rows = [Row(f"s{k}", f"rig{rig}", f"room{room}") for k, (rig, room) in enumerate(pairs)]
    info, recipe = SimpleNamespace(name="any"), SimpleNamespace(dataset=SimpleNamespace(seed=1))
    return splits(SimpleNamespace(rows=rows, info=info, recipe=recipe), request_of("frames", **options))  # type: ignore[arg-type]


@given(
    st.lists(st.tuples(st.integers(0, 12), st.integers(0, 12)), min_size=1, max_size=60),
    st.sampled_from(["both", "rig", "room"]),
)
def test_no_two_splits_share_a_rig_or_a_room(pairs: list[tuple[int, int]], split_by: str) -> None:
    found = splits_of(pairs, split_by=split_by, validation=0.2, test=0.3)
    assert len(found) == len(pairs)
    for shared, place in (("rig", 0), ("room", 1)):
        if split_by in ("both", shared):
            homes: dict[int, set[str]] = {}
            for k, pair in enumerate(pairs):
                homes.setdefault(pair[place], set()).add(found[f"s{k}"])
            assert all(len(names) == 1 for names in homes.values())
    for name, share in (("validation", 0.2), ("test", 0.3)):
        assert sum(split == name for split in found.values()) <= share * len(pairs) + 1e-9


def test_splits_take_their_shares_where_groups_are_small() -> None:
    """100 rigs of their own rooms: 10 and 10 of 100, and not the first ones."""
    found = splits_of([(k, k) for k in range(100)])
    names = [found[f"s{k}"] for k in range(100)]
    assert (names.count("test"), names.count("validation")) == (10, 10)
    assert names[:10] != ["test"] * 10


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (["--to", "parquet", "--preset", "ideal"], "no image file"),
        (["--to", "parquet", "--validation", "0.6", "--test", "0.5"], "below 1 together"),
        (["--to", "frames", "--draws", "0"], "draws = 0: must be an integer, 1 or above"),
        (["--to", "frames", "--region", "40000"], "region"),
    ],
)
def test_bad_requests_end_in_a_sentence(
    tiny_dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], text: str
) -> None:
    assert main(["export", str(tiny_dataset), "--out", str(tmp_path / "out"), "--workers", "1", *options]) == 2
    said = capsys.readouterr().err
    assert text in said
    assert "Traceback" not in said


def test_parquet_without_its_package_is_refused_before_anything_is_written(
    tiny_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing(name: str) -> str:
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "version", missing)
    request = ExportRequest("parquet", FrameOptions("srgb8"))
    with pytest.raises(DatasetError, match=r"need pyarrow: pip install 'phibench\[export\]'"):
        export(tiny_dataset, request, tmp_path / "out", workers=1)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("command", ["export", "score"])
def test_a_dataset_without_frames_ends_in_a_sentence(
    command: str, tiny_dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The layers are gone of which frames are made: one sentence, and what was there is left alone."""
    shutil.copytree(tiny_dataset, tmp_path / "bare", ignore=shutil.ignore_patterns("*.exr"))
    before = snapshot(tmp_path / "bare")
    out = tmp_path / "out"
    words = ["export", "--to", "frames"] if command == "export" else ["score", "--method", "detect"]
    options = ["--preset", "srgb8", "--workers", "1", "--out", str(out if command == "export" else out / "score.json")]
    assert main([words[0], str(tmp_path / "bare"), *words[1:], *options]) == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert re.search(r"\.exr is missing", said[-1])
    assert "Traceback" not in "".join(said)
    assert snapshot(tmp_path / "bare") == before
    assert not (out / "SHA256SUMS").exists()


def test_foreign_folders_and_other_exports_are_left_alone(
    done: Path, tiny_dataset: Path, tmp_path: Path, smallest_dataset: Path
) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("all of it")
    with pytest.raises(DatasetError, match="holds other files: give an empty folder"):
        exported(tiny_dataset, tmp_path / "mine", "frames")
    with pytest.raises(DatasetError, match="inside the data set"):
        exported(tiny_dataset, tiny_dataset / "export", "frames")
    before = snapshot(done)
    with pytest.raises(DatasetError, match=r"another export|differs in dataset, dataset_sha256"):
        exported(smallest_dataset, done, json.loads((done / "export.json").read_text())["form"])
    assert snapshot(done) == before
    (tmp_path / "unfinished").mkdir()
    shutil.copy(done / "export.json", tmp_path / "unfinished")
    with pytest.raises(DatasetError, match="it was not finished"):
        verify_export(tmp_path / "unfinished")
