"""Study misalignment: numbers against other mathematics, findings of made-up numbers, a tiny run of the whole."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from rich.console import Console
from scipy.optimize import brentq

from phibench.datasets.common.errors import DatasetError
from phibench.estimator.geometry.paper_depth import depth_paper
from phibench.estimator.geometry.rig_parameters import PARAMETERS as CALIBRATION
from phibench.render.optics.truth import spot_truth
from phibench.scenes.laser import LaserSpot
from phibench.scenes.mirror import OF_REVOLVED
from phibench.scenes.misalignment import PARAMETERS, Misalignment
from phibench.scenes.random_streams import generator
from phibench.scenes.room import default_rig
from phibench.studies.framework import StudyDatasets, read_settings
from phibench.studies.misaligned_rigs import (
    NOMINAL,
    CalibrationSetup,
    Places,
    RenderedDeviation,
    calibrated_errors,
    errors,
    errors_of_many,
    nominal_sigmas,
    pixels,
    rendered_deviations,
    seen_px,
    slopes,
)
from phibench.studies.misalignment.sobol_indices import (
    Interactions,
    evaluated_outputs,
    interaction_findings,
    with_intervals,
)
from phibench.studies.misalignment.study import STUDY, tightest_table
from phibench.studies.misalignment.tables import (
    Rank,
    Search,
    calibrated_findings,
    first_crossing,
    noise_intervals,
    over_azimuths,
    rendered_findings,
    signs,
    slope_findings,
    tolerance,
    tolerance_findings,
)

RIG = default_rig()
PLACES = Places(np.array([1.0, 3.18]), np.radians([0.0, 90.0, 200.0]), 0.5, 0.425)
GEOMETRIC = tuple(name for name in PARAMETERS if name not in ("focus_distance_m", "roughness_alpha", *OF_REVOLVED))
SPHERICAL = tuple(name for name in GEOMETRIC if not name.startswith("form_"))
SETUP = CalibrationSetup(
    np.array([[1.2, 0.3, 0.5], [-1.0, 1.8, 0.5], [-2.0, -2.1, 0.5], [2.6, -3.0, 0.5]]), 0.02, 1e-3, (8e-6, 8e-6, 24e-6)
)


def test_errors_of_many_rigs_agree_with_one_at_a_time() -> None:
    """Alhazen's problem in the plane of three points against Newton's method in the image, over drawn rigs."""
    rng = generator("test", "misalignment", "many")
    drawn = [
        Misalignment(**{name: float(rng.uniform(-1.0, 1.0)) * PARAMETERS[name].study for name in SPHERICAL})
        for _ in range(12)
    ]
    many = errors_of_many(RIG, drawn, PLACES, NOMINAL)
    single = np.stack([errors(RIG, m, PLACES) for m in drawn])
    assert many.shape == (12, len(NOMINAL), 2, 3)
    # pixels agree to 1e-10 px, and a pixel is 0.2 m of depth at most: 1e-11 of D
    assert np.allclose(many, single, rtol=0.0, atol=1e-11)
    assert np.min(np.abs(many[:, -1]).max(axis=(1, 2))) > 1e-4


def test_many_rigs_refuse_errors_of_form() -> None:
    with pytest.raises(ValueError, match="spheres only"):
        errors_of_many(RIG, [Misalignment(), Misalignment(form_20_m=2e-5)], PLACES, NOMINAL)


@pytest.mark.parametrize("form_m", [0.0, 1e-4])
def test_pixels_are_those_of_the_simulator(form_m: float) -> None:
    m = Misalignment(
        form_22c_m=form_m, tilt_y_rad=0.0087, decentre_x_m=1e-3, pitch_rad=1e-3, stroke_relative=2e-3, k1=0.02
    )
    true, h = RIG.perturbed(m), m.stroke_m(PLACES.stroke_m)
    found = pixels(RIG, m, PLACES)
    checked = 0
    for uv, view in zip(found, (true.at(0.0), true.at(h)), strict=True):
        for index in np.ndindex(2, 3):
            truth = spot_truth(view, LaserSpot(tuple(PLACES.points_m[index]), (0.0, 0.0, 1.0), 4e-3), ())
            assert np.allclose(uv[index], (truth.u_px, truth.v_px), rtol=0.0, atol=1e-6)
            checked += 1
    assert checked == 12


def test_eq_4_by_hand_for_an_error_of_the_stroke() -> None:
    """Eq. (4) with exact phi_ray: a true stroke that is 0.2 % longer than nominal scales h - lambda alone."""
    m = Misalignment(stroke_relative=2e-3)
    found = errors(RIG, m, PLACES, ("paper_ray",))[0]
    true, view = RIG.at(m.stroke_m(0.425)), RIG.at(0.0)
    for index in np.ndindex(2, 3):
        spot = LaserSpot(tuple(PLACES.points_m[index]), (0.0, 0.0, 1.0), 4e-3)
        phi = [spot_truth(each, spot, ()).phi_ray_rad for each in (view, true)]
        expected = float(depth_paper(phi[0], phi[1], 0.425, 0.06).depth_m) / PLACES.depths_m[index[0]] - 1.0
        assert found[index] == pytest.approx(expected, abs=1e-9)


def test_slopes_are_the_limit_of_whole_changes() -> None:
    found = slopes(RIG, PLACES)
    assert set(found) == set(PARAMETERS) - set(OF_REVOLVED)
    checked = 0
    for name in GEOMETRIC:
        step = 1e-3 * PARAMETERS[name].study
        plus, minus = (errors(RIG, Misalignment(**{name: s * step}), PLACES) for s in (1.0, -1.0))
        size = np.max(np.abs(found[name])) * PARAMETERS[name].study
        # central differences: third order in 1e-3, and rounding 1e-13 / 2e-3
        assert np.allclose(
            (plus - minus) / 2e-3, found[name] * PARAMETERS[name].study, rtol=0.0, atol=1e-4 * size + 1e-9
        )
        checked += size > 1e-6
    assert checked > 15
    assert np.all(found["focus_distance_m"] == 0.0)  # moves no chief ray


@pytest.mark.slow
def test_tolerance_solves_the_whole_change() -> None:
    """Against brentq on the same cost: the power law between steps of 10 % is good to (ln 1.1)^2 / 8 = 0.1 %."""

    def of(m: Misalignment) -> np.ndarray:
        return errors(RIG, m, PLACES, ("exact",))

    checked = 0
    for name in ("tilt_y_rad", "radius_m"):
        found = tolerance(RIG, name, of, of(Misalignment()), Search(0.01, 0.05, 100.0, 1.1))
        for k in range(2):
            for j in range(2):
                expected = _brent(name, k, j)
                assert found[k, 0, j] == pytest.approx(expected, rel=5e-3)
                checked += 1
        by_slope = 0.01 / np.max(np.abs(slopes(RIG, PLACES, ("exact",))[name][0, 1]))
        if name == "tilt_y_rad":  # the slope would allow another value: whole change, not slope
            assert abs(found[1, 0, 1] / by_slope - 1.0) > 0.05
    assert checked == 8


@cache
def _changes(name: str, value: float) -> np.ndarray:
    """Changes of D's relative error at both signs, shape (d, 2 a): all statistics and distances share them."""
    aligned = errors(RIG, Misalignment(), PLACES, ("exact",))[0]
    both = [errors(RIG, Misalignment(**{name: s * value}), PLACES, ("exact",))[0] - aligned for s in (1.0, -1.0)]
    return np.abs(np.concatenate(both, axis=-1))


