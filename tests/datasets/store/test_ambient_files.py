"""Ambient layers as halves: what rounding costs beside the sensor's noise, older files, and bad scales."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.store.layers import (
    read_ambient,
    read_ambient_variance,
    read_exr,
    write_ambient,
    write_exr,
)
from phibench.render.room.noise_budget import webcam

LIGHT = np.geomspace(1.0, 5e6, 3 * 40 * 50).reshape(3, 40, 50).astype(np.float32)  # a dark corner, and a lamp
VARIANCE = (0.01 * LIGHT) ** 2


def test_rounding_is_small_beside_the_sensors_noise(tmp_path: Path) -> None:
    """A half has 10 bits of fraction: it is off by 2^-11 at most. A pixel of n electrons has sqrt(n + r^2) of noise.

    At the full well, 12 000 electrons, that is 0.0533 of the noise. Deviations have 4 bits: 2^-5. Scaled values below
    2^-14 have fewer bits; here these are below 0.01 electrons/s.
    """
    path = write_ambient(tmp_path / "ambient.exr", LIGHT, VARIANCE, {})
    light, variance = read_ambient(path), read_ambient_variance(path)
    electrons = LIGHT * webcam().exposure_s
    below = electrons < webcam().full_well_e
    off = np.abs(light - LIGHT) * webcam().exposure_s / np.sqrt(electrons + webcam().read_noise_e ** 2)
    print(off[below].max(), off[below].mean())
    assert 0.03 < off[below].max() < 2.0**-11 * webcam().full_well_e ** 0.5
    np.testing.assert_allclose(np.sqrt(variance), np.sqrt(VARIANCE), rtol=1.01 * 2.0**-5, atol=1e-3)


def test_a_layer_shrinks_to_a_fifth(tmp_path: Path) -> None:
    """Half of the bits, and deviations of few values: 24 bytes a pixel were 22 MB a view."""
    v, u = np.mgrid[:360, :640]
    smooth = np.repeat((2e5 + 5e4 * np.sin(u / 90.0) * np.cos(v / 70.0))[None], 3, axis=0)
    noisy = np.random.default_rng(0).chisquare(20, smooth.shape) * smooth
    path = write_ambient(tmp_path / "ambient.exr", smooth, noisy, {})
    assert path.stat().st_size < 24 * v.size / 5


def test_a_layer_of_an_older_version_is_read(tmp_path: Path) -> None:
    planes = dict(zip(("R", "G", "B", "var.R", "var.G", "var.B"), (*LIGHT, *VARIANCE), strict=True))
    path = write_exr(tmp_path / "ambient.exr", planes, {"kind": "ambient"})
    assert np.array_equal(read_ambient(path), LIGHT)
    assert np.array_equal(read_ambient_variance(path), VARIANCE)


@pytest.mark.parametrize("scale", [0.0, -2.0, "2", None])
def test_a_scale_that_is_none_is_refused(tmp_path: Path, scale: object) -> None:
    path = write_ambient(tmp_path / "ambient.exr", LIGHT, VARIANCE, {})
    file = read_exr(path)
    write_exr(path, file.planes, {**file.header, "scale": scale}, half=True)
    with pytest.raises(DatasetError, match="instead of a number above 0"):
        read_ambient(path)


def test_a_value_beyond_a_half_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="beyond float16"):
        write_exr(tmp_path / "a.exr", {"R": LIGHT[2]}, {}, half=True)
