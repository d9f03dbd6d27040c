"""Attack: policies of the loop that run code in the judge's process, hang it, read the truth, and leave processes."""

import ast
import math
import os
import re
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from helpers.districts import DISTRICTS, tree
from helpers.hostile_policies import DEEDS, HEADER, REACHES, deeds
from helpers.listeners import accepting
from helpers.processes import processes_under

from phibench.benchmark.isolation.method_references import resolve
from phibench.benchmark.isolation.run_limits import MethodError, RunLimits
from phibench.robot.loop.episodes import LOST, Episode, run_foreign
from phibench.robot.loop.foreign_policies import PolicyFile, _action
from phibench.robot.loop.simulator import Action, Setup, Simulator, Task
from phibench.scenes.validation import SceneError

ROOT, SOURCES = Path(__file__).resolve().parents[2], DISTRICTS
SHORT = Setup(task=Task(longest_s=0.5, lights=0))
ANSWER_S = 2.0


def test_a_forged_answer_is_seven_numbers_or_refused() -> None:
    """Whatever JSON holds: what passes is an `Action` whose ranges the simulator checks."""
    good = [0.5, 0, 0.0, 0.0, 4, 1, 0.0]
    assert _action(good) == Action(drive_m_per_s=0.5)
    wrong = [None, "reached", {}, {"action": good}, good[:-1], [*good, 1.0], [good] * 7, "1234567"]
    for place in range(7):
        for value in ("0", None, True, [0], {"type": "array"}, *([0.5, 4.0] if place in (4, 5) else [])):
            wrong.append([*good[:place], value, *good[place + 1 :]])
    for answer in wrong:
        with pytest.raises(SceneError, match="the policy answered"):
            _action(answer)
    assert len(wrong) > 40


@pytest.mark.parametrize("value", [10**400, -(10**4000), 1e308, math.inf, math.nan, 2**63], ids=range(6))
def test_a_number_beyond_all_bounds_is_a_sentence(value: float) -> None:
    """Whole numbers of any length come as JSON; one is no float, and fills a terminal."""
    simulator = Simulator(SHORT)
    simulator.start("a")
    for place in range(7):
        if place not in (4, 5) or isinstance(value, int):
            action = Action(*(value if k == place else Action()[k] for k in range(7)))
            with pytest.raises(SceneError) as caught:
                simulator.act(action)
            assert len(str(caught.value)) < 200


DEEP = [
    "-" * 100_000 + "1",
    "a" + ".b" * 200_000,
    "1+" * 200_000 + "1",
    "not " * 100_000 + "1",
    "lambda:" * 20_000 + "1",
]


@pytest.mark.parametrize("text", [*(f"act = {deep}" for deep in DEEP), "#" * (17 << 20), "act = 1\0"])
def test_a_file_that_python_cannot_read_is_a_sentence(text: str, tmp_path: Path) -> None:
    """The judge reads it, and runs nothing of it."""
    path = tmp_path / "policy.py"
    path.write_text(text)
    with pytest.raises(SceneError, match=r"^policy in policy\.py.*: Python cannot read the file$"):
        PolicyFile.of(f"{path}:act")
    with pytest.raises(MethodError, match=r"Python cannot read the file$"):
        resolve(f"{path}:act")


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="needs /proc")
def test_a_policy_reaches_neither_truth_nor_judge(tmp_path: Path) -> None:
    """Files of the user, memory of both processes above it, a port; of its own folder all but the truth."""
    told: list[str] = []
    secret = [
        tmp_path / "set" / "dataset.json",
        tmp_path / "rooms" / "room.npz",
        Path.home() / f".phibench-{os.getpid()}",
    ]
    beside = tmp_path / "mine" / "notes.txt"
    for path in (*secret, beside):
        path.parent.mkdir(exist_ok=True)
        path.write_text("truth")
    try:
        with accepting() as port:
            code = REACHES.format(files=[str(path) for path in (*secret, beside)], judge=os.getpid(), port=port)
            (tmp_path / "mine" / "policy.py").write_text(HEADER + code)
            file = PolicyFile.of(f"{tmp_path / 'mine' / 'policy.py'}:reaching")
            (episode,) = run_foreign(SHORT, file, 1, "reach", hidden=[tmp_path / "rooms"], told=told.append)
    finally:
        secret[-1].unlink()
    assert episode.outcome == LOST
    if not told[0].startswith("isolated"):
        pytest.skip(told[0])
    assert f'reached ["{beside}"]' in episode.cause


