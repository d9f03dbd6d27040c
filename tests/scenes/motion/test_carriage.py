"""Positions and velocities of the carriage against integrals; vibration and encoder against their statistics."""

import math

import numpy as np
import pytest
import scipy

from phibench.scenes.motion.carriage import Carriage, Encoder, Vibration
from phibench.scenes.validation import SceneError

CARRIAGES = (
    Carriage((0.0, 0.4), (0.2, 0.3), 0.2, 1.0),
    Carriage((0.1, 0.5, 0.5, -0.2), (0.0, 0.1, 0.2, 0.0), 0.5, 2.0),
    Carriage((0.0, 0.01), (0.1, 0.1), 1.0, 1.0),  # never at full speed
)


@pytest.mark.parametrize("carriage", CARRIAGES)
def test_position_is_the_integral_of_velocity_and_that_of_acceleration(carriage: Carriage) -> None:
    t = np.linspace(-0.1, carriage.duration_s + 0.1, 200_001)
    x, v, a = carriage.position_m(t), carriage.velocity_m_per_s(t), carriage.acceleration(t)
    # the trapezoidal rule errs by up to (jump of a) x step^2 / 2 where a jumps, 1e-10 x a few corners
    assert np.abs(x - x[0] - scipy.integrate.cumulative_trapezoid(v, t, initial=0.0)).max() < 1e-9
    # and by (jump of a) x step / 2 for v: 4 x 2e-5 at most, at each corner
    assert np.abs(v - scipy.integrate.cumulative_trapezoid(a, t, initial=0.0)).max() < 12 * 4.0 * (t[1] - t[0])
    assert np.abs(v).max() <= carriage.speed_m_per_s * (1 + 1e-12)
    assert np.abs(a).max() == carriage.acceleration_m_per_s2


@pytest.mark.parametrize("carriage", CARRIAGES)
def test_carriage_rests_at_its_stops(carriage: Carriage) -> None:
    ends = np.array([-1.0, carriage.duration_s, carriage.duration_s + 5.0])
    wanted = [carriage.stops_m[0], carriage.stops_m[-1], carriage.stops_m[-1]]
    np.testing.assert_allclose(carriage.position_m(ends), wanted, atol=1e-15)
    assert not carriage.velocity_m_per_s(ends[[0, 2]]).any()


def test_a_carriage_needs_a_pause_for_each_stop() -> None:
    with pytest.raises(SceneError, match="1 numbers for 2 stops"):
        Carriage((0.0, 0.4), (0.2,))


def test_vibration_has_its_rms_within_its_band_and_its_own_derivative() -> None:
    shake = Vibration.band("stroke", 20.0, 40.0, 1e-4, "test", 3)
    t = np.arange(0.0, 60.0, 1e-3)
    x = shake.displacement_m(t)
    # beats of neighbouring waves, 20 Hz / 16 / 2 apart or more for most, average out over 60 s to a few percent
    assert np.std(x) == pytest.approx(1e-4, rel=0.05)
    assert shake.rms_m == pytest.approx(1e-4, rel=1e-12)
    power = np.abs(np.fft.rfft(x * np.hanning(len(x)))) ** 2
    frequency = np.fft.rfftfreq(len(x), 1e-3)
    assert power[(frequency < 19.9) | (frequency > 40.1)].sum() < 1e-6 * power.sum()
    step = 1e-5
    slope = (shake.displacement_m(t + step) - shake.displacement_m(t - step)) / (2 * step)
    # relative error of the central difference: (omega step)^2 / 6 = 1e-6
    np.testing.assert_allclose(shake.velocity_m_per_s(t), slope, atol=2e-6 * np.abs(slope).max())
    again = Vibration.band("stroke", 20.0, 40.0, 1e-4, "test", 3)
    assert again == shake
    assert Vibration.band("stroke", 20.0, 40.0, 1e-4, "test", 4) != shake


def test_encoder_readings_scatter_as_it_says() -> None:
    encoder, true = Encoder(2e-4, 5e-4), np.linspace(0.0, 0.5, 4000)
    error = encoder.readings_m(true, "a", 1) - true
    # standard deviation of 4000 draws is known to 1 / sqrt(8000) = 1.1 %: 5 % fails by chance once in 1e5
    assert np.std(error) == pytest.approx(encoder.sigma_m, rel=0.05)
    assert encoder.sigma_m == pytest.approx(math.hypot(2e-4, 5e-4 / math.sqrt(12)))
    read = encoder.readings_m(true, "a", 1) / 5e-4
    np.testing.assert_allclose(read, np.rint(read), atol=1e-9)
    np.testing.assert_array_equal(encoder.readings_m(true[:10], "a", 1), encoder.readings_m(true, "a", 1)[:10])
