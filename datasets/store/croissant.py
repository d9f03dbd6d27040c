"""Croissant descriptions: `croissant.json` beside every data set of pairs and of films, and what exports share with it.

Croissant 1.1 with the fields of its responsible-AI vocabulary (https://docs.mlcommons.org/croissant/). A description
follows from the data set's own files and holds no date: the same data set gives the same bytes. Small files are listed
with their SHA-256; layers as sets of files, whose hashes `SHA256SUMS` has.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from phibench.datasets.store import schema
from phibench.datasets.store.schema import DatasetInfo, ManifestRow, columns

LICENSE_URL = "https://creativecommons.org/licenses/by/4.0/"
LICENSE_TEXT = f"""Creative Commons Attribution 4.0 International (CC BY 4.0)

You may share and change this data set, also commercially, if you name its source, link this licence and say what you
changed. The licence's legal code is at {LICENSE_URL}legalcode

Source: phibench, by the phibench authors; see CITATION.cff of phibench.
"""
PARQUET, JSON_LINES, TOML, EXR = "application/x-parquet", "application/jsonlines", "application/toml", "image/x-exr"

_TERMS = (
    "arrayShape citeAs column containedIn equivalentProperty extract field fileObject fileProperty fileSet format "
    "includes isArray isLiveDataset jsonPath key md5 parentField path recordSet references regex repeated replace "
    "samplingRate separator source subField transform"
)
_CONTEXT = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "dct": "http://purl.org/dc/terms/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "sc": "https://schema.org/",
    "conformsTo": "dct:conformsTo",
    **{name: {"@id": f"cr:{name}", "@type": "@json"} for name in ("data", "examples")},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    **{name: {"@container": "@language"} for name in ("description", "name")},
    **{name: f"cr:{name}" for name in _TERMS.split()},
}
_TYPES = {"Float64": "sc:Float", "Int64": "sc:Integer", "Boolean": "sc:Boolean", "String": "sc:Text"}
_TYPES |= {"Null": "sc:Float"}  # a number that no row has
_RESPONSIBLE = {
    "rai:dataCollection": "All images are computed: light by path tracing and exact optics, frames by a model of the "
    "camera. No photograph was taken.",
    "rai:dataCollectionType": ["Software Collection"],
    "rai:dataAnnotationProtocol": "The truth is computed by the closed form of each chief ray, and checked against a "
    "ray tracer; each image has a certificate with the differences.",
    "rai:annotationsPerItem": "1",
    "rai:machineAnnotationTools": ["phibench"],
    "rai:dataPreprocessingProtocol": ["Expected electrons are put through the camera's chain of the preset."],
    "rai:dataUseCases": "Measuring how well a method finds a laser spot in a mirror image, and the depth behind it; "
    "training such methods.",
    "rai:dataLimitations": "One camera model, simulated noise, rooms of simple shapes or of the recipe's own files. "
    "Results say nothing about sensors or scenes of another kind.",
    "rai:dataBiases": "Depths, rooms and exposures are those that the recipe draws; they are no sample of real homes.",
    "rai:personalSensitiveInformation": "None: no person is shown.",
    "rai:dataSocialImpact": "None is known.",
    "rai:dataReleaseMaintenancePlan": "A changed recipe, seed or file gets a new version; old ones are not altered.",
}


def croissant_text(
    name: str,
    description: str,
    version: str,
    distribution: Sequence[Mapping[str, Any]],
    record_sets: Sequence[Mapping[str, Any]] = (),
) -> str:
    """JSON-LD text of a data set."""
    document = {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": ["http://mlcommons.org/croissant/1.1", "http://mlcommons.org/croissant/RAI/1.0"],
        "name": name,
        "description": description,
        "license": LICENSE_URL,
        "url": "https://pypi.org/project/phibench/",
        "version": version,
        "citeAs": "The phibench authors: phibench, exact ground truth and scores for depth from a camera and a mirror.",
        "creator": {"@type": "sc:Organization", "name": "The phibench authors"},
        "keywords": ["omnidirectional vision", "catadioptric camera", "depth estimation", "synthetic data"],
        **_RESPONSIBLE,
        "distribution": list(distribution),
        "recordSet": list(record_sets),
    }
    return json.dumps(document, indent=1, allow_nan=False) + "\n"


def file_object(name: str, media: str, digest: str, contained_in: str = "") -> dict[str, Any]:
    """Description of one file with its SHA-256."""
    entry = {"@type": "cr:FileObject", "@id": name, "name": name, "contentUrl": name, "encodingFormat": media}
    return entry | {"sha256": digest} | ({"containedIn": {"@id": contained_in}} if contained_in else {})


def file_set(name: str, media: str, includes: str) -> dict[str, Any]:
    """Description of files by a pattern."""
    return {"@type": "cr:FileSet", "@id": name, "name": name, "encodingFormat": media, "includes": includes}


def record_set(
    name: str, about: str, types: Mapping[str, str], texts: Mapping[str, str], source: Mapping[str, Any], key: str = ""
) -> dict[str, Any]:
    """Rows of a table: a field for each column.

    Parameters
    ----------
    types : type of each column as `polars` writes it: "Float64", ..., "List(Float64)"
    texts : meaning of columns
    source : where rows come from: {"fileObject": {"@id": ...}} or {"fileSet": ...}
    key : column that names a row, if one does
    """
    fields = [_field(name, column, kind, texts, source) for column, kind in types.items()]
    entry: dict[str, Any] = {"@type": "cr:RecordSet", "@id": name, "name": name, "description": about}
    return entry | ({"key": {"@id": f"{name}/{key}"}} if key else {}) | {"field": fields}


def _field(table: str, column: str, kind: str, texts: Mapping[str, str], source: Mapping[str, Any]) -> dict[str, Any]:
    is_list = "List" in kind
    entry: dict[str, Any] = {
        "@type": "cr:Field",
        "@id": f"{table}/{column}",
        "name": column,
        "description": texts.get(column, "drawn by the recipe"),
        "dataType": "sc:Float" if is_list else _TYPES[kind],
        "source": {**source, "extract": {"column": column}},
    }
    return entry | ({"isArray": True, "arrayShape": "-1"} if is_list else {})


def manifest_texts() -> dict[str, str]:
    """Meaning and unit of every column of `manifest.parquet` that the recipe does not draw."""
    return {name: described_field(field) for name, field in columns(ManifestRow)}


def described_field(field: Any) -> str:
    """Meaning of a field of a document, with its unit."""
    unit = (field.json_schema_extra or {}).get("unit", "-")
    return f"{field.description}{'' if unit == '-' else f' ({unit})'}"


def made_by(info: DatasetInfo) -> str:
    """Version of phibench that made a data set, as its `dataset.json` says."""
    packages = info.provenance.get("packages")
    version = packages.get("phibench") if isinstance(packages, dict) else None
    return version if isinstance(version, str) else "0.0.0"


_SMALL = {schema.TABLE: PARQUET, schema.MANIFEST: JSON_LINES, schema.RIGS: JSON_LINES, schema.ROOMS: JSON_LINES}


def dataset_croissant(info: DatasetInfo, types: Mapping[str, str], hashes: Mapping[str, str]) -> str:
    """JSON-LD text of a data set of pairs.

    Parameters
    ----------
    types : columns of `manifest.parquet` with their types
    hashes : SHA-256 by file
    """
    shard = f", part {info.shard}" if info.shard else ""
    left_out = f"Left out, because refused: {counted((len(info.left_out), 'pair'))}. " if info.left_out else ""
    about = (
        "Layers of light of a laser spot in a mirror, seen by a camera that moves up by the stroke between two images, "
        f"with the exact truth of every pixel and spot{shard}: "
        f"{counted((info.samples, 'pair'), (info.rigs, 'rig'), (info.rooms, 'room'))}. "
        f"{left_out}phibench draws frames of any exposure and noise from them."
    )
    sets = [
        *_settings(schema.INFO),
        file_set("ambient", EXR, "views/*/ambient.exr"),
        file_set("truth", EXR, "views/*/truth.exr"),
        file_set("spots", EXR, "spots/*.exr"),
        file_set("previews", "image/png", "previews/*.png"),
    ]
    rows = "One row for each pair: a spot, a rig, a room and a stroke, with the exact truth in both images."
    records = record_set("pairs", rows, types, manifest_texts(), {"fileObject": {"@id": schema.TABLE}}, key="sample_id")
    small = [file_object(name, media, hashes[name]) for name, media in _SMALL.items() if name in hashes]
    return croissant_text(info.name, about, made_by(info), [*small, *sets], [records])


def _settings(info: str) -> list[dict[str, Any]]:
    """Description and recipe, without hashes: `[frames]` may be changed, and this file stays as it is."""
    return [file_set("description", "application/json", info), file_set("recipe", TOML, schema.RECIPE)]


def films_croissant(name: str, version: str, films: int, types: Mapping[str, str]) -> str:
    """JSON-LD text of a data set of films; `types` are the columns of each `film.parquet`."""
    about = (
        "Films of a laser spot in a mirror, seen by a rolling-shutter camera that moves: the spot in every frame, "
        f"views of the room, and the exact truth of every frame: {counted((films, 'film'))}. "
        "phibench draws frames from them."
    )
    sets = [
        *_settings("film.json"),
        file_set("frames_truth", PARQUET, "films/*/film.parquet"),
        file_set("views", EXR, "films/*/views/*.exr"),
        file_set("spots", "application/x-npz", "films/*/spots.npz"),
    ]
    rows = "One row for each frame of each film: instants of the frame, and of the row that shows the spot."
    texts = {column: column.replace("_", " ") for column in types}
    records = record_set("frames", rows, types, texts, {"fileSet": {"@id": "frames_truth"}})
    return croissant_text(name, about, version, sets, [records])


def counted(*counts: tuple[int, str]) -> str:
    """Numbers with their nouns: "3 pairs, 1 rig"."""
    return ", ".join(f"{count} {noun}{'' if count == 1 else 's'}" for count, noun in counts)
