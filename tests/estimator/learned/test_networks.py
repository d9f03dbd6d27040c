"""Networks: their input, their files and what is wrong with one, and training where PyTorch is installed."""

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from phibench.datasets.errors import DatasetError
from phibench.datasets.frames.sensor_card import sensor_card
from phibench.estimator.learned import crop_training, networks
from phibench.estimator.learned.crop_training import Answers, TrainingSettings, scale_of
from phibench.estimator.learned.network_input import SCALARS, SIDE_PX, crop_input, crop_origin, cut, filter_planes
from phibench.estimator.learned.networks import CROP, Network, NetworkError, covariances, sealed, shipped
from phibench.estimator.methods.registry import METHODS
from phibench.estimator.sandbox.easy_pairs import EasyPairs
from phibench.scenes.random_streams import generator

FOLDER = Path(networks.__file__).parent
NAMES = [CROP]
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
        part = cut(colours, origin)
        assert part.shape == (SIDE_PX, SIDE_PX)
        np.testing.assert_array_equal(part, (np.indices(part.shape) % 2).sum(axis=0))
    np.testing.assert_array_equal(cut(u, (8, 2)), u[2:34, 8:40])


def spot_e(uv: tuple[float, float], electrons: float) -> np.ndarray:
    """Smooth spot, the same in all filters, shape (32, 32)."""
    v, u = np.indices((SIDE_PX, SIDE_PX))
    return np.asarray(electrons * np.exp(-0.5 * ((u - uv[0]) ** 2 + (v - uv[1]) ** 2) / 3.0**2))


def test_gain_and_room_are_not_in_the_planes() -> None:
    """A wide spot without noise at two gains: DN are whole, 0.5 DN of a spot of 250 or 500 DN, twice, and of the room.

    Interpolation of a Gaussian of 3 px is the same at both gains.
    """
    made = []
    for gain, room_e in ((1.0, 200.0), (2.0, 900.0)):
        card = replace(sensor_card("bayer-raw"), dn_per_e=gain * 0.1, full_well_e=1e5, top_dn=60000)
        off = np.rint(card.black_level_dn + card.dn_per_e * np.full((SIDE_PX, SIDE_PX), room_e)).astype(np.uint16)
        on = np.rint(card.black_level_dn + card.dn_per_e * (room_e + spot_e((14.7, 16.2), 2500.0))).astype(np.uint16)
        made.append(crop_input(on, off, card))
    assert made[0].scalars.shape == (SCALARS,)
    assert np.abs(made[0].planes - made[1].planes).max() < 3.0 * 0.5 / 250.0
    assert np.abs(made[0].planes[0].max() - 1.0) < 0.1
    assert made[0].scalars[3] < made[1].scalars[3]  # the room's level is a number by itself


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


# -- files -----------------------------------------------------------------------------------------------------------


@needs_runtime
@pytest.mark.parametrize("name", NAMES)
def test_shipped_networks_are_small_and_give_the_same_bytes(name: str) -> None:
    file = FOLDER / f"{name}.onnx"
    assert file.stat().st_size <= 1_000_000
    assert shipped(name).metadata["version"] == networks.VERSION
    inputs = {"planes": generator("planes").normal(size=(3, 4, 32, 32)).astype(np.float32)}
    inputs["scalars"] = np.zeros((3, SCALARS), np.float32)
    if name != CROP:
        inputs = {"planes": inputs["planes"][:, :3]}
    first, second = (Network(file, name).run(**inputs) for _ in range(2))
    assert all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))


