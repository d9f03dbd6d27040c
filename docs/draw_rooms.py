"""Pictures of docs/rooms.md: generated rooms in the mirror. Run from the repository root.

`draw_rooms.py` draws four rooms and takes some minutes. `draw_rooms.py --sheet` draws the contact sheet of forty from
coarse light maps, 9 CPU-s each, and keeps the views in `out/rooms/views.npz` for `compare_rooms.py`.
"""

from __future__ import annotations

import io
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from phibench.datasets.store.pictures import display_exposure_s, to_srgb
from phibench.render.room.ambient_layer import render_ambient
from phibench.render.room.light_map import BakeSettings, bake
from phibench.scenes.camera import Camera
from phibench.scenes.rig import Rig
from phibench.scenes.room import default_rig
from phibench.scenes.worlds.generated_room import generate_room
from phibench.scenes.worlds.room_properties import drawn_properties

FINE = BakeSettings(texel_m=0.1, indirect_texel_m=0.2, lamp_rays=32, bounces=6, bounce_rays=32, final_rays=64)
COARSE = BakeSettings(texel_m=0.2, indirect_texel_m=0.4, lamp_rays=16, bounces=5, bounce_rays=16, final_rays=24)
SHEET_ROOMS, _ACROSS, _TILE = 40, 8, 160
VIEWS = Path("out/rooms/views.npz")
STROKE_M = 0.1  # of the views on the sheet
_LIMIT_BYTES = 100_000


def coarse_rig() -> Rig:
    """Default rig whose camera has half of the pixels each way, and the same field of view."""
    camera = Camera(
        *(640, 360, 5.6, 715.0, 715.0, 319.5, 179.5),
        blur_sigma_px=0.35,
    )
    return replace(default_rig(), camera=camera)


def view(rig: Rig, stroke_m: float, number: int, settings: BakeSettings) -> np.ndarray:
    """Electrons per second of the view of one room, shape (3, height, width)."""
    stream = ("t", number)
    room = generate_room(drawn_properties(*stream), *stream)
    light = bake(rig.at(0.0), room, settings)
    return render_ambient(rig.at(stroke_m), room, light, settings, 2, 0, budget=0.5).electrons_per_s


def tile(rig: Rig, layer: np.ndarray) -> np.ndarray:
    """The mirror's part of a view, a square as high as the image, sRGB."""
    rows, columns = layer.shape[1:]
    left = (columns - rows) // 2
    return to_srgb(layer, rig.camera.detector, display_exposure_s(layer, rig.camera.detector))[:, left : left + rows]


def save(path: Path, tiles: list[np.ndarray], across: int, side: int) -> None:
    """Write tiles in rows as a JPEG picture, as good as the limit of its size allows."""
    small = [np.asarray(Image.fromarray(one).resize((side, side), Image.Resampling.LANCZOS)) for one in tiles]
    rows = [np.concatenate(small[k : k + across], axis=1) for k in range(0, len(small), across)]
    sheet = Image.fromarray(np.concatenate(rows))
    for quality in range(90, 20, -5):
        buffer = io.BytesIO()
        sheet.save(buffer, format="JPEG", quality=quality)
        if len(buffer.getvalue()) < _LIMIT_BYTES:
            break
    path.write_bytes(buffer.getvalue())


def draw_sheet() -> None:
    """Render forty rooms, keep the views, and write the contact sheet."""
    rig, layers = coarse_rig(), []
    for number in range(SHEET_ROOMS):
        layers.append(view(rig, STROKE_M, number, COARSE))
        print(f"room {number + 1} of {SHEET_ROOMS}", flush=True)
    VIEWS.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(VIEWS, electrons_per_s=np.array(layers))
    save(Path(__file__).with_name("rooms_sheet.jpg"), [tile(rig, layer) for layer in layers], _ACROSS, _TILE)


def main() -> None:
    """Write the picture that was asked for."""
    if "--sheet" in sys.argv[1:]:
        draw_sheet()
        return
    rig = default_rig()
    tiles = [tile(rig, view(rig, 0.3, number, FINE)) for number in range(4)]
    save(Path(__file__).with_name("rooms.jpg"), tiles, 2, 480)


if __name__ == "__main__":
    main()
