"""Attacks on readers and command line, one by one: what was done, and words of the sentence that must answer it."""

from __future__ import annotations

import json
import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import polars
import pytest
from helpers.bench_cases import cases, outcomes, truth_itself
from helpers.valid_files import NASTY_TEXTS, compact, digest, nested, png, public_rows, read_sealed, write_sealed

from phibench.benchmark.isolation.method_references import Reference, resolve
from phibench.benchmark.isolation.run_limits import MethodError
from phibench.benchmark.sealed.sealed_set import read_seal
from phibench.benchmark.sealed.submission import SealedPairs, outcomes_of, read_submission, submission
from phibench.calibration.captures.picture_files import read_picture
from phibench.calibration.rig.bundle import Bundle
from phibench.calibration.rig.calibration_file import read_calibration, write_calibration
from phibench.cli.main import main
from phibench.datasets.build.dataset_build import held_head, refuse_other
from phibench.datasets.build.journal import Entry, FolderHead, Journal
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import DEPTH, InputFile
from phibench.datasets.plan.plan import parse_shard
from phibench.datasets.recipe.load import load_recipe
from phibench.datasets.store.checksums import read_checksums
from phibench.datasets.store.json_forms import from_json, to_json
from phibench.datasets.store.layers import read_exr, write_exr
from phibench.datasets.store.metadata import read_rigs
from phibench.estimator.geometry.rig_parameters import PARAMETERS
from phibench.estimator.interface import Outcome
from phibench.scenes.rig import Rig
from phibench.scenes.validation import nearest


def refusal(read: Callable[[], object]) -> str:
    with pytest.raises((DatasetError, MethodError)) as caught:
        read()
    message = str(caught.value)
    assert all(c.isprintable() for c in message), ascii(message)
    assert len(message) < 2000
    return message


def written(path: Path, data: str | bytes) -> Path:
    path.write_bytes(data if isinstance(data, bytes) else data.encode("utf-8", "surrogatepass"))
    return path


# -- documents -----------------------------------------------------------------------------------------------------

TOML = (
    ("a = " + "9" * 5000, "not valid TOML"),
    ("a = " + "9" * 400, "more than 40 digits"),
    ("a = " + "[" * 5000, "nested deeper"),
    ("a = " + "[" * (DEPTH + 1) + "]" * (DEPTH + 1), "nested deeper"),
    (".".join("a" * 100_000) + " = 1", "more than 32 parts"),
    ("#" * 2_000_000, "larger than 1 MiB"),
    (b"\xff\xfe", "not UTF-8"),
)


@pytest.mark.parametrize(("text", "words"), TOML, ids=[words for _, words in TOML])
def test_toml_beyond_all_bounds(text: str | bytes, words: str, tmp_path: Path) -> None:
    assert words in refusal(lambda: load_recipe(written(tmp_path / "a.toml", text)))


JSON = (
    ("[" * 100_000, "nested deeper"),
    ('{"a": ' + "[" * 1000 + "]" * 1000 + "}", "nested deeper"),
    ('{"a": 1e999}', "not a finite number"),
    ('{"a": NaN}', "not a finite number"),
    ('{"a": ' + "9" * 5000 + "}", "not JSON"),
    ('{"a": [0, ' + "9" * 41 + "]}", "a.1 is a number of more than 40 digits"),
    ('{"a": 1, "a": 2}', "'a' twice"),
    ('{"a": "\\ud800"}', "surrogate"),
    ('{"' + "k" * 500 + '": 1}', "a key of more than 200"),
    ("[]", "JSON object"),
    ("\x1b[31m", "not JSON"),
    ("", "not JSON"),
)


@pytest.mark.parametrize(("text", "words"), JSON, ids=range(len(JSON)))
def test_json_beyond_all_bounds(text: str, words: str, tmp_path: Path) -> None:
    file = InputFile(written(tmp_path / "a.json", text), "write it again")
    message = refusal(file.json)
    assert words in message
    assert message.startswith(str(file.path))
    assert message.endswith("; write it again")


