"""Study `stroke`: stroke of least error of D for each distance, what limits it, and a check on drawn frames; drawings.

The drawings come last: the best stroke by distance, error by stroke, measured beside predicted.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from phibench.calibration.outline.outline_result import PoseMeasurement
from phibench.calibration.rig.bundle import calibrate
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.frames.sensor_card import SensorCard, sensor_card
from phibench.estimator.geometry.rig_parameters import PARAMETERS, prior_sigmas
from phibench.estimator.limits.best_stroke import best_stroke, spot_bound
from phibench.estimator.limits.processed_bound import SpotSigma
from phibench.estimator.limits.stroke_curve import StrokeCurve, Surroundings, stroke_curve, stroke_grid
from phibench.estimator.spots.spot_prediction import Laser
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig
from phibench.studies.framework import (
    COLOURS,
    MARKERS,
    Drawing,
    Metres,
    Settings,
    Study,
    StudyDatasets,
    StudyPreset,
    StudyResult,
    canvas,
    error_bars,
    finished_drawing,
    line_style,
)
from phibench.studies.stroke.perturbed_rigs import RenderedCheck, RenderedOutcome, measured_outcome
from phibench.studies.stroke.tables import (
    Found,
    best_findings,
    best_frame,
    best_table,
    check_findings,
    check_frame,
    check_table,
    curve_frame,
    growth_findings,
    limit_findings,
    reason_findings,
)

AS_BUILT, CALIBRATED, EXACT = "as built", "calibrated by the outline", "pixels alone"
_Range = tuple[float, float]
_QUALITY = 85  # of the charts' JPEG, if their preset has one: that of the study's figures
_FREE_STROKES_M = (0.1, 6.0)  # beyond every carriage: by geometry alone the best stroke is 1.2 to 2 D


class CheckSettings(Settings):
    """Frames that are drawn and evaluated."""

    preset: StudyPreset = Field(description="of the sensor")
    depths_m: Metres = Field(description="distances")
    factors: Annotated[tuple[float, ...], Field(min_length=1)] = Field(description="of the best stroke")
    strokes_m: _Range = Field(description="between which the best stroke is sought")
    power_mw: float = Field(gt=0.0, le=10.0, description="of the laser; weak enough that no pixel is full")
    draws: int = Field(ge=8, le=5000, description="pairs, each of a rig of its own")


class StrokeSettings(Settings):
    """Settings of the study."""

    preset: StudyPreset = Field(description="sensor of the charts")
    depths_m: Metres = Field(description="distances of the chart")
    spot_height_m: float = Field(ge=0.0, le=3.0, description="above the floor")
    strokes_m: _Range = Field(description="of the carriage")
    outline_sigma_um: tuple[float, float, float] = Field(
        description="sphere centre from the outline: across, across, along the axis"
    )
    paper_depths_m: Metres = Field(description="distances of the paper's tables 1 to 3")
    paper_strokes_m: Metres = Field(description="longest stroke of each of these tables")
    check: CheckSettings


def run(settings: StrokeSettings, datasets: StudyDatasets) -> StudyResult:
    """Run the study."""
    rig, card = Rig(), sensor_card(settings.preset, jpeg_quality=_QUALITY)
    around = Surroundings(heights_m=(settings.spot_height_m,))
    rigs, spot = tolerances(rig, settings.outline_sigma_um), spot_bound(rig, card)
    longest = _paper(settings)
    depths = sorted({*settings.depths_m, *longest})
    best_by_case = {}
    for name, d in datasets.each([(name, d) for name in rigs for d in depths], "stroke, curves"):
        best_by_case[name, d] = best_stroke(
            d, rig, covariance_rig=rigs[name], strokes_m=settings.strokes_m, around=around, card=card, spot=spot
        )
    todo = planned_checks(settings, rig, {k: rigs[k] for k in (AS_BUILT, EXACT)})
    checks = datasets.map(measured_outcome, todo, "stroke, frames")
    names, top = tuple(rigs), settings.strokes_m[1]
    findings = [row for name in names for row in best_findings(best_by_case, name, tuple(longest))]
    findings += [row for d in longest for row in growth_findings(best_by_case, d, names, top)]
    built = best_by_case[AS_BUILT, next(iter(longest))]
    if math.isfinite(built.stroke_m):
        findings += reason_findings(rig, built.depth_m, settings.spot_height_m, (built.stroke_m, top))
    findings += limit_findings(_free_curves(rig, settings.depths_m, spot, card, around))
    findings += check_findings(checks)
    return StudyResult(
        {"table": best_frame(best_by_case), "curves": curve_frame(best_by_case), "checks": check_frame(checks)},
        tuple(findings),
        (
            best_drawing(best_by_case, names, settings.depths_m),
            curves_drawing(best_by_case, names, longest),
            check_drawing(checks),
        ),
        {
            f"Best strokes, {settings.preset}": best_table(best_by_case, names, depths),
            f"Frames, {settings.check.preset}: rms error of D with 95 % interval": check_table(checks),
        },
        _notes(settings, checks),
    )


def _paper(settings: StrokeSettings) -> dict[float, float]:
    """Longest strokes of the paper's tables by distance.

    Raises
    ------
    DatasetError
        If there are not as many of both, or the check leaves out the best stroke itself.
    """
    depths, strokes = settings.paper_depths_m, settings.paper_strokes_m
    if len(depths) != len(strokes):
        raise DatasetError(f"paper_depths_m has {len(depths)} entries, paper_strokes_m {len(strokes)}: give as many")
    if 1.0 not in settings.check.factors or min(settings.check.factors) <= 0.0:
        raise DatasetError(
            f"check.factors = {list(settings.check.factors)}: must be above 0 and hold 1.0, the best stroke itself"
        )
    return dict(zip(depths, strokes, strict=True))


def tolerances(rig: Rig, outline_sigma_um: Sequence[float]) -> dict[str, Array]:
    """Covariances of the rig's parameters by name."""
    outline = PoseMeasurement(rig.sphere_in_camera_m, np.diag((np.array(outline_sigma_um) * 1e-6) ** 2))
    return {
        AS_BUILT: np.diag(prior_sigmas() ** 2),
        CALIBRATED: calibrate(rig, outline).covariance,
        EXACT: np.zeros((len(PARAMETERS),) * 2),
    }


