"""Response of raw frames: straight lines that do not fit, dark levels that jitter, numbers that are assumed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.transfer_frames import BentCamera, write_stack, write_transfer
from PIL import Image

from phibench.calibration.sensor_fit.block_sums import before_rounding, block_sums
from phibench.calibration.sensor_fit.capture_folder import CaptureError
from phibench.calibration.sensor_fit.fit_sensor import fit_sensor
from phibench.calibration.sensor_fit.response_fit import LightLevel, NoiseOfLevel, fit_linearity, fit_response

SHARES = (0.1, 0.25, 0.4, 0.54, 0.7, 0.84)
TWELVE_BITS = BentCamera(0.1, 30.0, 29.4)
EIGHT_BITS = BentCamera(0.02, 15.0, 6.0, bits=8)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("camera", "bend", "power"),
    [(TWELVE_BITS, 0.02, 3.0), (TWELVE_BITS, 0.05, 1.0), (EIGHT_BITS, 0.02, 2.0), (EIGHT_BITS, 0.05, 3.0)],
)
def test_a_bent_response_is_found_and_its_gain_at_black_is_right(
    tmp_path: Path, camera: BentCamera, bend: float, power: float
) -> None:
    """Gain and read noise within 4 of their sigmas (by chance beyond once in 2e3 runs), below 3 % (8 bits: 6 %).

    A straight line is 3 to 13 % off and claims 0.3 %: the bend of 2 (p + 1) + 1 times its share enters the noise.
    """
    camera = BentCamera(**{**vars(camera), "bend": bend, "power": power})
    found = fit_sensor(write_transfer(tmp_path / "c", camera, 1, SHARES)).file
    value, sigma = found.numbers, found.tables.sigma
    assert sigma["gain_dn_per_e"] < 0.06 * value["gain_dn_per_e"]
    assert abs(value["gain_dn_per_e"] - camera.gain_at_black) < 4.0 * sigma["gain_dn_per_e"]
    assert abs(value["read_noise_e"] - camera.read_noise_e) < 4.0 * sigma["read_noise_e"]
    assert "a straight line does not fit" in found.tables.findings["photon_transfer"]
    straight = found.tables.measured["straight_gain_dn_per_e"]
    assert abs(straight.value - camera.gain_at_black) > 5.0 * straight.sigma
    assert len(found.tables.measured["response_coefficients"].value) == 3


@pytest.mark.slow
def test_pulls_of_bent_cameras(tmp_path: Path) -> None:
    """48 cameras of 8 and 12 bits that lose 2 or 5 % at full scale, by powers from 1 to 4: pulls of K and read noise.

    The rms of 48 has the standard error 0.10. The sets hold powers of 1 to 3, and sigma their spread: below 1 is
    expected, above 1.3 three of these. A pull beyond 5 has the chance 3e-5.
    """
    pulls: dict[str, list[float]] = {"gain_dn_per_e": [], "read_noise_e": []}
    for k in range(48):
        rng = np.random.default_rng(k)
        bits, bend, power = (8, 12)[k % 2], (0.02, 0.05)[k // 2 % 2], float(rng.choice([1.0, 1.5, 2.0, 3.0, 4.0]))
        gain = ((1 << bits) - 1) / rng.uniform(8000.0, 30000.0)
        read = max(rng.uniform(4.0, 30.0), 0.35 / gain)
        black = max(rng.uniform(3.0, 20.0) * (1.0 if bits == 8 else 5.0), 5.0 * read * gain)
        camera = BentCamera(gain, read, black, bits, bend, power)
        found = fit_sensor(write_transfer(tmp_path / str(k), camera, k, SHARES)).file
        assert "photon_transfer" in found.tables.findings
        for name, truth in (("gain_dn_per_e", camera.gain_at_black), ("read_noise_e", read)):
            pulls[name].append((found.numbers[name] - truth) / found.tables.sigma[name])
    for name, values in pulls.items():
        rms, largest = float(np.sqrt(np.mean(np.square(values)))), float(np.abs(values).max())
        print(f"{name}: rms {rms:.2f}, largest {largest:.2f}")
        assert rms < 1.3
        assert largest < 5.0


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("camera", [TWELVE_BITS, EIGHT_BITS], ids=["12 bits", "8 bits"])
def test_a_straight_response_has_no_finding(tmp_path: Path, camera: BentCamera, seed: int) -> None:
    """False alarms: a posterior share above 0.95 needs a fall of chi-square by 13, once in 3e3; six cameras."""
    found = fit_sensor(write_transfer(tmp_path / "c", camera, seed, SHARES)).file
    assert not found.tables.findings
    assert abs(found.numbers["gain_dn_per_e"] - camera.gain) < 4.0 * found.tables.sigma["gain_dn_per_e"]
    assert found.tables.sigma["gain_dn_per_e"] < 0.04 * camera.gain


@pytest.mark.slow
def test_a_bend_that_noise_does_not_show_is_in_sigma() -> None:
    """40 responses that lose or win up to 0.3 % by powers 1 to 3, noise of 0.3 % of each variance, in 12 blocks.

    The rms pull of 40 has the standard error 0.11: 1.3 is three above 1. It is 0.8; of the straight line alone 2.3.
    """
    rng, pulls, bare = np.random.default_rng(5), [], []
    gain, dark, full, shares = 0.1, 9.0, 4095.0, np.array(SHARES)
    for _ in range(40):
        bend, power = rng.uniform(-0.003, 0.003), rng.integers(1, 4)
        signal, slope = full * shares, 1.0 + (power + 1) * bend * shares**power
        variance = (gain * signal * (1.0 + bend * shares**power) + dark) / slope**2
        blocks = variance[:, None] * (1.0 + 0.003 * np.sqrt(12.0) * rng.standard_normal((6, 12)))
        left_out = (blocks.sum(axis=1, keepdims=True) - blocks) / 11.0
        seen = np.concatenate([blocks.mean(axis=1, keepdims=True), left_out], axis=1) + 1.0 / 12.0
        levels = [
            NoiseOfLevel(str(k), np.full(13, signal[k]), seen[k], signal[k] + 100.0, 20.0, 2.0 / 0.003**2)
            for k in range(6)
        ]
        found = fit_response(levels, np.full(13, dark), full)
        pulls.append((found.gain[0] - gain) / found.sigma)
        bare.append((found.straight_gain - gain) / found.straight_sigma)
    print(f"rms pull {np.sqrt(np.mean(np.square(pulls))):.2f}, straight alone {np.sqrt(np.mean(np.square(bare))):.2f}")
    assert np.sqrt(np.mean(np.square(pulls))) < 1.3
    assert np.sqrt(np.mean(np.square(bare))) > 1.5


def test_one_level_says_that_it_cannot_tell(tmp_path: Path) -> None:
    found = fit_sensor(write_transfer(tmp_path / "c", TWELVE_BITS, 1, (0.5,), frames=4)).file
    assert "one level does not show" in found.tables.findings["photon_transfer"]
    # 3 % at full range move K by 3 a_1 u at u = 0.5, less what the dark frames' noise holds
    assert 0.03 < found.tables.sigma["gain_dn_per_e"] / found.numbers["gain_dn_per_e"] < 0.06


@pytest.mark.parametrize("bend", [0.0, 0.05])
def test_one_level_of_a_bent_camera_is_within_its_sigma(tmp_path: Path, bend: float) -> None:
    """Its gain was 22 sigma off without a bend in sigma; so was the PRNU by 10."""
    camera = BentCamera(0.1, 30.0, 29.4, bend=bend)
    found = fit_sensor(write_transfer(tmp_path / "c", camera, 3, (0.73,), frames=4)).file
    for name, true in (("gain_dn_per_e", camera.gain_at_black), ("prnu", camera.prnu)):
        assert abs(found.numbers[name] - true) < 4.0 * found.tables.sigma[name]


# -- dark levels -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("black", "jitter_dn"), [(2.9, 0.05), (2.9, 0.1), (8.3, 0.15)])
def test_a_dark_level_that_jitters_is_frame_noise(tmp_path: Path, black: float, jitter_dn: float) -> None:
    """Jitter of 24 levels together: 16 frames tell it to 18 %; four of these. Black within 4 sigmas, jitter included.

    8.3 +- 0.15 and 2.9 +- 0.1 were refused as "auto exposure": 2 % of them are less than their jitter.
    """
    camera = BentCamera(0.02, 15.0, black, bits=8, jitter_dn=jitter_dn)
    found = fit_sensor(write_transfer(tmp_path / "c", camera, 2, SHARES)).file
    value, sigma = found.numbers, found.tables.sigma
    assert abs(value["black_level_dn"] - black) < 4.0 * sigma["black_level_dn"]
    assert sigma["black_level_dn"] > 0.5 * jitter_dn / 4.0
    assert abs(value["gain_dn_per_e"] - 0.02) < 4.0 * sigma["gain_dn_per_e"]
    assert abs(value["read_noise_e"] - 15.0) < 4.0 * sigma["read_noise_e"] + 0.15  # jitter across codes, 2nd order
    assert found.tables.measured["frame_noise_e"].value * 0.02 == pytest.approx(jitter_dn, rel=0.72)
    assert not found.tables.findings


@pytest.mark.slow
@pytest.mark.parametrize(("black", "is_cut"), [(-0.4, True), (0.0, True), (0.4, True), (2.0, False), (6.0, False)])
def test_dark_frames_that_are_cut_are_said_to_be(tmp_path: Path, black: float, is_cut: bool) -> None:
    """Noise of 0.5 DN: 42, 16, 4 and 0.0 % of the values lie below -0.5 DN."""
    camera = BentCamera(0.02, 25.0, black, bits=8)
    tables = fit_sensor(write_transfer(tmp_path / "c", camera, 2, SHARES, frames=4)).file.tables
    assert ("cut at code 0" in tables.findings.get("dark", "")) == is_cut
    assert ("read_noise_e" in tables.not_determined) == is_cut


@pytest.mark.slow
@pytest.mark.parametrize(("shares", "bend"), [(SHARES, 0.0), ((0.2, 0.6), 0.0), (SHARES, 0.05)])
def test_cut_dark_frames_do_not_spoil_the_gain(tmp_path: Path, shares: tuple[float, ...], bend: float) -> None:
    """Their variance is too small: taken for the line's first point it made K 25 % too large, 7 sigma.

    Where levels bend as well, the intercept of a line through them is no better: sigma holds what both choices are
    apart.
    """
    camera = BentCamera(0.1, 30.0, 0.0, bend=bend)
    found = fit_sensor(write_transfer(tmp_path / "c", camera, 4, shares)).file
    value, sigma = found.numbers, found.tables.sigma
    assert abs(value["gain_dn_per_e"] - 0.1) < 4.0 * sigma["gain_dn_per_e"]
    assert abs(value["black_level_dn"]) < 2.0 * sigma["black_level_dn"]
    assert "cut at code 0" in found.tables.findings["dark"]
    if bend:
        assert "levels bend" in found.tables.not_determined["prnu"]
    else:
        assert sigma["gain_dn_per_e"] < 0.002


@pytest.mark.slow
@pytest.mark.parametrize("black", [3.0, 3.3, 3.45])
def test_a_black_level_between_two_codes_has_their_distance_for_sigma(tmp_path: Path, black: float) -> None:
    """Noise of 0.06 DN: all values are one code, or two whose shares tell no width. Sigma was 0, and 0.018."""
    camera = BentCamera(0.02, 3.0, black, bits=8)
    found = fit_sensor(write_transfer(tmp_path / "c", camera, 5, SHARES)).file
    assert found.tables.sigma["black_level_dn"] == pytest.approx(12.0**-0.5, rel=0.05)
    assert abs(found.numbers["black_level_dn"] - black) < 0.5
    assert abs(found.numbers["gain_dn_per_e"] - 0.02) < 4.0 * found.tables.sigma["gain_dn_per_e"]
    assert "rounding hides it" in found.tables.not_determined["read_noise_e"]


def test_levels_of_less_noise_than_a_code_do_not_bend_the_line(tmp_path: Path) -> None:
    """Noise of 0.2 to 0.65 codes: rounding depends on where in a code a level lies. Within 4 sigma, below 4 % each.

    The gain was twice the camera's, at 7 of its sigmas, and a bend of 40 % was found. A pattern of 0.1 codes is not
    seen in the darkest levels: 0.5 % came out as 0.43 %, at 22 sigmas.
    """
    camera = BentCamera(0.002, 15.0, 2.9, bits=8)
    shares = tuple(0.002 * e / 252.1 for e in (10e3, 25e3, 45e3, 65e3, 85e3, 105e3))
    found = fit_sensor(write_transfer(tmp_path / "c", camera, 5, shares, kind="bayer-raw")).file
    value, sigma = found.numbers, found.tables.sigma
    assert sigma["gain_dn_per_e"] < 0.04 * camera.gain
    for name, truth in (("gain_dn_per_e", camera.gain), ("prnu", camera.prnu)):
        assert abs(value[name] - truth) < 4.0 * sigma[name]


def test_hot_pixels_are_not_called_cut(tmp_path: Path) -> None:
    """Their spread is no Gaussian's: 1 % of hot pixels made 15 % of all values lie below code 0."""
    tables = fit_sensor(write_transfer(tmp_path / "c", BentCamera(0.1, 30.0, 29.4, hot=160), 6, SHARES)).file.tables
    assert "dark" not in tables.findings
    assert "read_noise_e" in tables.sigma


