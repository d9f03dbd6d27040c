"""Answers of a method, spots or dense planes, as JSON: encoded in its process, checked in its parent as an outcome.

A method may return anything. Encoding keeps what JSON can hold; the check gives one plain sentence if it is no answer.
"""

from __future__ import annotations

import base64
import binascii
import json
import math
from typing import Any

import numpy as np

from phibench.estimator.dense.dense_interface import DenseAnswer, DensePair, require_shape
from phibench.estimator.geometry.phi import CONVENTIONS
from phibench.estimator.interface import FAILURES, OK, Answer, Matrix2, Outcome, Pair, Spot
from phibench.scenes.validation import nearest, printable_line

MESSAGE_LENGTH = 400  # of a fault: some lines of a terminal
_MOST = 64  # numbers or letters of a value that is none of ours
_DEEPEST = 4  # lists in each other: a covariance has two
_LARGEST_INTEGER = 10**300  # a float holds it; a longer one does not fit into any number of an answer


def answer_document(value: object) -> dict[str, Any]:
    """Document of an answer; {"wrong": sentence} of anything else."""
    if not isinstance(value, Answer):
        return {"wrong": f"the method returned {value_description(value)}: an Answer(down, up) is needed"}
    for name in ("down", "up"):
        if not isinstance(getattr(value, name), Spot):
            return {"wrong": f"{name} is {value_description(getattr(value, name))}: a Spot is needed"}
    numbers = {name: plain_values(getattr(value, name)) for name in ("depth_m", "sigma_depth_m", "interval_depth_m")}
    return {"down": _spot_document(value.down), "up": _spot_document(value.up), **numbers}


def _spot_document(spot: Spot) -> dict[str, Any]:
    return {name: plain_values(getattr(spot, name)) for name in Spot.__dataclass_fields__}


def plain_values(value: Any, depth: int = 0) -> Any:
    """Numbers, texts and lists of them as they are, arrays as lists; {"type": ...} of what is neither.

    Arrays and tensors of any library that NumPy reads are taken, and every kind of float.
    """
    if value is None or isinstance(value, bool):
        return value
    if isinstance(value, int):
        return int(value) if abs(value) < _LARGEST_INTEGER else {"type": f"an integer of {value.bit_length()} bits"}
    if isinstance(value, float):
        return float(value)
    if isinstance(value, str):
        return value[: 8 * _MOST]
    if isinstance(value, (list, tuple)):
        return (
            [plain_values(x, depth + 1) for x in value]
            if _is_small(value, depth)
            else {"type": value_description(value)}
        )
    shape = getattr(value, "shape", ())
    if not isinstance(shape, tuple) or len(shape) > _DEEPEST or math.prod(shape) > _MOST:
        return {"type": value_description(value)}
    listed = value.tolist() if hasattr(value, "tolist") else value
    # NumPy's longdouble lists itself
    return plain_values(listed, depth) if isinstance(listed, (int, float, str, list)) else _converted(value)


def _is_small(value: list[Any] | tuple[Any, ...], depth: int) -> bool:
    return len(value) <= _MOST and depth < _DEEPEST


def _converted(value: Any) -> Any:
    """Floats of what has none of Python's, such as `np.longdouble`."""
    try:
        array = np.asarray(value)
        with np.errstate(over="ignore"):  # infinity, which is refused later
            kind, listed = array.dtype.kind, np.asarray(array, float).tolist()
    except (TypeError, ValueError, OverflowError):  # ragged lists and objects of a method: told by their kind
        return {"type": value_description(value)}
    return listed if kind in "fiu" else {"type": value_description(value)}


def value_description(value: object) -> str:
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
_STATUS_LENGTH = 120  # of a method's own words: a line of a table

# What is beyond these comes from a fit that diverged. Squares, and errors in units of claimed deviations, stay finite.
_FAR_PX = 1e6
_VARIANCE_PX2 = (1e-18, 1e12)  # deviations from 1e-9 px, below any rounding, to `_FAR_PX`
_ELONGATION = 1e12  # largest over least eigenvalue: beyond it the least one is a rounding error
_DEPTH_M = (1e-6, 1e6)  # a micrometre to a thousand kilometres
_SIGMA_DEPTH_M = (1e-9, 1e9)  # a thousandth of the least D, a thousand times the largest


class AnswerError(ValueError):
    """Not an answer; the message says what is wrong and what is needed."""


