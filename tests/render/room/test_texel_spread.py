"""Texels hold means over what is free of them: a shadow's edge keeps its place, and what is covered has no part."""

from __future__ import annotations

import numpy as np
import pytest

from phibench.render.optics.faces import TexelGrid, face_table
from phibench.render.room.lamp_light import direct_light, whole_lamp
from phibench.render.room.surfaces import Surfaces
from phibench.render.room.texel_points import Texels, spread_texels
from phibench.render.setup.variant import activate
from phibench.scenes.room import default_rig
from phibench.scenes.shapes import Mesh, Shape, Uniform, cuboid, rectangle

VIEW = default_rig().at(0.0)
TEXEL_M, LAMP_M, HIGH_M, EDGE_M, EDGE_X_M = 0.25, 0.4, 2.0, 0.3, 0.06
FLOOR = rectangle("floor", (0, 0, 0), (0, 0, 1), (2.0, 2.0))
CEILING = rectangle("ceiling", (0, 0, HIGH_M + 0.5), (0, 0, -1), (8.0, 8.0))


def spread(*shapes: Shape) -> tuple[Surfaces, Texels]:
    mi = activate()
    surfaces = Surfaces(mi, VIEW, face_table(shapes))
    texels = Texels.of(mi, surfaces, TexelGrid.of(surfaces.table, TEXEL_M))
    surfaces.set_light(texels.grid, np.zeros((len(texels), 3)))
    return surfaces, spread_texels(mi, surfaces, texels)


def places(texels: Texels, side: int) -> tuple[slice, np.ndarray, np.ndarray]:
    """Texels of the floor, and side x side places on each, world x and y, shape (texels, places)."""
    part, _, _ = next(texels.grid.grids())
    a, b = (axis.ravel() for axis in np.meshgrid(*((np.arange(side) + 0.5) / side - 0.5,) * 2))
    middles = texels.grid.points()[0][part]
    return part, middles[:, :1] + TEXEL_M * a, middles[:, 1:2] + TEXEL_M * b


def seen_of_lamp(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Irradiance per radiance at points of the floor: Lambert's form of the part that a straight edge leaves.

    The edge is parallel to a side of the lamp, so that what is left is a rectangle.
    """
    # the line from the point over the edge meets the lamp's plane here; what has a larger x is seen
    cut = np.clip(x + (EDGE_X_M - x) * HIGH_M / EDGE_M, -0.5 * LAMP_M, 0.5 * LAMP_M)
    light = np.zeros(len(x))
    for k in np.flatnonzero(cut < 0.5 * LAMP_M):
        width, middle = 0.5 * LAMP_M - cut[k], 0.5 * (0.5 * LAMP_M + cut[k])
        part = np.array([0, 0, 0, width, 0, 0, 0, LAMP_M, 0, 0, 0, -1, width * LAMP_M, 0], dtype=float)
        light[k] = whole_lamp(np.array([[middle - x[k], -y[k], HIGH_M]]), np.array([[0.0, 0.0, 1.0]]), part)[0]
    return light


@pytest.mark.slow
def test_a_shadow_edge_within_a_texel_leaves_the_mean_of_its_light() -> None:
    """The middle alone is off by 20 % of the light and more.

    The penumbra, a ramp 7 cm wide, is summed over places h = 6.25 cm apart: h^2 / 8 w, 3 % of the texel, and 2 % for
    the rays.
    """
    lamp = rectangle("lamp", (0, 0, HIGH_M), (0, 0, -1), (LAMP_M, LAMP_M), radiance_w_m2_sr=(1.0, 1.0, 1.0))
    board = cuboid("board", (EDGE_X_M - 2.0, 0, EDGE_M), (4.0, 8.0, 1e-4), (0.5, 0.5, 0.5))
    surfaces, texels = spread(FLOOR, CEILING, lamp, board)
    one, other = direct_light(activate(), surfaces, texels, None, 64, 0)
    part, x, y = places(texels, 16)
    fine = seen_of_lamp(x.ravel(), y.ravel()).reshape(x.shape)
    middle = seen_of_lamp(x.mean(axis=1), y.mean(axis=1))
    mean, most = fine.mean(axis=1), fine.max()
    assert np.abs((0.5 * (one + other))[part, 0] - mean).max() < 0.05 * most
    assert np.abs(middle - mean).max() > 0.2 * most


def test_places_below_a_box_are_not_free() -> None:
    box = cuboid("box", (0.3, 0.15, 0.25), (0.5, 0.4, 0.5), (0.5, 0.5, 0.5))
    _, texels = spread(FLOOR, CEILING, box)
    assert texels.spread is not None
    part, x, y = places(texels, 4)
    expected = ((np.abs(x - 0.3) > 0.25) | (np.abs(y - 0.15) > 0.2)).sum(axis=1)
    assert {0, 16} < set(expected)
    np.testing.assert_array_equal(np.array(texels.spread.free)[part], expected)
    np.testing.assert_array_equal(texels.spread.hidden[part], expected == 0)


def test_places_beyond_a_triangle_are_not_free() -> None:
    corners = np.array([[-1.0, -1.0, 0.5], [1.0, -1.0, 0.5], [-1.0, 1.0, 0.5]])
    sail = Mesh("sail", corners, np.array([[0, 1, 2]]), Uniform((0.5, 0.5, 0.5)), two_sided=True)
    _, texels = spread(FLOOR, CEILING, sail)
    assert texels.spread is not None
    free = np.array(texels.spread.free)[list(texels.grid.grids())[-1][0]]
    # half of a square of 64 texels; the diagonal leaves a place or not by rounding
    assert abs(free.sum() - 0.5 * 16 * len(free)) <= 0.5 * np.sqrt(16 * len(free))
