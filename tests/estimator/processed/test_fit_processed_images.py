"""Fit through the chain: its stages against the simulator's and against Pillow, its laws against sums, its failures."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import pytest
import scipy
from helpers.chain_scenes import COLLECTED, MIDDLE, ROOM, SQUARE, UNITS, scene
from PIL import Image

from phibench.datasets.frames.sensor_card import card_of
from phibench.estimator.geometry.status import Status
from phibench.estimator.limits.processed_bound import chain_limit
from phibench.estimator.processed.chain_model import chain_model, codes
from phibench.estimator.processed.fit_processed_images import fit_jpeg, fit_srgb
from phibench.estimator.processed.inverse_processing import unprocessed_electrons
from phibench.estimator.spots.camera_codes import (
    coefficients,
    linear_to_srgb,
    noisy_code,
    quantisation,
    quantised_output,
    quantiser_steps,
    srgb_slope,
    srgb_to_linear,
)
from phibench.estimator.spots.fit_raw import fit_law
from phibench.estimator.spots.gaussian_spot import SpotBlur, SpotModel, SpotPixels
from phibench.estimator.spots.jpeg_recovery import recovered_coefficients
from phibench.estimator.spots.pixel_statistics import code_law, code_table
from phibench.estimator.spots.raw_pixels import (
    GaussLaw,
    PixelNoise,
    background_of,
    bayer_filters,
    noise_before_rounding,
    outside_spot,
    spot_regions,
)
from phibench.render.sensor import processing
from phibench.render.sensor.camera_chain import Chain
from phibench.render.sensor.electrons import NoiseStream
from phibench.render.sensor.settings import sensor
from phibench.scenes.random_streams import generator

SRGB, MJPEG = sensor("srgb8"), sensor("mjpeg", jpeg_quality=85)
FLUX_E = 5000.0 / COLLECTED


def test_an_image_that_compression_has_emptied_has_no_spot() -> None:
    """Hardly any noise and coarse steps: no coefficient changes, so that there is nothing to fit; no error either."""
    card = card_of(sensor("mjpeg", jpeg_quality=1, read_noise_e=0.01, prnu=0.0, dsnu_e=0.0))
    flat = np.full((1, 48, 64, 3), 20, np.uint8)
    fit = fit_jpeg(flat, (0, 0), card, SpotBlur(0.7))
    assert fit.status[0] == Status.NO_SPOT
    assert not np.isfinite(chain_limit(card, (30.2, 22.7), SpotBlur(0.7), 50.0, (1.0, 1.0, 1.0)).covariance_px2).any()


def test_srgb_curve_against_the_simulators() -> None:
    x = np.concatenate([[-0.1, 0.0, 0.0031308, 1.0, 1.2], np.linspace(0.0, 1.0, 501)])
    np.testing.assert_allclose(linear_to_srgb(x), processing.srgb_encoded(x), rtol=0, atol=1e-12)
    np.testing.assert_allclose(srgb_to_linear(processing.srgb_encoded(x)), np.clip(x, 0, 1), rtol=0, atol=1e-6)
    inside = np.linspace(0.01, 0.99, 99)
    h = 1e-6
    slope = (processing.srgb_encoded(inside + h) - processing.srgb_encoded(inside - h)) / (2 * h)
    np.testing.assert_allclose(srgb_slope(inside), slope, rtol=1e-6)


def test_noisy_curve_against_quadrature() -> None:
    """Smooth where the noise does not reach the cut: 1e-6; at the cut 9 nodes are good to 3 % of the deviation."""
    for mean, sigma, tolerance in ((0.3, 0.02, 1e-6), (0.0005, 0.0006, 0.03 * 12.92 * 0.0006)):
        wide = [mean + k * sigma for k in (-9.0, 9.0)]
        exact, _ = scipy.integrate.quad(
            lambda x, m=mean, s=sigma: float(processing.srgb_encoded(np.array(x))) * scipy.stats.norm.pdf(x, m, s),
            *wide,
            points=[0.0, 0.0031308] if wide[0] < 0 else None,
            limit=400,
        )
        found = noisy_code(np.array([mean]), np.array([sigma]), card_of(SRGB)).mean[0]
        assert found == pytest.approx(exact, abs=tolerance)


def test_every_raw_code_lies_in_the_interval_of_its_8_bit_code() -> None:
    """All DN of the converter, sent through the simulator's stages, three colours."""
    card = card_of(SRGB)
    table, dn = code_table(card), np.arange(card.top_dn + 1)
    planes = processing.white_balanced(
        np.repeat(processing.linear_signal(dn, SRGB)[None, None], 3, axis=0), card.white_balance
    )
    eight = processing.eight_bit(processing.srgb_encoded(planes))[0]  # (dn, 3)
    electrons = (dn - card.black_level_dn) / card.dn_per_e
    for colour in range(3):
        low, high = table.low_e[colour, eight[:, colour]], table.high_e[colour, eight[:, colour]]
        assert (electrons >= low).all()
        assert (electrons < high).all()
    assert np.isneginf(table.low_e[:, 0]).all()
    assert np.isposinf(table.high_e[:, 255]).all()


