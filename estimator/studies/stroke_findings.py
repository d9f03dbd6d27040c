"""What the numbers of the study `stroke` say, in sentences and small tables."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from phibench.estimator.best_stroke import BestStroke
from phibench.estimator.calibration.parameters import PARAMETERS, PRIOR_SIGMA
from phibench.estimator.mirror_image import image_of
from phibench.estimator.rig_errors import RIG_PARAMETERS, rig_gradient
from phibench.estimator.stroke_curve import FREE, StrokeCurve
from phibench.estimator.studies.result import Row
from phibench.estimator.studies.stroke_checks import Checked
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig

GROWS = 1.05
"""An error grows again where that of the longest stroke is so many times the smallest."""
Found = Mapping[tuple[str, float], BestStroke]


def best_sentence(found: Found, tolerance: str, depths_m: Sequence[float]) -> str:
    """Best strokes of one tolerance."""
    return f"{tolerance}: " + "; ".join(_best(found[tolerance, depth]) for depth in depths_m) + "."


def growth_sentence(found: Found, depth_m: float, tolerances: Sequence[str], longest_m: float) -> str:
    """Whether an error that grows again at long strokes can occur at a distance, and for whom."""
    ratios = {t: growth(found[t, depth_m], longest_m) for t in tolerances}
    grows = [f"{t} ({ratio:.2f} times the smallest at {longest_m:g} m)" for t, ratio in ratios.items() if ratio > GROWS]
    falls = [t for t, ratio in ratios.items() if ratio <= GROWS]
    text = f"D = {depth_m:g} m, strokes up to {longest_m:g} m: "
    if grows:
        text += f"the error grows again for {', '.join(grows)}"
    if falls:
        text += ("; it does not for " if grows else "the error does not grow again for ") + ", ".join(falls)
    return text + "."


def growth(best: BestStroke, longest_m: float) -> float:
    """Predicted error at the longest stroke over the smallest up to there."""
    curve = best.curve
    within = (curve.strokes_m <= longest_m * (1.0 + 1e-9)) & np.isfinite(curve.allowed_sigma_m)
    sigma = curve.allowed_sigma_m[within]
    return float(sigma[-1] / sigma.min()) if sigma.size else math.nan


def reason_sentence(rig: Rig, depth_m: float, height_m: float, strokes_m: tuple[float, float]) -> str:
    """Which parameter of a rig as built costs most at two strokes, and where the up image is."""
    parts = [_worst(rig, depth_m, height_m, h) for h in strokes_m]
    turned = [math.degrees(theta_rad(rig, depth_m, height_m, h)) for h in (0.0, *strokes_m)]
    return (
        f"D = {depth_m:g} m: the ray to the spot leaves the mirror at {turned[0]:.0f} deg from straight down at the "
        f"lower position, at {turned[1]:.0f} deg at h = {strokes_m[0]:.2f} m and at {turned[2]:.0f} deg at "
        f"{strokes_m[1]:.2f} m; to first order, of the parameters of a rig as built {parts[0][0]} costs most at the "
        f"first stroke ({1e3 * parts[0][1]:.1f} mm), {parts[1][0]} at the second ({1e3 * parts[1][1]:.1f} mm)."
    )


def limits_sentence(curves: Mapping[float, StrokeCurve]) -> str:
    """What stands in the way when strokes are not bounded by the carriage."""
    first: dict[str, tuple[float, float]] = {}
    for depth, curve in curves.items():
        for h, cause in zip(curve.strokes_m.tolist(), curve.causes, strict=True):
            if cause != FREE and h < first.get(cause, (math.inf, 0.0))[0]:
                first[cause] = (h, depth)
    longest = max(float(curve.strokes_m[-1]) for curve in curves.values())
    if not first:
        return f"Nothing stands in the way of strokes up to {longest:g} m at the distances of the chart."
    listed = ", ".join(f"{cause} from {h:.2f} m (D = {depth:g} m)" for cause, (h, depth) in first.items())
    return f"Without the carriage's limit, what first stands in the way: {listed}."


def check_sentences(checks: Sequence[Checked]) -> tuple[str, ...]:
    """Measured against predicted, and whether the best stroke is the best, by tolerance."""
    return tuple(_checked(name, [c for c in checks if c.check.tolerance == name]) for name in _tolerances(checks))


def best_table(found: Found, tolerances: Sequence[str], depths_m: Sequence[float]) -> tuple[Row, ...]:
    """Best strokes by distance."""
    head = ("D, m", *(f"{t}: {what}" for t in tolerances for what in ("h, m", "sigma, mm", "limit")))
    return (head, *((f"{d:g}", *(cell for t in tolerances for cell in _cells(found[t, d]))) for d in depths_m))


def check_table(checks: Sequence[Checked]) -> tuple[Row, ...]:
    """Measured against predicted."""
    head = ("tolerance", "D, m", "h / best", "h, m", "predicted, mm", "measured rms, mm", "pairs")
    return (head, *(_check_row(c) for c in checks))


def theta_rad(rig: Rig, depth_m: float, height_m: float, stroke_m: float) -> float:
    """Angle from straight down at which a raised mirror's centre sees the spot."""
    return math.atan2(depth_m, float(rig.at(stroke_m).sphere_centre_m[2]) - height_m)


