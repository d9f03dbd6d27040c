"""Rig files: a recipe's tables, defaults, and one sentence for each wrong value."""

from __future__ import annotations

import math
import tomllib
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT

from phibench.calibration.captures.measurement_doubts import other_size_note
from phibench.calibration.captures.rig_file import read_rig_file, unusual_numbers
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.frames.sensor_card import sensor_card
from phibench.datasets.recipe.recipe_scene import build_rig
from phibench.datasets.recipe.tables import RigTable
from phibench.scenes.laser import Beam
from phibench.scenes.rig import Rig


def written(folder: Path, text: str) -> Path:
    path = folder / "rig.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_an_empty_file_is_the_default_rig(tmp_path: Path) -> None:
    assert read_rig_file(written(tmp_path, "")).rig == Rig()


def test_tables_of_a_recipe_mean_the_same(tmp_path: Path) -> None:
    keys = {"z_c_m": 0.27, "radius_m": 0.05, "fx_px": 1500.0, "k1": 0.01, "stroke_tilt_x_rad": 0.002}
    text = "\n".join(("[rig]", *(f"{key} = {value}" for key, value in keys.items())))
    text += '\n[rig.holder]\nkind = "rods"\n[laser]\ndiameter_base_m = 2e-3\n'
    read = read_rig_file(written(tmp_path, text))
    assert read.rig == build_rig(RigTable(**keys, holder={"kind": "rods"}))
    assert read.beam == Beam(2e-3, 1e-3)


def test_the_field_of_view_gives_the_focal_length(tmp_path: Path) -> None:
    rig = read_rig_file(written(tmp_path, "[rig]\nwidth_px = 640\nheight_px = 480\nfov_deg = 53.13010235415598\n")).rig
    # half the width over the tangent of half the angle, 320 / 0.5
    assert rig.camera.fx_px == rig.camera.fy_px == pytest.approx(640.0, rel=1e-12)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[rig]\nradius_m = -0.06", "rig.radius_m: -0.06 is not allowed; give a number above 0 up to 1"),
        ("[rig]\nradus_m = 0.06", "did you mean 'radius_m'"),
        ("[rig]\nfx = 1432.5", "did you mean 'fx_px'"),
        ("[rig]\nfy = 1432.5", "did you mean 'fy_px'"),
        ("[rig]\nradius = 0.06", "did you mean 'radius_m'"),
        ("[rig]\nradius_mm = 60", "write radius_m, in metres"),
        ("[rig]\nfocal_px = 1430", "did you mean 'fx_px'"),
        ("[rig]\ndistance_mm = 260", "did you mean 'z_c_m'"),
        ("[rig]\npixel_size_um = 3", "did you mean 'pixel_pitch_um'"),
        ("[rig]\nblur = 0.9", "did you mean 'blur_sigma_px'"),
        ("[rig]\nradius_m = 0.4", "inside the sphere"),
        ("[rig]\nfx_px = 'wide'", "rig.fx_px"),
        ("[rig]\nfov_deg = 400", "rig.fov_deg: 400 is not allowed; give a number from 5 up to 150"),
        ("[rig]\nfov_deg = 48\nfx_px = 1430", "given twice"),
        ("[rig]\nwidth_px = 640\nheight_px = 480", "rig.fx_px: missing"),
        ("[rig]\nk1 = nan", "rig.k1"),
        ("[rig]\nk1 = -5.0", "folds"),
        ("[camera]\nfx_px = 1430", "camera: unknown key"),
        ("[rig.holder]\nkind = 'string'", "rig.holder.kind"),
        ("rig = 3", "rig"),
        ("[[rig]]\nradius_m = 0.06", "write [rig] with one bracket"),
        ("[rig]\nkind = 'rods'", "kind belongs to the table [rig.holder]"),
        ("[rig]\nholder_kind = 'rods'", "kind belongs to the table [rig.holder]"),
        ("[rig]\ndiameter_base_m = 3e-3", "diameter_base_m belongs to the table [laser]"),
        ("[rig", "TOML"),
    ],
)
def test_each_wrong_value_is_one_sentence(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(DatasetError) as caught:
        read_rig_file(written(tmp_path, text))
    message = str(caught.value)
    assert words in message
    assert message.startswith(str(tmp_path / "rig.toml"))
    assert "\n" not in message


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("radius_m = 60", "60 is unusual, 0.002 to 0.5 metres are usual; write 0.06 if it is 60 mm"),
        ("radius_m = 6", "0.06 if it is 6 cm"),
        ("z_c_m = 26.2", "0.262 if it is 26.2 cm"),
        ("pixel_pitch_um = 0.0028", "write 2.8 if it is 0.0028 mm"),
        ("pixel_pitch_um = 2.8e-6", "write 2.8 if it is 2.8e-06 m"),
        ("stroke_tilt_x_rad = 0.5", "write 0.00872665 if it is 0.5 degrees"),
        ("tilt_y_rad = -2", "write -0.0349066 if it is -2 degrees"),
        ("fx_px = 4.0", "write 1428.57 if it is 4 mm, at pixels of 2.8 um"),
        ("fx_px = 0.004\npixel_pitch_um = 4.0", "write 1000 if it is 0.004 m, at pixels of 4 um"),
        ("fov_deg = 0.84", "write 48.1285 if it is 0.84 radians"),
        ("decentre_x_m = 1.5", "write 0.0015 if it is 1.5 mm"),
        ("focus_distance_m = 232", "write 0.232 if it is 232 mm"),
        ("radius_m = '60'", "'60' is a text: a number has no quotes"),
        ("radius_m = '0,06 m'", "no unit and a decimal point"),
        ("[laser]\ndiameter_m = 3", "write 0.003 if it is 3 mm"),
        ("[rig.holder]\nkind = 'rods'\nradius_m = 4", "write 0.004 if it is 4 mm"),
    ],
)
def test_numbers_of_another_unit_are_named(tmp_path: Path, line: str, words: str) -> None:
    with pytest.raises(DatasetError) as caught:
        read_rig_file(written(tmp_path, f"[rig]\n{line}\n"))
    assert words in str(caught.value)


