"""Answers of a dense method as JSON: planes encoded in the method's process, checked in its parent.

A plane travels as its type, its shape and base64 of its bytes, so that nothing is unpickled.
"""

from __future__ import annotations

import base64
import binascii
import math
from typing import Any

import numpy as np

from phibench.benchmark.isolation.answers import AnswerError, described
from phibench.estimator.dense.dense_interface import DenseAnswer, require_shape
from phibench.scenes.validation import printable_line

_PLANES = ("depth_m", "target_uv_px", "sigma_depth_m")
_TYPES = ("<f4", "<f8")
_LONGEST = 400  # of a sentence


def most_bytes(shape: tuple[int, int]) -> int:
    """Length of the longest reply for a pair of this shape: three planes of doubles as base64, and some words."""
    return 3 * 8 * math.prod(shape) * 4 // 3 + (1 << 16)


def planes_text(value: object) -> dict[str, Any]:
    """Document of a dense answer; {"wrong": sentence} of anything else."""
    if not isinstance(value, DenseAnswer):
        return {"wrong": f"the method returned {described(value)}: a DenseAnswer(depth_m=...) is needed"}
    planes = {name: getattr(value, name) for name in _PLANES}
    return {"planes": {name: _encoded(plane) for name, plane in planes.items() if plane is not None}}


def _encoded(plane: Any) -> dict[str, Any]:
    array = np.ascontiguousarray(plane, dtype="<f4" if plane.dtype == np.float32 else "<f8")
    return {"type": array.dtype.str, "shape": list(array.shape), "base64": base64.b64encode(array.data).decode()}


def checked_planes(document: dict[str, Any], shape: tuple[int, int]) -> DenseAnswer:
    """Answer of a document of `planes_text`, for an image of this shape; the document may be forged.

    Raises
    ------
    AnswerError
        In one sentence.
    """
    try:
        if "wrong" in document:
            raise AnswerError(str(document["wrong"]))
        planes: dict[str, Any] = {
            name: _decoded(name, document["planes"][name]) for name in _PLANES if name in document["planes"]
        }
        answer = DenseAnswer(**planes)
        require_shape(answer, shape)
        return answer
    except ValueError as error:  # those of `DenseAnswer`, and an AnswerError
        raise AnswerError(printable_line(str(error), _LONGEST)) from None
    except Exception as error:  # a fault in the checks must cost this answer alone
        raise AnswerError(f"the answer cannot be read: {type(error).__name__}") from error


def _decoded(name: str, field: dict[str, Any]) -> Any:
    kind, shape = field["type"], tuple(field["shape"])
    if kind not in _TYPES or len(shape) > 3 or not all(type(n) is int and 0 <= n <= 1 << 16 for n in shape):
        raise AnswerError(f"{name} is no plane of float32 or float64")
    try:
        data = base64.b64decode(field["base64"], validate=True)
    except binascii.Error:
        raise AnswerError(f"{name} cannot be read") from None
    if len(data) != math.prod(shape) * np.dtype(kind).itemsize:
        raise AnswerError(f"{name} has {len(data)} bytes, which is not its shape {shape}")
    # in native order, as `DenseAnswer` asks for it
    return np.frombuffer(data, kind).reshape(shape).astype(np.dtype(kind).newbyteorder("="), copy=False)
