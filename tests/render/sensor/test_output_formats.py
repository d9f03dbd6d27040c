"""Outputs of the camera beside R, G, B: Y'CbCr 4:2:2, tone curves, denoising, JPEG with given tables and markers."""

from __future__ import annotations

import io
from fractions import Fraction

import cv2
import numpy as np
import pytest
from helpers.sensor_light import electrons_from_srgb, room, tone_decoded
from PIL import Image
from scipy.ndimage import convolve

from phibench.render.sensor import processing
from phibench.render.sensor.camera_chain import Chain
from phibench.render.sensor.electrons import NoiseStream
from phibench.render.sensor.light import Light
from phibench.render.sensor.processing import rgb_from_yuyv, tone_encoded, yuyv
from phibench.render.sensor.settings import Sensor, SensorError, sensor

STREAM = NoiseStream(("formats", 0))
RANDOM = np.random.default_rng(7)
PLANES = RANDOM.uniform(0.0, 1.0, (3, 6, 10))
POINTS = ((0.0, 0.02), (0.1, 0.4), (0.3, 0.65), (1.0, 1.0))
CURVES = {
    "srgb": sensor("yuyv"),
    "rec709": sensor("yuyv", transfer_function="rec709"),
    "table": sensor("yuyv", transfer_function="table", transfer_points=POINTS),
}


def exact_bytes(planes: np.ndarray, s: Sensor) -> np.ndarray:
    """YUYV of BT.601 from its definition, in fractions: Kr = 0.299, Kb = 0.114; halves cannot be told apart."""
    kr, kb = Fraction(299, 1000), Fraction(114, 1000)
    _, height, width = planes.shape
    r, g, b = ([[Fraction(float(x)) for x in row] for row in plane] for plane in planes)
    taps = [Fraction(tap) for tap in s.chroma_taps]
    limited = s.ycbcr_range == "limited"
    black, span, chroma = (16, 219, 224) if limited else (0, 255, 255)
    result = np.empty((height, width, 2), int)
    for v in range(height):
        y = [kr * r[v][u] + (1 - kr - kb) * g[v][u] + kb * b[v][u] for u in range(width)]
        cb = [(b[v][u] - y[u]) / (2 * (1 - kb)) for u in range(width)]
        cr = [(r[v][u] - y[u]) / (2 * (1 - kr)) for u in range(width)]
        for u in range(width):
            k = u // 2 * 2
            of = cr if u % 2 else cb
            near = [of[abs(k - 1)], of[k], of[k + 1]]
            mean = sum((tap * x for tap, x in zip(taps, near, strict=True)), Fraction(0))
            result[v, u] = round(black + span * y[u]), round(128 + chroma * mean)
    return np.clip(result, 1 if limited else 0, 254 if limited else 255)


@pytest.mark.parametrize("taps", [(0.0, 1.0, 0.0), (0.0, 0.5, 0.5), (0.25, 0.5, 0.25)])
@pytest.mark.parametrize("span", ["full", "limited"])
def test_yuyv_against_bt_601_in_fractions(span: str, taps: tuple[float, float, float]) -> None:
    s = sensor("yuyv", ycbcr_range=span, chroma_taps=taps)
    wide = 1.3 * PLANES - 0.15  # sharpening leaves [0, 1]
    for planes in (PLANES, wide):
        found = yuyv(planes, s)
        assert (found.shape, found.dtype) == ((6, 10, 2), np.uint8)
        np.testing.assert_array_equal(found, exact_bytes(planes, s))
    other = "limited" if span == "full" else "full"
    assert (yuyv(PLANES, s.replace(ycbcr_range=other)) != found).mean() > 0.5


@pytest.mark.parametrize("span", ["full", "limited"])
def test_the_corners_of_yuyv_have_the_codes_of_bt_601(span: str) -> None:
    """Black, white, red and blue: 16, 235, (81, 240) and (41, 240) of limited range; 0, 255, ... of full range."""
    colours = np.array([[0, 0, 0], [1, 1, 1], [1, 0, 0], [0, 0, 1]], float)
    image = yuyv(np.repeat(colours, 2, axis=0).T[:, None], sensor("yuyv", ycbcr_range=span, chroma_taps=(0, 1, 0)))[0]
    expected = {
        "limited": [(16, 128, 128), (235, 128, 128), (81, 90, 240), (41, 240, 110)],
        "full": [(0, 128, 128), (255, 128, 128), (76, 85, 255), (29, 255, 107)],
    }[span]
    assert [(int(image[u, 0]), int(image[u, 1]), int(image[u + 1, 1])) for u in (0, 2, 4, 6)] == expected


