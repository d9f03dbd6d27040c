"""Data sets for training: truth of moved spots, phases, and the same items whatever loads them."""

import importlib.util
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy
from numpy.typing import NDArray

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.frames.frame_request import FrameOptions
from phibench.datasets.read import open_dataset
from phibench.datasets.store.layers import SpotWindow
from phibench.datasets.training import PERIOD_PX, CropSettings, PairDataset, SpotCrops, shifted_spot
from phibench.render.optics.spot_layer import SpotLayer, spot_layer
from phibench.scenes.frames import Array

SHIFT_PX = (0.37, -0.46)


def rendered(dataset: Path, shift_px: tuple[float, float]) -> SpotLayer:
    """Spot of the first sample by the renderer, with the principal point and so the whole image moved."""
    sample = open_dataset(dataset).samples[0]
    camera = sample.rig.camera
    moved = replace(camera, cx_px=camera.cx_px + shift_px[0], cy_px=camera.cy_px + shift_px[1])
    view = replace(sample.view("down"), rig=replace(sample.rig, camera=moved))
    return spot_layer(view, sample.laser_spot, sample.room.shapes(view))


def placed(planes: Array, u0_px: int, v0_px: int, size: tuple[int, int]) -> Array:
    whole = np.zeros((3, *size))
    whole[:, v0_px : v0_px + planes.shape[1], u0_px : u0_px + planes.shape[2]] = planes
    return whole


def window_of(layer: SpotLayer) -> SpotWindow:
    planes = layer.electrons_per_s, layer.du_electrons_per_s_px, layer.dv_electrons_per_s_px
    return SpotWindow(layer.u0_px, layer.v0_px, *planes)


def test_a_moved_spot_is_the_rendered_one(tiny_dataset: Path) -> None:
    """The renderer moves the principal point; the data set moves samples with the help of their derivatives.

    Frequencies beyond one cycle per pixel are left out, 6e-5 of a spot with a blur of 0.7 px: 1e-4 of the peak. Moved
    by samples alone it is a hundred times as wrong.
    """
    still, moved = rendered(tiny_dataset, (0.0, 0.0)), rendered(tiny_dataset, SHIFT_PX)
    camera = open_dataset(tiny_dataset).rig.camera
    size = camera.height_px, camera.width_px
    theirs = placed(moved.electrons_per_s, moved.u0_px, moved.v0_px, size)

    def error(planes: Array) -> float:
        """Largest error, of the peak."""
        return float(np.abs(placed(planes, still.u0_px, still.v0_px, size) - theirs).max() / theirs.max())

    ours = shifted_spot(window_of(still), *SHIFT_PX)
    assert error(ours) < 1e-4
    f_v, f_u = (np.fft.fftfreq(n) for n in ours.shape[1:])
    turn = np.exp(-2j * np.pi * (f_u * SHIFT_PX[0] + f_v[:, None] * SHIFT_PX[1]))
    assert error(np.fft.ifft2(np.fft.fft2(still.electrons_per_s) * turn).real) > 1e-2
    places = np.mgrid[: size[0], : size[1]]
    centres = [
        [(light.sum(axis=0) * place).sum() / light.sum() for place in places]
        for light in (placed(ours, still.u0_px, still.v0_px, size), theirs)
    ]
    assert np.allclose(*centres, atol=1e-4)


def crops(dataset: Path, length: int = 400, preset: str = "bayer-raw", **options: Any) -> SpotCrops:
    return SpotCrops([dataset], [FrameOptions(preset, options)], length, settings=CropSettings(side_px=24))


def test_truth_of_crops_is_where_the_light_is(tiny_dataset: Path) -> None:
    """Expected electrons of the spot alone: their centroid is the truth."""
    found = crops(tiny_dataset, 60, "ideal", lamp_level=0.0)
    v, u = np.mgrid[:24, :24]
    seen = 0
    for k in range(len(found)):
        item = found[k]
        light = item["image"].sum(axis=0)
        centroid = np.array([(light * u).sum(), (light * v).sum()]) / light.sum()
        if item["sample_id"].startswith("seen"):  # the other spot is wider than the crop
            seen += 1
            assert (
                np.abs(centroid - item["uv_px"]).max() < 2e-4
            )  # 2e-5 of the window's edge and of what is folded, found
    assert seen > 10


def test_phases_are_uniform(tiny_dataset: Path) -> None:
    """Every phase of pixel and of JPEG unit is as likely: chi^2 over 16 bins, false alarm 1e-6 each."""
    found = crops(tiny_dataset, 1600)
    draws = [found[k] for k in range(0, 1600, 4)]
    limit = scipy.stats.chi2.isf(1e-6, PERIOD_PX - 1)
    for axis in (0, 1):
        whole = np.bincount([item["phase_px"][axis] for item in draws], minlength=PERIOD_PX)
        part = np.histogram([item["uv_px"][axis] % 1.0 for item in draws], PERIOD_PX, (0.0, 1.0))[0]
        for counts in (whole, part):
            assert ((counts - counts.mean()) ** 2).sum() / counts.mean() < limit
    assert limit < ((np.bincount([0] * 300 + list(range(16)) * 6) - 24.75) ** 2).sum() / 24.75  # one phase alone


def same(a: dict[str, Any], b: dict[str, Any]) -> bool:
    return a.keys() == b.keys() and all(np.array_equal(a[name], b[name]) for name in a)


