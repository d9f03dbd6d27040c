"""Scores with a calibration file: every estimator and method gets its rig, and D its part of the predicted error."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy
from helpers.bench_cases import RIG, Cases, cases, records

from phibench.benchmark.pair_sets.wanted_pairs import CalibratedPairs, samples_of_calibration
from phibench.benchmark.reports import bench as benching
from phibench.benchmark.scores.answer_errors import Rules
from phibench.benchmark.scores.metrics import metric_estimates, prepared_records
from phibench.benchmark.sealed.score_check import check_score
from phibench.calibration.rig.bundle import Bundle
from phibench.calibration.rig.calibration_file import Calibration, CalibrationError, read_calibration, write_calibration
from phibench.cli.main import main
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.read import Dataset, open_finished
from phibench.estimator.geometry.rig_parameters import PARAMETERS, RENAMED, changed_rig, prior_sigmas
from phibench.estimator.interface import Answer, Outcome, Spot
from phibench.scenes.misalignment import Misalignment
from phibench.scenes.random_streams import generator
from phibench.scenes.rig import Rig
from phibench.studies.paper.paper_tables import GENERAL, score_estimators

SIGMAS = 0.05 * prior_sigmas()
COVARIANCE = np.diag(SIGMAS**2)
PIXEL2 = 0.02**2 * np.eye(2)


def calibration(values: np.ndarray, nominal: Rig = RIG, **made_from: object) -> Calibration:
    return Calibration(changed_rig(nominal, values), nominal, PARAMETERS, values, COVARIANCE, dict(made_from), "0" * 64)


def written(path: Path, values: np.ndarray, nominal: Rig, **made_from: object) -> Path:
    bundle = Bundle(changed_rig(nominal, values), values, COVARIANCE, 0.0, 0)
    return write_calibration(path, bundle, nominal, dict(made_from))


def corrections(misalignment: Misalignment) -> np.ndarray:
    """What a perfect calibration finds for a misalignment of tilt, decentre and stroke."""
    values = dict.fromkeys(PARAMETERS, 0.0)
    values |= {name: getattr(misalignment, name) for name in ("tilt_x_rad", "decentre_y_m")}
    values["stroke_relative"] = misalignment.stroke_relative
    return np.array([values[name] for name in PARAMETERS])


# -- The predicted error of D


def noisy_answers(pairs: Cases, rng: np.random.Generator) -> list[Outcome]:
    """Positions at the true pixels plus noise, with its covariance."""
    found = []
    for truth in pairs.truths:
        uv = [np.array(spot.uv_px) + rng.multivariate_normal([0.0, 0.0], PIXEL2) for spot in (truth.down, truth.up)]
        spots = [Spot((float(x[0]), float(x[1])), tuple(map(tuple, PIXEL2.tolist()))) for x in uv]
        found.append(Outcome(truth.number, Answer(*spots), 0.0))
    return found


def depth_pulls(rigs: int, with_calibration: bool) -> np.ndarray:
    """Errors of D over their predicted sigma: `rigs` calibrations that are off as their covariance says, 5 pairs each.

    The scene's true rig is `RIG`; a calibration that is off by `values` gives a rig that is off by as much.
    """
    rng, base, pulls = generator("tests", "calibrated score"), cases(5 * rigs), []
    for k in range(rigs):
        off = calibration(rng.normal(0.0, SIGMAS))
        five = Cases(tuple(replace(t, number=n) for n, t in enumerate(base.truths[5 * k : 5 * k + 5])))
        seen = CalibratedPairs(five, off)
        if not with_calibration:
            truths = tuple(replace(seen.truth(n), calibration_covariance=None) for n in range(5))
            seen = Cases(truths)
        table = records(seen, noisy_answers(five, rng), Rules())
        pulls.append(table.filter(image="down")["depth_pull"].to_numpy())
    return np.concatenate(pulls)


@pytest.mark.slow
def test_the_predicted_error_of_depth_holds_the_calibration() -> None:
    """12 rigs of 5 pairs. The pulls of one rig share its error, so that the sum over rigs of the mean square of 5 lies
    between independent and fully common errors; the worst case, common ones, is chi-square with 12 degrees.

    False alarm rate 1e-4 for the worst case. Without the calibration's part the mean square is 4.6 instead of 0.9.
    """
    low, high = scipy.stats.chi2.ppf([5e-5, 1.0 - 5e-5], 12) / 12
    mean_square, without = (float(np.mean(depth_pulls(12, given) ** 2)) for given in (True, False))
    print(f"mean square {mean_square:.2f}, without {without:.2f}; {low:.2f} to {high:.2f}")
    assert low < mean_square < high
    assert without > high


def test_pairs_carry_rig_stroke_and_covariance() -> None:
    given = {"stroke_offset_m": 2e-3, "stroke_relative": 1e-2, "axial_m": 1e-3}
    values = np.array([given.get(name, 0.0) for name in PARAMETERS])
    base = cases(3)
    seen = CalibratedPairs(base, calibration(values, dataset="x"))
    for number in range(3):
        pair, truth, before = seen.pair(number), seen.truth(number), base.truth(number)
        assert pair.rig == truth.nominal_rig == changed_rig(RIG, values)
        assert truth.true_rig == before.true_rig
        assert pair.stroke_m == truth.nominal_stroke_m == pytest.approx(1.01 * before.stroke_m + 2e-3)
        assert np.array_equal(pair.calibration_covariance, COVARIANCE)
        assert not pair.calibration_covariance.flags.writeable
    assert seen.document() == {**base.document(), "calibration": "0" * 64, "calibrated_from": {"dataset": "x"}}


def test_coverage_is_that_of_the_pulls() -> None:
    base = cases(40)
    rng = generator("tests", "coverage")
    table = prepared_records(records(base, noisy_answers(base, rng), Rules()))
    pulls = table.filter(image="down")["depth_pull"].to_numpy()
    found = metric_estimates(table, Rules(), "tests", names=("coverage_depth",))["coverage_depth"]
    assert found.n == 40
    assert found.estimate.value == pytest.approx(np.mean(np.abs(pulls) <= 1.96), abs=1e-12)
    assert 0.8 <= found.estimate.value <= 1.0  # 95 % of 40: below 32 hits in 3e-4 of the cases


def test_a_methods_own_depth_gets_the_calibrations_part() -> None:
    base = cases(4)
    seen = CalibratedPairs(base, calibration(np.zeros(len(PARAMETERS))))
    plain = noisy_answers(base, generator("tests", "own"))
    own = [
        replace(o, answer=replace(o.answer, depth_m=base.truth(o.number).depth_m, sigma_depth_m=0.01)) for o in plain
    ]
    rows = records(seen, own, Rules()).filter(image="down")
    without = records(base, own, Rules()).filter(image="down")
    assert without["depth_sigma_m"].to_list() == [0.01] * 4
    spots = records(base, plain, Rules()).filter(image="down")["depth_sigma_m"].to_numpy()
    both = records(seen, plain, Rules()).filter(image="down")["depth_sigma_m"].to_numpy()
    # the weights of the condition change with the calibration, hence the parts are equal to some per cent only
    expected = np.sqrt(both**2 - spots**2)
    assert np.sqrt(rows["depth_sigma_m"].to_numpy() ** 2 - 0.01**2) == pytest.approx(expected, rel=0.3)


# -- Which samples a calibration is for


@pytest.fixture(scope="module")
def misaligned(misaligned_dataset: Path) -> Dataset:
    return open_finished(misaligned_dataset)


def truth_of_rig(dataset: Dataset) -> np.ndarray:
    table = dataset.recipe.misalignment
    return corrections(Misalignment(**table.model_dump()))


def test_a_calibration_of_another_rig_is_refused(misaligned: Dataset) -> None:
    zero = np.zeros(len(PARAMETERS))
    with pytest.raises(CalibrationError, match="did not start from the nominal rig of sample seen-near"):
        samples_of_calibration(misaligned, calibration(zero, RIG))
    nominal = misaligned.samples[0].nominal_rig
    assert samples_of_calibration(misaligned, calibration(zero, nominal)) is misaligned
    with pytest.raises(CalibrationError, match="has 1 true rig and the calibration was made from none"):
        samples_of_calibration(misaligned, calibration(zero, nominal, dataset="another", samples=["seen-near-h0.500"]))


def test_of_several_true_rigs_the_calibrated_one_is_taken(misaligned: Dataset) -> None:
    first, second = misaligned.rows
    both = replace(misaligned, rows=(first, second.model_copy(update={"rig": "other"})))
    nominal = misaligned.samples[0].nominal_rig
    made = calibration(np.zeros(len(PARAMETERS)), nominal, dataset=misaligned.info.name, samples=[first.sample_id])
    assert samples_of_calibration(both, made).rows == (first,)
    stranger = replace(made, made_from={})
    with pytest.raises(CalibrationError, match="has 2 true rigs and the calibration was made from none"):
        samples_of_calibration(both, stranger)


# -- Estimators and the command


def test_estimators_get_the_calibrated_rig_and_stroke(misaligned: Dataset) -> None:
    """A yaw of 0.02 rad between the images is left, which no calibration knows: the rays miss each other, p says so."""
    nominal = misaligned.samples[0].nominal_rig
    before = {(s.estimator, s.source): s for s in score_estimators(misaligned) if s.status == "ok"}
    made = calibration(truth_of_rig(misaligned), nominal)
    after = {(s.estimator, s.source): s for s in score_estimators(misaligned, made) if s.status == "ok"}
    assert set(after) - set(before) == {(GENERAL, "truth"), (GENERAL, "frame")}
    for source in ("truth", "frame"):
        assert abs(before["exact", source].relative_error) > 0.02
        assert abs(after["exact", source].relative_error) < 0.01
        general = after[GENERAL, source]
        assert general.sigma_m > 0.0
        assert abs(general.relative_error) < 0.02
        assert general.p_value < 1e-6
        assert np.isnan(after["exact", source].sigma_m)


def run(*arguments: object) -> int:
    return main([str(argument) for argument in arguments])


def test_score_prints_the_general_row(misaligned: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    nominal = misaligned.samples[0].nominal_rig
    file = written(tmp_path / "c.json", truth_of_rig(misaligned), nominal)
    out = tmp_path / "s.json"
    assert run("paper", misaligned.folder, "--calibration", file, "--wide", "--out", out) == 0
    printed = capsys.readouterr().out
    assert "general" in printed
    assert "±" in printed
    rows = [row for row in json.loads(out.read_text())["scores"] if row["estimator"] == GENERAL]
    assert len(rows) == 2 * len(misaligned)
    seen = next(row for row in rows if row["status"] == "ok")
    assert abs(seen["relative_error"]) < 0.02
    assert seen["sigma_m"] > 0.0


@pytest.mark.slow
def test_methods_are_scored_with_a_calibration(
    misaligned: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(benching, "write_report", lambda *_: tmp_path)  # thirty figures
    nominal = misaligned.samples[0].nominal_rig
    made_from = {"dataset": misaligned.info.name, "samples": [misaligned.rows[0].sample_id], "spots": True}
    file = written(tmp_path / "c.json", truth_of_rig(misaligned), nominal, **made_from)
    common = ("score", misaligned.folder, "--method", "detect", "--preset", "bayer-raw")
    assert run(*common, "--out", tmp_path / "without.json") == 0
    assert run(*common, "--calibration", file, "--out", tmp_path / "with.json") == 0
    with_it, without = (json.loads((tmp_path / f"{name}.json").read_text()) for name in ("with", "without"))
    assert with_it["pair_set"]["calibration"] == read_calibration(file).sha256
    assert "calibration" not in without["pair_set"]
    assert run("compare", tmp_path / "with.json", tmp_path / "without.json") == 2
    check_submissions(tmp_path / "with.json", tmp_path / "without.json", file, misaligned)
    monkeypatch.setattr(benching, "_presets", lambda _: ["mjpeg"])
    few = ("bench", misaligned.folder, "--method", "detect", "--pairs", "1")
    assert run(*few, "--calibration", file, "--out", tmp_path / "b") == 0
    assert json.loads((tmp_path / "b" / "mjpeg-detect.json").read_text())["pair_set"]["calibration"]


def check_submissions(scored: Path, without: Path, file: Path, dataset: Dataset) -> None:
    """A calibrated score is handed in like any other; with the calibration's file it is built again whole."""
    alone = check_score(scored)
    assert alone.faults == ()
    assert "independence: D of 1 of the 2 scored samples went into the calibration" in alone.unchecked
    assert any(text.startswith("pair_set.calibration: give the file") for text in alone.unchecked)
    half = check_score(scored, dataset.folder)  # its pairs cannot be made without the file
    assert half.faults == ()
    assert any(text.endswith("give --data, the folder of the data set with --calibration") for text in half.unchecked)
    whole = check_score(scored, dataset.folder, calibration=file)
    assert whole.faults == ()
    assert not any("--data" in text or "pair_set.calibration" in text for text in whole.unchecked)
    other = written(file.with_name("other.json"), np.zeros(len(PARAMETERS)), dataset.samples[0].nominal_rig)
    (fault,) = check_score(scored, dataset.folder, calibration=other).faults
    assert fault.startswith("pair_set.calibration is not the hash of")
    with pytest.raises(DatasetError, match="made without a calibration: leave --calibration"):
        check_score(without, calibration=file)


