"""Networks: their input, their files and what is wrong with one, and training where PyTorch is installed."""

import importlib.util
import io
import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import pytest

from phibench.benchmark.isolation.easy_pairs import EasyPairs
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.frames.sensor_card import sensor_card
from phibench.estimator.learned import networks
from phibench.estimator.learned.network_file import read_model
from phibench.estimator.learned.network_graphs import CROP, DETECT
from phibench.estimator.learned.network_input import (
    SCALARS,
    SIDE_PX,
    VIEWS,
    WINDOW_PX,
    CropInput,
    crop_input,
    crop_origin,
    cut_part,
    filter_planes,
    frame_input,
)
from phibench.estimator.learned.networks import (
    Network,
    NetworkError,
    covariances,
    heat_peaks,
    sealed_model,
    shipped_network,
)
from phibench.estimator.methods.registry import METHODS, learned_crop, learned_detect
from phibench.scenes.random_streams import generator
from tools import crop_training, frame_training
from tools.crop_training import Answers, TrainingSettings, scale_of
from tools.frame_training import FrameSettings

FOLDER = Path(networks.__file__).parent
NAMES = [CROP, DETECT]
RUNTIME = importlib.util.find_spec("onnxruntime") is not None
needs_runtime = pytest.mark.skipif(not RUNTIME, reason="onnxruntime is not installed: pip install 'phibench[learned]'")
needs_torch = pytest.mark.skipif(
    not RUNTIME or any(importlib.util.find_spec(name) is None for name in ("torch", "onnx")),
    reason="training needs PyTorch, 200 MB: pip install 'phibench[learned-training]'",
)
ONE_SENTENCE = r"^[^\n]+$"


# -- input -----------------------------------------------------------------------------------------------------------


def test_crops_begin_with_red_and_hold_the_place_in_their_middle() -> None:
    draw = generator("crop origins")
    for uv in draw.uniform(0.0, 700.0, (200, 2)):
        u0, v0 = crop_origin((uv[0], uv[1]))
        assert (u0 % 2, v0 % 2) == (0, 0)
        assert np.abs(uv - [u0 + 15.5, v0 + 15.5]).max() <= 1.0 + 1e-9


def test_beyond_the_border_stands_its_mirror_image_in_the_mosaics_order() -> None:
    v, u = np.indices((40, 50))
    colours = v % 2 + u % 2
    for origin in ((-6, -4), (30, 20), (8, 2)):
        part = cut_part(colours, origin)
        assert part.shape == (WINDOW_PX, WINDOW_PX)
        np.testing.assert_array_equal(part, (np.indices(part.shape) % 2).sum(axis=0))
    np.testing.assert_array_equal(cut_part(u, (7, 2)), u[2:35, 7:40])


DEV = (1.0, 0.10, 0.03)  # response of the filters of `bench-dev`


def spot_e(uv: tuple[float, float], electrons: float) -> np.ndarray:
    """Smooth spot, the same in all filters, shape (33, 33)."""
    v, u = np.indices((WINDOW_PX, WINDOW_PX))
    return np.asarray(electrons * np.exp(-0.5 * ((u - uv[0]) ** 2 + (v - uv[1]) ** 2) / 3.0**2))


def test_gain_and_room_are_not_in_the_planes() -> None:
    """A wide spot without noise at two gains: DN are whole, 0.5 DN of a spot of 250 or 500 DN, twice, and of the room.

    Interpolation of a Gaussian of 3 px is the same at both gains.
    """
    made = []
    for gain, room_e in ((1.0, 200.0), (2.0, 900.0)):
        card = replace(sensor_card("bayer-raw"), dn_per_e=gain * 0.1, full_well_e=1e5, top_dn=60000)
        off = np.rint(card.black_level_dn + card.dn_per_e * np.full((WINDOW_PX, WINDOW_PX), room_e)).astype(np.uint16)
        on = np.rint(card.black_level_dn + card.dn_per_e * (room_e + spot_e((14.7, 16.2), 2500.0))).astype(np.uint16)
        made.append(crop_input(on, off, card, DEV))
    assert made[0].scalars.shape == (SCALARS,)
    assert np.abs(made[0].planes - made[1].planes).max() < 3.0 * 0.5 / 250.0
    assert np.abs(made[0].planes[0].max() - 1.0) < 0.1
    assert made[0].scalars[3] < made[1].scalars[3]  # the room's level is a number by itself


