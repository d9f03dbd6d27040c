"""Laser spots at known places, for calibration: pixels in both images, and places measured by a simulated `Ruler`.

Pixels are found by a built-in method; distance, height and azimuth are as if a person had measured them.
A "measured" place is the truth plus an error drawn from the sample's own stream. The stated sigma is the real one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from phibench.calibration.rig.bundle import KnownSpot
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.read import Sample
from phibench.estimator.interface import Answer, Pair, Spot
from phibench.scenes.frames import Array
from phibench.scenes.random_streams import generator
from phibench.scenes.rig import POSITIONS

MAX_SIGMA = 1e3
"""Largest sigma of a measured place, metres or radians: beyond it nothing was measured."""


@dataclass(frozen=True)
class Ruler:
    """Precision with which the place of a calibration spot is measured, one standard deviation each.

    Parameters
    ----------
    distance_m : float
        Of D.
    height_m, azimuth_rad : float
        Of the height above the floor, and of the azimuth about the sphere centre; infinite where not measured.

    Raises
    ------
    DatasetError
        If a sigma is not above 0, or finite and above `MAX_SIGMA`.
    """

    distance_m: float = 1e-3
    height_m: float = math.inf
    azimuth_rad: float = math.inf

    def __post_init__(self) -> None:
        for name, unit in (("distance_m", "m"), ("height_m", "m"), ("azimuth_rad", "rad")):
            sigma, free = getattr(self, name), name != "distance_m"
            if not (0.0 < sigma <= MAX_SIGMA or (free and sigma == math.inf)):
                what = name.rsplit("_", 1)[0]
                raise DatasetError(
                    f"sigma of a calibration spot's {what} = {sigma:g} {unit}: must be above 0, at most {MAX_SIGMA:g}"
                )


def require_positions(answer: Answer, sample_id: str) -> None:
    """Refuse a pair in which a spot was not found, or has no covariance.

    Raises
    ------
    DatasetError
        Naming the sample, the image, and what the method said.
    """
    for position in POSITIONS:
        spot: Spot = getattr(answer, position)
        if spot.uv_px is None or spot.covariance_px2 is None:
            why = "no covariance of its place" if spot.uv_px is not None else spot.status
            raise DatasetError(
                f"{sample_id} {position}: no spot to calibrate with: {why}; leave this sample out, or take frames "
                "with more light of the laser"
            )


def known_spot(sample: Sample, pair: Pair, answer: Answer, ruler: Ruler) -> KnownSpot:
    """Calibration spot of a pair whose spots were found.

    Raises
    ------
    DatasetError
        If one was not.
    """
    require_positions(answer, sample.row.sample_id)
    places = {p: np.array(getattr(answer, p).uv_px) for p in POSITIONS}
    covariances = {p: np.array(getattr(answer, p).covariance_px2) for p in POSITIONS}
    return measured_spot(sample, places, covariances, pair.stroke_m, ruler)


def measured_spot(
    sample: Sample, uv_px: dict[str, Array], covariance_px2: dict[str, Array], stroke_m: float, ruler: Ruler
) -> KnownSpot:
    """Calibration spot with its place as a ruler of that precision would give it; arguments by position."""
    spot = np.array(sample.row.spot_world_m)
    flat = spot[:2] - np.array(sample.row.down.sphere_centre_world_m)[:2]
    # the azimuth is about the true sphere centre when down, as a person at the rig would measure it
    truth = {"distance": sample.row.depth_m, "height": spot[2], "azimuth": math.atan2(flat[1], flat[0])}
    sigma = {"distance": ruler.distance_m, "height": ruler.height_m, "azimuth": ruler.azimuth_rad}
    read = {name: _read(sample, name, value, sigma[name]) for name, value in truth.items()}
    return KnownSpot(
        uv_px["down"],
        uv_px["up"],
        covariance_px2["down"],
        covariance_px2["up"],
        stroke_m,
        depth_m=read["distance"],
        depth_sigma_m=ruler.distance_m,
        height_m=read["height"],
        height_sigma_m=ruler.height_m,
        azimuth_rad=read["azimuth"],
        azimuth_sigma_rad=ruler.azimuth_rad,
    )


def _read(sample: Sample, what: str, value: float, sigma: float) -> float:
    """Reading of a ruler; 0 where it is not used."""
    if not math.isfinite(sigma):
        return 0.0
    # a stream of its own for each quantity: measuring one more changes no other
    return float(value + sigma * generator(*sample.stream_names, "calibration", what).standard_normal())


def one_per_pose(samples: Sequence[Sample]) -> list[tuple[Sample, str]]:
    """Sample and position of every mirror pose, once each, in the order of their appearance."""
    poses: dict[str, tuple[Sample, str]] = {}
    for sample in samples:
        for position in POSITIONS:
            poses.setdefault(sample.row.position(position).pose, (sample, position))
    return list(poses.values())
