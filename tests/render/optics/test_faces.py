"""Faces of shapes: closed solids, areas and volumes of closed forms, texture places at the corners."""

from __future__ import annotations

import math

import numpy as np
import pytest
from helpers.oracles import TARGETS

from phibench.render.optics.faces import FaceTable, face_table
from phibench.scenes.frames import Pose, rotation_xyz
from phibench.scenes.rig import Rig
from phibench.scenes.room import lab
from phibench.scenes.shapes import Bitmap, Checker, Cuboid, Mesh, Prism, Uniform, faces, rectangle
from phibench.scenes.validation import SceneError

TURNED = Pose("world", "shape", (0.3, -0.2, 1.1), rotation_xyz(0.4, -0.7, 1.9))
SOLIDS = {
    "cuboid": (Cuboid("a", TURNED, (0.4, 0.7, 0.2)), 0.4 * 0.7 * 0.2),
    "prism": (Prism("b", TURNED, 0.3, 0.8, 7), 0.8 * 3.5 * 0.3**2 * math.sin(2.0 * math.pi / 7)),
}


def volume(table: FaceTable) -> float:
    """By Gauss's theorem: positive only if all faces look outwards."""
    a, b, c = np.moveaxis(table.corners_m, 1, 0)
    return float(np.einsum("ti,ti->", a, np.cross(b, c)) / 6.0)


@pytest.mark.parametrize("name", SOLIDS)
def test_solids_are_closed_and_look_outwards(name):
    """Their volume is the closed form's (1e-12 of rounding), and normals agree with the order of the corners."""
    solid, expected = SOLIDS[name]
    table = face_table([solid])
    assert volume(table) == pytest.approx(expected, rel=1e-12)
    a, b, c = np.moveaxis(table.corners_m, 1, 0)
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    np.testing.assert_allclose(normal, table.normal[table.patch], atol=1e-12)


def test_sides_of_a_cuboid_are_those_of_its_rectangles():
    """The table takes a short cut past `shapes.faces`: the same frames and sizes, to rounding."""
    for pose in (TURNED, Pose("world", "shape", (0.3, -0.2, 1.1))):
        box = Cuboid("a", pose, (0.4, 0.7, 0.2))
        table = face_table([box])
        for k, side in enumerate(faces(box)):
            np.testing.assert_allclose(table.centre_m[k], side.T_world_shape.t, atol=1e-15)
            np.testing.assert_allclose(table.x_axis[k], side.T_world_shape.R[:, 0], atol=1e-15)
            np.testing.assert_allclose(table.y_axis[k], side.T_world_shape.R[:, 1], atol=1e-15)
            np.testing.assert_allclose(table.size_m[k], side.size_m, atol=1e-15)


def test_triangles_lie_in_their_patches():
    """In its plane and inside its rectangle, for every shape of the lab with its robot."""
    table = face_table(lab(TARGETS).shapes(Rig().at(0.4)))
    points, patch = table.corners_m.reshape(-1, 3), np.repeat(table.patch, 3)
    height = np.einsum("ni,ni->n", points - table.centre_m[patch], table.normal[patch])
    assert np.abs(height).max() < 1e-12
    assert np.all(np.abs(table.local_m(patch, points)) <= 0.5 * table.size_m[patch] + 1e-12)


def test_mesh_keeps_the_places_of_its_corners_on_the_texture():
    rng = np.random.default_rng(0)
    vertices, texels = rng.normal(size=(9, 3)), rng.uniform(0.0, 4.0, (5, 3, 2))
    triangles = np.array([[0, 1, 2], [3, 4, 5], [6, 7, 8], [0, 4, 8], [2, 4, 6]])
    bitmap = Bitmap(rng.random((4, 4, 4)), (1.0, 1.0))
    table = face_table([Mesh("m", vertices, triangles, bitmap, texels)])
    local = table.local_m(np.repeat(table.patch, 3), table.corners_m.reshape(-1, 3))
    place = np.einsum("nij,nj->ni", np.repeat(table.texels, 3, axis=0), np.c_[local, np.ones(15)])
    np.testing.assert_allclose(place, texels.reshape(-1, 2), atol=1e-9)