def test_two_numbers_tell_the_steps_of_jpeg() -> None:
    """Against the tables in a file of Pillow's; own tables count as a quality does, and other images have none."""
    window = np.full((WINDOW_PX, WINDOW_PX, 3), 90, np.uint8)
    for quality in (40, 76, 95):
        file = io.BytesIO()
        PIL.Image.fromarray(window).save(file, "JPEG", quality=quality)
        tables = [PIL.Image.open(file).quantization[k] for k in (0, 1)]  # type: ignore[attr-defined]
        expected = [math.log(sum(table) / 640.0) for table in tables]
        card = sensor_card("mjpeg", jpeg_quality=quality)
        np.testing.assert_allclose(crop_input(window, window, card, DEV).scalars[5:7], expected, rtol=1e-6)
    own = replace(card, jpeg_quality=20, jpeg_qtables=((16,) * 64, (20,) * 64))
    np.testing.assert_allclose(crop_input(window, window, own, DEV).scalars[5:7], np.log([1.6, 2.0]), rtol=1e-6)
    plain = crop_input(window, window, sensor_card("srgb8"), DEV).scalars
    assert plain[5:].tolist() == [0.0, 0.0, 0.0, 0.0]


def test_filters_that_let_more_of_the_laser_through_give_the_same_planes() -> None:
    """A wide spot without noise of 2500 DN behind two sets of filters: half a DN on and off, in both sets."""
    made = []
    for response in (DEV, (0.9, 0.18, 0.08)):
        card = replace(sensor_card("bayer-raw"), dn_per_e=0.1, full_well_e=1e5, top_dn=60000)
        v, u = np.indices((WINDOW_PX, WINDOW_PX))
        light = spot_e((14.7, 16.2), 25_000.0 / response[0]) * np.array(response)[v % 2 + u % 2]
        on, off = (np.rint(card.black_level_dn + card.dn_per_e * x).astype(np.uint16) for x in (200.0 + light, 200.0))
        made.append(crop_input(on, np.full_like(on, off), card, response).planes[:3])
    assert np.abs(made[0] - made[1]).max() < 4 * 0.5 / 2500.0
    assert np.abs(made[0][0].max() - 1.0) < 0.1
    assert 0.02 < made[0][2].max() < 0.04
    nothing = crop_input(on, np.full_like(on, off), card, (1.0, 0.0, 0.0))
    assert np.isfinite(nothing.planes).all()


def test_views_of_a_window_show_the_spot_where_their_matrix_says() -> None:
    """The largest pixel of a spot in a corner of the window, in all eight views; red stays at the first pixel."""
    v, u = np.indices((WINDOW_PX, WINDOW_PX))
    red = ((v % 2 == 0) & (u % 2 == 0)).astype(float)
    assert len({tuple(view.matrix.ravel()) for view in VIEWS}) == 8
    for view in VIEWS:
        seen = view.of(np.stack([spot_e((9.0, 20.0), 1.0), red]))
        assert seen.shape == (2, SIDE_PX, SIDE_PX)
        place = view.matrix @ (np.array([9.0, 20.0]) - 16.0) + 16.0
        assert np.unravel_index(int(np.argmax(seen[0])), seen[0].shape) == (place[1], place[0])
        np.testing.assert_array_equal(seen[1], red[:SIDE_PX, :SIDE_PX])


