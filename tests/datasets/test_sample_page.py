"""The page of a sample: its numbers decode to the truth, its lines are images of rays, and a browser shows them."""

from __future__ import annotations

import base64
import io
import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.pages import NEEDS_BROWSER, browsed, page_json, unpacked
from PIL import Image

from phibench.cli.main import main
from phibench.datasets.build.sample_task import _at_light
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.read import Sample, open_dataset
from phibench.datasets.sample_page import STEPS, epipolar_line, page_data, sample_of, sample_page, write_sample_page
from phibench.datasets.show import _cells
from phibench.datasets.store.layers import SpotWindow
from phibench.datasets.store.schema import NoiseRow
from phibench.render.optics.ray_tracer import trace_pixels
from phibench.render.optics.room_tracer import room_geometry
from phibench.render.optics.truth import spot_truth
from phibench.scenes.rig import POSITIONS

# float32 on disk: 7 digits of 10 m are 1e-6 m, far below a step
ROUNDING = 1.001


@pytest.fixture
def sample(tiny_dataset: Path) -> Sample:
    return open_dataset(tiny_dataset)[0]


def test_planes_of_the_page_are_the_truth_to_half_a_step(sample: Sample) -> None:
    views, read = page_data(sample)["views"], 0
    for position in POSITIONS:
        view, truth = views[position], sample.truth(position)
        size = view["width"], view["height"]
        ids = unpacked(view["planes"]["object_id"]["data"], *size)
        seen = truth["object_id"] >= 0
        assert 0.2 < seen.mean() < 0.8
        assert np.array_equal(np.where(ids == 65535, -1, ids), truth["object_id"])
        for name in STEPS:
            plane = view["planes"][name]
            shown = plane["offset"] + plane["step"] * unpacked(plane["data"], *size)
            assert np.abs(shown - truth[name])[seen].max() <= 0.5 * ROUNDING * plane["step"]
            assert np.abs(np.roll(shown, 1, axis=1) - truth[name])[seen].max() > 2.0 * plane["step"]  # half a pixel off
            read += 1
    assert read == 2 * len(STEPS)


def test_the_spot_layer_of_the_page_has_its_place_and_electrons(sample: Sample) -> None:
    spot, window = page_data(sample)["views"]["down"]["spot"], sample.spot("down")
    codes = unpacked(spot["data"], spot["width"], spot["height"])
    # a code is 1 / 65 534 of the peak
    red = window.electrons_per_s[0]
    assert np.abs(codes * spot["step"] - red).max() <= 0.5 * ROUNDING * red.max() / 65_534
    v, u = np.unravel_index(np.argmax(codes), codes.shape)
    mark = sample.row.down.centre
    # the brightest pixel holds the spot's centre or touches the pixel that does
    assert np.hypot(u + spot["u0"] - mark.u_px, v + spot["v0"] - mark.v_px) < 1.0


def test_the_page_and_the_table_show_the_light_that_scores_refer_to(sample: Sample) -> None:
    """Of a torn spot: its light is 0.5 px from the beam's axis, and so are cross, numbers and enlarged window."""
    row = sample.row
    assert row.down.light is not None
    light = row.down.light.model_copy(update={"u_px": row.down.u_px + 0.4, "v_px": row.down.v_px - 0.3})
    down = row.down.model_copy(update={"light": light})
    torn = replace(sample, row=row.model_copy(update={"down": down, "light_depth_m": 2.5}))
    data = page_data(torn)
    assert (data["depth_m"], data["views"]["down"]["mark"]) == (2.5, [light.u_px, light.v_px])
    assert data["views"]["down"]["axis"] == [row.down.u_px, row.down.v_px]
    shown = f"{light.u_px:.2f}, {light.v_px:.2f}"
    assert shown in _cells(torn.row, "")
    assert f"({shown}) px" in repr(torn)
    assert "D = 2.500 m" in repr(torn)


def test_the_table_tells_a_faint_spot_from_a_bright_one(sample: Sample) -> None:
    """A spot that sees the camera is visible, however faint: its least sigma of phi stands beside it, or no number."""
    row, faint, bright = sample.row, NoiseRow(phi_sensor_rad=0.02, phi_render_rad=0.0), sample.row.up.noise
    assert bright is not None
    dim = row.model_copy(update={"down": row.down.model_copy(update={"noise": faint})})
    assert f"1.1 / {np.degrees(bright.phi_sensor_rad):.2g}" in _cells(dim, "")
    hidden = row.model_copy(update={"down": row.down.model_copy(update={"noise": None})})
    assert f"- / {np.degrees(bright.phi_sensor_rad):.2g}" in _cells(hidden, "")


