"""JSON forms of frozen descriptions (rigs, rooms, shapes), written and rebuilt; and documents compared to rounding.

Doubles survive exactly.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any, TypeVar, cast

from pydantic import TypeAdapter, ValidationError

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import first_fault
from phibench.scenes.holder import OF_TUBES
from phibench.scenes.random_streams import LARGEST_SEED
from phibench.scenes.rig import Rig
from phibench.scenes.validation import printable_line

T = TypeVar("T")


def to_json(value: object) -> Any:
    """JSON document (dicts, lists, numbers) of a frozen dataclass such as `Rig` or `Room`.

    A rig without a holder says nothing of one: its document, and with it every key and digest, is that of older ones.
    A holder that is no tube says nothing of glass, a mirror of steel nothing of its metal, and one without a measured
    reflectance nothing of that. A mirror of revolution without a form error says nothing of one.
    """
    document = _adapter(cast(Any, type(value))).dump_python(value, mode="json")
    if isinstance(value, Rig):
        for name in value.mirror.unsaid:
            del document["mirror"][name]
        if value.holder is None:
            del document["holder"]
        elif value.holder.kind != "tube":
            document["holder"] = {key: part for key, part in document["holder"].items() if key not in OF_TUBES}
    return document


def from_json(kind: type[T], document: Any) -> T:
    """Rebuild a frozen dataclass of type `kind` from its JSON document.

    No field of a stored description has a default: one that is left out would silently be another rig's.

    Raises
    ------
    DatasetError
        If the document does not describe one, lacks a field or has one too many.
    """
    name = getattr(kind, "__name__", str(kind))  # a union has none
    try:
        value = cast(T, _adapter(cast(Any, kind)).validate_python(document))
    except ValidationError as error:
        raise DatasetError(f"not a valid {name}: {first_fault(error)}") from error
    except (OverflowError, TypeError, RecursionError) as error:
        raise DatasetError(f"not a valid {name}: {printable_line(str(error), 200)}") from error
    if fault := _difference(document, to_json(value)):
        raise DatasetError(f"not a valid {name}: {fault}")
    return value


_LATER = {"form", "form_radius_m", "coat", "window", "sun", "holder", "metal", "reflectance_table", *OF_TUBES}
"""Fields that older versions do not have, whose default is what these versions meant: `mirror.form` in version 4."""
_LARGEST = 1e12  # of a number in a document: squares and products stay finite
_LARGEST_WHOLE = LARGEST_SEED  # seeds and names of random streams


def _difference(given: Any, whole: Any, place: str = "its root") -> str:
    """First place in which a document is not of the form of the whole description; empty if there is none."""
    if isinstance(whole, dict) and isinstance(given, dict):
        if missing := sorted(whole.keys() - given.keys() - _LATER):
            return f"{place} lacks the field {missing[0]}"
        if strange := sorted(map(str, given.keys() - whole.keys())):
            return f"{place} has the field {printable_line(strange[0], 60)}, which is none of it"
        inner = ((str(key), value, whole[key]) for key, value in given.items())
    elif isinstance(whole, list) and isinstance(given, list | tuple) and len(whole) == len(given):
        inner = ((str(number), *pair) for number, pair in enumerate(zip(given, whole, strict=True)))
    else:
        return "" if _same_kind(given, whole) else f"{place} is {printable_line(repr(given), 60)}: not allowed"
    faults = (
        _difference(value, known, key if place == "its root" else f"{place}.{key}") for key, value, known in inner
    )
    return next(filter(None, faults), "")


def _same_kind(given: Any, whole: Any) -> bool:
    """True for two numbers of any sensible size, and for two other values of one type."""
    if type(given) is int and type(whole) is int:
        return abs(given) <= _LARGEST_WHOLE
    numbers = [isinstance(value, int | float) and not isinstance(value, bool) for value in (given, whole)]
    return abs(given) <= _LARGEST if all(numbers) else type(given) is type(whole)


@cache
def _adapter(kind: Any) -> TypeAdapter[Any]:
    """Adapter of a type; making one takes longer than using it a hundred times."""
    return TypeAdapter(kind)


# closed forms round to some 1e-15; another machine's library differs by some units in the last place of each step
def same_number(a: float, b: float, relative: float = 1e-11, absolute: float = 1e-12) -> bool:
    """True if two doubles agree to rounding; two NaN do."""
    return (math.isnan(a) and math.isnan(b)) or math.isclose(a, b, rel_tol=relative, abs_tol=absolute)


def same_document(a: Any, b: Any, relative: float = 1e-11) -> bool:
    """Equality of nested documents, of their numbers to rounding."""
    if isinstance(a, dict) and isinstance(b, dict):
        return a.keys() == b.keys() and all(same_document(a[key], b[key], relative) for key in a)
    if isinstance(a, list | tuple) and isinstance(b, list | tuple):
        return len(a) == len(b) and all(same_document(x, y, relative) for x, y in zip(a, b, strict=True))
    return same_number(a, b, relative) if isinstance(a, float) and isinstance(b, float | int) else bool(a == b)
