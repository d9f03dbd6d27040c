"""Imported sets: folders of real pairs measured, imported, scored, compared, reported and calibrated with."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers.camera_files import write_pictures

from phibench.benchmark.pair_sets.wanted_pairs import PairChoice, wanted_pairs
from phibench.benchmark.scores.score_files import read_score
from phibench.calibration.captures.imported_set import import_pairs, imported_pairs, open_imported
from phibench.calibration.captures.pair_list import read_pair_list
from phibench.calibration.outline.outline_result import Outline, PoseMeasurement
from phibench.calibration.rig.bundle import apparent_vertical
from phibench.calibration.rig.calibration_file import read_calibration
from phibench.cli.main import main
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.read import Sample, open_dataset
from phibench.estimator.geometry.rig_parameters import PARAMETERS
from phibench.estimator.spots.image_planes import ImageError

HEAD = "name,down,up,down_off,up_off,stroke_m,depth_m,depth_sigma_m\n"
TAPE_M = 0.01


def row_of(name: str, stroke_m: float, depth: str) -> str:
    files = ",".join(f"{image}-0.jpg;{image}-1.jpg" for image in ("down", "up", "down_off", "up_off"))
    return f"{name},{files},{stroke_m},{depth}\n"


@pytest.fixture(scope="module")
def sample(tiny_dataset: Path) -> Sample:
    return next(s for s in open_dataset(tiny_dataset) if s.row.down.visible and s.row.up.visible)


@pytest.fixture(scope="module")
def folder(tiny_dataset: Path, sample: Sample, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two rows of the same pictures, with two frames of each position: one with the right D, one without a D."""
    folder = tmp_path_factory.mktemp("real")
    write_pictures(open_dataset(tiny_dataset), sample, folder, "mjpeg", 2)
    rows = row_of("near", sample.row.stroke_m, f"{sample.row.depth_m},{TAPE_M}") + row_of(
        "unknown", sample.row.stroke_m, ","
    )
    (folder / "pairs.csv").write_text(HEAD + rows)
    return folder