def checked_answer(document: dict[str, Any]) -> Answer:
    """Answer of a document of `answer_document`.

    Where a status is not "ok" whatever position comes with it is dropped. The document may be forged: any JSON ends in
    an answer or in an `AnswerError` of one line.

    Raises
    ------
    AnswerError
        If a number is missing, not finite or out of its range, a covariance is not symmetric and positive definite, or
        a convention is unknown.
    """
    try:
        return _checked(document)
    except AnswerError as error:
        raise AnswerError(printable_line(str(error), 400)) from None
    except Exception as error:  # a fault in the checks must cost this answer alone
        raise AnswerError(f"the answer cannot be read: {type(error).__name__}") from error


def _checked(document: dict[str, Any]) -> Answer:
    if "wrong" in document:
        raise AnswerError(str(document["wrong"]))
    down, up = _checked_spot("down", document["down"]), _checked_spot("up", document["up"])
    depth = _positive("depth_m", document["depth_m"], _DEPTH_M)
    sigma = _positive("sigma_depth_m", document["sigma_depth_m"], _SIGMA_DEPTH_M)
    if sigma is not None and depth is None:
        raise AnswerError("sigma_depth_m comes without depth_m: give both or neither")
    return Answer(down, up, depth, sigma, _interval(document.get("interval_depth_m"), depth))


def _checked_spot(name: str, document: dict[str, Any]) -> Spot:
    status = document["status"]
    if not isinstance(status, str) or not status.strip():
        raise AnswerError(f"{name}.status is {_shown(status)}: 'ok', or in a few words why there is no position")
    status = printable_line(status, _STATUS_LENGTH)
    if status != OK:
        return Spot.missing(status)
    phi = _phi(name, document["phi_rad"])
    convention = document["phi_convention"]
    if not isinstance(convention, str) or convention not in CONVENTIONS:
        raise AnswerError(f"{name}.phi_convention is {_shown(convention)}: {nearest(str(convention), CONVENTIONS)}")
    covariance = _covariance(name, document["covariance_px2"])
    return Spot(_position(name, document["uv_px"]), covariance, phi, convention)


def _position(name: str, value: Any) -> tuple[float, float]:
    numbers = [_number(x) for x in value] if isinstance(value, list) and len(value) == 2 else [None, None]
    u, v = numbers
    if u is None or v is None:
        raise AnswerError(
            f"{name}.uv_px is {_shown(value)} with status 'ok': two numbers (u, v) in pixels are needed, "
            "or Spot.missing('why')"
        )
    if not (math.isfinite(u) and math.isfinite(v)):
        raise AnswerError(
            f"{name}.uv_px is ({u:g}, {v:g}) with status 'ok': give finite numbers, or Spot.missing('why')"
        )
    if max(abs(u), abs(v)) > _FAR_PX:
        raise AnswerError(f"{name}.uv_px is ({u:g}, {v:g}): the allowed range is -{_FAR_PX:g} to {_FAR_PX:g} px")
    return u, v


def _phi(name: str, value: Any) -> float | None:
    if value is None:
        return None
    phi = _number(value)
    if phi is None or not math.isfinite(phi):
        raise AnswerError(f"{name}.phi_rad is {_shown(value)}: a finite number is needed, or None")
    if not 0.0 <= phi <= math.pi / 2.0:
        degrees = " These look like degrees: give radians." if math.pi / 2.0 < phi <= 90.0 else ""
        raise AnswerError(f"{name}.phi_rad is {phi:g}: the allowed range is 0 to pi/2, radians.{degrees}")
    return phi


def _covariance(name: str, value: Any) -> Matrix2 | None:
    if value is None:
        return None
    rows = value if isinstance(value, list) else []
    numbers = [_number(x) for row in rows if isinstance(row, list) and len(row) == 2 for x in row]
    if len(rows) != 2 or len(numbers) != 4 or None in numbers:
        raise AnswerError(f"{name}.covariance_px2 is {_shown(value)}: 2 x 2 numbers are needed, or None")
    C = np.array(numbers, float).reshape(2, 2)
    if not np.isfinite(C).all():
        raise AnswerError(f"{name}.covariance_px2 holds numbers that are not finite: give None if it is not known")
    if np.abs(C).max() > _VARIANCE_PX2[1]:
        raise AnswerError(f"{name}.covariance_px2 holds {np.abs(C).max():.3g}: {_VARIANCE_PX2[1]:g} px^2 is the most")
    if abs(C[0, 1] - C[1, 0]) > _SYMMETRIC * max(abs(C[0, 1]), abs(C[1, 0])):
        raise AnswerError(f"{name}.covariance_px2 is not symmetric: {C[0, 1]:g} and {C[1, 0]:g} must be the same")
    least, largest = (float(x) for x in np.linalg.eigvalsh((C + C.T) / 2.0))
    if not least > 0.0:
        raise AnswerError(f"{name}.covariance_px2 is not positive definite: its least eigenvalue is {least:.3g} px^2")
    if least < max(_VARIANCE_PX2[0], largest / _ELONGATION):
        raise AnswerError(
            f"{name}.covariance_px2 has the eigenvalues {least:.3g} and {largest:.3g} px^2: {_VARIANCE_PX2[0]:g} is "
            f"the least, and their ratio may be {_ELONGATION:g}"
        )
    return (float(C[0, 0]), float(C[0, 1])), (float(C[1, 0]), float(C[1, 1]))