def planned_checks(settings: StrokeSettings, rig: Rig, rigs: Mapping[str, Array]) -> list[RenderedCheck]:
    """Cells of the check that lie within the limits."""
    wanted, card = settings.check, sensor_card(settings.check.preset)
    taken = (wanted.preset, wanted.power_mw, wanted.draws)
    laser = Laser(power_w=1e-3 * wanted.power_mw)
    spot, around = spot_bound(rig, card), Surroundings(heights_m=(settings.spot_height_m,), laser=laser)
    checks = []
    for name, C in rigs.items():
        rows = tuple(tuple(row) for row in C.tolist())
        for d in wanted.depths_m:
            options: dict[str, Any] = {"covariance_rig": C, "around": around, "spot": spot}
            best = best_stroke(d, rig, strokes_m=wanted.strokes_m, card=card, **options)
            strokes = np.array([f * best.stroke_m for f in wanted.factors])
            curve = stroke_curve(rig, d, strokes, exposure_s=card.exposure_s, stroke_sigma_m=0.0, **options)
            checks += [
                RenderedCheck(name, d, float(h), f, float(s), rows, settings.spot_height_m, *taken)
                for f, h, s in zip(wanted.factors, strokes, curve.allowed_sigma_m, strict=True)
                if math.isfinite(s)
            ]
    return checks


def _free_curves(
    rig: Rig, depths_m: Sequence[float], spot: SpotSigma, card: SensorCard, around: Surroundings
) -> dict[float, StrokeCurve]:
    """Curves over strokes that no carriage bounds, at the nearest and the farthest distance."""
    exact, grid = np.zeros((len(PARAMETERS),) * 2), stroke_grid(*_FREE_STROKES_M)
    ends = dict.fromkeys((min(depths_m), max(depths_m)))
    return {d: stroke_curve(rig, d, grid, spot, exact, around, card.exposure_s, 0.0) for d in ends}


def _notes(settings: StrokeSettings, checks: Sequence[RenderedOutcome]) -> tuple[str, ...]:
    notes = [
        "Predictions are for a round spot over a flat white wall at 1 mW and 1/60 s, rms over 8 "
        f"azimuths; frames of the check are {settings.check.preset} at {settings.check.power_mw:g} mW, before a "
        "wall of flat light.",
        "Bounds leave full pixels out: at 1 mW and 1/60 s the spot fills pixels nearer than about 1.5 m, where "
        "exposure is to be shortened.",
    ]
    wanted = 2 * len(settings.check.depths_m) * len(settings.check.factors)
    if len(checks) < wanted:
        notes.append(f"{wanted - len(checks)} of {wanted} cells of the check lie beyond a limit and are left out.")
    lost = sum(c.check.draws - len(c.errors_m) for c in checks)
    if lost:
        notes.append(f"{lost} pairs of the check without a spot in both images are left out.")
    return tuple(notes)


# -- drawings ----------------------------------------------------------------------------------------------------------


