"""Validation shared by every description in ``scenes``: one clear sentence per fault."""

from __future__ import annotations

import math
from collections.abc import Sequence


class SceneError(ValueError):
    """A description that no real rig, room or laser can have."""


def finite(owner: str, name: str, value: float) -> float:
    """Return `value`, or raise `SceneError` if it is NaN or infinite."""
    if not math.isfinite(value):
        raise SceneError(f"{owner}.{name} = {value}: must be a finite number")
    return value


def within(owner: str, name: str, value: float, low: float, high: float) -> float:
    """Return `value` if low <= value <= high, else raise `SceneError` naming the range."""
    finite(owner, name, value)
    if not low <= value <= high:
        raise SceneError(f"{owner}.{name} = {value}: allowed range is {low} to {high}")
    return value


def positive(owner: str, name: str, value: float) -> float:
    """Return `value` if it is finite and above zero, else raise `SceneError`."""
    finite(owner, name, value)
    if value <= 0.0:
        raise SceneError(f"{owner}.{name} = {value}: must be above 0")
    return value


def finite_vector(owner: str, name: str, value: Sequence[float], length: int) -> tuple[float, ...]:
    """Return `value` as a tuple of `length` finite floats, else raise `SceneError`."""
    vector = tuple(float(x) for x in value)
    if len(vector) != length:
        raise SceneError(f"{owner}.{name} has {len(vector)} numbers: {length} are needed")
    for x in vector:
        finite(owner, name, x)
    return vector


def unit_vector(owner: str, name: str, value: Sequence[float]) -> tuple[float, ...]:
    """Return the 3-vector `value` scaled to length 1; raise `SceneError` for a zero vector."""
    vector = finite_vector(owner, name, value, 3)
    length = math.hypot(*vector)
    if length < 1e-9:
        raise SceneError(f"{owner}.{name} = {vector}: a direction must not be the zero vector")
    return tuple(x / length for x in vector)
