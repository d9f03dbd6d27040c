"""Records of dense scores: oracles score 0, parts of the error add up, and metrics are what loops make of them."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.dense_truths import smaller, truth_of
from helpers.oracles import random_rig
from helpers.revolved_rigs import revolved

from phibench.benchmark.dense.dense_pairs import DenseTruth
from phibench.benchmark.dense.dense_records import COLUMNS, TruthErrors, ause, pair_records
from phibench.estimator.dense.dense_interface import DenseAnswer
from phibench.render.optics.ray_tracer import trace_pixels
from phibench.scenes.misalignment import Misalignment
from phibench.scenes.room import default_rig

ROUNDING = 1e-9


@pytest.fixture(scope="module")
def truth() -> DenseTruth:
    return truth_of(smaller(default_rig()))


@pytest.fixture(scope="module")
def errors(truth: DenseTruth) -> TruthErrors:
    return TruthErrors(truth)


def test_perfect_answers_score_nothing(truth: DenseTruth, errors: TruthErrors) -> None:
    """D itself, and the place in the other image, which the score makes D of."""
    for answer in (DenseAnswer(truth.depth_m), DenseAnswer(target_uv_px=truth.found.uv_px)):
        table = pair_records(errors, answer, 0.1)
        assert table.columns == list(COLUMNS)
        for name in ("median", "mean", "p90", "bias", "above_2", "mae_m", "disparity_mae_deg", "seam_m", "calibration"):
            assert np.abs(table[name].drop_nulls().to_numpy()).max() < ROUNDING, name
        assert (table["recall"] == 1.0).all()
        assert (table["answered"] == 1.0).all()
        assert len(table) > 10


def test_an_unanswered_pair_has_no_errors(errors: TruthErrors) -> None:
    table = pair_records(errors, None, 1.0, "error", "it broke")
    assert table["median"].null_count() == len(table)
    assert (table["recall"] == 0.0).all()
    assert (table["answered"] == 0.0).all()
    assert set(table["message"]) == {"it broke"}


def test_metrics_by_loops_over_pixels(truth: DenseTruth, errors: TruthErrors) -> None:
    rng = np.random.default_rng(3)
    relative = 0.05 * rng.normal(size=truth.depth_m.shape)
    depth = np.where(rng.random(relative.shape) < 0.6, truth.depth_m * (1.0 + relative), np.nan)
    row = pair_records(errors, DenseAnswer(depth, sigma_depth_m=0.05 * truth.depth_m), 0.1).row(0, named=True)
    sizes, total, squares, metres, within = [], 0, 0.0, 0.0, 0
    for v, u in np.argwhere(truth.scored):
        total += 1
        if np.isnan(depth[v, u]):
            continue
        e = depth[v, u] / truth.depth_m[v, u] - 1.0
        sizes.append(abs(e))
        squares += e * e
        metres += abs(depth[v, u] - truth.depth_m[v, u])
        within += abs(depth[v, u] - truth.depth_m[v, u]) <= 1.959963984540054 * 0.05 * truth.depth_m[v, u]
    n = len(sizes)
    recall = np.mean([sum(e <= t for e in sizes) for t in (0.005, 0.01, 0.02, 0.05, 0.1, 0.2)]) / total
    expected = {
        "pixels": total,
        "answered": n / total,
        "median": sorted(sizes)[n // 2],
        "mean": sum(sizes) / n,
        "square": squares / n,
        "above_5": sum(e > 0.05 for e in sizes) / n,
        "recall": recall,
        "mae_m": metres / n,
        "coverage": within / n,
    }
    for name, value in expected.items():
        assert row[name] == pytest.approx(value, rel=1e-4 if name == "median" else 1e-9), name
    # 95 % of Gaussian errors of the claimed size, to 4 of 0.22 / sqrt(n)
    assert row["coverage"] == pytest.approx(0.95, abs=4.0 * 0.22 / n**0.5)


def test_the_sparsification_curve_by_its_definition() -> None:
    rng = np.random.default_rng(5)
    error, sigma = rng.exponential(size=400), rng.exponential(size=400)
    assert ause(error, error) == 0.0
    shares, curves = np.arange(100) / 100.0, []
    for key in (sigma, error):
        order = sorted(range(400), key=lambda i: key[i])
        curves.append([np.mean([error[i] for i in order[: round(400 * (1 - s))]]) for s in shares])
    area = np.trapezoid(np.subtract(*curves), shares) / error.mean()
    assert ause(error, sigma) == pytest.approx(area, rel=1e-9)
    assert ause(error, -error) > ause(error, sigma) > 0.0


def test_a_hyperboloid_in_its_focus_is_central_and_a_sphere_is_not(errors: TruthErrors) -> None:
    focus = TruthErrors(truth_of(smaller(revolved("hyperboloid"))))
    seen = focus.truth.scored
    assert seen.sum() > 5000
    assert np.nanmax(np.abs(focus.central[seen])) < ROUNDING
    sphere = np.abs(errors.central[errors.truth.scored])
    assert np.median(sphere) > 1e-3
    row = pair_records(errors, DenseAnswer(errors.truth.depth_m), 0.1).row(0, named=True)
    assert row["central"] == pytest.approx(np.median(sphere), rel=1e-6)
    assert row["central_p90"] == pytest.approx(np.quantile(sphere, 0.9), rel=1e-6)


def test_the_error_of_a_rig_is_the_calibrations_part(errors: TruthErrors) -> None:
    """Perfect matches seen through the nominal rig: all of the error is calibration, and none is matching."""
    nominal = smaller(default_rig())
    true = nominal.perturbed(Misalignment(tilt_x_rad=0.01))
    wrong = TruthErrors(truth_of(true, given=nominal))
    row = pair_records(wrong, DenseAnswer(target_uv_px=wrong.truth.found.uv_px), 0.1).row(0, named=True)
    assert row["calibration"] > 1e-3
    assert row["median"] == pytest.approx(row["calibration"], rel=1e-12)
    assert row["matching"] < ROUNDING
    exact = TruthErrors(replace(wrong.truth, given_rig=true))
    assert np.nanmax(np.abs(exact.calibration)) < ROUNDING


def test_disparity_is_the_angle_between_both_centres_views() -> None:
    """Of a misaligned rig: by the points of the truth, and by the law of cosines at a wrong D."""
    truth = truth_of(smaller(random_rig(np.random.default_rng(2))))
    errors, X = TruthErrors(truth), truth.found.point_world_m
    centres = [truth.true_rig.at(h).sphere_centre_m for h in (0.0, truth.stroke_m)]
    a, b = (X - centre for centre in centres)
    cosine = (a * b).sum(axis=2) / np.linalg.norm(a, axis=2) / np.linalg.norm(b, axis=2)
    found = errors.true_disparity_rad
    assert np.nanmax(np.abs(np.cos(found) - cosine)[truth.scored]) < 1e-12
    assert np.nanmedian(errors.disparity_rad(1.1 * truth.depth_m)[truth.scored] / found[truth.scored]) < 1.0


def test_the_seam_compares_both_of_its_sides(truth: DenseTruth, errors: TruthErrors) -> None:
    """An answer that is 0.3 m too far on one side of the seam alone is 0.3 m inconsistent."""
    middle = int(np.floor(truth.given_rig.camera.project(truth.given_rig.sphere_in_camera_m)[1]))
    depth = truth.depth_m.copy()
    depth[: middle + 1] += 0.3
    row = pair_records(errors, DenseAnswer(depth), 0.1).row(0, named=True)
    assert row["seam_m"] == pytest.approx(0.3, rel=1e-9)


def test_the_seam_is_the_consistency_error_as_published(truth: DenseTruth, errors: TruthErrors) -> None:
    """First and last column of a panorama, row by row, as Helvipad's code sums them; its edges by azimuths alone."""
    rng = np.random.default_rng(8)
    depth = truth.depth_m * (1.0 + 0.1 * rng.normal(size=truth.depth_m.shape))
    depth[rng.random(depth.shape) < 0.2] = np.nan
    X = truth.found.point_world_m - truth.true_rig.at(0.0).sphere_centre_m
    azimuth = np.where(X[..., 0] < 0.0, np.arctan2(X[..., 1], X[..., 0]), np.nan)  # behind the robot
    total, count = 0.0, 0
    for u in np.flatnonzero(np.isfinite(azimuth).any(axis=0)):
        positive, negative = (np.where(sign * azimuth[:, u] > 0.0, np.abs(azimuth[:, u]), -1.0) for sign in (1, -1))
        first, last = int(positive.argmax()), int(negative.argmax())  # left edge of the panorama, and right edge
        if min(positive[first], negative[last]) < 0.0:
            continue
        ends = [(v, u) for v in (first, last)]
        if not all(truth.scored[end] and np.isfinite(depth[end]) for end in ends) or abs(first - last) != 1:
            continue
        true, given = (plane[ends[0]] - plane[ends[1]] for plane in (truth.depth_m, depth))
        total, count = total + abs(true - given), count + 1
    assert count > 20
    row = pair_records(errors, DenseAnswer(depth), 0.1).row(0, named=True)
    assert row["seam_m"] == pytest.approx(total / count, rel=1e-12)


