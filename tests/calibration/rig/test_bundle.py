"""The bundle, its covariance, its file and the command."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import scipy
from helpers.calibration_cases import OUTLINE2, RIG, STROKE, apparent
from helpers.oracles import true_pixel

from phibench.calibration.outline.outline_result import Outline, PoseMeasurement, mean_outline
from phibench.calibration.rig.bundle import Bundle, KnownSpot, _Problem, calibrate, mirror_pixels
from phibench.calibration.rig.calibration_file import CalibrationError, read_calibration, write_calibration
from phibench.cli import main as cli
from phibench.datasets.common.errors import DatasetError
from phibench.estimator.geometry.rig_parameters import PARAMETERS, changed_rig, has_effect, prior_sigmas, stroke_of
from phibench.scenes.rig import Rig

PIXEL2 = 0.05**2 * np.eye(2)
PLACES = ((1.2, 0.3), (2.0, 1.9), (3.0, 3.4), (4.0, 5.0))


def spots_of(true: Rig, values: np.ndarray, rng: np.random.Generator | None) -> list[KnownSpot]:
    """Spots at four distances, 0.5 m high, pixels by Alhazen's quartic; without a generator exact."""
    centre, found = true.at(0.0).sphere_centre_m, []
    h = float(stroke_of(STROKE, values))
    for depth, azimuth in PLACES:
        point = np.array([centre[0] + depth * np.cos(azimuth), centre[1] + depth * np.sin(azimuth), 0.5])
        down, up = true_pixel(true, 0.0, point), true_pixel(true, h, point)
        known = depth
        if rng is not None:
            down, up = (x + rng.multivariate_normal([0, 0], PIXEL2) for x in (down, up))
            known = depth + 1e-3 * rng.standard_normal()
        found.append(KnownSpot(down, up, PIXEL2, PIXEL2, STROKE, known, 1e-3))
    return found


def test_seen_at_against_the_quartic() -> None:
    true = changed_rig(RIG, 0.5 * prior_sigmas())
    points = np.array([[1.0, 1.0, 0.5], [-2.0, 0.5, 1.2]])
    start = np.array([true_pixel(RIG, 0.0, point) for point in points])
    expected = [true_pixel(true, 0.0, point) for point in points]
    assert mirror_pixels(true.at(0.0), points, start) == pytest.approx(np.array(expected), abs=1e-6)


def test_exact_data_of_the_nominal_rig_change_nothing() -> None:
    zero = np.zeros(len(PARAMETERS))
    bundle = calibrate(RIG, apparent(RIG), spots_of(RIG, zero, None))
    assert np.abs(bundle.values / prior_sigmas()).max() < 1e-4
    assert bundle.chi2 < 1e-4


def test_differences_are_those_of_one_unknown_after_the_other() -> None:
    """Spots with and without measured height and azimuth: each row of a spot goes to its own point's unknowns."""
    known = spots_of(RIG, np.zeros(len(PARAMETERS)), np.random.default_rng(3))
    known[1] = replace(known[1], height_m=0.51, height_sigma_m=2e-3)
    known[2] = replace(known[2], height_m=0.49, height_sigma_m=2e-3, azimuth_rad=3.4, azimuth_sigma_rad=1e-3)
    prior = np.where(has_effect(RIG), prior_sigmas(), 0.0)
    problem = _Problem(RIG, apparent(RIG), tuple(known), None, prior, np.flatnonzero(prior), np.zeros((2, 2)))
    points = np.array([[d * np.cos(a), d * np.sin(a), 0.5] for d, a in PLACES])
    x = np.concatenate([np.full(len(problem.free), 0.1), points.ravel()])
    J, f = problem.jacobian(x), problem.residuals(x)
    for i, step in enumerate(np.sqrt(np.finfo(float).eps) * np.where(x < 0.0, -1.0, 1.0) * np.maximum(1.0, np.abs(x))):
        moved = x.copy()
        moved[i] += step
        assert np.array_equal(J[:, i], (problem.residuals(moved) - f) / (moved[i] - x[i])), i
    assert (np.abs(J).max(axis=0) > 0.5).all()


@pytest.mark.parametrize(("rigs", "wrong"), [(12, 2.0), pytest.param(40, 1.7, marks=pytest.mark.slow)])
def test_covariance_by_simulation(rigs: int, wrong: float) -> None:
    """Drawn rigs: chi2 of all parameters against their covariance, and the fit's own chi2, both chi-square sums.

    False alarm rate 1e-4 each. A covariance `wrong` times too large or too small is noticed: 12 rigs have 156 degrees,
    limits of 0.62 and 1.50, and a ratio of 1 +- 0.11; 40 rigs have 0.78 and 1.26, and 1 +- 0.06.
    """
    rng, sigmas = np.random.default_rng(21), 0.3 * prior_sigmas()
    pulls, misfits, degrees, own = [], [], 0, has_effect(RIG)
    for _ in range(rigs):
        values = rng.normal(0.0, sigmas)
        true = changed_rig(RIG, values)
        bundle = calibrate(RIG, apparent(true, rng), spots_of(true, values, rng), sigmas=sigmas)
        off = (bundle.values - values)[own]
        pulls.append(off @ np.linalg.solve(bundle.covariance[np.ix_(own, own)], off))
        assert not bundle.values[~own].any()  # a sphere has neither axis nor rim
        misfits.append(bundle.chi2)
        degrees += bundle.degrees
    n = rigs * int(own.sum())
    low, high = scipy.stats.chi2.ppf([5e-5, 1 - 5e-5], n)
    assert low < sum(pulls) < high
    assert not low < sum(pulls) * wrong < high
    assert not low < sum(pulls) / wrong < high
    assert scipy.stats.chi2.ppf(5e-5, degrees) < sum(misfits) < scipy.stats.chi2.isf(5e-5, degrees)