def rewritten(file: Path, change: Callable[[dict], None]) -> None:
    """Change a file and give it the hash that fits."""
    from phibench.calibration.rig.calibration_file import _digest

    raw = json.loads(file.read_text())
    change(raw)
    raw["sha256"] = _digest({key: value for key, value in raw.items() if key != "sha256"})
    file.write_text(json.dumps(raw))


def as_version_1(raw: dict) -> None:
    """Keys, names and the focal length in pixels, as version 1 wrote them; it gave a perfect sphere no rotation."""
    focal = PARAMETERS.index("focal_relative")
    raw["version"] = 1
    raw["believed_rig"] = raw.pop("nominal_rig")
    raw["parameters"] = [{new: old for old, new in RENAMED.items()}.get(name, name) for name in raw["parameters"]]
    raw["values"][focal] *= RIG.camera.fx_px
    for k in range(len(PARAMETERS)):
        raw["covariance"][focal][k] *= RIG.camera.fx_px
        raw["covariance"][k][focal] *= RIG.camera.fx_px
    raw["rig"]["T_camera_sphere"]["rotation"] = raw["believed_rig"]["T_camera_sphere"]["rotation"]


def test_files_of_version_1_are_read(tmp_path: Path) -> None:
    values = 0.5 * prior_sigmas()
    file = written(tmp_path / "c.json", values, RIG, dataset="x")
    new = read_calibration(file, RIG)
    rewritten(file, as_version_1)
    assert '"f_px"' in file.read_text()
    old = read_calibration(file, RIG)
    assert old.values == pytest.approx(values, rel=1e-12)
    assert old.covariance == pytest.approx(COVARIANCE, rel=1e-12)
    assert (old.nominal, old.made_from, old.parameters) == (RIG, {"dataset": "x"}, PARAMETERS)
    assert old.rig.camera == new.rig.camera
    assert old.rig.outline_px(9) == pytest.approx(new.rig.outline_px(9), abs=1e-9)
    file.write_text(file.read_text().replace('"dataset": "x"', '"dataset": "y"'))
    with pytest.raises(CalibrationError, match="was changed"):
        read_calibration(file, RIG)


