"""Codes, dark frames and settings that are not a sensor's alone: what is said, what sigma holds, what is refused."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.transfer_frames import BentCamera, write_stack
from numpy.typing import NDArray
from PIL import Image

from phibench.calibration.sensor_fit.capture_folder import CaptureError
from phibench.calibration.sensor_fit.fit_sensor import fit_sensor
from phibench.datasets.frames.sensor_file import SensorFile

CAMERA = BentCamera(0.15, 12.0, 150.0, size=(96, 96))
NARROW = BentCamera(0.00275, 22.0, 15.5, bits=8, size=(96, 96))
SMALL = BentCamera(0.02, 40.0, 14.0, bits=8, size=(96, 96))
SHARES = (0.1, 0.25, 0.4, 0.55, 0.7, 0.85)
Frame = NDArray[Any]
Change = Callable[[str, int, Frame], Frame]


def as_taken(_: str, __: int, frame: Frame) -> Frame:
    return frame


def fitted(folder: Path, camera: BentCamera, change: Change, leak_e: float = 0.0, kind: str = "mono-raw") -> SensorFile:
    """Fit of 16 dark frames, which hold `leak_e` electrons of light, and 8 of each level."""
    rng = np.random.default_rng(7)
    levels = {"dark": leak_e, **{f"flat/{k:02d}": camera.electrons(share) for k, share in enumerate(SHARES)}}
    for place, electrons in levels.items():
        frames = camera.frames(electrons, 16 if place == "dark" else 8, rng)
        write_stack(folder / place, [change(place, k, frame) for k, frame in enumerate(frames)])
    (folder / "capture.toml").write_text(f'format = "{kind}"\nbits = {camera.bits}\nexposure_s = 0.01\n')
    return fit_sensor(folder).file


def pull(found: SensorFile, name: str, truth: float) -> float:
    value, sigma = found.numbers[name], found.tables.sigma[name]
    assert isinstance(value, float)
    assert isinstance(sigma, float)
    return abs(value - truth) / sigma


@pytest.mark.slow
def test_good_cameras_have_no_finding(tmp_path: Path) -> None:
    """30 cameras of 8 to 14 bits, of noise from 0.3 codes on: no finding, and no number beyond 4.5 of its sigmas."""
    alarms, largest = 0, 0.0
    for k in range(30):
        rng, bits = np.random.default_rng([k, 1288]), (8, 10, 12, 14)[k % 4]
        top = (1 << bits) - 1
        gain = rng.uniform(0.08, 0.2) * top / 4095.0
        read = max(rng.uniform(6.0, 30.0), 0.3 / gain)
        camera = BentCamera(gain, read, max(rng.uniform(0.02, 0.07) * top, 6.0 * read * gain), bits, size=(96, 96))
        found = fitted(tmp_path / str(k), camera, as_taken, kind=("mono-raw", "bayer-raw")[k // 4 % 2])
        alarms += bool(found.tables.findings)
        truths = {"gain_dn_per_e": gain, "read_noise_e": read, "black_level_dn": camera.black, "prnu": camera.prnu}
        largest = max(largest, *(pull(found, name, x) for name, x in truths.items() if name in found.tables.sigma))
    print(f"{alarms} of 30 cameras with a finding, largest pull {largest:.2f}")
    assert alarms == 0
    assert largest < 4.5


def without_every_fourth(_: str, __: int, frame: Frame) -> Frame:
    return (frame - (frame % 4 == 3)).astype(frame.dtype)


def digital_gain(_: str, __: int, frame: Frame) -> Frame:
    """A table of 0.9: every ninth code is twice as wide. Gain, black and noise are 0.9 times the camera's."""
    return np.rint(0.9 * frame).astype(frame.dtype)


@pytest.mark.parametrize(("change", "times"), [(without_every_fourth, 1.0), (digital_gain, 0.9)], ids=["gaps", "gain"])
def test_uneven_codes_are_said_and_in_sigma(tmp_path: Path, change: Change, times: float) -> None:
    """Black was 45 sigma off without the codes' widths, and nothing was said."""
    found = fitted(tmp_path, CAMERA, change)
    assert "the converter's own codes" in found.tables.findings["codes"]
    assert pull(found, "black_level_dn", times * CAMERA.black) < 4.0
    assert pull(found, "gain_dn_per_e", times * CAMERA.gain) < 4.0
    assert pull(found, "read_noise_e", CAMERA.read_noise_e) < 4.0


def test_light_in_dark_frames_is_seen_by_the_pattern(tmp_path: Path) -> None:
    """1 % of full scale: black was 1500 sigma off, and read noise 40."""
    found = fitted(tmp_path, CAMERA, as_taken, leak_e=260.0)
    assert "dark frames hold light" in found.tables.findings["dark"]
    assert pull(found, "black_level_dn", CAMERA.black) < 4.0
    assert pull(found, "read_noise_e", CAMERA.read_noise_e) < 4.0
    assert pull(found, "gain_dn_per_e", CAMERA.gain) < 4.0


