"""The bound of D from single frames, and what more light or more frames do to it."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import polars as pl
import pytest

from phibench.datasets.frames.sensor_card import SensorCard, sensor_card
from phibench.datasets.read import open_finished
from phibench.estimator.limits.processed_bound import spot_sigma
from phibench.studies.paper.experiment_bounds import spot_bounds


@pytest.mark.slow
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


def test_a_calibrated_pattern_is_known_better(tiny_dataset: Path) -> None:
    dataset = open_finished(tiny_dataset)
    [sample] = [one for one in dataset if one.row.down.visible and one.row.up.visible]
    row = spot_bounds(dataset, "bayer-raw", [sample], exposure=1 / 500).row(0, named=True)
    assert 0.0 < row["bound_pattern_known_m"] < row["bound_m"]
    assert row["relative_pattern_known"] == pytest.approx(row["bound_pattern_known_m"] / row["depth_m"])


def _raw_variance_px2(card: SensorCard, flux_e: float) -> float:
    """Mean variance of u and v of a round spot over flat levels."""
    table = spot_sigma(card, 0.73, (2400.0, 2100.0, 1100.0), places=1, flux_e=(flux_e,))
    return table.sigma_px[0] ** 2


@pytest.mark.parametrize("flux_e", [300.0, 1500.0, 9000.0])
def test_means_of_drawn_frames_keep_the_pattern(flux_e: float) -> None:
    """Against the bound of n frames itself: n times the pattern's variance in one frame, all of it over n.

    The rule is not below it, and little above it; a fall as 1 / n is below.
    """
    card = sensor_card("bayer-raw")
    one, rest = _raw_variance_px2(card, flux_e), _raw_variance_px2(replace(card, prnu=0.0, dsnu_e=0.0), flux_e)
    assert one > rest
    for n in (2, 5, 30):
        scaled = replace(card, prnu=math.sqrt(n) * card.prnu, dsnu_e=math.sqrt(n) * card.dsnu_e)
        exact = _raw_variance_px2(scaled, flux_e) / n
        rule = one - rest + rest / n
        assert exact <= rule * (1.0 + 1e-9)
        assert exact > 0.97 * rule
        assert one / n < 0.97 * exact
