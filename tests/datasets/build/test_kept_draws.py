"""Draws that a folder keeps: the plan is the same with them, nothing is traced again, and what is none is not taken."""

import hashlib
import json
import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from helpers.folders import contents
from helpers.inline_workers import make_inline
from helpers.processes import SMALLEST

from phibench.datasets.build import draws_file
from phibench.datasets.build.draws_file import draws_bytes, read_draws, seen_causes, write_draws
from phibench.datasets.plan import sampling
from phibench.datasets.plan.plan import Plan, make_plan
from phibench.datasets.plan.sampling import HIDDEN
from phibench.datasets.recipe.load import parse_recipe, recipe_text, with_numbers
from phibench.datasets.recipe.tables import Recipe
from phibench.datasets.rooms.room_files import RoomFiles
from phibench.datasets.store import schema
from phibench.datasets.verify import verify

# rigs, holders and hidden spots in two generated rooms; some samples need several draws
TEXT = re.sub(r"exported_(\w+) = 20", r"exported_\1 = 0", recipe_text("bench-dev").replace("count = 80", "count = 2"))
TEXT = TEXT.replace("hidden = 0.1 ", "hidden = 0.3 ")


def recipe_of(samples: int = 10, seed: int = 0) -> Recipe:
    return parse_recipe(with_numbers(TEXT, "test", samples, seed))


@pytest.fixture(scope="module")
def drawn() -> Plan:
    return make_plan(recipe_of())


