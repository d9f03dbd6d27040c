"""Reading: layers as arrays, the rig as it was, clear errors; no Mitsuba."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers.damage import sign
from helpers.processes import quiet

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.plan.plan import make_plan
from phibench.datasets.read import Dataset, open_dataset, open_finished
from phibench.datasets.recipe.load import load_recipe
from phibench.datasets.rooms.room_sources import room_of
from phibench.datasets.store import schema
from phibench.datasets.store.json_forms import to_json
from phibench.datasets.store.layers import SpotWindow
from phibench.datasets.store.parquet_tables import parquet_bytes
from phibench.datasets.verify import plan_faults, verify
from phibench.render.optics.spot_layer import spot_layer
from phibench.render.optics.truth import TRUTH_PLANES, truth_layer

TINY = Path(__file__).resolve().parents[1] / "tiny.toml"


@pytest.fixture
def dataset(tiny_dataset: Path) -> Dataset:
    return open_dataset(tiny_dataset)


def test_rig_room_and_recipe_come_back(dataset: Dataset) -> None:
    plan = make_plan(load_recipe(TINY))
    assert (dataset.rig, dataset.room, dataset.recipe) == (plan.rig, room_of(plan.rooms["room"]), plan.recipe)
    assert [sample.rig for sample in dataset] == [plan.rig, plan.rig]
    assert [sample.laser_spot for sample in dataset] == [plan.spots[pair.target] for pair in plan.pairs]
    assert len(dataset) == 2


def test_layers_are_what_the_renderer_gave(dataset: Dataset) -> None:
    sample = dataset["seen-near-h0.500"]
    for position in ("down", "up"):
        view = sample.view(position)
        shapes = dataset.room.shapes(view)
        layer, window = spot_layer(view, sample.laser_spot, shapes), sample.spot(position)
        assert (window.u0_px, window.v0_px) == (layer.u0_px, layer.v0_px)
        scale = layer.electrons_per_s.max()
        assert np.abs(window.electrons_per_s - layer.electrons_per_s).max() < 1e-7 * scale  # float32
        assert np.abs(window.du_electrons_per_s_px - layer.du_electrons_per_s_px).max() < 1e-7 * scale
        expected, truth = truth_layer(view, shapes), sample.truth(position)
        assert tuple(truth) == TRUTH_PLANES
        for name in TRUTH_PLANES:
            np.testing.assert_allclose(truth[name], expected[name], rtol=6e-8, atol=0.0, equal_nan=True)
        assert truth["object_id"].dtype == np.int32
        assert np.array_equal(np.isnan(truth["depth_m"]), truth["object_id"] < 0)


def test_the_pixel_truth_at_the_spot_is_the_spots_truth(dataset: Dataset) -> None:
    """Linear interpolation between the pixels around the spot, on the flat board that carries it."""
    sample = dataset["seen-near-h0.500"]
    for position in ("down", "up"):
        row, truth = sample.truth_row(position), sample.truth(position)
        u0, v0 = int(np.floor(row.u_px)), int(np.floor(row.v_px))
        a, b = row.u_px - u0, row.v_px - v0
        weights = np.outer([1.0 - b, b], [1.0 - a, a])
        ids = truth["object_id"][v0 : v0 + 2, u0 : u0 + 2]
        assert {dataset.rooms.info("room").object_names[i] for i in ids.ravel()} == {"board_near"}
        point = [float((weights * truth[name][v0 : v0 + 2, u0 : u0 + 2]).sum()) for name in ("x_m", "y_m", "z_m")]
        assert np.linalg.norm(np.array(point) - sample.row.spot_world_m) < 3e-3  # one pixel spans 6 cm here
        phi = float((weights * truth["phi_ray_rad"][v0 : v0 + 2, u0 : u0 + 2]).sum())
        assert abs(phi - row.phi_ray_rad) < 2e-4


def test_a_frame_is_ambient_plus_spot(dataset: Dataset) -> None:
    sample = dataset["seen-near-h0.500"]
    off, on = sample.expected_image("up", laser=False), sample.expected_image("up")
    assert on.shape == (3, 180, 320)
    assert on.dtype == np.float64
    assert np.array_equal(off, sample.ambient("up").astype(float))
    row, red = sample.row.up, (on - off)[0]
    v, u = np.indices(red.shape)
    assert red.sum() == pytest.approx(row.electrons_per_s[0], rel=1e-6)
    assert (red * u).sum() / red.sum() == pytest.approx(row.u_px + row.coma_shift_px[0], abs=2e-3)
    assert (red * v).sum() / red.sum() == pytest.approx(row.v_px + row.coma_shift_px[1], abs=2e-3)


def test_the_ambient_layer_states_its_noise(dataset: Dataset) -> None:
    sample = dataset["seen-near-h0.500"]
    ambient, variance = sample.ambient("up"), sample.ambient_variance("up")
    assert variance.shape == ambient.shape == (3, 180, 320)
    assert variance.dtype == np.float32
    assert np.all(variance >= 0.0)
    # of the whole image's light: a pixel's noise is 0.01 % to 100 % of it, and that of 320 x 180 pixels averages out;
    # outlines of lamps, which made most of it, are computed
    noise = np.sqrt(variance.sum(dtype=float)) / ambient.sum(dtype=float)
    assert 1e-4 < noise * np.sqrt(320 * 180) < 1.0


def test_a_hidden_spot_has_an_empty_window(dataset: Dataset) -> None:
    sample = dataset["half-hidden-h1.400"]
    assert sample.spot("down").electrons_per_s.shape == (3, 0, 0)
    assert np.array_equal(sample.expected_image("down"), sample.expected_image("down", laser=False))
    assert sample.spot("up").electrons_per_s.sum() > 0.0


@pytest.mark.parametrize("u0", [-9, -2, 0, 3, 6, 8, 30])
def test_windows_are_clipped_at_the_image(u0: int) -> None:
    ones = np.ones((3, 4, 5))
    image, expected = np.zeros((3, 6, 8)), np.zeros((3, 60, 80))
    SpotWindow(u0, u0 // 2, ones, ones, ones).add_to(image, gain=2.0)
    expected[:, 20 + u0 // 2 : 24 + u0 // 2, 20 + u0 : 25 + u0] = 2.0
    assert np.array_equal(image, expected[:, 20:26, 20:28])


def test_errors_are_clear(dataset: Dataset, tiny_dataset: Path, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="there is no folder"):
        open_dataset(tmp_path / "none")
    with pytest.raises(DatasetError, match="is not a data set"):
        open_dataset(tmp_path)
    with pytest.raises(DatasetError, match=r"did you mean 'seen-near-h0\.500'"):
        dataset["seen-near-h0.5"]
    with pytest.raises(DatasetError, match="'down' or 'up'"):
        dataset.samples[0].expected_image("left")
    copy = Path(shutil.copytree(tiny_dataset, tmp_path / "copy"))
    (copy / schema.view_file("h0.500", "ambient")).unlink()
    with pytest.raises(DatasetError, match=r"ambient\.exr is missing"):
        open_dataset(copy).samples[0].expected_image("up")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"schema_version": 99}, "schema version 99"),
        ({"samples": 3}, "2 rows instead of 3"),
        ({"rigs": 2}, "1 rigs instead of 2"),
        ({"rooms": 2}, "1 rooms instead of 2"),
    ],
)
def test_a_foreign_info_is_refused(tiny_dataset: Path, tmp_path: Path, change: dict[str, object], words: str) -> None:
    for name in (schema.INFO, schema.MANIFEST, schema.RIGS, schema.ROOMS):
        shutil.copy(tiny_dataset / name, tmp_path / name)
    info = json.loads((tmp_path / schema.INFO).read_text())
    (tmp_path / schema.INFO).write_text(json.dumps({**info, **change}))
    with pytest.raises(DatasetError, match=words):
        open_dataset(tmp_path)


def test_damaged_json_is_refused(tmp_path: Path) -> None:
    (tmp_path / schema.INFO).write_text('{"schema_version": 1,')
    with pytest.raises(DatasetError, match="is damaged"):
        open_dataset(tmp_path)


@pytest.fixture
def copy(tiny_dataset: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(tiny_dataset, tmp_path / "swapped"))


def view(name: str, pose: str = "h0.500") -> str:
    return schema.view_file(pose, name)


SPOTS = ("spots/seen-near-h0.500-down.exr", "spots/seen-near-h0.500-up.exr")


@pytest.mark.parametrize(
    "pair",
    [SPOTS, (view("ambient", "h0.000"), view("ambient")), (view("truth", "h0.000"), view("truth"))],
    ids=["spots", "ambient", "truth"],
)
def test_swapped_layers_are_refused(copy: Path, pair: tuple[str, str]) -> None:
    before = open_dataset(copy)["seen-near-h0.500"]
    assert before.expected_image("down").any()
    assert before.truth("up")
    a, b = (copy / name for name in pair)
    a.rename(copy / "aside")
    b.rename(a)
    (copy / "aside").rename(b)
    sample = open_dataset(copy)["seen-near-h0.500"]
    for position in ("down", "up"):
        with pytest.raises(DatasetError, match=r"is the \w+ layer of .*, not of"):
            (sample.truth if "truth" in pair[0] else sample.expected_image)(position)


def test_a_layer_of_another_data_set_is_refused(copy: Path, smallest_dataset: Path) -> None:
    shutil.copy(smallest_dataset / view("ambient", "h0.000"), copy / view("ambient", "h0.000"))
    with pytest.raises(DatasetError, match="dataset smallest, not of dataset tiny"):
        open_dataset(copy).samples[0].ambient("down")


def test_an_unfinished_or_changed_data_set_is_not_opened_as_finished(copy: Path) -> None:
    assert len(open_finished(copy)) == 2
    (copy / schema.RECIPE).write_text("")  # not read, so not hashed here
    assert len(open_finished(copy)) == 2
    manifest = (copy / schema.MANIFEST).read_text()
    (copy / schema.MANIFEST).write_text(manifest + " ")
    with pytest.raises(DatasetError, match=r"manifest\.jsonl is damaged"):
        open_finished(copy)
    (copy / schema.CHECKSUMS).unlink()
    with pytest.raises(DatasetError, match="not finished"):
        open_finished(copy)


def test_a_sample_prints_short(dataset: Dataset) -> None:
    assert "dataset" not in repr(dataset.samples[0]).split("(", 1)[1].split("row=")[0]
    assert len(repr(dataset.samples[0])) < 5000


def test_a_data_set_prints_in_ten_lines(dataset: Dataset) -> None:
    lines = repr(dataset).splitlines()
    assert len(lines) == 10
    assert max(map(len, lines[1:])) <= 80
    assert lines[0] == f"Dataset 'tiny' in {dataset.folder}"
    assert "2 stroke pairs" in lines[1]
    assert "3 of 4 visible" in repr(dataset)
    assert len(repr(dataset[:0]).splitlines()) == 10
    assert repr(dataset[0]).startswith(f"Sample('{dataset.rows[0].sample_id}': D = ")


def test_samples_are_taken_by_place_and_parts_as_slices(dataset: Dataset) -> None:
    first, last = dataset.samples
    assert dataset[0] is first
    assert dataset[-1] is last
    assert dataset[np.int64(1)] is last  # type: ignore[call-overload]
    assert dataset[first.row.sample_id] is first
    part = dataset[1:]
    assert [sample.row for sample in part] == [last.row]
    assert part.folder == dataset.folder
    assert len(dataset) == 2
    assert len(dataset[5:]) == 0
    with pytest.raises(IndexError, match=r"sample 2: .* has 2, numbered from 0"):
        dataset[2]


def test_the_table_of_a_data_set_is_its_parquet_file(dataset: Dataset) -> None:
    polars = pytest.importorskip("polars")
    assert dataset.to_polars().equals(polars.read_parquet(dataset.folder / schema.TABLE))
    assert dataset[1:].to_polars()["sample_id"].to_list() == [dataset[1].row.sample_id]


def as_of_version_5(folder: Path) -> None:
    """Write a folder's documents as version 5 did: its only room in `dataset.json`, and no id of a room anywhere."""
    dataset, (table, manifest) = open_dataset(folder), (folder / schema.TABLE, folder / schema.MANIFEST)
    info = json.loads((folder / schema.INFO).read_text())
    for document in (info, *info["poses"]):
        document.pop("rooms" if document is info else "room")
    names = dataset.rooms.info("room").object_names
    old = {"schema_version": 5, "room": to_json(dataset.room), "object_names": names}
    (folder / schema.INFO).write_text(json.dumps({**info, **old}))
    rows = [json.loads(line) for line in manifest.read_text().splitlines()]
    assert [(row.pop("room"), row.pop("spot_beam_world")) for row in rows] == [("room", None)] * len(rows)
    manifest.write_text("".join(json.dumps(row) + "\n" for row in rows))
    table.write_bytes(parquet_bytes(dataset.to_polars().drop("room", "spot_beam_world")))
    with np.load(folder / "lightmap.npz") as light:  # its faces had other texels
        np.savez(folder / "lightmap.npz", **{name: light[name][:-7] for name in light})
    (folder / schema.ROOMS).unlink()
    sign(folder)


