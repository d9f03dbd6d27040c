"""Comparison of one data set rendered by two Mitsuba variants: truth, shift of phi in units of its bound, and times.

Truth is NumPy's and must be the same to the bit. The difference dm of the layers' expected electrons moves the best
estimate of a spot by

    d theta = F^-1 sum over pixels of (dm/d theta) I dm,

F and I being the information of `position_bound`, and theta place, flux and room. Its part along the gradient of phi
over the bound's sigma of phi says what the variant costs whoever measures with these layers.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.exposures.expected_electrons import ExpectedRegion, expected_of_light
from phibench.datasets.frames.sensor_card import SensorCard, card_of
from phibench.datasets.read import Dataset, Sample, open_finished
from phibench.datasets.store import schema
from phibench.estimator.geometry.phi import GRADIENTS
from phibench.estimator.limits.position_bound import derivative_images, limit_of, raw_information
from phibench.scenes.frames import Array
from phibench.scenes.rig import POSITIONS

LARGEST = 0.05
"""Sigma of phi; above it layers of two variants are not the same measurement."""
PRESET = "bayer-raw"


@dataclass(frozen=True)
class VariantDifference:
    """Difference of two renderings.

    Attributes
    ----------
    name : str
        Of the data set.
    truth_differs : tuple of str
        "sample position field" of every exact number that is not the same to the bit.
    shifts_sigma : array, shape (n,)
        Of every visible spot, sigma of phi; NaN where one rendering has light of the spot and the other has none.
    seconds : (float, float)
        Wall-clock time of all tasks, and `cpu_s` that of the processor.
    """

    name: str
    truth_differs: tuple[str, ...]
    shifts_sigma: Array
    seconds: tuple[float, float]
    cpu_s: tuple[float, float]

    @property
    def worst_sigma(self) -> float:
        """Largest shift; infinite where one has none, NaN without spots."""
        if self.shifts_sigma.size == 0:
            return float("nan")
        return float(np.max(np.nan_to_num(np.abs(self.shifts_sigma), nan=np.inf)))

    @property
    def rms_sigma(self) -> float:
        """Root of the mean square of the shifts that are known."""
        return float(np.sqrt(np.nanmean(self.shifts_sigma**2)))

    @property
    def agrees(self) -> bool:
        """Truth is the same, and no spot moves by more than `LARGEST`."""
        return not self.truth_differs and self.worst_sigma <= LARGEST


def variant_difference(first: str | Path, second: str | Path) -> VariantDifference:
    """Compare two renderings of one recipe.

    Raises
    ------
    DatasetError
        If a folder holds no finished data set, or they are not of the same samples.
    """
    one, other = open_finished(first), open_finished(second)
    if one.info.recipe != other.info.recipe:
        raise DatasetError(f"{first} and {second} are of two recipes: render one with both variants")
    faults, shifts = [], []
    for a, b in zip(one, other, strict=True):
        for position in POSITIONS:
            faults += list(_truth_faults(a, b, position))
            if a.truth_row(position).visible:
                shifts.append(_shift(a, b, position))
    (first_s, first_cpu_s), (second_s, second_cpu_s) = (_times(dataset) for dataset in (one, other))
    seconds, cpu_s = (first_s, second_s), (first_cpu_s, second_cpu_s)
    return VariantDifference(one.info.name, tuple(faults), np.array(shifts), seconds, cpu_s)


_EXACT = (
    *("u_px", "v_px", "phi_ray_rad", "phi_normal_rad", "phi_incidence_rad", "azimuth_rad"),
    *("reflection_point_world_m", "path_spot_mirror_m", "path_mirror_camera_m", "visible", "cause"),
)


def _truth_faults(a: Sample, b: Sample, position: str) -> Iterator[str]:
    name = f"{a.row.sample_id} {position}"
    rows = a.truth_row(position), b.truth_row(position)
    for field in _EXACT:
        first, second = (np.asarray(getattr(row, field)) for row in rows)
        if not np.array_equal(first, second, equal_nan=first.dtype.kind == "f"):
            yield f"{name} {field}"
    planes = a.truth(position), b.truth(position)
    yield from (f"{name} {plane}" for plane in planes[0] if planes[0][plane].tobytes() != planes[1][plane].tobytes())


def _shift(a: Sample, b: Sample, position: str) -> float:
    sides = [sample.frame_source(PRESET).sides[position] for sample in (a, b)]
    camera = sides[0].chain.sensor  # of both: an exposure that follows the light would hide a difference
    try:
        regions = [expected_of_light(side.light, camera, a.rig.camera) for side in sides]
    except DatasetError:  # the light of one is too little to be a layer
        return float("nan")
    row = a.truth_row(position)
    gradient = GRADIENTS["ray"](a.rig.at(row.offset_m), np.array([row.centre.u_px, row.centre.v_px]))
    return phi_shift_sigma(regions[0], regions[1], card_of(camera), gradient)


def phi_shift_sigma(first: ExpectedRegion, second: ExpectedRegion, card: SensorCard, gradient: Array) -> float:
    """Shift of phi between the expected electrons of two renderings of a spot, over the sigma of its bound.

    Parameters
    ----------
    gradient : array, shape (2,)
        Of phi by (u, v).
    """
    derivatives, information = derivative_images(first), raw_information(first.mean_e, card)
    limit = limit_of(derivatives, information)
    v, u = np.ogrid[: first.mean_e.shape[0], : first.mean_e.shape[1]]
    v, u = v + first.v0_px - second.v0_px, u + first.u0_px - second.u0_px
    inside = (v >= 0) & (v < second.mean_e.shape[0]) & (u >= 0) & (u < second.mean_e.shape[1])
    on_first = second.mean_e[np.clip(v, 0, second.mean_e.shape[0] - 1), np.clip(u, 0, second.mean_e.shape[1] - 1)]
    change = np.where(inside, on_first - first.mean_e, 0.0)
    score = np.tensordot(derivatives, information * change, axes=2)
    moved = np.linalg.lstsq(limit.fisher, score, rcond=None)[0][:2]
    return float(gradient @ moved / np.sqrt(gradient @ limit.covariance_px2 @ gradient))


def _times(dataset: Dataset) -> tuple[float, float]:
    """Seconds of all tasks of a data set that was made in one go, wall-clock and of the processor."""
    entries = [json.loads(line) for line in (dataset.folder / schema.LOG).read_text(encoding="utf-8").splitlines()]
    return sum(e.get("seconds", 0.0) for e in entries), sum(e.get("cpu_s", 0.0) for e in entries)


def table_of(first: str, second: str, found: VariantDifference) -> str:
    """Lines for people: truth, shift of phi, times."""
    truth = "the same to the bit" if not found.truth_differs else f"differs: {', '.join(found.truth_differs[:3])}"
    verdict = "they agree" if found.agrees else f"they differ by more than {LARGEST:g} sigma, or in truth"
    return "\n".join(
        [
            f"{found.name}, {len(found.shifts_sigma)} visible spots, rendered with {first} and {second}: {verdict}",
            f"truth           {truth}",
            f"shift of phi    worst {found.worst_sigma:.2g}, rms {found.rms_sigma:.2g} sigma of {PRESET}'s bound",
            f"{first:<15} {found.seconds[0]:.1f} s, {found.cpu_s[0]:.1f} CPU-s",
            f"{second:<15} {found.seconds[1]:.1f} s, {found.cpu_s[1]:.1f} CPU-s",
        ]
    )
