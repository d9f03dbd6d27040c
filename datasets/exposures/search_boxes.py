"""Boxes around a spot that tell a method where to look (`search_box`), placed at random about the light."""

from __future__ import annotations

import numpy as np

from phibench.datasets.frames.frame_request import sample_stream
from phibench.datasets.frames.frame_source import has_place
from phibench.datasets.read import Sample
from phibench.render.sensor.light import Region
from phibench.scenes.camera import Camera
from phibench.scenes.rig import POSITIONS

BOX_MARGIN_PX = 4
"""The light of a hinted spot has its centre at least this far from the edges of its box."""


def search_boxes(sample: Sample, side_px: int, margin_px: int = BOX_MARGIN_PX) -> tuple[Region, Region]:
    """Boxes for both images of a sample, drawn from streams of its own: their centres tell nothing of the spot."""
    camera, boxes = sample.rig.camera, []
    for position in POSITIONS:
        row = sample.truth_row(position)
        light = (row.centre.u_px, row.centre.v_px) if has_place(row, (camera.height_px, camera.width_px)) else None
        boxes.append(search_box(sample.stream_names, position, light, camera, side_px, margin_px))
    return boxes[0], boxes[1]


def search_box(
    names: tuple[str, int, str],
    position: str,
    light_px: tuple[float, float] | None,
    camera: Camera,
    side_px: int,
    margin_px: int,
) -> Region:
    """Box that holds the centre of a spot's light anywhere alike, as far as the image has room for it.

    Parameters
    ----------
    names : data set, its seed, sample id
    position : "down" or "up"
    light_px : (u, v), or None where there is none in the image: the box is anywhere
    side_px, margin_px : int
        Side of the box, and how far the light is from its edges at least.
    """
    sizes = camera.width_px, camera.height_px
    random = sample_stream(names, "box", position)
    places = (None, None) if light_px is None else light_px
    u, v = (_start(random, place, side_px, margin_px, size) for place, size in zip(places, sizes, strict=True))
    return Region(u, v, u + min(side_px, sizes[0]), v + min(side_px, sizes[1]))


def _start(random: np.random.Generator, centre_px: float | None, side_px: int, margin_px: int, size_px: int) -> int:
    """First pixel of a box along one axis, in an image of `size_px` pixels."""
    last = max(size_px - side_px, 0)
    if centre_px is None:
        return int(random.integers(0, last + 1))
    # the light is at least the margin from the box's edges, which lie half a pixel beyond its outer pixels
    low = int(np.ceil(centre_px + margin_px + 0.5 - side_px))
    high = int(np.floor(centre_px - margin_px + 0.5))
    low, high = (min(max(edge, 0), last) for edge in (low, high))
    return int(random.integers(low, high + 1))
