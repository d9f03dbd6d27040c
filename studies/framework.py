"""Framework of the studies: findings, tables of text, data sets, drawings, the result, and settings in a TOML file.

A study is a question, settings, and a function from settings and data sets to a result. Data sets are rendered from
recipes, kept between runs and shared between studies. The top level of `settings.toml` is the full study; its table
`[quick]` holds what the reduced one changes. Drawings are SVG, or PNG where there are many marks.

A finding is a number that a study states: label, value, the ends of its 95 % interval, unit. Where a statement hangs on
the number there is a threshold, and a verdict. The terminal, Markdown and the HTML report show the same cells.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Generic, Literal, TypeVar

import numpy as np
import polars as pl
from pydantic import BaseModel, ConfigDict, Field, GetCoreSchemaHandler
from pydantic_core import CoreSchema
from rich.console import Console

from phibench.benchmark.reports import figures
from phibench.benchmark.reports.figures import EmbeddedFigure
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import SETTINGS_BYTES, InputFile
from phibench.datasets.common.parallel import parallel_map
from phibench.datasets.common.progress import Steps
from phibench.datasets.common.shown_text import table_lines
from phibench.datasets.read import Dataset, open_finished
from phibench.datasets.recipe.load import find_recipe
from phibench.scenes.frames import Array
from phibench.scenes.validation import structural_faults

if TYPE_CHECKING:
    from matplotlib.figure import Figure

T = TypeVar("T")
U = TypeVar("U")

# -- findings ----------------------------------------------------------------------------------------------------------

Row = tuple[str, ...]
Ends = tuple[float, float, float]
"""Value, and the ends of its interval."""
Relation = Literal["", "<=", ">=", "=", "!="]
Verdict = Literal["", "met", "missed", "undecided", "favoured", "disfavoured"]
HEADS = ("finding", "value", "95 %", "unit", "threshold", "verdict")
_WHOLE_FROM = 1000.0  # three digits of a larger number would hide its units
_SMALLEST = 1e-3  # below it numbers have an exponent


@dataclass(frozen=True)
class Finding:
    """One number that a study states.

    Attributes
    ----------
    label : str
        Quantity and the case that it belongs to; no two findings of a study share it.
    value : float or None
        In `unit`; None where there is no number.
    low, high : float or None
        Ends of its interval of 95 %; None without one.
    relation, threshold
        Statement that the number decides, such as "<=" 1.0.
    verdict : str
        "met", "missed" or "undecided"; of an explanation "favoured", "disfavoured" or "undecided".
    """

    label: str
    value: float | None
    low: float | None = None
    high: float | None = None
    unit: str = ""
    relation: Relation = ""
    threshold: float | None = None
    verdict: Verdict = ""

    def __post_init__(self) -> None:
        for name in ("value", "low", "high", "threshold"):
            number = getattr(self, name)
            known = number is not None and math.isfinite(number)
            object.__setattr__(self, name, float(number) if known else None)

    @classmethod
    def ranged(cls, label: str, ends: Iterable[float], unit: str = "", scale: float = 1.0) -> Finding:
        """Finding from value, low and high in this order, each times `scale`."""
        value, low, high = (scale * float(x) for x in ends)
        return cls(label, value, low, high, unit)

    def judged(self, relation: Relation, threshold: float) -> Finding:
        """The same row with a threshold and a verdict.

        The whole interval decides, or the value where there is no interval. An interval with the threshold inside is
        undecided; "=" asks for just that, and "!=" for the opposite.
        """
        return replace(self, relation=relation, threshold=threshold, verdict=self._verdict(relation, threshold))

    def _verdict(self, relation: Relation, threshold: float) -> Verdict:
        low, high = (self.value if end is None else end for end in (self.low, self.high))
        if low is None or high is None:
            return "undecided"
        inside = low <= threshold <= high
        if relation == "=":
            return "met" if inside else "missed"
        if relation == "!=":
            return "undecided" if inside else "met"
        if (high <= threshold) if relation == "<=" else (low >= threshold):
            return "met"
        return "undecided" if inside else "missed"

    @property
    def row(self) -> Row:
        """Cells below `HEADS`."""
        interval = "" if self.low is None or self.high is None else f"{number(self.low)} to {number(self.high)}"
        threshold = "" if self.threshold is None else f"{self.relation} {number(self.threshold)}"
        return (self.label, number(self.value), interval, self.unit, threshold, self.verdict)

    @property
    def text(self) -> str:
        """Label, value and interval in words, for the text alternative of a drawing."""
        _, value, interval, unit, _, _ = self.row
        return " ".join(filter(None, (f"{self.label}:", value, unit, f"({interval})" if interval else "")))


def number(value: float | None) -> str:
    """A number with three digits, whole from 1000 on; a dash for none."""
    if value is None or not math.isfinite(value):
        return "-"
    if value == round(value) and abs(value) < 1e15:  # beyond it every double is whole
        return f"{value:.0f}"
    if abs(value) >= _WHOLE_FROM:
        return f"{value:.0f}"
    return f"{value:#.3g}".rstrip(".") if abs(value) >= _SMALLEST else f"{value:.2e}"


def rms(values: Array | Sequence[float], axis: int = -1) -> Any:
    """Root mean square; NaN of nothing."""
    return np.sqrt(np.mean(np.square(values), axis=axis)) if np.size(values) else math.nan


def ends_text(ends: Iterable[float], form: str = ".3g", scale: float = 1.0) -> str:
    """Value and its interval, if there is one, such as "1.2 (1.1 to 1.3)"; a dash for no value."""
    value, low, high = (*(scale * x for x in ends), math.nan, math.nan)[:3]
    if not math.isfinite(value):
        return "-"
    return f"{value:{form}} ({low:{form}} to {high:{form}})" if math.isfinite(low) else f"{value:{form}}"


def text_table(items: Iterable[T], columns: Mapping[str, Callable[[T], str]]) -> tuple[Row, ...]:
    """Heads, and a row per item: every column has its head and the text of an item's cell."""
    return (tuple(columns), *(tuple(cell(item) for cell in columns.values()) for item in items))


