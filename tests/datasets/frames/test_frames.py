"""Frames of a data set: what they depend on and on nothing else; their noise is independent where it must be."""

from __future__ import annotations

import io
import itertools
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from subprocess import CompletedProcess

import numpy as np
import pytest
import scipy
from helpers.sensor_moments import raw_moments
from PIL import Image

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.frames.frame_request import FrameOptions, jpeg_tables
from phibench.datasets.frames.frame_source import FrameSource
from phibench.datasets.read import Dataset, Sample, open_dataset
from phibench.render.sensor.electrons import NoiseStream
from phibench.render.sensor.light import Region

SEEN, HALF = "seen-near-h0.500", "half-hidden-h1.400"
NAMES = ("down", "up", "down_off", "up_off")


@pytest.fixture(scope="module")
def dataset(tiny_dataset: Path) -> Dataset:
    return open_dataset(tiny_dataset)


@pytest.fixture(scope="module")
def sample(dataset: Dataset) -> Sample:
    return dataset[SEEN]


# -- what a frame is -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("preset", "shape", "dtype"),
    [
        ("ideal", (3, 180, 320), np.float64),
        ("mono-raw", (180, 320), np.uint16),
        ("bayer-raw", (180, 320), np.uint16),
        ("srgb8", (180, 320, 3), np.uint8),
        ("yuyv", (180, 320, 2), np.uint8),
        ("mjpeg", (180, 320, 3), np.uint8),
    ],
)
def test_every_preset_gives_its_arrays(sample: Sample, preset: str, shape: tuple[int, ...], dtype: type) -> None:
    frames = sample.camera_frames(preset, draw=0, laser_off=True)
    assert tuple(frames.by_name) == NAMES
    for name in NAMES:
        image = getattr(frames, name)
        assert (image.shape, image.dtype) == (shape, dtype)
    assert sorted(frames.jpeg) == (sorted(NAMES) if preset == "mjpeg" else [])


def test_ideal_frames_are_the_layers_times_the_exposure(sample: Sample) -> None:
    frames = sample.camera_frames("ideal", exposure=0.01, lamp_level=0.5, laser_level=3.0, laser_off=True)
    spot = np.zeros((3, 180, 320))
    sample.spot("up").add_to(spot)
    # sums and products of doubles
    np.testing.assert_allclose(frames.up_off, 0.005 * sample.ambient("up").astype(float), rtol=1e-12)
    np.testing.assert_allclose(frames.up - frames.up_off, 0.03 * spot, rtol=1e-9, atol=1e-9)


def test_the_jpeg_is_what_pillow_reads(sample: Sample) -> None:
    frames = sample.camera_frames("mjpeg", draw=3, laser_off=True)
    for name in NAMES:
        with Image.open(io.BytesIO(frames.jpeg[name])) as picture:
            assert (picture.format, picture.mode, picture.size) == ("JPEG", "RGB", (320, 180))
            np.testing.assert_array_equal(np.asarray(picture), getattr(frames, name))
    better = sample.camera_frames("mjpeg", draw=3, jpeg_quality=95)
    assert len(better.jpeg["down"]) > len(frames.jpeg["down"])


@pytest.mark.parametrize("preset", ["ideal", "mono-raw", "bayer-raw", "srgb8", "yuyv", "mjpeg"])
def test_a_region_is_a_crop_of_the_frame(sample: Sample, preset: str) -> None:
    whole = sample.camera_frames(preset, draw=2, laser_off=True)
    source = sample.region_frames(preset, 64)
    part = source.frames(2, laser_off=True)
    for name in NAMES:
        frame = part.by_name[name]
        row = sample.truth_row(frame.position)
        assert frame.region == Region.around(row.u_px, row.v_px, (180, 320), 64)
        slices = frame.region.slices()
        expected = getattr(whole, name)[slices if preset in ("srgb8", "yuyv", "mjpeg") else (..., *slices)]
        np.testing.assert_array_equal(frame.image, expected)
    assert part.jpeg == {}


