"""Doubts of a measurement as sentences: of the rig, by its mirror's outline; of the spots (`SeenSpot`) and their rays.

Of the rig: another rig file, an old calibration, a camera that was pushed. Of the spots: light that is no spot,
laser-off pictures that moved, rays that do not meet. A sentence begins with "doubtful: " and says what to look at; ""
says that there is nothing.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from phibench.calibration.captures.pair_mistakes import light_ratio, moved_note, moved_positions, relit_note
from phibench.calibration.captures.pair_photos import PairPhotos
from phibench.calibration.captures.spot_shape import UNLIKE
from phibench.calibration.outline.ball_circle import find_circle
from phibench.calibration.outline.first_circle import SIZES_LOOKED_FOR, grey, rig_circle
from phibench.calibration.outline.limb_image import planes_of
from phibench.calibration.outline.outline_result import Outline, PoseMeasurement, mirror_moved, outlines_as_one
from phibench.calibration.rig.calibration_file import Calibration
from phibench.datasets.frames.sensor_card import SensorCard
from phibench.estimator.geometry.least_squares_depth import GeneralDepth
from phibench.estimator.interface import Image, Pair
from phibench.estimator.spots.detect import FARTHEST_M
from phibench.estimator.spots.image_planes import ImageError
from phibench.scenes.frames import Array
from phibench.scenes.rig import POSITIONS, Rig

_AS_SEEN = 0.05  # of a circle's radius: errors of a ruler in radius and distance
_CONTRADICTED = 25.0  # chi^2 of three numbers beyond which is 1 of 7e4 rigs
DOUBTFUL_P = 1e-3
"""Probability of the two rays' gap below which the two spots are not taken for one point."""
_RELIT = 0.03  # relative change of the room's median code from which on it may be what has not the shape of a spot


def contradiction_note(nominal: Rig, outline: PoseMeasurement, chi2: float) -> str:
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


def other_size_note(rig: Rig, picture: Image, card: SensorCard) -> str:
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


def apart_note(outlines: Sequence[Outline]) -> str:
    """Sentence on a mirror that is elsewhere in the second picture: it and the camera move as one."""
    if len(outlines) < len(POSITIONS) or not (moved := mirror_moved(*(one.measured for one in outlines))):
        return ""
    return (
        f"doubtful: {moved} from the picture down to the picture up: the camera was pushed, or its picture is cut or "
        "scaled in another way; take both again"
    )


@dataclass(frozen=True)
class SeenSpot:
    """Position of a spot in one image; pixels, covariance of (u, v), and how unlike a spot its light is (0 to 1)."""

    uv_px: Array
    covariance_px2: Array = field(repr=False)
    unlike: float = 0.0

    @property
    def sigma_px(self) -> float:
        """Root mean square of both coordinates' standard deviations."""
        return math.sqrt(0.5 * float(np.trace(self.covariance_px2)))


def moved_off_notes(pair: Pair, photos: PairPhotos) -> Iterator[str]:
    """Sentences on laser-off pictures that are shifted: edges of the room then count as light of the spot."""
    for position, shift in moved_positions(pair):
        yield f"doubtful: the spot {position} lies on edges: {moved_note(photos, position, shift)}"


def unlike_spot_notes(pair: Pair, photos: PairPhotos, spots: Mapping[str, SeenSpot]) -> Iterator[str]:
    """Sentences on lights that have not the shape of a spot, by position."""
    for position, spot in spots.items():
        if spot.unlike < UNLIKE:
            continue
        (u, v), percent = spot.uv_px, 100.0 * min(spot.unlike, 1.0)
        remedy = "the beam may meet an edge or graze a surface, turn the laser a little"
        ratio = light_ratio(pair, position)
        if ratio is not None and abs(ratio - 1.0) > _RELIT:
            remedy = relit_note(photos, position, ratio)
        yield (
            f"doubtful: the spot {position} at ({u:.0f}, {v:.0f}) px has not the shape of one, {percent:.0f} % "
            f"of its light do not fit; {remedy}"
        )


def too_far_note(depth: GeneralDepth) -> str:
    """Sentence on a D beyond the points that spots are looked for at."""
    if float(depth.depth_m) <= FARTHEST_M:
        return ""
    return (
        f"doubtful: D is beyond {FARTHEST_M:g} m, up to which spots are looked for: one of the two lights may be "
        "another one, or the stroke is not in metres"
    )


def rays_gap_note(depth: GeneralDepth) -> str:
    """Sentence on the test of both rays."""
    p, chi2 = float(depth.p_value), float(depth.chi2)
    if p >= DOUBTFUL_P:
        return f"one point: chi^2 {chi2:.2f} for one degree of freedom (p = {p:.2g})"
    return (
        f"doubtful: the spots are not images of one point, chi^2 {chi2:.1f} for one degree of freedom (p = {p:.1e}); "
        "one may be a reflection, the rig may have turned between the pictures, or the calibration is another rig's"
    )
