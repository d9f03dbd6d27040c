"""Range checks of numbers (`SceneError`), pydantic's errors of TOML tables in words (`Fault`), and nearest known names.

Each message is one sentence: path, value, allowed range and advice. The first half checks numbers of the descriptions
in `scenes` and raises `SceneError`. The second half reads TOML files that come with the package, and words pydantic's
errors in a table that a file fills.
"""

from __future__ import annotations

import difflib
import math
import tomllib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails


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
    vector = tuple(map(float, value))
    if len(vector) != length:
        raise SceneError(f"{owner}.{name} has {len(vector)} numbers: {length} are needed")
    if not all(map(math.isfinite, vector)):
        for x in vector:
            finite(owner, name, x)
    return vector


def unit_vector(owner: str, name: str, value: Sequence[float]) -> tuple[float, ...]:
    """Return the 3-vector `value` scaled to length 1; raise `SceneError` for a zero vector."""
    vector = finite_vector(owner, name, value, 3)
    length = math.hypot(*vector)
    if length < 1e-9:  # shorter ones have no direction but rounding's
        raise SceneError(f"{owner}.{name} = {vector}: a direction must not be the zero vector")
    return tuple(x / length for x in vector)


def nearest(name: str, known: Iterable[str]) -> str:
    """Advice for an unknown name: the nearest known one, and what is known."""
    names = [printable_line(one) for one in known]  # of a file of somebody else, perhaps
    guesses = close_names(name, names)
    guess = f"did you mean '{guesses[0]}'? " if guesses else ""
    return f"{guess}known: {', '.join(names)}"


def printable_line(text: str, most: int = 200) -> str:
    """Text from outside as one line that any terminal, file or page takes.

    Blanks and line ends become one blank. What cannot be printed (control characters, lone surrogates, marks that turn
    the direction) becomes its escape. What is longer than `most` characters is cut.
    """
    line = " ".join(text[: 8 * most].split())  # 8: enough for what is cut below, and no gigabyte is looked through
    shown = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in line[: most + 1])
    return shown if len(shown) <= most else f"{shown[: most - 3]}..."


def close_names(name: str, known: Iterable[str]) -> list[str]:
    """Nearest known name, if one is near: a list of one or none. Nearest is one with a unit, or another unit."""
    names = list(known)
    stem, stems = without_unit(name), {without_unit(one) for one in names}
    stem = also if (also := _ALSO_CALLED.get(stem)) in stems else stem
    alike = [one for one in names if without_unit(one) == stem]
    longer = [one for one in names if one.lower().startswith(f"{stem}_")]
    return alike[:1] or (longer if len(longer) == 1 else difflib.get_close_matches(name, names, 1, 0.5))


_ALSO_CALLED = {
    "f": "fx", "focal": "fx", "focal_length": "fx", "distance": "z_c", "pixel_size": "pixel_pitch",
    "gain": "gain_dn_per", "conversion_gain": "gain_dn_per", "system_gain": "gain_dn_per", "k": "gain_dn_per",
    "bit_depth": "adc_bits", "offset": "black_level", "dark_current": "dark_e_per", "dark_noise": "read_noise",
}  # fmt: skip
"""Names, without units, that people give to numbers of a rig or a sensor, with those that they have here."""
_UNITS = ("px", "m", "cm", "mm", "um", "nm", "deg", "rad", "s", "ms", "us", "e", "w", "mw", "dn")


def without_unit(name: str) -> str:
    """Name in small letters without the unit at its end: `fx_px` and `fx` are one name."""
    stem, _, unit = name.lower().rpartition("_")
    return stem if stem and unit in _UNITS else name.lower()


# Tables that a file fills.

Schema = dict[str, Any]
Location = tuple[str | int, ...]
_LIMITS = {"exclusiveMinimum": "above {}", "minimum": "from {}", "exclusiveMaximum": "below {}", "maximum": "up to {}"}
SHA256 = "^[0-9a-f]{64}$"
"""Pattern of a SHA-256 in a table."""
KINDS_OF_NUMBERS = {"uniform", "choice"}
"""Keys by which the schema of a distribution of numbers is known."""
_KINDS = {
    "number": "a number",
    "integer": "an integer",
    "string": "a string",
    "boolean": "true or false",
    "array": "a list",
    "object": "a table",
}


@dataclass(frozen=True)
class Fault:
    """One fault: where it is and what to do about it."""

    path: str
    text: str
    unknown: bool = False  # the key is none of the table's

    def __str__(self) -> str:
        return f"{self.path}: {self.text}"


