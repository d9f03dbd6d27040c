"""The truth of a set as one canonical JSON file: same truth and salt, same bytes. NaN is null."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from phibench.datasets.codec import from_json, to_json
from phibench.datasets.errors import DatasetError
from phibench.estimator.bench.truth import Distraction, PairTruth, SpotTruth
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig

_MATRICES = ("bound_px2", "raw_bound_px2")
_RIGS = ("true_rig", "believed_rig")
_NOT_SEALED = ("calibration_covariance",)  # a calibration comes with the score, never with the set


def truth_text(truths: Sequence[PairTruth], salt: str, public_sha256: str) -> str:
    """Text of the truth's file: sorted keys, no blanks, doubles that read back to the same bits."""
    document = {
        "format": "phibench truth 1",
        "public_sha256": public_sha256,
        "salt": salt,
        "truths": [truth_document(truth) for truth in truths],
    }
    return json.dumps(document, sort_keys=True, separators=(",", ":"), allow_nan=False) + "\n"


def read_truth_file(path: Path, sha256: str) -> list[PairTruth]:
    """Truths of a file whose bytes must have a hash.

    Raises
    ------
    DatasetError
        If the file is missing or its bytes are others.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DatasetError(f"{path} is not readable: {error.strerror or error}; give the truth's file") from error
    found = hashlib.sha256(data).hexdigest()
    if found != sha256:
        raise DatasetError(
            f"{path} is not the truth that was sealed: its SHA-256 begins with {found[:12]}, the seal says "
            f"{sha256[:12]}; give the file that `phibench dataset seal` wrote for this set"
        )
    return [truth_of(document) for document in json.loads(data)["truths"]]


def truth_document(truth: PairTruth) -> dict[str, Any]:
    """A pair's truth as JSON can hold it."""
    bare = replace(truth, down=_without_arrays(truth.down), up=_without_arrays(truth.up))
    document = {name: getattr(bare, name) for name in PairTruth.__dataclass_fields__ if name not in _NOT_SEALED}
    document |= {name: to_json(document[name]) for name in _RIGS}
    for position in ("down", "up"):
        spot = getattr(truth, position)
        matrices = {name: _lists(getattr(spot, name)) for name in _MATRICES}
        document[position] = {**asdict(getattr(bare, position)), **matrices}
    nulled: dict[str, Any] = _null_for_nan(document)
    return nulled


def truth_of(document: dict[str, Any]) -> PairTruth:
    """A pair's truth from its document."""
    rigs = {name: from_json(Rig, document[name]) for name in _RIGS}
    return PairTruth(**{**document, **rigs, "down": _spot(document["down"]), "up": _spot(document["up"])})


def _spot(document: dict[str, Any]) -> SpotTruth:
    u_px, v_px = map(_number, document["uv_px"])
    found = {
        "uv_px": (u_px, v_px),
        "phi_rad": {name: _number(value) for name, value in document["phi_rad"].items()},
        "distractions": tuple(
            Distraction(one["kind"], (one["uv_px"][0], one["uv_px"][1]), one["electrons"])
            for one in document["distractions"]
        ),
        **{name: _array(document[name]) for name in _MATRICES},
        **{name: _number(document[name]) for name in ("azimuth_rad", "electrons", "peak_e", "snr")},
    }
    return SpotTruth(**{**document, **found})


def _without_arrays(spot: SpotTruth) -> SpotTruth:
    return replace(spot, bound_px2=None, raw_bound_px2=None)


def _lists(matrix: Array | None) -> list[list[float]] | None:
    return None if matrix is None else [[float(x) for x in row] for row in matrix]


def _array(rows: list[list[float | None]] | None) -> Array | None:
    return None if rows is None else np.array([[_number(x) for x in row] for row in rows])


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)


def _null_for_nan(value: Any) -> Any:
    if isinstance(value, float):
        return None if math.isnan(value) else value
    if isinstance(value, dict):
        return {key: _null_for_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_null_for_nan(item) for item in value]
    return value
