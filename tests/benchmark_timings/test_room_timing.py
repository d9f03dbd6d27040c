"""Times of rooms from files, `pytest --benchmark-enable --benchmark-only`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from helpers.mesh_files import scene, write_glb, y_up
from PIL import Image

from phibench.datasets.rooms.mesh_placement import MeshSettings
from phibench.datasets.rooms.mesh_room import mesh_room
from phibench.datasets.rooms.panorama_room import PanoramaSettings, panorama_room

MOST_S = 5.0
"""For 300 000 triangles, on one core of the machine that the figures were taken on."""


@pytest.mark.benchmark(group="mesh room")
def test_benchmark_mesh_room(benchmark, tmp_path: Path) -> None:
    """A ball of 327 680 triangles with a texture of 4096 x 4096."""
    rng, room = np.random.default_rng(0), scene()
    ball = trimesh.creation.icosphere(subdivisions=7)
    picture = Image.fromarray(rng.integers(0, 255, (4096, 4096, 3), dtype=np.uint8))
    material = trimesh.visual.material.PBRMaterial(name="noise", baseColorTexture=picture)
    ball.visual = trimesh.visual.TextureVisuals(uv=rng.random((len(ball.vertices), 2)), material=material)
    ball.apply_scale(0.4).apply_translation((-2.0, -1.0, 1.0))
    room.add_geometry(ball, node_name="ball")
    settings = MeshSettings(write_glb(tmp_path / "room.glb", y_up(room)), 1.0, "y", (0.0, 0.0, 0.0))
    found = benchmark.pedantic(lambda: mesh_room(settings), rounds=3)
    assert sum(len(shape.triangles) for shape in found.furniture) > 300_000
    assert benchmark.stats.stats.min < MOST_S


@pytest.mark.benchmark(group="panorama room")
@pytest.mark.parametrize("columns", [2048, 8192])
def test_benchmark_panorama_room(benchmark, tmp_path: Path, columns: int) -> None:
    """A JPEG of noise on a box of 8 x 6 x 2.7 m."""
    codes = np.random.default_rng(0).integers(0, 255, (columns // 2, columns, 3), dtype=np.uint8)
    Image.fromarray(codes).save(tmp_path / "panorama.jpg")
    settings = PanoramaSettings(tmp_path / "panorama.jpg", (0.2, 0.1, 1.5), box_m=(-4.0, 4.0, -3.0, 3.0, 2.7))
    found = benchmark.pedantic(lambda: panorama_room(settings), rounds=2)
    assert len(found.surfaces) == 6
