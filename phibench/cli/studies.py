"""Commands `phibench paper`, `stroke`, `study ...`: the paper's tables and experiments, the best stroke, studies."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import App, Parameter

from phibench.cli.options import (
    DEFAULT_PRESET,
    KEEPERS,
    Counts,
    DataFolder,
    Flag,
    Metres,
    OutFolder,
    OwnOrPreset,
    Preset,
    Whole,
)

if TYPE_CHECKING:
    from phibench.estimator.limits.best_stroke import BestStroke
    from phibench.studies.paper.experiment_tables import Procedure
    from phibench.studies.paper.paper_tables import Score


@Parameter(name="*")
@dataclass(frozen=True)
class MisalignedOptions:
    """Settings of the misaligned experiments.

    Parameters
    ----------
    preset
        With --misaligned: preset of the sensor, "mjpeg" (default), "bayer-raw", "srgb8" or "mono-raw".
    draws
        With --misaligned: draws of the noise per sample; 1 by default.
    laser_off
        With --misaligned: also a frame with the laser off beside each (default); --no-laser-off does without.
    frames
        With --misaligned: frames of each position, on and off; 1 1 by default.
    rig
        With --misaligned: ids of rigs; all by default.
    """

    preset: OwnOrPreset = None
    draws: Whole | None = None
    laser_off: bool | None = None
    frames: Counts = None
    rig: Annotated[tuple[str, ...], Parameter(consume_multiple=True, negative="")] = ()

    def refuse(self) -> None:
        """Raise `DatasetError` if one of the options is given."""
        from phibench.datasets.common.errors import DatasetError

        for name, value in vars(self).items():
            if value not in (None, ()):
                option = name.replace("_", "-")
                raise DatasetError(f"--{option} is for the misaligned experiments: give --misaligned too")

    @property
    def procedure(self) -> Procedure:
        """The same for the experiments."""
        from phibench.datasets.exposures.pair_draws import FrameCounts
        from phibench.studies.paper.experiment_tables import Procedure

        counts = FrameCounts() if self.frames is None else FrameCounts(*self.frames)
        draws, laser_off = 1 if self.draws is None else self.draws, self.laser_off is not False
        return Procedure(self.preset or DEFAULT_PRESET, draws, laser_off, frames=counts)


_BY_DEFAULT = MisalignedOptions()


def paper(
    directory: DataFolder,
    *,
    misaligned: Flag = False,
    calibration: Path | None = None,
    measured: MisalignedOptions = _BY_DEFAULT,
    wide: Flag = False,
    out: Path | None = None,
) -> int:
    """Print the tables of the paper beside those of every depth estimator; no method runs.

    With --misaligned every rig is calibrated from its own frames, measures D, and its errors are compared with their
    prediction. That data set needs an experiment "calibration" with spots at known distances: paper-misaligned.

    Parameters
    ----------
    misaligned
        The misaligned experiments instead of the tables.
    calibration
        File of `phibench calibrate`: its rig's samples, with the calibrated rig and stroke. Not with --misaligned.
    wide
        Estimates in metres too, or with --misaligned every interval, in up to 210 columns instead of 80.
    out
        JSON file for the scores; with --misaligned a Parquet file, one row per sample and draw.
    """
    if not misaligned:
        measured.refuse()
        return _tables(directory, calibration, wide, out)
    if calibration is not None:
        from phibench.datasets.common.errors import DatasetError

        raise DatasetError("--calibration does not go with --misaligned, which calibrates every rig itself")
    return _experiments(directory, measured.procedure, measured.rig, wide, out)


def _tables(directory: Path, calibration: Path | None, wide: bool, out: Path | None) -> int:
    from phibench.benchmark.pair_sets.wanted_pairs import samples_of_calibration
    from phibench.calibration.rig.calibration_file import read_calibration
    from phibench.datasets.common.shown_text import show_grid, table_console
    from phibench.datasets.read import open_finished
    from phibench.studies.paper.paper_tables import bias_table, table
    from phibench.studies.paper.paper_tables import score_estimators as score_dataset

    dataset = open_finished(directory)
    calibrated = None if calibration is None else read_calibration(calibration)
    scores = score_dataset(dataset if calibrated is None else samples_of_calibration(dataset, calibrated), calibrated)
    console = table_console(wide)
    for grid in (table(scores, "truth", wide), table(scores, "frame", wide), bias_table(scores)):
        show_grid(console, grid)
    if out is not None:
        _write_scores(out, directory, scores)
    return 0


def _write_scores(out: Path, directory: Path, scores: Sequence[Score]) -> None:
    from phibench.datasets.store.files import write_text
    from phibench.datasets.store.provenance import provenance
    from phibench.studies.paper.paper_tables import as_records, summarise

    document = {
        "dataset": str(directory),
        "provenance": provenance(),
        "unit": "metre; relative errors are fractions of the true depth; null where there is no estimate",
        "summary": as_records(summarise(scores)),
        "scores": as_records(scores),
    }
    write_text(out, json.dumps(document, indent=1, allow_nan=False) + "\n")


def _experiments(directory: Path, procedure: Procedure, rig: tuple[str, ...], wide: bool, out: Path | None) -> int:
    from phibench.datasets.common.shown_text import show_grid, table_console
    from phibench.datasets.read import open_finished
    from phibench.datasets.store.files import require_writable, write_bytes
    from phibench.datasets.store.parquet_tables import parquet_bytes
    from phibench.studies.paper.experiment_bounds import budget_table
    from phibench.studies.paper.experiment_tables import run_experiments

    if out is not None:
        require_writable(out)
    # a line for each rig: each takes minutes
    rows = run_experiments(open_finished(directory), procedure, rig or None, lambda name: print(f"{name} is measured"))
    if out is not None:
        write_bytes(out, parquet_bytes(rows))
    show_grid(table_console(wide), budget_table(rows, wide))
    return 0


@Parameter(name="*")
@dataclass(frozen=True)
class StrokeSetting:
    """Rig, camera and spot for which a stroke is sought."""

    rig: Annotated[
        Path | None, Parameter(help="TOML file of the rig, as for `measure`; the default rig if not given.")
    ] = None
    calibration: Annotated[
        Path | None,
        Parameter(help="File of `phibench calibrate`. Without one the rig is as good as one put together by hand."),
    ] = None
    preset: Annotated[Preset, Parameter(help="Preset of the sensor.")] = DEFAULT_PRESET
    strokes_m: Annotated[
        tuple[Metres, Metres], Parameter(negative="", help="Shortest and longest stroke of the carriage, metres.")
    ] = (0.10, 1.40)
    stroke_sigma_m: Annotated[Metres, Parameter(help="Standard deviation of the single stroke, metres.")] = 0.0
    height_m: Annotated[Metres, Parameter(help="Height of the spot above the floor, metres.")] = 0.5
    power_mw: Annotated[Metres, Parameter(help="Power of the laser, mW.")] = 1.0

    def best(self, depth_m: float) -> BestStroke:
        """Best stroke for a distance.

        Raises
        ------
        DatasetError
            If a file or a number will not do.
        """
        from phibench.calibration.captures.rig_file import read_rig_file
        from phibench.calibration.rig.calibration_file import read_calibration
        from phibench.datasets.common.errors import DatasetError
        from phibench.datasets.frames.sensor_card import sensor_card
        from phibench.estimator.limits.best_stroke import best_stroke
        from phibench.estimator.limits.stroke_curve import Surroundings
        from phibench.estimator.spots.spot_prediction import Laser

        for name, value, low, high in (("power-mw", self.power_mw, 1e-6, 1e3), ("height-m", self.height_m, 0.0, 20.0)):
            if not low <= value <= high:
                raise DatasetError(f"--{name} {value:g}: must be {low:g} to {high:g}")
        nominal = None if self.rig is None else read_rig_file(self.rig).rig
        held = None if self.calibration is None else read_calibration(self.calibration, nominal)
        return best_stroke(
            depth_m,
            nominal if held is None else held.rig,
            covariance_rig=None if held is None else held.covariance,
            stroke_sigma_m=self.stroke_sigma_m,
            strokes_m=self.strokes_m,
            around=Surroundings(heights_m=(self.height_m,), laser=Laser(power_w=1e-3 * self.power_mw)),
            card=sensor_card(self.preset),
        )

    @property
    def words(self) -> str:
        """Sentence on what the error holds for."""
        rig = "the default rig" if self.rig is None else f"the rig of {self.rig}"
        known = "as good as put together by hand" if self.calibration is None else f"calibrated by {self.calibration}"
        return f"{rig}, {known}; {self.preset}, {self.power_mw:g} mW, spots {self.height_m:g} m high"


_STROKE = StrokeSetting()


def stroke(
    *,
    depth_m: Metres,
    stroke_m: Annotated[tuple[Metres, ...], Parameter(consume_multiple=True, negative="", show_default=False)] = (),
    setting: StrokeSetting = _STROKE,
    out: Path | None = None,
) -> int:
    """Find the stroke that measures a distance best, and what another stroke loses.

    The error is a bound: root mean square over eight azimuths of a spot on a white wall, at 1/60 s.
    docs/studies/stroke.md says what it consists of.

    Parameters
    ----------
    depth_m
        Distance D of the spot from the stroke axis, metres.
    stroke_m
        Strokes of the table, metres; round ones if not given.
    out
        PNG or SVG to write: the error and its parts by the stroke.
    """
    from phibench.datasets.common.shown_text import show_grid, table_console
    from phibench.datasets.store.files import require_writable
    from phibench.studies.paper.stroke_chart import best_lines, loss_table, require_picture, write_stroke_picture

    if out is not None:
        require_picture(out)
        require_writable(out)
    best = setting.best(depth_m)
    grid = loss_table(best, stroke_m)
    for line in (*best_lines(best), setting.words, ""):
        print(line)
    show_grid(table_console(wide=False), grid)
    if out is not None:
        print(f"{write_stroke_picture(out, best)}: error of D and its parts by the stroke")
    return 0


STUDIES = Path(__file__).parents[1] / "studies"


def study_sentences() -> dict[str, str]:
    """Each study's sentence by its name: the first line of `studies/NAME/study.py`, which is not imported for it."""
    lines = {path.parent.name: path.open(encoding="utf-8").readline() for path in sorted(STUDIES.glob("*/study.py"))}
    sentences = {name: line.partition(": ")[2].strip().removesuffix('"""') for name, line in lines.items()}
    return {name: text[:1].upper() + text[1:] for name, text in sentences.items()}