def test_triangles_without_area_are_left_out():
    mesh = Mesh("m", np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2], [0, 1, 3]]))
    assert len(face_table([mesh]).patch) == 1


def test_laser_albedo_is_that_of_the_texture():
    """A table answers as the textures themselves, in metres from the surface's centre."""
    rng = np.random.default_rng(1)
    bitmap = Bitmap(rng.random((5, 7, 4)), (0.01, 0.02), (-0.1, 0.03))
    checker = Checker((0.1, 0.2, 0.3), (0.6, 0.5, 0.4), (0.05, 0.07), (-0.3, -0.2))
    walls = [
        rectangle(str(i), (0.0, 0.0, float(i)), (0.0, 0.0, 1.0), (0.6, 0.4), texture=texture)
        for i, texture in enumerate((Uniform((0.3, 0.2, 0.1)), checker, bitmap))
    ]
    table = face_table(walls)
    local = rng.uniform(-0.2, 0.2, (300, 2))
    patch = np.arange(300) % 3
    points = table.centre_m[patch] + local[:, :1] * table.x_axis[patch] + local[:, 1:] * table.y_axis[patch]
    expected = [walls[k].texture.laser_albedo(xy) for k, xy in zip(patch, local, strict=True)]
    np.testing.assert_allclose(table.laser_albedo(patch, points), np.array(expected, float), atol=1e-12)


def test_photographed_walls_carry_a_spot_and_lamps_do_not():
    """The bitmap's fourth value decides on what shines: 0 makes a screen. A lamp has none, whatever its texture."""
    values = np.ones((2, 2, 4)) * [3.0, 2.0, 1.0, 0.4]
    photographed, screen = (Bitmap(values * [1, 1, 1, part], (0.1, 0.1), is_radiance=True) for part in (1.0, 0.0))
    walls = [
        rectangle("wall", (0.0, 0.0, 1.0), (0.0, 0.0, 1.0), (0.4, 0.4), texture=photographed),
        rectangle("screen", (0.0, 0.0, 2.0), (0.0, 0.0, 1.0), (0.4, 0.4), texture=screen),
        rectangle("lamp", (0.0, 0.0, 3.0), (0.0, 0.0, 1.0), (0.4, 0.4), radiance_w_m2_sr=(1.0, 1.0, 1.0)),
    ]
    table = face_table(walls)
    np.testing.assert_allclose(table.laser_albedo(np.arange(3), table.centre_m), [0.4, 0.0, 0.0], atol=1e-7)


def test_bitmap_repeats_and_meets_its_texels():
    values = np.random.default_rng(2).random((3, 4, 4)).astype(np.float32)
    bitmap = Bitmap(values, (0.1, 0.2), (0.05, 0.0))
    row, column = np.mgrid[-3:6, -4:8]
    centres = np.stack([0.05 + (column + 0.5) * 0.1, (row + 0.5) * 0.2], axis=-1)
    np.testing.assert_allclose(bitmap.sample(centres), values[row % 3, column % 4], atol=1e-6)


@pytest.mark.parametrize(
    ("values", "word"),
    [(np.zeros((2, 2, 3)), "shape"), (np.full((1, 1, 4), 1.5), "albedos"), (np.full((1, 1, 4), np.nan), "finite")],
)
def test_impossible_bitmaps_are_refused(values, word):
    with pytest.raises(SceneError, match=word):
        Bitmap(values, (0.1, 0.1))


def test_radiance_may_be_above_1_and_the_lasers_albedo_not():
    assert Bitmap([[[5.0, 5.0, 5.0, 1.0]]], (0.1, 0.1), is_radiance=True).values.max() == 5.0
    with pytest.raises(SceneError, match="laser's albedo up to 1"):
        Bitmap([[[5.0, 5.0, 5.0, 1.5]]], (0.1, 0.1), is_radiance=True)