def far(raw: dict) -> None:
    raw["values"][PARAMETERS.index("tilt_x_rad")] = 0.9


def lopsided(raw: dict) -> None:
    raw["covariance"][0][1] = 1.0


def negative(raw: dict) -> None:
    raw["covariance"][2][2] = -1e-6


def other_rig(raw: dict) -> None:
    raw["values"][PARAMETERS.index("cx_px")] += 1.0


def impossible(raw: dict) -> None:
    raw["values"][PARAMETERS.index("axial_m")] = -0.1
    raw["values"][PARAMETERS.index("radius_m")] = 0.1


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (far, "corrects tilt_x_rad by 0.9: allowed is -0.5 to 0.5"),
        (lopsided, "no covariance"),
        (negative, "no covariance"),
        (other_rig, "not the nominal one with its corrections"),
        (impossible, "one that cannot be|not the nominal one"),
    ],
)
def test_a_file_with_numbers_that_no_calibration_gives(
    tmp_path: Path, change: Callable[[dict], None], complaint: str
) -> None:
    file = written(tmp_path / "c.json", np.zeros(len(PARAMETERS)), RIG)
    read_calibration(file)
    rewritten(file, change)
    with pytest.raises(CalibrationError, match=complaint):
        read_calibration(file)


@pytest.mark.parametrize("command", ["paper", "method", "bench"])
def test_every_command_refuses_a_wrong_file_in_one_sentence(
    misaligned: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture, command: str
) -> None:
    more = {
        "paper": ("paper", misaligned.folder),
        "method": ("score", misaligned.folder, "--method", "detect", "--preset", "mjpeg"),
        "bench": ("bench", misaligned.folder, "--method", "detect", "--out", tmp_path / "b"),
    }[command]
    changed_file = written(tmp_path / "c.json", np.zeros(len(PARAMETERS)), misaligned.samples[0].nominal_rig)
    changed_file.write_text(changed_file.read_text().replace('"chi2": 0.0', '"chi2": 1.0'))
    old = written(tmp_path / "o.json", np.zeros(len(PARAMETERS)), RIG)
    old.write_text(old.read_text().replace('"version": 2', '"version": 0'))
    other = written(tmp_path / "r.json", np.zeros(len(PARAMETERS)), RIG)
    for file, word in (
        (changed_file, "was changed"),
        (old, "version 0"),
        (other, "nominal rig"),
        (tmp_path, "is a folder"),
    ):
        assert run(*more, "--calibration", file) == 2
        said = capsys.readouterr().err
        assert said.count("\n") == 1, said
        assert word in said
