"""Tests of the light of lamps: Lambert's closed form against a sum over the lamp."""

import numpy as np
import pytest

from phibench.render.room.lamp_light import whole_lamp

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
    assert (here.min(axis=1) > 0.0).sum() >= 10, "most texels must have the whole lamp above their horizon"
    above = here.min(axis=1) > 0.0
    expected = (here * there / r**2).mean(axis=1) * size.prod()
    np.testing.assert_allclose(whole_lamp(-points, texels, lamp)[above], expected[above], rtol=2e-5)