@pytest.mark.parametrize("power", [0.5, 1.0 / 2.2])
def test_codes_of_a_curve_are_told_from_saturated_ones(tmp_path: Path, power: float) -> None:
    """A square root makes the noise equal everywhere; gamma 2.2 makes it fall."""
    folder = write_transfer(tmp_path / "c", TWELVE_BITS, 1, SHARES, frames=4)
    for path in folder.rglob("*.png"):
        codes = np.asarray(Image.open(path)) / TWELVE_BITS.top
        Image.fromarray(np.rint(255.0 * codes**power).astype(np.uint8)).save(path)
    (folder / "capture.toml").write_text('format = "mono-raw"\nbits = 8\n')
    with pytest.raises(CaptureError, match=r"does not grow with its level.*without a curve"):
        fit_sensor(folder)


def test_a_pgm_of_twelve_bits_has_its_own_codes(tmp_path: Path) -> None:
    """Pillow stretches them to 16 bits."""
    folder = write_transfer(tmp_path / "c", TWELVE_BITS, 1, SHARES, frames=2)
    expected = fit_sensor(folder).file.numbers
    for path in folder.rglob("*.png"):
        codes = np.asarray(Image.open(path))
        head = f"P5\n{codes.shape[1]} {codes.shape[0]}\n{TWELVE_BITS.top}\n".encode()
        path.with_suffix(".pgm").write_bytes(head + codes.astype(">u2").tobytes())
        path.unlink()
    assert fit_sensor(folder).file.numbers == expected


