"""Beliefs over a target: consistent with the truth after strokes and drives, for targets at rest and moving."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import scipy
from helpers.pair_tracker import PairTracker
from helpers.target_approach import (
    OF_SPHERE,
    RIG,
    VEHICLE,
    Approach,
    MisalignedApproach,
    rig_covariance,
    step,
    stroked,
)
from scipy.optimize import least_squares

from phibench.estimator.geometry.reflection import image_of
from phibench.estimator.geometry.rig_parameters import PARAMETERS, PRIOR_SIGMA, drawn_deviation
from phibench.estimator.geometry.triangulate import depth_exact
from phibench.robot.film.film_positions import FilmPositions
from phibench.robot.loop.belief import Belief, TargetBelief, TargetPrior
from phibench.robot.loop.rig_bias import RigBias
from phibench.robot.loop.sensing import direction_of, direction_read
from phibench.robot.loop.smoothing import SmoothedBelief, belief_of, film_beliefs
from phibench.scenes.frames import Array
from phibench.scenes.misalignment import Misalignment
from phibench.scenes.motion.vehicle import Arc, PlanarPose, arc_covariance
from phibench.scenes.validation import SceneError

RUNS = 24
FALSE_ALARM = 1e-3  # of each band; the streams are fixed, so that a pass stays one


def band(runs: int) -> tuple[float, float]:
    """Mean NEES of consistent beliefs over independent runs: chi squared of 3 degrees of freedom each."""
    low, high = scipy.stats.chi2.ppf([FALSE_ALARM / 2, 1 - FALSE_ALARM / 2], 3 * runs) / runs
    return float(low), float(high)


def test_a_direction_is_that_of_the_ray_to_the_point() -> None:
    """A far point lies in the direction itself; the covariance agrees with drawn pixels to 5 sqrt(2 / 4000)."""
    far = np.array([400.0, 100.0, 50.0])
    uv = image_of(RIG.at(0.0), far).uv_px
    found = direction_of(RIG, float(uv[0]), float(uv[1]), 0.05)
    assert found is not None
    assert found.values == pytest.approx([math.atan2(100, 400), (50 - 0.71) / math.hypot(400, 100)], abs=2e-4)
    rng = np.random.default_rng(1)
    drawn = []
    for du, dv in 0.05 * rng.standard_normal((300, 2)):
        other = direction_of(RIG, float(uv[0] + du), float(uv[1] + dv), 0.05)
        assert other is not None
        drawn.append(other.values)
    ratio = np.cov(np.array(drawn).T) / found.covariance
    assert np.diag(ratio) == pytest.approx([1.0, 1.0], abs=5 * math.sqrt(2 / 300))


def test_a_pixel_off_the_mirror_has_no_direction() -> None:
    assert direction_of(RIG, 5.0, 5.0, 0.1) is None


@pytest.fixture(scope="module")
def runs() -> list[tuple[float, float, float, float]]:
    """NEES and pull of q after a stroke, then after a drive towards the target, for each run."""
    rows = []
    for number in range(RUNS):
        run = Approach(number)
        belief = stroked(run, 0.42, 6)
        after = belief.nees(run.place()), pull(belief, run.place())
        for k in range(10):
            step(run, belief, *((0.04, 0.04) if k % 3 else (0.02, 0.05)))
        rows.append((*after, belief.nees(run.place()), pull(belief, run.place())))
    return rows


def pull(belief: Belief, place: Array) -> float:
    return float((belief.mean[2] - 1 / math.hypot(place[0], place[1])) / math.sqrt(belief.covariance[2, 2]))


def test_beliefs_are_consistent_after_a_stroke_and_after_a_drive(runs) -> None:
    low, high = band(RUNS)
    for column in (0, 2):
        mean = np.mean([row[column] for row in runs])
        assert low < mean < high
        # standard deviations stated twice too small or too large would leave the band
        assert not low < mean * 4 < high
        assert not low < mean / 4 < high


def test_a_stroke_gives_the_depth_that_triangulation_gives() -> None:
    """Four of its own standard deviations: a false alarm in 16 000; triangulation of exact pixels gives the truth."""
    run = Approach(3)
    belief = stroked(run, 0.42, 6)
    D = math.hypot(*run.place()[:2])
    assert abs(belief.distance_m - D) < 4 * belief.distance_sigma_m
    assert belief.distance_sigma_m < 0.02 * D
    down, up = (image_of(RIG.at(h), run.point - [VEHICLE.sensor_x_m, 0, 0]).uv_px for h in (0.0, 0.42))
    assert depth_exact(RIG, 0.42, down, up).depth_m == pytest.approx(D, rel=1e-9)


def test_driving_alone_gives_depth_but_no_better_than_the_slip_is_known() -> None:
    """Motion stereo: D scales with the way driven, whose scale is known to sigma_slip / (1 - slip)."""
    shares = []
    for number in (1, 5, 7):
        run = Approach(number)
        first = run.look()
        assert first is not None
        belief = TargetBelief(RIG, VEHICLE, first, 0.0)
        start = belief.distance_sigma_m / belief.distance_m
        for _ in range(20):
            step(run, belief, 0.03, 0.03)
        shares.append(belief.distance_sigma_m / belief.distance_m)
        assert shares[-1] < 0.35 * start
        assert abs(belief.distance_m - math.hypot(*run.place()[:2])) < 4 * belief.distance_sigma_m
    floor = VEHICLE.slip_sigma / (1 - VEHICLE.slip)
    # what is left of the way scales with the slip: (D - way) / D of nothing less than the floor
    assert min(shares) > 0.8 * floor


def test_a_lifted_robot_sees_the_same_place() -> None:
    """Flippers tilt the stroke axis by 8 degrees: with the attitude given, the belief stays consistent."""
    run = Approach(4)
    belief = stroked(run, 0.42, 6)
    run.flipper_rad = -1.0
    for _ in range(5):
        step(run, belief, 0.0, 0.0)
    assert belief.nees(run.place()) < scipy.stats.chi2.ppf(1 - 1e-4, 3)
    seen = run.look()
    assert seen is not None
    belief.predict(0.0, 0.0, 0.1)
    assert belief.distance2(seen, run.stroke_m, run.held) < scipy.stats.chi2.ppf(1 - 1e-4, 2)
    assert belief.distance2(seen, run.stroke_m) > 1e3  # as if the robot were level


# -- rigs that are not known exactly -----------------------------------------------------------------------------------

HEIGHT_M = float(RIG.at(0.0).sphere_centre_m[2])
SIZE = 1.0  # of a rig as built by hand


def approached(number: int, bias: RigBias | None) -> list[float]:
    """NEES after a stroke and after a drive, with a rig that is drawn by the number."""
    run = MisalignedApproach(number)
    drawn = np.random.default_rng(number).standard_normal(len(OF_SPHERE))
    values = {name: SIZE * PRIOR_SIGMA[name] * float(z) for name, z in zip(OF_SPHERE, drawn, strict=True)}
    run.rig = RIG.perturbed(Misalignment(**values))
    belief = stroked(run, 0.42, 3, bias=bias)
    found = [belief.nees(run.place())]
    for k in range(6):
        step(run, belief, *((0.06, 0.06) if k % 3 else (0.04, 0.07)))
    return [*found, belief.nees(run.place())]


@pytest.mark.slow
def test_a_belief_that_knows_how_well_its_rig_is_known_is_consistent() -> None:
    """NEES in the band of the runs; without the covariance the same rigs give hundreds of times as much."""
    bias, n = RigBias(RIG, rig_covariance(SIZE)), 6
    low, high = band(n)
    told = np.mean([approached(number, bias) for number in range(n)], axis=0)
    assert np.all((low < told) & (told < high)), told
    untold = np.mean([approached(number, None) for number in range(n)], axis=0)
    assert np.all(untold > 100.0 * high)


def explicit(run: MisalignedApproach, bias: RigBias, frames: list[tuple[Array, float, tuple[float, float]]], a: float):
    """Mean and standard deviations of azimuth, rise, q, slip and skid: pixels in deviated rigs, every step an unknown.

    Frames are (pixel, stroke, tracks since the frame before). Unknowns: the state now, and two normal numbers for
    each step of the tracks, six for each step of a target that moves.
    """
    n, m, dt, half = len(frames) - 1, bias.count, 0.1, 8 if a else 5
    roots = [np.linalg.cholesky(arc_covariance(VEHICLE, *lr)) if any(lr) else None for _, _, lr in frames]
    walk = math.sqrt(a) * np.linalg.cholesky(np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])) if a else None

    def residuals(x: Array) -> Array:
        azimuth, rise, q, slip, skid = x[:5]
        theta, w = x[half : half + m], x[half + m : half + m + 2 * n].reshape(n, 2)
        kicks = x[half + m + 2 * n :].reshape(n, 2, 3) if a else np.zeros((n, 2, 3))
        p = np.array([math.cos(azimuth) / q, math.sin(azimuth) / q, HEIGHT_M + rise / q])
        v, rows = x[5:8].copy() if a else np.zeros(3), []
        for i in range(n, -1, -1):
            uv, h, tracks = frames[i]
            rows += [(np.array(bias.pixel(p, h, theta)) - uv) / 0.05]
            if i == 0:
                break
            if walk is not None:
                dp, dv = walk @ kicks[i - 1]
                v = v - dv
                p = p - v * dt - dp
            arc = VEHICLE.arc(*tracks, slip, skid)
            if roots[i] is not None:
                extra = roots[i] @ w[i - 1]
                arc = Arc(arc.length_m + extra[0], arc.turn_rad + extra[1])
            pose = PlanarPose().after(arc)
            c, s = math.cos(pose.heading_rad), math.sin(pose.heading_rad)
            turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
            ahead = np.array([VEHICLE.sensor_x_m, 0.0, 0.0])
            p, v = turn @ (p + ahead) + [pose.x_m, pose.y_m, 0.0] - ahead, turn @ v
        q0 = (1 / math.hypot(p[0], p[1]) - 0.5 * (1 / 0.8 + 1 / 6.0)) / ((1 / 0.8 - 1 / 6.0) / 3.0)
        belief = [(slip - VEHICLE.slip) / VEHICLE.slip_sigma, (skid - VEHICLE.skid) / VEHICLE.skid_sigma]
        return np.concatenate([*rows, [q0], belief, theta, w.ravel(), v / 0.3 if a else [], kicks.ravel() if a else []])

    count = half + m + 2 * n + (6 * n if a else 0)
    start = np.zeros(count)
    D = math.hypot(*run.place()[:2])
    start[:5] = math.atan2(*run.place()[1::-1]), (run.place()[2] - HEIGHT_M) / D, 1 / D, VEHICLE.slip, VEHICLE.skid
    found = least_squares(residuals, start, x_scale="jac", method="lm")
    return found.x[:5], np.sqrt(np.diag(np.linalg.inv(found.jac.T @ found.jac))[:5])


@pytest.mark.parametrize("moving", [0.0, 0.01])
def test_frames_at_once_say_what_explicit_steps_say(moving: float) -> None:
    """Other mathematics, the same belief: means to 0.1 standard deviations, those to 5 %, after a stroke and a drive.

    Directions that shift by a tenth of a degree make the slopes differ by less; the covariance of the steps and of the
    motion left out would make standard deviations smaller by a tenth and more. The covariance of a motion depends on
    q, here known to 11 %: the reweighted solution and the mode over all unknowns then lie up to 0.25 apart.
    """
    bias, run = RigBias(RIG, rig_covariance(0.25)), MisalignedApproach(4)
    read = run.read()
    assert read is not None
    first = direction_of(RIG, read.u_px, read.v_px, 0.05)
    assert first is not None
    frames = [(first.uv_px, 0.0, (0.0, 0.0))]
    belief = belief_of(RIG, VEHICLE, first, 0.0, bias, TargetPrior(acceleration_m2_per_s3=moving))
    for k in range(9):
        tracks = (0.0, 0.0) if k < 4 else (0.06, 0.08)
        run.stroke_m = 0.1 * min(k + 1, 4)
        run.drive(*tracks)
        seen = run.look()
        assert seen is not None
        seen = replace(seen, covariance_px2=0.05**2 * np.eye(2))
        frames.append((seen.uv_px, run.stroke_m, tracks))
        belief.predict(*tracks, 0.1)
        belief.update(seen, run.stroke_m)
    mean, sigma = explicit(run, bias, frames, moving)
    assert np.sqrt(np.diag(belief.covariance)[:5]) == pytest.approx(sigma, rel=0.05)
    assert np.max(np.abs(belief.mean[:5] - mean) / sigma) < (0.25 if moving else 0.1)


@pytest.mark.slow
def test_noise_of_many_frames_does_not_move_the_rig() -> None:
    """A rig as built and 40 frames: q of the explicit solution to 0.15 standard deviations, those to 5 %.

    Residuals in angles, whose scale depends on the rig, gave a q that is 0.55 standard deviations beside it.
    """
    bias, run, count = RigBias(RIG, rig_covariance(SIZE)), MisalignedApproach(4), 40
    drawn = np.random.default_rng(4).standard_normal(len(OF_SPHERE))
    run.rig = RIG.perturbed(
        Misalignment(**{n: SIZE * PRIOR_SIGMA[n] * float(z) for n, z in zip(OF_SPHERE, drawn, strict=True)})
    )
    first = run.look()
    assert first is not None
    frames = [(first.uv_px, 0.0, (0.0, 0.0))]
    belief = belief_of(RIG, VEHICLE, first, 0.0, bias)
    for k in range(1, count):
        tracks = (0.0, 0.0) if k < count - 6 else (0.06, 0.08)
        run.stroke_m = 0.4 * min(k / (count - 6), 1.0)
        run.drive(*tracks)
        seen = run.look()
        assert seen is not None
        frames.append((seen.uv_px, run.stroke_m, tracks))
        belief.predict(*tracks, 0.1)
        belief.update(seen, run.stroke_m)
    mean, sigma = explicit(run, bias, frames, 0.0)
    assert abs(belief.mean[2] - mean[2]) < 0.15 * sigma[2]
    assert math.sqrt(belief.covariance[2, 2]) == pytest.approx(sigma[2], rel=0.05)


def test_imagined_frames_are_worth_what_real_ones_are() -> None:
    bias = RigBias(RIG, rig_covariance(SIZE))
    run = MisalignedApproach(3)
    belief = stroked(run, 0.2, 2, bias=bias)
    copied = belief.copied()
    run.stroke_m = 0.4
    seen = run.look()
    assert seen is not None
    before = copied.distance_sigma_m
    copied.imagine(0.4, seen.covariance)
    belief.update(seen, 0.4)
    assert copied.distance_sigma_m < 0.8 * before
    assert copied.distance_sigma_m == pytest.approx(belief.distance_sigma_m, rel=0.1)


def test_pixels_are_those_of_a_deviated_rig() -> None:
    """The stroke's axis included; the nominal rig is many pixels off."""
    bias = RigBias(RIG, rig_covariance(1.0))
    theta = np.random.default_rng(2).standard_normal(bias.count)
    values = bias.deviations @ theta
    rig = RIG.perturbed(Misalignment(**{n: float(v) for n, v in zip(PARAMETERS, values, strict=True) if v}))
    point, h = np.array([1.5, 0.4, 0.9]), 0.3
    found = bias.pixel(point, h, theta)
    assert found == pytest.approx(image_of(rig.at(h), point).uv_px.tolist(), abs=1e-6)
    assert math.dist(found, image_of(RIG.at(h), point).uv_px.tolist()) > 1.0


