"""`phibench study`.

`phibench experiments`: rigs calibrated from their own frames, what they measure, and whether the budget closes.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from phibench.estimator.cli.options import Whole


def study(
    name: str,
    *,
    out: Path,
    quick: Annotated[bool, Parameter(negative="")] = False,
    settings: Path | None = None,
    data: Path | None = None,
    workers: Whole | None = None,
) -> int:
    """Run a study: its data sets, a table in Parquet, drawings, and findings made from the numbers.

    Parameters
    ----------
    name
        noise, misalignment, baseline, cause, isotropy or stroke.
    out
        Folder to write.
    quick
        The reduced version, some minutes.
    settings
        TOML file in place of the study's own.
    data
        Folder of the data sets that it renders or finds there; by default "data" in the folder to write.
    workers
        Processes that render; by default one per core.
    """
    from phibench.estimator.studies.run import FINDINGS, run_study

    result = run_study(name, out, quick, settings, data, workers)
    print("\n".join(result.findings))
    for note in result.notes:
        print(f"note: {note}")
    print(f"{out / FINDINGS}: the findings; beside it {len(result.tables)} tables and {len(result.drawings)} drawings")
    return 0


def experiments(
    directory: Path,
    *,
    preset: str = "mjpeg",
    draws: Whole = 1,
    laser_off: bool = True,
    rig: Annotated[tuple[str, ...], Parameter(consume_multiple=True, negative="")] = (),
    out: Path | None = None,
) -> int:
    """Calibrate every rig of a data set from its frames, measure D with it, and compare errors with their prediction.

    The data set needs an experiment "calibration", whose spots stand at known distances: the recipe paper-misaligned.

    Parameters
    ----------
    directory
        Folder of a data set.
    preset
        Preset of the sensor: "mjpeg", "bayer-raw", "srgb8" or "mono-raw".
    draws
        Draws of the noise per sample.
    laser_off
        Take a frame with the laser off beside each; --no-laser-off does without.
    rig
        Ids of rigs; all by default.
    out
        Parquet file for the rows, one per sample and draw.
    """
    from phibench.datasets.read import open_finished
    from phibench.datasets.store.files import require_writable
    from phibench.estimator.paper.experiment_bounds import budget_table, write_rows
    from phibench.estimator.paper.experiment_tables import Procedure, run_experiments

    if out is not None:
        require_writable(out)
    procedure = Procedure(preset, draws, laser_off)
    rows = run_experiments(open_finished(directory), procedure, rig or None, lambda name: print(f"{name} is measured"))
    if out is not None:
        write_rows(rows, out)
    from rich.console import Console

    console = Console(width=150)
    console.print(budget_table(rows))
    return 0