def _brent(name: str, statistic: int, depth: int) -> float:
    def above(value: float) -> float:
        changes = _changes(name, value)[depth]
        return float((np.sqrt(np.mean(changes**2)), np.max(changes))[statistic]) - 0.01

    end = start = 0.02 * PARAMETERS[name].study
    while above(end) < 0.0:
        end *= 1.2
    return float(brentq(above, max(start, end / 1.2), end, rtol=1e-4))


def test_first_crossing_of_known_costs() -> None:
    """Power laws are exact; a cost that is never reached, or already at the start, or jumps to what cannot be."""

    def cost(x: float) -> np.ndarray:
        return np.array([2.0 * x, x**2, 1e-9 * x, 100.0 * x, 0.01 * x if x < 3.0 else np.inf])

    found = first_crossing(cost, 0.5, 0.01, 40.0, 1.5)
    assert found[0] == pytest.approx(0.25, rel=1e-12)
    assert found[1] == pytest.approx(math.sqrt(0.5), rel=1e-12)
    assert np.isnan(found[2])
    assert found[3] == pytest.approx(0.005, rel=1e-12)
    assert 2.0 <= found[4] < 3.0


def test_what_cannot_be_is_no_tolerance() -> None:
    assert signs(RIG, "roughness_alpha", 1e-3) == (1.0,)
    assert signs(RIG, "radius_m", 1e-3) == (1.0, -1.0)
    lost = over_azimuths(np.array([[0.01, np.nan], [0.03, 0.04]]))
    assert np.all(np.isinf(lost[:, 0]))
    assert lost[:, 1] == pytest.approx([math.sqrt(0.00125), 0.04])


