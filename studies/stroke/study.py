"""Study `stroke`: the stroke that measures a distance best."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

import numpy as np
import polars as pl
from pydantic import Field

from phibench.calibration.outline.limb_image import PoseMeasurement
from phibench.calibration.rig.bundle import calibrate
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.progress import Steps
from phibench.datasets.frames.sensor_card import SensorCard, sensor_card
from phibench.estimator.geometry.rig_parameters import PARAMETERS, prior_sigmas
from phibench.estimator.limits.best_stroke import BestStroke, best_stroke, spot_bound
from phibench.estimator.limits.processed_bound import SpotSigma
from phibench.estimator.limits.stroke_curve import StrokeCurve, Surroundings, stroke_curve, stroke_grid
from phibench.estimator.spots.spot_prediction import Laser
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig
from phibench.studies.framework import Settings, Study, StudyDatasets, StudyResult
from phibench.studies.stroke.drawings import best_drawing, check_drawing, curves_drawing
from phibench.studies.stroke.rendered_checks import (
    RenderedCheck,
    RenderedOutcome,
    best_findings,
    best_table,
    check_findings,
    check_table,
    growth_findings,
    limit_findings,
    reason_findings,
    run_checks,
)

AS_BUILT, CALIBRATED, EXACT = "as built", "calibrated by the outline", "pixels alone"
_Depths = Annotated[tuple[Annotated[float, Field(ge=0.2, le=20.0)], ...], Field(strict=False, min_length=1)]
_Preset = Literal["bayer-raw", "srgb8", "mjpeg"]
_Range = Annotated[tuple[float, float], Field(strict=False)]
_QUALITY = 85  # of the charts' JPEG, if their preset has one: that of the study's figures
_FREE_STROKES_M = (0.1, 6.0)  # beyond every carriage: by geometry alone the best stroke is 1.2 to 2 D


class CheckSettings(Settings):
    """Frames that are drawn and evaluated."""

    preset: _Preset = Field(description="of the sensor")
    depths_m: _Depths = Field(description="distances")
    factors: Annotated[tuple[float, ...], Field(strict=False, min_length=1)] = Field(description="of the best stroke")
    strokes_m: _Range = Field(description="between which the best stroke is sought")
    power_mw: float = Field(gt=0.0, le=10.0, description="of the laser; weak enough that no pixel is full")
    draws: int = Field(ge=8, le=5000, description="pairs, each of a rig of its own")


class StrokeSettings(Settings):
    """Settings of the study."""

    preset: _Preset = Field(description="sensor of the charts")
    depths_m: _Depths = Field(description="distances of the chart")
    spot_height_m: float = Field(ge=0.0, le=3.0, description="above the floor")
    strokes_m: _Range = Field(description="of the carriage")
    outline_sigma_um: Annotated[tuple[float, float, float], Field(strict=False)] = Field(
        description="sphere centre from the outline: across, across, along the axis"
    )
    paper_depths_m: _Depths = Field(description="distances of the paper's tables 1 to 3")
    paper_strokes_m: _Depths = Field(description="longest stroke of each of these tables")
    check: CheckSettings


def run(settings: StrokeSettings, datasets: StudyDatasets) -> StudyResult:
    """Run the study."""
    rig, card = Rig(), sensor_card(settings.preset, jpeg_quality=_QUALITY)
    around = Surroundings(heights_m=(settings.spot_height_m,))
    rigs, spot = tolerances(rig, settings.outline_sigma_um), spot_bound(rig, card)
    longest = _paper(settings)
    depths = sorted({*settings.depths_m, *longest})
    best_by_case = {}
    with Steps(datasets.console, "stroke, curves", len(rigs) * len(depths)) as steps:
        for name, C in rigs.items():
            for d in depths:
                best_by_case[name, d] = best_stroke(
                    d, rig, covariance_rig=C, strokes_m=settings.strokes_m, around=around, card=card, spot=spot
                )
                steps.advance()
    checks = run_checks(planned(settings, rig, {k: rigs[k] for k in (AS_BUILT, EXACT)}), datasets)
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


def planned(settings: StrokeSettings, rig: Rig, rigs: Mapping[str, Array]) -> list[RenderedCheck]:
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


def best_frame(found: Mapping[tuple[str, float], BestStroke]) -> pl.DataFrame:
    """A row per tolerance and distance."""
    keys = ("depth_m", "stroke_m", "sigma_m", "sigma_spot_m", "sigma_calibration_m", "sigma_higher_order_m")
    rows = [
        {
            "tolerance": name,
            **{key: getattr(best, key) for key in keys},
            "near_low_m": best.near()[0],
            "near_high_m": best.near()[1],
            "limits": ", ".join(best.limits),
        }
        for (name, _), best in found.items()
    ]
    return pl.DataFrame(rows)


def curve_frame(found: Mapping[tuple[str, float], BestStroke]) -> pl.DataFrame:
    """A row per tolerance, distance and stroke."""
    return pl.concat([_curve(name, best) for (name, _), best in found.items()])


def check_frame(checks: Sequence[RenderedOutcome]) -> pl.DataFrame:
    """A row per cell of the check."""
    keys = ("tolerance", "depth_m", "stroke_m", "factor", "predicted_m")
    rows = [
        {**{key: getattr(c.check, key) for key in keys}, "rms_m": c.rms_m, "pairs": len(c.errors_m)}
        | dict(zip(("rms_low_m", "rms_high_m"), c.interval_m, strict=True))
        for c in checks
    ]
    return pl.DataFrame(rows)


def _curve(name: str, best: BestStroke) -> pl.DataFrame:
    c = best.curve
    names = ("sigma_m", "sigma_spot_m", "sigma_calibration_m", "sigma_higher_order_m")
    columns = {name: getattr(c, name) for name in names}
    return pl.DataFrame({"stroke_m": c.strokes_m, **columns, "cause": c.causes}).with_columns(
        tolerance=pl.lit(name), depth_m=pl.lit(best.depth_m)
    )


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


STUDY = Study(
    "stroke",
    "The best stroke",
    "Which stroke h makes the error of D smallest for a distance, a rig's tolerance and a field of view, and can an "
    "error grow again at long strokes?",
    StrokeSettings,
    run,
)
