"""Two renderings are compared in sigma of phi: a known shift gives its own size, the room's level none."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.damage import sign

from phibench.cli.main import main
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.exposures.expected_electrons import ExpectedRegion, expected_region
from phibench.datasets.frames.sensor_card import card_of
from phibench.datasets.read import open_finished
from phibench.datasets.store import schema
from phibench.estimator.limits.position_bound import spot_limit
from phibench.estimator.limits.variant_difference import (
    LARGEST,
    phi_shift_sigma,
    table_of,
    variant_difference,
)
from phibench.render.sensor.settings import sensor

CAMERA = sensor("bayer-raw")
CARD = card_of(CAMERA)
GRADIENT = np.array([2e-3, -1e-3])
NO_DRIVER = {"DRJIT_LIBCUDA_PATH": "/nowhere", "DRJIT_LIBOPTIX_PATH": "/nowhere"}


@pytest.fixture(scope="module")
def region(tiny_dataset: Path) -> ExpectedRegion:
    return expected_region(open_finished(tiny_dataset)[0], "down", CAMERA)


def test_a_known_shift_has_its_own_size(region: ExpectedRegion) -> None:
    """Linear by construction, so that the only tolerance is that of solving for the shift: 1e-6."""
    moved = np.array([3e-3, -1e-3])
    spot = region.spot_e + moved[0] * region.du_e_per_px + moved[1] * region.dv_e_per_px
    covariance = spot_limit(region, CARD).covariance_px2
    expected = GRADIENT @ moved / np.sqrt(GRADIENT @ covariance @ GRADIENT)
    assert abs(expected) > 1e-3
    found = phi_shift_sigma(region, replace(region, spot_e=spot), CARD, GRADIENT)
    assert found == pytest.approx(expected, rel=1e-6)


def test_flux_and_the_level_of_each_filter_move_nothing(region: ExpectedRegion) -> None:
    brighter = replace(region, spot_e=1.01 * region.spot_e, background_e=region.background_e + 5.0 * region.filters)
    assert abs(phi_shift_sigma(region, brighter, CARD, GRADIENT)) < 1e-6
    tilted = replace(region, background_e=region.background_e + np.arange(region.mean_e.shape[1]) * 20.0)
    assert abs(phi_shift_sigma(region, tilted, CARD, GRADIENT)) > 0.1


def test_a_window_cut_elsewhere_is_laid_on_the_same_pixels(region: ExpectedRegion) -> None:
    """What lies outside the other's window holds next to no light of the spot: here 2 of the 4 pixels of margin."""
    inner = {name: getattr(region, name)[2:-2, 2:-2] for name in vars(region) if not name.endswith("0_px")}
    cut = ExpectedRegion(region.u0_px + 2, region.v0_px + 2, **inner)
    assert abs(phi_shift_sigma(region, cut, CARD, GRADIENT)) < 1e-9


def test_a_data_set_agrees_with_itself(smallest_dataset: Path) -> None:
    found = variant_difference(smallest_dataset, smallest_dataset)
    assert found.agrees
    assert found.worst_sigma == found.rms_sigma == 0.0
    assert len(found.shifts_sigma) == 3  # two spots of one sample, one of the other
    assert "the same to the bit" in table_of("llvm", "cuda", found)


def test_another_last_bit_of_truth_is_named(smallest_dataset: Path, tmp_path: Path) -> None:
    other = Path(shutil.copytree(smallest_dataset, tmp_path / "other"))
    text = (other / schema.MANIFEST).read_text()
    key = '"phi_ray_rad": '
    at = text.index(key) + len(key)
    end = at + min(text[at:].index(mark) for mark in ",}")
    changed = repr(float(np.nextafter(float(text[at:end]), 9.0)))
    (other / schema.MANIFEST).write_text(text[:at] + changed + text[end:])
    sign(other)
    found = variant_difference(smallest_dataset, other)
    assert not found.agrees
    assert len(found.truth_differs) == 1
    assert found.truth_differs[0].endswith("phi_ray_rad")
    assert found.worst_sigma < LARGEST
    assert "differs: " in table_of("llvm", "cuda", found)


def test_other_samples_are_refused(smallest_dataset: Path, tiny_dataset: Path) -> None:
    with pytest.raises(DatasetError, match="are of two recipes"):
        variant_difference(smallest_dataset, tiny_dataset)


def test_a_variant_that_does_not_start_is_a_sentence(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    for name, value in NO_DRIVER.items():
        monkeypatch.setenv(name, value)
    assert main(["doctor", "--variants"]) == 2
    told = capfd.readouterr().err
    assert "cuda does not render: " in told
    assert "CUDA is asked for, and no NVIDIA driver" in told
    assert told.count("\n") == 1
