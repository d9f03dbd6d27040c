"""Pixels cut at the full well, and what quantisation hides of the room: against drawn pixels and drawn frames."""

from __future__ import annotations

import numpy as np
import pytest
import scipy

from phibench.datasets.frames.sensor_card import sensor_card
from phibench.estimator.spots.camera_codes import quantiser_steps, room_variance
from phibench.estimator.spots.pixel_statistics import (
    COUNTS,
    _information_table,
    _interval,
    code_table,
    cut_pixels,
    mean_codes,
)
from phibench.estimator.spots.raw_pixels import PixelNoise


@pytest.mark.parametrize("mean", [8e3, 11_600.0, 11_950.0, 12_000.0, 12_300.0, 40e3])
def test_moments_are_those_of_the_cut_law(mean: float) -> None:
    """By numerical integration of min(x, W) and of its square over the normal law."""
    well, s = 12e3, 150.0
    law = scipy.stats.norm(mean, s)
    found = cut_pixels(np.array([mean]), np.array([s * s]), well)

    def moment(f) -> float:
        low, high = min(mean - 12 * s, well), max(mean + 12 * s, well)
        parts = ((low, well), (well, high))
        return sum(
            scipy.integrate.quad(lambda x: f(min(x, well)) * law.pdf(x), a, b, epsabs=0.0, limit=200)[0]
            for a, b in parts
        )

    first = moment(lambda y: y - well)
    second = moment(lambda y: (y - well) ** 2)
    # beyond 6 deviations the law is taken as uncut: 1e-9 of a deviation
    assert found.mean_e[0] - well == pytest.approx(first, abs=1e-6)
    assert found.variance_e2[0] == pytest.approx(second - first**2, rel=1e-6, abs=1e-6)
    step = 1e-2
    up, down = (cut_pixels(np.array([mean + x]), np.array([s * s]), well).mean_e[0] for x in (step, -step))
    assert found.slope[0] == pytest.approx((up - down) / (2.0 * step), abs=1e-5)


def test_a_frame_without_full_pixels_is_as_it_was() -> None:
    mean, variance = np.array([[100.0, 5e3]]), np.array([[100.0, 5e3]])
    found = cut_pixels(mean, variance, 12e3)
    assert found.mean_e is mean
    assert found.variance_e2 is variance
    assert (found.slope == 1.0).all()


def drawn_room(rng: np.random.Generator, power: float, count: int) -> np.ndarray:
    """Coefficients of rooms whose spectrum falls with the square of the frequency, shape (count, 64)."""
    i, j = np.indices((8, 8))
    deviation = power / (1.0 + i**2 + j**2)
    return rng.normal(0.0, 1.0, (count, 64)) * deviation.ravel()


@pytest.mark.parametrize("power", [20.0, 100.0, 1000.0])
def test_quantised_rooms_err_as_much_as_is_said(power: float) -> None:
    """Rms error of quantised coefficients over the claimed one, of those whose claim is a tenth of a step or more.

    The claim is a model of the spectrum, not a law: within a factor of 1.5 over all of them.
    """
    rng, step = np.random.default_rng(5), quantiser_steps((8, 16), "4:4:4", 85)[:64]
    rooms = drawn_room(rng, power, 2000)
    quantised = np.round(rooms / step) * step
    claimed = room_variance(quantised.ravel(), np.tile(step, len(rooms))).reshape(rooms.shape)
    chosen = claimed > (0.1 * step) ** 2
    assert chosen.mean() > 0.05
    ratio = np.sqrt(np.mean((quantised - rooms)[chosen] ** 2) / np.mean(claimed[chosen]))
    assert 1.0 / 1.5 < ratio < 1.5


def test_a_flat_room_is_known_but_for_its_level() -> None:
    step = quantiser_steps((8, 16), "4:4:4", 85)[:64]
    flat = np.zeros(64)
    flat[0] = 40 * step[0]
    variance = room_variance(flat, step)
    assert variance[0] == pytest.approx(step[0] ** 2 / 12.0)
    assert (variance[1:] == 0.0).all()


NAMES = ("mean", "by_mean", "regression", "excess")


@pytest.mark.parametrize("asked", [(5000.0, 60.0, 900.0), (0.0, 15_600.0), (-30.0, 2000.0), (300.0, 310.0, 290.0)])
def test_tables_of_codes_do_not_depend_on_what_was_asked_for_before(asked: tuple[float, ...]) -> None:
    """Bit by bit those of tables that are worked out as a whole, from below 0 to above the last node."""
    card, noise = sensor_card("mjpeg"), PixelNoise(20.0, 0.01)
    whole, parts = (mean_codes.__wrapped__(card, noise) for _ in range(2))
    rows = np.repeat(np.arange(3 * len(COUNTS)), 2)
    whole.values(NAMES, np.tile([0.0, 1e6], 3 * len(COUNTS)), rows)
    for mean in asked:
        means = mean + np.linspace(-5.0, 5.0, len(rows))
        for name, expected, found in zip(
            NAMES, whole.values(NAMES, means, rows), parts.values(NAMES, means, rows), strict=True
        ):
            assert expected.tobytes() == found.tobytes(), name


def test_information_leaves_out_codes_without_a_chance_and_nothing_else() -> None:
    card, noise = sensor_card("srgb8"), PixelNoise(20.0, 0.01)
    step, information = _information_table.__wrapped__(card, noise)
    table, checked = code_table(card), 0
    root = -8.0 + step * np.arange(information.shape[1])
    for node in range(0, information.shape[1], 100):
        mean = np.sign(root[node]) * root[node] ** 2
        smooth = 0.5 * (mean + np.sqrt(mean * mean + 1.0))
        s = np.sqrt(noise.variance_e2(np.array(smooth)))
        by_mean = 0.5 * (1.0 + mean / np.sqrt(mean * mean + 1.0)) * (1.0 + 2.0 * noise.prnu**2 * smooth) / (2.0 * s)
        for colour in range(3):
            low, once = np.unique(table.low_e[colour], return_index=True)
            ends = (low - mean) / s, (table.high_e[colour][once] - mean) / s
            chance, change = _interval(*ends, s, by_mean)
            expected = np.sum(np.where(chance > 1e-30, change**2 / np.maximum(chance, 1e-30), 0.0))
            # the nodes of this test and of the table differ by rounding: 1e-13 of sqrt(mean)
            assert information[colour, node] == pytest.approx(expected, rel=1e-9)
            checked += 1
    assert checked == 33
