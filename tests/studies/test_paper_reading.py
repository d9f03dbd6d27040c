"""What the paper's user reads off a misaligned rig, and the likelihood of the published estimates."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl
import pytest
import scipy

from phibench.estimator.geometry.paper_depth import depth_approx
from phibench.estimator.geometry.phi import outline_circle, phi_outline
from phibench.estimator.geometry.reflection import image_of
from phibench.estimator.geometry.triangulate import ESTIMATORS
from phibench.scenes.frames import Array, Pose
from phibench.scenes.misalignment import PARAMETERS as MISALIGNMENT
from phibench.scenes.misalignment import Misalignment
from phibench.scenes.random_streams import generator
from phibench.scenes.rig import Rig
from phibench.studies.cause.model import NOISE, DepthModel, brute_force, simulate
from phibench.studies.cause.nested_sampling import CauseSettings
from phibench.studies.cause.paper_reading import (
    AZIMUTHS,
    PARAMETERS,
    Reader,
    published_experiments,
    radii_px,
    read_depths,
)
from phibench.studies.cause.study import STUDY, short_stroke_findings
from phibench.studies.cause.tables import short_stroke_table
from phibench.studies.framework import read_settings

DATA = published_experiments()
HEIGHTS = {f"height_{k}_m": -0.2 for k in (1, 2, 3, 4)}


@pytest.fixture(scope="module")
def settings() -> CauseSettings:
    return read_settings(STUDY)


def _world(random: np.random.Generator, scale: float = 1.0) -> dict[str, Array]:
    """A rig with every error at `scale` times its study magnitude."""
    wrong = {name: random.normal(scale=scale * MISALIGNMENT[name].study) for name in PARAMETERS}
    heights = {f"height_{k}_m": random.uniform(-0.5, 0.4) for k in (1, 2, 3, 4)}
    azimuths = {name: random.uniform(0.0, 2.0 * np.pi) for name in AZIMUTHS}
    return {k: np.asarray(v) for k, v in {"z_c_m": random.uniform(0.25, 0.3), **wrong, **heights, **azimuths}.items()}


def _pixels(world: dict[str, Array], i: int) -> tuple[Rig, Array, Array]:
    """Nominal rig and the true pixels of experiment i by the Newton iteration in pixels of `reflection`."""
    nominal = replace(Rig(), T_camera_sphere=Pose("camera", "sphere", (0.0, 0.0, float(world["z_c_m"]))))
    wrong = Misalignment(**{name: float(world[name]) for name in PARAMETERS if name in world})
    true, table = nominal.perturbed(wrong), int(DATA.table[i]) + 1
    azimuth = float(world.get(f"azimuth_{table}_rad", 0.0))
    away = DATA.depth_m[i] * np.array([np.cos(azimuth), np.sin(azimuth)])
    point = true.at(0.0).sphere_centre_m + np.array([*away, float(world[f"height_{table}_m"])])
    down, up = (image_of(true.at(o), point).uv_px for o in (0.0, wrong.stroke_m(float(DATA.stroke_m[i]))))
    return nominal, down, up


@pytest.mark.parametrize("convention", ["ray", "normal", "incidence"])
def test_readings_are_those_of_misaligned_rigs(convention: str) -> None:
    """Against other mathematics for image, phi and eq. (4); the 1e-10 px of `reflection` are below 1e-9 m."""
    checked = 0
    for draw in range(3):
        world = _world(generator("test", "cause", "world", draw))
        ours = read_depths(world, DATA, Reader(convention), Rig()).depth_m  # type: ignore[arg-type]
        for i in range(0, 25, 3):
            rig, down, up = _pixels(world, i)
            expected = ESTIMATORS[f"paper_{convention}"](rig, float(DATA.stroke_m[i]), down, up).depth_m
            assert ours[i] == pytest.approx(float(expected), abs=1e-9 * max(1.0, abs(float(expected))) ** 2)
            checked += 1
    assert checked == 27


def test_centred_radii_and_the_outline() -> None:
    world = _world(generator("test", "cause", "centred"))
    world.update(cx_px=np.asarray(0.0), cy_px=np.asarray(0.0), roll_rad=np.asarray(0.0), pitch_rad=np.asarray(0.0))
    radii = radii_px(world, DATA, Reader("ray", centred=True), Rig())
    aligned = {name: value for name, value in world.items() if name not in PARAMETERS}
    angles = read_depths(aligned, DATA, Reader("outline"), Rig()).depth_m
    for i in (0, 9, 20):
        rig, down, up = _pixels(world, i)
        true = rig.perturbed(Misalignment(**{name: float(world[name]) for name in PARAMETERS}))
        centre, _ = outline_circle(true)
        assert radii[:, i] == pytest.approx([np.hypot(*(uv - centre)) for uv in (down, up)], abs=1e-8)
        rig, down, up = _pixels(aligned, i)
        expected = ESTIMATORS["paper_outline"](rig, float(DATA.stroke_m[i]), down, up).depth_m
        assert angles[i] == pytest.approx(float(expected), rel=1e-9)
        assert np.isfinite(phi_outline(rig.at(0.0), down))


def test_h_against_d_cannot_make_the_error_rise() -> None:
    """Eq. (4) with phi_ray is off by less than a millimetre; eq. (5) is depth.depth_approx."""
    short = short_stroke_table()
    assert short["eq4_error_m"].abs().max() < 1e-3
    world = {"z_c_m": np.asarray(0.26), **{name: np.asarray(-0.21) for name in HEIGHTS}}
    rig, down, up = _pixels(world, 6)
    phi = [ESTIMATORS["approx_ray"](rig, float(DATA.stroke_m[6]), down, up).depth_m]
    assert short["eq5_error_m"][6] == pytest.approx(float(phi[0]) - 2.18, abs=1e-9)
    assert float(depth_approx(0.7, 0.5, 1.0).depth_m) == pytest.approx(np.sin(1.4) * np.sin(1.0) / np.sin(0.4))
    own = short.filter(pl.col("table") == 1).sort("stroke_m")["eq5_error_m"].abs()
    assert own[-1] < own[0]
    label = "eq. (5) with exact phi_ray: growth of the size of the error along Table 1"
    growth = {f.label: f for f in short_stroke_findings(short)}[label]
    assert growth.value == pytest.approx(1e3 * float(own[-1] - own[0]))
    assert growth.verdict == "met"
    grown = short.with_columns(
        pl.when(pl.col("stroke_m") > 1.35).then(1.0).otherwise(pl.col("eq5_error_m")).alias("eq5_error_m")
    )
    assert {f.label: f for f in short_stroke_findings(grown)}[label].verdict == "missed"


def test_readings_of_many_rigs_are_those_of_each(settings: CauseSettings) -> None:
    random = generator("test", "cause", "many")
    for name in ("ray_full", "outline_misaligned", "ray_shared", "ray_turn", "ray_misaligned_student"):
        model = settings.model(name, DATA)
        points = model.point(random.uniform(0.05, 0.95, size=(6, len(model.names))))
        each = np.array([model.log_likelihood(point) for point in points])
        # two orders of summation; the largest terms are some 1e4
        assert model.log_likelihoods(points) == pytest.approx(each, rel=1e-9)


@pytest.mark.parametrize("name", ["ray", "ray_misaligned", "ray_shared", "ray_pixels"])
def test_likelihood_is_a_normal_in_the_inverse(settings: CauseSettings, name: str) -> None:
    """scipy's multivariate normal with a covariance built here from the definition, times the Jacobian."""
    model = settings.model(name, DATA)
    point = model.point(np.full(len(model.names), 0.6))
    named, reading = model.named(point), model.reading(point)
    noise = float(named.get(NOISE, np.asarray(12.0**-0.5)))
    covariance = np.zeros((25, 25))
    scale = reading.inverse_depth_per_m**2
    for i in range(25):
        for j in range(25):
            same = DATA.table[i] == DATA.table[j] and DATA.depth_m[i] == DATA.depth_m[j]
            if same:
                covariance[i, j] += settings.depth_sigma_m**2 * scale[i] * scale[j]
            if i == j or (same and model.explanation.shared_down):
                covariance[i, j] += noise**2 * reading.by_down[i] * reading.by_down[j]
            if i == j:
                rounding = 0.001 if DATA.table[i] == 3 else 0.01
                covariance[i, j] += noise**2 * reading.by_up[i] ** 2 + rounding**2 / 12.0 * scale[i] ** 2
    expected = scipy.stats.multivariate_normal.logpdf(1.0 / DATA.estimate_m, reading.inverse_depth_per_m, covariance)
    assert model.log_likelihood(point) == pytest.approx(expected - 2.0 * np.log(DATA.estimate_m).sum(), rel=1e-9)


