"""Bayesian model of why the paper's published depths are off: explanations, priors, likelihood, simulation.

The reading noise is Gaussian in the radius in the image. The inverse of an estimate is nearly linear in it, which
`brute_force` measures. So the density of a published value is a Gaussian in 1/D times the Jacobian 1/D^2. Two errors
add to it: the printed estimate is rounded (uniform, taken as a Gaussian of the same variance), and the paper's real
depth of a target is measured (common to all experiments with that target). Simulation linearises nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
import scipy
from numpy.typing import NDArray
from pydantic import Field
from scipy.special import gammaln, ndtri

from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig
from phibench.studies.cause.paper_reading import (
    AZIMUTHS,
    Convention,
    Experiments,
    PaperReading,
    Parameters,
    Reader,
    inverse_depth,
    radii_px,
    read_depths,
)
from phibench.studies.framework import Settings

NOISE = "noise_px"
WHOLE_PIXEL_PX = 12.0**-0.5  # standard deviation of what rounding to whole pixels takes away
GROUPS: dict[str, tuple[str, ...]] = {
    "misalignment": ("decentre_x_m", "tilt_y_rad"),
    "turn": ("pitch_rad",),
    "stroke": ("stroke_relative", "stroke_offset_m"),
    "scale": ("focal_relative", "axial_m", "radius_m"),
}
"""Parameters that an explanation can leave free besides lens distance, spot heights and noise.

World x is the direction of the tilt (of the turn), so that its size is not negative and the other component is 0; the
decentre has its component along it alone. Then a spot and its mirror image about that direction are seen alike, and
azimuths run from 0 to pi. Without these choices the posterior has some sixteen equal modes, of which nested sampling
loses some. The missing component is a restriction of the prior, not a small effect: the spot's azimuth decides which of
the two counts. With it azimuths would have to run from -pi to pi.
"""
_DIRECTED = ("misalignment", "turn")  # their effect depends on the spot's azimuth
COMMON = ("z_c_m", "height_1_m", "height_2_m", "height_3_m", "height_4_m")
FREEDOM = 4.0  # of Student's t where noise has heavy tails
_STUDENT_TOP = float(gammaln((FREEDOM + 1.0) / 2.0) - gammaln(FREEDOM / 2.0) - 0.5 * np.log(np.pi * FREEDOM))
_IMPOSSIBLE = -1e300  # a finite number, as samplers want it


class Prior(Settings):
    """Prior of one parameter: exactly one of the four."""

    normal: list[float] | None = Field(default=None, min_length=2, max_length=2, description="mean, sigma")
    uniform: list[float] | None = Field(default=None, min_length=2, max_length=2, description="low, high")
    log_uniform: list[float] | None = Field(default=None, min_length=2, max_length=2, description="low, high; above 0")

    rayleigh: float | None = Field(default=None, gt=0.0, description="sigma of each component of a vector: its length")

    @property
    def fault(self) -> str:
        """Fault in a few words, "" if there is none."""
        given = [name for name in ("normal", "uniform", "log_uniform", "rayleigh") if getattr(self, name) is not None]
        if len(given) != 1:
            return "must have exactly one of normal, uniform, log_uniform, rayleigh"
        if self.rayleigh is not None:
            return ""  # its one number is checked by its field
        low, high = getattr(self, given[0])
        if given[0] == "normal":
            return "" if high > 0.0 else f"normal = [{low:g}, {high:g}]: the sigma must be above 0"
        lowest = 0.0 if given[0] == "log_uniform" else -np.inf
        return "" if lowest < low < high else f"{given[0]} = [{low:g}, {high:g}]: must be {lowest:g} < low < high"

    def scaled(self, by: float) -> Prior:
        """The same with sigma so many times as large; uniform priors have no scale to change."""
        if self.rayleigh is not None:
            return Prior(rayleigh=self.rayleigh * by)
        return self if self.normal is None else Prior(normal=[self.normal[0], self.normal[1] * by])

    def of_share(self, share: Array) -> Array:
        """Quantiles of shares in (0, 1)."""
        if self.rayleigh is not None:
            return np.asarray(self.rayleigh * np.sqrt(-2.0 * np.log1p(-share)))
        if self.normal is not None:
            return np.asarray(self.normal[0] + self.normal[1] * ndtri(share))
        low, high = self.uniform or [np.log(x) for x in self.log_uniform or ()]
        value = low + (high - low) * share
        return np.asarray(value if self.uniform else np.exp(value))


class Explanation(Settings):
    """One explanation of the published estimates."""

    name: str = Field(pattern="^[a-z0-9_]+$", max_length=60)
    text: str = Field(description="in a few words, for tables")
    convention: Convention = "ray"
    equation: Literal[4, 5] = 4
    centred: bool = Field(default=False, description="radii count from the image of the sphere")
    free: list[Literal["misalignment", "turn", "stroke", "scale"]] = Field(default=[])
    noise: Literal["free", "whole pixels"] = "free"
    shared_down: bool = Field(default=False, description="one down image for all strokes with a target")
    tails: Literal["normal", "student"] = "normal"
    priors: dict[str, Prior] = Field(default={}, description="in place of the study's")

    @property
    def reader(self) -> Reader:
        """Reader of its pixels."""
        return Reader(self.convention, self.equation, self.centred)

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of what is free."""
        noise = (NOISE,) if self.noise == "free" else ()
        azimuths = AZIMUTHS if set(self.free) & set(_DIRECTED) else ()
        groups = (name for group in GROUPS if group in self.free for name in GROUPS[group])
        return (*noise, *COMMON, *azimuths, *groups)


