"""Rooms of the three kinds on which renderer and truth are proven: generated, of meshes, of panoramas. No test file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenEXR
import trimesh
from helpers.mesh_files import SIZE, coloured, corners, scene, side, write_glb, write_ply, y_up
from PIL import Image

from phibench.datasets.rooms.mesh_placement import MeshLamp, MeshSettings
from phibench.datasets.rooms.mesh_room import mesh_room
from phibench.datasets.rooms.panorama_room import PanoramaSettings, panorama_room
from phibench.datasets.rooms.room_sources import GeneratedRoom
from phibench.scenes.room import Room
from phibench.scenes.worlds.room_properties import drawn_properties

MESHES = ("curved", "vault", "colours")
PANORAMAS = ("box", "flat box", "mesh")
LAMPS = (
    MeshLamp((-1.2, 0.8, 2.7), (0.0, 0.0, -1.0), (1.2, 0.6)),
    MeshLamp((1.5, -1.0, 2.7), (0.0, 0.0, -1.0), (0.6, 0.6), (2.4, 3.0, 3.6)),
)


def generated(number: int) -> Room:
    """Room of the default distributions, from a stream that no recipe has."""
    return GeneratedRoom(drawn_properties("proof", number), ("proof", number)).build()


# Meshes.


def mesh_settings(kind: str, folder: Path, lamps: tuple[MeshLamp, ...] = LAMPS) -> MeshSettings:
    """One of `MESHES`, written to a folder: glTF with y up, glTF in centimetres with z up, PLY with face colours."""
    if kind == "colours":
        return MeshSettings(_write_colours(folder / "colours.ply"), 1.0, "z", (0.0, 0.0, 0.0), 25.0, lamps)
    if kind == "vault":
        path = write_glb(folder / "vault.glb", _vault().apply_scale(100.0))
        return MeshSettings(path, 0.01, "z", (0.0, 0.0, 0.0), lamps=lamps)
    path = write_glb(folder / "curved.glb", y_up(_curved()))
    return MeshSettings(path, 1.0, "y", (0.0, 0.0, 0.0), lamps=lamps)


def of_mesh(kind: str, folder: Path) -> Room:
    return mesh_room(mesh_settings(kind, folder))


def _curved() -> trimesh.Scene:
    """A textured floor and table (`mesh_files`), a torus, a sphere and a box with a picture on all sides."""
    room = scene(lamp=False)
    torus = trimesh.creation.torus(0.35, 0.12, 32, 16)
    torus.apply_translation((-1.6, 0.3, 0.13))
    ball = trimesh.creation.icosphere(3, 0.4)
    ball.apply_translation((0.4, -1.4, 0.41))
    _place(room, "torus", torus, _plain(torus, (0.7, 0.3, 0.2)))
    _place(room, "ball", ball, _plain(ball, (0.2, 0.5, 0.7)))
    picture = np.kron(np.random.default_rng(8).integers(20, 255, (8, 8, 3), dtype=np.uint8), np.ones((4, 4, 1)))
    box = trimesh.creation.box((0.7, 0.5, 1.1))
    box.apply_translation((-1.5, -1.5, 0.56))
    box = trimesh.Trimesh(box.triangles.reshape(-1, 3), np.arange(36).reshape(-1, 3), process=False)
    uv = np.tile([[0.0, 0.0], [1.0, 0.1], [0.9, 1.0]], (12, 1))
    material = trimesh.visual.material.PBRMaterial(name="print", baseColorTexture=Image.fromarray(np.uint8(picture)))
    _place(room, "box", box, trimesh.visual.TextureVisuals(uv=uv, material=material))
    return room


def _vault() -> trimesh.Scene:
    """A hall under a barrel of 24 strips that is open at both ends, with a cone, a tube and a capsule in it."""
    room = trimesh.Scene()
    x, y, h = SIZE[0] / 2.0, SIZE[1] / 2.0, SIZE[2]
    for name, points in corners().items():
        if name != "ceiling":
            room.add_geometry(side(points, coloured("paint", (0.5, 0.55, 0.6))), node_name=name, geom_name=name)
    turn = np.linspace(0.0, np.pi, 25)
    arc = np.stack([y * np.cos(turn), h + 0.9 * np.sin(turn)], axis=-1)
    points = np.concatenate([np.column_stack([np.full(25, at), arc]) for at in (-x, x)])
    k = np.arange(24)
    strips = np.concatenate([np.stack([k, k + 1, k + 26], -1), np.stack([k, k + 26, k + 25], -1)])
    _place(room, "barrel", trimesh.Trimesh(points, strips, process=False), None)
    for name, shape, at in (
        ("cone", trimesh.creation.cone(0.4, 1.2, sections=24), (1.5, -1.2, 0.01)),
        ("tube", trimesh.creation.annulus(0.2, 0.35, 0.8, sections=24), (-1.4, 1.1, 0.45)),
        ("capsule", trimesh.creation.capsule(0.7, 0.25, count=(12, 12)), (-1.2, -1.3, 0.3)),
    ):
        shape.apply_translation(at)
        _place(room, name, shape, _plain(shape, (0.3, 0.6, 0.3)))
    return room


def _write_colours(path: Path) -> Path:
    """The plain room of `mesh_files` with a ball and a turned ring, a colour at every vertex."""
    walls = trimesh.load(write_ply(path), process=False)
    ball, ring = trimesh.creation.icosphere(2, 0.5), trimesh.creation.torus(0.5, 0.1, 24, 12)
    ball.apply_translation((1.6, 0.9, 0.6))
    ring.apply_transform(trimesh.transformations.rotation_matrix(0.7, (1.0, 0.5, 0.0), (0.0, 0.0, 0.0)))
    ring.apply_translation((-1.7, -0.9, 0.8))
    for shape in (ball, ring):
        tints = np.random.default_rng(len(shape.vertices)).integers(30, 256, (len(shape.vertices), 4), dtype=np.uint8)
        shape.visual = trimesh.visual.ColorVisuals(shape, vertex_colors=tints)
    path.write_bytes(trimesh.util.concatenate([walls, ball, ring]).export(file_type="ply"))
    return path


def _plain(shape: trimesh.Trimesh, colour: tuple[float, ...]) -> trimesh.visual.TextureVisuals:
    material = trimesh.visual.material.PBRMaterial(name="plain", baseColorFactor=[*colour, 1.0])
    return trimesh.visual.TextureVisuals(uv=np.zeros((len(shape.vertices), 2)), material=material)


def _place(room: trimesh.Scene, name: str, shape: trimesh.Trimesh, visual: object) -> None:
    if visual is not None:
        shape.visual = visual
    room.add_geometry(shape, node_name=name, geom_name=name)


# Panoramas.

ROWS = 256
POINT_M = (0.4, -0.3, 1.5)
HEADING_DEG = {"box": 0.0, "flat box": 130.0, "mesh": -75.0, "high box": -20.0}
BOX_M = {
    "box": (-3.0, 2.5, -2.0, 2.4, 2.7),
    "flat box": (-6.5, 7.0, -4.0, 3.0, 2.4),
    "high box": (-2.0, 6.0, -5.0, 2.5, 4.2),
}
LAMP_DIRECTIONS = ((0.3, 0.5, 0.8), (-0.7, 0.2, 0.6), (0.9, -0.4, 0.1))
"""Of three lamps in the picture, 40 times as bright as the rest and 15 degrees wide."""


def light_in(directions: np.ndarray) -> np.ndarray:
    """Light, shape (..., 3), in directions of the picture's own frame: waves, stripes of 9 degrees, three lamps."""
    d = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    x, y, z = np.moveaxis(d, -1, 0)
    stripes = 0.4 * np.tanh(4.0 * np.sin(20.0 * np.arctan2(y, x))) * (1.0 - z * z)
    light = np.stack([2.0 + x + 0.5 * y * z + stripes, 1.5 + y - stripes, 1.2 + 0.8 * z - 0.4 * x * y], axis=-1)
    for lamp in LAMP_DIRECTIONS:
        angle = np.arccos(np.clip(d @ np.array(lamp) / np.linalg.norm(lamp), -1.0, 1.0))
        light += 40.0 / (1.0 + np.exp((angle - np.radians(7.5)) / np.radians(0.6)))[..., None]
    return light


