"""Cramer-Rao limits of a spot: against Mortensen's integral, characteristic functions, the chain, and draws.

Random tests have fixed streams and state the chance that they would fail for another one.
"""

from __future__ import annotations

import numpy as np
import pytest
import scipy
from helpers.processed_fisher import hartlap_factor, processed_fisher
from helpers.sensor_light import spot_at
from helpers.sensor_moments import drawn_moments, linear_operator, raw_moments

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.exposures.expected_electrons import ExpectedRegion, expected_of_light, expected_region
from phibench.datasets.frames.sensor_card import card_of, sensor_card
from phibench.estimator.geometry.status import Status
from phibench.estimator.limits.position_bound import (
    UNKNOWNS,
    censored_share,
    derivative_images,
    exact_information,
    limit_of,
    quantised_information,
    raw_information,
    spot_limit,
)
from phibench.estimator.spots.fit_raw import fit_raw
from phibench.estimator.spots.gaussian_spot import SpotBlur, SpotModel, covariance_bound, fisher_matrix
from phibench.estimator.spots.raw_pixels import PixelNoise, noise_of, raw_electrons
from phibench.render.sensor.camera_chain import Chain
from phibench.render.sensor.electrons import NoiseStream
from phibench.render.sensor.light import Light, Region
from phibench.render.sensor.settings import Sensor, sensor
from phibench.scenes.random_streams import generator

FALSE_ALARM = 1e-6  # per assertion
MONO = sensor("mono-raw", mono_weights=(1.0, 0.0, 0.0), dark_e_per_s=0.0)
BAYER = sensor("bayer-raw")
SIZE = (48, 48)


def scene(u: float, v: float, sigma_px: float, flux_e: float, background_e: float, s: Sensor) -> Light:
    """A spot of `flux_e` red electrons per exposure over a flat room; green and blue of it are a little darker."""
    room = np.array([1.0, 0.9, 0.6])[:, None, None] * np.full((3, *SIZE), background_e / s.exposure_s)
    return Light(room, spot_at(u, v, sigma_px, flux_e / s.exposure_s))


def region_of(u: float, v: float, sigma_px: float, flux_e: float, background_e: float, s: Sensor) -> ExpectedRegion:
    return expected_of_light(scene(u, v, sigma_px, flux_e, background_e, s), s)


# -- closed forms --------------------------------------------------------------------------------------------------


def mortensen_variance(sigma_px: float, flux_e: float, background_e: float) -> float:
    """Variance of u for maximum likelihood, K. I. Mortensen et al., Nature Methods 7, 377 (2010), eq. (5), a = 1 px."""
    s2 = sigma_px**2 + 1.0 / 12.0
    tau = 2.0 * np.pi * s2 * background_e / flux_e
    integral, _ = scipy.integrate.quad(lambda t: np.log(t) / (1.0 + t / tau), 0.0, 1.0)
    return s2 / flux_e / (1.0 + integral)


def thompson_variance(sigma_px: float, flux_e: float, background_e: float) -> float:
    """R. E. Thompson, D. R. Larson, W. W. Webb, Biophys. J. 82, 2775 (2002): of least squares; optimistic."""
    return (sigma_px**2 + 1.0 / 12.0) / flux_e + 8.0 * np.pi * sigma_px**4 * background_e / flux_e**2