def test_raw_and_8_bit_planes_are_the_same_electrons() -> None:
    """Grey of 300 DN: half a code of 8 bits is 0.5 % to 1 % of it in linear light."""
    raw, eight = sensor_card("bayer-raw"), sensor_card("srgb8")
    from phibench.render.sensor import processing
    from phibench.render.sensor.settings import sensor

    dn, s = np.full((SIDE_PX, SIDE_PX), 300, np.uint16), sensor("bayer-raw")
    image = processing.eight_bit(processing.srgb_encoded(processing.linear_rgb(processing.linear_signal(dn, s), s)))
    (a, _), (b, _) = filter_planes(dn, raw), filter_planes(image, eight)
    assert np.abs(b / a - 1.0).max() < 0.015


def test_covariances_are_the_inverse_of_the_precision() -> None:
    factors = generator("factors").normal(0.0, 1.0, (50, 3))
    found = covariances(factors, 2.0)
    for (a, b, c), covariance in zip(factors, found, strict=True):
        lower = np.array([[np.exp(a), 0.0], [b, np.exp(c)]])
        np.testing.assert_allclose(covariance @ (lower @ lower.T), 2.0 * np.eye(2), rtol=0, atol=1e-9)


def test_the_scale_makes_pulls_unit_and_is_not_moved_by_a_few() -> None:
    """4000 Gaussian errors whose covariance is claimed 4 times too small; one in 200 is ten times as far off.

    The mean of 4000 squared pulls of two numbers has the deviation 1/sqrt(4000) = 1.6 %; outliers, cut at 25, add
    0.005 * 25 = 12 % of one at most.
    """
    draw = generator("scale")
    error = draw.normal(0.0, 0.02, (4000, 2))
    error[::200] *= 10.0
    answers = Answers(error, np.tile(0.01**2 * np.eye(2), (4000, 1, 1)))
    assert 4.0 * (1.0 - 5 * 0.016) < scale_of(answers) < 4.0 * (1.14 + 5 * 0.016)


def test_significances_of_a_frame_know_neither_gain_nor_room() -> None:
    """The same electrons at two gains, steps of 0.01 and 0.005 electrons at a noise of 15: less than a thousandth."""
    draw, made = generator("frame input"), []
    v, u = np.indices((64, 80))
    spot = 400.0 * np.exp(-0.5 * ((u - 37.0) ** 2 + (v - 22.0) ** 2) / 1.5**2)
    noise = draw.normal(0.0, 15.0, (2, 64, 80))
    for gain, room_e in ((100.0, 200.0), (200.0, 220.0)):
        card = replace(sensor_card("bayer-raw"), dn_per_e=gain, full_well_e=1e5, top_dn=2**31)
        on, off = (card.black_level_dn + np.rint(gain * (room_e + x)) for x in (spot + noise[0], noise[1]))
        made.append(frame_input(on, off, card))
    (first, red), (second, _) = made
    assert first.shape == (3, 32, 40)
    assert np.unravel_index(int(np.argmax(first[0])), red.shape) == (11, 18)
    # a cell's variance is the mean of the card's; the room's 10 % of it cancels with the measured scatter
    assert np.abs(first - second).max() < 0.02
    assert not first[2].any()


def test_peaks_of_heat_are_the_largest_of_five_cells_inside_the_part() -> None:
    heat = np.full((30, 40), -9.0)
    for (v, u), value in {(10, 10): 3.0, (10, 12): 4.0, (20, 30): 2.0, (25, 5): 9.0, (5, 35): -1.0}.items():
        heat[v, u] = value
    inside = np.ones(heat.shape, bool)
    inside[24:] = False
    red = np.zeros(heat.shape)
    red[20, 30] = 25.0
    found = heat_peaks(heat, red, inside, 0.0)
    assert found.cells.tolist() == [[12.0, 10.0], [30.0, 20.0]]
    assert found.heat.tolist() == [4.0, 2.0]
    np.testing.assert_allclose(found.red_e, [0.0, 1.0], atol=1e-12)


# -- files -----------------------------------------------------------------------------------------------------------


