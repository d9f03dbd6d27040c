"""Thousands of damaged meshes and pictures: each makes a room or ends in one sentence, without a warning."""

from __future__ import annotations

import copy
import random
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR
import pytest
from helpers.mesh_files import glb_document, glb_of, scene, write_glb, write_obj, write_ply, y_up

from phibench.datasets.rooms.mesh_placement import MeshLamp, MeshSettings
from phibench.datasets.rooms.mesh_room import mesh_room
from phibench.datasets.rooms.panorama_files import read_light
from phibench.scenes.validation import SceneError

LAMP = MeshLamp((0.0, 0.0, 2.7), (0.0, 0.0, -1.0), (1.2, 0.6))
JUNK = (None, -1, 3, 1e300, "x", [], {}, [1], {"a": 1}, True, 10**30)
FEW, MANY = 12, 600


def as_room(path: Path) -> object:
    up = "y" if path.suffix == ".glb" else "z"
    return mesh_room(MeshSettings(path, 1.0, up, (0.0, 0.0, 0.0), lamps=(LAMP,)))


def outcome(read: Callable[[Path], object], path: Path) -> str:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            read(path)
        except SceneError as error:
            said = str(error)
        else:
            return "read"
    assert said.isprintable()  # one line
    return "refused"


def written(folder: Path, kind: str) -> Path:
    if kind == "glb":
        return write_glb(folder / "a.glb", y_up(scene()))
    if kind == "ply":
        return write_ply(folder / "a.ply")
    if kind == "obj":
        return write_obj(folder)
    light = np.random.default_rng(0).random((32, 64, 3)).astype(np.float32)
    if kind == "hdr":
        cv2.imwrite(str(folder / "a.hdr"), light)
    else:
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        with OpenEXR.File(header, {"RGB": light}) as file:
            file.write(str(folder / "a.exr"))
    return folder / f"a.{kind}"


def damaged(data: bytes, rng: random.Random) -> bytes:
    """Some bytes changed, near the beginning or anywhere, and at times the end cut off."""
    changed = bytearray(data)
    for _ in range(rng.choice([1, 1, 3, 20])):
        changed[rng.randrange(min(len(changed), rng.choice([100, 400, len(changed)])))] = rng.randrange(256)
    return bytes(changed[: rng.randrange(len(changed))] if rng.random() < 0.2 else changed)


def places(node: Any, before: tuple = ()) -> Iterator[tuple]:
    """Every place in a document."""
    if before:
        yield before
    inner = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for key, value in inner:
        yield from places(value, (*before, key))


def with_junk(document: Any, place: tuple, value: object) -> Any:
    changed = copy.deepcopy(document)
    node = changed
    for key in place[:-1]:
        node = node[key]
    if value == "delete":
        del node[place[-1]]
    else:
        node[place[-1]] = value
    return changed


def bytes_fuzzed(folder: Path, kind: str, count: int) -> None:
    source, rng = written(folder, kind), random.Random(kind)
    data, target = source.read_bytes(), folder / f"x.{kind}"
    read = as_room if kind in ("glb", "ply", "obj") else read_light
    found = []
    for _ in range(count):
        target.write_bytes(damaged(data, rng))
        found.append(outcome(read, target))
    assert "refused" in found  # the damage is damage


def document_fuzzed(folder: Path, step: int) -> None:
    source, rng = written(folder, "glb"), random.Random(1)
    document, rest = glb_document(source)
    found = []
    for place in list(places(document))[::step]:
        for value in (rng.choice(JUNK), rng.choice(JUNK), "delete"):
            (folder / "x.glb").write_bytes(glb_of(with_junk(document, place, value), rest))
            found.append(outcome(as_room, folder / "x.glb"))
    assert {"read", "refused"} == set(found)


KINDS = ("glb", "ply", "obj", "hdr", "exr")


@pytest.mark.parametrize("kind", KINDS)
def test_a_few_damaged_files(tmp_path, kind):
    bytes_fuzzed(tmp_path, kind, FEW)


def test_a_few_changed_documents(tmp_path):
    document_fuzzed(tmp_path, 40)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_many_damaged_files(tmp_path, kind):
    bytes_fuzzed(tmp_path, kind, MANY)


@pytest.mark.slow
def test_many_changed_documents(tmp_path):
    document_fuzzed(tmp_path, 1)
