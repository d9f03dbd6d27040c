"""Generated rooms by one and by two real workers, each with an empty cache: the same light, views, spots and rows."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from helpers.folders import contents
from helpers.processes import quiet

from phibench.datasets.make import make
from phibench.datasets.store import schema

WORLDS = Path(__file__).resolve().parents[2] / "tiny_worlds.toml"


@pytest.mark.slow
def test_generated_rooms_are_bit_identical_whatever_the_number_of_workers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every file but those that tell of the run. Light that came from a cache would prove nothing about the bake."""
    sets = []
    for count in (1, 2):
        monkeypatch.setenv("PHIBENCH_CACHE", str(tmp_path / f"cache{count}"))
        out = make(WORLDS, tmp_path / f"by{count}", workers=count, console=quiet())
        log = [json.loads(line) for line in (out / schema.LOG).read_text().splitlines()]
        assert len({line["worker"] for line in log}) == count
        sets.append({name: data for name, data in contents(out).items() if name != schema.JOURNAL})
    one, two = sets
    assert one.keys() == two.keys()
    assert [name for name in one if one[name] != two[name]] == []
    files = [name for name in one if name.startswith("views/")]
    assert len(files) == 4 * 3  # ambient light, truth and preview of two positions in two rooms
    assert len({one[name] for name in files}) == len(files)  # all of them differ
    assert sum(name.endswith(".npz") for name in one) == 2
    assert any(name.startswith("spots/") for name in one)
