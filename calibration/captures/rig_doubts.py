"""Doubts of a rig that its mirror's outline shows: another rig file, an old calibration, a camera that was pushed.

A sentence begins with "doubtful: " and says what to look at; "" says that there is nothing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from phibench.calibration.outline.ball_circle import find_circle
from phibench.calibration.outline.first_circle import SIZES_LOOKED_FOR, grey, rig_circle
from phibench.calibration.outline.limb_image import planes_of
from phibench.calibration.outline.outline_result import Outline, PoseMeasurement, mean_outline, mirror_moved
from phibench.calibration.rig.calibration_file import Calibration
from phibench.datasets.frames.sensor_card import SensorCard
from phibench.estimator.interface import Image
from phibench.estimator.spots.image_planes import ImageError
from phibench.scenes.rig import POSITIONS, Rig

_AS_SEEN = 0.05  # of a circle's radius: errors of a ruler in radius and distance
_CONTRADICTED = 25.0  # chi^2 of three numbers beyond which is 1 of 7e4 rigs


def outlines_as_one(outlines: Sequence[Outline]) -> PoseMeasurement:
    """Weighted mean of outlines of one rig, with the covariance of a single one.

    What an outline claims is mostly what all of them share: the lens's blur, where the limb lies in its edge, the
    nominal camera. Ten outlines of a rig in ten rooms were all 0.4 to 0.6 mm short, each within its sigma.
    """
    mean = mean_outline(outlines)
    return replace(mean, covariance=mean.covariance * len(outlines))


def contradicted(nominal: Rig, outline: PoseMeasurement, chi2: float) -> str:
    """Sentence on a rig file that the outline contradicts by more than the errors of a ruler."""
    if chi2 < _CONTRADICTED:
        return ""
    (x, y, z), camera = outline.value[:3] - nominal.sphere_in_camera_m, nominal.camera
    aside = math.hypot(camera.fx_px * x, camera.fy_px * y) / outline.value[2]
    size = -100.0 * z / outline.value[2]
    return (
        f"doubtful: the mirror's outline contradicts the rig file: it is {abs(size):.1f} % "
        f"{'larger' if size > 0.0 else 'smaller'} than fx_px, radius_m and z_c_m say, and {aside:.0f} px from where it "
        f"says; correct the number that is wrong"
    )


def of_another_size(rig: Rig, picture: Image, card: SensorCard) -> str:
    """Sentence on a picture without the rig's outline that has a clear circle of another size.

    The outline is looked for with about the size that the rig says; here circles of all sizes are.
    """
    try:
        u, v, radius = find_circle(grey(planes_of(picture, card))).circle_px
    except ImageError:
        return ""
    u0, v0, said = rig_circle(rig)
    low, high = SIZES_LOOKED_FOR
    if not said > 0.0 or low <= radius / said <= high:
        return ""
    camera = rig.camera
    return (
        f"doubtful: the mirror's outline is seen as a circle of radius {radius:.0f} px about ({u:.0f}, {v:.0f}), and "
        f"fx_px = {camera.fx_px:g}, z_c_m = {rig.sphere_in_camera_m[2]:g} and the mirror's radius in the rig file give "
        f"{said:.0f} px about ({u0:.0f}, {v0:.0f}); {_likely(rig, radius)}"
    )


def _likely(rig: Rig, radius_px: float) -> str:
    """Advice: the sphere's radius where half or twice of it gives the circle, else all three numbers."""
    if not rig.mirror.has_rim:
        distance, focal_px = (
            float(np.linalg.norm(rig.sphere_in_camera_m)),
            math.sqrt(rig.camera.fx_px * rig.camera.fy_px),
        )
        for factor, words in ((0.5, "the diameter"), (2.0, "half the radius")):
            sine = factor * rig.sphere.radius_m / distance
            if sine < 1.0 and abs(focal_px * math.tan(math.asin(sine)) / radius_px - 1.0) < _AS_SEEN:
                return f"radius_m = {rig.sphere.radius_m:g} is {words}, it seems: write {sine * distance:g}"
    return "correct the number that is wrong"


def calibration_note(held: Calibration, outlines: Sequence[Outline]) -> tuple[str, str]:
    """Sentence on the calibration, and a doubt where the mirror is not where it was."""
    made, text = held.made_from.get("sphere_in_camera_m"), "rig: of the calibration file"
    if not made or not outlines:
        return text, ""
    sigmas = np.array(held.made_from["sigma_m"])
    then = PoseMeasurement(np.mean(made, axis=0), np.diag(np.mean(sigmas**2, axis=0)))
    now = outlines_as_one(outlines)
    if moved := mirror_moved(then, now):
        return text, f"doubtful: {moved} since it was calibrated; calibrate again"
    return f"{text}; the mirror is still where it was", ""


def apart(outlines: Sequence[Outline]) -> str:
    """Sentence on a mirror that is elsewhere in the second picture: it and the camera move as one."""
    if len(outlines) < len(POSITIONS) or not (moved := mirror_moved(*(one.measured for one in outlines))):
        return ""
    return (
        f"doubtful: {moved} from the picture down to the picture up: the camera was pushed, or its picture is cut or "
        "scaled in another way; take both again"
    )
