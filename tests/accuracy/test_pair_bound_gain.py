"""What the bound of both images together gains over that of each image, on samples of `random`: docs/limits.md.

`pytest --slow -s tests/accuracy/test_pair_bound_gain.py` prints the ratios. Nothing is rendered: rigs, strokes and
spots are those of the recipe, over an even room.
"""

from __future__ import annotations

import numpy as np
import pytest

from phibench.datasets.frames.sensor_card import SensorCard, sensor_card
from phibench.datasets.plan.plan import make_plan
from phibench.datasets.recipe.load import load_recipe
from phibench.estimator.geometry.least_squares_depth import joint_bound
from phibench.estimator.geometry.phi import estimate_phi
from phibench.estimator.geometry.reflection import image_of
from phibench.estimator.geometry.triangulate import depth_exact
from phibench.estimator.limits.position_bound import limit_of, raw_information
from phibench.estimator.limits.processed_bound import chain_limit
from phibench.estimator.spots.gaussian_spot import LASER_RESPONSE, SpotBlur, SpotModel, SpotPixels
from phibench.estimator.spots.image_planes import bayer_filters
from phibench.estimator.spots.spot_prediction import Laser, spot_blur, spot_electrons_per_s
from phibench.scenes.frames import Array
from phibench.scenes.random_streams import generator

SAMPLES, SIDE_PX = 100, 24
ROOM_E = (100.0, 90.0, 60.0)
QUALITIES = (75, 85, 95)


def bound(card: SensorCard, uv: Array, sigma_px: float, flux_e: float, pattern_known: bool = False) -> Array:
    if card.output == "mjpeg":
        return chain_limit(card, uv, SpotBlur(sigma_px), flux_e, ROOM_E, LASER_RESPONSE).covariance_px2
    corner = np.floor(uv).astype(np.int64) - SIDE_PX // 2
    filters = bayer_filters(corner[None], (SIDE_PX, SIDE_PX))
    pixels = SpotPixels.of(filters, SpotBlur(sigma_px), SpotModel(LASER_RESPONSE))
    mean, slopes = pixels.at(np.array([[*(uv - corner), flux_e, *ROOM_E]]))
    return limit_of(slopes[0], raw_information(mean[0], card, pattern_known=pattern_known)).covariance_px2


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["bayer-raw", "mjpeg"])
def test_gain_of_the_pairs_bound(preset: str) -> None:
    """At least 1 for every pair; positions gain sqrt(4 / 3) = 1.15 where all coordinates are alike, D hardly."""
    recipe = load_recipe("random")
    assert recipe.random is not None
    few = recipe.random.model_copy(update={"samples": SAMPLES})
    plan, rng, rows = make_plan(recipe.model_copy(update={"random": few})), generator("pair bound", preset), []
    for pair in plan.pairs:
        rig, spot = plan.rigs[pair.nominal_rig], plan.spots[pair.spot]
        seconds = np.exp(rng.uniform(np.log(0.25 * 0.004), np.log(1.0 / 60.0)))
        card = sensor_card(preset, **({"jpeg_quality": int(rng.choice(QUALITIES))} if preset == "mjpeg" else {}))
        uv, C, known = [], [], []
        for offset_m in (0.0, pair.stroke_m):
            seen = image_of(rig.at(0.0), np.array(spot.position_world_m) - offset_m * np.array(rig.stroke_axis_world))
            flux_e = seconds * float(spot_electrons_per_s(rig, Laser(), seen, np.array(spot.normal_world)))
            numbers = card, seen.uv_px, spot_blur(rig, tuple(seen.uv_px)).sigma_px, flux_e
            uv.append(seen.uv_px)
            C.append(bound(*numbers))
            known.append(bound(*numbers, pattern_known=True))
        if not np.isfinite(C).all() or max(np.trace(one) for one in C) > 1.0:
            continue  # as a score leaves it out
        D = float(np.linalg.norm((np.array(spot.position_world_m) - rig.at(0.0).sphere_centre_m)[:2]))
        joint = joint_bound(rig, pair.stroke_m, uv[0], D, *C)
        both = joint.covariance_down_px2, joint.covariance_up_px2
        phi = [
            float(estimate_phi("ray", rig.at(0.0), x, a).variance_rad2)
            / float(estimate_phi("ray", rig.at(0.0), x, b).variance_rad2)
            for x, a, b in zip(uv, C, both, strict=True)
        ]
        free_m = float(depth_exact(rig, pair.stroke_m, uv[0], uv[1], *C).sigma_m)
        rows.append(
            [
                *(np.sqrt(np.trace(a) / np.trace(b)) for a, b in zip(C, both, strict=True)),
                np.sqrt((np.trace(C[0]) + np.trace(C[1])) / (np.trace(both[0]) + np.trace(both[1]))),
                *np.sqrt(phi),
                free_m / np.sqrt(float(joint.variance_depth_m2)),
                np.sqrt(np.trace(C[0]) / np.trace(known[0])),
            ]
        )
    table = np.array(rows)
    names = ("position down", "position up", "positions", "phi down", "phi up", "D", "fixed pattern known")
    for name, x in zip(names, table.T, strict=True):
        print(
            f"{preset}, {len(x)} pairs, bound of each image / of the pair, {name}: median {np.median(x):.3f}, "
            f"90 % {np.quantile(x, 0.9):.3f}, largest {x.max():.3f}"
        )
    assert len(table) >= 0.9 * SAMPLES
    assert table[:, :6].min() >= 1.0 - 1e-9
    assert 1.05 < np.median(table[:, 2]) < 1.4
    assert np.median(table[:, 5]) < 1.05