@pytest.mark.parametrize("flux_e", [1000.0, 5000.0])
@pytest.mark.parametrize("sigma_px", [1.0, 1.5, 2.0])
def test_accuracy_mortensen(sigma_px: float, flux_e: float) -> None:
    """0.5 % of the standard deviation, rms over an 8 x 8 grid of phases. That a pixel adds a^2/12 to the Gaussian's
    variance and leaves it a Gaussian, as Mortensen takes it, is what may differ.
    """
    variances = []
    for phase in range(64):
        region = region_of(24 + phase % 8 / 8, 24 + phase // 8 / 8, sigma_px, flux_e, 10.0, MONO)
        limit = limit_of(derivative_images(region, "flux"), 1.0 / PixelNoise(0.0).variance_e2(region.mean_e))
        variances.append(np.trace(limit.covariance_px2) / 2.0)
    ratio = np.sqrt(np.mean(variances) / mortensen_variance(sigma_px, flux_e, 10.0))
    thompson = np.sqrt(np.mean(variances) / thompson_variance(sigma_px, flux_e, 10.0))
    print(f"sigma {sigma_px} px, {flux_e:g} e-: bound / Mortensen {ratio:.4f}, bound / Thompson {thompson:.4f}")
    assert len(variances) == 64
    assert ratio == pytest.approx(1.0, abs=0.005)
    assert thompson > 1.02  # what must not be used


# -- information of one pixel ----------------------------------------------------------------------------------------


def from_characteristic_function(mu: float, r: float) -> float:
    """Information from densities by inversion of exp(mu (e^it - 1) - r^2 t^2 / 2), differenced by mu."""
    t = np.linspace(-9.0 / r, 9.0 / r, 6001)
    x = np.arange(-9.0 * r, mu + 12.0 * np.sqrt(mu + r * r) + 9.0, min(r, 1.0) / 6.0)

    def density(mean: float) -> np.ndarray:
        phi = np.exp(mean * np.expm1(1j * t) - 0.5 * (r * t) ** 2)
        return (np.exp(-1j * x[:, None] * t) @ phi).real * (t[1] - t[0]) / (2.0 * np.pi)

    step = 1e-3 * np.sqrt(mu)
    slope, p = (density(mu + step) - density(mu - step)) / (2.0 * step), density(mu)
    seen = p > 1e-9 * p.max()  # rounding of the inversion is 1e-13
    return float(np.sum(slope[seen] ** 2 / p[seen]) * (x[1] - x[0]))


@pytest.mark.parametrize(("mu", "r"), [(0.5, 1.0), (10.0, 3.0), (3.0, 4.0), (200.0, 4.0)])
def test_accuracy_exact_information_against_the_characteristic_function(mu: float, r: float) -> None:
    """Differences of 1e-3 sd: 1e-6; tails below 1e-9 of the peak: 1e-7."""
    assert exact_information(np.array([mu]), r * r)[0] == pytest.approx(from_characteristic_function(mu, r), rel=1e-5)


def test_exact_information_is_a_little_above_the_approximate_one() -> None:
    """0.6 % at mu = 10, r = 3."""
    excess = exact_information(np.array([10.0]), 9.0)[0] * 19.0 - 1.0
    print(f"exact over approximate at mu = 10, r = 3: {100 * excess:+.2f} %")
    assert 0.0055 < excess < 0.0065
    assert exact_information(np.array([1e4]), 9.0)[0] * 10009.0 == pytest.approx(1.0, abs=1e-4)
    np.testing.assert_allclose(exact_information(np.array([5.0, 50.0]), 0.0), [0.2, 0.02])  # counts alone: 1 / mu


@pytest.mark.slow
@pytest.mark.parametrize("r", [0.5, 4.0])
def test_the_spline_through_exact_values(r: float) -> None:
    mean = np.geomspace(0.2, 2000.0, 150)
    direct = np.array([exact_information(mean[i : i + 1], r * r)[0] for i in range(0, 150, 7)])
    np.testing.assert_allclose(exact_information(mean, r * r)[::7], direct, rtol=5e-5 if r > 1 else 2e-3)


def test_quantised_information_at_its_limits() -> None:
    mean = np.array([3.0, 40.0, 400.0])
    fine = sensor_card("mono-raw", gain_dn_per_e=20.0, adc_bits=16, black_level_dn=2e3, dsnu_e=0.0)
    # a step of 1/20 e- on a noise of 4 e- loses (1/20)^2 / 12 / 16 = 1e-5
    np.testing.assert_allclose(quantised_information(mean, fine), exact_information(mean, 16.0), rtol=3e-5)
    coarse = sensor_card("mono-raw", gain_dn_per_e=0.25, dsnu_e=0.0)  # 1 DN of read noise
    noise = noise_of(coarse)
    # rounding as Gaussian noise of 1/12 DN^2 on 1 DN of noise: Sheppard's first harmonic is 1e-8, its flat law 1e-3
    as_noise = exact_information(mean, noise.gaussian_e2)
    np.testing.assert_allclose(quantised_information(mean, coarse), as_noise, rtol=2e-3)
    assert quantised_information(mean[2:], coarse)[0] < exact_information(mean[2:], 16.0)[0]


def test_quantised_information_where_the_converter_or_the_well_ends() -> None:
    """Nothing is left above; half way it lies between the bound from the chain's moments and the unclipped value."""
    for s in (
        sensor("mono-raw", gain_dn_per_e=0.5, prnu=0.0, dsnu_e=0.0, dark_e_per_s=0.0),  # 959 DN are 1918 e-
        sensor("mono-raw", full_well_e=1918.0, gain_dn_per_e=0.4, prnu=0.0, dsnu_e=0.0, dark_e_per_s=0.0),
    ):
        card = card_of(s)
        assert quantised_information(np.array([4000.0]), card)[0] < 1e-12
        half = quantised_information(np.array([1918.0]), card)[0]
        free = 1.0 / noise_of(card).variance_e2(np.array([1918.0]))[0]
        m, v = zip(*(clipped_moments(s, mu) for mu in (1898.0, 1918.0, 1938.0)), strict=True)
        bracket = ((m[2] - m[0]) / 40.0) ** 2 / v[1]
        # drawn means of 65536 pixels: the slope's standard error is 1.6 %
        assert 0.95 * bracket < half < 0.98 * free
        assert bracket > 0.3 * free


@pytest.mark.parametrize("model", ["approximate", "exact"])
def test_accuracy_information_near_the_full_well_against_the_codes(model: str) -> None:
    """The codes' law is summed, the censored Gaussian is a closed form; 1 % of what an uncut pixel has.

    Read noise comes after the full well and hides which of the highest readings are full: with 0.5 electrons on 110 of
    shot noise that is below 1 %, with the preset's 4 electrons at most 6 %.
    """
    ideal = sensor_card("mono-raw", prnu=0.0, dsnu_e=0.0, read_noise_e=0.5, gain_dn_per_e=1.0, adc_bits=16)
    real = sensor_card("mono-raw", prnu=0.0, dsnu_e=0.0, gain_dn_per_e=0.075)
    z = np.array([-9.0, -3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0, 4.0])
    for card, tolerance in ((ideal, 0.01), (real, 0.06)):
        assert card.saturation_e == card.full_well_e  # the converter does not end first
        mean = card.full_well_e + np.sqrt(card.full_well_e) * z
        uncut = 1.0 / noise_of(card).variance_e2(mean)
        shares, codes = raw_information(mean, card, model) / uncut, quantised_information(mean, card) / uncut
        print("share of the information left:", np.round(shares, 4), "of the codes:", np.round(codes, 4))
        np.testing.assert_allclose(shares, codes, rtol=0, atol=tolerance)
        assert shares[0] == pytest.approx(1.0, abs=2e-3)
        assert 0.75 < shares[4] < 0.9  # half of the readings are full: what is lost is not half
        assert shares[-1] < 2e-3
        assert np.all(np.diff(shares) < 1e-9)


@pytest.mark.parametrize("z", [-2.5, -1.0, 0.0, 1.0, 2.5])
def test_censored_share_is_the_mean_square_of_drawn_scores(z: float) -> None:
    """Scores by differences of the censored log likelihood. 2e5 draws; a score's square has a deviation of at most 1.7
    times its mean's bound of 1, so that five standard errors are 0.02.
    """
    well, s, n = 12_000.0, 160.0, 200_000
    mean = well - z * s
    x = generator("limits", "censored", z).normal(mean, s, n)
    full, step = x >= well, 1e-3 * s

    def log_likelihood(mu: float) -> np.ndarray:
        return np.where(full, scipy.stats.norm.logsf(well, mu, s), scipy.stats.norm.logpdf(x, mu, s))

    score = (log_likelihood(mean + step) - log_likelihood(mean - step)) / (2.0 * step)
    share = censored_share(np.array([mean]), np.array([s * s]), well)[0]
    assert abs(score.mean()) * s < 5.0 / np.sqrt(n)
    assert share == pytest.approx(s * s * np.mean(score**2), abs=0.02)
    assert censored_share(np.array([mean]), np.array([s * s]), np.inf)[0] == 1.0


@pytest.mark.parametrize(("s", "u", "v"), [(MONO, 24.3, 23.8), (BAYER, 25.0, 24.0)])
def test_accuracy_bound_of_a_saturated_spot_against_fits(s: Sensor, u: float, v: float) -> None:
    """Full pixels in the middle, 300 cameras: rms of the fit over the bound, to 1 / sqrt(4 n) = 2.9 %.

    The fit leaves out what may be full (`full_from_e`), so that it may lose some per cent. If full pixels informed, the
    bound would be smaller by 22 % and 39 %, and no fit would reach it.
    """
    n = 300
    region, card = region_of(u, v, 0.7, 200_000.0, 100.0, s), card_of(s)
    assert region.mean_e.max() > 1.3 * card.saturation_e
    rng = generator("limits", "saturated", s.mosaic)
    shape = (n, *region.mean_e.shape)
    light = region.mean_e * (1.0 + card.prnu * rng.normal(size=shape))
    charge = np.minimum(rng.poisson(np.maximum(light, 0.0)), card.full_well_e)
    added = np.hypot(card.read_noise_e, card.dsnu_e) * rng.normal(size=shape)
    dn = np.clip(np.rint(card.black_level_dn + card.dn_per_e * (charge + added)), 0, card.top_dn)
    x = raw_electrons(dn, card)
    response = (1.0, 0.10, 0.03) if s.mosaic == "bayer" else None
    origin = (region.u0_px, region.v0_px)
    fit = fit_raw(x, origin, noise_of(card), SpotBlur(0.7), SpotModel(response), card.full_from_e)
    assert (fit.status == Status.OK).all()
    rms = np.sqrt(np.mean((fit.uv_px - [u, v]) ** 2))
    bound = spot_limit(region, card).rms_px
    wrong = limit_of(derivative_images(region), 1.0 / noise_of(card).variance_e2(region.mean_e)).rms_px
    print(
        f"{s.mosaic}: rms {1e3 * rms:.2f} mpx, bound {1e3 * bound:.2f} mpx, ratio {rms / bound:.3f}, {rms / wrong:.3f}"
    )
    assert 0.9 < rms / bound < 1.15
    assert rms / wrong > 1.15


def clipped_moments(s: Sensor, mean_e: float) -> tuple[float, float]:
    light = Light.flat((mean_e / s.exposure_s, 0.0, 0.0), (256, 256))
    frame = Chain(s).frame(light, NoiseStream(("limits", "clipped", int(mean_e)))).astype(float)
    return float(frame.mean()), float(frame.var())


# -- derivative images and the bound ---------------------------------------------------------------------------------


@pytest.mark.parametrize("s", [MONO, BAYER])
def test_derivatives_against_differences_of_the_chain(s: Sensor) -> None:
    """Central differences of h = 1e-3 px: h^2 / 6 f''' / f' < 1e-6 at a blur of 0.7 px."""
    u, v, h = 24.3, 23.8, 1e-3
    region = region_of(u, v, 0.7, 5000.0, 100.0, s)
    box = Region(region.u0_px, region.v0_px, region.u0_px + region.mean_e.shape[1], region.v0_px + len(region.mean_e))

    def photo(du: float = 0.0, dv: float = 0.0, flux_e: float = 5000.0, background_e: float = 100.0) -> np.ndarray:
        return Chain(s).photo_electrons(scene(u + du, v + dv, 0.7, flux_e, background_e, s), box)

    images = derivative_images(region)
    peak = np.abs(images[0]).max()
    np.testing.assert_allclose(images[0], (photo(du=h) - photo(du=-h)) / (2 * h), rtol=0, atol=1e-5 * peak)
    np.testing.assert_allclose(images[1], (photo(dv=h) - photo(dv=-h)) / (2 * h), rtol=0, atol=1e-5 * peak)
    np.testing.assert_allclose(images[2], (photo(flux_e=5050.0) - photo()) / 0.01, rtol=0, atol=1e-6 * peak)
    levels = images[3:]
    assert len(levels) == (1 if s is MONO else 3)
    brighter = (photo(background_e=101.0) - photo()) @ np.ones(images.shape[2])
    weights = np.array([1.0]) if s is MONO else np.array([1.0, 0.9, 0.6])
    np.testing.assert_allclose(np.einsum("c,chw->h", weights, levels), brighter, rtol=1e-6)
    np.testing.assert_allclose(region.mean_e, photo() + s.dark_e_per_s * s.exposure_s, rtol=1e-12)


def test_more_unknowns_cost_and_models_agree() -> None:
    """Each unknown more makes the bound larger; at 10 e- and more the models of the noise differ by under 2 %."""
    card = card_of(BAYER)
    region = region_of(24.3, 23.8, 0.7, 5000.0, 30.0, BAYER)
    known = [spot_limit(region, card, unknown, pattern_known=True).rms_px for unknown in UNKNOWNS]
    assert known[0] < known[1] < known[2] < 1.2 * known[0]
    models = {name: spot_limit(region, card, model=name, pattern_known=True).rms_px for name in ("exact", "quantised")}
    assert models["exact"] == pytest.approx(known[2], rel=0.01)
    assert models["quantised"] == pytest.approx(known[2], rel=0.02)
    assert spot_limit(region, card).rms_px > known[2]  # PRNU and DSNU as noise


def test_what_the_pixels_cannot_tell_is_nan() -> None:
    images = np.zeros((4, 6, 6))
    images[0, 2, 2], images[2], images[3] = 1.0, 1.0, 1.0  # v has no effect, flux and background look alike
    assert np.isnan(covariance_bound(fisher_matrix(images, np.ones((6, 6))))).all()
    mixed = np.stack([np.eye(3), np.zeros((3, 3))])
    bound = covariance_bound(mixed)
    np.testing.assert_allclose(bound[0], np.eye(2))
    assert np.isnan(bound[1]).all()


def test_an_ideal_sampler_has_efficiency_one() -> None:
    """Truth + draws from the bound: e^T C^-1 e is chi-square with 2 degrees of freedom each. 3 % more is noticed."""
    limit = spot_limit(region_of(24.3, 23.8, 0.7, 5000.0, 100.0, BAYER), card_of(BAYER))
    n = 20_000
    errors = generator("limits", "ideal sampler").multivariate_normal([0.0, 0.0], limit.covariance_px2, n)
    square = np.einsum("ni,ij,nj->", errors, np.linalg.inv(limit.covariance_px2), errors)
    low, high = scipy.stats.chi2.ppf([FALSE_ALARM / 2, 1 - FALSE_ALARM / 2], 2 * n)
    interval = np.sqrt(2 * n / np.array([high, square, low]))
    print("efficiency of the sampler {1:.4f}, between {0:.4f} and {2:.4f}".format(*interval))
    assert low < square < high
    assert square * 1.03**2 > high
    assert square / 1.03**2 < low


def test_accuracy_bayer_phase() -> None:
    """The bound over the 2 x 2 cell, and what the colour filters cost against the same pixels without (red light)."""
    card, mono_card = card_of(BAYER), card_of(MONO)
    rows = []
    for sigma_px in (0.5, 0.7, 1.0):
        phases = [(23 + i / 8, 23 + j / 8) for i in range(16) for j in range(16)]
        bayer, mono = (
            np.array([spot_limit(region_of(u, v, sigma_px, 1e4, 100.0, s), c).rms_px for u, v in phases])
            for s, c in ((BAYER, card), (MONO, mono_card))
        )
        spread, cost = np.percentile(bayer, 95) / np.median(bayer), np.median(bayer) / np.median(mono)
        mean_cost = np.sqrt(np.mean(bayer**2) / np.mean(mono**2))
        rows.append((sigma_px, spread, cost))
        print(
            f"blur {sigma_px} px: rms bound {1e3 * np.median(bayer):.2f} mpx (median), p95/median {spread:.2f}, "
            f"max/min {bayer.max() / bayer.min():.2f}, Bayer/mono {cost:.2f} (median) {mean_cost:.2f} (rms)"
        )
    assert len(rows) == 3
    assert rows[0][1] > rows[1][1] > rows[2][1] > 1.0  # blur evens the phases out
    assert rows[1][2] == pytest.approx(2.4, abs=0.4)


# -- processed pixels ------------------------------------------------------------------------------------------------


def test_linear_processing_that_keeps_the_pixels_loses_nothing() -> None:
    """Demosaicing, white balance and matrix of the whole image: the same Fisher matrix as the raw pixels."""
    s = sensor("bayer-raw", analogue_gain=4.0)
    room = np.full((3, 14, 16), 6e3)
    light, whole = Light(room, spot_at(7.3, 6.8, 0.7, 3e5)), Region.whole((14, 16))
    region = expected_of_light(light, s, margin_px=20)
    assert region.mean_e.shape == (14, 16)
    raw = raw_moments(Chain(s.replace(prnu=0.0, dsnu_e=0.0)), light, whole)
    slopes = s.dn_per_e * derivative_images(region).reshape(6, -1)
    operator = linear_operator(s, (14, 16))
    C = operator @ (operator @ raw.covariance_dn2()).T
    direct = fisher_matrix(s.dn_per_e * derivative_images(region), 1.0 / raw.variance_dn2)
    # the pseudo-inverse cuts at 1e-11
    np.testing.assert_allclose(processed_fisher(slopes @ operator.T, C), direct, rtol=1e-6)
    without_red = np.arange(operator.shape[0]) >= 14 * 16
    less = processed_fisher(slopes @ operator.T[:, without_red], C[np.ix_(without_red, without_red)])
    assert less[0, 0] < 0.999 * direct[0, 0]


def test_the_inverse_of_a_sample_covariance_is_corrected() -> None:
    """Mean of 400 repetitions with 60 draws of 20 outputs: standard error 1.3 %; without the factor it is 1.55."""
    rng = generator("limits", "hartlap")
    slopes, truth = rng.normal(size=(2, 20)), np.eye(20)
    expected = processed_fisher(slopes, truth)[0, 0]
    J = [processed_fisher(slopes, np.cov(rng.normal(size=(60, 20)), rowvar=False), 60)[0, 0] for _ in range(400)]
    error = np.std(J) / 20.0
    assert abs(np.mean(J) - expected) < 5.0 * error
    assert abs(np.mean(J) / hartlap_factor(20, 60) - expected) > 5.0 * error
    with pytest.raises(ValueError, match="23 draws are the least"):
        processed_fisher(slopes, truth, 22)


def test_noise_of_the_slopes_adds_no_information() -> None:
    """Two noisy estimates of slopes: products of different ones are right in the mean, squares are too large."""
    rng = generator("limits", "slopes")
    slopes = rng.normal(size=(2, 50))
    expected = processed_fisher(slopes, np.eye(50))[0, 0]
    noisy = [slopes + 0.7 * rng.normal(size=(2, 2, 50)) for _ in range(600)]
    crossed, squared = (np.array([processed_fisher(x[:n], np.eye(50))[0, 0] for x in noisy]) for n in (2, 1))
    assert abs(crossed.mean() - expected) < 5.0 * crossed.std() / np.sqrt(600)
    assert abs(squared.mean() - expected) > 5.0 * squared.std() / np.sqrt(600)


@pytest.mark.slow
def test_accuracy_processed_bound_lies_above_the_raw_one() -> None:
    """sRGB, 8 bit, drawn: the position's bound is at least the raw one and at most some per cent more."""
    s = sensor("srgb8", prnu=0.0, dsnu_e=0.0)
    light, window = scene(24.3, 23.8, 0.7, 10_000.0, 400.0, s), Region(20, 20, 29, 28)
    chain, stream, draws, step = Chain(s), NoiseStream(("limits", "srgb8")), 3000, 0.1
    C = drawn_moments(chain, light, window, stream, draws).covariance

    def mean(du: float, dv: float, half: str) -> np.ndarray:
        moved = scene(24.3 + du, 23.8 + dv, 0.7, 10_000.0, 400.0, s)
        return drawn_moments(chain, moved, window, stream.stage(half, f"{du} {dv}"), 1000).mean.ravel()

    slopes = [
        [(mean(step * i, step * j, half) - mean(-step * i, -step * j, half)) / (2 * step) for i, j in ((1, 0), (0, 1))]
        for half in ("a", "b")
    ]
    processed = np.sqrt(np.trace(np.linalg.inv(processed_fisher(slopes, C, draws))) / 2.0)
    region = expected_of_light(light, s.replace(output="raw"))
    raw = spot_limit(region, card_of(s), "position", pattern_known=True).rms_px
    print(f"sRGB 8 bit: bound {1e3 * processed:.2f} mpx, raw {1e3 * raw:.2f} mpx, ratio {processed / raw:.3f}")
    # covariance of 216 outputs from 3000 draws: sqrt(2 / 2784) = 2.7 % of the variance; slopes about as much
    assert 0.95 < processed / raw < 1.25


# -- what is said to the user ------------------------------------------------------------------------------------------


def test_messages() -> None:
    region = region_of(24.3, 23.8, 0.7, 5000.0, 100.0, BAYER)
    card = card_of(BAYER)
    with pytest.raises(ValueError, match="unknown 'flx'"):
        spot_limit(region, card, "flx")
    with pytest.raises(ValueError, match="noise model 'exakt'"):
        spot_limit(region, card, model="exakt")
    with pytest.raises(ValueError, match="row_noise_e = 2"):
        spot_limit(region, sensor_card("bayer-raw", row_noise_e=2.0))
    with pytest.raises(ValueError, match="gaussian_e2"):
        PixelNoise(-1.0)
    with pytest.raises(DatasetError, match="no light of the spot"):
        expected_of_light(Light.flat((1.0, 1.0, 1.0), SIZE), BAYER)
    with pytest.raises(DatasetError, match="outside the image"):
        region_of(200.0, 24.0, 0.7, 5000.0, 100.0, BAYER)


def test_a_spot_at_the_edge_is_cut_with_the_image() -> None:
    region = region_of(0.2, 47.1, 0.7, 5000.0, 100.0, BAYER)
    assert (region.u0_px, region.v0_px + len(region.mean_e)) == (0, 48)
    assert np.isfinite(spot_limit(region, card_of(BAYER)).rms_px)


def test_region_of_a_stored_sample(tiny_dataset) -> None:
    from phibench.datasets.read import open_dataset

    sample = open_dataset(tiny_dataset).samples[0]
    region = expected_region(sample, "down", BAYER)
    light = Light(sample.ambient("down"), sample.spot("down"))
    h, w = region.mean_e.shape
    box = Region(region.u0_px, region.v0_px, region.u0_px + w, region.v0_px + h)
    dark = BAYER.dark_e_per_s * BAYER.exposure_s
    np.testing.assert_allclose(region.mean_e, Chain(BAYER).photo_electrons(light, box) + dark, rtol=1e-6)
    limit = spot_limit(region, card_of(BAYER))
    assert 1e-4 < limit.rms_px < 1.0
