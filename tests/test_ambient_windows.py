"""The windows that `test_ambient.py` leaves out, so that `pytest -k accuracy` stays short."""

from __future__ import annotations

import pytest
from test_ambient import CROPS, QUICK, RIG, ROOM, SETTINGS, check_means

from phibench.render.room.light_map import LightMap, bake


@pytest.fixture(scope="module")
def light() -> LightMap:
    return bake(RIG.at(0.0), ROOM, SETTINGS)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in CROPS if name not in QUICK])
def test_ambient_means_against_path_tracing(light: LightMap, name: str) -> None:
    check_means(light, name)
