"""Study `dense`: error and bound of D over all pixels of a pair, by stroke, mirror, wrong rig and method; a drawing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from phibench.benchmark.dense.dense_pairs import dense_pairs
from phibench.benchmark.scores.answer_errors import Rules
from phibench.benchmark.scores.intervals import Estimate
from phibench.calibration.outline.outline_result import PoseMeasurement
from phibench.calibration.rig.bundle import calibrate
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.frames.sensor_card import sensor_card
from phibench.estimator.geometry.rig_parameters import prior_sigmas
from phibench.estimator.limits.best_stroke import best_stroke
from phibench.scenes.frames import Array
from phibench.studies.dense.perfect_matches import (
    CENTRAL,
    IN_FOCUS,
    NEAR,
    SIGMA,
    SPHERE,
    THROUGH,
    Numbers,
    PerfectMatchTask,
    rigs,
    room_numbers,
)
from phibench.studies.dense.rendered_pairs import ANSWERS, NearLimits, RenderedRoom, rendered_room
from phibench.studies.dense.tables import (
    ALL_PAIRS,
    AS_BUILT,
    CALIBRATED,
    Bounds,
    DenseSettings,
    Geometry,
    Parts,
    RoomStatistics,
    answer_rows,
    best_findings,
    bound_frame,
    bounds_of,
    central_rows,
    gain_findings,
    geometry_findings,
    geometry_of,
    mirror_findings,
    outcome_frame,
    outcomes_of,
    perfect_frame,
    stroke_rows,
)
from phibench.studies.framework import (
    Drawing,
    Finding,
    Study,
    StudyDatasets,
    StudyResult,
    canvas,
    error_bars,
    finished_drawing,
    line_style,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_QUALITY = 85  # of the spot's JPEG, as in the study `stroke`


def run(settings: DenseSettings, datasets: StudyDatasets) -> StudyResult:
    """Run the study."""
    for name in ("strokes_m", "bands_m", "stroke_ends_m"):
        if (values := getattr(settings, name)) != tuple(sorted(set(values))):
            raise DatasetError(f"{name} = {list(values)}: must rise from each number to the next")
    over = RoomStatistics(Rules(resamples=settings.resamples))
    perfect = datasets.map(_perfect(settings), range(settings.rooms), "dense, perfect matches")
    pairs = dense_pairs(datasets.dataset("bench-dev", settings.samples), settings.preset, 1)
    near = NearLimits(settings.near_m, settings.right_m)
    ask = partial(rendered_room, pairs, settings.strokes_m, near)
    rendered = sorted(datasets.map(ask, range(len(pairs)), "dense, rendered pairs"), key=lambda room: room.sample_id)
    geometry, bounds = geometry_of(over, perfect), bounds_of(over, rendered)
    parts = outcomes_of(over, rendered, settings.stroke_ends_m)
    spots = {d: _spot_stroke_m(settings, d) for d in datasets.each(settings.spot_depths_m, "dense, spots")}
    findings = (
        *geometry_findings(geometry),
        *(Finding.ranged(f"bound, h = {h:g} m: {what}", e.ends, "%") for (h, what), e in bounds.items()),
        *mirror_findings(over, perfect, settings),
        *best_findings(rendered, settings.strokes_m),
        *(Finding(f"spot, D = {d:g} m, rig calibrated: best stroke", h, unit="m") for d, h in spots.items()),
        *(Finding.ranged(f"{name}, {part}: {what}", e.ends, "%") for (name, part, what), e in parts.items()),
        *gain_findings(over, rendered),
    )
    return StudyResult(
        {"table": outcome_frame(rendered), "bounds": bound_frame(rendered), "perfect": perfect_frame(perfect)},
        findings,
        (drawing(settings, geometry, bounds, parts, spots),),
        {
            "The whole room by stroke, %": stroke_rows(settings, geometry, bounds),
            "What the central model costs, % of D": central_rows(settings, geometry),
            "What is right within the near space, %": answer_rows(parts),
        },
        _notes(settings, rendered),
    )


def _perfect(settings: DenseSettings) -> partial[Numbers]:
    asked = PerfectMatchTask(
        settings.strokes_m, settings.divisor, settings.bands_m, settings.matching_px, settings.near_m, settings.right_m
    )
    exact = rigs()
    covariances = {AS_BUILT: np.diag(prior_sigmas() ** 2), CALIBRATED: _calibrated(settings)}
    return partial(room_numbers, asked, exact, covariances)


def _calibrated(settings: DenseSettings) -> Array:
    """Covariance of the rig's parameters that the mirror's outline leaves."""
    rig = rigs()[SPHERE]
    outline = PoseMeasurement(rig.sphere_in_camera_m, np.diag((np.array(settings.outline_sigma_um) * 1e-6) ** 2))
    return calibrate(rig, outline).covariance


def _spot_stroke_m(settings: DenseSettings, depth_m: float) -> float:
    ends = settings.strokes_m[0], settings.strokes_m[-1]
    card = sensor_card(settings.preset, jpeg_quality=_QUALITY)
    rig = rigs()[SPHERE]
    return best_stroke(depth_m, rig, covariance_rig=_calibrated(settings), strokes_m=ends, card=card).stroke_m


def _notes(settings: DenseSettings, rendered: Sequence[RenderedRoom]) -> tuple[str, ...]:
    kinds = {kind: sum(room.room == kind for room in rendered) for kind in sorted({room.room for room in rendered})}
    return (
        f"Rendered rooms by kind: {', '.join(f'{kind} {count}' for kind, count in kinds.items())}.",
        "Rigs of rendered pairs are exactly known; the bound is that of a window of 15 x 15 pixels.",
        "Generated rooms of the perfect matches are 3 m high, with matt surfaces.",
        *([] if settings.samples >= 30 and settings.rooms >= 30 else ["Fewer than 30 rooms: intervals are wide."]),
    )


# -- drawing -----------------------------------------------------------------------------------------------------------


def drawing(
    settings: DenseSettings, geometry: Geometry, bounds: Bounds, parts: Parts, spots: Mapping[float, float]
) -> Drawing:
    """Sigma of D, near space, costs of model and rig by stroke, and what methods get right."""
    strokes = settings.strokes_m
    with canvas(10.0, 7.4) as figure:
        (sigma, near), (cost, right) = figure.subplots(2, 2)
        for i, what in enumerate(("sigma of D, median", "sigma of D, 90 %")):
            _line(sigma, i, strokes, [bounds[h, what] for h in strokes], f"bound, {what.split(', ')[1]} of the pixels")
        label = f"sphere, matches to {settings.matching_px:g} px"
        _line(sigma, 2, strokes, [geometry[SPHERE, h, SIGMA] for h in strokes], label)
        for k, (d, h) in enumerate(spots.items()):
            sigma.axvline(h, color="grey", linestyle=":", label=None if k else "best stroke of a spot")
            sigma.annotate(f"D = {d:g} m", (h, 1.0), xycoords=("data", "axes fraction"), rotation=90, va="top", size=7)
        sigma.set(ylabel="sigma of D / D, %", yscale="log", title="the whole room")
        _line(near, 0, strokes, [bounds[h, "near space within the bound"] for h in strokes], "rendered, bound")
        for i, name in enumerate((SPHERE, IN_FOCUS), 1):
            _line(near, i, strokes, [geometry[name, h, NEAR] for h in strokes], f"{name}, {settings.matching_px:g} px")
        title = f"D below {settings.near_m:g} m, sigma {100 * settings.right_m:g} cm or less"
        near.set(ylabel="share of the near space, %", title=title)
        for i, name in enumerate(name for name in rigs() if name != IN_FOCUS):
            _line(cost, i, strokes, [geometry[name, h, CENTRAL] for h in strokes], f"central model, {name}")
        for i, name in enumerate((AS_BUILT, CALIBRATED), len(rigs()) - 1):
            _line(cost, i, strokes, [geometry[f"rig {name}", h, THROUGH] for h in strokes], f"rig {name}")
        cost.set(ylabel="median error of D, %", yscale="log", ylim=(5e-4, 30.0), title="perfect matches")
        for ax in (sigma, near, cost):
            ax.set(xlabel="stroke h, m", xscale="log")
            ax.set_xticks(strokes, [f"{h:g}" for h in strokes])
            ax.minorticks_off()
            ax.legend(frameon=False, fontsize=7, loc="lower right" if ax is near else "lower left")
        _bars(right, parts)
        right.set(ylabel=f"right to {100 * settings.right_m:g} cm, %", title="answers, all pairs")
        best, first = (bounds[h, "sigma of D, median"].value for h in (strokes[-1], strokes[0]))
        alt = f"Median bound of sigma of D: {first:.2g} % at h = {strokes[0]:g} m, {best:.2g} % at {strokes[-1]:g} m. "
        alt += "Near space right: " + "; ".join(
            f"{name} {parts[name, ALL_PAIRS, 'near space right'].value:.0f} %" for name in ANSWERS
        )
        return finished_drawing("dense", figure, alt + ".")


def _line(ax: Axes, i: int, strokes: Sequence[float], values: Sequence[Estimate], label: str) -> None:
    ends = np.array([each.ends for each in values])
    ax.errorbar(strokes, ends[:, 0], error_bars(ends), label=label, capsize=2, **line_style(i))


def _bars(ax: Axes, parts: Parts) -> None:
    for i, what in enumerate(("near space right", "floor right")):
        ends = np.array([parts[name, ALL_PAIRS, what].ends for name in ANSWERS])
        place = np.arange(len(ANSWERS)) + 0.38 * (i - 0.5)
        label = what.replace(" right", "")
        ax.bar(place, ends[:, 0], 0.36, yerr=error_bars(ends), capsize=2, label=label, color=line_style(i)["color"])
    ax.set_xticks(range(len(ANSWERS)), [name.replace(", ", ",\n") for name in ANSWERS])
    ax.set_ylim(0.0, 115.0)
    ax.legend(frameon=False, fontsize=7, loc="upper left", ncols=2)


STUDY = Study(
    "dense",
    "The whole room by two images",
    "Which stroke and mirror serve the whole room, what do the central model and a wrong rig cost, and how much of the "
    "near space is right?",
    DenseSettings,
    run,
)
