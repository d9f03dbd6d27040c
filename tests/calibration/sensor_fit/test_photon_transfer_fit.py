"""Fit of raw frames: every number within its stated sigma over drawn sensors, beside `emva1288`, and bad folders."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers.sensor_captures import drawn_sensor, flat_frames, write_frames, write_raw_capture
from PIL import Image

from phibench.calibration.sensor_fit.block_sums import rounded_moments
from phibench.calibration.sensor_fit.capture_folder import CaptureError
from phibench.calibration.sensor_fit.fit_sensor import SensorFit, fit_sensor
from phibench.render.sensor.settings import Sensor, sensor

LEVELS = (0.1, 0.3, 0.5, 0.7, 0.85)
SLOW_SECONDS = {1.0: 8, 5.0: 8}
NUMBERS = {"gain_dn_per_e", "black_level_dn", "dark_e_per_s", "read_noise_e", "dsnu_e", "prnu"}


def fitted(folder: Path, s: Sensor, seed: int, past_full: bool) -> SensorFit:
    levels = (*LEVELS, 1.4) if past_full else LEVELS
    found = fit_sensor(write_raw_capture(folder, s, seed, levels, dark_seconds=SLOW_SECONDS))
    shutil.rmtree(folder)
    return found


def pulls(found: SensorFit, s: Sensor) -> dict[str, float]:
    sigma = found.file.tables.sigma
    return {name: (found.file.numbers[name] - getattr(s, name)) / sigma[name] for name in sigma}


def all_pulls(tmp_path: Path, numbers: range) -> list[float]:
    result = []
    for k in numbers:
        s = drawn_sensor(k)
        found = pulls(fitted(tmp_path / str(k), s, k, past_full=k % 3 == 0), s)
        assert set(found) - {"full_well_e"} >= NUMBERS
        result += found.values()
    return result


@pytest.mark.slow
def test_every_number_lies_within_its_sigma(tmp_path: Path) -> None:
    """Four sensors, 26 pulls or so: of Student's t with 63 degrees of freedom beyond 5 once in 1e4 runs.

    Their mean square is chi-square with 26 degrees of freedom (fewer, where numbers share their noise): with 13 it is
    below 2.9 but for 1e-3.
    """
    found = np.array(all_pulls(tmp_path, range(3, 7)))
    assert np.abs(found).max() < 5.0
    assert np.mean(found**2) < 2.9


@pytest.mark.slow
def test_pulls_of_fifty_sensors(tmp_path: Path) -> None:
    """310 pulls: their rms has the standard error 0.04, widened by a half for what numbers share: 0.8 to 1.2 are 3.3.

    Beyond 5 lies one of Student's t in 2e5.
    """
    found = np.array(all_pulls(tmp_path, range(50)))
    print(
        f"{len(found)} pulls: mean {found.mean():+.3f}, rms {np.sqrt(np.mean(found**2)):.3f}, "
        f"largest {np.abs(found).max():.2f}"
    )
    assert len(found) > 300
    assert 0.8 < np.sqrt(np.mean(found**2)) < 1.2
    assert np.abs(found).max() < 5.0


def test_a_wrong_number_is_seen(tmp_path: Path) -> None:
    """A sensor that is 5 % off in one number is refused by that number's pull."""
    s = drawn_sensor(9)
    found = fitted(tmp_path / "a", s, 9, past_full=True)
    for name in ("gain_dn_per_e", "read_noise_e", "dsnu_e", "prnu", "full_well_e"):
        assert abs(pulls(found, s.replace(**{name: 1.05 * getattr(s, name)}))[name]) > 5.0, name
    assert abs(pulls(found, s.replace(black_level_dn=s.black_level_dn + 0.2))["black_level_dn"]) > 5.0


def test_the_file_gives_the_sensor_back(tmp_path: Path) -> None:
    s = drawn_sensor(4).replace(row_noise_e=4.0)
    found = fit_sensor(write_raw_capture(tmp_path, s, 4))
    again = found.file.sensor()
    assert (again.mosaic, again.adc_bits) == (s.mosaic, s.adc_bits)
    assert again.row_noise_e == pytest.approx(4.0, rel=0.15)  # 23 x 127 row means: sigma 2 %, of the pixels' share 3 %
    assert again.read_noise_e == pytest.approx(s.read_noise_e, rel=0.05)
    reasons = found.file.tables.not_determined
    assert "dark-exposure/SECONDS" in reasons["dark_e_per_s"]
    assert "no level of flat/ is saturated" in found.file.tables.assumed["full_well_e"]
    assert not set(reasons) & set(found.file.numbers)
    assert again.full_well_e * again.dn_per_e > again.top_dn - again.black_level_dn


