"""Answer to "which stroke?": what another stroke loses against the best one, as a table and as a picture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from phibench.benchmark.reports.figures import COLOURS, LINES, STYLE, encoded_figure, styled_figure
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.shown_text import TextTable
from phibench.datasets.store.files import write_bytes
from phibench.estimator.limits.best_stroke import BestStroke
from phibench.estimator.limits.stroke_curve import (
    CEILING,
    FREE,
    IMAGE_EDGE,
    MIRROR_EDGE,
    NO_BOUND,
    NO_IMAGE,
    TOO_BRIGHT,
    TOO_FAINT,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

USUAL_M = (0.10, 0.15, 0.20, 0.30, 0.425, 0.60, 0.80, 1.00, 1.20, 1.40)
"""Strokes of the table unless others are asked for; 0.425 m is that of the paper's Table 4."""
WORST = 1.0 / 3.0
"""Of D: beyond it the disparity, to which 1 / D is proportional, is less than three of its standard deviations."""
_KINDS = (".png", ".svg")
_TICKS = (0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.4, 2.0, 3.0, 5.0, 10.0)
_ELSEWHERE = "give another --height-m or --depth-m"
_REMEDIES = {
    CEILING: "give shorter strokes (--strokes-m) or a rig that stands lower",
    NO_IMAGE: _ELSEWHERE,
    MIRROR_EDGE: _ELSEWHERE,
    IMAGE_EDGE: _ELSEWHERE,
    TOO_BRIGHT: "give a longer --depth-m or less --power-mw",
    TOO_FAINT: "give a shorter --depth-m or more --power-mw",
    NO_BOUND: f"{_ELSEWHERE}, or a --calibration",
}


@dataclass(frozen=True)
class Loss:
    """Predicted error of D with a stroke that is not the best.

    Attributes
    ----------
    sigma_m : float
        NaN where the stroke cannot be taken.
    times : float
        `sigma_m` over that of the best stroke.
    cause : str
        Why the stroke cannot be taken, or its error is not known.
    """

    stroke_m: float
    sigma_m: float
    times: float
    cause: str


def require_measured(best: BestStroke) -> None:
    """Refuse a distance that no stroke measures.

    Raises
    ------
    DatasetError
        With the cause, and what to change.
    """
    first, last = best.curve.strokes_m[[0, -1]]
    none = f"D = {best.depth_m:g} m: no stroke from {first:g} to {last:g} m measures it"
    if math.isnan(best.stroke_m):
        what = dict.fromkeys(_REMEDIES.get(cause, _ELSEWHERE) for cause in best.limits)
        said = [one for one in what if not any(other != one and other.startswith(one) for other in what)]
        raise DatasetError(f"{none} ({', '.join(best.limits)}); {', or '.join(said)}")
    if best.sigma_m > WORST * best.depth_m:
        raise DatasetError(
            f"{none}: the best leaves a sigma of {best.sigma_m:.2g} m, more than a third of D; "
            "give a shorter --depth-m, longer strokes (--strokes-m) or a --calibration"
        )


def losses(best: BestStroke, strokes_m: Sequence[float]) -> list[Loss]:
    """Errors of other strokes; between those of the curve the logarithm is interpolated.

    Raises
    ------
    DatasetError
        If a stroke is beyond the curve.
    """
    return [_loss(best, float(stroke)) for stroke in strokes_m]


def _loss(best: BestStroke, stroke_m: float) -> Loss:
    known, sigma = best.curve.strokes_m, best.curve.allowed_sigma_m
    # ends of a grid that is even in its logarithm are off by their rounding
    slack = 1e-9 * known[-1]
    if not known[0] - slack <= stroke_m <= known[-1] + slack:
        raise DatasetError(
            f"a stroke of {stroke_m:g} m: is not among those from {known[0]:g} to {known[-1]:g} m; "
            "give --strokes-m with both ends of the carriage"
        )
    right = int(np.clip(np.searchsorted(known, stroke_m), 1, len(known) - 1))
    causes = [cause for cause in best.curve.causes[right - 1 : right + 1] if cause != FREE]
    if causes:
        return Loss(stroke_m, math.nan, math.nan, causes[0])
    free = np.isfinite(sigma)
    sigma_m = math.exp(np.interp(math.log(stroke_m), np.log(known[free]), np.log(sigma[free])))
    return Loss(stroke_m, sigma_m, sigma_m / best.sigma_m, FREE)


def loss_table(best: BestStroke, strokes_m: Sequence[float] | None = None) -> TextTable:
    """Table of `losses`: those that are asked for, or `USUAL_M` within the curve.

    Raises
    ------
    DatasetError
        If no stroke measures the distance, or a stroke is beyond the curve.
    """
    require_measured(best)
    first, last = best.curve.strokes_m[[0, -1]]
    # ends of the curve, with rounding
    wanted = strokes_m or [stroke for stroke in USUAL_M if first * (1 - 1e-9) <= stroke <= last * (1 + 1e-9)]
    rows = [
        (f"{loss.stroke_m:.3f}", *_millimetres(best, loss), loss.cause or _verdict(loss))
        for loss in losses(best, wanted)
    ]
    heads = ("stroke\nm", "sigma of D\nmm", "of D\n%", "over the best", "")
    return TextTable("What another stroke loses", heads, tuple(rows), "rrrrL")


