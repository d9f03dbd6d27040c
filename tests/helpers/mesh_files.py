"""Mesh rooms made by code: a box with a textured floor, a table and a lamp, as glTF, OBJ and PLY."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image

from phibench.datasets.rooms.mesh_parts import MeshPart

SIZE = (6.0, 5.0, 2.8)
"""Of the room in x, y and height, metres; the origin is in the middle of its floor."""
FLOOR_PICTURE = np.random.default_rng(4).integers(0, 256, (50, 60, 3), dtype=np.uint8)


def corners(size: tuple[float, ...] = SIZE) -> dict[str, np.ndarray]:
    """Corners, shape (4, 3), of the six sides, z up, against the clock seen from inside."""
    x, y, h = size[0] / 2.0, size[1] / 2.0, size[2]
    return {
        "floor": np.array([[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0]]),
        "ceiling": np.array([[-x, -y, h], [-x, y, h], [x, y, h], [x, -y, h]]),
        "wall_east": np.array([[x, -y, 0], [x, -y, h], [x, y, h], [x, y, 0]]),
        "wall_west": np.array([[-x, y, 0], [-x, y, h], [-x, -y, h], [-x, -y, 0]]),
        "wall_north": np.array([[x, y, 0], [x, y, h], [-x, y, h], [-x, y, 0]]),
        "wall_south": np.array([[-x, -y, 0], [-x, -y, h], [x, -y, h], [x, -y, 0]]),
    }


def side(points: np.ndarray, visual: Any) -> trimesh.Trimesh:
    return trimesh.Trimesh(points, [[0, 1, 2], [0, 2, 3]], visual=visual, process=False)


def coloured(name: str, colour: tuple[float, ...], **options: Any) -> Any:
    material = trimesh.visual.material.PBRMaterial(name=name, baseColorFactor=[*colour, 1.0], **options)
    return trimesh.visual.TextureVisuals(uv=np.zeros((4, 2)), material=material)


def scene(size: tuple[float, ...] = SIZE, lamp: bool = True, scale: float = 1.0) -> trimesh.Scene:
    """Room, z up; `scale` is units of the file per metre."""
    result = trimesh.Scene()
    uv = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    for name, points in corners(size).items():
        if name == "floor":
            material = trimesh.visual.material.PBRMaterial(
                name="tiles", baseColorTexture=Image.fromarray(FLOOR_PICTURE), baseColorFactor=[1.0, 1.0, 1.0, 1.0]
            )
            visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
        else:
            visual = coloured("paint", (0.6, 0.4, 0.2))
        result.add_geometry(side(points * scale, visual), node_name=name, geom_name=name)
    table = trimesh.creation.box((1.0, 0.6, 0.7))
    table.visual = trimesh.visual.TextureVisuals(
        material=trimesh.visual.material.PBRMaterial(name="wood", baseColorFactor=[0.4, 0.2, 0.1, 1.0])
    )
    table.apply_translation((2.0, 1.0, 0.36)).apply_scale(scale)
    result.add_geometry(table, node_name="table", geom_name="table")
    if lamp:
        points = corners((1.2, 0.6, 2.75))["ceiling"] * scale
        visual = coloured("glow", (0.0, 0.0, 0.0), emissiveFactor=[1.0, 0.9, 0.7])
        result.add_geometry(side(points, visual), node_name="panel", geom_name="panel")
    return result


def y_up(room: trimesh.Scene) -> trimesh.Scene:
    """The same with the file's y axis up, as glTF has it: file (x, y, z) is world (x, -z, y)."""
    turned = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]], float)
    return room.apply_transform(turned)


def write_glb(path: Path, room: trimesh.Scene) -> Path:
    path.write_bytes(room.export(file_type="glb"))
    return path


def glb_document(path: Path) -> tuple[Any, bytes]:
    """Document of a .glb file, and the chunks after it."""
    data = path.read_bytes()
    length = struct.unpack("<I", data[12:16])[0]
    return json.loads(data[20 : 20 + length]), data[20 + length :]


def glb_of(document: Any, rest: bytes) -> bytes:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 20 + len(text) + len(rest))
    return head + struct.pack("<I4s", len(text), b"JSON") + text + rest


def edited_glb(source: Path, path: Path, edit: Any) -> Path:
    """Copy of a .glb whose document `edit` has changed."""
    document, rest = glb_document(source)
    edit(document)
    path.write_bytes(glb_of(document, rest))
    return path


def write_obj(folder: Path, picture: bool = True) -> Path:
    """Room as OBJ with materials and a picture of the floor; quads, one object a side."""
    lines, count = ["mtllib room.mtl"], 0
    for name, points in corners().items():
        lines += [f"o {name}", *(f"v {x} {y} {z}" for x, y, z in points), "vt 0 0", "vt 1 0", "vt 1 1", "vt 0 1"]
        lines += [f"usemtl {'tiles' if name == 'floor' else 'paint'}"]
        lines += ["f " + " ".join(f"{count + k}/{count + k}" for k in range(1, 5))]
        count += 4
    (folder / "room.obj").write_text("\n".join(lines) + "\n")
    materials = "newmtl tiles\nKd 1 1 1\nmap_Kd floor.png\nnewmtl paint\nKd 0.5 0.5 0.5\n"
    (folder / "room.mtl").write_text(materials)
    if picture:
        Image.fromarray(FLOOR_PICTURE).save(folder / "floor.png")
    return folder / "room.obj"


def write_ply(path: Path, colours: bool = True) -> Path:
    """Room as PLY with a colour at each vertex; the four of a side differ."""
    points = np.concatenate(list(corners().values()))
    faces = np.array([[4 * k + i for i in triangle] for k in range(6) for triangle in ((0, 1, 2), (0, 2, 3))])
    tints = np.random.default_rng(1).integers(0, 256, (len(points), 4), dtype=np.uint8)
    tints[:, 3] = 255
    mesh = trimesh.Trimesh(points, faces, vertex_colors=tints if colours else None, process=False)
    path.write_bytes(mesh.export(file_type="ply"))
    return path


def area(parts: tuple[MeshPart, ...] | list[MeshPart]) -> float:
    """Of all triangles of a mesh, m^2."""
    corners = np.concatenate([part.vertices[part.triangles] for part in parts])
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return float(0.5 * np.linalg.norm(cross, axis=1).sum())


def normals(part: MeshPart) -> np.ndarray:
    """Unit normals of the triangles, shape (n, 3)."""
    a, b, c = np.moveaxis(part.vertices[part.triangles], 1, 0)
    cross = np.cross(b - a, c - a)
    return cross / np.linalg.norm(cross, axis=1, keepdims=True)
