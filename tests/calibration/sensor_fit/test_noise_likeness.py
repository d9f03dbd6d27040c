"""Frames that are no raw ones, or not of one sensor at rest: what is refused, and what sigma holds."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.transfer_frames import BentCamera, write_stack
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from phibench.calibration.sensor_fit.capture_folder import CaptureError
from phibench.calibration.sensor_fit.fit_sensor import fit_sensor
from phibench.datasets.frames.sensor_file import SensorFile

CAMERA = BentCamera(0.15, 12.0, 150.0, size=(96, 96))
SHARES = (0.15, 0.4, 0.7)
Frame = NDArray[Any]
Change = Callable[[str, int, Frame], Frame]


def fitted(folder: Path, change: Change, shares: tuple[float, ...] = SHARES, kind: str = "mono-raw") -> SensorFile:
    rng = np.random.default_rng(7)
    levels = {"dark": 0.0, **{f"flat/{k:02d}": CAMERA.electrons(share) for k, share in enumerate(shares)}}
    for place, electrons in levels.items():
        frames = CAMERA.frames(electrons, 8, rng)
        write_stack(folder / place, [change(place, k, frame) for k, frame in enumerate(frames)])
    (folder / "capture.toml").write_text(f'format = "{kind}"\nbits = 12\nexposure_s = 0.01\n')
    return fit_sensor(folder).file


def rounded(values: Frame) -> Frame:
    return np.clip(np.rint(values), 0, CAMERA.top).astype(np.uint16)


def smoothed(sigma_px: float) -> Change:
    return lambda _, __, frame: rounded(gaussian_filter(frame.astype(float), sigma_px))


def banded(place: str, k: int, frame: Frame) -> Frame:
    """A lamp on mains and a rolling shutter: bands of 1 %, at another place in each frame."""
    wave = 1.0 + 0.01 * np.sin(np.arange(96.0)[:, None] / 5.0 + 1.7 * k)
    return rounded((frame - CAMERA.black) * wave + CAMERA.black) if place != "dark" else frame


def evened(place: str, k: int, frame: Frame) -> Frame:
    """A camera that evens out a shading of 1 to 0.4: it multiplies signal and noise of the corners."""
    y, x = np.mgrid[-1:1:96j, -1:1:96j]
    light = 1.0 - 0.3 * (x**2 + y**2)
    seen = np.random.default_rng([k, len(place), ord(place[-1])]).binomial(
        np.rint((frame - CAMERA.black).clip(0) / CAMERA.gain).astype(int), light
    )
    return rounded(seen * CAMERA.gain / light + CAMERA.black) if place != "dark" else frame


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "kind", "said"),
    [
        (smoothed(0.4), "mono-raw", "neighbouring pixels is alike"),
        (smoothed(0.4), "bayer-raw", "neighbouring pixels is alike"),
        (banded, "mono-raw", "rows jump together"),
        (evened, "mono-raw", "evens out its shading"),
    ],
    ids=["smoothed", "smoothed mosaic", "bands", "shading"],
)
def test_noise_that_is_not_the_converters_is_said_and_in_sigma(
    tmp_path: Path, change: Change, kind: str, said: str
) -> None:
    """Without it the gain of the smoothed frames is 28 % too low at 0.4 % claimed."""
    found = fitted(tmp_path, change, kind=kind)
    assert said in found.tables.findings["noise"]
    sigma = found.tables.sigma["gain_dn_per_e"]
    assert isinstance(sigma, float)
    assert abs(float(str(found.numbers["gain_dn_per_e"])) - CAMERA.gain) < 3.0 * sigma


def averaged_over_time(_: str, k: int, frame: Frame, kept: dict[str, Any] = {}) -> Frame:  # noqa: B006
    before = kept.get(_) if k else None
    kept[_] = frame.astype(float) if before is None else 0.5 * before + 0.5 * frame
    return rounded(kept[_])


def moved_light(place: str, k: int, frame: Frame) -> Frame:
    wave = 1.0 + 0.1 * np.sin((np.arange(96.0) + 4.0 * k) * np.pi / 24.0)
    return rounded((frame - CAMERA.black) * wave + CAMERA.black) if place != "dark" else frame


def tabled(_: str, __: int, frame: Frame) -> Frame:
    """Codes through a table of the root with 12 bits in 256 steps."""
    return rounded(np.rint(np.sqrt(frame * 4095.0) / 16.0) ** 2 * 256.0 / 4095.0)


def doubled(place: str, k: int, frame: Frame, kept: dict[str, Any] = {}) -> Frame:  # noqa: B006
    return kept.setdefault(f"{place}{k // 2}", frame)


def exchanged(place: str, _: int, frame: Frame) -> Frame:
    """Dark frames of a bright level."""
    return rounded(frame + 1500.0) if place == "dark" else frame


def two_gains(place: str, k: int, frame: Frame) -> Frame:
    fine = np.random.default_rng(k).uniform(-0.5, 0.5, frame.shape)
    return rounded(2.0 * (frame + fine - CAMERA.black) + CAMERA.black) if place in ("flat/00", "flat/01") else frame


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (smoothed(0.8), "neighbouring pixels is alike"),
        (averaged_over_time, "noise of one frame is in the next"),
        (moved_light, "light moves over the picture"),
        (tabled, "which a table or a digital gain spread"),
        (doubled, "000.png and 001.png are the same frame"),
        (exchanged, "is darker than dark/"),
    ],
)
def test_frames_that_tell_nothing_of_the_sensor_are_refused(tmp_path: Path, change: Change, said: str) -> None:
    with pytest.raises(CaptureError, match=said):
        fitted(tmp_path, change)


def test_levels_of_two_gains_are_refused(tmp_path: Path) -> None:
    """Bent responses took them in with a gain of 1e4 DN per electron."""
    with pytest.raises(CaptureError, match="one gain and one setting"):
        fitted(tmp_path, two_gains, (0.1, 0.25, 0.4, 0.55, 0.7, 0.85))


def test_dark_frames_that_a_program_cut_are_seen_at_any_code(tmp_path: Path) -> None:
    """A cut at black made the gain 31 % too large: the dark frames' noise was taken for whole."""
    found = fitted(tmp_path, lambda _, __, frame: np.maximum(frame, 151).astype(np.uint16))
    assert "cut at code 151" in found.tables.findings["dark"]
    sigma = found.tables.sigma["gain_dn_per_e"]
    assert isinstance(sigma, float)
    assert abs(float(str(found.numbers["gain_dn_per_e"])) - CAMERA.gain) < 4.0 * sigma


def test_uneven_light_takes_no_full_pixels_in_and_leaves_the_pattern(tmp_path: Path) -> None:
    """A lamp in the middle: its level's mean is far below full scale, and its middle is full."""
    y, x = np.mgrid[-1:1:96j, -1:1:96j]
    light, rng = 1.45 - 0.5 * (x**2 + y**2), np.random.default_rng(3)
    pattern = 1.0 + 0.005 * np.random.default_rng(99).standard_normal((96, 96))

    def lit(place: str, _: int, frame: Frame) -> Frame:
        if place == "dark":
            return frame
        e = CAMERA.electrons((0.15, 0.3, 0.45, 0.75)[int(place[-1])]) * light * pattern
        return rounded(CAMERA.black + CAMERA.gain * (rng.poisson(e) + 12.0 * rng.standard_normal((96, 96))))

    found = fitted(tmp_path, lit, (*SHARES, 0.8))
    assert not found.tables.findings
    for name, truth in (("gain_dn_per_e", CAMERA.gain), ("prnu", 0.005)):
        sigma = found.tables.sigma[name]
        assert isinstance(sigma, float)
        assert abs(float(str(found.numbers[name])) - truth) < 4.0 * sigma
