"""The prediction against rendered spots: D from the centroids of noise-free spot layers of the misaligned rig."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from phibench.datasets.errors import DatasetError
from phibench.estimator.score import ESTIMATORS
from phibench.estimator.studies.misaligned import NOMINAL, Places, errors, pixels, spot_of, true_depth_m
from phibench.estimator.triangulate import exact_gradient
from phibench.render.spot import spot_layer
from phibench.scenes.frames import Array
from phibench.scenes.misalignment import PARAMETERS, Misalignment
from phibench.scenes.rig import Rig, View


@dataclass(frozen=True)
class Rendered:
    """One parameter at one value.

    Attributes
    ----------
    parameter : str
    value : float
    change : shape (estimators, d, a), relative change of D from rendered spots
    predicted : same, from the chief rays
    centroid_px : float
        Largest change of (centroid - chief ray), by the misalignment, in either image: what blur and aberrations do.
    explained : shape (d, a)
        Relative change of D of the exact estimator that 1 px of such a shift could make, at most.
    """

    parameter: str
    value: float
    change: Array
    predicted: Array
    centroid_px: float
    explained: Array


def rendered(nominal: Rig, places: Places) -> Iterator[Rendered]:
    """Every parameter at its study's magnitude."""
    aligned = _errors(nominal, Misalignment(), places)
    before = errors(nominal, Misalignment(), places)
    down, up = pixels(nominal, Misalignment(), places)
    per_px = np.abs(exact_gradient(nominal, places.stroke_m, down, up)).sum(axis=-1) / places.depths_m[:, None]
    for name, one in PARAMETERS.items():
        m = Misalignment(**{name: one.study})
        found = _errors(nominal, m, places)
        moved = [np.abs(a - b).max() for a, b in zip(found.beside_px, aligned.beside_px, strict=True)]
        predicted = errors(nominal, m, places) - before
        yield Rendered(name, one.study, found.errors - aligned.errors, predicted, max(map(float, moved)), per_px)


@dataclass(frozen=True)
class _Seen:
    errors: Array
    beside_px: tuple[Array, Array]


def _errors(nominal: Rig, misalignment: Misalignment, places: Places) -> _Seen:
    """Relative errors (estimators, d, a) from rendered centroids, and centroids less chief rays in both images."""
    true, h = nominal.perturbed(misalignment), misalignment.stroke_m(places.stroke_m)
    found = [centroids_px(true.at(offset), places.points_m) for offset in (0.0, h)]
    D = true_depth_m(nominal, misalignment, places)
    estimates = [ESTIMATORS[name](nominal, places.stroke_m, *found).depth_m / D - 1.0 for name in NOMINAL]
    chief = pixels(nominal, misalignment, places)
    return _Seen(np.stack(estimates), (found[0] - chief[0], found[1] - chief[1]))


def centroids_px(view: View, points_m: Array) -> Array:
    """Centroids (..., 2) of the rendered images of spots at points (..., 3); nothing stands in the way."""
    return np.array([centroid_px(view, point) for point in points_m.reshape(-1, 3)]).reshape(*points_m.shape[:-1], 2)


def centroid_px(view: View, point_m: Array) -> tuple[float, float]:
    """Centroid of one spot's rendered layer, red plane: sums over pixels, as an estimator would form them.

    Raises
    ------
    DatasetError
        If no light reaches the image.
    """
    layer = spot_layer(view, spot_of(point_m), ())
    image = layer.electrons_per_s[0]
    if not image.sum() > 0.0:
        raise DatasetError(f"no light of a spot at {point_m.tolist()} reaches the image; choose other depths_m")
    v, u = np.mgrid[: image.shape[0], : image.shape[1]]
    return (
        layer.u0_px + float(np.sum(u * image) / image.sum()),
        layer.v0_px + float(np.sum(v * image) / image.sum()),
    )