def test_drawn_deviations_have_the_covariance() -> None:
    """Of 3000 draws variances are known to 2.6 %: 13 % are five of that. Correlations are kept."""
    P, (u, v) = rig_covariance(0.1), (PARAMETERS.index("cx_px"), PARAMETERS.index("decentre_x_m"))
    P[u, v] = P[v, u] = 0.8 * math.sqrt(P[u, u] * P[v, v])
    rng = np.random.default_rng(4)
    drawn = [drawn_deviation(P, rng) for _ in range(3000)]
    both = np.array([(one.cx_px, one.decentre_x_m) for one in drawn])
    C = np.cov(both.T) / np.sqrt(np.outer(np.diag(P)[[u, v]], np.diag(P)[[u, v]]))
    assert C == pytest.approx(np.array([[1.0, 0.8], [0.8, 1.0]]), abs=0.13)
    assert {one.stroke_relative for one in drawn} == {0.0}


def positions_of(run: MisalignedApproach, strokes_m: Array) -> tuple[FilmPositions, Array]:
    """Read pixels of a carriage that rises, and their times."""
    rows = []
    for run.stroke_m in strokes_m.tolist():
        read = run.read()
        assert read is not None
        rows.append((read.u_px, read.v_px))
    n = len(rows)
    noise = np.tile(0.05**2 * np.eye(2), (n, 1, 1))
    return FilmPositions(np.array(rows), noise, np.zeros((n, 2, n, 2))), 0.03 * np.arange(n)


