"""Built-in method `dense_learned`: a small network corrects the depths of `dense_sweep` and predicts their errors.

The network sees, at each grid point, what `dense_sweep` has reckoned: the cost curves around its answer before and
after aggregation, the fit's sigma and its way from the minimum, the fit at eight points around, place and stroke. Two
layers of 64 answer a relative correction of 1 / D and the scale of a Laplace density of its error.
`docs/train_dense.py` trained it on 30 rooms of `bench-dev`; the weights lie beside this file.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from phibench.estimator.dense.dense_interface import DenseAnswer, DensePair
from phibench.estimator.dense.panorama_matchers import opencv
from phibench.estimator.dense.sweep import SweepParts, hidden_points
from phibench.estimator.dense.unrolled_pair import Float32, UnrolledPair
from phibench.scenes.frames import Array

LEARNED_WIDTH_PX = 640
"""Width of the panoramas of the training."""
LARGEST = 0.3
"""Largest correction, relative."""
WEIGHTS = Path(__file__).with_name("learned_sweep.npz")
_AROUND = 8  # levels of a cost curve on each side
_NEIGHBOURS = (3, 9)  # grid points
_UNLIKE = 6.0  # standard deviations of a feature, cut
_WORST = 0.1  # scale of the relative error from which on there is no answer
_CLAIM = 1.73  # claimed sigma over that scale: 95 % coverage in rooms that a network has not seen
_AT_ONCE = 1 << 16
_LEAST_INVERSE = 0.02


def features_of(parts: SweepParts, row: NDArray[np.intp], column: NDArray[np.intp], base: Array) -> Float32:
    """Features of grid points, shape (n, 53); `base` is the sweep's 1 / D there."""
    fit, levels, unrolled = parts.fit, parts.levels, parts.heights[0]
    point = (row, column)
    middle = np.clip(np.rint((base - levels[0]) / parts.step).astype(int), 0, len(levels) - 1)
    window = np.clip(middle[:, None] + np.arange(-_AROUND, _AROUND + 1), 0, len(levels) - 1)
    raw, total = (cost[row[:, None], window, column[:, None]].astype(float) for cost in (parts.raw, parts.total))
    away = np.abs(np.arange(len(levels)) - middle[:, None]) > _AROUND
    second = np.where(away, parts.total[row, :, column], np.iinfo(np.int16).max).min(axis=1) - total.min(axis=1)
    height, width = fit.inverse.shape
    near = [
        np.clip(
            (fit.inverse[np.clip(row + dv * k, 0, height - 1), (column + du * k) % width] - base) / parts.step, -5, 5
        )
        for k in _NEIGHBOURS
        for dv, du in ((0, 1), (0, -1), (1, 0), (-1, 0))
    ]
    rest = [
        second / 4000.0,
        np.log(fit.sigma[point] / parts.step),
        (parts.start[point] - fit.inverse[point]) / parts.step,
        np.log(fit.variance[point]),
        base,
        np.log(np.maximum(base, _LEAST_INVERSE)),
        np.full(len(row), np.log(parts.step)),
        unrolled.maps.grid.elevations_rad[row],
        np.full(len(row), unrolled.maps.stroke_m),
        unrolled.down[point] / 128.0,
        hidden_points(unrolled.maps, fit.inverse)[point].astype(float),
        *near,
    ]
    curves = [curve - curve.min(axis=1, keepdims=True) for curve in (raw, total)]
    return np.concatenate([curves[0] / 240.0, curves[1] / 2000.0, np.stack(rest, axis=1)], axis=1).astype(np.float32)


@dataclass(frozen=True)
class SweepNetwork:
    """Weights: mean and spread of the features, and matrices with their offsets, from first to last."""

    mean: Float32
    spread: Float32
    layers: tuple[tuple[Float32, Float32], ...]

    @classmethod
    def read(cls, path: Path) -> SweepNetwork:
        """Weights of a file."""
        with np.load(path, allow_pickle=False) as file:
            count = sum(name.startswith("matrix") for name in file.files)
            layers = tuple((file[f"matrix{k}"], file[f"offset{k}"]) for k in range(count))
            return cls(file["mean"], file["spread"], layers)

    def __call__(self, features: Float32) -> tuple[Array, Array]:
        """Relative correction of 1 / D, and scale of its error, shape (n,) each."""
        values = np.clip((features - self.mean) / self.spread, -_UNLIKE, _UNLIKE)
        for k, (matrix, offset) in enumerate(self.layers):
            values = values @ matrix.T + offset
            if k < len(self.layers) - 1:
                values = values / (1.0 + np.exp(-values))  # SiLU
        return LARGEST * np.tanh(values[:, 0].astype(float)), np.exp(values[:, 1].astype(float))


@cache
def _network() -> SweepNetwork:
    return SweepNetwork.read(WEIGHTS)


def dense_learned(pair: DensePair, width_px: int = LEARNED_WIDTH_PX) -> DenseAnswer:
    """Answer of the sweep, corrected by the network, with the sigma that it claims."""
    opencv()
    parts = SweepParts.of((UnrolledPair.of(pair, width_px),))
    inverse, scale = _corrected(parts)
    good = parts.both_show & (scale < _WORST)
    sigma = np.where(good, _CLAIM * scale * inverse, np.nan)
    return parts.heights[0].answer(np.where(good, inverse, np.nan), sigma)


def _corrected(parts: SweepParts) -> tuple[Array, Array]:
    """1 / D and the scale of its relative error on the grid, shape (H, W) each."""
    shape = parts.fit.inverse.shape
    inverse, scale = np.empty(shape), np.empty(shape)
    for index in np.array_split(np.arange(inverse.size), inverse.size // _AT_ONCE + 1):
        row, column = np.divmod(index, shape[1])
        base = np.maximum(parts.fit.inverse[row, column], _LEAST_INVERSE)
        correction, scale[row, column] = _network()(features_of(parts, row, column, base))
        inverse[row, column] = base * (1.0 + correction)
    return inverse, scale