def test_crosses_of_previews_are_on_the_light(sample: Sample) -> None:
    """The layer's centroid is the manifest's centre, whatever the beam's axis; its derivative planes are not asked."""
    row = sample.row.up
    axis = spot_truth(sample.view("up"), sample.laser_spot, room_geometry(sample.room, sample.view("up")))
    shown = _at_light(replace(axis, u_px=axis.u_px + 0.6), sample.spot("up"))
    assert row.light is not None
    # what the window cuts of the blur moves the centroid by 2e-5 px at most
    assert (shown.u_px, shown.v_px) == pytest.approx((row.light.u_px, row.light.v_px), abs=2e-4)
    assert _at_light(axis, SpotWindow.empty()) == axis


@pytest.mark.parametrize("place", [0, 1])
def test_an_epipolar_line_is_the_image_of_the_other_ray_accuracy(misaligned_dataset: Path, place: int) -> None:
    """Rays traced back from the line meet the ray of the spot: film to mirror, where the line went mirror to film."""
    sample = open_dataset(misaligned_dataset)[0]
    position, other = POSITIONS[place], POSITIONS[1 - place]
    line = epipolar_line(sample, position)
    assert line is not None
    points = np.array([p for p in line["points"] if p is not None])
    spot = sample.truth_row(other).centre
    assert np.hypot(*(points - [spot.u_px, spot.v_px]).T).min() < 1e-3  # written to a thousandth of a pixel
    row = sample.truth_row(position)
    start = np.array(row.reflection_point_world_m)
    along = np.array(sample.row.spot_world_m) - start
    along /= np.linalg.norm(along)
    back = trace_pixels(sample.view(other), points)
    across = np.cross(back.directions, along)
    apart = np.abs(np.einsum("ni,ni->n", start - back.points_m, across / np.linalg.norm(across, axis=1)[:, None]))
    # 5e-4 px of rounding at 4 x 7.6 mrad a pixel, over the 20 m that are checked; lines that are off by 0.1 px fail
    near = np.linalg.norm(np.cross(back.points_m - start, along), axis=1) / np.linalg.norm(across, axis=1) < 20.0
    assert near.sum() > 50
    assert apart[near].max() < 2e-3
    shifted = trace_pixels(sample.view(other), points + [0.1, -0.1])
    across = np.cross(shifted.directions, along)
    apart = np.abs(np.einsum("ni,ni->n", start - shifted.points_m, across / np.linalg.norm(across, axis=1)[:, None]))
    assert apart[near].max() > 2e-3


def test_the_page_is_one_file_that_fetches_nothing(sample: Sample, tmp_path: Path) -> None:
    page = write_sample_page(sample, tmp_path / "page.html").read_text(encoding="utf-8")
    assert page == sample_page(sample)
    text = re.sub(r'<script type="application/json".*?</script>', "", page, flags=re.S)
    assert not re.findall(r"https?://|@import|\bsrc=|<link", text)
    assert len(page) < 4e6


def test_an_untouched_page_says_what_to_do(sample: Sample) -> None:
    box = re.search(r'<div id="readout"[^>]*>(.*?)</div>', sample_page(sample), flags=re.S)
    assert box is not None
    assert "Move over a frame" in box[1]


