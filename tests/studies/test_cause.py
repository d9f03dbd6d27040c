"""The study `cause`: sampler, made-up data, findings."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
import scipy
from rich.console import Console

from phibench.datasets.common.errors import DatasetError
from phibench.scenes.frames import Array
from phibench.scenes.random_streams import generator
from phibench.scenes.rig import Rig
from phibench.studies.cause.model import COMMON, NOISE, DepthModel, Explanation, Prior, simulate, without_table
from phibench.studies.cause.nested_sampling import CauseSettings, Posterior, all_runs, nested_sample, pooled_posterior
from phibench.studies.cause.paper_reading import Reader, published_experiments, read_depths
from phibench.studies.cause.study import (
    STUDY,
    convention_findings,
    evidence_findings,
    left_out_findings,
    noise_findings,
    offset_findings,
    residual_findings,
    scale_findings,
)
from phibench.studies.cause.tables import DECIDED, FLOOR, alike_parameters, coverage, fit_of, left_out_score
from phibench.studies.framework import Finding, read_settings
from phibench.studies.run import run_study

DATA = published_experiments()
HEIGHTS = {f"height_{k}_m": -0.2 for k in (1, 2, 3, 4)}


@pytest.fixture(scope="module")
def settings() -> CauseSettings:
    return read_settings(STUDY)


@pytest.mark.parametrize(
    ("prior", "law"),
    [
        (Prior(rayleigh=2.0), lambda: scipy.stats.rayleigh(scale=2.0)),
        (Prior(normal=[1.0, 2.0]), lambda: scipy.stats.norm(1.0, 2.0)),
        (Prior(uniform=[-1.0, 3.0]), lambda: scipy.stats.uniform(-1.0, 4.0)),
        (Prior(log_uniform=[0.02, 3.0]), lambda: scipy.stats.loguniform(0.02, 3.0)),
    ],
)
def test_values_of_priors_have_their_laws(prior: Prior, law: Callable[[], Any]) -> None:
    shares = np.linspace(0.01, 0.99, 7)
    assert law().cdf(prior.of_share(shares)) == pytest.approx(shares)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({}, "exactly one"),
        ({"normal": [0.0, 1.0], "uniform": [0.0, 1.0]}, "exactly one"),
        ({"normal": [0.0, 0.0]}, "sigma must be above 0"),
        ({"uniform": [1.0, 0.0]}, "low < high"),
        ({"log_uniform": [0.0, 1.0]}, "must be 0 < low"),
        ({"normal": [0.0, 1.0]}, ""),
    ],
)
def test_priors_that_are_none_say_so(given: dict[str, list[float]], words: str) -> None:
    fault = Prior(**given).fault
    assert words in fault
    assert bool(words) == bool(fault)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('left_out = ["ray"]', 'left_out = ["rays"]', "no explanation 'rays'; did you mean 'ray'"),
        ("radius_m = { normal", "radius_mm = { normal", "no prior of radius_m"),
        ('name = "outline"', 'name = "ray"', "same name: ray"),
        ("z_c_m = 0.27, height_1_m", "height_1_m", "no value of z_c_m"),
        ("prior_scales = [2.0]", "prior_scales = [0.0]", "must be above 0"),
        ("axial_m = { normal = [0.0, 0.001] }", "axial_m = { normal = [0.0, -1.0] }", "sigma must be above 0"),
        ('name = "outline"', 'name = "Out line"', "name"),
    ],
)
def test_bad_settings_end_in_sentences(tmp_path: Path, old: str, new: str, words: str) -> None:
    text = _tiny()
    assert old in text
    (tmp_path / "cause.toml").write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(DatasetError, match=words):
        run_study("cause", tmp_path / "out", settings=tmp_path / "cause.toml", console=Console(quiet=True))


def test_the_sampler_is_asked_for_in_a_sentence(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "dynesty", None)
    with pytest.raises(DatasetError, match=r"pip install 'phibench\[study\]'"):
        run_study("cause", tmp_path, quick=True, console=Console(quiet=True))


class _Line(DepthModel):
    """Two unknowns with unit normal priors, each measured once: everything in closed form."""

    @property
    def names(self) -> tuple[str, ...]:  # type: ignore[override]
        return ("a", "b")

    def point(self, shares: Array) -> Array:
        return np.asarray(scipy.stats.norm.ppf(shares))

    def log_likelihood(self, point: Array) -> float:
        return float(scipy.stats.norm.logpdf([0.5, -1.0], point, 0.3).sum())


@pytest.mark.slow
def test_evidence_and_posterior_of_a_closed_form(settings: CauseSettings) -> None:
    """Evidence N(y; 0, 1 + s^2) of each; 200 live points: sampler's error 0.13, four of which are one alarm in 16000.

    Posterior mean y / (1 + s^2), deviation 0.287: some 800 draws with about 200 live points' worth, 0.02 and 0.1.
    """
    pytest.importorskip("dynesty")
    line = _Line(settings.explanations[0], settings.priors, DATA, Rig(), 0.0)
    found = nested_sample(line, 200, 0.05, "line")
    expected = scipy.stats.norm.logpdf([0.5, -1.0], 0.0, np.hypot(1.0, 0.3)).sum()
    assert found.log_evidence == pytest.approx(expected, abs=4.0 * max(found.log_evidence_error, 0.13))
    assert found.points.mean(axis=0) == pytest.approx(np.array([0.5, -1.0]) / 1.09, abs=0.1)
    assert found.points.std(axis=0) == pytest.approx([0.287, 0.287], rel=0.25)
    small, again = (nested_sample(line, 30, 1.0, "line") for _ in range(2))
    assert np.array_equal(small.points, again.points)


def test_pooled_runs() -> None:
    """Evidence is the mean of the runs' (not of their logarithms); a run without evidence gives no draws."""
    first = Posterior(np.zeros((50, 2)), 0.0, 0.1, 10)
    second = Posterior(np.ones((40, 2)), np.log(3.0), 0.1, 20)
    both = pooled_posterior([first, second], "test")
    assert both.log_evidence == pytest.approx(np.log(2.0))
    assert both.evaluations == 30
    assert both.log_evidence_error == pytest.approx(np.log(3.0) / 2.0)  # deviation log(3)/sqrt(2) over sqrt(2)
    assert 0.5 < both.points.mean() < 0.95  # 50 draws with probability 3/4: 0.06 of deviation
    nothing = Posterior(np.ones((40, 2)), -1e4, 0.1, 20)
    assert pooled_posterior([first, nothing], "test").points.max() == 0.0
    assert pooled_posterior([first], "test") is first


