"""FORMAT.md and the code say the same, in both directions."""

import dataclasses
import re
from pathlib import Path
from typing import get_args

import pytest
from pydantic import BaseModel

from phibench.datasets.frames.frame_files import TRUTH, FrameRow
from phibench.datasets.rooms.room_sources import EXPORTED, RoomSource, UnexportedRoom
from phibench.datasets.store import layers, schema
from phibench.render.optics import truth
from phibench.render.room.light_map import ARRAYS, LightMap
from phibench.scenes.camera import FILTERS

PAGE = (Path(schema.__file__).resolve().parents[1] / "FORMAT.md").read_text(encoding="utf-8")
MODELS = (
    schema.ManifestRow,
    schema.SpotRow,
    schema.LightRow,
    schema.CertificateRow,
    schema.NoiseRow,
    schema.DatasetInfo,
    schema.PoseInfo,
    schema.LeftOutInfo,
    schema.RigInfo,
    schema.RoomInfo,
    FrameRow,
)


def tables() -> list[list[list[str]]]:
    """All tables of the page: rows of cells, heading first."""
    blocks = re.findall(r"(?:^\|.*\|\n)+", PAGE, flags=re.MULTILINE)
    return [[[cell.strip() for cell in line[1:-1].split("|")] for line in block.splitlines()] for block in blocks]


def field_tables() -> list[list[list[str]]]:
    return [table[2:] for table in tables() if table[0] == ["field", "type", "unit", "meaning"]]


def table_with(*heading: str) -> list[list[str]]:
    """Rows of all tables with that heading."""
    return [row for table in tables() if table[0] == list(heading) for row in table[2:]]


def names(cell: str) -> list[str]:
    return re.findall(r"`([^`]+)`", cell)


def test_there_is_one_table_per_document() -> None:
    assert len(field_tables()) == len(MODELS)


@pytest.mark.parametrize("index", range(len(MODELS)), ids=lambda i: MODELS[i].__name__)
def test_fields_and_units(index: int) -> None:
    model: type[BaseModel] = MODELS[index]
    said = [(name, row[2]) for row in field_tables()[index] for name in names(row[0])]
    meant = [(name, field.json_schema_extra["unit"]) for name, field in model.model_fields.items()]  # type: ignore[index]
    assert said == meant
    assert all(field.description for field in model.model_fields.values())


@pytest.mark.parametrize("index", range(len(MODELS)), ids=lambda i: MODELS[i].__name__)
def test_types(index: int) -> None:
    kinds = {
        "string": "str|Literal",
        "double": "float",
        "3 doubles": "tuple",
        "2 doubles": "tuple",
        "bool": "bool",
        "integer": "int",
    }
    for name, kind, *_ in field_tables()[index]:
        annotation = str(MODELS[index].model_fields[names(name)[0]].annotation)
        assert re.search(kinds.get(kind.removesuffix(" or null"), ""), annotation), name
        assert ("None" in annotation) == ("null" in kind), name


def test_files() -> None:
    said = {name for row in table_with("file", "content") for name in names(row[0])}
    views = {schema.view_file("POSE", name) for name in ("ambient", "truth", "preview")}
    spots = {schema.spot_file("SAMPLE", position) for position in ("down", "up")}
    single = {
        schema.INFO,
        schema.MANIFEST,
        schema.TABLE,
        schema.RECIPE,
        schema.CHECKSUMS,
        schema.RUN,
        schema.CONTACT_SHEET,
    }
    single |= {schema.LOG, schema.JOURNAL, schema.RIGS, schema.SENSITIVITIES, schema.CROISSANT}
    rooms = {
        schema.ROOMS,
        schema.room_file("FILE"),
        schema.room_file(f"{EXPORTED}/FILE"),
        schema.light_map_file("room"),
        schema.light_map_file("ROOM"),
    }
    assert said == views | spots | single | rooms | {schema.preview_file("SAMPLE")}


def test_planes() -> None:
    said = [name for row in table_with("plane", "unit", "meaning") for name in names(row[0])]
    assert tuple(said) == layers.STORED_TRUTH_PLANES
    assert {*said, *truth.ANGLES} == set(truth.TRUTH_PLANES)
    spots = [name for row in table_with("planes", "unit", "meaning") for name in names(row[0])]
    assert tuple(spots) == layers.SPOT_PLANES
    ambient = [name for row in table_with("ambient plane", "unit", "meaning") for name in names(row[0])]
    assert tuple(ambient) == layers.AMBIENT_PLANES
    assert FILTERS == ("R", "G", "B")


def test_arrays_of_the_light_map() -> None:
    said = [name for row in table_with("array", "unit", "meaning") for name in names(row[0])]
    assert tuple(said) == tuple(ARRAYS) == tuple(field.name for field in dataclasses.fields(LightMap))


def test_causes() -> None:
    said = {name for row in table_with("cause", "meaning") for name in names(row[0])}
    meant = {truth.VISIBLE, truth.NO_REFLECTION, truth.FACES_AWAY, truth.OUTSIDE, truth.EDGE}
    assert said == meant | {truth.OCCLUDED + "OBJECT"}


def test_the_truth_of_a_frame_is_that_of_the_manifest() -> None:
    for name in TRUTH:
        assert FrameRow.model_fields[name].annotation == schema.SpotRow.model_fields[name].annotation


def test_kinds_of_rooms() -> None:
    said = {name for row in table_with("kind", "source") for name in names(row[0])}
    sources = get_args(RoomSource) or (RoomSource,)
    kinds = {source.__dataclass_fields__["kind"].default for source in sources if source is not UnexportedRoom}
    assert said == kinds  # no finished data set has a room whose file is not there yet


def test_version() -> None:
    assert f"schema version {schema.SCHEMA_VERSION}" in PAGE.splitlines()[0]
