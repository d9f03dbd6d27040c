"""Tone curves, Y'CbCr 4:2:2 and mixed codes on the estimator's side, against the simulator's chain and OpenCV."""

from __future__ import annotations

import io
from dataclasses import replace

import cv2
import numpy as np
import pytest
from helpers.chain_scenes import COLLECTED, FITS, MIDDLE, ROOM, SQUARE, UNITS, scene
from helpers.sensor_light import tone_decoded
from PIL import Image

from phibench.calibration.captures.picture_files import read_picture, sensor_choice
from phibench.datasets.frames.sensor_card import card_of
from phibench.estimator.geometry.status import Status
from phibench.estimator.limits.processed_bound import chain_limit
from phibench.estimator.processed.chain_model import chain_model, codes
from phibench.estimator.processed.fit_processed_region import grid_px
from phibench.estimator.spots.camera_codes import (
    coefficients,
    light_of,
    quantised_output,
    rgb_codes,
    rgb_picture,
    tone_of,
    tone_slope,
    ycbcr_codes,
    ycbcr_transform,
    yuyv_image,
)
from phibench.estimator.spots.gaussian_spot import SpotBlur
from phibench.estimator.spots.image_planes import colour_planes, linear_planes, through_jpeg
from phibench.estimator.spots.jpeg_recovery import recovered_coefficients
from phibench.estimator.spots.raw_pixels import noise_before_rounding
from phibench.render.sensor import processing
from phibench.render.sensor.camera_chain import Chain
from phibench.render.sensor.electrons import NoiseStream
from phibench.render.sensor.light import Region
from phibench.render.sensor.settings import Sensor, sensor

POINTS = ((0.0, 0.0), (0.02, 0.15), (0.1, 0.38), (0.3, 0.65), (0.6, 0.86), (1.0, 1.0))
TABLE = {"transfer_function": "table", "transfer_points": POINTS}
MATRIX = ((1.4, -0.3, -0.1), (-0.2, 1.4, -0.2), (0.0, -0.4, 1.4))
YUYV = sensor("yuyv")
RANDOM = np.random.default_rng(23)
FLUX_E = 5000.0 / COLLECTED


@pytest.mark.parametrize("changes", [{}, {"transfer_function": "rec709"}, TABLE], ids=["srgb", "rec709", "table"])
def test_tone_curves_are_the_simulators(changes: dict) -> None:
    s = YUYV.replace(**changes)
    card, x = card_of(s), np.concatenate([[-0.2, 0.0, 1.0, 1.3], np.linspace(0.0, 1.0, 997)])
    np.testing.assert_allclose(tone_of(x, card), processing.tone_encoded(x, s), rtol=0, atol=1e-12)
    y = np.linspace(0.0, 1.0, 1001)
    np.testing.assert_allclose(light_of(y, card), tone_decoded(y, s), rtol=0, atol=1e-12)
    inside, h = np.linspace(0.0003, 0.9997, 777), 1e-7  # none is a point of the table or a knee
    slope = (tone_of(inside + h, card) - tone_of(inside - h, card)) / (2 * h)
    np.testing.assert_allclose(tone_slope(inside, card), slope, rtol=1e-5)
    np.testing.assert_array_equal(tone_slope(np.array([-0.1, 1.1]), card), 0.0)


@pytest.mark.parametrize("taps", [(0.0, 1.0, 0.0), (0.0, 0.5, 0.5), (0.25, 0.5, 0.25)])
@pytest.mark.parametrize("span", ["full", "limited"])
def test_codes_are_the_simulators(span: str, taps: tuple[float, float, float]) -> None:
    """The matrix of the model, the whole image, and the way back to R, G, B, each against the simulator's."""
    s = YUYV.replace(ycbcr_range=span, chroma_taps=taps)
    card, planes = card_of(s), RANDOM.uniform(0.0, 1.0, (3, 10, 14))
    image = processing.yuyv(planes, s)
    rgb = np.moveaxis(255.0 * planes, 0, -1)
    np.testing.assert_array_equal(yuyv_image(rgb, card), image)
    matrix, added = ycbcr_transform((6, 8), card)
    # the window begins at row 2 and column 4, its outer planes a pixel before
    modelled = matrix @ (255.0 * planes[:, 1:9, 3:13]).ravel() + added
    np.testing.assert_array_equal(np.rint(modelled), ycbcr_codes(image[2:8, 4:12]))
    np.testing.assert_array_equal(rgb_picture(image, card), processing.rgb_from_yuyv(image, s))
    # the sums of a crop that begins in the middle of a pair differ in its first column's Cb, and its last one's Cr
    crop = rgb_codes(image[:, 3:12], card, (3, 0))
    np.testing.assert_array_equal(crop[:, 1:], rgb_codes(image, card)[:, 4:12])
    assert np.isfinite(crop).all()