def test_a_picture_of_limited_range_is_what_opencv_decodes() -> None:
    """`cv2.VideoCapture` takes YUYV for limited range: equal within OpenCV's own rounding, 1 code."""
    image = RANDOM.integers(16, 236, (8, 12, 2), dtype=np.uint8)
    by_opencv = cv2.cvtColor(image, cv2.COLOR_YUV2RGB_YUY2).astype(int)
    assert np.abs(rgb_from_yuyv(image, sensor("yuyv", ycbcr_range="limited")) - by_opencv).max() <= 1
    assert np.abs(rgb_from_yuyv(image, sensor("yuyv")) - by_opencv).max() > 5


def test_a_grey_picture_comes_back_and_chroma_follows_the_pair() -> None:
    grey = np.repeat(np.arange(256.0)[None, None] / 255.0, 3, axis=0)
    np.testing.assert_array_equal(rgb_from_yuyv(yuyv(grey, CURVES["srgb"]), CURVES["srgb"])[0, :, 1], np.arange(256))
    # flat colours: 1 code of Y', half a code of Cb and Cr, times at most 1.772
    flat = np.broadcast_to(np.array([0.8, 0.3, 0.5])[:, None, None], (3, 4, 6))
    again = rgb_from_yuyv(yuyv(flat, CURVES["srgb"]), CURVES["srgb"])
    assert np.abs(again - 255.0 * np.array([0.8, 0.3, 0.5])).max() <= 0.5 + 0.5 * 1.772 + 0.5


def test_rec_709_is_its_published_curve() -> None:
    """ITU-R BT.709, with its four digits: 4.5 L below 0.018, 1.099 L^0.45 - 0.099 from there on."""
    x = np.linspace(0.0, 1.0, 2001)
    published = np.where(x < 0.018, 4.5 * x, 1.099 * x**0.45 - 0.099)
    # the published digits leave a step of 3e-4 at the knee
    np.testing.assert_allclose(tone_encoded(x, CURVES["rec709"]), published, rtol=0, atol=3.5e-4)
    assert tone_encoded(np.array([-1.0, 2.0]), CURVES["rec709"]) == pytest.approx([0.0, 1.0], abs=1e-12)


def test_a_table_is_joined_by_straight_lines() -> None:
    found = tone_encoded(np.array([0.0, 0.05, 0.2, 0.65, 1.0, 3.0]), CURVES["table"])
    np.testing.assert_allclose(found, [0.02, 0.21, 0.525, 0.825, 1.0, 1.0], rtol=1e-14)


@pytest.mark.parametrize("name", CURVES)
def test_tone_curves_have_an_inverse_and_keep_float32(name: str) -> None:
    x = np.linspace(0.0, 1.0, 1001)
    # sRGB's own pieces meet to 2e-8
    np.testing.assert_allclose(tone_decoded(tone_encoded(x, CURVES[name]), CURVES[name]), x, rtol=0, atol=1e-7)
    assert tone_encoded(x.astype(np.float32), CURVES[name]).dtype == np.float32
    assert (np.diff(tone_encoded(x, CURVES[name])) > 0.0).all()


@pytest.mark.parametrize("name", CURVES)
def test_a_flat_field_shows_its_tone_curve(name: str) -> None:
    """Green light of a third of full scale, no noise but rounding: the code of the curve, within half a code each."""
    changes = {"shot_noise": False, "read_noise_e": 0.0, "prnu": 0.0, "dsnu_e": 0.0, "dark_e_per_s": 0.0}
    s = CURVES[name].replace(output="srgb8", white_balance=(1.0, 1.0, 1.0), **changes)
    frame = Chain(s).frame(Light.flat((4000.0 / s.exposure_s,) * 3, (16, 16)), STREAM)
    expected = 255.0 * tone_encoded(np.array([1.0 / 3.0]), s)
    np.testing.assert_allclose(frame, float(expected[0]), atol=0.6)  # rounding, and half a DN of the converter
    light = electrons_from_srgb(frame, s)
    np.testing.assert_allclose(light, 4000.0, rtol=0.01)  # half a code of 150 times the slope's 2