@dataclass(frozen=True)
class DepthModel:
    """An explanation with priors, data and the nominal rig: what a sampler needs.

    Parameters
    ----------
    priors : Prior by parameter
    rig : Rig
        Focal length and mirror that the paper's user takes as nominal.
    depth_sigma_m : float
        Of the paper's real depth of a target.
    """

    explanation: Explanation
    priors: Mapping[str, Prior]
    experiments: Experiments
    rig: Rig
    depth_sigma_m: float

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Free parameters, in the order of points."""
        return self.explanation.parameters

    @cached_property
    def _chosen(self) -> tuple[Prior, ...]:
        return tuple(self.priors[name] for name in self.names)

    @cached_property
    def _same_target(self) -> Array:
        return self.experiments.same_target.astype(float)

    def point(self, shares: Array) -> Array:
        """Parameters, shape (..., d), from the unit cube."""
        return np.stack([prior.of_share(shares[..., i]) for i, prior in enumerate(self._chosen)], axis=-1)

    def named(self, points: Array) -> dict[str, Array]:
        """Parameters by name for `read_depths`: scalars of a point (d,), columns (m, 1) of points (m, d)."""
        return dict(zip(self.names, points if points.ndim == 1 else points.T[..., None], strict=True))

    def noise_px(self, named: Parameters) -> Array:
        """Sigma of the reading noise."""
        return named.get(NOISE, np.asarray(WHOLE_PIXEL_PX))

    def reading(self, points: Array) -> PaperReading:
        """Noise-free estimates, shape (..., n)."""
        return read_depths(self.named(points), self.experiments, self.explanation.reader, self.rig)

    def log_likelihood(self, point: Array) -> float:
        """Log density of the published estimates, per metre each, at one point, shape (d,)."""
        value = float(self.log_likelihoods(point))
        return value if np.isfinite(value) else _IMPOSSIBLE

    def log_likelihoods(self, points: Array) -> Array:
        """Log densities at points, shape (..., d); not finite where a rig shows no spot."""
        with np.errstate(all="ignore"):
            reading = self.reading(points)
            residual = 1.0 / self.experiments.estimate_m - reading.inverse_depth_per_m
            jacobian = -2.0 * np.sum(np.log(self.experiments.estimate_m))
            if self.explanation.tails == "student":
                return np.asarray(self._student(residual, reading, points) + jacobian)
            if not np.isfinite(reading.by_down).all():
                return self._one_by_one(points)
            own, common = self._variances(reading, points)
            if self.explanation.shared_down:
                return np.asarray(_normal(residual, self.covariance(reading, points)) + jacobian)
            return np.asarray(_normal_in_groups(residual, own, common, self._targets) + jacobian)

    def covariance(self, reading: PaperReading, points: Array) -> Array:
        """Covariance of the inverse estimates, shape (..., n, n), in m^-2."""
        own, common = self._variances(reading, points)
        if self.explanation.shared_down:
            common = [*common, self.noise_px(self.named(points)) * reading.by_down]
        result = sum((_outer(effect) for effect in common), np.zeros(())) * self._same_target
        diagonal = np.arange(len(self.experiments))
        result[..., diagonal, diagonal] += own
        return np.asarray(result)

    def _variances(self, reading: PaperReading, points: Array) -> tuple[Array, list[Array]]:
        """Variances of each inverse estimate by itself, and effects that all estimates of a target share."""
        noise, square = self.noise_px(self.named(points)), reading.inverse_depth_per_m * reading.inverse_depth_per_m
        seen = reading.by_up * reading.by_up
        if not self.explanation.shared_down:
            seen = seen + reading.by_down * reading.by_down
        own = self._rounding_m2 * square * square + noise * noise * seen
        return own, [self.depth_sigma_m * square]  # d(1/D) of an error of D

    @cached_property
    def _rounding_m2(self) -> Array:
        return self.experiments.rounding_m**2 / 12.0  # printed digits: an error uniform over the last one

    @cached_property
    def _targets(self) -> NDArray[np.int64]:
        """First experiment of every target; those of one target follow each other."""
        changes = np.diagonal(self.experiments.same_target, 1)
        return np.concatenate([[0], np.flatnonzero(~changes) + 1])

    def _student(self, residual: Array, reading: PaperReading, points: Array) -> Array:
        """Independent Student t of 4 degrees of freedom with the scale of the Gaussian."""
        scale = np.sqrt(np.diagonal(self.covariance(reading, points), axis1=-2, axis2=-1))
        heavy = 0.5 * (FREEDOM + 1.0) * np.log1p((residual / scale) ** 2 / FREEDOM)
        return np.asarray(np.sum(_STUDENT_TOP - heavy - np.log(scale), axis=-1))

    def _one_by_one(self, points: Array) -> Array:
        """Points of which some show no spot."""
        if points.ndim == 1:
            return np.asarray(-np.inf)
        return np.array([self.log_likelihood(point) for point in points])


def standardised_residuals(model: DepthModel, points: Array, independent: bool = False) -> Array:
    """Residuals made independent with unit variance, shape (..., n).

    By the Cholesky factor of their covariance, or by their own deviations where they count as independent.
    """
    reading = model.reading(points)
    residual = 1.0 / model.experiments.estimate_m - reading.inverse_depth_per_m
    covariance = model.covariance(reading, points)
    if independent:
        return np.asarray(residual / np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1)))
    factor = np.linalg.cholesky(covariance)
    return np.asarray(np.linalg.solve(factor, residual[..., None])[..., 0])


def without_table(model: DepthModel, table: int) -> tuple[DepthModel, NDArray[np.bool_]]:
    """The model on the other three tables, and the mask of the experiments that are left out."""
    out = model.experiments.table == table
    chosen = model.experiments.chosen(~out)
    return DepthModel(model.explanation, model.priors, chosen, model.rig, model.depth_sigma_m), out


def _normal(residual: Array, covariance: Array) -> Array:
    factor = np.linalg.cholesky(covariance)
    z = np.linalg.solve(factor, residual[..., None])[..., 0]
    log_root = np.sum(np.log(np.diagonal(factor, axis1=-2, axis2=-1)), axis=-1)
    return np.asarray(-0.5 * np.sum(z * z, axis=-1) - log_root - 0.5 * residual.shape[-1] * np.log(2.0 * np.pi))


def _normal_in_groups(residual: Array, own: Array, common: list[Array], starts: NDArray[np.int64]) -> Array:
    """Log density of a normal with covariance diag(own) + v v^T within each group (Sherman and Morrison)."""
    (v,), weight = common, 1.0 / own
    inner, size = (np.add.reduceat(x, starts, axis=-1) for x in (residual * v * weight, v * v * weight))
    square = np.sum(residual * residual * weight, axis=-1) - np.sum(inner * inner / (1.0 + size), axis=-1)
    log_det = np.sum(np.log(own), axis=-1) + np.sum(np.log1p(size), axis=-1)
    return np.asarray(-0.5 * (square + log_det + residual.shape[-1] * np.log(2.0 * np.pi)))


def _outer(vector: Array) -> Array:
    return vector[..., :, None] * vector[..., None, :]


def simulate(
    model: DepthModel, points: Array, random: np.random.Generator, experiments: Experiments | None = None
) -> Array:
    """Printed estimates of as many worlds as there are points, shape (m, n), metres.

    Parameters as for `unrounded_estimates`.
    """
    step = (experiments or model.experiments).rounding_m
    return np.asarray(np.round(unrounded_estimates(model, points, random, experiments) / step) * step)


def unrounded_estimates(
    model: DepthModel, points: Array, random: np.random.Generator, experiments: Experiments | None = None
) -> Array:
    """Estimates of as many worlds as there are points, before they are printed, shape (m, n), metres.

    Parameters
    ----------
    model : DepthModel
    points : shape (m, d)
    random : Generator
    experiments : Experiments, optional
        Others than the model's.
    """
    asked = experiments or model.experiments
    first = np.argmax(asked.same_target, axis=1)  # the first experiment with the same target
    size = (len(points), len(asked))
    measured = random.normal(scale=model.depth_sigma_m, size=size)[:, first]
    true = replace(asked, depth_m=asked.depth_m + measured)
    named, reader = model.named(points), model.explanation.reader
    down, up = radii_px(named, true, reader, model.rig)
    errors = _reading_errors(model, points, random, size)
    if model.explanation.shared_down:
        errors[0] = errors[0][:, first]
    return np.asarray(1.0 / inverse_depth(named, asked, reader, model.rig, down + errors[0], up + errors[1]))


def brute_force(model: DepthModel, point: Array, random: np.random.Generator, draws: int) -> tuple[Array, Array]:
    """Log density of each published estimate, by simulation and by the likelihood, shape (n,) each.

    The simulated density is a kernel estimate in 1/D of `draws` worlds with the same parameters. The probability of a
    printed value over its step is the density of estimate plus a uniform error of one step, there.
    """
    worlds = unrounded_estimates(model, np.repeat(point[None], draws, axis=0), random)
    worlds = 1.0 / (worlds + model.experiments.rounding_m * random.uniform(-0.5, 0.5, size=worlds.shape))
    seen = 1.0 / model.experiments.estimate_m
    simulated = np.array(
        [scipy.stats.gaussian_kde(worlds[:, i][np.isfinite(worlds[:, i])]).logpdf(y)[0] for i, y in enumerate(seen)]
    )
    reading = model.reading(point)
    variance = np.diagonal(model.covariance(reading, point))
    residual = seen - reading.inverse_depth_per_m
    linear = -0.5 * residual**2 / variance - 0.5 * np.log(2.0 * np.pi * variance)
    jacobian = -2.0 * np.log(model.experiments.estimate_m)
    return simulated + jacobian, linear + jacobian


def _reading_errors(model: DepthModel, points: Array, random: np.random.Generator, size: tuple[int, int]) -> Array:
    """Errors of the radii in both images, shape (2, m, n), pixels."""
    if model.explanation.noise == "free":
        return np.asarray(model.noise_px(model.named(points)) * random.normal(size=(2, *size)))
    # rounding u and v to whole pixels, with unknown phase and unknown azimuth of the image
    azimuth = random.uniform(0.0, 2.0 * np.pi, size=(2, *size))
    du, dv = random.uniform(-0.5, 0.5, size=(2, 2, *size))
    return np.asarray(np.cos(azimuth) * du + np.sin(azimuth) * dv)
