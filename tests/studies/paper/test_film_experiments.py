"""Experiments as films: bursts and the whole stroke of a small film with a known rig, and what is refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
import scipy

from phibench.calibration.rig.bundle import Bundle
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.film.film_read import Film, open_films
from phibench.datasets.read import open_finished
from phibench.estimator.geometry.rig_parameters import PARAMETERS
from phibench.robot.film.film_frames import film_frames, lit_frames
from phibench.studies.paper.film_experiments import (
    COLUMNS,
    FilmProcedure,
    burst_pair,
    bursts,
    closure_interval,
    cut_rig,
    processed_stroke,
    resting_frames,
    run_film_experiments,
    summary,
    whole_stroke,
)

FEW = FilmProcedure(on=2, off=2)


def film_and_bundle(folder: Path) -> tuple[Film, Bundle]:
    film = next(iter(open_films(folder)))
    count = len(PARAMETERS)
    return film, Bundle(film.plan.nominal.rig, np.zeros(count), np.zeros((count, count)), 0.0, 1)


def test_frames_at_rest_are_those_before_and_after_the_stroke(film_windows: Path) -> None:
    film, _ = film_and_bundle(film_windows)
    first, last = resting_frames(film)
    assert first == [0, 1]
    assert last == [8, 9]


def test_frames_are_lit_by_the_code_or_by_turns(film_windows: Path, film_with_rests: Path) -> None:
    film = next(iter(open_films(film_windows)))
    # bits of 0.2 s from the time 0, frames every 0.1 s; the spot's row is read after half an exposure, so that no
    # frame sees an edge of the code
    times, row = film.plan.nominal.times, film.table["row_v_px"].min()
    assert times.row_s(0, row) > 0.5 * times.exposure_s
    on, off, blinks = lit_frames(film, np.arange(len(film)))
    assert blinks
    assert on.tolist() == [0, 1, 2, 3, 6, 7, 8, 9]
    assert off.tolist() == [4, 5]
    on, off, blinks = lit_frames(next(iter(open_films(film_with_rests))), np.arange(5))
    assert not blinks
    assert (on.tolist(), off.tolist()) == ([0, 2, 4], [1, 3])


def test_a_burst_of_a_cut_out_gives_the_depth(film_with_rests: Path) -> None:
    film, bundle = film_and_bundle(film_with_rests)
    found = bursts(film, bundle, FEW, 0)
    assert found.frames == 8
    at = found.depth
    assert at is not None
    # a normal error beyond 5 sigma: 6e-7
    assert abs(at.depth_m - film.light_depth_m) < 5.0 * at.sigma_m
    assert at.sigma_m < 0.1 * at.depth_m


@pytest.mark.slow
def test_processed_frames_on_the_way_add_to_the_bursts(film_processed: Path) -> None:
    """Three cameras: squared pulls of D, and misfits, below their limits of 1e-5; sigma falls, D moves with the rig."""
    film, bundle = film_and_bundle(film_processed)
    wide = replace(bundle, covariance=1e-6 * np.diag([float(name == "stroke_relative") for name in PARAMETERS]))
    mjpeg, depth_m = FilmProcedure("mjpeg", on=2, off=2, sensor={"jpeg_quality": 85}), film.light_depth_m
    pulls, misfits, degrees = [], 0.0, 0
    for camera in range(3):
        ends = bursts(film, bundle, mjpeg, camera)
        whole = processed_stroke(film, bundle, mjpeg, camera, ends)
        assert whole is not None
        assert ends.depth is not None
        assert whole.frames > 3
        assert whole.sigma_m < 0.9 * ends.depth.sigma_m
        pulls.append((whole.depth_m - depth_m) / whole.sigma_m)
        misfits, degrees = misfits + whole.chi2, degrees + 2 * whole.frames - 3
    assert np.sum(np.square(pulls)) < scipy.stats.chi2.ppf(1 - 1e-5, 3)
    assert misfits < scipy.stats.chi2.ppf(1 - 1e-5, degrees)
    # a stroke that is longer by a thousandth makes D larger by as much
    found = processed_stroke(film, wide, mjpeg, 0, bursts(film, wide, mjpeg, 0))
    assert found is not None
    assert found.by_rig_m[-1] == pytest.approx(depth_m, rel=0.1)
    assert found.sigma_m**2 == pytest.approx(whole_sigma_m(film, bundle, mjpeg) ** 2 + (1e-3 * depth_m) ** 2, rel=0.05)


def whole_sigma_m(film: Film, bundle: Bundle, procedure: FilmProcedure) -> float:
    found = processed_stroke(film, bundle, procedure, 0, bursts(film, bundle, procedure, 0))
    assert found is not None
    return found.sigma_m


def test_the_whole_stroke_gives_the_depth(film_with_rests: Path) -> None:
    film, bundle = film_and_bundle(film_with_rests)
    found, light = whole_stroke(film, bundle, FEW, 0)
    assert abs(found.depth_m - film.light_depth_m) < 5.0 * found.sigma_m
    assert light.film_m == pytest.approx(found.sigma_m, rel=0.05)  # the rig is known: pixels and encoder are all
    assert light.gain > 0.0


def test_a_cut_camera_sees_the_same_rays(film_with_rests: Path) -> None:
    film, bundle = film_and_bundle(film_with_rests)
    region = film.info.region
    corner = np.array([region.u0_px, region.v0_px])
    uv = np.array([[40.0, 30.0], [60.5, 33.25]])
    camera, cut = bundle.rig.camera, cut_rig(bundle.rig, film.info).camera
    # the principal point is moved by whole pixels
    np.testing.assert_allclose(cut.rays(uv - corner), camera.rays(uv), atol=1e-14)
    pair = burst_pair(film, bundle, FEW, 0)
    assert pair.down.shape == region.shape
    assert pair.count("up_off") == 2
    processed = burst_pair(film, bundle, replace(FEW, preset="mjpeg", sensor={"jpeg_quality": 85}), 0)
    assert processed.stack("down").shape == (2, *region.shape, 3)


def test_what_does_not_go_together_is_one_sentence(film_windows: Path, tiny_dataset: Path) -> None:
    film, bundle = film_and_bundle(film_windows)
    with pytest.raises(DatasetError, match="rests down for 2 frames, two with the laser on"):
        burst_pair(film, bundle, FEW, 0)
    with pytest.raises(DatasetError, match="off in 0; two on and one off"):
        film_frames(film, frames=np.arange(4))
    with pytest.raises(DatasetError, match="make both of one recipe"):
        run_film_experiments(open_films(film_windows), open_finished(tiny_dataset), FEW)


def test_summary_of_rows() -> None:
    rows = pl.DataFrame(
        [
            ("f", "e", "r", k, "burst", 2.0, error, 0.02, 4, 0.01, 0.02, [0.0])
            for k, error in enumerate((0.02, -0.02, 0.06, float("nan")))
        ],
        schema=list(COLUMNS),
        orient="row",
    )
    (row,) = summary(rows).iter_rows(named=True)
    assert row["films"] == 3
    assert row["rms"] == pytest.approx(np.sqrt((1 + 1 + 9) / 3) * 0.01)
    assert row["predicted"] == pytest.approx(0.01)
    assert row["within_95"] == pytest.approx(2 / 3)
    assert row["gain"] == pytest.approx(4.0)


@pytest.mark.parametrize(("common", "degrees"), [(0.0, 20), (0.02, 1)])
def test_the_interval_of_a_right_budget_knows_what_rows_share(common: float, degrees: int) -> None:
    """Ends of the root of chi-square over its degrees: 20 of independent rows, 1 of rows with one common error."""
    rows = pl.DataFrame(
        [("f", "e", "r", k, "burst", 2.0, 0.0, 0.02, 4, 0.01, 0.02, [common, 0.0]) for k in range(20)],
        schema=list(COLUMNS),
        orient="row",
    )
    # 4000 draws: a quantile of 2.5 % is good to 2.5e-3 in probability; tails of one degree are flat below
    expected = np.sqrt(scipy.stats.chi2.ppf([0.025, 0.975], degrees) / degrees)
    np.testing.assert_allclose(closure_interval(rows), expected, rtol=0.06, atol=0.02)
    # 20 cameras: their lower ends have nothing in common; of one camera half of the variance is a single number
    np.testing.assert_allclose(closure_interval(rows, True), expected, rtol=0.06, atol=0.02)
    low, high = closure_interval(rows.with_columns(camera=pl.lit(0)), True)
    assert high > 1.5 if common == 0.0 else high > 2.0
    assert low < expected[0] + 0.05
