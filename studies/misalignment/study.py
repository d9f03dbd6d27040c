"""Study `misalignment`: error of D that each misalignment of the rig makes, predicted and rendered; drawings.

Tolerances, a ranking, the effect of a calibration, and interactions follow from the same closed forms.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import Annotated, Any

import numpy as np
import polars as pl
from pydantic import Field

from phibench.calibration.rig.bundle import Bundle
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.progress import Steps
from phibench.estimator.geometry.paper_depth import load_published
from phibench.estimator.geometry.triangulate import depth_exact
from phibench.scenes.frames import Array
from phibench.scenes.misalignment import PARAMETERS, Misalignment
from phibench.scenes.random_streams import generator
from phibench.scenes.rig import Rig
from phibench.scenes.room import default_rig
from phibench.scenes.validation import nearest
from phibench.studies.framework import (
    Drawing,
    Finding,
    Names,
    Row,
    Settings,
    Study,
    StudyDatasets,
    StudyResult,
    canvas,
    error_bars,
    finished_drawing,
    line_style,
    text_table,
)
from phibench.studies.misaligned_rigs import (
    ALL,
    CALIBRATED,
    NOMINAL,
    Calibrate,
    CalibrationSetup,
    Places,
    RenderedDeviation,
    pixels,
    rendered_deviations,
    true_depth_m,
)
from phibench.studies.misalignment import tables
from phibench.studies.misalignment.refocus import FOCUS_M, LENS_M, refocus, refocus_findings, thin_lens
from phibench.studies.misalignment.sobol_indices import Interactions, interaction_findings, interactions, rows

Distance = Annotated[float, Field(gt=0.1, le=20.0)]
Positive = Annotated[float, Field(gt=0.0, le=1.0)]
Distances = Annotated[tuple[Distance, ...], Field(min_length=1, max_length=20)]
Spot = tuple[Distance, Annotated[float, Field(ge=-360.0, le=360.0)]]


class SearchSettings(Settings):
    """Values of a parameter that are tried, in units of its usual size."""

    start: float = Field(gt=0.0, le=1.0)
    largest: float = Field(ge=1.0, le=1e5)
    factor: float = Field(gt=1.01, le=10.0)


class MisalignmentSettings(Settings):
    """Numbers of the study."""

    depths_m: Distances = Field(description="D of the spots from the nominal stroke axis")
    strokes_m: Distances = Field(description="strokes; calibration, rendering and interactions take the first")
    height_m: float = Field(ge=0.0, le=3.0, description="of the spots above the floor")
    azimuths: int = Field(ge=4, le=360, multiple_of=4, description="evenly spaced, from world x")
    cost: float = Field(gt=0.0, lt=1.0, description="relative change of D that a tolerance allows")
    search: SearchSettings
    search_calibrated: SearchSettings
    rendered_every: int = Field(ge=1, description="every n-th azimuth is rendered, from the second one on")
    agreement: float = Field(gt=0.0, lt=1.0, description="allowed difference of rendered and predicted change of D")
    calibration_spots: Annotated[tuple[Spot, ...], Field(min_length=1)]
    calibration_pixel_sigma_px: Positive
    calibration_distance_sigma_m: Positive
    calibration_outline_sigma_m: tuple[Positive, Positive, Positive]
    noise_draws: int = Field(ge=2, le=10000, description="calibrations of the aligned rig from noisy measurements")
    sobol_log2: int = Field(ge=3, le=16, description="base sample of the Sobol indices: 2 to this power")
    resamples: int = Field(ge=20, le=100000, description="of the bootstrap")
    parameters: Names = Field(default=(), description="misalignments; all if empty")

    @property
    def azimuths_rad(self) -> Array:
        """All azimuths."""
        return np.asarray(np.arange(self.azimuths) * (2.0 * math.pi / self.azimuths), float)

    def places(self, stroke_m: float, azimuths_rad: Array | None = None) -> Places:
        """Spots at a stroke, at all azimuths or at others."""
        azimuths = self.azimuths_rad if azimuths_rad is None else azimuths_rad
        return Places(np.array(self.depths_m), azimuths, self.height_m, stroke_m)

    @property
    def chosen(self) -> tuple[str, ...]:
        """Names of the misalignments.

        Raises
        ------
        DatasetError
            If there is none of such a name.
        """
        for name in self.parameters:
            if name not in PARAMETERS:
                raise DatasetError(f"parameters: no misalignment '{name}'; {nearest(name, tuple(PARAMETERS))}")
        return self.parameters or ALL

    @property
    def calibration_setup(self) -> CalibrationSetup:
        """Simulated calibration of a rig."""
        spots = [
            (D * math.cos(math.radians(a)), D * math.sin(math.radians(a)), self.height_m)
            for D, a in self.calibration_spots
        ]
        return CalibrationSetup(
            np.array(spots),
            self.calibration_pixel_sigma_px,
            self.calibration_distance_sigma_m,
            self.calibration_outline_sigma_m,
        )

    def tolerance_search(self, calibrated: bool = False) -> tables.Search:
        """Search for a tolerance."""
        how = self.search_calibrated if calibrated else self.search
        return tables.Search(self.cost, how.start, how.largest, how.factor)


_PARTS = 5  # table, rendered spots, tolerances, interactions, calibrations with noise; of unequal length
_SLOPE_TARGET = 1e-3  # of D: a slope that misses by more is said to be not enough


def run(settings: MisalignmentSettings, datasets: StudyDatasets) -> StudyResult:
    """Run the study; it renders spots itself and needs no data set."""
    nominal = default_rig()
    strokes = [settings.places(stroke) for stroke in settings.strokes_m]
    places, names = strokes[0], settings.chosen
    calibrate = _calibration(settings, nominal, places.stroke_m)
    with Steps(datasets.console, "misalignment, parts", _PARTS) as steps:
        table = tables.study_table(nominal, strokes, calibrate, names)
        steps.advance()
        some = settings.places(places.stroke_m, settings.azimuths_rad[1 :: settings.rendered_every])
        seen = tuple(rendered_deviations(nominal, some, names))
        steps.advance()
        fine, coarse = settings.tolerance_search(), settings.tolerance_search(calibrated=True)
        tolerances = list(tables.tolerance_rows(nominal, places, fine, coarse, calibrate, names))
        steps.advance()
        at_once = _interactions(settings, nominal, places.stroke_m)
        steps.advance()
        noise = _noise(settings, nominal, places)
        steps.advance()
    ranks = {name: tables.ranking(table, name, places.stroke_m) for name in (*NOMINAL, CALIBRATED)}
    pictures = tables.rendered_table(seen, some)
    middle = float(places.depths_m[len(places.depths_m) // 2])
    return StudyResult(
        {
            "table": table.join(pictures.drop("whole_relative"), on=_KEYS, how="left"),
            "tolerance": pl.DataFrame(tolerances, infer_schema_length=None),
            "interactions": pl.DataFrame(rows(at_once, "exact", places)),
        },
        _findings(settings, table, seen, tolerances, at_once, noise, ranks, places),
        _drawings(table, pictures, at_once, ranks, places),
        {
            "Change of D by a misalignment of the usual size, %, rms over azimuths and signs; exact estimator, nominal "
            "numbers and calibrated": ranking_rows(ranks["exact"], ranks[CALIBRATED]),
            f"Tolerances at D = {middle:g} m, exact estimator with nominal numbers": (
                tightest_table(tolerances, "exact", middle, settings.cost)
            ),
            f"Value that costs {100.0 * settings.cost:g} % of D, rms over azimuths and signs; - is never reached": (
                tolerance_table(tolerances, "rms", ("exact", "paper_normal", CALIBRATED))
            ),
            f"Value that costs {100.0 * settings.cost:g} % of D at the worst azimuth and sign": (
                tolerance_table(tolerances, "worst", ("exact", "paper_normal", CALIBRATED))
            ),
        },
        _notes(settings, seen),
    )


_KEYS = ["parameter", "unit", "value", "estimator", "stroke_m", "height_m", "depth_m", "azimuth_deg"]


def _calibration(settings: MisalignmentSettings, nominal: Rig, stroke_m: float) -> Calibrate:
    """Calibrations of a run, each done once: the table and the tolerances ask for the same."""
    setup = settings.calibration_setup

    @cache
    def calibrated(misalignment: Misalignment) -> Bundle:
        return setup.calibrated(nominal, stroke_m, misalignment)

    return calibrated


def _interactions(settings: MisalignmentSettings, nominal: Rig, stroke_m: float) -> tuple[Interactions, ...]:
    # four azimuths give the mean of all terms up to the third harmonic, and the first one is world x
    places = settings.places(stroke_m, np.radians([0.0, 90.0, 180.0, 270.0]))
    rng = generator("study", "misalignment", "sobol")
    return interactions(nominal, places, "exact", 2**settings.sobol_log2, settings.resamples, rng, settings.chosen)


def _noise(settings: MisalignmentSettings, nominal: Rig, places: Places) -> Array:
    """Relative errors of an aligned rig that was calibrated with noise, shape (draws, d, a)."""
    down, up = pixels(nominal, Misalignment(), places)
    D, setup = true_depth_m(nominal, Misalignment(), places), settings.calibration_setup
    errors = []
    for draw in range(settings.noise_draws):
        rng = generator("study", "misalignment", "calibration", draw)
        bundle = setup.calibrated(nominal, places.stroke_m, Misalignment(), rng)
        errors.append(depth_exact(bundle.rig, bundle.stroke(np.asarray(places.stroke_m)), down, up).depth_m / D - 1.0)
    return np.stack(errors)


def _refocused(settings: MisalignmentSettings, nominal: Rig) -> tuple[Finding, ...]:
    """Errors of D after the lens was turned, in the paper's 25 experiments."""
    rig = replace(nominal, camera=thin_lens(nominal.camera, LENS_M))
    places = [(row.real_depth_m, row.baseline_m) for row in load_published()]
    rows = [refocus(rig, focus_m, places, settings.height_m) for focus_m in FOCUS_M]
    return tuple(refocus_findings(rows))


