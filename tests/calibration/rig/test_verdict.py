"""Verdict on a calibration, and its picture."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.limb_frames import limb_light
from PIL import Image

from phibench.calibration.outline.limb_image import planes_of
from phibench.calibration.outline.outline import find_outline
from phibench.calibration.outline.outline_least_squares import band, step_from
from phibench.calibration.outline.outline_result import SECTORS, Outline, PoseMeasurement
from phibench.calibration.rig.bundle import Bundle, calibrate
from phibench.calibration.rig.from_dataset import BAD, DOUBTFUL, GOOD, verdict_of
from phibench.calibration.rig.outline_picture import write_overlay
from phibench.estimator.geometry.rig_parameters import PARAMETERS, prior_sigmas
from phibench.estimator.spots.image_planes import ImageError
from phibench.scenes.frames import Pose
from phibench.scenes.rig import Rig

RIG = Rig()
SHIFTS = 0.1 * np.cos(np.arange(SECTORS))
OUTLINE = Outline(np.array([0.0, 0.0, 0.26]), 1e-12 * np.eye(3), 1.0, 1.0, 0.7, 0.01, 1000, 5, SHIFTS)


def room(points: np.ndarray, directions: np.ndarray) -> np.ndarray:
    return 1.0 + 0.1 * directions[:, 0]


@pytest.fixture(scope="module")
def light() -> np.ndarray:
    rig = replace(RIG, T_camera_sphere=Pose("camera", "sphere", (2e-4, 0.0, 0.26)))
    return limb_light(rig, np.random.default_rng(3), room=room)


@pytest.fixture(scope="module")
def bundle() -> Bundle:
    return calibrate(RIG, PoseMeasurement(np.array([2e-4, 0.0, 0.2605]), np.diag([4e-6, 4e-6, 2e-5]) ** 2))


def test_a_good_calibration_names_what_only_the_prior_knows(bundle: Bundle) -> None:
    found = verdict_of(bundle, prior_sigmas(), [OUTLINE])
    assert (found.mark, found.reasons) == (GOOD, ())
    assert {"stroke_offset_m", "stroke_relative"} <= set(found.only_prior)
    assert not {"tilt_x_rad", "axial_m"} & set(found.only_prior)
    assert str(found).startswith("calibration good: chi2 ")
    assert "0.071 px rms over 100 %" in str(found)


@pytest.mark.parametrize(
    ("change", "mark", "reason"),
    [
        ({"chi2": 13.0}, DOUBTFUL, "chi2"),  # 3 degrees of freedom: p = 0.005
        ({"chi2": 30.0}, BAD, "chi2"),
        ({"axial_m": 3.5}, DOUBTFUL, "axial_m is corrected by 3.5"),
        ({"tilt_x_rad": -6.0}, BAD, "tilt_x_rad is corrected by 6.0"),
        ({"arc": 0.7}, DOUBTFUL, "70 %"),
        ({"shifts_px": 6.0 * SHIFTS}, DOUBTFUL, "off by 0.4"),
    ],
)
def test_what_makes_it_doubtful_or_bad(bundle: Bundle, change: dict, mark: str, reason: str) -> None:
    assert bundle.degrees == 3
    outline = replace(OUTLINE, **{k: v for k, v in change.items() if k in ("arc", "shifts_px")})
    values = bundle.values.copy()
    for name in set(change) & set(PARAMETERS):
        values[PARAMETERS.index(name)] = change[name] * prior_sigmas()[PARAMETERS.index(name)]
    changed = replace(bundle, values=values, chi2=change.get("chi2", bundle.chi2))
    found = verdict_of(changed, prior_sigmas(), [OUTLINE, outline])
    assert found.mark == mark
    assert reason in found.reasons[0]
    assert reason in str(found)


def test_the_worst_comes_first(bundle: Bundle) -> None:
    found = verdict_of(replace(bundle, chi2=30.0), prior_sigmas(), [replace(OUTLINE, arc=0.7)])
    assert found.mark == BAD
    assert [reason.split()[0] for reason in found.reasons] == ["chi2", "only"]


@pytest.mark.slow
def test_shifts_say_where_the_limb_is(light: np.ndarray) -> None:
    """A model 30 um too far right, 0.165 px: the limb lies further in on the right and further out on the left."""
    found = find_outline(light, RIG)
    assert found.shift_rms_px < 0.01
    off = found.sphere_in_camera_m + [3e-5, 0.0, 0.0]
    planes = planes_of(light)
    pixels = band(planes, RIG.camera, found.sphere_in_camera_m, RIG.mirror.radius_m, 5.0)
    step = step_from(pixels, planes, RIG, off, found.blur_px**2, SECTORS, 5.0)
    still = replace(step.solution, J=np.zeros_like(step.solution.J))  # the step itself would take the shift away
    shifts = still.sector_shifts(pixels.y - step.model)
    turn = -np.pi + 2.0 * np.pi * (np.arange(SECTORS) + 0.5) / SECTORS
    assert shifts == pytest.approx(-0.165 * np.cos(turn), abs=0.05)  # to first order over a limb 0.7 px wide


def test_the_picture_shows_outline_and_residuals(light: np.ndarray, tmp_path: Path) -> None:
    outline = replace(find_outline(light, RIG), shifts_px=np.where(np.arange(SECTORS) < 30, np.nan, SHIFTS))
    path = write_overlay(tmp_path / "o.png", light, None, RIG, outline, "a frame")
    drawn = np.asarray(Image.open(path).convert("RGB"), int)
    assert drawn.shape == (720, 1280, 3)
    green = (drawn[..., 1] > 200) & (drawn[..., 0] < 60)
    yellow = (drawn[..., 0] > 240) & (drawn[..., 1] > 200) & (drawn[..., 2] < 60)
    assert green.sum() > 500
    assert yellow.sum() > 1000
    v, u = np.nonzero(yellow)
    reach = np.abs(np.hypot(u - 640.0, v - 360.0) - 330.0)
    assert 20.0 < reach.max() < 60.0  # 0.1 px x 200 or 500, beside the outline's own ellipse
    assert not yellow[:340, :400].any()  # sectors 0 to 29 are the quarter from -x to -y, up left, and not used


@pytest.mark.parametrize("factor", [0.0, -1.0, np.inf, np.nan])
def test_a_factor_that_widens_nothing_is_refused(factor: float) -> None:
    with pytest.raises(ImageError, match="must be above 0"):
        OUTLINE.widened(factor)


def test_a_wider_outline_is_wider() -> None:
    assert OUTLINE.widened(2.0).sigma_m == pytest.approx(2.0 * OUTLINE.sigma_m)
