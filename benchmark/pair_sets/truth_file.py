"""Truth file of a sealed set: the exact answers of its pairs, with a secret number.

It is canonical JSON: same truth and salt, same bytes. NaN is written as null. Version 1 had other names for the nominal
rig and stroke.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import InputFile
from phibench.datasets.store.documents import from_json, to_json
from phibench.datasets.store.pair_files import MOST_PAIRS, SpotTruthRow, TruthRow
from phibench.datasets.store.schema import Document
from phibench.estimator.pair_set import Distraction, ImageTruth, PairTruth
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig

Digest = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]

_MATRICES = ("bound_px2", "raw_bound_px2")
_RIGS = ("true_rig", "nominal_rig")
_NOT_SEALED = (
    "calibration_covariance",
    "depth_sigma_m",
)  # of a score's calibration, and of real pairs: never of a seal


class SealedTruth(Document):
    """The truth's file."""

    format: Literal["phibench truth 1", "phibench truth 2"]
    public_sha256: Digest
    salt: Digest
    truths: Annotated[tuple[TruthRow, ...], Field(strict=False, max_length=MOST_PAIRS)]


def truth_text(truths: Sequence[PairTruth], salt: str, public_sha256: str) -> str:
    """Text of the truth's file: sorted keys, no blanks, doubles that read back to the same bits."""
    document = {
        "format": "phibench truth 2",
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
        If the file is missing, its bytes are others, or it holds what is no truth.
    """
    file = InputFile(path, "give the truth's file")
    data = file.read()
    digest = hashlib.sha256(data).hexdigest()
    if digest != sha256:
        raise DatasetError(
            f"{path} is not the truth that was sealed: its SHA-256 begins with {digest[:12]}, the seal says "
            f"{sha256[:12]}; give the file that `phibench seal make` wrote for this set"
        )
    truths = []
    for place, row in enumerate(file.document(SealedTruth, data).truths):
        try:
            truths.append(truth_of(row))
        except DatasetError as error:
            raise file.fault(f"is damaged: truths.{place}: {error}") from error
    return truths


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


def truth_of(row: TruthRow) -> PairTruth:
    """A pair's truth of its document.

    Raises
    ------
    DatasetError
        If one of its rigs is none.
    """
    rigs = {name: from_json(Rig, getattr(row, name)) for name in _RIGS}
    return PairTruth(**{**dict(row), **rigs, "down": _spot(row.down), "up": _spot(row.up)})


def _spot(row: SpotTruthRow) -> ImageTruth:
    matrices = {name: _array(getattr(row, name)) for name in _MATRICES}
    distractions = tuple(Distraction(**dict(distraction)) for distraction in row.distractions)
    return ImageTruth(**{**dict(row), **matrices, "phi_rad": dict(row.phi_rad), "distractions": distractions})


def _without_arrays(spot: ImageTruth) -> ImageTruth:
    return replace(spot, bound_px2=None, raw_bound_px2=None)


def _lists(matrix: Array | None) -> list[list[float]] | None:
    return None if matrix is None else [[float(x) for x in row] for row in matrix]


def _array(rows: tuple[tuple[float, float], tuple[float, float]] | None) -> Array | None:
    return None if rows is None else np.array(rows)


def _null_for_nan(value: Any) -> Any:
    if isinstance(value, float):
        return None if math.isnan(value) else value
    if isinstance(value, dict):
        return {key: _null_for_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_null_for_nan(item) for item in value]
    return value
