"""Scores of every estimator on every sample of a data set, and the paper's tables beside ours.

An estimator takes (rig, stroke, pixel down, pixel up) and returns a `DepthEstimate`. The pixels are the true ones
("truth") or those that the centroid finds on the noise-free frames ("frame").
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from phibench.calibration.rig.calibration_file import Calibration
from phibench.datasets.common.shown_text import TextTable
from phibench.datasets.read import Dataset, Sample
from phibench.estimator.geometry.least_squares_depth import GeneralDepth, depth_general
from phibench.estimator.geometry.paper_depth import find_published
from phibench.estimator.geometry.rig_parameters import stroke_of
from phibench.estimator.geometry.status import DepthEstimate, Status, describe
from phibench.estimator.geometry.triangulate import ESTIMATORS
from phibench.estimator.spots.simple_spots import find_spot
from phibench.scenes.frames import Array
from phibench.scenes.rig import POSITIONS, Rig

SOURCES = ("truth", "frame")
GENERAL = "general"
"""Row of `depth_general`, which takes a calibration's covariance."""
CENTROID_SIGMA_PX = 0.02
"""Of `find_spot` on noise-free frames: the pixels' share in the predicted error of `GENERAL` from "frame"."""


@dataclass(frozen=True)
class Score:
    """One estimator on one sample.

    Parameters
    ----------
    depth_m, stroke_m : float, truth
    estimator : key of `ESTIMATORS`
    source : "truth" or "frame", where the pixels come from
    estimate_m, error_m, relative_error : float, NaN unless `status` is "ok"
    published_m : float, the paper's estimate, NaN if it has none
    status : "ok", or why there is no estimate
    sigma_m, p_value : float
        Of `GENERAL`: predicted standard deviation, and the test whether both rays meet; NaN for the others.
    """

    sample_id: str
    experiment: str
    depth_m: float
    stroke_m: float
    estimator: str
    source: str
    estimate_m: float
    error_m: float
    relative_error: float
    published_m: float
    status: str
    sigma_m: float = math.nan
    p_value: float = math.nan


@dataclass(frozen=True)
class RelativeErrors:
    """Relative errors of one estimator over the samples that have an estimate."""

    estimator: str
    source: str
    n: int
    missing: int
    rms: float
    mean: float
    minimum: float
    maximum: float


@dataclass(frozen=True)
class _Pixels:
    down: Array
    up: Array
    fault: str = ""


@dataclass(frozen=True)
class _Nominal:
    """Input of an estimator besides pixels."""

    rig: Rig
    stroke_m: float
    covariance: Array | None = None

    @classmethod
    def of(cls, sample: Sample, calibration: Calibration | None) -> _Nominal:
        """Nominal numbers, or those of a calibration."""
        if calibration is None:
            return cls(sample.nominal_rig, sample.row.nominal_stroke_m)
        stroke_m = float(stroke_of(np.array(sample.row.nominal_stroke_m), calibration.values))
        return cls(calibration.rig, stroke_m, calibration.covariance)


def score_estimators(dataset: Dataset, calibration: Calibration | None = None) -> tuple[Score, ...]:
    """Score all estimators on all samples, from true pixels and from noise-free frames.

    Parameters
    ----------
    calibration : Calibration, optional
        Every estimator gets its rig and its strokes, and `GENERAL` its covariance, too.

    Returns
    -------
    tuple of Score
        Every sample appears for every estimator and source; what cannot be estimated carries its cause.
    """
    names = tuple(ESTIMATORS) if calibration is None else (*ESTIMATORS, GENERAL)
    return tuple(
        _score_one(_Nominal.of(sample, calibration), sample.row, name, source, pixels)
        for sample in dataset.samples
        for source in SOURCES
        for pixels in (_pixels(sample, source),)
        for name in names
    )


def summarise(scores: Iterable[Score]) -> tuple[RelativeErrors, ...]:
    """Summaries per estimator and source, in the order of first appearance."""
    groups: dict[tuple[str, str], list[Score]] = {}
    for item in scores:
        groups.setdefault((item.estimator, item.source), []).append(item)
    return tuple(_summary(*key, items) for key, items in groups.items())


def table(scores: Sequence[Score], source: str = "truth", wide: bool = False) -> TextTable:
    """The paper's tables beside ours: a row per sample, a column per estimator, relative errors.

    `wide` adds the estimates, the cause where there is none, and the p values of `GENERAL`.
    """
    rows: dict[str, list[Score]] = {}
    for item in scores:
        if item.source == source:
            rows.setdefault(item.sample_id, []).append(item)
    names = list(dict.fromkeys(item.estimator for item in scores))
    return (_wide_table if wide else _narrow_table)(list(rows.values()), names, source)


