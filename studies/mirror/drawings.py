"""Figure of the study `mirror`: resolution, bound of D, measured places, and cost of deviations."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from phibench.studies.framework import COLOURS, LINES, MARKERS, Drawing, canvas, drawn
from phibench.studies.mirror.measured_places import DIRECTIONS
from phibench.studies.mirror.tables import Asked, Compared

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_LEAST = 1e-2  # per cent: what costs less is not drawn


def comparison_drawing(found: Mapping[str, Compared], asked: Asked) -> Drawing:
    """The four panels."""
    from matplotlib.lines import Line2D

    with canvas(10.0, 8.0) as figure:
        (left, right), (low, last) = figure.subplots(2, 2)
        _resolution(left, found)
        _bounds(right, found, asked)
        _places(low, found)
        _costs(last, found, asked)
        handles = [Line2D([], [], label=n, marker=MARKERS[i], **_style(i)) for i, n in enumerate(found)]
        left.legend(handles=handles, frameon=False)
        far = asked.misaligned_m[-1]
        parts = "; ".join(
            f"{name} {100.0 * value:.2g} %"
            for name, c in found.items()
            if np.isfinite(value := c.bounds[asked.presets[0], asked.spot_height_m, far].relative)
        )
        alt = (
            "Four panels: pixels per degree against theta; bound of D against D; outlines of the places that are "
            f"measured; error of D by deviations of the usual size. Bounds at {far:g} m: {parts}."
        )
        return drawn("mirror", figure, alt, "png")


def _style(i: int) -> dict[str, Any]:
    return {"color": COLOURS[i % len(COLOURS)], "linestyle": LINES[i % len(LINES)]}


def _resolution(ax: Axes, found: Mapping[str, Compared]) -> None:
    for i, c in enumerate(found.values()):
        inside = np.degrees(c.rays.theta_rad) <= c.field_deg[1]
        ax.plot(np.degrees(c.rays.theta_rad)[inside], np.radians(1.0) * c.rays.px_per_rad[inside], **_style(i))
    ax.axvline(90.0, color="grey", linewidth=0.8)
    ax.set_yscale("log")
    ax.set_xlabel("theta from straight down, deg (90: horizon)")
    ax.set_ylabel("resolution, px/deg")


def _bounds(ax: Axes, found: Mapping[str, Compared], asked: Asked) -> None:
    preset = asked.presets[0]
    for i, c in enumerate(found.values()):
        depths = sorted(d for p, h, d in c.bounds if (p, h) == (preset, asked.spot_height_m))
        sigma = [100.0 * c.bounds[preset, asked.spot_height_m, d].relative for d in depths]
        ax.plot(depths, sigma, **_style(i))
    ax.set_yscale("log")
    ax.set_xlabel("distance D, m")
    ax.set_ylabel(f"bound of D, %, {preset}, spots at {asked.spot_height_m:g} m")


def _places(ax: Axes, found: Mapping[str, Compared]) -> None:
    for i, c in enumerate(found.values()):
        padded = np.pad(c.places.measured.astype(float), 1)
        D, Z = (
            np.concatenate([[2 * x[0] - x[1]], x, [2 * x[-1] - x[-2]]]) for x in (c.places.depths_m, c.places.heights_m)
        )
        ax.contour(D, Z, padded, levels=[0.5], colors=[COLOURS[i]], linestyles=[LINES[i % len(LINES)]], linewidths=1.5)
    ax.set_xlabel("distance D, m")
    ax.set_ylabel("height of the spot, m: measured inside")


def _costs(ax: Axes, found: Mapping[str, Compared], asked: Asked) -> None:
    middle = asked.misaligned_m[len(asked.misaligned_m) // 2]
    kinds = list(DIRECTIONS)
    for i, c in enumerate(found.values()):
        cost = np.array([100.0 * c.costs[middle][kind] for kind in kinds])
        cost = np.where((cost >= _LEAST) & np.isfinite(cost), cost, np.nan)
        ax.plot(cost, np.arange(len(kinds)), MARKERS[i], color=COLOURS[i], markersize=5, linestyle="")
    ax.set_yticks(np.arange(len(kinds)), kinds, fontsize=7)
    ax.invert_yaxis()
    ax.set_xscale("log")
    ax.set_xlabel(f"error of D at {middle:g} m by a deviation of usual size, %")
