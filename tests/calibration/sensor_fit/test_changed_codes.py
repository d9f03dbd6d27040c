"""Faults of raw codes: exchanged bytes, wrapped negative numbers, dates in frames; sound codes have none."""

from __future__ import annotations

import numpy as np
import pytest

from phibench.calibration.sensor_fit.code_widths import code_fault

SHAPE = (4, 64, 96)


def counted(mean: float, deviation: float, seed: int = 0) -> np.ndarray:
    return np.rint(np.random.default_rng(seed).normal(mean, deviation, SHAPE)).astype(np.int64)


def as_codes(values: np.ndarray) -> np.ndarray:
    return (values % 65536).astype(np.uint16)


@pytest.mark.parametrize(
    ("frames", "bits", "words"),
    [
        (as_codes(counted(1000.0, 9.0)).byteswap(), 12, "bytes are exchanged"),
        (as_codes(counted(30.0, 1.0)).byteswap(), 16, "or whose bytes are exchanged"),
        (as_codes(counted(1.0, 1.0)), 12, "numbers below 0 became 65535 and less"),
        (as_codes(counted(1.0, 1.0)), 16, "numbers below 0 became the largest codes"),
        (as_codes(counted(1.0, 1.0) % 4096), 12, "numbers below 0 became the largest codes"),
        (as_codes(counted(4090.0, 20.0) % 4096), 12, "began anew"),
        (as_codes(16 * counted(100.0, 5.0)), 16, "shift them right by 4 bits"),
        (as_codes(16 * counted(300.0, 5.0)), 12, "write `bits`"),
    ],
)
def test_each_fault_of_codes_is_named(frames: np.ndarray, bits: int, words: str) -> None:
    assert words in code_fault(frames, bits)


def test_a_date_that_changes_is_named_with_its_place() -> None:
    frames, rng = as_codes(counted(300.0, 5.0)), np.random.default_rng(1)
    frames[:, 50:58, 60:90] = np.where(rng.random((4, 8, 30)) > 0.5, 4095, 0)
    assert "all within 30 x 8 pixels at (60, 50): a date" in code_fault(frames, 12)


def test_sound_codes_have_no_fault() -> None:
    rng = np.random.default_rng(2)
    for level in (0.0, 2.0, 30.0, 400.0, 2000.0, 4000.0, 4200.0):
        frames = np.clip(np.rint(level + np.sqrt(1.0 + 0.1 * level) * rng.standard_normal(SHAPE)), 0, 4095)
        frames[:, 5, 5] = 4095  # hot
        frames[2, 20, 20:26] = 4095  # a cosmic ray
        assert code_fault(frames.astype(np.uint16), 12) == ""