def picture_directions(rows: int) -> np.ndarray:
    """Directions of the middles of the pixels of a panorama, shape (rows, 2 rows, 3)."""
    elevation = np.radians(90.0 - (np.arange(rows) + 0.5) * 180.0 / rows)[:, None]
    azimuth = np.radians(180.0 - (np.arange(2 * rows) + 0.5) * 180.0 / rows)[None, :]
    d = np.broadcast_arrays(np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation))
    return np.stack(d, axis=-1)


def panorama_settings(kind: str, folder: Path, rows: int = ROWS) -> PanoramaSettings:
    """One of `PANORAMAS`, written to a folder; 1 W/(m^2 sr) per unit of `light_in`."""
    path, light = folder / f"{kind}-{rows}.exr", light_in(picture_directions(rows))
    planes = {name: np.ascontiguousarray(light[..., k], np.float32) for k, name in enumerate("RGB")}
    with OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, planes) as file:
        file.write(str(path))
    mesh = mesh_settings("curved", folder, ()) if kind == "mesh" else None
    return PanoramaSettings(path, POINT_M, HEADING_DEG[kind], BOX_M.get(kind), mesh, radiance_scale=1.0)


def of_panorama(kind: str, folder: Path) -> Room:
    return panorama_room(panorama_settings(kind, folder))
