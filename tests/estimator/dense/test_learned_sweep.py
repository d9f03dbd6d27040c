"""The network on the sweep's costs: its layers by loops, its features, and without a correction the sweep's answer."""

from __future__ import annotations

import math

import numpy as np
import pytest
from helpers.textured_rooms import TexturedRoom, small_rig

from phibench.estimator.dense import learned_sweep
from phibench.estimator.dense.learned_sweep import LARGEST, WEIGHTS, SweepNetwork, dense_learned, features_of
from phibench.estimator.dense.sweep import SweepParts, dense_sweep
from phibench.estimator.dense.unrolled_pair import UnrolledPair

WIDTH_PX = 320


def test_layers_are_what_loops_make_of_them() -> None:
    network, rng = SweepNetwork.read(WEIGHTS), np.random.default_rng(0)
    features = (network.mean + network.spread * rng.normal(size=(3, len(network.mean)))).astype(np.float32)
    correction, scale = network(features)
    for n in range(3):
        values = [float((f - m) / s) for f, m, s in zip(features[n], network.mean, network.spread, strict=True)]
        for k, (matrix, offset) in enumerate(network.layers):
            values = [
                sum(float(w) * x for w, x in zip(row, values, strict=True)) + float(b)
                for row, b in zip(matrix, offset, strict=True)
            ]
            values = values if k == 2 else [x / (1.0 + math.exp(-x)) for x in values]
        # float32 sums of some 60 terms
        assert correction[n] == pytest.approx(LARGEST * math.tanh(values[0]), abs=1e-4)
        assert scale[n] == pytest.approx(math.exp(values[1]), rel=1e-3)


def test_without_a_correction_the_answer_is_the_sweeps(monkeypatch: pytest.MonkeyPatch) -> None:
    pair, _ = TexturedRoom().pair(small_rig(), 0.4)
    network = SweepNetwork.read(WEIGHTS)
    (matrix, _), still = network.layers[-1], np.array([0.0, math.log(0.01)], np.float32)
    idle = SweepNetwork(network.mean, network.spread, (*network.layers[:-1], (0.0 * matrix, still)))
    monkeypatch.setattr(learned_sweep, "_network", lambda: idle)
    learned, sweep = dense_learned(pair, WIDTH_PX), dense_sweep(pair, WIDTH_PX)
    assert learned.depth_m is not None
    assert sweep.depth_m is not None
    assert learned.sigma_depth_m is not None
    both = learned.answered & sweep.answered
    assert both.sum() > 0.9 * sweep.answered.sum()
    assert np.abs(learned.depth_m / sweep.depth_m - 1.0)[both].max() < 1e-6
    ratio = (learned.sigma_depth_m / learned.depth_m)[both]
    assert np.ptp(ratio) < 1e-3 * ratio.mean()  # one scale everywhere


def test_the_weights_fit_the_features() -> None:
    pair, _ = TexturedRoom().pair(small_rig(), 0.4)
    parts = SweepParts.of((UnrolledPair.of(pair, WIDTH_PX),))
    row, column = np.array([40, 50]), np.array([3, WIDTH_PX - 1])
    features = features_of(parts, row, column, parts.fit.inverse[row, column])
    assert features.shape == (2, len(SweepNetwork.read(WEIGHTS).mean))
    assert np.isfinite(features).all()
