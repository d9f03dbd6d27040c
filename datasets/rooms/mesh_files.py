"""Mesh files: glTF (.glb, .gltf), OBJ and PLY as parts of one material each, with linear colours.

Each format is read by its definition in a module of its own. What a file states is read rightly or refused by name:
a reading library would pass over it, or make it up.

Colours become linear. Pictures, the colours of OBJ materials and vertex colours of OBJ and PLY are sRGB. Factors and
vertex colours of glTF are linear by its specification. A triangle with vertex colours has their mean.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import InputFile
from phibench.datasets.rooms.gltf_file import gltf_parts
from phibench.datasets.rooms.mesh_parts import (
    REMEDY,
    Companions,
    MeshPart,
    check_count,
    check_part,
    check_parts,
    damaged,
    named_parts,
)
from phibench.datasets.rooms.obj_file import obj_parts
from phibench.datasets.rooms.ply_file import ply_parts
from phibench.datasets.rooms.polygons import CuttingError
from phibench.datasets.rooms.room_files import RoomError

_READERS = {".glb": gltf_parts, ".gltf": gltf_parts, ".obj": obj_parts, ".ply": ply_parts}
SUFFIXES = tuple(_READERS)


def read_mesh(path: Path, one_file: bool = False) -> tuple[MeshPart, ...]:
    """Read the parts of a mesh file, in the order of their names; `one_file` refuses one that names others.

    Raises
    ------
    RoomError
        If the file is missing, damaged, of another kind, without triangles, has what is not read, or names what is not
        there.
    """
    file = InputFile(path, REMEDY, RoomError)
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise RoomError(f"{path} is no mesh: give a file that ends in {', '.join(SUFFIXES)}")
    try:
        with np.errstate(all="ignore"):
            parts = reader(file, Companions(file, one_file))
    except (DatasetError, MemoryError):
        raise
    except CuttingError as error:
        raise file.fault(f"has {error}: export triangles") from error
    except Exception as error:  # documents and arrays can contradict each other in any way
        raise damaged(file) from error
    named = named_parts(part for part in parts if len(part.triangles))
    check_count(file, sum(len(part.triangles) for part in named))
    check_parts(file, len(named))
    for part in named:
        check_part(file, part)
    return named