@needs_runtime
@pytest.mark.parametrize("name", NAMES)
def test_shipped_networks_are_small_and_give_the_same_bytes(name: str) -> None:
    file = FOLDER / f"{name}.onnx"
    assert file.stat().st_size <= 1_000_000
    assert shipped_network(name).metadata["version"] == networks.VERSIONS[name]
    inputs = {"planes": generator("planes").normal(size=(3, 4, 32, 32)).astype(np.float32)}
    inputs["scalars"] = np.zeros((3, SCALARS), np.float32)
    if name != CROP:
        inputs = {"planes": inputs["planes"][:, :3]}
    first, second = (Network(file, name).run(**inputs) for _ in range(2))
    assert all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))


@needs_runtime
def test_a_mirrored_window_has_the_mirrored_answer() -> None:
    """A window of a spot beside the middle, in three views: floats of 6e-8 through six layers, places of 20 pixels."""
    card = sensor_card("bayer-raw")
    noise = generator("mirrored windows").normal(0.0, 15.0, (2, WINDOW_PX, WINDOW_PX))
    v, u = np.indices((WINDOW_PX, WINDOW_PX))
    light = 1500.0 * np.exp(-0.5 * ((u - 14.3) ** 2 + (v - 17.1) ** 2) / 1.3**2) * np.array(DEV)[v % 2 + u % 2]
    on, off = (card.black_level_dn + np.rint(card.dn_per_e * (300.0 + x)) for x in (light + noise[0], noise[1]))
    whole = crop_input(on, off, card, DEV)
    found = shipped_network(CROP).position(whole)
    assert np.abs(found.uv_px - [14.3, 17.1]).max() < 0.5
    for turn in (lambda x: x[..., ::-1], lambda x: x[..., ::-1, :], lambda x: np.swapaxes(x, -1, -2)):
        seen = shipped_network(CROP).position(replace(whole, planes=np.ascontiguousarray(turn(whole.planes))))
        marked = turn(np.stack([u, v]).astype(float))  # where each pixel of the turned window comes from
        slopes = np.array([[marked[i, 0, 1] - marked[i, 0, 0], marked[i, 1, 0] - marked[i, 0, 0]] for i in (0, 1)])
        np.testing.assert_allclose(slopes @ seen.uv_px + marked[:, 0, 0], found.uv_px, rtol=0, atol=1e-4)
        np.testing.assert_allclose(slopes @ seen.covariance_px2 @ slopes.T, found.covariance_px2, rtol=1e-3, atol=1e-7)


def convolved(x: np.ndarray, kernel: np.ndarray, offset: np.ndarray, stride: int) -> np.ndarray:
    """Sums over the kernel's places, without a border."""
    side = kernel.shape[-1]
    windows = np.lib.stride_tricks.sliding_window_view(x, (side, side), axis=(2, 3))[:, :, ::stride, ::stride]
    return np.einsum("nihwyx,oiyx->nohw", windows, kernel) + offset[:, None, None]


@needs_runtime
def test_the_network_of_crops_is_what_its_description_says() -> None:
    """The layers in double precision by NumPy: sums of 1200 terms of order 1 at 6e-8, through six layers."""
    draw = generator("tests", "crops by numpy")
    planes = draw.normal(0.0, 0.3, (5, 4, 32, 32)).astype(np.float32)
    scalars = draw.uniform(0.0, 1.0, (5, SCALARS)).astype(np.float32)
    w = {key: np.asarray(x, float) for key, x in read_model((FOLDER / f"{CROP}.onnx").read_bytes()).tensors.items()}

    def dense(name: str, x: np.ndarray) -> np.ndarray:
        return np.asarray(x @ w[f"{name}.w"] + w[f"{name}.b"])

    film = dense("f2", np.maximum(dense("f1", scalars), 0.0))[:, :, None, None]
    x = convolved(planes.astype(float), w["c1.w"], w["c1.b"], 2)
    x = np.maximum(x * film[:, :32] + film[:, 32:], 0.0)
    for name in ("c2", "c3", "c4"):
        x = np.maximum(convolved(x, w[f"{name}.w"], w[f"{name}.b"], 1), 0.0)
    assert x.shape == (5, 32, 8, 8)
    cells = convolved(x, w["cells.w"], w["cells.b"], 1)
    weight = np.exp(cells[:, 0] - cells[:, 0].max(axis=(1, 2), keepdims=True))
    weight /= weight.sum(axis=(1, 2), keepdims=True)
    v, u = 8.0 + 2.0 * np.indices((8, 8))
    middle = [(weight * (cells[:, k + 1] + place)).sum(axis=(1, 2)) for k, place in enumerate((u, v))]
    less = np.maximum(convolved(x, w["less.w"], w["less.b"], 1), 0.0).reshape(5, -1)
    pooled = np.concatenate([(weight[:, None] * x).sum(axis=(2, 3)), less, scalars], axis=1)
    y = dense("d2", np.maximum(dense("d1", pooled), 0.0))
    uv, factor = shipped_network(CROP).run(planes=planes, scalars=scalars)
    np.testing.assert_allclose(uv, np.stack(middle, axis=1) + 0.1 * y[:, :2], rtol=0, atol=1e-3)
    np.testing.assert_allclose(factor, y[:, 2:], rtol=1e-3, atol=1e-3)


