"""Values that the Tab key completes: names of recipes, presets, methods, data sets, parts and policies.

The shell starts `phibench` for them, so that nothing slow may be imported here. Presets and methods are read from their
files. Other names that stand in modules with NumPy stand here again; a test compares the two.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cyclopts.completion import CompletionContext

RECIPES = Path(__file__).parents[1] / "datasets" / "recipes"
_PRESETS = Path(__file__).parents[1] / "render" / "sensor" / "settings_presets.toml"
_REGISTRY = Path(__file__).parents[1] / "estimator" / "methods" / "registry.py"
PARTS = ("dev", "test", "paper", "mirrors", "films", "drives", "starter")
TITLE = "phibench-v4-"
POLICIES = ("paper", "greedy", "drive-only", "random", "oracle")
METHOD_PACKAGES = "phibench.methods"
_MOST_FILES = 200  # that a Tab shows: more is no help


def presets(_: CompletionContext) -> tuple[str, ...]:
    """Presets of the sensor that end in pixels."""
    tables = tomllib.loads(_PRESETS.read_text(encoding="utf-8"))["presets"]
    return tuple(name for name, table in tables.items() if table["output"] != "electrons")


def pictures(_: CompletionContext) -> tuple[str, ...]:
    """Pictures that `dataset panorama` unrolls: layers, and frames of two presets."""
    return "layers", "mjpeg", "srgb8"


def recipes(films: bool) -> Callable[[CompletionContext], Iterator[str]]:
    """Completer of shipped recipes, those with films or the others, and of TOML files."""

    def complete(context: CompletionContext) -> Iterator[str]:
        for file in sorted(RECIPES.glob("*.toml")):
            if ("\n[film]" in file.read_text(encoding="utf-8")) == films:
                yield file.stem
        yield from _files(context.incomplete, ".toml")

    return complete


def methods(context: CompletionContext) -> Iterator[str]:
    """Built-in methods, those of installed packages, and Python files."""
    from importlib.metadata import entry_points

    yield from named_methods(context)
    yield from (point.name for point in entry_points(group=METHOD_PACKAGES))
    yield from _files(context.incomplete, ".py")


def named_methods(_: CompletionContext) -> tuple[str, ...]:
    """Built-in methods, for commands that take no file; names that packages register are not looked up."""
    return tuple(re.findall(r'^    BuiltIn\(\s+"(\w+)"', _REGISTRY.read_text(encoding="utf-8"), re.MULTILINE))


def released(_: CompletionContext) -> tuple[str, ...]:
    """Released data sets, by their last words and by their titles."""
    return *PARTS, *(f"{TITLE}{part}" for part in PARTS)


def parts(_: CompletionContext) -> tuple[str, ...]:
    """Parts of the frozen benchmark."""
    return PARTS


def policies(context: CompletionContext) -> Iterator[str]:
    """Policies of the loop, and Python files."""
    yield from POLICIES
    yield from _files(context.incomplete, ".py")


def _files(begun: str, suffix: str) -> Iterator[str]:
    """Files with a suffix in the folder of what is typed, and in folders whose names begin so, as they are typed."""
    typed = begun[: begun.rfind("/") + 1]
    folder, word = Path(typed or "."), begun[len(typed) :]
    # folders below take long, and only a word narrows them
    patterns = (f"*{suffix}", f"*/*{suffix}") if word else (f"*{suffix}",)
    names = {path.relative_to(folder).as_posix() for pattern in patterns for path in folder.glob(pattern)}
    shown = sorted(name for name in names if name.startswith(word) and not name.startswith("."))
    yield from (typed + name for name in shown[:_MOST_FILES])