@pytest.fixture(scope="module")
def imported(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("imported") / "real"
    assert main(["import", str(folder), "--out", str(out)]) == 0
    return out


@pytest.fixture
def unaligned(monkeypatch: pytest.MonkeyPatch) -> None:
    def nothing(*_: object) -> None:
        raise ImageError("not looked for")

    monkeypatch.setattr("phibench.calibration.captures.measure.find_outline", nothing)
    monkeypatch.setattr("phibench.calibration.captures.measure.other_size_note", lambda *_: "")


@pytest.mark.usefixtures("unaligned")
def test_a_folder_gives_a_csv_and_one_bad_pair_ends_no_run(folder: Path, sample: Sample, tmp_path: Path) -> None:
    row = sample.row
    text = HEAD + "".join(
        (
            f"good,down-0.jpg,up-0.jpg,down_off-0.jpg,up_off-0.jpg,{row.stroke_m},{row.depth_m},{TAPE_M}\n",
            f"gone,nothing.jpg,up-0.jpg,,,{row.stroke_m},,\n",
            f"short,down-0.jpg,up-0.jpg,down_off-0.jpg,up_off-0.jpg,{1.5 * row.stroke_m},{row.depth_m},{TAPE_M}\n",
        )
    )
    for path in folder.iterdir():
        if path.suffix in (".jpg", ".toml"):
            (tmp_path / path.name).symlink_to(path)
    (tmp_path / "pairs.csv").write_text(text)
    out = tmp_path / "results.csv"
    assert main(["measure", str(tmp_path), "--rig", str(tmp_path / "rig.toml"), "--out", str(out)]) == 1
    good, gone, short = csv.DictReader(out.read_text().splitlines())
    assert good["status"] == "ok"
    # 4 sigma: by chance in 6e-5 of all cases
    assert abs(float(good["difference_sigmas"])) < 4.0
    assert float(good["tape_sigma_m"]) == TAPE_M
    assert "nothing.jpg is missing" in gone["status"]
    assert gone["depth_m"] == ""
    # D grows with the stroke: half as much again, which the tape contradicts
    assert "contradicts the tape" in short["status"]


@pytest.mark.slow
def test_an_imported_set_is_scored_by_its_tape(
    imported: Path, folder: Path, sample: Sample, tmp_path: Path, capsys
) -> None:
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    files = [tmp_path / f"{name}.json" for name in ("chain_fit", "red_centroid")]
    for file in files:
        assert main(["score", str(imported), "--method", file.stem, "--rank", "depth", "--out", str(file)]) == 0
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    document = read_score(files[0])
    # the pair without a D is no pair of the score; two frames are two draws of one sample
    assert (document.pairs, document.samples) == (2, 1)
    assert document.pair_set["imported"] is True
    metrics = document.metrics
    assert metrics["depth_rate"].value == metrics["detection_rate"].value == 1.0
    assert metrics["false_rate"].value == 0.0
    assert 0.0 < metrics["rms_depth_relative"].value < 0.1
    # nobody has measured where the spots are
    for name in ("rms_px", "rms_counted_px", "rank_phi_rad", "rms_phi_rad", "efficiency_px", "efficiency_depth"):
        assert metrics[name].value is None
    assert main(["compare", *map(str, files)]) == 0
    assert main(["report", *map(str, files), "--rank", "depth", "--out", str(tmp_path / "page.html")]) == 0
    page = (tmp_path / "page.html").read_text()
    for words in ("chain_fit", "any position counts as found", "pull of D"):
        assert words in page
    for words in ("Where in the image", "The worst images", "Cramér-Rao", "mostly method"):
        assert words not in page
    assert main(["score", str(imported), "--method", "chain_fit", "--preset", "bayer-raw"]) == 2
    assert "leave --preset out" in capsys.readouterr().err


def test_the_tape_widens_the_pull(imported: Path) -> None:
    truth = imported_pairs(open_imported(imported), 5).truth(0)
    assert truth.depth_sigma_m == TAPE_M
    assert np.isnan(truth.down.uv_px).all()


def test_the_frames_are_the_cameras(imported: Path, folder: Path) -> None:
    opened = open_imported(imported)
    assert (imported / opened.rows[1].files["up"]).read_bytes() == (folder / "up-1.jpg").read_bytes()
    assert opened.pair(opened.rows[0]).card.output == "mjpeg"
    assert opened.info.assumed


@pytest.mark.parametrize("name", ["imported.json", "pairs.jsonl", "frames/near-0-up.jpg"])
def test_a_changed_file_is_told(imported: Path, tmp_path: Path, name: str) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(imported, copy)
    (copy / name).write_bytes((copy / name).read_bytes() + b" ")

    def read() -> None:
        opened = open_imported(copy)
        opened.pair(opened.rows[0])

    with pytest.raises(DatasetError, match="was changed"):
        read()


def test_the_rig_is_calibrated_from_pictures(
    imported: Path, sample: Sample, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An outline of 0.05 mm, one spot at a tape's distance: the file corrects the rig that scores then take."""
    outline = Outline(sample.rig.sphere_in_camera_m, np.diag([5e-5, 5e-5, 2e-4]) ** 2, 1.0, 1.0, 0.7, 0.1, 1000, 5)
    monkeypatch.setattr("phibench.calibration.captures.imported_calibration.find_outline", lambda *_: outline)
    file, scored = tmp_path / "rig.json", tmp_path / "score.json"
    assert main(["calibrate", str(imported), "--out", str(file), "--spots"]) == 0
    held = read_calibration(file, open_imported(imported).rig)
    assert held.made_from["samples"] == ["near"]
    # what the spot adds: D of the tape holds the tilt and the stroke together, the outline the decentre
    assert held.covariance[6, 6] < (1e-3) ** 2
    arguments = ["score", str(imported), "--method", "chain_fit", "--calibration", str(file), "--out", str(scored)]
    assert main(arguments) == 0
    assert read_score(scored).pair_set["calibration"] == held.sha256
    # spots are scored with the blur and filters that the calibration's spots gave
    blur_px, *_ = held.made_from["spot_shape"]["values"]
    assert blur_px != held.rig.camera.blur_sigma_px
    pairs = wanted_pairs(open_imported(imported), PairChoice(calibration=file))
    assert pairs.pair(0).rig.camera.blur_sigma_px == blur_px


@pytest.mark.slow
def test_vertical_edges_of_pictures_tell_the_tilt(
    imported: Path, sample: Sample, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    """Two pictures that show a vertical 0.01 rad off count as one; where none shows any, one sentence says so."""
    module, seen = (
        "phibench.calibration.captures.imported_calibration",
        PoseMeasurement(np.array([0.01, 0.0]), 1e-8 * np.eye(2)),
    )
    outline = Outline(sample.rig.sphere_in_camera_m, np.diag([4e-6, 4e-6, 2e-5]) ** 2, 1.0, 1.0, 0.7, 0.1, 1000, 5)
    monkeypatch.setattr(f"{module}.find_outline", lambda *_: outline)
    lacking = ImageError("0 vertical edges were found that agree: 3 are needed; leave the vertical out")
    told, rig = [], open_imported(imported).rig

    def calibrated(answers: list[PoseMeasurement | ImageError], *more: str) -> int:
        waiting = iter(answers)

        def answer(*given: object) -> PoseMeasurement:
            told.append(given)
            found = next(waiting)
            if isinstance(found, ImageError):
                raise found
            return found

        monkeypatch.setattr(f"{module}.find_vertical", answer)
        return main(["calibrate", str(imported), "--out", str(tmp_path / "rig.json"), *more])

    tilt, sigmas = [PARAMETERS.index(f"tilt_{axis}_rad") for axis in "xy"], []
    for answers, more in (([], ()), ([seen, seen], ("--vertical",)), ([lacking, seen], ("--vertical",))):
        assert calibrated(answers, *more) == 0
        held = read_calibration(tmp_path / "rig.json", rig)
        sigmas.append(np.sqrt(np.diag(held.covariance))[tilt])
    assert held.made_from["vertical_in_camera"] == pytest.approx([0.01, 0.0])
    # tilt and principal point share it out: in a picture of 320 px the point's 5 px are as much as the prior's tilt
    assert apparent_vertical(rig, held.rig) == pytest.approx([0.01, 0.0], abs=2e-4)
    assert np.all(sigmas[1] < 0.95 * sigmas[0])
    assert sigmas[1] == pytest.approx(sigmas[2])
    # the camera's picture, its card and the outline's error are handed on
    assert all(given[0].shape[-1] == 3 and given[2] is not None for given in told)
    (tmp_path / "rig.json").unlink()
    capsys.readouterr()
    assert calibrated([lacking, lacking], "--vertical") == 2
    said = capsys.readouterr().err
    assert "0 vertical edges" in said
    assert said.count("\n") == 1
    assert not (tmp_path / "rig.json").exists()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "no column 'name'"),
        ("name,down,up,stroke_m\n", "has 0 pairs"),
        ("name,down,up,stroke_m\na,d.jpg,u.jpg,0.4\na,d.jpg,u.jpg,0.4\n", "the name a twice"),
        ("name,down,up,stroke_m\na,d.jpg,u.jpg,425\n", "line 2: stroke_m = 425: allowed is 0.001 to 10, metres"),
        ("name,down,up,stroke_m\na,d.jpg,u.jpg,\n", "line 2: it has no stroke_m"),
        ("name,down,up,stroke_m\na,d.jpg,../u.jpg,0.4\n", "no name of a file below the folder"),
        ("name,down,up,stroke_m\na,,u.jpg,0.4\n", "names no picture in the column 'down'"),
        ("name,down,up,stroke_m\na b,d.jpg,u.jpg,0.4\n", "the name has 1 to 64"),
        ("name,down,up,stroke_m\na,d.jpg,u.jpg,0.4,7\n", "another number of columns"),
        ("name,down,up,stroke\na,d.jpg,u.jpg,0.4\n", "did you mean 'stroke_m'"),
        ("name,down,up,stroke_m,depth_m\na,d.jpg,u.jpg,0.4,2.0\n", "depth_m and depth_sigma_m go together"),
        (HEAD + "a,d.jpg,u.jpg,,,0.4,2.0,2\n", "2 mm are 0.002"),
        ("name,down,up,stroke_m,stroke_sigma_m\na,d.jpg,u.jpg,0.4,0.5\n", "allowed is a quarter of stroke_m"),
    ],
)
def test_each_wrong_row_is_one_sentence(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "pairs.csv").write_text(text)
    with pytest.raises(DatasetError) as caught:
        read_pair_list(tmp_path)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_import_leaves_nothing_behind_when_it_fails(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "pairs.csv").write_text("name,down,up,stroke_m\na,d.jpg,u.jpg,0.4\n")
    with pytest.raises(DatasetError, match=r"d\.jpg is missing"):
        import_pairs(tmp_path / "in", tmp_path / "out", folder / "rig.toml")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in"]
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("mine")
    with pytest.raises(DatasetError, match="not an empty folder"):
        import_pairs(folder, tmp_path / "full")
    assert json.dumps([path.name for path in (tmp_path / "full").iterdir()]) == '["mine.txt"]'
