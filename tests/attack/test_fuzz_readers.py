"""Thousands of damaged files and command lines: each ends in an answer or in one sentence, soon.

A reader may raise `DatasetError` alone. A command may end with 0, 1 or 2. Code 3 is the guard of the command line for
what nobody has thought of: here it is a failure.
"""

from __future__ import annotations

import contextlib
import json
import random
import resource
import signal
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers.valid_files import (
    NASTY_TEXTS,
    Kind,
    changed,
    compact,
    damaged,
    digest,
    hostile,
    kinds,
    public_rows,
    read_sealed,
    write_sealed,
)
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from phibench.cli.main import main
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.read import open_finished
from phibench.datasets.store.checksums import checksums_text, read_checksums
from phibench.datasets.store.metadata import differences

PATIENCE_S = 60  # far above the slowest case, on a machine with other work
CPU_S = 10.0  # of one case
MOST_BYTES = 2e9  # resident, of the whole process
RSS_BYTES = 1 if sys.platform == "darwin" else 1024  # unit of ru_maxrss
KINDS = (
    *("recipe.toml", "settings.toml", "calibration.json", "score.json", "records.parquet", "layer.exr", "picture.png"),
    "panorama.jpg",
    *("submission.json", "truth.json", "study.json", "frames.jsonl", "journal.txt"),
    *("lightmap.npz", "entry.lightmap", "sensitivities.parquet"),
)
FEW, MANY = 8, 550  # cases of a kind: 18 x 8 and 2 500 command lines with 17 x 550 are above 100 and 10 000
SEEDS = st.integers(0, 2**64 - 1)
KEPT = {"database": None, "deadline": None, "derandomize": True, "suppress_health_check": list(HealthCheck)}


@contextlib.contextmanager
def soon() -> Iterator[None]:
    """A case that waits or works without end fails, and one that takes too much memory."""

    def late(number: int, _: object) -> None:
        raise AssertionError(f"no end: {signal.Signals(number).name}")

    clocks = {
        signal.SIGALRM: (signal.ITIMER_REAL, float(PATIENCE_S)),
        signal.SIGPROF: (signal.ITIMER_PROF, CPU_S),
    }
    before = {number: signal.signal(number, late) for number in clocks}
    try:
        for clock, seconds in clocks.values():
            signal.setitimer(clock, seconds)
        yield
    finally:
        for clock, _ in clocks.values():
            signal.setitimer(clock, 0.0)
        for number, handler in before.items():
            signal.signal(number, handler)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * RSS_BYTES < MOST_BYTES


@pytest.fixture(scope="module")
def valid(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Kind]:
    return kinds(tmp_path_factory.mktemp("valid"))


def sentence(text: str) -> None:
    """A message for a terminal: short lines that can be printed."""
    assert text
    assert len(text) < 20_000
    assert all(c.isprintable() or c == "\n" for c in text), ascii(text)


def outcome(read: object, path: Path) -> str:
    """ "read" or "refused"; anything else is a fault of the reader."""
    try:
        with soon():
            read(path)  # type: ignore[operator]
    except DatasetError as error:
        sentence(str(error))
        return "refused"
    return "read"


def fuzz_a_file(kind: Kind, folder: Path, cases: int, always_read: bool = False) -> None:
    found: Counter[str] = Counter()
    path = folder / kind.name
    path.parent.mkdir(parents=True, exist_ok=True)

    @settings(max_examples=cases, **KEPT)
    @given(SEEDS)
    def one(seed: int) -> None:
        path.write_bytes(hostile(kind, random.Random(seed)))
        found[outcome(kind.read, path)] += 1

    path.write_bytes(kind.data)
    assert outcome(kind.read, path) == "read"
    one()
    assert sum(found.values()) >= cases
    # damaged lines of a journal are passed over
    assert found["refused"] > cases // 10 or kind.name == "journal.txt" or always_read


