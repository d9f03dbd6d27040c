"""Options that commands share, with limits and declarations of methods; converters, and values for tab completion.

`--method` is repeated, `--sample` names one sample by its number or id, `--samples` is a count, `--out` is the file or
folder to write. Wherever a method runs, `Limits` are its options.

The shell starts `phibench` to complete a value, so that nothing slow may be imported here. Presets and methods are read
from their files. Other names that stand in modules with NumPy stand here again; a test compares the two.
"""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Group, Parameter, Token

if TYPE_CHECKING:
    from cyclopts.completion import CompletionContext

    from phibench.benchmark.isolation.run_limits import RunLimits
    from phibench.benchmark.scores.score_document import Declared

START, DATA, METHODS, SENSOR, KEEPERS, INSTALLATION = (
    Group.create_ordered(name)
    for name in ("Start with", "Data sets", "Methods", "Sensor and paper", "Publish and study", "Installation")
)
DEFAULT_PRESET = "mjpeg"  # what the C310 delivers; a data set's own presets go before it
SECONDS = 30.0  # of one pair; those of `run_limits.RunLimits`, slow to import
MEMORY_MB = 4096.0  # of a method; a network and its arrays fit


_PACKAGE = Path(__file__).parents[1]
RECIPES = _PACKAGE / "datasets" / "recipes"
_PRESETS = _PACKAGE / "render" / "sensor" / "settings_presets.toml"
_REGISTRY = _PACKAGE / "estimator" / "methods" / "registry.py"
PARTS = ("dev", "test", "paper", "mirrors", "films", "drives", "dense-dev", "dense-test", "starter")
TITLE = "phibench-v4-"
POLICIES = ("paper", "greedy", "drive-only", "random", "oracle")
METHOD_PACKAGES = "phibench.methods"
_MOST_FILES = 200  # that a Tab shows: more is no help


def presets(_: CompletionContext) -> tuple[str, ...]:
    """Presets of the sensor that end in pixels."""
    tables = tomllib.loads(_PRESETS.read_text(encoding="utf-8"))["presets"]
    return tuple(name for name, table in tables.items() if table.get("output") != "electrons")


def pictures(_: CompletionContext) -> tuple[str, ...]:
    """Pictures that `dataset panorama` unrolls: layers, and frames of two presets."""
    return "layers", "mjpeg", "srgb8"


def shipped(_: CompletionContext) -> tuple[str, ...]:
    """All shipped recipes."""
    return tuple(file.stem for file in sorted(RECIPES.glob("*.toml")))


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


def _whole(_kind: object, tokens: Sequence[Token]) -> int:
    """Convert a whole number as it is written: cyclopts would round 1.5 without a word."""
    try:
        return int(tokens[0].value)
    except ValueError:
        raise ValueError(f"{tokens[0].value!r} is not a whole number") from None


def number(_kind: object, tokens: Sequence[Token]) -> float:
    """Convert a number; one with a comma is refused with what to write instead."""
    text = tokens[0].value
    try:
        return float(text)
    except ValueError:
        other = text.replace(",", ".")  # a decimal comma
        hint = f"; write {other}" if text.count(",") == 1 and other.replace(".", "", 1).isdigit() else ""
        raise ValueError(f"{text!r} is not a number{hint}") from None


def _variant(_kind: object, tokens: Sequence[Token]) -> str:
    """Variant of Mitsuba for this command and all processes that it starts."""
    known, asked = ("llvm", "cuda"), tokens[0].value
    if asked not in known:
        raise ValueError(f"there is no variant {asked!r}: give {' or '.join(known)}")
    os.environ["PHIBENCH_VARIANT"] = asked
    return asked


