"""Interactions of misalignments, as Sobol indices of the relative error of D.

I. M. Sobol, Math. Comput. Simul. 55, 271 (2001); estimators of A. Saltelli et al., Comput. Phys. Commun. 181, 259
(2010), as scipy has them. The parameters are uniform from minus to plus the study's magnitude, independent of each
other. First-order indices that sum to 1 mean errors that add; what is missing is interaction.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from phibench.benchmark.scores.intervals import percentile_interval
from phibench.datasets.common.errors import DatasetError
from phibench.estimator.geometry.sensitivities import PARAMETERS as ANALYTIC
from phibench.scenes.frames import Array
from phibench.scenes.misalignment import PARAMETERS, Misalignment
from phibench.scenes.rig import Rig
from phibench.studies.framework import Finding
from phibench.studies.misaligned_rigs import ALL, Places, errors, errors_of_many

_ADDITIVE = 0.9  # sum of the first-order indices from which errors add
OUTPUTS = (("error", 2), ("square", 1))
"""Outputs, and the power whose mean is the mean square error."""


@dataclass(frozen=True)
class Interactions:
    """Indices of one output.

    Attributes
    ----------
    output : "error" or "square"
    parameters : tuple of str
    indices, low, high : shape (2 p + 2,)
        First-order ones, total ones, the sum of the first-order ones, and the rms relative error over the draws, with
        the ends of 95 % intervals.
    """

    output: str
    depth_m: float
    parameters: tuple[str, ...]
    indices: Array
    low: Array
    high: Array

    @property
    def first(self) -> Array:
        """First-order indices, shape (p,)."""
        return self.indices[: len(self.parameters)]

    @property
    def total(self) -> Array:
        """Total indices, shape (p,)."""
        return self.indices[len(self.parameters) : -2]


def moving_parameters(
    nominal: Rig, places: Places, estimators: tuple[str, ...], parameters: Sequence[str] = ALL
) -> tuple[str, ...]:
    """Parameters of a spherical mirror that change any estimate at all, at the study's magnitude.

    Errors of form are left out: `errors_of_many` takes spheres.
    """
    aligned = errors(nominal, Misalignment(), places, estimators)
    return tuple(
        name
        for name in parameters
        if name in ANALYTIC
        and nominal.perturbed(usual := Misalignment(**{name: PARAMETERS[name].study})).sphere.form is None
        and np.max(np.abs(errors(nominal, usual, places, estimators) - aligned)) > 0.0
    )


def interactions(
    nominal: Rig,
    places: Places,
    estimator: str,
    n: int,
    resamples: int,
    rng: np.random.Generator,
    parameters: Sequence[str] = ALL,
) -> tuple[Interactions, ...]:
    """Indices for every D: of the relative error at the first azimuth, and of its square, averaged over azimuths.

    Parameters
    ----------
    nominal, places
        The first azimuth is the one of the signed error.
    n : int
        Base sample, a power of two; n (parameters + 2) rigs are computed.
    resamples : int
        Of the bootstrap.
    rng : Generator
    parameters : names; those that move no chief ray are left out

    Raises
    ------
    DatasetError
        If a drawn rig has no estimate.
    """
    names = moving_parameters(nominal, places, (estimator,), parameters)
    aligned = errors(nominal, Misalignment(), places, (estimator,))[0]

    size = np.array([PARAMETERS[name].study for name in names])
    for sign in (1.0, -1.0):  # the largest distortion must not fold the image: the many rigs are not checked
        nominal.perturbed(Misalignment(**dict(zip(names, (sign * size).tolist(), strict=True))))

    def model(unit: Array) -> Array:
        drawn = (2.0 * unit - 1.0) * size
        rigs = [Misalignment(**dict(zip(names, row.tolist(), strict=True))) for row in drawn]
        change = np.moveaxis(errors_of_many(nominal, rigs, places, (estimator,))[:, 0] - aligned, 0, -1)
        if lost := int(np.isnan(change).any(axis=(0, 1)).sum()):
            raise DatasetError(
                f"Sobol indices: {lost} of {len(unit)} drawn rigs lose a spot; take smaller depths_m in the settings"
            )
        return np.concatenate([change[:, 0], np.mean(change**2, axis=1)])

    values = evaluated_outputs(model, len(names), n, rng)
    labels = [(kind, power, float(D)) for kind, power in OUTPUTS for D in places.depths_m]
    powers = np.array([power for _, power, _ in labels])
    indices, low, high = with_intervals(values, powers, resamples, rng)
    return tuple(Interactions(kind, D, names, indices[i], low[i], high[i]) for i, (kind, _, D) in enumerate(labels))


@dataclass(frozen=True)
class Values:
    """Outputs at the points A and B, shape (s, n), and at A with one column of B, shape (p, s, n)."""

    A: Array
    B: Array
    AB: Array

    def taken(self, index: NDArray[np.int64]) -> Values:
        """Those points only."""
        return Values(self.A[:, index], self.B[:, index], self.AB[..., index])


def evaluated_outputs(model: Callable[[Array], Array], p: int, n: int, rng: np.random.Generator) -> Values:
    """Outputs of a model of p numbers, uniform from 0 to 1, shape (m, p), to (s, m)."""
    points = scipy.stats.qmc.Sobol(2 * p, rng=rng).random(n)
    A, B = points[:, :p], points[:, p:]
    mixed = [np.where(np.arange(p) == i, B, A) for i in range(p)]
    return Values(model(A), model(B), np.stack([model(each) for each in mixed]))


def with_intervals(
    values: Values, powers: Array, resamples: int, rng: np.random.Generator
) -> tuple[Array, Array, Array]:
    """`indices_of`, and the ends of 95 % intervals, in the same shape: points are drawn again.

    The bootstrap of scipy's own result takes no generator.
    """
    points = np.arange(values.A.shape[1])
    low, high = percentile_interval([points], lambda i: indices_of(values.taken(i), powers), resamples, rng)
    return indices_of(values, powers), low, high


def indices_of(values: Values, powers: Array) -> Array:
    """First-order, total, sum of first-order, root of the mean of output^power, shape (s, 2 p + 2)."""
    sobol = scipy.stats.sobol_indices(func={"f_A": values.A, "f_B": values.B, "f_AB": values.AB}, n=values.A.shape[1])
    first, total = np.atleast_2d(sobol.first_order), np.atleast_2d(sobol.total_order)
    both = np.concatenate([values.A, values.B], axis=1)
    rms = np.sqrt(np.mean(both ** powers[:, None], axis=1))
    return np.column_stack([first, total, first.sum(axis=1), rms])


def rows(found: Sequence[Interactions], estimator: str, places: Places) -> list[dict[str, Any]]:
    """One row per output, D and parameter."""
    return [
        {
            "estimator": estimator,
            "output": interaction.output,
            "depth_m": interaction.depth_m,
            "stroke_m": places.stroke_m,
            "parameter": name,
            **_cells("first", interaction, i),
            **_cells("total", interaction, i + len(interaction.parameters)),
            **_cells("first_sum", interaction, -2),
            **_cells("rms_relative", interaction, -1),
        }
        for interaction in found
        for i, name in enumerate(interaction.parameters)
    ]


def _cells(name: str, one: Interactions, i: int) -> dict[str, float]:
    low, high = float(one.low[i]), float(one.high[i])
    return {name: float(one.indices[i]), f"{name}_low": low, f"{name}_high": high}


def interaction_findings(found: Sequence[Interactions]) -> Iterator[Finding]:
    """All parameters drawn at once: rms change of D, sum of the first-order indices, largest total index."""
    signed = [interaction for interaction in found if interaction.output == "error"]
    for interaction in signed:
        together = (interaction.indices[-1], interaction.low[-1], interaction.high[-1])
        yield Finding.ranged(f"all drawn at once, rms change of D, D = {interaction.depth_m:g} m", together, "%", 100.0)
    for interaction in signed:
        first = (interaction.indices[-2], interaction.low[-2], interaction.high[-2])
        total = Finding.ranged(f"sum of the first-order Sobol indices, D = {interaction.depth_m:g} m", first)
        yield total.judged(">=", _ADDITIVE)
        rest = (1.0 - first[0], 1.0 - first[2], 1.0 - first[1])
        yield Finding.ranged(f"variance by interaction, D = {interaction.depth_m:g} m", rest, "%", 100.0)
    interaction = max(signed, key=lambda each: float(np.max(each.total)))
    top = int(np.argmax(interaction.total))
    i = len(interaction.parameters) + top
    label = f"largest total Sobol index ({interaction.parameters[top]}, D = {interaction.depth_m:g} m)"
    yield Finding(label, interaction.total[top], interaction.low[i], interaction.high[i])
