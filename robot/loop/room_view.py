"""Picture of an episode from above: room, robot, its heading, the way so far, the target and its stand-off circle."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from phibench.robot.loop.simulator import Simulator
from phibench.scenes.frames import Array
from phibench.scenes.room import ROBOT_SIZE_M

SIDE_PX = 400
_HALF_M = 5.0  # from the start to each side: targets are drawn within 4.5 m
_CORNERS = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
_THIN_M = 0.02  # half of what walls, thin as they are, are drawn with


def room_view(simulator: Simulator, way_m: Sequence[tuple[float, float]] = ()) -> NDArray[np.uint8]:
    """Room from above, shape (SIDE_PX, SIDE_PX, 3): x to the right, y up, the start in the middle.

    Parameters
    ----------
    simulator : Simulator
        Of an episode that has begun.
    way_m : sequence of (x, y)
        Places of the robot so far, world.
    """
    picture = Image.new("RGB", (SIDE_PX, SIDE_PX), "white")
    draw = ImageDraw.Draw(picture)
    boxes = simulator.arena.floor
    for centre, axes, half in zip(boxes.centre_m, boxes.axes, boxes.half_m, strict=True):
        _polygon(draw, centre[:2] + (_CORNERS * np.maximum(half[:2], _THIN_M)) @ axes[:2, :2].T, "#bbbbbb")
    target = simulator.target.point_m[:2]
    low, high = _pixels(
        np.stack([target - simulator.setup.task.stand_off_m, target + simulator.setup.task.stand_off_m])
    )
    draw.ellipse((low[0], high[1], high[0], low[1]), outline="#cc3311")
    u, v = _pixels(target[None])[0]
    draw.ellipse((u - 4, v - 4, u + 4, v + 4), fill="#cc3311")
    if len(way_m) > 1:
        draw.line([tuple(place) for place in _pixels(np.array(way_m)).tolist()], fill="#0072b2", width=2)
    pose = simulator.pose
    c, s = math.cos(pose.heading_rad), math.sin(pose.heading_rad)
    place, ahead = np.array([pose.x_m, pose.y_m]), np.array([c, s])
    _polygon(draw, place + 0.5 * _CORNERS * ROBOT_SIZE_M[:2] @ np.array([[c, s], [-s, c]]), "#999944")
    ends = _pixels(np.stack([place, place + 0.5 * ROBOT_SIZE_M[0] * ahead]))
    draw.line([tuple(end) for end in ends.tolist()], fill="black", width=2)
    return np.asarray(picture)


def _pixels(points_m: Array) -> Array:
    """Pixels (u, v) of places on the floor, shape (n, 2)."""
    scale = 0.5 * SIDE_PX / _HALF_M
    return np.stack([0.5 * SIDE_PX + scale * points_m[:, 0], 0.5 * SIDE_PX - scale * points_m[:, 1]], axis=-1)


def _polygon(draw: ImageDraw.ImageDraw, corners_m: Array, colour: str) -> None:
    draw.polygon([tuple(corner) for corner in _pixels(corners_m).tolist()], fill=colour)
