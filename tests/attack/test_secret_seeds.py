"""Guessing of a sealed set's root seed, and of the fixed pattern of its cameras."""

from __future__ import annotations

import math
import stat
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from helpers.sealed_sets import SECRET_SEED

from phibench.benchmark.export.export_make import export
from phibench.benchmark.export.pair_rows import ExportRequest
from phibench.benchmark.sealed.sealed_set import secret_seed
from phibench.cli.main import main
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.exposures.draw_frames import draw_frames
from phibench.datasets.frames.frame_files import read_index
from phibench.datasets.frames.frame_request import FrameOptions, sample_request
from phibench.datasets.recipe.load import load_recipe, parse_recipe, with_numbers
from phibench.datasets.store.files import write_secret
from phibench.render.sensor.electrons import fixed_pattern
from phibench.render.sensor.light import Region
from phibench.render.sensor.settings import sensor

LEAST = 2**128
GUESSES_A_YEAR = 1e6 * 3.15e7 / 0.7e-6
"""Seeds that a million cores try in a year, at the 0.7 us that were measured."""


def test_a_seed_is_drawn_by_the_system_and_kept_for_its_owner(tmp_path: Path) -> None:
    """Each of the 128 bits is set in half of the draws: 64 draws give 32 +- 4, and none is 5.6 sigma away."""
    seeds = [secret_seed(tmp_path / f"{k}" / "seed") or 0 for k in range(64)]
    assert len(set(seeds)) == 64
    assert all(LEAST <= seed < 2 * LEAST for seed in seeds)
    counts = [sum(seed >> bit & 1 for seed in seeds) for bit in range(128)]
    assert all(abs(count - 32) < 5.6 * 4 for count in counts)
    assert math.log2(LEAST) > math.log2(GUESSES_A_YEAR) + 60
    path = tmp_path / "0" / "seed"
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert secret_seed(path) == seeds[0]
    assert secret_seed(tmp_path / "none", make_it=False) is None


@pytest.mark.parametrize(
    "text", ["7", str(2**62 + 12345), str(LEAST - 1), str(2 * LEAST), "9" * 5000, "", "-1", "1e40"]
)
def test_a_shorter_seed_is_none(text: str, tmp_path: Path) -> None:
    path = write_secret(tmp_path / "seed", text)
    with pytest.raises(DatasetError, match=r"from 2\^128 to 2\^129 - 1, drawn by the system"):
        secret_seed(path)


def test_a_seed_that_others_may_read_is_none(tmp_path: Path) -> None:
    path = write_secret(tmp_path / "seed", str(LEAST))
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert secret_seed(path) == LEAST
    path.chmod(0o640)
    with pytest.raises(DatasetError, match="chmod 600"):
        secret_seed(path)


def test_a_recipe_takes_a_secret_seed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from phibench.datasets.recipe.load import recipe_text

    assert load_recipe("bench-test").dataset.seed < LEAST
    assert parse_recipe(with_numbers(recipe_text("bench-test"), "t", 5, 2 * LEAST - 1)).dataset.seed == 2 * LEAST - 1
    words = ["dataset", "make", "smoke", "--out", str(tmp_path / "a"), "--seed", "1", "--secret-seed", "x"]
    assert main(words) == 2
    assert "give one of them" in capsys.readouterr().err


def camera_of(seed: int, sample: str = "s0") -> int:
    return sample_request(("paper", seed, sample), None, FrameOptions()).camera_seed


@pytest.mark.parametrize(("seed", "camera"), [(0, 356470609), (7, 407758302), (2**63 - 1, 875760463)])
def test_public_sets_keep_their_cameras(seed: int, camera: int) -> None:
    """As version 0.2 drew them."""
    assert camera_of(seed) == camera


def test_a_set_with_a_secret_seed_is_drawn_and_exported(secret_dataset: Path, tmp_path: Path) -> None:
    """A seed of 128 bits is no integer of a Parquet file."""
    drawn = draw_frames(secret_dataset, FrameOptions("srgb8"), 1, out=tmp_path / "drawn", workers=1).folder
    assert {row.dataset_seed for row in read_index(drawn).values()} == {SECRET_SEED}
    assert set(pl.read_parquet(drawn / "frames.parquet")["dataset_seed"]) == {str(SECRET_SEED)}
    request = ExportRequest("frames", FrameOptions("srgb8"), 1)
    assert export(secret_dataset, request, tmp_path / "export", workers=1).folder.is_dir()


def test_the_root_enters_the_fixed_pattern() -> None:
    """31 bits are tried in minutes, and the right camera stands out: 265 sigma over a frame, as it was measured.

    Secret roots name cameras by 128 bits: no two agree in the lowest or the highest 31, and patterns are unlike.
    """
    roots = [LEAST + 2**k for k in range(128)]
    cameras = [camera_of(root) for root in roots]
    for shift in (0, 97):  # 128 of 2^31: some two agree by chance of 4e-6
        assert len({camera >> shift & (2**31 - 1) for camera in cameras}) == 128
    region = Region(0, 0, 64, 64)
    patterns = [np.asarray(fixed_pattern(sensor("mono-raw"), camera, region).offset_e) for camera in cameras[:2]]
    found = np.corrcoef(patterns[0].ravel(), patterns[1].ravel())[0, 1]
    assert abs(found) < 6.0 / 64.0  # 1/sqrt(4096) a sigma
