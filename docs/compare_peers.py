"""Bound of this project's sensor at the distance and baseline of published sensors: `compare_peers.py`.

Two bounds, both of single MJPEG or raw frames, the rig known exactly, the spot of a 1 mW laser on a wall of the lab:

* own mirror: exact rays of the default rig with the peer's D and h, and the bound of the spot's position there;
* its pixels: the same position error in pixels on images of the peer's resolution, through equation (7) of the paper
  with both rays horizontal. This is an approximation: sigma_D = D^2 / h * sqrt(2) * sigma_px * (radians per pixel).

Prints the tables of docs/peers.md, which says where the published figures were read.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from phibench.datasets.frames.sensor_card import SensorCard, card_of
from phibench.estimator.geometry.paper_depth import error_eq7, load_published
from phibench.estimator.geometry.phi import estimate_phi
from phibench.estimator.geometry.reflection import image_of
from phibench.estimator.geometry.triangulate import depth_exact
from phibench.estimator.limits.best_stroke import spot_bound
from phibench.estimator.limits.processed_bound import SpotSigma
from phibench.estimator.spots.spot_prediction import Laser, spot_electrons_per_s
from phibench.render.sensor.settings import sensor
from phibench.scenes.rig import Rig
from phibench.scenes.room import default_rig

PRESETS = ("mjpeg", "bayer-raw")
EXPOSURE_S = 0.046  # auto exposure in the lab: docs/experiments.md
SPOT_HEIGHT_M = 0.50  # of all targets in datasets/recipes/paper.toml
WALL_NORMAL = np.array([-1.0, 0.0, 0.0])  # an upright wall along world x, facing the mirror
HORIZONTAL = np.pi / 4.0  # phi of a horizontal ray


@dataclass(frozen=True)
class Peer:
    """Geometry of one published sensor.

    Attributes
    ----------
    name : str
    depth_m : float
        Distance at which the published error holds.
    baseline_m : float
    rad_per_px : float
        Angle in the plane of both rays that a pixel of its images spans.
    published : float
        Error of D, relative.
    """

    name: str
    depth_m: float
    baseline_m: float
    rad_per_px: float
    published: float

    def on_its_pixels(self, sigma_px: float) -> float:
        """Relative standard deviation of D for that of each of two positions, pixels; an approximation."""
        per_rad = float(error_eq7(self.depth_m, HORIZONTAL, HORIZONTAL, self.baseline_m))
        return per_rad * float(np.sqrt(2.0)) * sigma_px * self.rad_per_px / self.depth_m


@dataclass(frozen=True)
class Own:
    """Bound of the default rig for one pair.

    Attributes
    ----------
    exact, approximate : float
        Relative standard deviation of D, by exact rays and by equation (7) with horizontal rays.
    sigma_px : float
        Bound of a position, root mean square of both images.
    """

    exact: float
    approximate: float
    sigma_px: float


def own_bound(rig: Rig, spot: SpotSigma, depth_m: float, stroke_m: float) -> Own:
    """Bound of D for a spot at 0.5 m above the floor, the rig known exactly."""
    point, views = np.array([depth_m, 0.0, SPOT_HEIGHT_M]), (rig.at(0.0), rig.at(stroke_m))
    seen = [image_of(rig.at(0.0), point - np.array([0.0, 0.0, offset])) for offset in (0.0, stroke_m)]
    light = [float(spot_electrons_per_s(rig, Laser(), one, WALL_NORMAL)) * EXPOSURE_S for one in seen]
    uv, covariances = [one.uv_px for one in seen], [float(spot.at(e)) ** 2 * np.eye(2) for e in light]
    exact = depth_exact(rig, stroke_m, uv[0], uv[1], covariances[0], covariances[1])
    phi = [estimate_phi("ray", *given) for given in zip(views, uv, covariances, strict=True)]
    theta = 2.0 * np.sqrt(sum(float(one.variance_rad2) for one in phi))
    per_rad = float(error_eq7(depth_m, HORIZONTAL, HORIZONTAL, stroke_m))
    sigma_px = float(np.sqrt(np.mean([c[0, 0] for c in covariances])))
    return Own(float(exact.sigma_m) / depth_m, float(per_rad * theta) / depth_m, sigma_px)


# -- published geometries ----------------------------------------------------------------------------------------------


def two_fisheyes(method: str, disparity_mae_deg: float, depth_mare: float) -> Peer:
    """Helvipad: one camera above the other; the distance at which both mean errors agree stands for its scenes.

    Baseline and rows are those of `compute_depth_from_disparity` in public code: 0.191 m, and 960 rows in 180 degrees,
    on which disparities are estimated. The photographs have 1920.
    """
    depth = depth_mare * 0.191 / float(np.radians(disparity_mae_deg))
    return Peer(f"two fisheyes, {method}", depth, 0.191, np.pi / 960, depth_mare)


def folded_hyperboloids() -> Peer:
    """Two hyperbolic mirrors over one camera, from the published curve of range by disparity.

    The curve steps by 0.105 m from 21 to 22 pixels. Such steps fall as K / (n (n + 1)), so that the range at n pixels
    is K / n. The baseline is c1 + c2 - d of the design file, 123.488 + 241.803 - 233.684 mm.
    """
    n, step_m, baseline_m = 21, 0.105, 0.131607
    depth = step_m * (n + 1)
    return Peer("two hyperboloids, one camera", depth, baseline_m, baseline_m / (depth * n), step_m / depth)


PEERS = (
    two_fisheyes("PSMNet", 0.286, 0.176),
    two_fisheyes("360-IGEV-Stereo", 0.188, 0.130),
    two_fisheyes("DFI-OmniStereo", 0.158, 0.108),
    folded_hyperboloids(),
)


# -- tables ------------------------------------------------------------------------------------------------------------


def rms(values: list[float]) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def paper_table(rig: Rig, spots: list[SpotSigma]) -> None:
    """Print the paper's errors and bounds, by table."""
    print("| experiments | published, rms | mjpeg, rms | bayer-raw, rms | approximation over exact |")
    results = load_published()
    for wanted in ("table1", "table2", "table3", "table4", "table"):
        part = [p for p in results if p.experiment.startswith(wanted)]
        own = [[own_bound(rig, spot, p.real_depth_m, p.baseline_m) for p in part] for spot in spots]
        ratio = [one.approximate / one.exact for one in own[0]]
        print(
            f"| {wanted}, {len(part)} | {rms([p.error_m / p.real_depth_m for p in part]):.2%} "
            f"| {rms([one.exact for one in own[0]]):.2%} | {rms([one.exact for one in own[1]]):.2%} "
            f"| {min(ratio):.2f} to {max(ratio):.2f} |"
        )


def peer_table(rig: Rig, spots: list[SpotSigma]) -> None:
    """Print published errors of other sensors and both bounds, MJPEG / raw."""
    print("\n| sensor | D, m | h, m | mrad a pixel | published | sigma, px | own mirror | its pixels |")
    for peer in PEERS:
        own = [own_bound(rig, spot, peer.depth_m, peer.baseline_m) for spot in spots]
        cells = (
            " / ".join(f"{one.sigma_px:.3f}" for one in own),
            " / ".join(f"{one.exact:.1%}" for one in own),
            " / ".join(f"{peer.on_its_pixels(one.sigma_px):.1%}" for one in own),
        )
        print(
            f"| {peer.name} | {peer.depth_m:.2f} | {peer.baseline_m:.3f} | {peer.rad_per_px * 1e3:.2f} "
            f"| {peer.published:.1%} | {' | '.join(cells)} |"
        )


def main() -> None:
    """Print both tables."""
    rig = default_rig()
    cards: list[SensorCard] = [card_of(sensor(preset, exposure_s=EXPOSURE_S)) for preset in PRESETS]
    spots = [spot_bound(rig, card) for card in cards]
    paper_table(rig, spots)
    peer_table(rig, spots)


if __name__ == "__main__":
    main()