def test_a_data_set_of_version_5_is_read_and_verified(copy: Path, tiny_dataset: Path) -> None:
    as_of_version_5(copy)
    old, new = open_finished(copy), open_dataset(tiny_dataset)
    assert (old.info.schema_version, old.rows) == (5, new.rows)
    assert old.room == new.room == old[0].room == old.rooms[old.rows[1].room]
    assert old.rooms.info("room").object_names == new.rooms.info("room").object_names
    assert np.array_equal(old[0].expected_image("up"), new[0].expected_image("up"))
    assert repr(old).splitlines()[1:-1] == repr(new).splitlines()[1:-1]
    assert verify(copy, truth_layers=False, console=quiet()).faults == ()
    info = json.loads((copy / schema.INFO).read_text())
    info["room"]["surfaces"][0].pop("name")
    (copy / schema.INFO).write_text(json.dumps(info))
    with pytest.raises(DatasetError, match=r"dataset\.json: not a valid Room: .*surfaces.*; run `phibench dataset rep"):
        open_dataset(copy)


def test_a_data_set_of_version_4_is_read_as_perfect_spheres(tiny_dataset: Path, tmp_path: Path) -> None:
    """Version 4 has no `mirror.form`: what was true then is true now, and verification agrees."""
    copy = Path(shutil.copytree(tiny_dataset, tmp_path / "copy"))
    as_of_version_5(copy)
    info = json.loads((copy / schema.INFO).read_text())
    (copy / schema.INFO).write_text(json.dumps({**info, "schema_version": 4}))
    lines = [json.loads(line) for line in (copy / schema.RIGS).read_text().splitlines()]
    assert [line["resolved"]["mirror"].pop("form") for line in lines] == [None] * len(lines)
    (copy / schema.RIGS).write_text("".join(json.dumps(line) + "\n" for line in lines))
    old, new = open_dataset(copy), open_dataset(tiny_dataset)
    assert old.rigs["rig"] == new.rigs["rig"]
    assert old.rigs["rig"].mirror.form is None
    assert list(plan_faults(old)) == []


def test_counterparts_of_pixels_are_those_of_the_rig_and_the_room(dataset: Dataset) -> None:
    sample = dataset["seen-near-h0.500"]
    for position in ("down", "up"):
        found, truth = sample.correspondence(position), sample.truth(position)
        assert found.object_names == sample.object_names
        # a layer holds float32; where a face ends, it may hold the next one
        same = np.abs(found.depth_m - truth["depth_m"])[truth["object_id"] >= 0] < 1e-5
        assert same.mean() > 0.999
        assert np.array_equal(np.isfinite(found.depth_m), truth["object_id"] >= 0)
        assert found.seen.sum() > 1000
    with pytest.raises(DatasetError, match="must be 'down' or 'up'"):
        sample.correspondence("left")