def _best(best: BestStroke) -> str:
    if not math.isfinite(best.stroke_m):
        return f"D = {best.depth_m:g} m: no stroke, {', '.join(best.limits)}"
    low, high = best.near()
    text = f"D = {best.depth_m:g} m best h {best.stroke_m:.2f} m, sigma {1e3 * best.sigma_m:.3g} mm"
    text += f" ({100 * best.sigma_m / best.depth_m:.2g} %; within 5 % from {low:.2f} to {high:.2f} m"
    if best.sigma_higher_order_m > best.sigma_calibration_m:
        text += ", most of it beyond first order"
    return text + (f"; limit: {', '.join(best.limits)})" if best.limits else ")")


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


def _checked(name: str, checks: Sequence[Checked]) -> str:
    fits = sum(c.fits for c in checks)
    ratio = math.exp(float(np.mean([math.log(c.rms_m / c.check.predicted_m) for c in checks])))
    text = (
        f"Frames, {name}: measured rms over predicted sigma is {ratio:.2f} on average of {len(checks)} cells of "
        f"{min(len(c.errors_m) for c in checks)} pairs or more; the prediction lies in the 95 % interval of {fits}."
    )
    beaten = [c for c in checks if c.check.factor != 1.0 and _surely_better(c, _best_of(c, checks))]
    if beaten:
        where = ", ".join(f"D = {c.check.depth_m:g} m, {c.check.factor:g} times" for c in beaten)
        return f"{text} The best stroke is surely not the best at {where}."
    worse = [c for c in checks if c.check.factor != 1.0 and _surely_better(_best_of(c, checks), c)]
    others = sum(c.check.factor != 1.0 for c in checks)
    return f"{text} No other stroke is surely better than the best; {len(worse)} of {others} are surely worse."


def _best_of(check: Checked, checks: Sequence[Checked]) -> Checked:
    return next(c for c in checks if c.check.depth_m == check.check.depth_m and c.check.factor == 1.0)


def _surely_better(a: Checked, b: Checked) -> bool:
    return a.interval_m[1] < b.interval_m[0]


def _tolerances(checks: Sequence[Checked]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(c.check.tolerance for c in checks))


def _cells(best: BestStroke) -> tuple[str, str, str]:
    return f"{best.stroke_m:.2f}", f"{1e3 * best.sigma_m:.3g}", ", ".join(best.limits)


def _check_row(c: Checked) -> Row:
    low, high = c.interval_m
    rms = f"{1e3 * c.rms_m:.3g} ({1e3 * low:.3g} to {1e3 * high:.3g})"
    where = (f"{c.check.depth_m:g}", f"{c.check.factor:g}", f"{c.check.stroke_m:.3f}")
    return (c.check.tolerance, *where, f"{1e3 * c.check.predicted_m:.3g}", rms, str(len(c.errors_m)))