study = App(name="study", group=KEEPERS, help="Run a study: its data sets, tables in Parquet, drawings, and findings.")


def _command(name: str, sentence: str) -> None:
    def run(
        *,
        out: OutFolder,
        quick: Flag = False,
        settings: Path | None = None,
        data: Path | None = None,
        workers: Whole | None = None,
        publish: Path | None = None,
    ) -> int:
        """Run a study.

        Parameters
        ----------
        quick
            The reduced version, some minutes.
        settings
            TOML file in place of the study's own.
        data
            Folder of the data sets that it renders or finds there; by default "data" in the folder to write.
        workers
            Processes that render; by default one per core.
        publish
            Folder of the pages of the studies (docs/studies): NAME.json there is replaced. Full studies only.
        """
        from phibench.datasets.common.shown_text import TextTable, show_grid, table_console
        from phibench.studies.framework import findings_table
        from phibench.studies.run import FINDINGS, run_study

        result = run_study(name, out, quick, settings, data, workers, publish=publish)
        heads, *rows = findings_table(result.findings)
        show_grid(table_console(wide=False), TextTable("Findings", heads, tuple(rows), "L" + "l" * (len(heads) - 1)))
        for note in result.notes:
            print(f"note: {note}")
        tables, drawings = len(result.tables), len(result.drawings)
        print(f"{out / FINDINGS}: the findings; beside it {tables} tables and {drawings} drawings")
        return 0

    study.command(run, name=name, help=sentence)


for _name, _sentence in study_sentences().items():
    _command(_name, _sentence)
