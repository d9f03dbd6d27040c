"""Main table of the study `misalignment`: a row per parameter, value, spot and estimator."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import polars as pl

from phibench.estimator.studies.misaligned import CALIBRATED, NOMINAL, Calibrate, Places, errors, slopes
from phibench.estimator.studies.misalignment_rendered import Rendered
from phibench.estimator.studies.misalignment_tolerance import calibrated_or_lost, over_azimuths, signs
from phibench.scenes.frames import Array
from phibench.scenes.misalignment import PARAMETERS, Misalignment
from phibench.scenes.rig import Rig

PLACE = ("depth_m", "azimuth_deg")


def study_table(nominal: Rig, strokes: Sequence[Places], calibrate: Calibrate) -> pl.DataFrame:
    """Every parameter at plus and minus its study's magnitude; the calibrated estimator at the first stroke only.

    Columns
    -------
    parameter, unit, value, estimator, stroke_m, height_m, depth_m, azimuth_deg
    error_relative : (estimate - D) / D of the misaligned rig
    whole_relative : change of it by the misalignment
    first_order_relative : slope times value; null for the calibrated estimator
    """
    parts = [_nominal(nominal, places) for places in strokes]
    return pl.concat([*parts, _calibrated(nominal, strokes[0], calibrate)])


def rendered_table(found: Sequence[Rendered], places: Places) -> pl.DataFrame:
    """Rows of rendered spots: rendered and predicted change of D's relative error."""
    frames = []
    for one in found:
        for name, change, predicted in zip(NOMINAL, one.change, one.predicted, strict=True):
            frames.append(
                _frame(
                    one.parameter, one.value, name, places, {"rendered_relative": change, "whole_relative": predicted}
                )
            )
    return pl.concat(frames)


def _nominal(nominal: Rig, places: Places) -> pl.DataFrame:
    slope, aligned = slopes(nominal, places), errors(nominal, Misalignment(), places)
    frames = []
    for parameter, value in _values(nominal):
        found = errors(nominal, Misalignment(**{parameter: value}), places)
        for i, name in enumerate(NOMINAL):
            columns = {
                "error_relative": found[i],
                "whole_relative": found[i] - aligned[i],
                "first_order_relative": slope[parameter][i] * value,
            }
            frames.append(_frame(parameter, value, name, places, columns))
    return pl.concat(frames)


def _calibrated(nominal: Rig, places: Places, calibrate: Calibrate) -> pl.DataFrame:
    aligned = calibrated_or_lost(nominal, Misalignment(), places, calibrate)
    frames = []
    for parameter, value in _values(nominal):
        found = calibrated_or_lost(nominal, Misalignment(**{parameter: value}), places, calibrate)
        columns = {
            "error_relative": found,
            "whole_relative": found - aligned,
            "first_order_relative": np.full(found.shape, np.nan),
        }
        frames.append(_frame(parameter, value, CALIBRATED, places, columns))
    return pl.concat(frames)


def _values(nominal: Rig) -> list[tuple[str, float]]:
    return [(name, sign * one.study) for name, one in PARAMETERS.items() for sign in signs(nominal, name, one.study)]


def _frame(parameter: str, value: float, estimator: str, places: Places, columns: dict[str, Array]) -> pl.DataFrame:
    D, turn = np.broadcast_arrays(places.depths_m[:, None], np.degrees(places.azimuths_rad))
    table = {"depth_m": D.ravel(), "azimuth_deg": turn.ravel(), **{key: x.ravel() for key, x in columns.items()}}
    words = {
        "parameter": parameter,
        "unit": PARAMETERS[parameter].unit,
        "value": value,
        "estimator": estimator,
        "stroke_m": places.stroke_m,
        "height_m": places.height_m,
    }
    frame = pl.DataFrame(table).with_columns(*(pl.lit(x).alias(key) for key, x in words.items()))
    return frame.select(*words, *table).fill_nan(None)


@dataclass(frozen=True)
class Rank:
    """What a parameter of the study's magnitude costs one estimator: rms and worst relative change of D, shape (d,)."""

    parameter: str
    estimator: str
    depths_m: Array
    rms: Array
    worst: Array


def ranking(table: pl.DataFrame, estimator: str, stroke_m: float) -> list[Rank]:
    """Parameters by their largest rms over all D, the costliest first; over azimuths and both signs."""
    mine = table.filter((pl.col("estimator") == estimator) & (pl.col("stroke_m") == stroke_m))
    ranks = []
    for parameter in PARAMETERS:
        rows = mine.filter(pl.col("parameter") == parameter).sort("depth_m", "azimuth_deg", "value")
        depths = rows["depth_m"].unique(maintain_order=True).to_numpy()
        changes = rows["whole_relative"].fill_null(np.nan).to_numpy().reshape(len(depths), -1)
        rms, worst = over_azimuths(changes)
        ranks.append(Rank(parameter, estimator, depths, rms, worst))
    return sorted(ranks, key=lambda rank: (-float(np.max(rank.rms)), rank.parameter))


def slope_misses(table: pl.DataFrame, estimator: str) -> tuple[str, float, float]:
    """Parameter, D and size of the largest difference between slope times value and the whole change."""
    mine = table.filter(pl.col("estimator") == estimator).drop_nulls(["whole_relative", "first_order_relative"])
    off = mine.with_columns(off=(pl.col("whole_relative") - pl.col("first_order_relative")).abs()).sort("off")
    last = off.row(-1, named=True)
    return str(last["parameter"]), float(last["depth_m"]), float(last["off"])