def test_a_moving_carriage_moves_the_spot(sample: Sample) -> None:
    """0.2 m/s: the spot's rows are read at their own times; regions and frames agree to the bit."""
    still, moving = (sample.camera_frames("ideal", carriage_speed_m_s=speed, laser_off=True) for speed in (0.0, 0.2))
    flux = [(f.up - f.up_off)[0].sum() for f in (still, moving)]
    assert flux[1] == pytest.approx(flux[0], rel=1e-3)  # rows that see it at other times trade with each other
    centres = [_centroid((f.up - f.up_off)[0]) for f in (still, moving)]
    assert np.hypot(*(centres[1] - centres[0])) > 0.01
    np.testing.assert_array_equal(still.up_off, moving.up_off)
    part = sample.region_frames("bayer-raw", 48, carriage_speed_m_s=0.2).frames(1).by_name["up"]
    whole = sample.camera_frames("bayer-raw", draw=1, carriage_speed_m_s=0.2)
    np.testing.assert_array_equal(part.image, whole.up[part.region.slices()])


def _centroid(image: np.ndarray) -> np.ndarray:
    v, u = np.indices(image.shape)
    return np.array([(image * u).sum(), (image * v).sum()]) / image.sum()


def test_auto_exposure_looks_at_the_room_alone(sample: Sample) -> None:
    source = sample.frame_source("srgb8", exposure="auto")
    on, off = source.frame("down"), source.frame("down", laser=False)
    assert on.sensor == off.sensor
    darker = sample.frame_source("srgb8", exposure="auto", lamp_level=0.5).frame("down").sensor
    light, half = (s.exposure_s * s.analogue_gain for s in (on.sensor, darker))
    # pixels at the converter's end count less under half the light
    assert 1.9 * light < half < 2.1 * light
    assert sample.frame_source("srgb8").frame("down").sensor == on.sensor  # what is not given is the camera's choice
    assert source.frame("up").sensor == on.sensor  # one exposure for both images of a pair
    fixed = sample.frame_source("srgb8", exposure=None).frame("down").sensor
    assert fixed.exposure_s == pytest.approx(1 / 60)


def test_a_hidden_spot_gives_frames_of_the_room(dataset: Dataset) -> None:
    frames = dataset[HALF].camera_frames("ideal", laser_off=True)
    np.testing.assert_array_equal(frames.down, frames.down_off)
    assert (frames.up != frames.up_off).any()


# -- what a frame depends on ---------------------------------------------------------------------------------------


def test_order_and_company_do_not_matter(dataset: Dataset, sample: Sample) -> None:
    expected = sample.camera_frames("mjpeg", draw=4, laser_off=True)
    source = sample.frame_source("mjpeg")
    for position, draw in (("up", 9), ("down", 4), ("down", 0)):
        source.frame(position, draw)
    dataset[HALF].camera_frames("mjpeg", draw=4)
    for name, laser in (("up_off", False), ("down", True), ("up", True)):
        again = source.frame(name.removesuffix("_off"), 4, laser)
        np.testing.assert_array_equal(again.image, getattr(expected, name))
        assert again.jpeg == expected.jpeg[name]
    np.testing.assert_array_equal(source.frame("up", np.int64(4)).image, expected.up)


CHILD = """
import hashlib, sys
from phibench.datasets.read import open_dataset
for sample in list(open_dataset(sys.argv[1]))[:: int(sys.argv[2])]:
    frames = sample.camera_frames("mjpeg", draw=0, laser_off=True)
    for name in frames.by_name:
        print(sample.row.sample_id, name, hashlib.sha256(getattr(frames, name).tobytes()).hexdigest())
assert "mitsuba" not in sys.modules
"""