def test_disparity_and_range_obey_helvipads_corrected_formula(truth: DenseTruth, errors: TruthErrors) -> None:
    """range = B (sin / tan(disparity) - cos) of the angle from straight down; the first release had + cos.

    Points of a wrong answer are those of the renderer's rays. Means are the published ones, over all answered pixels.
    """
    down, stroke_m = truth.true_rig.at(0.0), truth.stroke_m
    depth = np.where(truth.scored, 1.07 * truth.depth_m, np.nan)
    v, u = np.nonzero(truth.scored)
    ray = trace_pixels(down, np.stack([u, v], axis=1).astype(float))
    out, way = (ray.points_m - down.sphere_centre_m)[:, :2], ray.directions[:, :2]
    a, b, c = (way**2).sum(axis=1), (out * way).sum(axis=1), (out**2).sum(axis=1) - depth[v, u] ** 2
    t = (-b + np.sqrt(b * b - a * c)) / a
    points = {"true": truth.found.point_world_m[v, u], "given": ray.points_m + t[:, None] * ray.directions}
    degrees = {}
    for name, X in points.items():
        reach = np.linalg.norm(X - down.sphere_centre_m, axis=1)
        theta = np.arccos((down.sphere_centre_m - X)[:, 2] / reach)  # from straight down
        disparity = np.arctan2(stroke_m * np.sin(theta), reach + stroke_m * np.cos(theta))
        again = stroke_m * (np.sin(theta) / np.tan(disparity) - np.cos(theta))
        assert np.abs(again / reach - 1.0).max() < ROUNDING
        legacy = stroke_m * (np.sin(theta) / np.tan(disparity) + np.cos(theta))
        assert np.median(np.abs(legacy / reach - 1.0)) > 0.05
        degrees[name] = np.degrees(disparity)
    off = degrees["given"] - degrees["true"]
    row = pair_records(errors, DenseAnswer(depth), 0.1).row(0, named=True)
    expected = {
        "disparity_mae_deg": np.abs(off).mean(),
        "disparity_square_deg2": (off**2).mean(),
        "disparity_mare": np.abs(off / degrees["true"]).mean(),
        "mae_m": 0.07 * truth.depth_m[v, u].mean(),
        "square_m2": 0.07**2 * (truth.depth_m[v, u] ** 2).mean(),
        "mean": 0.07,
    }
    for name, value in expected.items():
        assert row[name] == pytest.approx(value, rel=1e-7), name


