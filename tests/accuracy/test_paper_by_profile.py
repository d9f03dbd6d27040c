"""The paper's experiments with the sphere as a mirror of revolution: truth, light and D against its own path."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.oracles import TARGETS, paper_cases

from phibench.estimator.geometry.triangulate import depth_exact
from phibench.render.optics.spot_layer import spot_layer
from phibench.render.optics.truth import SpotTruth, spot_truth
from phibench.scenes.frames import Pose
from phibench.scenes.laser import LaserSpot, beam_diameter_m
from phibench.scenes.revolved_mirror import RevolvedMirror
from phibench.scenes.revolved_profile import sphere_cap
from phibench.scenes.rig import Rig
from phibench.scenes.room import default_rig

ANGLES = ("phi_ray_rad", "phi_normal_rad", "phi_incidence_rad", "azimuth_rad")
LENGTHS = ("path_spot_mirror_m", "path_mirror_camera_m")


def by_profile() -> Rig:
    """Default rig, its sphere a cap that ends at 59.9 mm; the vertex is a radius nearer than the centre."""
    ball = default_rig()
    x, y, z = ball.T_camera_sphere.translation_m
    R = ball.sphere.radius_m
    return replace(
        ball, mirror=RevolvedMirror(sphere_cap(R, 0.0599)), T_camera_sphere=Pose("camera", "sphere", (x, y, z - R))
    )


def test_accuracy_the_papers_data_by_the_general_path() -> None:
    """All 25 experiments, both positions: 1e-9 px, rad, m and of D; the spots' light to 1e-9 of its brightest pixel."""
    rigs, largest, experiments = (default_rig(), by_profile()), dict.fromkeys(("px", "rad", "m", "D", "light"), 0.0), 0
    for row, position in paper_cases():
        target = next(t for t in TARGETS if t.depth_m == row.real_depth_m)
        spot = LaserSpot(tuple(position), target.normal_world, beam_diameter_m(target.depth_m))
        truths: list[list[SpotTruth]] = [
            [spot_truth(rig.at(h), spot, ()) for h in (0.0, row.baseline_m)] for rig in rigs
        ]
        for one, two in zip(*truths, strict=True):
            assert one.visible
            assert two.visible
            largest["px"] = max(largest["px"], abs(one.u_px - two.u_px), abs(one.v_px - two.v_px))
            largest["rad"] = max(largest["rad"], *(abs(getattr(one, n) - getattr(two, n)) for n in ANGLES))
            largest["m"] = max(largest["m"], *(abs(getattr(one, n) - getattr(two, n)) for n in LENGTHS))
        D = [
            float(depth_exact(rig, row.baseline_m, *(np.array([t.u_px, t.v_px]) for t in both)).depth_m)
            for rig, both in zip(rigs, truths, strict=True)
        ]
        largest["D"] = max(largest["D"], abs(D[1] / D[0] - 1.0), abs(D[1] / row.real_depth_m - 1.0))
        if experiments % 5 == 0:
            one, two = (spot_layer(rig.at(row.baseline_m), spot, ()).electrons_per_s for rig in rigs)
            largest["light"] = max(largest["light"], float(np.abs(one - two).max() / one.max()))
        experiments += 1
    print({name: f"{value:.1e}" for name, value in largest.items()})
    assert experiments == 25
    assert all(value < 1e-9 for value in largest.values())


def test_another_sphere_is_noticed() -> None:
    """A radius that is 1 nm larger moves the image by more than 1e-9 px."""
    rig = by_profile()
    assert isinstance(rig.mirror, RevolvedMirror)
    larger = replace(rig, mirror=RevolvedMirror(sphere_cap(0.060000001, 0.0599)))
    spot = LaserSpot((2.0, 0.5, 0.5), (-1.0, 0.0, 0.0), 5e-3)
    one, two = (spot_truth(r.at(0.0), spot, ()) for r in (rig, larger))
    assert abs(one.u_px - two.u_px) == pytest.approx(5e-6, rel=0.9)
