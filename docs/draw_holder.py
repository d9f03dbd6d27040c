"""Drawing of docs/holder.jpg: the mirror with all kinds of holders. Run `python docs/draw_holder.py`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from phibench.datasets.build.bake_task import light_map
from phibench.datasets.store.pictures import display_exposure_s, to_srgb
from phibench.render.room.ambient_layer import render_ambient
from phibench.render.room.light_map import BakeSettings
from phibench.scenes.holder import fitted_holder
from phibench.scenes.room import default_rig, lab

_COARSE = BakeSettings(texel_m=0.25, lamp_rays=8, bounces=3, bounce_rays=16, final_rays=32)
_WIDTH, _HEIGHT, _SQUARE = 640, 360, 380


def main() -> None:
    """Write the picture beside this file."""
    rig, room = default_rig(), lab()
    old = rig.camera
    half = {"fx_px": old.fx_px / 2.0, "fy_px": old.fy_px / 2.0, "pixel_pitch_um": 2.0 * old.pixel_pitch_um}
    middle = {"cx_px": (_WIDTH - 1) / 2.0, "cy_px": (_HEIGHT - 1) / 2.0}
    camera = replace(old, width_px=_WIDTH, height_px=_HEIGHT, **half, **middle)
    light = light_map(rig.at(0.0), room, _COARSE)
    parts = []
    for holder in (None, *(fitted_holder(kind, rig.sphere.radius_m) for kind in ("rods", "post", "tube"))):
        view = replace(rig, camera=camera, holder=holder).at(0.3)
        planes = render_ambient(view, room, light, _COARSE, 2, 0).electrons_per_s
        left = (_WIDTH - _SQUARE) // 2
        picture = to_srgb(planes, camera.detector, display_exposure_s(planes, camera.detector))
        parts.append(picture[:, left : left + _SQUARE])
    image = Image.fromarray(np.concatenate(parts, axis=1))
    image.save(Path(__file__).with_name("holder.jpg"), quality=68, optimize=True)


if __name__ == "__main__":
    main()