def _findings(
    settings: MisalignmentSettings,
    table: pl.DataFrame,
    seen: tuple[RenderedDeviation, ...],
    tolerances: list[dict[str, object]],
    at_once: tuple[Interactions, ...],
    noise: Array,
    ranks: dict[str, list[tables.Rank]],
    places: Places,
) -> tuple[Finding, ...]:
    middle = float(places.depths_m[len(places.depths_m) // 2])
    return (
        *tables.cost_findings(ranks["exact"]),
        *tables.cost_findings(ranks["paper_normal"]),
        *tables.slope_findings(tables.slope_misses(table, "exact"), _SLOPE_TARGET),
        *tables.rendered_findings(seen, settings.agreement),
        *tables.tolerance_findings(tolerances, "exact", middle, settings.cost),
        *tables.calibrated_findings(ranks[CALIBRATED], ranks["exact"]),
        *tables.noise_findings(noise, places.depths_m),
        *_refocused(settings, default_rig()),
        *interaction_findings(at_once),
    )


def _drawings(
    table: pl.DataFrame,
    pictures: pl.DataFrame,
    at_once: tuple[Interactions, ...],
    ranks: dict[str, list[tables.Rank]],
    places: Places,
) -> tuple[Drawing, ...]:
    chosen = {name: ranks[name] for name in ("exact", "paper_normal", "paper_incidence", CALIBRATED)}
    return (
        azimuth_drawing(table, pictures, ranks["exact"], places.stroke_m),
        ranking_drawing(chosen, len(places.depths_m) - 1),
        interaction_drawing(at_once),
    )


def _notes(settings: MisalignmentSettings, seen: tuple[RenderedDeviation, ...]) -> tuple[str, ...]:
    off, name = tables.worst_disagreement(seen)
    missed = [
        f"rendered and predicted change differ by {off:.1e} of D ({name}); {settings.agreement:.0e} was the target"
    ]
    coarse = settings.search_calibrated
    limited = [
        f"tolerances after calibration are searched up to {coarse.largest:g} times the usual size only, in steps of "
        f"{coarse.factor:g}"
    ]
    return (*missed[: off > settings.agreement], *limited)


# -- small tables of the report ----------------------------------------------------------------------------------------


def tightest_table(rows: Sequence[dict[str, Any]], estimator: str, depth_m: float, cost: float) -> tuple[Row, ...]:
    """Table: tolerance of every parameter at one D beside the expected deviation, and their ratio."""
    return text_table(
        [row for row in tables.tolerances_of(rows, estimator, depth_m) if row["value"] is not None],
        {
            "parameter": lambda row: row["parameter"],
            f"tolerance for {100.0 * cost:g} % of D": lambda row: tables.value_text(row["parameter"], row["value"]),
            "expected deviation": lambda row: tables.usual_text(row["parameter"]),
            "ratio": lambda row: f"{row['value_over_study']:.2g}",
        },
    )


def ranking_rows(ranks: Sequence[tables.Rank], calibrated: Sequence[tables.Rank]) -> tuple[Row, ...]:
    """Table: what every parameter costs, % of D, rms over azimuths."""
    after = {rank.parameter: map(tables.percent_text, rank.rms) for rank in calibrated}
    depths = [f"{D:g} m" for D in ranks[0].depths_m]
    heads = ("parameter", "size", *depths, *(f"calibrated, {D}" for D in depths))
    return heads, *(
        (r.parameter, tables.usual_text(r.parameter), *map(tables.percent_text, r.rms), *after[r.parameter])
        for r in ranks
    )


def tolerance_table(rows: Sequence[dict[str, Any]], statistic: str, estimators: Sequence[str]) -> tuple[Row, ...]:
    """Table: the value of every parameter that costs 1 % of D, per estimator and D."""
    mine = {(r["parameter"], r["estimator"], r["depth_m"]): r["value"] for r in rows if r["statistic"] == statistic}
    cases = [(name, D) for name in estimators for D in sorted({depth for _, _, depth in mine})]
    values = {p: [mine[p, *case] for case in cases] for p in dict.fromkeys(parameter for parameter, _, _ in mine)}
    heads = ("parameter", *(f"{name}, {D:g} m" for name, D in cases))
    reached = {p: row for p, row in values.items() if any(value is not None for value in row)}
    return heads, *((p, *("-" if x is None else tables.value_text(p, x) for x in row)) for p, row in reached.items())


# -- drawings: change of D by azimuth, cost of each parameter, interactions --------------------------------------------

_CURVES, _BARS = 5, 14  # as many as can be told apart


def azimuth_drawing(
    table: pl.DataFrame, rendered: pl.DataFrame, ranks: Sequence[tables.Rank], stroke_m: float
) -> Drawing:
    """Change of D against the azimuth, exact estimator: lines predicted, crosses rendered; nearest and farthest D."""
    names = [rank.parameter for rank in ranks[:_CURVES]]
    depths = (ranks[0].depths_m[0], ranks[0].depths_m[-1])
    with canvas(9.0, 4.2) as figure:
        axes = figure.subplots(1, 2, sharex=True)
        for ax, D in zip(axes, depths, strict=True):
            for i, name in enumerate(names):
                size = PARAMETERS[name].study
                style = {**line_style(i), "marker": ""}
                x, y = _curve(table, name, size, stroke_m, D, "whole_relative")
                ax.plot(x, y, label=f"{name}, {tables.usual_text(name)}", **style)
                x, y = _curve(rendered, name, size, stroke_m, D, "rendered_relative")
                ax.plot(x, y, "x", color=style["color"], markersize=7)
            ax.set(title=f"D = {D:g} m", xlabel="azimuth of the spot, degrees", ylabel="change of D, %")
            ax.set_xticks(range(0, 361, 90))
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
        parts = ", ".join(f"{rank.parameter} {tables.percent_text(rank.worst[-1])} %" for rank in ranks[:_CURVES])
        alt = (
            "Change of the exact estimator's D against the spot's azimuth for the costliest misalignments, predicted "
            f"as lines and rendered as crosses, at D = {depths[0]:g} and {depths[1]:g} m; largest at {depths[1]:g} m: "
            f"{parts}."
        )
        return finished_drawing("azimuth", figure, alt)


def ranking_drawing(by_estimator: Mapping[str, Sequence[tables.Rank]], depth_index: int) -> Drawing:
    """Bars: what each parameter costs each estimator at one D."""
    first = next(iter(by_estimator.values()))
    D = first[0].depths_m[depth_index]
    order = sorted(first, key=lambda one: -float(one.rms[depth_index]))[:_BARS]
    names = [one.parameter for one in order]
    height = 0.8 / len(by_estimator)
    with canvas(9.0, 5.2) as figure:
        ax = figure.subplots()
        for i, (estimator, ranks) in enumerate(by_estimator.items()):
            cost = {one.parameter: 100.0 * float(one.rms[depth_index]) for one in ranks}
            places = np.arange(len(names)) + (i - 0.5 * (len(by_estimator) - 1)) * height
            values = [cost[name] for name in names]
            ax.barh(places, values, height, label=estimator, color=line_style(i)["color"])
        ax.set_xscale("log")
        ax.set_yticks(range(len(names)), [f"{name}, {tables.usual_text(name)}" for name in names])
        ax.invert_yaxis()
        ax.set(xlabel=f"change of D, % (rms over azimuths and signs), D = {D:g} m")
        ax.legend()
        top = ", ".join(f"{one.parameter} {tables.percent_text(one.rms[depth_index])} %" for one in order[:3])
        alt = f"Cost of each misalignment at D = {D:g} m by estimator, logarithmic; exact with nominal numbers: {top}."
        return finished_drawing("ranking", figure, alt)


def interaction_drawing(drawn_at_once: Sequence[Interactions]) -> Drawing:
    """First-order and total indices of the relative error with intervals, at the farthest D."""
    error_of = [each for each in drawn_at_once if each.output == "error"][-1]
    p = len(error_of.parameters)
    order = np.argsort(-error_of.total, kind="stable")[:10]  # the others have no effect that a bar shows
    with canvas(9.0, 4.0) as figure:
        ax = figure.subplots()
        for i, (label, start) in enumerate((("first order", 0), ("total", p))):
            at = start + order
            ends = np.stack([error_of.indices, error_of.low, error_of.high], axis=-1)[at]
            x = np.arange(len(order)) + (i - 0.5) * 0.25
            style = {**line_style(i), "linestyle": "none"}
            ax.errorbar(x, ends[:, 0], error_bars(ends), label=label, capsize=3, **style)
        ax.set_xticks(range(len(order)), [error_of.parameters[i] for i in order], rotation=30, ha="right")
        ax.set(ylabel="Sobol index (95 %)", xlabel=f"parameter; D = {error_of.depth_m:g} m, spots along x")
        ax.legend()
        alt = (
            f"Sobol indices of the relative error of D at {error_of.depth_m:g} m; the first-order ones sum to "
            f"{error_of.indices[-2]:.2f} ({error_of.low[-2]:.2f} to {error_of.high[-2]:.2f}); largest total "
            f"{error_of.total.max():.2f}, "
            f"{error_of.parameters[int(np.argmax(error_of.total))]}."
        )
        return finished_drawing("interactions", figure, alt)


def _curve(
    table: pl.DataFrame, parameter: str, value: float, stroke_m: float, depth_m: float, column: str
) -> tuple[list[float], list[float]]:
    here = {"parameter": parameter, "value": value, "estimator": "exact", "stroke_m": stroke_m, "depth_m": depth_m}
    mine = table.filter(**here).sort("azimuth_deg")
    return mine["azimuth_deg"].to_list(), (100.0 * mine[column]).to_list()


STUDY = Study(
    "misalignment",
    "Misalignment",
    "What does each misalignment cost each estimator, how tight must it be for 1 % of depth, and do errors add up?",
    MisalignmentSettings,
    run,
)
