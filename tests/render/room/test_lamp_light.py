"""Tests of the light of lamps: Lambert's closed form against a sum over the lamp."""

import numpy as np
import pytest

from phibench.render.optics.faces import TexelGrid, face_table
from phibench.render.room.lamp_light import direct_light, lamps_in_coats, whole_lamp
from phibench.render.room.surfaces import Surfaces
from phibench.render.room.texel_points import Texels
from phibench.render.setup.variant import activate
from phibench.scenes.room import default_rig
from phibench.scenes.shapes import rectangle

N = 400  # midpoints along each edge: the sum errs by h^2 / 24 of a second derivative, below 1e-5 at these distances


@pytest.mark.parametrize("seed", range(5))
def test_the_light_of_a_whole_lamp_is_the_sum_over_its_parts(seed: int) -> None:
    """L cos cos' / r^2 over the area, for a rectangle that is turned, from points below it."""
    random = np.random.default_rng([14, seed])
    x = random.normal(size=3)
    x /= np.linalg.norm(x)
    y = np.cross(x, random.normal(size=3))
    y /= np.linalg.norm(y)
    normal = np.cross(x, y)
    size = random.uniform(300.0, 900.0, 2)
    lamp = np.concatenate([np.zeros(3), size[0] * x, size[1] * y, normal, [size.prod(), 0.0]])
    points = random.uniform(-600.0, 600.0, (20, 2)) @ np.array([x, y]) + random.uniform(500.0, 3000.0, (20, 1)) * normal
    texels = -normal + 0.2 * random.normal(size=(20, 3))
    texels /= np.linalg.norm(texels, axis=1, keepdims=True)

    a, b = np.meshgrid(*((np.arange(N) + 0.5) / N - 0.5,) * 2)
    places = a.ravel()[:, None] * size[0] * x + b.ravel()[:, None] * size[1] * y
    way = places - points[:, None]
    r = np.linalg.norm(way, axis=2)
    here, there = np.einsum("nmi,ni->nm", way, texels) / r, -way @ normal / r
    above = here.min(axis=1) > 0.0
    assert above.sum() >= 10, "most texels must have the whole lamp above their horizon"
    expected = (np.maximum(here, 0.0) * there / r**2).mean(axis=1) * size.prod()
    np.testing.assert_allclose(whole_lamp(-points, texels, lamp)[above], expected[above], rtol=2e-5)


def test_the_horizon_cuts_a_lamp() -> None:
    """As above, of which the horizon leaves a part. The sum errs where it cuts a cell: by 1 / N^2 of a bare cosine."""
    lamp = np.array([0, 0, 0, 600, 0, 0, 0, 400, 0, 0, 0, -1, 600 * 400, 0], dtype=float)
    a, b = np.meshgrid(*((np.arange(N) + 0.5) / N - 0.5,) * 2)
    places = np.stack([a.ravel() * 600, b.ravel() * 400, np.zeros(N * N)], axis=-1)
    random = np.random.default_rng(15)
    cut = 0
    for _ in range(40):
        point, texel = np.array([*random.uniform(-500, 500, 2), -random.uniform(50, 400)]), random.normal(size=3)
        texel /= np.linalg.norm(texel)
        way = places - point
        r = np.linalg.norm(way, axis=1)
        cos = way @ texel / r
        cut += bool(cos.min() < 0.0 < cos.max())
        expected = np.mean(np.maximum(cos, 0.0) * -point[2] / r**3) * 600 * 400
        assert whole_lamp(-point[None], texel[None], lamp)[0] == pytest.approx(expected, rel=2e-3, abs=1e-5)
    assert cut >= 10


def test_photons_bring_what_a_coat_mirrors_of_a_lamp() -> None:
    """A lamp on the floor shines up at a coated ceiling: the floor gets the lamp's image, times Fresnel's reflectance.

    Sum over the image and Fresnel's formulas in float64. 2 x 131 072 photons, of which a hundredth reaches a texel of
    0.25 m: 3 % each by chance, 0.2 % their mean over 256 texels.
    """
    side, high, index, radiance = 4.0, 1.0, 1.5, np.array([10.0, 6.0, 3.0])
    floor = rectangle("floor", (0, 0, 0), (0, 0, 1), (side, side))
    ceiling = rectangle("ceiling", (0, 0, high), (0, 0, -1), (20.0, 20.0), coat=index)
    lamp = rectangle("lamp", (0.3, 0.2, 0.01), (0, 0, 1), (0.5, 0.3), radiance_w_m2_sr=tuple(radiance))
    mi = activate()
    surfaces = Surfaces(mi, default_rig().at(0.0), face_table([floor, ceiling, lamp]))
    texels = Texels.of(mi, surfaces, TexelGrid.of(surfaces.table, 0.25))
    surfaces.set_light(texels.grid, np.zeros((len(texels), 3)))
    found = (0.5 * sum(lamps_in_coats(mi, surfaces, texels, seed) for seed in (3, 4)))[:256]

    a, b = ((np.arange(40) + 0.5) / 40 - 0.5 for _ in range(2))
    image = np.stack(np.meshgrid(0.3 + 0.5 * a, 0.2 + 0.3 * b, [2.0 * high - 0.01]), axis=-1).reshape(-1, 3)
    way = image - texels.grid.points()[0][:256, None]
    r = np.linalg.norm(way, axis=2)
    cos = way[..., 2] / r
    inside = np.sqrt(1.0 - (1.0 - cos**2) / index**2)
    s, p = (cos - index * inside) / (cos + index * inside), (index * cos - inside) / (index * cos + inside)
    expected = (0.5 * (s**2 + p**2) * cos**2 / r**2).mean(axis=1)[:, None] * 0.15 * radiance
    lit = np.abs(texels.grid.points()[0][:256, :2] - (0.3, 0.2)).max(axis=1) > 0.4  # not below the lamp
    assert lit.sum() > 200
    assert found[lit].sum(axis=0) == pytest.approx(expected[lit].sum(axis=0), rel=0.01)
    assert np.median(np.abs(found / expected - 1.0)[lit]) < 0.06


def test_a_lamp_that_faces_no_texel_gives_no_light() -> None:
    """A lamp below a floor, beside none: both halves are 0, with a second lamp above it they are that one's alone."""
    floor = rectangle("floor", (0, 0, 0), (0, 0, 1), (2.0, 2.0))
    below = rectangle("below", (0, 0, -1.0), (0, 0, -1), (0.5, 0.5), radiance_w_m2_sr=(1.0, 1.0, 1.0))
    above = rectangle("above", (0, 0, 1.0), (0, 0, -1), (0.5, 0.5), radiance_w_m2_sr=(1.0, 1.0, 1.0))
    mi, light = activate(), []
    for lamps in ([below], [below, above], [above]):
        surfaces = Surfaces(mi, default_rig().at(0.0), face_table([floor, *lamps]))
        texels = Texels.of(mi, surfaces, TexelGrid.of(surfaces.table, 0.5))
        light.append(direct_light(mi, surfaces, texels, None, 16, 1)[0][:16])  # of the floor, which comes first
    assert not light[0].any()
    assert np.array_equal(light[1], light[2])
    assert light[2].min() > 0.0