@pytest.mark.parametrize("kind", ["pairs", "crops"])
def test_items_depend_on_seed_epoch_and_index_alone(tiny_dataset: Path, kind: str) -> None:
    def made() -> PairDataset | SpotCrops:
        return (
            PairDataset(tiny_dataset, "srgb8", laser_off=True) if kind == "pairs" else crops(tiny_dataset, 6, "mjpeg")
        )

    first, second = made(), pickle.loads(pickle.dumps(made()))
    items = [first[k] for k in range(len(first))]
    assert all(same(second[k], items[k]) for k in reversed(range(len(items))))
    second.set_epoch(1)
    assert not any(same(second[k], items[k]) for k in range(len(items)))
    second.set_epoch(0)
    assert same(second[-1], items[-1])
    with pytest.raises(IndexError):
        first[len(first)]


def test_crops_with_the_laser_off_are_the_same_crops_without_the_spot(tiny_dataset: Path) -> None:
    """Expected electrons without noise: what is taken away is the spot, and the item is otherwise the same."""
    sample = open_dataset(tiny_dataset).samples[0].row.sample_id
    request, settings = FrameOptions("ideal", {}), CropSettings(side_px=24)
    both = SpotCrops([tiny_dataset], [request], 8, settings=settings, samples=[sample], laser_off=True)
    alone = SpotCrops([tiny_dataset], [request], 8, settings=settings, samples=[sample])
    checked = 0
    for k in range(8):
        crop, item = both.crop(k), alone[k]
        assert crop.sample_id == sample
        assert crop.card.exposure_s > 0.0
        assert crop.image_off is not None
        assert np.array_equal(crop.image, item["image"])
        assert np.array_equal(both[k]["image_off"], crop.image_off)
        assert "image_off" not in item
        added = crop.image - crop.image_off
        assert added.min() > -1e-9 * crop.image.max()
        v, u = np.unravel_index(np.argmax(added.sum(axis=0)), (24, 24))
        checked += bool(np.hypot(u - crop.uv_px[0], v - crop.uv_px[1]) < 1.0)
    assert checked == 8


def test_pairs_are_the_data_sets_own_frames(tiny_dataset: Path) -> None:
    pairs = PairDataset(tiny_dataset, "mjpeg")
    pairs.set_epoch(2)
    sample = open_dataset(tiny_dataset).samples[1]
    item, frames = pairs[1], sample.camera_frames("mjpeg", draw=2)
    assert np.array_equal(item["down"], frames.down)
    assert np.array_equal(item["up"], frames.up)
    assert sample.row.up.light is not None
    assert (item["up_u_px"], item["depth_m"]) == (sample.row.up.light.u_px, sample.row.light_depth_m)


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("torch") is None, reason="PyTorch is no dependency: 200 MB")
@pytest.mark.parametrize("workers", [1, 3])
def test_loaders_of_pytorch_give_the_same_bytes(tiny_dataset: Path, workers: int) -> None:
    from torch.utils.data import DataLoader

    found = crops(tiny_dataset, 24)
    loader = DataLoader(found, batch_size=5, num_workers=workers)  # type: ignore[var-annotated]
    images: list[NDArray[Any]] = [image for batch in loader for image in batch["image"].numpy()]
    assert np.array_equal(np.stack(images), np.stack([found[k]["image"] for k in range(24)]))


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        ({"side_px": 4}, "side_px = 4: must be an integer, 8 or above"),
        ({"spread_px": 20.0}, "spread_px = 20: must be from 0 to half a side, 16"),
        ({"laser_levels": (0.0, 1.0)}, "laser_levels"),
        ({"cameras": 0}, "cameras"),
    ],
)
def test_bad_settings_are_refused(settings: dict[str, Any], text: str) -> None:
    with pytest.raises(DatasetError, match=text.replace("(", r"\(")):
        CropSettings(**settings)


def test_bad_crops_are_refused(tiny_dataset: Path, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="options is empty"):
        SpotCrops([tiny_dataset], [], 10)
    with pytest.raises(DatasetError, match="a side of their own"):
        crops(tiny_dataset, region=64)
    with pytest.raises(DatasetError, match="there is nothing to crop"):
        SpotCrops([], [FrameOptions()], 10)


def test_dense_items_are_the_laser_off_frames_with_the_truth_of_pixels(tiny_dataset: Path) -> None:
    pairs = PairDataset(tiny_dataset, "mjpeg", task="dense")
    spots = PairDataset(tiny_dataset, "mjpeg", laser_off=True)
    item, spot = pairs[0], spots[0]
    assert np.array_equal(item["down"], spot["down_off"])
    assert np.array_equal(item["up"], spot["up_off"])
    found = open_dataset(tiny_dataset)[item["sample_id"]].correspondence()
    assert np.array_equal(np.isfinite(item["depth_m"]), found.of_room)
    # float32: 6e-8, relative
    np.testing.assert_allclose(item["up_px"], found.uv_px, rtol=6e-8, equal_nan=True)
    np.testing.assert_allclose(item["depth_m"][found.of_room], found.depth_m[found.of_room], rtol=6e-8)
    assert np.array_equal(item["cause"], found.cause)
    assert item["depth_m"].dtype == np.float32
    pairs.set_epoch(1)
    assert (pairs[0]["down"] != item["down"]).any()
    item["cause"][0, 0] += 1  # an item is its own
    assert np.array_equal(pairs[0]["cause"], found.cause)


@pytest.mark.parametrize("wrong", [{"laser_off": True}, {"region": 32}])
def test_dense_items_are_whole_frames(tiny_dataset: Path, wrong: dict[str, Any]) -> None:
    with pytest.raises(DatasetError, match="dense items are whole frames with the laser off"):
        PairDataset(tiny_dataset, "mjpeg", task="dense", **wrong)
    with pytest.raises(DatasetError, match="give 'spot' or 'dense'"):
        PairDataset(tiny_dataset, "mjpeg", task="deep")  # type: ignore[arg-type]