@pytest.fixture(scope="module")
def lost(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, tuple[Episode, float]]]:
    """Episode of each deed and the seconds that it took."""
    folder = tmp_path_factory.mktemp("policies")
    (folder / "mine").mkdir()
    (folder / "temporary").mkdir()
    (folder / "mine" / "deeds.py").write_text(deeds(folder / "mark"))
    before, tempfile.tempdir = tempfile.tempdir, str(folder / "temporary")
    found, limits = {}, RunLimits(seconds=ANSWER_S, memory_mb=1000.0)
    try:
        for k, name in enumerate(DEEDS):
            file, start = PolicyFile.of(f"{folder / 'mine' / 'deeds.py'}:deed_{k}"), time.monotonic()
            (episode,) = run_foreign(SHORT, file, 1, "hostile", limits=limits)
            found[name] = replace(episode, refused=str(folder)), time.monotonic() - start
        yield found
    finally:
        tempfile.tempdir = before


@pytest.mark.slow
@pytest.mark.parametrize("deed", DEEDS)
def test_a_hostile_policy_loses_its_episode_and_leaves_nothing(
    lost: dict[str, tuple[Episode, float]], deed: str
) -> None:
    episode, seconds = lost[deed]
    folder = Path(episode.refused)
    assert episode.outcome == LOST
    assert DEEDS[deed][1] in episode.cause, episode.cause
    assert episode.cause.isprintable()
    assert math.isnan(episode.stated_m)
    assert seconds < 90.0  # a start on a busy machine, 2 s for the answer, 4 s for a supervisor
    assert not (folder / "mark").exists()  # no pickle of a policy was opened
    assert list(processes_under(folder)) == []
    assert list((folder / "temporary").iterdir()) == []


UNPICKLED = {
    "datasets/build/workers.py": "workers of ours",
    "benchmark/isolation/prefetched_pairs.py": "processes of ours that draw pairs",
    "benchmark/isolation/pair_transport.py": "pairs of ours, in the process of a method",
    "robot/loop/foreign_policies.py": "what is known and observed, in the process of a policy",
}
"""Modules that open pickles, and whose: none is of a method or a policy."""


OPENERS = re.compile("marshal|shelve|dill|pickle|joblib|multiprocessing")
"""What a file that does any of the following holds."""


def test_pickles_are_opened_of_our_own_processes_alone() -> None:
    """`Connection.recv` of multiprocessing and `pickle.load(s)`; no NumPy file with objects, no marshal, no shelve."""
    found = set()
    for file in sorted(path for folder in SOURCES for path in (ROOT / folder).rglob("*.py")):
        if not OPENERS.search(file.read_text(encoding="utf-8")):
            continue
        for node in ast.walk(tree(file)):
            if isinstance(node, ast.Import | ast.ImportFrom):
                names = {alias.name for alias in node.names} | {getattr(node, "module", None)}
                assert not names & {"marshal", "shelve", "dill", "cloudpickle", "joblib"}, file
                if "multiprocessing.connection" in names:
                    found.add(file.relative_to(ROOT).as_posix())
            if isinstance(node, ast.keyword):
                assert node.arg != "allow_pickle" or getattr(node.value, "value", True) is False, file
            pickles = isinstance(node, ast.Attribute) and node.attr in ("loads", "load")
            if pickles and ast.unparse(node).startswith("pickle."):
                found.add(file.relative_to(ROOT).as_posix())
    assert found == set(UNPICKLED)
