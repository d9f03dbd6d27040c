"""Signal to noise of a spot: closed forms, the likelihood ratio of drawn pixels, and that it rises with the light."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ndtr

from phibench.datasets.exposures.expected_electrons import ExpectedRegion
from phibench.datasets.frames.sensor_card import SensorCard, sensor_card
from phibench.estimator.limits.position_bound import processed_snr, raw_snr
from phibench.estimator.limits.processed_bound import chain_limit
from phibench.estimator.spots.gaussian_spot import SpotBlur

SIDE, CENTRE = 16, (7.3, 7.8)


def region_of(flux_e: float, room_e: float) -> ExpectedRegion:
    across, down = (np.diff(ndtr((np.arange(SIDE + 1) - 0.5 - x) / 0.8)) for x in CENTRE)
    spot, room = flux_e * np.outer(down, across), np.full((SIDE, SIDE), room_e)
    nothing = np.zeros_like(spot)
    return ExpectedRegion(0, 0, nothing.astype(int), room, spot, nothing, nothing)


def photons_only(**changes: float) -> SensorCard:
    raw = sensor_card("mono-raw", row_noise_e=0.0)
    return replace(raw, read_noise_e=0.0, dsnu_e=0.0, prnu=0.0, dn_per_e=10.0, top_dn=2**40, **changes)


@pytest.mark.parametrize("flux_e", [3.0, 300.0, 30_000.0])
def test_poisson_noise_gives_the_difference_of_the_roots(flux_e: float) -> None:
    region, card = region_of(flux_e, 40.0), photons_only(full_well_e=1e9)
    quantum = noise_of_rounding(card)
    a, b = (np.sqrt(x + quantum) for x in (region.mean_e, region.background_e))
    # the way's square is a sum over pixels only where all go at one pace; else the way is the longer one, by little
    assert raw_snr(region, card) == pytest.approx(float(np.linalg.norm(2.0 * (a - b))), rel=0.06)
    assert raw_snr(region, card) >= float(np.linalg.norm(2.0 * (a - b))) * (1.0 - 1e-6)


def noise_of_rounding(card: SensorCard) -> float:
    return 1.0 / (12.0 * card.dn_per_e**2)


@pytest.mark.parametrize("room_e", [20.0, 400.0])
def test_its_square_is_twice_the_expected_likelihood_ratio(room_e: float) -> None:
    """Of 4000 draws of a spot at 4 to 6 sigma: 2 ln(L1 / L0) has the deviation 2 SNR, its mean 0.03 SNR.

    Poisson noise skews it: with s = 0.2 b in the brightest pixel twice the divergence is within 10 % of the square.
    """
    rng, card = np.random.default_rng(3), photons_only(full_well_e=1e9)
    region = region_of(22.0 * np.sqrt(room_e), room_e)
    counts = rng.poisson(region.mean_e, (4000, SIDE, SIDE))
    ratio = 2.0 * np.sum(counts * np.log(region.mean_e / region.background_e) - region.spot_e, axis=(1, 2))
    snr = raw_snr(region, card)
    assert 3.0 < snr < 9.0
    assert ratio.mean() == pytest.approx(snr**2, rel=0.1)


def test_a_faint_spot_has_the_ratio_of_a_matched_filter() -> None:
    region, card = region_of(1.0, 100.0), photons_only()
    # the peak adds 0.2 electrons to 100 and as much to the variance: 1e-3
    expected = np.sqrt(np.sum(region.spot_e**2) / (100.0 + noise_of_rounding(card)))
    assert raw_snr(region, card) == pytest.approx(float(expected), rel=1e-3)


def test_raw_pixels_rise_with_the_light_through_saturation() -> None:
    card = sensor_card("mono-raw")
    found = [raw_snr(region_of(flux, 50.0), card) for flux in np.geomspace(10.0, 3e7, 30)]
    assert all(np.diff(found) > 0.0)


def test_jpeg_rises_with_the_light_and_stays_below_the_codes() -> None:
    """Where three unknown room levels were degenerate a plain spot of 41 000 e- had 1.6; its codes have 67."""
    levels = (900.0, 900.0, 900.0)
    values: dict[str, list[float]] = {}
    for name in ("srgb8", "mjpeg"):
        card = sensor_card(name)
        for flux in (2000.0, 8000.0, 41_000.0):

            def information(part: float, card: SensorCard = card, flux: float = flux) -> float:
                light = part * flux
                limit = chain_limit(card, (200.3, 120.8), SpotBlur(0.8), light, levels)
                return float(limit.fisher[2, 2] * flux**2)

            values.setdefault(name, []).append(processed_snr(information, information(1.0)))
    assert np.all(np.diff(values["mjpeg"]) > 0.0)
    assert values["mjpeg"][-1] > 25.0
    assert np.all(np.array(values["mjpeg"]) < values["srgb8"])
