"""Picture of docs/rooms.md: four generated rooms in the mirror. Run from the repository root; takes some minutes."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from PIL import Image

from phibench.datasets.store.pictures import display_exposure_s, to_srgb
from phibench.render.room.ambient import render_ambient
from phibench.render.room.light_map import BakeSettings, bake
from phibench.scenes.catalog import default_rig
from phibench.scenes.worlds.generated_room import generate_room
from phibench.scenes.worlds.properties import drawn_properties

OUT = Path(__file__).with_name("rooms.jpg")
SETTINGS = BakeSettings(texel_m=0.1, indirect_texel_m=0.2, lamp_rays=32, bounces=6, bounce_rays=32, final_rays=64)
_LIMIT_BYTES = 100_000
_MIRROR = slice(280, 1000)  # columns


def tile(number: int) -> np.ndarray:
    """The mirror's part of the view of one room, shape (720, 720, 3)."""
    rig, stream = default_rig(), ("t", number)
    room = generate_room(drawn_properties(*stream), *stream)
    light = bake(rig.at(0.0), room, SETTINGS)
    layer = render_ambient(rig.at(0.3), room, light, SETTINGS, 2, 0, budget=0.5).electrons_per_s
    return to_srgb(layer, rig.camera.detector, display_exposure_s(layer, rig.camera.detector))[:, _MIRROR]


def main() -> None:
    """Write the picture, as good as its limit allows."""
    rows = [np.concatenate([tile(k), tile(k + 1)], axis=1) for k in (0, 2)]
    sheet = Image.fromarray(np.concatenate(rows)).resize((960, 960), Image.Resampling.LANCZOS)
    for quality in range(90, 20, -5):
        buffer = io.BytesIO()
        sheet.save(buffer, format="JPEG", quality=quality)
        if len(buffer.getvalue()) < _LIMIT_BYTES:
            break
    OUT.write_bytes(buffer.getvalue())


if __name__ == "__main__":
    main()