@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS)
def test_a_damaged_file_is_read_or_refused(name: str, valid: dict[str, Kind], tmp_path: Path) -> None:
    fuzz_a_file(valid[name], tmp_path, FEW)


@pytest.mark.study
@pytest.mark.parametrize("name", KINDS)
def test_hundreds_of_damaged_files_are_read_or_refused(name: str, valid: dict[str, Kind], tmp_path: Path) -> None:
    fuzz_a_file(valid[name], tmp_path, MANY)


def fuzz_a_sealed_set(folder: Path, cases: int) -> None:
    found: Counter[str] = Counter()

    @settings(max_examples=cases, **KEPT)
    @given(SEEDS)
    def one(seed: int) -> None:
        rng = random.Random(seed)
        rows, seal = (changed(public_rows(), rng), {}) if rng.random() < 0.8 else (None, changed({"pairs": 2}, rng))
        if isinstance(rows, list | None) and isinstance(seal, dict):
            with contextlib.suppress(TypeError, UnicodeEncodeError):  # of a seal with other names of keys
                write_sealed(folder, rows, **seal)
        found[outcome(read_sealed, folder)] += 1

    write_sealed(folder)
    assert outcome(read_sealed, folder) == "read"
    one()
    assert found["refused"] > cases // 10


def test_a_sealed_set_with_strange_pairs_is_refused(tmp_path: Path) -> None:
    fuzz_a_sealed_set(tmp_path, FEW)


@pytest.mark.study
def test_hundreds_of_sealed_sets_with_strange_pairs_are_refused(tmp_path: Path) -> None:
    fuzz_a_sealed_set(tmp_path, MANY)


# -- the command line ----------------------------------------------------------------------------------------------

COMMANDS = (
    *(("dataset", "make", "{}", "--dry-run", "--out", "{}"), ("dataset", "make", "smoke", "--dry-run", "--out", "{}")),
    *(("dataset", word, "{}") for word in ("verify", "show", "repair", "sensitivities")),
    *(("dataset", "merge", "{}", "--out", "{}"), ("dataset", "frames", "{}"), ("dataset", "panorama", "{}")),
    *(("score", "{}", "--method", "{}"), ("compare", "{}", "{}"), ("report", "{}", "--out", "{}")),
    *(("seal", "make", "{}", "--out", "{}"), ("seal", "submit", "{}", "--method", "{}", "--out", "{}")),
    *(("seal", "open", "{}", "--truth", "{}", "--submission", "{}"), ("calibrate", "{}", "--out", "{}")),
    *(("align", "{}"), ("paper", "{}"), ("study", "{}", "--out", "{}"), ("method", "check", "--method", "{}")),
    *(("method", "new", "{}"), ("{}",), ("dataset", "{}"), ("bench", "{}", "--out", "{}")),
)
OPTIONS = (
    *("--out", "--workers", "--shard", "--samples", "--seed", "--preset", "--draws", "--sample", "--exposure"),
    *("--region", "--camera-seed", "--pairs", "--boxes", "--rank", "--bootstrap-seed", "--calibration", "--seconds"),
    *("--memory-mb", "--study", "--picture", "--radius-mm", "--focal-px", "--position", "--by", "--width", "--rig"),
)
VALUES = (
    *(text for text in NASTY_TEXTS if text != "[" * 100_000),
    *("1/" + "9" * 5000, "0/0", "1/2", "1/0", "²/³", "inf", "-inf", "1e400", "1e-400", "0x10", "1_0", "٣", "{}", "--"),
    *("\udcff", "/dev/zero", "/dev/null", ".", "..", "/", "~", "file.py:extract", "a.py", "nope.json", "paper", "-"),
    *("red_centroid", "mjpeg", "auto", "1", "0", "1.5", "[bold]x[/bold]", ":smile:", "x" * 300, "/proc/self/mem"),
)


