"""The cache of light maps: an entry is that of its room or is not taken; the longest unused go; writers hold a lock."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from filelock import FileLock
from helpers.processes import within

from phibench.cli.main import main
from phibench.datasets.build import bake_task as cache
from phibench.datasets.common.errors import DatasetError
from phibench.render.room.light_map import BakeSettings, LightMap, texel_count
from phibench.scenes.room import Room, Sun, default_rig
from phibench.scenes.shapes import Bitmap, rectangle

VIEW = default_rig().at(0.0)
LAMP = dataclasses.replace(rectangle("lamp", (0, 0, 2), (0, 0, -1), (0.5, 0.5)), radiance_w_m2_sr=(1.0, 1.0, 0.5))
ROOM = Room("small", (rectangle("floor", (0, 0, 0), (0, 0, 1), (1, 1)), LAMP), (), robot=False)
SETTINGS = BakeSettings(texel_m=0.25, lamp_rays=8, bounces=1, bounce_rays=8, final_rays=8)


class Oven:
    """Counts what is baked, and gives each time other light."""

    def __init__(self) -> None:
        self.baked = 0

    def bake(self, _: object, room: Room, settings: BakeSettings) -> LightMap:
        self.baked += 1
        texels = texel_count(room, settings.texel_m)
        light = np.full((texels, 3), self.baked, dtype=np.float32)
        return LightMap(light, np.zeros_like(light), np.zeros(texels, dtype=bool))


@pytest.fixture
def oven(monkeypatch: pytest.MonkeyPatch) -> Oven:
    oven = Oven()
    monkeypatch.setattr(cache, "bake", oven.bake)
    return oven


def value(folder: Path, settings: BakeSettings = SETTINGS, room: Room = ROOM) -> float:
    return float(cache.light_map(VIEW, room, settings, folder).irradiance_w_m2[0, 0])


def test_a_baked_room_is_taken_from_the_cache_to_the_bit(tmp_path: Path) -> None:
    first = cache.light_map(VIEW, ROOM, SETTINGS, tmp_path)
    assert cache.is_sound(first, ROOM, SETTINGS)
    assert first.irradiance_w_m2.max() > 0.0
    assert cache.is_cached(VIEW, ROOM, SETTINGS, tmp_path)
    [entry] = cache.cache_entries(tmp_path)
    written = entry.path.read_bytes()
    again = cache.light_map(VIEW, ROOM, SETTINGS, tmp_path)
    assert all(getattr(again, n).tobytes() == getattr(first, n).tobytes() for n in ("irradiance_w_m2", "covered"))
    entry.path.write_bytes(written[:-10])
    cache.light_map(VIEW, ROOM, SETTINGS, tmp_path)
    assert entry.path.read_bytes() == written


def test_other_rooms_and_settings_are_other_entries(tmp_path: Path, oven: Oven) -> None:
    others = [dataclasses.replace(SETTINGS, lamp_rays=9), dataclasses.replace(SETTINGS, texel_m=0.3)]
    brighter = dataclasses.replace(
        ROOM, surfaces=(ROOM.surfaces[0], dataclasses.replace(LAMP, radiance_w_m2_sr=(2.0, 1.0, 0.5)))
    )
    sunny = dataclasses.replace(ROOM, sun=Sun((1.0, 0.0, 1.0), (10.0, 8.0, 6.0)))
    hotter = dataclasses.replace(ROOM, sun=Sun((1.0, 0.0, 1.0), (20.0, 8.0, 6.0)))
    numbers = [value(tmp_path), *(value(tmp_path, other) for other in others), value(tmp_path, room=brighter)]
    numbers += [value(tmp_path, room=room) for room in (sunny, hotter)]
    assert numbers == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    assert [value(tmp_path), *(value(tmp_path, other) for other in others)] == [1.0, 2.0, 3.0]


def test_light_of_screens_and_of_the_sun_is_sound() -> None:
    """Rooms without lamps: what a screen of radiance 3 or a sun of 10 W/m^2 gives, and not a million times as much."""
    picture = Bitmap(np.array([[[1.0, 2.0, 3.0, 0.0]]]), (1.0, 1.0), is_radiance=True)
    screen = rectangle("screen", (0.0, 0.0, 2.0), (0.0, 0.0, -1.0), (1.0, 1.0), texture=picture)
    rooms = [
        dataclasses.replace(ROOM, surfaces=(ROOM.surfaces[0], screen)),
        dataclasses.replace(ROOM, surfaces=ROOM.surfaces[:1], sun=Sun((0.0, 0.0, 1.0), (10.0, 10.0, 10.0))),
    ]
    for room in rooms:
        texels = texel_count(room, SETTINGS.texel_m)
        light = np.full((texels, 3), 9.0, dtype=np.float32)
        shut = np.zeros(texels, dtype=bool)
        assert cache.is_sound(LightMap(light, np.zeros_like(light), shut), room, SETTINGS)
        assert not cache.is_sound(LightMap(np.float32(1e6) * light, np.zeros_like(light), shut), room, SETTINGS)


def test_no_flipped_bit_of_an_entry_is_taken(tmp_path: Path, oven: Oven) -> None:
    value(tmp_path)
    [entry] = cache.cache_entries(tmp_path)
    for bit in map(int, np.random.default_rng(0).integers(0, 8 * entry.size_bytes, 40)):
        data = bytearray(entry.path.read_bytes())
        data[bit // 8] ^= 1 << bit % 8
        entry.path.write_bytes(data)
        baked = oven.baked
        assert value(tmp_path) == oven.baked == baked + 1, bit


def other_room(path: Path, folder: Path) -> None:
    """An entry that is whole, under the name of another room."""
    cache.light_map(VIEW, ROOM, dataclasses.replace(SETTINGS, lamp_rays=9), folder / "other")
    [entry] = cache.cache_entries(folder / "other")
    path.write_bytes(entry.path.read_bytes())


def with_light(change: Callable[[LightMap], LightMap]) -> Callable[[Path, Path], None]:
    """An entry with right recipe and right hash over wrong arrays."""

    def forge(path: Path, folder: Path) -> None:
        recipe = cache._recipe(VIEW, ROOM, SETTINGS)
        light = cache._read(path, recipe)
        assert light is not None
        cache._write(path, recipe, change(light))

    return forge


def replaced(light: LightMap, **arrays: object) -> LightMap:
    return dataclasses.replace(light, **arrays)  # type: ignore[arg-type]


FORGERIES = {
    "of another room": other_room,
    "too short": with_light(lambda light: replaced(light, irradiance_w_m2=light.irradiance_w_m2[:-1])),
    "not finite": with_light(lambda light: replaced(light, irradiance_w_m2=light.irradiance_w_m2 * np.float32(np.nan))),
    "negative": with_light(lambda light: replaced(light, sigma_w_m2=light.sigma_w_m2 - np.float32(1.0))),
    "too bright": with_light(lambda light: replaced(light, irradiance_w_m2=light.irradiance_w_m2 + np.float32(1e6))),
    "doubles": with_light(lambda light: replaced(light, irradiance_w_m2=light.irradiance_w_m2.astype(float))),
    "of the first version": lambda path, _: path.write_bytes(b"0" * 64 + b"PK"),
    "empty": lambda path, _: path.write_bytes(b""),
}


@pytest.mark.parametrize("forge", FORGERIES.values(), ids=FORGERIES)
def test_an_entry_is_taken_for_its_content_not_for_its_name_or_hash(
    tmp_path: Path, oven: Oven, forge: Callable[[Path, Path], None]
) -> None:
    value(tmp_path)
    [entry] = cache.cache_entries(tmp_path)
    forge(entry.path, tmp_path)
    baked = oven.baked
    assert value(tmp_path) == baked + 1
    assert value(tmp_path) == baked + 1


@pytest.mark.parametrize("kind", ["fifo", "folder", "circle"])
def test_what_is_no_file_is_no_entry(tmp_path: Path, oven: Oven, kind: str) -> None:
    value(tmp_path)
    [entry] = cache.cache_entries(tmp_path)
    entry.path.unlink()
    {"fifo": os.mkfifo, "folder": os.mkdir, "circle": lambda path: path.symlink_to(path)}[kind](entry.path)
    with within(20):
        assert value(tmp_path) == 2.0


def test_the_longest_unused_go_first(tmp_path: Path, oven: Oven) -> None:
    settings = [dataclasses.replace(SETTINGS, lamp_rays=rays) for rays in (8, 9, 10)]
    for age, each in zip((300, 200, 100), settings, strict=True):
        value(tmp_path, each)
        newest = cache.cache_entries(tmp_path)[0].path
        os.utime(newest, (1e9 - age, 1e9 - age))
    assert value(tmp_path, settings[0]) == 1.0  # used now: the second is the longest unused
    size = cache.cache_entries(tmp_path)[0].size_bytes
    assert cache.limit_cache(2.5e-6 * size, tmp_path) == 1
    assert [value(tmp_path, each) for each in (settings[0], settings[2])] == [1.0, 3.0]
    assert value(tmp_path, settings[1]) == 4.0  # baked again, and another goes
    assert len(cache.cache_entries(tmp_path)) == 2
    assert cache.limit_cache(0.0, tmp_path) == 2
    assert value(tmp_path) == 5.0
    assert cache.cache_entries(tmp_path) == []


@pytest.mark.parametrize("text", ["", "much", "nan", "-1", "1e999", "7" * 5000])
def test_a_damaged_limit_is_the_default(tmp_path: Path, text: str) -> None:
    (tmp_path / "limit.txt").write_text(text)
    assert cache.cache_limit_mb(tmp_path) == cache.LIMIT_MB


def test_a_cache_that_is_held_or_cannot_be_written_costs_time_only(
    tmp_path: Path, oven: Oven, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cache, "_PATIENCE_S", 0.1)
    with FileLock(tmp_path / ".lock", is_singleton=False):
        assert value(tmp_path) == 1.0
        with pytest.raises(DatasetError, match="another process holds the cache"):
            cache.clear_cache(tmp_path)
    (tmp_path / "file").write_bytes(b"")
    assert value(tmp_path / "file") == 2.0
    with pytest.raises(DatasetError, match="cannot be written"):
        cache.limit_cache(1.0, tmp_path / "file")


def test_what_a_killed_writer_left_is_removed(tmp_path: Path, oven: Oven) -> None:
    code = (
        "import sys, time\nfrom pathlib import Path\nfrom phibench.datasets.store.files import write_atomic\n"
        "def write(path):\n    print('writing', flush=True)\n    time.sleep(60)\n"
        "write_atomic(Path(sys.argv[1]) / 'a.lightmap', write)"
    )
    with subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == b"writing\n"
        child.kill()
    (tmp_path / ".old.tmp").write_bytes(b"")
    assert len(list(tmp_path.iterdir())) == 2
    value(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} <= {".lock", cache.cache_entries(tmp_path)[0].path.name}


def test_the_command_shows_limits_and_clears(
    tmp_path: Path, oven: Oven, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PHIBENCH_CACHE", str(tmp_path))
    assert main(["cache", "show"]) == 0
    assert "0 light maps, 0.0 MB of at most 1000 MB" in capsys.readouterr().out
    cache.light_map(VIEW, ROOM, SETTINGS)
    assert main(["cache", "limit", "250"]) == 0
    assert main(["cache", "show"]) == 0
    assert "1 light map, " in (shown := capsys.readouterr().out)
    assert "of at most 250 MB" in shown
    assert "last used 20" in shown
    assert main(["cache", "clear"]) == 0
    assert "1 light map removed" in capsys.readouterr().out
    assert not cache.is_cached(VIEW, ROOM, SETTINGS)
    for bad in ("-1", "nan"):
        assert main(["cache", "limit", bad]) == 2
        assert "must be 0 or more" in capsys.readouterr().err


def test_a_map_of_another_variant_or_llvm_is_another_entry(
    tmp_path: Path, oven: Oven, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Keys alone: nothing is rendered, so that no GPU is needed."""
    value(tmp_path)
    for number, environment in enumerate(({"variant": "cuda_ad_rgb", "llvm": None}, {"variant": "llvm_ad_rgb"}), 2):
        monkeypatch.setattr(cache, "renders_with", lambda changed=environment: {"llvm": "LLVM 20.1.0", **changed})
        value(tmp_path)
        assert oven.baked == number
        value(tmp_path)
        assert oven.baked == number
