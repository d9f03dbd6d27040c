"""Estimates drawn from an explanation: noise in the pixels, errors of the real depth, rounding, nothing linearised."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.stats import gaussian_kde

from phibench.estimator.studies.cause_model import Model
from phibench.estimator.studies.paper_reading import Experiments, inverse_depth, radii_px
from phibench.scenes.frames import Array


def simulate(model: Model, points: Array, random: np.random.Generator, experiments: Experiments | None = None) -> Array:
    """Printed estimates of as many worlds as there are points, shape (m, n), metres.

    Parameters as for `unrounded`.
    """
    step = (experiments or model.experiments).rounding_m
    return np.asarray(np.round(unrounded(model, points, random, experiments) / step) * step)


def unrounded(
    model: Model, points: Array, random: np.random.Generator, experiments: Experiments | None = None
) -> Array:
    """Estimates of as many worlds as there are points, before they are printed, shape (m, n), metres.

    Parameters
    ----------
    model : Model
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


def brute_force(model: Model, point: Array, random: np.random.Generator, draws: int) -> tuple[Array, Array]:
    """Log density of each published estimate, by simulation and by the likelihood, shape (n,) each.

    The simulated density is a kernel estimate in 1/D of `draws` worlds with the same parameters. The probability of a
    printed value over its step is the density of estimate plus a uniform error of one step, there.
    """
    worlds = unrounded(model, np.repeat(point[None], draws, axis=0), random)
    worlds = 1.0 / (worlds + model.experiments.rounding_m * random.uniform(-0.5, 0.5, size=worlds.shape))
    seen = 1.0 / model.experiments.estimate_m
    simulated = np.array(
        [gaussian_kde(worlds[:, i][np.isfinite(worlds[:, i])]).logpdf(y)[0] for i, y in enumerate(seen)]
    )
    reading = model.reading(point)
    variance = np.diagonal(model.covariance(reading, point))
    residual = seen - reading.inverse_depth_per_m
    linear = -0.5 * residual**2 / variance - 0.5 * np.log(2.0 * np.pi * variance)
    jacobian = -2.0 * np.log(model.experiments.estimate_m)
    return simulated + jacobian, linear + jacobian


def _reading_errors(model: Model, points: Array, random: np.random.Generator, size: tuple[int, int]) -> Array:
    """Errors of the radii in both images, shape (2, m, n), pixels."""
    if model.explanation.noise == "free":
        return np.asarray(model.noise_px(model.named(points)) * random.normal(size=(2, *size)))
    # rounding u and v to whole pixels, with unknown phase and unknown azimuth of the image
    azimuth = random.uniform(0.0, 2.0 * np.pi, size=(2, *size))
    du, dv = random.uniform(-0.5, 0.5, size=(2, 2, *size))
    return np.asarray(np.cos(azimuth) * du + np.sin(azimuth) * dv)
