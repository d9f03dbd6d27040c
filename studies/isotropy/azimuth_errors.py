"""Error of D against azimuth for a baseline, upright or sideways: bound, scatter, bias, isotropy; tables, a drawing.

A pair is a spot in the views from both ends of a baseline, with the rig that the estimator knows. The baseline is
vertical (the rig lifted) or horizontal (the rig moved sideways).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import polars as pl
import scipy

from phibench.benchmark.scores.answer_errors import Rules
from phibench.benchmark.scores.intervals import Clusters, Estimate, deviation_of, estimates
from phibench.datasets.exposures.expected_electrons import expected_of_light
from phibench.datasets.frames.sensor_card import card_of
from phibench.datasets.read import Dataset, Sample
from phibench.estimator.geometry.reflection import image_of
from phibench.estimator.geometry.status import Status
from phibench.estimator.geometry.triangulate import depth_exact
from phibench.estimator.limits.position_bound import spot_limit
from phibench.estimator.spots.fit_raw import fit_law
from phibench.estimator.spots.gaussian_spot import SpotModel
from phibench.estimator.spots.raw_pixels import GaussLaw, noise_of, raw_electrons, spot_regions
from phibench.estimator.spots.spot_prediction import spot_blur
from phibench.render.optics.spot_layer import spot_layer
from phibench.render.sensor.camera_chain import Chain
from phibench.render.sensor.electrons import NoiseStream
from phibench.render.sensor.light import Light, Region
from phibench.render.sensor.settings import Sensor
from phibench.scenes.frames import Array, as_vector
from phibench.scenes.laser import Beam
from phibench.scenes.random_streams import generator
from phibench.scenes.rig import POSITIONS, Rig, View
from phibench.studies.framework import (
    Drawing,
    Finding,
    Row,
    canvas,
    ends_text,
    error_bars,
    finished_drawing,
    line_style,
    text_table,
)
from phibench.studies.misaligned_rigs import spot_of

_SIDE_PX = 11  # a board of 0.3 m at 2.5 m is 16 px high in the image: a larger square has its edges in the corners


@dataclass(frozen=True)
class BaselinePair:
    """A spot seen from both ends of a baseline.

    Parameters
    ----------
    rig : Rig
        What the estimator knows; its stroke axis is the direction of the baseline.
    point_m : shape (3,)
    lights : of the first and the second image
    uv_px : shape (2, 2), true pixels
    """

    name: str
    rig: Rig
    baseline_m: float
    point_m: Array
    lights: tuple[Light, Light] = field(repr=False)
    uv_px: Array

    @property
    def depth_m(self) -> float:
        """D, from the vertical through the sphere at the first position."""
        return float(np.hypot(*(self.point_m - self.rig.at(0.0).sphere_centre_m)[:2]))

    @property
    def azimuth_deg(self) -> float:
        """Azimuth of the spot seen from there, 0 to 360."""
        x, y = (self.point_m - self.rig.at(0.0).sphere_centre_m)[:2]
        return math.degrees(math.atan2(y, x)) % 360.0


def sideways_rig(rig: Rig) -> Rig:
    """The rig with its baseline along world x."""
    return replace(rig, stroke_axis_world=(1.0, 0.0, 0.0))


def pairs_of(dataset: Dataset) -> Iterator[BaselinePair]:
    """Visible pairs of a data set; the baseline is what its true rig moves by, known to the estimator."""
    for sample in dataset:
        if sample.row.down.visible and sample.row.up.visible:
            yield _pair(sample)


def _pair(sample: Sample) -> BaselinePair:
    centres = [sample.view(position).camera_centre_m for position in POSITIONS]
    along = centres[1] - centres[0]
    length = float(np.linalg.norm(along))
    rig = replace(sample.nominal_rig, stroke_axis_world=as_vector(along / length))
    lights = tuple(
        Light(sample.ambient(position), sample.spot(position), f_number=rig.camera.f_number) for position in POSITIONS
    )
    places = [(sample.truth_row(position).u_px, sample.truth_row(position).v_px) for position in POSITIONS]
    return BaselinePair(
        sample.row.sample_id, rig, length, np.array(sample.row.spot_world_m), (lights[0], lights[1]), np.array(places)
    )


def flat_pair(rig: Rig, baseline_m: float, point_m: Array, background_electrons_per_s: Array) -> BaselinePair | None:
    """Pair rendered without a room, on an even background; None where an image does not show the spot."""
    views = (rig.at(0.0), rig.at(baseline_m))
    uv = np.array([image_of(view, point_m).uv_px for view in views])
    if not np.all(rig.camera.contains(uv)):
        return None  # one of the cameras does not see it
    lights = [_flat(view, point_m, background_electrons_per_s) for view in views]
    return BaselinePair("flat", rig, baseline_m, point_m, (lights[0], lights[1]), uv)


def _flat(view: View, point_m: Array, background: Array) -> Light:
    camera = view.rig.camera
    levels = (float(background[0]), float(background[1]), float(background[2]))
    light = Light.flat(levels, (camera.height_px, camera.width_px))
    return replace(light, spot=spot_layer(view, spot_of(point_m), ()), f_number=camera.f_number)


def bound_m(pair: BaselinePair, sensor: Sensor) -> float:
    """Least standard deviation of D from the noise of both frames; nothing else is unknown of the rig."""
    C = [
        spot_limit(expected_of_light(light, sensor, pair.rig.camera), card_of(sensor)).covariance_px2
        for light in pair.lights
    ]
    return float(depth_exact(pair.rig, pair.baseline_m, *pair.uv_px, *C).sigma_m)


def errors_m(pair: BaselinePair, sensor: Sensor, draws: int, *names: str) -> Array:
    """Estimate minus D, shape (draws,), by likelihood fits to raw frames; NaN where a fit fails.

    Every draw is of another camera, as the bound counts the fixed pattern as noise.
    """
    uv = fitted_px(pair, sensor, draws, *names)
    return np.asarray(depth_exact(pair.rig, pair.baseline_m, uv[0], uv[1]).depth_m - pair.depth_m)


def fitted_px(pair: BaselinePair, sensor: Sensor, draws: int, *names: str) -> Array:
    """Pixels that likelihood fits find in raw frames of both images, shape (2, draws, 2); NaN where a fit fails."""
    return np.stack([_fitted(pair, i, sensor, draws, names) for i in range(2)])


def _fitted(pair: BaselinePair, i: int, sensor: Sensor, draws: int, names: tuple[str, ...]) -> Array:
    """Pixels (draws, 2) found in one image."""
    light, card, (u, v) = pair.lights[i], card_of(sensor), pair.uv_px[i]
    region = Region.around(u, v, light.size, _SIDE_PX)
    dn = np.stack(
        [
            Chain(sensor, k, pair.rig.camera).frame(light, NoiseStream((*names, pair.name, i, k)), region)
            for k in range(draws)
        ]
    )
    x, blur = raw_electrons(dn, card), spot_blur(pair.rig, (u, v), pair.depth_m, Beam())
    r, g, b = pair.rig.camera.detector.laser_filter_response
    regions = spot_regions(x, (region.u0_px, region.v0_px), x < card.full_from_e)
    fit = fit_law(regions, GaussLaw(noise_of(card)), blur, SpotModel((r, g, b)))
    return np.where((fit.status == Status.OK)[:, None], fit.uv_px, np.nan)


_LEAST_GROUPS, _LEAST_ERRORS = 2, 3  # for a deviation with an interval
_PHASES = 4  # per axis, over the two pixels of a Bayer cell
_STREAM = ("study", "isotropy")


@dataclass(frozen=True)
class AzimuthNoise:
    """One spot.

    Attributes
    ----------
    scatter_m : Estimate
        Standard deviation about the mean, with its interval over draws.
    bias_m, bias_sigma_m : float
        Mean error and its standard error.
    errors_m : shape (draws,), those that were found
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
        """There were azimuths enough for a test."""
        return math.isfinite(self.p_value) and math.isfinite(self.p_value_over_bound)


