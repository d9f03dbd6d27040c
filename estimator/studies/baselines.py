"""The two baselines, the rig lifted or moved sideways: pairs of views with what an estimator knows."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from phibench.datasets.expected import expected_of_light
from phibench.datasets.read import Dataset, Sample
from phibench.datasets.sensor_card import card_of
from phibench.estimator.fit_raw import fit_law
from phibench.estimator.limits import spot_limit
from phibench.estimator.mirror_image import image_of
from phibench.estimator.pixel_law import GaussLaw
from phibench.estimator.raw_pixels import noise_of, raw_electrons
from phibench.estimator.spot_blur import spot_blur
from phibench.estimator.status import Status
from phibench.estimator.studies.misaligned import spot_of
from phibench.estimator.triangulate import depth_exact
from phibench.render.chain import Chain
from phibench.render.light import Light
from phibench.render.region import Region
from phibench.render.sensor import Sensor
from phibench.render.spot import spot_layer
from phibench.render.tiles import NoiseStream
from phibench.scenes.frames import Array, as_vector
from phibench.scenes.laser import Beam
from phibench.scenes.rig import POSITIONS, Rig, View

_SIDE_PX = 11  # a board of 0.3 m at 2.5 m is 16 px high in the image: a larger square has its edges in the corners


@dataclass(frozen=True)
class Pair:
    """A spot seen from both ends of a baseline.

    Parameters
    ----------
    name : str
    rig : Rig
        What the estimator knows; its stroke axis is the direction of the baseline.
    baseline_m : float
    point_m : shape (3,)
    lights : of the first and the second image
    uv_px : shape (2, 2), true pixels
    """

    name: str
    rig: Rig
    baseline_m: float
    point_m: Array
    lights: tuple[Light, Light] = field(repr=False)
    uv_px: Array

    @property
    def depth_m(self) -> float:
        """D, from the vertical through the sphere at the first position."""
        return float(np.hypot(*(self.point_m - self.rig.at(0.0).sphere_centre_m)[:2]))

    @property
    def azimuth_deg(self) -> float:
        """Azimuth of the spot seen from there, 0 to 360."""
        x, y = (self.point_m - self.rig.at(0.0).sphere_centre_m)[:2]
        return math.degrees(math.atan2(y, x)) % 360.0


def sideways(rig: Rig) -> Rig:
    """The rig with its baseline along world x."""
    return replace(rig, stroke_axis_world=(1.0, 0.0, 0.0))


def pairs_of(dataset: Dataset) -> Iterator[Pair]:
    """Visible pairs of a data set; the baseline is what its true rig moves by, known to the estimator."""
    for sample in dataset:
        if sample.row.down.visible and sample.row.up.visible:
            yield _pair(sample)


def _pair(sample: Sample) -> Pair:
    centres = [sample.view(position).camera_centre_m for position in POSITIONS]
    along = centres[1] - centres[0]
    length = float(np.linalg.norm(along))
    rig = replace(sample.nominal_rig, stroke_axis_world=as_vector(along / length))
    lights = tuple(
        Light(sample.ambient(position), sample.spot(position), f_number=rig.camera.f_number) for position in POSITIONS
    )
    places = [(sample.truth_row(position).u_px, sample.truth_row(position).v_px) for position in POSITIONS]
    return Pair(
        sample.row.sample_id, rig, length, np.array(sample.row.spot_world_m), (lights[0], lights[1]), np.array(places)
    )


def flat_pair(rig: Rig, baseline_m: float, point_m: Array, background_electrons_per_s: Array) -> Pair | None:
    """Pair rendered without a room, on an even background; None where an image does not show the spot."""
    views = (rig.at(0.0), rig.at(baseline_m))
    uv = np.array([image_of(view, point_m).uv_px for view in views])
    if not np.all(rig.camera.contains(uv)):
        return None
    lights = [_flat(view, point_m, background_electrons_per_s) for view in views]
    return Pair("flat", rig, baseline_m, point_m, (lights[0], lights[1]), uv)


def _flat(view: View, point_m: Array, background: Array) -> Light:
    camera = view.rig.camera
    levels = (float(background[0]), float(background[1]), float(background[2]))
    light = Light.flat(levels, (camera.height_px, camera.width_px))
    return replace(light, spot=spot_layer(view, spot_of(point_m), ()), f_number=camera.f_number)


def bound_m(pair: Pair, sensor: Sensor) -> float:
    """Least standard deviation of D from the noise of both frames; nothing else is unknown of the rig."""
    C = [
        spot_limit(expected_of_light(light, sensor, pair.rig.camera), card_of(sensor)).covariance_px2
        for light in pair.lights
    ]
    return float(depth_exact(pair.rig, pair.baseline_m, *pair.uv_px, *C).sigma_m)


def errors_m(pair: Pair, sensor: Sensor, draws: int, *names: str) -> Array:
    """Estimate minus D, shape (draws,), by likelihood fits to raw frames; NaN where a fit fails.

    Every draw is of another camera, as the bound counts the fixed pattern as noise.
    """
    uv = np.stack([_fitted(pair, i, sensor, draws, names) for i in range(2)])
    return np.asarray(depth_exact(pair.rig, pair.baseline_m, uv[0], uv[1]).depth_m - pair.depth_m)


def _fitted(pair: Pair, i: int, sensor: Sensor, draws: int, names: tuple[str, ...]) -> Array:
    """Pixels (draws, 2) found in one image."""
    light, card, (u, v) = pair.lights[i], card_of(sensor), pair.uv_px[i]
    region = Region.around(u, v, light.size, _SIDE_PX)
    dn = np.stack(
        [
            Chain(sensor, k, pair.rig.camera).frame(light, NoiseStream((*names, pair.name, i, k)), region)
            for k in range(draws)
        ]
    )
    x, blur = raw_electrons(dn, card), spot_blur(pair.rig, (u, v), pair.depth_m, Beam())
    r, g, b = pair.rig.camera.detector.laser_filter_response
    fit = fit_law(
        x,
        (region.u0_px, region.v0_px),
        GaussLaw(noise_of(card)),
        blur.sigma_px,
        (r, g, b),
        used=x < card.full_from_e,
        ratio=blur.ratio,
        mixed_px2=blur.mixed_px2,
    )
    return np.where((fit.status == Status.OK)[:, None], fit.uv_px, np.nan)
