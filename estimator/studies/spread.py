"""Root mean squares with intervals, in words."""

from __future__ import annotations

import numpy as np
from scipy.stats import bootstrap

from phibench.scenes.frames import Array
from phibench.scenes.streams import generator

RESAMPLES = 2000
CONFIDENCE = 0.95


def rms(values: Array) -> float:
    """Root mean square; NaN of nothing."""
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else float("nan")


def rms_interval(values: Array, *names: str) -> tuple[float, float]:
    """Percentile bootstrap interval, 95 %, of a root mean square over independent cases; NaN for less than three.

    `names` are those of the random stream.
    """
    if len(values) < 3:
        return float("nan"), float("nan")
    found = bootstrap(
        (np.square(values),),
        lambda squares, axis: np.sqrt(np.mean(squares, axis=axis)),
        n_resamples=RESAMPLES,
        confidence_level=CONFIDENCE,
        method="percentile",
        vectorized=True,
        rng=generator("study", "spread", *names),
    )
    return float(found.confidence_interval.low), float(found.confidence_interval.high)


def rms_percent(values: Array, *names: str) -> str:
    """Such as "5.79 % (4.31 to 7.21)", of relative values; those that are not finite are left out."""
    good = values[np.isfinite(values)]
    low, high = rms_interval(good, *names)
    interval = f" ({100.0 * low:.2f} to {100.0 * high:.2f})" if np.isfinite(low) else ""
    return f"{100.0 * rms(good):.2f} %{interval}"
