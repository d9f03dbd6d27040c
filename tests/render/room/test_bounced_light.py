"""Light of surfaces: rays that aim at what is bright, and rays by area."""

from __future__ import annotations

import numpy as np
import pytest

from phibench.render.optics.faces import TexelGrid, face_table
from phibench.render.room.bounced_light import FEWEST, BrightTexels, gathered_light, rays_by_area, rays_by_noise
from phibench.render.room.lamp_light import whole_lamp
from phibench.render.room.surfaces import Surfaces
from phibench.render.room.texel_points import Texels
from phibench.render.setup.variant import activate
from phibench.scenes.room import default_rig
from phibench.scenes.shapes import Uniform, rectangle

VIEW = default_rig().at(0.0)
HIGH_M, SPOT_M, ALBEDO, LIGHT = 2.0, 0.4, 0.5, 100.0
RAYS = 64


@pytest.fixture(scope="module", params=[0.0, 1.5], ids=["matt", "coated"])
def floor(request: pytest.FixtureRequest) -> tuple[Surfaces, Texels, np.ndarray, np.ndarray]:
    """A floor below one bright square of a dark ceiling; and its light by Lambert's closed form."""
    mi = activate()
    own = rectangle("floor", (0, 0, 0), (0, 0, 1), (4, 4), texture=Uniform((0.3,) * 3))
    spot = rectangle("spot", (0.5, 0.2, HIGH_M), (0, 0, -1), (SPOT_M, SPOT_M), texture=Uniform((ALBEDO,) * 3))
    ceiling = rectangle(
        "ceiling", (0, 0, HIGH_M + 0.01), (0, 0, -1), (8, 8), texture=Uniform((0.3,) * 3), coat=request.param
    )
    surfaces = Surfaces(mi, VIEW, face_table([own, spot, ceiling]))
    texels = Texels.of(mi, surfaces, TexelGrid.of(surfaces.table, np.full(3, 0.2)))
    light = np.zeros((len(texels), 3))
    light[texels.grid.patch()[0] == 1] = LIGHT
    surfaces.set_light(texels.grid, light)
    place = np.array([0, 0, 0, SPOT_M, 0, 0, 0, SPOT_M, 0, 0, 0, -1, SPOT_M**2, 0])
    here = texels.grid.points()[0][:400]
    exact = whole_lamp(np.array([0.5, 0.2, HIGH_M]) - here, np.tile([0.0, 0.0, 1.0], (400, 1)), place)
    return surfaces, texels, light, ALBEDO * LIGHT / np.pi * exact


def test_rays_that_aim_at_what_is_bright_find_its_light(
    floor: tuple[Surfaces, Texels, np.ndarray, np.ndarray],
) -> None:
    """The mean is kept, 400 texels with 3 % each: 0.15 %. By chance alone a texel is off by more than half.

    A quarter as many more than 64 rays aim at a square of 0.4 m from 2 m and more: the integrand varies by some 10 %.
    """
    surfaces, texels, light, exact = floor
    mi, rays = activate(), np.full(len(texels), RAYS)
    bright = BrightTexels.of(mi, surfaces, texels.grid, light)
    assert bright is not None
    aimed, chance = (gathered_light(mi, surfaces, texels, rays, 3, how)[:400, 0] for how in (bright, None))
    assert aimed.mean() == pytest.approx(exact.mean(), rel=0.005)
    assert np.sqrt(np.mean((aimed / exact - 1.0) ** 2)) < 0.05
    assert np.sqrt(np.mean((chance / exact - 1.0) ** 2)) > 0.5


def test_even_light_has_no_bright_texels(floor: tuple[Surfaces, Texels, np.ndarray, np.ndarray]) -> None:
    surfaces, texels, light, _ = floor
    assert BrightTexels.of(activate(), surfaces, texels.grid, np.ones_like(light)) is None
    assert BrightTexels.of(activate(), surfaces, texels.grid, np.zeros_like(light)) is None


def test_rays_follow_the_area() -> None:
    """A square of the full size has all rays, a quarter of it a quarter, a hundredth the fewest: powers of two."""
    shapes = [rectangle("face", (0, 0, 0), (0, 0, 1), (side, side)) for side in (0.8, 0.4, 0.08)]
    grid = TexelGrid.of(face_table(shapes), np.full(3, 0.4))
    rays = rays_by_area(grid, 100, 0.4)
    assert rays.tolist() == [128] * 4 + [32] * 4 + [FEWEST] * 4
    assert rays_by_area(grid, 3, 0.4).tolist() == [4] * 12


def test_rays_go_where_halves_differ() -> None:
    """A face whose halves differ by 4 % has four times the rays of one with 1 %, and all together as many as before."""
    table = face_table([rectangle("face", (0, 0, 0), (0, 0, 1), (4.0, 4.0)) for _ in range(2)])
    grid = TexelGrid.of(table, np.full(2, 0.4))
    halves = np.full((2, grid.count, 3), 1.0)
    halves[0, :100] += 0.04
    halves[0, 100:] += 0.01
    rays = rays_by_noise(np.full(200, 40), grid, halves)
    assert rays.tolist() == [64] * 100 + [16] * 100
    assert not rays_by_noise(np.zeros(200, dtype=int), grid, halves).any()


def test_small_faces_have_finer_texels() -> None:
    """Eight across, down to half the size and 5 cm; strips narrower than a texel keep it."""
    sizes = ((3.0, 2.0), (0.6, 2.0), (0.2, 0.4), (0.05, 1.0))
    table = face_table([rectangle("face", (0, 0, 0), (0, 0, 1), size) for size in sizes])
    grid = TexelGrid.of(table, 0.1)
    assert list(zip(grid.columns.tolist(), grid.rows.tolist(), strict=True)) == [(30, 20), (8, 27), (4, 8), (2, 10)]
    fine = TexelGrid.of(table, 0.05)
    assert (fine.columns[1], fine.rows[1]) == (12, 40)
