"""The bound of D from single frames, and what more light or more frames do to it."""

from __future__ import annotations

from pathlib import Path

import polars as pl
import pytest

from phibench.datasets.errors import DatasetError
from phibench.datasets.read import open_finished
from phibench.estimator.experiment_bounds import frames_needed, spot_bounds


@pytest.mark.parametrize("preset", ["bayer-raw", "mjpeg"])
def test_more_light_of_the_laser_gives_a_better_bound(tiny_dataset: Path, preset: str) -> None:
    """Between sqrt(k), where the spot's own photons are the noise, and k, where the room's are; PRNU lies below both.

    JPEG's quantiser is nonlinear, so that its bound is held only to be better.
    """
    dataset = open_finished(tiny_dataset)
    [sample] = [one for one in dataset if one.row.down.visible and one.row.up.visible]
    low, high = (spot_bounds(dataset, preset, [sample], level, 1 / 500)["bound_m"][0] for level in (1.0, 4.0))
    assert low > high > 0.0
    if preset == "bayer-raw":
        assert 1.3 < low / high < 4.1
    both = spot_bounds(dataset, preset, exposure=1 / 500)
    assert len(both) == len(dataset)
    hidden = both.filter(pl.col("sample_id") != sample.row.sample_id)
    assert hidden["bound_m"].is_nan().all()
    assert both["exposure_s"].to_list() == [1 / 500] * len(both)


def test_frames_needed() -> None:
    bounds = pl.DataFrame({"relative": [0.01, 0.03, float("nan")]})
    assert frames_needed(bounds, 0.03) == 1
    assert frames_needed(bounds, 0.01) == 5  # (1 + 9) / 2
    assert frames_needed(bounds, 0.0099) == 6
    with pytest.raises(DatasetError, match="0 bounds"):
        frames_needed(bounds.clear(), 0.01)
    with pytest.raises(DatasetError, match="must be above 0"):
        frames_needed(bounds, 0.0)
