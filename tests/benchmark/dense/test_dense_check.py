"""Planted faults of dense methods: each is named in plain words, and right answers pass, also coarse ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from phibench.benchmark.dense.dense_check import check_of_dense_outcomes, with_exchanged
from phibench.benchmark.dense.easy_dense_pairs import EasyDensePairs, EasyTruth, points_of
from phibench.benchmark.isolation.method_check import MethodCheck
from phibench.estimator.dense.dense_interface import DenseAnswer
from phibench.estimator.geometry.reflection import image_of
from phibench.estimator.geometry.triangulate import depth_exact
from phibench.estimator.interface import Outcome

PAIRS = EasyDensePairs(count=1)
SHAPE = (720, 1280)
NOISE = 0.03


@pytest.fixture(scope="module")
def truths() -> list[EasyTruth]:
    return [PAIRS.truth(number) for number in range(1)]


def plane(truth: EasyTruth, values: np.ndarray) -> np.ndarray:
    """Values at the pixels that are looked at, NaN elsewhere."""
    whole = np.full((*SHAPE, *values.shape[1:]), np.nan)
    u, v = truth.uv_px.astype(int).T
    whole[v, u] = values
    return whole


def judged(truths: list[EasyTruth], answers: list[DenseAnswer]) -> MethodCheck:
    return check_of_dense_outcomes([Outcome(k, None, 0.1, dense=answer) for k, answer in enumerate(answers)], truths)


def noisy(values: np.ndarray, seed: int = 0) -> np.ndarray:
    """A coarse method: 3 % of noise, a tenth of it wrong by up to a factor of two, a third without an answer."""
    rng = np.random.default_rng(seed)
    values = values * np.exp(NOISE * rng.normal(size=len(values)))
    values = np.where(rng.random(len(values)) < 0.1, values * rng.uniform(0.5, 2.0, len(values)), values)
    return np.where(rng.random(len(values)) < 0.33, np.nan, values)


def from_elevations(truth: EasyTruth, formula: Callable[..., np.ndarray]) -> np.ndarray:
    """D by a formula of the polar angles of both directions and the stroke."""
    centre = truth.rig.at(0.0).sphere_centre_m[2]
    height = truth.point_world_m[:, 2] - centre
    down, up = np.arctan2(height, truth.depth_m), np.arctan2(height - truth.stroke_m, truth.depth_m)
    return formula(0.5 * np.pi - down, 0.5 * np.pi - up, truth.stroke_m)


@dataclass(frozen=True)
class Half:
    """A method that takes pixel centres at a half, in one image or in both."""

    down_px: float
    up_px: float | tuple[float, float]

    def __call__(self, t: EasyTruth) -> np.ndarray:
        return depth_exact(t.rig, t.stroke_m, t.uv_px + self.down_px, t.up_px + np.array(self.up_px)).depth_m


def turned(t: EasyTruth, degrees: float) -> np.ndarray:
    """D of the panorama's columns that are so many degrees off."""
    return seen(t, turned_px(t, degrees), 0.0)


def turned_px(t: EasyTruth, degrees: float) -> np.ndarray:
    middle, a = np.array([639.5, 359.5]), np.radians(degrees)
    x, y = (t.uv_px - middle).T
    return middle + np.stack([np.cos(a) * x - np.sin(a) * y, np.sin(a) * x + np.cos(a) * y], axis=1)


def rows_off(t: EasyTruth, pixels: float, uv_px: np.ndarray | None = None) -> np.ndarray:
    uv_px = t.uv_px if uv_px is None else uv_px
    away = uv_px - np.array([639.5, 359.5])
    length = np.linalg.norm(away, axis=1, keepdims=True)
    return seen(t, uv_px + pixels * away / np.maximum(length, 1e-9), 0.0)


def seen(t: EasyTruth, uv: np.ndarray, offset_m: float) -> np.ndarray:
    X = points_of(t.rig.at(offset_m), t.room, uv)
    return np.hypot(X[:, 0], X[:, 1])


def distance(t: EasyTruth) -> np.ndarray:
    return np.sqrt(t.depth_m**2 + (t.point_world_m[:, 2] - t.rig.at(0.0).sphere_centre_m[2]) ** 2)


