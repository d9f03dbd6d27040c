"""Card (README with YAML header) and Croissant description (JSON-LD) of an export, with the meaning of its columns.

Dataset hosts read the card's header. Neither file holds a date: the same export gives the same bytes.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

from phibench.benchmark.export.pair_rows import INDEX, POSITION_FIELDS, SPLITS, ExportRequest
from phibench.benchmark.export.shard_files import FOLDER, hugging_face_features
from phibench.datasets.common.shown_text import markdown_text, table_lines
from phibench.datasets.frames.frame_files import VALUES, FrameRow
from phibench.datasets.read import Dataset
from phibench.datasets.store.croissant import (
    LICENSE_URL,
    PARQUET,
    counted,
    croissant_text,
    described_field,
    file_object,
    file_set,
    manifest_texts,
    record_set,
)
from phibench.datasets.store.schema import columns

if TYPE_CHECKING:
    from polars import DataFrame

_MEDIA = {
    "parquet": (PARQUET, "*.parquet"),
    "webdataset": ("application/x-tar", "*.tar"),
    "frames": ("image/png", "**/*.png"),
}

_PIXELS = "Pixels are (column, row), integers at pixel centres."


def croissant(
    dataset: Dataset, request: ExportRequest, table: DataFrame, index_sha256: str, hashes: Mapping[str, str]
) -> str:
    """JSON-LD text of an export whose index `table` has that SHA-256."""
    name = f"{dataset.info.name}-{request.frames.preset}"
    distribution = [file_object(INDEX, PARQUET, index_sha256), *_distribution(request, hashes)]
    about = "One row for each pair of images and draw of the noise, with the exact truth."
    types = {column: str(dtype) for column, dtype in table.schema.items()}
    pairs = record_set("pairs", about, types, column_texts(request), {"fileObject": {"@id": INDEX}}, key="key")
    text = f"{_description(dataset, request, table)} {_PIXELS}"
    return croissant_text(name, text, version("phibench"), distribution, [pairs, *_images(request)])


def _distribution(request: ExportRequest, hashes: Mapping[str, str]) -> list[dict[str, Any]]:
    """Shards one by one, with their hashes; plain images as one set, for `SHA256SUMS` has theirs."""
    media, pattern = _MEDIA[request.form]
    if request.form != "frames":
        return [file_object(name, media, hashes[name]) for name in sorted(hashes)]
    media, pattern = ("image/jpeg", "**/*.jpg") if request.end == ".jpg" else (media, pattern)
    includes = f"{FOLDER['frames']}/{pattern}"
    return [file_set("images", media, includes)]


def _images(request: ExportRequest) -> list[dict[str, Any]]:
    if request.form != "frames":
        return []  # pictures lie in tables or archives, which have extracts of their own
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
    texts = manifest_texts()
    frame = {name: described_field(field) for name, field in columns(FrameRow)}
    texts |= {f"{p}.{name}": frame[name] for p in ("down", "up") for name in POSITION_FIELDS}
    texts |= {name: frame[name] for name in ("draw", "preset", "jpeg_quality", "laser_level", "lamp_level")}
    texts |= {"key": "name of the pair in this draw", "split": "train, validation or test"}
    places = {"parquet": "shard and name", "webdataset": "shard and member", "frames": "file"}
    return texts | {column: f"{places[request.form]} of the image" for column, _, _ in request.images}


# The card.


def card(dataset: Dataset, request: ExportRequest, table: DataFrame) -> str:
    """README of an export: YAML header, what it is, columns."""
    name = markdown_text(dataset.info.name)
    lines = ["---", *_header(dataset, request, table), "---", "", f"# {name}, {request.frames.preset}", ""]
    lines += [_description(dataset, request, table), "", *_reading(request), "", "## Splits", ""]
    by = {"both": "rig or room", "rig": "rig", "room": "room"}[request.split_by]
    lines += [f"No two splits share a {by}, and draws of one pair stay together.", ""]
    lines += table_lines(("split", "pairs"), [(name, f"{int((table['split'] == name).sum())}") for name in SPLITS])
    values = VALUES[request.frames.sensor().output]
    if request.frames.region is not None:
        values = f"{values.removesuffix(', in a JPEG')}, in a PNG"
    lines += ["", "## Columns", "", f"Images: {values}.", ""]
    texts = column_texts(request)
    meanings = [(f"`{name}`", texts.get(name, "drawn by the recipe")) for name in table.columns]
    lines += table_lines(("column", "meaning"), meanings)
    lines += ["", f"{_PIXELS} `rigs.jsonl` has the numbers of every rig by the"]
    lines += ["ids in `rig` and `nominal_rig`, `rooms.jsonl` those of every room, `recipe.toml` the recipe.", ""]
    return "\n".join([*lines, "## Licence", "", f"[CC BY 4.0]({LICENSE_URL}).", ""])


def _header(dataset: Dataset, request: ExportRequest, table: DataFrame) -> list[str]:
    """YAML; what is nested is JSON, which is YAML too."""
    # size_categories of the Hub's cards
    sizes = (("n<1K", 1e3), ("1K<n<10K", 1e4), ("10K<n<100K", 1e5), ("100K<n<1M", 1e6))
    size = next((text for text, limit in sizes if table.height < limit), "n>1M")
    ends = {"parquet": "-*.parquet", "webdataset": "-*.tar", "frames": "/**"}
    there = [name for name in SPLITS if (table["split"] == name).any()]
    files = [{"split": name, "path": f"{FOLDER[request.form]}/{name}{ends[request.form]}"} for name in there]
    lines = [
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
        lines.append(f"dataset_info: {json.dumps({'features': features})}")
    return lines


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
    return (
        "Pairs of images of a laser spot in a mirror, seen by a camera that moves up by the stroke between them: "
        f"{counted(*counts)}. "
        f"Draws of the noise: {request.draws}. "
        "The exact pixel, mirror angles and distance D of every spot are known."
    )