@pytest.mark.slow
def test_another_process_draws_the_same_bits(tiny_dataset: Path, python: Callable[..., CompletedProcess[str]]) -> None:
    runs = [python(CHILD, str(tiny_dataset), step, PYTHONHASHSEED=seed) for step, seed in (("1", "1"), ("-1", "2"))]
    lines = [sorted(run.stdout.splitlines()) for run in runs]
    assert lines[0] == lines[1]
    assert len(set(lines[0])) == 8, runs[0].stderr


def test_the_camera_seed_names_the_fixed_pattern(sample: Sample) -> None:
    """Averaged over 64 draws: two draws of one camera share its pattern, two cameras do not."""
    settings = {"prnu": 0.05, "dsnu_e": 50.0, "analogue_gain": 4.0, "exposure": 1e-3}
    pattern = [_pattern(sample.frame_source("mono-raw", camera_seed=c, **settings), 8) for c in (0, 0, 1)]
    limit = 6.0 / np.sqrt(pattern[0].size)  # false alarm 2e-9
    assert _correlation(pattern[0], pattern[1]) > 0.9
    assert abs(_correlation(pattern[0], pattern[2])) < limit


def _pattern(source: FrameSource, draws: int) -> np.ndarray:
    """Mean frame less the expectation of a sensor without pattern."""
    side = source.sides["down"]
    mean = np.mean([source.frame("down", k).image for k in range(draws)], axis=0)
    flat = side.chain.sensor.replace(prnu=0.0, dsnu_e=0.0)
    moments = raw_moments(type(side.chain)(flat), side.light, side.region)
    return np.where(moments.mean_dn < 900.0, mean - moments.mean_dn, 0.0)


# -- independence --------------------------------------------------------------------------------------------------

# Gain 4, so that rounding is white; residuals in units of their own standard deviation, pixels that reach the
# converter's end left out. A correlation of n independent pairs has the standard error 1/sqrt(n): 6 of them, false
# alarm 2e-9 for each of the pairs below.
FRAMES = [(p, laser, draw) for p in ("down", "up") for laser in (True, False) for draw in (0, 1)]


def _residual(source: FrameSource, position: str, laser: bool, draw: int) -> np.ndarray:
    side = source.sides[position]
    light = side.light if laser else side.light.laser_off()
    moments = raw_moments(side.chain, light, side.region)
    z = (source.frame(position, draw, laser).image - moments.mean_dn) / np.sqrt(moments.variance_dn2)
    return np.where(moments.mean_dn < 850.0, z, 0.0)


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    return float((a * b).sum() / np.sqrt((a * a).sum() * (b * b).sum()))


def _limit(a: np.ndarray, b: np.ndarray) -> float:
    count = int(((a != 0.0) & (b != 0.0)).sum())
    assert count > 20_000
    return 6.0 / np.sqrt(count)


def _dependent(residuals: list[np.ndarray]) -> list[bool]:
    return [abs(_correlation(a, b)) > _limit(a, b) for a, b in itertools.combinations(residuals, 2)]


def test_frames_of_a_data_set_are_independent(dataset: Dataset) -> None:
    """Down and up, on and off, adjacent draws, both samples: 120 pairs of 16 frames."""
    sources = [sample.frame_source("bayer-raw", analogue_gain=4.0, exposure=4e-3) for sample in dataset]
    found = _dependent([_residual(source, *frame) for source in sources for frame in FRAMES])
    assert len(found) == 120
    assert not any(found)


@pytest.mark.parametrize("forgotten", ["sample", "position", "laser", "draw"])
def test_a_shared_stream_is_noticed(dataset: Dataset, monkeypatch: pytest.MonkeyPatch, forgotten: str) -> None:
    """The same measure, with one name left out of the stream: the pairs that then share it are found."""

    def stream(data: str, seed: int, sample: str, position: str, laser: bool, draw: int) -> NoiseStream:
        names = {"data": data, "seed": seed, "sample": sample, "position": position, "laser": str(laser), "draw": draw}
        return NoiseStream(tuple(value for name, value in names.items() if name != forgotten))

    monkeypatch.setattr("phibench.datasets.frames.frame_source.frame_stream", stream)
    sources = [sample.frame_source("bayer-raw", analogue_gain=4.0, exposure=4e-3) for sample in dataset]
    found = _dependent([_residual(source, *frame) for source in sources for frame in FRAMES])
    assert sum(found) == 8  # every frame has exactly one twin