@pytest.mark.parametrize("mean_e", [0.0, 30.0, 800.0, 11_000.0])
def test_law_of_a_code_sums_to_one_and_gives_its_information(mean_e: float) -> None:
    """Sum of P, of the scores and of their squares over all codes that occur, by the likelihood itself."""
    card = card_of(SRGB)
    table = code_table(card)
    for colour in range(3):
        _, once = np.unique(table.low_e[colour], return_index=True)
        filters = np.full((1, 1, len(once)), colour)
        law = code_law(once[None, None].astype(np.uint8), filters, card, noise_before_rounding(card), table)
        mean = np.full(filters.shape, mean_e)
        P, score = np.exp(-0.5 * law.misfit(mean, mean)), law.score(mean, mean)
        information = law.information(mean)[0, 0, 0]
        assert P.sum() == pytest.approx(1.0, abs=1e-9)
        assert (P * score).sum() == pytest.approx(0.0, abs=1e-6 * np.sqrt(information) + 1e-12)
        # linear interpolation between 1024 nodes
        assert (P * score**2).sum() == pytest.approx(information, rel=5e-3, abs=1e-9)


def test_quantiser_against_its_sum_and_against_draws() -> None:
    for mean, sigma in ((0.3, 0.05), (0.49, 0.05), (2.2, 0.3), (-1.4, 0.7), (0.5, 1.5)):
        k = np.arange(-40, 41)
        p = np.diff(scipy.stats.norm.cdf(np.append(k - 0.5, 40.5), mean, sigma))
        one = quantised_output(np.array([4.0 * mean]), np.array([4.0 * sigma]), np.array([4.0]))
        h = 1e-5
        shifted = [np.diff(scipy.stats.norm.cdf(np.append(k - 0.5, 40.5), mean + d, sigma)) @ k for d in (h, -h)]
        assert one.mean[0] == pytest.approx(4.0 * (p @ k), abs=1e-5)
        assert one.slope[0] == pytest.approx((shifted[0] - shifted[1]) / (2 * h), abs=1e-5)
        assert one.variance[0] == pytest.approx(16.0 * (p @ k**2 - (p @ k) ** 2), rel=1e-5)


@pytest.mark.parametrize("quality", [10, 49, 50, 75, 85, 95, 100])
def test_quantisation_tables_are_pillows(quality: int) -> None:
    file = io.BytesIO()
    Image.fromarray(np.zeros((16, 16, 3), np.uint8)).save(file, "JPEG", quality=quality)
    tables = Image.open(io.BytesIO(file.getvalue())).quantization
    for ours, theirs in zip(quantisation(quality), (tables[0], tables[1]), strict=True):
        np.testing.assert_array_equal(ours.ravel(), theirs)


