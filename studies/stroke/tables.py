"""Findings and tables of the study `stroke`: best strokes, their limits, measured errors beside predicted ones."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import polars as pl

from phibench.estimator.geometry.reflection import image_of
from phibench.estimator.geometry.rig_parameters import PARAMETERS, PRIOR_SIGMA, RIG_PARAMETERS, rig_gradient
from phibench.estimator.limits.best_stroke import BestStroke
from phibench.estimator.limits.stroke_curve import FREE, StrokeCurve
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig
from phibench.studies.framework import Finding, Row, ends_text, text_table
from phibench.studies.stroke.perturbed_rigs import RenderedOutcome

GROWS = 1.05
"""An error grows again where that of the longest stroke is so many times the smallest."""
NEAR = 0.05  # of the smallest error: strokes within it are as good
Found = Mapping[tuple[str, float], BestStroke]


def best_frame(found: Found) -> pl.DataFrame:
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


def curve_frame(found: Found) -> pl.DataFrame:
    """A row per tolerance, distance and stroke."""
    names = ("sigma_m", "sigma_spot_m", "sigma_calibration_m", "sigma_higher_order_m")
    frames = [
        pl.DataFrame(
            {"stroke_m": c.strokes_m, **{key: getattr(c, key) for key in names}, "cause": c.causes}
        ).with_columns(tolerance=pl.lit(name), depth_m=pl.lit(depth))
        for (name, depth), c in ((case, best.curve) for case, best in found.items())
    ]
    return pl.concat(frames)


def check_frame(checks: Sequence[RenderedOutcome]) -> pl.DataFrame:
    """A row per cell of the check."""
    keys = ("tolerance", "depth_m", "stroke_m", "factor", "predicted_m")
    rows = [
        {**{key: getattr(c.check, key) for key in keys}, "rms_m": c.rms_m.value, "pairs": len(c.errors_m)}
        | {"rms_low_m": c.rms_m.low, "rms_high_m": c.rms_m.high}
        for c in checks
    ]
    return pl.DataFrame(rows)


def best_findings(found: Found, tolerance: str, depths_m: Sequence[float]) -> Iterator[Finding]:
    """Best strokes of one tolerance; the range of the stroke is that within 5 % of the smallest error."""
    for depth in depths_m:
        best, lead = found[tolerance, depth], f"{tolerance}, D = {depth:g} m"
        if not math.isfinite(best.stroke_m):
            yield Finding(f"{lead}: no stroke, {', '.join(best.limits)}", None, unit="m")
            continue  # nothing to render
        yield Finding(f"{lead}: best stroke", best.stroke_m, unit="m")
        if best.limits:
            yield Finding(f"{lead}: limit of the stroke ({', '.join(best.limits)})", best.stroke_m, unit="m")
        for end, value in zip(("shortest", "longest"), best.near(NEAR), strict=True):
            yield Finding(f"{lead}: {end} stroke within {100.0 * NEAR:g} % of the smallest error", value, unit="m")
        yield Finding(f"{lead}: sigma of D", 1e3 * best.sigma_m, unit="mm")
        yield Finding(f"{lead}: relative sigma of D", 100.0 * best.sigma_m / depth, unit="%")
        yield Finding(f"{lead}: part of sigma beyond first order", 1e3 * best.sigma_higher_order_m, unit="mm")


def growth_findings(found: Found, depth_m: float, tolerances: Sequence[str], longest_m: float) -> Iterator[Finding]:
    """Error at the longest stroke over the smallest one: whether it can grow again."""
    for tolerance in tolerances:
        label = f"{tolerance}, D = {depth_m:g} m: error at h = {longest_m:g} m over the smallest"
        yield Finding(label, growth(found[tolerance, depth_m], longest_m)).judged("<=", GROWS)


def growth(best: BestStroke, longest_m: float) -> float:
    """Predicted error at the longest stroke over the smallest up to there."""
    curve = best.curve
    # the longest itself counts, despite rounding
    within = (curve.strokes_m <= longest_m * (1.0 + 1e-9)) & np.isfinite(curve.allowed_sigma_m)
    sigma = curve.allowed_sigma_m[within]
    return float(sigma[-1] / sigma.min()) if sigma.size else math.nan


def reason_findings(rig: Rig, depth_m: float, height_m: float, strokes_m: tuple[float, float]) -> Iterator[Finding]:
    """Angle of the ray to the spot, and the costliest parameter of a rig as built, at two strokes."""
    for h in (0.0, *strokes_m):
        angle = math.degrees(theta_rad(rig, depth_m, height_m, h))
        yield Finding(f"D = {depth_m:g} m, h = {h:.2f} m: ray to the spot, from straight down", angle, unit="deg")
    for h in strokes_m:
        name, size = _worst(rig, depth_m, height_m, h)
        label = f"D = {depth_m:g} m, h = {h:.2f} m: costliest parameter to first order ({name})"
        yield Finding(label, 1e3 * size, unit="mm")


def limit_findings(curves: Mapping[float, StrokeCurve]) -> Iterator[Finding]:
    """Shortest stroke that each cause forbids, where no carriage bounds the stroke."""
    first: dict[str, tuple[float, float]] = {}
    for depth, curve in curves.items():
        for h, cause in zip(curve.strokes_m.tolist(), curve.causes, strict=True):
            if cause != FREE and h < first.get(cause, (math.inf, 0.0))[0]:
                first[cause] = (h, depth)
    for cause, (h, depth) in first.items():
        yield Finding(f"without the carriage's limit: {cause}, first at D = {depth:g} m, from h", h, unit="m")
    if not first:
        longest = max(float(curve.strokes_m[-1]) for curve in curves.values())
        yield Finding("without the carriage's limit: nothing forbids a stroke up to h", longest, unit="m")


def check_findings(checks: Sequence[RenderedOutcome]) -> Iterator[Finding]:
    """Measured against predicted error by tolerance, and strokes surely better or worse than the best."""
    for name in dict.fromkeys(c.check.tolerance for c in checks):
        yield from _checked(name, [c for c in checks if c.check.tolerance == name])


def _checked(name: str, checks: Sequence[RenderedOutcome]) -> Iterator[Finding]:
    lead, cells = f"frames, {name}", f"of {len(checks)} cells"
    ratios = [c.rms_m.value / c.check.predicted_m for c in checks]
    yield Finding(f"{lead}: measured rms over predicted sigma, mean", math.exp(float(np.mean(np.log(ratios)))))
    for word, value in (("smallest", min(ratios)), ("largest", max(ratios))):
        yield Finding(f"{lead}: measured rms over predicted sigma, {word}", value)
    yield Finding(f"{lead}: pairs of a cell, least", min(len(c.errors_m) for c in checks))
    yield Finding(f"{lead}: predictions in the 95 % interval", sum(c.fits for c in checks), unit=cells)
    others = [c for c in checks if c.check.factor != 1.0]
    beaten = sum(_surely_better(c, _best_of(c, checks)) for c in others)
    worse = sum(_surely_better(_best_of(c, checks), c) for c in others)
    of = f"of {len(others)}"
    yield Finding(f"{lead}: strokes surely better than the best", beaten, unit=of).judged("<=", 0.0)
    yield Finding(f"{lead}: strokes surely worse than the best", worse, unit=of)


def best_table(found: Found, tolerances: Sequence[str], depths_m: Sequence[float]) -> tuple[Row, ...]:
    """Best strokes by distance."""
    head = ("D, m", *(f"{t}: {what}" for t in tolerances for what in ("h, m", "sigma, mm", "limit")))
    return (head, *((f"{d:g}", *(cell for t in tolerances for cell in _cells(found[t, d]))) for d in depths_m))


def check_table(checks: Sequence[RenderedOutcome]) -> tuple[Row, ...]:
    """Measured against predicted."""
    return text_table(
        checks,
        {
            "tolerance": lambda c: c.check.tolerance,
            "D, m": lambda c: f"{c.check.depth_m:g}",
            "h / best": lambda c: f"{c.check.factor:g}",
            "h, m": lambda c: f"{c.check.stroke_m:.3f}",
            "predicted, mm": lambda c: f"{1e3 * c.check.predicted_m:.3g}",
            "measured rms, mm": lambda c: ends_text(c.rms_m.ends, scale=1e3),
            "pairs": lambda c: str(len(c.errors_m)),
        },
    )


def theta_rad(rig: Rig, depth_m: float, height_m: float, stroke_m: float) -> float:
    """Angle from straight down at which a raised mirror's centre sees the spot."""
    return math.atan2(depth_m, float(rig.at(stroke_m).sphere_centre_m[2]) - height_m)


