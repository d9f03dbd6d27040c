"""Errors of recipes and data sets, and the check of a whole number; messages are for the person at the terminal."""

from __future__ import annotations

import operator
from typing import Any


class DatasetError(ValueError):
    """A data set that cannot be made, read or trusted."""


class RecipeError(DatasetError):
    """A recipe with faults; the message has one line per fault."""


class RefusedSampleError(DatasetError):
    """A sample that cannot be made, while others can: an answer that is not certain, or too much noise."""


class IncompleteError(DatasetError):
    """A run that has finished all samples but those that were refused; the message has one line for each of these."""


def whole_number(name: str, value: Any, low: int = 0) -> int:
    """Return `value` as a Python int: a NumPy integer would name another noise stream.

    Raises
    ------
    DatasetError
        If it is not an integer of at least `low`.
    """
    try:
        number = None if isinstance(value, bool) else operator.index(value)
    except TypeError:
        number = None
    if number is None or number < low:
        raise DatasetError(f"{name} = {value!r}: must be an integer, {low} or above")
    return number