# Helvipad's formula is r = B (sin(theta) / tan(d) + cos(theta)); its sign was wrong, so that cos(theta) was subtracted.
DEPTHS: dict[str, tuple[Callable[[EasyTruth], np.ndarray], str]] = {
    "wrong sign": (
        lambda t: from_elevations(
            t, lambda p1, p2, h: h * np.abs(np.sin(p1) / np.tan(p2 - p1) - np.cos(p1)) * np.sin(p1)
        ),
        "sign is wrong",
    ),
    "images swapped": (lambda t: seen(t, t.uv_px, t.stroke_m), "images are swapped"),
    "range for D": (distance, "range along the ray"),
    "height for D": (lambda t: t.point_world_m[:, 2] + 1e-3, "height above the floor"),
    "degrees": (
        lambda t: from_elevations(t, lambda p1, p2, h: np.degrees(p2 - p1)),
        "disparity in degrees",
    ),
    "tangent of degrees": (
        lambda t: from_elevations(
            t,
            lambda p1, p2, h: np.abs(h / (np.tan(90.0 - np.degrees(p1)) - np.tan(90.0 - np.degrees(p2)))),
        ),
        "tan\\(\\) of degrees",
    ),
    "half a pixel in both": (Half(0.5, 0.5), "pixels of both images are off by half a pixel"),
    "half a pixel in the other": (Half(0.0, -0.5), "pixels of the up image are off by half a pixel"),
    "half a pixel along v in the other": (
        Half(0.0, (0.0, 0.5)),
        "up image are off by half a pixel \\(\\(\\+0.0, \\+0.5",
    ),
    "0.8 px in the other": (Half(0.0, (0.8, -0.3)), "one image are off against the other \\(\\(\\+0.8, -0.3\\)"),
    "half a block of the grid": (
        lambda t: rows_off(t, 1.7, turned_px(t, 0.75)),
        "grid is off: D is that of pixels about .*azimuth further and 2 px further outwards",
    ),
    "a quarter turn of the grid": (lambda t: turned(t, 90.0), "grid is turned by about \\+90 degrees"),
    "five degrees of the grid": (lambda t: turned(t, -5.0), "grid is turned by about -5 degrees"),
    "rows of the grid": (lambda t: rows_off(t, 10.0), "some 10 px further outwards"),
    "millimetres": (lambda t: 1000.0 * t.depth_m, "millimetres"),
    "inverse depth": (lambda t: 1.0 / t.depth_m, "1 / D: give D"),
    "strokes": (lambda t: t.depth_m / t.stroke_m, "in strokes"),
    "mirrored": (lambda t: seen(t, 2.0 * np.array([639.5, 0.0]) + t.uv_px * [-1.0, 1.0], 0.0), "u runs to the left"),
    "constant": (lambda t: np.full_like(t.depth_m, 1.7), "a constant"),
}


@pytest.mark.slow
@pytest.mark.parametrize("fault", DEPTHS)
def test_a_planted_fault_of_d_is_named(fault: str, truths: list[EasyTruth]) -> None:
    make, words = DEPTHS[fault]
    exact = fault.startswith(("tangent", "constant"))  # chaotic, or without any noise
    values = [np.where(d > 0.0, d, np.nan) for d in (make(t) for t in truths)]
    answers = [DenseAnswer(plane(t, d if exact else noisy(d))) for t, d in zip(truths, values, strict=True)]
    (found,) = judged(truths, answers).faults
    import re

    assert re.search(words, found), found


@pytest.mark.slow
def test_images_that_a_right_method_exchanges_are_named(truths: list[EasyTruth]) -> None:
    """It is right where both are exchanged once more; a method that is wrong there, too, keeps its own faults."""
    (truth,) = truths
    right = Outcome(0, None, 0.1, dense=DenseAnswer(plane(truth, noisy(truth.depth_m))))
    empty = Outcome(0, None, 0.1, dense=DenseAnswer(np.full(SHAPE, np.nan)))
    refused = Outcome(0, None, 0.1, "invalid", "depth_m is 0 or below")
    (found,) = with_exchanged(("some fault",), refused, right, truth)
    assert "down and up are exchanged" in found
    assert with_exchanged(("some fault",), refused, empty, truth) == ("some fault",)
    assert with_exchanged(("pair 1 failed",), right, right, truth) == ("pair 1 failed",)