CENTRAL = {
    "sphere": (0.554, 0.470, 0.325),
    "paraboloid": (0.294, 0.249, 0.172),
    "hyperboloid off axis": (0.0194, 0.0187, 0.0161),
    "hyperboloid": (0.0, 0.0, 0.0),
}
"""Median cost of the central model in the lab, % of D, at strokes of 0.10, 0.425 and 1.40 m: docs/dense.md."""


@pytest.mark.slow
@pytest.mark.parametrize("shape", CENTRAL)
def test_what_the_central_model_costs(shape: str) -> None:
    """Of perfect matches through the exact rig, a quarter of the pixels along each side."""
    name, *off = shape.split(maxsplit=1)
    rig = default_rig() if name == "sphere" else revolved(name, aligned=not off)
    for stroke_m, expected in zip((0.1, 0.425, 1.4), CENTRAL[shape], strict=True):
        errors = TruthErrors(truth_of(smaller(rig), stroke_m))
        cost = 100.0 * np.abs(errors.central - errors.calibration)[errors.truth.scored]
        print(f"{shape}, h = {stroke_m} m: median {np.median(cost):.3g} %, 90 % below {np.quantile(cost, 0.9):.3g} %")
        assert np.median(cost) == pytest.approx(expected, rel=5e-3, abs=100.0 * ROUNDING)


def test_glossy_and_matt_surfaces_are_strata_where_there_are_both(truth: DenseTruth) -> None:
    upper = np.arange(truth.depth_m.shape[0])[:, None] < truth.depth_m.shape[0] // 2
    shiny = replace(truth, found=replace(truth.found, glossy=np.broadcast_to(upper, truth.depth_m.shape)))
    parts = {label: mask for by, label, mask in TruthErrors(shiny).strata if by == "gloss"}
    assert np.array_equal(parts["glossy"], upper & truth.scored)
    assert np.array_equal(parts["matt"], ~upper & truth.scored)
    assert "gloss" not in {by for by, _, _ in TruthErrors(truth).strata}
