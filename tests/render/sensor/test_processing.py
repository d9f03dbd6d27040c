"""Processing: demosaicing, colours, sRGB, sharpening, JPEG, and the way back."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from helpers.sensor_light import electrons_from_srgb, room
from PIL import Image
from scipy.ndimage import convolve

from phibench.datasets.store.files import write_bytes
from phibench.render.sensor import processing
from phibench.render.sensor.camera_chain import Chain, auto_exposed, mean_level
from phibench.render.sensor.electrons import NoiseStream, mosaic
from phibench.render.sensor.light import Light
from phibench.render.sensor.processing import compressed, jpeg_bytes, jpeg_image
from phibench.render.sensor.settings import sensor
from phibench.render.sensor.srgb import srgb_decoded

STREAM = NoiseStream(("isp", 0))
MATRIX = ((1.5, -0.4, -0.1), (-0.25, 1.45, -0.2), (-0.05, -0.45, 1.5))
RANDOM = np.random.default_rng(3)
SMALL = RANDOM.integers(0, 256, (24, 40, 3), dtype=np.uint8)


@pytest.mark.parametrize("size", [(8, 10), (9, 11), (2, 2), (16, 5)])
def test_demosaic_is_the_convolution_of_each_colour(size: tuple[int, int]) -> None:
    """Bilinear interpolation as two kernels over the zero-filled planes, borders mirrored."""
    raw = RANDOM.uniform(0.0, 1.0, size)
    of = mosaic(np.broadcast_to(np.arange(3.0)[:, None, None], (3, *size)))
    cross, square = np.array([[0, 1, 0], [1, 4, 1], [0, 1, 0]]) / 4.0, np.array([[1, 2, 1], [2, 4, 2], [1, 2, 1]]) / 4.0
    planes = [convolve(raw * (of == c), k, mode="mirror") for c, k in ((0, square), (1, cross), (2, square))]
    # sums of four numbers below 1
    np.testing.assert_allclose(processing.demosaic(raw), planes, rtol=0, atol=1e-15)
    stack = processing.demosaic(np.stack([raw, 2.0 * raw]))
    np.testing.assert_array_equal(stack[1], 2.0 * processing.demosaic(raw))


def test_demosaic_keeps_flat_and_sloping_colours() -> None:
    v, u = np.mgrid[:12, :14]
    planes = np.stack([3.0 + 0.5 * u, 7.0 - 0.25 * v, 1.0 + 0.0 * u])
    again = processing.demosaic(mosaic(planes))
    np.testing.assert_allclose(again[:, 1:-1, 1:-1], planes[:, 1:-1, 1:-1], rtol=1e-14)
    assert np.abs(again - planes).max() > 0.1  # at the border the mirror image is not the slope


def test_colours_are_what_a_matrix_product_gives() -> None:
    planes = RANDOM.uniform(0.0, 1.0, (4, 3, 5, 6))
    balanced = processing.white_balanced(planes, (1.5, 1.0, 2.0))
    by_einsum = np.einsum("ij,nj...->ni...", np.array(MATRIX) * [1.5, 1.0, 2.0], planes)
    np.testing.assert_allclose(processing.colour_corrected(balanced, MATRIX), by_einsum, rtol=0, atol=1e-14)


def test_srgb_against_published_values() -> None:
    """IEC 61966-2-1: 18 % grey is 0.4614 (117.6 of 255), 50 % is 0.7354; forward and back agree."""
    np.testing.assert_allclose(
        processing.srgb_encoded(np.array([0.0, 0.18, 0.5, 1.0])), [0, 0.46136, 0.73536, 1], atol=1e-5
    )
    x = np.linspace(0.0, 1.0, 1001)
    # the two pieces meet to 2e-8 at the published knee
    np.testing.assert_allclose(srgb_decoded(processing.srgb_encoded(x)), x, rtol=0, atol=1e-7)
    np.testing.assert_allclose(processing.srgb_encoded(np.array([-3.0, 7.0])), [0.0, 1.0], rtol=1e-15)
    assert processing.srgb_encoded(x.astype(np.float32)).dtype == np.float32


def test_sharpening_against_a_convolution() -> None:
    planes = RANDOM.uniform(0.0, 1.0, (3, 9, 12))
    blur = np.outer([1, 2, 1], [1, 2, 1]) / 16.0
    by_hand = np.stack([p + 0.7 * (p - convolve(p, blur, mode="mirror")) for p in planes])
    np.testing.assert_allclose(processing.sharpened(planes, 0.7), by_hand, rtol=0, atol=1e-15)
    np.testing.assert_allclose(processing.sharpened(np.full((3, 8, 8), 0.3), 2.0), 0.3, rtol=1e-15)


def test_eight_bits_are_rounded_and_cut() -> None:
    planes = np.array([-0.1, 0.49 / 255, 0.51 / 255, 254.6 / 255, 1.2]).reshape(1, 1, 5).repeat(3, 0)
    np.testing.assert_array_equal(processing.eight_bit(planes)[0, :, 1], [0, 0, 1, 255, 255])


@pytest.mark.parametrize("subsampling", ["4:2:2", "4:2:0", "4:4:4"])
def test_the_frame_is_what_pillow_reads_from_the_written_file(tmp_path: Path, subsampling: str) -> None:
    chain, light = Chain(sensor("mjpeg", jpeg_subsampling=subsampling)), room((90, 118))
    file = write_bytes(tmp_path / "frame.jpg", chain.jpeg_bytes(light, STREAM))
    with Image.open(file) as image:
        assert image.size == (118, 90)
        layers = image.layer  # type: ignore[attr-defined]
        assert [layers[0][1:3], layers[1][1:3]] == [
            {"4:2:2": (2, 1), "4:2:0": (2, 2), "4:4:4": (1, 1)}[subsampling],
            (1, 1),
        ]
        np.testing.assert_array_equal(np.asarray(image), chain.frame(light, STREAM))


def test_a_stack_of_images_is_compressed_one_by_one() -> None:
    stack = np.stack([SMALL, 255 - SMALL]).reshape(2, 1, *SMALL.shape)
    s = sensor("mjpeg", jpeg_quality=70)
    result = compressed(stack, s)
    np.testing.assert_array_equal(result[1, 0], jpeg_image(jpeg_bytes(255 - SMALL, s)))
    reference = io.BytesIO()
    Image.fromarray(SMALL).save(reference, "JPEG", quality=70, subsampling=1)
    assert jpeg_bytes(SMALL, s) == reference.getvalue()


@pytest.mark.parametrize("matrix", [processing.IDENTITY, MATRIX])
@pytest.mark.parametrize("preset", ["srgb8", "mjpeg"])
def test_a_flat_field_is_recovered_within_the_noise(preset: str, matrix) -> None:
    """Chain and inverse on flat light, mean over 256 x 256 pixels."""
    electrons, size = np.array([3000.0, 4000.0, 2500.0]), (256, 256)
    s = sensor(preset, colour_matrix=matrix, jpeg_quality=95)
    frame = Chain(s).frame(Light.flat(tuple(electrons / s.exposure_s), size), STREAM)
    found = electrons_from_srgb(frame, s).mean(axis=(1, 2))
    usual = Chain(s.replace(jpeg_quality=85)).frame(Light.flat(tuple(electrons / s.exposure_s), size), STREAM)
    off = electrons_from_srgb(usual, s).mean(axis=(1, 2)) / electrons - 1.0
    print(f"{preset}: {100 * (found / electrons - 1.0)} %; quality 85: {100 * off} %")
    # noise per pixel below 150 e-, so 0.6 e- of the mean; the curve bends by 4 % of its slope per noise of 4 %: 0.1 %;
    # a rounding of 8 bits is dithered by 2 codes of noise. JPEG rounds the mean of a block's chroma to its table, and
    # colour by colour to 8 bits, undithered: half a code of 255, which is 1/255 of the slope's 0.45: 0.5 %
    np.testing.assert_allclose(found, electrons, rtol=0.002 if preset == "srgb8" else 0.006)
    wrong = electrons_from_srgb(frame, s.replace(white_balance=(1.0117, 1.03, 1.3416))).mean(axis=(1, 2))
    assert np.abs(wrong / electrons - 1.0).max() > 0.006


def test_raw_gives_back_the_light_within_its_standard_error() -> None:
    s = sensor("bayer-raw", prnu=0.0, dsnu_e=0.0)
    dn = Chain(s).frame(Light.flat((6e4, 1.2e5, 3e4), (256, 256)), STREAM).astype(float)
    electrons = (dn - s.black_level_dn) / s.dn_per_e
    for (row, column), expected in (((0, 0), 1000.0), ((0, 1), 2000.0), ((1, 1), 500.0)):
        mean, dark = electrons[row::2, column::2].mean(), s.dark_e_per_s * s.exposure_s
        error = np.sqrt((expected + 16.0 + 1 / 12 / s.dn_per_e**2) / 128**2)
        assert abs(mean - dark - expected) < 5.0 * error  # false alarm 6e-7 each
        assert abs(mean - 1.03 * expected) > 5.0 * error


def test_auto_exposure_reaches_its_level() -> None:
    light = room((120, 160))
    s = auto_exposed(sensor("mjpeg"), light)
    assert s.exposure_min_s < s.exposure_s < s.exposure_max_s
    assert s.analogue_gain == 1.0
    level = Chain(s.replace(output="srgb8")).frame(light.laser_off(), STREAM) @ [0.299, 0.587, 0.114]
    # a mean over 300 of 19200 pixels of white noise light, spread 60: 60 / sqrt(300) = 3.5 each channel's
    assert level.mean() == pytest.approx(110.0, abs=10.0)
    flat = Light.flat((1e5, 1e5, 7e4), (64, 64))
    assert mean_level(
        np.broadcast_to(
            np.array([1e5, 1e5, 7e4])[:, None, None] * auto_exposed(sensor("mjpeg"), flat).exposure_s, (3, 2, 2)
        ),
        sensor("mjpeg"),
    ) == pytest.approx(110.0, abs=0.01)


@pytest.mark.parametrize("preset", ["mono-raw", "bayer-raw"])
def test_auto_exposure_reaches_its_level_with_and_without_filters(preset: str) -> None:
    """Developed frames of flat light, whose mean is known to 60 / sqrt(19200) = 0.4; rounding to 8 bits 0.3."""
    light = Light.flat((1e5, 1e5, 7e4), (120, 160))
    s = auto_exposed(sensor(preset), light)
    image = Chain(s.replace(output="srgb8")).frame(light, STREAM)
    luma = image if image.ndim == 2 else image @ [0.299, 0.587, 0.114]
    assert luma.mean() == pytest.approx(110.0, abs=2.0)


def test_auto_exposure_is_the_same_for_on_and_off_and_scales_with_the_lamps() -> None:
    light = room((120, 160))
    s = sensor("mjpeg")
    assert auto_exposed(s, light) == auto_exposed(s, light.laser_off())
    dim = Light(light.ambient_electrons_per_s, lamp_level=0.5)
    assert auto_exposed(s, dim).exposure_s == pytest.approx(2.0 * auto_exposed(s, light).exposure_s, rel=1e-5)


def test_auto_exposure_stops_at_its_limits() -> None:
    s = sensor("mjpeg")
    dim = auto_exposed(s, Light.flat((3e3, 3e3, 2e3), (64, 64)))
    assert dim.exposure_s == 0.2
    assert 1.0 < dim.analogue_gain < 16.0
    dark = auto_exposed(s, Light.flat((0.0, 0.0, 0.0), (64, 64)))
    assert (dark.exposure_s, dark.analogue_gain) == (0.2, 16.0)
    glare = auto_exposed(s, Light.flat((1e9, 1e9, 1e9), (64, 64)))
    assert (glare.exposure_s, glare.analogue_gain) == (1e-4, 1.0)
