"""Card, Croissant description and licence that lie beside an export.

Croissant 1.1 with the fields of its responsible-AI vocabulary (https://docs.mlcommons.org/croissant/). The card is a
README with a YAML header, as dataset hosts read it. Neither holds a date: the same export gives the same bytes.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from phibench.datasets.export.containers import FOLDER, hugging_face_features
from phibench.datasets.export.pair_rows import INDEX, POSITION_FIELDS, SPLITS, ExportRequest
from phibench.datasets.frames.frame_files import VALUES, FrameRow
from phibench.datasets.read import Dataset
from phibench.datasets.store.files import sha256
from phibench.datasets.store.schema import ManifestRow, columns

if TYPE_CHECKING:
    from polars import DataFrame

LICENSE_URL = "https://creativecommons.org/licenses/by/4.0/"
LICENSE_TEXT = f"""Creative Commons Attribution 4.0 International (CC BY 4.0)

You may share and change this data set, also commercially, if you name its source, link this licence and say what you
changed. The licence's legal code is at {LICENSE_URL}legalcode

Source: phibench, by the phibench authors; see CITATION.cff of phibench.
"""

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
_MEDIA = {
    "parquet": ("application/x-parquet", "*.parquet"),
    "webdataset": ("application/x-tar", "*.tar"),
    "frames": ("image/png", "**/*.png"),
}
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


def croissant(dataset: Dataset, request: ExportRequest, table: DataFrame, out: Path, hashes: Mapping[str, str]) -> str:
    """JSON-LD text of an export whose index `table` lies in `out`."""
    name = f"{dataset.info.name}-{request.frames.preset}"
    document = {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": ["http://mlcommons.org/croissant/1.1", "http://mlcommons.org/croissant/RAI/1.0"],
        "name": name,
        "description": _description(dataset, request, table),
        "license": LICENSE_URL,
        "url": "https://pypi.org/project/phibench/",
        "version": version("phibench"),
        "citeAs": "The phibench authors: phibench, exact ground truth and scores for depth from a camera and a mirror.",
        "creator": {"@type": "sc:Organization", "name": "The phibench authors"},
        "keywords": ["omnidirectional vision", "catadioptric camera", "depth estimation", "synthetic data"],
        **_RESPONSIBLE,
        "distribution": [
            _file_object(INDEX, "application/x-parquet", sha256(out / INDEX)),
            *_distribution(request, hashes),
        ],
        "recordSet": [_pairs(request, table), *_images(request)],
    }
    return json.dumps(document, indent=1, allow_nan=False) + "\n"


def _file_object(name: str, media: str, digest: str) -> dict[str, Any]:
    return {
        "@type": "cr:FileObject",
        "@id": name,
        "name": name,
        "contentUrl": name,
        "encodingFormat": media,
        "sha256": digest,
    }


def _distribution(request: ExportRequest, hashes: Mapping[str, str]) -> list[dict[str, Any]]:
    """Shards one by one, with their hashes; plain images as one set, for `SHA256SUMS` has theirs."""
    media, pattern = _MEDIA[request.form]
    if request.form != "frames":
        return [_file_object(name, media, hashes[name]) for name in sorted(hashes)]
    media, pattern = ("image/jpeg", "**/*.jpg") if request.end == ".jpg" else (media, pattern)
    includes = f"{FOLDER['frames']}/{pattern}"
    return [{"@type": "cr:FileSet", "@id": "images", "name": "images", "encodingFormat": media, "includes": includes}]


def _pairs(request: ExportRequest, table: DataFrame) -> dict[str, Any]:
    """Record set of the index: a field for each column."""
    texts = column_texts(request)
    fields = []
    for name, dtype in table.schema.items():
        is_list = "List" in str(dtype)
        entry: dict[str, Any] = {
            "@type": "cr:Field",
            "@id": f"pairs/{name}",
            "name": name,
            "description": texts.get(name, "drawn by the recipe"),
            "dataType": "sc:Float" if is_list else _TYPES[str(dtype)],
            "source": {"fileObject": {"@id": INDEX}, "extract": {"column": name}},
        }
        if is_list:
            entry |= {"isArray": True, "arrayShape": "3"}
        fields.append(entry)
    about = "One row for each pair of images and draw of the noise, with the exact truth."
    key = {"@id": "pairs/key"}
    return {
        "@type": "cr:RecordSet",
        "@id": "pairs",
        "name": "pairs",
        "description": about,
        "key": key,
        "field": fields,
    }


def _images(request: ExportRequest) -> list[dict[str, Any]]:
    if request.form != "frames":
        return []
    extracts = {"file": ("sc:Text", "filename"), "content": ("sc:ImageObject", "content")}
    fields = [
        {
            "@type": "cr:Field",
            "@id": f"images_of_pairs/{name}",
            "name": name,
            "dataType": kind,
            "source": {"fileSet": {"@id": "images"}, "extract": {"fileProperty": what}},
        }
        for name, (kind, what) in extracts.items()
    ]
    return [{"@type": "cr:RecordSet", "@id": "images_of_pairs", "name": "images_of_pairs", "field": fields}]


def column_texts(request: ExportRequest) -> dict[str, str]:
    """Meaning of every column of an export that is not drawn by the recipe, with its unit."""
    found = {name: _described(field) for name, field in columns(ManifestRow)}
    frame = {name: _described(field) for name, field in columns(FrameRow)}
    found |= {f"{p}.{name}": frame[name] for p in ("down", "up") for name in POSITION_FIELDS}
    found |= {name: frame[name] for name in ("draw", "preset")}
    found |= {"key": "name of the pair in this draw", "split": "train, validation or test"}
    places = {"parquet": "shard and name", "webdataset": "shard and member", "frames": "file"}
    return found | {column: f"{places[request.form]} of the image" for column, _, _ in request.images}


def _described(field: Any) -> str:
    unit = (field.json_schema_extra or {}).get("unit", "-")
    return f"{field.description}{'' if unit == '-' else f' ({unit})'}"


# The card.


def card(dataset: Dataset, request: ExportRequest, table: DataFrame) -> str:
    """README of an export: YAML header, what it is, columns."""
    lines = ["---", *_header(dataset, request, table), "---", "", f"# {dataset.info.name}, {request.frames.preset}", ""]
    lines += [_description(dataset, request, table), "", *_reading(request), "", "## Splits", ""]
    by = {"both": "rig or room", "rig": "rig", "room": "room"}[request.split_by]
    lines += [f"No two splits share a {by}, and draws of one pair stay together.", "", "| split | pairs |", "|---|---|"]
    lines += [f"| {name} | {int((table['split'] == name).sum())} |" for name in SPLITS]
    values = VALUES[request.frames.sensor().output]
    if request.frames.region is not None:
        values = f"{values.removesuffix(', in a JPEG')}, in a PNG"
    lines += ["", "## Columns", "", f"Images: {values}.", "", "| column | meaning |", "|---|---|"]
    texts = column_texts(request)
    lines += [f"| `{name}` | {texts.get(name, 'drawn by the recipe')} |" for name in table.columns]
    lines += [
        "",
        "Pixels are (column, row), integers at pixel centres. `rigs.jsonl` has the numbers of every rig by the",
    ]
    lines += ["ids in `rig` and `nominal_rig`, `rooms.jsonl` those of every room, `recipe.toml` the recipe.", ""]
    return "\n".join([*lines, "## Licence", "", f"[CC BY 4.0]({LICENSE_URL}).", ""])


def _header(dataset: Dataset, request: ExportRequest, table: DataFrame) -> list[str]:
    """YAML; what is nested is JSON, which is YAML too."""
    sizes = (("n<1K", 1e3), ("1K<n<10K", 1e4), ("10K<n<100K", 1e5), ("100K<n<1M", 1e6))
    size = next((text for text, limit in sizes if table.height < limit), "n>1M")
    ends = {"parquet": "-*.parquet", "webdataset": "-*.tar", "frames": "/**"}
    there = [name for name in SPLITS if (table["split"] == name).any()]
    files = [{"split": name, "path": f"{FOLDER[request.form]}/{name}{ends[request.form]}"} for name in there]
    found = [
        "license: cc-by-4.0",
        f"pretty_name: {json.dumps(f'{dataset.info.name} ({request.frames.preset})')}",
        'tags: ["omnidirectional", "catadioptric", "synthetic", "metrology"]',
        'task_categories: ["depth-estimation", "keypoint-detection"]',
        f'size_categories: ["{size}"]',
        f"configs: {json.dumps([{'config_name': 'default', 'data_files': files}])}",
    ]
    if request.form == "parquet":
        plain = table.drop([column for column, _, _ in request.images])
        features = [
            {"name": name, **_card_feature(kind)} for name, kind in hugging_face_features(request, plain).items()
        ]
        found.append(f"dataset_info: {json.dumps({'features': features})}")
    return found


def _card_feature(kind: Any) -> dict[str, Any]:
    if kind["_type"] == "Image":
        return {"dtype": "image"}
    return {"list": kind["feature"]["dtype"]} if kind["_type"] == "Sequence" else {"dtype": kind["dtype"]}


def _reading(request: ExportRequest) -> list[str]:
    """Lines that read the export in its own tool."""
    code = {
        "parquet": 'import datasets\n\nrows = datasets.load_dataset(FOLDER, split="train")\nrows[0]["image_down"]',
        "webdataset": 'import webdataset\n\nrows = webdataset.WebDataset(SHARDS, shardshuffle=False).decode("pil")',
        "frames": 'import polars\n\nrows = polars.read_parquet("pairs.parquet")  # image_down: file in this folder',
    }
    return ["```python", *code[request.form].splitlines(), "```"]


def _description(dataset: Dataset, request: ExportRequest, table: DataFrame) -> str:
    rigs, rooms = len({row.rig for row in dataset.rows}), len({row.room for row in dataset.rows})
    counts = ((table.height, "pair"), (len(dataset.rows), "scene"), (rigs, "rig"), (rooms, "room"))
    text = ", ".join(f"{count} {noun}{'' if count == 1 else 's'}" for count, noun in counts)
    return (
        "Pairs of images of a laser spot in a mirror, seen by a camera that moves up by the stroke between them: "
        f"{text}. "
        f"Draws of the noise: {request.draws}. "
        "The exact pixel, mirror angles and distance D of every spot are known."
    )
