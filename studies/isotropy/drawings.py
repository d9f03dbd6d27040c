"""Figures of the study `isotropy`: noise and error of D against azimuth, and epipolar lines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from phibench.scenes.frames import Array
from phibench.studies.framework import COLOURS, Drawing, canvas, drawn, line_style
from phibench.studies.isotropy.lines import Line
from phibench.studies.isotropy.noise import AzimuthNoise


def noise_drawing(curves: Mapping[str, tuple[Array, Array]], noise: Mapping[str, Sequence[AzimuthNoise]]) -> Drawing:
    """Standard deviation of D against azimuth: bounds on an even background as lines, measured in the room as marks."""
    with canvas(9.0, 4.2) as figure:
        ax = figure.subplots()
        for i, (name, (azimuths, bound)) in enumerate(curves.items()):
            style = {**line_style(i), "marker": ""}
            ax.plot(azimuths, 1e3 * bound, label=f"{name}, bound", **style)
            if name not in noise:
                continue
            rows = noise[name]
            value = np.array([1e3 * row.scatter_m.value for row in rows])
            low, high = (np.array([1e3 * getattr(row.scatter_m, end) for row in rows]) for end in ("low", "high"))
            error = np.nan_to_num(np.maximum([value - low, high - value], 0.0))
            places = [row.azimuth_deg for row in rows]
            marks = {**line_style(i), "linestyle": "none", "markersize": 4}
            ax.errorbar(places, value, error, label=f"{name}, measured", capsize=3, **marks)
        ax.set_yscale("log")
        ax.set(xlabel="azimuth of the spot, degrees (the horizontal baseline lies at 0 and 180)")
        ax.set(ylabel="standard deviation of D, mm")
        ax.set_xticks(range(0, 361, 45))
        figure.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=8)
        parts = "; ".join(f"{name} {_range(rows)} mm" for name, rows in noise.items())
        return drawn("noise", figure, f"Standard deviation of D against the azimuth of the spot, measured: {parts}.")


def misaligned_drawing(azimuths_deg: Array, errors: dict[str, Array], words: str) -> Drawing:
    """Relative error of the exact estimator with nominal numbers against azimuth."""
    with canvas(9.0, 3.6) as figure:
        ax = figure.subplots()
        for i, (name, values) in enumerate(errors.items()):
            ax.plot(azimuths_deg, 100.0 * values, label=name, **{**line_style(i), "marker": ""})
        ax.set(xlabel="azimuth of the spot, degrees", ylabel="error of D, %", title=words)
        ax.set_yscale("symlog", linthresh=1.0)
        ax.set_xticks(range(0, 361, 45))
        ax.legend()
        parts = "; ".join(f"{k} {100 * np.nanmin(v):+.2g} to {100 * np.nanmax(v):+.2g} %" for k, v in errors.items())
        return drawn("misaligned", figure, f"Error of D of a misaligned rig against the azimuth: {parts}.")


def lines_drawing(aligned: Sequence[Line], tilted: Sequence[Line], centre_px: Array) -> Drawing:
    """Epipolar lines in the image, and their columns in the panorama."""
    with canvas(9.0, 4.2) as figure:
        left, right = figure.subplots(1, 2)
        for i, (name, lines) in enumerate((("aligned", aligned), ("misaligned", tilted))):
            for k, line in enumerate(lines):
                label = name if k == 0 else None
                left.plot(*line.uv_px.T, "-", color=COLOURS[i], label=label, linewidth=1.2)
                left.plot(*line.down_px, "o", color=COLOURS[i], markersize=3)
                right.plot(line.columns_px - line.columns_px[-1], line.depths_m, ".-", color=COLOURS[i], label=label)
        for line in aligned:
            left.plot(*np.stack([centre_px, line.down_px]).T, ":", color=COLOURS[6], linewidth=0.6)
        left.set(xlabel="u, px", ylabel="v, px", title="image: down pixel (dot), up image of its ray (line)")
        left.set_aspect("equal")
        left.invert_yaxis()
        right.set(xlabel="column - column of the farthest point, px", ylabel="D, m", title="panorama", yscale="log")
        left.legend(loc="upper left", fontsize=8)
        bend = [max(line.bend_px for line in lines) for lines in (aligned, tilted)]
        alt = (
            "Epipolar lines: radial in the image and vertical in the panorama for the aligned rig "
            f"({bend[0]:.1e} columns), up to {bend[1]:.2g} columns off for the misaligned one."
        )
        return drawn("lines", figure, alt)


def _range(rows: Sequence[AzimuthNoise]) -> str:
    values = [1e3 * row.scatter_m.value for row in rows]
    return f"{min(values):.2g} to {max(values):.2g}"
