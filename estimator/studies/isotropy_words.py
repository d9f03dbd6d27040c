"""What the study `isotropy` says: sentences from numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from phibench.estimator.panorama_edges import SeenEdge
from phibench.estimator.studies.isotropy_lines import Line
from phibench.estimator.studies.isotropy_noise import AzimuthNoise, Isotropy
from phibench.estimator.studies.result import Row
from phibench.scenes.frames import Array

_LEAST_P = 1e-9  # smaller ones say no more
_STRAIGHT_PX = 0.1  # a tenth of a pixel matters, less does not


def noise_sentence(name: str, noise: Sequence[AzimuthNoise], test: Isotropy) -> str:
    """Scatter of one baseline, and whether it depends on the azimuth."""
    least = min(noise, key=lambda one: one.scatter_m.value)
    most = max(noise, key=lambda one: one.scatter_m.value)
    if not test.tested:
        return f"{name}: too few azimuths for a test of isotropy; the scatter of D is {_scatter(least)}."
    verdict = "isotropic" if test.isotropic else "not isotropic"
    follows = "is the same everywhere" if test.explained else "still differs"
    over_bound = _probability(test.p_value_over_bound)
    return (
        f"{name}: at D = {least.depth_m:.3g} m the noise of D is {verdict} ({_probability(test.p_value)}, "
        f"false alarms {100.0 * test.false_alarm:g} %): {_scatter(least)} to {_scatter(most)}, a factor of "
        f"{test.ratio:.2g}; as a multiple of each spot's own bound it {follows} ({over_bound})."
    )


def bias_sentence(name: str, noise: Sequence[AzimuthNoise]) -> str:
    """Largest systematic error of the likelihood fits."""
    usable = [one for one in noise if one.errors_m.size > 1]
    if not usable:
        return f"{name}: too few estimates for a mean error."
    worst = max(usable, key=lambda one: abs(one.bias_m))
    share = abs(worst.bias_m) / worst.scatter_m.value
    return (
        f"{name}: the mean error is at most {1e3 * abs(worst.bias_m):.2g} +- {1e3 * worst.bias_sigma_m:.1g} mm, "
        f"{share:.2g} of the scatter there (azimuth {worst.azimuth_deg:.0f} degrees)."
    )


def grid_sentence(single: Array, averaged: Array) -> str:
    """What the mosaic does to the isotropy of the vertical stroke."""
    one, mean = ratio(single), ratio(averaged)
    cause = "the mosaic's grid makes the difference" if mean - 1.0 < 0.5 * (one - 1.0) else "the grid is not the cause"
    return (
        f"On an even background the vertical stroke's bound varies by a factor of {one:.2f} with the azimuth, and of "
        f"{mean:.3f} once averaged over places in a Bayer cell: {cause}."
    )


def baseline_sentence(
    azimuths_deg: Array, vertical: Array, horizontal: Array, depth_m: float, baseline_m: float
) -> str:
    """Where each baseline is better."""
    seen = np.isfinite(horizontal) & np.isfinite(vertical)
    better = float(np.mean(horizontal[seen] < vertical[seen]))
    from_it = np.degrees(np.arcsin(np.abs(np.sin(np.radians(azimuths_deg)))))
    near, across = (int(np.argmin(np.where(seen, each, np.inf))) for each in (from_it, -from_it))
    return (
        f"At the same length ({baseline_m:.3g} m) and D = {depth_m:.3g} m the horizontal baseline's bound is "
        f"{1e3 * horizontal[across]:.2g} mm at {from_it[across]:.2g} degrees from its direction and "
        f"{1e3 * horizontal[near]:.2g} mm at {from_it[near]:.2g} degrees, against "
        f"{1e3 * np.sqrt(np.mean(vertical[seen] ** 2)):.2g} mm (rms) of the vertical stroke; it is the smaller one at "
        f"{100.0 * better:.0f} % of the azimuths."
    )


def misaligned_sentence(vertical: Array, horizontal: Array, words: str) -> str:
    """What a misalignment does to isotropy; relative errors over azimuths."""
    return (
        f"With {words} the exact estimator's error with nominal numbers runs from {_percent(np.nanmin(vertical))} to "
        f"{_percent(np.nanmax(vertical))} % of D around the vertical stroke, and from "
        f"{_percent(np.nanmin(horizontal))} to {_percent(np.nanmax(horizontal))} % around the horizontal baseline "
        f"({np.count_nonzero(np.isfinite(horizontal))} of {horizontal.size} azimuths have an estimate)."
    )


def occlusion_sentence(heights_m: Sequence[float], pair: Sequence[float], own: Sequence[float], apart_m: float) -> str:
    """Who hides whom."""
    parts = ", ".join(f"{100.0 * share:.2g} % at {height:g} m" for height, share in zip(heights_m, pair, strict=True))
    single = max(own)
    moving = "nothing" if single == 0.0 else f"up to {100.0 * single:.2g} %"
    return (
        f"Two fixed sensors {apart_m:.3g} m apart hide from each other these shares of all azimuths, by height of the "
        f"spot: {parts}; one sensor that moves hides {moving} from itself."
    )


def line_sentence(aligned: Sequence[Line], tilted: Sequence[Line]) -> str:
    """Whether epipolar lines are radial, and vertical in the panorama."""
    exact = max(line.beside_radius_px for line in aligned)
    rendered = max(line.rendered_beside_px for line in aligned)
    bend = max(line.bend_px for line in aligned)
    verdict = "radial" if max(exact, rendered) < _STRAIGHT_PX else "not radial"
    off, straight = max(line.beside_radius_px for line in tilted), max(line.beside_line_px for line in tilted)
    column = max(line.bend_px for line in tilted)
    return (
        f"Epipolar lines of the aligned rig are {verdict} in the image: exact points lie within {exact:.1e} px and "
        f"rendered spots within {rendered:.1e} px of the down pixel's radius, and in the panorama within {bend:.1e} "
        f"columns; of the misaligned rig they leave it by up to {off:.2g} px and {column:.2g} columns, and lie within "
        f"{straight:.2g} px of a straight line."
    )


def edge_sentence(name: str, edges: Sequence[SeenEdge]) -> str:
    """Whether upright edges of the room are vertical in the panorama."""
    if not edges:
        return f"No upright edge was measured in the panorama of the {name} rig."
    worst = max(edges, key=lambda edge: abs(edge.lean_px))
    miss = max(abs(edge.lean_px - edge.expected_lean_px) for edge in edges)
    upright = "vertical" if abs(worst.lean_px) < _STRAIGHT_PX else "not vertical"
    return (
        f"In the panorama of the {name} rig upright edges are {upright}: the largest lean is "
        f"{worst.lean_px:+.2f} +- {1.96 * worst.lean_sigma_px:.2f} columns over {worst.rows} rows ({worst.name}), "
        f"and the leans differ from the predicted ones by at most {miss:.2f}."
    )


def noise_rows(noise: Mapping[str, Sequence[AzimuthNoise]]) -> tuple[Row, ...]:
    """Table: scatter, interval, bound and bias per baseline and azimuth."""
    heads = ("baseline", "azimuth, degrees", "bound, mm", "scatter, mm (95 %)", "bias, mm", "fits missing")
    return (
        heads,
        *(
            (
                name,
                f"{one.azimuth_deg:.0f}",
                f"{1e3 * one.bound_m:.2f}",
                _interval(one),
                f"{1e3 * one.bias_m:+.2f} +- {1e3 * one.bias_sigma_m:.2f}",
                str(one.missing),
            )
            for name, rows in noise.items()
            for one in rows
        ),
    )


def edge_rows(edges: Mapping[str, Sequence[SeenEdge]]) -> tuple[Row, ...]:
    """Table: upright edges in the panorama."""
    heads = ("rig", "edge", "azimuth, degrees", "rows", "lean, columns", "predicted", "offset, columns")
    return (
        heads,
        *(
            (
                name,
                edge.name,
                f"{edge.azimuth_deg:.1f}",
                str(edge.rows),
                f"{edge.lean_px:+.3f} +- {edge.lean_sigma_px:.3f}",
                f"{edge.expected_lean_px:+.3f}",
                f"{edge.offset_px:+.3f}",
            )
            for name, rows in edges.items()
            for edge in rows
        ),
    )


def ratio(values: Array) -> float:
    """Largest over smallest; NaN without any."""
    known = values[np.isfinite(values)]
    return float(known.max() / known.min()) if known.size else math.nan


def _probability(p: float) -> str:
    return f"p = {p:.2g}" if p >= _LEAST_P else f"p below {_LEAST_P:g}"


def _scatter(one: AzimuthNoise) -> str:
    return f"{_interval(one)} mm at {one.azimuth_deg:.0f} degrees"


def _interval(one: AzimuthNoise) -> str:
    s = one.scatter_m
    return f"{1e3 * s.value:.2f} ({1e3 * s.low:.2f} to {1e3 * s.high:.2f})"


def _percent(relative: float) -> str:
    return f"{100.0 * relative:+.2g}"
