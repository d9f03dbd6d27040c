"""Settings of a study from its TOML file: the top level is the full study, `[quick]` what a reduced one changes."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from phibench.datasets.errors import DatasetError
from phibench.estimator.studies.study import S, Study
from phibench.render.model_faults import structural_faults

QUICK = "quick"


def settings_file(name: str) -> Path:
    """Path of the settings that a study comes with."""
    return Path(__file__).with_name(f"{name}.toml")


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
    try:
        raw = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise DatasetError(f"{path} is not valid TOML: {error}") from error
    reduced = raw.pop(QUICK, {})
    if not isinstance(reduced, dict):
        raise DatasetError(f"{path}: [quick] is {reduced!r}; must be a table of settings")
    checked = _checked(study, raw, str(path))
    return _checked(study, {**raw, **reduced}, f"{path} with its [quick]") if quick else checked


def _checked(study: Study[S], raw: dict[str, Any], source: str) -> S:
    if faults := structural_faults(study.settings, raw):
        raise DatasetError("\n".join([f"{source}: settings of the study '{study.name}':", *(f"  {f}" for f in faults)]))
    return study.settings.model_validate(raw)