def _wide_table(rows: list[list[Score]], names: list[str], source: str) -> TextTable:
    heads = ("experiment", "h", "real D", "published", *names)
    body = []
    for items in rows:
        first = items[0]
        published = _cell(first.published_m, first.published_m / first.depth_m - 1.0, "")
        cells = (_cell(item.estimate_m, item.relative_error, item.status) + _doubt(item) for item in items)
        body.append((first.experiment, f"{first.stroke_m:.3f}", f"{first.depth_m:.3f}", published, *cells))
    means = (f"{_rms(rms)} ({n})" if n else "- (0)" for rms, n in _means(rows, names))
    published = "{} ({})".format(*_published_rms(rows))
    body.append(("rms relative error (n)", "", "", published, *means))
    title = f"Depth in metres, relative error in %; pixels: {source}"
    return TextTable(title, heads, tuple(body), "l" + "r" * (len(heads) - 1))


def _narrow_table(rows: list[list[Score]], names: list[str], source: str) -> TextTable:
    """Relative errors alone, for 80 columns; with a calibration the predicted error in place of the paper's estimate.

    The approximation goes then, too.
    """
    calibrated = GENERAL in names
    shown = [name for name in names if not (calibrated and name.startswith("approx"))]
    means = dict(zip(names, _means(rows, names), strict=True))
    body = []
    for items in rows:
        first, by_name = items[0], {item.estimator: item for item in items}
        cells = [_short(by_name[name].relative_error) for name in shown]
        published = _short(first.published_m / first.depth_m - 1.0)
        sigma = _short(by_name[GENERAL].sigma_m / first.depth_m).removeprefix("+") if calibrated else ""
        cells = [*cells, sigma] if calibrated else [published, *cells]
        body.append((first.experiment, f"{first.stroke_m:.3f}", f"{first.depth_m:.3f}", *cells))
    of_all = [(_short(means[name][0]).removeprefix("+"), str(means[name][1])) for name in shown]
    of_all = [*of_all, ("", "")] if calibrated else [_published_rms(rows), *of_all]
    body += [(name, "", "", *(pair[k] for pair in of_all)) for k, name in enumerate(("rms", "n"))]
    heads = [name.replace("_", "\n") for name in shown]
    heads = [*heads, "its\nsigma"] if calibrated else ["printed", *heads]
    note = "" if calibrated else "printed: the paper's own estimates. "
    return TextTable(
        f"Relative error of D in %; pixels: {source}",
        ("experiment", "h\nm", "D\nm", *heads),
        tuple(body),
        "L" + "r" * (len(heads) + 2),
        f"{note}{_without(rows)}Estimates in metres: --wide.",
    )


def _without(rows: list[list[Score]], most: int = 3) -> str:
    """Sentence on the samples that have no estimate; "" if there are none."""
    causes = [(items[0], next((x.status for x in items if x.status != "ok"), "")) for items in rows]
    left_out = [f"{x.experiment}, h {x.stroke_m:.3f}, D {x.depth_m:.3f} ({cause})" for x, cause in causes if cause]
    more = f"; and {len(left_out) - most} more" if len(left_out) > most else ""
    return f"Without an estimate: {'; '.join(left_out[:most])}{more}. " if left_out else ""


def bias_table(scores: Sequence[Score]) -> TextTable:
    """Relative error of eq. (4) from true pixels per phi convention: smallest, largest, mean, rms."""
    rows = []
    for item in summarise(scores):
        # true pixels: what is left is the bias of the formula
        if item.source == "truth" and item.estimator.startswith("paper_"):
            values = (_percent(value) for value in (item.minimum, item.maximum, item.mean))
            rows.append((item.estimator.removeprefix("paper_"), str(item.n), *values, _rms(item.rms)))
    title = "Bias of eq. (4) by what is taken for phi, true pixels, relative error in %"
    return TextTable(title, ("phi", "n", "min", "max", "mean", "rms"), tuple(rows), "lrrrrr")


def as_records(items: Iterable[Score | RelativeErrors]) -> list[dict[str, object]]:
    """Scores or summaries as JSON-ready records; NaN becomes None."""
    return [{key: _json_value(value) for key, value in asdict(item).items()} for item in items]