def test_pipes_devices_folders_and_large_files_are_not_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    large = tmp_path / "large"
    with large.open("wb") as file:
        file.truncate(1 << 40)  # takes no room on the disk
    for path, words in ((tmp_path / "pipe", "no ordinary file"), (Path("/dev/zero"), "no ordinary file")):
        assert words in refusal(InputFile(path, "give a file").read)
    assert "larger than 512 MiB" in refusal(InputFile(large, "give a file").read)
    assert "it is a folder" in refusal(InputFile(tmp_path, "give a file").read)
    assert "null byte" in refusal(InputFile(Path("a\0b"), "give a file").read)
    assert "pipe" in refusal(lambda: read_picture(tmp_path / "pipe"))


def test_a_table_of_other_columns_types_or_bytes(tmp_path: Path) -> None:
    polars.DataFrame({"a": [1.0], "b": ["x"]}).write_parquet(tmp_path / "t")
    file = InputFile(tmp_path / "t", "write it again")
    assert file.table({"a": polars.Float64(), "b": polars.String()}).shape == (1, 2)
    assert "no column 'c'" in refusal(lambda: file.table({"c": polars.Float64()}))
    assert "of type Float64, not Int64" in refusal(lambda: file.table({"a": polars.Int64()}))
    written(tmp_path / "t", b"PAR1" + b"\xff" * 40 + b"PAR1")
    assert "cannot be read" in refusal(file.table)


# -- pictures and layers -------------------------------------------------------------------------------------------


def declared(width: int, height: int) -> bytes:
    """PNG of a few bytes that says it has so many pixels."""
    head = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    good = png()
    return good[:12] + head + struct.pack(">I", zlib.crc32(head)) + good[33:]


@pytest.mark.parametrize(("width", "height"), [(60_000, 60_000), (10_000, 10_000), (2**31 - 1, 1)])
def test_a_picture_that_declares_more_pixels_than_memory(width: int, height: int, tmp_path: Path) -> None:
    path = written(tmp_path / "a.png", declared(width, height))
    assert "pixels" in refusal(lambda: read_picture(path))
    assert main(["align", str(path)]) == 2


def test_a_layer_that_declares_more_pixels_than_memory(tmp_path: Path) -> None:
    path = write_exr(tmp_path / "a.exr", {"R": np.ones((2, 3))}, {"kind": "ambient"})
    window = struct.pack("<4i", 0, 0, 2, 1)
    data = path.read_bytes()
    assert data.count(window) == 2  # data window and display window
    written(path, data.replace(window, struct.pack("<4i", 0, 0, 60_000, 60_000)))
    assert "is damaged" in refusal(lambda: read_exr(path))


# -- sealed sets ---------------------------------------------------------------------------------------------------


def rows(**changes: Any) -> list[Any]:
    return [{**row, **changes} for row in public_rows()]


DEFAULT_RIG = {key: value for key, value in to_json(Rig()).items() if key != "motion"}
PAIRS = (
    (rows(files={"down": "/etc/passwd", "up": "frames/000000-up.png"}), "no name of a file below the folder"),
    (rows(files={"down": "../x.png", "up": "frames/000000-up.png"}), "no name of a file below the folder"),
    (rows(files={"down": "seal.json", "up": "frames/000000-up.png"}), "does not lie in frames/"),
    (rows(files={"up": "frames/000000-up.png"}), "the images down and up are needed"),
    (rows(rig={}), "lacks the field T_camera_sphere"),
    (rows(rig=DEFAULT_RIG), "lacks the field motion"),
    (rows(rig={**to_json(Rig()), "evil": 1}), "has the field evil"),
    (rows(beam={}), "lacks the field diameter_base_m"),
    (rows(stroke_m=-1.0), "stroke_m"),
    (rows(number=-1), "number"),
    ([nested(300)] * 2, "damaged"),
)


@pytest.mark.parametrize(("lines", "words"), PAIRS, ids=range(len(PAIRS)))
def test_pairs_that_nobody_sealed(lines: list[Any], words: str, tmp_path: Path) -> None:
    message = refusal(lambda: read_sealed(write_sealed(tmp_path / "public", lines)))
    assert words in message
    assert "pairs.jsonl line 1" in message


@pytest.mark.parametrize("pairs", [-1, 0, 10**9, 2.0, None])
def test_a_seal_of_so_many_pairs(pairs: Any, tmp_path: Path) -> None:
    assert "pairs" in refusal(lambda: read_seal(write_sealed(tmp_path / "public", pairs=pairs)))


def test_a_sealed_picture_of_another_size(tmp_path: Path) -> None:
    folder = write_sealed(tmp_path / "public", picture=png(65, 48))
    assert "65 x 48 pixels" in refusal(lambda: SealedPairs(folder).pair(0))
    write_sealed(folder, picture=declared(60_000, 60_000))
    assert "pixels" in refusal(lambda: SealedPairs(folder).pair(0))


