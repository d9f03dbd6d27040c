"""Folder of pairs: reads `pairs.csv`, measures every pair, and writes a CSV of the results.

Columns of `pairs.csv`: `name`, `down`, `up` and `stroke_m`; where they are known `down_off`, `up_off`,
`stroke_sigma_m`, `depth_m` and `depth_sigma_m`, the D of a tape with its standard deviation. Several frames of a
position are separated by semicolons.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from phibench.calibration.captures.measure import Measurement, MeasureSetting, measure
from phibench.calibration.captures.pair_photos import LARGEST_SIGMA, PairPhotos, read_photos
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import FILE_NAME, MIB, InputFile
from phibench.datasets.common.shown_text import csv_text
from phibench.datasets.recipe.tables import MAX_STROKE_M, MIN_STROKE_M
from phibench.datasets.store.files import write_text
from phibench.datasets.store.schema import TruthFile
from phibench.scenes.validation import nearest, printable_line

PAIRS = TruthFile.MEASURED.value
_FILES = ("down", "up", "down_off", "up_off")
_NUMBERS = {
    "stroke_m": (MIN_STROKE_M, MAX_STROKE_M),
    "stroke_sigma_m": (0.0, 1.0),
    "depth_m": (0.05, 100.0),
    "depth_sigma_m": (1e-6, 10.0),
}
_NEEDED = ("name", "down", "up", "stroke_m")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")
_MOST_ROWS = 100_000  # a list of pairs that somebody measured; more is another file
_CONTRADICTS_SIGMAS = 5.0  # of D by the images against the tape


@dataclass(frozen=True)
class ListedPair:
    """One row of `pairs.csv`.

    Attributes
    ----------
    name : str
    files : dict of "down", "up", "down_off", "up_off" to names of files below the folder
    stroke_m, stroke_sigma_m : float
    depth_m, depth_sigma_m : float or None
        D of a tape, with its standard deviation; both or none.
    """

    name: str
    files: dict[str, tuple[str, ...]]
    stroke_m: float
    stroke_sigma_m: float = 0.0
    depth_m: float | None = None
    depth_sigma_m: float | None = None


def read_pair_list(folder: Path) -> list[ListedPair]:
    """Rows of a folder's `pairs.csv`.

    Raises
    ------
    DatasetError
        If there is none, or a row is none; with the number of the line, in one sentence.
    """
    if not folder.is_dir():
        raise DatasetError(f"{folder} is no folder; give one with pictures and {PAIRS}")
    file = InputFile(folder / PAIRS, "docs/measure.md has an example", limit_bytes=16 * MIB)
    reader = csv.DictReader(io.StringIO(file.text(encoding="utf-8-sig")), strict=True)
    try:
        columns = list(reader.fieldnames or ())
        lines = [(reader.line_num, line) for line in reader]
    except csv.Error as error:
        raise file.fault(f"is no CSV: {printable_line(str(error))}") from error
    known = ("name", *_FILES, *_NUMBERS)
    if len(columns) == 1 and (mark := next((m for m in (";", "\t") if m in columns[0]), "")):
        name = "semicolons" if mark == ";" else "tabs"
        raise file.fault(f"has columns between {name}: save it with commas between them, and points in numbers")
    if strange := [column for column in columns if column not in known]:
        raise file.fault(f"has the column {printable_line(strange[0], 40)!r}; {nearest(strange[0], known)}")
    if twice := [column for column in columns if columns.count(column) > 1]:
        raise file.fault(f"has the column '{twice[0]}' twice")
    if lacking := [column for column in _NEEDED if column not in columns]:
        raise file.fault(f"has no column '{lacking[0]}'")
    if not 0 < len(lines) <= _MOST_ROWS:
        raise file.fault(f"has {len(lines)} pairs: 1 to {_MOST_ROWS} are read")
    pairs = [_row(line, partial(_fault_of_line, file, number)) for number, line in lines]
    counts = Counter(row.name for row in pairs)
    if len(counts) != len(pairs):
        raise file.fault(f"has the name {counts.most_common(1)[0][0]} twice")
    return pairs


def _fault_of_line(file: InputFile, number: int, text: str) -> DatasetError:
    return file.fault(f"line {number}: {text}")


def _row(line: dict[str, str | None], fault: Callable[[str], DatasetError]) -> ListedPair:
    texts = {key: (value or "").strip() for key, value in line.items() if isinstance(key, str)}
    if len(texts) != len(line) or None in line.values():
        raise fault("it has another number of columns than the head")
    if _NAME.fullmatch(texts["name"]) is None:
        raise fault("the name has 1 to 64 letters, digits and . _ -, and begins with a letter or digit")
    files = {key: tuple(part.strip() for part in texts.get(key, "").split(";") if part.strip()) for key in _FILES}
    for key in ("down", "up"):
        if not files[key]:
            raise fault(f"it names no picture in the column '{key}'")
    if strange := [name for names in files.values() for name in names if re.fullmatch(FILE_NAME, name) is None]:
        raise fault(f"{printable_line(strange[0], 60)!r} is no name of a file below the folder")
    numbers = {key: _number(key, texts[key], fault) for key in _NUMBERS if texts.get(key)}
    if "stroke_m" not in numbers:
        raise fault("it has no stroke_m")
    if ("depth_m" in numbers) != ("depth_sigma_m" in numbers):
        raise fault("depth_m and depth_sigma_m go together: a tape has a standard deviation, too")
    for key in ("stroke", "depth"):
        sigma = numbers.get(f"{key}_sigma_m", 0.0)
        if sigma > LARGEST_SIGMA * numbers.get(f"{key}_m", math.inf):
            raise fault(
                f"{key}_sigma_m = {sigma:g}: allowed is a quarter of {key}_m, metres; {sigma:g} mm are {1e-3 * sigma:g}"
            )
    return ListedPair(texts["name"], files, **numbers)


def _number(key: str, text: str, fault: Callable[[str], DatasetError]) -> float:
    low, high = _NUMBERS[key]
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not low <= value <= high:
        raise fault(f"{key} = {printable_line(text, 40)}: allowed is {low:g} to {high:g}, metres")
    return value


def photos_of(folder: Path, row: ListedPair, setting: MeasureSetting) -> PairPhotos:
    """Pictures of a row.

    Raises
    ------
    DatasetError
        As `read_photos`.
    """
    files = {key: [folder / name for name in names] for key, names in row.files.items()}
    return read_photos(files, setting.known.rig, setting.sensor)


# -- results ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class PairOutcome:
    """Outcome for one row: a measurement, or one sentence that says why there is none."""

    row: ListedPair
    found: Measurement | None
    fault: str = ""

    @property
    def tape_sigmas(self) -> float | None:
        """D less that of the tape, over both standard deviations together."""
        if self.found is None or self.row.depth_m is None or self.row.depth_sigma_m is None:
            return None
        return (self.found.depth_m - self.row.depth_m) / math.hypot(self.found.sigma_m, self.row.depth_sigma_m)

    @property
    def status(self) -> str:
        """Fault in one sentence; "ok" if there is none."""
        if self.found is None:
            return self.fault
        if self.found.doubts:
            return self.found.doubts[0]
        sigmas = self.tape_sigmas
        if sigmas is not None and abs(sigmas) > _CONTRADICTS_SIGMAS:
            return (
                f"contradicts the tape by {sigmas:.1f} standard deviations: a stroke of "
                f"{self.row.stroke_m * (self.row.depth_m or 0.0) / self.found.depth_m:.3f} m would give its D"
            )
        return "ok"


def measured_pairs(
    folder: Path, setting: MeasureSetting, told: Callable[[PairOutcome], None] = lambda _: None
) -> list[PairOutcome]:
    """Measure all pairs of a folder; a pair that cannot be measured ends no run.

    Parameters
    ----------
    folder : Path
    setting : MeasureSetting
        The stroke's standard deviation of a row goes before its own.
    told : callable
        Given each result.
    """
    results = []
    for row in read_pair_list(folder):
        own = replace(setting, stroke_sigma_m=row.stroke_sigma_m or setting.stroke_sigma_m)
        try:
            result = PairOutcome(row, measure(photos_of(folder, row, own), row.stroke_m, own))
        except DatasetError as error:
            result = PairOutcome(row, None, printable_line(str(error), 600))
        told(result)
        results.append(result)
    return results


COLUMNS = (
    *("name", "stroke_m", "depth_m", "sigma_m", "sigma_spot_m", "sigma_rig_m", "sigma_stroke_m", "chi2", "p_value"),
    *("down_u_px", "down_v_px", "down_sigma_px", "up_u_px", "up_v_px", "up_sigma_px"),
    *("tape_m", "tape_sigma_m", "difference_m", "difference_sigmas", "status"),
)


def write_results(path: Path, results: Sequence[PairOutcome]) -> Path:
    """Write results as CSV, atomically."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows([_cell(value) for value in _values(result)] for result in results)
    return write_text(path, text.getvalue())


def _values(result: PairOutcome) -> Iterable[float | str | None]:
    row, measurement = result.row, result.found
    yield from (row.name, row.stroke_m)
    if measurement is None:
        yield from [None] * 13
    else:
        depth = measurement.depth
        yield from (
            measurement.depth_m,
            measurement.sigma_m,
            float(depth.sigma_spot_m),
            float(depth.sigma_calibration_m),
        )
        yield from (float(depth.sigma_stroke_m), float(depth.chi2), float(depth.p_value))
        for spot in (measurement.down, measurement.up):
            yield from (float(spot.uv_px[0]), float(spot.uv_px[1]), spot.sigma_px)
    yield from (row.depth_m, row.depth_sigma_m)
    yield None if measurement is None or row.depth_m is None else measurement.depth_m - row.depth_m
    yield from (result.tape_sigmas, result.status)


def _cell(value: float | str | None) -> str:
    if isinstance(value, str):
        return csv_text(value)
    return "" if value is None else f"{value:.6g}"
