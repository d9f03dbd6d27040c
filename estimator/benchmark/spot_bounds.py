"""What the light around a spot says of it: electrons, signal, saturation, and the bounds of its position."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from phibench.datasets.exposures.expected import ExpectedRegion, expected_of_light
from phibench.datasets.frames.sensor_card import SensorCard, card_of
from phibench.datasets.frames.source import Side
from phibench.estimator.limits.position_bound import SpotLimit, spot_limit
from phibench.estimator.limits.processed_bound import chain_limit
from phibench.estimator.spots.fit_raw import covariance_bound
from phibench.estimator.spots.image_planes import PROCESSED
from phibench.estimator.spots.spot_prediction import SpotBlur, spot_blur
from phibench.scenes.frames import Array
from phibench.scenes.laser import Beam
from phibench.scenes.rig import Rig

_OF_THE_SPOT = 0.01  # of its brightest pixel: dimmer pixels are not the spot's
_POSITION = 2  # unknowns of a position, the first ones of a Fisher matrix


@dataclass(frozen=True)
class SpotBounds:
    """One spot in one image; the attributes are those of `bench.truth.SpotTruth`."""

    electrons: float
    peak_e: float
    snr: float
    saturated: bool
    bound_px2: Array | None
    raw_bound_px2: Array | None


def spot_bounds(
    side: Side,
    rig: Rig,
    uv_px: tuple[float, float],
    rates_per_s: tuple[float, ...],
    visible: bool,
    pattern_known: bool = False,
    depth_m: float | None = None,
    beam: Beam | None = None,
) -> SpotBounds:
    """Bounds of a spot in the image of a sensor and in the raw pixels behind it.

    Parameters
    ----------
    side : Side
        Light and sensor; its region is not used.
    rig : Rig
    uv_px : (u, v), true
    rates_per_s : 3 floats
        Electrons per second of the whole spot behind R, G, B at laser level 1.
    visible : bool
        Whether the spot is seen; there are no bounds of one that is not.
    pattern_known : bool
        Whether the camera's PRNU and DSNU are calibrated; otherwise the bounds count them as noise.
    depth_m, beam
        As for `spot_blur`: the spot's own size. Raw pixels' bound does not need it, it takes the light as it is.
    """
    sensor = side.chain.sensor
    raw = sensor.replace(output="raw")
    card = card_of(raw)
    region = expected_of_light(side.light, raw, rig.camera) if visible else None
    raw_limit = None if region is None else spot_limit(region, card, pattern_known=pattern_known)
    limit, electrons, unit = raw_limit, spot_electrons(rates_per_s, side), 1.0
    if region is not None and sensor.output in PROCESSED:
        blur = spot_blur(rig, uv_px, depth_m, beam)
        limit, unit = _processed_limit(region, card_of(sensor), rig, uv_px, blur, electrons, pattern_known), electrons
    peak_e = 0.0 if region is None else _peak_e(region)
    return SpotBounds(
        electrons=electrons,
        peak_e=peak_e,
        snr=0.0 if limit is None else _snr(limit, unit),
        saturated=peak_e > card.saturation_e,
        bound_px2=_bound(limit),
        raw_bound_px2=_bound(raw_limit),
    )


def spot_electrons(rates_per_s: tuple[float, ...] | Array, side: Side) -> float:
    """Electrons of a whole spot: behind the red filter, or all of them where there are no filters."""
    sensor = side.chain.sensor
    weights = sensor.mono_weights if sensor.mosaic == "mono" else (1.0, 0.0, 0.0)
    return float(np.dot(rates_per_s, weights)) * sensor.exposure_s * side.light.laser_level


def _processed_limit(
    region: ExpectedRegion,
    card: SensorCard,
    rig: Rig,
    uv_px: tuple[float, float],
    blur: SpotBlur,
    electrons: float,
    pattern_known: bool,
) -> SpotLimit:
    """Limit of the 8-bit or JPEG image: the room as one level per filter, its mean under the spot; a Gaussian spot."""
    weight = region.spot_e + 1e-3 * region.spot_e.max()  # of a filter that sees nothing of the spot: the mean of all
    levels = [
        float(np.average(region.background_e[region.filters == c], weights=weight[region.filters == c]))
        for c in range(3)
    ]
    r, g, b = rig.camera.detector.laser_filter_response
    return chain_limit(card, uv_px, blur.sigma_px, electrons, levels, (r, g, b), blur.ratio, pattern_known)


def _bound(limit: SpotLimit | None) -> Array | None:
    return None if limit is None or not np.isfinite(limit.covariance_px2).all() else limit.covariance_px2


def _peak_e(region: ExpectedRegion) -> float:
    """Largest expected electrons of a pixel that belongs to the spot, room included."""
    return float(region.mean_e[region.spot_e >= _OF_THE_SPOT * region.spot_e.max()].max())


def _snr(limit: SpotLimit, flux: float) -> float:
    """Flux, in the unit of the limit, over its deviation at the limit: position known, background unknown."""
    variance = covariance_bound(limit.fisher[_POSITION:, _POSITION:], keep=1)[0, 0]
    return float(flux / np.sqrt(variance)) if variance > 0.0 else 0.0
