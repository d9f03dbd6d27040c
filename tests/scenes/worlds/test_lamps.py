"""Colour temperatures against Planck's law, luminous efficacies against CIE V, and properties of rooms."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy

from phibench.scenes.validation import SceneError
from phibench.scenes.worlds.lamps import BANDS_NM, EFFICACY_LM_W, band_radiance, black_body_bands
from phibench.scenes.worlds.room_properties import PROPERTIES, drawn_properties

# CIE 1924 V(lambda), 410 to 680 nm in steps of 10 nm.
V = (
    *(0.00121, 0.004, 0.0116, 0.023, 0.038, 0.06, 0.09098, 0.13902, 0.20802, 0.323, 0.503, 0.71, 0.862, 0.954),
    *(0.99495, 0.995, 0.952, 0.87, 0.757, 0.631, 0.503, 0.381, 0.265, 0.175, 0.107, 0.061, 0.032, 0.017),
)


def planck(wavelength_nm: float, temperature_k: float) -> float:
    h, c, k, x = 6.62607015e-34, 299792458.0, 1.380649e-23, wavelength_nm * 1e-9
    return 2.0 * h * c**2 / x**5 / math.expm1(h * c / (x * k * temperature_k))


@pytest.mark.parametrize("temperature_k", [2000.0, 2856.0, 4000.0, 6504.0, 20000.0])
def test_bands_follow_planck(temperature_k):
    """Adaptive quadrature in SI against 12 nodes; the constants are rounded to 1e-7."""
    bands = np.array([scipy.integrate.quad(planck, *band, args=(temperature_k,))[0] for band in BANDS_NM])
    np.testing.assert_allclose(black_body_bands(temperature_k), bands / bands.max(), rtol=1e-6)


def test_warm_light_is_redder():
    ratio = [band[0] / band[2] for band in map(black_body_bands, (2000.0, 3000.0, 4500.0, 8000.0))]
    assert ratio == sorted(ratio, reverse=True)
    assert ratio[0] > 5.0 > 1.0 > ratio[-1]


def test_efficacies_are_the_means_of_v():
    """Trapezes of 10 nm; the constants have one decimal."""
    wavelength = np.arange(410.0, 681.0, 10.0)
    for (low, high), efficacy in zip(BANDS_NM, EFFICACY_LM_W, strict=True):
        use = (wavelength >= low) & (wavelength <= high)
        mean = 683.0 * np.trapezoid(np.array(V)[use], wavelength[use]) / (high - low)
        assert efficacy == pytest.approx(mean, abs=0.06)


def test_radiance_has_the_stated_luminance():
    assert band_radiance(250.0, 3000.0) @ np.array(EFFICACY_LM_W) == pytest.approx(250.0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"length_m": 20.0}, "length_m = 20.0: allowed range is 4.0 to 16.0"),
        ({"height_m": 2.0}, "height_m"),
        ({"height_m": math.nan}, "finite"),
        ({"doors": 1.5}, "doors = 1.5: give a whole number, 0 to 3"),
        ({"lamp_kind": "panel"}, "did you mean 'panels'"),
        ({"gloss": "high"}, "gloss = 'high': give a number from 0 to 1"),
        ({"lampkind": "panels"}, "did you mean 'lamp_kind'"),
        ({"lamps": True}, "lamps = True"),
    ],
)
def test_bad_properties_are_one_sentence(change, words):
    with pytest.raises(SceneError) as caught:
        drawn_properties("bad", **change)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_default_distributions_stay_in_range():
    for name, entry in PROPERTIES.items():
        ((kind, values),) = entry.default.items()
        assert kind in ("uniform", "log_uniform", "choice")
        assert [entry.checked(value) for value in values] == list(values), name
        assert entry.meaning


def test_a_fixed_property_changes_no_other():
    free, fixed = drawn_properties("own", 1), drawn_properties("own", 1, windows=3)
    assert {name for name in PROPERTIES if getattr(free, name) != getattr(fixed, name)} <= {"windows"}
    assert drawn_properties("own", 2) != free
