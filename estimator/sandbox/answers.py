"""Answers of a method as JSON: encoded in the method's process, checked in its parent.

A method may return anything. Encoding keeps what JSON can hold; the check gives one plain sentence if it is no answer.
"""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np

from phibench.estimator.geometry.phi import CONVENTIONS
from phibench.estimator.interface import OK, Answer, Matrix2, Spot
from phibench.scenes.validation import nearest

_MOST = 64  # numbers or letters of a value that is none of ours


def answer_text(value: object) -> dict[str, Any]:
    """Document of an answer; {"wrong": sentence} of anything else."""
    if not isinstance(value, Answer):
        return {"wrong": f"the method returned {described(value)}: an Answer(down, up) is needed"}
    for name in ("down", "up"):
        if not isinstance(getattr(value, name), Spot):
            return {"wrong": f"{name} is {described(getattr(value, name))}: a Spot is needed"}
    numbers = {name: plain(getattr(value, name)) for name in ("depth_m", "sigma_depth_m")}
    return {"down": _spot_document(value.down), "up": _spot_document(value.up), **numbers}


def _spot_document(spot: Spot) -> dict[str, Any]:
    return {name: plain(getattr(spot, name)) for name in Spot.__dataclass_fields__}


def plain(value: Any) -> Any:
    """Numbers, texts and lists of them as they are, arrays as lists; {"type": ...} of what is neither."""
    if value is None or isinstance(value, (bool, int, float)):
        return value
    if isinstance(value, str):
        return value[: 8 * _MOST]
    if hasattr(value, "tolist") and getattr(value, "size", _MOST + 1) <= _MOST:
        return plain(value.tolist())
    if isinstance(value, (list, tuple)) and len(value) <= _MOST:
        return [plain(part) for part in value]
    return {"type": described(value)}


def described(value: object) -> str:
    """A value in a few words: "None", "a tuple of 2", "an array of shape (720, 1280)"."""
    if value is None:
        return "None"
    kind, shape = type(value).__name__, getattr(value, "shape", None)
    if isinstance(shape, tuple):
        return f"an array of shape {shape}"
    article = "an" if kind[0].lower() in "aeiou" else "a"
    return f"{article} {kind} of {len(value)}" if isinstance(value, (tuple, list, dict)) else f"{article} {kind}"


def to_bytes(document: dict[str, Any]) -> bytes:
    """JSON; NaN as Python writes it."""
    return json.dumps(document).encode()


_SYMMETRIC = 1e-6  # relative: a covariance in single precision passes


class AnswerError(ValueError):
    """Not an answer; the message says what is wrong and what is needed."""


def checked(document: dict[str, Any]) -> Answer:
    """Answer of a document of `answer_text`.

    Where a status is not "ok" whatever position comes with it is dropped.

    Raises
    ------
    AnswerError
        If a number is missing, not finite or out of its range, a covariance is not symmetric and positive definite, or
        a convention is unknown.
    """
    if "wrong" in document:
        raise AnswerError(document["wrong"])
    down, up = _checked_spot("down", document["down"]), _checked_spot("up", document["up"])
    depth, sigma = (_positive(name, document[name]) for name in ("depth_m", "sigma_depth_m"))
    if sigma is not None and depth is None:
        raise AnswerError("sigma_depth_m comes without depth_m: give both or neither")
    return Answer(down, up, depth, sigma)


def _checked_spot(name: str, document: dict[str, Any]) -> Spot:
    status = document["status"]
    if not isinstance(status, str) or not status:
        raise AnswerError(f"{name}.status is {_shown(status)}: 'ok', or in a few words why there is no position")
    if status != OK:
        return Spot.missing(status)
    phi = _phi(name, document["phi_rad"])
    convention = document["phi_convention"]
    if convention not in CONVENTIONS:
        raise AnswerError(f"{name}.phi_convention is {_shown(convention)}: {nearest(str(convention), CONVENTIONS)}")
    covariance = _covariance(name, document["covariance_px2"])
    return Spot(_position(name, document["uv_px"]), covariance, phi, convention)


def _position(name: str, value: Any) -> tuple[float, float]:
    if not (isinstance(value, list) and len(value) == 2 and all(_is_number(x) for x in value)):
        raise AnswerError(
            f"{name}.uv_px is {_shown(value)} with status 'ok': two numbers (u, v) in pixels are needed, "
            "or Spot.missing('why')"
        )
    u, v = (float(x) for x in value)
    if not (math.isfinite(u) and math.isfinite(v)):
        raise AnswerError(
            f"{name}.uv_px is ({u:g}, {v:g}) with status 'ok': give finite numbers, or Spot.missing('why')"
        )
    return u, v


def _phi(name: str, value: Any) -> float | None:
    if value is None:
        return None
    if not _is_number(value) or not math.isfinite(value):
        raise AnswerError(f"{name}.phi_rad is {_shown(value)}: a finite number is needed, or None")
    if not 0.0 <= value <= math.pi / 2.0:
        degrees = " These look like degrees: give radians." if math.pi / 2.0 < value <= 90.0 else ""
        raise AnswerError(f"{name}.phi_rad is {value:g}: the allowed range is 0 to pi/2, radians.{degrees}")
    return float(value)


def _covariance(name: str, value: Any) -> Matrix2 | None:
    if value is None:
        return None
    rows = value if isinstance(value, list) else []
    if len(rows) != 2 or not all(isinstance(row, list) and len(row) == 2 and all(map(_is_number, row)) for row in rows):
        raise AnswerError(f"{name}.covariance_px2 is {_shown(value)}: 2 x 2 numbers are needed, or None")
    C = np.array(rows, float)
    if not np.isfinite(C).all():
        raise AnswerError(f"{name}.covariance_px2 holds numbers that are not finite: give None if it is not known")
    if abs(C[0, 1] - C[1, 0]) > _SYMMETRIC * max(abs(C[0, 1]), abs(C[1, 0])):
        raise AnswerError(f"{name}.covariance_px2 is not symmetric: {C[0, 1]:g} and {C[1, 0]:g} must be the same")
    least = float(np.linalg.eigvalsh((C + C.T) / 2.0)[0])
    if not least > 0.0:
        raise AnswerError(f"{name}.covariance_px2 is not positive definite: its least eigenvalue is {least:.3g} px^2")
    return (float(C[0, 0]), float(C[0, 1])), (float(C[1, 0]), float(C[1, 1]))


def _positive(name: str, value: Any) -> float | None:
    if value is None:
        return None
    if not _is_number(value) or not math.isfinite(value) or not value > 0.0:
        raise AnswerError(f"{name} is {_shown(value)}: a finite number above 0 is needed, metres, or None")
    return float(value)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _shown(value: Any) -> str:
    if isinstance(value, dict):
        return str(value.get("type", "an object"))
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