def test_dark_frames_that_drift_are_not_called_auto_exposure(tmp_path: Path) -> None:
    folder = write_transfer(tmp_path / "c", TWELVE_BITS, 1, (0.5,), frames=2)
    write_stack(tmp_path / "more", BentCamera(0.1, 30.0, 60.0).frames(0.0, 1, np.random.default_rng(1)))
    (tmp_path / "more/000.png").rename(folder / "dark/999.png")
    with pytest.raises(CaptureError, match=r"0\.25 % of full scale are allowed; cap the lens") as caught:
        fit_sensor(folder)
    assert "auto exposure" not in str(caught.value)


def test_dark_noise_before_rounding_needs_no_pattern() -> None:
    """0.35 DN without DSNU: 4e5 values tell the variance to 0.3 %; five of these.

    Sampling takes the pattern below 0 in some of them.
    """
    for seed in range(4):
        rng = np.random.default_rng(seed)
        frames = np.rint(7.86 + 0.35 * rng.standard_normal((16, 160, 160)))
        _, temporal, _ = before_rounding(block_sums(frames, 255).jackknife())[0]
        assert temporal == pytest.approx(0.35**2, rel=0.015)


def test_a_level_near_black_hides_no_other(tmp_path: Path) -> None:
    """Its noise over its signal is anything; taken for the usual one it made every level a full well."""
    found = fit_sensor(write_transfer(tmp_path / "c", EIGHT_BITS, 1, (1e-5, *SHARES), frames=4))
    assert sum(point.used for point in found.transfer.points) >= len(SHARES)
    assert "full_well_e" in found.file.tables.assumed