def azimuth_noise(pair: BaselinePair, sensor: Sensor, draws: int, baseline: str, rules: Rules) -> AzimuthNoise:
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
    scatter = [at_azimuth.scatter_m.value for at_azimuth in noise if at_azimuth.errors_m.size > 1]
    ratio = max(scatter) / min(scatter) if scatter else math.nan
    plain, scaled = (
        [at_azimuth.errors_m for at_azimuth in noise],
        [at_azimuth.errors_m / at_azimuth.bound_m for at_azimuth in noise],
    )
    return Isotropy(_equal_scatter(plain), _equal_scatter(scaled), false_alarm, ratio)


def _equal_scatter(groups: Sequence[Array]) -> float:
    """Probability of scatter that differs by more; NaN with fewer than two groups of three."""
    if len(groups) < _LEAST_GROUPS or min(map(len, groups)) < _LEAST_ERRORS:
        return math.nan
    return float(scipy.stats.levene(*groups, center="median").pvalue)


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


# -- what comes of it --------------------------------------------------------------------------------------------------

NORMAL_95 = 1.96
"""Standard errors on both sides of an interval of 95 %."""
_LEAST_P = 1e-9  # smaller ones say no more


def scatter_findings(name: str, noise: Sequence[AzimuthNoise], test: Isotropy) -> Iterator[Finding]:
    """Smallest and largest scatter of one baseline, and the tests of isotropy; none with too few azimuths."""
    for word, pick in (("smallest", min), ("largest", max)):
        azimuth = pick(noise, key=lambda each: each.scatter_m.value)
        yield Finding.ranged(f"{name}: {word} scatter of D", azimuth.scatter_m.ends, "mm", 1e3)
        yield Finding(f"{name}: azimuth of the {word} scatter", azimuth.azimuth_deg, unit="deg")
    yield Finding(f"{name}: D", noise[0].depth_m, unit="m")
    if test.tested:
        yield Finding(f"{name}: largest over smallest scatter", test.ratio)
        for word, p in (
            ("the same scatter", test.p_value),
            ("the same multiple of the bound", test.p_value_over_bound),
        ):
            yield Finding(f"{name}: p of {word} at all azimuths", max(p, _LEAST_P)).judged(">=", test.false_alarm)