def _interval(value: Any, depth_m: float | None) -> tuple[float, float] | None:
    if value is None:
        return None
    if depth_m is None:
        raise AnswerError("interval_depth_m comes without depth_m: give both or neither")
    if not isinstance(value, list) or len(value) != 2:
        raise AnswerError(f"interval_depth_m is {_shown(value)}: two numbers (low, high) are needed, metres, or None")
    low, high = (_positive("interval_depth_m", x, _DEPTH_M) for x in value)
    if low is None or high is None or not low <= depth_m <= high or low == high:
        raise AnswerError(f"interval_depth_m is {_shown(value)}: two numbers low < high about depth_m are needed")
    return low, high


def _positive(name: str, value: Any, allowed: tuple[float, float]) -> float | None:
    if value is None:
        return None
    number, (low, high) = _number(value), allowed
    if number is None or not math.isfinite(number) or not number > 0.0:
        raise AnswerError(f"{name} is {_shown(value)}: a finite number above 0 is needed, metres, or None")
    if not low <= number <= high:
        raise AnswerError(f"{name} is {number:g}: the allowed range is {low:g} to {high:g} m")
    return number


def _number(value: Any) -> float | None:
    """Float of a JSON number, infinite where none holds it; None of what is no number."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    try:
        return float(value)
    except OverflowError:  # a whole number of more than 308 digits
        return math.inf if value > 0 else -math.inf


def _shown(value: Any) -> str:
    if isinstance(value, dict):
        return str(value.get("type", "an object"))
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


# Answers of a dense method as JSON: planes encoded in the method's process, checked in its parent.
#
# A plane travels as its type, its shape and base64 of its bytes, so that nothing is unpickled.


_PLANES = ("depth_m", "target_uv_px", "sigma_depth_m")
_TYPES = ("<f4", "<f8")
_LONGEST = 400  # of a sentence


def most_bytes(shape: tuple[int, int]) -> int:
    """Length of the longest reply for a pair of this shape: three planes of doubles as base64, and some words."""
    return 3 * 8 * math.prod(shape) * 4 // 3 + (1 << 16)


def dense_answer_document(value: object) -> dict[str, Any]:
    """Document of a dense answer; {"wrong": sentence} of anything else."""
    if not isinstance(value, DenseAnswer):
        return {"wrong": f"the method returned {value_description(value)}: a DenseAnswer(depth_m=...) is needed"}
    planes = {name: getattr(value, name) for name in _PLANES}
    return {"planes": {name: _encoded(plane) for name, plane in planes.items() if plane is not None}}


def _encoded(plane: Any) -> dict[str, Any]:
    array = np.ascontiguousarray(plane, dtype="<f4" if plane.dtype == np.float32 else "<f8")
    return {"type": array.dtype.str, "shape": list(array.shape), "base64": base64.b64encode(array.data).decode()}


def checked_dense_answer(document: dict[str, Any], shape: tuple[int, int]) -> DenseAnswer:
    """Answer of a document of `dense_answer_document`, for an image of this shape; the document may be forged.

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


def outcome_of(pair: Pair | DensePair, reply: dict[str, Any], seconds: float) -> Outcome:
    """Outcome of a pair from the reply of `method_worker.reply_of`; what is no answer is the failure "invalid"."""
    failure, message = reply.get("failure"), reply.get("message", "")
    if failure in FAILURES and isinstance(message, str):
        return Outcome(pair.number, None, seconds, failure, printable_line(message, MESSAGE_LENGTH))
    try:
        if isinstance(pair, DensePair):
            return Outcome(pair.number, None, seconds, dense=checked_dense_answer(reply["answer"], pair.shape))
        return Outcome(pair.number, checked_answer(reply["answer"]), seconds)
    except (AnswerError, KeyError) as error:
        text = str(error) if isinstance(error, AnswerError) else "the reply holds neither answer nor failure"
        return Outcome(pair.number, None, seconds, "invalid", text)
