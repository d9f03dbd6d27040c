"""Forecast of the spot in both images of planned pairs, by chief rays; its table; advice if a mirror's rim hides it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from phibench.datasets.plan.plan import PairPlan, Plan
from phibench.render.optics.room_tracer import room_geometry
from phibench.render.optics.truth import EDGE, NO_REFLECTION, SpotTruth, depth_m, spot_truth
from phibench.scenes.frames import Array
from phibench.scenes.rig import POSITIONS, Rig


@dataclass(frozen=True)
class PairForecast:
    """A pair as it will be seen; D in metres."""

    pair: PairPlan
    depth_m: float
    down: SpotTruth
    up: SpotTruth

    @property
    def visible(self) -> bool:
        """True if both images show the spot."""
        return self.down.visible and self.up.visible


def pair_forecasts(plan: Plan, pairs: Sequence[PairPlan] | None = None) -> Iterator[PairForecast]:
    """Trace the chief rays of all pairs of a plan, or of some, room by room; nothing is rendered."""
    rooms, pairs = {name: number for number, name in enumerate(plan.rooms)}, plan.pairs if pairs is None else pairs
    forecasts = {
        forecast.pair.sample_id: forecast
        for forecast in _traced(plan, sorted(pairs, key=lambda pair: rooms[pair.room]))
    }
    return (forecasts[pair.sample_id] for pair in pairs)


def rim_lines(plan: Plan, pairs: Iterable[PairForecast]) -> list[str]:
    """Say what to do about spots that the rim of a mirror of revolution hides; no line where there are none."""
    hidden = [
        forecast.pair.sample_id
        for forecast in pairs
        if plan.rigs[forecast.pair.rig].mirror.has_rim
        and {forecast.down.cause, forecast.up.cause} & {NO_REFLECTION, EDGE}
    ]
    if not hidden:
        return []  # no spot is lost at a rim
    first = next(pair for pair in plan.pairs if pair.sample_id == hidden[0])
    if cause := _below_cone(plan.rigs[first.rig], np.array(plan.spots[first.spot].position_world_m)):
        return [f"{NO_REFLECTION} and {EDGE} of {hidden[0]}: {cause}"]
    return [
        f"{NO_REFLECTION} and {EDGE} of {hidden[0]}: the mirror ends at its rim, before the place that would show the "
        "spot; put the spot nearer to the mirror's height or farther away, or make rim_radius_m of [rig.mirror] larger"
    ]


def _below_cone(rig: Rig, point_world_m: Array) -> str:
    """Sentence if a cone shows a point at no size: its side turns a ray along the axis by twice the half angle."""
    least = np.degrees(rig.mirror.least_theta_rad)
    away = point_world_m - rig.at(0.0).sphere_centre_m
    theta = np.degrees(np.arctan2(np.hypot(away[0], away[1]), -away[2]))
    if theta >= least:
        return ""  # the cone could show it
    return (
        f"a cone of {90.0 - 0.5 * least:.0f} degrees shows nothing less than {least:.0f} degrees from straight "
        f"down, whatever its rim, and the spot is at {theta:.1f}; raise the spot, or make half_angle_deg of "
        "[rig.mirror] larger"
    )


def _traced(plan: Plan, pairs: Iterable[PairPlan]) -> Iterator[PairForecast]:
    for pair in pairs:
        spot, rig = plan.spots[pair.spot], plan.rigs[pair.rig]
        views = [plan.view(pair, position) for position in POSITIONS]
        room = plan.room(pair.room)
        down, up = (spot_truth(view, spot, room_geometry(room, view)) for view in views)
        distance_m = depth_m(np.array(spot.position_world_m), rig.at(0.0).sphere_centre_m)
        yield PairForecast(pair, float(distance_m), down, up)


def pair_table(pairs: Iterable[PairForecast]) -> list[str]:
    """Lines of a table: sample, D, stroke, and the pixel of the spot in both images or why it is not seen."""
    rows = [("sample", "D m", "stroke m", "down u, v px", "up u, v px")]
    for forecast in pairs:
        places = [f"{t.u_px:.1f}, {t.v_px:.1f}" if t.visible else t.cause for t in (forecast.down, forecast.up)]
        rows.append(
            (forecast.pair.sample_id, f"{forecast.depth_m:.3f}", f"{forecast.pair.stroke_m:.3f}", places[0], places[1])
        )
    widths = [max(len(row[k]) for row in rows) for k in range(5)]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