@pytest.fixture(scope="module")
def folder(drawn: Plan, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("kept")
    write_draws(out, draws_bytes(drawn, seen_causes(drawn)))
    return out


@pytest.fixture
def blind(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """No room can be built."""

    def refused(*_: Any) -> Any:
        raise AssertionError("a room was built")

    monkeypatch.setattr(sampling, "room_of", refused)
    monkeypatch.setattr("phibench.datasets.plan.pair_forecasts.spot_truth", refused)
    return


def exact(plan: Plan) -> str:
    """All numbers of a plan to the last bit: `repr` of a double gives it."""
    return repr((plan.rigs, plan.rooms, plan.spots, plan.poses, plan.pairs, plan.refused))


@pytest.mark.usefixtures("blind")
def test_the_plan_is_the_same_and_no_room_is_built(drawn: Plan, folder: Path) -> None:
    assert max(pair.tries for pair in drawn.pairs) > 1
    assert {dict(pair.drawn)["spot.hidden"] for pair in drawn.pairs} >= {HIDDEN}
    plan = make_plan(recipe_of(), RoomFiles(), None, read_draws(folder, recipe_of(), RoomFiles()))
    assert plan == drawn
    assert exact(plan) == exact(drawn)
    assert seen_causes(plan) == drawn.seen
    assert draws_bytes(plan, seen_causes(plan)) == (folder / schema.DRAWS).read_bytes()


@pytest.mark.usefixtures("blind")
def test_fewer_samples_and_shards_take_theirs(drawn: Plan, folder: Path) -> None:
    few = make_plan(recipe_of(4), RoomFiles(), None, read_draws(folder, recipe_of(4), RoomFiles()))
    assert few.pairs == drawn.pairs[:4]
    part = make_plan(recipe_of(), RoomFiles(), "2/2", read_draws(folder, recipe_of(), RoomFiles()))
    assert part.pairs == drawn.pairs[5:]


@pytest.mark.slow
def test_of_more_samples_the_others_are_drawn(drawn: Plan, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recipe, numbers, once = recipe_of(12), list[int](), sampling._Makers._once
    monkeypatch.setattr(sampling._Makers, "_once", lambda self, few, k: numbers.extend(few) or once(self, few, k))
    plan = make_plan(recipe, RoomFiles(), None, read_draws(folder, recipe, RoomFiles()))
    assert set(numbers) == {10, 11}
    monkeypatch.undo()
    assert exact(plan) == exact(make_plan(recipe))


def test_refusals_are_kept(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    sample = sampling._Makers._sample

    def never(self: Any, number: int, *rest: Any) -> Any:
        return "the wall is in the way" if number == 1 else sample(self, number, *rest)

    monkeypatch.setattr(sampling._Makers, "_sample", never)
    recipe = recipe_of(4)
    plan = make_plan(recipe)
    assert list(plan.refused) == ["random-000001"]
    write_draws(tmp_path, draws_bytes(plan, seen_causes(plan)))
    monkeypatch.setattr(sampling._Makers, "_sample", lambda *_: "nothing can be drawn")
    assert make_plan(recipe, RoomFiles(), None, read_draws(tmp_path, recipe, RoomFiles())) == plan


def signed(path: Path, document: Any) -> None:
    text = json.dumps(document).encode()
    path.write_bytes(hashlib.sha256(text).hexdigest().encode() + b"\n" + text)


def test_draws_of_something_else_are_not_taken(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another seed, number, room or code; frames and light do not count, for no draw depends on them."""
    files = RoomFiles()
    assert len(read_draws(folder, recipe_of(), files)) == 10
    assert read_draws(folder, recipe_of(seed=1), files) == {}
    for old, new in (("count = 2", "count = 3"), ("radius_m = { normal = [0.060", "radius_m = { normal = [0.0601")):
        assert old in TEXT
        assert read_draws(folder, parse_recipe(TEXT.replace(old, new)), files) == {}
    for old, new in (("lamp_rays = 16", "lamp_rays = 8"), ("jpeg_quality = { choice = [75, 85, 95] }", "")):
        assert old in TEXT
        assert len(read_draws(folder, parse_recipe(TEXT.replace(old, new)), files)) == 10
    monkeypatch.setattr(draws_file, "code_behind", lambda _: "other code")
    assert read_draws(folder, recipe_of(), files) == {}


@pytest.mark.parametrize("what", ["bit", "empty", "cut", "no object", "text", "folder", "tries", "vector", "number"])
def test_damaged_draws_are_drawn_anew(drawn: Plan, folder: Path, tmp_path: Path, what: str) -> None:
    """The last three have a good hash and samples that are no draws."""
    path, data, recipe = tmp_path / schema.DRAWS, (folder / schema.DRAWS).read_bytes(), recipe_of()
    key, samples = json.loads(data.split(b"\n", 1)[1])
    if what == "bit":
        path.write_bytes(data[:-9] + bytes([data[-9] ^ 1]) + data[-8:])
    elif what in ("empty", "cut"):
        path.write_bytes(b"" if what == "empty" else data[: len(data) // 2])
    elif what == "folder":
        path.mkdir()
    elif what in ("no object", "text"):
        signed(path, [key, [1, 2]] if what == "no object" else [key, {"zero": "x"}])
    elif what == "tries":
        signed(path, [key, samples | {"0": samples["0"] | {"tries": 0}, "1": samples["1"] | {"tries": 10**6}}])
    elif what == "vector":
        signed(path, [key, samples | {"0": samples["0"] | {"normal_world": [0.0, 0.0, 0.0]}}])
    else:
        signed(path, [key, samples | {"99": samples["0"], "-1": samples["0"]}])
    kept = read_draws(tmp_path, recipe, RoomFiles())
    assert (kept == {}) == (what not in ("tries", "vector", "number"))
    # without a draw the plan is that of an empty folder: it is drawn once more, for all of these
    if kept or what == "cut":
        assert exact(make_plan(recipe, RoomFiles(), None, kept)) == exact(drawn)


@pytest.mark.slow
def test_a_restart_is_faster(tmp_path: Path) -> None:
    """500 samples in 10 rooms, CPU seconds of this process: the second plan takes less than a third of the first."""
    text = re.sub(r"exported_(\w+) = 20", r"exported_\1 = 0", recipe_text("bench-dev"))
    recipe, files, times = parse_recipe(text.replace("count = 80", "count = 10")), RoomFiles(), [time.process_time()]
    for _ in range(2):
        plan = make_plan(recipe, files, None, read_draws(tmp_path, recipe, files))
        write_draws(tmp_path, draws_bytes(plan, seen_causes(plan)))
        times.append(time.process_time())
    first_s, again_s = times[1] - times[0], times[2] - times[1]
    print(f"\nplan of {len(plan.pairs)} pairs in 10 rooms: {first_s:.1f} CPU-s, again {again_s:.2f} CPU-s")
    assert again_s < first_s / 3.0


@pytest.mark.slow
def test_make_keeps_them_and_its_bytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recipe, out = tmp_path / "drawn.toml", tmp_path / "out"
    spot = '[random.spot]\ntarget = { choice = ["near"] }\nacross_m = { uniform = [-0.02, 0.02] }\n'
    head = SMALLEST.read_text().split("[[experiments]]")[0]
    recipe.write_text(f"{head}\n[random]\nsamples = 2\nstroke_m = 0.5\n\n{spot}")
    make_inline(recipe, out)
    held = contents(out)
    assert (out / schema.DRAWS).is_file()
    assert schema.DRAWS not in held[schema.CHECKSUMS].decode()
    assert verify(out).faults == ()
    assert verify(out).notes == ()
    with monkeypatch.context() as patch:
        patch.setattr(sampling._Makers, "draw", lambda *_: 1 / 0)
        make_inline(recipe, out)
        with pytest.raises(ZeroDivisionError):
            verify(out)  # which draws all samples itself
    (out / schema.DRAWS).write_text("damaged")
    make_inline(recipe, out)
    assert contents(out) == held
    assert (out / schema.DRAWS).read_text() != "damaged"
