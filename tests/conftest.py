"""What several test files share."""

import gc
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Generator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

# before NumPy is loaded: small matrices gain nothing from threads, and lose much where tests share the cores
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import pytest  # noqa: E402
from filelock import FileLock  # noqa: E402
from helpers.inline_workers import PROBE, InlineWorkerPool, make_inline, nothing  # noqa: E402

ROOT = Path(__file__).resolve().parent.parent


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options that ask for more than the quick tests."""
    parser.addoption("--slow", action="store_true", help="run the tests marked slow too, but those of many minutes")
    parser.addoption("--study", action="store_true", help="run the tests of many minutes too (marked study)")


PROOFS = "accuracy"
"""Word of the tests that README offers as proofs: `pytest -k accuracy`."""


@pytest.hookimpl(tryfirst=True)  # before pytest-xdist reads the number of processes
def pytest_cmdline_main(config: pytest.Config) -> None:
    """Let two processes share the proofs, unless `-n`, `-s` or `--pdb` is given."""
    option = config.option
    given = getattr(option, "numprocesses", 0) is not None or option.capture == "no" or option.usepdb
    if option.keyword == PROOFS and not given and "PYTEST_XDIST_WORKER" not in os.environ:
        option.numprocesses, option.dist = min(2, os.cpu_count() or 1), "worksteal"


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Collect tests without looking for garbage, and never look at modules and tests again: they all stay."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave unread, of the proofs, test files without the word: reading all takes as long as ten of them."""
    if config.option.keyword != PROOFS or not collection_path.name.startswith("test_"):
        return None
    inside = PROOFS in collection_path.relative_to(ROOT).as_posix()
    return None if inside or PROOFS in collection_path.read_text(encoding="utf-8").lower() else True


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out slow tests and benchmarks unless they are asked for: by an option, or by their full name."""
    named = [argument.removeprefix("./") for argument in config.args if "::" in argument]
    timed = config.getoption("benchmark_enable") or config.getoption("slow")
    wanted, left_out = [], []
    for item in items:
        # a test marked study may be marked slow as well: --study runs it
        mark = next((name for name in ("study", "slow") if item.get_closest_marker(name)), None)
        timing = "benchmark" in getattr(item, "fixturenames", ()) and not timed
        asked = any(item.nodeid.startswith(name) for name in named)
        (left_out if ((mark and not config.getoption(mark)) or timing) and not asked else wanted).append(item)
    if left_out:
        config.hook.pytest_deselected(items=left_out)
        items[:] = wanted


@pytest.fixture
def python() -> Callable[..., subprocess.CompletedProcess[str]]:
    """Run code in a fresh interpreter, from the root of the checkout; keywords set environment variables."""

    def run(code: str, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-c", code, *arguments]
        merged = {**os.environ, **environment}
        return subprocess.run(command, cwd=ROOT, env=merged, capture_output=True, text=True, timeout=300, check=False)

    return run


@pytest.fixture
def inline(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let `make` do its tasks in this process."""
    monkeypatch.setattr("phibench.datasets.make.WorkerPool", InlineWorkerPool)
    monkeypatch.setattr(PROBE, nothing)


class SharedFolder:
    """Folder of one test run for what several test processes use, each thing made by the first that wants it."""

    def __init__(self, factory: pytest.TempPathFactory) -> None:
        base = factory.getbasetemp()
        self.folder = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base

    def made(self, name: str, make: Callable[[Path], object]) -> Path:
        """Folder `name`, filled by `make`, which gets a path that is not there yet; without Mitsuba a skip."""
        if find_spec("mitsuba") is None:  # imported it must not be before its LLVM is chosen
            pytest.skip("nothing renders here: Mitsuba is not installed")
        out = self.folder / f"shared-{name}"
        with FileLock(out.with_suffix(".lock")):
            if not out.exists():
                make(out.with_suffix(".part"))
                out.with_suffix(".part").rename(out)
        return out


@pytest.fixture(scope="session")
def shared(tmp_path_factory: pytest.TempPathFactory) -> SharedFolder:
    """What test processes share."""
    return SharedFolder(tmp_path_factory)


def rendered(shared: SharedFolder, name: str, recipe: str | Path) -> Path:
    """Data set of a recipe, rendered once for all test processes. Read only: copy it to change it."""
    return shared.made(name, lambda out: make_inline(recipe, out))


@pytest.fixture(scope="session")
def tiny_dataset(shared: SharedFolder) -> Path:
    """Data set of `tests/tiny.toml`. Read only."""
    return rendered(shared, "tiny", ROOT / "tests" / "tiny.toml")


@pytest.fixture(scope="session")
def smallest_dataset(shared: SharedFolder) -> Path:
    """Data set of `tests/smallest.toml`. Read only."""
    return rendered(shared, "smallest", ROOT / "tests" / "smallest.toml")


