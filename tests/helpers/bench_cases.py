"""A believable set of pairs for tests of the score: truth by other mathematics, bounds, and methods that know it all.

Not a test file. Pixels are those of `oracles.true_pixel` (Alhazen's quartic and OpenCV), phi those of the geometry of
the reflection point, so that neither comes from what is tested.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import polars as pl
from helpers.oracles import alhazen_quartic, true_pixel, true_reflection
from scipy.linalg import block_diag

from phibench.benchmark.scores.answer_errors import Rules
from phibench.benchmark.scores.records import in_order, missed_relative, record_table, with_missed
from phibench.datasets.frames.sensor_card import sensor_card
from phibench.estimator.geometry.triangulate import depth_exact
from phibench.estimator.interface import Answer, Outcome, Pair, Spot
from phibench.estimator.pair_set import ImageTruth, PairSet, PairTruth
from phibench.scenes.random_streams import generator
from phibench.scenes.rig import Rig

RIG = Rig()
SAMPLES = 200


@dataclass(frozen=True)
class Cases:
    """A pair set of truths; images are made when they are asked for."""

    truths: tuple[PairTruth, ...]
    name: str = "cases"

    def __len__(self) -> int:
        return len(self.truths)

    def truth(self, number: int) -> PairTruth:
        return self.truths[number]

    def pair(self, number: int) -> Pair:
        truth = self.truths[number]
        images = {p: image_of(getattr(truth, p)) for p in ("down", "up")}
        return Pair(number, **images, rig=truth.nominal_rig, stroke_m=truth.stroke_m, card=sensor_card("mjpeg"))

    def document(self) -> dict[str, object]:
        return {"name": self.name, "task_version": 4, "sha256": "0" * 64, "draws": 1}


@cache
def cases(samples: int = SAMPLES, draws: int = 1) -> Cases:
    """Pairs of `samples` spots 1 to 4.2 m away on all azimuths, `draws` of each, all visible."""
    rng = generator("tests", "bench cases")
    truths = []
    for i in range(samples):
        depth, azimuth, stroke = rng.uniform(1.0, 4.2), rng.uniform(-np.pi, np.pi), rng.uniform(0.3, 1.0)
        spot = np.array([depth * np.cos(azimuth), depth * np.sin(azimuth), rng.uniform(0.3, 0.7)])
        down, up = (spot_truth(h, spot, rng) for h in (0.0, stroke))
        first = PairTruth(0, f"s{i:04d}", 0, "mjpeg", (60, 75, 85)[i % 3], False, depth, stroke, RIG, RIG, down, up)
        truths += [replace(first, draw=draw) for draw in range(draws)]
    return Cases(tuple(replace(truth, number=n) for n, truth in enumerate(truths)))


def spot_truth(offset_m: float, spot_world_m: np.ndarray, rng: np.random.Generator) -> ImageTruth:
    """One image: angles from the reflection point, a bound that falls with the light and is longer one way."""
    P = true_reflection(RIG, offset_m, spot_world_m, alhazen_quartic)
    camera = RIG.T_world_camera.t + [0.0, 0.0, offset_m]
    normal = (P - camera - RIG.T_camera_sphere.t) / RIG.mirror.radius_m
    ray = (spot_world_m - P) / np.linalg.norm(spot_world_m - P)
    phi = {
        "ray": np.arccos(-ray[2]) / 2,
        "normal": np.arccos(-normal[2]),
        "incidence": np.arccos(ray @ normal),
    }
    electrons = 60_000.0 / np.linalg.norm(spot_world_m[:2]) ** 2 * rng.uniform(0.3, 1.0)
    turn, sigma2 = rng.uniform(0, np.pi), 2.0 / electrons
    axes = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    raw = axes @ np.diag([sigma2, 2.5 * sigma2]) @ axes.T
    u, v = true_pixel(RIG, offset_m, spot_world_m)
    return ImageTruth(
        uv_px=(float(u), float(v)),
        phi_rad={name: float(x) for name, x in phi.items()},
        azimuth_rad=float(np.arctan2(normal[1], normal[0])),
        visible=True,
        cause="none",
        electrons=float(electrons),
        peak_e=float(electrons) / 6.0,
        snr=float(np.sqrt(electrons)),
        saturated=False,
        bound_px2=2.0 * raw,
        raw_bound_px2=raw,
    )


def image_of(spot: ImageTruth) -> np.ndarray:
    """Black frame with a red spot where the truth says, or without one if it is not visible."""
    image = np.zeros((RIG.camera.height_px, RIG.camera.width_px, 3), np.uint8)
    if spot.visible:
        u, v = (round(x) for x in spot.uv_px)
        image[v - 1 : v + 2, u - 1 : u + 2, 0] = 120
        image[v, u, 0] = 230
    return image


def change(truth: PairTruth, position: str, **changes: object) -> PairTruth:
    """The pair with one of its spots changed."""
    return replace(truth, **{position: replace(getattr(truth, position), **changes)})


# -- methods that know the truth -----------------------------------------------------------------------------------

Oracle = Callable[[PairTruth], Answer]


def outcomes(pairs: Cases, oracle: Oracle) -> list[Outcome]:
    """What a method with the truth in hand answers, 10 ms each."""
    return [Outcome(truth.number, oracle(truth), 0.01) for truth in pairs.truths]


def truth_itself(truth: PairTruth) -> Answer:
    return Answer(Spot(truth.down.uv_px), Spot(truth.up.uv_px))


def shifted(du: float, dv: float = 0.0) -> Oracle:
    return lambda t: Answer(*(Spot((s.uv_px[0] + du, s.uv_px[1] + dv)) for s in (t.down, t.up)))


def scaled(factor: float) -> Oracle:
    """Radii from the principal point, which the default rig's sphere centre is imaged to, times a factor."""

    def answer(t: PairTruth) -> Answer:
        c = np.array([RIG.camera.cx_px, RIG.camera.cy_px])
        return Answer(*(Spot(tuple(c + factor * (np.array(s.uv_px) - c))) for s in (t.down, t.up)))

    return answer