def findings_table(findings: Iterable[Finding]) -> tuple[Row, ...]:
    """Heads and a row per finding; columns that are empty throughout are left out."""
    rows = [HEADS, *(finding.row for finding in findings)]
    kept = [i for i in range(len(HEADS)) if i < 2 or any(row[i] for row in rows[1:])]
    return tuple(tuple(row[i] for i in kept) for row in rows)


def markdown_table(rows: Sequence[Row]) -> str:
    """Lines of a Markdown table; the first row is the heads."""
    head, *body = ([cell.replace("|", "\\|") for cell in row] for row in rows)
    return "\n".join(table_lines(head, body, [" --- "] * len(head)))


# -- data sets and drawings --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class StudyDatasets:
    """Data sets of a study in their folder, and the number of processes that render them.

    Parameters
    ----------
    folder : Path
        Data sets lie in it under the names of their recipes; what is finished there is not rendered again.
    console : Console
        For progress.
    workers : int, optional
        Processes; by default one per core.
    """

    folder: Path
    console: Console
    workers: int | None = None

    def dataset(self, recipe: str | Path, samples: int | None = None) -> Dataset:
        """Data set of a recipe, rendered if need be.

        Parameters
        ----------
        recipe : name of a shipped recipe, or a TOML file
        samples : number instead of the recipe's, for recipes with `[random]`

        Raises
        ------
        DatasetError
            If the recipe has faults, rendering fails, or Mitsuba is not installed and the data set is not there.
        """
        name = find_recipe(recipe).stem if samples is None else f"{find_recipe(recipe).stem}-{samples}"
        target = self.folder / name
        try:
            # imported here, so that a study of data sets that are there already runs without Mitsuba
            from phibench.datasets.make import make

            make(recipe, target, workers=self.workers, console=self.console, samples=samples)
        except ImportError as error:
            if (error.name or "").split(".")[0] not in ("mitsuba", "drjit"):
                raise
            if not target.is_dir():
                raise DatasetError(
                    f"the study needs the data set {name}, which is not in {self.folder}, and Mitsuba is not "
                    "installed: pip install 'phibench[render]', or put a rendered one there (--data)"
                ) from error
        return open_finished(target)

    def each(self, cases: Sequence[T], what: str) -> Iterator[T]:
        """Cases one by one; progress counts those that the loop has left behind."""
        with Steps(self.console, what, len(cases)) as steps:
            for case in cases:
                yield case
                steps.advance()

    def map(self, function: Callable[[T], U], cases: Sequence[T], what: str) -> list[U]:
        """Results of a picklable function for all cases, by the workers, which change no number."""
        with Steps(self.console, what, len(cases)) as steps:
            results = []
            for result in parallel_map(function, cases, self.workers):
                results.append(result)
                steps.advance()
        return results


COLOURS = (*figures.COLOURS, "#000000")
MARKERS, LINES, line_style, error_bars = figures.MARKERS, figures.LINES, figures.line_style, figures.error_bars


@dataclass(frozen=True)
class Drawing:
    """A drawing.

    Attributes
    ----------
    name : str
        File name without its ending.
    alt : str
        Text alternative with the main numbers.
    kind : "svg" or "png"
    """

    name: str
    data: bytes
    alt: str
    kind: str = "svg"

    @property
    def file_name(self) -> str:
        """Name of its file."""
        return f"{self.name}.{self.kind}"

    def picture(self) -> EmbeddedFigure:
        """The drawing as a data address, for a report."""
        return figures.embedded_figure(self.data, self.kind, self.alt)


@contextmanager
def canvas(width_in: float = 9.0, height_in: float = 4.0) -> Iterator[Figure]:
    """A figure in the style of all studies; draw and call `finished_drawing` inside of the block."""
    with figures.styled_figure(figures.STYLE, (width_in, height_in), layout="constrained", dpi=130) as figure:
        yield figure


