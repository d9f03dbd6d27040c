"""What a study finds: tables, drawings, and sentences made from the numbers."""

from __future__ import annotations

from dataclasses import dataclass, field

import polars as pl

from phibench.estimator.studies.drawing import Drawing

Row = tuple[str, ...]


@dataclass(frozen=True)
class Result:
    """Result of a study.

    Attributes
    ----------
    tables : dict of str to DataFrame
        By name; "table" is the main one, one row per measured case, units in the column names. Each is written as
        `NAME.parquet`.
    findings : tuple of str
        Sentences of a paragraph, every number in them computed; an uncertain number carries its interval.
    drawings : tuple of Drawing
    shown : dict of str to rows
        Small tables of text for the report, by caption, the first row being heads.
    notes : tuple of str
        What this run leaves out or could not do: few samples, missing packages, targets missed.
    """

    tables: dict[str, pl.DataFrame]
    findings: tuple[str, ...]
    drawings: tuple[Drawing, ...] = ()
    shown: dict[str, tuple[Row, ...]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