@pytest.mark.parametrize("mean", [64.0, 64.3, 64.5])
def test_moments_of_rounding_are_those_of_drawn_numbers(mean: float) -> None:
    """2000 pixels x 200 values: standard errors 2e-3 of the temporal and 3 % of the spatial variance; five of them."""
    rng = np.random.default_rng(5)
    centre = mean + 0.12 * rng.standard_normal((2000, 1))
    values = np.rint(centre + 0.32 * rng.standard_normal((2000, 200)))
    temporal = values.var(axis=1, ddof=1).mean()
    spatial = values.mean(axis=1).var(ddof=1) - temporal / 200
    expected = rounded_moments(mean, 0.32, 0.12)
    assert values.mean() == pytest.approx(expected[0], abs=0.02)
    assert temporal == pytest.approx(expected[1], rel=0.02)
    assert spatial == pytest.approx(expected[2], rel=0.17)
    assert abs(expected[1] - (0.32**2 + 1.0 / 12.0)) > 0.01 or mean == 64.3  # 1/12 would not do


@pytest.mark.slow
def test_emva1288_finds_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The package and we read the same frames; its errors are ours, so that the difference is below 5 of our sigmas.

    K: it takes the unweighted slope up to 70 % of saturation, so twice our sigma is allowed for that.
    """
    from emva1288 import process

    monkeypatch.setattr(np, "asfarray", lambda x: np.asarray(x, float), raising=False)  # emva1288 1.0.2 knows NumPy 1
    # noise well above the rounding, full well inside the converter: what the package needs
    s = sensor("mono-raw", adc_bits=12, gain_dn_per_e=0.3, black_level_dn=200.0, dark_e_per_s=0.0, full_well_e=11000.0)
    lines, size = ["v 4.0", "n 12 160 160"], (160, 160)
    folder = tmp_path / "capture"

    def series(place: str, seconds: float, electrons: float, count: int) -> list[str]:
        images = flat_frames(s.replace(exposure_s=seconds), (electrons, 0.0, 0.0), count, place, 3, size)
        write_frames(folder / place, images)
        return [f"i {folder / place}/{k:03d}.png" for k in range(count)]

    for i, seconds in enumerate(np.concatenate([np.linspace(0.004, 0.08, 16), np.linspace(0.082, 0.1, 8)])):
        electrons = 1.2e5 * seconds
        lines += [f"b {seconds * 1e9:.1f} {electrons:.4f}", *series(f"flat/{i:02d}", seconds, electrons, 2)]
        lines += [f"d {seconds * 1e9:.1f}", *series(f"other/{i:02d}", seconds, 0.0, 2)]
    lines += ["b 44000000.0 5280.0", *series("flat/99", 0.044, 5280.0, 30)]
    lines += ["d 44000000.0", *series("dark", 0.044, 0.0, 60)]
    (folder / "emva.txt").write_text("\n".join(lines) + "\n")
    (folder / "capture.toml").write_text('format = "mono-raw"\nbits = 12\nexposure_s = 0.044\n')
    parsed = process.ParseEmvaDescriptorFile(str(folder / "emva.txt"))
    theirs = process.Results1288(process.Data1288(process.LoadImageData(parsed.images).data).data)
    found = fit_sensor(folder).file
    ours, sigma = found.numbers, found.tables.sigma
    for name, value, widen in (
        ("gain_dn_per_e", theirs.K, 2.0),
        ("read_noise_e", theirs.sigma_d, 2.0),
        ("dsnu_e", theirs.DSNU1288, 1.0),
        ("prnu", theirs.PRNU1288 / 100.0, 1.0),
    ):
        print(f"{name}: ours {ours[name]:.5g} +- {sigma[name]:.2g}, emva1288 {value:.5g}, true {getattr(s, name):.5g}")
        assert abs(ours[name] - value) < 5.0 * widen * sigma[name], name


# -- folders that will not do ----------------------------------------------------------------------------------------


@pytest.fixture
def good(tmp_path: Path) -> Path:
    return write_raw_capture(tmp_path / "c", sensor("bayer-raw"), 0, (0.2, 0.6), frames=2, dark_frames=2)


def _remove(name: str):
    return lambda folder: shutil.rmtree(folder / name)


def _one_frame(folder: Path) -> None:
    (folder / "flat/00/001.png").unlink()


def _another_size(folder: Path) -> None:
    Image.fromarray(np.zeros((64, 64), np.uint16)).save(folder / "flat/01/000.png")


def _another_format(folder: Path) -> None:
    Image.fromarray(np.zeros((128, 128, 3), np.uint8)).save(folder / "flat/01/000.png")


def _drift(folder: Path) -> None:
    image = np.asarray(Image.open(folder / "flat/01/001.png")).astype(float)
    Image.fromarray((1.05 * image).astype(np.uint16)).save(folder / "flat/01/001.png")


def _saturate(folder: Path) -> None:
    for path in (folder / "flat").rglob("*.png"):
        Image.fromarray(np.full((128, 128), 1023, np.uint16)).save(path)


def _scaled(folder: Path) -> None:
    for path in folder.rglob("*.png"):
        Image.fromarray((np.asarray(Image.open(path)) * 64).astype(np.uint16)).save(path)


def _scaled_whole(folder: Path) -> None:
    """As programs do that fill 16 bits: 10 bits with their upper ones behind them."""
    for path in folder.rglob("*.png"):
        dn = np.asarray(Image.open(path)).astype(np.uint16)
        Image.fromarray((dn << 6) | (dn >> 4)).save(path)
    notes = (folder / "capture.toml").read_text()
    (folder / "capture.toml").write_text(notes.replace("bits = 10", "bits = 16"))


def _turned(folder: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 2
    for path in folder.rglob("*.png"):
        Image.fromarray(np.zeros((128, 128, 3), np.uint8)).save(path, exif=exif)


def _palette(folder: Path) -> None:
    for path in folder.rglob("*.png"):
        Image.fromarray(np.zeros((128, 128, 3), np.uint8)).quantize(4).save(path)


def _cmyk(folder: Path) -> None:
    for path in folder.rglob("*.png"):
        Image.new("CMYK", (128, 128)).save(path.with_suffix(".jpg"))
        path.unlink()


def _damage(folder: Path) -> None:
    (folder / "flat/00/000.png").write_bytes(b"no picture")


def _unknown_note(folder: Path) -> None:
    (folder / "capture.toml").write_text("exposure = 0.1\n")


def _whole_time(folder: Path) -> None:
    (folder / "capture.toml").write_text("exposure_s = 33\n")


def _exposed(name: str) -> Callable[[Path], None]:
    """One level of flat frames is said to have an exposure time."""

    def harm(folder: Path) -> None:
        (folder / "flat/00").rename(folder / "x")
        (folder / "exposure").mkdir()
        (folder / "x").rename(folder / "exposure" / name)

    return harm


@pytest.mark.parametrize(
    ("harm", "reason"),
    [
        (_remove("dark"), "no dark frames"),
        (_remove("flat"), "no flat frames"),
        (_one_frame, "has one frame"),
        (_another_size, "one size"),
        (_another_format, "one format"),
        (_drift, "auto exposure"),
        (_saturate, "saturated"),
        (_scaled, "not scaled"),
        (_scaled_whole, "right by 6 bits, and write bits = 10"),
        (_turned, "turned by EXIF"),
        (_palette, "the mode P"),
        (_cmyk, "CMYK"),
        (_damage, "not a picture"),
        (_unknown_note, "exposure: unknown key; did you mean 'exposure_s'"),
        (_whole_time, "Write 33.0 for seconds, 0.033 for milliseconds"),
        (_exposed("short"), "exposure time"),
        (_exposed("20"), "Write 20.0 for seconds, 0.02 for milliseconds"),
    ],
)
def test_a_folder_that_will_not_do_is_refused_in_one_sentence(good: Path, harm, reason: str) -> None:
    harm(good)
    with pytest.raises(CaptureError, match=reason) as caught:
        fit_sensor(good)
    assert "\n" not in str(caught.value)


def test_a_folder_without_frames_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="has no frames"):
        fit_sensor(tmp_path)
    with pytest.raises(CaptureError, match="is no folder"):
        fit_sensor(tmp_path / "missing")
