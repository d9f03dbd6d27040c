"""Rendered spots in a mirror of any shape over a flat room, drawn by the simulator's chain and fitted.

Unlike the scenes of `chain_scenes` the spots are no Gaussians: they are spot layers, with what lens, mirror and beam do
to them. A fit takes the blur that `spot_blur` predicts from the rig, as the methods do.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from helpers.sensor_light import FILTERS

from phibench.datasets.exposures.expected_electrons import expected_of_light
from phibench.datasets.frames.sensor_card import card_of
from phibench.datasets.recipe.recipe_scene import build_rig
from phibench.datasets.recipe.tables import RigTable
from phibench.estimator.geometry.status import Status
from phibench.estimator.limits.position_bound import spot_limit
from phibench.estimator.limits.processed_bound import chain_limit
from phibench.estimator.processed.fit_processed_images import fit_jpeg, fit_srgb
from phibench.estimator.spots.fit_raw import SpotFit, fit_raw
from phibench.estimator.spots.gaussian_spot import LASER_RESPONSE, SpotBlur, SpotModel
from phibench.estimator.spots.raw_pixels import noise_of, raw_electrons
from phibench.estimator.spots.spot_prediction import spot_blur
from phibench.render.optics.spot_layer import SpotLayer, spot_layer
from phibench.render.optics.truth import spot_truth
from phibench.render.sensor.camera_chain import Chain
from phibench.render.sensor.electrons import NoiseStream
from phibench.render.sensor.light import Light, Region
from phibench.render.sensor.settings import Sensor
from phibench.scenes.frames import Array
from phibench.scenes.laser import Beam, LaserSpot
from phibench.scenes.random_streams import generator
from phibench.scenes.rig import Rig

MIRRORS: dict[str, dict[str, object] | None] = {
    "sphere": None,
    "ellipsoid": {},
    "paraboloid": {},
    "hyperboloid": {},
    "cone": {},
    "polynomial": {"vertex_radius_m": 0.08, "conic": -0.7, "rim_radius_m": 0.055, "even_terms": (20.0, 300.0)},
}
BEAM = Beam()
ROOM = np.array([1.0, 0.9, 0.6])
COLLECTED = float(FILTERS @ (0.25, 0.5, 0.25))  # of the mosaic, per electron of an unfiltered red pixel
_SIZE = (96, 96)
_UNITS = Region(16, 24, 80, 72)  # whole units of 4:2:2 around the middle
_TOP_M = 0.67  # the tip of a cone, down; what it sees is level with it or above


def rig_of(shape: str) -> Rig:
    """Rig as a recipe with nothing but the shape has it; the polynomial has no default."""
    keys = MIRRORS[shape]
    return build_rig(RigTable() if keys is None else RigTable.model_validate({"mirror": {"shape": shape, **keys}}))


@dataclass(frozen=True)
class Draws:
    """Errors, bounds of their variances and pulls of (u, v), shape (n, 2), and how many fits came to nothing."""

    error_px: Array
    bound_px2: Array
    pull: Array
    failed: int

    @property
    def over_bound(self) -> float:
        return float(np.sqrt(np.mean(self.error_px**2 / self.bound_px2)))


@dataclass(frozen=True)
class Place:
    """One spot in the down image: its layer in a small image, its chief ray's place there, and the predicted blur."""

    layer: SpotLayer
    uv_px: Array
    blur: SpotBlur


@cache
def places(shape: str, count: int) -> tuple[Place, ...]:
    """Spots 1 to 4 m away on all azimuths, up to 0.9 m high; of a cone 2 to 12 degrees above its tip."""
    rig, rng, found = rig_of(shape), generator("tests", "mirror fits", shape), []
    view = rig.at(0.0)
    for _ in range(50 * count):
        D, turn, share = rng.uniform(1.0, 4.0), rng.uniform(0.0, 2.0 * np.pi), rng.random()
        z = _TOP_M + D * np.tan(np.radians(2.0 + 10.0 * share)) if shape == "cone" else 0.3 + 0.6 * share
        across = np.array([np.cos(turn), np.sin(turn)])
        spot = LaserSpot((*(D * across), z), (*-across, 0.0), BEAM.diameter_m(D))
        truth = spot_truth(view, spot, ())
        if not truth.visible:
            continue
        uv, layer = np.array([truth.u_px, truth.v_px]), spot_layer(view, spot, ())
        corner = np.floor(uv).astype(int) // [16, 8] * [16, 8] - [32, 40]  # the grid of units, and red stays red
        moved = SpotLayer(
            *(np.array([layer.u0_px, layer.v0_px]) - corner).tolist(),
            layer.electrons_per_s / layer.total_electrons_per_s[0],
            layer.du_electrons_per_s_px / layer.total_electrons_per_s[0],
            layer.dv_electrons_per_s_px / layer.total_electrons_per_s[0],
            layer.centroid_uv_px - corner,
            layer.total_electrons_per_s / layer.total_electrons_per_s[0],
            layer.place_m,
        )
        found.append(Place(moved, uv - corner, spot_blur(rig, uv, D, BEAM)))
        if len(found) == count:
            return tuple(found)
    raise AssertionError(f"{shape}: {len(found)} visible spots of {count}")


def drawn(s: Sensor, spots: tuple[Place, ...], collected_e: float, background_e: float, cameras: int) -> Draws:
    """Fits of some spots by `cameras` cameras each, every one with its own fixed pattern."""
    card, dark, flux_e = card_of(s), s.dark_e_per_s * s.exposure_s, collected_e / COLLECTED
    errors, bounds, pulls, failed = [], [], [], 0
    for k, place in enumerate(spots):
        light = Light(
            ROOM[:, None, None] * np.full((3, *_SIZE), background_e / s.exposure_s),
            place.layer,
            laser_level=flux_e / s.exposure_s,
        )
        box = _UNITS if s.output == "mjpeg" else _box(place.uv_px, 17 if s.output == "srgb8" else 15)
        frames = np.stack(
            [Chain(s, cameras * k + j).frame(light, NoiseStream(("mirror", k, j)), box) for j in range(cameras)]
        )
        fit = _fit(s, frames, box, place.blur)
        if s.output == "raw":
            covariance = spot_limit(expected_of_light(light, s), card).covariance_px2
        else:
            covariance = chain_limit(card, place.uv_px, place.blur, flux_e, background_e * ROOM + dark).covariance_px2
        good = fit.status == Status.OK
        failed += int((~good).sum())
        errors.append(fit.uv_px[good] - place.uv_px)
        bounds.append(np.tile(np.diag(covariance), (int(good.sum()), 1)))
        pulls.append(errors[-1] / np.sqrt(np.diagonal(fit.covariance_px2[good], axis1=1, axis2=2)))
    return Draws(*(np.concatenate(x) for x in (errors, bounds, pulls)), failed)


def _box(uv: Array, side: int) -> Region:
    u0, v0 = (round(float(x)) - side // 2 for x in uv)
    return Region(u0, v0, u0 + side, v0 + side)


def _fit(s: Sensor, frames: Array, box: Region, blur: SpotBlur) -> SpotFit:
    card, corner = card_of(s), (box.u0_px, box.v0_px)
    if s.output == "mjpeg":
        return fit_jpeg(frames, corner, card, blur)
    if s.output == "srgb8":
        return fit_srgb(frames, corner, card, blur)
    electrons = raw_electrons(frames, card)
    return fit_raw(electrons, corner, noise_of(card), blur, SpotModel(LASER_RESPONSE), saturation_e=card.saturation_e)