def test_denoising_is_a_convolution_of_luma_and_chroma() -> None:
    """By OpenCV's Y'CbCr matrix and SciPy's convolution."""
    blur = np.outer([1, 2, 1], [1, 2, 1]) / 16.0
    to_ycc = np.array([[0.299, 0.587, 0.114], [-0.168736, -0.331264, 0.5], [0.5, -0.418688, -0.081312]])
    ycc = np.einsum("ij,jhw->ihw", to_ycc, PLANES)
    mixed = [x + d * (convolve(x, blur, mode="mirror") - x) for x, d in zip(ycc, (0.3, 0.9, 0.9), strict=True)]
    by_hand = np.einsum("ij,jhw->ihw", np.linalg.inv(to_ycc), mixed)
    s = sensor("yuyv", denoise_luma=0.3, denoise_chroma=0.9)
    np.testing.assert_allclose(processing.denoised(PLANES, s), by_hand, rtol=0, atol=2e-6)  # six digits
    assert processing.denoised(PLANES, sensor("yuyv")) is PLANES


def test_denoising_spares_edges_and_smooths_the_rest() -> None:
    """One pixel by hand, from fractions of its 5 x 5 neighbours; a step of ten thresholds stays, noise goes down."""
    s = sensor("yuyv", denoise_luma=0.8, denoise_reach_px=2, denoise_vertical=0.6, denoise_threshold_codes=20.0)
    grey = np.repeat(RANDOM.uniform(0.3, 0.5, (1, 9, 9)), 3, axis=0)
    across = np.array([1.0, 4.0, 6.0, 4.0, 1.0]) / 16.0
    down = 0.6 * across + np.array([0.0, 0.0, 0.4, 0.0, 0.0])
    near = grey[0, 2:7, 2:7] - grey[0, 4, 4]
    wanted = grey[0, 4, 4] + 0.8 * float(down @ (near * np.exp(-0.5 * (255.0 * near / 20.0) ** 2)) @ across)
    np.testing.assert_allclose(processing.denoised(grey, s)[:, 4, 4], wanted, rtol=1e-6)
    step = np.broadcast_to(np.where(np.arange(40) < 20, 0.1, 0.9), (3, 30, 40))
    noisy = step + RANDOM.normal(0.0, 0.01, (1, 30, 40))
    kept = processing.denoised(noisy, s)[0, :, 3:-3]
    assert abs(np.diff(kept.mean(axis=0))[16] - 0.8) < 0.01  # between columns 19 and 20
    # weights of 5 x 5 pixels: the sum of their squares is 0.16 for a share of 0.8 and 0.6 of the blur along columns
    assert 0.3 < kept[:, :14].std() / 0.01 < 0.5
    blurred = processing.denoised(noisy, s.replace(denoise_threshold_codes=1000.0))[0, :, 3:-3]
    assert np.diff(blurred.mean(axis=0)).max() < 0.5


TABLES = (tuple(range(3, 67)), tuple(range(70, 134)))


def tables_in(data: bytes) -> dict[int, list[int]]:
    """Tables of a JPEG's DQT segments, in their own zigzag order (ITU-T T.81)."""
    found, at = {}, 2
    while data[at : at + 2] != b"\xff\xda":
        length = int.from_bytes(data[at + 2 : at + 4], "big")
        if data[at + 1] == 0xDB:
            body = data[at + 4 : at + 2 + length]
            for first in range(0, len(body), 65):
                found[body[first]] = list(body[first + 1 : first + 65])
        at += 2 + length
    return found


