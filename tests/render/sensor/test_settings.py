"""Presets: their numbers, prefixes of one chain, and one sentence for each fault."""

from __future__ import annotations

import re
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from helpers.sensor_light import room

from phibench.datasets.recipe.tables import Preset
from phibench.render.sensor import settings
from phibench.render.sensor.camera_chain import Chain
from phibench.render.sensor.electrons import NoiseStream
from phibench.render.sensor.processing import compressed, eight_bit, linear_rgb, linear_signal, rendered
from phibench.render.sensor.settings import SensorError, sensor

ROOT = Path(__file__).resolve().parents[3]
STREAM = NoiseStream(("presets", 0))
SHAPES = {
    "ideal": ((3, 48, 64), np.float64),
    "mono-raw": ((48, 64), np.uint16),
    "bayer-raw": ((48, 64), np.uint16),
    "srgb8": ((48, 64, 3), np.uint8),
    "yuyv": ((48, 64, 2), np.uint8),
    "mjpeg": ((48, 64, 3), np.uint8),
}


def test_numbers_of_the_presets() -> None:
    assert set(SHAPES) <= {"ideal", *get_args(Preset)}
    s = sensor()
    assert s.name == "mjpeg"
    assert (s.full_well_e, s.read_noise_e, s.prnu, s.dsnu_e, s.dark_e_per_s) == (12000.0, 4.0, 0.01, 1.5, 3.0)
    assert (s.adc_bits, s.black_level_dn, s.top_dn, s.jpeg_quality, s.jpeg_subsampling) == (10, 64.0, 1023, 76, "4:2:2")
    assert (s.exposure_s, s.readout_s, s.gain_max) == (1 / 60, 0.030, 16.0)
    # full well meets full scale at gain 1
    assert s.black_level_dn + s.full_well_e * s.dn_per_e == pytest.approx(1023.0, rel=1e-12)


@pytest.mark.parametrize("name", SHAPES)
def test_every_preset_gives_its_kind_of_frame(name: str) -> None:
    frame = Chain(sensor(name)).frame(room((48, 64)), STREAM)
    assert (frame.shape, frame.dtype) == SHAPES[name]


def test_the_presets_are_steps_of_one_chain() -> None:
    """The stages called one by one on what one preset gives lead to what the next one gives."""
    light, s = room((48, 64)), sensor("bayer-raw")
    raw = Chain(s).frame(light, STREAM)
    srgb = eight_bit(rendered(linear_rgb(linear_signal(raw, s, np.float32), s), s))
    np.testing.assert_array_equal(srgb, Chain(sensor("srgb8")).frame(light, STREAM))
    np.testing.assert_array_equal(compressed(srgb, sensor()), Chain(sensor("mjpeg")).frame(light, STREAM))
    # in float64, as a fit calls them, at most one code differs, where a value lies on a rounding edge
    fine = eight_bit(rendered(linear_rgb(linear_signal(raw, s), s), s)).astype(int)
    assert np.abs(fine - srgb).max() <= 1
    assert (fine != srgb).mean() < 1e-3


def test_a_changed_preset_is_a_new_one() -> None:
    s = sensor("mjpeg")
    assert s.replace(exposure_s=0.01).exposure_s == 0.01
    assert s.exposure_s == 1 / 60
    assert s.replace(exposure_s=0.01) == sensor("mjpeg", exposure_s=0.01)
    assert s.replace(f_number=2.8).replace(speckle_m=2).f_number == 2.8