@needs_runtime
@pytest.mark.parametrize("name", NAMES)
def test_files_that_will_not_do_are_refused_in_one_sentence(name: str, tmp_path: Path, monkeypatch: Any) -> None:
    model = (FOLDER / f"{name}.onnx").read_bytes()
    bare = model[:-76]  # without the entry of its hash
    assert sealed_model(bare) == model
    version = networks.VERSIONS[name].encode()
    other = bare.replace(b"version\x12\x01" + version, b"version\x12\x010")
    assert other != bare
    cases = [
        (sealed_model(other), f"is of version 0, this phibench needs version {version.decode()}"),
        (b"", "does not end as"),
        (model[:-1], "does not end as"),
        (sealed_model(b"no network"), "is no ONNX model"),
        (sealed_model(_renamed(bare, name)), f"not '{name}'"),
    ]
    for place in generator("flipped bits").integers(0, len(model), 20):
        flipped = bytearray(model)
        flipped[place] ^= 1 << int(place) % 8
        cases.append((bytes(flipped), "does not end as|is damaged"))
    for number, (data, text) in enumerate(cases):
        path = tmp_path / f"{number}.onnx"
        path.write_bytes(data)
        with pytest.raises(NetworkError, match=text) as caught:
            Network(path, name)
        assert "\n" not in str(caught.value)
        assert "install phibench anew" in str(caught.value)
    with pytest.raises(DatasetError, match="install phibench anew"):
        Network(tmp_path / "nothing.onnx", name)
    monkeypatch.setattr(networks, "SHIPPED", {CROP: "0" * 64, DETECT: "0" * 64})
    with pytest.raises(NetworkError, match="belongs to another release"):
        shipped_network(name)


@pytest.mark.parametrize(
    "method", [learned_crop, lambda file: learned_detect(file), lambda file: learned_detect(crop=file)]
)
def test_a_method_of_a_wrong_file_is_refused_before_the_first_pair(method: Any, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"nothing\.onnx is missing; install phibench anew"):
        method(tmp_path / "nothing.onnx")


def _renamed(model: bytes, name: str) -> bytes:
    """Model whose name has another last letter."""
    entry = b"name\x12" + bytes([len(name)]) + name.encode()
    assert entry in model
    return model.replace(entry, entry[:-1] + b"x")


