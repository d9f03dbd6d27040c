"""Manifest rows: exact doubles, null for what does not exist, nothing missing where a spot is visible."""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.damage import write_manifest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from phibench.datasets.build.spot_task import make_spot
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.plan.plan import make_plan
from phibench.datasets.recipe.load import load_recipe
from phibench.datasets.store.json_forms import from_json, to_json
from phibench.datasets.store.metadata import differences, read_manifest
from phibench.datasets.store.parquet_tables import to_table
from phibench.datasets.store.schema import ManifestRow, columns, flat, row_line
from phibench.scenes.rig import Rig
from phibench.scenes.room import Room, c310_rig, lab

TINY = Path(__file__).resolve().parents[2] / "tiny.toml"


@pytest.fixture(scope="module")
def rows(tmp_path_factory: pytest.TempPathFactory) -> list[ManifestRow]:
    plan, out = make_plan(load_recipe(TINY)), tmp_path_factory.mktemp("rows")
    made = [
        make_spot(out, "tiny", plan.rig, plan.rooms[pair.room], plan.spots[pair.target], pair) for pair in plan.pairs
    ]
    return [ManifestRow.model_validate_json(json.dumps(_with_noise(one.result))) for one in made]


def _with_noise(row: dict[str, Any]) -> dict[str, Any]:
    """What the task `sample` adds: here some numbers, where the spot is visible."""
    noise = {"phi_sensor_rad": 5e-5, "phi_render_rad": 1e-7}
    return row | {side: row[side] | {"noise": noise if row[side]["visible"] else None} for side in ("down", "up")}


@pytest.fixture
def document(rows: list[ManifestRow]) -> dict[str, Any]:
    return json.loads(row_line(rows[0]))


def test_a_line_gives_back_the_very_row(rows: list[ManifestRow]) -> None:
    for row in rows:
        line = row_line(row)
        assert row_line(ManifestRow.model_validate_json(line)) == line
    assert ManifestRow.model_validate_json(row_line(rows[0])) == rows[0]


def test_rows_of_older_data_sets_know_no_beam(rows: list[ManifestRow], document: dict[str, Any]) -> None:
    """Rows that were written before spots had beams are discs."""
    assert document.pop("spot_beam_world") is None
    assert ManifestRow.model_validate_json(json.dumps(document)) == rows[0]
    beam = ManifestRow.model_validate_json(json.dumps(document | {"spot_beam_world": [0.6, 0.8, 0.0]}))
    assert beam.spot_beam_world == (0.6, 0.8, 0.0)
    assert to_table([beam, rows[0]])["spot_beam_world"].to_list() == [[0.6, 0.8, 0.0], None]
    assert to_table([rows[0]]).schema == to_table([beam]).schema


@given(number=st.floats(allow_nan=False, allow_infinity=False))
def test_doubles_survive_json_bit_by_bit(number: float) -> None:
    row = ManifestRow.model_construct(depth_m=number)
    back = json.loads(json.dumps(row.model_dump(mode="json")))["depth_m"]
    assert np.float64(back).tobytes() == np.float64(number).tobytes()


def test_a_hidden_spot_is_kept_with_its_cause(rows: list[ManifestRow]) -> None:
    hidden = rows[1]
    assert (hidden.down.visible, hidden.down.cause) == (False, "occluded:crate_red")
    assert hidden.down.certificate is None
    assert (hidden.up.visible, hidden.up.cause) == (True, "none")
    assert math.isfinite(hidden.down.u_px)  # where it would be


def test_missing_numbers_are_null_in_json_and_nan_in_python(document: dict[str, Any]) -> None:
    down = {**document["down"], "visible": False, "cause": "no_reflection", "certificate": None, "spot_file": None}
    down.update(u_px=None, reflection_point_world_m=[None, None, None], coma_shift_px=[None, None])
    row = ManifestRow.model_validate_json(json.dumps({**document, "down": down}))
    assert math.isnan(row.down.u_px)
    assert all(map(math.isnan, row.down.reflection_point_world_m))
    assert json.loads(row_line(row))["down"] == down


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"u_px": None}, "visible but has no u_px"),
        ({"coma_shift_px": [None, 0.0]}, "visible but has no coma_shift_px"),
        ({"certificate": None}, "has no certificate"),
        ({"spot_file": None}, "has no spot_file"),
        ({"u_px": "1.0"}, "valid number"),
        ({"visible": 1}, "valid boolean"),
        ({"reflection_point_world_m": [0.0, 0.0]}, "Field required"),
        ({"colour": "red"}, "Extra inputs"),
    ],
)
def test_a_bad_row_is_refused(document: dict[str, Any], change: dict[str, Any], words: str) -> None:
    document["down"] = {**document["down"], **change}
    with pytest.raises(ValidationError, match=words):
        ManifestRow.model_validate_json(json.dumps(document))


def test_a_failed_certificate_is_refused(document: dict[str, Any]) -> None:
    document["up"]["certificate"]["passed"] = False
    with pytest.raises(ValidationError, match="not passed"):
        ManifestRow.model_validate_json(json.dumps(document))


def test_the_table_has_the_leaves_of_the_rows(rows: list[ManifestRow], tmp_path: Path) -> None:
    leaves = dict(flat(rows[0].model_dump(mode="json")))
    assert list(leaves) == [name for name, _ in columns()]
    frame = to_table(rows)
    assert frame.columns == list(leaves)
    assert frame["down.u_px"].to_list() == [row.down.u_px for row in rows]
    assert frame["down.certificate.passed"].to_list() == [True, None]
    write_manifest(tmp_path, rows)
    assert read_manifest(tmp_path)[0] == rows[0]
    assert differences(tmp_path, rows) == []
    assert differences(tmp_path, rows[::-1]) != []


def test_a_broken_line_is_named(rows: list[ManifestRow], tmp_path: Path) -> None:
    write_manifest(tmp_path, rows)
    path = tmp_path / "manifest.jsonl"
    path.write_text(path.read_text()[:-50])
    with pytest.raises(DatasetError, match="line 2"):
        read_manifest(tmp_path)


def test_rig_and_room_survive_json() -> None:
    rig, room = c310_rig(), lab()
    assert from_json(Rig, json.loads(json.dumps(to_json(rig)))) == rig
    assert from_json(Room, json.loads(json.dumps(to_json(room)))) == room
    with pytest.raises(DatasetError, match="camera"):
        from_json(Rig, {**to_json(rig), "camera": {"fx_px": -1.0}})


@dataclass(frozen=True)
class _Named:
    stream: tuple[str | int, ...]


def test_names_of_streams_may_hold_any_seed() -> None:
    """A secret seed has 128 bits above 2^128; 1e12 is the largest of other numbers."""
    named = _Named(("bench-test", 2**62 + 1, "room", 3))
    assert from_json(_Named, json.loads(json.dumps(to_json(named)))) == named
    with pytest.raises(DatasetError, match=r"stream\.1 is \d+: not allowed"):
        from_json(_Named, {"stream": ["bench-test", 2**130]})
