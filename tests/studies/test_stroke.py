"""Study `stroke`: the drawn rigs, intervals of an rms, findings of made-up numbers, and a tiny run."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from phibench.datasets.common.errors import DatasetError
from phibench.estimator.geometry.rig_parameters import PARAMETERS, PRIOR_SIGMA, prior_sigmas
from phibench.estimator.limits.best_stroke import LARGEST, BestStroke
from phibench.estimator.limits.stroke_curve import CEILING, FREE, StrokeCurve
from phibench.scenes.random_streams import generator
from phibench.scenes.rig import Rig
from phibench.studies.framework import Finding, StudyDatasets, read_settings
from phibench.studies.stroke.perturbed_rigs import RenderedCheck, RenderedOutcome, deviations
from phibench.studies.stroke.study import AS_BUILT, CALIBRATED, EXACT, STUDY, tolerances
from phibench.studies.stroke.tables import (
    best_findings,
    check_findings,
    growth,
    growth_findings,
    limit_findings,
    reason_findings,
    theta_rad,
)

TINY = """
preset = "bayer-raw"
depths_m = [1.0]
spot_height_m = 0.5
strokes_m = [0.4, 1.4]
outline_sigma_um = [8.0, 8.0, 24.0]
paper_depths_m = [1.0]
paper_strokes_m = [1.4]
[check]
preset = "bayer-raw"
depths_m = [1.0]
power_mw = 0.3
factors = [0.3, 1.0]
strokes_m = [0.4, 1.6]
draws = 8
"""


def _best(sigmas: list[float], limits: tuple[str, ...] = (), causes: tuple[str, ...] | None = None) -> BestStroke:
    strokes, zero = np.linspace(0.2, 1.4, len(sigmas)), np.zeros(len(sigmas))
    curve = StrokeCurve(strokes, np.array(sigmas), zero, zero, zero, causes or (FREE,) * len(sigmas))
    k = int(np.argmin(sigmas))
    return BestStroke(2.0, float(strokes[k]), sigmas[k], sigmas[k], 0.0, 0.0, 0.0, limits, curve)


def _checked(factor: float, predicted: float, size: float, n: int = 400, name: str = AS_BUILT) -> RenderedOutcome:
    check = RenderedCheck(name, 1.0, 0.5 * factor, factor, predicted, (), 0.5, "bayer-raw", 0.3, n)
    return RenderedOutcome(check, tuple(np.resize([size, -size], n).tolist()))


def test_drawn_rigs_have_the_covariance() -> None:
    # a full covariance of rank 4 with units from 1e-5 to 10; the relative error of a variance is sqrt(2 / n) = 2.2 %
    random, n = generator("test", "deviations"), 4000
    A = random.standard_normal((len(PARAMETERS), 4)) * prior_sigmas()[:, None]
    C = A @ A.T
    x = np.stack([deviations(C, ("test", k)) for k in range(n)])
    scale = np.sqrt(np.diag(C))
    correlation = (x.T @ x / n) / np.outer(scale, scale)
    # the standard error of an element is at most sqrt(2 / n); 5 of them for 256 elements: wrong once in 10 000
    assert np.abs(correlation - C / np.outer(scale, scale)).max() < 5.0 * math.sqrt(2.0 / n)
    assert np.abs(correlation - np.eye(len(PARAMETERS))).max() > 0.3  # which it would not be without the covariances
    assert not deviations(np.zeros((len(PARAMETERS),) * 2), ("test", 0)).any()


def test_intervals_of_an_rms_cover() -> None:
    # 200 samples of 48 normal numbers: a rate of 95 % is seen to 1.5 %; 4 sigma. BCa itself lacks a per cent or two
    random = generator("test", "rms")
    covered = [
        _inside(RenderedOutcome(_checked(1.0, 1.0, 1.0).check, tuple(random.standard_normal(48)))) for _ in range(200)
    ]
    assert 0.87 < np.mean(covered) <= 1.0
    wrong = [
        _inside(RenderedOutcome(_checked(1.0, 1.0, 1.0).check, tuple(1.5 * random.standard_normal(20))))
        for _ in range(99)
    ]
    assert np.mean(wrong) < 0.5


def _inside(checked: RenderedOutcome) -> bool:
    low, high = checked.rms_m.low, checked.rms_m.high
    return bool(low <= 1.0 <= high) and checked.fits


def test_calibrated_rigs_are_between_the_others() -> None:
    found = tolerances(Rig(), (8.0, 8.0, 24.0))
    spread = {name: np.sqrt(np.diag(C)) for name, C in found.items()}
    assert spread[AS_BUILT] == pytest.approx([PRIOR_SIGMA[name] for name in PARAMETERS])
    assert not spread[EXACT].any()
    assert np.all(spread[CALIBRATED] <= spread[AS_BUILT] * (1.0 + 1e-9))
    assert spread[CALIBRATED][PARAMETERS.index("decentre_x_m")] < spread[AS_BUILT][PARAMETERS.index("decentre_x_m")]


def test_growth_is_told_from_a_limit() -> None:
    falls, grows = _best([4e-3, 3e-3, 2e-3], (LARGEST,)), _best([4e-3, 2e-3, 3e-3])
    assert growth(falls, 1.4) == 1.0
    assert growth(grows, 1.4) == pytest.approx(1.5)
    assert growth(grows, 0.8) == 1.0  # up to there it has only fallen
    falling, growing = growth_findings({("a", 2.0): falls, ("b", 2.0): grows}, 2.0, ("a", "b"), 1.4)
    assert (falling.value, falling.verdict) == (1.0, "met")
    assert (growing.value, growing.verdict) == (pytest.approx(1.5), "missed")
    assert growing.label == "b, D = 2 m: error at h = 1.4 m over the smallest"


def _of_best(best: BestStroke) -> dict[str, float | None]:
    return {f.label: f.value for f in best_findings({("a", 2.0): best}, "a", (2.0,))}


def test_best_strokes_with_and_without_limit_or_stroke() -> None:
    assert _of_best(_best([4e-3, 3e-3, 2e-3], (LARGEST,))) == {
        "a, D = 2 m: best stroke": pytest.approx(1.4),
        "a, D = 2 m: limit of the stroke (longest stroke)": pytest.approx(1.4),
        "a, D = 2 m: shortest stroke within 5 % of the smallest error": pytest.approx(1.4),
        "a, D = 2 m: longest stroke within 5 % of the smallest error": pytest.approx(1.4),
        "a, D = 2 m: sigma of D": 2.0,
        "a, D = 2 m: relative sigma of D": pytest.approx(0.1),
        "a, D = 2 m: part of sigma beyond first order": 0.0,
    }
    assert not any("limit" in label for label in _of_best(_best([4e-3, 2e-3, 3e-3])))
    nan = (math.nan,) * 6
    none = BestStroke(2.0, *nan, (CEILING,), _best([1.0, 1.0]).curve)
    assert _of_best(none) == {"a, D = 2 m: no stroke, ceiling": None}


def test_what_stands_in_the_way_first() -> None:
    near, far = (
        _best([1.0, 1.0, 1.0], (), causes).curve for causes in ((FREE, FREE, CEILING), (FREE, CEILING, CEILING))
    )
    (found,) = limit_findings({1.0: near, 4.0: far})
    assert (found.label, found.value) == (
        "without the carriage's limit: ceiling, first at D = 4 m, from h",
        pytest.approx(0.8),
    )
    (nothing,) = limit_findings({1.0: _best([1.0, 1.0]).curve})
    assert "nothing forbids" in nothing.label


def test_reason_names_the_costliest_parameter() -> None:
    rig = Rig()
    # the sphere is at 0.71 m, the spot 0.21 m below it
    assert theta_rad(rig, 2.18, 0.5, 0.0) == pytest.approx(math.atan2(2.18, 0.21))
    found = list(reason_findings(rig, 2.18, 0.5, (0.8, 1.4)))
    assert found[0].value == pytest.approx(84.5, abs=0.05)
    assert len(found) == 5
    assert all(any(f"({name})" in f.label for name in PARAMETERS) for f in found[3:])


def _of_checks(checks: list[RenderedOutcome]) -> dict[str, Finding]:
    return {f.label.removeprefix(f"frames, {AS_BUILT}: "): f for f in check_findings(checks)}


def test_checks_are_judged_by_their_intervals() -> None:
    good = [_checked(0.5, 2.0, 2.0), _checked(1.0, 1.0, 1.0), _checked(2.0, 1.5, 1.5)]
    found = _of_checks(good)
    assert found["measured rms over predicted sigma, mean"].value == pytest.approx(1.0)
    assert found["pairs of a cell, least"].value == 400
    inside = found["predictions in the 95 % interval"]
    assert (inside.value, inside.unit) == (3, "of 3 cells")
    assert found["strokes surely better than the best"].verdict == "met"
    worse = found["strokes surely worse than the best"]
    assert (worse.value, worse.unit) == (2, "of 2")
    beaten = _of_checks([*good[:2], _checked(2.0, 1.5, 0.5)])
    assert beaten["strokes surely better than the best"].verdict == "missed"
    assert beaten["predictions in the 95 % interval"].value == 2
    assert len(list(check_findings([*good, _checked(1.0, 1.0, 1.0, name=EXACT)]))) == 14


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('preset = "bayer-raw"\ndepths', 'preset = "bayer"\ndepths', ("preset", "'mjpeg'")),
        ("factors = [0.3, 1.0]", "factors = [0.3]", ("check.factors = [0.3]", "hold 1.0")),
        ("paper_strokes_m = [1.4]", "paper_strokes_m = [1.4, 1.0]", ("1 entries", "2: give as many")),
        ("spot_height_m = 0.5", "spot_height_m = 9.0", ("spot_height_m",)),
    ],
)
def test_bad_settings(tmp_path: Path, old: str, new: str, words: tuple[str, ...]) -> None:
    file = tmp_path / "stroke.toml"
    file.write_text(TINY.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(DatasetError) as caught:
        STUDY.run(read_settings(STUDY, False, file), StudyDatasets(tmp_path, Console(quiet=True), 1))
    assert all(word in str(caught.value) for word in words)


def test_shipped_settings_are_sound() -> None:
    full, quick = (read_settings(STUDY, short) for short in (False, True))
    assert quick.check.draws < full.check.draws
    assert 1.0 in quick.check.factors


@pytest.mark.slow  # 15 s
def test_tiny_study(tmp_path: Path) -> None:
    file = tmp_path / "stroke.toml"
    file.write_text(TINY, encoding="utf-8")
    settings: Any = read_settings(STUDY, False, file)
    result = STUDY.run(settings, StudyDatasets(tmp_path, Console(quiet=True), 1))
    table = result.tables["table"]
    assert table["tolerance"].unique(maintain_order=True).to_list() == [AS_BUILT, CALIBRATED, EXACT]
    sigma = {name: part["sigma_m"].to_list() for (name,), part in table.group_by("tolerance", maintain_order=True)}
    assert all(a > b > c for a, b, c in zip(*(sigma[n] for n in (AS_BUILT, CALIBRATED, EXACT)), strict=True))
    checks = result.tables["checks"]
    assert checks["pairs"].min() == 8
    exact = checks.filter(tolerance=EXACT).sort("factor")
    # 8 errors: the rms of a right prediction is within 0.3 to 2 times it with 99.9 %
    ratio = (exact["rms_m"] / exact["predicted_m"]).to_numpy()
    assert np.all((ratio > 0.3) & (ratio < 2.0))
    assert [d.name for d in result.drawings] == ["best", "curves", "checks"]
    assert any("over the smallest" in finding.label for finding in result.findings)
