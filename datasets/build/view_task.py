"""Task that renders one view: room's light without laser, geometry of every pixel, preview; start of the renderer.

A view is what the camera sees at one position of the mirror; it runs in a worker process.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from phibench.datasets.build.bake_task import bake_settings, read_light_map
from phibench.datasets.build.tasks import TaskResult
from phibench.datasets.common.parallel import keep_memory
from phibench.datasets.plan.plan import PosePlan
from phibench.datasets.recipe.tables import AmbientTable
from phibench.datasets.rooms.room_files import RoomError
from phibench.datasets.rooms.room_sources import RoomSource, room_of
from phibench.datasets.store import schema
from phibench.datasets.store.layers import STORED_TRUTH_PLANES, write_ambient, write_truth
from phibench.datasets.store.pictures import display_exposure_s, save_png, to_srgb
from phibench.scenes.rig import Rig


def start_renderer() -> dict[str, Any]:
    """Switch Mitsuba on in this process; return what it runs on."""
    from phibench.render.setup.variant import THREADS, activate, renders_with

    keep_memory()
    activate()
    return {**renders_with(), "threads_per_process": THREADS}


def render_view(
    out: Path, dataset: str, rig: Rig, source: RoomSource, pose: PosePlan, ambient: AmbientTable
) -> TaskResult:
    """Task: render one pose and write its three files below `out`."""
    from phibench.render.optics.room_tracer import room_geometry
    from phibench.render.optics.truth import truth_layer
    from phibench.render.room.ambient_layer import dark_layer, render_ambient, view_surfaces
    from phibench.render.room.noise_budget import BUDGETS
    from phibench.render.setup.variant import activate

    activate()
    view, room = rig.at(pose.offset_m), room_of(source, out / schema.ROOM_FILES)
    surfaces = view_surfaces(view, room)
    header = {"dataset": dataset, "pose": pose.pose_id, "offset_m": pose.offset_m}
    if room.lit:
        light, settings = read_light_map(out, pose.room), bake_settings(ambient)
        budget = BUDGETS[ambient.quality]
        numbers = (ambient.cells_per_pixel, pose.seed)
        layer = render_ambient(view, room, light, settings, *numbers, budget=budget, surfaces=surfaces)
    else:
        layer = dark_layer(rig.camera)
    planes = layer.electrons_per_s
    if room.lit and not planes.any():
        raise RoomError(f"room {pose.room}: no light reaches the camera; move its lamps inside, facing the room")
    truth = truth_layer(view, room_geometry(room, view), surfaces.first_patch, STORED_TRUTH_PLANES)
    header_ambient = {**header, **ambient.model_dump(), "seed": pose.seed}
    write_ambient(out / schema.view_file(pose.pose_id, "ambient"), planes, layer.variance_per_s2, header_ambient)
    write_truth(out / schema.view_file(pose.pose_id, "truth"), truth, header)
    detector = rig.camera.detector
    picture = to_srgb(planes, detector, display_exposure_s(planes, detector))
    save_png(out / schema.view_file(pose.pose_id, "preview"), picture)
    return TaskResult(tuple(schema.view_file(pose.pose_id, name) for name in ("ambient", "truth", "preview")))
