"""Whether a recipe's target boards leave the carriage room to move, and are large enough for their spots."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from phibench.datasets.recipe import LaserTable, TargetTable
from phibench.datasets.recipe_scene import build_spot, build_target
from phibench.render.model_faults import Fault
from phibench.scenes.catalog import BOARD_SIZE_M, board
from phibench.scenes.rig import Rig
from phibench.scenes.robot import carriage

Targets = Sequence[tuple[int, TargetTable]]


def boards_in_the_way(rig: Rig, strokes_m: Sequence[float], targets: Targets) -> Iterator[Fault]:
    """Boards that cut the mirror, the camera's housing or the mast at an end of a stroke."""
    for i, target in targets:
        for offset_m in (0.0, *sorted(set(strokes_m))):
            if hit := _hit(rig, offset_m, target):
                text = f"the board (0.40 m wide, 0.30 m high) cuts the {hit} at stroke {offset_m:g} m"
                yield Fault(f"targets[{i}].depth_m", f"{text}; move it away from the axis or to another height")
                break


def spots_on_boards(laser: LaserTable | None, targets: Targets) -> Iterator[Fault]:
    """Spots that are larger than the board that carries them."""
    if laser is None:
        return
    limit_m = min(BOARD_SIZE_M)
    for i, target in targets:
        diameter_m = build_spot(laser, target).diameter_m
        if diameter_m > limit_m:
            text = f"the spot's diameter is {diameter_m:g} m, its board measures {limit_m:g} m"
            yield Fault(f"targets[{i}]", f"{text}; make laser.diameter_m (or its growth) smaller")


def _hit(rig: Rig, offset_m: float, target: TargetTable) -> str | None:
    """What a board cuts with the carriage at an offset; None if nothing."""
    plate, view = board(build_target(target)), rig.at(offset_m)
    if plate.distance_m(view.sphere_centre_m) <= rig.mirror.radius_m:
        return "mirror"
    return next((part.name.replace("_", " ") for part in carriage(view) if plate.meets(part)), None)
