"""Last task of a sample: its preview picture, and the error of phi that sensor noise and rendering noise cause.

A sample whose rendering noise disturbs phi too much is refused. The task reads the files of the
sample's spot and of its two views.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from phibench.datasets.build.tasks import TaskResult
from phibench.datasets.common.errors import RefusedSampleError
from phibench.datasets.plan.plan import PairPlan
from phibench.datasets.rooms.room_sources import RoomSource, room_of
from phibench.datasets.store import schema
from phibench.datasets.store.layers import SpotWindow, read_ambient_pair, read_spot
from phibench.datasets.store.pictures import PositionImages, sample_picture, save_png
from phibench.datasets.store.schema import NoiseRow
from phibench.render.optics.room_tracer import room_geometry
from phibench.render.optics.truth import SpotTruth, spot_truth
from phibench.render.room.noise_budget import BUDGETS, NoiseBudget, noise_budget
from phibench.scenes.laser import LaserSpot
from phibench.scenes.rig import POSITIONS, Rig, View


def finish_sample(out: Path, pair: PairPlan, rig: Rig, source: RoomSource, spot: LaserSpot, quality: str) -> TaskResult:
    """Task: the picture of one sample, and as its result the `NoiseRow` of both positions.

    Raises
    ------
    RefusedSampleError
        If a view's noise is above the budget of this quality at the spot, with the numbers.
    """
    sides, rows, room = [], {}, room_of(source, out / schema.ROOM_FILES)
    for position in POSITIONS:
        view = rig.at(pair.offset_m(position))
        truth = spot_truth(view, spot, room_geometry(room, view))
        ambient = out / schema.view_file(pair.pose_id(position), "ambient")
        (planes, variance), window = read_ambient_pair(ambient), _window(out, pair, position)
        budget = spot_noise(view, truth, window, planes, variance)
        _check(position, budget, BUDGETS[quality])
        rows[position] = None if budget is None else noise_row(budget).model_dump(mode="json")
        frame = planes.astype(float)
        window.add_to(frame)
        sides.append(PositionImages(position, _at_light(truth, window), frame, planes))
    file = schema.preview_file(pair.sample_id)
    save_png(out / file, sample_picture(sides, rig.camera.detector))
    return TaskResult((file,), rows)


def spot_noise(
    view: View, truth: SpotTruth, window: SpotWindow, ambient: np.ndarray, variance: np.ndarray
) -> NoiseBudget | None:
    """Noise budget of a spot from its layers; None where it is not visible."""
    if not truth.visible:
        return None  # no spot: no budget
    return noise_budget(view, np.array([truth.u_px, truth.v_px]), window, ambient, variance)


def noise_row(budget: NoiseBudget) -> NoiseRow:
    """Row of the manifest."""
    return NoiseRow(phi_sensor_rad=budget.phi_sensor_rad, phi_render_rad=budget.phi_render_rad)


def _check(position: str, budget: NoiseBudget | None, allowed: float) -> None:
    if budget is not None and not budget.kept(allowed):
        raise RefusedSampleError(
            f"the rendering noise of its view {position} is an error of phi of {budget.phi_render_rad:.2g} rad, more "
            f"than {allowed:g} of the sensor's {budget.phi_sensor_rad:.2g} rad: raise ambient.cells_per_pixel"
        )


def _at_light(truth: SpotTruth, window: SpotWindow) -> SpotTruth:
    """Truth with the place of the light that reaches the image: the layer's centroid."""
    light = window.electrons_per_s.sum(axis=0)
    if not truth.visible or not light.sum() > 0.0:
        return truth
    v, u = (float(np.average(np.indices(light.shape)[axis], weights=light)) for axis in (0, 1))
    return replace(truth, u_px=window.u0_px + u, v_px=window.v0_px + v)


def _window(out: Path, pair: PairPlan, position: str) -> SpotWindow:
    """Spot layer; the spot's task has made sure that there is a file exactly if light reaches the image."""
    path = out / schema.spot_file(pair.sample_id, position)
    return read_spot(path) if path.is_file() else SpotWindow.empty()
