"""Export of dense pairs: what is read back is the pair and its truth, and a second run keeps what is whole."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from phibench.benchmark.dense.dense_pairs import dense_pairs
from phibench.benchmark.export.dense_export import INDEX, PLANES, export_dense
from phibench.benchmark.scored_dataset import open_dataset
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.store.checksums import differing_files, read_checksums
from phibench.datasets.store.layers import read_exr


def test_an_export_holds_the_frames_and_the_truth(tiny_dataset: Path, tmp_path: Path) -> None:
    pairs = dense_pairs(open_dataset(tiny_dataset), "mjpeg")
    out = export_dense(pairs, tmp_path / "out")
    lines = [json.loads(text) for text in (out / INDEX).read_text().splitlines()]
    assert len(lines) == len(pairs) == 2
    pair, truth = pairs.pair(0), pairs.truth(0)
    name = lines[0]["name"]
    assert np.array_equal(np.asarray(Image.open(out / f"{name}-down.jpg")), pair.down)
    planes = read_exr(out / f"{name}-truth.exr").planes
    assert set(planes) == set(PLANES)
    # float32: relative rounding of 6e-8
    np.testing.assert_allclose(planes["depth_m"], truth.depth_m, rtol=6e-8, equal_nan=True)
    np.testing.assert_allclose(planes["up_u_px"], truth.found.uv_px[..., 0], rtol=6e-8, equal_nan=True)
    assert np.array_equal(planes["cause"], truth.found.cause)
    assert lines[0]["cause_names"]["0"] == "none"
    assert differing_files(out, read_checksums(out)) == []


def test_a_second_run_keeps_what_is_whole_and_mends_the_rest(tiny_dataset: Path, tmp_path: Path) -> None:
    pairs = dense_pairs(open_dataset(tiny_dataset), "srgb8")
    out = export_dense(pairs, tmp_path / "out")
    before = {path.name: (path.stat().st_mtime_ns, path.read_bytes()) for path in out.iterdir()}
    damaged = next(path for path in out.iterdir() if path.name.endswith("up.png"))
    damaged.write_bytes(b"nothing")
    (out / INDEX).write_text((out / INDEX).read_text() + '{"name": ')
    export_dense(pairs, out)
    after = {path.name: (path.stat().st_mtime_ns, path.read_bytes()) for path in out.iterdir()}
    assert {name: data for name, (_, data) in after.items()} == {name: data for name, (_, data) in before.items()}
    kept = [name for name in before if before[name][0] == after[name][0] and name.endswith((".png", ".exr"))]
    assert len(kept) == 3  # those of the other pair


def test_a_folder_of_something_else_is_left_alone(tiny_dataset: Path, tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    pairs = dense_pairs(open_dataset(tiny_dataset), "mjpeg")
    with pytest.raises(DatasetError, match="holds something else"):
        export_dense(pairs, tmp_path)
    with pytest.raises(DatasetError, match="inside the data set"):
        export_dense(pairs, tiny_dataset / "out")