# -- full well -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shares", [SHARES, (*SHARES, 1.3)], ids=["none saturated", "saturated"])
def test_a_number_is_found_or_assumed_or_not_determined(tmp_path: Path, shares: tuple[float, ...]) -> None:
    tables = (found := fit_sensor(write_transfer(tmp_path / "c", TWELVE_BITS, 1, shares, frames=4)).file).tables
    assert "full_well_e" in found.numbers
    assert "full_well_e" in tables.assumed
    assert not set(found.numbers) & set(tables.not_determined)
    assert not set(tables.sigma) & set(tables.assumed)


# -- linearity -------------------------------------------------------------------------------------------------------


def test_linearity_is_the_deviation_from_a_line_with_an_offset() -> None:
    """y = 3 + 100 t (1 - 0.02 (t / 10)) against a line of weights 1 / y^2 by the normal equations."""
    times = np.arange(1.0, 10.5, 1.0)
    bent = 3.0 + 100.0 * times * (1.0 - 0.02 * times / 10.0)
    straight = [LightLevel(t, 3.0 + 100.0 * t, 0.01) for t in times]
    assert (line := fit_linearity(straight, "seconds")) is not None
    assert line.most_percent < 1e-9
    assert line.finding() is None
    found = fit_linearity([LightLevel(t, y, 0.01) for t, y in zip(times, bent, strict=True)], "seconds")
    assert found is not None
    used = bent <= 0.95 * bent.max()
    a = np.stack([1.0 / bent[used], times[used] / bent[used]], axis=1)
    normal = np.linalg.inv(a.T @ a) @ a.T @ np.ones(used.sum())
    by_hand = 100.0 * (bent[used] / (normal[0] + normal[1] * times[used]) - 1.0)
    assert found.most_percent == pytest.approx(np.abs(by_hand).max(), rel=1e-9)
    assert "leaves a straight line" in (found.finding() or "")
    assert fit_linearity(straight[:4], "seconds") is None


def test_exposures_of_raw_frames_tell_linearity(tmp_path: Path) -> None:
    camera = BentCamera(0.1, 30.0, 29.4, bend=0.05, power=2.0)
    folder = write_transfer(tmp_path / "c", camera, 1, SHARES, frames=4)
    rng = np.random.default_rng(3)
    for share in (0.1, 0.2, 0.35, 0.5, 0.65, 0.8):
        write_stack(folder / f"exposure/{0.02 * share:.4f}", camera.frames(camera.electrons(share), 2, rng))
    tables = fit_sensor(folder).file.tables
    assert "signal against seconds leaves a straight line" in tables.findings["linearity"]
    assert tables.measured["linearity_error"].value > 0.3