def bias_findings(name: str, noise: Sequence[AzimuthNoise]) -> Iterator[Finding]:
    """Largest systematic error of the likelihood fits; none with too few estimates."""
    usable = [one for one in noise if one.errors_m.size > 1]
    if usable:
        worst = max(usable, key=lambda one: abs(one.bias_m))
        value, half = 1e3 * abs(worst.bias_m), 1e3 * NORMAL_95 * worst.bias_sigma_m
        yield Finding(f"{name}: largest mean error", value, value - half, value + half, "mm")
        yield Finding(f"{name}: largest mean error over the scatter there", abs(worst.bias_m) / worst.scatter_m.value)
        yield Finding(f"{name}: azimuth of the largest mean error", worst.azimuth_deg, unit="deg")


def noise_table(noise: Mapping[str, Sequence[AzimuthNoise]]) -> pl.DataFrame:
    """A row per baseline and spot."""
    return pl.DataFrame(
        [
            {
                "baseline": name,
                "azimuth_deg": row.azimuth_deg,
                "depth_m": row.depth_m,
                "bound_m": row.bound_m,
                "scatter_m": row.scatter_m.value,
                "scatter_low_m": row.scatter_m.low,
                "scatter_high_m": row.scatter_m.high,
                "bias_m": row.bias_m,
                "bias_sigma_m": row.bias_sigma_m,
                "draws": len(row.errors_m),
                "missing": row.missing,
            }
            for name, rows in noise.items()
            for row in rows
        ]
    )


def noise_rows(noise: Mapping[str, Sequence[AzimuthNoise]]) -> tuple[Row, ...]:
    """Table: scatter, interval, bound and bias per baseline and azimuth."""
    return text_table(
        ((name, row) for name, rows in noise.items() for row in rows),
        {
            "baseline": lambda spot: spot[0],
            "azimuth, degrees": lambda spot: f"{spot[1].azimuth_deg:.0f}",
            "bound, mm": lambda spot: f"{1e3 * spot[1].bound_m:.2f}",
            "scatter, mm (95 %)": lambda spot: ends_text(spot[1].scatter_m.ends, ".2f", 1e3),
            "bias, mm": lambda spot: f"{1e3 * spot[1].bias_m:+.2f} +- {1e3 * spot[1].bias_sigma_m:.2f}",
            "fits missing": lambda spot: str(spot[1].missing),
        },
    )


def noise_drawing(curves: Mapping[str, tuple[Array, Array]], noise: Mapping[str, Sequence[AzimuthNoise]]) -> Drawing:
    """Standard deviation of D against azimuth: bounds on an even background as lines, measured in the room as marks."""
    with canvas(9.0, 4.2) as figure:
        ax = figure.subplots()
        for i, (name, (azimuths, bound)) in enumerate(curves.items()):
            style = {**line_style(i), "marker": ""}
            ax.plot(azimuths, 1e3 * bound, label=f"{name}, bound", **style)
            if name not in noise:
                continue
            rows = noise[name]
            ends = 1e3 * np.array([row.scatter_m.ends for row in rows])
            places = [row.azimuth_deg for row in rows]
            marks = {**line_style(i), "linestyle": "none", "markersize": 4}
            ax.errorbar(places, ends[:, 0], error_bars(ends), label=f"{name}, measured", capsize=3, **marks)
        ax.set_yscale("log")
        ax.set(xlabel="azimuth of the spot, degrees (the horizontal baseline lies at 0 and 180)")
        ax.set(ylabel="standard deviation of D, mm")
        ax.set_xticks(range(0, 361, 45))
        figure.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=8)
        parts = "; ".join(f"{name} {_range(rows)} mm" for name, rows in noise.items())
        return finished_drawing(
            "noise", figure, f"Standard deviation of D against the azimuth of the spot, measured: {parts}."
        )


def _range(rows: Sequence[AzimuthNoise]) -> str:
    values = [1e3 * row.scatter_m.value for row in rows]
    return f"{min(values):.2g} to {max(values):.2g}"