@pytest.mark.slow
def test_made_up_data_give_back_their_cause(settings: CauseSettings) -> None:
    """A tilt of 1.1 degrees at 0.2 px beats noise alone by far; noise alone does not make a tilt favoured."""
    pytest.importorskip("dynesty")
    gains, tilts = {}, {}
    for truth, tilt in (("ray", 0.0), ("ray_misaligned", 0.02)):
        model = settings.model("ray_misaligned", DATA)
        values = {
            NOISE: 0.2,
            "z_c_m": 0.27,
            **HEIGHTS,
            "tilt_y_rad": tilt,
            "azimuth_1_rad": 0.3,
            "azimuth_2_rad": 1.0,
            "azimuth_3_rad": 3.0,
        }
        point = np.array([[values.get(name, 0.0) for name in model.names]])
        data = DATA.with_estimates(simulate(model, point, generator("test", "cause", "made-up", truth))[0])
        found = {
            name: nested_sample(settings.model(name, data), 25, 4.0, "test", truth, name)
            for name in ("ray", "ray_misaligned")
        }
        gains[truth] = found["ray_misaligned"].log_evidence - found["ray"].log_evidence
        tilts[truth] = found["ray_misaligned"].points[:, model.names.index("tilt_y_rad")]
    # error of a difference with 25 live points about 1.5; nested runs of these data give -6 and +20
    assert gains["ray"] < DECIDED
    assert gains["ray_misaligned"] > 5.0
    low, high = np.quantile(tilts["ray_misaligned"], [0.005, 0.995])
    assert low < 0.02 < high
    assert tilts["ray"].mean() < 0.01


