"""`phibench dataset frames`: the files are what the API gives, a rerun makes only what is missing or damaged."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import polars
import pytest
from PIL import Image

from phibench.cli import main as cli
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.exposures.draw_frames import DrawnFrames, draw_frames
from phibench.datasets.frames.frame_files import (
    INDEX,
    INDEX_TABLE,
    REQUEST,
    TRUTH,
    FrameRow,
    preview,
    read_index,
    write_index,
)
from phibench.datasets.frames.frame_request import FrameOptions
from phibench.datasets.frames.frame_source import Frame
from phibench.datasets.read import open_dataset
from phibench.datasets.store.checksums import damaged_files, stray_files
from phibench.datasets.store.layers import read_exr
from phibench.render.sensor.light import Region

SEEN, HALF = "seen-near-h0.500", "half-hidden-h1.400"


def run(*tokens: object) -> int:
    return cli.main(["dataset", "frames", *map(str, tokens)])


def image_in(path: Path) -> np.ndarray:
    if path.suffix == ".exr":
        return np.stack([read_exr(path).planes[name] for name in "RGB"])
    with Image.open(path) as picture:
        return np.asarray(picture)


def test_the_first_preset_of_the_recipe_is_drawn_and_the_others_are_told(
    bench_dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The recipe's first is not the default of the command."""
    first, *others = open_dataset(bench_dataset).recipe.frames.presets
    assert first != "mjpeg"
    out = tmp_path / "frames"
    assert run(bench_dataset, "--out", out, "--workers", 1, "--region", 32) == 0
    assert {row.preset for row in read_index(out).values()} == {first}
    told = capsys.readouterr().out
    assert all(f"--preset {name}" in told for name in others)


@pytest.mark.parametrize(
    ("preset", "end", "mode"),
    [
        ("ideal", "exr", ""),
        ("bayer-raw", "png", "I;16"),
        ("srgb8", "png", "RGB"),
        ("yuyv", "png", "LA"),
        ("mjpeg", "jpg", "RGB"),
    ],
)
def test_files_are_what_the_api_gives(tiny_dataset: Path, tmp_path: Path, preset: str, end: str, mode: str) -> None:
    out = tmp_path / "f"
    assert run(tiny_dataset, "--preset", preset, "--draws", 2, "--laser-off", "--out", out, "--workers", 1) == 0
    rows = read_index(out)
    frames = {name: row for name, row in rows.items() if row.kind == "frame"}
    assert len(frames) == 2 * 2 * 2 * 2
    assert len(rows) - len(frames) == (8 if preset in ("ideal", "bayer-raw", "yuyv") else 0)
    assert f"{SEEN}-down-on-0000.{end}" in frames
    dataset = open_dataset(tiny_dataset)
    for name, row in frames.items():
        source = dataset[row.sample_id].frame_source(preset)
        frame = source.frame(row.position, row.draw, row.laser == "on")
        expected = frame.image.astype(np.float32) if preset == "ideal" else frame.image
        np.testing.assert_array_equal(image_in(out / name), expected)
        assert hashlib.sha256((out / name).read_bytes()).hexdigest() == row.sha256
        assert row.sensor == json.loads(frame.sensor.model_dump_json())
        assert (row.width_px, row.height_px, row.exposure_s) == (320, 180, frame.sensor.exposure_s)
        spot = dataset[row.sample_id].truth_row(row.position)
        for field in TRUTH:
            np.testing.assert_equal(getattr(row, field), spot.at_centre(field))
        if spot.light is not None and spot.visible:
            assert (row.u_px, row.v_px, row.phi_ray_rad) == (spot.light.u_px, spot.light.v_px, spot.light.phi_ray_rad)
        manifest = dataset[row.sample_id].row
        assert (row.depth_m, row.stroke_m) == (manifest.light_depth_m, manifest.stroke_m)
        if mode:
            with Image.open(out / name) as picture:
                assert picture.mode == mode
        if preset == "mjpeg":
            assert (out / name).read_bytes() == frame.jpeg