def lit_in_part(place: str, k: int, frame: Frame) -> Frame:
    """Light of 0 to 200 electrons from left to right, with its shot noise, and no pattern of the sensor."""
    light = np.random.default_rng(k).poisson(np.broadcast_to(np.linspace(0.0, 200.0, 96), (96, 96)))
    return np.rint(frame + CAMERA.gain * light).astype(frame.dtype) if place == "dark" else frame


def drifting(place: str, k: int, frame: Frame) -> Frame:
    fine = np.random.default_rng(k).uniform(-0.5, 0.5, frame.shape)
    return np.rint(frame + fine + 0.1 * k).astype(frame.dtype) if place == "dark" else frame


@pytest.mark.parametrize(
    ("change", "said"),
    [(lit_in_part, "dark frames hold light"), (drifting, "drifts by 1.5 DN")],
    ids=["light", "drift"],
)
def test_dark_frames_that_are_not_black_level_alone(tmp_path: Path, change: Change, said: str) -> None:
    found = fitted(tmp_path, CAMERA, change)
    assert said in found.tables.findings["dark"]
    assert pull(found, "black_level_dn", CAMERA.black) < 4.0


def test_a_curve_about_black_makes_the_noise_lopsided(tmp_path: Path) -> None:
    """Twice the slope above black: its mean is 0.4 of the noise too high, 50 sigma."""

    rng = np.random.default_rng(5)

    def curved(frame: Frame) -> Frame:
        above = frame + rng.uniform(-0.5, 0.5, frame.shape) - CAMERA.black
        return np.rint(CAMERA.black + np.where(above > 0.0, 2.0 * above, above)).astype(frame.dtype)

    camera = BentCamera(0.15, 30.0, 150.0, size=(96, 96))
    for place, share in (("dark", 0.0), ("flat/0", 0.1), ("flat/1", 0.2), ("flat/2", 0.3), ("flat/3", 0.4)):
        frames = camera.frames(camera.electrons(share), 8, rng)
        write_stack(tmp_path / place, [curved(frame) for frame in frames])
    (tmp_path / "capture.toml").write_text('format = "mono-raw"\nbits = 12\n')
    found = fit_sensor(tmp_path).file
    assert "is lopsided" in found.tables.findings["dark"]
    assert pull(found, "black_level_dn", camera.black) < 4.0


@pytest.mark.parametrize("code", [0, 4095], ids=["dead", "hot"])
def test_defects_leave_black_and_pattern(tmp_path: Path, code: int) -> None:
    """Two of a thousand pixels moved black by 5 to 90 sigma."""
    defects = np.random.default_rng(1).random((96, 96)) < 0.002

    def broken(_: str, __: int, frame: Frame) -> Frame:
        return np.where(defects, code, frame).astype(frame.dtype)

    found = fitted(tmp_path, CAMERA, broken)
    assert not found.tables.findings
    for name, truth in (("black_level_dn", CAMERA.black), ("gain_dn_per_e", CAMERA.gain), ("prnu", CAMERA.prnu)):
        assert pull(found, name, truth) < 4.0


def test_columns_that_jump_are_no_read_noise(tmp_path: Path) -> None:
    """Columns of 12 electrons made the read noise 40 % too large."""

    def jumping(place: str, k: int, frame: Frame) -> Frame:
        rng = np.random.default_rng([k, *place.encode()])
        fine = rng.uniform(-0.5, 0.5, frame.shape)
        return np.rint(frame + fine + 1.8 * rng.standard_normal((1, 96))).astype(frame.dtype)

    found = fitted(tmp_path, CAMERA, jumping)
    columns = found.tables.measured["column_noise_e"]
    assert columns.value == pytest.approx(12.0, rel=0.1)
    assert isinstance(read := found.numbers["read_noise_e"], float)
    # twice rounded: 1/12 of a uniform law and 1/12 more
    assert read == pytest.approx(float(np.hypot(12.0, 6.0**-0.5 / CAMERA.gain)), rel=0.03)


def averaged(places: str | tuple[str, ...]) -> Change:
    def change(place: str, k: int, frame: Frame) -> Frame:
        if not place.startswith(places):
            return frame
        share = SHARES[int(place[-1])] if place != "dark" else 0.0
        more = CAMERA.frames(CAMERA.electrons(share), 3, np.random.default_rng([k, *place.encode()]))
        return np.rint(np.mean([frame, *more], axis=0)).astype(frame.dtype)

    return change


@pytest.mark.parametrize("offset_dn", [-90, 60])
def test_dark_frames_of_another_black_level_are_refused(tmp_path: Path, offset_dn: int) -> None:
    """Brightness was changed between dark and flat frames: below, a bend was found, and half of the gain."""

    def moved(place: str, _: int, frame: Frame) -> Frame:
        return (frame.astype(int) + offset_dn * (place == "dark")).astype(frame.dtype)

    with pytest.raises(CaptureError, match="with one gain and one black level"):
        fitted(tmp_path, CAMERA, moved)


