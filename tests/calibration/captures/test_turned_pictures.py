"""Pictures of a pair that are mirrored or turned against each other: which, and how, is said; right ones pass."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from phibench.calibration.captures.picture_files import Photo, require_one_camera
from phibench.calibration.captures.turned_pictures import require_alike
from phibench.datasets.common.camera_pictures import Kind
from phibench.datasets.common.errors import DatasetError
from phibench.scenes.camera import Camera
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig

SIZE = (320, 180)


def rig_of(width: int, height: int) -> Rig:
    middle = {"cx_px": 0.5 * width - 0.5, "cy_px": 0.5 * height - 0.5}
    return Rig(camera=Camera(width_px=width, height_px=height, fx_px=357.5, fy_px=357.5, pixel_pitch_um=11.2, **middle))


def room(size: tuple[int, int], seed: int, inwards: float) -> Array:
    """Lights at fixed bearings around the mirror's middle, moved inwards by a factor; shape (H, W, 3), codes."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[: size[1], : size[0]]
    x, y = u - 0.5 * (size[0] - 1), v - 0.5 * (size[1] - 1)
    codes = np.full((size[1], size[0], 3), 60.0)
    for _ in range(14):
        bearing, r, reach = rng.uniform(0.0, 2.0 * math.pi), rng.uniform(35.0, 85.0) * inwards, rng.uniform(3.0, 9.0)
        off = (x - r * math.cos(bearing)) ** 2 + (y - r * math.sin(bearing)) ** 2
        codes += rng.uniform(30.0, 120.0, 3) * np.exp(-0.5 * off / reach**2)[..., None]
    return codes + rng.normal(0.0, 1.0, codes.shape)


def photo(codes: Array, name: str, kind: Kind = "rgb") -> Photo:
    pixels = np.clip(codes, 0.0, 255.0)
    if kind == "raw":
        return Photo(Path(name), (4.0 * pixels[..., 1]).astype(np.uint16), kind)
    return Photo(Path(name), pixels.astype(np.uint8), kind)


TURNS = {
    "mirrored left to right": lambda x: x[:, ::-1],
    "mirrored top to bottom": lambda x: x[::-1],
    "turned by 180 degrees": lambda x: x[::-1, ::-1],
}
OF_SQUARES = {
    **TURNS,
    "turned by 90 degrees": lambda x: np.rot90(x, -1),
    "mirrored at a diagonal": lambda x: np.swapaxes(x, 0, 1),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["rgb", "raw"])
@pytest.mark.parametrize("words", TURNS)
def test_a_turned_picture_is_named(words: str, kind: Kind) -> None:
    for seed in range(5):
        down, up = (photo(room(SIZE, seed, inwards), "d.png", kind) for inwards in (1.0, 0.8))
        turned = photo(TURNS[words](room(SIZE, seed, 0.8)), "u.png", kind)
        require_alike([(down, up)], rig_of(*SIZE))
        with pytest.raises(DatasetError, match=f"u.png is {words} against d.png") as caught:
            require_alike([(down, turned)], rig_of(*SIZE))
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("words", OF_SQUARES)
def test_squares_may_be_turned_by_90_degrees(words: str) -> None:
    down = photo(room((180, 180), 3, 1.0), "d.png")
    with pytest.raises(DatasetError, match=f"u.png is {words}"):
        require_alike([(down, photo(OF_SQUARES[words](room((180, 180), 3, 0.8)), "u.png"))], rig_of(180, 180))


def test_dark_and_even_pictures_are_not_called_turned() -> None:
    down, dark = photo(room(SIZE, 0, 1.0), "d.png"), photo(np.full((180, 320, 3), 2.0), "dark.png")
    even = photo(120.0 + np.random.default_rng(0).normal(0.0, 2.0, (180, 320, 3)), "even.png")
    require_alike([(down, dark), (dark, dark), (even, dark), (down, even)], rig_of(*SIZE))


def test_a_picture_turned_by_90_degrees_has_its_sides_exchanged() -> None:
    pixels = room(SIZE, 0, 1.0)
    with pytest.raises(DatasetError, match=r"u.png is turned by 90 degrees against d.png: 180 x 320 and 320 x 180"):
        require_one_camera([photo(pixels, "d.png"), photo(np.rot90(pixels), "u.png")])