def test_fit_of_right_and_wrong_residuals(settings: CauseSettings) -> None:
    """Estimates as predicted are too good, estimates that run are caught by the trend."""
    model = settings.model("ray", DATA)
    values = {NOISE: 0.5, "z_c_m": 0.27, **HEIGHTS}
    point = np.array([values[name] for name in model.names])
    points, random = np.repeat(point[None], 400, axis=0), generator("test", "cause", "fit")
    inverse = model.reading(point).inverse_depth_per_m
    sigma = np.sqrt(np.diagonal(model.covariance(model.reading(point), point)))

    def fit(shift: Array) -> object:
        data = DATA.with_estimates(1.0 / (inverse + shift * sigma))
        return fit_of(
            DepthModel(model.explanation, model.priors, data, model.rig, settings.depth_sigma_m), points, random
        )

    exact, running, jumping = fit(np.zeros(25)), fit(np.full(25, 1.2)), fit(1.2 * (-1.0) ** np.arange(25))
    assert exact.chi2_p > 0.99  # type: ignore[attr-defined]
    assert running.trend_p < 0.01  # type: ignore[attr-defined]
    assert jumping.trend_p > 0.9  # type: ignore[attr-defined]


def test_left_out_score_is_the_density_of_the_table(settings: CauseSettings) -> None:
    """With one point only the mean over the posterior is the density there: all minus the rest."""
    model = settings.model("ray", DATA)
    point = model.point(np.full(len(model.names), 0.5))
    rest, out = without_table(model, 1)
    assert out.sum() == 7
    score, error = left_out_score(model, np.repeat(point[None], 3, axis=0), 1)
    assert score == pytest.approx(model.log_likelihood(point) - rest.log_likelihood(point), rel=1e-9)
    assert error == pytest.approx(0.0, abs=1e-9)


def test_principal_point_and_tilt_are_alike(settings: CauseSettings) -> None:
    """A turned camera moves the image as a shifted principal point does, but for (r/f)^2 = 6 %: cosine near -1."""
    model = settings.model("ray", DATA)
    pairs = {(a, b): c for a, b, c in alike_parameters(model, model.point(np.full(len(model.names), 0.5)))}
    assert pairs["tilt_y_rad", "cx_px"] < -0.98
    assert pairs["focal_relative", "radius_m"] > 0.98
    assert abs(pairs["tilt_y_rad", "focal_relative"]) < 0.95


def _moved(azimuth_deg: float, **errors: float) -> Array:
    """Estimates of a rig with a tilt of 0.0136 rad and spots in one azimuth, of the real depth, shape (25,)."""
    world = {"z_c_m": 0.28, "tilt_y_rad": 0.0136, **HEIGHTS, **errors}
    world |= {f"azimuth_{k}_rad": np.radians(azimuth_deg) for k in (1, 2, 3, 4)}
    given = {name: np.asarray(value) for name, value in world.items()}
    return np.asarray(read_depths(given, DATA, Reader(), Rig()).depth_m / DATA.depth_m)


@pytest.mark.parametrize(
    ("azimuth_deg", "along", "across"), [(0, 1.34, 0.07), (45, 0.74, 0.97), (90, 0.21, 1.80), (135, 1.86, 2.11)]
)
def test_the_decentre_that_is_left_out_counts(azimuth_deg: float, along: float, across: float) -> None:
    """Figures of cause.toml and docs/studies/cause.md: rms of what 1 mm changes, in per cent, as printed (0.005)."""
    plain = _moved(azimuth_deg)
    changes = (_moved(azimuth_deg, **{f"decentre_{axis}_m": 1e-3}) - plain for axis in "xy")
    assert [100.0 * float(np.sqrt(np.mean(c**2))) for c in changes] == pytest.approx([along, across], abs=0.0051)


def test_azimuths_fold_only_without_a_decentre_across_the_tilt() -> None:
    """The mirror image of a spot about the tilt's direction gives the same reading only where the rig is symmetric."""
    for azimuth_deg in (20.0, 90.0, 160.0):
        kept = [_moved(sign * azimuth_deg, decentre_x_m=1e-3) for sign in (1, -1)]
        broken = [_moved(sign * azimuth_deg, decentre_y_m=1e-3) for sign in (1, -1)]
        assert kept[0] == pytest.approx(kept[1], rel=1e-9)  # only the sine of the azimuth changes sign
        assert np.abs(broken[0] - broken[1]).max() > 1e-3