@pytest.mark.parametrize("name", ["/etc/passwd", "../../x", "a/../../x", "frames/\x1b[31m", ""])
def test_a_list_of_hashes_that_leads_out_of_its_folder(name: str, tmp_path: Path) -> None:
    written(tmp_path / "SHA256SUMS", f"{'0' * 64}  {name}\n")
    assert "SHA256SUMS line 1" in refusal(lambda: read_checksums(tmp_path))


# -- submissions ---------------------------------------------------------------------------------------------------


def a_submission(path: Path, **method: Any) -> Path:
    seal = read_seal(write_sealed(path.parent / "public"))
    document = submission(seal, Reference("mine", "built-in", "here"), outcomes(cases(2), truth_itself))
    plain = document.model_dump(mode="json")
    return written(path, compact({**plain, "method": {**plain["method"], **method}}))


@pytest.mark.parametrize("name", ["\x1b[31mred", "[" * 100_000, "a\nb", "\u202eabc", 7])
def test_a_submission_with_a_strange_name(name: Any, tmp_path: Path) -> None:
    assert "method" in refusal(lambda: read_submission(a_submission(tmp_path / "a.json", name=name)))


@pytest.mark.parametrize("name", [r"$\frac{1}$", "[/b]", "[red]mine[/red]", ":smile:"])
def test_a_name_is_shown_as_it_is(name: str, tmp_path: Path) -> None:
    assert read_submission(a_submission(tmp_path / "a.json", name=name)).method.name == name


def test_a_submission_carries_no_folders_of_its_user(tmp_path: Path) -> None:
    text = f"FileNotFoundError: '/home/alice/secret project/model.pt', {tmp_path}/x.npy and C:\\Users\\alice\\y.npy"
    seal = read_seal(write_sealed(tmp_path / "public"))
    fault = Outcome(0, None, 0.1, "error", text)
    document = submission(seal, Reference("mine", "built-in", "here"), [fault])
    message = document.answers[0].message
    assert "alice" not in message
    assert str(tmp_path) not in message
    assert "x.npy" in message


def test_an_answer_with_escape_codes_is_escaped(tmp_path: Path) -> None:
    path = a_submission(tmp_path / "a.json")
    document = json.loads(path.read_bytes())
    document["answers"][0]["down"]["status"] = "\x1b[2J" + "[" * 100_000
    status = outcomes_of(read_submission(written(path, compact(document))))[0].answer
    assert status is None or (status.down.status.isprintable() and len(status.down.status) <= 2000)


# -- calibrations, rigs, journals ----------------------------------------------------------------------------------


def test_a_ragged_covariance(tmp_path: Path) -> None:
    p = len(PARAMETERS)
    path = tmp_path / "calibration.json"
    write_calibration(path, Bundle(Rig(), np.zeros(p), np.eye(p) * 1e-6, 1.0, 2), Rig(), {})
    document = json.loads(path.read_bytes())
    document["covariance"][3] = [1.0, 2.0]
    assert "its hash does not fit" in refusal(lambda: read_calibration(written(path, compact(document))))
    content = {key: value for key, value in document.items() if key != "sha256"}
    document["sha256"] = digest(json.dumps(content, sort_keys=True, separators=(",", ":")).encode())
    assert "other parameters" in refusal(lambda: read_calibration(written(path, compact(document))))


@pytest.mark.parametrize("leave_out", ["camera", "mirror", "T_world_camera", "stroke_axis_world"])
def test_no_field_of_a_stored_rig_has_a_default(leave_out: str) -> None:
    rig = Rig()
    assert from_json(Rig, to_json(rig)) == rig
    document = {key: value for key, value in to_json(rig).items() if key != leave_out}
    assert f"lacks the field {leave_out}" in refusal(lambda: from_json(Rig, document))
    inner = {**to_json(rig), "camera": {**to_json(rig)["camera"], "width_px": 10**9}}
    assert "allowed range is 1 to 20000" in refusal(lambda: from_json(Rig, inner))