def test_spot_outside_of_the_image_is_lost() -> None:
    tilted = RIG.perturbed(Misalignment(cx_px=900.0))
    assert np.isnan(seen_px(tilted.at(0.0), PLACES.points_m)).all(axis=-1).any()


def test_sobol_indices_of_a_sum_and_of_a_product() -> None:
    """a x + b y: S = a^2, b^2 over their sum, which add to 1; (x - 1/2)(y - 1/2): no first order, total 1 each."""

    def model(unit: np.ndarray) -> np.ndarray:
        x, y = (unit - 0.5).T
        return np.stack([2.0 * x + y, x * y])

    values = evaluated_outputs(model, 2, 1024, generator("test", "sobol"))
    found, low, high = with_intervals(values, np.array([2, 2]), 200, generator("test", "boot"))
    # Sobol points at n = 1024 err by about 1/n^(3/4) of a smooth function; Monte Carlo would by 1/sqrt(n) = 0.03
    assert found[0, :5] == pytest.approx([0.8, 0.2, 0.8, 0.2, 1.0], abs=0.03)
    assert found[1, :5] == pytest.approx([0.0, 0.0, 1.0, 1.0, 0.0], abs=0.06)
    assert found[0, 5] == pytest.approx(math.sqrt(5.0 / 12.0), rel=0.01)
    assert found[1, 5] == pytest.approx(1.0 / 12.0, rel=0.02)
    assert np.all(low <= found + 1e-12)
    assert np.all(found <= high + 1e-12)
    assert high[0, 4] - low[0, 4] < 0.5


def test_calibration_takes_out_what_it_fits() -> None:
    """Radius, tilt and decentre are the calibration's own; a pitch between the images is not."""
    cost = {}
    for name in ("tilt_y_rad", "pitch_rad"):
        m = Misalignment(**{name: PARAMETERS[name].study})
        before = np.abs(errors(RIG, m, PLACES, ("exact",))).max()
        after = np.abs(calibrated_errors(RIG, m, PLACES, lambda m: SETUP.calibrated(RIG, 0.425, m))).max()
        cost[name] = after / before
    assert cost["tilt_y_rad"] < 0.05
    assert cost["pitch_rad"] > 0.2


def test_priors_are_as_wide_as_the_usual_sizes() -> None:
    sigmas = dict(zip(CALIBRATION, nominal_sigmas(), strict=True))
    assert sigmas["cx_px"] == PARAMETERS["cx_px"].study
    assert sigmas["focal_relative"] == PARAMETERS["focal_relative"].study
    assert sigmas["axial_m"] == 2e-3  # the calibration's own, which is wider


def test_calibration_needs_its_spots_in_the_image() -> None:
    with pytest.raises(DatasetError, match="not in the image"):
        SETUP.calibrated(RIG, 0.425, Misalignment(cx_px=900.0))


@pytest.mark.slow
def test_rendered_spots_move_as_predicted() -> None:
    """One place, all parameters: centroids and chief rays drift apart by a thousandth of a pixel at most."""
    places = Places(np.array([2.18]), np.radians([30.0]), 0.5, 0.425)
    found = tuple(rendered_deviations(RIG, places))
    assert [one.parameter for one in found] == [name for name in PARAMETERS if name not in OF_REVOLVED]
    for one in found:
        # 1 mpx in each of four coordinates of the blurred spot, times what a pixel is worth
        assert np.max(np.abs(one.change - one.predicted)[-1]) < 1e-3 * float(one.explained.max())
    moved = {one.parameter: float(np.abs(one.predicted[-1]).max()) for one in found}
    assert moved["tilt_y_rad"] > 10.0 * 1e-3 * float(found[0].explained.max())  # the tolerance is far below the effect