def test_coverage_counts_intervals(settings: CauseSettings) -> None:
    model = settings.model("ray", DATA)
    points = np.repeat(np.linspace(0.0, 1.0, 101)[:, None], len(model.names), axis=1)
    truth = dict.fromkeys(COMMON, 0.5) | {NOISE: 0.99}
    held = coverage(model, points, truth, 0.9)
    assert held == dict.fromkeys(COMMON, True) | {NOISE: False}


def _rows(**changes: list[float]) -> pl.DataFrame:
    columns = {
        "explanation": ["ray", "tilted", "worse"],
        "text": ["noise", "tilt", "wrong"],
        "log_evidence": [0.0, 10.0, -9.0],
        "log_evidence_error": [0.5, 0.5, 0.5],
        "against": [0.0, 10.0, -9.0],
        "against_error": [0.0, 0.7, 0.7],
        "noise_px": [1.0, 0.5, 1.1],
        "noise_low_px": [0.8, 0.4, 0.8],
        "noise_high_px": [1.3, 0.6, 1.4],
        "left_rms": [0.06, 0.04, 0.07],
        "chi2_p": [0.5, 0.5, 0.01],
        "trend_p": [0.001, 0.4, 0.5],
        "left_out_score": [-5.0, 2.0, float("nan")],
        "left_out_error": [0.1, 0.1, float("nan")],
    }
    return pl.DataFrame({**columns, **changes})


def _verdicts(rows: Iterable[Finding]) -> dict[str, str]:
    return {row.label: row.verdict for row in rows}


def test_evidences_are_judged_against_the_first_and_the_best() -> None:
    found = _verdicts(evidence_findings(_rows()))
    assert found == {
        "log evidence against 'noise': tilt": "favoured",
        "log evidence against 'noise': wrong": "disfavoured",
        "log evidence against the best, 'tilt': noise": "disfavoured",
        "log evidence against the best, 'tilt': wrong": "disfavoured",
    }
    near = _rows(log_evidence=[9.0, 10.0, -9.0], against=[0.0, 1.0, -18.0])
    found = _verdicts(evidence_findings(near))
    assert found["log evidence against the best, 'tilt': noise"] == "undecided"
    assert found["log evidence against the best, 'tilt': wrong"] == "disfavoured"


def test_findings_follow_the_numbers() -> None:
    table = _rows()
    assert _verdicts(residual_findings(table)) == {
        "posterior predictive p, size of the residuals: noise": "met",
        "posterior predictive p, size of the residuals: tilt": "met",
        "posterior predictive p, size of the residuals: wrong": "missed",
        "posterior predictive p, trend of the residuals: noise": "missed",
        "posterior predictive p, trend of the residuals: tilt": "met",
        "posterior predictive p, trend of the residuals: wrong": "met",
    }
    assert _verdicts(noise_findings(table))["reading noise of a radius: tilt"] == "met"
    wide = _rows(noise_low_px=[0.8, 0.2, 0.8])
    assert _verdicts(noise_findings(wide))["reading noise of a radius: tilt"] == "undecided"
    best, other = left_out_findings(table)
    assert (best.label, best.value, best.low) == ("log density of left-out tables: tilt", 2.0, 1.8)
    assert other.value == -5.0
    assert list(scale_findings(pl.DataFrame(schema=dict.fromkeys(("explanation", "scale", "against", "error"))))) == []
    offsets = {"explanation": ["tilted"], "mean_px": [20.0], "low_px": [15.0], "high_px": [30.0]}
    prior = {"prior_mean_px": [20.0], "prior_low_px": [4.0], "prior_high_px": [50.0]}
    above, _ = offset_findings(table, pl.DataFrame({**offsets, **prior}))
    assert (above.threshold, above.verdict) == (6.0, "met")
    reaching, _ = offset_findings(table, pl.DataFrame({**offsets, **prior, "low_px": [4.0]}))
    assert reaching.verdict == "undecided"


