"""Mirrors of equal rim beside each other: field of view, resolution, bound of D, cost of misalignments.

All from closed forms, for the default camera and a spot 0.5 m high. Prints the tables of docs/mirrors.md.
"""

from __future__ import annotations

import numpy as np
from compare_peers import EXPOSURE_S, PRESETS, own_bound

from phibench.datasets.frames.sensor_card import card_of
from phibench.datasets.recipe.build import build_rig
from phibench.datasets.recipe.tables import RigTable
from phibench.estimator.geometry.mirror_image import image_of
from phibench.estimator.geometry.reflection import reflect
from phibench.estimator.geometry.triangulate import depth_exact
from phibench.estimator.limits.best_stroke import spot_bound
from phibench.render.sensor.settings import sensor
from phibench.scenes.frames import Array
from phibench.scenes.misalignment import Misalignment
from phibench.scenes.rig import Rig

SHAPES = ("ellipsoid", "paraboloid", "hyperboloid", "cone")
STROKE_M, SPOT_HEIGHT_M = 0.425, 0.50
DEPTHS_M = (1.0, 2.0, 3.18, 4.18)
ANGLES_DEG = (30.0, 60.0, 75.0, 90.0, 95.0)
DEVIATIONS = {
    "mirror 1 mm aside": Misalignment(decentre_x_m=1e-3),
    "mirror 1 mm higher": Misalignment(axial_m=1e-3),
    "camera 0.1 deg": Misalignment(tilt_y_rad=float(np.radians(0.1))),
    "focal length 1 %": Misalignment(focal_relative=0.01),
    "vertex radius 1 mm": Misalignment(radius_m=1e-3),
}


def rigs() -> dict[str, Rig]:
    """Default rig with each mirror."""
    found = {"sphere": build_rig(RigTable())}
    found |= {shape: build_rig(RigTable.model_validate({"mirror": {"shape": shape}})) for shape in SHAPES}
    return found


def angles_along_u(rig: Rig) -> tuple[Array, Array]:
    """Pixels from the image's middle along u, and theta in degrees of the rays that leave the mirror."""
    u = np.arange(1.0, 640.0, 0.25)
    ray = reflect(rig.at(0.0), np.stack([rig.camera.cx_px + u, np.full_like(u, rig.camera.cy_px)], axis=-1))
    theta = np.degrees(np.arctan2(ray.direction_world[:, 0], -ray.direction_world[:, 2]))
    seen = np.isfinite(theta)
    return u[seen], theta[seen]


def pixels(rig: Rig, depth_m: float) -> tuple[Array, Array]:
    """Exact pixels of a spot, down and up."""
    point = np.array([depth_m, 0.0, SPOT_HEIGHT_M])
    up = np.array([0.0, 0.0, STROKE_M])
    return image_of(rig.at(0.0), point).uv_px, image_of(rig.at(0.0), point - up).uv_px


def main() -> None:
    """Print the tables."""
    every = rigs()
    cards = [card_of(sensor(preset, exposure_s=EXPOSURE_S)) for preset in PRESETS]
    spots = [spot_bound(every["sphere"], card) for card in cards]
    print("| mirror | theta seen, deg |", " | ".join(f"{angle:g} deg" for angle in ANGLES_DEG), "|")
    for name, rig in every.items():
        u, theta = angles_along_u(rig)
        slope = np.gradient(u, theta)
        at = [np.interp(a, theta, slope, left=np.nan, right=np.nan) for a in ANGLES_DEG]
        print(f"| {name} | {theta[0]:.0f} to {theta[-1]:.0f} |", " | ".join(f"{x:.1f}" for x in at), "|")
    print("| mirror |", " | ".join(f"{preset} {depth:g} m" for preset in PRESETS for depth in DEPTHS_M), "|")
    for name, rig in every.items():
        bounds = [own_bound(rig, spot, depth, STROKE_M).exact for spot in spots for depth in DEPTHS_M]
        print(f"| {name} |", " | ".join(f"{100.0 * bound:.2f}" for bound in bounds), "|")
    print("| mirror |", " | ".join(DEVIATIONS), "|")
    for name, rig in every.items():
        errors = []
        for wrong in DEVIATIONS.values():
            true = rig.perturbed(wrong)
            errors.append(float(depth_exact(rig, STROKE_M, *pixels(true, 2.0)).depth_m) / 2.0 - 1.0)
        print(f"| {name} |", " | ".join(f"{100.0 * error:+.2f}" for error in errors), "|")


if __name__ == "__main__":
    main()