def test_a_picture_of_limited_range_is_opencvs() -> None:
    image = RANDOM.integers(16, 236, (6, 10, 2), dtype=np.uint8)
    by_opencv = cv2.cvtColor(image, cv2.COLOR_YUV2RGB_YUY2).astype(int)
    assert np.abs(rgb_picture(image, card_of(YUYV.replace(ycbcr_range="limited"))) - by_opencv).max() <= 1


def test_a_grey_room_has_equal_planes_and_its_light() -> None:
    """Flat grey light of 1000 e- behind G: planes of 1000 / full scale within 1 %, half a code of Y' being 0.6 %."""
    s = YUYV.replace(shot_noise=False, read_noise_e=0.0, prnu=0.0, dsnu_e=0.0, dark_e_per_s=0.0)
    gains = np.array(s.white_balance)
    light = scene(MIDDLE, 0.7, 0.0, 0.0, s)
    light = replace(
        light, ambient_electrons_per_s=(1000.0 / gains / s.exposure_s)[:, None, None] * np.ones((3, 64, 96))
    )
    frame, card = Chain(s).frame(light, NoiseStream(("grey",))), card_of(s)
    np.testing.assert_allclose(linear_planes(frame, card), 1000.0 / s.full_well_e, rtol=0.025)  # a DN is 1.2 %
    from phibench.estimator.interface import Box

    planes = colour_planes(frame, card, Box(2, 4, 20, 10))
    np.testing.assert_allclose(
        planes.values_e, np.broadcast_to((1000.0 / gains)[:, None, None], (3, 10, 20)), rtol=0.03
    )
    with pytest.raises(ValueError, match=r"yuyv needs \(H, W, 2\)"):
        colour_planes(np.zeros((8, 8, 3), np.uint8), card, Box(0, 0, 4, 4))


SPARING = {
    "denoise_luma": 0.9,
    "denoise_reach_px": 2,
    "denoise_vertical": 0.7,
    "denoise_threshold_codes": 20.0,
}
CHAINS = {
    "yuyv": YUYV,
    "yuyv limited": YUYV.replace(ycbcr_range="limited", chroma_taps=(0.0, 0.5, 0.5)),
    "yuyv all on": YUYV.replace(
        sharpen_amount=0.4, denoise_luma=0.2, denoise_chroma=0.7, colour_matrix=MATRIX, transfer_function="rec709"
    ),
    "yuyv edges spared": YUYV.replace(sharpen_amount=0.5, **SPARING),
    "srgb8 edges spared": sensor("srgb8", denoise_chroma=0.5, **SPARING),
    "mjpeg edges spared": sensor("mjpeg", jpeg_quality=92, **SPARING),
    "srgb8 sharpened": sensor("srgb8", sharpen_amount=0.5),
    "srgb8 matrix, table": sensor("srgb8", colour_matrix=MATRIX, **TABLE),
    "srgb8 denoised": sensor("srgb8", denoise_luma=0.3, denoise_chroma=0.3),
    "mjpeg denoised": sensor(
        "mjpeg", jpeg_quality=92, denoise_luma=0.3, denoise_chroma=0.8, transfer_function="rec709"
    ),
}
SLOW = ("srgb8 edges spared", "mjpeg edges spared")
NAMES = [pytest.param(name, marks=[pytest.mark.slow] if name in SLOW else []) for name in CHAINS]
# one colour's values lie on the converter's lattice of 1 to 3 codes, which mixing pixels and 8 bits do not smear enough
COARSE = ("srgb8 sharpened", "srgb8 denoised")