def test_the_same_difference_is_decided_or_not_by_its_error() -> None:
    """5 in log evidence: decided with 0.7 of error (3.7 is the limit), undecided with 2.1 (6.5)."""
    evidence = [0.0, 5.0, -5.0]
    sure = _rows(log_evidence=evidence, against=evidence)
    unsure = _rows(
        log_evidence=evidence, log_evidence_error=[FLOOR] * 3, against=evidence, against_error=[0.0, 2.1, 2.1]
    )
    tilt, wrong, noise, _ = evidence_findings(sure)
    assert (tilt.value, tilt.low, tilt.high) == pytest.approx((5.0, 3.6, 6.4))
    assert (tilt.verdict, wrong.verdict, noise.verdict) == ("favoured", "disfavoured", "disfavoured")
    tilt, wrong, noise, _ = evidence_findings(unsure)
    assert (tilt.verdict, wrong.verdict, noise.verdict) == ("undecided",) * 3
    assert (wrong.low, wrong.high) == pytest.approx((-9.2, -0.8))


@pytest.mark.parametrize(("error", "word"), [(0.5, "disfavoured"), (FLOOR, "undecided")])
def test_senses_of_phi_are_told_apart_by_the_same_rule(settings: CauseSettings, error: float, word: str) -> None:
    chosen = settings.model_copy(update={"explanations": settings.explanations[:2]})
    table = pl.DataFrame(
        {"explanation": ["ray", "normal"], "log_evidence": [-6.2, 0.0], "log_evidence_error": [error] * 2}
    )
    (found,) = convention_findings(chosen, table)
    assert found.label == "sense of phi, noise alone: phi_ray against phi_normal"
    assert found.value == -6.2
    assert found.high == pytest.approx(-6.2 + 2.0 * error * 2.0**0.5)
    assert found.verdict == word


def _tiny() -> str:
    """Settings smaller than the reduced ones: three explanations, few points."""
    text = (Path(__file__).resolve().parents[2] / "studies" / "cause" / "settings.toml").read_text(encoding="utf-8")
    priors = text[text.index("[priors]") : text.index("[[explanations]]")]
    truth = text[
        text.index('[[validation.truths]]\nexplanation = "ray"') : text.index(
            '[[validation.truths]]\nexplanation = "normal'
        )
    ]
    return f"""
live_points = 30
live_points_other = 25
repeats = 2
stop = 5.0
prior_scales = [2.0]
scaled = ["tilted"]
predictive = 60
brute_force = 300
left_out = ["ray"]
drawn = ["ray", "tilted"]
depth_sigma_m = 0.005
{priors}
[[explanations]]
name = "ray"
text = "noise"

[[explanations]]
name = "outline"
text = "parallel rays"
convention = "outline"

[[explanations]]
name = "tilted"
text = "tilt"
free = ["misalignment"]

[validation]
candidates = ["ray"]
repeats = 1

{truth}"""


def test_the_whole_study_in_small(tmp_path: Path) -> None:
    pytest.importorskip("dynesty")
    (tmp_path / "cause.toml").write_text(_tiny(), encoding="utf-8")
    result = run_study(
        "cause", tmp_path / "out", settings=tmp_path / "cause.toml", workers=1, console=Console(quiet=True)
    )
    assert result.tables["table"]["explanation"].to_list() == ["ray", "outline", "tilted"]
    table = result.tables["table"]  # two samplings: the floor holds, and the sampler's own error is kept beside it
    assert (table["log_evidence_error"] >= FLOOR).all()
    assert (table["sampler_error"] <= table["log_evidence_error"]).all()
    assert result.tables["prior_scales"]["error"].min() >= FLOOR * 2.0**0.5 - 1e-9
    assert result.tables["made_up"]["log_evidence_error"].min() >= FLOOR
    assert "sampled 2 time(s)" in " ".join(result.notes)
    assert result.tables["left_out"].height == 4
    assert result.tables["made_up"].height == 1
    assert {drawing.name for drawing in result.drawings} == {"predictive", "evidence", "posterior"}
    text = " ".join(finding.label for finding in result.findings)
    for words in (
        "log evidence against the best",
        "reading noise",
        "made-up data of 'ray'",
        "eq. (5) with exact phi_ray",
        "likelihood against simulation",
        "2 times as wide",
        "sense of phi, noise alone: phi_",
        "size of the cosine",
        "left-out tables",
    ):
        assert words in text
    assert (tmp_path / "out" / "findings.md").stat().st_size > 1000


def test_runs_have_streams_of_their_own(settings: CauseSettings) -> None:
    keys = [run.key for run in all_runs(settings)]
    assert len(keys) == len(set(keys))
    assert len(keys) > 40
    assert isinstance(settings.explanations[0], Explanation)
