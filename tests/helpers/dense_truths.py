"""Truth of dense pairs without rendering."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from phibench.benchmark.dense.dense_pairs import DenseTruth
from phibench.render.optics.correspondence import correspondence
from phibench.scenes.rig import Rig
from phibench.scenes.room import lab


def smaller(rig: Rig, divisor: float = 4.0) -> Rig:
    """The rig with so many times fewer pixels along each side."""
    camera = rig.camera
    size = {name: round(getattr(camera, name) / divisor) for name in ("width_px", "height_px")}
    focal = {name: getattr(camera, name) / divisor for name in ("fx_px", "fy_px")}
    middle = {name: (getattr(camera, name) + 0.5) / divisor - 0.5 for name in ("cx_px", "cy_px")}
    return replace(rig, camera=replace(camera, **size, **focal, **middle))


def truth_of(rig: Rig, stroke_m: float = 0.425, given: Rig | None = None) -> DenseTruth:
    """Truth of a pair in the lab; the method has the true rig unless another is given."""
    room = lab(())
    found = correspondence(room, rig.at(0.0), rig.at(stroke_m))
    texture = np.ones(found.depth_m.shape)
    return DenseTruth(0, "one", 0, "mjpeg", "lab", stroke_m, rig, given or rig, stroke_m, found, texture)
