"""Frame of the studies: data sets, drawings, the result, and the settings in a TOML file.

A study is a question, settings, and a function from settings and data sets to a result. Data sets are rendered from
recipes, kept between runs and shared between studies. The top level of `settings.toml` is the full study; its table
`[quick]` holds what the reduced one changes. Drawings are SVG, or PNG where there are many marks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import polars as pl
from pydantic import BaseModel, ConfigDict
from rich.console import Console

from phibench.benchmark.reports import figures
from phibench.benchmark.reports.figures import EmbeddedFigure
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import SETTINGS_BYTES, InputFile
from phibench.datasets.read import Dataset, open_finished
from phibench.datasets.recipe.load import find_recipe
from phibench.scenes.validation import structural_faults
from phibench.studies.findings import Finding, Row

if TYPE_CHECKING:
    from matplotlib.figure import Figure


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


COLOURS = (*figures.COLOURS, "#000000")
MARKERS, LINES, line_style = figures.MARKERS, figures.LINES, figures.line_style


@dataclass(frozen=True)
class Drawing:
    """A drawing.

    Attributes
    ----------
    name : str
        File name without its ending.
    data : bytes
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
        return figures.picture(self.data, self.kind, self.alt)


@contextmanager
def canvas(width_in: float = 9.0, height_in: float = 4.0) -> Iterator[Figure]:
    """A figure in the style of all studies; draw and call `drawn` inside of the block."""
    with figures.styled(figures.STYLE, (width_in, height_in), layout="constrained", dpi=130) as figure:
        yield figure


def drawn(name: str, figure: Figure, alt: str, kind: str = "svg") -> Drawing:
    """The finished drawing; the same marks give the same bytes."""
    return Drawing(name, figures.encoded(figure, kind), alt, kind)


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
        labels = [finding.label for finding in self.findings]
        if twice := sorted({label for label in labels if labels.count(label) > 1}):
            raise ValueError(f"findings with the same label: {'; '.join(twice)}")


class Settings(BaseModel):
    """Settings of a study; each study has its own, frozen and strict, with ranges and descriptions."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


S = TypeVar("S", bound=Settings)


@dataclass(frozen=True)
class Study(Generic[S]):
    """A study.

    Parameters
    ----------
    name : str
        As in `phibench study NAME`; its settings are in `NAME.toml` beside the code.
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
