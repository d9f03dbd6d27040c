"""Descriptor files of EMVA 1288 as input: the same numbers as from a folder; lines that will not do."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.transfer_frames import BentCamera, write_stack

from phibench.calibration.sensor_fit.capture_folder import CaptureError
from phibench.calibration.sensor_fit.emva_descriptor import open_descriptor
from phibench.calibration.sensor_fit.fit_sensor import fit_sensor
from phibench.cli.main import main

CAMERA = BentCamera(0.1, 30.0, 29.4, bend=0.02)
QUANTUM_EFFICIENCY = 0.5
SHARES = np.linspace(0.06, 0.9, 12)


def write_descriptor(folder: Path, ending: str = "\n", slash: str = "/", size: str = "12 128 128") -> Path:
    """Twelve pairs, one dark pair and a dark stack; the bright stack states a light that it does not have."""
    rng = np.random.default_rng(4)
    lines = ["# Müller, 1288", "v 3.0", f"n {size}"]

    def level(head: str, place: str, electrons: float, count: int) -> None:
        names = write_stack(folder / "images" / place, CAMERA.frames(electrons, count, rng))
        lines.extend([head, *(f"i images{slash}{place}{slash}{name}" for name in names)])

    for k, share in enumerate(SHARES):
        electrons = CAMERA.electrons(share)
        level(f"b 1000000 {electrons / QUANTUM_EFFICIENCY:.1f}".replace(".", ","), f"b{k}", electrons, 2)
    level("b 1000000 1000.0", "stack", CAMERA.electrons(0.5), 8)
    level("d 1000000", "d0", 0.0, 2)
    level("d 1000000   # the larger one", "d1", 0.0, 16)
    path = folder / "EMVA1288_Data.txt"
    path.write_bytes(ending.join([*lines, ""]).encode("latin-1"))
    return path


@pytest.fixture(scope="module")
def descriptor(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_descriptor(tmp_path_factory.mktemp("emva"), "\r\n", "\\")


def test_its_numbers_are_those_of_the_camera(descriptor: Path) -> None:
    """Within 4 sigmas: by chance beyond once in 1.6e4 each. The signal bends by 2 % (y / 4095)^3 and is said to."""
    found = fit_sensor(descriptor).file
    value, sigma, tables = found.numbers, found.tables.sigma, found.tables
    assert abs(value["gain_dn_per_e"] - CAMERA.gain) < 4.0 * sigma["gain_dn_per_e"]
    assert abs(value["read_noise_e"] - CAMERA.read_noise_e) < 4.0 * sigma["read_noise_e"]
    assert abs(value["black_level_dn"] - CAMERA.black) < 4.0 * sigma["black_level_dn"]
    assert (found.preset, value["adc_bits"]) == ("mono-raw", 12)
    assert set(tables.findings) == {"photon_transfer", "linearity"}
    assert 0.2 < tables.measured["linearity_error"].value < 1.0  # the stack's wrong light would make it 10 %


@pytest.mark.slow
def test_more_electrons_than_photons_are_said(descriptor: Path) -> None:
    """Means of four frames, given as single ones, have four times the electrons: photons are stated so here."""
    text = descriptor.read_text("latin-1").replace(",", ".")
    lines = [line.split() for line in text.splitlines()]
    fewer = [[*x[:2], f"{float(x[2]) / 4.0}"] if x[:1] == ["b"] else x for x in lines]
    averaged = descriptor.with_name("averaged.txt")
    averaged.write_text("\n".join(" ".join(x).replace("\\", "/") for x in fewer), encoding="latin-1")
    said, right = fit_sensor(averaged).file.tables, fit_sensor(descriptor).file.tables.measured["quantum_efficiency"]
    assert "electrons a photon" in said.findings["quantum_efficiency"]
    assert said.measured["quantum_efficiency"].value == pytest.approx(4.0 * right.value, rel=1e-6)
    assert abs(right.value - QUANTUM_EFFICIENCY) < 0.05 * QUANTUM_EFFICIENCY  # the response bends by 2 %


def test_its_levels_are_read_as_they_stand(descriptor: Path) -> None:
    capture = open_descriptor(descriptor)
    assert len(capture.flats) == len(SHARES) + 1
    assert capture.dark is not None
    assert len(capture.dark.files) == 16
    assert capture.notes.exposure_s == pytest.approx(1e-3)
    assert capture.flats[0].photons == pytest.approx(CAMERA.electrons(SHARES[0]) / QUANTUM_EFFICIENCY, abs=0.05)
    assert capture.flats[-1].photons is None
    assert capture.dark_exposures == ()


def test_the_command_takes_it(descriptor: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sensor", "fit", str(descriptor), "--out", str(tmp_path / "s.toml")]) == 0
    said = capsys.readouterr().out
    assert "finding, photon_transfer: a straight line does not fit" in said
    assert "full_well_e: assumed: no level of flat/ is saturated" in said


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "0 lines `n`"),
        ("n 12 32 32\nx 3\n", "line 2: 'x 3' is no line of a descriptor"),
        ("n 12 32 32\nb 100\n", "line 2: 'b 100' is no line"),
        ("n 12 32 32\nb 1 -3\ni a.png\ni b.png\n", "line 2: '-3' is no number"),
        ("n 12 32 32\ni a.png\n", "before the first level"),
        ("n 12 32 32\nd 1\ni a.png\n", "a level with 1 pictures"),
        ("n 12 32 32\nd 1\ni ../a.png\ni b.png\n", "relative and below"),
        ("n 12 32 32\nd 1\ni C:\\a.png\ni b.png\n", "relative and below"),
        ("n 12 32 32\nd 1\ni /etc/a.png\ni b.png\n", "relative and below"),
        ("n 12 32 32\nd 1\ni a.png\ni b.png\n", "0 bright and 1 dark levels"),
        ("n 12.5 32 32\n", "no whole number"),
        ("n 64 32 32\nd 1\ni a.png\ni b.png\nb 1 1\ni a.png\ni b.png\n", "bits"),
        ("n 12 32 32\nd 1\ni a.png\ni b.png\nb 1 1\ni a.png\ni b.png\n", "a.png"),
    ],
)
def test_a_descriptor_that_will_not_do_is_refused_in_one_sentence(tmp_path: Path, text: str, reason: str) -> None:
    path = tmp_path / "d.txt"
    path.write_text(text)
    with pytest.raises(CaptureError) as caught:
        fit_sensor(path)
    assert reason in str(caught.value)
    assert "\n" not in str(caught.value)


def test_another_size_than_stated_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="128 x 128"):
        fit_sensor(write_descriptor(tmp_path, size="12 656 494"))
