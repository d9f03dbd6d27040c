"""Score the dense baselines on a data set, and compare the sweep with block matching.

Usage: python docs/measure_dense.py DATASET [SAMPLES] [PRESET] [METHODS, with commas]

Prints a row per sample, ratios of median errors, then a row per method: the median over samples.

Two ratios compare the sweep with block matching. "Same share": both keep the same number of answers, the lesser of
both counts. The sweep keeps those with the least claimed sigma. Block matching claims none; it keeps those with most
texture, which it has not chosen, but which help it. "Same pixels": those that both answer. Intervals resample samples.
Coverage is the share of the errors within 1.96 claimed sigma.
"""

from __future__ import annotations

import sys
import time

import numpy as np

from phibench.benchmark.dense.dense_pairs import DenseTruth, dense_pairs
from phibench.datasets.read import open_dataset
from phibench.estimator.dense.dense_bound import dense_bound
from phibench.estimator.dense.dense_interface import DenseAnswer, DensePair
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


def best(error: Array, key: Array, count: int) -> Array:
    """Sizes of the errors of the so many answers whose key is least."""
    known = np.flatnonzero(np.isfinite(error))
    order = np.argsort(key.reshape(-1)[known], kind="stable")[:count]
    return np.abs(error.reshape(-1)[known[order]])


def claimed(answer: DenseAnswer) -> Array:
    """Relative sigma."""
    assert answer.depth_m is not None
    assert answer.sigma_depth_m is not None
    return answer.sigma_depth_m / answer.depth_m


def ratios(found: dict[str, tuple[DenseAnswer, Array]], truth: DenseTruth) -> dict[str, float]:
    """Median errors of one method over those of another."""
    published, (answer, sweep) = found["dense_sgbm"][1], found["dense_sweep"]
    count = min(int(np.isfinite(error).sum()) for error in (published, sweep))
    both = np.isfinite(published) & np.isfinite(sweep)
    result = {
        "sweep, same share": np.median(best(sweep, claimed(answer), count))
        / np.median(best(published, -truth.texture, count)),
        "sweep, same pixels": np.median(np.abs(sweep[both])) / np.median(np.abs(published[both])),
    }
    if "dense_sgbm_exact" in found:
        exact = found["dense_sgbm_exact"][1]
        both = np.isfinite(published) & np.isfinite(exact)
        result["exact rig alone, same pixels"] = np.median(np.abs(exact[both])) / np.median(np.abs(published[both]))
    return {name: float(value) for name, value in result.items()}


def over_bound(pair: DensePair, truth: DenseTruth, planes_e: Array, error: Array) -> float:
    """Median of the error over the median at the bound, where that is below 1 % of D."""
    bound = dense_bound(truth.true_rig, truth.stroke_m, pair.card, planes_e, truth.depth_m)
    textured = np.isfinite(error) & (bound < 0.01 * truth.depth_m)
    return float(np.median(np.abs(error[textured]) * truth.depth_m[textured] / (0.6745 * bound[textured])))


def told(name: str, values: list[float]) -> str:
    """Median with its interval over samples, and the range."""
    draws = np.random.default_rng(1).choice(values, (4000, len(values)))
    low, high = np.percentile(np.median(draws, axis=1), [2.5, 97.5])
    return f"{name}: median {np.median(values):.3f} ({low:.3f} to {high:.3f}), {min(values):.2f} to {max(values):.2f}"


def main() -> None:
    """Print the tables."""
    samples = int(sys.argv[2]) if len(sys.argv) > 2 else None
    preset = sys.argv[3] if len(sys.argv) > 3 else "mjpeg"
    names = sys.argv[4].split(",") if len(sys.argv) > 4 else list(DENSE_METHODS)
    pairs = dense_pairs(open_dataset(sys.argv[1]), preset, 1, samples)
    rows: dict[str, list[list[float]]] = {name: [] for name in names}
    kept: dict[str, list[float]] = {}
    for pair, truth in pairs:
        found: dict[str, tuple[DenseAnswer, Array]] = {}
        for name in names:
            begin = time.process_time()
            answer = DENSE_METHODS[name](pair)
            seconds = time.process_time() - begin
            error = errors(answer, truth)
            found[name] = answer, error
            if np.isfinite(error).any():
                rows[name].append(row(error, int(truth.scored.sum()), seconds))
        answer, error = found["dense_sweep"]
        known = np.isfinite(error)
        planes = pairs.dataset[truth.sample_id].ambient("down").astype(float) * pair.card.exposure_s
        one = ratios(found, truth) | {
            "sweep, error over bound": over_bound(pair, truth, planes, error),
            "sweep, coverage of 95 %": float(np.mean(np.abs(error[known]) < 1.96 * claimed(answer)[known])),
        }
        for name, value in one.items():
            kept.setdefault(name, []).append(value)
        print(truth.sample_id, f"h = {truth.stroke_m:.2f} m;", *(f"{k}: {v:.3f};" for k, v in one.items()), flush=True)
    for name, values in kept.items():
        print(told(name, values))
    print("| method | " + " | ".join(METRICS) + " |")
    print("|---|" + "---|" * len(METRICS))
    for name, numbers in rows.items():
        middle = np.median(np.array(numbers), axis=0)
        print(f"| `{name}` | " + " | ".join(f"{x:.3g}" for x in middle) + " |")


if __name__ == "__main__":
    main()