def zigzag() -> list[int]:
    """Places, row by row, in the order of T.81, figure 5: odd diagonals go down, even ones up."""
    return sorted(range(64), key=lambda i: (d := i // 8 + i % 8, i // 8 if d % 2 else i % 8))


def test_given_tables_are_in_the_file_and_go_before_the_quality() -> None:
    s = sensor("mjpeg", jpeg_qtables=TABLES)
    data = Chain(s).jpeg_bytes(room((48, 64)), STREAM)
    order = zigzag()
    assert order[:6] == [0, 1, 8, 16, 9, 2]
    assert tables_in(data) == {k: [table[i] for i in order] for k, table in enumerate(TABLES)}
    assert data == Chain(s.replace(jpeg_quality=10)).jpeg_bytes(room((48, 64)), STREAM)
    assert data != Chain(sensor("mjpeg")).jpeg_bytes(room((48, 64)), STREAM)


def test_the_default_tables_begin_as_those_of_a_real_camera() -> None:
    """A C270's header: 8, 5, ... in zigzag order (rscam issue 20)."""
    assert tables_in(Chain(sensor("mjpeg")).jpeg_bytes(room((48, 64)), STREAM))[0][:2] == [8, 5]


@pytest.mark.parametrize("subsampling", ["4:2:2", "4:2:0"])
def test_restart_markers_are_in_the_file_and_change_no_pixel(subsampling: str) -> None:
    plain, s = (
        Chain(sensor("mjpeg", jpeg_subsampling=subsampling, jpeg_restart_interval=n)).jpeg_bytes(room((64, 64)), STREAM)
        for n in (0, 4)
    )
    assert (b"\xff\xdd\x00\x04\x00\x04" in plain, b"\xff\xdd\x00\x04\x00\x04" in s) == (False, True)
    units = {"4:2:2": 4 * 8, "4:2:0": 4 * 4}[subsampling]
    scan = s[s.index(b"\xff\xda") :]
    # a byte 0xFF within the scan is followed by 0: markers cannot be mistaken
    assert sum(scan.count(bytes([0xFF, 0xD0 + k])) for k in range(8)) == units // 4 - 1
    np.testing.assert_array_equal(*(np.asarray(Image.open(io.BytesIO(data))) for data in (plain, s)))


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"ycbcr_range": "tv"}, "ycbcr_range: 'tv' is not allowed; give one of 'full', 'limited'"),
        ({"chroma_taps": [0.0, 0.5, 0.4]}, r"chroma_taps = .*: must add up to 1, not 0.9"),
        ({"transfer_function": "gamma"}, "transfer_function: 'gamma' is not allowed; give one of 'srgb', 'rec709'"),
        ({"transfer_function": "table"}, "give the measured curve, transfer_points"),
        ({"transfer_points": POINTS}, "transfer_points: only for transfer_function = 'table', not 'srgb'"),
        (
            {"transfer_function": "table", "transfer_points": [[0.0, 0.0], [0.5, 0.7], [0.6, 0.65], [1.0, 1.0]]},
            r"transfer_points 2 and 3, \(0.5, 0.7\) and \(0.6, 0.65\): both columns must rise",
        ),
        (
            {"transfer_function": "table", "transfer_points": [[0.1, 0.0], [1.0, 1.0]]},
            r"must go from \[0, y\] to \[1, 1\]",
        ),
        ({"jpeg_qtables": [[1] * 64, [1] * 63]}, r"jpeg_qtables\[1\].*give a list of 64"),
        ({"jpeg_qtables": [[1] * 64, [256] * 64]}, "jpeg_qtables hold 256: steps must be whole numbers from 1 to 255"),
        ({"jpeg_restart_interval": -1}, "jpeg_restart_interval: -1 is not allowed"),
        ({"denoise_luma": 1.5}, "denoise_luma: 1.5 is not allowed; give a number from 0 up to 1"),
    ],
)
def test_a_fault_is_one_sentence(change: dict, complaint: str) -> None:
    with pytest.raises(SensorError, match=complaint) as caught:
        sensor("yuyv", **change)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 300


def test_an_odd_number_of_columns_is_refused() -> None:
    with pytest.raises(SensorError, match="image of 63 columns: YUYV holds pairs of them, give an even number"):
        Chain(sensor("yuyv")).frame(room((48, 63)), STREAM)