def outputs(frames: np.ndarray, s: Sensor) -> np.ndarray:
    """What the model's means stand for: codes, or coefficients of the decoded image before JPEG."""
    planes = np.moveaxis(frames.astype(float), -1, 1)
    if s.output == "mjpeg":
        return coefficients(planes, "4:2:2")
    return np.stack([ycbcr_codes(f) for f in frames]) if s.output == "yuyv" else planes.reshape(len(frames), -1)


@pytest.mark.parametrize("name", NAMES)
def test_model_of_the_outputs_against_the_chain(name: str) -> None:
    """Means of 400 frames on the model's window, a bright spot in it: standard errors of sigma / 20.

    Nodes of tables and unequal neighbours leave some hundredths of a code and a mean square of 0.9 to 1.4; where the
    rounding is not white, 0.1 codes and 2.5 to 4.4. A shift by 0.3 codes gives 9 or more, and there 21 or more.
    """
    s = CHAINS[name].replace(prnu=0.0, dsnu_e=0.0)
    card, n = card_of(s), 400
    model = chain_model(card, noise_before_rounding(card))
    (h, w), m, (down, across) = model.shape, model.margin, grid_px(card)
    v0, u0 = (round((c - side / 2) / step) * step for c, side, step in ((32, h, down), (48, w, across)))
    window, raw = Region(u0, v0, u0 + w, v0 + h), Region(u0 - m, v0 - m, u0 + w + m, v0 + h + m)
    light = scene(MIDDLE + [0.3, -0.2], 0.9, FLUX_E, 200.0, s)
    at = codes(model, (Chain(s).photo_electrons(light, raw) + s.dark_e_per_s * s.exposure_s).ravel())
    wanted = at.mean @ model.transform + (0.0 if s.output == "mjpeg" else model.shift)
    before = Chain(s.replace(output="srgb8") if s.output == "mjpeg" else s)
    drawn = outputs(np.stack([before.frame(light, NoiseStream(("means", k)), window) for k in range(n)]), s)
    deviation = drawn.std(axis=0, ddof=1)
    if s.output != "mjpeg":  # codes are rounded, whose mean a small noise leaves beside that of the input
        wanted = quantised_output(wanted, np.sqrt(np.maximum(deviation**2 - 1.0 / 12.0, 0.01)), np.array(1.0)).mean
    error, live = deviation / np.sqrt(n), deviation > 0.3
    z = ((drawn.mean(axis=0) - wanted) / np.maximum(error, 1e-9))[live]
    off = 0.3 * (outputs(np.ones((1, h, w, 3)), s)[0] if s.output == "mjpeg" else 1.0)
    shifted = ((drawn.mean(axis=0) - wanted + off) / np.maximum(error, 1e-9))[live]
    print(f"{name}: mean square {np.mean(z**2):.2f}, of a shift {np.mean(shifted**2):.2f}, live {live.mean():.2f}")
    assert live.mean() > 0.4
    most = 6.0 if name in COARSE else 2.2
    assert np.mean(z**2) < most
    assert np.mean(shifted**2) > 1.5 * most


@pytest.mark.parametrize("name", NAMES)
def test_fit_of_a_bright_spot(name: str) -> None:
    """Three frames: within 6 standard deviations of its own, which are the bound's; the flux within 10 %."""
    s, uv = CHAINS[name], MIDDLE + [0.3, -0.4]
    light, box = scene(uv, 0.7, FLUX_E, 100.0, s), UNITS if s.output == "mjpeg" else SQUARE
    if s.output != "mjpeg":
        box = Region(box.u0_px - 1, box.v0_px, box.u1_px - 1, box.v1_px)  # an odd column first: pairs are found
        assert box.u0_px % 2 == 1
    frames = np.stack([Chain(s, k).frame(light, NoiseStream(("bright", k)), box) for k in range(3)])
    fit = FITS[s.output](frames, (box.u0_px, box.v0_px), card_of(s), SpotBlur(0.7))
    assert (fit.status == Status.OK).all()
    sd = np.sqrt(np.diagonal(fit.covariance_px2, axis1=1, axis2=2))
    assert (np.abs(fit.uv_px - uv) < 6.0 * sd).all()
    assert (sd < 0.08).all()
    np.testing.assert_allclose(fit.flux_e, FLUX_E, rtol=0.1)
    assert (fit.chi2 < 2.5).all()
    limit = chain_limit(card_of(s), uv, SpotBlur(0.7), FLUX_E, 100.0 * ROOM)
    np.testing.assert_allclose(sd.mean(axis=0), np.sqrt(np.diag(limit.covariance_px2)), rtol=0.15)