def swapped(t: PairTruth) -> Answer:
    return Answer(Spot(t.up.uv_px), Spot(t.down.uv_px))


def constant(t: PairTruth) -> Answer:
    return Answer(Spot((640.0, 360.0)), Spot((640.0, 360.0)))


def silent(t: PairTruth) -> Answer:
    return Answer(Spot.missing("nothing there"), Spot.missing("nothing there"))


def sampler(seed: int = 0, claim: float = 1.0, spread: float = 1.0) -> Oracle:
    """Truth and a draw of the bound's covariance, times `spread` in sigma; claims the covariance times `claim`."""

    def answer(t: PairTruth) -> Answer:
        rng = generator("tests", "ideal sampler", seed, t.sample_id, t.draw)
        return Answer(*(drawn(s, rng) for s in (t.down, t.up)))

    def drawn(s: ImageTruth, rng: np.random.Generator) -> Spot:
        e = spread * np.linalg.cholesky(s.bound_px2) @ rng.standard_normal(2)
        C = claim * s.bound_px2
        return Spot((s.uv_px[0] + e[0], s.uv_px[1] + e[1]), ((C[0, 0], C[0, 1]), (C[1, 0], C[1, 1])))

    return answer


def at_the_pairs_bound(seed: int = 0, spread: float = 1.0) -> Oracle:
    """Truth and a draw of the bound of both images together: errors of one point of the room, by least squares."""
    return lambda t: _of_the_point(t, seed, np.eye(3), spread)


def knows_boards(seed: int = 0) -> Oracle:
    """Noise of the bound, fitted by a point on the board's plane, which is known: two unknowns instead of four."""

    def answer(t: PairTruth) -> Answer:
        X = point_of(t)
        towards = np.append(X[:2], 0.0) / np.hypot(*X[:2])
        across = np.array([-towards[1], towards[0], 0.0])
        return _of_the_point(t, seed, np.stack([across, [0.0, 0.0, 1.0]], axis=-1), 1.0)

    return answer


def point_of(t: PairTruth) -> np.ndarray:
    """The spot in the room."""
    return _place(t.stroke_m, t.down.uv_px, t.up.uv_px)[0]


def slopes_of(t: PairTruth) -> np.ndarray:
    """Derivatives of the four coordinates by the spot's place, shape (4, 3), by differences of the quartic's pixels."""
    return _place(t.stroke_m, t.down.uv_px, t.up.uv_px)[1]


@cache
def _place(stroke_m: float, *uv_px: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    def pixels(point: np.ndarray) -> np.ndarray:
        return np.concatenate([true_pixel(RIG, h, point) for h in (0.0, stroke_m)])

    X, step_m = np.asarray(depth_exact(RIG, stroke_m, *map(np.array, uv_px)).point_world_m), 1e-5
    return X, np.stack([(pixels(X + step_m * e) - pixels(X - step_m * e)) / (2.0 * step_m) for e in np.eye(3)], -1)


def _of_the_point(t: PairTruth, seed: int, directions: np.ndarray, spread: float) -> Answer:
    """Least squares over places of the spot along `directions`, shape (3, k), of a draw of the images' bounds."""
    rng = generator("tests", "point sampler", seed, t.sample_id, t.draw)
    C = block_diag(t.down.bound_px2, t.up.bound_px2)
    M, W = slopes_of(t) @ directions, np.linalg.inv(C)
    e = spread * np.linalg.cholesky(C) @ rng.standard_normal(4)
    move = np.linalg.solve(M.T @ W @ M, M.T @ W @ e)
    uv = np.concatenate([t.down.uv_px, t.up.uv_px]) + M @ move
    D = np.linalg.norm((point_of(t) + directions @ move)[:2] - RIG.at(0.0).sphere_centre_m[:2])
    return Answer(Spot((uv[0], uv[1])), Spot((uv[2], uv[3])), float(D))


def records(pairs: PairSet, outcomes: Iterable[Outcome], rules: Rules) -> pl.DataFrame:
    """Records of a run with what missed pairs count, as a score has them."""
    ordered = in_order(outcomes, len(pairs))
    table = record_table([pairs.truth(outcome.number) for outcome in ordered], ordered, rules)
    return with_missed(table, missed_relative(table, rules))