# -- findings ------------------------------------------------------------------------------------------------------


def _rank(parameter: str, *rms: float) -> Rank:
    return Rank(parameter, "exact", np.array([1.0, 4.0]), np.array(rms), 2.0 * np.array(rms))


def _indices(low: float, high: float) -> Interactions:
    first, total = np.array([0.6, 0.3]), np.array([0.65, 0.35])
    middle = 0.5 * (low + high)
    value = np.concatenate([first, total, [middle, 0.05]])
    return Interactions(
        "error",
        1.0,
        ("cx_px", "tilt_y_rad"),
        value,
        np.concatenate([first - 0.1, total - 0.1, [low, 0.04]]),
        np.concatenate([first + 0.1, total + 0.1, [high, 0.06]]),
    )


@pytest.mark.parametrize(
    ("low", "high", "verdict"), [(0.92, 1.02, "met"), (0.5, 0.8, "missed"), (0.85, 1.0, "undecided")]
)
def test_additivity_is_decided_by_the_interval(low: float, high: float, verdict: str) -> None:
    found = {f.label: f for f in interaction_findings([_indices(low, high)])}
    total = found["sum of the first-order Sobol indices, D = 1 m"]
    assert (total.low, total.high, total.verdict) == (low, high, verdict)
    share = found["variance by interaction, D = 1 m"]
    assert (share.low, share.high) == pytest.approx((100.0 * (1.0 - high), 100.0 * (1.0 - low)))
    assert found["largest total Sobol index (cx_px, D = 1 m)"].value == 0.65


def test_slopes_are_judged_by_their_misses() -> None:
    assert next(slope_findings(("tilt_y_rad", 1.0, 0.02), 1e-3)).verdict == "missed"
    assert next(slope_findings(("tilt_y_rad", 1.0, 1e-4), 1e-3)).verdict == "met"


def test_rendered_agreement_is_judged_by_the_tolerance() -> None:
    one = RenderedDeviation("k1", 0.03, np.full((5, 1, 1), 0.011), np.full((5, 1, 1), 0.01), 1e-4, np.ones((1, 1)))
    assert next(rendered_findings([one], 1e-4)).verdict == "missed"
    assert next(rendered_findings([one], 1e-2)).verdict == "met"
    lost = replace(one, change=np.full((5, 1, 1), np.nan))
    assert next(rendered_findings([lost], 1e-2)).verdict == "undecided"


def test_tolerances_start_with_the_tightest_and_count_those_never_reached() -> None:
    def row(parameter: str, value: float | None) -> dict[str, object]:
        over = None if value is None else value / PARAMETERS[parameter].study
        words = {"estimator": "exact", "statistic": "rms", "depth_m": 3.18}
        return {"parameter": parameter, "value": value, "value_over_study": over, **words}

    rows = [row("cx_px", 30.0), row("tilt_y_rad", 0.001), row("k3", None)]
    first, second, below, never = tolerance_findings(rows, "exact", 3.18, 0.01)
    assert first.label == "tolerance for 1 % of D, exact, D = 3.18 m: tilt_y_rad"
    assert (first.value, first.unit) == (pytest.approx(0.0573, abs=5e-5), "deg")
    assert (second.value, second.unit) == (30.0, "px")
    assert (below.value, below.unit) == (1, "of 3")
    assert never.value == 1
    assert "(k3)" in never.label
    assert tightest_table(rows, "exact", 3.18, 0.01) == (
        ("parameter", "tolerance for 1 % of D", "expected deviation", "ratio"),
        ("tilt_y_rad", "0.0573 deg", "0.498 deg", "0.11"),
        ("cx_px", "30 px", "15 px", "2"),
    )


def _left(ranks: list[Rank], before: list[Rank]) -> dict[str, str]:
    return {f.label: f.verdict for f in calibrated_findings(ranks, before)}


def test_calibration_is_judged_by_what_it_leaves() -> None:
    before = [_rank("cx_px", 0.02, 0.03)]
    label = "largest change of D after a calibration"
    assert _left([_rank("cx_px", 0.002, 0.008)], before)[label] == "met"
    assert _left([_rank("cx_px", 0.02, 0.08)], before)[label] == "missed"