def test_what_cannot_be_told_apart_is_named() -> None:
    """From the outline alone: R with z_c, and tilt with decentre, are each one direction that stays."""
    bundle = calibrate(RIG, apparent(RIG))
    named = [set(direction.parts) for direction in bundle.undetermined]
    assert any({"radius_m", "axial_m"} & parts for parts in named)
    assert any({"stroke_relative"} & parts for parts in named)
    with_spots = calibrate(RIG, apparent(RIG), spots_of(RIG, np.zeros(len(PARAMETERS)), None))
    assert len(with_spots.undetermined) < len(bundle.undetermined)


def test_a_spot_that_the_nominal_rig_cannot_see_is_refused() -> None:
    spot = KnownSpot(np.array([5.0, 5.0]), np.array([9.0, 9.0]), PIXEL2, PIXEL2, STROKE, 2.0)
    with pytest.raises(DatasetError, match="no depth"):
        calibrate(RIG, None, [spot])


def test_unknown_priors_are_refused() -> None:
    with pytest.raises(DatasetError, match="tilt_x_rad"):
        prior_sigmas({"tilt_x": 0.1})
    with pytest.raises(DatasetError, match="0 or above"):
        prior_sigmas({"focal_relative": -1.0})


def outline_at(centre: np.ndarray, sigma_m: float) -> Outline:
    return Outline(centre, sigma_m**2 * np.eye(3), 1.0, 1.0, 0.7, 0.01, 1000, 5)


def test_mean_of_outlines_and_their_scatter() -> None:
    a, b = np.array([0.0, 0.0, 0.26]), np.array([0.0, 0.0, 0.2602])
    near = mean_outline([outline_at(a, 1e-3), outline_at(b, 1e-3)])
    assert near.value == pytest.approx((a + b) / 2)
    assert np.diag(near.covariance) == pytest.approx(0.5e-6)
    far = mean_outline([outline_at(a, 1e-5), outline_at(b, 1e-5)])
    assert np.diag(far.covariance) == pytest.approx(0.5e-10 * 200 / 3)  # chi2 = 2 (0.1 mm / 0.01 mm)^2, 3 degrees


@pytest.fixture
def bundle() -> Bundle:
    return calibrate(RIG, PoseMeasurement(np.array([2e-4, 0.0, 0.2605]), OUTLINE2))


def test_the_file_keeps_every_number(tmp_path, bundle) -> None:
    path = write_calibration(tmp_path / "c.json", bundle, RIG, {"dataset": "test"})
    back = read_calibration(path, RIG)
    assert back.rig == bundle.rig
    assert back.nominal == RIG
    assert back.parameters == PARAMETERS
    assert np.array_equal(back.covariance, bundle.covariance)
    assert np.array_equal(back.values, bundle.values)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"version": 3}, "version 3"),
        ({"kind": "shopping list"}, "not a calibration"),
        ({"chi2": 5.0}, "was changed"),
        ({"extra": 1}, "was changed"),
        ({"degrees": "three"}, "was changed"),
    ],
)
def test_a_file_that_is_not_right_is_refused(tmp_path, bundle, change, complaint) -> None:
    path = write_calibration(tmp_path / "c.json", bundle, RIG, {})
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    with pytest.raises(CalibrationError, match=complaint):
        read_calibration(path)


def test_another_rig_a_missing_file_and_no_json_are_refused(tmp_path, bundle) -> None:
    path = write_calibration(tmp_path / "c.json", bundle, RIG, {})
    other = replace(RIG, camera=replace(RIG.camera, fx_px=1431.0))
    with pytest.raises(CalibrationError, match="another rig"):
        read_calibration(path, other)
    with pytest.raises(CalibrationError, match="is missing"):
        read_calibration(tmp_path / "none.json")
    path.write_text("[rig]\nfx_px = 1430.0\n")
    with pytest.raises(CalibrationError, match="give a rig file with --rig"):
        read_calibration(path)
    path.write_text("{")
    with pytest.raises(CalibrationError, match="not JSON"):
        read_calibration(path)


def test_command_says_one_sentence(tmp_path, capsys) -> None:
    assert cli.main(["calibrate", str(tmp_path), "--out", str(tmp_path / "c.json")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
