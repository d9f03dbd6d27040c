"""Drawing of docs/mirrors.jpg: one room in mirrors of four shapes. Run `python docs/draw_mirrors.py`."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from phibench.datasets.build.bake_task import light_map
from phibench.datasets.store.pictures import display_exposure_s, to_srgb
from phibench.render.room.ambient_layer import render_ambient
from phibench.render.room.light_map import BakeSettings
from phibench.scenes.frames import Pose
from phibench.scenes.revolved_mirror import RevolvedMirror
from phibench.scenes.revolved_profile import cone, hyperboloid, paraboloid
from phibench.scenes.room import default_rig, lab

_COARSE = BakeSettings(texel_m=0.25, lamp_rays=8, bounces=3, bounce_rays=16, final_rays=32)
_WIDTH, _HEIGHT, _SQUARE = 640, 480, 470
_VERTEX_M, _RIM_M = 0.2, 0.06
_IMAGE_M = 0.05  # behind the vertex: where the room's image lies, nearly


def main() -> None:
    """Write the picture beside this file."""
    rig, room = default_rig(), lab()
    old = rig.camera
    half = {"fx_px": old.fx_px / 2.0, "fy_px": old.fy_px / 2.0, "pixel_pitch_um": 2.0 * old.pixel_pitch_um}
    middle = {"cx_px": (_WIDTH - 1) / 2.0, "cy_px": (_HEIGHT - 1) / 2.0}
    camera = replace(old, width_px=_WIDTH, height_px=_HEIGHT, **half, **middle)
    near = replace(camera, focus_distance_m=_VERTEX_M + _IMAGE_M)
    profiles = (paraboloid(_RIM_M, _RIM_M), hyperboloid(_VERTEX_M, 1.25, _RIM_M), cone(math.pi / 4.0, _RIM_M))
    pose = Pose("camera", "sphere", (0.0, 0.0, _VERTEX_M))
    rigs = [replace(rig, camera=camera)]
    rigs += [replace(rig, camera=near, mirror=RevolvedMirror(one), T_camera_sphere=pose) for one in profiles]
    light, parts = light_map(rig.at(0.0), room, _COARSE), []
    for each in rigs:
        planes = render_ambient(each.at(0.3), room, light, _COARSE, 2, 0).electrons_per_s
        left, top = (_WIDTH - _SQUARE) // 2, (_HEIGHT - _SQUARE) // 2
        picture = to_srgb(planes, camera.detector, display_exposure_s(planes, camera.detector))
        parts.append(picture[top : top + _SQUARE, left : left + _SQUARE])
    image = Image.fromarray(np.concatenate(parts, axis=1))
    image.save(Path(__file__).with_name("mirrors.jpg"), quality=68, optimize=True)


if __name__ == "__main__":
    main()