@pytest.mark.parametrize("subsampling", ["4:4:4", "4:2:2", "4:2:0"])
@pytest.mark.parametrize("background_e", [0.0, 400.0])
def test_coefficients_behind_a_decoded_image(subsampling: str, background_e: float) -> None:
    """Those of the image before JPEG, rounded; at most 3 % differ, where libjpeg's integers round the other way.

    Without the quantiser's grid none of the 64 frequencies would agree. Dark rooms are cut at 0.
    """
    s = MJPEG.replace(jpeg_subsampling=subsampling)
    light = scene(MIDDLE, 0.7, FLUX_E, background_e, s)
    before = Chain(s.replace(output="srgb8")).frame(light, NoiseStream(("recovery",)))
    after = Chain(s).frame(light, NoiseStream(("recovery",)))
    found = recovered_coefficients(after[None], 85, subsampling, (True,) * 4)
    z = np.concatenate([found.luma.ravel(), found.chroma.ravel()])
    step = quantiser_steps(before.shape[:2], subsampling, 85)
    codes_before = np.moveaxis(before.astype(float), -1, 0)
    exact = coefficients(codes_before, subsampling)
    exact[: before.shape[0] * before.shape[1] : 64] -= 1024.0  # the level shift, on Y's mean
    differ = np.abs(z / step - np.rint(exact / step)) > 0.5
    assert (after == 0).any() == (background_e == 0.0)
    assert z.any()
    assert differ.mean() < 0.03
    assert found.wrong.mean() < 0.01


@pytest.mark.parametrize("subsampling", ["4:2:2", "4:2:0"])
def test_a_dark_room_comes_out_again(subsampling: str) -> None:
    """Half of the pixels are cut at 0: without steps of single coefficients 0.5 % of the pixels are wrong."""
    s = MJPEG.replace(jpeg_subsampling=subsampling)
    for k in range(3):
        light = scene(MIDDLE + [0.2 * k, 0.3], 0.7, 4.0 * FLUX_E, 0.0, s)
        found = recovered_coefficients(
            Chain(s).frame(light, NoiseStream(("dark", k)))[None], 85, subsampling, (True,) * 4
        )
        assert found.wrong.mean() < 0.002


@pytest.mark.parametrize("changes", [{}, {"sharpen_amount": 0.5}], ids=["plain", "sharpened"])
def test_model_of_the_means_against_the_chain(changes: dict) -> None:
    """Mean codes of 600 frames: chi-square of 1536 values; a false alarm in 1e-6, a shift by 0.3 codes is noticed."""
    s = MJPEG.replace(prnu=0.0, dsnu_e=0.0, **changes)
    model = chain_model(card_of(s), noise_before_rounding(card_of(s)))
    light, m = scene(MIDDLE + [0.3, -0.2], 0.7, FLUX_E, 100.0, s), model.margin
    from phibench.render.sensor.light import Region

    window = Region(32, 24, 64, 40)
    raw = Region(32 - m, 24 - m, 64 + m, 40 + m)
    mean_e = Chain(s).photo_electrons(light, raw) + s.dark_e_per_s * s.exposure_s
    at = codes(model, mean_e.ravel())
    developed = Chain(s.replace(output="srgb8"))
    n = 600
    frames = np.stack([developed.frame(light, NoiseStream(("model", k)), window) for k in range(n)]).astype(float)
    planes = np.moveaxis(frames, -1, 1)
    wanted = at.mean @ model.transform + model.shift
    drawn = coefficients(planes, "4:2:2") + model.shift
    z = (drawn.mean(axis=0) - wanted) / (drawn.std(axis=0, ddof=1) / np.sqrt(n))
    # nodes of the table and neighbours of unequal means leave some hundredths of a code
    assert np.mean(z**2) < (1.6 if not changes else 2.2)
    off = (drawn.mean(axis=0) - wanted + 0.3 * coefficients(np.ones((3, 16, 32)), "4:2:2")) / (
        drawn.std(axis=0, ddof=1) / np.sqrt(n)
    )
    print(np.mean(z**2), np.mean(off**2))
    assert np.mean(off**2) > 3.0