def shipped_tables(path: Path) -> dict[str, Any]:
    """Tables of a TOML file that comes with the package.

    Raises
    ------
    SceneError
        If it is no TOML: the file and the line.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise SceneError(f"{path} is not valid TOML: {printable_line(str(error))}; mend it") from error


def structural_faults(model: type[BaseModel], raw: object) -> list[Fault]:
    """All keys of `raw` that are wrong, missing or unknown for `model`."""
    try:
        model.model_validate(raw)
    except ValidationError as error:
        schema = model.model_json_schema()
        faults = [_untagged(details) for details in error.errors() if not _follows(details)]
        return [_fault(schema, details) for details in _merged(schema, faults)]
    return []


def _untagged(details: ErrorDetails) -> ErrorDetails:
    """Return the same without the tags of unions in the location; they stand in angle brackets."""
    return {**details, "loc": tuple(key for key in details["loc"] if not str(key).startswith("<"))}


def _follows(details: ErrorDetails) -> bool:
    """Return True for a list that is too short only because its faulty entries were not counted."""
    return details["type"] == "too_short" and len(details["input"]) >= details["ctx"]["min_length"]


def _merged(schema: Schema, found: list[ErrorDetails]) -> list[ErrorDetails]:
    """Leave out that a key is missing where an unknown one is its misspelling: one typo is one fault."""
    meant: set[Location] = set()
    for details in found:
        if details["type"] == "extra_forbidden":
            *table, name = details["loc"]
            known = schema_node(schema, tuple(table)).get("properties", {})
            meant.update((*table, close) for close in close_names(str(name), known))
    return [details for details in found if details["type"] != "missing" or details["loc"] not in meant]


def path_text(location: Sequence[str | int]) -> str:
    """Path of a key as people write it, such as ``targets[2].depth_m``."""
    parts = (f"[{key}]" if isinstance(key, int) else f".{key}" for key in location)
    return "".join(parts).removeprefix(".") or "recipe"


def _fault(schema: Schema, details: ErrorDetails) -> Fault:
    kind, location, given = details["type"], details["loc"], details["input"]
    path = path_text(location)
    if kind == "value_error":  # of a validator of ours, which says all
        return Fault(path, str(details["ctx"]["error"]))
    if kind == "extra_forbidden":
        known = schema_node(schema, location[:-1]).get("properties", {})
        return Fault(path, f"unknown key; {nearest(str(location[-1]), known)}", unknown=True)
    node = schema_node(schema, location)
    hint = f" ({node['description']})" if "description" in node else ""
    if kind == "missing":
        return Fault(path, f"missing; add {allowed_text(node)}{hint}")
    if isinstance(given, dict) and node.get("type") == "array" and not _plain(node):
        return Fault(path, f"a single table; write [[{path}]] with two brackets, once for each entry{hint}")
    return Fault(path, f"{_shown(given)} is not allowed; give {allowed_text(node)}{hint}")


def schema_node(schema: Schema, location: Location) -> Schema:
    """Return the part of a JSON schema that describes one key, references and optional values resolved."""
    node = _resolve(schema, schema)
    for key in location:
        inner = _entry(node, key) if isinstance(key, int) else _value(node, key)
        description = inner.get("description")
        node = _resolve(schema, inner)
        node = {**node, "description": description} if description else node
    return node


def _resolve(schema: Schema, node: Schema) -> Schema:
    options = [option for key in ("anyOf", "oneOf") for option in node.get(key, ()) if option.get("type") != "null"]
    if options:
        return _resolve(schema, {**node, "anyOf": (), "oneOf": (), **options[0]})
    if "$ref" in node:
        return _resolve(schema, schema["$defs"][node["$ref"].rsplit("/", 1)[-1]])
    return node


def allowed_text(node: Schema) -> str:
    """Say in words what a JSON schema node allows."""
    if KINDS_OF_NUMBERS <= set(node.get("properties", {})):
        return "a number or a distribution such as { uniform = [low, high] }"
    if set(node.get("properties", {})) == {"choice"}:
        return "a name or { choice = [names] }" + _names(node["properties"]["choice"])
    if "enum" in node or "const" in node:
        return "one of " + ", ".join(repr(value) for value in node.get("enum", [node.get("const")]))
    words = [_KINDS.get(node.get("type", ""), "a value"), *_limits(node)]
    if "pattern" in node:
        if node["pattern"] == SHA256:
            return "a string of 64 digits 0 to 9 and a to f"
        words.append(f"of at most {node['maxLength']} letters, digits and signs like {_signs(node['pattern'])}")
    if "minItems" in node:
        count = "of" if node["minItems"] == node.get("maxItems") else "of at least"
        words.append(f"{count} {node['minItems']} ({allowed_text(_entry(node))})" if _plain(node) else "with entries")
    elif "maxItems" in node:
        words.append(f"of at most {node['maxItems']} entries")
    return " ".join(words)


def _names(node: Schema) -> str:
    """Names of a choice, if they are known: with a colon before them."""
    known = _entry(node).get("enum", ())
    return f": {', '.join(map(repr, known))}" if known else ""


def _limits(node: Schema) -> list[str]:
    return [text.format(_number(node[key])) for key, text in _LIMITS.items() if key in node]


def _plain(node: Schema) -> bool:
    entry = _entry(node)
    return bool(entry) and "$ref" not in entry


def _entry(node: Schema, index: int = 0) -> Schema:
    """Schema of a list's entry; a list of so many entries has one for each."""
    each = node.get("prefixItems", ())
    entry: Schema = each[min(index, len(each) - 1)] if each else node.get("items") or {}
    return entry


def _value(node: Schema, key: str) -> Schema:
    """Schema of a key's value; where the keys are names of anyone's choice, all have the same."""
    named = node.get("additionalProperties")
    found: Schema = node.get("properties", {}).get(key, named if isinstance(named, dict) else {})
    return found


def _number(value: float) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def _signs(pattern: str) -> str:
    return "_ . -" if "-]" in pattern else "_ ."


def _shown(given: object) -> str:
    text = str(given).lower() if isinstance(given, bool) else repr(given)  # as TOML and JSON write it
    return text if len(text) <= 60 else text[:57] + "..."
