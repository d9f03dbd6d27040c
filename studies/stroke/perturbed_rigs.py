"""Frames of the study `stroke`, drawn for rigs other than the nominal one, and the errors of D that they give.

The spot's light is rendered for every rig; the wall behind it is flat light, as strong as the lab's. A check is one
distance, stroke and tolerance; its measured error of D is held against the predicted one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from phibench.benchmark.scores.answer_errors import Rules
from phibench.benchmark.scores.intervals import Clusters, Estimate, estimates, rms_of
from phibench.estimator.geometry.least_squares_depth import depth_general
from phibench.estimator.geometry.rig_parameters import PARAMETERS, changed_rig, stroke_of
from phibench.estimator.limits.best_stroke import ROOM_E_PER_S
from phibench.estimator.limits.stroke_curve import covariance_root
from phibench.estimator.methods.registry import METHODS
from phibench.render.optics.truth import spot_truth
from phibench.render.sensor.settings import sensor
from phibench.scenes.frames import Array
from phibench.scenes.laser import LaserSpot, beam_diameter_m
from phibench.scenes.random_streams import Name, generator
from phibench.scenes.rig import POSITIONS, Rig, Stroke
from phibench.scenes.room import Room
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
    depth_m, stroke_m, factor : float
        The stroke is `factor` times the best.
    predicted_m : float
        Standard deviation of D.
    covariance : shape (p, p), of the rig's parameters; rows
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
    check : RenderedCheck
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


def measured_outcome(check: RenderedCheck) -> RenderedOutcome:
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
    true, stroke_m = changed_rig(nominal, values), float(stroke_of(np.array(check.stroke_m), values))
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
