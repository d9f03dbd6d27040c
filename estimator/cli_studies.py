"""`phibench study`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from phibench.estimator.cli_words import Whole


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
    from phibench.estimator.studies.folder import FINDINGS
    from phibench.estimator.studies.run import run_study

    result = run_study(name, out, quick, settings, data, workers)
    print("\n".join(result.findings))
    for note in result.notes:
        print(f"note: {note}")
    print(f"{out / FINDINGS}: the findings; beside it {len(result.tables)} tables and {len(result.drawings)} drawings")
    return 0