def test_a_journal_with_strange_entries_counts_as_damaged(tmp_path: Path) -> None:
    with Journal(tmp_path) as journal:
        journal.begin(FolderHead("{}", ""), [])
        journal.add(Entry("spot a", "k", {"spots/a-down.exr": "0" * 64}, None))
    for text in (
        '{"task": "x", "key": "k", "files": {"../../x": "h"}}',
        '{"info": 1, "recipe": []}',
        "[]",
        "null",
        "{}",
    ):
        line = text.encode()
        with (tmp_path / "journal.txt").open("ab") as file:
            file.write(b"%08x %b\n" % (zlib.crc32(line), line))
    journal = Journal(tmp_path)
    assert list(journal.entries) == ["spot a"]
    assert journal.damaged == [3, 4, 5, 6, 7]
    head = held_head(tmp_path)
    assert head is not None
    assert "dataset.json" in refusal(lambda: refuse_other(tmp_path, "a"))


# -- the command line ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shard", ["1/" + "9" * 5000, "9" * 5000, "²/³", "0/1", "1/0", "-1/2", "1/2/3", "١/٢"])
def test_a_shard_that_is_none(shard: str) -> None:
    assert "must be i/n" in refusal(lambda: parse_shard(shard))


@pytest.mark.parametrize(
    "text",
    ["-" * 100_000 + "1", "(" * 100_000, "a." * 100_000 + "b", "+".join(["1"] * 100_000), "\0", "9" * 5000 + ".real"],
    ids=["minus", "brackets", "attributes", "sum", "zero byte", "digits"],
)
def test_a_method_that_python_cannot_read(text: str, tmp_path: Path) -> None:
    path = written(tmp_path / "mine.py", f"def f(pair):\n    return {text}\n")
    assert "mine.py" in refusal(lambda: resolve(f"{path}:f"))


@pytest.mark.parametrize("name", [name for name in NASTY_TEXTS if len(name) < 200])
def test_a_path_is_said_as_it_is_given(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["dataset", "show", f"nowhere/{name}"]) in (1, 2)
    out, err = capsys.readouterr()
    assert "Traceback" not in out + err
    assert all(c.isprintable() or c == "\n" for c in err)
    if name == "[/b]":
        assert "nowhere/[/b]" in err


@pytest.mark.parametrize("out", [".", "/", "folder", ".."])
def test_a_file_to_write_that_is_a_folder(
    out: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Found by the fuzzer: "." and "/" have no name to which the ending of a picture could be given."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder").mkdir()
    assert main(["calibrate", "nope", "--out", out]) == 2
    assert "it is a folder; give the name of a file" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize("name", ["\0", "\x1b[31m", "a" * 201])
def test_a_rig_with_a_strange_name(name: str, tmp_path: Path) -> None:
    """Found by the fuzzer: a list of the known rigs held it as it was."""
    (tmp_path / "rigs.jsonl").write_text(json.dumps({"rig": name, "resolved": {}}) + "\n")
    with pytest.raises(DatasetError, match=r"rigs\.jsonl line 1 is damaged: rig: ") as caught:
        read_rigs(tmp_path)
    assert str(caught.value).isprintable()
    assert nearest("rig", [name]).isprintable()


def test_an_output_that_is_no_utf_8(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["dataset", "make", "smoke", "--out", os.fsdecode(b"a\xff")]) == 2
    assert "'a\\udcff' is not UTF-8" in capsys.readouterr().err


def test_progress_into_a_folder_called_like_markup(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from phibench.datasets.common.progress import progress_console

    progress_console().print(f"{tmp_path}/[/b]/:smile: is complete", soft_wrap=True)
    assert "/[/b]/:smile: is complete" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("scheduler", ["[/b]", "tcp://[", "nowhere:70000", "x" * 5000, "ftp://a:1", "1", "{}"])
def test_a_nonsense_scheduler(scheduler: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recipe = Path(__file__).parents[1] / "smallest.toml"
    assert main(["dataset", "make", str(recipe), "--out", str(tmp_path / "a"), "--scheduler", scheduler]) == 2
    assert "Traceback" not in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["nonsense", "[/b]", "scalar_mono_polarized", "\x1b[31m", "a" * 5000])
def test_a_wrong_variant(
    variant: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PHIBENCH_VARIANT", variant)
    recipe = Path(__file__).parents[1] / "smallest.toml"
    assert main(["dataset", "make", str(recipe), "--out", str(tmp_path / "a")]) == 2
    err = capsys.readouterr().err
    assert "Traceback" not in err
    assert "variant" in err
