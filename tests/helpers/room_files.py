"""A tiny panorama, a mesh of one file, and a recipe that has rooms of all kinds with them."""

from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from phibench.scenes.random_streams import generator

BOX = (-2.5, 2.5, -2.0, 2.0, 2.6)


def write_panorama(path: Path, rows: int = 32) -> Path:
    """Picture of coloured noise, brighter at the top."""
    noise = generator("tests", "panorama").integers(60, 200, (rows, 2 * rows, 3))
    Image.fromarray((noise + np.linspace(50, 0, rows)[:, None, None]).astype(np.uint8)).save(path)
    return path


def write_mesh(path: Path) -> Path:
    """Box of 5 x 4 x 2.6 m with its floor at y = 0, as glTF has it, and a cabinet of another colour."""
    import trimesh

    room = trimesh.creation.box((5.0, 2.6, 4.0))
    room.apply_translation((0.0, 1.3, 0.0))
    room.invert()
    cabinet = trimesh.creation.box((0.6, 1.5, 0.8))
    cabinet.apply_translation((1.9, 0.75, 1.2))
    for mesh, colour in ((room, (190, 180, 170, 255)), (cabinet, (90, 60, 140, 255))):
        mesh.visual = trimesh.visual.TextureVisuals(
            material=trimesh.visual.material.PBRMaterial(baseColorFactor=np.array(colour, np.uint8))
        )
    trimesh.Scene({"room": room, "cabinet": cabinet}).export(path)
    return path


def write_files(folder: Path) -> Path:
    """Folder with `office.png` and `meshes/hall.glb`."""
    (folder / "meshes").mkdir(parents=True, exist_ok=True)
    write_panorama(folder / "office.png")
    write_mesh(folder / "meshes" / "hall.glb")
    return folder


PANORAMA: dict[str, Any] = {"file": "office.png", "point_m": [0.3, -0.2, 1.4], "box_m": list(BOX)}
MESH: dict[str, Any] = {
    "file": "meshes/hall.glb",
    "metres_per_unit": 1.0,
    "up_axis": "y",
    "floor_point": [0.0, 0.0, 0.0],
    "lamps": [{"centre_m": [0.0, 0.6, 2.55], "normal": [0.0, 0.0, -1.0], "size_m": [1.2, 0.6]}],
}


def recipe(samples: int = 3, **rooms: Any) -> dict[str, Any]:
    """Document of a recipe with a generated room, a panorama and a mesh, unless `rooms` says otherwise."""
    return {
        "dataset": {"name": "kinds"},
        "rooms": {"count": 1, "panoramas": [PANORAMA], "meshes": [MESH], **rooms},
        "laser": {"albedo": "surface"},
        "random": {
            "samples": samples,
            "stroke_m": {"uniform": [0.1, 0.4]},
            "spot": {"azimuth_deg": {"uniform": [0.0, 360.0]}, "height_m": 0.45},
        },
    }


KINDS_TOML = """# Three samples of small images, each in a room of another kind.
[dataset]
name = "kinds"

[rig]
width_px = 160
height_px = 90
fx_px = 178.75
fy_px = 178.75
pixel_pitch_um = 22.4
f_number = 19.2

[rooms]
count = 1

[rooms.properties]
furniture_per_m2 = 0.0
near_objects = 0
floor_objects = 0

[[rooms.panoramas]]
file = "office.png"
point_m = [0.3, -0.2, 1.4]
box_m = [-2.5, 2.5, -2.0, 2.0, 2.6]
texel_m = 0.2

[[rooms.meshes]]
file = "meshes/hall.glb"
metres_per_unit = 1.0
up_axis = "y"
floor_point = [0.0, 0.0, 0.0]

[[rooms.meshes.lamps]]
centre_m = [0.0, 0.6, 2.55]
normal = [0.0, 0.0, -1.0]
size_m = [1.2, 0.6]

[laser]
power_w = 64e-3
albedo = "surface"

[ambient]
quality = "training"
texel_m = 0.5
indirect_texel_m = 0.5
lamp_rays = 4
bounces = 2
bounce_rays = 8
final_rays = 8

[random]
samples = 3
stroke_m = { uniform = [0.2, 0.5] }

[random.spot]
azimuth_deg = { uniform = [0.0, 360.0] }
height_m = 0.45
elevation_deg = { uniform = [-5.0, 20.0] }
"""
