"""`dataset.json`: what is in the folder, in which conventions, made by what."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from phibench.datasets import layout
from phibench.datasets.codec import to_json
from phibench.datasets.errors import DatasetError
from phibench.datasets.plan import Plan, PosePlan
from phibench.datasets.provenance import provenance
from phibench.datasets.recipe import Recipe
from phibench.datasets.schema import READABLE_VERSIONS, SCHEMA_VERSION, DatasetInfo, PoseInfo

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
        room=to_json(plan.room),
        object_names=plan.room.object_names(plan.rig.at(0.0)),
        poses=tuple(_pose_info(pose) for pose in plan.poses),
        samples=len(plan.pairs),
        shard=plan.shard,
        conventions=CONVENTIONS,
        provenance={**provenance(), **environment},
    )


def info_text(info: DatasetInfo) -> str:
    """Text of `dataset.json`."""
    return json.dumps(info.model_dump(mode="json"), indent=1, allow_nan=False) + "\n"


def same_content(a: DatasetInfo, b: DatasetInfo) -> bool:
    """Whether two descriptions mean the same bytes; the commit does not count."""
    return _without_commit(a) == _without_commit(b)


def parse_info(text: str) -> DatasetInfo:
    """Read the text of a `dataset.json` that this version wrote."""
    return DatasetInfo.model_validate(json.loads(text))


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
    path = folder / layout.INFO
    if not folder.is_dir():
        raise DatasetError(f"there is no folder {folder}")
    if not path.is_file():
        raise DatasetError(f"{folder} is not a data set: it has no {layout.INFO}")
    document = _json(path)
    version = document.get("schema_version")
    if version not in READABLE_VERSIONS:
        known = " and ".join(map(str, READABLE_VERSIONS))
        raise DatasetError(f"{path} has schema version {version}; this phibench reads versions {known}")
    try:
        return DatasetInfo.model_validate(document)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise DatasetError(f"{path}: {where}: {first['msg']}" if where else f"{path}: {first['msg']}") from error


def _json(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise DatasetError(f"{path} is not readable: {error.strerror or error}") from error
    except ValueError as error:
        raise DatasetError(f"{path} is damaged: {error}") from error
    if not isinstance(document, dict):
        raise DatasetError(f"{path} is damaged: it does not hold a JSON object")
    return document


def _without_commit(info: DatasetInfo) -> str:
    provenance = {key: value for key, value in info.provenance.items() if key != "commit"}
    return info_text(info.model_copy(update={"provenance": provenance}))


def _pose_info(pose: PosePlan) -> PoseInfo:
    files = {name: layout.view_file(pose.pose_id, name) for name in ("ambient", "truth", "preview")}
    return PoseInfo(pose=pose.pose_id, rig=pose.rig, offset_m=pose.offset_m, ambient_seed=pose.seed, files=files)