def test_bits_are_those_of_the_file(tmp_path: Path) -> None:
    """8 bits a pixel were taken for 10, and a full well of four times the range for the sensor's."""
    fitted(tmp_path, NARROW, as_taken)
    notes = tmp_path / "capture.toml"
    notes.write_text('format = "mono-raw"\n')
    assert fit_sensor(tmp_path).file.numbers["adc_bits"] == 8
    notes.write_text('format = "mono-raw"\nbits = 10\n')
    with pytest.raises(CaptureError, match=r"has 8 bits a pixel, and capture\.toml says bits = 10"):
        fit_sensor(tmp_path)
    notes.write_text('format = "mono-raw"\n')
    for path in tmp_path.rglob("*.png"):
        with Image.open(path) as picture:
            codes = np.array(picture).astype(">u2")
        path.with_suffix(".pgm").write_bytes(b"P5 %d %d 4095\n" % codes.shape[::-1] + codes.tobytes())
        path.unlink()
    assert fit_sensor(tmp_path).file.numbers["adc_bits"] == 12


def test_frames_of_two_cameras_are_refused(tmp_path: Path) -> None:
    fitted(tmp_path, CAMERA, as_taken)
    for path in tmp_path.rglob("*.png"):
        with Image.open(path) as picture:
            picture.save(path.with_suffix(".tif"), tiffinfo={0x0110: "A" if path.parent.name == "dark" else "B"})
        path.unlink()
    with pytest.raises(CaptureError, match="is of B and the first frame of A"):
        fit_sensor(tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("places", ["dark", "flat"])
def test_means_beside_single_frames_are_refused(tmp_path: Path, places: str) -> None:
    """Means of four among flat frames made the gain 80 % too small, at 235 sigma."""
    with pytest.raises(CaptureError, match="give single frames for both, not means"):
        fitted(tmp_path, CAMERA, averaged(places))


def test_means_that_were_rounded_half_to_even_are_said(tmp_path: Path) -> None:
    """Even codes are a quarter wider. The gain was a quarter of the camera's, at 600 sigma, and nothing was said."""
    found = fitted(tmp_path, CAMERA, averaged(("dark", "flat")))
    assert "each frame were a mean of 4" in found.tables.findings["codes"]
    assert pull(found, "gain_dn_per_e", CAMERA.gain) < 4.0


@pytest.mark.parametrize("quality", [95, 98, 100])
def test_frames_that_passed_through_a_jpeg_are_refused(tmp_path: Path, quality: int) -> None:
    def coded(_: str, __: int, frame: Frame) -> Frame:
        file = io.BytesIO()
        Image.fromarray(frame.astype(np.uint8)).save(file, "JPEG", quality=quality)
        return np.asarray(Image.open(file))

    with pytest.raises(CaptureError, match="passed through JPEG"):
        fitted(tmp_path, SMALL, coded)


def test_noise_below_a_code_bends_no_line(tmp_path: Path) -> None:
    """Dark noise of 0.06 codes: a bend of 48 % was found, and the gain 4 times too small."""
    found = fitted(tmp_path, NARROW, as_taken, kind="bayer-raw")
    assert "photon_transfer" not in found.tables.findings
    assert pull(found, "gain_dn_per_e", NARROW.gain) < 4.0


@pytest.mark.slow
@pytest.mark.parametrize("power", [0.9, 1.05])
def test_a_power_of_the_codes_is_among_the_responses(tmp_path: Path, power: float) -> None:
    """Gamma, black included. Polynomials alone were 7 % off at 8 sigma."""

    def raised(_: str, __: int, frame: Frame) -> Frame:
        return np.rint(4095.0 * (frame / 4095.0) ** power).astype(frame.dtype)

    found = fitted(tmp_path, CAMERA, raised)
    slope = power * (CAMERA.black / 4095.0) ** (power - 1.0)
    assert "a straight line does not fit" in found.tables.findings["photon_transfer"]
    assert pull(found, "gain_dn_per_e", CAMERA.gain * slope) < 4.0


@pytest.mark.parametrize(("note", "said"), [('format = "mono-raw"\n', "two planes"), ("", "second plane of 200")])
def test_opacity_is_no_chroma(tmp_path: Path, note: str, said: str) -> None:
    grey = CAMERA.frames(0.0, 2, np.random.default_rng(1))
    for k, frame in enumerate(grey):
        (tmp_path / "dark").mkdir(exist_ok=True)
        planes = np.stack([(frame // 8).astype(np.uint8), np.full(frame.shape, 200, np.uint8)], axis=-1)
        Image.fromarray(planes, "LA").save(tmp_path / f"dark/{k}.png")
    (tmp_path / "capture.toml").write_text(f"{note}bits = 8\n")
    with pytest.raises(CaptureError, match=said):
        fit_sensor(tmp_path)