def test_films_of_a_rig_that_is_not_known_exactly() -> None:
    """A carriage that rises by 0.4 m: NEES within what 1e-4 of consistent beliefs exceed; untold, 30 times that."""
    run, strokes = MisalignedApproach(6), np.linspace(0.0, 0.4, 8)
    run.rig = RIG.perturbed(drawn_deviation(rig_covariance(0.5), np.random.default_rng(5)))
    film = *positions_of(run, strokes), strokes
    told, untold = (
        list(film_beliefs(RIG, VEHICLE, *film, rig_covariance=covariance))[-1][1]
        for covariance in (rig_covariance(0.5), None)
    )
    most = scipy.stats.chi2.ppf(1 - 1e-4, 3)
    assert told.nees(run.place()) < most
    assert untold.nees(run.place()) > 30.0 * most


@pytest.mark.slow
def test_films_of_such_a_rig_with_an_inexact_encoder() -> None:
    """Readings that err by 5 mm: mean NEES of twelve films in its band; where the encoder is not told of, above it."""
    strokes, found = np.linspace(0.0, 0.4, 8), []
    for k in range(12):
        run, rng = MisalignedApproach(100 + k), np.random.default_rng(1000 + k)
        run.rig = RIG.perturbed(drawn_deviation(rig_covariance(1e-3), rng))
        film = RIG, VEHICLE, *positions_of(run, strokes), strokes + 5e-3 * rng.standard_normal(len(strokes))
        beliefs = (
            list(film_beliefs(*film, encoder_sigma_m=sigma, rig_covariance=rig_covariance(1e-3)))[-1][1]
            for sigma in (5e-3, 0.0)
        )
        found.append([belief.nees(run.place()) for belief in beliefs])
    told, untold = np.mean(found, axis=0)
    low, high = band(len(found))
    assert low < told < high
    assert untold > 2.0 * high


