"""Rig files: a recipe's tables, defaults, and one sentence for each wrong value."""

from __future__ import annotations

from pathlib import Path

import pytest

from phibench.calibration.captures.rig_file import read_rig_file
from phibench.datasets.common.errors import DatasetError
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
