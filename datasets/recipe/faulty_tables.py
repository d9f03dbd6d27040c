"""Tables of a recipe's document that may be faulty: what is sound of them, for checks across several keys."""

from __future__ import annotations

from typing import Any, TypeVar, cast

from pydantic import ValidationError

from phibench.datasets.recipe.distributions import DistributionTable, Table, one_number

Raw = dict[str, Any]
T = TypeVar("T", bound=Table)


def sound_of(raw: object, model: type[T]) -> T | None:
    """Table of `raw` without its faulty keys; None where that leaves out a key that must be there."""
    try:
        return model.model_validate(raw)
    except ValidationError as error:
        faulty = {details["loc"][0] for details in error.errors() if details["loc"]}
    rest = {key: value for key, value in raw.items() if key not in faulty} if isinstance(raw, dict) else None
    return None if rest is None or len(rest) == len(cast(Raw, raw)) else sound_of(rest, model)


def distribution_of(given: object) -> DistributionTable | None:
    """Distribution, or None where it is missing or faulty."""
    return None if given is None else sound_of(one_number(given), DistributionTable)


def table_of(raw: Raw, *keys: str) -> Raw:
    """Table below some keys; an empty one where there is none."""
    found: object = raw
    for key in keys:
        found = found.get(key) if isinstance(found, dict) else None
    return found if isinstance(found, dict) else {}


def tables_of(raw: Raw, key: str) -> list[tuple[int, Raw]]:
    """Entries of an array of tables that are tables, with their index."""
    return [(i, entry) for i, entry in enumerate(list_of(raw, key)) if isinstance(entry, dict)]


def list_of(table: Raw, key: str) -> list[Any]:
    """List of a key; an empty one where there is none."""
    return values if isinstance(values := table.get(key), list) else []


def boards_of(table: Raw) -> list[Any]:
    """Names of the boards that a table with `target` draws from."""
    given = table.get("target")
    return [given] if isinstance(given, str) else list_of(table_of(table, "target"), "choice")
