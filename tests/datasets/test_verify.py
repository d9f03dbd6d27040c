"""Verification finds every kind of damage, and nothing where there is none."""

import contextlib
import errno
import io
import json
import os
import re
import shutil
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers.damage import (
    AMBIENT,
    OTHER_SPOT,
    SPOT,
    TRUTH,
    flip_a_bit,
    sign,
    swap,
    truncate,
    unseen_flips,
    write_checksums,
    write_manifest,
)
from helpers.processes import within
from PIL import Image
from rich.console import Console

from phibench.cli.main import main
from phibench.datasets import show as show_module
from phibench.datasets.build.dataset_build import visibility_line
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.read import open_dataset
from phibench.datasets.show import show
from phibench.datasets.store import checksums, pictures, schema
from phibench.datasets.store.layers import (
    read_ambient,
    read_ambient_variance,
    read_exr,
    read_truth,
    write_ambient,
    write_truth,
)
from phibench.datasets.store.metadata import read_manifest
from phibench.datasets.store.pictures import Picture
from phibench.datasets.verify import Report, file_faults, verify
from phibench.estimator.geometry.sensitivity_table import keep_sensitivities

PREVIEW = schema.preview_file("seen-near-h0.500")


def check(folder: Path, truth_layers: bool = False) -> Report:
    return verify(folder, truth_layers, Console(file=io.StringIO()))


@pytest.fixture
def copy(smallest_dataset: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(smallest_dataset, tmp_path / "copy"))


# images of full size, of a recipe that is shipped, show the same once more
@pytest.mark.parametrize("name", ["smallest_dataset", pytest.param("smoke_dataset", marks=pytest.mark.slow)])
def test_a_fresh_data_set_is_in_order(name: str, request: pytest.FixtureRequest) -> None:
    report = check(request.getfixturevalue(name), truth_layers=True)
    assert report.faults == ()
    assert report.ok
    assert report.files >= 15
    assert report.samples in (2, 3)


@pytest.mark.slow
@pytest.mark.parametrize("damage", [truncate, flip_a_bit, Path.unlink])
@pytest.mark.parametrize(
    "name",
    [
        AMBIENT,
        TRUTH,
        SPOT,
        schema.light_map_file("room"),
        schema.TABLE,
        schema.RECIPE,
        schema.RIGS,
        schema.ROOMS,
        schema.preview_file("seen-near-h0.500"),
        schema.MANIFEST,
    ],
)
def test_a_damaged_file_is_named(copy: Path, name: str, damage: Callable[[Path], None]) -> None:
    damage(copy / name)
    report = check(copy)
    assert not report.ok
    assert [fault for fault in report.faults if name in fault]
    if name not in (schema.RIGS, schema.MANIFEST) or damage is not flip_a_bit:  # another digit is another rig or truth
        assert not [fault for fault in report.faults if name not in fault and schema.MANIFEST not in fault]


@pytest.mark.parametrize(("a", "b"), [(SPOT, OTHER_SPOT), (AMBIENT, schema.view_file("h0.500", "ambient"))])
@pytest.mark.parametrize("hide", [False, True], ids=["sums as they were", "sums made anew"])
def test_swapped_files_are_found(copy: Path, a: str, b: str, hide: bool) -> None:
    swap(copy, a, b)
    if hide:
        sign(copy)
    faults = check(copy).faults
    assert {name for name in (a, b) if any(name in fault for fault in faults)} == {a, b}


def test_a_stray_file_is_a_note_and_neither_a_fault_nor_signed(copy: Path) -> None:
    before = (copy / schema.CHECKSUMS).read_text()
    (copy / "spots" / "extra.exr").write_bytes(b"")
    (copy / "scores.json").write_text("{}")
    report = check(copy)
    assert report.ok
    assert ["scores.json" in report.notes[0], "spots/extra.exr" in report.notes[1]] == [True, True]
    write_checksums(copy)
    assert (copy / schema.CHECKSUMS).read_text() == before


def test_a_file_of_the_data_set_that_is_not_listed_is_a_fault(copy: Path) -> None:
    lines = (copy / schema.CHECKSUMS).read_text().splitlines(keepends=True)
    (copy / schema.CHECKSUMS).write_text("".join(line for line in lines if SPOT not in line))
    assert check(copy).faults == (f"{SPOT} is not listed in SHA256SUMS",)