def test_the_seed_of_the_data_set_counts(dataset: Dataset, sample: Sample) -> None:
    assert sample.stream_names == ("tiny", 0, SEEN)
    zero = sample.frame_source("bayer-raw", analogue_gain=4.0, exposure=4e-3)
    one = FrameSource(zero.request, ("tiny", 1, SEEN), zero.sides)
    residuals = [_residual(source, "down", True, 0) for source in (zero, one, zero)]
    assert _dependent(residuals) == [False, True, False]


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["mono-raw", "bayer-raw"])
def test_the_mean_of_many_draws_is_the_expectation(sample: Sample, preset: str) -> None:
    """400 draws of both regions: chi-square of the mean, and of the sum of squares, two-sided 1e-6 each.

    Light that is 1 % off is noticed. Pixels are independent given the camera's pattern, which is in the expectation.
    """
    draws = 400
    source = sample.region_frames(preset, 48, analogue_gain=4.0, exposure=1e-3)
    for position in ("down", "up"):
        side = source.sides[position]
        moments = raw_moments(side.chain, side.light, side.region)
        images = np.array([source.frame(position, k).image for k in range(draws)], dtype=float)
        inside = moments.mean_dn < 800.0
        assert inside.sum() > 1000
        signal = (moments.mean_dn - 64.0)[inside]
        z = (images.mean(axis=0) - moments.mean_dn)[inside] / np.sqrt(moments.variance_dn2[inside] / draws)
        wrong = z + 0.01 * signal / np.sqrt(moments.variance_dn2[inside] / draws)
        assert _two_sided(scipy.stats.chi2(inside.sum()), z @ z) > 1e-6
        assert _two_sided(scipy.stats.chi2(inside.sum()), wrong @ wrong) < 1e-6
        spread = (images.var(axis=0, ddof=1)[inside] / moments.variance_dn2[inside]).sum() * (draws - 1)
        law = scipy.stats.norm(inside.sum() * (draws - 1), np.sqrt(2.0 * inside.sum() * (draws - 1)))
        assert _two_sided(law, spread) > 1e-6
        assert _two_sided(law, 1.03 * spread) < 1e-6


def _two_sided(law: object, value: float) -> float:
    return 2.0 * min(law.cdf(value), law.sf(value))  # type: ignore[attr-defined]