def test_bounds_follow_what_the_chain_loses() -> None:
    """Y'CbCr loses to R, G, B, denoising loses by rounding what it makes smaller; JPEG loses most."""

    def bound(s: Sensor) -> float:
        return chain_limit(card_of(s), MIDDLE + [0.3, -0.4], SpotBlur(0.7), FLUX_E, 100.0 * ROOM).rms_px

    yuyv = bound(YUYV)
    assert bound(sensor("srgb8", sharpen_amount=1e-9)) < yuyv < bound(sensor("mjpeg"))
    assert yuyv < bound(YUYV.replace(ycbcr_range="limited")) < 1.1 * yuyv
    assert yuyv < bound(YUYV.replace(denoise_luma=0.9, denoise_chroma=0.9))


def test_jpeg_tables_of_a_card_are_those_of_the_file() -> None:
    """Coefficients behind a decoded frame are multiples of the given steps; those of another table are not found."""
    tables = (tuple(3 + k // 4 for k in range(64)), tuple(5 + k // 3 for k in range(64)))
    s = sensor("mjpeg", jpeg_qtables=tables, jpeg_restart_interval=2)
    light = scene(MIDDLE, 0.7, FLUX_E, 400.0, s)
    frame = Chain(s).frame(light, NoiseStream(("tables",)))
    data = Chain(s).jpeg_bytes(light, NoiseStream(("tables",)))
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(data))), frame)
    before = Chain(s.replace(output="srgb8")).frame(light, NoiseStream(("tables",)))
    np.testing.assert_array_equal(through_jpeg(before, card_of(s)), frame)
    assert recovered_coefficients(frame[None], tables, "4:2:2", (True,) * 4).wrong.mean() < 0.01
    assert recovered_coefficients(frame[None], 76, "4:2:2", (True,) * 4).wrong.mean() > 0.02


def test_a_png_of_two_planes_is_read_as_yuyv(tmp_path) -> None:
    image = RANDOM.integers(0, 256, (8, 12, 2), dtype=np.uint8)
    Image.fromarray(image).save(tmp_path / "frame.png")
    found = read_picture(tmp_path / "frame.png")
    np.testing.assert_array_equal(found.pixels, image)
    assert sensor_choice(found).card.output == "yuyv"


def test_messages() -> None:
    card = card_of(YUYV)
    with pytest.raises(ValueError, match=r"\(n, h, w, 2\) or, of f frames, \(n, f, h, w, 2\) of uint8 is needed"):
        FITS["yuyv"](np.zeros((1, 17, 17, 3), np.uint8), (0, 0), card, SpotBlur(0.7))
    with pytest.raises(ValueError, match="13 x 13 pixels or more are needed"):
        FITS["yuyv"](np.zeros((1, 9, 9, 2), np.uint8), (0, 0), card, SpotBlur(0.7))
    assert FITS["yuyv"](np.zeros((0, 17, 17, 2), np.uint8), (0, 0), card, SpotBlur(0.7)).uv_px.shape == (0, 2)


@pytest.mark.parametrize("preset", ["srgb8", "mjpeg"])
def test_bytes_have_the_light_of_their_codes_to_the_bit(preset: str) -> None:
    """One power for each of 256 codes is the power of each pixel; planes lie in memory as those of floats do."""
    card = card_of(sensor(preset))
    codes = np.arange(3 * 256, dtype=np.uint16).reshape(16, 16, 3) % 256
    of_bytes, of_floats = linear_planes(codes.astype(np.uint8), card), linear_planes(codes.astype(float), card)
    assert np.array_equal(of_bytes, of_floats)
    assert of_bytes.strides == of_floats.strides
