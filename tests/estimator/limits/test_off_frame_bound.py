"""Bounds with laser-off frames against Fisher matrices that hold every unknown of the room explicitly."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from helpers.sensor_light import spot_at

from phibench.datasets.exposures.expected_electrons import ExpectedRegion, expected_of_light
from phibench.datasets.frames.sensor_card import card_of, sensor_card
from phibench.estimator.limits.position_bound import spot_limit
from phibench.estimator.limits.processed_bound import (
    FrameCounts,
    chain_limit,
    on_off_limit,
    processed_on_off_limit,
)
from phibench.estimator.processed.chain_model import chain_model, codes, raw_variance_e2
from phibench.estimator.spots.camera_codes import quantised_output, step_correlation
from phibench.estimator.spots.gaussian_spot import LASER_RESPONSE, SpotBlur, SpotModel, SpotPixels
from phibench.estimator.spots.raw_pixels import noise_before_rounding
from phibench.render.sensor.light import Light
from phibench.render.sensor.settings import sensor

BAYER = sensor("bayer-raw")
LEVELS = (2400.0, 2100.0, 1100.0)
BLUR = SpotBlur(0.73)


def region_of(flux_e: float) -> ExpectedRegion:
    room = np.array(LEVELS)[:, None, None] * np.ones((3, 40, 40)) / BAYER.exposure_s
    return expected_of_light(Light(room, spot_at(20.3, 19.6, 0.73, flux_e / BAYER.exposure_s)), BAYER, margin_px=0)


def schur(fisher: np.ndarray, keep: int) -> np.ndarray:
    """Fisher matrix of the first unknowns with the others unknown too."""
    A, B, C = fisher[:keep, :keep], fisher[:keep, keep:], fisher[keep:, keep:]
    return np.asarray(A - B @ np.linalg.solve(C, B.T))


@pytest.mark.parametrize("counts", [(1, 1), (1, 4), (3, 2)])
@pytest.mark.parametrize("flux_e", [3e3, 3e4])
def test_raw_bound_is_that_of_all_readings_with_a_room_of_unknown_pixels(
    counts: tuple[int, int], flux_e: float
) -> None:
    """Every reading of every frame, with the covariance that the camera's fixed pattern gives to its frames."""
    region, card = region_of(flux_e), card_of(BAYER)
    frames = FrameCounts(*counts)
    mean, room = region.mean_e.ravel(), region.background_e.ravel()
    p, n = len(mean), frames.on + frames.off
    D = np.stack([region.du_e_per_px, region.dv_e_per_px, region.spot_e]).reshape(3, -1)
    means = [mean] * frames.on + [room] * frames.off
    read = card.read_noise_e**2 + 1.0 / (12.0 * card.dn_per_e**2)
    fisher = np.zeros((3 + p, 3 + p))
    for i in range(p):
        here = np.array([m[i] for m in means])
        S = np.diag(here + read) + card.dsnu_e**2 + card.prnu**2 * np.outer(here, here)
        J = np.zeros((n, 4))  # the unknowns of the spot, and this pixel's room
        J[: frames.on, :3], J[:, 3] = D[:, i], 1.0
        one = J.T @ np.linalg.solve(S, J)
        at = np.array([0, 1, 2, 3 + i])
        fisher[np.ix_(at, at)] += one
    expected = np.linalg.inv(schur(fisher, 3))[:2, :2]
    found = on_off_limit(region, card, frames).covariance_px2
    # the matrix takes the PRNU of the room (1 + p)(B + s) for known B: a room unknown in electrons, not in readings,
    # keeps of (1 + p) s in first order what the closed form has; second order is prnu^2 = 1e-4
    np.testing.assert_allclose(found, expected, rtol=2e-3)


def test_one_off_frame_costs_what_its_noise_is() -> None:
    """Weak spot: both frames have the noise of the room, so that the variance is twice that of a known room."""
    region, card = region_of(100.0), card_of(BAYER)
    known = spot_limit(region, card, "flux", pattern_known=True).covariance_px2
    one, many = (on_off_limit(region, card, FrameCounts(1, n)).covariance_px2 for n in (1, 10**7))
    # 100 electrons of the spot, 45 in its brightest pixel, against 2400: 2 % of the variance
    assert np.trace(one) / np.trace(known) == pytest.approx(2.0, rel=0.02)
    np.testing.assert_allclose(many, known, rtol=1e-4)


def test_the_best_split_is_the_root_of_the_noises_quotient() -> None:
    """V_on / n_on + V_off / n_off is least at n_off / n_on = sqrt(V_off / V_on): of 40 frames of a bright spot."""
    region, card = region_of(3e4), card_of(BAYER)
    bound = [
        float(np.trace(on_off_limit(region, card, FrameCounts(40 - k, k), True).covariance_px2)) for k in range(1, 40)
    ]
    best = 1 + int(np.argmin(bound))
    noise = card.read_noise_e**2 + 1.0 / (12.0 * card.dn_per_e**2)
    on, off = region.mean_e.ravel() + noise, region.background_e.ravel() + noise
    D = np.stack([region.du_e_per_px, region.dv_e_per_px, region.spot_e]).reshape(3, -1)
    # derivative of the bound's trace by a pixel's variance, d(F^-1) = -F^-1 dF F^-1, at frames of equal number
    F = (D / (on + off)) @ D.T
    weight = np.sum((np.linalg.inv(F)[:2] @ D) ** 2, axis=0) / (on + off) ** 2
    ratio = math.sqrt(float(weight @ off) / float(weight @ on))
    # the minimum is flat: a split off by 2 of 40 costs 1 %
    assert best / (40 - best) == pytest.approx(ratio, abs=0.1)
    assert best < 20


