"""A region of a frame has the pixels of the whole frame, to the bit."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from helpers.sensor_light import moving, room

from phibench.render.sensor.camera_chain import Chain
from phibench.render.sensor.electrons import NoiseStream
from phibench.render.sensor.light import Light, Region
from phibench.render.sensor.settings import SensorError, sensor
from phibench.scenes.camera import Camera

STREAM = NoiseStream(("region", 0, "sample", "down", "on", 0))
SIZES = ((72, 130), (81, 123), (96, 64))  # (height, width); none but the last is a multiple of a unit or a tile
CAMERA = Camera(width_px=130, height_px=81, fx_px=150.0, fy_px=150.0, cx_px=64.0, cy_px=40.0)
MATRIX = ((1.5, -0.4, -0.1), (-0.25, 1.45, -0.2), (-0.05, -0.45, 1.5))
PLAIN = {"mono-raw": {}, "bayer-raw": {"row_noise_e": 2.0}, "srgb8": {}, "ideal": {"vignetting_exponent": 2.5}}
JPEGS = {
    f"{name} {sharpen}": {"jpeg_subsampling": name, "sharpen_amount": sharpen, "jpeg_quality": quality}
    for name, sharpen, quality in (("4:2:2", 0.0, 85), ("4:2:2", 0.8, 50), ("4:2:0", 0.0, 95), ("4:2:0", 0.8, 70))
}
ALL_ON = {"vignetting_exponent": 2.5, "colour_matrix": MATRIX, "speckle_m": 2.0, "row_noise_e": 1.0}
CHAINS = {name: Chain(sensor(name, **changes), 3, CAMERA) for name, changes in PLAIN.items()}
CHAINS |= {name: Chain(sensor("mjpeg", **changes), 3, CAMERA) for name, changes in JPEGS.items()}
CHAINS |= {"all on": Chain(sensor("mjpeg", jpeg_subsampling="4:2:0", sharpen_amount=0.5, **ALL_ON), 3, CAMERA)}
CHAINS |= {"sharpened": Chain(sensor("srgb8", sharpen_amount=1.0, **ALL_ON), 3, CAMERA)}
SMOOTH = {"denoise_luma": 0.3, "denoise_chroma": 0.8, "transfer_function": "rec709"}
CHAINS |= {
    "yuyv": Chain(sensor("yuyv"), 3, CAMERA),
    "yuyv all on": Chain(sensor("yuyv", sharpen_amount=0.5, **SMOOTH, **ALL_ON), 3, CAMERA),
    "edges spared": Chain(
        sensor("yuyv", sharpen_amount=0.8, denoise_luma=0.9, denoise_reach_px=2, denoise_threshold_codes=15.0),
        3,
        CAMERA,
    ),
    "denoised": Chain(sensor("mjpeg", jpeg_restart_interval=3, **SMOOTH), 3, CAMERA),
}


def regions(size: tuple[int, int]) -> Iterator[Region]:
    """Corners, borders, single pixels, the whole, and 20 anywhere."""
    height, width = size
    for u in (0.0, 0.5 * width, width - 1.0):
        for v in (0.0, 0.5 * height, height - 1.0):
            yield Region.around(u, v, size, 33)
            yield Region.around(u, v, size, 1)
    yield Region.whole(size)
    random = np.random.default_rng(11)
    for _ in range(20):
        u0, u1 = np.sort(random.choice(width + 1, 2, replace=False))
        v0, v1 = np.sort(random.choice(height + 1, 2, replace=False))
        yield Region(int(u0), int(v0), int(u1), int(v1))


def mismatches(chain: Chain, size: tuple[int, int], velocity: tuple[float, float] = (0.0, 0.0)) -> list[bool]:
    """For each region whether it differs from the whole frame."""
    if chain.sensor.output == "yuyv":
        size = size[0], size[1] // 2 * 2  # it has pairs of columns
    light = moving(room(size), velocity, chain.sensor)
    whole = chain.frame(light, STREAM)
    assert whole.std() > 0
    return [
        not np.array_equal(chain.frame(light, STREAM, part), whole[(..., *part.slices())])
        if chain.sensor.output in ("raw", "electrons")
        else not np.array_equal(chain.frame(light, STREAM, part), whole[part.slices()])
        for part in regions(size)
    ]


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("name", CHAINS)
def test_a_region_is_the_whole_frame_there(name: str, size: tuple[int, int]) -> None:
    found = mismatches(CHAINS[name], size)
    assert len(found) == 39
    assert not any(found)


@pytest.mark.parametrize("name", ["bayer-raw", "4:2:2 0.8", "all on"])
def test_a_region_of_a_moving_spot(name: str) -> None:
    assert not any(mismatches(CHAINS[name], SIZES[1], (140.0, -90.0)))


class NoUnitAround(Chain):
    """Forgets that chroma is interpolated across units."""

    def jpeg_region(self, region: Region, size: tuple[int, int]) -> Region:
        return region.grown(size, (16, 16))


class NoMargin(Chain):
    """Forgets that demosaicing looks at neighbours."""

    def raw_region(self, region: Region, size: tuple[int, int]) -> Region:
        return region.grown(size, (2, 2))


@pytest.mark.parametrize(
    ("kind", "name"), [(NoUnitAround, "4:2:2 0.0"), (NoUnitAround, "4:2:0 0.0"), (NoMargin, "srgb8")]
)
def test_the_comparison_notices_a_missing_margin(kind: type[Chain], name: str) -> None:
    assert any(mismatches(kind(CHAINS[name].sensor, 3, CAMERA), SIZES[0]))


def test_a_square_is_moved_inside_and_keeps_its_size() -> None:
    size = (72, 130)
    assert Region.around(64.2, 36.0, size, 64).shape == (64, 64)
    assert Region.around(0.0, 71.4, size, 64) == Region(0, 8, 64, 72)
    assert Region.around(64.4, 40.0, size, 3) == Region(63, 39, 66, 42)


@pytest.mark.parametrize(
    ("call", "complaint"),
    [
        (lambda: Region.around(-1.0, 3.0, (72, 130)), r"\(-1, 3\): outside the image, which spans \[-0.5, 129.5\]"),
        (lambda: Region.around(float("nan"), 3.0, (72, 130)), "outside the image"),
        (lambda: Region.around(5.0, 3.0, (72, 130), 80), "region of 80 px: allowed sides are 1 to 72"),
        (lambda: Region(0, 0, 131, 5).within((72, 130)), "inside the image of 130 x 72 pixels"),
        (lambda: Region(5, 0, 5, 5).within((72, 130)), "must hold a pixel"),
        (lambda: CHAINS["srgb8"].frame(room((32, 32)), STREAM, Region(-1, 0, 5, 5)), "lie inside the image"),
    ],
)
def test_a_region_outside_is_refused(call, complaint: str) -> None:
    with pytest.raises(SensorError, match=complaint):
        call()


def test_a_shrunk_frame_is_the_mean_of_its_pixels() -> None:
    """An even field: the level stays, and noise of Y' falls below that of the sensor's own pixels."""
    chain, stream = Chain(sensor("yuyv", prnu=0.0)), NoiseStream(("shrunk",))
    light = Light.flat((9e4, 9e4, 6e4), (64, 128))
    small, full = chain.shrunk_frame(light, stream, 2)[..., 0], chain.frame(light, stream)[..., 0]
    assert small.shape == (32, 64)
    assert abs(small.mean() - full.mean()) < 0.1
    blocks = full.reshape(32, 2, 64, 2).mean(axis=(1, 3))
    assert np.abs(small - blocks).max() < 1.0  # rounding before and after the mean
    with pytest.raises(SensorError, match="cannot be shrunk 3 times"):
        chain.shrunk_frame(light, stream, 3)