@pytest.mark.parametrize("kind", [0, 1])
def test_errors_that_frames_share_do_not_average_out(kind: int) -> None:
    """Pattern and texture of 0.1 px: after 20 frames at rest the azimuth is known to that; without them far better."""
    run = Approach(3)
    read = run.read()
    assert read is not None
    alone = direction_of(RIG, read.u_px, read.v_px, 0.1)
    assert alone is not None
    sigmas = []
    for size in (0.0, 0.1):
        shared = (size, 0.0) if kind == 0 else (0.0, size)
        frame = read._replace(sigma_px=0.05, pattern_px=shared[0], texture_px=shared[1])
        first = direction_read(RIG, frame)
        assert first is not None
        belief = belief_of(RIG, VEHICLE, first, 0.0, RigBias(RIG, None))
        assert isinstance(belief, SmoothedBelief) == (size > 0.0)
        for _ in range(20):
            belief.predict(0.0, 0.0, 0.1)
            belief.update(replace(first), 0.0)
        sigmas.append(math.sqrt(belief.covariance[0, 0]))
    assert sigmas[1] == pytest.approx(math.sqrt(alone.covariance[0, 0]), rel=0.05)
    assert sigmas[0] < 0.2 * sigmas[1]


def test_an_exact_rig_adds_no_states_and_a_wrong_covariance_is_refused() -> None:
    assert RigBias(RIG, None).count == RigBias(RIG, np.zeros((len(PARAMETERS),) * 2)).count == 0
    with pytest.raises(SceneError, match="of shape"):
        RigBias(RIG, np.eye(3))
    with pytest.raises(SceneError, match="no negative eigenvalue"):
        RigBias(RIG, rig_covariance(1.0) @ (np.ones((len(PARAMETERS),) * 2) - 0.5 * np.eye(len(PARAMETERS))))


