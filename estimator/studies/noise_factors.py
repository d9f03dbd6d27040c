"""What the study `noise` changes, one at a time: a number of the sensor, of the laser, or of the lens."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from phibench.estimator.studies.cut import Shot
from phibench.render.sensor import sensor
from phibench.scenes.rig import Rig

OFF = 0.0
BASE = "base"
"""Name of the factor of a cell in which nothing is changed."""
Change = Callable[[str, Rig, float], tuple[Shot, Rig]]


@dataclass(frozen=True)
class Factor:
    """One factor.

    Parameters
    ----------
    label : with its unit, for an axis
    change : from preset, rig and level to how pairs are taken and by which rig
    base : level of the base case
    presets : those that it acts on
    ranked : whether an elasticity about the base says something; not where the base is an optimum
    """

    label: str
    change: Change
    base: float
    presets: tuple[str, ...] = ("bayer-raw", "srgb8", "mjpeg")
    ranked: bool = True


def _sensor(key: str, whole: bool = False) -> Change:
    return lambda preset, rig, x: (Shot(sensor(preset, **{key: round(x) if whole else x})), rig)


def _power(preset: str, rig: Rig, power_mw: float) -> tuple[Shot, Rig]:
    return Shot(sensor(preset), laser_level=power_mw), rig  # layers are rendered for 1 mW


def _bits(preset: str, rig: Rig, bits: float) -> tuple[Shot, Rig]:
    """Another converter over the same range: gain and black level follow the codes."""
    plain = sensor(preset)
    scale = 2.0 ** (round(bits) - plain.adc_bits)
    changes = {"gain_dn_per_e": plain.gain_dn_per_e * scale, "black_level_dn": plain.black_level_dn * scale}
    return Shot(sensor(preset, adc_bits=round(bits), **changes)), rig


def _speckle(preset: str, rig: Rig, contrast: float) -> tuple[Shot, Rig]:
    return Shot(sensor(preset) if contrast == OFF else sensor(preset, speckle_m=contrast**-2)), rig


def _blur(preset: str, rig: Rig, sigma_px: float) -> tuple[Shot, Rig]:
    return Shot(sensor(preset)), replace(rig, camera=replace(rig.camera, blur_sigma_px=sigma_px))


def _focus(preset: str, rig: Rig, distance_m: float) -> tuple[Shot, Rig]:
    return Shot(sensor(preset)), replace(rig, camera=replace(rig.camera, focus_distance_m=distance_m))


FACTORS: dict[str, Factor] = {
    "exposure_s": Factor("exposure, s", _sensor("exposure_s"), 1.0 / 60.0),
    "power_mw": Factor("laser power, mW", _power, 1.0),
    "read_noise_e": Factor("read noise, e-", _sensor("read_noise_e"), 4.0),
    "blur_sigma_px": Factor("optical blur sigma, px", _blur, 0.7),
    "focus_distance_m": Factor("focus distance, m", _focus, 0.23, ranked=False),
    "jpeg_quality": Factor("JPEG quality", _sensor("jpeg_quality", True), 85.0, ("mjpeg",)),
    "adc_bits": Factor("converter, bits", _bits, 10.0),
    "speckle_contrast": Factor("speckle contrast of the flux", _speckle, OFF),
}
"""By name; the keys are those of the settings, whose levels include the base."""


def applied(factor: str, preset: str, rig: Rig, level: float) -> tuple[Shot, Rig]:
    """Shot and rig of a cell; the factor `BASE` changes nothing.

    Raises
    ------
    SensorError
        If the level is not allowed.
    """
    if factor == BASE:
        return Shot(sensor(preset)), rig
    return FACTORS[factor].change(preset, rig, level)