def test_a_dataset_is_shown_as_one_document(tiny_dataset: Path, capsys: pytest.CaptureFixture) -> None:
    before = sorted(tiny_dataset.rglob("*"))
    assert main(["dataset", "show", str(tiny_dataset), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    lines = (tiny_dataset / "manifest.jsonl").read_text().splitlines()
    assert document["rows"] == [json.loads(line) for line in lines]
    assert document["samples"] == len(lines) == 2
    assert sorted(tiny_dataset.rglob("*")) == before
    assert main(["dataset", "show", str(tiny_dataset), "--json", "--sample", "0"]) == 2
    assert "writes no file" in capsys.readouterr().err


def test_samples_are_taken_by_number_or_name(tiny_dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    dataset = open_dataset(tiny_dataset)
    assert sample_of(dataset, None) == sample_of(dataset, "0") == dataset[0]
    assert sample_of(dataset, dataset.rows[1].sample_id) == sample_of(dataset, "1") == dataset[1]
    with pytest.raises(DatasetError, match="numbered from 0 to 1"):
        sample_of(dataset, "2")
    assert main(["dataset", "show", str(tiny_dataset), "--sample", "1"]) == 2
    assert "--html" in capsys.readouterr().err
    assert main(["dataset", "show", str(tiny_dataset), "--sample", "1", "--html", str(tmp_path / "a.html")]) == 0
    assert "a.html" in capsys.readouterr().out
    # the hidden spot has no layer and no noise, but a mark and its cause
    data = page_json(tmp_path / "a.html")
    assert data["id"] == dataset.rows[1].sample_id
    assert [data["views"][p]["visible"] for p in POSITIONS] == [dataset.rows[1].position(p).visible for p in POSITIONS]
    assert main(["dataset", "show", str(tiny_dataset), "--html", str(tmp_path / "a.html" / "b.html")]) == 2
    assert "was not written" in capsys.readouterr().err


def places(sample: Sample) -> Iterator[tuple[str, int, int]]:
    for position in POSITIONS:
        spot = sample.truth_row(position)
        yield position, round(spot.u_px), round(spot.v_px)
    height, width = sample.truth("down")["depth_m"].shape
    yield from (("down", width // 2, height // 4), ("up", width - 1, height - 1))


@NEEDS_BROWSER
@pytest.mark.slow
@pytest.mark.parametrize("options", [("--window-size=1280,900",), ("--window-size=400,900",)])
@pytest.mark.parametrize("zoom", ["whole", "spot"])
def test_a_pointer_over_a_pixel_shows_its_truth_accuracy(
    sample: Sample, tmp_path: Path, options: tuple[str, ...], zoom: str
) -> None:
    page, shown = write_sample_page(sample, tmp_path / "page.html"), 0
    data = page_json(page)
    for position, u, v in places(sample):
        inside = zoom == "whole" or (u, v) != (sample.rig.camera.width_px // 2, sample.rig.camera.height_px // 4)
        if not inside or (zoom == "spot" and u == sample.rig.camera.width_px - 1):
            continue  # out of sight
        readout, console = browsed(page, f"hover={position},{u},{v}&zoom={zoom}", tmp_path, *options)
        assert console == ""
        assert (readout["position"], readout["u"], readout["v"]) == (position, str(u), str(v))
        view, truth = data["views"][position], sample.truth(position)
        frame = np.asarray(Image.open(io.BytesIO(base64.b64decode(view["on"]))).convert("RGB"))
        # two JPEG decoders differ by a few codes; the next pixel of a spot by tens
        assert np.abs(np.array(readout["rgb"].split(","), int) - frame[v, u]).max() <= 6
        object_id = int(truth["object_id"][v, u])
        assert readout["object"] == ("nothing" if object_id < 0 else sample.object_names[object_id])
        for name in STEPS if object_id >= 0 else ():
            value, step = float(readout[name]), view["planes"][name]["step"]
            assert abs(value - truth[name][v, u]) <= 0.5 * ROUNDING * step, name
            shown += 1
    assert shown >= 2 * len(STEPS)


@NEEDS_BROWSER
@pytest.mark.slow
@pytest.mark.parametrize("position", POSITIONS)
@pytest.mark.parametrize("beside", [-0.3, 0.3])
def test_pixels_are_drawn_around_their_centres_accuracy(
    sample: Sample, tmp_path: Path, position: str, beside: float
) -> None:
    """0.3 px beside the centre of the brightest pixel still lies on it; a picture half a pixel off shows another."""
    page = write_sample_page(sample, tmp_path / "page.html")
    frame = sample.camera_frames("mjpeg").by_name[position].image.astype(int)
    spot = sample.truth_row(position)
    u, v = round(spot.u_px), round(spot.v_px)
    around = [frame[v + j, u + i] for i, j in ((-1, -1), (1, 1))]
    assert min(np.abs(frame[v, u] - other).max() for other in around) > 12
    address = f"hover={position},{u + beside},{v + beside}&zoom=spot&marks=0&lines=0"
    readout, console = browsed(page, address, tmp_path)
    assert console == ""
    assert (readout["u"], readout["v"]) == (str(u), str(v))
    # two JPEG decoders differ by a few codes
    assert np.abs(np.array(readout["drawn"].split(","), int) - frame[v, u]).max() <= 6