@pytest.mark.parametrize("preset", ["srgb8", "mjpeg"])
def test_fit_of_a_bright_spot(preset: str) -> None:
    """Within 6 standard deviations of its own; flux within 10 %. What is offered as the wrong phase is not."""
    s = sensor(preset)
    uv = MIDDLE + [0.3, -0.4]
    light, box = scene(uv, 0.7, FLUX_E, 100.0, s), UNITS if preset == "mjpeg" else SQUARE
    frames = np.stack([Chain(s, k).frame(light, NoiseStream(("bright", k)), box) for k in range(4)])
    fit = (fit_jpeg if preset == "mjpeg" else fit_srgb)(frames, (box.u0_px, box.v0_px), card_of(s), SpotBlur(0.7))
    assert (fit.status == Status.OK).all()
    sd = np.sqrt(np.diagonal(fit.covariance_px2, axis1=1, axis2=2))
    assert (np.abs(fit.uv_px - uv) < 6.0 * sd).all()
    assert (sd < 0.06).all()
    np.testing.assert_allclose(fit.flux_e, FLUX_E, rtol=0.1)
    limit = chain_limit(card_of(s), uv, SpotBlur(0.7), FLUX_E, 100.0 * ROOM)
    np.testing.assert_allclose(sd.mean(axis=0), np.sqrt(np.diag(limit.covariance_px2)), rtol=0.15)


def test_sharpening_and_matrix_are_undone() -> None:
    s = SRGB.replace(sharpen_amount=0.5, colour_matrix=((1.4, -0.3, -0.1), (-0.2, 1.4, -0.2), (0.0, -0.4, 1.4)))
    light = scene(MIDDLE, 0.9, FLUX_E, 1500.0, s.replace(shot_noise=False, read_noise_e=0.0))
    frame = Chain(s.replace(shot_noise=False, read_noise_e=0.0, prnu=0.0, dsnu_e=0.0)).frame(
        light, NoiseStream(("undone",)), SQUARE
    )
    x, extra = unprocessed_electrons(frame[None], np.array([[SQUARE.u0_px, SQUARE.v0_px]]), card_of(s))
    photo = Chain(s.replace(output="raw")).photo_electrons(light, SQUARE)
    inner = (slice(4, -4), slice(4, -4))
    # 5 deviations of 8 bits, and half a DN of the converter
    assert (np.abs(x[0] - photo)[inner] < 5.0 * np.sqrt(extra[0][inner]) + 0.5 / s.dn_per_e + 1.0).all()


def test_background_of_a_flat_room_is_quiet_and_of_an_edge_is_kept() -> None:
    rng = generator("chain", "base")
    room = np.full((1, 48, 64), 400.0)
    room[:, :, 40:] = 1600.0
    variance = room + 16.0
    base = background_of(room + rng.normal(size=room.shape) * np.sqrt(variance), variance, np.ones(room.shape))
    flat = (slice(None), slice(8, 40), slice(4, 24))
    assert np.std(base.mean_e[flat] - room[flat]) < 0.4 * np.sqrt(416.0)
    edge = (slice(None), slice(8, 40), slice(38, 42))
    assert np.abs(base.mean_e[edge] - room[edge]).mean() < 3.0 * 40.0
    assert base.variance_e2[edge].mean() > 3.0 * base.variance_e2[flat].mean()
    hidden = outside_spot(np.array([[20.0, 20.0]]), np.zeros((1, 2)), (48, 64))
    assert hidden[0, 20, 20] == 0.0
    assert hidden[0, 20, 26] == 1.0


def test_messages() -> None:
    card, image = card_of(MJPEG), np.zeros((1, 32, 64, 3), np.uint8)
    with pytest.raises(ValueError, match="uint8 is needed"):
        fit_srgb(image.astype(float), (0, 0), card, SpotBlur(0.7))
    with pytest.raises(ValueError, match="multiples of 16 x 8"):
        fit_jpeg(image, (8, 8), card, SpotBlur(0.7))
    with pytest.raises(ValueError, match="needs 'bayer'"):
        fit_srgb(image, (0, 0), card_of(sensor("srgb8", mosaic="mono")), SpotBlur(0.7))
    with pytest.raises(ValueError, match="knows 'srgb8', 'yuyv' and 'mjpeg'"):
        chain_limit(card_of(sensor("bayer-raw")), (10.0, 10.0), SpotBlur(0.7), 1e4, (1.0, 1.0, 1.0))
    with pytest.raises(ValueError, match="1 to 100"):
        quantisation(0)


