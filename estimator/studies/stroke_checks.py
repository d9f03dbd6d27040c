"""Frames of a spot at a distance and a stroke, taken by rigs that are not what is believed, and the error of D.

The spot's light is rendered for every rig; the wall behind it is flat light, as strong as the lab's.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from multiprocessing import get_context

import numpy as np

from phibench.datasets.progress import Steps
from phibench.estimator.bench.bootstrap import Clusters, estimates, rms_of
from phibench.estimator.bench.rules import Rules
from phibench.estimator.best_stroke import ROOM_E_PER_S
from phibench.estimator.calibration.parameters import PARAMETERS, changed, stroke_of
from phibench.estimator.depth_general import depth_general
from phibench.estimator.methods.registry import METHODS
from phibench.estimator.rig_draws import covariance_root
from phibench.estimator.studies.cut import Shot, SpotPair, cut_region, cut_rig, taken, without_off
from phibench.estimator.studies.material import Material
from phibench.render.sensor import sensor
from phibench.render.spot_truth import spot_truth
from phibench.scenes.frames import Array
from phibench.scenes.laser import LaserSpot, beam_diameter_m
from phibench.scenes.rig import POSITIONS, Rig, Stroke
from phibench.scenes.room import Room
from phibench.scenes.streams import Name, generator

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
        for one in _results(checks, material.workers or os.cpu_count() or 1):
            found.append(one)
            steps.advance()
    return found


def _results(checks: Sequence[Check], workers: int) -> Iterator[Checked]:
    if workers == 1 or len(checks) == 1:
        yield from map(measured, checks)
        return
    # spawned, not forked: a fork copies the locks of other threads
    with ProcessPoolExecutor(min(workers, len(checks)), get_context("spawn")) as pool:
        yield from pool.map(measured, checks)


def measured(check: Check) -> Checked:
    """Draw and evaluate all frames of a check."""
    believed = Rig()
    answers = [_answer(check, believed, k) for k in range(check.draws)]
    found = [a for a in answers if a is not None]
    if not found:
        return Checked(check, ())
    true, down, up, C_down, C_up = (np.array(column) for column in zip(*found, strict=True))
    depth = depth_general(believed, check.stroke_m, down, up, C_down, C_up, np.array(check.covariance)).depth_m
    errors = depth - true
    return Checked(check, tuple(errors[np.isfinite(errors)].tolist()))


def _answer(check: Check, believed: Rig, draw: int) -> tuple[float, Array, Array, Array, Array] | None:
    """True D, positions in the whole image and claimed covariances of one draw; None if a spot is not found."""
    names = (*_NAMES, check.tolerance, f"{check.depth_m:.6f}", f"{check.stroke_m:.6f}", draw)
    values = deviations(np.array(check.covariance), (*_NAMES, check.tolerance, f"{check.depth_m:.6f}", draw))
    true, stroke_m = changed(believed, values), float(stroke_of(np.array(check.stroke_m), values))
    spot = _spot(check, believed, 2.0 * math.pi * (draw * _TURN % 1.0))
    uv = [_pixel(true, stroke_m, spot, p) for p in POSITIONS]
    camera = believed.camera
    region = cut_region(uv, (camera.height_px, camera.width_px), _MARGIN_PX)
    flat = np.broadcast_to(np.array(ROOM_E_PER_S)[:, None, None], (3, *region.shape))
    pair = SpotPair.of(cut_rig(true, region), stroke_m, spot, _ROOM, dict.fromkeys(POSITIONS, flat), str(draw))
    seen = taken(draw, Shot(sensor(check.preset)), pair, (cut_rig(believed, region), check.stroke_m), names, _BOX_PX)
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
