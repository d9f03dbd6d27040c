"""Pairs made ahead by other processes: the same pairs and truths, in any order, and nothing left of the processes."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import time
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.processes import quiet

from phibench.benchmark.isolation.easy_pairs import EasyPairs
from phibench.benchmark.isolation.prefetched_pairs import PrefetchedPairs
from phibench.benchmark.pair_sets.dataset_pairs import dataset_pairs
from phibench.benchmark.scores import score as scoring
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.read import open_finished
from phibench.estimator.interface import Pair
from phibench.estimator.pair_set import PairSet, PairTruth


def assert_same_pair(one: Pair, other: Pair) -> None:
    assert one.images.keys() == other.images.keys()
    for name, image in one.images.items():
        there = other.images[name]
        assert (image.dtype, image.shape, image.tobytes()) == (there.dtype, there.shape, there.tobytes())
        assert not image.flags.writeable
    plain = [field.name for field in fields(Pair) if field.name not in one.images and field.repr]
    assert [getattr(one, name) for name in plain] == [getattr(other, name) for name in plain]


def assert_same_truth(one: PairTruth, other: PairTruth) -> None:
    for position in ("down", "up"):
        for name, value in vars(getattr(one, position)).items():
            np.testing.assert_equal(value, getattr(getattr(other, position), name))
    assert (one.number, one.depth_m, one.true_rig) == (other.number, other.depth_m, other.true_rig)


def assert_same(made: PairSet, plain: PairSet, number: int) -> None:
    assert_same_pair(made.pair(number), plain.pair(number))
    assert_same_truth(made.truth(number), plain.truth(number))


@pytest.mark.slow
def test_pairs_and_truths_are_those_of_the_set_in_any_order() -> None:
    plain = EasyPairs("bayer-raw", count=5)
    with PrefetchedPairs(plain, 2) as made:
        assert len(made) == 5
        for number in (*range(5), 4, 0, 3, 3, 2):  # in order, then the last one again, back, ahead, twice
            assert_same(made, plain, number)
        assert_same_truth(made.truth(1), plain.truth(1))  # of a pair that nobody asked for


@pytest.mark.slow
def test_pairs_of_a_data_set_are_the_same_bytes(bench_dataset: Path) -> None:
    """Pictures, with boxes; the test above has raw images."""
    plain = dataset_pairs(open_finished(bench_dataset), "mjpeg", boxes_px=64)
    with PrefetchedPairs(plain, 2) as made:
        for number in range(len(plain)):
            assert_same(made, plain, number)
        assert made.document() == plain.document()
        assert made.folders == plain.folders
        assert min(made.seconds.values()) > 0.0


@pytest.mark.slow
def test_a_score_does_not_depend_on_who_makes_the_pairs(bench_dataset: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    began: list[int] = []
    start = PrefetchedPairs.__init__
    monkeypatch.setattr(
        PrefetchedPairs, "__init__", lambda self, *given: (began.append(given[1]), start(self, *given))[1]
    )

    def scored(workers: int) -> scoring.Scored:
        return scoring.score(bench_dataset, "red_centroid", "srgb8", workers=workers, console=quiet())

    few = scored(2)
    assert began == []  # too few pairs to be worth a process
    monkeypatch.setattr(scoring, "_WORTH_A_PROCESS", 2)
    here = scored(1)
    assert began == []  # one worker makes them itself
    elsewhere = scored(2)
    assert began == [2]
    for other in (few, elsewhere):
        assert other.records.drop("seconds").equals(here.records.drop("seconds"))
        assert other.document.worst == here.document.worst


class Faulty(EasyPairs):
    """Pair 1 cannot be read, and says so in an error that cannot be pickled; pair 2 in one that can."""

    def pair(self, number: int) -> Pair:
        if number == 1:
            error = DatasetError("layer is gone")
            error.handle = sys.stderr  # type: ignore[attr-defined]
            raise error
        if number == 2:
            raise DatasetError("layer is damaged")
        return super().pair(number)


@pytest.mark.slow
def test_what_a_process_raises_is_raised_here_and_the_others_go_on(monkeypatch: pytest.MonkeyPatch) -> None:
    here = Path(__file__)
    for folder in (here.parent, here.parents[2]):  # the processes import this file, and its helpers
        monkeypatch.setenv("PYTHONPATH", str(folder), prepend=os.pathsep)
    monkeypatch.setattr(Faulty, "__module__", here.stem)
    monkeypatch.setitem(sys.modules, here.stem, sys.modules[__name__])
    plain = EasyPairs(count=4)
    with PrefetchedPairs(Faulty(count=4), 2) as made:
        assert_same(made, plain, 0)
        with pytest.raises(DatasetError, match="layer is gone"):
            made.pair(1)
        with pytest.raises(DatasetError, match=r"^layer is damaged$"):
            made.pair(2)
        assert_same(made, plain, 3)


def test_a_process_that_dies_is_a_sentence() -> None:
    with PrefetchedPairs(EasyPairs(count=4), 1) as made:
        made.pair(0)
        os.kill(made._makers[0]._process.pid, signal.SIGKILL)
        with pytest.raises(DatasetError, match="died; most often memory has run out: take fewer --workers"):
            made.pair(1), made.pair(2)


def test_a_process_that_cannot_be_started_is_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[subprocess.Popen[bytes]] = []
    start = subprocess.Popen

    def popen(*given: Any, **named: Any) -> subprocess.Popen[bytes]:
        if started:
            raise OSError(errno.EAGAIN, os.strerror(errno.EAGAIN))
        started.append(start(*given, **named))
        return started[0]

    monkeypatch.setattr(subprocess, "Popen", popen)
    with pytest.raises(DatasetError, match="can be started: Resource temporarily unavailable; take --workers 1"):
        PrefetchedPairs(EasyPairs(count=4), 2)
    assert started[0].poll() is not None  # the first one was ended


def is_alive(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state not in "ZX"


def test_nothing_is_left_of_the_processes(tmp_path: Path) -> None:
    with PrefetchedPairs(EasyPairs(count=4), 2) as made:
        pids = [maker._process.pid for maker in made._makers]
        assert all(map(is_alive, pids))
    assert not any(map(is_alive, pids))
    code = (
        "import time\nfrom phibench.benchmark.isolation.easy_pairs import EasyPairs\n"
        "from phibench.benchmark.isolation.prefetched_pairs import PrefetchedPairs\n"
        "made = PrefetchedPairs(EasyPairs(count=9), 2)\nmade.pair(0)\n"
        "print(*(maker._process.pid for maker in made._makers), flush=True)\ntime.sleep(600)\n"
    )
    with subprocess.Popen([sys.executable, "-c", code], cwd=tmp_path, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        pids = list(map(int, parent.stdout.readline().split()))
        assert len(pids) == 2
        parent.kill()
    end = time.monotonic() + 30.0  # a pair that is being made is finished first
    while any(map(is_alive, pids)) and time.monotonic() < end:
        time.sleep(0.05)
    assert not any(map(is_alive, pids))
