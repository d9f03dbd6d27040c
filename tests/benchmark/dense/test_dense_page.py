"""The page of a dense answer: its numbers decode to truth and answer, and a browser shows them."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.pages import NEEDS_BROWSER, browsed, page_json, unpacked

from phibench.benchmark.dense.dense_page import LOGARITHMIC, PLANE_STEPS, DensePage
from phibench.benchmark.dense.dense_pairs import dense_pairs
from phibench.benchmark.dense.dense_pictures import DensePicture
from phibench.cli.main import main
from phibench.datasets.read import open_dataset

FAR = 1.05  # of the answers over the truth


@pytest.fixture(scope="module")
def page(tiny_dataset: Path) -> DensePage:
    pairs = dense_pairs(open_dataset(tiny_dataset), "mjpeg", 1)
    pair, truth = pairs.pair(0), pairs.truth(0)
    depth = np.where(truth.scored, FAR * truth.depth_m, np.nan)
    depth[: len(depth) // 3] = np.nan
    return DensePage(DensePicture(pair, truth, depth, "far", 0.02 * depth), pairs)


@pytest.fixture(scope="module")
def data(page: DensePage) -> dict[str, Any]:
    return page.data()


def decoded(plane: dict[str, Any], view: dict[str, Any]) -> np.ndarray:
    codes = unpacked(plane["data"], view["width"], view["height"])
    values = np.where(codes == 65535, np.nan, plane["offset"] + plane["step"] * codes)
    return np.exp(values) if plane.get("log") else values


def test_planes_are_truth_and_answer_to_half_a_step(page: DensePage, data: dict[str, Any]) -> None:
    view, values = data["views"]["down"], page.values()
    assert set(values) == set(PLANE_STEPS)
    for name, wanted in values.items():
        shown = decoded(view["planes"][name], view)
        assert np.array_equal(np.isfinite(shown), np.isfinite(wanted)) or name in LOGARITHMIC
        # codes are rounded in float64: half a step and the last digits
        half = 0.5001 * view["planes"][name]["step"]
        known = np.isfinite(shown) & np.isfinite(wanted)
        assert known.sum() > 500, name
        apart = np.log(shown[known] / wanted[known]) if name in LOGARITHMIC else shown[known] - wanted[known]
        assert np.abs(apart).max() <= half, name
    true, answer = (decoded(view["planes"][name], view) for name in ("depth_m", "answer_m"))
    ratio = (answer / true)[np.isfinite(answer)]
    assert np.median(ratio) == pytest.approx(FAR, rel=1e-3)


def test_a_right_answer_has_the_true_place(page: DensePage) -> None:
    """The estimator's projection of the answered point against the renderer's counterpart."""
    truth = page.picture.truth
    values = DensePage(replace(page.picture, depth_m=truth.depth_m), page.pairs).values()
    for axis in ("u", "v"):
        off = np.abs(values[f"answer_{axis}_px"] - values[f"up_{axis}_px"])[truth.scored]
        assert off.max() < 1e-6
    wrong = page.values()
    known = page.picture.known
    off = np.hypot(*(wrong[f"answer_{axis}_px"] - wrong[f"up_{axis}_px"] for axis in "uv"))[known]
    assert np.median(off) > 1e-3  # 5 per cent of D is seen


def test_causes_are_in_words(data: dict[str, Any], page: DensePage) -> None:
    view = data["views"]["down"]
    index = decoded(view["planes"]["cause"], view).astype(int)
    assert [text for text in data["causes"] if "_" in text.split(": ")[0]] == []
    seen = data["causes"].index("both images show this point")
    assert np.array_equal(index == seen, page.picture.truth.scored)
    groups = decoded(view["planes"]["group"], view)
    assert np.array_equal(groups == 0, page.picture.truth.scored)


@pytest.mark.slow
def test_the_page_is_one_file_that_fetches_nothing(page: DensePage, tmp_path: Path) -> None:
    text = page.write(tmp_path / "page.html").read_text(encoding="utf-8")
    assert text == page.html()
    bare = re.sub(r'<script type="application/json".*?</script>', "", text, flags=re.S)
    assert not re.findall(r"https?://|@import|\bsrc=|<link|@DATA|@STYLE|@SCRIPT", bare)
    assert len(text) < 1.5e6  # images of an eighth of the size; whole ones take 3 MB


def test_what_to_write_must_be_named(tiny_dataset: Path, capsys: pytest.CaptureFixture) -> None:
    assert main(["dense", "picture", str(tiny_dataset), "--method", "dense_sweep"]) == 2
    assert "--html FILE" in capsys.readouterr().err


@NEEDS_BROWSER
@pytest.mark.slow
@pytest.mark.parametrize("width", [1280, 400])
def test_a_pointer_shows_truth_and_answer_accuracy(page: DensePage, tmp_path: Path, width: int) -> None:
    """Over the down image and over a panorama; colours of the panorama are those of the values."""
    file = page.write(tmp_path / "page.html")
    data, window = page_json(file), f"--window-size={width},900"
    view, truth, picture = data["views"]["down"], page.picture.truth, page.picture
    v, u = (int(x[len(x) // 2]) for x in np.nonzero(picture.known))
    readout, console = browsed(file, f"hover=down,{u},{v}", tmp_path, window)
    assert console == ""
    assert (readout["u"], readout["v"], readout["cause"]) == (str(u), str(v), "both images show this point")
    wanted = page.values()
    for name in set(PLANE_STEPS) - set(LOGARITHMIC):
        # ends of the numbers differ, for JavaScript adds offset and step in another order
        assert float(readout[name]) == pytest.approx(wanted[name][v, u], abs=0.501 * view["planes"][name]["step"])
    assert float(readout["error"]) == pytest.approx(FAR - 1.0, abs=2e-3)
    column, row = (int(x) for x in readout["cell"].split(","))
    grid = data["grid"]
    near = np.array([unpacked(grid[k], grid["width"], grid["height"])[row, column] for k in "uv"])
    assert np.hypot(*(near - [u, v])) < 3.0
    over, console = browsed(file, f"hover=error,{column},{row}", tmp_path, window)
    assert console == ""
    assert [int(over["u"]), int(over["v"])] == near.tolist()
    if picture.known[near[1], near[0]]:
        place = (0.5 + 0.5 * picture.error[near[1], near[0]] / data["scales"]["error"]) * 32
        low = np.array(data["scales"]["of_error"][int(place)]), np.array(data["scales"]["of_error"][int(place) + 1])
        colour = low[0] + (place - int(place)) * (low[1] - low[0])
        assert np.abs(np.array(over["drawn"].split(","), int) - colour).max() <= 4  # 2e-3 of the error are 2 codes
    hidden = np.argwhere(truth.found.of_room & ~truth.scored)
    robot = np.argwhere(np.isfinite(truth.depth_m) & ~truth.found.of_room)
    for places, words in ((hidden, "hidden from the up image"), (robot, "the robot")):
        y, x = places[len(places) // 2]
        readout, console = browsed(file, f"hover=down,{x},{y}", tmp_path, window)
        assert console == ""
        assert readout["cause"].startswith(words)
        assert "error" not in readout or readout["error"] == ""