def test_harm_by_a_calibration_is_a_finding() -> None:
    before = [_rank("cx_px", 0.02, 0.03), _rank("yaw_rad", 1e-5, 1e-4)]
    after = [_rank("yaw_rad", 0.003, 0.002), _rank("cx_px", 1e-4, 1e-4)]
    label = "change of D that a calibration adds: yaw_rad"
    assert _left(after, before)[label] == "missed"
    assert label not in _left([_rank("yaw_rad", 1e-5, 1e-4), after[1]], before)


def test_noise_interval_covers_as_often_as_it_says() -> None:
    """400 sets of 20 draws of one normal number: 95 % intervals hold the true 1 in 91 to 98 % (5 sigma: 0.011 each)."""
    rng = generator("test", "noise", "intervals")
    held = 0
    for _ in range(400):
        low, _, high = noise_intervals(rng.normal(0.0, 1.0, (20, 1, 1)) * np.ones((1, 1, 4)))
        held += bool(low[0] <= 1.0 <= high[0])
    # the mean square of 20 is skewed: Student's t is a little short
    assert 0.86 < held / 400 < 0.985


# -- the whole -----------------------------------------------------------------------------------------------------

TINY = """
depths_m = [1.0, 3.18]
strokes_m = [0.425]
height_m = 0.50
azimuths = 4
cost = 0.01
search = { start = 0.5, largest = 8.0, factor = 2.0 }
search_calibrated = { start = 1.0, largest = 1.0, factor = 2.0 }
rendered_every = 4
agreement = 1e-4
calibration_spots = [[1.2, 40.0], [3.0, 220.0]]
calibration_pixel_sigma_px = 0.02
calibration_distance_sigma_m = 1e-3
calibration_outline_sigma_m = [8e-6, 8e-6, 24e-6]
noise_draws = 2
sobol_log2 = 4
resamples = 20
parameters = ["tilt_y_rad", "cx_px", "roughness_alpha"]
"""


@pytest.mark.slow  # 8 s: calibrations of three parameters
def test_tiny_study(tmp_path: Path) -> None:
    """Three of the parameters, because every one of them costs two calibrations."""
    file = tmp_path / "tiny.toml"
    file.write_text(TINY, encoding="utf-8")
    settings = read_settings(STUDY, path=file)
    result = STUDY.run(settings, StudyDatasets(tmp_path, Console(quiet=True)))
    table = result.tables["table"]
    assert set(table["estimator"].unique()) == {*NOMINAL, "exact_calibrated"}
    assert set(table["parameter"].unique()) == set(settings.chosen)
    assert table.filter(pl.col("rendered_relative").is_not_null()).height > 0
    assert result.tables["tolerance"].height == 3 * 6 * 2 * 2
    labels = " ".join(finding.label for finding in result.findings)
    for words in ("change of D, exact: ", "change of D, paper_normal: ", "slope times error", "rendered against"):
        assert words in labels
    for words in ("tolerance for 1 % of D", "after a calibration", "noise of the calibration", "all drawn at once"):
        assert words in labels
    assert len(result.drawings) == 3
    assert not (tmp_path / "data").exists()  # it needs no data set


def test_shipped_settings_are_valid_and_the_reduced_ones_smaller() -> None:
    full, quick = read_settings(STUDY), read_settings(STUDY, True)
    assert quick.sobol_log2 < full.sobol_log2
    assert quick.azimuths < full.azimuths


def test_bad_settings_end_in_a_sentence(tmp_path: Path) -> None:
    file = tmp_path / "bad.toml"
    file.write_text(TINY.replace("sobol_log2 = 4", "sobol_log2 = 40"), encoding="utf-8")
    with pytest.raises(DatasetError, match="sobol_log2"):
        read_settings(STUDY, path=file)
    file.write_text(TINY.replace("tilt_y_rad", "tilt_z_rad"), encoding="utf-8")
    with pytest.raises(DatasetError, match="no misalignment 'tilt_z_rad'; did you mean"):
        STUDY.run(read_settings(STUDY, path=file), StudyDatasets(tmp_path, Console(quiet=True)))