@needs_runtime
def test_files_that_will_not_do_are_refused_in_one_sentence(tmp_path: Path, monkeypatch: Any) -> None:
    model = (FOLDER / f"{CROP}.onnx").read_bytes()
    bare = model[:-76]  # without the entry of its hash
    assert sealed(bare) == model
    other = bare.replace(b"version\x12\x011", b"version\x12\x012")
    assert other != bare
    cases = [
        (sealed(other), "is of version 2, this phibench needs version 1"),
        (b"", "does not end as"),
        (model[:-1], "does not end as"),
        (sealed(b"no network"), "is no network that onnxruntime can run"),
        (sealed(bare.replace(b"name\x12\x0clearned_crop", b"name\x12\x0clearned_crow")), "not 'learned_crop'"),
    ]
    for place in generator("flipped bits").integers(0, len(model), 20):
        flipped = bytearray(model)
        flipped[place] ^= 1 << int(place) % 8
        cases.append((bytes(flipped), "does not end as|is damaged"))
    for number, (data, text) in enumerate(cases):
        path = tmp_path / f"{number}.onnx"
        path.write_bytes(data)
        with pytest.raises(NetworkError, match=text) as caught:
            Network(path, CROP)
        assert "\n" not in str(caught.value)
        assert "install phibench anew" in str(caught.value)
    with pytest.raises(DatasetError, match="install phibench anew"):
        Network(tmp_path / "nothing.onnx", CROP)
    monkeypatch.setattr(networks, "SHIPPED", {CROP: "0" * 64})
    with pytest.raises(NetworkError, match="belongs to another release"):
        shipped(CROP)


def test_without_onnxruntime_and_pytorch_it_says_what_to_install(monkeypatch: Any, tmp_path: Path) -> None:
    for name in ("onnxruntime", "torch"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(NetworkError, match=r"onnxruntime: pip install 'phibench\[learned\]'$"):
        Network(FOLDER / f"{CROP}.onnx", CROP)
    with pytest.raises(NetworkError, match=r"training needs PyTorch: pip install 'phibench\[learned-training\]'"):
        crop_training.torch_on_one_thread()
    absent = replace(METHODS[CROP] if RUNTIME else next(iter(METHODS.values())), package="no_such_package_here")
    assert absent(EasyPairs("bayer-raw").pair(0)).down.status == "install no_such_package_here"


# -- training --------------------------------------------------------------------------------------------------------


@needs_torch
def test_training_refuses_data_sets_that_will_not_do(tmp_path: Path, tiny_dataset: Path, capsys: Any) -> None:
    out = tmp_path / "out.onnx"
    for folder, text in ((tmp_path, str(tmp_path)), (tiny_dataset, "training holds 6 out and needs more than that")):
        assert crop_training.main([str(folder), "--out", str(out)]) == 2
        said = capsys.readouterr().err
        assert said.startswith("error: ")
        assert text in said
        assert said.count("\n") == 1
    assert not out.exists()


@needs_torch
def test_training_gives_the_same_weights_and_the_file_their_answers(tiny_dataset: Path, tmp_path: Path) -> None:
    from phibench.datasets.read import open_dataset
    from phibench.estimator.learned.crop_training import answers_of, crops_of, items_of, train_crop
    from phibench.estimator.learned.networks import write_network

    settings = TrainingSettings(presets=("srgb8",), epochs=2, crops=64, passes=1)
    samples = [row.sample_id for row in open_dataset(tiny_dataset).rows if row.sample_id.startswith("seen")]
    first, second = (train_crop(tiny_dataset, settings, samples) for _ in range(2))
    assert all(np.array_equal(first[name], second[name]) for name in first)
    assert any(not np.array_equal(value, crop_training.first_crop_weights(0)[name]) for name, value in first.items())
    items = items_of(crops_of(tiny_dataset, settings, samples, 8, 5), settings, SIDE_PX)
    found = Network(write_network(tmp_path / "n.onnx", CROP, first, {"covariance_scale": 1.0}), CROP)
    uv, factor = found.run(planes=items.planes, scalars=items.scalars)
    answers = answers_of(first, items)
    np.testing.assert_allclose(uv - items.uv_px, answers.error_px, rtol=0, atol=1e-4)  # float32, sums of 1000 terms
    np.testing.assert_allclose(covariances(factor.astype(float), 1.0), answers.covariance_px2, rtol=1e-3)
