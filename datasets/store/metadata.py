"""Metadata of a data set, written and read: `dataset.json`, the manifest as lines and as a table, `rigs.jsonl`.

Doubles survive exactly. Numbers that do not exist are NaN in Python and null in JSON and Parquet.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import InputFile
from phibench.datasets.plan.plan import Plan, PosePlan
from phibench.datasets.recipe.tables import Recipe
from phibench.datasets.store import schema
from phibench.datasets.store.files import read_rows
from phibench.datasets.store.json_forms import from_json, to_json
from phibench.datasets.store.parquet_tables import parquet_bytes, to_table
from phibench.datasets.store.provenance import provenance
from phibench.datasets.store.schema import (
    READABLE_VERSIONS,
    SCHEMA_VERSION,
    DatasetInfo,
    LeftOutInfo,
    ManifestRow,
    PoseInfo,
    RigInfo,
    row_line,
)
from phibench.scenes.rig import Rig
from phibench.scenes.validation import nearest, printable_line

if TYPE_CHECKING:
    pass


# dataset.json.


CONVENTIONS = {
    "units": "SI: metres, radians, seconds, watts; layers are expected photo-electrons per second per pixel",
    "world": "right-handed, z up, origin on the floor below the stroke axis",
    "camera": "OpenCV axes: x right, y down, z along the optical axis, which looks up",
    "pixels": "integer (u, v) at pixel centres; the image spans [-0.5, W - 0.5] x [-0.5, H - 0.5]",
    "positions": "down is stroke position 1 (offset 0), up is position 2 (offset stroke_m)",
    "depth_m": "horizontal distance from the vertical line through the sphere centre at the down position",
    "phi_ray_rad": "theta / 2, theta between the ray that leaves the mirror and straight down",
    "phi_normal_rad": "polar angle of the outward mirror normal from straight down",
    "phi_incidence_rad": "angle of incidence on the mirror",
    "fall_off": "layers include the natural (cos^4) fall-off of the thin lens; do not apply it again",
    "bands": "planes R, G, B are electrons behind the three filters, not colours of light",
    "missing": "NaN in EXR planes and in Python, null in JSON and Parquet; object_id is -1",
}


def dataset_info(plan: Plan, environment: dict[str, Any]) -> DatasetInfo:
    """Describe a plan that is rendered in `environment` (variant, LLVM, threads)."""
    recipe = plan.recipe
    return DatasetInfo(
        schema_version=SCHEMA_VERSION,
        name=recipe.dataset.name,
        recipe=recipe.model_dump(mode="json"),
        recipe_sha256=recipe_sha256(recipe),
        rigs=len(plan.rigs),
        rooms=len(plan.rooms),
        poses=tuple(_pose_info(pose) for pose in plan.poses),
        samples=len(plan.pairs),
        shard=plan.shard,
        left_out=tuple(LeftOutInfo(sample_id=name, cause=cause) for name, cause in plan.left_out.items()),
        conventions=CONVENTIONS,
        provenance={**provenance(), **environment},
    )


def info_text(info: DatasetInfo) -> str:
    """Text of `dataset.json`; a data set of which nothing was left out has no such key, as before there was one."""
    document = info.model_dump(mode="json", exclude=None if info.left_out else {"left_out"})
    return json.dumps(document, indent=1, allow_nan=False) + "\n"


def same_content(a: DatasetInfo, b: DatasetInfo) -> bool:
    """True if two descriptions mean the same bytes; the commit does not count."""
    return _without_commit(a) == _without_commit(b)


def parse_info(text: str) -> DatasetInfo:
    """Read the text of a `dataset.json` that this version wrote.

    Raises
    ------
    DatasetError
        If it is not one.
    """
    return _info_file(Path(schema.INFO)).document(DatasetInfo, text.encode())


def recipe_sha256(recipe: Recipe) -> str:
    """Hash of a recipe's values: comments, order of keys and defaults left out do not count."""
    text = json.dumps(recipe.model_dump(mode="json"), sort_keys=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def read_info(folder: Path) -> DatasetInfo:
    """Read `dataset.json`.

    Raises
    ------
    DatasetError
        If the folder is missing, not a data set, of another schema version, or the file damaged.
    """
    path = folder / schema.INFO
    if not folder.is_dir():
        raise DatasetError(
            f"there is no folder {folder}; `phibench dataset make` makes a data set, `phibench demo` writes five pairs"
        )
    if not path.is_file():
        if (folder / schema.TruthFolder.FRAMES_SET).is_file():
            raise DatasetError(
                f"{folder} is a frames set, which `phibench score`, `bench` and PairDataset take; this needs the data "
                "set with layers that it comes from"
            )
        if (folder / schema.JOURNAL).is_file():
            raise DatasetError(
                f"{folder} is not a finished data set: it has no {schema.INFO}; wait until `phibench dataset make` has "
                "ended there, or give the same command again"
            )
        sets = sorted(path.parent.name for path in folder.glob(f"*/{schema.TruthFolder.FRAMES_SET}"))
        held = f"; give one of its frames sets: {', '.join(sets[:10])}" if sets else ""
        raise DatasetError(f"{folder} is not a data set: it has no {schema.INFO}{held}")
    file = _info_file(path)
    document = file.json()
    version = document.get("schema_version")
    if version not in READABLE_VERSIONS:
        known, shown = " and ".join(map(str, READABLE_VERSIONS)), printable_line(str(version), 60)
        raise DatasetError(f"{path} has schema version {shown}; this phibench reads versions {known}")
    return file.validated(DatasetInfo, document)


def _info_file(path: Path) -> InputFile:
    return InputFile(path, "run `phibench dataset verify` to see all faults, `phibench dataset repair` to mend them")


def _without_commit(info: DatasetInfo) -> str:
    provenance = {key: value for key, value in info.provenance.items() if key != "commit"}
    return info_text(info.model_copy(update={"provenance": provenance}))


def _pose_info(pose: PosePlan) -> PoseInfo:
    files = {name: schema.view_file(pose.pose_id, name) for name in ("ambient", "truth", "preview")}
    ids = {"pose": pose.pose_id, "rig": pose.rig, "room": pose.room}
    return PoseInfo(**ids, offset_m=pose.offset_m, ambient_seed=pose.seed, files=files)


# The manifest, as lines of JSON and as a flat table.


def manifest_documents(rows: Sequence[ManifestRow]) -> dict[str, bytes]:
    """Both forms as bytes, by file name."""
    return {
        schema.MANIFEST: "".join(row_line(row) + "\n" for row in rows).encode(),
        schema.TABLE: parquet_bytes(to_table(rows)),
    }


def read_manifest(folder: Path) -> list[ManifestRow]:
    """Rows of `manifest.jsonl`.

    Raises
    ------
    DatasetError
        If it is missing, or with the number of the first line that is not a row.
    """
    return read_rows(folder / schema.MANIFEST, ManifestRow)


def differences(folder: Path, rows: Sequence[ManifestRow]) -> list[str]:
    """One sentence per column in which the Parquet table differs from the rows."""
    expected = to_table(rows)
    try:
        table = InputFile(folder / schema.TABLE, "run `phibench dataset repair`").table()
    except DatasetError as error:
        return [str(error).removeprefix(f"{folder}{os.sep}")]
    expected = expected.drop(_later_columns(table.columns, rows))
    if table.schema != expected.schema or table.height != expected.height:
        return [f"{schema.TABLE} has other columns or rows than {schema.MANIFEST}"]
    changed = [name for name in table.columns if not table[name].equals(expected[name], null_equal=True)]
    return [f"{schema.TABLE} differs from {schema.MANIFEST} in column {name}" for name in changed]


def _later_columns(columns: Sequence[str], rows: Sequence[ManifestRow]) -> list[str]:
    """Columns that a table of an older version does not have, where every row has what that version meant."""
    later = {name: field.default for name, field in ManifestRow.model_fields.items() if not field.is_required()}
    return [
        name
        for name, default in later.items()
        if name not in columns and all(getattr(row, name) == default for row in rows)
    ]


# rigs.jsonl.


@dataclass(frozen=True)
class Rigs:
    """Rigs by id, kept as JSON documents and built when they are asked for: a large data set has many."""

    documents: dict[str, dict[str, Any]]

    def __len__(self) -> int:
        return len(self.documents)

    def __getitem__(self, name: str) -> Rig:
        if name not in self.documents:
            raise DatasetError(f"{schema.RIGS} has no rig '{name}'; {nearest(name, list(self.documents)[:20])}")
        if name not in self._built:
            self._built[name] = from_json(Rig, self.documents[name])
        return self._built[name]

    @cached_property
    def _built(self) -> dict[str, Rig]:
        return {}


def rigs_text(rigs: Mapping[str, Rig]) -> str:
    """Text of `rigs.jsonl`; doubles are written so that reading gives the same bits."""
    lines = (json.dumps({"rig": name, "resolved": to_json(rig)}, allow_nan=False) for name, rig in rigs.items())
    return "".join(line + "\n" for line in lines)


def read_rigs(folder: Path) -> Rigs:
    """Rigs of a data set.

    Raises
    ------
    DatasetError
        If the file is missing, or with the number of the first line that is not a rig.
    """
    return Rigs({info.rig: info.resolved for info in read_rows(folder / schema.RIGS, RigInfo)})
