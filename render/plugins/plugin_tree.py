"""Tree of standard Mitsuba plugins, with PLY and PFM bytes of meshes and images; its dictionary for `mi.load_dict`.

The tree is plain Python: it is written as XML (`datasets.scene.scene_export`) without Mitsuba, whose own writer
distorts boxes. Both forms come from one tree and load as the same scene.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.scenes.frames import Array, Vector

IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class Rgb:
    """One number for each band."""

    values: Vector


@dataclass(frozen=True)
class SceneSetting:
    """Whole number that whoever opens the scene may change by its name."""

    name: str
    value: int


@dataclass(frozen=True, eq=False)
class BitmapPlugin:
    """Linear values, shape (rows, columns, 3), float32; v = 0 is the edge of the first row."""

    name: str
    values: NDArray[np.float32]
    suffix = "pfm"

    def data(self) -> bytes:
        """Bytes of a PFM file, whose last row comes first.

        Mitsuba reads OpenEXR with the threads of Dr.Jit, and waits for ever where that has one.
        """
        rows, columns = self.values.shape[:2]
        return f"PF\n{columns} {rows}\n-1.0\n".encode() + self.values[::-1].astype("<f4").tobytes()


@dataclass(frozen=True, eq=False)
class Triangles:
    """Triangle mesh; its corners in millimetres.

    Attributes
    ----------
    corners_mm : array, shape (N, 3)
    triangles : int array, shape (M, 3)
    normals, uv : arrays, shapes (N, 3) and (N, 2), or None
    """

    name: str
    corners_mm: Array
    triangles: IntArray
    normals: Array | None = None
    uv: Array | None = None
    suffix = "ply"

    def data(self) -> bytes:
        """Bytes of a binary PLY file."""
        columns = {"xyz": self.corners_mm, "nx ny nz": self.normals, "u v": self.uv}
        names = ["x", "y", "z", *("nx", "ny", "nz") * (self.normals is not None), *("u", "v") * (self.uv is not None)]
        vertices = np.concatenate([values for values in columns.values() if values is not None], axis=1)
        faces = np.zeros(len(self.triangles), dtype=[("n", "u1"), ("corners", "<i4", 3)])
        faces["n"], faces["corners"] = 3, self.triangles
        head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
        head += [f"property float {name}" for name in names]
        head += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
        return "\n".join(head).encode() + vertices.astype("<f4").tobytes() + faces.tobytes()


@dataclass(frozen=True, eq=False)
class Plugin:
    """Instance of a Mitsuba plugin.

    Attributes
    ----------
    kind : str
        Mitsuba's class of plugins: "shape", "bsdf", "emitter", "texture", "sensor", "film", ...
    type : str
        Name of the plugin.
    values : mapping
        Parameters; an array of shape (4, 4) is a transform, one of shape (3,) a point.
    name : str
        Identifier in the scene, of a shape.
    label : str
        For people.
    """

    kind: str
    type: str
    values: Mapping[str, Any] = field(default_factory=dict)
    name: str = ""
    label: str = ""

    def all_values(self) -> Iterator[Any]:
        """Parameters of this plugin and of those within it."""
        for value in self.values.values():
            yield value
            if isinstance(value, Plugin):
                yield from value.all_values()


Value = float | bool | str | Rgb | SceneSetting | BitmapPlugin | Triangles | Plugin | Array


def mitsuba_dict(mi: ModuleType, scene: Plugin) -> dict[str, Any]:
    """Dictionary that `mi.load_dict` takes; meshes in it are loaded already.

    Parameters
    ----------
    mi : module
        Mitsuba with its variant set.
    """
    return {"type": scene.type} | {name: _taken(mi, value) for name, value in scene.values.items()}


def _taken(mi: ModuleType, value: Value) -> Any:
    if isinstance(value, Plugin):
        if isinstance(value.values.get("filename"), Triangles):
            return _mesh(mi, value)
        if isinstance(picture := value.values.get("filename"), BitmapPlugin):
            entry = mitsuba_dict(mi, value)
            del entry["filename"]
            return entry | {"bitmap": mi.Bitmap(np.array(picture.values, dtype=np.float32))}
        return mitsuba_dict(mi, value)
    if isinstance(value, Rgb):
        return {"type": "rgb", "value": [float(x) for x in value.values]}
    if isinstance(value, SceneSetting):
        return value.value
    if isinstance(value, np.ndarray):
        return mi.ScalarTransform4f(value) if value.ndim == 2 else [float(x) for x in value]
    return value


def _mesh(mi: ModuleType, shape: Plugin) -> Any:
    """Mesh, loaded from a file that does not stay: one that Mitsuba makes in memory cannot shine."""
    triangles = shape.values["filename"]
    assert isinstance(triangles, Triangles)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "mesh.ply")
        path.write_bytes(triangles.data())
        entry = {"type": shape.type} | {k: _taken(mi, v) for k, v in shape.values.items() if k != "filename"}
        return mi.load_dict(entry | {"filename": str(path), "id": shape.name})