def _worst(rig: Rig, depth_m: float, height_m: float, stroke_m: float) -> tuple[str, float]:
    """Parameter with the largest error of D, root mean square over azimuths, and that error."""
    turn = 2.0 * math.pi * np.arange(8) / 8.0
    axis = rig.at(0.0).sphere_centre_m
    x, y = axis[0] + depth_m * np.cos(turn), axis[1] + depth_m * np.sin(turn)
    points = np.stack([x, y, np.full(8, height_m)], axis=-1)
    down, up = (image_of(rig.at(h), points).uv_px for h in (0.0, stroke_m))
    g: Array = rig_gradient(rig, stroke_m, down, up)
    size = np.sqrt(np.mean(g**2, axis=0)) * np.array([PRIOR_SIGMA[name] for name in RIG_PARAMETERS])
    k = int(np.argmax(size))
    return PARAMETERS[k], float(size[k])


def _best_of(check: RenderedOutcome, checks: Sequence[RenderedOutcome]) -> RenderedOutcome:
    return next(c for c in checks if c.check.depth_m == check.check.depth_m and c.check.factor == 1.0)


def _surely_better(a: RenderedOutcome, b: RenderedOutcome) -> bool:
    return a.rms_m.high < b.rms_m.low


def _cells(best: BestStroke) -> tuple[str, str, str]:
    return f"{best.stroke_m:.2f}", f"{1e3 * best.sigma_m:.3g}", ", ".join(best.limits)