def _millimetres(best: BestStroke, loss: Loss) -> tuple[str, str, str]:
    if math.isnan(loss.sigma_m):
        return "-", "-", "-"
    return f"{1e3 * loss.sigma_m:.3g}", f"{100.0 * loss.sigma_m / best.depth_m:.2g}", f"{loss.times:.2f}"


def _verdict(loss: Loss) -> str:
    return "as good as the best, within 5 %" if loss.times <= 1.05 else ""


def best_lines(best: BestStroke) -> list[str]:
    """Sentences on the best stroke: what it is, what its error consists of, and what limits it."""
    parts = (best.sigma_spot_m, best.sigma_calibration_m, best.sigma_stroke_m, best.sigma_higher_order_m)
    spot, rig, stroke, beyond = (f"{1e3 * error_m:.2g} mm" for error_m in parts)
    low, high = best.near(0.05)
    share = 100.0 * best.sigma_m / best.depth_m
    lines = [
        f"D = {best.depth_m:g} m: the best stroke is {best.stroke_m:.2f} m, "
        f"sigma of D {1e3 * best.sigma_m:.3g} mm ({share:.2g} %)",
        f"of which the spots {spot}, the rig {rig}, this stroke {stroke}, the rig beyond first order {beyond}",
        f"strokes from {low:.2f} to {high:.2f} m lose at most 5 %",
    ]
    if best.limits:
        lines.append(f"it would be better still, but for: {', '.join(best.limits)}")
    return lines


# -- picture -----------------------------------------------------------------------------------------------------------


def require_picture(path: Path) -> None:
    """Refuse a name that ends in no kind of picture which is written.

    Raises
    ------
    DatasetError
    """
    if path.suffix.lower() not in _KINDS:
        raise DatasetError(f"--out {path}: the picture is a PNG or an SVG; give a name that ends in .png or .svg")


def write_stroke_picture(path: Path, best: BestStroke) -> Path:
    """Draw the error of D and its parts by the stroke, atomically; the same curve gives the same bytes."""
    require_picture(path)
    with styled_figure(STYLE, (7.0, 4.2), layout="constrained", dpi=110) as figure:
        _draw(figure.add_subplot(), best)
        return write_bytes(path, encoded_figure(figure, path.suffix.lower()[1:]))


def _draw(ax: Axes, best: BestStroke) -> None:
    curve = best.curve
    free = np.isfinite(curve.allowed_sigma_m)
    parts = (
        ("the rig, to first order", curve.sigma_calibration_m),
        ("the rig, beyond", curve.sigma_higher_order_m),
        ("the spots", curve.sigma_spot_m),
        ("this stroke", curve.sigma_stroke_m),
    )
    for i, (name, sigma_m) in enumerate(parts):
        shown = np.where(free & (sigma_m > 0.0), 1e3 * sigma_m, np.nan)
        if np.isfinite(shown).any():
            ax.plot(curve.strokes_m, shown, LINES[1 + i % 3], color=COLOURS[i + 1], linewidth=1.2, label=name)
    ax.plot(curve.strokes_m, np.where(free, 1e3 * curve.sigma_m, np.nan), color=COLOURS[0], label="sigma of D")
    ax.plot(best.stroke_m, 1e3 * best.sigma_m, "o", color=COLOURS[0], label=f"best: {best.stroke_m:.2f} m")
    ax.axvspan(*best.near(0.05), color=COLOURS[0], alpha=0.12, linewidth=0.0, label="within 5 % of it")
    _shade_causes(ax, best)
    ax.set(xscale="log", yscale="log", xlabel="stroke h, m", ylabel="error of D, mm")
    ax.set_title(f"D = {best.depth_m:g} m: {1e3 * best.sigma_m:.3g} mm at h = {best.stroke_m:.2f} m")
    first, last = curve.strokes_m[[0, -1]]
    ax.set_xlim(first / 1.03, last * 1.03)
    _set_ticks(ax, float(first), float(last))
    _set_floor(ax, best)
    ax.legend(frameon=False, fontsize=8, ncols=2)


def _shade_causes(ax: Axes, best: BestStroke) -> None:
    """Grey where a stroke cannot be taken, one label for each cause."""
    named = set[str]()
    for stroke, cause in zip(best.curve.strokes_m, best.curve.causes, strict=True):
        if cause != FREE:
            label = "" if cause in named else f"not taken: {cause}"
            ax.axvline(stroke, color="0.75", linewidth=3.0, zorder=0, label=label)
            named.add(cause)


def _set_ticks(ax: Axes, first: float, last: float) -> None:
    from matplotlib.ticker import FuncFormatter, NullFormatter

    # ends count, despite rounding
    ax.set_xticks([x for x in _TICKS if first <= 1.001 * x <= 1.01 * last] or [first, last])
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
        axis.set_minor_formatter(NullFormatter())


def _set_floor(ax: Axes, best: BestStroke) -> None:
    """Leave out parts below a fiftieth of the smallest error, which would press the curve together."""
    sigma = 1e3 * best.curve.allowed_sigma_m
    top = float(sigma[np.isfinite(sigma)].max())
    ax.set_ylim(20.0 * best.sigma_m, 1.5 * top)
