"""Frames of a spot at a distance and a stroke, taken by rigs that are not what is nominal, and the error of D.

The spot's light is rendered for every rig; the wall behind it is flat light, as strong as the lab's.

What the numbers of the study `stroke` say, in sentences and small tables.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from phibench.datasets.parallel import parallel_map
from phibench.datasets.progress import Steps
from phibench.estimator.benchmark.answer_errors import Rules
from phibench.estimator.benchmark.intervals import Clusters, estimates, rms_of
from phibench.estimator.geometry.least_squares_depth import depth_general
from phibench.estimator.geometry.mirror_image import image_of
from phibench.estimator.geometry.rig_parameters import (
    PARAMETERS,
    PRIOR_SIGMA,
    RIG_PARAMETERS,
    changed,
    rig_gradient,
    stroke_of,
)
from phibench.estimator.limits.best_stroke import ROOM_E_PER_S, BestStroke
from phibench.estimator.limits.stroke_curve import FREE, StrokeCurve, covariance_root
from phibench.estimator.methods.registry import METHODS
from phibench.estimator.studies.framework import Material, Row
from phibench.estimator.studies.image_cutout import Shot, SpotPair, cut_region, cut_rig, taken, without_off
from phibench.render.optics.truth import spot_truth
from phibench.render.sensor.settings import sensor
from phibench.scenes.frames import Array
from phibench.scenes.laser import LaserSpot, beam_diameter_m
from phibench.scenes.random_streams import Name, generator
from phibench.scenes.rig import POSITIONS, Rig, Stroke
from phibench.scenes.room import Room

METHOD = {"bayer-raw": "raw_maximum_likelihood", "srgb8": "chain_fit", "mjpeg": "chain_fit"}
_NAMES: tuple[Name, ...] = ("study", "stroke")
_ROOM = Room("wall", ())  # the robot stands in it
_BOX_PX = 48
_MARGIN_PX = 32
_TURN = 0.618033988749895  # golden: azimuths, and with them sub-pixel phases, never repeat


@dataclass(frozen=True)
class Check:
    """One distance, stroke and tolerance.

    Attributes
    ----------
    tolerance : str
    depth_m, stroke_m, factor : float
        The stroke is `factor` times the best.
    predicted_m : float
        Standard deviation of D.
    covariance : shape (p, p), of the rig's parameters; rows
    height_m : float
    preset : str
    power_mw : float
    draws : int
    """

    tolerance: str
    depth_m: float
    stroke_m: float
    factor: float
    predicted_m: float
    covariance: tuple[tuple[float, ...], ...]
    height_m: float
    preset: str
    power_mw: float
    draws: int


@dataclass(frozen=True)
class Checked:
    """A check with what was measured.

    Attributes
    ----------
    check : Check
    errors_m : tuple of float
        D of the frames minus the true one, of the pairs in which both spots were found.
    """

    check: Check
    errors_m: tuple[float, ...]

    @property
    def rms_m(self) -> float:
        """Root mean square error; NaN without a pair."""
        return math.sqrt(float(np.mean(np.square(self.errors_m)))) if self.errors_m else math.nan

    @cached_property
    def interval_m(self) -> tuple[float, float]:
        """95 % interval of the rms, by bootstrap: errors of rigs as built have long tails."""
        n = len(self.errors_m)
        rms = rms_of(Clusters(np.arange(n), n), np.square(self.errors_m))
        (estimate,) = estimates([rms], n, Rules(resamples=999), generator(*_NAMES, "interval"))
        return estimate.low, estimate.high

    @property
    def fits(self) -> bool:
        """Whether the predicted error lies in the interval of the measured one."""
        low, high = self.interval_m
        return low <= self.check.predicted_m <= high


def run_checks(checks: Sequence[Check], material: Material) -> list[Checked]:
    """Measure, with the material's workers."""
    with Steps(material.console, "stroke, frames", len(checks)) as steps:
        found = []
        for one in parallel_map(measured, checks, material.workers):
            found.append(one)
            steps.advance()
    return found


def measured(check: Check) -> Checked:
    """Draw and evaluate all frames of a check."""
    nominal = Rig()
    answers = [_answer(check, nominal, k) for k in range(check.draws)]
    found = [a for a in answers if a is not None]
    if not found:
        return Checked(check, ())
    true, down, up, C_down, C_up = (np.array(column) for column in zip(*found, strict=True))
    depth = depth_general(nominal, check.stroke_m, down, up, C_down, C_up, np.array(check.covariance)).depth_m
    errors = depth - true
    return Checked(check, tuple(errors[np.isfinite(errors)].tolist()))


def _answer(check: Check, nominal: Rig, draw: int) -> tuple[float, Array, Array, Array, Array] | None:
    """True D, positions in the whole image and claimed covariances of one draw; None if a spot is not found."""
    names = (*_NAMES, check.tolerance, f"{check.depth_m:.6f}", f"{check.stroke_m:.6f}", draw)
    values = deviations(np.array(check.covariance), (*_NAMES, check.tolerance, f"{check.depth_m:.6f}", draw))
    true, stroke_m = changed(nominal, values), float(stroke_of(np.array(check.stroke_m), values))
    spot = _spot(check, nominal, 2.0 * math.pi * (draw * _TURN % 1.0))
    uv = [_pixel(true, stroke_m, spot, p) for p in POSITIONS]
    camera = nominal.camera
    region = cut_region(uv, (camera.height_px, camera.width_px), _MARGIN_PX)
    flat = np.broadcast_to(np.array(ROOM_E_PER_S)[:, None, None], (3, *region.shape))
    pair = SpotPair.of(cut_rig(true, region), stroke_m, spot, _ROOM, dict.fromkeys(POSITIONS, flat), str(draw))
    seen = taken(draw, Shot(sensor(check.preset)), pair, (cut_rig(nominal, region), check.stroke_m), names, _BOX_PX)
    answer = METHODS[METHOD[check.preset]](without_off(seen))
    spots = (answer.down, answer.up)
    if any(one.uv_px is None or one.covariance_px2 is None for one in spots):
        return None
    corner = np.array([region.u0_px, region.v0_px], float)
    down, up = (np.array(one.uv_px) + corner for one in spots)
    C_down, C_up = (np.array(one.covariance_px2) for one in spots)
    return pair.depth_m, down, up, C_down, C_up


def deviations(covariance: Array, names: tuple[Name, ...]) -> Array:
    """Errors of the rig's parameters, shape (p,), normal with a covariance that may be singular."""
    return np.asarray(covariance_root(covariance) @ generator(*names, "rig").standard_normal(len(PARAMETERS)))


def _spot(check: Check, rig: Rig, azimuth_rad: float) -> LaserSpot:
    axis = rig.at(0.0).sphere_centre_m
    away = np.array([math.cos(azimuth_rad), math.sin(azimuth_rad)])
    x, y = (axis[:2] + check.depth_m * away).tolist()
    place, normal, power_w = (x, y, check.height_m), (-away[0], -away[1], 0.0), 1e-3 * check.power_mw
    return LaserSpot(place, normal, beam_diameter_m(check.depth_m), power_w=power_w)


def _pixel(rig: Rig, stroke_m: float, spot: LaserSpot, position: str) -> tuple[float, float]:
    truth = spot_truth(rig.at(Stroke(stroke_m).offset_m(position)), spot, ())
    return truth.u_px, truth.v_px


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