@pytest.fixture(scope="session")
def misaligned_dataset(shared: SharedFolder, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Data set of `tests/tiny.toml` with a tilt, a decentre, a form, a stroke too long and a yaw between the images."""
    folder, text = tmp_path_factory.mktemp("misaligned"), (ROOT / "tests" / "tiny.toml").read_text(encoding="utf-8")
    wrong = (
        "tilt_x_rad = 0.01",
        "decentre_y_m = 2e-3",
        "form_31c_m = 5e-5",
        "stroke_relative = 0.01",
        "yaw_rad = 0.02",
    )
    table = "\n".join(("[misalignment]", *wrong, "", ""))
    (folder / "recipe.toml").write_text(text.replace("[[targets]]", f"{table}[[targets]]", 1), encoding="utf-8")
    return rendered(shared, "misaligned", folder / "recipe.toml")


def filmed(shared: SharedFolder, name: str, changes: dict[str, str], alone: bool = False) -> Path:
    """Films of `tests/films.toml` with changes, made once for all test processes. Read only.

    `alone`: without vibration and other lights.
    """
    from helpers.remembered_spots import SPOTS

    from phibench.datasets.film.film_make import make_films

    SPOTS.folder = shared.folder / "spots-of-films"

    def make(out: Path) -> None:
        recipe, text = out.with_suffix(".toml"), (ROOT / "tests" / "films.toml").read_text(encoding="utf-8")
        for old, new in changes.items():
            assert old in text
            text = text.replace(old, new)
        recipe.write_text(text.split("[[film.vibration]]")[0] if alone else text, encoding="utf-8")
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("phibench.datasets.film.film_task.frame_spots", SPOTS)
            make_films(recipe, out, 1)

    return shared.made(name, make)


@pytest.fixture(scope="session")
def film_windows(shared: SharedFolder) -> Path:
    """Films of windows around the spot. Read only."""
    return filmed(shared, "films-windows", {})


_MOVES = "window_px = 24\nspeed_m_per_s = 1.0\nacceleration_m_per_s2 = 4.0\n"
_RESTS = f"{_MOVES}pauses_s = [0.6, 0.6]\n"
_BLINKING = f'frames = 10\n{_MOVES}pauses_s = [0.2, 0.1]\ncode = "110"\nbit_s = 0.2\n'


@pytest.fixture(scope="session")
def film_with_rests(shared: SharedFolder) -> Path:
    """Film with a laser that is on all the time, and with rests of some frames."""
    return filmed(shared, "films-rests", {_BLINKING: _RESTS})


@pytest.fixture(scope="session")
def film_processed(shared: SharedFolder) -> Path:
    """The same for processed frames: whole units of a JPEG, a spot below the full well, and nothing else that moves."""
    changes = {_BLINKING: _RESTS, "height_px = 90": "height_px = 96", "power_w = 64e-3": "power_w = 40e-3"}
    return filmed(shared, "films-processed", changes, alone=True)


@pytest.fixture(scope="session")
def film_images(shared: SharedFolder) -> Path:
    """The same as whole images. Read only."""
    return filmed(shared, "films-images", {"window_px = 24": 'view = "full"'})


@pytest.fixture(scope="session")
def smoke_dataset(shared: SharedFolder) -> Path:
    """Data set of the shipped recipe `smoke`. Read only."""
    return rendered(shared, "smoke", "smoke")


@pytest.fixture(scope="session")
def bench_dataset(shared: SharedFolder) -> Path:
    """Data set of `tests/tiny_bench.toml`. Read only."""
    return rendered(shared, "bench", ROOT / "tests" / "tiny_bench.toml")


@pytest.fixture(scope="session")
def secret_dataset(bench_dataset: Path, shared: SharedFolder) -> Path:
    """The same with a seed of 128 bits, which sealing asks for. Read only."""
    from helpers.sealed_sets import with_secret_seed

    return shared.made("secret", lambda out: with_secret_seed(bench_dataset, out))


@pytest.fixture(scope="session")
def kinds_dataset(shared: SharedFolder) -> Path:
    """Data set of `tests/tiny_kinds.toml`: a generated room, a panorama and a mesh. Read only."""
    return rendered(shared, "kinds", ROOT / "tests" / "tiny_kinds.toml")


@pytest.fixture(scope="session")
def method(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Reference of a method in a file: the brightest pixel; it fails on pair 1."""
    from helpers.sealed_sets import METHOD

    file = tmp_path_factory.mktemp("method") / "mine.py"
    file.write_text(METHOD)
    return f"{file}:extract"


@pytest.fixture(scope="session")
def sealed(secret_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Sealed set of 3 pairs, one of each sample, with its truth. Read only: copy it to change it."""
    from rich.console import Console

    from phibench.benchmark.sealed.sealed_set import seal

    folder = tmp_path_factory.mktemp("private")
    shutil.copytree(secret_dataset, folder / "set")
    return seal(folder / "set", folder / "public", console=Console(quiet=True))


@pytest.fixture(scope="session")
def submitted(sealed: Any, method: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Submission of `method` to `sealed`."""
    from phibench.benchmark.scores.score_document import Declared
    from phibench.benchmark.sealed.submission import submit

    out = tmp_path_factory.mktemp("submission") / "submission.json"
    done = submit(sealed.public, method, out, declared=Declared("closed"))
    assert (done.pairs, done.answered) == (3, 2)
    return out