def test_nothing_there() -> None:
    light = scene(MIDDLE, 0.7, 1.0, 100.0, MJPEG)
    frame = Chain(MJPEG).frame(light, NoiseStream(("nothing",)), UNITS)
    fit = fit_jpeg(frame[None], (UNITS.u0_px, UNITS.v0_px), card_of(MJPEG), SpotBlur(0.7))
    assert fit.status[0] != Status.OK
    assert np.isnan(fit.uv_px).all()
    assert fit_srgb(np.zeros((0, 17, 17, 3), np.uint8), (0, 0), card_of(SRGB), SpotBlur(0.7)).uv_px.shape == (0, 2)
    assert fit_jpeg(np.zeros((0, 16, 32, 3), np.uint8), (0, 0), card_of(MJPEG), SpotBlur(0.7)).uv_px.shape == (0, 2)


def oblique(centre: np.ndarray, moments: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Share of each pixel of a Gaussian with any covariance, 9 x 9 Gauss-Legendre points a pixel."""
    x, w = np.polynomial.legendre.leggauss(9)
    v, u = (np.arange(n)[:, None] + 0.5 * x for n in shape)
    points = np.stack(np.broadcast_arrays(u[None, :, None, :], v[:, None, :, None]), axis=-1) - centre
    density = np.exp(-0.5 * np.einsum("...i,ij,...j->...", points, np.linalg.inv(moments), points))
    return np.einsum("vukl,k,l->vu", density, 0.5 * w, 0.5 * w) / (2.0 * np.pi * np.sqrt(np.linalg.det(moments)))


def test_means_and_derivatives_of_an_oblique_spot() -> None:
    """Mixed moment of 0.035 px^2 on 0.5: its second order is 0.5 (0.07)^2 = 0.25 % of the peak; the first is 7 %."""
    blur = SpotBlur.of(np.array([[0.515, 0.035], [0.035, 0.56]]))
    filters = bayer_filters(np.array([[0, 0]]), (14, 16))[0]
    pixels = SpotPixels.of(filters[None], blur, SpotModel((1.0, 0.1, 0.03), free_width=True))
    theta = np.array([[7.3, 6.6, 1e4, 100.0, 90.0, 60.0, blur.sigma_px]])
    mean, derivatives = pixels.at(theta)
    exact = (
        1e4
        * np.array([1.0, 0.1, 0.03])[filters]
        * oblique(theta[0, :2], np.array([[0.515, 0.035], [0.035, 0.56]]), filters.shape)
    )
    level = np.array([100.0, 90.0, 60.0])[filters]
    np.testing.assert_allclose(mean[0], exact + level, rtol=0, atol=0.004 * exact.max())
    upright = replace(pixels, blur=replace(pixels.blur, mixed_px2=np.zeros(1))).at(theta)[0]
    assert np.abs(upright[0] - exact - level).max() > 0.008 * exact.max()
    for k, h in enumerate((1e-5, 1e-5, 1.0, 1.0, 1.0, 1.0)):  # the mixed term's change with the width is left out
        step = np.zeros(7)
        step[k] = h
        difference = (pixels.at(theta + step)[0] - pixels.at(theta - step)[0])[0] / (2.0 * h)
        np.testing.assert_allclose(derivatives[0, k], difference, rtol=0, atol=1e-6 * np.abs(difference).max() + 1e-6)


def test_an_oblique_spot_is_not_biased() -> None:
    """Four phases, over 100 e-: within 3 mpx with the mixed moment, beyond 8 without."""
    moments = np.array([[0.515, 0.035], [0.035, 0.56]])
    blur, worst = SpotBlur.of(moments), {0.0: 0.0, 1.0: 0.0}
    for origin in ((0, 0), (1, 0), (0, 1), (1, 1)):
        filters = bayer_filters(np.array([origin]), (15, 15))
        x = 1e4 * np.array([1.0, 0.1, 0.03])[filters] * oblique(np.array([7.2, 6.9]), moments, (15, 15)) + 100.0
        for share in worst:
            shape = replace(blur, mixed_px2=share * blur.mixed_px2)
            fit = fit_law(spot_regions(x, origin), GaussLaw(PixelNoise(18.0)), shape)
            worst[share] = max(worst[share], float(np.abs(fit.uv_px[0] - origin - [7.2, 6.9]).max()))
    print(worst)
    assert worst[1.0] < 0.003
    assert worst[0.0] > 0.008
