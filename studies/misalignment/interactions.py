"""Interactions of misalignments, as Sobol indices of the relative error of D; and errors after a change of focus.

I. M. Sobol, Math. Comput. Simul. 55, 271 (2001); estimators of A. Saltelli et al., Comput. Phys. Commun. 181, 259
(2010), as scipy has them. The parameters are uniform from minus to plus the study's magnitude, independent of each
other. First-order indices that sum to 1 mean errors that add; what is missing is interaction.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from phibench.benchmark.scores.intervals import percentile_interval
from phibench.calibration.rig.bundle import apparent_outline
from phibench.datasets.common.errors import DatasetError
from phibench.estimator.geometry.sensitivities import PARAMETERS as ANALYTIC
from phibench.estimator.geometry.triangulate import depth_exact
from phibench.scenes.camera import Camera, refocused
from phibench.scenes.frames import Array, as_vector
from phibench.scenes.misalignment import PARAMETERS, Misalignment
from phibench.scenes.rig import Rig
from phibench.studies.framework import Finding
from phibench.studies.misaligned_rigs import ALL, Places, errors, errors_of_many, seen_px

# A refocused lens: its focal length in pixels, and what D with the old calibration is off by.
#
# The paper focuses last, after all else is set. A lens that is turned has another image distance, so that fx and fy
# change by more than the 0.3 % to which a calibration knows them. The mirror's outline grows with them. Whoever takes
# the new outline with the old focal length finds the mirror nearer by nearly as much, and D hardly changes.


LENS_M, FOCUS_M = 4e-3, (0.46, 0.23)
"""Focal length of the C310's lens, and planes of focus: the factory's and that of the mirror's virtual image."""
FAR_M = 1e6
"""Plane of focus of a lens that is focused far away."""
OUTLINE, OLD = "z_c from the outline's size", "old calibration"


@dataclass(frozen=True)
class Refocus:
    """One plane of focus.

    Attributes
    ----------
    focus_m, focal_px : float
    relative : float
        Focal length over the old one, less 1: the misalignment `focal_relative`.
    errors : dict
        Relative errors of D by what the estimator takes for the rig, shape (n,) each.
    """

    focus_m: float
    focal_px: float
    relative: float
    errors: dict[str, Array]

    def rms(self, kind: str) -> float:
        """Root mean square of the relative errors."""
        return float(np.sqrt(np.mean(np.square(self.errors[kind]))))


def thin_lens(camera: Camera, lens_m: float) -> Camera:
    """The camera with a thin lens of this focal length, focused far away."""
    focal_px = 1.0 / ((1.0 / lens_m - 1.0 / FAR_M) * camera.pixel_pitch_um * 1e-6)
    return replace(camera, fx_px=focal_px, fy_px=focal_px, focus_distance_m=FAR_M)


def refocus(nominal: Rig, focus_m: float, places: Sequence[tuple[float, float]], height_m: float) -> Refocus:
    """Errors of the nominal rig in pictures that were taken after its lens was turned.

    Parameters
    ----------
    nominal : Rig
        Calibrated before.
    focus_m : float
        New plane of focus.
    places : sequence of (D, stroke), metres; spots along world x
    height_m : float, of the spots above the floor
    """
    camera = refocused(nominal.camera, focus_m)
    true = replace(nominal, camera=camera)
    pose = replace(nominal.T_camera_sphere, translation_m=as_vector(apparent_outline(nominal, true)[:3]))
    known = {OLD: nominal, OUTLINE: replace(nominal, T_camera_sphere=pose)}
    D, h = np.array(places, float).T
    errors_by_name: dict[str, list[float]] = {name: [] for name in known}
    for depth_m, stroke_m in zip(D, h, strict=True):
        point = np.array([depth_m, 0.0, height_m])
        down, up = (seen_px(true.at(offset), point) for offset in (0.0, float(stroke_m)))
        for name, rig in known.items():
            errors_by_name[name].append(float(depth_exact(rig, float(stroke_m), down, up).depth_m) / depth_m - 1.0)
    errors = {name: np.array(values) for name, values in errors_by_name.items()}
    return Refocus(focus_m, camera.fx_px, camera.fx_px / nominal.camera.fx_px - 1.0, errors)


def refocus_findings(rows: Sequence[Refocus]) -> Iterator[Finding]:
    """Focal length, its change, and the rms error of D for each plane of focus."""
    for row in rows:
        where = f"lens refocused at {row.focus_m:g} m"
        yield Finding(f"{where}: focal length", row.focal_px, unit="px")
        yield Finding(f"{where}: focal_relative", 100.0 * row.relative, unit="%")
        for kind in (OLD, OUTLINE):
            yield Finding(f"{where}: rms error of D, {kind}", 100.0 * row.rms(kind), unit="%")


_ADDITIVE = 0.9  # sum of the first-order indices from which errors add
OUTPUTS = (("error", 2), ("square", 1))
"""Outputs, and the power whose mean is the mean square error."""


@dataclass(frozen=True)
class Interactions:
    """Indices of one output.

    Attributes
    ----------
    output : "error" or "square"
    depth_m : float
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


def moving(
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
    estimator : str
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
    names = moving(nominal, places, (estimator,), parameters)
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

    values = evaluated(model, len(names), n, rng)
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


def evaluated(model: Callable[[Array], Array], p: int, n: int, rng: np.random.Generator) -> Values:
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