def command_line(rng: random.Random, files: list[str]) -> list[str]:
    def value() -> str:
        return rng.choice(files) if files and rng.random() < 0.4 else rng.choice(VALUES)

    tokens = [value() if word == "{}" else word for word in rng.choice(COMMANDS)]
    for _ in range(rng.randrange(3)):
        tokens += [rng.choice(OPTIONS), value()]
    return tokens


def fuzz_the_command_line(valid: dict[str, Kind], folder: Path, cases: int) -> None:
    codes: Counter[int] = Counter()
    for kind in valid.values():
        (folder / kind.name).write_bytes(kind.data)
    write_sealed(folder / "public")
    files = [*valid, "public", "."]

    @settings(max_examples=cases, **KEPT)
    @given(SEEDS)
    def one(seed: int) -> None:
        rng = random.Random(seed)
        tokens = command_line(rng, files)
        kind = rng.choice(list(valid.values()))
        (folder / kind.name).write_bytes(hostile(kind, rng) if rng.random() < 0.5 else kind.data)
        with soon():
            code = main(tokens)
        assert code in (0, 1, 2), tokens
        codes[code] += 1

    one()
    assert codes[2] > cases // 2


def test_a_strange_command_line_ends_in_a_sentence(
    valid: dict[str, Kind], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    fuzz_the_command_line(valid, tmp_path, FEW)
    assert "Traceback" not in capsys.readouterr().err


@pytest.mark.study
def test_thousands_of_strange_command_lines_end_in_a_sentence(
    valid: dict[str, Kind], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    fuzz_the_command_line(valid, tmp_path, 2500)
    assert "Traceback" not in capsys.readouterr().err


# -- data sets -----------------------------------------------------------------------------------------------------

SMALL = ("dataset.json", "manifest.jsonl", "rigs.jsonl", "rooms.jsonl")


def read_dataset(folder: Path) -> None:
    """Everything that a reader does with the small files; layers are in other tests."""
    dataset = open_finished(folder)
    for sample in dataset:
        assert sample.rig.at(0.0) is not None
        assert sample.room.name
        assert sample.laser_spot.diameter_m > 0.0
        assert sample.stream_names
    assert repr(dataset)
    assert dataset.to_polars().height == len(dataset)
    assert differences(folder, dataset.rows) is not None
    assert dataset.beam is not None


def fuzz_a_dataset(source: Path, folder: Path, cases: int) -> None:
    """Small files with faults under hashes that fit."""
    found: Counter[str] = Counter()
    valid = {path.name: path.read_bytes() for path in source.iterdir() if path.is_file()}
    hashes = read_checksums(source)

    @settings(max_examples=cases, **KEPT)
    @given(SEEDS)
    def one(seed: int) -> None:
        rng = random.Random(seed)
        name = rng.choice(SMALL)
        lines = valid[name].splitlines() if name.endswith("l") else [valid[name]]
        k = rng.randrange(len(lines))
        lines[k] = compact(changed(json.loads(lines[k]), rng)) if rng.random() < 0.8 else damaged(lines[k], rng)
        files = {**valid, name: b"\n".join(lines) + b"\n"}
        for file in SMALL:
            (folder / file).write_bytes(files[file])
        listed = {**hashes, name: digest(files[name])}
        (folder / "SHA256SUMS").write_text(checksums_text(listed))
        found[outcome(read_dataset, folder)] += 1

    for file, data in valid.items():
        (folder / file).write_bytes(data)
    assert outcome(read_dataset, folder) == "read"
    one()
    assert found["refused"] > cases // 10


def test_a_data_set_with_strange_documents_is_refused(smallest_dataset: Path, tmp_path: Path) -> None:
    fuzz_a_dataset(smallest_dataset, tmp_path, FEW)


@pytest.mark.study
def test_hundreds_of_data_sets_with_strange_documents_are_refused(smallest_dataset: Path, tmp_path: Path) -> None:
    fuzz_a_dataset(smallest_dataset, tmp_path, MANY)