TARGETS: dict[str, tuple[Callable[[EasyTruth], np.ndarray], str]] = {
    "half a pixel": (lambda t: t.up_px + 0.5, "off by half a pixel"),
    "axes swapped": (lambda t: t.up_px[:, ::-1], "axes are swapped"),
    "shift": (lambda t: t.up_px - t.uv_px, "shift from the down to the up image"),
    "wrong sign": (lambda t: 2.0 * t.uv_px - t.up_px, "wrong sign"),
    "images swapped": (
        lambda t: image_of(t.rig.at(0.0), points_of(t.rig.at(t.stroke_m), t.room, t.uv_px)).uv_px,
        "images are swapped",
    ),
    "binned": (lambda t: (t.up_px - 0.5) / 2.0, "halved"),
    "nothing done": (lambda t: t.uv_px, "repeats the pixel"),
}


@pytest.mark.slow
@pytest.mark.parametrize("fault", TARGETS)
def test_a_planted_fault_of_places_is_named(fault: str, truths: list[EasyTruth]) -> None:
    make, words = TARGETS[fault]
    rng = np.random.default_rng(1)
    answers = [DenseAnswer(target_uv_px=plane(t, make(t) + 0.3 * rng.normal(size=t.uv_px.shape))) for t in truths]
    (found,) = judged(truths, answers).faults
    assert words in found


def test_right_answers_pass(truths: list[EasyTruth]) -> None:
    """Exact and coarse ones, as D and as places, with a sigma that is right."""
    rng = np.random.default_rng(2)
    exact = [DenseAnswer(plane(t, t.depth_m)) for t in truths]
    coarse = [
        DenseAnswer(plane(t, d), sigma_depth_m=plane(t, np.where(np.isnan(d), np.nan, NOISE * t.depth_m)))
        for t in truths
        for d in [noisy(t.depth_m)]
    ]
    places = [DenseAnswer(target_uv_px=plane(t, t.up_px + 0.4 * rng.normal(size=t.up_px.shape))) for t in truths]
    for answers in (exact, coarse, places):
        done = judged(truths, answers)
        assert done.ok, done.faults
    assert "67 % of the pixels answered" in judged(truths, coarse).notes


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sigma", "words"),
    [
        (lambda t: 0.1 * NOISE * t.depth_m, "too small: the errors are"),
        (lambda t: 10.0 * NOISE * t.depth_m, "too large"),
        (lambda t: (NOISE * t.depth_m) ** 2, "holds variances"),
    ],
)
def test_a_wrong_sigma_is_named(sigma: Callable[[EasyTruth], np.ndarray], words: str, truths: list[EasyTruth]) -> None:
    answers = [
        DenseAnswer(plane(t, d), sigma_depth_m=plane(t, np.where(np.isnan(d), np.nan, sigma(t))))
        for t in truths
        for d in [noisy(t.depth_m)]
    ]
    (found,) = judged(truths, answers).faults
    assert words in found


def test_failures_and_silence_are_told(truths: list[EasyTruth]) -> None:
    outcomes = [Outcome(k, None, 0.1, "error", "ValueError: takes colour") for k in range(1)]
    assert check_of_dense_outcomes(outcomes, truths).faults == (
        "1 of 1 pairs failed (error): ValueError: takes colour",
    )
    silent = [DenseAnswer(np.full(SHAPE, np.nan))] * 1
    (found,) = judged(truths, silent).faults
    assert found.endswith("pixels are answered, although all have a pattern")
    sparse = [np.where(np.arange(len(t.depth_m)) % 100 == 0, noisy(t.depth_m), np.nan) for t in truths]
    assert judged(truths, [DenseAnswer(plane(t, d)) for t, d in zip(truths, sparse, strict=True)]).ok


def test_easy_truth_is_what_the_images_show() -> None:
    """Brightness at a pixel of the down image is that at its place in the up image, but for noise and the mosaic."""
    pairs = replace(PAIRS, preset="mono-raw")
    pair, truth = pairs.pair(0), pairs.truth(0)
    u, v = truth.uv_px.astype(int).T
    x, y = np.rint(truth.up_px).astype(int).T
    there, here = pair.up[y, x].astype(float), pair.down[v, u].astype(float)
    assert np.corrcoef(here, there)[0, 1] > 0.9
    assert abs(np.corrcoef(here, np.roll(there, 50))[0, 1]) < 0.3