Variant = Annotated[
    str | None,
    Parameter(
        name="--variant",
        converter=_variant,
        help="What renders on this machine: llvm, on the processor, or cuda, on an NVIDIA GPU; by default "
        "PHIBENCH_VARIANT, else llvm. Workers of a scheduler take their own.",
    ),
]
Whole = Annotated[int, Parameter(converter=_whole)]
Metres = Annotated[float, Parameter(converter=number)]
Flag = Annotated[bool, Parameter(negative="")]
Counts = Annotated[tuple[Whole, Whole] | None, Parameter(negative="")]
DataFolder = Annotated[Path, Parameter(help="Folder of a data set.")]
FilmFolder = Annotated[Path, Parameter(help="Folder of films.")]
OutFolder = Annotated[Path, Parameter(help="Folder to write.")]
OneSample = Annotated[
    str | None, Parameter(help="Sample: its number, counted from 0, or its id; the first one by default.")
]
SensorFile = Annotated[
    Path | None, Parameter(help="TOML file of the sensor; by default the preset of the kind of file is assumed.")
]
Workers = Annotated[int | None, Parameter(converter=_whole, help="Number of processes; one for each core by default.")]
Scheduler = Annotated[
    str | None, Parameter(help="Address or scheduler file of a running dask scheduler, to use its workers instead.")
]
PairsAtOnce = Annotated[
    int,
    Parameter(
        converter=_whole,
        help="Pairs that are worked on at a time. From 2 on, as many further processes draw them, where they are 40 or "
        "more.",
    ),
]
BootstrapSeed = Annotated[int, Parameter(converter=_whole, help="Seed of the bootstrap that makes the intervals.")]
Preset = Annotated[str, Parameter(completer=presets)]
OwnOrPreset = Annotated[str | None, Parameter(completer=presets)]
Methods = Annotated[
    list[str] | None,
    Parameter(
        name="--method",
        negative="",
        completer=methods,
        help="A method: a name that `phibench method list` shows, or FILE.py:FUNCTION. May be given several times.",
    ),
]
BuiltIn = Annotated[
    list[str] | None,
    Parameter(
        name="--method",
        negative="",
        completer=named_methods,
        help="A built-in or registered method, as `phibench method list` shows. May be repeated; all by default.",
    ),
]


@Parameter(name="*")
@dataclass(frozen=True)
class Limits:
    """Limits under which methods run."""

    seconds: Annotated[float, Parameter(help="Time limit of a method for one pair, seconds.")] = SECONDS
    memory_mb: Annotated[
        float,
        Parameter(help="Limit of a method's address space on top of what its imports take, 1e6 bytes. Linux only."),
    ] = MEMORY_MB
    fresh: Annotated[
        bool, Parameter(negative="", help="A process for each pair: what a method keeps between pairs is lost.")
    ] = False
    allow: Annotated[
        tuple[str, ...],
        Parameter(negative="", help="A file or folder that methods may read, besides their own. May be given again."),
    ] = ()

    @property
    def of_run(self) -> RunLimits:
        """The same for the harness.

        Raises
        ------
        MethodError
            If a number is out of its range.
        """
        from phibench.benchmark.isolation.run_limits import RunLimits

        return RunLimits(self.seconds, self.memory_mb, fresh=self.fresh, allow=self.allow)


LIMITS = Limits()


@Parameter(name="*")
@dataclass(frozen=True)
class OwnWord:
    """Statement of yours on methods of your own; nobody can check it (docs/submission.md).

    Parameters
    ----------
    division
        closed: tuned on dev alone; open: on anything else. Built-in methods are closed, others open by default.
    self_calibrates
        The method corrects the rig from the pictures that it gets.
    """

    division: Literal["closed", "open"] | None = None
    self_calibrates: Flag = False

    def declared(self, references: Sequence[str]) -> Declared:
        """The same for the harness.

        Raises
        ------
        DatasetError
            If something is said and every method is built in.
        """
        from phibench.benchmark.scores.score_document import Declared

        if self.division is not None or self.self_calibrates:
            _require_own(references)
        return Declared(self.division, self.self_calibrates)


def _require_own(references: Sequence[str]) -> None:
    from phibench.datasets.common.errors import DatasetError
    from phibench.estimator.methods.registry import KNOWN

    if all(name in KNOWN for name in references):
        raise DatasetError(
            f"--division and --self-calibrates are of methods of your own: {references[0]} is built in, closed, "
            "and takes the rig as it is given; leave them out"
        )


OWN_WORD = OwnWord()