@pytest.mark.parametrize(
    ("numbers", "words"),
    [
        ({"distances_m": (3.0, 2.0)}, "the first must be below the second"),
        ({"distances_m": (0.0, 2.0)}, "distances_m = 0.0: must be above 0"),
        ({"acceleration_m2_per_s3": -0.1}, "must be 0 or above"),
        ({"speed_m_per_s": math.nan}, "must be a finite number"),
    ],
)
def test_targets_that_cannot_be_expected_are_refused(numbers, words: str) -> None:
    with pytest.raises(SceneError, match=words):
        TargetPrior(**numbers)


# -- moving targets ----------------------------------------------------------------------------------------------------

MOVING = 0.01  # m2/s3: the speed changes by 0.1 m/s in a second


def moved(number: int, seconds: float = 6.0) -> tuple[float, float, float, float]:
    """NEES, and relative errors of D by belief and by the last pair, and the latter's claim, of a target on its way."""
    run = Approach(number)
    side = np.array([-run.normal[1], run.normal[0], 0.0])
    velocity = (
        0.25 * run.rng.choice([-1.0, 1.0]) * side
        + 0.05 * run.rng.standard_normal(3) * [0, 0, 1]
        + (0.15 * run.rng.choice([-1.0, 1.0]) * run.normal)
    )
    first = run.look()
    assert first is not None
    belief, pairs = TargetBelief(RIG, VEHICLE, first, 0.0, TargetPrior(acceleration_m2_per_s3=MOVING)), PairTracker(RIG)
    for k in range(round(10 * seconds)):
        kick, rest = math.sqrt(MOVING * 0.1) * run.rng.standard_normal((2, 3))
        # the integral of a velocity that walks randomly: half of its step, and a part of its own
        run.point = run.point + 0.1 * (velocity + 0.5 * kick + rest / math.sqrt(12))
        velocity = velocity + kick
        run.stroke_m = 0.21 * (1 - math.cos(0.2 * math.pi * k / 2))  # up and down in two seconds
        belief.predict(0.0, 0.0, 0.1)
        read = run.read()
        if read is None:
            continue
        seen = direction_of(RIG, read.u_px, read.v_px, read.sigma_px)
        assert seen is not None
        belief.update(seen, run.stroke_m)
        pairs.update(read, run.stroke_m)
    D = math.hypot(*run.place()[:2])
    return belief.nees(run.place()), belief.distance_m / D - 1, pairs.distance_m / D - 1, pairs.distance_sigma_m / D


