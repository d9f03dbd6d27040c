"""Rendering noise as an error of phi: against Monte Carlo of the weighted estimate, and its limits."""

from __future__ import annotations

import dataclasses
import tomllib

import numpy as np
import pytest
from scipy import ndimage

from phibench.render.optics.spot_layer import spot_layer
from phibench.render.optics.truth import spot_truth
from phibench.render.room import noise_budget
from phibench.render.sensor.settings import PRESETS_FILE
from phibench.scenes.laser import LaserSpot, beam_diameter_m
from phibench.scenes.room import default_rig

VIEW = default_rig().at(0.2)
SPOT = LaserSpot((2.0, 0.7, 0.5), (-2.0, -0.7, 0.0), beam_diameter_m(2.1))
TRUTH = spot_truth(VIEW, SPOT, ())
UV = np.array([TRUTH.u_px, TRUTH.v_px])
LAYER = spot_layer(VIEW, SPOT, ())
SIZE = (3, 720, 1280)
ROOM = np.full(SIZE, 4e4)


def test_gradient_of_phi_is_that_of_the_closed_form() -> None:
    """Moving the spot by a little moves pixel and phi_ray together, to 1e-4 (second order of the move)."""
    moved = spot_truth(VIEW, LaserSpot((2.0, 0.7, 0.501), (-2.0, -0.7, 0.0), 5e-3), ())
    step = np.array([moved.u_px, moved.v_px]) - UV
    change = moved.phi_ray_rad - TRUTH.phi_ray_rad
    assert noise_budget.phi_gradient(VIEW, UV) @ step == pytest.approx(change, rel=1e-3)
    assert np.linalg.norm(noise_budget.phi_gradient(VIEW, UV)) == pytest.approx(
        7.6e-3 / 2.0, rel=0.1
    )  # 7.6 mrad of theta


def _blurred_noise(rng: np.random.Generator, draws: int, h: int, w: int) -> np.ndarray:
    """Unit noise of pixels that share samples: white noise on a grid of 1/4 px, blurred as the camera blurs."""
    fine, pad, frames = 4, 5, []
    for _ in range(draws):
        white = rng.normal(size=((h + 2 * pad) * fine, (w + 2 * pad) * fine))
        blurred = ndimage.uniform_filter(ndimage.gaussian_filter(white, 0.7 * fine, mode="wrap"), fine, mode="wrap")
        frames.append(blurred[pad * fine :: fine, pad * fine :: fine][:h, :w].ravel())
    noise = np.array(frames)
    return np.asarray(noise / noise.std())


@pytest.mark.slow
@pytest.mark.parametrize("source", ["sensor", "render"])
def test_predicted_errors_against_monte_carlo(source: str) -> None:
    """4000 draws of one Newton step from the truth: the standard deviation's own error is 1.1 %; 6 sigma, 7 %."""
    variance = np.full(SIZE, (0.1 * 4e4) ** 2)
    budget = noise_budget.noise_budget(VIEW, UV, LAYER, ROOM, variance)
    rng, draws = np.random.default_rng(3), 4000
    h, w = LAYER.electrons_per_s.shape[1:]
    image = (slice(LAYER.v0_px, LAYER.v0_px + h), slice(LAYER.u0_px, LAYER.u0_px + w))
    mosaic = noise_budget._bayer(image)

    def raw(stack: np.ndarray) -> np.ndarray:
        return np.where(mosaic, stack, 0.0).sum(axis=0).ravel() * noise_budget.webcam().exposure_s

    mean = raw(LAYER.electrons_per_s + ROOM[:, *image])
    slopes = np.stack([raw(LAYER.du_electrons_per_s_px), raw(LAYER.dv_electrons_per_s_px)])
    weight = 1.0 / (mean + noise_budget.webcam().read_noise_e ** 2)
    if source == "sensor":
        noise = (
            rng.poisson(mean, (draws, mean.size))
            - mean
            + rng.normal(0, noise_budget.webcam().read_noise_e, (draws, mean.size))
        )
    else:
        noise = 0.1 * 4e4 * noise_budget.webcam().exposure_s * _blurred_noise(rng, draws, h, w)
    steps = np.linalg.solve((slopes * weight) @ slopes.T, (slopes * weight) @ noise.T)
    measured = np.std(noise_budget.phi_gradient(VIEW, UV) @ steps)
    predicted = budget.phi_sensor_rad if source == "sensor" else budget.phi_render_rad
    assert measured == pytest.approx(predicted, rel=0.07)
    assert measured != pytest.approx(1.2 * predicted, rel=0.07)  # the test can tell 20 %


def test_quiet_layers_keep_the_budget_and_noisy_ones_do_not() -> None:
    quiet = noise_budget.noise_budget(VIEW, UV, LAYER, ROOM, np.full(SIZE, (0.001 * 4e4) ** 2))
    noisy = noise_budget.noise_budget(VIEW, UV, LAYER, ROOM, np.full(SIZE, (0.2 * 4e4) ** 2))
    assert quiet.kept()
    assert not noisy.kept()
    between = dataclasses.replace(noisy, phi_render_rad=0.4 * noisy.phi_sensor_rad)
    assert {name: between.kept(part) for name, part in noise_budget.BUDGETS.items()} == {
        "reference": False,
        "training": True,
    }
    assert noisy.phi_render_rad == pytest.approx(200.0 * quiet.phi_render_rad)
    assert quiet.phi_sensor_rad == noisy.phi_sensor_rad


def test_a_spot_off_the_image_has_no_budget_to_keep() -> None:
    dark = spot_layer(VIEW, LaserSpot((0.0, 0.0, 2.9), (0, 0, -1), 5e-3), ())
    budget = noise_budget.noise_budget(VIEW, UV, dark, ROOM, ROOM)
    assert np.isnan(budget.phi_render_rad)
    assert budget.kept()


def test_the_measure_is_the_presets_own() -> None:
    """One source of truth: what the file says is what the budget uses."""
    table = tomllib.loads(PRESETS_FILE.read_text())["webcam"]
    measure = noise_budget.webcam()
    for name in ("exposure_s", "read_noise_e", "full_well_e"):
        assert getattr(measure, name) == table[name]
    assert measure is noise_budget.webcam()
    share = noise_budget.allowed_per_s2(np.zeros((3, 1, 1), np.float32), 0.0) / (noise_budget.BUDGET * 4.0 * 60.0) ** 2
    np.testing.assert_allclose(share, 1.0, rtol=1e-6)  # a dark pixel's budget is the read noise's
