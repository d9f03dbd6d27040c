"""Patterns: they tile without a seam, have power in every octave, and stay within albedos."""

from __future__ import annotations

import inspect

import numpy as np
import pytest

from phibench.scenes.shapes import Bitmap
from phibench.scenes.worlds import graphics, patterns
from phibench.scenes.worlds.materials import MATERIALS, MaterialSet
from phibench.scenes.worlds.room_properties import drawn_properties

COLOURS = np.array([[0.45, 0.32, 0.2, 0.5], [0.25, 0.2, 0.15, 0.3], [0.6, 0.6, 0.55, 0.6]])
HELPERS = {"fractal", "mixed", "shaded", "lattice", "band", "joints", "motif"}
PATTERNS = {
    name: function
    for name, function in inspect.getmembers(patterns, inspect.isfunction)
    if function.__module__ == patterns.__name__ and name not in HELPERS
}
PICTURES = (
    *("poster", "photograph", "landscape", "portrait", "notice", "corridor", "carton"),
    *("spines", "whiteboard", "chart", "hazard", "screen", "outdoors"),
)


def drawn(name: str, shape: tuple[int, int] = (96, 96), seed: int = 0) -> np.ndarray:
    return PATTERNS[name](np.random.default_rng(seed), shape, COLOURS)


def seam(values: np.ndarray, axis: int) -> float:
    """Mean step across the tile's edge, relative to the largest mean step inside."""
    steps = np.abs(np.roll(values, -1, axis=axis) - values).mean(axis=1 - axis)
    return float(steps[-1] / (steps[:-1].max() + 1e-3))


def test_there_are_many_patterns():
    assert len(PATTERNS) >= 16


@pytest.mark.parametrize("name", PATTERNS)
def test_patterns_tile_without_a_seam(name):
    """The step across the tile's edge is none that does not occur inside as well: 1.5 for the spread of noise."""
    assert max(seam(drawn(name, seed=seed)[..., 1], axis) for seed in range(3) for axis in (0, 1)) < 1.5


def test_a_seam_is_found():
    assert seam(np.tile(np.linspace(0.2, 0.8, 96)[:, None], (1, 96)), 0) > 1.5


@pytest.mark.parametrize("name", PATTERNS)
def test_patterns_have_power_in_every_octave(name):
    """From the tile to three texels, each octave holds 1e-4 of the variance; a gradient or a stripe would not."""
    values = drawn(name)[..., 1]
    power = np.abs(np.fft.fft2(values - values.mean())) ** 2
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(96) * 96, np.fft.fftfreq(96) * 96))
    parts = [power[(frequency >= low) & (frequency < 2 * low)].sum() / power.sum() for low in (1, 2, 4, 8, 16)]
    assert min(parts) > 1e-4, np.round(parts, 5)


@pytest.mark.parametrize("name", PATTERNS)
def test_patterns_are_drawn_in_any_shape_and_repeat(name):
    values = drawn(name, (48, 64))
    assert values.shape == (48, 64, 4)
    assert np.isfinite(values).all()
    np.testing.assert_array_equal(values, drawn(name, (48, 64)))
    assert not np.array_equal(values, drawn(name, (48, 64), seed=1))


@pytest.mark.parametrize("name", PICTURES)
def test_pictures_are_finite_and_differ(name):
    one, other = (getattr(graphics, name)(np.random.default_rng(seed), (40, 52)) for seed in (0, 1))
    assert one.shape == (40, 52, 4)
    assert np.isfinite(one).all()
    assert one.min() >= 0.0
    assert not np.array_equal(one, other)


@pytest.mark.parametrize("slope", [0.5, 1.0, 1.5])
def test_noise_has_the_stated_slope(slope):
    """Fit of the amplitude spectrum over most of a decade: 0.15 is 4 sigma of the noise of 600 places."""
    power = np.zeros((128, 128))
    for seed in range(4):
        power += np.abs(np.fft.fft2(patterns.fractal(np.random.default_rng(seed), (128, 128), slope))) ** 2
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(128), np.fft.fftfreq(128)))
    use = (frequency > 0.02) & (frequency < 0.12)
    fitted = np.polyfit(np.log(frequency[use]), 0.5 * np.log(power[use]), 1)[0]
    assert fitted == pytest.approx(-slope, abs=0.15)


def test_materials_keep_their_ranges():
    """Means lie between the darkest colour of the lowest albedo and the brightest of the highest, a fifth beyond."""
    seen = 0
    for name, material in MATERIALS.items():
        texture = MaterialSet(drawn_properties("materials"), ("materials",)).surface(name).texture
        if isinstance(texture, Bitmap):
            mean, (low, high) = float(texture.values[..., 1].mean()), material.albedo
            darkest, brightest = min(material.second[0], material.third[0], 1.0), max(material.third[1], 1.0)
            assert 0.8 * low * darkest <= mean <= 1.2 * high * brightest, name
            assert 0.0 < texture.values.min() <= texture.values.max() <= 0.921
            seen += 1
    assert seen > 40


def test_materials_are_shared_and_independent():
    one, other = (MaterialSet(drawn_properties("shared"), ("shared",)) for _ in "ab")
    assert one.surface("steel").texture is one.surface("steel").texture
    other.surface("paper")  # what was asked for before changes nothing
    assert one.surface("steel") == other.surface("steel")
    assert one.surface("steel", 1) != one.surface("steel")
    upright, flat = (one.surface("light_wood", upright=turned).texture for turned in (True, False))
    np.testing.assert_array_equal(upright.values, np.swapaxes(flat.values, 0, 1))
