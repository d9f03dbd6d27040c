"""An answer as JSON can hold it, whatever a method returned: made in the method's process, judged in its parent."""

from __future__ import annotations

import json
from typing import Any

from phibench.estimator.seat.pair import Answer, Spot

_MOST = 64  # numbers or letters of a value that is none of ours


def answer_text(value: object) -> dict[str, Any]:
    """Document of an answer; {"wrong": sentence} of anything else."""
    if not isinstance(value, Answer):
        return {"wrong": f"the method returned {described(value)}: an Answer(down, up) is needed"}
    for name in ("down", "up"):
        if not isinstance(getattr(value, name), Spot):
            return {"wrong": f"{name} is {described(getattr(value, name))}: a Spot is needed"}
    numbers = {name: plain(getattr(value, name)) for name in ("depth_m", "sigma_depth_m")}
    return {"down": _spot(value.down), "up": _spot(value.up), **numbers}


def _spot(spot: Spot) -> dict[str, Any]:
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
