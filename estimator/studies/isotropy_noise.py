"""Error of D against azimuth for one baseline: bound, measured scatter and bias, and a test of isotropy."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import stats

from phibench.estimator.bench.bootstrap import Clusters, Estimate, deviation_of, estimates
from phibench.estimator.bench.rules import Rules
from phibench.estimator.studies.baselines import Pair, bound_m, errors_m, flat_pair
from phibench.render.sensor import Sensor
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig
from phibench.scenes.streams import generator

_LEAST_GROUPS, _LEAST_ERRORS = 2, 3
_PHASES = 4  # per axis, over the two pixels of a Bayer cell
_STREAM = ("study", "isotropy")


@dataclass(frozen=True)
class AzimuthNoise:
    """One spot.

    Attributes
    ----------
    azimuth_deg, depth_m : float
    bound_m : float
    scatter_m : Estimate
        Standard deviation about the mean, with its interval over draws.
    bias_m, bias_sigma_m : float
        Mean error and its standard error.
    errors_m : shape (draws,), those that were found
    missing : int
    """

    azimuth_deg: float
    depth_m: float
    bound_m: float
    scatter_m: Estimate
    bias_m: float
    bias_sigma_m: float
    errors_m: Array = field(repr=False)
    missing: int


@dataclass(frozen=True)
class Isotropy:
    """Test of equal scatter at all azimuths (M. B. Brown, A. B. Forsythe, J. Am. Stat. Assoc. 69, 364, 1974).

    Attributes
    ----------
    p_value : float
        Of the errors: small where their scatter depends on the azimuth; NaN with too few azimuths.
    p_value_over_bound : float
        Of the errors over each spot's own bound.
    false_alarm : float
        Probability, in each test, of "not isotropic" where the scatter is the same.
    ratio : float
        Largest over smallest scatter, of spots with two errors or more; NaN if there is none.
    """

    p_value: float
    p_value_over_bound: float
    false_alarm: float
    ratio: float

    @property
    def tested(self) -> bool:
        """Whether there were azimuths enough for a test."""
        return math.isfinite(self.p_value) and math.isfinite(self.p_value_over_bound)

    @property
    def isotropic(self) -> bool:
        """Whether nothing speaks against equal scatter."""
        return self.p_value >= self.false_alarm

    @property
    def explained(self) -> bool:
        """Whether nothing speaks against a scatter that follows the bound."""
        return self.p_value_over_bound >= self.false_alarm


def azimuth_noise(pair: Pair, sensor: Sensor, draws: int, baseline: str, rules: Rules) -> AzimuthNoise:
    """Draw frames of a pair, estimate, and compare with the bound."""
    all_errors = errors_m(pair, sensor, draws, *_STREAM, baseline)
    errors = all_errors[np.isfinite(all_errors)]
    rng = generator(*_STREAM, baseline, pair.name, "bootstrap")
    draws_of = Clusters(np.arange(len(errors)), len(errors))
    scatter = estimates([deviation_of(draws_of, errors)], len(errors), rules, rng)[0]
    return AzimuthNoise(
        pair.azimuth_deg,
        pair.depth_m,
        bound_m(pair, sensor),
        scatter,
        float(errors.mean()) if errors.size else math.nan,
        float(errors.std(ddof=1) / math.sqrt(errors.size)) if errors.size > 1 else math.nan,
        errors,
        draws - errors.size,
    )


def isotropy(noise: Sequence[AzimuthNoise], false_alarm: float) -> Isotropy:
    """Test whether the scatter is the same at all azimuths, and whether it is relative to each spot's bound."""
    scatter = [one.scatter_m.value for one in noise if one.errors_m.size > 1]
    ratio = max(scatter) / min(scatter) if scatter else math.nan
    plain, scaled = ([one.errors_m for one in noise], [one.errors_m / one.bound_m for one in noise])
    return Isotropy(_equal_scatter(plain), _equal_scatter(scaled), false_alarm, ratio)


def _equal_scatter(groups: Sequence[Array]) -> float:
    """Probability of scatter that differs by more; NaN with fewer than two groups of three."""
    if len(groups) < _LEAST_GROUPS or min(map(len, groups)) < _LEAST_ERRORS:
        return math.nan
    return float(stats.levene(*groups, center="median").pvalue)


def bounds(rig: Rig, baseline_m: float, points_m: Array, background: Array, sensor: Sensor) -> Array:
    """Bound of D for spots at points (n, 3) on an even background, shape (n,); NaN where a spot is not seen."""
    pairs = [flat_pair(rig, baseline_m, point, background) for point in points_m]
    return np.array([math.nan if pair is None else bound_m(pair, sensor) for pair in pairs])


def bounds_over_grid(rig: Rig, baseline_m: float, points_m: Array, background: Array, sensor: Sensor) -> Array:
    """Root of the mean squared bound over places of the images in a 2 x 2 cell of the mosaic, shape (n,).

    The principal point moves by half pixels: both images move alike, as they do from one unit of a camera to the next.
    """
    steps = np.arange(_PHASES) * (2.0 / _PHASES)
    squares = []
    for du in steps:
        for dv in steps:
            camera = replace(rig.camera, cx_px=rig.camera.cx_px + float(du), cy_px=rig.camera.cy_px + float(dv))
            squares.append(bounds(replace(rig, camera=camera), baseline_m, points_m, background, sensor) ** 2)
    return np.sqrt(np.mean(squares, axis=0))


def circle(depth_m: float, height_m: float, count: int) -> Array:
    """Points around the robot, shape (count, 3), starting half a step from world x."""
    turn = (np.arange(count) + 0.5) * (2.0 * math.pi / count)
    return np.stack([depth_m * np.cos(turn), depth_m * np.sin(turn), np.full(count, height_m)], axis=-1)