def test_a_missing_folder_and_an_unreadable_file_are_called_so(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(DatasetError, match="there is no folder"):
        check(copy / "nowhere")
    sha256 = checksums.sha256

    def denied(path: Path) -> str:
        if path.name == schema.TABLE:
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
        return sha256(path)

    monkeypatch.setattr(checksums, "sha256", denied)
    assert check(copy).faults == (f"{schema.TABLE} is not readable: Permission denied",)


@pytest.mark.parametrize("name", ["irradiance_w_m2", "sigma_w_m2", "covered"])
@pytest.mark.parametrize("spoil", ["negative", "nan", "short", "gone"])
def test_a_spoilt_light_map_is_found_though_signed(copy: Path, name: str, spoil: str) -> None:
    with np.load(copy / schema.light_map_file("room")) as file:
        arrays = dict(file)
    if spoil == "short":
        arrays[name] = arrays[name][:-1]
    elif spoil == "gone":
        del arrays[name]
    elif name != "covered":
        arrays[name][5] = -1.0 if spoil == "negative" else np.nan
    else:
        return
    np.savez(copy / schema.light_map_file("room"), **arrays)
    sign(copy)
    [fault] = check(copy).faults
    assert schema.light_map_file("room") in fault
    assert name in fault


@pytest.mark.parametrize("value", [-1.0, np.nan])
def test_a_variance_that_is_none_is_found_though_signed(copy: Path, value: float) -> None:
    path = copy / AMBIENT
    planes, variance, header = read_ambient(path), read_ambient_variance(path), read_exr(path).header
    variance[1, 2, 3] = value
    write_ambient(path, planes, variance, header)
    sign(copy)
    assert check(copy).faults == (f"{AMBIENT} has negative or non-finite variances",)


def place(kind: str, path: Path) -> None:
    """Something that is no file, under the name of a file."""
    path.unlink(missing_ok=True)
    if kind == "folder":
        path.mkdir()
    elif kind == "FIFO":
        os.mkfifo(path)
    elif kind == "socket":
        with socket.socket(socket.AF_UNIX) as server, contextlib.chdir(path.parent):  # a socket's path has 108 bytes
            server.bind(path.name)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    else:
        path.symlink_to(path.name)


KINDS = ["folder", "FIFO", "socket", "device", "circle"]
NAMES = [
    *(
        schema.INFO,
        schema.MANIFEST,
        schema.TABLE,
        schema.RECIPE,
        schema.RIGS,
        schema.ROOMS,
        schema.CHECKSUMS,
        schema.light_map_file("room"),
    ),
    *(schema.JOURNAL, schema.RUN, schema.LOG, schema.CONTACT_SHEET, schema.SENSITIVITIES),
    *(AMBIENT, TRUTH, SPOT, PREVIEW, schema.view_file("h0.000", "preview")),
]


@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX files")
@pytest.mark.parametrize("kind", KINDS)
def test_what_is_no_file_is_a_fault_and_keeps_nobody_waiting(copy: Path, kind: str) -> None:
    """All names at once, then each by itself: file by file costs little, contents are looked at once."""
    for name in NAMES:
        aside = copy.parent / "aside"
        (copy / name).rename(aside) if (copy / name).is_file() else None
        place(kind, copy / name)
        with within(20):
            assert [fault for fault in file_faults(copy)[0] if name in fault], name
        (copy / name).rmdir() if kind == "folder" else (copy / name).unlink()
        aside.rename(copy / name) if aside.is_file() else None
    assert file_faults(copy)[0] == []
    for name in set(NAMES) - {schema.INFO, schema.MANIFEST}:  # by which a data set is known
        place(kind, copy / name)
    with within(60):
        faults = check(copy).faults
    told = [name for name in NAMES if any(fault.startswith(f"{name} is ") for fault in faults)]
    assert told == [name for name in NAMES if name not in (schema.INFO, schema.MANIFEST)]


def test_without_its_sums_the_other_faults_are_told_too(copy: Path) -> None:
    """The journal's hashes stand in; a table of sensitivities is no system error."""
    keep_sensitivities(copy)
    (copy / schema.CHECKSUMS).unlink()
    flip_a_bit(copy / PREVIEW)
    (copy / SPOT).unlink()
    faults = check(copy).faults
    assert len(faults) == 3
    assert "was not finished" in faults[0]
    assert {f"{SPOT} is missing", f"{PREVIEW} is damaged: its SHA-256 is not the listed one"} == set(faults[1:])


@pytest.mark.parametrize("line", [0, 3, -1])
def test_a_journal_that_is_missing_or_damaged_is_a_fault(copy: Path, line: int) -> None:
    path = copy / schema.JOURNAL
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join([*lines[:line], *lines[line:][1:]]))
    assert [fault for fault in file_faults(copy)[0] if fault.startswith("journal.txt is damaged")]
    path.unlink()
    assert tuple(file_faults(copy)[0]) == ("journal.txt is missing; `phibench dataset repair` writes it anew",)


def test_a_file_that_is_signed_anew_is_told_by_the_journal(copy: Path) -> None:
    flip_a_bit(copy / PREVIEW)
    write_checksums(copy)
    assert check(copy).faults == (f"{PREVIEW} is damaged: its SHA-256 is not that of journal.txt",)


