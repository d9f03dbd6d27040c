"""Frames of the study `stroke`, drawn for rigs other than the nominal one, and the findings of the study.

The spot's light is rendered for every rig; the wall behind it is flat light, as strong as the lab's. A check is one
distance, stroke and tolerance; its measured error of D is held against the predicted one.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from phibench.benchmark.scores.answer_errors import Rules
from phibench.benchmark.scores.intervals import Clusters, Estimate, estimates, rms_of
from phibench.estimator.geometry.least_squares_depth import depth_general
from phibench.estimator.geometry.reflection import image_of
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
from phibench.render.optics.truth import spot_truth
from phibench.render.sensor.settings import sensor
from phibench.scenes.frames import Array
from phibench.scenes.laser import LaserSpot, beam_diameter_m
from phibench.scenes.random_streams import Name, generator
from phibench.scenes.rig import POSITIONS, Rig, Stroke
from phibench.scenes.room import Room
from phibench.studies.framework import Finding, Row, ends_text, text_table
from phibench.studies.image_cutout import Shot, SpotPair, cut_region, cut_rig, drawn_pair, without_off

METHOD = {"bayer-raw": "raw_maximum_likelihood", "srgb8": "chain_fit", "mjpeg": "chain_fit"}
_NAMES: tuple[Name, ...] = ("study", "stroke")
_ROOM = Room("wall", ())  # the robot stands in it
_BOX_PX = 48  # of the search: the fit starts as it does with a hint
_MARGIN_PX = 32  # around it: what the chain's stages and JPEG's units look at
_TURN = 0.618033988749895  # golden: azimuths, and with them sub-pixel phases, never repeat


@dataclass(frozen=True)
class RenderedCheck:
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
class RenderedOutcome:
    """A check with what was measured.

    Attributes
    ----------
    check : Check
    errors_m : tuple of float
        D of the frames minus the true one, of the pairs in which both spots were found.
    """

    check: RenderedCheck
    errors_m: tuple[float, ...]

    @cached_property
    def rms_m(self) -> Estimate:
        """Root mean square error with its interval, by bootstrap: errors of rigs as built have long tails."""
        n = len(self.errors_m)
        rms = rms_of(Clusters(np.arange(n), n), np.square(self.errors_m))
        # ends good to some per cent
        return estimates([rms], n, Rules(resamples=999), generator(*_NAMES, "interval"))[0]

    @property
    def fits(self) -> bool:
        """The predicted error lies in the interval of the measured one."""
        return self.rms_m.low <= self.check.predicted_m <= self.rms_m.high


def measured(check: RenderedCheck) -> RenderedOutcome:
    """Draw and evaluate all frames of a check."""
    nominal = Rig()
    answers = [_answer(check, nominal, k) for k in range(check.draws)]
    given = [a for a in answers if a is not None]
    if not given:
        return RenderedOutcome(check, ())
    true, down, up, C_down, C_up = (np.array(column) for column in zip(*given, strict=True))
    depth = depth_general(nominal, check.stroke_m, down, up, C_down, C_up, np.array(check.covariance)).depth_m
    errors = depth - true
    return RenderedOutcome(check, tuple(errors[np.isfinite(errors)].tolist()))


def _answer(check: RenderedCheck, nominal: Rig, draw: int) -> tuple[float, Array, Array, Array, Array] | None:
    """True D, positions in the whole image and claimed covariances of one draw; None if a spot is not found."""
    names = (*_NAMES, check.tolerance, f"{check.depth_m:.6f}", f"{check.stroke_m:.6f}", draw)
    # named without the stroke: all strokes of a distance are compared on the same random rigs
    values = deviations(np.array(check.covariance), (*_NAMES, check.tolerance, f"{check.depth_m:.6f}", draw))
    true, stroke_m = changed(nominal, values), float(stroke_of(np.array(check.stroke_m), values))
    spot = _spot(check, nominal, 2.0 * math.pi * (draw * _TURN % 1.0))
    uv = [_pixel(true, stroke_m, spot, p) for p in POSITIONS]
    camera = nominal.camera
    region = cut_region(uv, (camera.height_px, camera.width_px), _MARGIN_PX)
    flat = np.broadcast_to(np.array(ROOM_E_PER_S)[:, None, None], (3, *region.shape))
    pair = SpotPair.of(cut_rig(true, region), stroke_m, spot, _ROOM, dict.fromkeys(POSITIONS, flat), str(draw))
    seen = drawn_pair(
        draw, Shot(sensor(check.preset)), pair, (cut_rig(nominal, region), check.stroke_m), names, _BOX_PX
    )
    answer = METHODS[METHOD[check.preset]](without_off(seen))
    spots = (answer.down, answer.up)
    if any(one.uv_px is None or one.covariance_px2 is None for one in spots):
        return None
    # the method saw the cutout alone: back to pixels of the whole image, for the uncut nominal rig
    corner = np.array([region.u0_px, region.v0_px], float)
    down, up = (np.array(one.uv_px) + corner for one in spots)
    C_down, C_up = (np.array(one.covariance_px2) for one in spots)
    return pair.depth_m, down, up, C_down, C_up


def deviations(covariance: Array, names: tuple[Name, ...]) -> Array:
    """Errors of the rig's parameters, shape (p,), normal with a covariance that may be singular."""
    return np.asarray(covariance_root(covariance) @ generator(*names, "rig").standard_normal(len(PARAMETERS)))


def _spot(check: RenderedCheck, rig: Rig, azimuth_rad: float) -> LaserSpot:
    axis = rig.at(0.0).sphere_centre_m
    away = np.array([math.cos(azimuth_rad), math.sin(azimuth_rad)])
    x, y = (axis[:2] + check.depth_m * away).tolist()
    place, normal, power_w = (x, y, check.height_m), (-away[0], -away[1], 0.0), 1e-3 * check.power_mw
    return LaserSpot(place, normal, beam_diameter_m(check.depth_m), power_w=power_w)


def _pixel(rig: Rig, stroke_m: float, spot: LaserSpot, position: str) -> tuple[float, float]:
    truth = spot_truth(rig.at(Stroke(stroke_m).offset_m(position)), spot, ())
    return truth.u_px, truth.v_px


# -- findings ------------------------------------------------------------------------------------------------------

GROWS = 1.05
"""An error grows again where that of the longest stroke is so many times the smallest."""
NEAR = 0.05  # of the smallest error: strokes within it are as good
Found = Mapping[tuple[str, float], BestStroke]


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
