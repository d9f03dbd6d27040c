"""Sensor files: what is written is read again, frames and scores take the numbers, and what is no sensor is refused."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest

from phibench.cli.main import main
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.exposures.pair_draws import pair_draws
from phibench.datasets.frames.sensor_card import sensor_card
from phibench.datasets.frames.sensor_file import (
    FitTables,
    MeasuredQuantity,
    SensorFile,
    allowed_numbers,
    read_sensor_file,
    write_sensor_file,
)
from phibench.datasets.read import open_dataset

CAMERA = SensorFile(
    "bayer-raw",
    {"gain_dn_per_e": 0.09, "read_noise_e": 3.25, "white_balance": [1.5, 1.0, 1.75]},
    FitTables(
        sigma={"gain_dn_per_e": 1e-4},
        not_determined={"dark_e_per_s": 'no "dark-exposure/SECONDS"'},
        measured={"edge_sigma_px": MeasuredQuantity(value=0.7, sigma=0.01, unit="px")},
        source={"frames": 12, "folder": "capture"},
    ),
)


def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    assert read_sensor_file(write_sensor_file(tmp_path / "s.toml", CAMERA)) == CAMERA
    found = CAMERA.sensor(exposure_s=0.01)
    assert (found.output, found.read_noise_e, found.white_balance) == ("raw", 3.25, (1.5, 1.0, 1.75))
    assert CAMERA.sensor("mjpeg").output == "mjpeg"


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ('preset = "bayer"', "no sensor preset 'bayer'"),
        ("read_noise_e = -1.0", "read_noise_e"),
        ("read_nose_e = 1.0", "did you mean 'read_noise_e'"),
        ("exposure_s = 0.1", "belongs to a frame"),
        ("preset = 3", "no text"),
        ("[rig]\nfx_px = 1430.0", "is a rig file: give it with --rig"),
        ('format = "bayer-raw"\nbits = 12', "describes frames, not a sensor"),
        ("[sensor]\nadc_bits = 12", "without that line"),
        ("gain = 0.1", "did you mean 'gain_dn_per_e'"),
        ("[sigma]\nread_noise_e = 'much'", "sigma.read_noise_e"),
        ("[sigma]\nread_noise_e = 1979-05-27", "sigma.read_noise_e"),
        ("preset = ", "TOML"),
    ],
)
def test_what_is_no_sensor_is_refused_in_one_sentence(tmp_path: Path, text: str, reason: str) -> None:
    path = tmp_path / "s.toml"
    path.write_text(text)
    with pytest.raises(DatasetError, match=reason) as caught:
        read_sensor_file(path)
    assert "\n" not in str(caught.value)


def test_numbers_out_of_range_are_told_apart() -> None:
    kept, refused = allowed_numbers("bayer-raw", {"read_noise_e": 3.0, "prnu": 0.5, "sharpen_amount": -0.1})
    assert kept == {"read_noise_e": 3.0}
    assert set(refused) == {"prnu", "sharpen_amount"}


def test_frames_and_scores_take_the_numbers(smallest_dataset: Path, tmp_path: Path) -> None:
    draws = pair_draws(open_dataset(smallest_dataset), sensor=CAMERA)
    assert {draw.preset for draw in draws} == {"bayer-raw"}
    assert {draw.request.sensor().read_noise_e for draw in draws} == {3.25}
    camera = write_sensor_file(tmp_path / "s.toml", CAMERA)
    out = tmp_path / "frames"
    given = ["dataset", "frames", str(smallest_dataset), "--out", str(out), "--workers", "1", "--region", "32"]
    assert main([*given, "--sensor", str(camera)]) == 0
    assert '"read_noise_e":3.25' in (out / "request.json").read_text().replace(" ", "")
    assert list(out.glob("**/*.png"))


def test_a_full_pixel_is_told_though_no_frame_has_shown_the_well() -> None:
    card = sensor_card("bayer-raw")
    # frames of a flat that is nowhere full say only that the well lies above them: one that is taken too deep
    unseen = replace(card, full_well_e=1.05 * card.full_well_e)
    full_dn = round(card.black_level_dn + card.dn_per_e * card.full_well_e)
    assert full_dn == card.top_dn
    # read noise and fixed pattern of 4.3 electrons: a full pixel reads up to two codes less
    low_dn = full_dn - math.floor(5.0 * math.hypot(card.read_noise_e, card.dsnu_e) * card.dn_per_e)
    for one in (card, unseen):
        assert (low_dn - one.black_level_dn) / one.dn_per_e > one.full_from_e
        assert (full_dn - 4 - one.black_level_dn) / one.dn_per_e < one.full_from_e