# -- mistakes ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"preset": "mjpg"}, "no sensor preset 'mjpg'; did you mean 'mjpeg'"),
        ({"draw": -1}, "draw = -1: must be an integer, 0 or above"),
        ({"draw": 1.5}, "draw = 1.5: must be an integer"),
        ({"draw": True}, "draw = True: must be an integer"),
        ({"camera_seed": -3}, "camera_seed = -3"),
        ({"region": 181}, "region of 181 px: allowed sides are 1 to 180"),
        ({"region": 0}, "region = 0: must be an integer, 1 or above"),
        ({"region": Region(0, 0, 321, 10)}, "inside the image of 320 x 180 pixels"),
        ({"exposure": 0}, "exposure_s: 0 is not allowed; give a number above 0 up to 10"),
        ({"exposure": "fast"}, "exposure = 'fast': give seconds above 0, or 'auto'"),
        ({"exposure": 0.1, "exposure_s": 0.1}, "are both given"),
        ({"jpeg_quality": 0}, "jpeg_quality: 0 is not allowed; give an integer from 1 up to 100"),
        ({"jpeg_qualty": 80}, "unknown key; did you mean 'jpeg_quality'"),
        ({"laser_level": -1.0}, "laser_level = -1.0: must be a number from 0 to 1e+06"),
        ({"carriage_speed_m_s": float("nan")}, "carriage_speed_m_s = nan: must be a number from -1000 to 1000"),
        ({"carriage_speed_m_s": 1e3}, "move the carriage more slowly"),
        ({"carriage_speed_m_s": "1"}, "carriage_speed_m_s = '1': must be a number"),
        ({"lamp_level": "2"}, "lamp_level = '2': must be a number from 0 to 1e+06"),
        ({"lamp_level": 1e300}, "lamp_level = 1e+300: must be a number from 0 to 1e+06"),
        ({"laser_level": None}, "laser_level = None: must be a number"),
        ({"preset": 3}, "preset = 3: give the name of a preset"),
        ({"region": Region(0.5, 0, 10, 10)}, "region.u0_px = 0.5: must be an integer"),
        ({"overrides": {}}, "overrides: give the numbers of the preset by name"),
    ],
)
def test_a_mistake_is_one_sentence(sample: Sample, options: dict[str, object], words: str) -> None:
    with pytest.raises(DatasetError, match=re.escape(words)) as caught:
        sample.camera_frames(**options)  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)


def test_what_was_not_drawn_is_refused(sample: Sample) -> None:
    frames = sample.camera_frames("bayer-raw", region=8)
    with pytest.raises(DatasetError, match=r"'up_off' was not drawn: ask for frames\(laser_off=True\)"):
        _ = frames.up_off
    with pytest.raises(DatasetError, match="'down' or 'up'"):
        sample.frame_source("bayer-raw").frame("left")


def test_a_missing_layer_is_named(tiny_dataset: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(tiny_dataset, tmp_path / "copy"))
    (copy / "views/h0.500/ambient.exr").unlink()
    with pytest.raises(DatasetError, match=r"ambient\.exr is missing"):
        open_dataset(copy)[SEEN].camera_frames()


def test_tables_of_a_file_go_into_the_frames(tmp_path: Path) -> None:
    """Of a JPEG and of `cjpeg -qtables` text, read by Pillow; what is no table is refused in one sentence."""
    luma, chroma = tuple(range(2, 66)), tuple(range(40, 104))
    Image.new("RGB", (16, 16)).save(tmp_path / "camera.jpg", qtables=[list(luma), list(chroma)])
    assert jpeg_tables(tmp_path / "camera.jpg") == (luma, chroma)
    Image.new("L", (16, 16)).save(tmp_path / "grey.jpg", qtables=[list(luma)])
    assert jpeg_tables(tmp_path / "grey.jpg") == (luma, luma)
    words = [str(step) for step in (*luma, *chroma)]
    rows = (" ".join(words[k : k + 8]) for k in range(0, 128, 8))
    (tmp_path / "tables.txt").write_text("# of a camera\n" + "\n".join(rows))
    request = FrameOptions("mjpeg", {"jpeg_qtables": tmp_path / "tables.txt"})
    assert request.sensor().jpeg_qtables == (luma, chroma)
    assert json.loads(json.dumps(request.document()))["jpeg_qtables"][1][0] == 40
    for text, complaint in (("1 2 3", "no quantisation"), ("0 " * 64, "steps outside 1 to 255"), ("x", "no quant")):
        (tmp_path / "bad.txt").write_text(text)
        with pytest.raises(DatasetError, match=complaint) as caught:
            FrameOptions("mjpeg", {"jpeg_qtables": str(tmp_path / "bad.txt")})
        assert "bad.txt" in str(caught.value)
        assert "\n" not in str(caught.value)
    Image.new("RGB", (16, 16)).save(tmp_path / "frame.png")
    with pytest.raises(DatasetError, match=r"frame.png"):
        jpeg_tables(tmp_path / "frame.png")