def best_drawing(found: Found, tolerances: Sequence[str], depths_m: Sequence[float]) -> Drawing:
    """Best stroke and its error against the distance."""
    with canvas(10.0, 4.0) as figure:
        left, right = figure.subplots(1, 2)
        for i, tolerance in enumerate(tolerances):
            best = [found[tolerance, d] for d in depths_m]
            h, sigma = (np.array([getattr(b, name) for b in best]) for name in ("stroke_m", "sigma_m"))
            bound = np.array([bool(b.limits) for b in best])
            for ax, y in ((left, h), (right, 100.0 * sigma / np.array(depths_m))):
                ax.plot(depths_m, y, label=tolerance, **line_style(i))
                # hollow: a limit stopped it
                ax.plot(np.array(depths_m)[bound], y[bound], "o", color="white", markersize=3.0, zorder=5)
        left.set_ylabel("best stroke h, m")
        right.set_ylabel("sigma of D at the best stroke, %")
        right.set_yscale("log")
        for ax in (left, right):
            ax.set_xlabel("distance D, m")
        left.legend(frameon=False, title="white centre: at a limit")
        ends = {t: (found[t, depths_m[0]], found[t, depths_m[-1]]) for t in tolerances}
        alt = "Best stroke and its relative error against the distance. " + "; ".join(
            f"{t}: {a.stroke_m:.2f} m at D = {a.depth_m:g} m to {b.stroke_m:.2f} m at {b.depth_m:g} m"
            for t, (a, b) in ends.items()
        )
        return finished_drawing("best", figure, alt + ".")


def curves_drawing(found: Found, tolerances: Sequence[str], longest_m: Mapping[float, float]) -> Drawing:
    """Predicted error against the stroke, a panel per distance of the paper."""
    with canvas(11.0, 3.8) as figure:
        axes = figure.subplots(1, len(longest_m), squeeze=False)[0]
        for ax, (depth, longest) in zip(axes, longest_m.items(), strict=True):
            for i, tolerance in enumerate(tolerances):
                best = found[tolerance, depth]
                sigma = np.where(np.isfinite(best.curve.allowed_sigma_m), best.curve.allowed_sigma_m, np.nan)
                style = {**line_style(i), "marker": ""}
                ax.plot(best.curve.strokes_m, 1e3 * sigma, label=tolerance, **style)
                ax.plot(best.stroke_m, 1e3 * best.sigma_m, MARKERS[i], color=COLOURS[i])
            ax.axvline(longest, color="grey", linestyle=":", label="longest stroke in the paper's table")
            ax.set_title(f"D = {depth:g} m")
            ax.set_xscale("log")
            ax.set_yscale("log")
            ax.set_xlabel("stroke h, m")
        axes[0].set_ylabel("predicted sigma of D, mm")
        axes[0].legend(frameon=False, fontsize=7)
        alt = "Predicted error of D against the stroke; markers at the smallest: " + "; ".join(
            f"D = {d:g} m, {t} {found[t, d].stroke_m:.2f} m" for d in longest_m for t in tolerances
        )
        return finished_drawing("curves", figure, alt + ".")


def check_drawing(checks: Sequence[RenderedOutcome]) -> Drawing:
    """Measured rms beside the prediction."""
    names = tuple(dict.fromkeys(c.check.tolerance for c in checks))
    with canvas(10.0, 3.8) as figure:
        for ax, name in zip(figure.subplots(1, len(names), squeeze=False)[0], names, strict=True):
            for i, depth in enumerate(dict.fromkeys(c.check.depth_m for c in checks)):
                mine = [c for c in checks if c.check.tolerance == name and c.check.depth_m == depth]
                h = [c.check.stroke_m for c in mine]
                ends = 1e3 * np.array([c.rms_m.ends for c in mine])
                ax.plot(h, [1e3 * c.check.predicted_m for c in mine], color=COLOURS[i], linewidth=1.0)
                label = f"D = {depth:g} m"
                ax.errorbar(h, ends[:, 0], error_bars(ends), fmt=MARKERS[i], color=COLOURS[i], capsize=2, label=label)
            ax.set_title(f"{name}: points frames, lines predicted")
            ax.set_xscale("log")
            ax.set_yscale("log")
            ax.set_xlabel("stroke h, m")
            ax.set_ylabel("error of D, mm rms")
            ax.legend(frameon=False, fontsize=8)
        ratios = [c.rms_m.value / c.check.predicted_m for c in checks]
        alt = f"Rms error of D in frames over the predicted: from {min(ratios):.2f} to {max(ratios):.2f}."
        return finished_drawing("checks", figure, alt)


STUDY = Study(
    "stroke",
    "The best stroke",
    "Which stroke h makes the error of D smallest for a distance, a rig's tolerance and a field of view, and can an "
    "error grow again at long strokes?",
    StrokeSettings,
    run,
)
