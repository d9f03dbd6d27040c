"""Drawing of docs/binocular.jpg: what both sensors of the paper's horizontal binocular see. Run it without arguments.

Two sensors stand 0.425 m apart in the lab, and a laser spot 2.5 m away across their line. Each picture is rendered with
the other sensor in the room. Above each: that part of it, enlarged. The two pixels give D. Printed besides: what the
two hide from each other, and the laws of the error of D, by rendered spots and drawn frames. Some minutes.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from phibench.datasets.build.bake_task import light_map
from phibench.datasets.store.pictures import display_exposure_s, to_srgb
from phibench.estimator.geometry.reflection import image_of
from phibench.estimator.geometry.triangulate import depth_exact
from phibench.render.optics.room_tracer import room_geometry
from phibench.render.optics.spot_layer import spot_layer
from phibench.render.room.ambient_layer import render_ambient
from phibench.render.room.light_map import BakeSettings
from phibench.render.sensor.settings import sensor
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig
from phibench.scenes.room import TargetBoard, lab
from phibench.studies.isotropy.azimuth_errors import sideways_rig
from phibench.studies.isotropy.binocular import Binocular, Laws, binocular_results
from phibench.studies.misaligned_rigs import spot_of

APART_M, DEPTH_M, HEIGHT_M, AZIMUTH_DEG = 0.425, 2.5, 0.50, 105.0
HEIGHTS_M, LIGHT_E_PER_S = (0.50, 0.65, 0.71, 0.80), (3e4, 3e4, 2e4)
DRAWS = 200
_HALF_PX, _ZOOM, _WIDTH_PX = 40, 4, 1000


def seen(both: Binocular, index: int) -> tuple[Image.Image, Array]:
    """Picture of one sensor, and the pixel of the spot's centroid."""
    target = TargetBoard("a105", DEPTH_M, math.radians(AZIMUTH_DEG), HEIGHT_M)
    view, room = both.views[index], lab([target])
    room = replace(room, furniture=(*room.furniture, *both.seen_beside(index)))
    settings = BakeSettings()
    light = light_map(view, room, settings)
    layer = render_ambient(view, room, light, settings, 2, 1, rounds=1).electrons_per_s
    spot = spot_layer(view, spot_of(np.array(target.position_world_m)), room_geometry(room, view))
    rows, columns = spot.electrons_per_s.shape[1:]
    frame = np.array(layer)
    frame[:, spot.v0_px : spot.v0_px + rows, spot.u0_px : spot.u0_px + columns] += spot.electrons_per_s
    detector = view.rig.camera.detector
    picture = Image.fromarray(to_srgb(frame, detector, display_exposure_s(layer, detector)))
    return picture, spot.centroid_uv_px


def with_inset(picture: Image.Image, at: Array, title: str) -> Image.Image:
    """The mirror's part of a picture, with a part of it enlarged in the corner."""
    u, v = (round(float(value)) for value in at)
    box = (u - _HALF_PX, v - _HALF_PX, u + _HALF_PX, v + _HALF_PX)
    large = picture.crop(box).resize((2 * _HALF_PX * _ZOOM,) * 2, Image.Resampling.BICUBIC)
    ImageDraw.Draw(picture).rectangle(box, outline="white")
    left = (picture.width - picture.height) // 2
    picture = picture.crop((left, 0, left + picture.height, picture.height))
    canvas = Image.new("RGB", (picture.width, picture.height + large.height + 28))
    canvas.paste(picture, (0, large.height + 28))
    canvas.paste(large, ((picture.width - large.width) // 2, 28))
    ImageDraw.Draw(canvas).text((canvas.width / 2, 6), title, fill="white", anchor="ma", font_size=18)
    return canvas


def main() -> None:
    """Write the picture beside this file, and print D from the two rendered spots."""
    both = Binocular(Rig(), APART_M, DEPTH_M, HEIGHT_M)
    parts, pixels = [], []
    for index, name in enumerate(("first sensor: sees the second", "second sensor: sees the first")):
        picture, uv = seen(both, index)
        other = both.views[1 - index].sphere_centre_m
        parts.append(with_inset(picture, _pixel(both, index, other), name))
        pixels.append(uv)
    sheet = Image.new("RGB", (sum(part.width for part in parts) + 12, parts[0].height), "white")
    for k, part in enumerate(parts):
        sheet.paste(part, (k * (part.width + 12), 0))
    size = (_WIDTH_PX, round(sheet.height * _WIDTH_PX / sheet.width))
    sheet.resize(size, Image.Resampling.LANCZOS).save(
        Path(__file__).with_name("binocular.jpg"), quality=74, optimize=True
    )
    found = float(depth_exact(sideways_rig(Rig()), APART_M, *pixels).depth_m)
    print(f"D from both pictures {found:.4f} m, true {DEPTH_M:.4f} m", flush=True)
    for finding in binocular_results(both, HEIGHTS_M, Laws(DRAWS), np.array(LIGHT_E_PER_S), sensor("bayer-raw")):
        interval = "" if finding.low is None else f" ({finding.low:.2f} to {finding.high:.2f})"
        print(f"{finding.label}: {finding.value:.2f}{interval} {finding.unit}", flush=True)


def _pixel(both: Binocular, index: int, point_m: Array) -> Array:
    """Pixel by which one sensor sees a point in its mirror."""
    return np.asarray(image_of(both.views[index], point_m).uv_px)


if __name__ == "__main__":
    main()