def test_lost_info_is_a_fault_with_its_remedy(copy: Path) -> None:
    (copy / schema.INFO).unlink()
    [fault] = check(copy).faults
    assert fault == "dataset.json is missing; `phibench dataset repair` writes it anew"


def test_no_flipped_bit_goes_unseen(copy: Path) -> None:
    """Four bits of every kind of file, at random; tests/attack has the large sweep."""
    keep_sensitivities(copy)
    assert unseen_flips(copy, 4) == {}


def test_an_unfinished_data_set_is_found(copy: Path) -> None:
    (copy / schema.CHECKSUMS).unlink()
    [fault] = check(copy).faults
    assert "was not finished" in fault


def test_a_truth_that_the_parameters_do_not_give_is_found(copy: Path) -> None:
    """The last digits of one number, with manifest, table and hashes made to fit."""
    rows = read_manifest(copy)
    up = rows[0].up.model_copy(update={"u_px": rows[0].up.u_px + 1e-7})
    write_manifest(copy, [rows[0].model_copy(update={"up": up}), *rows[1:]])
    sign(copy)
    [fault] = check(copy).faults
    assert fault.startswith("seen-near-h0.500 up: u_px is")


@pytest.mark.parametrize("field", ["v_px", "phi_normal_rad", "place_world_m"])
def test_a_light_that_the_parameters_do_not_give_is_found(copy: Path, field: str) -> None:
    rows = read_manifest(copy)
    light = rows[0].up.light
    assert light is not None
    value = getattr(light, field)
    moved = (*value[:2], value[2] + 1e-6) if isinstance(value, tuple) else value + 1e-7
    up = rows[0].up.model_copy(update={"light": light.model_copy(update={field: moved})})
    write_manifest(copy, [rows[0].model_copy(update={"up": up}), *rows[1:]])
    sign(copy)
    [fault] = check(copy).faults
    assert fault.startswith("seen-near-h0.500 up: light is")


def test_a_depth_of_the_light_that_the_places_do_not_give_is_found(copy: Path) -> None:
    rows = read_manifest(copy)
    write_manifest(copy, [rows[0].model_copy(update={"light_depth_m": rows[0].light_depth_m + 1e-6}), *rows[1:]])
    sign(copy)
    [fault] = check(copy).faults
    assert fault.startswith("seen-near-h0.500: light_depth_m is")


def test_several_processes_find_what_one_does(kinds_dataset: Path, tmp_path: Path) -> None:
    """A fault in the last room; processes are started for it, which takes some seconds."""
    copy = Path(shutil.copytree(kinds_dataset, tmp_path / "copy"))
    rows = read_manifest(copy)
    assert len({row.room for row in rows}) > 1
    last = max(rows, key=lambda row: row.room)
    changed = last.model_copy(update={"light_depth_m": (last.light_depth_m or 1.0) + 1e-6})
    write_manifest(copy, [changed if row is last else row for row in rows])
    sign(copy)
    one, two = (verify(copy, False, Console(file=io.StringIO()), workers) for workers in (1, 2))
    assert [fault for fault in one.faults if fault.startswith(f"{last.sample_id}: light_depth_m is")]
    assert one.faults == two.faults


@pytest.mark.parametrize("workers", ["0", "-3"])
def test_fewer_than_one_process_is_refused(copy: Path, workers: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["dataset", "verify", str(copy), f"--workers={workers}"]) == 2
    assert capsys.readouterr().err.strip().endswith(f"--workers: workers = {workers}, at least 1 is needed")


def test_a_changed_rig_is_found(copy: Path) -> None:
    rig = json.loads((copy / schema.RIGS).read_text())
    rig["resolved"]["mirror"]["radius_m"] += 1e-6
    (copy / schema.RIGS).write_text(json.dumps(rig))
    sign(copy)
    faults = check(copy).faults
    assert any("u_px" in fault for fault in faults)
    assert any("phi_ray_rad" in fault for fault in faults)
    assert "rigs.jsonl: rig is not the rig that the recipe gives" in faults


def test_a_missing_row_is_found(copy: Path) -> None:
    info = json.loads((copy / schema.INFO).read_text())
    info["samples"] = 1
    (copy / schema.INFO).write_text(json.dumps(info))
    write_manifest(copy, read_manifest(copy)[:1])
    sign(copy)
    assert "manifest.jsonl: sample half-hidden-h1.400 of the recipe is missing" in check(copy).faults


def test_a_changed_pixel_truth_is_found_when_asked_for(copy: Path) -> None:
    dataset = open_dataset(copy)
    planes = read_truth(copy / TRUTH, dataset.rigs[dataset.info.poses[0].rig].at(0.5))
    planes["depth_m"][60:120, 100:200] *= 1.0 + 1e-5
    write_truth(copy / TRUTH, planes, {"dataset": "smallest", "pose": "h0.500", "offset_m": 0.5})
    sign(copy)
    assert check(copy).ok
    [fault] = check(copy, truth_layers=True).faults
    assert "depth_m is not what the parameters give" in fault


