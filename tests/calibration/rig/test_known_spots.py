"""Calibration spots from camera frames, with measured places, and the command that takes them."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import scipy

from phibench.calibration.rig.bundle import vertical_by_principal_point
from phibench.calibration.rig.calibration_file import read_calibration
from phibench.calibration.rig.from_dataset import CalibrationSources, calibrate_dataset, frame_spots
from phibench.calibration.rig.known_spots import Ruler, known_spot, one_per_pose
from phibench.cli.main import main
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.read import Dataset, open_finished
from phibench.estimator.drawn_pairs import pairs_of
from phibench.estimator.geometry.rig_parameters import PARAMETERS, has_effect, prior_sigmas
from phibench.estimator.interface import Answer, Spot
from phibench.estimator.methods.registry import method_for
from phibench.studies.paper.experiment_tables import Procedure, run_experiments

EVERYTHING = Ruler(distance_m=2e-3, height_m=5e-3, azimuth_rad=0.01)


@pytest.fixture(scope="module")
def smoke(smoke_dataset: Path) -> Dataset:
    return open_finished(smoke_dataset)


@pytest.fixture(scope="module")
def tiny(tiny_dataset: Path) -> Dataset:
    return open_finished(tiny_dataset)


def found(u_px: float = 1.0) -> Spot:
    return Spot((u_px, 2.0), ((0.01, 0.0), (0.0, 0.01)))


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["mjpeg", "bayer-raw", "srgb8", "mono-raw"])
def test_frames_of_every_preset_calibrate(smoke: Dataset, tmp_path: Path, preset: str) -> None:
    """The nominal rig is the true one: corrections stay within 5 posterior sigmas, which 13 normal numbers leave in
    1e-5 of the cases. MJPEG outlines understate their sigma across the axis by up to 2, which the bound of 5 allows for
    (docs/measurements/calibration.md).
    """
    ids = [row.sample_id for row in smoke.rows]
    out = tmp_path / "c.json"
    with_spots, ruler = CalibrationSources(spots=True), Ruler(height_m=5e-3)
    bundle = calibrate_dataset(smoke.folder, out, ids, preset, with_spots, ruler).bundle
    sigma = np.sqrt(np.diag(bundle.covariance))
    free = has_effect(smoke.rig)  # a sphere's own tilts have none: their value and sigma are 0
    assert np.count_nonzero(free) == 13
    assert np.all(np.abs(bundle.values[free]) < 5.0 * sigma[free])
    assert not bundle.values[~free].any()
    assert np.all(sigma <= prior_sigmas() * (1.0 + 1e-9))
    assert bundle.sigmas["decentre_x_m"] < 0.7e-3  # the prior has 1 mm
    made = json.loads(out.read_text())["made_from"]
    assert made["preset"] == preset
    assert len(made["spot_depth_m"]) == len(ids) == 3
    assert len(made["sphere_in_camera_m"]) == 3  # poses: down is shared


def test_places_are_the_truth_plus_an_error_of_the_stated_size(tiny: Dataset) -> None:
    """One spot, read under 400 names of the data set: errors over sigma are normal, chi-square at 1e-4 for each."""
    sample = tiny["seen-near-h0.500"]
    pair = pairs_of(tiny, [sample], "bayer-raw").pair(0)
    answer, errors = Answer(found(), found()), []
    flat = np.array(sample.row.spot_world_m)[:2] - np.array(sample.row.down.sphere_centre_world_m)[:2]
    truth = np.array([sample.row.depth_m, sample.row.spot_world_m[2], math.atan2(flat[1], flat[0])])
    sigma = np.array([2e-3, 5e-3, 0.01])
    for k in range(400):
        info = tiny.info.model_copy(update={"name": f"n{k}"})
        other = type(sample)(type(tiny)(tiny.folder, info, tiny.rigs, tiny.rooms, tiny.rows), sample.row)
        spot = known_spot(other, pair, answer, EVERYTHING)
        assert (spot.depth_sigma_m, spot.height_sigma_m, spot.azimuth_sigma_rad) == tuple(sigma)
        errors.append((np.array([spot.depth_m, spot.height_m, spot.azimuth_rad]) - truth) / sigma)
    squares = np.sum(np.square(errors), axis=0)
    low, high = scipy.stats.chi2.ppf([5e-5, 1.0 - 5e-5], 400)
    assert np.all((low < squares) & (squares < high))
    assert not np.any((low < 1.5 * squares) & (1.5 * squares < high))  # a sigma 1.22 times too small is noticed
    correlation = np.corrcoef(np.array(errors).T)[np.triu_indices(3, 1)]
    assert np.abs(correlation).max() < 4.2 / math.sqrt(400)  # streams of their own: 8e-5 for three


def test_what_was_not_measured_has_no_say(tiny: Dataset) -> None:
    sample = tiny["seen-near-h0.500"]
    pair = pairs_of(tiny, [sample], "bayer-raw").pair(0)
    spot = known_spot(sample, pair, Answer(found(), found()), Ruler())
    assert spot.height_sigma_m == spot.azimuth_sigma_rad == math.inf
    assert spot.depth_sigma_m == 1e-3
    assert spot.depth_m != sample.row.depth_m


@pytest.mark.parametrize(
    ("numbers", "word"),
    [({"distance_m": 0.0}, "distance"), ({"distance_m": math.inf}, "distance"), ({"height_m": -1.0}, "height")]
    + [({"azimuth_rad": math.nan}, "azimuth"), ({"height_m": 2e3}, "height")],
)
def test_a_ruler_of_no_precision_is_refused(numbers: dict[str, float], word: str) -> None:
    with pytest.raises(DatasetError, match=f"{word} = .*: must be above 0"):
        Ruler(**numbers)


def test_spots_that_were_not_found_are_refused(tiny: Dataset) -> None:
    sample = tiny["seen-near-h0.500"]
    pair = pairs_of(tiny, [sample], "bayer-raw").pair(0)
    with pytest.raises(DatasetError, match=r"seen-near-h0.500 up: no spot to calibrate with: too dark"):
        known_spot(sample, pair, Answer(found(), Spot.missing("too dark")), Ruler())
    with pytest.raises(DatasetError, match="down: no spot to calibrate with: no covariance of its place"):
        known_spot(sample, pair, Answer(Spot((1.0, 2.0)), found()), Ruler())
    hidden = next(s for s in tiny if not s.row.down.visible)
    with pytest.raises(DatasetError, match="down: no spot to calibrate with"):
        frame_spots(tiny, [hidden], "bayer-raw", Ruler())
    assert frame_spots(tiny, [hidden], "bayer-raw", Ruler(), least=0) == []
    with pytest.raises(DatasetError, match="down: no spot to calibrate with"):
        frame_spots(tiny, [hidden], "bayer-raw", Ruler(), least=1)


def test_the_method_is_the_one_that_reaches_the_limit(tiny: Dataset) -> None:
    names = {
        preset: method_for(pairs_of(tiny, tiny.samples[:1], preset).pair(0).card).name
        for preset in ("mjpeg", "srgb8", "bayer-raw", "mono-raw")
    }
    assert names == {
        **dict.fromkeys(("mjpeg", "srgb8"), "chain_fit"),
        **dict.fromkeys(("bayer-raw", "mono-raw"), "raw_maximum_likelihood"),
    }


def test_every_pose_gives_one_outline(tiny: Dataset) -> None:
    poses = [sample.row.position(position).pose for sample, position in one_per_pose(tiny.samples)]
    assert sorted(poses) == sorted(pose.pose for pose in tiny.info.poses)


def test_pairs_of_samples_keep_their_order(tiny: Dataset) -> None:
    backwards = tiny.samples[::-1]
    pairs = pairs_of(tiny, backwards, "mjpeg", draws=2, laser_off=False)
    assert [(t.sample_id, t.draw) for t in pairs.pair_draws] == [
        (s.row.sample_id, k) for s in backwards for k in (0, 1)
    ]
    assert [pairs.pair(n).number for n in range(len(pairs))] == list(range(len(pairs)))
    assert pairs.pair(0).down_off is None
    assert np.array_equal(pairs.image(1, "up", True), pairs.pair(1).up)


def test_experiments_need_calibration_spots(tiny: Dataset) -> None:
    with pytest.raises(DatasetError, match="rig rig has no experiment 'calibration'"):
        run_experiments(tiny, Procedure("bayer-raw"))
    with pytest.raises(DatasetError, match="no sample has the rig 'r9'; known: rig"):
        run_experiments(tiny, Procedure("bayer-raw"), rigs=["r9"])


def test_the_command_refuses_in_one_sentence(tiny: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    common = ["calibrate", str(tiny.folder), "--out", str(tmp_path / "c.json"), "--spots"]
    hidden = next(s.row.sample_id for s in tiny if not s.row.down.visible)
    for more, word in (
        (["--distance-sigma-m", "0"], "distance"),
        (["--azimuth-sigma-deg", "-1"], "azimuth"),
        (["--sample", "nobody"], "no sample 'nobody'"),
        (["--sample", hidden], "spot"),
        (["--preset", "kodak"], "kodak"),
    ):
        preset = [] if "--preset" in more else ["--preset", "bayer-raw"]
        assert main([*common, *preset, *more]) == 2, more
        said = capsys.readouterr().err
        assert said.count("\n") == 1, said
        assert word in said or "mirror" in said
    assert not (tmp_path / "c.json").exists()


@pytest.mark.slow
def test_upright_edges_give_the_tilt(smoke: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The nominal rig is the true one: all stays within 5 sigmas. Measured is the tilt with the principal point.

    A principal point 5 px off turns the edges' vertical by 2.9e-3 rad, so that the tilt alone is not known better
    than that, and together with 5.8e-4 rad/px of the principal point it is known to some 4e-4 rad an image.
    """
    plain, upright = tmp_path / "plain.json", tmp_path / "upright.json"
    without = calibrate_dataset(smoke.folder, plain).bundle
    assert main(["calibrate", str(smoke.folder), "--preset", "layers", "--vertical", "--out", str(upright)]) == 0
    assert "tilt_x_rad" in capsys.readouterr().out
    rig = smoke.samples[0].nominal_rig
    found = read_calibration(upright, rig)
    sigma, slope = np.sqrt(np.diag(found.covariance)), vertical_by_principal_point(rig)[0, 0]
    assert slope == pytest.approx(5.8e-4, rel=0.02)
    assert np.all(np.abs(found.values) < 5.0 * sigma + 1e-12)
    for tilt, centre in (("tilt_x_rad", "cy_px"), ("tilt_y_rad", "cx_px")):
        k, c = PARAMETERS.index(tilt), PARAMETERS.index(centre)
        assert without.sigmas[tilt] > 4e-3
        assert 2e-3 < sigma[k] < 3e-3
        both = [found.covariance[k, k] + 2.0 * x * found.covariance[k, c] + x**2 * found.covariance[c, c]
                for x in (slope, -slope)]  # fmt: skip
        assert np.sqrt(min(both)) < 1.2e-3
    made = [json.loads(path.read_text())["made_from"]["vertical_in_camera"] for path in (plain, upright)]
    assert made[0] is None
    assert len(made[1]) == 2


def test_errors_of_places_are_about_spots(smoke: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["calibrate", str(smoke.folder), "--height-sigma-m", "0.01", "--out", str(tmp_path / "c.json")]) == 2
    assert "give --spots too" in capsys.readouterr().err
