"""A refocused lens: focal lengths by the lens equation, errors of D by the whole change, and what the outline saves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from phibench.calibration.rig.from_dataset import CalibrationSources
from phibench.datasets.common.errors import DatasetError
from phibench.estimator.geometry.paper_depth import load_published
from phibench.estimator.geometry.rig_parameters import PARAMETERS, prior_sigmas
from phibench.scenes.camera import Camera, refocused
from phibench.scenes.misalignment import Misalignment
from phibench.scenes.rig import Rig
from phibench.scenes.validation import SceneError
from phibench.studies.misaligned_rigs import Places, errors
from phibench.studies.misalignment.refocus import FAR_M, OLD, OUTLINE, refocus, refocus_findings, thin_lens

PLACES = [(row.real_depth_m, row.baseline_m) for row in load_published()]


def rig() -> Rig:
    return replace(Rig(), camera=thin_lens(Camera(), 4e-3))


@pytest.mark.parametrize(("focus_m", "focal_px"), [(FAR_M, 1428.6), (0.46, 1441.1), (0.23, 1453.9)])
def test_focal_length_of_a_thin_lens(focus_m: float, focal_px: float) -> None:
    """Newton's form (v - f) (u - f) = f^2, to the 0.05 px of the printed digits; the aperture stays."""
    camera = refocused(rig().camera, focus_m)
    image_m = 4e-3 + 4e-3**2 / (focus_m - 4e-3)
    assert camera.fx_px == pytest.approx(image_m / 2.8e-6, rel=1e-9)
    assert camera.fx_px == pytest.approx(focal_px, abs=0.05)
    assert camera.aperture_radius_m == pytest.approx(rig().camera.aperture_radius_m, rel=1e-12)
    assert camera.focus_distance_m == focus_m


def test_turning_back_gives_the_same_lens() -> None:
    back = refocused(refocused(Camera(), 0.46), Camera().focus_distance_m)
    assert (back.fx_px, back.f_number) == pytest.approx((Camera().fx_px, Camera().f_number), rel=1e-12)
    for distance_m in (3e-3, 0.0, -1.0, float("nan")):
        with pytest.raises(SceneError, match="focal length"):
            refocused(Camera(), distance_m)


def test_the_outline_saves_what_refocusing_costs() -> None:
    """Figures of the paper's experiments: 1.3 and 2.7 % with the old calibration, 0.05 and 0.09 % with the outline.

    0.02 and 0.005 % of D: the figures were asked for with 1.33 and 2.71, 0.05 and 0.09 % for places not stated.
    """
    rows = [refocus(rig(), focus_m, PLACES, 0.5) for focus_m in (0.46, 0.23)]
    assert [100.0 * row.rms(OLD) for row in rows] == pytest.approx([1.33, 2.71], abs=0.02)
    assert [100.0 * row.rms(OUTLINE) for row in rows] == pytest.approx([0.05, 0.09], abs=0.005)
    assert [100.0 * row.relative for row in rows] == pytest.approx([0.877, 1.770], abs=0.001)
    # an image that is larger looks nearer: every D is too small with the old focal length
    assert all(np.all(row.errors[OLD] < 0.0) for row in rows)
    labels = [finding.label for finding in refocus_findings(rows)]
    assert len(set(labels)) == len(labels) == 8


def test_the_errors_are_those_of_the_misalignment() -> None:
    """The same as `focal_relative` by the other program of the study; the plane of focus moves no chief ray."""
    row = refocus(rig(), 0.46, [(2.18, 0.425), (4.18, 0.425)], 0.5)
    there = Places(np.array([2.18, 4.18]), np.array([0.0]), 0.5, 0.425)
    expected = errors(rig(), Misalignment(focal_relative=row.relative), there, ("exact",))[0, :, 0]
    assert row.errors[OLD] == pytest.approx(expected, rel=1e-9)


def test_a_calibration_takes_the_statement_about_the_lens() -> None:
    """By default the prior of all calibrations; a stated one changes no other number. Nonsense is one sentence."""
    focal = PARAMETERS.index("focal_relative")
    assert np.array_equal(CalibrationSources().sigmas, prior_sigmas())
    stated = CalibrationSources(focal_sigma=0.018).sigmas
    assert stated[focal] == 0.018
    assert np.array_equal(np.delete(stated, focal), np.delete(prior_sigmas(), focal))
    for value in (0.0, -0.01, 0.2, float("nan")):
        with pytest.raises(DatasetError, match=r"--focal-sigma .*: must be above 0 and below 0\.2"):
            _ = CalibrationSources(focal_sigma=value).sigmas