def test_numbers_of_the_recipes_are_usual() -> None:
    files = [path for folder in ("datasets/recipes", "tests", "docs") for path in (ROOT / folder).glob("*.toml")]
    tables = [tomllib.loads(path.read_text(encoding="utf-8")) for path in files]
    rigs = [raw for raw in tables if "rig" in raw]
    assert len(rigs) >= 20
    assert not any(unusual_numbers(raw) for raw in rigs)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ("radius_m = 0.12", "radius_m = 0.12 is the diameter, it seems: write 0.06"),
        ("radius_m = 0.03", "radius_m = 0.03 is half the radius, it seems: write 0.06"),
        ("fx_px = 100.0", "correct the number that is wrong"),
        ("radius_m = 0.065", ""),
    ],
)
def test_a_circle_of_another_size_contradicts_the_rig_file(tmp_path: Path, keys: str, words: str) -> None:
    rng, (v, u) = np.random.default_rng(1), np.mgrid[:360, :640]
    size = "width_px = 640\nheight_px = 360\npixel_pitch_um = 5.6\nz_c_m = 0.26\n"
    focal = "" if "fx_px" in keys else "fx_px = 715.0\n"
    rig = read_rig_file(written(tmp_path, f"[rig]\n{size}{focal}{keys}\n")).rig
    # f R / sqrt(z^2 - R^2) of 60 mm at 0.26 m, before a bright wall
    ball = np.hypot(u - 319.5, v - 179.5) < 715.0 * 0.06 / math.sqrt(0.26**2 - 0.06**2)
    picture = np.clip(np.where(ball, 60.0, 150.0) + rng.normal(0.0, 2.0, ball.shape), 0, 255).astype(np.uint8)
    said = other_size_note(rig, np.repeat(picture[..., None], 3, axis=-1), sensor_card("srgb8"))
    assert words in said
    assert bool(said) == bool(words)
    if words:
        assert "radius 170 px about (320, 1" in said