@pytest.fixture(scope="module")
def moves() -> list[tuple[float, float, float, float]]:
    return [moved(number) for number in range(12)]


@pytest.mark.slow
def test_a_moving_target_is_tracked_and_two_frames_are_not_enough(moves) -> None:
    """The last pair takes the motion between its frames for depth: wrong by much more than it claims."""
    nees, belief, pair, claim = np.array(moves).T
    low, high = band(len(moves))
    assert low < nees.mean() < high
    pair = np.where(np.isfinite(pair), pair, -1.0)  # rays that do not meet
    assert np.sqrt(np.mean(belief**2)) < 0.5 * np.sqrt(np.mean(pair**2))
    assert np.nanmedian(np.abs(pair / claim)) > 5


@pytest.mark.slow
def test_tracking_over_many_runs(capsys) -> None:
    """NEES within its 95 % band, at rest and moving: bands of 5 % false alarm each, at fixed streams."""
    n = 120
    rows = []
    for number in range(1000, 1000 + n):
        run = Approach(number)
        belief = stroked(run, 0.42, 6)
        after = belief.nees(run.place())
        for k in range(12):
            step(run, belief, *((0.04, 0.04) if k % 3 else (0.02, 0.05)))
        rows.append((after, belief.nees(run.place()), moved(number)[0]))
    low, high = scipy.stats.chi2.ppf([0.025, 0.975], 3 * n) / n
    means = np.mean(rows, axis=0)
    with capsys.disabled():
        print(f"NEES of {n} runs after a stroke, a drive, moving: {means.round(2)}; 95 % band {low:.2f} to {high:.2f}")
    assert np.all((low < means) & (means < high))
