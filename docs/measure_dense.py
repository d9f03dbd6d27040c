"""Score the dense baselines on a data set, and compare the sweep with block matching at the same share answered.

Usage: python docs/measure_dense.py DATASET [SAMPLES] [PRESET]

Prints a row per method: the median over samples of what each sample gives. Block matching claims no sigma. So the
sweep's answers with the least sigma are taken until as many pixels are answered; where it answers fewer, all are. A
second ratio takes the pixels that both answer. Then a row per sample.
"""

from __future__ import annotations

import sys
import time

import numpy as np

from phibench.benchmark.dense.dense_pairs import DenseTruth, dense_pairs
from phibench.datasets.read import open_dataset
from phibench.estimator.dense.dense_bound import dense_bound
from phibench.estimator.dense.dense_interface import DenseAnswer
from phibench.estimator.dense.dense_methods import DENSE_METHODS
from phibench.scenes.frames import Array

METRICS = ("answered %", "median %", "mean %", "above 2 %", "above 5 %", "above 10 %", "CPU s")


def errors(answer: DenseAnswer, truth: DenseTruth) -> Array:
    """Relative error, NaN where there is no answer or the point is not in both images."""
    assert answer.depth_m is not None
    return np.where(truth.scored, answer.depth_m / truth.depth_m - 1.0, np.nan)


def row(error: Array, scored: int, seconds: float) -> list[float]:
    """Numbers of `METRICS`."""
    size = np.abs(error[np.isfinite(error)])
    above = [100.0 * np.mean(size > limit) for limit in (0.02, 0.05, 0.10)]
    return [100.0 * len(size) / scored, 100.0 * np.median(size), 100.0 * np.mean(size), *above, seconds]


def at_share(answer: DenseAnswer, error: Array, count: int) -> Array:
    """Errors of the so many answers with the least relative sigma."""
    assert answer.depth_m is not None
    assert answer.sigma_depth_m is not None
    claimed = np.where(np.isfinite(error), answer.sigma_depth_m / answer.depth_m, np.inf)
    order = np.argsort(claimed, axis=None)[:count]
    kept = np.full(error.size, np.nan)
    kept[order] = error.reshape(-1)[order]
    return kept


def main() -> None:
    """Print the tables."""
    samples = int(sys.argv[2]) if len(sys.argv) > 2 else None
    preset = sys.argv[3] if len(sys.argv) > 3 else "mjpeg"
    pairs = dense_pairs(open_dataset(sys.argv[1]), preset, 1, samples)
    rows: dict[str, list[list[float]]] = {name: [] for name in DENSE_METHODS}
    ratios: dict[str, list[float]] = {"same share": [], "same pixels": [], "exact rig alone": []}
    print("sample                h, m  block matching %  sweep %, same share  ratio  error over bound")
    for pair, truth in pairs:
        found: dict[str, tuple[DenseAnswer, Array]] = {}
        for name, method in DENSE_METHODS.items():
            begin = time.process_time()
            answer = method(pair)
            seconds = time.process_time() - begin
            error = errors(answer, truth)
            found[name] = answer, error
            if np.isfinite(error).any():
                rows[name].append(row(error, int(truth.scored.sum()), seconds))
        published = np.abs(found["dense_sgbm"][1])
        kept = np.abs(at_share(*found["dense_sweep"], int(np.isfinite(published).sum())))
        medians = 100.0 * np.nanmedian(published), 100.0 * np.nanmedian(kept)
        ratios["same share"].append(medians[1] / medians[0])
        sweep, exact = (np.abs(found[name][1]) for name in ("dense_sweep", "dense_sgbm_exact"))
        both = np.isfinite(published) & np.isfinite(sweep)
        ratios["same pixels"].append(float(np.median(sweep[both]) / np.median(published[both])))
        ratios["exact rig alone"].append(float(np.nanmedian(exact) / np.nanmedian(published)))
        sample = pairs.dataset[truth.sample_id]
        planes = sample.ambient("down").astype(float) * pair.card.exposure_s
        bound = dense_bound(truth.true_rig, truth.stroke_m, pair.card, planes, truth.depth_m)
        textured = np.isfinite(sweep) & (bound < 0.01 * truth.depth_m)
        over = np.median(sweep[textured] * truth.depth_m[textured] / (0.6745 * bound[textured]))
        print(
            f"{truth.sample_id:20s} {truth.stroke_m:5.2f} {medians[0]:12.2f} {medians[1]:16.2f} "
            f"{ratios['same share'][-1]:14.2f} {over:10.1f}",
            flush=True,
        )
    for kind, each in ratios.items():
        draws = np.random.default_rng(1).choice(each, (4000, len(each)))
        low, high = np.percentile(np.median(draws, axis=1), [2.5, 97.5])
        print(
            f"ratio, {kind}: median {np.median(each):.3f} ({low:.3f} to {high:.3f}, 95 %), "
            f"from {min(each):.2f} to {max(each):.2f}, {np.sum(np.array(each) > 0.6)} above 0.6"
        )
    print("| method | " + " | ".join(METRICS) + " |")
    print("|---|" + "---|" * len(METRICS))
    for name, numbers in rows.items():
        middle = np.median(np.array(numbers), axis=0)
        print(f"| `{name}` | " + " | ".join(f"{x:.3g}" for x in middle) + " |")


if __name__ == "__main__":
    main()