def _pixels(sample: Sample, source: str) -> _Pixels:
    nowhere = np.full(2, np.nan)  # estimators then give NaN, and the fault says why
    for position in POSITIONS:
        spot = getattr(sample.row, position)
        if not spot.visible:
            return _Pixels(nowhere, nowhere, f"{position}: {spot.cause}")
    if source == "truth":
        row = sample.row
        return _Pixels(np.array([row.down.u_px, row.down.v_px]), np.array([row.up.u_px, row.up.v_px]))
    spots = {
        p: find_spot(sample.expected_image(p, laser=True), sample.expected_image(p, laser=False)) for p in POSITIONS
    }
    faults = (f"{p}: {describe(spot.status)}" for p, spot in spots.items() if spot.status is not Status.OK)
    return _Pixels(spots["down"].uv_px, spots["up"].uv_px, ", ".join(faults))


def _score_one(nominal: _Nominal, row: Any, name: str, source: str, pixels: _Pixels) -> Score:
    estimate = _estimate(nominal, name, source, pixels)
    depth = float(estimate.depth_m)
    # published results are those of a nominal stroke: the paper knew no other
    published = find_published(row.experiment, row.depth_m, row.nominal_stroke_m)
    return Score(
        sample_id=row.sample_id,
        experiment=row.experiment,
        depth_m=row.depth_m,
        stroke_m=row.stroke_m,
        estimator=name,
        source=source,
        estimate_m=depth,
        error_m=depth - row.depth_m,
        relative_error=depth / row.depth_m - 1.0,
        published_m=published.estimated_depth_m if published else float("nan"),
        status=pixels.fault or describe(int(estimate.status)),
        sigma_m=float(estimate.sigma_m) if isinstance(estimate, GeneralDepth) else math.nan,
        p_value=float(estimate.p_value) if isinstance(estimate, GeneralDepth) else math.nan,
    )


def _estimate(nominal: _Nominal, name: str, source: str, pixels: _Pixels) -> DepthEstimate:
    if name != GENERAL:
        return ESTIMATORS[name](nominal.rig, nominal.stroke_m, pixels.down, pixels.up)
    C = (CENTROID_SIGMA_PX**2 if source == "frame" else 0.0) * np.eye(2)
    return depth_general(nominal.rig, nominal.stroke_m, pixels.down, pixels.up, C, C, nominal.covariance)


def _summary(estimator: str, source: str, items: list[Score]) -> RelativeErrors:
    errors = np.array([item.relative_error for item in items if item.status == "ok"])
    missing = len(items) - len(errors)
    if not len(errors):
        return RelativeErrors(estimator, source, 0, missing, *[float("nan")] * 4)
    rms = float(np.sqrt(np.mean(errors**2)))
    return RelativeErrors(
        estimator, source, len(errors), missing, rms, *(float(f(errors)) for f in (np.mean, np.min, np.max))
    )


def _cell(value_m: float, relative: float, status: str) -> str:
    if np.isnan(value_m):
        return status if status != "ok" else "-"
    return f"{value_m:.4f} {_percent(relative):>8}"


def _doubt(item: Score) -> str:
    """Predicted error and p value, where there are any."""
    return "" if math.isnan(item.sigma_m) else f" ± {100.0 * item.sigma_m / item.depth_m:.3f}, p {item.p_value:.2f}"


def _percent(relative: float) -> str:
    """Relative error in %, "-" where there is none; below 0.001 % as a power of ten, so that it does not read as 0."""
    if np.isnan(relative):
        return "-"
    percent = 100.0 * relative
    return f"{percent:+.3f}" if abs(percent) >= 1e-3 or percent == 0.0 else f"{percent:+.0e}"


def _rms(relative: float) -> str:
    return _percent(relative).removeprefix("+")


def _short(relative: float) -> str:
    """Relative error in % within 6 characters up to 100 %."""
    percent = 100.0 * relative
    return _percent(relative) if not abs(percent) >= 10.0 else f"{percent:+.2f}"


def _means(rows: list[list[Score]], names: list[str]) -> list[tuple[float, int]]:
    """Rms relative error of each estimator, and number of samples that have one."""
    by_name = {s.estimator: s for s in summarise(item for items in rows for item in items)}
    return [(by_name[name].rms, by_name[name].n) if name in by_name else (math.nan, 0) for name in names]


def _published_rms(rows: list[list[Score]]) -> tuple[str, str]:
    """Rms relative error of the paper's estimates, and their number."""
    relative = np.array([items[0].published_m / items[0].depth_m - 1.0 for items in rows])
    relative = relative[np.isfinite(relative)]
    return _rms(float(np.sqrt(np.mean(relative**2)))) if len(relative) else "-", str(len(relative))


def _json_value(value: object) -> object:
    return None if isinstance(value, float) and not np.isfinite(value) else value