def test_without_onnxruntime_and_pytorch_it_says_what_to_install(monkeypatch: Any, tmp_path: Path) -> None:
    for name in ("onnxruntime", "torch"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(NetworkError, match=r"onnxruntime: pip install 'phibench\[learned\]'$"):
        Network(FOLDER / f"{CROP}.onnx", CROP)
    with pytest.raises(NetworkError, match=r"training needs PyTorch: pip install 'phibench\[learned-training\]'"):
        crop_training.torch_on_one_thread()
    absent = replace(METHODS[CROP] if RUNTIME else next(iter(METHODS.values())), package="no_such_package_here")
    assert absent(EasyPairs("bayer-raw").pair(0)).down.status == "install no_such_package_here"


# -- detection in whole frames ---------------------------------------------------------------------------------------


@pytest.mark.slow
@needs_runtime
@pytest.mark.parametrize("preset", ["bayer-raw", "srgb8", "mjpeg"])
def test_a_bright_spot_is_found_in_the_whole_mirror_and_an_absent_one_is_not(preset: str) -> None:
    pairs = EasyPairs(preset, hinted=False)
    pair, truth = pairs.pair(0), pairs.truth(0)
    answer = METHODS[DETECT](pair)
    for spot, true in ((answer.down, truth.down), (answer.up, truth.up)):
        assert spot.uv_px is not None
        assert spot.covariance_px2 is not None
        # of 25 000 electrons: its claims are below 0.2 px, five of them are a pixel
        assert np.hypot(*np.subtract(spot.uv_px, true.uv_px)) < 1.0
    dark = pairs.pair(1)  # the same camera and room, other noise
    without = METHODS[DETECT](replace(pair, down=dark.down_off, up=dark.up_off))
    assert (without.down.uv_px, without.up.uv_px) == (None, None)
    assert without.down.status == "no spot found"
    half = METHODS[DETECT](replace(pair, up=dark.up_off))
    assert (half.down.uv_px is None, half.up.uv_px is None) == (False, True)
    assert METHODS[DETECT](replace(pair, down_off=None)).down.status == "needs laser-off frames"


@needs_runtime
def test_boxes_restrict_the_search() -> None:
    pairs = EasyPairs("srgb8")
    pair = pairs.pair(2)
    assert pair.box_down is not None
    there = METHODS[DETECT](pair).down.uv_px
    assert there is not None
    elsewhere = replace(pair.box_down, u0_px=pair.box_down.u0_px + pair.box_down.width_px)
    assert METHODS[DETECT](replace(pair, box_down=elsewhere)).down.uv_px is None


# -- training --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("module", [crop_training, frame_training])
def test_training_takes_the_number_of_passes(module: Any, tmp_path: Path, monkeypatch: Any, capsys: Any) -> None:
    asked: list[int] = []
    monkeypatch.setattr(module, "train", lambda folder, out, settings: asked.append(settings.passes))
    call = [str(tmp_path), "--out", str(tmp_path / "out.onnx")]
    assert module.main([*call, "--passes", "6"]) == 0
    assert module.main(call) == 0
    assert asked == [6, {crop_training: TrainingSettings.passes, frame_training: FrameSettings.passes}[module]]
    for wrong in ("0", "-1", "two"):
        with pytest.raises(SystemExit):
            module.main([*call, f"--passes={wrong}"])
        assert "from 1 up" in capsys.readouterr().err


@needs_torch
def test_training_refuses_data_sets_that_will_not_do(tmp_path: Path, tiny_dataset: Path, capsys: Any) -> None:
    out = tmp_path / "out.onnx"
    for main in (crop_training.main, frame_training.main):
        for folder, text in ((tmp_path, str(tmp_path)), (tiny_dataset, "training holds 20 out and needs more")):
            assert main([str(folder), "--out", str(out)]) == 2
            said = capsys.readouterr().err
            assert said.startswith("error: ")
            assert text in said
            assert said.count("\n") == 1
    assert not out.exists()


@needs_torch
def test_training_gives_the_same_weights_and_the_file_their_answers(tiny_dataset: Path, tmp_path: Path) -> None:
    from phibench.datasets.read import open_dataset
    from phibench.estimator.learned.networks import write_network
    from tools.crop_training import answers_of, crops_of, items_of, train_crop

    settings = TrainingSettings(presets=("srgb8",), crops=64, passes=2, batch=32)
    samples = [row.sample_id for row in open_dataset(tiny_dataset).rows if row.sample_id.startswith("seen")]
    views = items_of(crops_of(tiny_dataset, settings, samples, settings.crops, 0), settings)
    first, second = (train_crop(views, settings) for _ in range(2))
    assert all(np.array_equal(first[name], second[name]) for name in first)
    assert any(not np.array_equal(value, crop_training.first_crop_weights(0)[name]) for name, value in first.items())
    items = items_of(crops_of(tiny_dataset, settings, samples, 8, 5), settings)
    found = Network(write_network(tmp_path / "n.onnx", CROP, first, {"covariance_scale": 1.0}), CROP)
    uv, factor = found.run(planes=items.planes[..., :SIDE_PX, :SIDE_PX].astype(np.float32), scalars=items.scalars)
    answers = answers_of(first, items)
    np.testing.assert_allclose(uv - items.uv_px, answers.error_px, rtol=0, atol=1e-4)  # float32, sums of 1000 terms
    np.testing.assert_allclose(covariances(factor.astype(float), 1.0), answers.covariance_px2, rtol=1e-3)
    means = crop_training.mean_answers(first, items)
    for k in range(len(items.planes)):
        one = found.position(CropInput(items.planes[k].astype(np.float32), items.scalars[k]))
        np.testing.assert_allclose(one.uv_px - items.uv_px[k], means.error_px[k], rtol=0, atol=1e-4)
        np.testing.assert_allclose(one.covariance_px2, means.covariance_px2[k], rtol=1e-3)


@needs_torch
def test_a_network_that_claims_no_pixel_has_no_scale(tiny_dataset: Path, tmp_path: Path, monkeypatch: Any) -> None:
    from phibench.datasets.read import open_dataset

    samples = [row.sample_id for row in open_dataset(tiny_dataset).rows if row.sample_id.startswith("seen")]
    monkeypatch.setattr(crop_training, "_FIRST_LN", -9.0)
    monkeypatch.setattr(crop_training, "rooms_of", lambda folder, seed: (samples, samples))
    settings = TrainingSettings(presets=("srgb8",), crops=8, passes=1, batch=8, rate=0.0)
    for chosen, text in ((settings, "train on more --crops"), (replace(settings, batch=17), "8 crops are too few")):
        with pytest.raises(NetworkError, match=text):
            crop_training.train(tiny_dataset, tmp_path / "out.onnx", chosen)


@needs_torch
def test_training_of_frames_gives_the_same_weights_and_learns(tiny_dataset: Path, tmp_path: Path) -> None:
    """Tiles alone: the heat of a spot's cells rises above that of all others."""
    import torch

    from phibench.datasets.read import open_dataset
    from phibench.estimator.learned.networks import write_network

    settings = FrameSettings(rounds=1, passes=8, batch=8)
    samples = [row.sample_id for row in open_dataset(tiny_dataset).rows if row.sample_id.startswith("seen")]
    tiles = frame_training.spot_tiles(frame_training.spot_crops(tiny_dataset, samples, 32, 5))
    assert set(np.unique(tiles.heat)) == {0.0, 1.0}
    maps = [
        frame_training.FrameMap("srgb8", planes.astype(np.float16), planes[0].astype(float), heat, counted)
        for planes, heat, counted in zip(tiles.planes[:3], tiles.heat, tiles.counted, strict=False)
    ]
    first, second = (frame_training.train_detector(tiles, maps, settings) for _ in range(2))
    assert all(np.array_equal(first[name], second[name]) for name in first)
    found = Network(write_network(tmp_path / "n.onnx", DETECT, first, {"covariance_scale": 1.0}), DETECT)
    heat = found.run(planes=tiles.planes)[0][:, 0]
    weights = {name: torch.from_numpy(value) for name, value in first.items()}
    forward = frame_training.detector_forward(torch, weights, torch.from_numpy(tiles.planes))
    np.testing.assert_allclose(heat, forward.numpy(), rtol=0, atol=1e-4)  # float32, sums of 150 terms
    hot, cold = tiles.heat > 0.0, (tiles.heat == 0.0) & (tiles.counted > 0.0)
    assert np.median(heat[hot]) > np.quantile(heat[cold], 0.99)