def test_what_is_no_data_set_raises(tmp_path: Path) -> None:
    for folder, words in ((tmp_path, "is not a data set"), (tmp_path / "none", "there is no folder")):
        with pytest.raises(DatasetError, match=words):
            check(folder)


def test_a_damaged_info_is_a_fault(copy: Path) -> None:
    truncate(copy / schema.INFO)
    assert len(check(copy).faults) == 2  # its hash, and that it cannot be read


def test_show_prints_a_table_and_draws_the_spots(copy: Path) -> None:
    console = Console(file=io.StringIO(), width=170)
    sheet = show(copy, console)
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert "seen-near-h0.500" in text
    assert "occluded:crate_red / yes" in text
    with Image.open(sheet) as image:
        assert image.size[0] > 400
        colours = {colour for _, colour in image.getcolors(1 << 24)}
    assert (0, 255, 80) in colours  # the mark
    assert check(copy).ok  # the sheet is not part of the data
    [hidden] = [row for row in read_manifest(copy) if not row.down.visible]
    assert hidden.up.noise is not None
    assert f"- / {np.degrees(hidden.up.noise.phi_sensor_rad):.2g} " in text  # one sigma for each image
    assert "certificates passed: 3 of 3" in text


@pytest.mark.parametrize("width", [60, 80, 100, 170])
def test_show_never_cuts_a_number_or_a_name(smallest_dataset: Path, tmp_path: Path, width: int) -> None:
    console = Console(file=io.StringIO(), width=width)
    show(smallest_dataset, console, out=tmp_path / "sheet.png")
    text = console.file.getvalue()  # type: ignore[attr-defined]
    shown = set(re.split(r"[\s,]+", text))
    for row in read_manifest(smallest_dataset):
        numbers = {f"{row.up.u_px:.2f}", f"{row.up.v_px:.2f}"}
        assert {row.sample_id, f"{row.depth_m:.3f}", f"{row.stroke_m:.3f}"} | numbers <= shown
    assert "occluded:crate_red" in shown
    table = text.split("contact sheet")[0].splitlines()
    assert width < 80 or max(map(len, table)) <= width
    assert (tmp_path / "sheet.png").stat().st_size > 1000


def test_a_sheet_that_cannot_be_written_is_said_after_the_table(smallest_dataset: Path, tmp_path: Path) -> None:
    console = Console(file=io.StringIO(), width=170)
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(DatasetError, match=r"contact sheet was not written.*--out") as caught:
        show(smallest_dataset, console, out=tmp_path / "file" / "sheet.png")
    assert "\n" not in str(caught.value)
    assert "seen-near-h0.500" in console.file.getvalue()  # type: ignore[attr-defined]


def test_the_sheet_is_written_when_the_reader_of_the_table_leaves(copy: Path) -> None:
    """As in `phibench dataset show DIR | head`."""
    command = [sys.executable, "-m", "phibench", "dataset", "show", str(copy)]
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "wb") as closed:
        child = subprocess.run(command, stdout=closed, stderr=subprocess.PIPE, text=True, timeout=120, check=False)
    assert child.returncode == 0, child.stderr
    assert "Traceback" not in child.stderr
    assert "Broken" not in child.stderr
    assert (copy / schema.CONTACT_SHEET).stat().st_size > 1000


def test_a_sheet_says_why_a_spot_is_hidden(smallest_dataset: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    said = []

    def captioned(picture: Picture, text: str) -> Picture:
        said.append(text)
        changed = pictures.captioned_picture(picture, text)
        assert np.count_nonzero(changed != picture) > 100
        return changed

    monkeypatch.setattr(show_module, "captioned_picture", captioned)
    show_module.contact_sheet(open_dataset(smallest_dataset), Console(file=io.StringIO()))
    [text] = said  # the other three spots are seen
    assert "occluded:crate_red" in text


def test_previews_mark_the_spot(smallest_dataset: Path) -> None:
    with Image.open(smallest_dataset / schema.preview_file("seen-near-h0.500")) as image:
        picture = np.asarray(image)
    for half in np.split(picture, 2, axis=1):
        marks = np.all(half == (0, 255, 80), axis=2)
        assert np.count_nonzero(marks) > 4 * 24  # the inset's frame and the crosses


def test_the_last_line_of_make_counts_what_can_be_used(smallest_dataset: Path) -> None:
    rows = read_manifest(smallest_dataset)
    assert visibility_line(rows) == (
        "1 of 2 pairs are visible in both images; not visible: down occluded:crate_red (1)"
    )
    assert visibility_line(rows[:1]) == "1 of 1 pairs are visible in both images"