def test_the_index_as_a_table_says_the_same(tiny_dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "f"
    draw_frames(tiny_dataset, FrameOptions("mjpeg", {"jpeg_quality": 60}), 2, out=out, laser_off=True, workers=1)
    lines = [json.loads(line) for line in (out / INDEX).read_text().splitlines()]
    table = polars.read_parquet(out / INDEX_TABLE)
    assert table.columns == list(FrameRow.model_fields)
    rows = [{**row, **{name: json.loads(row[name]) for name in ("sensor", "request")}} for row in table.to_dicts()]
    assert rows == lines
    hidden = table.filter(~polars.col("visible"))
    assert 0 < hidden.height < table.height == 16
    assert hidden["cause"].str.starts_with("occluded:").all()


def test_an_exposure_that_is_not_given_is_the_cameras(tiny_dataset: Path, tmp_path: Path) -> None:
    """Without `[frames]` every preset is auto exposed."""
    options = ("--sample", SEEN, "--region", 16, "--workers", 1)
    for preset, exposure in (("mjpeg", "auto"), ("srgb8", "auto"), ("bayer-raw", "auto")):
        assert run(tiny_dataset, "--preset", preset, *options, "--out", tmp_path / preset) == 0
        rows = [row for row in read_index(tmp_path / preset).values() if row.kind == "frame"]
        assert {row.request["exposure"] for row in rows} == {exposure}
        for row in rows:
            sensor = open_dataset(tiny_dataset)[SEEN].frame_source(preset, exposure=exposure).sides[row.position]
            assert row.exposure_s == sensor.chain.sensor.exposure_s
    assert run(tiny_dataset, *options, "--exposure", "preset", "--out", tmp_path / "p") == 0
    assert {row.exposure_s for row in read_index(tmp_path / "p").values()} == {1.0 / 60.0}


def test_raw_files_hold_ten_bits_unscaled(tiny_dataset: Path, tmp_path: Path) -> None:
    draw_frames(tiny_dataset, FrameOptions("bayer-raw"), out=tmp_path / "f", samples=[SEEN], workers=1)
    image = image_in(tmp_path / "f" / f"{SEEN}-up-on-0000.png")
    assert image.dtype == np.uint16
    assert 64 < np.median(image) <= 1023
    assert image.max() == 1023  # the lamps
    picture = image_in(tmp_path / "f" / "previews" / f"{SEEN}-up-on.png")
    assert (picture.shape, picture.dtype) == ((180, 320, 3), np.uint8)


def test_a_rerun_makes_what_is_missing_or_damaged(
    tiny_dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "f"
    options = (tiny_dataset, "--region", 32, "--sample", SEEN, "--out", out, "--draws")
    assert run(*options, 3) == 0
    assert "6 files written, 0 kept" in capsys.readouterr().out
    before = {path.name: path.read_bytes() for path in out.glob("*.*")}
    assert run(*options, 3) == 0
    assert "0 files written, 6 kept" in capsys.readouterr().out
    (out / f"{SEEN}-down-on-0001.png").unlink()
    (out / f"{SEEN}-up-on-0002.png").write_bytes(b"half")
    assert run(*options, 3) == 0
    assert "2 files written, 4 kept" in capsys.readouterr().out
    assert {path.name: path.read_bytes() for path in out.glob("*.*")} == before
    (out / INDEX).unlink()
    assert run(*options, 4) == 0
    assert "8 files written, 0 kept" in capsys.readouterr().out
    assert {name: (out / name).read_bytes() for name in before if name.endswith("png")} == {
        name: data for name, data in before.items() if name.endswith("png")
    }


def test_workers_give_the_same_bytes(tiny_dataset: Path, tmp_path: Path) -> None:
    for workers in (1, 2):
        assert run(tiny_dataset, "--draws", 2, "--out", tmp_path / str(workers), "--workers", workers) == 0
    one, two = ({p.name: p.read_bytes() for p in (tmp_path / n).glob("*.*") if p.is_file()} for n in ("1", "2"))
    one, two = ({name: data for name, data in x.items() if not name.startswith(".")} for x in (one, two))
    assert one == two
    assert len(one) == 2 * 2 * 2 + 3  # the index in two forms and the request


def test_changed_layers_are_drawn_again(tiny_dataset: Path, tmp_path: Path) -> None:
    """The hash of a layer in SHA256SUMS enters the key of the frames that come from it."""
    copy, out = Path(shutil.copytree(tiny_dataset, tmp_path / "copy")), tmp_path / "f"
    request = FrameOptions("bayer-raw", {"region": 16})
    assert draw_frames(copy, request, out=out, samples=[SEEN], workers=1).made == 4
    sums = (copy / "SHA256SUMS").read_text().splitlines()
    changed = ["0" * 64 + line[64:] if line.endswith(f"{SEEN}-up.exr") else line for line in sums]
    assert changed != sums
    (copy / "SHA256SUMS").write_text("\n".join(changed) + "\n")
    assert draw_frames(copy, request, out=out, samples=[SEEN], workers=1).made == 4


def test_the_default_folder_is_beside_the_data_set(tiny_dataset: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(tiny_dataset, tmp_path / "copy"))
    assert run(copy, "--region", 8, "--sample", SEEN) == 0
    assert (tmp_path / "copy-frames" / INDEX).is_file()
    assert damaged_files(copy) == stray_files(copy) == []


def test_samples_without_a_place_for_a_region_are_named(
    tiny_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("phibench.datasets.exposures.draw_frames.has_place", lambda spot, size: spot.pose != "h1.400")
    assert run(tiny_dataset, "--region", 8, "--out", tmp_path / "f") == 0
    out = capsys.readouterr().out
    assert f"note: {HALF} is left out: no image of the spot" in out
    assert "2 files written" in out


@pytest.mark.parametrize(
    ("tokens", "words"),
    [
        (["--preset", "mjpg"], "did you mean 'mjpeg'"),
        (["--exposure", "long"], "give seconds above 0, 'auto'"),
        (["--exposure", "0"], "give a number above 0 up to 10"),
        (["--draws", "0"], "draws = 0: must be an integer, 1 or above"),
        (["--region", "0"], "region = 0: must be an integer, 1 or above"),
        (["--region", "500", "--workers", "1"], "allowed sides are 1 to 180"),
        (["--sample", "seen"], "no sample 'seen'"),
        (["--workers", "0"], "workers = 0"),
    ],
)
def test_mistakes_are_one_sentence(
    tiny_dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], tokens: list[str], words: str
) -> None:
    assert run(tiny_dataset, "--out", tmp_path / "f", *tokens) == 2
    err = capsys.readouterr().err
    assert words in err
    assert "Traceback" not in err


def test_folders_that_will_not_do_are_refused(tiny_dataset: Path, tmp_path: Path) -> None:
    request, only = FrameOptions("bayer-raw", {"region": 8}), {"samples": [SEEN], "workers": 1}
    with pytest.raises(DatasetError, match="lies inside the data set"):
        draw_frames(tiny_dataset, request, out=tiny_dataset / "frames", **only)  # type: ignore[arg-type]
    out = tmp_path / "f"
    draw_frames(tiny_dataset, request, out=out, **only)  # type: ignore[arg-type]
    with pytest.raises(DatasetError, match="holds frames with region 8, not 16: give another folder"):
        draw_frames(tiny_dataset, FrameOptions("bayer-raw", {"region": 16}), out=out, **only)  # type: ignore[arg-type]
    (out / INDEX).write_text("{}\n")
    with pytest.raises(DatasetError, match=r"frames\.jsonl line 1 is damaged"):
        draw_frames(tiny_dataset, request, out=out, **only)  # type: ignore[arg-type]
    with pytest.raises(DatasetError, match="is a data set"):
        draw_frames(tiny_dataset, request, out=shutil.copytree(tiny_dataset, tmp_path / "copy"), **only)  # type: ignore[arg-type]


@pytest.mark.parametrize("corner", [(0, 0), (1, 0), (0, 1), (1, 1)])
def test_previews_of_parts_keep_the_colours(tiny_dataset: Path, corner: tuple[int, int]) -> None:
    """A part that begins at any site of the mosaic looks like the same part of the whole picture."""
    sample = open_dataset(tiny_dataset)[SEEN]
    u0, v0 = 100 + corner[0], 60 + corner[1]
    whole = sample.frame_source("bayer-raw").frame("up")
    part: Frame = sample.frame_source("bayer-raw", region=Region(u0, v0, u0 + 20, v0 + 16)).frame("up")
    expected = preview(whole)[v0 : v0 + 16, u0 : u0 + 20]
    # borders are mirrored: compare the inside
    np.testing.assert_array_equal(preview(part)[1:-1, 1:-1], expected[1:-1, 1:-1])


@pytest.mark.parametrize("side", [1, 2, 33])
@pytest.mark.parametrize("preset", ["mono-raw", "bayer-raw"])
def test_previews_have_the_size_of_their_frames(tiny_dataset: Path, tmp_path: Path, preset: str, side: int) -> None:
    out = tmp_path / "f"
    request = ("--preset", preset, "--region", side, "--sample", SEEN, "--out", out, "--workers", 1)
    assert run(tiny_dataset, *request) == 0
    rows = read_index(out).values()
    assert {row.kind for row in rows} == {"frame", "preview"}
    for row in rows:
        assert image_in(out / row.file).shape[:2] == (row.height_px, row.width_px) == (side, side)


def test_a_folder_is_claimed_before_its_first_frame(tiny_dataset: Path, tmp_path: Path) -> None:
    """After a kill there are files and no index: the folder is still for the first request alone."""
    out = tmp_path / "f"
    assert run(tiny_dataset, "--sample", SEEN, "--region", 16, "--exposure", 0.01, "--out", out, "--workers", 1) == 0
    (out / INDEX).unlink()
    claimed = (out / REQUEST).read_bytes()
    with pytest.raises(DatasetError, match=r"exposure .*give another folder"):
        draw_frames(tiny_dataset, FrameOptions("mjpeg", {"region": 16}), out=out, samples=[SEEN], workers=1)
    assert (out / REQUEST).read_bytes() == claimed


def test_a_refused_request_claims_nothing(tiny_dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "f"
    assert run(tiny_dataset, "--sample", SEEN, "--region", 181, "--out", out, "--workers", 1) == 2
    assert run(tiny_dataset, "--sample", SEEN, "--region", 16, "--out", out, "--workers", 1) == 0
    (tmp_path / "file").write_text("")
    assert run(tiny_dataset, "--out", tmp_path / "file") == 2


@pytest.mark.parametrize("option", ["--draws", "--region", "--camera-seed", "--workers"])
def test_fractions_are_not_rounded(
    tiny_dataset: Path, tmp_path: Path, option: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(tiny_dataset, "--out", tmp_path / "f", option, "1.5") == 2
    assert "'1.5' is not a whole number" in capsys.readouterr().err


def test_a_frame_that_goes_while_others_are_drawn_ends_the_run(
    smallest_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def removing(folder: Path, rows: Iterable[FrameRow]) -> Path:
        (folder / f"{SEEN}-down-on-0000.jpg").unlink()
        return write_index(folder, rows)

    def again() -> DrawnFrames:
        return draw_frames(smallest_dataset, FrameOptions("mjpeg", {}), out=tmp_path, samples=[SEEN], workers=1)

    with monkeypatch.context() as patch:
        patch.setattr("phibench.datasets.exposures.draw_frames.write_index", removing)
        with pytest.raises(
            DatasetError, match=r"1 of 2 files are gone from .*-down-on-0000\.jpg.*run the same"
        ) as caught:
            again()
    assert "\n" not in str(caught.value)
    assert (again().made, again().kept) == (1, 2)