def finished_drawing(name: str, figure: Figure, alt: str, kind: str = "svg") -> Drawing:
    """The finished drawing; the same marks give the same bytes."""
    return Drawing(name, figures.encoded_figure(figure, kind), alt, kind)


@dataclass(frozen=True)
class StudyResult:
    """Result of a study.

    Attributes
    ----------
    tables : dict of str to DataFrame
        By name; "table" is the main one, one row per measured case, units in the column names. Each is written as
        `NAME.parquet`.
    findings : tuple of Finding
        Numbers that the study states, no label twice.
    drawings : tuple of Drawing
    shown : dict of str to rows
        Small tables of text for the report, by caption, the first row being heads.
    notes : tuple of str
        Limits of this run: few samples, missing packages, targets missed.
    """

    tables: dict[str, pl.DataFrame]
    findings: tuple[Finding, ...]
    drawings: tuple[Drawing, ...] = ()
    shown: dict[str, tuple[Row, ...]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        parts = (("tables", self.tables.values(), pl.DataFrame), ("findings", self.findings, Finding))
        for name, values, kind in (*parts, ("drawings", self.drawings, Drawing)):
            if wrong := [type(value).__name__ for value in values if not isinstance(value, kind)]:
                raise DatasetError(f"StudyResult.{name} holds a {wrong[0]}; each must be a {kind.__name__}")
        labels = [finding.label for finding in self.findings]
        if twice := sorted({label for label in labels if labels.count(label) > 1}):
            raise DatasetError(f"findings with the same label: {'; '.join(twice)}")


def _take_arrays(schema: Any) -> None:
    """Let each tuple of a schema take a list; its entries stay strict."""
    if isinstance(schema, dict):
        if schema.get("type") == "tuple":
            schema["strict"] = False
        schema = list(schema.values())
    if isinstance(schema, list):
        for part in schema:
            _take_arrays(part)


class Settings(BaseModel):
    """Settings of a study; each study has its own, frozen and strict, with ranges and descriptions.

    An array of TOML fills a field that is a tuple.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    @classmethod
    def __get_pydantic_core_schema__(cls, source: type[BaseModel], handler: GetCoreSchemaHandler, /) -> CoreSchema:
        schema = handler(source)
        _take_arrays(schema)
        return schema


Names = tuple[str, ...]
Numbers = tuple[float, ...]
Metres = Annotated[tuple[Annotated[float, Field(ge=0.2, le=20.0)], ...], Field(min_length=1)]
Heights = Annotated[tuple[Annotated[float, Field(ge=0.0, le=3.0)], ...], Field(min_length=1)]
StudyPreset = Literal["bayer-raw", "srgb8", "mjpeg"]
Presets = Annotated[tuple[StudyPreset, ...], Field(min_length=1)]

S = TypeVar("S", bound=Settings)


@dataclass(frozen=True)
class Study(Generic[S]):
    """A study.

    Parameters
    ----------
    name : str
        As in `phibench study NAME`; its settings are in `settings.toml` beside the code.
    title : str
        Heading of its section in the report.
    question : str
        One sentence.
    settings : type
    run : callable
        From settings and data sets to the result; the same settings and data sets give the same result.
    """

    name: str
    title: str
    question: str
    settings: type[S]
    run: Callable[[S, StudyDatasets], StudyResult]

    def __post_init__(self) -> None:
        if not isinstance(self.settings, type) or not issubclass(self.settings, Settings):
            raise DatasetError(f"Study.settings = {self.settings!r}: must be a class derived from Settings")
        try:
            inspect.signature(self.run).bind(None, None)
        except (TypeError, ValueError) as error:
            raise DatasetError("Study.run must be a function of (settings, datasets)") from error


QUICK = "quick"


def settings_file(name: str) -> Path:
    """Path of the settings that a study comes with."""
    return Path(__file__).parent / name / "settings.toml"


def read_settings(study: Study[S], quick: bool = False, path: Path | None = None) -> S:
    """Settings of a study.

    Parameters
    ----------
    study : Study
    quick : bool
        Take the numbers of the table `[quick]` in place of those of the same names.
    path : Path, optional
        Another TOML file than the study's own.

    Raises
    ------
    DatasetError
        If the file cannot be read or has faults: all of them, a line each.
    """
    path = path or settings_file(study.name)
    raw = InputFile(path, "mend it, and save it as UTF-8", limit_bytes=SETTINGS_BYTES).toml()
    reduced = raw.pop(QUICK, {})
    if not isinstance(reduced, dict):
        raise DatasetError(f"{path}: [quick] is {reduced!r}; must be a table of settings")
    # the full settings are checked in a quick run, too: a fault must not wait for the long one
    checked = _checked(study, raw, str(path))
    return _checked(study, {**raw, **reduced}, f"{path} with its [quick]") if quick else checked


def _checked(study: Study[S], raw: dict[str, Any], source: str) -> S:
    if faults := structural_faults(study.settings, raw):
        raise DatasetError("\n".join([f"{source}: settings of the study '{study.name}':", *(f"  {f}" for f in faults)]))
    return study.settings.model_validate(raw)
