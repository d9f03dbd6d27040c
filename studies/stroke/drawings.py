"""Figures of the study `stroke`: the best stroke by distance, error by stroke, measured beside predicted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from phibench.studies.framework import COLOURS, MARKERS, Drawing, canvas, drawn, line_style
from phibench.studies.stroke.rendered_checks import Found, RenderedOutcome


def best_drawing(found: Found, tolerances: Sequence[str], depths_m: Sequence[float]) -> Drawing:
    """Best stroke and its error against the distance."""
    with canvas(10.0, 4.0) as figure:
        left, right = figure.subplots(1, 2)
        for i, tolerance in enumerate(tolerances):
            best = [found[tolerance, d] for d in depths_m]
            h, sigma = (np.array([getattr(b, name) for b in best]) for name in ("stroke_m", "sigma_m"))
            bound = np.array([bool(b.limits) for b in best])
            for ax, y in ((left, h), (right, 100.0 * sigma / np.array(depths_m))):
                ax.plot(depths_m, y, label=tolerance, **line_style(i))
                # hollow: a limit stopped it
                ax.plot(np.array(depths_m)[bound], y[bound], "o", color="white", markersize=3.0, zorder=5)
        left.set_ylabel("best stroke h, m")
        right.set_ylabel("sigma of D at the best stroke, %")
        right.set_yscale("log")
        for ax in (left, right):
            ax.set_xlabel("distance D, m")
        left.legend(frameon=False, title="white centre: at a limit")
        ends = {t: (found[t, depths_m[0]], found[t, depths_m[-1]]) for t in tolerances}
        alt = "Best stroke and its relative error against the distance. " + "; ".join(
            f"{t}: {a.stroke_m:.2f} m at D = {a.depth_m:g} m to {b.stroke_m:.2f} m at {b.depth_m:g} m"
            for t, (a, b) in ends.items()
        )
        return drawn("best", figure, alt + ".")


def curves_drawing(found: Found, tolerances: Sequence[str], longest_m: Mapping[float, float]) -> Drawing:
    """Predicted error against the stroke, a panel per distance of the paper."""
    with canvas(11.0, 3.8) as figure:
        axes = figure.subplots(1, len(longest_m), squeeze=False)[0]
        for ax, (depth, longest) in zip(axes, longest_m.items(), strict=True):
            for i, tolerance in enumerate(tolerances):
                best = found[tolerance, depth]
                sigma = np.where(np.isfinite(best.curve.allowed_sigma_m), best.curve.allowed_sigma_m, np.nan)
                style = {**line_style(i), "marker": ""}
                ax.plot(best.curve.strokes_m, 1e3 * sigma, label=tolerance, **style)
                ax.plot(best.stroke_m, 1e3 * best.sigma_m, MARKERS[i], color=COLOURS[i])
            ax.axvline(longest, color="grey", linestyle=":", label="longest stroke in the paper's table")
            ax.set_title(f"D = {depth:g} m")
            ax.set_xscale("log")
            ax.set_yscale("log")
            ax.set_xlabel("stroke h, m")
        axes[0].set_ylabel("predicted sigma of D, mm")
        axes[0].legend(frameon=False, fontsize=7)
        alt = "Predicted error of D against the stroke; markers at the smallest: " + "; ".join(
            f"D = {d:g} m, {t} {found[t, d].stroke_m:.2f} m" for d in longest_m for t in tolerances
        )
        return drawn("curves", figure, alt + ".")


def check_drawing(checks: Sequence[RenderedOutcome]) -> Drawing:
    """Measured rms beside the prediction."""
    names = tuple(dict.fromkeys(c.check.tolerance for c in checks))
    with canvas(10.0, 3.8) as figure:
        for ax, name in zip(figure.subplots(1, len(names), squeeze=False)[0], names, strict=True):
            for i, depth in enumerate(dict.fromkeys(c.check.depth_m for c in checks)):
                mine = [c for c in checks if c.check.tolerance == name and c.check.depth_m == depth]
                h = [c.check.stroke_m for c in mine]
                rms = np.array([1e3 * c.rms_m for c in mine])
                ends = np.array([c.interval_m for c in mine]).T * 1e3
                ax.plot(h, [1e3 * c.check.predicted_m for c in mine], color=COLOURS[i], linewidth=1.0)
                label = f"D = {depth:g} m"
                ax.errorbar(h, rms, np.abs(ends - rms), fmt=MARKERS[i], color=COLOURS[i], capsize=2, label=label)
            ax.set_title(f"{name}: points frames, lines predicted")
            ax.set_xscale("log")
            ax.set_yscale("log")
            ax.set_xlabel("stroke h, m")
            ax.set_ylabel("error of D, mm rms")
            ax.legend(frameon=False, fontsize=8)
        ratios = [c.rms_m / c.check.predicted_m for c in checks]
        alt = f"Rms error of D in frames over the predicted: from {min(ratios):.2f} to {max(ratios):.2f}."
        return drawn("checks", figure, alt)
