"""Frozen descriptions of `scenes` to JSON and back; doubles survive exactly."""

from __future__ import annotations

from functools import cache
from typing import Any, TypeVar, cast

from pydantic import TypeAdapter, ValidationError

from phibench.datasets.errors import DatasetError

T = TypeVar("T")


def to_json(value: object) -> Any:
    """JSON document (dicts, lists, numbers) of a frozen dataclass such as `Rig` or `Room`."""
    return _adapter(cast(Any, type(value))).dump_python(value, mode="json")


def from_json(kind: type[T], document: Any) -> T:
    """Rebuild a frozen dataclass of type `kind` from its JSON document.

    Raises
    ------
    DatasetError
        If the document does not describe one.
    """
    try:
        return cast(T, _adapter(cast(Any, kind)).validate_python(document))
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise DatasetError(f"not a valid {kind.__name__} at {where or 'its root'}: {first['msg']}") from error


@cache
def _adapter(kind: Any) -> TypeAdapter[Any]:
    """Adapter of a type; making one takes longer than using it a hundred times."""
    return TypeAdapter(kind)