def test_slopes_are_those_of_simulated_noise(settings: CauseSettings) -> None:
    """Standard deviation of 1/D over 4000 worlds against the slopes; 1 / sqrt(2 n) = 1.1 %, so 5 % is 4.5 sigma.

    False alarm below 2e-4 over 25 experiments; a slope that is a tenth off fails.
    """
    model = settings.model("ray", DATA)
    values = {NOISE: 0.05, "z_c_m": 0.27, **HEIGHTS}
    point = np.array([values[name] for name in model.names])
    smooth = replace(DATA, rounding_m=np.full(25, 1e-9))
    exact = DepthModel(model.explanation, model.priors, smooth, model.rig, 0.0)
    worlds = 1.0 / simulate(exact, np.repeat(point[None], 4000, axis=0), generator("test", "cause", "slopes"))
    predicted = np.sqrt(np.diagonal(exact.covariance(exact.reading(point), point)))
    ratio = worlds.std(axis=0) / predicted
    assert np.abs(ratio - 1.0).max() < 0.05


def test_brute_force_agrees_with_the_likelihood_at_small_noise(settings: CauseSettings) -> None:
    """A kernel density of 20000 draws is good to a few per cent near the middle of a normal; doubled noise is not."""
    model = settings.model("ray", DATA)
    values = {NOISE: 0.1, "z_c_m": 0.27, **HEIGHTS}
    point = np.array([values[name] for name in model.names])
    middle = DepthModel(
        model.explanation,
        model.priors,
        DATA.with_estimates(model.reading(point).depth_m),
        model.rig,
        settings.depth_sigma_m,
    )
    simulated, linear = brute_force(middle, point, generator("test", "cause", "brute"), 20_000)
    assert np.abs(simulated - linear)[DATA.table < 3].max() < 0.1
    values[NOISE] = 0.2
    _, other = brute_force(middle, np.array([values[n] for n in model.names]), generator("test", "cause", "brute"), 200)
    assert np.abs(simulated - other)[DATA.table < 3].min() > 0.3