FAULTS = [
    ({"exposure_s": 0.0}, "exposure_s: 0.0 is not allowed; give a number above 0"),
    ({"exposure_s": -0.1}, "exposure_s: -0.1 is not allowed"),
    ({"exposure_s": float("nan")}, "exposure_s: nan is not allowed"),
    ({"exposure_s": "1/60"}, "exposure_s: '1/60' is not allowed"),
    ({"exposure_ms": 10.0}, "exposure_ms: unknown key; did you mean 'exposure_s'"),
    ({"jpeg_quality": 0}, "jpeg_quality: 0 is not allowed; give an integer from 1 up to 100"),
    ({"jpeg_quality": 101}, "jpeg_quality: 101 is not allowed"),
    ({"jpeg_subsampling": "4:1:1"}, "one of '4:4:4', '4:2:2', '4:2:0'"),
    ({"full_well_e": 500.0}, r"full_well_e = 500 gives 39.96 DN, not above black_level_dn = 64: raise full_well_e"),
    ({"full_well_e": -1.0}, "full_well_e: -1.0 is not allowed"),
    ({"black_level_dn": 1023.0}, "black_level_dn = 1023: must be below 1023"),
    ({"analogue_gain": 17.0}, "analogue_gain: 17.0 is not allowed; give a number from 1 up to 16"),
    ({"colour_matrix": [[1.0, 0.0], [0.0, 1.0]]}, "colour_matrix"),
    ({"white_balance": [1.0, -1.0, 1.0]}, "white_balance"),
    ({"exposure_min_s": 0.5}, "exposure_min_s = 0.5: must not be above exposure_max_s = 0.2"),
    ({"speckle_m": 7.0}, "speckle_m: 7.0 is not allowed"),
    ({"output": "jpeg"}, "output: 'jpeg' is not allowed"),
]


@pytest.mark.parametrize(("change", "complaint"), FAULTS)
def test_a_fault_is_one_sentence(change: dict, complaint: str) -> None:
    with pytest.raises(SensorError, match=complaint) as caught:
        sensor("mjpeg", **change)
    text = str(caught.value)
    assert text.startswith("sensor preset 'mjpeg': ")
    assert "\n" not in text
    with pytest.raises(SensorError, match=complaint):
        sensor("mjpeg").replace(**change)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[webcam]\noutput = \n", " is not valid TOML: Invalid value (at line 2, column 10)"),
        ("[webcam]\n[presets]\n[preset.dark]\n", ": preset: unknown key; did you mean 'presets'?"),
        ("[webcam]\n[presets]\ndark = 3\n", ": presets.dark: 3 is not allowed; give a table"),
        ("[webcam]\n", ": presets: missing; add a table"),
    ],
)
def test_a_broken_file_of_presets_is_named(
    text: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "settings_presets.toml"
    file.write_text(text, encoding="utf-8")
    monkeypatch.setattr(settings, "PRESETS_FILE", file)
    with pytest.raises(ValueError, match=f"^{re.escape(f'{file}{words}')}"):
        sensor()


def test_a_typo_names_the_nearest_preset() -> None:
    with pytest.raises(SensorError, match="no sensor preset 'mjpg'; did you mean 'mjpeg'"):
        sensor("mjpg")


def test_a_preset_is_immutable() -> None:
    with pytest.raises(ValueError, match="frozen"):
        sensor("mjpeg").exposure_s = 1.0  # type: ignore[misc]


@pytest.mark.parametrize("value", [-1.0, np.nan])
def test_a_layer_below_zero_is_refused(value: float) -> None:
    light = room((48, 64))
    light.ambient_electrons_per_s[:, 20, 30] = value * 1e6
    with pytest.raises(SensorError, match="a layer must hold finite numbers from 0 up"):
        Chain(sensor("mjpeg")).frame(light, STREAM)


def test_frames_need_no_mitsuba(python) -> None:
    files = [file for folder in ("optics", "sensor") for file in (ROOT / "render" / folder).glob("*.py")]
    assert len(files) > 10
    modules = [f"{file.parent.name}.{file.stem}" for file in files]
    code = "import importlib, sys\nsys.modules.update(mitsuba=None, drjit=None)\n"
    child = python(code + "for name in sys.argv[1:]: importlib.import_module('phibench.render.' + name)", *modules)
    assert child.returncode == 0, child.stderr