def test_many_off_frames_of_a_jpeg_are_a_known_room() -> None:
    """Against `chain_limit` with the flux alone unknown; its room is as flat as here."""
    card = sensor_card("mjpeg")
    known = chain_limit(card, (100.3, 100.4), BLUR, 14e3, LEVELS, pattern_known=True).fisher[:3, :3]
    flat = replace(card, prnu=0.0)
    found = processed_on_off_limit(flat, (100.3, 100.4), BLUR, 14e3, LEVELS, FrameCounts(1, 10**7))
    np.testing.assert_allclose(found.fisher, known, rtol=1e-4)


@pytest.mark.parametrize(("counts", "steps"), [((1, 1), False), ((1, 1), True), ((4, 2), True)])
def test_jpeg_bound_is_that_of_explicit_unknowns(counts: tuple[int, int], steps: bool) -> None:
    """Unknown: the room of each raw pixel and of each coefficient, and each pixel's PRNU; the rest is Schur's."""
    card, frames = sensor_card("mjpeg"), FrameCounts(*counts)
    uv, flux = np.array([100.3, 100.4]), 14e3
    found = processed_on_off_limit(card, uv, BLUR, flux, LEVELS, frames, steps=steps).fisher
    model = chain_model(card, noise_before_rounding(card, True))
    corner = np.array([80, 96]) - model.margin  # the units of 16 x 8 pixels that have it nearest to their middle
    pixels = SpotPixels.of(model.filters[None], BLUR, SpotModel(LASER_RESPONSE))
    mean, derivatives = pixels.at(np.array([[*(uv - corner), flux, *LEVELS]]))
    mean, D = mean.ravel(), derivatives[0, :3].reshape(3, -1)
    room = mean - flux * D[2]
    on, off = codes(model, mean), codes(model, room)
    T = model.transform

    def by_raw(at: object) -> np.ndarray:
        """Change of the coefficients with each raw pixel, shape (r, n)."""
        return np.asarray((model.linear.T.toarray() * at.regression) @ T)  # type: ignore[attr-defined]

    K, V = by_raw(on), raw_variance_e2(model, mean)
    rest = [at.excess @ model.transform**2 + model.rounding for at in (on, off)]
    output = quantised_output(on.mean @ T + model.shift, np.sqrt(V @ K**2 + rest[0]), model.step)
    live = output.variance > 2e-3 * model.step**2
    S = (K.T * V) @ K * np.outer(output.slope, output.slope)
    np.fill_diagonal(S, output.variance)
    sigma = np.sqrt(raw_variance_e2(model, room) @ by_raw(off) ** 2 + rest[1]) / model.step
    hidden = model.step**2 / 12.0 * (step_correlation(sigma) * (1 - 1 / frames.off) + 1 / frames.off) * steps
    prior = np.concatenate(
        [
            frames.off / raw_variance_e2(model, room),  # room of the raw pixels, from the off frames
            1.0 / (card.prnu * np.maximum(flux * D[2], 1e-6)) ** 2,  # PRNU times the spot
            1.0 / (rest[1] / frames.off + hidden),  # room of the coefficients
        ]
    )
    spot = (model.linear @ D.T).T * on.by_mean @ T
    J = (np.vstack([spot, K, K, np.eye(len(model.step))]) * output.slope)[:, live]
    fisher = J @ np.linalg.solve(S[np.ix_(live, live)] / frames.on, J.T)
    fisher[np.arange(3, len(fisher)), np.arange(3, len(fisher))] += prior
    np.testing.assert_allclose(found, schur(fisher, 3), rtol=1e-5)


def test_codes_with_off_frames_lie_between_raw_pixels_and_a_jpeg() -> None:
    one = FrameCounts(1, 1)
    srgb, yuyv, jpeg = (
        np.trace(processed_on_off_limit(sensor_card(name), (100.3, 100.4), BLUR, 14e3, LEVELS, one).covariance_px2)
        for name in ("srgb8", "yuyv", "mjpeg")
    )
    known = np.trace(chain_limit(sensor_card("srgb8"), (100.3, 100.4), BLUR, 14e3, LEVELS).covariance_px2)
    assert known < srgb < yuyv < jpeg  # yuyv averages chroma of two pixels


@pytest.mark.parametrize("sigma", [0.1, 0.3, 0.6])
def test_correlation_of_a_quantisers_error(sigma: float) -> None:
    """Against the mean of the squared expected error over places, by sums over thresholds."""
    place = (np.arange(2000) + 0.5) / 2000.0 - 0.5
    expected = quantised_output(place, np.full(2000, sigma), np.ones(2000)).mean - place
    assert float(step_correlation(np.array(sigma))) == pytest.approx(12.0 * np.mean(expected**2), abs=1e-3)


def test_counts_below_one_are_refused() -> None:
    with pytest.raises(ValueError, match="1 or more of each"):
        FrameCounts(1, 0)
